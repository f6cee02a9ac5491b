"""What decoder `mesh-template` is made of: splines against polynomials and integrals; surfaces, remeshing, registration
and what is said about a design's health against solids known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.sparse import eye_array

from lampopt.intersections import self_intersections
from lampopt.metrics import surface_distance
from lampopt.testing import shapes
from lampopt.topology import topology
from lampopt_template.detail import Detail
from lampopt_template.health import LEAST, gradients, health_checks, least_quality
from lampopt_template.lattice import Lattice, Refined
from lampopt_template.registration import AGREE, Registration, _Way
from lampopt_template.remesh import LONG, edge_of, remeshed
from lampopt_template.surface import CURVED, Surface
from lampopt_template.template import Template, mirrored_half

LATTICE = Lattice(np.array([-0.3, 0.1, 0.2]), 0.25, np.array([2, 1, 3]))
VOLUME = 6 * 0.25**3
NODES = LATTICE.nodes


def within(lattice, count, seed=0):
    return np.random.default_rng(seed).uniform(lattice.low, lattice.high, (count, 3))


def squared(axis):
    """Coefficients of x², by its blossom: the mean product of two of the three knots about a node."""
    return NODES[:, axis] ** 2 - LATTICE.cell**2 / 3


def cubed(axis):
    """Coefficients of x³: the product of those three knots."""
    return NODES[:, axis] ** 3 - NODES[:, axis] * LATTICE.cell**2


# The lattice.


def test_affine_displacements_are_exact_even_outside():
    matrix, shift = np.random.default_rng(0).normal(size=(3, 3)), np.array([0.3, -2.0, 1.0])
    points = within(LATTICE, 500) + np.repeat([[0.0] * 3, [1.5, -2.0, 0.7]], 250, axis=0)
    np.testing.assert_allclose(LATTICE.rows(points) @ (NODES @ matrix + shift), points @ matrix + shift, atol=1e-12)
    for axis in range(3):
        slope = LATTICE.rows(points, derivative=axis) @ (NODES @ matrix + shift)
        np.testing.assert_allclose(slope, np.tile(matrix[axis], (500, 1)), atol=1e-11)


def test_cubics_are_exact_and_their_derivatives():
    points = within(LATTICE, 300)
    x, y, z = points.T
    given = cubed(0) + 2 * squared(1) - NODES[:, 0] * NODES[:, 2]
    np.testing.assert_allclose(LATTICE.rows(points) @ given, x**3 + 2 * y**2 - x * z, atol=1e-12)
    slopes = [LATTICE.rows(points, derivative=k) @ given for k in range(3)]
    np.testing.assert_allclose(slopes, [3 * x**2 - z, 4 * y, -x], atol=1e-11)


def test_derivatives_against_differences():
    points, values = within(LATTICE, 200), np.random.default_rng(1).normal(size=(LATTICE.size, 3))
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (LATTICE.rows(points + step) - LATTICE.rows(points - step)) @ values / 2e-6
        np.testing.assert_allclose(LATTICE.rows(points, derivative=axis) @ values, slope, atol=1e-7)


def test_functions_are_a_partition_of_unity_and_none_is_negative():
    rows = LATTICE.rows(within(LATTICE, 200))
    assert rows.shape == (200, 5 * 4 * 6)
    assert rows.min() >= 0
    np.testing.assert_allclose(rows.sum(1), 1, atol=1e-13)


def test_around_covers_the_points_with_margin_and_is_centred():
    points = np.array([[0.0, 0, 0], [1.0, 0.5, 0.04]])
    lattice = Lattice.around(points, 0.2, 0.05)
    np.testing.assert_array_equal(lattice.spans, [6, 3, 1])
    np.testing.assert_allclose((lattice.low + lattice.high) / 2, points.mean(0))
    assert (lattice.low <= -0.05 + 1e-12).all()
    assert (lattice.high >= points[1] + 0.05 - 1e-12).all()


def cube_integral(axis):
    """∫ 36 x² over the lattice."""
    low, high = LATTICE.low[axis], LATTICE.high[axis]
    return 36 * (high**3 - low**3) / 3 * VOLUME / (high - low)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (NODES @ [1.0, -2.0, 3.0] + 5, 0.0),
        (squared(0), 4 * VOLUME),
        (squared(1), 4 * VOLUME),
        (NODES[:, 0] * NODES[:, 2], 2 * VOLUME),  # two mixed derivatives, 1 each
        (squared(0) - 3 * squared(2) + 2 * NODES[:, 1] * NODES[:, 2], (4 + 36 + 8) * VOLUME),
        (cubed(2), cube_integral(2)),
    ],
    ids=["affine", "xx", "yy", "xz", "sum", "zzz"],
)
def test_bending_of_polynomials(given, wanted):
    for form, more in ((LATTICE.bending(), 0), (Refined(LATTICE, np.array([7, 40])).bending(), 2)):
        coefficients = np.append(given, np.zeros(more))
        assert coefficients @ (form @ coefficients) == pytest.approx(wanted, abs=1e-9)


# The lattice that is finer in places.

REFINED = Refined(LATTICE, np.sort(np.random.default_rng(5).choice(7 * 5 * 9, 20, replace=False)))


def test_a_coarse_function_is_the_sum_of_finer_ones():
    whole = Refined(LATTICE, np.arange(REFINED.fine.size))
    coarse, fine = np.split(whole.rows(within(LATTICE, 1500)).toarray(), [LATTICE.size], axis=1)
    sums = np.linalg.lstsq(fine, coarse)[0]
    np.testing.assert_allclose(fine @ sums, coarse, atol=1e-11)
    np.testing.assert_allclose(np.unique(sums.max(0).round(9))[-1], (6 / 8) ** 3)  # 1, 4, 6, 4, 1 eighths an axis
    bent = whole.bending().toarray()
    both = bent[: LATTICE.size, LATTICE.size :]
    np.testing.assert_allclose(sums.T @ bent[LATTICE.size :, LATTICE.size :], both, atol=1e-9 * np.abs(bent).max())
    np.testing.assert_allclose(sums.T @ both.T, LATTICE.bending().toarray(), atol=1e-9 * np.abs(bent).max())


def test_motion_without_the_matrix_is_that_with_it():
    given = np.random.default_rng(4).normal(size=(REFINED.size, 3))
    ends = np.array([LATTICE.low, LATTICE.high, (LATTICE.low + LATTICE.high) / 2])
    points = np.concatenate([within(LATTICE, 400), ends])
    np.testing.assert_allclose(REFINED.displacement(points, given), REFINED.rows(points) @ given, atol=1e-12)
    coarse = given[: LATTICE.size]
    np.testing.assert_allclose(LATTICE.displacement(points, coarse), LATTICE.rows(points) @ coarse, atol=1e-12)


def test_bending_of_both_together_is_the_integral():
    given = np.random.default_rng(2).normal(size=REFINED.size)
    fine, step = REFINED.fine, 1e-4 * REFINED.fine.cell
    nodes, weights = np.polynomial.legendre.leggauss(4)
    firsts = [low + fine.cell * np.arange(n) for low, n in zip(fine.low, fine.spans, strict=True)]
    at = [(first[:, None] + fine.cell * (nodes + 1) / 2).ravel() for first in firsts]
    points = np.stack(np.meshgrid(*at, indexing="ij"), -1).reshape(-1, 3)
    share = np.einsum("i,j,k->ijk", *(np.tile(weights / 2 * fine.cell, n) for n in fine.spans)).ravel()
    total = 0.0
    for other in range(3):
        way = step * np.eye(3)[other]
        for one in range(3):
            ends = [REFINED.rows(points + s * way, derivative=one) @ given for s in (1, -1)]
            total += share @ ((ends[0] - ends[1]) / (2 * step)) ** 2
    assert given @ (REFINED.bending() @ given) == pytest.approx(total, rel=1e-7)


def test_bending_is_zero_for_affine_displacements_alone():
    form = REFINED.bending().toarray()
    np.testing.assert_allclose(form, form.T, atol=1e-12)
    values = np.linalg.eigvalsh(form)
    assert values[0] > -1e-12 * values[-1]
    assert abs(values[3]) < 1e-12 * values[-1]
    assert values[4] > 1e-8 * values[-1]
    for affine in (NODES, np.ones_like(NODES)):
        np.testing.assert_allclose(form @ REFINED.affine(affine), 0, atol=1e-9 * values[-1])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_functions_mirrored(axis):
    fine = REFINED.fine
    image = np.flip(np.arange(fine.size).reshape(fine.count), axis).ravel()
    refined = Refined(LATTICE, np.union1d(REFINED.chosen, image[REFINED.chosen]))
    mirrored, points = refined.mirrored(axis), within(LATTICE, 200)
    np.testing.assert_array_equal(mirrored[mirrored], np.arange(refined.size))
    across = points.copy()
    across[:, axis] = LATTICE.low[axis] + LATTICE.high[axis] - points[:, axis]
    np.testing.assert_allclose(refined.rows(across).toarray(), refined.rows(points).toarray()[:, mirrored], atol=1e-12)
    form = refined.bending().toarray()
    np.testing.assert_allclose(form[np.ix_(mirrored, mirrored)], form, atol=1e-11)


def test_where_finds_the_functions_that_weigh_most():
    points = within(LATTICE, 20)
    for point in points:
        rows = REFINED.fine.rows(point[None]).toarray()[0]
        found = REFINED.where(point[None])
        assert len(found) == 8
        assert rows[found].sum() > 0.3  # of 1; (23/24)³ in the middle of a cell, (5/6)³ at its corner
        assert rows.argmax() in found
    np.testing.assert_array_equal(REFINED.where(points), np.unique([REFINED.where(p[None]) for p in points]))


# Surfaces.

BRICK = shapes.box((1.0, 0.6, 0.4), divisions=3)
COARSE = Surface.of(trimesh.creation.icosphere(subdivisions=2, radius=0.5))


def test_closest_points_are_trimeshs():
    mesh = trimesh.creation.torus(0.4, 0.15)
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 3))
    near = Surface.of(mesh).near(points)
    _, distances, _ = trimesh.proximity.closest_point(mesh, points)
    np.testing.assert_allclose(np.linalg.norm(near.points - points, axis=1), distances, atol=1e-9)
    np.testing.assert_allclose(near.normals, mesh.face_normals[near.faces], atol=1e-9)
    again = np.einsum("mk,mkc->mc", near.weights, mesh.vertices[mesh.faces[near.faces]])
    np.testing.assert_allclose(again, near.points, atol=1e-9)


def test_curved_leaves_a_known_part_of_what_flat_faces_are_off_a_sphere():
    """A point of a face s within the sphere is 2 s below its corners' tangent planes, by whatever weights."""
    points = np.random.default_rng(1).normal(size=(2000, 3))
    true = points / np.linalg.norm(points, axis=1, keepdims=True)
    off, turned = [], []
    for curved in (False, True):
        near = COARSE.near(np.random.default_rng(2).uniform(0.4, 0.6, (2000, 1)) * true, curved=curved)
        off.append((np.linalg.norm(near.points, axis=1) - 0.5).mean())
        turned.append(np.arccos(np.clip((near.normals * true).sum(1), -1, 1)).mean())
    assert off[0] < -0.005
    assert off[1] / off[0] == pytest.approx(1 - 2 * CURVED, abs=0.06)
    assert abs(off[1]) < 0.6 * abs(off[0])
    assert turned[1] < turned[0] / 5


