"""Fields to meshes: closed forms, the dense grid as reference, and a count of what was evaluated."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.chain import Chain
from lampopt.decode import NarrowBand, decode, decoding, field_to_mesh, field_to_mesh_dense
from lampopt.errors import EmptyMesh, InputError, PluginError
from lampopt.testing import shapes
from lampopt.topology import topology
from lampopt.types import Bank, Frame, Parameter, Spec

BOX = np.array([[-1.0] * 3, [1.0] * 3])
LONG = np.array([[-1.3, -0.5, -0.4], [1.0, 0.55, 0.5]])  # no side is a multiple of a cell
MESHERS = pytest.mark.parametrize("mesher", [field_to_mesh, field_to_mesh_dense])


def ball(centre=(0.0, 0.0, 0.0), radius=0.5):
    return lambda p: np.linalg.norm(p - np.asarray(centre), axis=1) - radius


def block(centre, half):
    def field(p):
        q = np.abs(p - np.asarray(centre)) - half
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    return field


def torus(major=0.5, minor=0.2):
    return lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - major, p[:, 2]) - minor


def union(*fields):
    return lambda p: np.min([f(p) for f in fields], 0)


def waves(seed, frequency=6.0):
    """A sum of sines, slope at most 1: many bodies, handles and saddles."""
    draw = np.random.default_rng(seed)
    k, phase, size = draw.normal(0, frequency, (8, 3)), draw.uniform(0, 6, 8), draw.normal(size=8)
    size /= (np.abs(size) * np.linalg.norm(k, axis=1)).sum()
    return lambda p: np.sin(p @ k.T + phase) @ size


FIELDS = {
    "sphere": (ball((0.03, 0.01, -0.02)), BOX),
    "torus": (torus(), BOX),
    "thin plate": (block((0.011, 0.02, 0.003), (0.6, 0.4, 0.06)), BOX),
    "two very different": (union(ball((-0.3, 0, 0)), ball((0.61, 0.53, 0.57), 0.07)), BOX),
    "hollow": (lambda p: np.abs(np.linalg.norm(p, axis=1) - 0.5) - 0.1, BOX),
    "steep": (lambda p: 40 * ball()(p), BOX),
    "steep at the surface alone": (lambda p: np.tanh(20 * ball()(p)), BOX),
    "steep inside alone": (lambda p: np.where(ball()(p) < 0, 30, 1) * ball()(p), BOX),
    "gentle": (lambda p: 0.2 * ball()(p), BOX),
    "cut by the box": (ball((0.7, 0, 0)), BOX),
    "cut by a corner": (ball((1, 1, 1), 0.7), BOX),
    "long box": (ball((0.1, 0, 0.05), 0.3), LONG),
    "long box, cut": (block((0, 0, 0), (2, 0.2, 0.25)), LONG),
    "waves": (waves(1, 4), BOX),
}


def apart(a, b):
    """The largest distance of a vertex or face centre of either mesh to the other's surface."""

    def one(a, b):
        points = np.concatenate([np.asarray(a.vertices), np.asarray(a.triangles_center)])
        return igl.point_mesh_squared_distance(points, np.asarray(b.vertices), np.asarray(b.faces, np.int64))[0].max()

    return float(np.sqrt(max(one(a, b), one(b, a))))


def nodes(bounds, resolution):
    pitch = (bounds[1] - bounds[0]).max() / resolution
    axes = [low + pitch * np.arange(int((high - low) / pitch + 1e-9) + 1) for low, high in bounds.T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), pitch


def is_where_the_field_says(mesh, field, bounds, resolution):
    """Whether nodes of the grid lie on the side of the surface that the field's sign tells, the box's hull out.

    The winding number is 1 inside an outward surface, 0 outside, so this also says that no wall is missing, doubled or
    turned round.
    """
    points, pitch = nodes(bounds, resolution)
    inner = (np.minimum(points - bounds[0], bounds[1] - points) > 0.6 * pitch).all(1)
    points = points[inner]
    values = field(points)
    close = np.argsort(np.abs(values))[: len(values) // 2]  # the half nearest to the surface, or so
    chosen = np.random.default_rng(0).permutation(close)[:3000]
    points, values = points[chosen], values[chosen]
    turns = igl.winding_number(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), points)
    clear = np.abs(values) > 2e-3 * pitch
    return bool((np.abs(turns - (values < 0))[clear] < 1e-6).all())


