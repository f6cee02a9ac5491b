"""Solver `kkt` against solutions found otherwise: the whole KKT system by numpy, SLSQP by scipy, closed forms."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from threadpoolctl import ThreadpoolController, threadpool_info, threadpool_limits

from lampopt import threads
from lampopt.errors import InputError, SolveError
from lampopt.plugins import Plugins
from lampopt.testing import solver_checks
from lampopt.types import Problem
from lampopt_kkt import kkt
from lampopt_kkt.kkt import KKT

SEEDS = pytest.mark.parametrize("seed", range(6))


def names(k):
    return tuple(f"q{i}" for i in range(k))


def problem(seed=0, k=4, n=9, **changes):
    """k rows on [-1, 1] of n exemplars, targets out of range but reachable (k < n), uneven weights and centre."""
    draw = np.random.default_rng(seed)
    matrix, alpha = draw.uniform(-1, 1, (k, n)), draw.normal(size=n)
    given = {
        "names": names(k),
        "matrix": matrix,
        "target": matrix @ (alpha + (1 - alpha.sum()) / n),
        "weight": draw.uniform(0.3, 3, k),
        "centre": draw.dirichlet(np.ones(n)),
        "ridge": 0.0,
    }
    return Problem(**(given | changes))


def beyond(seed=0, k=4, n=9, **changes):
    """As `problem`, with targets that no mix need meet."""
    return problem(seed, k, n, target=np.random.default_rng(seed + 100).uniform(-2, 2, k), **changes)


def full_system(p):
    """Stationarity, the sum and the hard rows as one system in alpha and the multipliers; least norm by lstsq.

    In beta = alpha − centre, so that the least-norm solution is the one nearest to the centre.
    """
    n, soft = len(p.centre), ~p.hard
    rows, weight = p.matrix[soft], p.weight[soft]
    exact = np.vstack([np.ones(n), p.matrix[p.hard]])
    size = len(exact)
    system = np.zeros((n + size, n + size))
    system[:n, :n] = rows.T @ (weight[:, None] * rows) + p.ridge * np.eye(n)
    system[:n, n:], system[n:, :n] = exact.T, exact
    gap = p.target - p.matrix @ p.centre
    given = np.concatenate([rows.T @ (weight * gap[soft]), [0.0], gap[p.hard]])
    return p.centre + np.linalg.lstsq(system, given, rcond=1e-13)[0][:n]


def cost(p, alpha):
    soft = ~p.hard
    misses = p.weight[soft] @ (p.matrix[soft] @ alpha - p.target[soft]) ** 2
    return misses + p.ridge * ((alpha - p.centre) ** 2).sum()


def slsqp(p):
    exact = np.vstack([np.ones(len(p.centre)), p.matrix[p.hard]])
    value = np.append(1.0, p.target[p.hard])
    kept = {"type": "eq", "fun": lambda a: exact @ a - value, "jac": lambda _: exact}
    found = minimize(
        lambda a: cost(p, a), p.centre, method="SLSQP", constraints=[kept], options={"ftol": 1e-15, "maxiter": 500}
    )
    return found.x


@pytest.mark.parametrize("outside", [1, 2])
def test_one_blas_thread_within_and_the_users_number_after(monkeypatch, outside):
    def limits():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    threads._one_thread.cache_clear()  # other tests may have loaded more libraries since
    inside, real = [], kkt._solve
    monkeypatch.setattr(kkt, "_solve", lambda *args: inside.append(limits()) or real(*args))
    with threadpool_limits(outside, "blas"):
        before = limits()  # a library may have been built for one thread
        KKT().solve(problem())
        assert limits() == before
        assert outside in before
    assert inside == [{1}]


def test_thread_pools_are_looked_for_once(monkeypatch):
    looked = []
    monkeypatch.setattr(threads, "ThreadpoolController", lambda: looked.append(1) or ThreadpoolController())
    threads._one_thread.cache_clear()
    for seed in range(3):
        KKT().solve(problem(seed))
    assert len(looked) == 1


@solver_checks(KKT())
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("solver", "kkt") == KKT()


@SEEDS
@pytest.mark.parametrize("ridge", [1e-4, 1e-2, 1.0, 100.0])
@pytest.mark.parametrize(("k", "n"), [(1, 4), (4, 9), (8, 9), (9, 9), (15, 6)])
def test_equals_the_full_kkt_system(seed, k, n, ridge):
    p = beyond(seed, k, n, ridge=ridge)
    np.testing.assert_allclose(KKT().solve(p).alpha, full_system(p), atol=1e-7)


@SEEDS
@pytest.mark.parametrize(("k", "n"), [(1, 4), (4, 9), (8, 9)])
def test_without_ridge_equals_the_pseudoinverse_of_the_constraints(seed, k, n):
    p = problem(seed, k, n)
    exact = np.vstack([np.ones(n), p.matrix])
    wanted = p.centre + np.linalg.pinv(exact) @ (np.append(1.0, p.target) - exact @ p.centre)
    mix = KKT().solve(p)
    np.testing.assert_allclose(mix.alpha, wanted, atol=1e-9)
    assert mix.status == "exact"
    assert mix.message == "every target is met"


@SEEDS
@pytest.mark.parametrize("ridge", [1e-3, 0.1])
@pytest.mark.parametrize("hard", [0, 2])
def test_equals_slsqp(seed, ridge, hard):
    p = beyond(seed, 4, 7, ridge=ridge, hard=np.arange(4) < hard)
    mine, theirs = KKT().solve(p).alpha, slsqp(p)
    np.testing.assert_allclose(mine, theirs, atol=2e-3)  # where SLSQP stops
    assert cost(p, mine) <= cost(p, theirs) + 1e-12


@SEEDS
def test_hard_rows_are_met_and_the_others_give_way(seed):
    p = beyond(seed, 5, 8, ridge=0.5, hard=np.array([True, False, True, False, False]))
    mix = KKT().solve(p)
    np.testing.assert_allclose(mix.residual[[0, 2]], 0, atol=1e-11)
    np.testing.assert_allclose(mix.alpha, full_system(p), atol=1e-9)
    assert np.abs(mix.residual[[1, 3, 4]]).max() > 1e-3
    assert mix.status == "inexact"
    assert "ridge or weights hold" in mix.message


@SEEDS
def test_soft_rows_have_what_hard_rows_leave(seed):
    # three hard rows of five exemplars leave one direction, two soft rows share it by their weights
    p = beyond(seed, 5, 5, hard=np.array([True, True, True, False, False]), ridge=0.0)
    mix = KKT().solve(p)
    np.testing.assert_allclose(mix.residual[:3], 0, atol=1e-9)
    direction = np.linalg.svd(np.vstack([np.ones(5), p.matrix[:3]]))[2][-1]
    slope = p.matrix[3:] @ direction
    assert slope @ (p.weight[3:] * mix.residual[3:]) == pytest.approx(0, abs=1e-9)


def test_two_contradictory_rows_meet_at_their_weighted_mean():
    row = np.array([[-1.0, 0.0, 1.0]])
    for w in (1.0, 3.0, 100.0):
        p = Problem(names(2), np.vstack([row, row]), np.array([1.0, -1.0]), weight=np.array([w, 1.0]))
        value = row[0] @ KKT().solve(p).alpha
        assert value == pytest.approx((w - 1) / (w + 1))


def test_the_weight_of_a_hard_row_is_ignored():
    p = beyond(3, hard=np.array([True, False, False, False]), ridge=0.1)
    heavy = replace(p, weight=p.weight * [1e6, 1, 1, 1])
    np.testing.assert_allclose(KKT().solve(p).alpha, KKT().solve(heavy).alpha, atol=1e-10)


def test_one_row_by_hand():
    # M = (-1, 0, 1), centre 1/3 each: beta = s (-1, 0, 1), minimise (2s − t)² + 2 r s² → s = t / (2 + r)
    for t, r in ((0.5, 0.0), (3.0, 0.0), (1.0, 2.0), (-2.0, 0.5)):
        p = Problem(("q",), np.array([[-1.0, 0.0, 1.0]]), np.array([t]), ridge=r)
        s = t / (2 + r)
        np.testing.assert_allclose(KKT().solve(p).alpha, [1 / 3 - s, 1 / 3, 1 / 3 + s], atol=1e-12)


@SEEDS
def test_more_ridge_holds_closer_to_the_centre_and_misses_more(seed):
    p = beyond(seed, 4, 9)
    ridges = np.concatenate([[0.0], np.logspace(-6, 4, 30)])
    batch = KKT().solve_many(p, np.repeat(p.target[None], len(ridges), 0), ridges)
    misses = (p.weight * batch.residual**2).sum(1)
    away = np.linalg.norm(batch.alpha - p.centre, axis=1)
    assert (np.diff(misses) > 0).all()
    assert (np.diff(away) < 0).all()
    assert misses[0] == pytest.approx(0, abs=1e-20)
    assert away[-1] < 1e-3
    one_by_one = [KKT().solve(replace(p, ridge=float(r))).alpha for r in ridges]
    np.testing.assert_allclose(batch.alpha, one_by_one, atol=1e-12)


def test_the_solvers_own_ridge_stands_in_where_the_problem_names_none():
    p = beyond(1)
    for own, stated, used in ((0.3, None, 0.3), (0.3, 0.0, 0.0), (0.3, 2.0, 2.0)):
        found = KKT(ridge=own).solve(replace(p, ridge=stated)).alpha
        np.testing.assert_array_equal(found, KKT().solve(replace(p, ridge=used)).alpha)
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="ridge"):
            KKT(ridge=bad)


@SEEDS
def test_of_all_that_hit_the_nearest_to_the_centre(seed):
    p = problem(seed, 3, 8)
    alpha = KKT().solve(p).alpha
    free = np.linalg.svd(np.vstack([np.ones(8), p.matrix]))[2][4:]  # moves that change nothing asked
    np.testing.assert_allclose(free @ (alpha - p.centre), 0, atol=1e-10)


def test_a_reference_that_has_what_is_asked_stays_as_it_is():
    p = problem(2, 3, 8)
    one_hot = np.eye(8)[5]
    mix = KKT().solve(replace(p, centre=one_hot, target=p.matrix[:, 5]))
    np.testing.assert_allclose(mix.alpha, one_hot, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), k=st.integers(0, 8), n=st.integers(1, 12), ridge=st.sampled_from([0.0, 1e-6, 1.0]))
def test_invariants(seed, k, n, ridge):
    p = beyond(seed, k, n, ridge=ridge, hard=np.arange(k) < min(k, n - 1) // 3)
    mix = KKT().solve(p)
    assert mix.alpha.sum() == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(mix.residual, p.matrix @ mix.alpha - p.target, atol=1e-9)
    order = np.random.default_rng(seed).permutation(n)
    turned = KKT().solve(replace(p, matrix=p.matrix[:, order], centre=p.centre[order])).alpha
    np.testing.assert_allclose(turned, mix.alpha[order], atol=1e-6)
    rows = np.random.default_rng(seed).permutation(k)
    chosen = {name: getattr(p, name)[rows] for name in ("matrix", "target", "weight", "hard")}
    np.testing.assert_allclose(KKT().solve(replace(p, **chosen)).alpha, mix.alpha, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    shift=st.floats(-100, 100),
    scale=st.floats(0.01, 100),
    ridge=st.sampled_from([0.0, 1e-3, 1.0]),
)
def test_the_unit_and_origin_of_a_row_do_not_matter(seed, shift, scale, ridge):
    # matrix → scale·matrix + shift, target likewise, weight → weight / scale²: the same question
    p = beyond(seed, 4, 8, ridge=ridge)
    q = replace(p, matrix=scale * p.matrix + shift, target=scale * p.target + shift, weight=p.weight / scale**2)
    np.testing.assert_allclose(KKT().solve(q).alpha, KKT().solve(p).alpha, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(-1, 2), ridge=st.sampled_from([0.0, 1e-3, 1.0]))
def test_alpha_is_affine_in_the_target(seed, share, ridge):
    p, draw = beyond(seed, 3, 7, ridge=ridge), np.random.default_rng(seed)
    a, b = draw.normal(size=(2, 3))
    alpha = KKT().solve_many(p, np.stack([a, b, (1 - share) * a + share * b])).alpha
    np.testing.assert_allclose(alpha[2], (1 - share) * alpha[0] + share * alpha[1], atol=1e-7)


def test_ten_thousand_targets_are_as_one_by_one():
    p = problem(4, 5, 20, ridge=1e-3, hard=np.array([True, False, False, False, False]))
    targets = np.random.default_rng(0).uniform(-3, 3, (10_000, 5))
    batch = KKT().solve_many(p, targets)
    assert len(batch) == 10_000
    np.testing.assert_allclose(batch.alpha.sum(1), 1, atol=1e-9)
    np.testing.assert_allclose(batch.residual, batch.alpha @ p.matrix.T - targets, atol=1e-9)
    for i in range(0, 10_000, 50):
        alone = KKT().solve(replace(p, target=targets[i]))
        np.testing.assert_allclose(batch.alpha[i], alone.alpha, atol=1e-9)
        np.testing.assert_allclose(batch.residual[i], alone.residual, atol=1e-9)
        assert batch.status[i] == alone.status
    # all of them: alpha is affine in the target, so six solved alone tell the rest
    alone = np.stack([KKT().solve(replace(p, target=t)).alpha for t in np.vstack([np.zeros(5), np.eye(5)])])
    np.testing.assert_allclose(batch.alpha, alone[0] + targets @ (alone[1:] - alone[0]), atol=1e-9)


def test_each_of_many_has_a_status_of_its_own():
    row = np.array([-1.0, 0.0, 1.0])
    p = Problem(names(2), np.vstack([row, row]), np.zeros(2))
    batch = KKT().solve_many(p, np.array([[0.5, 0.5], [0.5, -0.5], [3.0, 3.0]]), np.array([0.0, 0.0, 1.0]))
    assert batch.status == ("exact", "infeasible", "inexact")


def planted(seed):
    """Eight exemplars, three free rows and one contradiction: a copy, a combination, a constant or a shifted copy."""
    draw = np.random.default_rng(seed)
    matrix = draw.uniform(-1, 1, (3, 8))
    reach = draw.normal(size=8)
    target = matrix @ (reach + (1 - reach.sum()) / 8)
    off = draw.choice([-1, 1]) * draw.uniform(0.05, 1)
    kind = ("copy", "combination", "constant", "shifted")[seed % 4]
    if kind == "copy":
        row, value, clash = matrix[1], target[1] + off, {"q1", "new"}
    elif kind == "combination":
        factors = draw.uniform(0.5, 2, 2) * draw.choice([-1, 1], 2)
        row, value, clash = factors @ matrix[[0, 2]], factors @ target[[0, 2]] + off, {"q0", "q2", "new"}
    elif kind == "constant":
        row, value, clash = np.full(8, 0.3), 0.3 + off, {"new"}
    else:
        row, value, clash = 2 * matrix[2] + 0.7, 2 * target[2] + 0.7 + off, {"q2", "new"}
    place = int(draw.integers(4))
    labels = list(names(3))
    labels.insert(place, "new")
    return Problem(
        tuple(labels), np.insert(matrix, place, row, 0), np.insert(target, place, value), ridge=0.0
    ), clash, abs(off)  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_planted_contradictions_are_named_exactly_and_resolved(seed):
    p, clash, off = planted(seed)
    mix = KKT().solve(p)
    assert mix.status == "infeasible"
    assert [set(c.names) for c in mix.conflicts] == [clash]
    assert all(name in mix.message for name in clash)
    assert ("cannot move" in mix.message) == (clash == {"new"})
    relaxed = np.array(p.target)
    for conflict in mix.conflicts:
        relaxed[[p.names.index(name) for name in conflict.names]] += conflict.amounts
    again = KKT().solve(replace(p, target=relaxed))
    assert again.status == "exact"
    assert not again.conflicts
    assert np.abs(relaxed - p.target).max() <= off + 1e-9  # never more than what was planted


@pytest.mark.parametrize("seed", range(4))
def test_the_amounts_are_the_least_change(seed):
    p, _, _ = planted(4 * seed + 1)
    (conflict,) = KKT().solve(p).conflicts
    # targets that some mix meets: the affine hull of the exemplars' rows; the nearest of them by projection
    middle = p.matrix.mean(1)
    u = np.linalg.svd(p.matrix - middle[:, None], full_matrices=False)
    basis = u[0][:, u[1] > 1e-9]
    nearest = middle + basis @ basis.T @ (p.target - middle)
    change = np.zeros(4)
    change[[p.names.index(name) for name in conflict.names]] = conflict.amounts
    np.testing.assert_allclose(p.target + change, nearest, atol=1e-8)


def test_two_contradictions_are_told_apart():
    draw = np.random.default_rng(5)
    a, b, free = draw.uniform(-1, 1, (3, 9))
    p = Problem(
        ("a", "b", "free", "a2", "still", "b2"),
        np.stack([a, b, free, a, np.zeros(9), -b]),
        np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
    )
    mix = KKT().solve(p)
    assert {frozenset(c.names) for c in mix.conflicts} == {
        frozenset({"a", "a2"}), frozenset({"b", "b2"}), frozenset({"still"}),
    }  # fmt: skip
    assert mix.residual[2] == pytest.approx(0, abs=1e-9)  # the row that clashes with none is met


def test_dependent_rows_that_agree_are_no_conflict():
    p = problem(3, 2, 6)
    twice = Problem(names(4), np.vstack([p.matrix, p.matrix]), np.tile(p.target, 2))
    mix = KKT().solve(twice)
    assert mix.status == "exact"
    assert not mix.conflicts


@pytest.mark.parametrize("hard", [False, True])
def test_the_nearest_is_returned_where_rows_clash(hard):
    row = np.array([-1.0, 0.0, 1.0])
    p = Problem(names(2), np.vstack([row, row]), np.array([0.4, 0.2]), hard=np.full(2, hard))
    mix = KKT().solve(p)
    assert row @ mix.alpha == pytest.approx(0.3)
    np.testing.assert_allclose(mix.residual, [-0.1, 0.1], atol=1e-12)


@pytest.mark.parametrize("copies", [1, 2])
def test_a_soft_row_that_only_repeats_hard_ones_gives_way(copies):
    # what is left of it beside the hard rows is rounding, no direction to move in
    draw = np.random.default_rng(0)
    hard = draw.uniform(-1, 1, (2, 9))
    soft = draw.uniform(0.5, 2, (copies, 2)) @ hard
    p = Problem(names(2 + copies), np.vstack([hard, soft]), np.full(2 + copies, 0.5), hard=np.arange(2 + copies) < 2)
    mix = KKT().solve(p)
    alone = KKT().solve(Problem(names(2), hard, np.full(2, 0.5), hard=np.ones(2)))
    np.testing.assert_allclose(mix.alpha, alone.alpha, atol=1e-9)
    assert mix.status == "infeasible"


@pytest.mark.parametrize("off", [1.0, 1e-3, 1e-6])
def test_a_small_contradiction_is_one(off):
    row = np.array([-1.0, 0.0, 1.0])
    p = Problem(names(2), np.vstack([row, row]), np.array([0.5, 0.5 + off]))
    mix = KKT().solve(p)
    assert mix.status == "infeasible"
    (conflict,) = mix.conflicts
    np.testing.assert_allclose(conflict.amounts, [off / 2, -off / 2], rtol=1e-6)


def test_too_many_rows_come_out_as_least_squares():
    p = beyond(1, 15, 6)
    mix = KKT().solve(p)
    root = np.sqrt(p.weight)
    centred = p.matrix - p.matrix.mean(1, keepdims=True)
    wanted = np.linalg.lstsq(root[:, None] * centred, root * (p.target - p.matrix.mean(1)), rcond=None)[0]
    np.testing.assert_allclose(p.matrix @ mix.alpha, p.matrix @ (wanted + (1 - wanted.sum()) / 6), atol=1e-9)
    assert mix.status == "infeasible"
    assert mix.conflicts


def test_one_exemplar_is_all_there_is():
    p = Problem(names(2), np.array([[0.5], [-0.5]]), np.array([0.5, 0.0]))
    mix = KKT().solve(p)
    assert mix.alpha.tolist() == [1.0]
    assert mix.status == "infeasible"
    assert [c.names for c in mix.conflicts] == [("q1",)]
    assert KKT().solve(replace(p, target=np.array([0.5, -0.5]))).status == "exact"


@pytest.mark.parametrize("value", [0.1, 0.3, -0.7734, 1 / 3, 1e6 / 7])
@pytest.mark.parametrize("hard", [False, True])
def test_a_row_in_which_all_exemplars_agree_moves_nothing(value, hard):
    """Though centring leaves rounding noise of it, whose direction means nothing."""
    centre = np.random.default_rng(0).dirichlet(np.ones(12))
    p = Problem(("q",), np.full((1, 12), value), np.array([value + 1]), hard=np.full(1, hard), centre=centre, ridge=0.0)
    mix = KKT().solve(p)
    np.testing.assert_allclose(mix.alpha, centre, atol=1e-12)
    assert mix.status == "infeasible"
    assert [c.names for c in mix.conflicts] == [("q",)]
    assert KKT().solve(replace(p, target=np.array([value]))).status == "exact"
    other = np.random.default_rng(1).uniform(-1, 1, (2, 12))
    asked = Problem(("q",), other[:1], np.array([1.5]), centre=centre, ridge=0.0)
    free, still = KKT().solve(asked), KKT().solve(replace(asked, still=p.matrix))
    np.testing.assert_allclose(still.alpha, free.alpha, atol=1e-12)
    both = KKT().solve(replace(asked, still=np.vstack([p.matrix, other[1:]])))
    np.testing.assert_allclose(both.alpha, KKT().solve(replace(asked, still=other[1:])).alpha, atol=1e-9)


def test_nothing_asked_is_the_centre():
    centre = np.array([0.7, 0.2, 0.1])
    mix = KKT().solve(Problem((), np.empty((0, 3)), np.empty(0), centre=centre))
    np.testing.assert_allclose(mix.alpha, centre, atol=1e-15)
    assert mix.status == "exact"
    batch = KKT().solve_many(Problem((), np.empty((0, 3)), np.empty(0), centre=centre), np.empty((3, 0)))
    np.testing.assert_allclose(batch.alpha, np.tile(centre, (3, 1)))


@pytest.mark.parametrize("scale", [1e-8, 1e-6, 1e6])
def test_rows_of_any_scale_are_met(scale):
    p = problem(6, 3, 8)
    q = replace(p, matrix=p.matrix * [[1], [scale], [1]], target=p.target * [1, scale, 1])
    mix = KKT().solve(q)
    assert np.isfinite(mix.alpha).all()
    np.testing.assert_allclose(mix.alpha, KKT().solve(p).alpha, atol=1e-6)
    assert mix.status == "exact"


def test_a_small_row_that_cannot_be_met_is_not_passed_over():
    # misses are judged in the rows' own scale: 1e-8 of a row whose entries are 1e-8 is all of it
    row = 1e-8 * np.array([-1.0, 0.0, 1.0])
    p = Problem(names(2), np.vstack([row, np.array([-1.0, 0.0, 1.0])]), np.array([1.0, 1.0]))
    mix = KKT().solve(p)
    assert mix.status == "infeasible"


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), near=st.floats(1e-7, 1e-3))
def test_almost_equal_rows_are_two_rows(seed, near):
    draw = np.random.default_rng(seed)
    row, other = draw.uniform(-1, 1, (2, 8))
    assume(np.linalg.norm(other - other.mean()) > 0.1)
    matrix = np.stack([row, row + near * other])
    alpha = draw.normal(size=8)
    alpha += (1 - alpha.sum()) / 8
    mix = KKT().solve(Problem(names(2), matrix, matrix @ alpha))
    assert mix.status == "exact"
    assert np.linalg.norm(mix.alpha - 1 / 8) <= np.linalg.norm(alpha - 1 / 8) * (1 + 1e-4)


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ("ranges", {"range_names": ("r",), "range_matrix": np.ones((1, 9)), "range_low": [0], "range_high": [1]}),
        ("bounds on alpha", {"alpha_low": np.zeros(9)}),
        ("bounds on alpha", {"alpha_high": np.ones(9)}),
        ("norm=1", {"norm": 1}),
        ("objectives", {"objectives": (lambda a: (0.0, a),)}),
        ("constraints", {"constraints": (lambda a: (0.0, a),)}),
        ("equalities", {"equalities": (lambda a: (0.0, a),)}),
    ],
)
def test_what_it_is_not_able_to_take_is_refused_by_name(words, changes):
    p = problem(**changes)
    with pytest.raises(SolveError, match=rf"not able to take {words}\b.*or choose another solver, such as 'casadi'"):
        KKT().solve(p)
    with pytest.raises(SolveError, match=rf"not able to take {words}\b.*or choose another solver, such as 'casadi'"):
        KKT().solve_many(p, p.target[None])


@pytest.mark.parametrize("targets", [np.zeros(4), np.zeros((2, 3)), np.full((2, 4), np.nan), np.zeros((1, 2, 4))])
def test_targets_of_another_shape_are_refused(targets):
    with pytest.raises(InputError, match=r"targets: expected finite values of shape \(B, 4\)"):
        KKT().solve_many(problem(), targets)


@pytest.mark.parametrize("ridges", [np.zeros(3), np.array([0.0, -1.0]), np.array([0.0, np.nan])])
def test_ridges_that_do_not_fit_are_refused(ridges):
    with pytest.raises(InputError, match="ridges: expected 2 numbers"):
        KKT().solve_many(problem(), np.zeros((2, 4)), ridges)


def test_no_targets_are_no_mixes():
    assert len(KKT().solve_many(problem(), np.empty((0, 4)))) == 0


@pytest.mark.parametrize("first", ["leaves first", "leaves last"])
def test_threads_that_overlap_leave_the_users_number(first):
    threads._one_thread.cache_clear()

    def limits():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(2, "blas"):
        before, entered, left = limits(), threading.Event(), threading.Event()

        def other():
            with threads.one_thread():
                entered.set()
                left.wait(10)

        thread = threading.Thread(target=other)
        with threads.one_thread(), threads.one_thread():
            thread.start()
            entered.wait(10)
            assert limits() == {1}
            if first == "leaves last":
                left.set()
                thread.join()
                assert limits() == {1}
        left.set()
        thread.join()
        assert limits() == before
