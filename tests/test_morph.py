"""Morphs of a body whose planes are known: what each deformation does, where, and what it must leave alone."""

import contextlib
import logging
import pickle
import re
import tomllib
from dataclasses import fields
from importlib.metadata import entry_points
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt.errors import InputError, LampoptError
from lampopt.plugins import Plugins
from lampopt.protocols import Source
from lampopt.testing import check_plugin, shapes
from lampopt.topology import topology
from lampopt_families.body import Body
from lampopt_families.deformation import Deformation
from lampopt_families.deformation_file import read_deformations
from lampopt_families.field import Field, Places, ramp, step
from lampopt_families.morph import MorphSource, family
from lampopt_families.morphing import Morph
from lampopt_families.refine import refined
from lampopt_families.vehicle import NAMES, vehicle

LENGTH, WIDTH, HEIGHT = 4.0, 1.8, 1.4
TOP = ((0, 0.25, 0.45, 0.72, 0.78, 1), (0.62, 0.72, 1, 1, 0.76, 0.68))  # along; of the height
BOTTOM = ((0, 0.16, 0.80, 1), (0.12, 0.08, 0.08, 0.14))
HALF_WIDTH = ((0, 0.48, 1), (0.9, 0.9, 0.58))  # of the height; [m]


def unit_box(counts):
    """Surface of the unit cube as a grid: lattice places (V, 3) and faces (F, 3), outward."""
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for end in (0, counts[axis]):
            for i, j in product(range(counts[u]), range(counts[v])):
                corners = np.zeros((4, 3), int)
                corners[:, axis] = end
                corners[:, u] = (i, i + 1, i + 1, i)
                corners[:, v] = (j, j, j + 1, j + 1)
                faces += [corners[[0, 1, 2]], corners[[0, 2, 3]]] if end else [corners[[0, 2, 1]], corners[[0, 3, 2]]]
    corners = np.concatenate(faces)
    lattice, where = np.unique(corners, axis=0, return_inverse=True)
    return lattice, where.reshape(-1, 3)


LATTICE, FACES = unit_box((100, 8, 12))


def car():
    """A car of planes, nose at -x, 4 m long, 1.8 m wide, 1.4 m high; its left half is the right one's mirror image."""
    s, t, h = (LATTICE / (100, 4, 12) - (0, 1, 0)).T
    bottom, top = np.interp(s, *BOTTOM), np.interp(s, *TOP)
    z = bottom + h * (top - bottom)
    y = t * np.interp(z, *HALF_WIDTH)
    return trimesh.Trimesh(np.column_stack([LENGTH * (s - 0.5), y, HEIGHT * z]), FACES, process=False)


CAR = car()
BODY = Body.of(CAR)
MORPH = Morph.of(BODY, vehicle(BODY))
LOW, HIGH = (np.array([getattr(f.deformation, end) for f in MORPH.fields]) for end in ("low", "high"))
S, T, H = BODY.fractions(np.asarray(CAR.vertices)).T
ON_TOP, ON_BOTTOM = LATTICE[:, 2] == 12, LATTICE[:, 2] == 0
SIDE = LATTICE[:, 1] == 8
PLANES = {  # the vertices of each tilt's core, the axes of its slope: across the ground or up, and the sense
    "hood": (ON_TOP & (S < 0.17), 0, 2, 1),
    "trunk": (ON_TOP & (S > 0.86), 0, 2, -1),
    "ramp": (ON_BOTTOM & (S < 0.10), 0, 2, -1),
    "diffuser": (ON_BOTTOM & (S > 0.87), 0, 2, 1),
    "greenhouse": (SIDE & (H > 0.62) & (S > 0.28) & (S < 0.78), 2, 1, -1),
}


def only(**values):
    return np.array([values.get(name, 0.0) for name in NAMES])


def lean(mesh, name):
    """The angle [deg] of the plane through a tilt's core, and how far the vertices are off that plane."""
    chosen, over, axis, sense = PLANES[name]
    points = np.asarray(mesh.vertices)[chosen]
    system = np.column_stack([points[:, over], np.ones(len(points))])
    slope, start = np.linalg.lstsq(system, points[:, axis], rcond=None)[0]
    return sense * np.degrees(np.arctan(slope)), np.abs(system @ [slope, start] - points[:, axis]).max()


def anywhere(factor=1.0, least=-1.0):
    """Parameters from the ranges widened by `factor`."""
    unit = st.tuples(*[st.floats(least, 1)] * len(NAMES))
    return unit.map(lambda u: (LOW + HIGH) / 2 + factor * (HIGH - LOW) / 2 * np.array(u))


