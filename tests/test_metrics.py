"""Scores against closed forms: shifted grids, overlapping boxes and balls, lines through known points."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lampopt.errors import InputError
from lampopt.metrics import (
    chamfer_distance,
    conformal_quantile,
    iou,
    mean_absolute_error,
    minimum_matching_distance,
    r_squared,
    sample_surface,
    twins,
)
from lampopt.testing import shapes

GRID = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
FLOATS = st.floats(-1e3, 1e3, width=32)


def moved(points, x, y=0.0, z=0.0):
    return points + np.array([x, y, z])


@pytest.mark.parametrize("shift", [0.0, 0.1, 0.4, 0.5])
def test_chamfer_of_a_grid_shifted_by_less_than_half_a_cell(shift):
    # every point's nearest is its own copy, both ways: 2·shift²
    assert chamfer_distance(GRID, moved(GRID, shift)) == pytest.approx(2 * shift**2)
    assert chamfer_distance(GRID, moved(GRID, 0, -shift, shift)) == pytest.approx(4 * shift**2)


@pytest.mark.parametrize("cells", [1, 2, 6])
def test_chamfer_of_a_grid_shifted_by_whole_cells(cells):
    # of 6 layers, `cells` stick out on either side, 1, 2, … away from what is covered
    once = sum(j**2 for j in range(1, cells + 1)) / 6
    assert chamfer_distance(GRID, moved(GRID, cells)) == pytest.approx(2 * once)


def test_chamfer_averages_each_side_by_itself():
    # three points to one: 0, 1 and 4 → 5/3; back: 0
    assert chamfer_distance([[0, 0, 0], [1, 0, 0], [0, 2, 0]], [[0, 0, 0]]) == pytest.approx(5 / 3)


@settings(max_examples=40, deadline=None)
@given(arrays(float, (7, 3), elements=FLOATS), arrays(float, (4, 3), elements=FLOATS))
def test_chamfer_by_all_pairs(x, y):
    pairs = ((x[:, None] - y) ** 2).sum(-1)
    wanted = pairs.min(1).mean() + pairs.min(0).mean()
    assert chamfer_distance(x, y) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    assert chamfer_distance(y, x) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    assert chamfer_distance(x, x[::-1]) == 0


def test_chamfer_grows_with_the_square_of_the_unit():
    draw = np.random.default_rng(0)
    x, y = draw.normal(size=(2, 50, 3))
    assert chamfer_distance(1000 * x, 1000 * y) == pytest.approx(1e6 * chamfer_distance(x, y))


@pytest.mark.parametrize("bad", [np.empty((0, 3)), np.zeros(3), np.zeros((4, 2)), np.zeros((2, 3, 1))])
def test_clouds_are_points(bad):
    with pytest.raises(InputError, match=r"x: expected points of shape \(n, 3\)"):
        chamfer_distance(bad, GRID)
    with pytest.raises(InputError, match=r"y: expected points of shape \(n, 3\)"):
        chamfer_distance(GRID, bad)


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.75, 1.0, 2.0])
def test_iou_of_shifted_boxes(shift):
    a, b = shapes.box((1, 1, 1)), shapes.box((1, 1, 1), centre=(shift, 0, 0))
    common = max(1 - shift, 0)
    # faces lie on planes between voxels, so that their count is exact
    assert iou(a, b, resolution=int(40 * (1 + shift))) == pytest.approx(common / (2 - common))


def test_iou_of_boxes_shifted_along_all_axes():
    a, b = shapes.box((1, 1, 1)), shapes.box((1, 1, 1), centre=(0.5, 0.5, 0.5))
    assert iou(a, b, resolution=60) == pytest.approx(0.125 / 1.875)


def test_iou_of_a_box_within_a_box():
    assert iou(shapes.box((2, 1, 1)), shapes.box((1, 0.5, 0.5)), resolution=40) == pytest.approx(1 / 8)


@pytest.mark.parametrize("far", [1e4, 1e6, 1e8])
def test_iou_is_of_the_shapes_wherever_they_are(far):
    a, b = (trimesh.creation.icosphere(subdivisions=3) for _ in range(2))
    b.apply_scale((1.25, 1, 1))
    here = iou(a, b, 32)
    for mesh in (a, b):
        mesh.apply_translation((far, -2 * far, 0))
    assert iou(a, b, 32) == pytest.approx(here, abs=0.01)


def test_iou_of_what_is_inside_out_is_told():
    a, b = shapes.box((1, 1, 1)), shapes.box((1, 1, 1))
    a.invert()
    with pytest.raises(InputError, match=r"lies inside the first mesh; are they closed and outward"):
        iou(a, b, 32)


def test_iou_of_balls():
    # two balls of radius 1, centres d apart: lens π (4 + d) (2 − d)² / 12
    d = 0.6
    lens = np.pi * (4 + d) * (2 - d) ** 2 / 12
    a, b = (trimesh.creation.icosphere(subdivisions=4).apply_translation((x, 0, 0)) for x in (0, d))
    assert iou(a, b, resolution=80) == pytest.approx(lens / (8 * np.pi / 3 - lens), abs=0.01)


def test_iou_knows_neither_order_nor_unit():
    a, b = shapes.box((1, 0.7, 0.5)), shapes.ellipsoid((0.6, 0.4, 0.3), centre=(0.1, 0, 0))
    found = iou(a, b, 32)
    assert found == iou(b, a, 32)
    assert iou(a.copy().apply_scale(1000), b.copy().apply_scale(1000), 32) == pytest.approx(found, abs=1e-3)
    assert 0 < found < 1


def test_iou_hardly_minds_a_missing_face():
    ball, torn = (trimesh.creation.icosphere(subdivisions=3) for _ in range(2))
    torn.update_faces(np.arange(len(torn.faces)) != 5)
    assert iou(ball, torn, 32) > 0.98


def test_iou_of_nothing_inside_is_refused():
    inward = shapes.box((1, 1, 1))
    inward.invert()
    with pytest.raises(InputError, match="closed and outward"):
        iou(inward, inward, 16)


def test_iou_of_a_mesh_without_faces_is_refused():
    for pair in ((trimesh.Trimesh(), shapes.box()), (shapes.box(), trimesh.Trimesh())):
        with pytest.raises(InputError, match="iou: expected meshes with faces"):
            iou(*pair)


def test_mmd_takes_the_best_of_the_reference_for_each_generated():
    cloud = np.zeros((1, 3))
    generated = [moved(cloud, 0), moved(cloud, 3)]
    reference = [moved(cloud, 1), moved(cloud, 5)]
    # squared distances both ways: 2·1 and 2·4; 2·25 and 2·4 → means of the minima (2 + 8) / 2
    assert minimum_matching_distance(generated, reference) == pytest.approx(5)
    assert minimum_matching_distance(reference, generated) == pytest.approx((2 + 8) / 2)
    assert minimum_matching_distance(generated, [*reference, generated[0]]) == pytest.approx(4)
    assert minimum_matching_distance(generated, generated) == 0


def test_mmd_with_a_distance_of_ones_own():
    assert minimum_matching_distance([1, 5], [2, 9], distance=lambda x, y: abs(x - y)) == pytest.approx(2)


@pytest.mark.parametrize("pair", [([], [GRID]), ([GRID], []), ([], [])])
def test_mmd_of_nothing_is_refused(pair):
    with pytest.raises(InputError, match="MMD: expected clouds on both sides, got"):
        minimum_matching_distance(*pair)


def test_r_squared_and_mae_by_hand():
    wanted, found = [1.0, 2.0, 3.0, 4.0], [1.0, 2.5, 3.0, 3.0]
    assert mean_absolute_error(wanted, found) == pytest.approx(1.5 / 4)
    assert r_squared(wanted, found) == pytest.approx(1 - 1.25 / 5)
    assert r_squared(wanted, wanted) == 1
    assert r_squared(wanted, np.full(4, 2.5)) == 0  # no better than the mean
    assert r_squared(wanted, wanted[::-1]) == pytest.approx(1 - 20 / 5)  # worse than the mean


def test_r_squared_is_about_the_line_y_x_not_about_any_line():
    wanted = np.linspace(0, 1, 11)
    assert r_squared(wanted, wanted + 1) == pytest.approx(1 - 11 / ((wanted - 0.5) ** 2).sum())
    assert r_squared(wanted, 2 * wanted) < 0.5
    assert r_squared(wanted, wanted + 0.1) != r_squared(wanted + 0.1, 2 * wanted)


@settings(max_examples=40, deadline=None)
@given(arrays(float, 6, elements=FLOATS).filter(lambda v: np.ptp(v) > 1), arrays(float, 6, elements=FLOATS))
def test_r_squared_is_one_less_the_share_of_the_mean_square(wanted, found):
    share = ((wanted - found) ** 2).mean() / wanted.var()
    assert r_squared(wanted, found) == pytest.approx(1 - share, rel=1e-9, abs=1e-9)
    assert r_squared(wanted, found) <= 1
    assert mean_absolute_error(wanted, found) == mean_absolute_error(found, wanted)


@pytest.mark.parametrize("score", [r_squared, mean_absolute_error])
@pytest.mark.parametrize("pair", [([1.0, 2.0], [1.0]), ([], []), ([[1.0, 2.0]], [1.0, 2.0])])
def test_pairs_that_do_not_fit_are_refused(score, pair):
    with pytest.raises(InputError, match="expected two arrays of one shape, not empty"):
        score(*pair)


def test_r_squared_of_one_wanted_value_is_refused():
    with pytest.raises(InputError, match="expected wanted values that differ"):
        r_squared([2.0, 2.0], [1.0, 3.0])


def test_points_lie_on_the_surface_and_evenly():
    box = shapes.box((2, 1, 1), divisions=0)
    points = sample_surface(box, 20_000, seed=1)
    assert points.shape == (20_000, 3)
    np.testing.assert_allclose(np.abs(points / [1, 0.5, 0.5]).max(1), 1, atol=1e-9)
    # areas: 2 ends of 1, 4 sides of 2 → a tenth on each end of the length; standard deviation 0.002
    assert (points[:, 0] > 1 - 1e-9).mean() == pytest.approx(0.1, abs=0.01)
    assert points.mean(0) == pytest.approx([0, 0, 0], abs=0.03)


def test_points_repeat_for_a_seed():
    box = shapes.box()
    np.testing.assert_array_equal(sample_surface(box, 100, seed=3), sample_surface(box, 100, seed=3))
    assert not np.array_equal(sample_surface(box, 100, seed=3), sample_surface(box, 100, seed=4))


def test_conformal_quantile_is_the_counted_one():
    errors = np.array([-3.0, 1.0, 2.0, -5.0, 4.0, 6.0, 7.0, -8.0, 9.0])
    assert conformal_quantile(errors, 0.5) == 5.0  # the fifth of nine
    assert conformal_quantile(errors, 0.9) == 9.0  # the ninth, though 0.9 × 10 is more than 9 in binary
    assert conformal_quantile(errors, 0.91) == np.inf
    assert conformal_quantile(np.zeros(0), 0.5) == np.inf
    for level in (0, 1, -0.5, 90):
        with pytest.raises(InputError, match="coverage between 0 and 1"):
            conformal_quantile(errors, level)


def test_conformal_quantile_covers_as_promised():
    """Exchangeable errors: over many draws of 19 and one more, the next is within the 90 % quantile 18 times of 20."""
    draws = np.random.default_rng(0).normal(size=(20_000, 20))
    inside = [abs(d[19]) <= conformal_quantile(d[:19], 0.9) for d in draws]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize("columns", [1, 8, 9, 400])
def test_twins_are_found_however_many_columns_there_are(columns):
    """Rows apart by a little less than what is allowed in every column, and others by a little more in one."""
    rng = np.random.default_rng(2)
    rows = 10.0 * np.arange(30)[:, None] + rng.normal(size=(30, columns))
    near = rows + 0.99e-3 * rng.choice([-1, 1], rows.shape)
    far = rows.copy()
    far[:, -1] += 1.01e-3
    group = twins(np.concatenate([rows, near]), 1e-3)
    assert len(set(group)) == 30 and (group[:30] == group[30:]).all()
    assert len(set(twins(np.concatenate([rows, far]), 1e-3))) == 60


def test_rows_without_columns_are_all_twins():
    assert twins(np.empty((3, 0)), 1e-3).tolist() == [0, 0, 0]
