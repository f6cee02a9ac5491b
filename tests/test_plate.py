"""The plate with a hole: true meshes at any parameters, and parameters read off any mesh of one."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc
from skimage.measure import marching_cubes

from lampopt.errors import InputError, MeasureError
from lampopt.protocols import Source
from lampopt_families.plate import HIGH, LOW, NAMES, PlateSource, plate_mesh
from lampopt_measure.basic import Extents, Genus, Volume
from lampopt_measure.plate import Plate

MIDDLE = (np.array(LOW) + HIGH) / 2
HALF = (np.array(HIGH) - LOW) / 2
MILLIMETRE = 1e-3


def fits(parameters):
    length, width, _, radius, x, y = parameters
    return abs(x) + radius < length / 2 - 0.02 and abs(y) + radius < width / 2 - 0.02


def widened(factor: float = 3.0):
    """Parameters from the family's range widened by `factor`, the hole inside."""
    unit = st.tuples(*[st.floats(-1, 1)] * len(NAMES))
    return unit.map(lambda u: MIDDLE + factor * HALF * np.array(u)).filter(fits)


def draws(count: int, factor: float = 3.0, seed: int = 0):
    unit = qmc.LatinHypercube(len(NAMES), rng=seed).random(4 * count)
    rows = MIDDLE + factor * HALF * (2 * unit - 1)
    return [row for row in rows if fits(row)][:count]


def distance(parameters, points):
    """Signed distance to the plate; exact but for the acute outside of the hole's rim, which no cell of ours sees."""
    q = np.abs(points) - np.array(parameters[:3]) / 2
    block = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)
    return np.maximum(block, parameters[3] - np.hypot(points[..., 0] - parameters[4], points[..., 1] - parameters[5]))


def cells(parameters, cell: float, change=None):
    """Marching cubes of the exact field at cells of `cell` [m], off the plate's planes; `change` edits the field."""
    low = -np.array(parameters[:3]) / 2 - 2.37 * cell
    counts = np.ceil(-2 * low / cell).astype(int) + 1
    axes = [low[k] + cell * np.arange(counts[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = distance(parameters, points)
    if change is not None:
        field = change(field, points)
    vertices, faces, _, _ = marching_cubes(field, 0, spacing=(cell,) * 3)
    mesh = trimesh.Trimesh(vertices + low, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


# the family


def test_the_thirteen_of_the_paper():
    source = PlateSource()
    assert isinstance(source, Source)
    exemplars = source()
    assert len(exemplars) == 13
    assert [q.name for q in exemplars.space] == list(NAMES)
    assert {q.unit for q in exemplars.space} == {exemplars.unit} == {"m"}
    assert exemplars.measured == {name: f"plate.{name}" for name in NAMES}
    np.testing.assert_allclose(exemplars.parameters[0], MIDDLE)
    np.testing.assert_array_equal(exemplars.parameters.min(axis=0), LOW)
    np.testing.assert_array_equal(exemplars.parameters.max(axis=0), HIGH)
    changed = exemplars.parameters != exemplars.parameters[0]
    assert exemplars.names[0] == "middle"
    for name, row in zip(exemplars.names[1:], changed[1:], strict=True):
        assert [NAMES[k] for k in np.flatnonzero(row)] == [name.rsplit("_", 1)[0]]


@pytest.mark.parametrize("design", ["lhs", "sobol", "random"])
def test_designs_of_experiments(design):
    first, again = (PlateSource(design=design, count=11, seed=3)() for _ in range(2))
    other = PlateSource(design=design, count=11, seed=4)()
    assert len(first) == len(set(first.names)) == 11
    np.testing.assert_array_equal(first.parameters, again.parameters)
    assert not np.allclose(first.parameters, other.parameters)
    assert (first.parameters >= LOW).all() and (first.parameters <= HIGH).all()
    if design == "lhs":  # one draw in each of the 11 strata of each parameter
        strata = np.floor((first.parameters - LOW) / (np.array(HIGH) - LOW) * 11)
        assert all(len(set(column)) == 11 for column in strata.T)


def test_meshes_are_made_on_access():
    exemplars = PlateSource()()
    assert exemplars.meshes[3] is not exemplars.meshes[3]
    assert len(exemplars.meshes[2:5]) == 3
    np.testing.assert_array_equal(exemplars.meshes[2:5][1].vertices, exemplars.meshes[3].vertices)
    assert len(list(exemplars.meshes)) == 13


@settings(max_examples=60, deadline=None)
@given(parameters=widened(), segments=st.integers(8, 200))
def test_true_mesh(parameters, segments):
    """Closed, outward, one handle; the volume of the prism over the polygon, n/2 r² sin(2π/n) being cut out."""
    mesh = plate_mesh(parameters, segments=segments)
    length, width, thickness, radius, x, y = parameters
    assert mesh.is_watertight and mesh.is_winding_consistent
    np.testing.assert_array_equal(Genus()(mesh), [1, 1])
    hole = segments / 2 * radius**2 * np.sin(2 * np.pi / segments)
    np.testing.assert_allclose(Volume()(mesh), (length * width - hole) * thickness, rtol=1e-9)
    np.testing.assert_allclose(Extents()(mesh), parameters[:3], rtol=1e-12)
    rim = np.hypot(mesh.vertices[:, 0] - x, mesh.vertices[:, 1] - y)
    assert (np.abs(rim - radius) < 1e-12).sum() == 2 * segments
    assert len(mesh.vertices) == 2 * segments + 8
    assert (mesh.area_faces > 0).all()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("length", -1.0, r"length: expected a positive size, got -1 m"),
        ("thickness", 0.0, r"thickness: expected a positive size, got 0 m"),
        ("hole_radius", np.nan, r"hole_radius: expected a positive size, got nan m"),
        ("hole_x", np.inf, r"hole_x: expected a finite place, got inf m"),
        ("hole_x", 1.1, r"hole_x: the hole of radius 0.2 m at 1.1 m reaches the edge at 1.25 m"),
        ("hole_y", -0.7, r"hole_y: the hole of radius 0.2 m at -0.7 m reaches the edge at -0.85 m"),
    ],
)
def test_parameters_that_make_no_plate(name, value, message):
    with pytest.raises(InputError, match=message):
        plate_mesh(np.where(np.array(NAMES) == name, value, MIDDLE))


def test_all_that_is_wrong_at_once():
    with pytest.raises(InputError, match=r"length: .* -1 m; width: .* 0 m"):
        plate_mesh(np.array([-1, 0, 0.2, 0.1, 0, 0]))
    with pytest.raises(InputError, match=r"expected parameters \(6,\).*got shape \(5,\)"):
        plate_mesh(MIDDLE[:5])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"design": "grid"}, "expected one of lhs, sobol, random, ends, got 'grid'"),
        ({"count": 20}, "'ends' has 13 exemplars, got count=20"),
        ({"design": "lhs", "seed": -1}, "0 or more, got -1"),
        ({"segments": 2}, "from 8 to 100,000, got 2"),
    ],
)
def test_options_that_make_no_family(options, message):
    with pytest.raises(InputError, match=message):
        PlateSource(**options)