# the eight


def test_the_test_body_is_what_it_is_meant_to_be():
    assert CAR.is_watertight and CAR.volume > 0
    np.testing.assert_allclose(CAR.extents, (LENGTH, WIDTH, HEIGHT * 0.92))
    assert [f.deformation.name for f in MORPH.fields] == list(NAMES)
    for name, angle in {"hood": 7.970, "trunk": 7.253, "ramp": 5.000, "diffuser": 5.994, "greenhouse": 23.729}.items():
        found, off = lean(CAR, name)
        assert off < 1e-12
        assert found == pytest.approx(angle, abs=1e-3)
        field = MORPH.fields[NAMES.index(name)]
        assert np.degrees(np.arctan(field.slope)) == pytest.approx(found, abs=1e-9)


def test_no_deformation_is_the_mesh_bit_for_bit():
    made = MORPH(np.zeros(8))
    assert made.vertices.tobytes() == CAR.vertices.tobytes()
    assert np.array_equal(made.faces, CAR.faces)


@pytest.mark.parametrize("value", [-0.5, -0.28, 0.1, 0.28, 1.3])
@pytest.mark.parametrize("name", ["length", "width"])
def test_length_and_width_are_exact(name, value):
    change = lampopt.measure("extents", MORPH(only(**{name: value})))
    for side, base in zip(("length", "width", "height"), CAR.extents, strict=True):
        assert change[side] - base == pytest.approx(value if side == name else 0, abs=1e-14)


@pytest.mark.parametrize("value", [-0.09, 0.05, 0.13])
def test_roof_raises_the_top(value):
    made = MORPH(only(roof=value))
    assert made.extents[2] - CAR.extents[2] == pytest.approx(value, abs=1e-14)
    low = H < 0.45
    assert np.array_equal(made.vertices[low], CAR.vertices[low])