def test_curved_is_flat_where_the_surface_is():
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (500, 3))
    flat, curved = (Surface.of(BRICK).near(points, curved=c) for c in (False, True))
    np.testing.assert_allclose(curved.points, flat.points, atol=1e-12)
    np.testing.assert_allclose(curved.normals, flat.normals, atol=1e-12)


def test_normals_at_corners_respect_edges():
    surface = Surface.of(BRICK)
    np.testing.assert_allclose(surface.corner_normals, np.repeat(surface.normals[:, None], 3, 1), atol=1e-12)
    on = np.isclose(np.abs(surface.vertices), BRICK.extents / 2)
    inner, ridge = on.sum(1) == 1, on.sum(1) == 2
    out = np.sign(surface.vertices) * on
    np.testing.assert_allclose(surface.vertex_normals[inner], out[inner], atol=1e-12)
    assert ((surface.vertex_normals * out)[ridge].sum(1) > 1.2).all()  # over the edge; √2 where faces are even
    ball = COARSE.corner_normals  # 20 degrees between its faces: all smooth
    np.testing.assert_allclose(ball, COARSE.vertices[COARSE.faces] / 0.5, atol=0.05)


def test_areas_and_samples_add_up():
    long = Surface.of(shapes.box((1.0, 0.6, 0.4), divisions=0))
    for surface in (Surface.of(BRICK), long):
        assert surface.areas.sum() == pytest.approx(2 * (0.6 + 0.4 + 0.24))
        assert surface.vertex_areas.sum() == pytest.approx(surface.areas.sum())
        points, normals, areas = surface.samples(0.2, np.random.default_rng(0))
        assert areas.sum() == pytest.approx(surface.areas.sum())
        assert len(points) >= 2 * surface.areas.sum() / 0.2**2
        side = np.abs(points) / [0.5, 0.3, 0.2]
        np.testing.assert_allclose(side.max(1), 1)
        assert ((normals * points).sum(1) > 0).all()
        assert (areas * normals.T).sum(1) == pytest.approx([0, 0, 0], abs=0.02)
    assert Surface.of(BRICK).away(long) < 1e-9


