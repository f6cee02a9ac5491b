"""Measures of machined parts: closed forms, solids cut by manifold3d, trimesh's own integrals, real parts."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from manifold3d import Manifold
from skimage.measure import marching_cubes

from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.metrics import r_squared
from lampopt.plugins import Plugins
from lampopt.testing import ConformanceError, measure_checks, shapes
from lampopt.testing.measures import check_place_does_not_matter
from lampopt_families.plate import HIGH, LOW, plate_mesh
from lampopt_measure.basic import Area, Extents, Volume
from lampopt_measure.facets import section
from lampopt_measure.holes import Hole, Holes, area_and_centre
from lampopt_measure.mass import Centroid, Inertia
from lampopt_measure.plate import Plate
from lampopt_measure.wall import Wall
from lampopt_measure.wetted import WettedArea

PARTS = Path(__file__).parent.parent.parent / "shared" / "data" / "parts"
PLATE = np.array([2.5, 1.7, 0.25, 0.2, 0.05, -0.03])
MIDDLE, HALF = (np.array(LOW) + HIGH) / 2, (np.array(HIGH) - LOW) / 2


def mesh(solid: Manifold) -> trimesh.Trimesh:
    found = solid.to_mesh()
    return trimesh.Trimesh(found.vert_properties[:, :3].astype(float), found.tri_verts, process=False)


def drilled(*holes: tuple[str, float, float, float], size=(6.0, 5.0, 4.0), corners=64) -> Manifold:
    """A block about the origin with round holes: the axis they run along, radius, place along the two axes after it."""
    block = Manifold.cube(size, True)
    for axis, radius, u, v in holes:
        drill = Manifold.cylinder(20, radius, radius, corners, True).translate((u, v, 0))
        turn = {"z": (0, 0, 0), "x": (90, 0, 90), "y": (0, -90, -90)}[axis]
        block -= drill.rotate(turn)
    return block


def seen_radius(radius: float, corners: int = 64) -> float:
    """Of the circle that has the area of a regular polygon with its corners at `radius`."""
    return radius * np.sqrt(corners / (2 * np.pi) * np.sin(2 * np.pi / corners))


def rough(size: float = 0.02) -> trimesh.Trimesh:
    """A plate whose vertices are all out of line, so that nothing ties."""
    fine = trimesh.remesh.subdivide(*(lambda m: (m.vertices, m.faces))(plate_mesh(PLATE, segments=32)))
    vertices = fine[0] + np.random.default_rng(3).normal(size=fine[0].shape) * size * PLATE[2]
    return trimesh.Trimesh(vertices, fine[1], process=False)


def sampled(parameters: np.ndarray, cells: int) -> trimesh.Trimesh:
    """A plate by marching cubes on its exact signed distance."""
    size = np.array(parameters[:3]) * 1.1
    axes = [np.linspace(-s / 2, s / 2, cells + 1) for s in size]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    length, width, thickness, radius, u, v = parameters
    a, b = abs(x) - length / 2, abs(y) - width / 2
    flat = np.minimum(np.maximum(a, b), 0) + np.hypot(np.maximum(a, 0), np.maximum(b, 0))
    flat = np.maximum(flat, radius - np.hypot(x - u, y - v))
    high = abs(z) - thickness / 2
    distance = np.minimum(np.maximum(flat, high), 0) + np.hypot(np.maximum(flat, 0), np.maximum(high, 0))
    vertices, faces, _, _ = marching_cubes(distance, 0, spacing=[axis[1] - axis[0] for axis in axes])
    return trimesh.Trimesh(vertices - size / 2, faces, process=False)


@measure_checks(Hole(), Holes(), Wall(), Centroid(), Inertia(), Plate(), Extents(), Volume(), Area(), Hole(which=-1))
def test_they_keep_to_the_protocol(check):
    check()


def test_they_come_in_by_the_front_door():
    plugins = Plugins.load()
    made = [plugins.make("measure", name) for name in ("hole", "holes", "wall", "centroid", "inertia")]
    assert made == [Hole(), Holes(), Wall(), Centroid(), Inertia()]


# Centroid and inertia


def test_mass_of_a_box():
    box = trimesh.creation.box((1, 2, 3), transform=trimesh.transformations.translation_matrix((70, -8, 9)))
    np.testing.assert_allclose(Centroid()(box), (70, -8, 9), rtol=1e-13)
    np.testing.assert_allclose(Inertia()(box), [6 * (1 + 4) / 12, 6 * (1 + 9) / 12, 6 * (4 + 9) / 12])


def test_mass_of_a_plate_with_a_hole():
    # a cuboid less a prism with the hole's 128 corners, whose area is n/2 r² sin(2π/n)
    length, width, thickness, radius, x, _ = PLATE
    hole = thickness * np.pi * seen_radius(radius, 128) ** 2
    block = length * width * thickness
    found = Centroid()(plate_mesh(PLATE))
    np.testing.assert_allclose(found[0], -hole * x / (block - hole), rtol=1e-12)
    np.testing.assert_allclose(found[2], 0, atol=1e-15)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_mass_as_trimesh_has_it_wherever_the_body_lies(seed):
    draw = np.random.default_rng(seed)
    body = trimesh.creation.icosphere(2)
    body.vertices *= draw.uniform(0.5, 3, 3)
    body.vertices += draw.normal(size=body.vertices.shape) * 0.02
    moments = Inertia()(body)
    np.testing.assert_allclose(Centroid()(body), body.center_mass, atol=1e-12)
    np.testing.assert_allclose(moments, np.sort(body.principal_inertia_components), rtol=1e-9)
    body.apply_transform(trimesh.transformations.random_rotation_matrix(draw.random(3)))
    body.apply_translation(draw.normal(size=3) * 100)
    np.testing.assert_allclose(Inertia()(body), moments, rtol=1e-8)


# Wall thickness


@pytest.mark.parametrize(
    ("solid", "least", "median"),
    [
        (trimesh.creation.box((1, 2, 3)), 1, 1),
        (plate_mesh(PLATE), 0.25, 0.25),
        (trimesh.creation.annulus(0.9, 1.0, 5.0, sections=256), 0.1, 0.1),
        (trimesh.creation.cylinder(1.0, 5.0, sections=256), 2, 2),
    ],
    ids=["box", "plate", "tube", "cylinder"],
)
def test_wall_of_plain_shapes(solid, least, median):
    np.testing.assert_allclose(Wall()(solid), (least, median), rtol=1e-3)


def test_wall_of_a_shell():
    outer, inner = trimesh.creation.icosphere(4), trimesh.creation.icosphere(4, radius=0.8)
    inner.invert()
    np.testing.assert_allclose(Wall()(trimesh.util.concatenate([outer, inner])), 0.2, rtol=5e-3)


def test_wall_of_a_box_that_is_thinner_on_one_side():
    # walls of 0.3, but for one of 0.1: this one is found, the median is what most of the area has
    hollow = Manifold.cube((4, 4, 4), True) - Manifold.cube((3.4, 3.4, 3.6), True).translate((0, 0, 0.1))
    np.testing.assert_allclose(Wall()(mesh(hollow)), (0.1, 0.3), rtol=1e-4)


def test_a_wedge_has_no_wall():
    with pytest.raises(MeasureError, match="two sides that face apart"):
        Wall()(tetrahedron())


def tetrahedron() -> trimesh.Trimesh:
    corners = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], process=False)


# Holes


@pytest.mark.parametrize(("axis", "turn"), [("z", None), ("x", (0, 1, 0)), ("y", (1, 0, 0))])
def test_the_hole_of_a_plate_along_every_axis(axis, turn):
    plate = plate_mesh(PLATE)
    place = np.array([PLATE[4], PLATE[5], 0])
    if turn is not None:
        matrix = trimesh.transformations.rotation_matrix(np.pi / 2, turn)
        plate.apply_transform(matrix)
        place = matrix[:3, :3] @ place
    plate.apply_translation((3, -4, 5))
    np.testing.assert_allclose(Hole()(plate), (seen_radius(0.2, 128), *place), atol=1e-12)
    np.testing.assert_array_equal(Hole(along=axis)(plate), Hole()(plate))
    with pytest.raises(MeasureError, match=f"along {'y' if axis == 'x' else 'x'}, got 0"):
        Hole(along="y" if axis == "x" else "x")(plate)


def test_holes_are_told_by_size():
    block = mesh(drilled(("z", 0.3, -2, -1), ("x", 0.5, 1.6, -1.2), ("y", 0.4, 1.3, 2.2)))
    wanted = {1: (0.5, 0, 1.6, -1.2), 2: (0.4, 2.2, 0, 1.3), 3: (0.3, -2, -1, 0)}
    for which, (radius, *place) in wanted.items():
        np.testing.assert_allclose(Hole(which)(block), (seen_radius(radius), *place), atol=1e-5)
    np.testing.assert_array_equal(Hole(-1)(block), Hole(3)(block))
    radii = [seen_radius(r) for r in (0.5, 0.4, 0.3)]
    np.testing.assert_allclose(Holes()(block), (3, radii[0], radii[2], sum(radii)), rtol=1e-5)
    np.testing.assert_allclose(Holes(along="y")(block), (1, radii[1], radii[1], radii[1]), rtol=1e-5)
    with pytest.raises(MeasureError, match=r"at least 4 round through-holes, got 3 of radius 0\.49"):
        Hole(4)(block)


def test_a_stepped_bore_is_one_hole():
    bore = drilled(("z", 0.3, 1, 0)) - Manifold.cylinder(1, 0.7, 0.7, 64, True).translate((1, 0, 2))
    assert Holes()(mesh(bore))[0] == 1
    # most of its depth is narrow; that part reaches from the bottom, -2, to the step at 1.5
    np.testing.assert_allclose(Hole()(mesh(bore)), (seen_radius(0.3), 1, 0, -0.25), atol=1e-5)


def test_a_bore_that_another_one_crosses_counts_on_both_sides():
    assert Holes(along="z")(mesh(drilled(("z", 0.3, 0, 0), ("x", 0.6, 0, 0))))[0] == 2


@pytest.mark.parametrize("place", [(0.5, 1.0), (0.0, 0.25)])  # the second meets an edge of the other wall's faces
def test_a_hole_in_one_wall_of_a_bracket(place):
    bracket = Manifold.cube((4, 4, 4), True) - Manifold.cube((3, 5, 4), True).translate((0, 0, 0.5))
    bracket -= Manifold.cylinder(2, 0.4, 0.4, 64, True).rotate((0, 90, 0)).translate((2, *place))
    np.testing.assert_allclose(Hole()(mesh(bracket)), (seen_radius(0.4), 1.75, *place), atol=1e-5)


def rod(length: float, radius: float) -> Manifold:
    return Manifold.cylinder(length, radius, radius, 64, True)


NO_HOLES = {  # what is taken out of a cube of 4
    "blind": lambda: rod(2, 0.5).translate((0, 0, 2)),
    "square": lambda: Manifold.cube((1, 1, 9), True),
    "slot": lambda: rod(9, 0.5).scale((2, 1, 1)),
    "cavity": lambda: Manifold.sphere(1, 64),
    "slanting": lambda: rod(9, 0.5).rotate((0, 15, 0)),
    "filled": lambda: rod(9, 0.5) - rod(9, 0.3),
    "nothing": lambda: Manifold(),
}


@pytest.mark.parametrize("name", NO_HOLES)
def test_what_is_no_round_through_hole(name):
    for measure in (Hole(), Holes()):
        with pytest.raises(MeasureError, match=r"round through-hole.*, got (none|0)"):
            measure(mesh(Manifold.cube((4, 4, 4), True) - NO_HOLES[name]()))


@pytest.mark.parametrize("factor", [1, 2])
def test_the_family_of_plates(factor):
    draw, rows, found = np.random.default_rng(factor), [], []
    while len(rows) < 12:
        parameters = MIDDLE + factor * HALF * draw.uniform(-1, 1, 6)
        try:
            plate = plate_mesh(parameters, segments=96)
        except InputError:  # the hole reaches the edge
            continue
        rows.append([parameters[3], parameters[4], parameters[5], parameters[2]])
        least, median = Wall()(plate)
        found.append([*Hole()(plate)[:3], median])
        # beside a hole near the edge the plate can be narrower than it is thick
        beside = np.min(parameters[:2] / 2 - np.abs(parameters[4:]) - parameters[3])
        assert least == pytest.approx(parameters[2]) or beside - 1e-3 <= least < parameters[2]
    for wanted, seen in zip(np.transpose(rows), np.transpose(found), strict=True):
        assert r_squared(wanted, seen) > 0.999


def test_a_plate_by_marching_cubes():
    plate = sampled(PLATE, 48)
    np.testing.assert_allclose(Hole()(plate), (0.2, 0.05, -0.03, 0), atol=0.003)
    np.testing.assert_allclose(Wall()(plate), 0.25, rtol=1e-3)
    assert Holes()(plate)[0] == 1


@pytest.mark.parametrize("which", [0, True, 1.5])
def test_which_hole_is_no_number(which):
    with pytest.raises(InputError, match="which: expected 1, 2"):
        Hole(which)(plate_mesh(PLATE))


def test_the_section_that_counts_is_not_chosen_by_rounding():
    """A drilled hole that widens by a tenth over the depth, cut into more slabs than sections."""
    part = shapes.plate_with_hole()
    for _ in range(3):
        part = part.subdivide()
    vertices = np.array(part.vertices)
    drilled = np.hypot(*vertices[:, :2].T) <= 0.15 + 1e-9
    vertices[drilled, :2] *= 1 + (vertices[drilled, 2:] + 0.05)
    between = np.abs(np.abs(vertices[:, 2]) - 0.05) > 1e-9
    vertices[between, 2] += 1e-4 * np.random.default_rng(0).normal(size=between.sum())
    radii = [Hole()(trimesh.Trimesh(vertices * s, part.faces, process=False))[0] / s for s in np.linspace(1, 2, 12)]
    np.testing.assert_allclose(radii, radii[0], rtol=1e-6)


def two(first, second):
    return trimesh.util.concatenate([first, second])


def test_a_flap_without_volume_has_no_side():
    """Two sheets on top of each other, closed: whether they face inward is rounding."""
    body = trimesh.creation.box((1, 1, 1))
    for seed in range(20):
        draw = np.random.default_rng(seed)
        corners = draw.normal(size=(4, 2)) @ draw.normal(size=(2, 3)) + [3, 0, 0]
        flap = trimesh.Trimesh(corners, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]], process=False)
        assert Volume()(two(body, flap))[0] == pytest.approx(1)


SOLID = [Wall(), Centroid(), Inertia(), Volume(), WettedArea()]


@pytest.mark.parametrize("measure", SOLID, ids=lambda m: type(m).__name__)
def test_a_part_inside_out_is_told_and_a_cavity_is_none(measure):
    """What is inside out beside a body would be taken from it; within it, it is a cavity."""
    body, small = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((0.5, 0.5, 0.5))
    small.invert()
    assert np.isfinite(measure(two(body, small))).all()
    for place in ((2, 0, 0), (0.6, 0, 0), (0.3, 0, 0)):  # the last one is sunk but for a tenth
        beside = small.copy().apply_translation(place)
        with pytest.raises(MeasureError, match="faces that point outward, got 1 of its parts inside out"):
            measure(two(body, beside))


def test_an_axis_that_is_none():
    with pytest.raises(InputError, match="along: expected x, y, z"):
        Holes(along="up")(plate_mesh(PLATE))


# What cannot be measured


@pytest.mark.parametrize("measure", [Hole(), Holes(), Wall(), Centroid(), Inertia()], ids=lambda m: type(m).__name__)
def test_open_inside_out_and_empty(measure):
    plate = plate_mesh(PLATE)
    with pytest.raises(MeasureError, match="faces that point outward"):
        measure(trimesh.Trimesh(plate.vertices, plate.faces[:, ::-1], process=False))
    with pytest.raises(MeasureError, match="closed mesh"):
        measure(trimesh.Trimesh(plate.vertices, plate.faces[1:], process=False))
    with pytest.raises(EmptyMesh):
        measure(trimesh.Trimesh())


@pytest.mark.parametrize("measure", [Hole(), Holes(), Wall(), Centroid(), Inertia()], ids=lambda m: type(m).__name__)
def test_loose_triangles_are_joined(measure):
    plate = plate_mesh(PLATE)
    corners = plate.vertices[plate.faces].reshape(-1, 3)
    loose = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    np.testing.assert_allclose(measure(loose), measure(plate), atol=1e-12)
    if isinstance(measure, Hole | Holes):
        with pytest.raises(MeasureError, match="loose triangles"):
            measure.gradient(loose)


# Derivatives


@pytest.mark.parametrize(
    "measure",
    [Extents(), Volume(), Area(), Plate(), Centroid(), Inertia(), Hole(), Holes()],
    ids=lambda m: type(m).__name__,
)
def test_gradients_against_central_differences(measure):
    body = rough()
    vertices, gradient, draw, step = np.array(body.vertices), measure.gradient(body), np.random.default_rng(1), 1e-6
    assert gradient.shape == (len(measure.names), len(vertices), 3)
    for _ in range(4):
        move = draw.normal(size=vertices.shape)
        ahead, behind = (
            measure(trimesh.Trimesh(vertices + sign * step * move, body.faces, process=False)) for sign in (1, -1)
        )
        slope, wanted = (gradient * move).sum((1, 2)), (ahead - behind) / (2 * step)
        np.testing.assert_allclose(slope, wanted, rtol=1e-4, atol=1e-6 * np.abs(wanted).max())


def test_moments_that_are_one_share_their_derivative():
    # Of a cube under a stretch along z: two moments grow alike and the third is left, so that any share is the mean.
    cube = trimesh.creation.box((1, 1, 1))
    stretch = cube.vertices * (0, 0, 1)
    slopes = (Inertia().gradient(cube) * stretch).sum((1, 2))
    # V/12 (a² + b²) with c the height: d/dc of c (1 + c²) / 12 and of c / 6 at 1
    np.testing.assert_allclose(slopes, np.mean([4 / 12, 4 / 12, 1 / 6]))


# The kit: a value that is a place


class Corner:
    """The low corner's x and the length: the first moves with the mesh."""

    names = ("x", "length")
    units: tuple[str, ...] = ("L", "L")
    positions: tuple[str, ...] = ("x", "")

    def __call__(self, body):
        return np.array([body.bounds[0, 0], body.extents[0]])