@pytest.mark.parametrize("factor", [-1.0, 0.3, 1.0, 2.0])
@pytest.mark.parametrize("name", PLANES)
def test_tilts_turn_their_plane_by_the_angle(name, factor):
    value = factor * HIGH[NAMES.index(name)]
    made = MORPH(only(**{name: value}))
    angle, off = lean(made, name)
    assert off < 1e-12  # still a plane
    assert angle - lean(CAR, name)[0] == pytest.approx(value, abs=1e-9)
    np.testing.assert_allclose(made.extents[0], CAR.extents[0], rtol=1e-15)
    for other in set(PLANES) - {name}:
        assert lean(made, other)[0] == pytest.approx(lean(CAR, other)[0], abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_moves_outside_region_and_falloff(name):
    field = MORPH.fields[NAMES.index(name)]
    d = field.deformation
    made = MORPH(only(**{name: d.high}))
    moved = (made.vertices != CAR.vertices).any(axis=1)
    assert moved.any()
    if d.kind == "stretch":
        return
    for fraction, (low, high), width, axis in zip((S, np.abs(T), H), d.region, d.falloff, range(3), strict=True):
        ends_low, ends_high = d.ends(axis)
        assert not ends_low or fraction[moved].min() >= low - width - 1e-12
        assert not ends_high or fraction[moved].max() <= high + width + 1e-12


@settings(max_examples=40, deadline=None)
@given(anywhere(1.5))
def test_left_is_the_mirror_image_of_right(parameters):
    vertices = MORPH(parameters).vertices
    place = {tuple(row): i for i, row in enumerate(LATTICE)}
    mirrored = [place[(i, 8 - j, k)] for i, j, k in LATTICE]
    assert np.array_equal(CAR.vertices[mirrored], CAR.vertices * (1, -1, 1))
    assert np.array_equal(vertices[mirrored], vertices * (1, -1, 1))


@settings(max_examples=40, deadline=None)
@given(anywhere(1.5))
def test_topology_stays(parameters):
    made = MORPH(parameters)
    assert np.array_equal(made.faces, CAR.faces)
    shape = topology(made)
    assert shape.closed and (shape.bodies, shape.genus) == (1, 0)
    assert made.volume > 0


@settings(max_examples=60, deadline=None)
@given(anywhere(3.0))
def test_far_out_it_is_valid_or_refused_with_names(parameters):
    try:
        made = MORPH(parameters)
    except InputError as error:
        blamed = str(error).split(": too much")[0].removeprefix("morph: ").split(", ")
        assert {part.partition(" = ")[0] for part in blamed} <= set(NAMES)
        assert "expected values nearer to 0" in str(error)
    else:
        assert made.is_watertight and made.volume > 0 and (made.area_faces > 0).all()


@pytest.mark.parametrize(
    ("values", "blamed"),
    [
        ({"roof": -2.0}, ["roof"]),
        ({"length": -4.0}, ["length"]),
        ({"length": -4.5, "hood": 1.0}, ["length"]),
        ({"width": -1.8, "length": 0.2}, ["width"]),
        ({"diffuser": 35.0, "roof": 0.1}, ["diffuser"]),
        ({"length": -1e308}, ["length"]),
    ],
)
def test_folding_over_is_refused(values, blamed):
    with pytest.raises(InputError, match="folds over") as error:
        MORPH(only(**values))
    names = str(error.value).split(": too much")[0].removeprefix("morph: ").split(", ")
    assert [name.partition(" = ")[0] for name in names] == blamed


def test_where_none_presses_alone_all_are_named():
    """Two shears across each other: either alone keeps every volume, both together turn the body inside out."""
    shear = [
        Deformation("a", "move", "rear", -9, 9, up=(0.6, 1), falloff=(0.1, 0.1, 0.5)),
        Deformation("b", "move", "up", -9, 9, along=(0.5, 1), falloff=(0.4, 0.1, 0.1)),
    ]
    with pytest.raises(InputError, match="morph: a = 2, b = 2: too much at once"):
        Morph.of(BODY, shear)([2.0, 2.0])


@pytest.mark.parametrize("value", [75.0, -90.0, 180.0, 1e300])
def test_no_slope_beyond_eighty_degrees(value):
    with pytest.raises(InputError, match=r"hood = .* beyond 80 deg"):
        MORPH(only(hood=value))


@pytest.mark.parametrize("parameters", [np.zeros(7), np.zeros((8, 1)), np.full(8, np.nan), [np.inf, *[0] * 7]])
def test_parameters_are_checked(parameters):
    with pytest.raises(InputError, match="expected 8 finite parameters, length"):
        MORPH(parameters)


# fields


def test_step_is_the_derivative_of_ramp_and_smooth_at_its_ends():
    x = np.linspace(-0.5, 2.5, 3001)
    value, slope = step(x, 2.0)
    np.testing.assert_allclose(np.gradient(ramp(x, 2.0), x)[1:-1], value[1:-1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(value, x)[1:-1], slope[1:-1], atol=1e-5)
    np.testing.assert_allclose(ramp(np.array([-1.0, 0.0, 2.0, 5.0]), 2.0), [0, 0, 1, 4])
    assert (value[x <= 0] == 0).all() and (value[x >= 2] == 1).all() and (np.diff(value) >= 0).all()
    assert np.abs(np.diff(slope, 2)).max() < 1e-4  # no kink: the curvature is continuous


FREE = (
    Deformation("a", "move", (1.0, 0.0, 2.0), -1, 1, along=(0.2, 0.5), up=(0.3, 0.6)),
    Deformation("b", "move", "out", -1, 1, across=(0.6, 0.9), along=(0.4, 0.8), falloff=(0.2, 0.3, 0.1)),
    Deformation("c", "move", "left", -1, 1, symmetric=False, across=(-0.7, 0.2), falloff=(0.1, 0.4, 0.2)),
    Deformation("d", "stretch", "rear", -1, 1, along=(0.3, 0.6), falloff=(0.1, 0.1, 0.1), fixed=0.25),
    Deformation("e", "stretch", "out", -1, 1, along=(0.3, 0.6), across=(0.3, 0.8), falloff=(0.2, 0.2, 0.2)),
    Deformation("f", "tilt", "down", -9, 9, over="front", along=(0.2, 0.6), up=(0.5, 1)),
    Deformation("g", "tilt", "right", -9, 9, over="up", symmetric=False, up=(0.4, 1), across=(0.3, 1)),
    Deformation("h", "turn", "right", -20, 20, about=(0.9, 0.0, 0.8), along=(0.8, 1.0), up=(0.6, 1.0)),
    Deformation("i", "turn", (1.0, 0.4, 2.0), -20, 20, about=(0.4, 0.7, 0.5), across=(0.5, 1), falloff=(0.2, 0.4, 0.2)),
)  # fmt: skip


@pytest.mark.parametrize("deformation", [*FREE, *vehicle(BODY)], ids=lambda d: d.name)
def test_jacobian_agrees_with_differences(deformation):
    field, value, h = Field.of(deformation, BODY), 0.7 * deformation.high, 1e-6
    points = np.random.default_rng(0).uniform(*CAR.bounds, (500, 3))

    def moved(at):
        found, jacobian = np.zeros((3, len(at))), np.zeros((3, 3, len(at)))
        field.add(value, Places.of(BODY, at), found, jacobian)
        return found, jacobian

    jacobian = moved(points)[1]
    assert np.abs(jacobian).max() > 1e-3
    for k in range(3):  # the body's axes are the mesh's here: to the rear, to the right, up
        apart = np.eye(3)[k] * h
        differences = (moved(points + apart)[0] - moved(points - apart)[0]) / (2 * h)
        np.testing.assert_allclose(jacobian[:, k], differences, atol=1e-7 * max(1, np.abs(jacobian).max()))


def test_a_turn_is_rigid_in_its_core():
    d = FREE[7]
    made = Morph.of(BODY, [d])([8.0])
    core = (S >= 0.8) & (H >= 0.6)
    before, after = CAR.vertices[core], made.vertices[core]
    apart = [np.linalg.norm(v[:, None] - v[None], axis=-1) for v in (before, after)]
    np.testing.assert_allclose(*apart, atol=1e-12)
    centre = np.array([LENGTH * 0.4, 0.0, 0.112 + 0.8 * 1.288])
    a, b = (v - centre for v in (before, after))
    # right-handed about y: from z towards x
    angle = np.degrees(np.arctan2(a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2], a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]))
    np.testing.assert_allclose(angle, 8, atol=1e-9)


