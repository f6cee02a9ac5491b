"""The pieces that measures are composed of, against closed forms and central differences."""

import pickle
import tracemalloc
from types import ModuleType

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.plugins import Plugins
from lampopt.protocols import Gradient, Measure
from lampopt.testing import check_measure, shapes
from lampopt_measure.pieces import (
    Quantity,
    angle,
    atan2,
    circle,
    distance,
    enclosed_area,
    extent,
    highest,
    line,
    lowest,
    maximum,
    mean,
    measure,
    median,
    middle,
    minimum,
    plane,
    section,
    slope,
    sqrt,
    surface,
    total,
)


def lump():
    """An ellipsoid without any symmetry that its triangles keep."""
    mesh = trimesh.creation.icosphere(4)
    mesh.vertices = mesh.vertices * [1, 0.8, 0.7] + 0.05 * np.sin(3 * mesh.vertices[:, [1, 2, 0]] + [0.1, 0.5, 0.9])
    return mesh


def tube():
    return trimesh.creation.cylinder(1.5, 2.0, sections=256).apply_translation((3, 1, 0))


def way(mesh, seed):
    """(V, 3) a smooth random displacement of the size of the mesh."""
    draw = np.random.default_rng(seed)
    size = float(np.max(mesh.extents))
    at = (mesh.vertices - mesh.centroid) / size
    return size * (
        0.3 * at @ draw.normal(size=(3, 3)) + 0.1 * np.sin(3 * at @ draw.normal(size=(3, 3)) + draw.random(3))
    )


def slopes(measured, mesh, seed=0, step=1e-6):
    """By the gradient and by central differences, (p,) each, along a smooth random displacement."""
    move = way(mesh, seed)
    ends = [measured(trimesh.Trimesh(mesh.vertices + s * step * move, mesh.faces, process=False)) for s in (-1, 1)]
    return (measured.gradient(mesh) * move).sum((1, 2)), (ends[1] - ends[0]) / (2 * step)


@measure(
    top="L", bottom="L", radius="L", x="L", z="L", between="deg", apart="L", encloses="L^2", area="L^2", around="L",
    tilt="deg", width="L", rise="deg", near="L",
)  # fmt: skip
def anatomy(mesh, *, at: float = 0.1):
    whole = surface(mesh)
    cut = section(mesh, "y", middle(whole, "y") + at * extent(whole, "y"))
    ring, side = circle(cut.facing("-z", 50)), plane(whole.facing((0.1, 0.9, 0.2), 30))
    top, bottom = line(cut.facing((0.3, 0, 1), 30)), line(cut.facing((0.5, 0, -1), 20))
    return {
        "top": highest(cut),
        "bottom": lowest(cut),
        "radius": ring.radius,
        "x": ring.centre[0],
        "z": ring.centre[2],
        "between": angle(top, bottom),
        "apart": distance(ring, side),
        "encloses": enclosed_area(cut),
        "area": total(whole),
        "around": total(cut),
        "tilt": angle(side, "y"),
        "width": extent(cut, (1, 0, 1)),
        "rise": slope(top),
        "near": line(cut.facing("z", 60), within=0.05).point[2],
    }


@pytest.mark.parametrize("seed", range(4))
def test_gradients_agree_with_central_differences(seed):
    found, wanted = slopes(anatomy(), lump(), seed)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7)


def test_a_circle_around_an_axis_has_a_gradient():
    @measure(radius="L", x="L")
    def round_about(mesh):
        found = circle(surface(mesh).facing("z", 70).between(x=(-0.5, 0.5)), axis="x")
        return {"radius": found.radius, "x": found.centre[1]}

    found, wanted = slopes(round_about(), lump())
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7)


@measure(top="L", fill="")
def shares(mesh, *, at: float = 0.1):
    whole = surface(mesh)
    cut = section(mesh, "z", middle(whole, "z") + at * extent(whole, "z"))
    return {"top": highest(whole) - lowest(whole), "fill": enclosed_area(cut) / extent(cut, "x") / extent(cut, "y")}


numbers = st.floats(0.2, 5)


@settings(max_examples=40, deadline=None)
@given(a=numbers, b=numbers)
def test_arithmetic_keeps_derivatives(a, b):
    def formula(x, y):
        return abs(-x * y + 3 / x - (x - 2 * y) ** 2) + sqrt(x + y) + atan2(x, y) / 90 + 1 - x

    def quantity(value, row):
        return Quantity(value, np.array([row]), np.array([[1.0, 0, 0]]))

    found = formula(quantity(a, 0), quantity(b, 1))
    value = float(formula(a, b))
    assert float(found) == pytest.approx(value)
    step = 1e-6
    by = [
        (float(formula(a + step, b)) - float(formula(a - step, b))) / (2 * step),
        (float(formula(a, b + step)) - float(formula(a, b - step))) / (2 * step),
    ]
    if abs(-a * b + 3 / a - (a - 2 * b) ** 2) > 1e-3:  # the kink of the absolute value has none
        np.testing.assert_allclose(found.gradient(2)[:, 0], by, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.collected().gradient(3)[:2], found.gradient(2))