# Even triangles.


def cut_box():
    """A box with a square hole through it: genus 1, volume 1 · 0.6 · 0.4 − 0.3² · 0.4."""
    return trimesh.boolean.difference([shapes.box((1, 0.6, 0.4)), shapes.box((0.3, 0.3, 1))], engine="manifold")


def cubes():
    """The sphere of radius 0.5 as marching cubes give it: slivers by the hundred."""
    from skimage.measure import marching_cubes

    axis = np.linspace(-0.55, 0.55, 30)
    field = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - 0.5
    vertices, faces, *_ = marching_cubes(field, 0.0, spacing=(axis[1] - axis[0],) * 3)
    mesh = trimesh.Trimesh(vertices - 0.55, faces)
    mesh.fix_normals()
    return mesh


def torus():
    return trimesh.creation.torus(0.4, 0.15, major_sections=48, minor_sections=24)


REMESHED = {
    "ellipsoid": (lambda: shapes.ellipsoid((0.6, 0.35, 0.2), divisions=3), 1000, 0.003),
    "torus": (torus, 1000, 0.003),
    "cut box": (cut_box, 1200, 1e-9),
    "plate": (lambda: shapes.plate_with_hole((1, 0.6, 0.1), 0.15), 1500, 0.001),
    "marching cubes": (cubes, 1000, 0.003),
    "few large faces": (lambda: shapes.box((1, 0.6, 0.4), divisions=0), 1000, 1e-9),
}