def counted(field):
    count = [0]

    def counting(points):
        count[0] += len(points)
        return field(points)

    return counting, count


@pytest.mark.parametrize("resolution", [21, 32])
@pytest.mark.parametrize("name", FIELDS)
def test_sparse_is_dense(name, resolution):
    field, bounds = FIELDS[name]
    pitch = (bounds[1] - bounds[0]).max() / resolution
    sparse, dense = (mesher(field, bounds, resolution) for mesher in (field_to_mesh, field_to_mesh_dense))
    assert topology(sparse).closed
    assert topology(sparse) == topology(dense)
    assert sparse.is_winding_consistent
    assert is_where_the_field_says(sparse, field, bounds, resolution)
    assert sparse.volume == pytest.approx(dense.volume, abs=2e-2 * pitch * dense.area)
    assert apart(sparse, dense) < 0.25 * pitch
    assert (sparse.bounds[0] >= bounds[0]).all()
    assert (sparse.bounds[1] <= bounds[1]).all()


@MESHERS
@pytest.mark.parametrize("resolution", [24, 40, 64])
def test_sphere(mesher, resolution):
    radius, mesh = 0.7, mesher(ball((0.05, -0.02, 0.01), 0.7), BOX, resolution)
    pitch = 2 / resolution
    off = np.linalg.norm(np.asarray(mesh.vertices) - [0.05, -0.02, 0.01], axis=1) - radius
    # along an edge of length h the distance is at most h²/2r from straight, so its zero is off by at most h²/8r
    # over the least slope met there
    assert np.abs(off).max() < 0.5 * pitch**2 / radius
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=(pitch / radius) ** 2)
    assert mesh.area == pytest.approx(4 * np.pi * radius**2, rel=(pitch / radius) ** 2)
    assert (topology(mesh).bodies, topology(mesh).genus) == (1, 0)


@MESHERS
def test_torus_has_one_handle(mesher):
    mesh = mesher(torus(0.55, 0.2), BOX, 56)
    assert (topology(mesh).bodies, topology(mesh).genus) == (1, 1)
    assert mesh.volume == pytest.approx(2 * np.pi**2 * 0.55 * 0.2**2, rel=0.01)


@MESHERS
def test_plate_thinner_than_a_coarse_cell_keeps_its_sizes(mesher):
    half = np.array([0.61, 0.43, 0.02])  # 0.04 thick; a coarse cell is 0.0625
    mesh = mesher(block((0.011, 0.02, 0.003), half), BOX, 96)
    assert (topology(mesh).bodies, topology(mesh).genus) == (1, 0)
    assert mesh.extents == pytest.approx(2 * half, abs=0.2 * 2 / 96)
    assert mesh.volume == pytest.approx(8 * half.prod(), rel=0.05)


@MESHERS
@pytest.mark.parametrize("factor", [1.0, 7.0, 40.0, 1000.0])
def test_a_factor_on_the_field_changes_nothing(mesher, factor):
    # linear interpolation between nodes has the same zero for f and c·f; depth must not be bent by the box's walls
    plain, scaled = (mesher(lambda p, c=c: c * ball((0.1, 0, 0))(p), BOX, 40) for c in (1.0, factor))
    assert scaled.volume == pytest.approx(plain.volume, rel=1e-4)
    assert apart(plain, scaled) < 2e-3 * 2 / 40  # values within a thousandth of a cell are moved off zero


@MESHERS
@pytest.mark.parametrize("resolution", [32, 50])
def test_a_half_space_is_closed_at_the_box(mesher, resolution):
    pitch = 2 / resolution
    mesh = mesher(lambda p: p[:, 0] - 0.303, BOX, resolution)
    # closed half a cell inside the box; rims lose what marching cubes cuts off an edge, at most half a cell² along it
    exact = (1.303 - pitch / 2) * (2 - pitch) ** 2
    assert topology(mesh).closed
    assert mesh.extents == pytest.approx([1.303 - pitch / 2, 2 - pitch, 2 - pitch], abs=1e-6)
    assert exact - 0.5 * pitch**2 * 4 * (mesh.extents.sum()) <= mesh.volume <= exact + 1e-9