# the measure


def check_exact(parameters, mesh, segments=128):
    values = Plate()(mesh)
    radius = parameters[3] * np.sqrt(segments / (2 * np.pi) * np.sin(2 * np.pi / segments))  # circle by area
    np.testing.assert_allclose(values, [*parameters[:3], radius, *parameters[4:]], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(parameters=widened())
def test_true_mesh_measures_as_its_parameters(parameters):
    check_exact(parameters, plate_mesh(parameters))
    np.testing.assert_allclose(Plate()(plate_mesh(parameters)), parameters, atol=0.1 * MILLIMETRE)


@settings(max_examples=20, deadline=None)
@given(move=st.tuples(*[st.floats(-10, 10)] * 3), scale=st.floats(0.01, 1000))
def test_place_does_not_matter_and_all_values_are_lengths(move, scale):
    mesh = plate_mesh(MIDDLE).apply_translation(move).apply_scale(scale)
    np.testing.assert_allclose(Plate()(mesh), scale * Plate()(plate_mesh(MIDDLE)), atol=1e-9 * scale)


def test_loose_triangles():
    mesh = plate_mesh(MIDDLE)
    faces = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    check_exact(MIDDLE, trimesh.Trimesh(mesh.triangles.reshape(-1, 3), faces, process=False))


def test_subdivided():
    check_exact(MIDDLE, plate_mesh(MIDDLE).subdivide().subdivide())


@pytest.mark.parametrize("cell", [0.020, 0.030])
def test_marching_cubes_of_the_exact_field(cell):
    """Six plates from the widened range, some only 4 cells thick with a hole of 2 cells' radius."""
    for parameters in draws(6, seed=1):
        error = Plate()(cells(parameters, cell)) - parameters
        assert (np.abs(error[:3]) < 0.1 * MILLIMETRE).all(), error
        # a chord cut across a cell makes the hole smaller by some cell² / (8 r)
        assert -(cell**2) / (4 * parameters[3]) < error[3] < cell**2 / (8 * parameters[3]), error
        assert (np.abs(error[4:]) < MILLIMETRE).all(), error


def test_rounded_edges():
    """A field offset inward and out again has edges of 30 mm radius, as a network draws them."""
    inner = MIDDLE + np.array([-0.06, -0.06, -0.06, 0.03, 0, 0])
    mesh = cells(MIDDLE, 0.02, lambda _, points: distance(inner, points) - 0.03)
    np.testing.assert_allclose(Plate()(mesh), MIDDLE, atol=1 * MILLIMETRE)


def test_rough_faces():
    noise = np.random.default_rng(0)
    mesh = cells(MIDDLE, 0.025, lambda field, _: field + 0.002 * noise.standard_normal(field.shape))
    error = Plate()(mesh) - MIDDLE
    # Nineteen of twenty points of a side lie within 1.6 standard deviations; the bounding box is the worst of all.
    assert (np.abs(error[:3]) < 2 * 1.7 * 2 * MILLIMETRE).all()
    assert (error[:3] < (mesh.extents - MIDDLE[:3]) * 0.7).all()
    assert (np.abs(error[3:]) < MILLIMETRE).all()


def test_a_bump_is_overlooked():
    """Bumps of 4 % of the length, as wide as a hand: the bounding box believes them."""
    ends = [[MIDDLE[0] / 2, 0.3, 0], [0.3, MIDDLE[1] / 2, 0], [0.8, 0.5, MIDDLE[2] / 2]]

    def bump(field, points):
        for end in ends:
            field = np.minimum(field, np.linalg.norm((points - end) / [2, 2, 2], axis=-1) * 2 - 0.045)
        return field

    mesh = cells(MIDDLE, 0.02, bump)
    assert (mesh.extents - MIDDLE[:3] > 0.04).all()
    np.testing.assert_allclose(Plate()(mesh), MIDDLE, atol=MILLIMETRE)


@pytest.mark.parametrize("axis", [1, 2])
def test_flaring_ends_are_seen(axis):
    """Width (thickness) grows by 30 % towards the ends, nothing in the middle: a mid-section would see nothing."""
    mesh = plate_mesh(MIDDLE)
    for _ in range(5):
        mesh = mesh.subdivide()
    mesh.vertices[:, axis] *= 1 + 0.3 * (2 * mesh.vertices[:, 0] / MIDDLE[0]) ** 4
    measured = Plate()(mesh)[axis] / MIDDLE[axis]
    assert 1.2 < measured <= 1.3


def test_a_slanting_side_of_two_triangles_is_seen():
    mesh = plate_mesh(MIDDLE)
    mesh.vertices[:, 1] *= 1 + 0.2 * mesh.vertices[:, 0] / MIDDLE[0]  # a trapezoid, 10 % wider at one end
    np.testing.assert_allclose(Plate()(mesh)[1], 1.1 * MIDDLE[1])


def test_a_stray_body_is_overlooked():
    crumb = trimesh.creation.icosphere(2, 0.05).apply_translation((3, 2, 1))
    np.testing.assert_allclose(
        Plate()(trimesh.util.concatenate([plate_mesh(MIDDLE), crumb])), MIDDLE, atol=0.1 * MILLIMETRE
    )


def drilled(*holes, block=(2.5, 1.7, 0.25)):
    mesh = trimesh.creation.box(block)
    for radius, x, y, z in holes:
        drill = trimesh.creation.cylinder(radius, 0.5, sections=64).apply_translation((x, y, z))
        mesh = trimesh.boolean.difference([mesh, drill], engine="manifold")
    return mesh


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (drilled(), "got no through-hole$"),
        (drilled((0.2, 0, 0, 0), (0.1, 0.8, 0.4, 0)), r"got 2 holes; at \(.*\); at \(.*\)"),
        (drilled((0.2, 0, 0, 0.25)), "got no through-hole"),  # blind: drilled half through
        (drilled((0.2, 0, 0, 0.14)), "got no through-hole .1 recesses"),  # a skin of 15 mm is left
        (drilled((0.2, 1.2, 0, 0)), "got no through-hole$"),  # over the edge: a notch
    ],
    ids=["none", "two", "blind", "skin", "notch"],
)
def test_not_one_through_hole(mesh, message):
    with pytest.raises(MeasureError, match=message):
        Plate()(mesh)