def across(mesh):
    """The two angles across from each edge together [degrees]."""
    ends = mesh.vertices[mesh.face_adjacency_edges]
    total = np.zeros(len(ends))
    for corner in mesh.face_adjacency_unshared.T:
        one, other = (trimesh.unitize(ends[:, k] - mesh.vertices[corner]) for k in (0, 1))
        total += np.degrees(np.arccos((one * other).sum(1)))
    return total


@pytest.mark.parametrize(("make", "count", "near"), REMESHED.values(), ids=REMESHED)
def test_remeshed_is_clean_and_the_same_surface(make, count, near):
    given = make()
    edge = edge_of(given.area, count)
    vertices, faces = remeshed(np.asarray(given.vertices), np.asarray(given.faces), edge)
    made = trimesh.Trimesh(vertices, faces, process=False)
    assert topology(made) == topology(given)
    assert topology(made).closed
    assert made.volume > 0
    assert 0.7 * count < len(faces) < 1.5 * count
    assert not len(self_intersections(made))
    lengths = made.edges_unique_length / edge
    assert lengths.max() < 1.15 * LONG
    assert lengths.min() > 0.45
    assert np.quantile(lengths, 0.05) > 0.65
    assert np.quantile(lengths, 0.95) < 1.3
    angles = np.degrees(made.face_angles.min(1))
    assert np.quantile(angles, 0.01) > 28
    assert angles.min() > 5  # one triangle of the torus is a cap
    smooth = made.face_adjacency_angles < np.radians(40)
    assert (across(made)[smooth] > 180.5).mean() < 0.003  # nearly all edges are Delaunay's
    assert surface_distance(made, given) < near
    flat = near == 1e-9  # all edges are kept: the very same solid in other triangles
    np.testing.assert_allclose(made.extents, given.extents, atol=1e-9 if flat else 0.01)
    assert made.volume == pytest.approx(given.volume, rel=1e-9 if flat else 2e-2)


