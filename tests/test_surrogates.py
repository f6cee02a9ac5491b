"""Learned measures: clouds against closed forms, gradients against differences, coverage and range on shapes apart."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.plugins import Plugins
from lampopt.protocols import CrossValidated, Gradient, Interval, Measure, State
from lampopt.testing import report, shapes, surrogate_checks
from lampopt_families.bwb import HIGH as BWB_HIGH
from lampopt_families.bwb import LOW as BWB_LOW
from lampopt_families.bwb import bwb_mesh
from lampopt_families.car import HIGH as CAR_HIGH
from lampopt_families.car import LOW as CAR_LOW
from lampopt_families.car import car_mesh
from lampopt_pointnet.cloud import SIDE, Cut
from lampopt_pointnet.conformal import Region
from lampopt_pointnet.learned import Learned
from lampopt_pointnet.pooled import PointNet, Waves
from lampopt_pointnet.regression import kernel_ridge, lasso, lasso_path
from lampopt_pointnet.surrogates import FourierRidge, PointNetLasso

KINDS = (PointNetLasso.example(), FourierRidge.example())
NAMES, UNITS = ("length", "width", "volume"), ("L", "L", "L^3")
LOW, HIGH = np.array([0.8, 0.3, 0.3]), np.array([1.4, 0.6, 0.5])
both = pytest.mark.parametrize("learned", [0, 1], ids=["pointnet-lasso", "fourier-ridge"], indirect=True)


def boxes(count, seed, factor=1.0):
    """Boxes and their length, width, volume, sides drawn from the range widened by `factor`."""
    sides = (LOW + HIGH) / 2 + factor * (HIGH - LOW) / 2 * np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return [shapes.box(s, divisions=1) for s in sides], np.column_stack([sides[:, :2], sides.prod(axis=1)])


@pytest.fixture(scope="module")
def measures():
    meshes, values = boxes(60, 1)
    values[::4, 1] = np.nan
    return [kind.fit(meshes, values, NAMES, UNITS, seed=3) for kind in KINDS]


@pytest.fixture
def learned(request, measures):
    return measures[request.param]


def scaled(mesh, by):
    return trimesh.Trimesh(np.asarray(mesh.vertices) * by, mesh.faces, process=False)


def listed_otherwise(mesh, seed=0):
    """The same faces in another order, vertices numbered anew."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    faces = np.argsort(order)[np.asarray(mesh.faces)][rng.permutation(len(mesh.faces))]
    return trimesh.Trimesh(np.asarray(mesh.vertices)[order], faces, process=False)


@surrogate_checks(*KINDS)
def test_conformance(check):
    check()


def test_they_come_in_by_the_front_door():
    plugins = Plugins.load()
    assert plugins.make("surrogate", "pointnet-lasso") == PointNetLasso()
    assert plugins.make("surrogate", "fourier-ridge") == FourierRidge()


@both
def test_what_is_learned_is_a_measure_with_every_ability(learned):
    for protocol in (Measure, Gradient, Interval, State, CrossValidated):
        assert isinstance(learned, protocol)
    assert type(learned).__module__.split(".")[0] == "lampopt_pointnet"
    excuse = {"check_scale_follows_the_unit": "it knows the sizes it has learned from, and no others"}
    failed = [r.message for r in report("measure", learned, excuse) if not r.passed]
    assert not failed


# clouds


def test_a_cloud_has_the_surface_s_area_and_closes():
    mesh = shapes.ellipsoid()
    cloud = Cut.of(mesh, 0.5).cloud()
    points = cloud.corners.mean(axis=1)
    np.testing.assert_allclose(cloud.areas.sum(), mesh.area / 0.25)
    np.testing.assert_allclose(cloud.areas @ points, 0, atol=1e-12)  # about the area centroid
    np.testing.assert_allclose(cloud.areas @ cloud.normals, 0, atol=1e-12)  # a closed surface's vector area
    # divergence theorem: volume = ∮ x · n / 3
    volume = (cloud.areas * (points * cloud.normals).sum(axis=1)).sum() / 3
    np.testing.assert_allclose(volume * 0.125, mesh.volume)


@pytest.mark.parametrize("pooled", [PointNet.drawn(32, 0), Waves.drawn(32, 0)], ids=["PointNet", "Waves"])
def test_features_are_the_same_for_any_order(pooled):
    for mesh in (shapes.plate_with_hole(), shapes.ellipsoid()):
        one, other = (pooled(Cut.of(m, 0.5).cloud()) for m in (mesh, listed_otherwise(mesh)))
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)


