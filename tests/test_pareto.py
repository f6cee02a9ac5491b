"""Fronts and knees: against what can be counted, and against fronts known in closed form."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lampopt.errors import InputError
from lampopt.pareto import knee, pareto

VALUES = st.one_of(st.integers(-3, 3).map(float), st.floats(-1e300, 1e300), st.sampled_from([np.nan, np.inf, -np.inf]))
TABLES = arrays.arrays(float, st.tuples(st.integers(0, 30), st.integers(1, 4)), elements=VALUES)
PAIRS = arrays.arrays(
    float, st.tuples(st.integers(1, 30), st.just(2)), elements=st.one_of(st.integers(0, 9).map(float), st.floats(-1, 1))
)


def counted(points):
    """The same by its definition, pair by pair."""
    return [
        not np.isnan(p).any() and not any((q <= p).all() and (q < p).any() for q in points if not np.isnan(q).any())
        for p in points
    ]


@given(points=TABLES)
@settings(deadline=None, max_examples=300)
def test_what_is_not_dominated_is_what_no_pair_says_is(points):
    found = pareto(points)
    assert (found.dtype, found.shape) == (bool, (len(points),))
    assert found.tolist() == counted(points)


@given(points=TABLES, seed=st.integers(0, 99))
@settings(deadline=None)
def test_order_of_rows_and_columns_and_scale_do_not_matter(points, seed):
    rng = np.random.default_rng(seed)
    rows, columns = rng.permutation(len(points)), rng.permutation(points.shape[1])
    assert pareto(points[rows][:, columns]).tolist() == pareto(points)[rows].tolist()
    assert pareto(points / 4 * 2.0 ** np.arange(points.shape[1])).tolist() == pareto(points / 4).tolist()


def test_small_fronts():
    assert pareto([[1, 2], [2, 1], [2, 2], [1, 2], [1, 3]]).tolist() == [True, True, False, True, False]
    assert pareto([[3], [1], [1], [np.nan], [2]]).tolist() == [False, True, True, False, False]
    assert pareto([[0.0, 1.0], [-0.0, 1.0]]).tolist() == [True, True]
    assert pareto([[1, np.inf], [np.inf, 1], [np.inf, np.inf]]).tolist() == [True, True, False]
    assert pareto([[1, -5], [2, -6], [2, -4]]).tolist() == [True, True, False]
    assert pareto(np.zeros((0, 3))).tolist() == []
    assert pareto(np.zeros((4, 3))).all()


@pytest.mark.parametrize("wide", [2, 3, 4])
def test_a_sphere_that_faces_the_origin_is_all_front_and_shells_behind_it_are_none(wide):
    near = 2 - np.abs(np.random.default_rng(wide).normal(size=(200, wide)))
    near = 2 - (2 - near) / np.linalg.norm(2 - near, axis=1, keepdims=True)
    assert pareto(np.concatenate([near + 0.01, near])).tolist() == [False] * 200 + [True] * 200


@pytest.mark.parametrize("wide", [1, 2, 3, 5])
def test_ten_thousand_points_that_are_all_on_the_front_take_no_more_than_moments(wide):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10_000, wide))
    points -= points.sum(1, keepdims=True) / wide  # a plane that none of its points is below another on
    began = time.process_time()
    assert pareto(points).all()
    assert time.process_time() - began < 10  # 1 s alone; the naive way needs 10⁸ comparisons of rows
    assert pareto(rng.random((10_000, wide))).sum() < 5_000


def test_the_knee_of_curves_is_where_they_run_along_their_chord():
    x = np.linspace(0, 1, 10_001)
    circle = np.column_stack([x, 1 - np.sqrt(1 - (1 - x) ** 2)])
    assert circle[knee(circle)] == pytest.approx([1 - 0.5**0.5] * 2, abs=1e-4)
    for k in (0.5, 0.25, 0.1):  # (1 - x) / (1 + c x) with its steepness -1, as the chord's, at (√(1 + c) - 1) / c
        c = 1 / k**2 - 1
        curve = np.column_stack([x, (1 - x) / (1 + c * x)])
        assert curve[knee(curve), 0] == pytest.approx((1 / k - 1) / c, abs=1e-4)


@given(points=PAIRS)
@settings(deadline=None, max_examples=300)
def test_a_knee_is_on_the_front_and_farthest_from_the_chord(points):
    found = knee(points)
    front = np.flatnonzero(pareto(points))
    assert found in front
    low, reach = points[front].min(0), np.ptp(points[front], axis=0)
    if reach.min() < 1e-6:
        return
    off = 1 - ((points[front] - low) / reach).sum(1)
    assert off[front.tolist().index(found)] >= off.max() - 1e-9


@given(points=PAIRS, scale=st.tuples(st.integers(-9, 9), st.integers(-9, 9)), add=st.integers(-4, 4))
@settings(deadline=None)
def test_units_do_not_move_the_knee(points, scale, add):
    moved = (points * 1024).round() / 1024  # so that all of it is exact
    assert knee(moved * 2.0 ** np.array(scale) + add * 2.0 ** np.array(scale)) == knee(moved)


def test_fronts_that_do_not_bend():
    x = np.linspace(0, 3, 31)
    assert knee(np.column_stack([x, 7 - 2 * x])[::-1]) == 30  # straight: the end that is least in the first
    assert knee(np.column_stack([x, np.sqrt(9 - x**2)])) == 0  # bulges away
    assert knee([[5.0, 5.0]]) == 0
    assert knee([[2.0, 1.0], [1.0, 2.0]]) == 1
    assert knee([[1.0, 2.0], [1.0, 2.0]]) == 0
    assert knee([[0, 1], [0.2, 0.2], [0.2, 0.2], [1, 0]]) == 1


def test_a_knee_leaves_out_what_is_not_finite():
    front = [[np.nan, 0], [-np.inf, 5], [0, 1], [0.1, 0.2], [1, 0], [0.5, np.inf]]
    assert knee(front) == 3
    assert knee(np.array(front[2:5]) * 1.7e308) == 1
    assert knee(np.array([[-1, 1], [-0.9, -0.9], [1, -1]]) * 1.7e308) == 1


def test_what_is_no_table_is_refused():
    for wrong in (3.0, [1.0, 2.0], np.zeros((2, 2, 2)), np.zeros((3, 0)), [["a", "b"]], [[1.0], [1.0, 2.0]]):
        with pytest.raises(InputError, match="expected"):
            pareto(wrong)
    with pytest.raises(InputError, match=r"expected points \(B, 2\), got shape \(4, 3\)"):
        knee(np.zeros((4, 3)))
    with pytest.raises(InputError, match="none of them finite"):
        knee([[np.nan, 1.0]])