def test_slivers_were_there():
    for given in (cubes(), shapes.plate_with_hole((1, 0.6, 0.1), 0.15)):
        assert np.degrees(given.face_angles.min()) < 5


# Registration.

FLAT, TALL = np.array([0.6, 0.35, 0.2]), np.array([0.5, 0.3, 0.32])
BALL = shapes.ellipsoid((FLAT + TALL) / 2, divisions=3)


def off(vertices, radii, centre=(0, 0, 0)):
    """Mean and largest distance of points from an ellipsoid, to first order."""
    at = (vertices - np.asarray(centre)) / radii
    apart = np.abs((at**2).sum(1) - 1) / (2 * np.linalg.norm(at / radii, axis=1))
    return apart.mean(), apart.max()


@pytest.fixture(scope="module")
def ball():
    surface, nothing = Surface.of(BALL), np.empty(0, np.int64)
    size = np.ptp(surface.vertices, axis=0).max()
    space = Refined(Lattice.around(surface.vertices, 0.2 * size, 0.05 * size), nothing)
    return Template(surface, nothing, np.empty(0), space, False, least_quality(surface.vertices, surface.faces))


@pytest.fixture(scope="module")
def registration(ball):
    return Registration(ball, (ball.size * np.geomspace(1, 2e-7, 6)).tolist())


def moved(registration, target, **options):
    return registration.template.surface.vertices + registration.rows @ registration.onto(target, **options)


def other_ellipsoid(radii, centre=(0, 0, 0)):
    """An ellipsoid whose triangles run along meridians."""
    mesh = trimesh.creation.uv_sphere(1.0, count=(32, 48))
    mesh.apply_transform(np.diag([*radii, 1.0]))
    mesh.apply_translation(centre)
    return mesh


@pytest.mark.parametrize(
    ("radii", "centre"),
    [(FLAT, (0, 0, 0)), (FLAT, (0.1, -0.15, 0.1)), (1.3 * FLAT, (0, 0, 0)), ([0.3, 0.6, 0.5], (0, 0.1, 0))],
    ids=["another", "beside", "30 % larger", "its longest axis another"],
)
def test_an_ellipsoid_onto_one_triangulated_otherwise(registration, radii, centre):
    mean, largest = off(moved(registration, Surface.of(other_ellipsoid(radii, centre))), radii, centre)
    assert mean < 0.001
    assert largest < 0.003