def test_pieces_are_short_and_partition_their_faces():
    cut = Cut.of(shapes.plate_with_hole(), 0.5)
    corners = cut.cloud().corners
    assert np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max() <= SIDE
    np.testing.assert_allclose(np.bincount(cut.face, cut.share), 1)
    np.testing.assert_allclose(cut.weights.sum(axis=2), 1)
    # centroids weighted by share are the face's own
    for k in range(3):
        np.testing.assert_allclose(np.bincount(cut.face, cut.share * cut.weights.mean(axis=1)[:, k]), 1 / 3)
    assert len(cut.face) < 40_000


def test_waves_over_a_box_are_those_of_the_closed_form():
    """∫ cos(k·x + m·n + b) over a rectangle of half-sides u, v: area · sinc(k·u) · sinc(k·v) · cos at its middle."""
    waves, sides = Waves.drawn(64, 5), np.array([2.0, 1.0, 0.8])
    k, m = waves.vectors[:3].T, waves.vectors[3:].T
    wanted = np.zeros(64)
    for axis in range(3):
        rest = [i for i in range(3) if i != axis]
        damped = np.prod(np.sinc(k[:, rest] * sides[rest] / 2 / np.pi), axis=1) * sides[rest].prod()
        for sign in (-1, 1):
            wanted += damped * np.cos(sign * (k[:, axis] * sides[axis] / 2 + m[:, axis]) + waves.phases)
    for divisions in (0, 3):
        found = waves(Cut.of(shapes.box(sides / 2, divisions=divisions), 0.5).cloud())
        np.testing.assert_allclose(found, wanted, atol=1e-5)


@settings(max_examples=6, deadline=None)
@given(shift=st.tuples(*[st.floats(-50, 50)] * 3), divisions=st.integers(0, 3))
@pytest.mark.parametrize(
    ("pooled", "share"), [(PointNet.drawn(32, 0), 3e-3), (Waves.drawn(32, 0), 1e-6)], ids=["PointNet", "Waves"]
)
def test_features_hardly_see_place_or_tessellation(pooled, share, shift, divisions):
    """Against what a tenth more length does to them."""

    def seen(mesh):
        return pooled(Cut.of(mesh, 0.5).cloud())

    once, again = seen(shapes.box()), seen(shapes.box(divisions=divisions).apply_translation(shift))
    longer = seen(shapes.box((1.1, 0.5, 0.4)))
    assert np.linalg.norm(again - once) < share * np.linalg.norm(longer - once)


def test_what_is_far_too_large_is_cut_coarsely():
    cut = Cut.of(shapes.box((1e6, 5e5, 4e5)), 0.5)
    assert len(cut.face) < 500_000


def test_no_surface_and_no_numbers_are_refused():
    with pytest.raises(EmptyMesh, match="area"):
        Cut.of(trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False), 1.0)
    mesh = shapes.box()
    mesh.vertices[3] = np.nan
    with pytest.raises(MeasureError, match="finite"):
        Cut.of(mesh, 1.0)


# gradients


def slopes(measured, mesh, way, step):
    """By central differences as all vertices move along `way`."""
    ends = [trimesh.Trimesh(mesh.vertices + sign * step * way, mesh.faces, process=False) for sign in (1, -1)]
    return (measured(ends[0]) - measured(ends[1])) / (2 * step)


@pytest.mark.parametrize("pooled", [PointNet.drawn(24, 1), Waves.drawn(24, 1)], ids=["PointNet", "Waves"])
@pytest.mark.parametrize("mesh", [shapes.ellipsoid(), shapes.box(divisions=1)], ids=["ellipsoid", "box"])
def test_pullback_agrees_with_differences(pooled, mesh):
    """Of sums of all features, as each vertex goes its own way; some faces of the box are halved."""
    scale = 0.7
    rng = np.random.default_rng(2)
    cut = Cut.of(mesh, scale)
    cloud = cut.cloud()
    rows = rng.normal(size=(3, len(pooled(cloud))))
    gradient = np.stack([cut.pullback(*by) for by in pooled.pullback(cloud, rows)])
    assert gradient.shape == (3, len(mesh.vertices), 3)
    way = rng.normal(size=mesh.vertices.shape)
    found = slopes(lambda moved: rows @ pooled(Cut.of(moved, scale).cloud()), mesh, way, 1e-6)
    np.testing.assert_allclose((gradient * way).sum(axis=(1, 2)), found, rtol=1e-4)