def test_a_place_may_move_with_the_mesh():
    check_place_does_not_matter(Corner())


@pytest.mark.parametrize("said", [("", ""), ("y", ""), ("x", "x")])
def test_a_place_has_to_move_as_declared(said):
    lying = Corner()
    lying.positions = said
    with pytest.raises(ConformanceError, match="on a moved mesh"):
        check_place_does_not_matter(lying)


@pytest.mark.parametrize("said", [("x",), ("up", ""), ["x", ""]])
def test_a_place_has_to_be_declared_in_axes(said):
    lying = Corner()
    lying.positions = said
    with pytest.raises(ConformanceError, match="positions: expected 2 of 'x', 'y', 'z' and ''"):
        check_place_does_not_matter(lying)


def test_a_place_is_a_length():
    lying = Corner()
    lying.units = ("", "L")
    with pytest.raises(ConformanceError, match="positions: expected unit L"):
        check_place_does_not_matter(lying)


# Real parts


@pytest.mark.parametrize(("name", "holes"), [("featuretype.STL", 9), ("plate_holes.STL", 5), ("round.stl", 1)])
def test_real_parts_have_as_many_round_holes_as_handles(name, holes):
    path = PARTS / f"trimesh_{name}"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    part = trimesh.load(path, force="mesh")
    assert 1 - part.euler_number / 2 == holes
    assert Holes()(part)[0] == holes
    least, median = Wall()(part)
    assert 0 < least <= median <= part.extents.max()
    np.testing.assert_allclose(Centroid()(part), part.center_mass, atol=1e-6 * part.scale)