def test_an_ellipsoid_turned(registration):
    turn = trimesh.transformations.rotation_matrix(np.radians(20), [0, 0, 1])
    target = other_ellipsoid(TALL)
    target.apply_transform(turn)
    mean, largest = off(moved(registration, Surface.of(target)) @ turn[:3, :3], TALL)
    assert mean < 0.001
    assert largest < 0.003


def test_a_target_with_a_hole_and_faces_twice(registration):
    dirty = other_ellipsoid(FLAT)
    centres = dirty.triangles_center
    hole = np.linalg.norm(centres - [0.45, 0.2, 0.07], axis=1) < 0.06
    assert 5 < hole.sum() < 100
    faces = np.concatenate([dirty.faces[~hole], dirty.faces[::50]])
    mean, largest = off(moved(registration, Surface(np.asarray(dirty.vertices), faces)), FLAT)
    assert mean < 0.001
    assert largest < 0.003


def test_what_is_there_already_stays(registration):
    np.testing.assert_allclose(moved(registration, registration.template.surface), BALL.vertices, atol=1e-6)


def bent(vertices, by):
    return vertices + by * vertices[:, :1] ** 2 * [0, 0, 1]


def test_a_bent_ellipsoid_in_any_unit(registration, ball):
    target = Surface.of(other_ellipsoid(FLAT))
    target = Surface(bent(target.vertices, 0.3), target.faces)
    found = moved(registration, target)
    mean, largest = off(bent(found, -0.3), FLAT)
    assert mean < 0.001
    assert largest < 0.003
    lattice = ball.space.coarse
    grown = Surface(1000 * ball.surface.vertices, ball.surface.faces)
    space = Refined(Lattice(1000 * lattice.low, 1000 * lattice.cell, lattice.spans), ball.space.chosen)
    large = Registration(replace(ball, surface=grown, space=space), [1000 * s for s in registration.stiffness])
    again = moved(large, Surface(1000 * target.vertices, target.faces)) / 1000
    np.testing.assert_allclose(again, found, atol=2e-4)  # where two places are as near, rounding chooses


def test_stiffer_follows_less(registration, ball):
    target = Surface.of(other_ellipsoid(FLAT))
    target = Surface(bent(target.vertices, 0.3), target.faces)
    stiff = moved(Registration(ball, [ball.size]), target)
    assert off(bent(stiff, -0.3), FLAT)[0] > 0.01


# Detail and symmetry.


def test_detail_reaches_bumps_along_the_normals():
    def bumpy(mesh):
        x, _, z = mesh.vertices.T
        wave = 1 + 0.012 * np.cos(24 * x) * np.cos(24 * z) / np.linalg.norm(mesh.vertices, axis=1)
        return trimesh.Trimesh(mesh.vertices * wave[:, None], mesh.faces, process=False)

    ball, rough = shapes.ellipsoid(TALL, divisions=4), bumpy(shapes.ellipsoid(TALL, divisions=5))
    along = Detail(Surface.of(ball), 0.02).onto(Surface.of(rough), np.array(ball.vertices))
    made = trimesh.Trimesh(ball.vertices + along[:, None] * ball.vertex_normals, ball.faces, process=False)
    assert surface_distance(made, rough) < surface_distance(ball, rough) / 5


def test_half_a_shape_and_its_image():
    mesh = trimesh.creation.torus(0.4, 0.15)
    mesh.apply_translation([0.3, 0.1, 0.0])
    vertices, faces, twins, plane = mirrored_half(np.array(mesh.vertices), np.array(mesh.faces), 0, 0.01)
    made = trimesh.Trimesh(vertices, faces, process=False)
    assert plane == pytest.approx([0, 0.3])
    assert topology(made) == topology(mesh)
    assert made.volume == pytest.approx(mesh.volume, rel=1e-3)
    assert surface_distance(made, mesh) < 1e-3
    assert (vertices[: len(vertices) - len(twins), 0] >= 0.3).all()


# Whether a design is sound.