FAMILIES = {
    "car": (np.array(CAR_LOW), np.array(CAR_HIGH), lambda p: car_mesh(p, edge=90.0)),
    "bwb": (np.array(BWB_LOW), np.array(BWB_HIGH), lambda p: bwb_mesh(p, chordwise=30, spanwise=40)),
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: type(k).__name__)
@pytest.mark.parametrize("family", FAMILIES)
def test_gradient_agrees_with_differences_on_a_family(kind, family):
    """To 1e-4 (relative to the steepest value), as a design is bent smoothly."""
    low, high, make = FAMILIES[family]
    rng = np.random.default_rng(6)
    designs = low + (high - low) * rng.uniform(size=(16, len(low)))
    names = tuple(map(str, range(3)))
    learned = kind.fit([make(p) for p in designs], designs[:, :3], names, ("mm",) * 3, seed=0)
    mesh = make((low + high) / 2)
    places = mesh.vertices / mesh.extents
    way = mesh.extents.max() * np.sin(places @ rng.normal(size=(3, 3)) * 2)
    found = slopes(learned, mesh, way, 1e-6) / learned.values[1]
    wanted = (learned.gradient(mesh) * way).sum(axis=(1, 2)) / learned.values[1]
    np.testing.assert_allclose(wanted, found, atol=1e-4 * np.abs(found).max())


@both
def test_gradient_leads_a_box_to_another_length(learned):
    """Stretching along x by a share s adds s · length; what is learned knows it to 10 %."""
    mesh = shapes.box((1.1, 0.45, 0.4), divisions=1)
    stretch = np.asarray(mesh.vertices) * [1, 0, 0]
    found = (learned.gradient(mesh) * stretch).sum(axis=(1, 2))
    np.testing.assert_allclose(found[[0, 2]], [1.1, 1.1 * 0.45 * 0.4], rtol=0.1)
    assert abs(found[1]) < 0.1 * 0.45  # the width stays
    moved = learned.gradient(mesh).sum(axis=1)
    np.testing.assert_allclose(moved, 0, atol=1e-9)  # place does not matter


# intervals and range


@both
def test_intervals_cover_what_they_say(learned):
    """150 new boxes: 90 %, give or take three standard deviations of calibrating on 60."""
    meshes, values = boxes(150, 5)
    half = learned.half_widths(0.9)
    found = np.array([learned(m) for m in meshes])
    covered = (np.abs(found - values) <= half).mean()
    assert 0.8 <= covered <= 0.99
    np.testing.assert_allclose(np.diff(learned.interval(meshes[0], 0.9)).ravel(), 2 * half)
    # of 45 labels the ⌈46 · 0.9⌉-th smallest error, of 60 the ⌈61 · 0.9⌉-th
    for column, rank in ((1, 42), (0, 55)):
        sizes = np.sort(np.abs(learned.errors[:, column]))
        np.testing.assert_allclose(half[column], sizes[rank - 1] * learned.values[1, column])
    assert np.isinf(learned.half_widths(0.99)).all()


@both
def test_values_are_learned(learned):
    meshes, values = boxes(40, 6)
    found = np.array([learned(m) for m in meshes])
    score = 1 - ((found - values) ** 2).sum(axis=0) / ((values - values.mean(axis=0)) ** 2).sum(axis=0)
    assert (score > 0.98).all()
    for k, name in enumerate(NAMES):
        said = learned.cross_validated[name]
        assert abs(said["r2"] - score[k]) < 0.03
        assert 0.3 < said["mean_absolute_error"] / np.abs(found - values)[:, k].mean() < 3