def test_a_stretch_moves_what_lies_beyond_it_in_one_piece():
    made = Morph.of(BODY, [FREE[3]])([0.4])
    shift = made.vertices - CAR.vertices
    assert not shift[:, 1:].any()
    np.testing.assert_allclose(shift[S <= 0.2, 0], -0.1, atol=1e-15)
    np.testing.assert_allclose(shift[S >= 0.7, 0], 0.3, atol=1e-15)


def test_a_move_in_its_core_is_the_value():
    made = Morph.of(BODY, [FREE[0]])([0.05])
    core = (S >= 0.2) & (S <= 0.5) & (H >= 0.3) & (H <= 0.6)
    want = np.array([1, 0, 2]) / np.sqrt(5) * 0.05
    np.testing.assert_allclose(made.vertices[core] - CAR.vertices[core], np.tile(want, (core.sum(), 1)), atol=1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "bend"}, "kind: expected one of move, stretch"),
        ({"name": "a.b"}, "without '.'"),
        ({"name": "a:b"}, "without ','"),
        ({"direction": "sideways"}, "direction: expected one of"),
        ({"direction": (0.0, 0.0, 0.0)}, "not all 0"),
        ({"direction": (0.0, 1.0)}, "three numbers"),
        ({"direction": (1.0, 1.0, 0.0), "kind": "stretch"}, "no vector"),
        ({"direction": "left"}, "the sides with symmetric = true are called in and out"),
        ({"direction": "in", "symmetric": False}, "the sides without symmetric are called left and right"),
        ({"low": 0.1}, "a range that holds 0"),
        ({"low": 0.0, "high": 0.0}, "a range that holds 0"),
        ({"high": float("nan")}, "high: expected 1 finite"),
        ({"along": (0.5, 0.5)}, "along: expected low < high"),
        ({"along": (1.1, 1.3)}, "partly within 0 to 1"),
        ({"along": (0.1, 0.2, 0.3)}, "along: expected 2 finite numbers"),
        ({"falloff": (0.0, 0.1, 0.1), "along": (0.2, 0.4)}, "falloff along: expected more than 0"),
        ({"falloff": (-1.0, 0.1, 0.1)}, "at least 0"),
        ({"kind": "tilt"}, "over: expected a direction across"),
        ({"kind": "tilt", "over": "down"}, "over: expected a direction across"),
        ({"kind": "tilt", "over": "rear", "falloff": (0.0, 0.1, 0.1)}, "falloff along: expected more than 0"),
        ({"over": "rear"}, "belongs to a tilt"),
        ({"direction": "out"}, "tear the halves apart"),
        ({"direction": "out", "across": (0.2, 0.8), "falloff": (0.1, 0.4, 0.1)}, "reaches past the middle"),
        ({"kind": "turn"}, "tear the halves apart"),
        ({"kind": "turn", "direction": "out"}, "the sides of a turn are called left and right"),
        ({"fixed": 2.0}, "fixed: expected 0 to 1"),
    ],
)
def test_a_deformation_that_is_none(change, message):
    good = {"name": "a", "kind": "move", "direction": "up", "low": -1.0, "high": 1.0}
    Deformation(**good)
    with pytest.raises(InputError, match=message):
        Deformation(**{**good, **change})