def checks(template, weights, vertices=None):
    made = template.moved(weights) if vertices is None else vertices
    return {check.name: check for check in health_checks(template, weights, made)}


def test_what_does_not_move_is_sound(ball):
    found = checks(ball, np.zeros(ball.count))
    assert all(check.passed for check in found.values())
    assert {name: check.value for name, check in found.items()} == {
        "jacobian": 1, "flipped": 0, "crossing": 0, "quality": 1
    }  # fmt: skip


def test_a_motion_that_folds(ball):
    """x → x − 0.9 x² turns back at x = 5 / 9: its derivative is 1 − 1.8 x."""
    lattice = ball.space.coarse
    weights = np.zeros((ball.space.size, 3))
    weights[:, 0] = -0.9 * (lattice.nodes[:, 0] ** 2 - lattice.cell**2 / 3)
    larger = replace(ball, surface=Surface(ball.surface.vertices * [1.1, 1, 1], ball.surface.faces))
    x = larger.surface.vertices[larger.surface.faces].mean(1)[:, 0]
    found = checks(larger, weights.ravel())
    assert found["jacobian"].value == pytest.approx(1 - 1.8 * x.max(), abs=1e-9)
    assert found["jacobian"].value < 0 < LEAST
    assert not found["jacobian"].passed
    assert found["flipped"].passed  # faces turn over as space does
    matrices = gradients(larger, weights.ravel(), larger.surface.vertices)
    np.testing.assert_allclose(matrices[:, 0, 0], 1 - 1.8 * larger.surface.vertices[:, 0], atol=1e-9)


def test_a_template_pushed_through_itself(ball):
    detailed = replace(ball, detailed=True)
    x, y, z = ball.surface.vertices.T
    push = -0.9 * np.exp(-(x**2 + y**2) / 0.04) * (z > 0)
    found = checks(detailed, np.concatenate([np.zeros(ball.count), push]))
    assert found["jacobian"].value == 1
    assert found["crossing"].value > 10
    assert not found["crossing"].passed


def test_a_vertex_pulled_over_its_neighbours(ball):
    vertices = ball.surface.vertices.copy()
    vertices[0] += 5 * (vertices[ball.surface.faces[(ball.surface.faces == 0).any(1)][0]].mean(0) - vertices[0])
    found = checks(ball, np.zeros(ball.count), vertices)
    moved = Surface(vertices, ball.surface.faces)
    over = (moved.normals * ball.surface.normals).sum(1) < 0
    assert found["flipped"].value == pytest.approx(moved.areas[over].sum() / moved.areas.sum())
    assert 0 < over.sum() < 7
    assert not found["flipped"].passed
    assert f"{over.sum()} faces" in found["flipped"].note


def test_triangles_squashed(ball):
    squash = (np.zeros((ball.space.size, 3)) - [0, 0, 0.9]) * ball.space.coarse.nodes
    found = checks(ball, squash.ravel())
    assert found["jacobian"].value == pytest.approx(0.1)
    assert found["jacobian"].passed
    assert found["quality"].value < 0.4
    assert not found["quality"].passed
    assert found["crossing"].passed


def test_pairs_that_face_away_from_each_other_do_not_count():
    """Weights of pairs whose normals are at 0, 60 and 180 degrees: in full, in part, not at all."""
    normals = np.array([[0, 0, 1.0]] * 3)
    facing = np.array([[0, 0, 1.0], [0, np.sqrt(0.75), 0.5], [0, 0, -1.0]])
    way = _Way.of(eye_array(3, format="csr"), np.zeros((3, 3)), facing, normals, normals, np.full(3, 2.0))
    part = (0.5 - AGREE[0]) / (AGREE[1] - AGREE[0])
    assert way.weights == pytest.approx(np.array([1, part, 0]) / 3)
    assert 0 < part < 1
    assert way.gaps == pytest.approx([1, 1, 1])
    assert way.pull()[2] == pytest.approx([0, 0, 0])