@both
def test_outside_is_told(learned):
    inside, _ = boxes(40, 7)
    # 2 % in the mean over what is learned from, 12 % where these 45 widths are known
    assert np.mean([learned.outside(m) for m in inside]) <= 0.2
    for other in (
        shapes.ellipsoid(),
        shapes.plate_with_hole(),
        shapes.box((2.4, 0.5, 0.4)),
        shapes.box((50, 30, 30)),
    ):
        assert learned.outside(other)


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: type(k).__name__)
def test_a_few_shapes_have_an_outside(kind):
    lengths = np.linspace(0.8, 1.6, 20)
    meshes = [shapes.box((a, 0.5, 0.4)) for a in lengths]
    learned = kind.fit(meshes, lengths[:, None], ("length",), ("m",), seed=0)
    assert learned.outside(shapes.box((80, 0.5, 0.4)))
    assert not any(learned.outside(shapes.box((a, 0.5, 0.4))) for a in (0.9, 1.21, 1.5))


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: type(k).__name__)
def test_outside_asks_where_each_value_was_known(kind):
    """The width only of boxes shorter than 1: of a box of 1.55 it was learned elsewhere."""
    rng = np.random.default_rng(3)
    sides = np.column_stack([rng.uniform(0.8, 1.6, 60), rng.uniform(0.3, 0.6, 60), rng.uniform(0.3, 0.5, 60)])
    meshes, values = [shapes.box(s) for s in sides], sides[:, :2].copy()
    whole = kind.fit(meshes, values, ("length", "width"), ("m", "m"), seed=0)
    values[sides[:, 0] > 1.0, 1] = np.nan
    part = kind.fit(meshes, values, ("length", "width"), ("m", "m"), seed=0)
    assert (len(whole.regions), len(part.regions)) == (1, 2)
    middle = shapes.box((0.9, 0.45, 0.4))
    assert (whole.outside(middle), part.outside(middle)) == (False, False)
    long = shapes.box((1.55, 0.45, 0.4))
    assert (whole.outside(long), part.outside(long)) == (False, True)


@both
def test_an_extrapolated_value_is_outside(learned):
    mean = learned.features[0]
    assert not learned.beyond(mean)
    low, high = learned.reach
    for k in range(3):
        for end in (low, high):
            off = np.where(np.arange(3) == k, end + 0.01 * (end - learned.at(mean)), learned.at(mean))
            told = dataclasses.replace(
                learned, values=np.stack([learned.values[0] + off - learned.at(mean), learned.values[1]])
            )
            assert told.beyond(mean)


def test_region_counts_what_lies_off_its_directions():
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(200, 2)) @ rng.normal(size=(2, 40)) + 0.01 * rng.normal(size=(200, 40))
    region = Region.of(plane, 0)
    assert not region.outside(plane.mean(axis=0))
    assert region.outside(plane.mean(axis=0) + 0.5 * rng.normal(size=40))
    assert region.outside(plane.mean(axis=0) + 5 * (plane[0] - plane.mean(axis=0)))


# learning


def test_leaving_one_out_by_formula_is_leaving_one_out():
    """Each error against a fit of scikit-learn's own without that row, at the same width and ridge."""
    from sklearn.kernel_ridge import KernelRidge

    rng = np.random.default_rng(4)
    features = rng.normal(size=(25, 3))
    values = np.column_stack([np.sin(features[:, 0]), features[:, 1] ** 2]) + 0.1 * rng.normal(size=(25, 2))
    sharpness, weights, errors = kernel_ridge(features, values)
    kernel = np.exp(-sharpness[0] * ((features[:, None] - features) ** 2).sum(axis=2))
    ridge = (values[:, 0] - kernel @ weights[:, 0])[0] / weights[0, 0]  # (K + λ) w = y
    for i in (0, 7, 24):
        rest = np.arange(25) != i
        model = KernelRidge(alpha=ridge, kernel="rbf", gamma=sharpness[0]).fit(features[rest], values[rest, 0])
        np.testing.assert_allclose(values[i, 0] - model.predict(features[[i]])[0], errors[i, 0], rtol=1e-5)


def test_a_mesh_given_more_than_once_is_left_out_as_a_whole():
    """Against fits of scikit-learn's own without any copy, at the same width and ridge; and by LASSO."""
    from sklearn.kernel_ridge import KernelRidge

    rng = np.random.default_rng(4)
    once, noise = rng.normal(size=(20, 3)), rng.normal(size=(20, 1))
    copies = np.repeat(np.arange(20), [1, 2, 3, 1] * 5)
    features, values = once[copies] * (1 + 1e-9 * rng.normal(size=(len(copies), 1))), noise[copies]
    sharpness, weights, errors = kernel_ridge(features, values)
    kernel = np.exp(-sharpness[0] * ((features[:, None] - features) ** 2).sum(axis=2))
    ridge = ((values - kernel @ weights) / weights).mean()
    for shape in (0, 1, 2):
        out = copies == shape
        model = KernelRidge(alpha=ridge, kernel="rbf", gamma=sharpness[0]).fit(features[~out], values[~out, 0])
        np.testing.assert_allclose(values[out, 0] - model.predict(features[out]), errors[out, 0], rtol=1e-3)
    assert (errors**2).mean() > 0.5 * values.var()  # noise cannot be told
    many = rng.normal(size=(20, 60))[copies]  # enough of them to tell each shape by heart
    assert (lasso(many, values, 10, 0)[2] ** 2).mean() > 0.5 * values.var()