def test_the_four_screw_holes_of_a_real_plate_lie_in_a_rectangle():
    path = PARTS / "trimesh_plate_holes.STL"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    plate = trimesh.load(path, force="mesh")
    places = np.array([Hole(which)(plate) for which in range(1, 6)])
    screws = places[np.abs(places[:, 1]) > 1]
    np.testing.assert_allclose(screws[:, 0], screws[0, 0], rtol=1e-4)
    np.testing.assert_allclose(np.abs(screws[:, 1]), np.abs(screws[0, 1]), rtol=1e-4)
    np.testing.assert_allclose(np.abs(screws[:, 2]), np.abs(screws[0, 2]), rtol=1e-4)


def test_a_real_part_without_a_hole():
    path = PARTS / "trimesh_fandisk.obj"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    with pytest.raises(MeasureError, match="got none"):
        Holes()(trimesh.load(path, force="mesh"))


def test_a_loop_around_material_is_no_hole():
    """Where a surface crosses itself, a hole's loop may run the other way round."""
    cut = section(trimesh.creation.cylinder(1.0, 2.0), "z", 0.1)
    with pytest.raises(MeasureError, match="a loop around the opening of a hole, got one around material"):
        area_and_centre(cut, 2)


def test_flat_and_tiny_parts():
    flat = trimesh.creation.box((1, 2, 3))
    flat.vertices = flat.vertices * [1, 1, 1e-150]
    np.testing.assert_allclose(Centroid()(flat), 0, atol=1e-12)
    tiny = trimesh.Trimesh(trimesh.creation.box((1, 2, 3)).vertices * 1e-49, flat.faces, process=False)
    np.testing.assert_allclose(Inertia()(tiny), np.array([2.5, 5, 6.5]) * 1e-245)


@pytest.mark.parametrize("measure", [Hole(), Holes(), Wall(), Centroid(), Inertia()], ids=lambda m: type(m).__name__)
def test_vertices_of_no_face_change_nothing(measure):
    plate = plate_mesh(PLATE)
    stray = trimesh.Trimesh(np.vstack([plate.vertices, [[1e12] * 3]]), plate.faces, process=False)
    np.testing.assert_allclose(measure(stray), measure(plate), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("shift", [(0, 0, 0), (0.1, 0.2, 0.3), (7.3, 1, 2), (3.3, -2.2, 9), (-5.1, 2, 3)])
def test_which_of_equal_holes_comes_first_does_not_depend_on_where_the_part_lies(shift):
    part = mesh(drilled(("z", 0.5, -1.5, 0.4), ("z", 0.5, 1.5, 0.4), ("x", 0.5, 0.1, 0.2)))
    moved = part.copy().apply_translation(shift)
    for which in (1, 2, 3):
        hole, there = Hole(which), Hole(which)(moved)
        np.testing.assert_allclose(there, hole(part), atol=1e-9)