def test_order_statistics():
    given_ = [Quantity(v, np.array([i]), np.ones((1, 3))) for i, v in enumerate((3.0, 1.0, 2.0, 9.0))]
    assert [float(f(given_)) for f in (mean, median)] == [3.75, 2.5]
    assert float(minimum(*given_)) == 1
    assert float(maximum(*given_, 20.0)) == 20
    np.testing.assert_array_equal(median(given_).gradient(4)[:, 0], [0.5, 0, 0.5, 0])
    np.testing.assert_array_equal(median(given_[:3]).gradient(4)[:, 0], [0, 0, 1, 0])


def test_section_of_a_box():
    box = trimesh.creation.box((2, 4, 6))
    cut = section(box, "z", 1.0)
    assert float(enclosed_area(cut)) == pytest.approx(8)
    assert float(total(cut)) == pytest.approx(12)
    assert float(extent(cut, "x")) == pytest.approx(2)
    assert float(total(cut.facing("x"))) == pytest.approx(4)
    np.testing.assert_allclose(cut.facing("x").middles[:, 0], 1)
    assert float(enclosed_area(section(box, (0, 1, 0), -1.0))) == pytest.approx(12)
    assert float(enclosed_area(section(box, (1, 1, 1), 0.1))) > 0


def test_a_hole_is_taken_off():
    outer, inner = trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1, 1, 1))
    inner.invert()
    assert float(enclosed_area(section(trimesh.util.concatenate([outer, inner]), "z", 0.1))) == pytest.approx(3)


def test_faces_of_a_box():
    box = trimesh.creation.box((2, 4, 6))
    side = plane(surface(box).facing("x"))
    np.testing.assert_allclose([float(n) for n in side.normal], [1, 0, 0], atol=1e-12)
    assert float(distance(side, plane(surface(box).facing("-x")))) == pytest.approx(2)
    assert float(angle(side, plane(surface(box).facing("y")))) == pytest.approx(90)
    assert float(angle(side, "x")) == pytest.approx(90)  # of the surface to the axis, not of its normal
    assert float(angle(side, "z")) == pytest.approx(0)
    assert float(total(surface(box).between(z=(2.9, 3.1)))) == pytest.approx(8)


def test_circle_of_a_tube():
    found = circle(section(tube(), "z", 0.3))
    assert float(found.radius) == pytest.approx(1.5, rel=1e-4)
    np.testing.assert_allclose([float(c) for c in found.centre], [3, 1, 0.3], atol=1e-9)
    around = circle(surface(tube()).facing("x", 80), axis="z")
    assert float(around.radius) == pytest.approx(1.5, rel=1e-9)


def test_a_consensus_leaves_out_what_disagrees():
    slab = trimesh.creation.box((4, 2, 0.2))
    lumps = [trimesh.creation.box((0.3, 3, 0.3)).apply_translation((x, 0, 0.3)) for x in (-1.5, 1.2)]
    profile = section(trimesh.util.concatenate([slab, *lumps]), "y", 0.0).facing("z", 20)
    assert float(line(profile).point[2]) > 0.12
    assert float(line(profile, within=0.01).point[2]) == pytest.approx(0.1)
    assert float(slope(line(profile, within=0.01))) == pytest.approx(0, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(turn=st.floats(-80, 80))
def test_slopes_are_true_angles(turn):
    slab = trimesh.creation.box((4, 1, 0.1))
    slab.apply_transform(trimesh.transformations.rotation_matrix(-np.radians(turn), (0, 1, 0)))
    top = section(slab, "y", 0.013).facing((-np.sin(np.radians(turn)), 0, np.cos(np.radians(turn))), 10)
    assert float(slope(line(top))) == pytest.approx(turn, abs=1e-6)
    assert float(angle(line(top), "x")) == pytest.approx(abs(turn), abs=1e-5)


def test_distances():
    a, b = (trimesh.creation.cylinder(0.2, 1, sections=64).apply_translation((x, 0, 0)) for x in (0, 3))
    cut = section(trimesh.util.concatenate([a, b]), "z", 0.1)
    left, right = circle(cut.between(x=(-1, 1))), circle(cut.between(x=(2, 4)))
    assert float(distance(left, right)) == pytest.approx(3)
    roof, floor = (line(section(trimesh.creation.box(), "y", 0.1).facing(to)) for to in ("z", "-z"))
    assert float(distance(roof, floor)) == pytest.approx(1)
    assert float(distance(left, roof)) == pytest.approx(np.hypot(0.1, 0.4))


def test_a_decorated_function_is_a_measure():
    made = anatomy()
    assert isinstance(made, Measure)
    assert isinstance(made, Gradient)
    assert made == anatomy(at=0.1) != anatomy(at=0.2)
    assert repr(made) == "anatomy(at=0.1)"
    assert anatomy.names[:2] == ("top", "bottom")
    assert anatomy.units[5] == "deg"
    check_measure(shares())
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(made))(lump()), made(lump()))