def test_shapes_given_more_than_once_do_not_narrow_the_region():
    rng = np.random.default_rng(7)
    once, new = rng.normal(size=(60, 40)), rng.normal(size=(200, 40))
    told = [np.mean([Region.of(np.tile(once, (times, 1)), 0).outside(row) for row in new]) for times in (1, 6)]
    assert told[1] < told[0] + 0.2


@pytest.mark.parametrize(("shapes", "alike"), [(200, 1e-2), (200, 0.0), (30, 1e-2)])
def test_lasso_paths_are_those_of_its_optimality_conditions(shapes, alike):
    """Tibshirani 1996: Xᵀ(y − Xw − b) / n = penalty · sign(w) where w is not 0, no larger elsewhere; twins included."""
    rng = np.random.default_rng(3)
    few = rng.normal(size=(shapes, 12))
    features = np.concatenate([few, few + alike * rng.normal(size=few.shape)], axis=1)
    values = few @ rng.normal(size=12) + 0.1 * rng.normal(size=shapes)
    steepest = np.abs((features - features.mean(axis=0)).T @ values).max() / shapes
    penalties = steepest * np.geomspace(1, 1e-3, 12)
    path, intercepts = lasso_path(features, values, penalties)
    for weights, intercept, penalty in zip(path.T, intercepts, penalties, strict=True):
        pull = features.T @ (values - features @ weights - intercept) / shapes
        assert np.abs(pull).max() <= penalty + 1e-9 * steepest
        np.testing.assert_allclose(
            pull[weights != 0], penalty * np.sign(weights[weights != 0]), rtol=0, atol=1e-9 * steepest
        )


def test_lasso_finds_the_few_features_that_matter():
    rng = np.random.default_rng(5)
    features = rng.normal(size=(120, 60))
    truth = np.zeros(60)
    truth[[3, 17, 40]] = 2, -1, 0.5
    values = features @ truth + 3 + 0.05 * rng.normal(size=120)
    weights, intercept, errors = lasso(features, values[:, None], 10, 0)
    np.testing.assert_allclose(weights[:, 0], truth, atol=0.1)
    np.testing.assert_allclose(intercept, 3, atol=0.05)
    assert 0.04 < errors.std() < 0.08  # the noise, a little more by leaving out


def test_lasso_of_a_value_that_a_fold_leaves_without_variation():
    values = np.zeros((12, 1))
    values[3] = 1
    weights, intercept, errors = lasso(np.random.default_rng(6).normal(size=(12, 30)), values, 10, 0)
    assert np.isfinite(weights).all() and np.isfinite(errors).all()
    np.testing.assert_allclose(errors[3], 1.0)  # nothing else tells of it
    np.testing.assert_allclose(intercept, 1 / 12)


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: type(k).__name__)
def test_unlabelled_rows_are_left_out_of_their_column_only(kind):
    meshes, values = boxes(40, 8)
    partly = values.copy()
    partly[30:, 1] = np.nan
    whole, part = (kind.fit(meshes, v, NAMES, UNITS, seed=0) for v in (values, partly))
    mesh = boxes(1, 9)[0][0]
    np.testing.assert_allclose(part(mesh)[[0, 2]], whole(mesh)[[0, 2]], rtol=1e-6)
    assert np.isnan(part.errors[30:, 1]).all()
    assert np.isfinite(part.errors[:30]).all()


@both
def test_state_gives_the_same_bits(learned, tmp_path):
    np.savez(tmp_path / "learned.npz", **learned.state())
    with np.load(tmp_path / "learned.npz", allow_pickle=False) as kept:
        again = Learned.from_state(dict(kept))
    mesh = shapes.box((1.0, 0.4, 0.4))
    np.testing.assert_array_equal(again(mesh), learned(mesh))
    np.testing.assert_array_equal(again.interval(mesh, 0.9), learned.interval(mesh, 0.9))
    np.testing.assert_array_equal(again.gradient(mesh), learned.gradient(mesh))
    assert again.outside(mesh) == learned.outside(mesh)
    assert again.cross_validated == learned.cross_validated
    assert (again.names, again.units) == (NAMES, UNITS)