@MESHERS
def test_a_sphere_cut_by_the_box_is_a_cap_less(mesher):
    resolution = 64
    edge, radius, centre = 1 - 1 / resolution, 0.5, 0.7
    cap = radius - (edge - centre)  # its height
    exact = 4 / 3 * np.pi * radius**3 - np.pi * cap**2 * (3 * radius - cap) / 3
    mesh = mesher(ball((centre, 0, 0), radius), BOX, resolution)
    assert topology(mesh).closed
    assert mesh.bounds[1, 0] == pytest.approx(edge)
    assert mesh.volume == pytest.approx(exact, rel=0.005)


@MESHERS
def test_a_box_full_of_solid_is_the_box(mesher):
    mesh = mesher(lambda p: np.full(len(p), -5.0), LONG, 40)
    pitch = 2.3 / 40
    assert topology(mesh) == topology(shapes.box())
    assert mesh.extents == pytest.approx(LONG[1] - LONG[0] - pitch)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), resolution=st.integers(5, 24), frequency=st.floats(2, 15))
def test_ambiguous_cells_leave_no_seam(seed, resolution, frequency):
    field = waves(seed, frequency)
    values = field(nodes(BOX, resolution)[0])
    mesh = field_to_mesh(field, BOX, resolution) if values.min() < 0 else None
    if mesh is not None:
        assert topology(mesh).closed
        assert is_where_the_field_says(mesh, field, BOX, resolution)


@pytest.mark.parametrize("seed", range(4))
def test_noise_leaves_no_seam(seed):
    # every cell is as likely to be ambiguous as can be
    noise = np.random.default_rng(seed).normal(size=(14, 14, 14))

    def field(p):
        at = np.round((p + 1) * 6.5).astype(int)
        return 0.05 * noise[at[:, 0], at[:, 1], at[:, 2]]

    mesh = field_to_mesh(field, BOX, 13)
    assert topology(mesh).closed
    assert is_where_the_field_says(mesh, field, BOX, 13)


@settings(max_examples=25, deadline=None)
@given(
    centre=st.tuples(*[st.floats(-0.9, 0.9)] * 3).filter(lambda c: np.linalg.norm(c) > 0.4),
    radius=st.floats(0.015, 0.03),
    factor=st.floats(0.2, 10),
)
def test_a_lump_between_the_nodes_of_the_coarse_lattice_is_found(centre, radius, factor):
    # 32 coarse cells of 0.0625: a lump 0.03 to 0.06 wide fits between their nodes, and no node need lie in it. That
    # holds for distances and what is proportional to them; a lump alone much steeper than all else may be passed over
    both = union(ball(radius=0.3), ball(centre, radius))
    mesh = field_to_mesh(lambda p: factor * both(p), BOX, 128)
    assert topology(mesh).bodies == 2
    small = min(mesh.split(only_watertight=True), key=lambda m: m.volume)
    assert small.centroid == pytest.approx(centre, abs=1 / 128)


def test_a_lump_alone_in_the_box_is_found():
    centre = np.array([0.03125, 0.03125, 0.03125]) * 9  # in the middle of a coarse cell
    mesh = field_to_mesh(ball(centre, 0.02), BOX, 256)
    assert topology(mesh).bodies == 1
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.15)


@pytest.mark.parametrize(("off", "steep"), [(0.0, 5), (0.008, 5), (0.02, 20)])
def test_a_spot_steeper_than_was_seen_leaves_no_hole(off, steep):
    # in the middle of a coarse cell, `off` the surface, the field rises much faster than at any node of the lattice;
    # the zeros are the sphere's
    spot = -1 + 0.0625 * (np.array([27, 18, 15]) + 0.5)
    sphere = ball(radius=float(np.linalg.norm(spot)) - off)

    def field(p):
        return sphere(p) * (1 + steep * np.exp(-((p - spot) ** 2).sum(1) / 0.012**2))

    mesh = field_to_mesh(field, BOX, 128)
    assert topology(mesh) == topology(shapes.ellipsoid())
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (np.linalg.norm(spot) - off) ** 3, rel=1e-3)