def test_a_bubble_is_no_hole():
    bubble = trimesh.creation.icosphere(3, 0.1).apply_translation((0.8, 0.4, 0))
    bubble.invert()
    mesh = trimesh.util.concatenate([plate_mesh(MIDDLE), bubble])
    np.testing.assert_allclose(Plate()(mesh), MIDDLE, atol=0.1 * MILLIMETRE)


def test_inward_faces():
    mesh = plate_mesh(MIDDLE)
    mesh.invert()
    with pytest.raises(MeasureError, match="they point inward"):
        Plate()(mesh)


def test_an_open_plate():
    mesh = plate_mesh(MIDDLE)
    mesh.update_faces(np.abs(mesh.face_normals[:, 1]) < 0.99)
    with pytest.raises(MeasureError, match=r"a side is missing"):
        Plate()(mesh)
    mesh = plate_mesh(MIDDLE)
    mesh.update_faces(np.arange(len(mesh.faces)) != len(mesh.faces) - 1)
    with pytest.raises(MeasureError, match="not closed"):
        Plate()(mesh)


def test_not_a_plate_at_all():
    with pytest.raises(MeasureError):
        Plate()(trimesh.creation.icosphere(3))


def test_a_sweep_is_monotonous():
    """Each parameter alone, moved in small steps on coarse cells: the reading follows, without jumps between cells."""
    for k in (0, 3, 4):
        steps = MIDDLE[k] + HALF[k] * np.linspace(-1, 1, 5)
        read = [Plate()(cells(np.where(np.arange(6) == k, step, MIDDLE), 0.03))[k] for step in steps]
        assert all(b > a for a, b in pairwise(read))