def damages(array):
    """Of one array: of other shapes, other numbers, another type."""
    yield array[: len(array) // 2] if array.ndim else array[None]
    yield array[..., None]
    yield np.zeros(array.shape, np.int64)
    yield array.astype(np.float32)
    yield np.full_like(array, np.nan)
    yield np.full_like(array, np.inf)
    if array.ndim == 2:
        yield array.ravel()
        yield array.T


@both
def test_a_damaged_state_is_refused(learned):
    state = learned.state()
    wrong = [{k: v for k, v in state.items() if k != name} for name in state]
    for name, array in state.items():
        if name != "words":
            wrong += [state | {name: other} for other in damages(array)]
    wrong += [state | {name: -state[name]} for name in ("scale", "values", "features", "reach", "region1.off")]
    wrong += [state | {name: 0 * state[name]} for name in ("scale", "values", "region0.limit", "region0.directions")]
    words = json.loads(state["words"].tobytes())
    for other in (
        {},
        [],
        words | {"names": ["length", "width\n", "volume"]},
        words | {"names": ["length", "length", "volume"]},
        words | {"units": ["L", 1, "L"]},
        words | {"units": ["L"]},
        words | {"pooled": "Region"},
        words | {"regression": ["Linear"]},
    ):
        wrong.append(state | {"words": np.frombuffer(json.dumps(other).encode(), np.uint8)})
    for text in (b"\xff", b"[" * 100_000):
        wrong.append(state | {"words": np.frombuffer(text, np.uint8)})
    for each in wrong:
        with pytest.raises(InputError, match="expected"):
            Learned.from_state(each)
    assert Learned.from_state(state).names == NAMES


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: type(k).__name__)
def test_values_of_any_unit_are_learned_alike(kind):
    """Beside each other, however small one is to another."""
    meshes, values = boxes(20, 12)
    units = np.array([1e-90, 1.0, 1e90])
    one, other = (kind.fit(meshes, values * by, NAMES, UNITS, seed=0) for by in (np.ones(3), units))
    mesh = boxes(1, 13)[0][0]
    np.testing.assert_allclose(other(mesh), one(mesh) * units, rtol=1e-9)
    large = scaled(mesh, 1e9)
    assert np.isfinite(one(large)).all()
    assert one.outside(large)
    with pytest.raises(MeasureError, match="far beyond"):
        one(scaled(mesh, 1e200))


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: type(k).__name__)
def test_bad_input_is_named(kind):
    meshes, values = boxes(12, 10)
    few = np.where(np.arange(12)[:, None] < 3, values, np.nan)
    cases = [
        (meshes, values[:5], "expected values"),
        (meshes, few, "length: expected values for at least 10 meshes, got 3"),
        (meshes, np.where(np.arange(3) == 2, 1.0, values), "volume: expected values that differ"),
        (meshes, np.where(np.arange(3) == 1, np.inf, values), "width: expected finite"),
        ([*meshes[:11], trimesh.Trimesh()], values, "mesh 11: expected a mesh with faces"),
        ([trimesh.Trimesh(), *meshes[1:]], values, "mesh 0: expected a mesh with faces"),
        ([meshes[0]] * 12, values, "the meshes do not differ"),
        ([scaled(meshes[0], 1e-9), *meshes[1:]], values, "mesh 0: expected a size"),
        ([scaled(m, 10.0**i) for i, m in enumerate(meshes)], values, "mesh [01]+: expected a size"),
        ([scaled(m, 1e200) for m in meshes], values, "mesh 0: .* another unit"),
        *[(meshes, values * size, "length: expected values of size") for size in (1e-300, 1e-170, 1e160)],
        (meshes, np.full(values.shape, "x"), "real numbers"),
        (meshes, values * 1j, "real numbers"),
    ]
    for given_meshes, given_values, message in cases:
        with pytest.raises((InputError, EmptyMesh, MeasureError), match=message):
            kind.fit(given_meshes, given_values, NAMES, UNITS, seed=0)
    with pytest.raises(InputError, match="distinct"):
        kind.fit(meshes, values, ("a", "a", "b"), UNITS, seed=0)
    count = "neurons" if kind is KINDS[0] else "waves"
    for option in ({count: 0}, {count: "x"}):
        with pytest.raises(InputError, match=next(iter(option))):
            type(kind)(**option)