@pytest.mark.parametrize("alone", [True, False])
def test_a_body_that_a_coarse_node_has_seen_is_not_lost(alone):
    # a node of the coarse lattice lies in it, but the middles of the eight cells about it are all far too high
    node = -1 + 0.0625 * np.array([25, 20, 18])
    spots = node + 0.03125 * (2 * np.array(list(np.ndindex(2, 2, 2))) - 1)
    small, large = ball(node, 0.045), ball((-0.4, -0.4, -0.4), 0.3)

    def field(p):
        near = np.exp(-((p[:, None] - spots) ** 2).sum(-1) / 0.012**2).sum(1)
        return small(p) * (1 + 50 * near) if alone else np.minimum(small(p) * (1 + 50 * near), large(p))

    mesh = field_to_mesh(field, BOX, 128)
    assert topology(mesh).closed
    assert topology(mesh).bodies == 2 - alone
    part = max(mesh.split(only_watertight=True), key=lambda m: m.centroid[0])
    assert part.volume == pytest.approx(4 / 3 * np.pi * 0.045**3, rel=0.1)


@pytest.mark.parametrize(("resolution", "share"), [(96, 0.15), (128, 0.1), (256, 0.05)])
@pytest.mark.parametrize("name", ["sphere", "torus", "thin plate", "two very different", "steep"])
def test_few_points_are_evaluated(name, resolution, share):
    field, bounds = FIELDS[name]
    counting, count = counted(field)
    field_to_mesh(counting, bounds, resolution)
    assert count[0] < share * (resolution + 1) ** 3


def test_the_work_grows_with_the_surface_not_with_the_volume():
    work = []
    for resolution in (128, 256):
        counting, count = counted(ball())
        field_to_mesh(counting, BOX, resolution)
        work.append(count[0])
    assert work[1] / work[0] < 5  # 4 for a surface, 8 for a volume


# One field after another


def same(a, b):
    """Whether two meshes are one: rounding may differ where points are grouped otherwise."""
    return np.array_equal(a.faces, b.faces) and np.allclose(a.vertices, b.vertices, atol=1e-9)


def moved(field, by):
    return lambda p: field(p - np.asarray(by))


@pytest.mark.parametrize("resolution", [21, 64])
@pytest.mark.parametrize("name", FIELDS)
def test_a_band_makes_the_meshes_that_are_made_alone(name, resolution):
    field, bounds = FIELDS[name]
    band = NarrowBand(bounds, resolution)
    pitch = (bounds[1] - bounds[0]).max() / resolution
    for cells in (0, 0.1, 0.15, 0.3, 0.9, 0.85, 4.0, 4.1, 4.2, 0):
        other = moved(field, (cells * pitch, -0.3 * cells * pitch, 0.1 * cells * pitch))
        assert same(band.mesh(other), field_to_mesh(other, bounds, resolution))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), steps=st.lists(st.floats(-0.05, 0.05), min_size=3, max_size=6))
def test_a_band_follows_any_way(seed, steps):
    one, other = waves(seed, 5.0), waves(seed + 1, 5.0)
    band, at = NarrowBand(BOX, 40), 0.0
    for step in steps:
        at += step

        def field(p, at=at):
            return one(p) + at * other(p)

        assert same(band.mesh(field), field_to_mesh(field, BOX, 40))


@settings(max_examples=20, deadline=None)
@given(
    centre=st.tuples(*[st.floats(-0.9, 0.9)] * 3).filter(lambda c: np.linalg.norm(c) > 0.5),
    radius=st.floats(0.015, 0.15),
)
def test_a_band_sees_what_comes_up_far_away_and_goes_again(centre, radius):
    band, alone = NarrowBand(BOX, 128), ball(radius=0.3)
    for _ in range(3):
        band.mesh(alone)
    assert topology(band.mesh(union(alone, ball(centre, radius)))).bodies == 2
    assert topology(band.mesh(alone)).bodies == 1


def test_a_band_sees_what_comes_up_between_two_bodies():
    # in a gap, in the middle of a coarse cell: its corners see next to nothing of it
    middle = np.array([0.03125, 0.03125, 0.03125])
    gap = union(*(block(middle + np.array([side * 0.23, 0, 0]), (0.2, 0.3, 0.3)) for side in (-1, 1)))
    band = NarrowBand(BOX, 128)
    for _ in range(3):
        assert topology(band.mesh(gap)).bodies == 2
    assert topology(band.mesh(union(gap, ball(middle, 0.0149)))).bodies == 3