def test_a_tilt_needs_a_surface():
    hole = Deformation("a", "tilt", "up", -1, 1, over="rear", along=(0.4, 0.6), up=(0.45, 0.6), falloff=(0.05,) * 3)
    with pytest.raises(InputError, match="'a': no surface in its region faces 'up'"):
        Morph.of(BODY, [hole])


# bodies in other axes and places


@pytest.mark.parametrize("shift", [(0, 0, 0), (3.0, -2.0, 5.0)])
@pytest.mark.parametrize(
    ("forward", "up"), [("x", "z"), ("y", "z"), ("-y", "z"), ("-z", "y"), ("z", "x"), ("-x", "-z"), ("y", "-x")]
)
def test_axes_are_only_names(forward, up, shift):
    axes = {sign + name: (-1 if sign else 1) * np.eye(3)[k] for k, name in enumerate("xyz") for sign in ("", "-")}
    rear = -axes[forward]
    turned = np.stack([rear, np.cross(axes[up], rear), axes[up]], axis=1)  # from the body's axes to the mesh's
    assert np.linalg.det(turned) == pytest.approx(1)
    other = trimesh.Trimesh(CAR.vertices @ turned.T + shift, CAR.faces, process=False)
    body = Body.of(other, forward=forward, up=up)
    values = 0.8 * HIGH
    made = Morph.of(body, vehicle(body))(values)
    np.testing.assert_allclose(made.vertices, MORPH(values).vertices @ turned.T + shift, atol=1e-12)
    found = family(body, count=12)
    lengths = np.ptp(other.vertices, axis=0)
    for name, address in found.measured.items():
        size = {"length": LENGTH, "width": WIDTH}[name]
        assert lampopt.measure("extents", other)[address.removeprefix("extents.")] == pytest.approx(size)
    assert len(lengths) == 3 and set(found.measured) == {"length", "width"}


@pytest.mark.parametrize("scale", [1e-90, 1e-3, 1e3, 1e90])
def test_any_unit_is_as_good(scale):
    body = Body.of(trimesh.Trimesh(CAR.vertices * scale, CAR.faces, process=False))
    values = 0.9 * HIGH * np.array([1.0 if f.deformation.angle else scale for f in MORPH.fields])
    made = Morph.of(body, vehicle(body))(values)
    np.testing.assert_allclose(made.vertices / scale, MORPH(0.9 * HIGH).vertices, atol=1e-12)


def test_the_nose_is_at_the_low_end_of_the_longer_side():
    assert (BODY.index, BODY.sign) == ((0, 1, 2), (1, 1, 1))
    with pytest.raises(InputError, match=r"cannot tell which way.*forward='-"):
        Body.of(shapes.box((2.0, 1.9, 1.0)))
    assert Body.of(shapes.box((2.0, 1.9, 1.0)), forward="y").sign == (-1, 1, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"forward": "w"}, "forward: expected one of x, -x"),
        ({"up": ""}, "up: expected one of"),
        ({"forward": "-z"}, "expected an axis across up"),
    ],
)
def test_axes_are_checked(options, message):
    with pytest.raises(InputError, match=message):
        Body.of(CAR, **options)


def test_vertices_without_a_face_are_no_part_of_a_body():
    mesh = car()
    stray = trimesh.Trimesh(np.concatenate([mesh.vertices, [[99.0, 99, 99]]]), mesh.faces, process=False)
    one, other = Body.of(mesh), Body.of(stray)
    assert (one.size == other.size).all() and (one.start == other.start).all()


def test_a_sheet_is_no_body():
    flat = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(InputError, match="a length, a width and a height"):
        Body.of(flat)
    with pytest.raises(InputError, match="a body with faces"):
        Body.of(trimesh.Trimesh())


# the source


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("morph") / "car.ply"
    CAR.export(path, encoding="binary")
    return str(path)


def test_three_exemplars_for_each_deformation(file):
    source = MorphSource(file)
    assert isinstance(source, Source)
    found = source()
    assert len(found) == 24
    assert found.names[:2] == ("base", "morph_01")
    assert not found.parameters[0].any()
    assert [str(q) for q in found.space] == [
        "length [m]", "width [m]", "roof [m]", "greenhouse [deg]", "ramp [deg]", "diffuser [deg]", "trunk [deg]",
        "hood [deg]",
    ]  # fmt: skip
    drawn = found.parameters[1:]
    assert (drawn >= LOW).all() and (drawn <= HIGH).all()
    cells = np.floor((drawn - LOW) / (HIGH - LOW) * 23).astype(int)
    assert all(sorted(column) == list(range(23)) for column in cells.T)  # a Latin hypercube
    assert found.measured == {"length": "extents.length", "width": "extents.width"}
    for i in (0, 7, 23):
        assert np.array_equal(found.meshes[i].vertices, found.mesh_at(found.parameters[i]).vertices)
    assert found.meshes[1:3][1].vertices[0] == pytest.approx(found.meshes[2].vertices[0])
    assert np.array_equal(MorphSource(file)().parameters, found.parameters)
    assert not np.array_equal(MorphSource(file, seed=1)().parameters[1:], found.parameters[1:])