def test_it_is_registered_as_any_class():
    module = ModuleType("extra")
    module.lampopt_measures = lampopt.hookimpl(lambda: {"anatomy": anatomy})
    plugins = Plugins.load(extra=[("extra", module)])
    assert plugins.make("measure", lampopt.Spec("anatomy", at=0.05)) == anatomy(at=0.05)


def test_a_value_without_derivative_is_named():
    @measure(height="L", count="")
    def partly(mesh):
        return {"height": extent(surface(mesh), "z"), "count": float(len(mesh.faces))}

    np.testing.assert_array_equal(partly()(trimesh.creation.box()), [1, 12])
    with pytest.raises(MeasureError, match="'count' has no derivative"):
        partly().gradient(trimesh.creation.box())


def test_a_kink_has_no_derivative():
    @measure(lean="deg")
    def lean(mesh):
        area = total(surface(mesh))
        return {"lean": sqrt(area - float(area))}

    assert lean()(trimesh.creation.box())[0] == 0
    with pytest.raises(MeasureError, match="'lean' has no derivative"):
        lean().gradient(trimesh.creation.box())


def test_wrong_use_is_explained():
    with pytest.raises(InputError, match="expected names with units"):
        measure()

    with pytest.raises(InputError, match="expected a default for option 'at'"):

        @measure(a="L")
        def without(mesh, *, at):
            return {}

    @measure(a="L")
    def wrong(mesh):
        return {"b": 1.0}

    with pytest.raises(MeasureError, match="expected values a, got b"):
        wrong()(trimesh.creation.box())
    with pytest.raises(EmptyMesh):
        wrong()(trimesh.Trimesh())
    with pytest.raises(InputError, match="expected one of x"):
        section(trimesh.creation.box(), "w", 0.0)
    with pytest.raises(InputError, match="three numbers, not all zero"):
        section(trimesh.creation.box(), (0, 0, 0), 0.0)


def test_what_is_not_there_is_said():
    box = trimesh.creation.box()
    nothing = section(box, "z", 5.0)
    assert len(nothing) == 0
    for piece in (highest, line, circle, enclosed_area):
        with pytest.raises(MeasureError, match="expected"):
            piece(nothing)
    with pytest.raises(MeasureError, match="along a line"):
        circle(section(box, "z", 0.1).facing("x"))
    with pytest.raises(MeasureError, match="expected a section, got triangles"):
        circle(surface(box))
    opened = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 0] < 0.5], process=False)
    with pytest.raises(MeasureError, match="open ends"):
        enclosed_area(section(opened, "z", 0.1))
    assert float(extent(section(opened, "z", 0.1), "y")) == pytest.approx(1)  # a section of an open mesh is one


@measure(root="L")
def rooted(mesh):
    return {"root": sqrt(1.0 - extent(surface(mesh), "x"))}


@measure(share="")
def shared(mesh):
    return {"share": 1 / (extent(surface(mesh), "x") - 2.0)}


@measure(power="L")
def powered(mesh):
    return {"power": (1.0 - extent(surface(mesh), "x")) ** 0.5}


@pytest.mark.parametrize("made", [rooted, shared, powered])
def test_what_cannot_be_worked_out_is_said_of_this_mesh(made):
    """One shape of a sweep must not end it."""
    with pytest.raises(MeasureError, match=f"{made.__name__}: cannot be worked out on this mesh"):
        made()(shapes.box((2, 1, 1)))


def only_some(*, part=0.5):
    if not 0 < part < 1:
        raise InputError(f"part: expected a share, got {part}")


@measure(None, only_some, size="L")
def portion(mesh, *, part: float = 0.5):
    return {"size": part * extent(surface(mesh), "x")}


def test_options_are_checked_before_anything_is_measured():
    assert portion(part=0.25)(shapes.box((2, 1, 1))) == pytest.approx([0.5])
    with pytest.raises(InputError, match="part: expected a share"):
        portion(part=2.0)