@pytest.mark.parametrize("radius", [0.02, 0.03])
def test_a_band_sees_what_comes_up_between_the_nodes_of_the_coarse_lattice(radius):
    centre = np.array([0.65625, 0.65625, 0.65625])  # in the middle of a coarse cell, 0.054 from its corners
    band = NarrowBand(BOX, 128)
    for _ in range(3):
        band.mesh(ball(radius=0.3))
    assert topology(band.mesh(union(ball(radius=0.3), ball(centre, radius)))).bodies == 2


def test_a_band_follows_a_surface_that_leaves_every_cell_it_crossed():
    pitch, band = 2 / 64, NarrowBand(BOX, 64)
    for cells in (0.0, 0.02, 0.04, 0.3):  # all faces from one cell into the next at once
        field = block((0, 0, 0), (np.array([10.8, 8.8, 6.8]) + cells) * pitch)
        assert same(band.mesh(field), field_to_mesh(field, BOX, 64))


def laid(field, resolution):
    """A band laid around `field`."""
    band = NarrowBand(BOX, resolution)
    for _ in range(2):
        band.mesh(field)
    assert band._seen.band is not None
    return band


def lacking(band, gone):
    """That band without the cells whose x lies where `gone` says, as if it had been misled there."""
    seen, own = band._seen, band._seen.band
    left = ~gone(BOX[0, 0] + own.cells[:, 0] * own.look.lattice.pitch)
    band._seen = replace(seen, band=replace(own, cells=own.cells[left], low=own.low[left], high=own.high[left]))
    return band


def test_what_a_band_lacks_is_searched_for():
    both = union(ball((-0.4, 0, 0), 0.3), ball((0.5, 0, 0), 0.2))
    band = lacking(laid(both, 64), lambda x: x > 0.1)
    assert same(band.mesh(both), field_to_mesh(both, BOX, 64))


def test_what_a_band_lacks_of_a_surface_is_run_on_into_and_does_not_show():
    field = ball((0, 0, 0), 0.5)
    band = lacking(laid(field, 64), lambda x: np.abs(x - 0.031) < 0.016)  # a slice thinner than a coarse cell
    assert same(band.mesh(field), field_to_mesh(field, BOX, 64))


def test_no_band_is_laid_where_the_slope_that_was_seen_left_something_out():
    spot = -1 + 0.0625 * (np.array([27, 18, 15]) + 0.5)  # as in the test of a spot steeper than was seen
    sphere = ball(radius=float(np.linalg.norm(spot)))
    band = NarrowBand(BOX, 128)
    for _ in range(3):
        band.mesh(lambda p: sphere(p) * (1 + 20 * np.exp(-((p - spot) ** 2).sum(1) / 0.012**2)))
    assert band._seen.band is None


def test_a_part_that_the_coarse_lattice_saw_is_not_lost_to_a_slope_that_it_did_not(caplog):
    caplog.set_level("INFO", logger="lampopt")
    far = union(ball((-0.4, 0.013, 0.007), 0.3), block([0.53125] * 3, [0.04] * 3))
    band = NarrowBand(BOX, 128)
    mesh = band.mesh(lambda p: np.clip(1e5 * far(p), -1, 1))  # a step: its slope shows nowhere on the coarse lattice
    assert topology(mesh).bodies == 2
    assert "the field is steeper than was seen at first: slope bound raised to 80" in caplog.text
    assert band._seen.look.slope == pytest.approx(80)  # what was found out is kept


def test_threads_may_share_a_band():
    fields = [moved(FIELDS[name][0], (0.002 * k, 0, 0)) for name in ("sphere", "torus") for k in range(8)]
    band = NarrowBand(BOX, 48)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(band.mesh, fields))
    assert all(same(mesh, field_to_mesh(field, BOX, 48)) for mesh, field in zip(found, fields, strict=True))


@pytest.mark.parametrize("name", ["sphere", "torus", "thin plate", "two very different"])
def test_near_the_last_field_few_points_are_evaluated(name):
    field, bounds = FIELDS[name]
    band, work = NarrowBand(bounds, 256), []
    for k in range(6):
        counting, count = counted(moved(field, (0.1 * k / 256, 0, 0)))
        band.mesh(counting)
        work.append(count[0])
    assert max(work[2:]) < 0.6 * work[0]