def test_designs(file):
    ends = MorphSource(file, design="ends", deformations="length,hood")()
    assert ends.names == ("base", "length_low", "length_high", "hood_low", "hood_high")
    np.testing.assert_allclose(ends.parameters, [[0, 0], [-0.28, 0], [0.28, 0], [0, -4], [0, 4]])
    one = MorphSource(file, design="ends", deformations="length,hood", ranges="hood=0:3", count=4)()
    assert one.names == ("base", "length_low", "length_high", "hood_high")  # the other end is the base
    for design in ("sobol", "random"):
        found = MorphSource(file, design=design, count=17, ranges="ramp=0:2")()
        assert len(found) == 17 and (found.parameters[1:, 4] >= 0).all() and (found.parameters[:, 4] <= 2).all()
    assert len(MorphSource(file, count=1)()) == 1
    sobol = MorphSource(file, design="sobol", count=33)().parameters[1:]
    assert np.array_equal(np.bincount(((sobol[:, 0] - LOW[0]) / (HIGH[0] - LOW[0]) * 8).astype(int)), [4] * 8)


def test_names_and_ranges_are_chosen(file):
    found = MorphSource(file, deformations="roof, length", ranges=" length = -0.3:0.5 ,roof=-0.1:0.15", unit="mm")()
    assert [str(q) for q in found.space] == ["roof [mm]", "length [mm]"]
    assert found.unit == "mm"
    assert np.ptp(found.parameters[:, 1]) > 0.28 * 2
    by_name = lampopt.exemplars("morph", mesh=file, deformations=["roof", "length"], ranges=["length=0:1"])
    assert by_name.parameters[:, 1].min() == 0


def test_few_exemplars_declare_only_what_stands_alone(file):
    """Over few exemplars the core cannot free the bounding width from what a greenhouse does to it."""
    assert set(MorphSource(file, count=10)().measured) == {"length"}
    assert set(MorphSource(file, count=11)().measured) == {"length", "width"}
    assert set(MorphSource(file, count=2, deformations="width,hood")().measured) == {"width"}


def test_meshes_are_made_anew_and_hold_nothing_in_common(file):
    found = MorphSource(file)()
    first = found.meshes[3]
    kept = np.array(first.vertices)
    first.vertices += 1.0
    first.faces[:] = 0
    base = found.meshes[0]
    base.vertices *= 2.0
    assert np.array_equal(found.meshes[3].vertices, kept)
    assert found.meshes[0].extents == pytest.approx(CAR.extents)
    with pytest.raises(ValueError, match="read-only"):
        found.mesh_at.body.vertices[0] = 0
    again = pickle.loads(pickle.dumps(found.meshes))
    assert np.array_equal(again[3].vertices, kept)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"design": "grid"}, "design: expected one of lhs, sobol"),
        ({"count": 10**9}, "count: expected a whole number"),
        ({"count": -1}, "count: expected a whole number from 0 to 100,000"),
        ({"seed": -1}, "seed: expected a whole number"),
        ({"edge": -1.0}, "edge: expected a length"),
        ({"edge": float("nan")}, "edge: expected a length"),
        ({"count": 5, "design": "ends"}, "has 17 exemplars here, got count=5"),
        ({"ranges": "length"}, "expected each name once, as in"),
        ({"ranges": "length=1"}, "expected each name once, as in"),
        ({"ranges": "length=a:b"}, "expected each name once, as in"),
        ({"ranges": "length=-1:1,length=0:1"}, "expected each name once, as in"),
        ({"ranges": "lenght=-1:1"}, "ranges: unknown lenght; known are length, width"),
        ({"ranges": "hood=-1:1", "deformations": "length"}, "hood not among the deformations chosen"),
        ({"ranges": "hood=1:2"}, "'hood': expected a range that holds 0"),
        ({"ranges": "hood=-1:nan"}, "'hood': high: expected 1 finite"),
        ({"deformations": "length,height"}, "deformations: unknown height; known are length"),
        ({"deformations": "length,length"}, "length named twice"),
        ({"mesh": "none.stl"}, "none.stl"),
        ({"custom": "none.toml"}, "none.toml"),
    ],
)
def test_options_are_checked(file, options, message):
    with pytest.raises(InputError, match=message):
        MorphSource(**{"mesh": file, **options})()