def test_a_consensus_among_many_facets_takes_little_memory():
    """Votes of all candidates at once would take gigabytes."""
    ball = trimesh.creation.icosphere(subdivisions=7)  # 327,680 faces
    tracemalloc.start()
    plane(surface(ball), within=0.1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.5e9


def quantity(value, row=0):
    return Quantity(value, np.array([row]), np.ones((1, 3)))


def test_quantities_are_compared_by_value():
    one, two = quantity(1.0), quantity(2.0, 1)
    assert one < two
    assert two >= one
    assert one <= 1.0 < two
    assert not one > two
    assert min(two, one) is one
    assert max(one, two, key=float) is two


def test_numpy_numbers_go_along_and_its_functions_are_refused():
    found = np.float64(3) * quantity(2.0) - np.float64(1) / quantity(2.0) + np.int64(1)
    assert float(found) == 6.5
    np.testing.assert_allclose(found.gradient(1), 3.25)
    with pytest.raises(
        TypeError, match=r"np\.sqrt: keeps no derivative of a quantity; of lampopt_measure\.pieces take sqrt"
    ):
        np.sqrt(quantity(2.0))
    with pytest.raises(TypeError, match=r"np\.minimum: .*minimum, maximum"):
        np.minimum(quantity(2.0), quantity(1.0))


@pytest.mark.parametrize("layer", [-1.0, np.nan, np.inf, "deep"])
def test_a_layer_is_a_length(layer):
    with pytest.raises(InputError, match="layer: expected a length of at least 0"):
        highest(surface(shapes.box((2, 1, 1))), layer=layer)


def test_places_and_distances_are_finite_numbers():
    box = shapes.box((2, 1, 1))
    for at in (np.nan, np.inf, "0"):
        with pytest.raises(InputError, match="section: at: expected a finite number"):
            section(box, "z", at)
    for within in (np.nan, 0.0, "a"):
        with pytest.raises(InputError, match="within: expected a distance above 0"):
            line(section(box, "z", 0.0), within=within)
    for within in (np.nan, 0.0, 181.0):
        with pytest.raises(InputError, match="facing: within: expected an angle"):
            surface(box).facing("z", within)


def test_a_run_that_is_nearly_straight_is_no_arc():
    plate = trimesh.creation.cylinder(100.0, 2.0, sections=720)  # of which 6° are looked at
    bow = section(plate, "z", 0.1).facing("x", 3)
    with pytest.raises(MeasureError, match=r"circle: expected a radius of at most .* got 100\.0.* say how large"):
        circle(bow)
    assert float(circle(bow, largest=200.0).radius) == pytest.approx(100, rel=1e-3)
    with pytest.raises(MeasureError, match="expected a radius of at most 50, got"):
        circle(section(plate, "z", 0.1), largest=50.0)
    with pytest.raises(InputError, match="largest: expected a radius above 0"):
        circle(bow, largest=-1.0)


@measure(height="L", length="L")
def roof(mesh):
    whole = surface(mesh)
    top = section(mesh, "y", at=middle(whole, "y") + 0.01 * extent(whole, "y")).facing("z", within=30)
    return {"height": highest(top) - lowest(whole), "length": extent(top, "x")}


@measure(None, None, {"top": "z"}, top="L", size="L")
def top_of_it(mesh):
    return {"top": highest(surface(mesh)), "size": extent(surface(mesh), "z")}


@pytest.mark.parametrize("made", [roof, top_of_it])
def test_places_are_declared(made):
    assert made.positions == (("z", "") if made is top_of_it else ("", ""))
    check_measure(made())


def test_what_a_function_has_to_return():
    @measure(a="L")
    def nothing(mesh):
        return None

    @measure(a="L")
    def words(mesh):
        return {"a": "long"}

    @measure(a="L")
    def lost(mesh):
        return {"a": highest(section(mesh, "z", 9.0))}

    box = shapes.box((2, 1, 1))
    with pytest.raises(InputError, match="nothing: expected a mapping of names to numbers to be returned, got None"):
        nothing()(box)
    with pytest.raises(InputError, match="words: 'a': expected a quantity or a number, got 'long'"):
        words()(box)
    with pytest.raises(MeasureError, match="lost: expected something to look for its end along z"):
        lost()(box)
    with pytest.raises(InputError, match="a: expected a unit as text"):
        measure(a=1)
    with pytest.raises(InputError, match="positions: expected a value's name and x, y or z, got 'b'"):
        measure(None, None, {"b": "x"}, a="L")


def test_what_agrees_on_nothing_is_said():
    ball = lump()
    ball.vertices += np.random.default_rng(0).normal(size=ball.vertices.shape) * 0.05
    with pytest.raises(MeasureError, match=r"expected a line within 1e-06 .* too rough, too coarse, or bent"):
        line(section(ball, "z", 0.01), within=1e-6)