def test_a_band_outlives_a_field_without_surface():
    band = NarrowBand(BOX, 40)
    for _ in range(3):
        band.mesh(ball())
    with pytest.raises(EmptyMesh, match="does not change sign"):
        band.mesh(lambda p: 1 + ball()(p))
    with pytest.raises(EmptyMesh, match="not finite"):
        band.mesh(lambda p: np.full(len(p), np.nan))
    assert same(band.mesh(ball(radius=0.49)), field_to_mesh(ball(radius=0.49), BOX, 40))


def test_bands_differ_by_what_they_saw_but_not_in_what_they_make():
    # Two ways to one field, one of which lays a band around another
    target = moved(FIELDS["torus"][0], (0.001, 0, 0))
    one, other = NarrowBand(BOX, 64), NarrowBand(BOX, 64)
    for k in range(4):
        one.mesh(moved(FIELDS["torus"][0], (0.002 * k, 0, 0)))
        other.mesh(moved(FIELDS["sphere"][0], (0, 0.003 * k, 0)))
    assert same(one.mesh(target), other.mesh(target))


@MESHERS
def test_points_outside_the_box_are_never_asked_for(mesher):
    seen = []
    mesher(lambda p: seen.append((p.min(0), p.max(0))) or ball((0.1, 0, 0), 0.3)(p), LONG, 37)
    assert (np.min([low for low, _ in seen], 0) >= LONG[0]).all()
    assert (np.max([high for _, high in seen], 0) <= LONG[1]).all()


@MESHERS
def test_no_sliver_where_the_surface_passes_through_nodes(mesher):
    mesh = mesher(block((0, 0, 0), (0.5, 0.25, 0.75)), BOX, 32)  # all six faces on planes of nodes
    assert topology(mesh) == topology(shapes.box())
    assert mesh.area_faces.min() > 0
    assert mesh.extents == pytest.approx([1.0, 0.5, 1.5], abs=1e-3)


def test_meshes_repeat_to_the_bit():
    a, b = (field_to_mesh(FIELDS["waves"][0], BOX, 30) for _ in range(2))
    assert np.array_equal(a.vertices, b.vertices)
    assert np.array_equal(a.faces, b.faces)


@MESHERS
@pytest.mark.parametrize("value", [1.0, 1e-6, 0.0])
def test_a_field_without_inside_is_empty(mesher, value):
    with pytest.raises(EmptyMesh, match="does not change sign"):
        mesher(lambda p: np.full(len(p), value), BOX, 16)


@MESHERS
def test_a_body_outside_the_box_is_empty(mesher):
    with pytest.raises(EmptyMesh):
        mesher(ball((2, 2, 2)), BOX, 20)


@MESHERS
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(mesher, bad):
    with pytest.raises(EmptyMesh, match="finite"):
        mesher(lambda p: np.where(p[:, 0] > 0.4, bad, ball()(p)), BOX, 16)


@MESHERS
def test_one_value_a_point_is_asked_for(mesher):
    with pytest.raises(InputError, match=r"one value for each of \d+ points, got \d+"):
        mesher(lambda p: ball()(p)[:-1], BOX, 16)
    with pytest.raises(InputError, match=r"one value for each of \d+ points, got \d+"):
        mesher(lambda p: p, BOX, 16)
    assert mesher(lambda p: ball()(p)[:, None], BOX, 16).is_watertight


@MESHERS
@pytest.mark.parametrize(
    "bounds",
    [BOX[0], BOX[::-1], BOX * np.nan, BOX * np.inf, np.array([[0, 0, 0], [1, 1, 0]]), np.zeros((3, 2))],
    ids=["flat", "turned", "nan", "infinite", "without height", "transposed"],
)
def test_bad_bounds(mesher, bounds):
    with pytest.raises(InputError, match=r"bounds: expected \(2, 3\)"):
        mesher(ball(), bounds, 16)


@MESHERS
@pytest.mark.parametrize("resolution", [-1, 0, 3, 4097])
def test_bad_resolution(mesher, resolution):
    with pytest.raises(InputError, match=f"resolution: expected 4 to 4096 cells along the box, got {resolution}"):
        mesher(ball(), BOX, resolution)


class Ball:
    """A decoder whose one weight is a radius."""

    bounds = BOX

    def decode(self, shared, weights, *, resolution):
        return field_to_mesh(ball(shared["centre"], float(weights[0])), BOX, resolution)