@pytest.mark.parametrize("text", ["", " , ,", "=", ":", "a=", "a=:", "=1:2", "a=1:2:3", "a=1:2,", "\0=0:1"])
def test_whatever_ranges_say_raises_only_our_errors(file, text):
    with contextlib.suppress(LampoptError):
        MorphSource(file, ranges=text)()


# deformations of one's own

SPOILER = """
[spoiler]
kind = "turn"
direction = "right"
about = { along = 0.97, up = 0.6 }
region = { along = [0.97, 1.0], up = [0.55, 1.0] }
falloff = { along = 0.04, up = 0.1 }
low = -8
high = 8

[wheelbase]
kind = "stretch"
direction = "-x"
region = { x = [-0.6, 0.6] }
falloff = { x = 0.4 }
low = -0.2
high = 0.2

[hood]
kind = "tilt"
direction = "down"
over = "front"
region = { along = [0.0, 0.3], up = [0.5, 1.0] }
falloff = 0.05
low = -2
high = 2

[dent]
direction = [0, -1, 0.5]
symmetric = false
region = { along = [0.4, 0.5], y = [0.7, 0.9], z = [0.5, 0.6] }
falloff = { y = 0.2, z = 0.1, along = 0.05 }
low = 0
high = 0.05
"""


def test_deformations_from_a_file(file, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(SPOILER, encoding="utf-8")
    found = MorphSource(file, custom=str(path))()
    assert [q.name for q in found.space] == [*NAMES, "spoiler", "wheelbase", "dent"]
    assert [q.unit for q in found.space][-3:] == ["deg", "m", "m"]
    spoiler, wheelbase, hood, dent = read_deformations(path, BODY)
    assert spoiler == Deformation(
        "spoiler", "turn", "right", -8, 8, along=(0.97, 1.0), up=(0.55, 1.0), falloff=(0.04, 0.15, 0.1),
        about=(0.97, 0.0, 0.6),
    )  # fmt: skip
    assert wheelbase.direction == "front"
    assert wheelbase.along == pytest.approx((0.35, 0.65)) and wheelbase.falloff[0] == pytest.approx(0.1)
    assert hood.high == 2 and found.mesh_at.fields[7].deformation == hood  # replaces the vehicle's, in its place
    assert dent.across == pytest.approx((7 / 9, 1)) and not dent.symmetric
    moved = Morph.of(BODY, [dent])([0.05]).vertices - CAR.vertices
    assert moved[T > 0.7].any() and not moved[T < 0].any()
    only_own = MorphSource(file, custom=str(path), deformations="wheelbase")()
    stretched = only_own.mesh_at([0.2])
    assert stretched.extents[0] == pytest.approx(LENGTH + 0.2)
    assert only_own.measured == {}  # only stretches of the whole are known to be what extents show


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected tables such as"),
        ("a = 1", r"\[a\]: expected a table, got 1"),
        ("[a", "cannot be read"),
        ("[a]", "expected direction, low, high too, got only an empty table"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nfall = 2", "unknown fall; known are kind"),
        ("[a]\ndirection = 'up'\nlow = '-1'\nhigh = 1", "low: expected 1 finite"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = true", "high: expected 1 finite"),
        ("[a]\ndirection = 3\nlow = -1\nhigh = 1", "direction: expected 3 numbers, got 3"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nkind = 3", "kind: expected text"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nsymmetric = 3", "symmetric: expected true or false"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nregion = 3", "region: expected a table with some of along"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nregion = {long = [0, 1]}", "region: unknown long"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nregion = {along = 0.5}", "region along: expected 2 numbers"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nregion = {along = [0, 1], x = [0, 1]}", "x and along are one"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nregion = {x = [70, 80]}", "partly within 0 to 1"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nfalloff = '1'", "falloff: expected a table"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nfixed = '1'", "fixed: expected 1 finite"),
        ("['a.b']\ndirection = 'up'\nlow = -1\nhigh = 1", "without '.'"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1\nregion = {x = [-1e300, 1]}", "region x: expected 2 numbers"),
        ("[a]\ndirection = 'up'\nlow = -1e300\nhigh = 1", "low: expected 1 finite"),
        ("[a]\ndirection = 'up'\nlow = -1\nhigh = 1" + "0" * 400, "high: expected 1 finite"),
        ("[a]\ndirection = 'up'\nlow = nan\nhigh = 1", "low: expected 1 finite"),
    ],
)  # fmt: skip
def test_files_are_checked(tmp_path, text, message):
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as error:
        read_deformations(path, BODY)
    assert "own.toml" in str(error.value)


def test_programs_give_meshes_and_deformations_themselves():
    found = family(CAR, [vehicle(BODY)[0], FREE[0]], unit="mm", count=4)
    assert [str(q) for q in found.space] == ["length [mm]", "a [mm]"]
    assert len(found) == 4
    with pytest.raises(InputError, match="design: expected one of"):
        family(CAR, design="grid")
    with pytest.raises(InputError, match="distinct names, got a twice"):
        family(CAR, [FREE[0], FREE[0]])


# coarse meshes


def test_edges_are_divided_without_gaps():
    coarse = trimesh.creation.box((4.0, 1.5, 1.0))
    vertices, faces = refined(np.asarray(coarse.vertices), np.asarray(coarse.faces), 0.3)
    fine = trimesh.Trimesh(vertices, faces, process=False)
    assert fine.is_watertight and fine.is_winding_consistent
    assert fine.volume == pytest.approx(coarse.volume) and fine.area == pytest.approx(coarse.area)
    assert fine.edges_unique_length.max() <= 0.3
    assert np.array_equal(vertices[:8], coarse.vertices)
    same = refined(np.asarray(coarse.vertices), np.asarray(coarse.faces), 10.0)
    assert np.array_equal(same[1], coarse.faces)
    with pytest.raises(InputError, match="more than 4,000,000 faces"):
        refined(np.asarray(coarse.vertices) * 1e3, np.asarray(coarse.faces), 0.3)


def test_a_coarse_mesh_is_reported_and_can_be_divided(tmp_path, caplog):
    trimesh.creation.box((4.0, 1.5, 1.0)).export(tmp_path / "box.stl")
    with caplog.at_level(logging.WARNING, "lampopt"):
        MorphSource(str(tmp_path / "box.stl"), deformations="length")()
    assert "100 % of the surface" in caplog.text and "edge=0.1 divides them" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING, "lampopt"):
        found = MorphSource(str(tmp_path / "box.stl"), deformations="length,diffuser", edge=0.1)()
    assert not caplog.text
    made = found.mesh_at([0.0, 6.0])
    tail = made.vertices[(made.vertices[:, 0] > 1.6) & (made.face_normals[0] is not None)]
    bottom = tail[tail[:, 2] < -0.3]
    assert made.is_watertight and len(bottom) > 20


def test_the_kit_is_satisfied():
    plugins = Plugins.load(block=[p.name for p in entry_points(group="lampopt") if p.name != "families"])
    records = check_plugin(plugins, "families")
    assert {record.plugin for record in records} >= {"source morph", "source plate"}
    assert all(record.passed for record in records), records


def test_a_bank_of_morphs_makes_a_design():
    """From a body to a checked design: the length asked for is the length that is measured."""
    found = family(CAR, vehicle(BODY)[:2], design="ends")
    bank = lampopt.build_bank(found, decoder=lampopt.Spec("gridsdf", size=33), probes=200)
    result = lampopt.design(bank, {"length": 0.1, "width": 0.05}, resolution=48)
    assert result.check("drift.length").passed
    assert result.design.mesh.extents[0] == pytest.approx(LENGTH + 0.1, abs=0.05)


@pytest.mark.parametrize("name", ["plate", "table", "morph", "run"])
def test_every_option_of_every_source_is_documented(name):
    """docs/sources.md has a section a source, with a line an option."""
    page = (Path(__file__).parent.parent / "docs" / "sources.md").read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {name}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    source = Plugins.load().get("source", name).resolve()
    listed = section.split("| option | default | what it is |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", listed, re.MULTILINE) == [field.name for field in fields(source)]


def test_the_eight_are_documented_as_they_are():
    page = (Path(__file__).parent.parent / "docs" / "sources.md").read_text(encoding="utf-8")
    for d in vehicle(BODY):
        (row,) = re.findall(rf"^\| `{d.name}` \| {d.kind} \|.*\|$", page, re.MULTILINE)
        numbers = {float(x) for x in re.findall(r"\d+\.?\d*", row)}
        for axis, region in enumerate(d.region):
            for end, inside in zip(region, d.ends(axis), strict=True):
                assert not inside or end in numbers, (d.name, axis)
            assert not any(d.ends(axis)) or d.falloff[axis] in numbers, (d.name, axis)
        if d.angle:
            assert {abs(d.low), d.high} <= numbers
    own = "".join(
        re.findall(r"^    (.*\n|\n)", page.split("### Deformations of your own")[1].split("| key |")[0], re.M)
    )
    assert len(tomllib.loads(own)) == 3