class FollowedBall(Ball):
    """The same, one after another; `asked` counts the points."""

    def __init__(self):
        self.asked = []

    def follow(self, shared, *, resolution):
        band = NarrowBand(BOX, resolution)

        def made(weights):
            field, count = counted(ball(shared["centre"], float(weights[0])))
            self.asked.append(count)
            return band.mesh(field)

        return made


def balls():
    frame = Frame(0.001, np.array([1000.0, 2000.0, 0.0]), "mm")
    return Bank(
        (Parameter("r", "mm", 300.0, 500.0),), np.array([[300.0], [500.0]]), (), np.empty((2, 0)), ("a", "b"),
        np.array([[0.3], [0.5]], np.float32), {"centre": np.array([0.1, 0, 0])}, frame, Spec("ball"),
        np.zeros((1, 3)), np.zeros((2, 1, 1)), np.zeros(2),
    )  # fmt: skip


def test_decode_answers_in_the_users_unit_and_place():
    bank = balls()
    mesh = decode(bank, Ball(), np.array([0.4], np.float32), resolution=64)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.units == "mm"
    assert mesh.bounds == pytest.approx(np.array([[700, 1600, -400], [1500, 2400, 400]]), abs=2)
    with pytest.raises(InputError, match=r"weights: expected shape \(1,\), got \(2,\)"):
        decode(bank, Ball(), np.ones(2, np.float32))
    with pytest.raises(EmptyMesh):
        decode(bank, Ball(), np.array([-0.4], np.float32))


@pytest.mark.parametrize("decoder", [Ball(), FollowedBall()])
def test_decoding_makes_what_decode_makes_one_after_another(decoder):
    bank = balls()
    made = decoding(bank, decoder, resolution=64)
    for radius in (0.4, 0.401, 0.402, 0.403, 0.5):
        weights = np.array([radius], np.float32)
        found = made(weights)
        assert found.units == "mm"
        assert same(found, decode(bank, decoder, weights, resolution=64))
    with pytest.raises(InputError, match=r"weights: expected shape \(1,\), got \(2,\)"):
        made(np.ones(2, np.float32))
    with pytest.raises(EmptyMesh):
        made(np.array([-0.4], np.float32))


def test_a_search_follows_its_designs():
    decoder = FollowedBall()
    chain = Chain(balls(), decoder, 128)
    for share in (0.5, 0.499, 0.498, 0.497):
        mesh = chain.mesh(np.array([share, 1 - share]))
        assert mesh.extents == pytest.approx([2000 * (0.5 - 0.2 * share)] * 3, abs=1)
    work = [count[0] for count in decoder.asked]
    assert max(work[2:]) < 0.7 * work[0]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda weights: None, "decode: expected a trimesh.Trimesh, got None"),
        (None, "follow: expected a function of weights, got None"),
    ],
)
def test_garbage_from_what_follows_is_named(answer, message):
    class Odd(Ball):
        def follow(self, shared, *, resolution):
            return answer

    with pytest.raises(PluginError, match=f"decoder 'ball': {message}"):
        decoding(balls(), Odd())(np.array([0.4], np.float32))


@dataclass(frozen=True)
class Returns:
    answer: object

    def decode(self, shared, weights, *, resolution):
        return self.answer


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "expected a trimesh.Trimesh, got None"),
        ((np.zeros((3, 3)), [[0, 1, 2]]), "expected a trimesh.Trimesh, got "),
        (trimesh.Trimesh(np.eye(3), [[0, 1, 7]], process=False), "corners are 0 to 2, got 0 to 7"),
        (trimesh.Trimesh(np.eye(3), [[0, 1, -1]], process=False), "corners are 0 to 2, got -1 to 1"),
    ],
)
def test_garbage_from_a_decoder_is_named(answer, message):
    bank = Bank(
        (Parameter("r", "m", 0.3, 0.5),), np.array([[0.3], [0.5]]), (), np.empty((2, 0)), ("a", "b"),
        np.array([[0.3], [0.5]], np.float32), {}, Frame(1.0, np.zeros(3)), Spec("odd"),
        np.zeros((1, 3)), np.zeros((2, 1, 1)), np.zeros(2),
    )  # fmt: skip
    with pytest.raises(PluginError, match=f"decoder 'odd': decode: .*{message}"):
        decode(bank, Returns(answer), np.array([0.4], np.float32))
