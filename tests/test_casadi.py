"""Solver `casadi` against solutions found otherwise: closed forms, cvxpy with CLARABEL, planted contradictions."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.errors import InputError, SolveError
from lampopt.plugins import Plugins
from lampopt.testing import solver_checks
from lampopt.types import BOUNDS, Problem
from lampopt_casadi.solver import CasADi
from lampopt_kkt.kkt import KKT

SEEDS = pytest.mark.parametrize("seed", range(6))


def problem(seed=0, k=4, n=12, **changes):
    """k soft rows on [-1, 1] of n exemplars, with ranges on two rows of their own and bounds on alpha."""
    draw = np.random.default_rng(seed)
    matrix, alpha = draw.uniform(-1, 1, (k, n)), draw.normal(size=n)
    wide = draw.uniform(-1, 1, (2, n))
    given = {
        "names": tuple(f"q{i}" for i in range(k)),
        "matrix": matrix,
        "target": matrix @ (alpha + (1 - alpha.sum()) / n),
        "weight": draw.uniform(0.3, 3, k),
        "centre": draw.dirichlet(np.ones(n)),
        "ridge": 0.0,
        "range_names": ("a (range)", "b (range)"),
        "range_matrix": wide,
        "range_low": np.array([-0.2, -np.inf]),
        "range_high": np.array([0.2, 0.1]),
        "alpha_low": np.full(n, -0.8),
        "alpha_high": np.full(n, 1.0),
    }
    return Problem(**(given | changes))


def independent(p):
    """Alpha by cvxpy with CLARABEL; of all best ones the nearest to the centre."""
    import cvxpy as cp

    alpha = cp.Variable(len(p.centre))
    kept = [cp.sum(alpha) == 1]
    if p.hard.any():
        kept.append(p.matrix[p.hard] @ alpha == p.target[p.hard])
    for low, high, row in zip(p.range_low, p.range_high, p.range_matrix, strict=True):
        kept += [row @ alpha >= low] if np.isfinite(low) else []
        kept += [row @ alpha <= high] if np.isfinite(high) else []
    if p.alpha_low is not None:
        kept.append(alpha >= p.alpha_low)
    if p.alpha_high is not None:
        kept.append(alpha <= p.alpha_high)
    apart = alpha - p.centre
    size = cp.sum_squares(apart) if p.norm == 2 else cp.norm1(apart)
    soft = ~p.hard
    off = p.matrix[soft] @ alpha - p.target[soft]
    cost = cp.sum_squares(cp.multiply(np.sqrt(p.weight[soft]), off)) + p.ridge * size
    tight = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12)
    cp.Problem(cp.Minimize(cost), kept).solve(solver=cp.CLARABEL, **tight)
    if p.ridge == 0:
        kept.append(p.matrix[soft] @ alpha == np.array(p.matrix[soft] @ alpha.value))
        cp.Problem(cp.Minimize(size), kept).solve(solver=cp.CLARABEL, **tight)
    return np.array(alpha.value)


@solver_checks(CasADi())
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("solver", "casadi") == CasADi()


@SEEDS
@pytest.mark.parametrize("ridge", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize("hard", [0, 2])
def test_equals_clarabel(seed, ridge, hard):
    p = problem(seed, ridge=ridge, hard=np.arange(4) < hard, range_low=np.array([-0.4, -np.inf]))
    mix = CasADi().solve(p)
    assert mix.alpha == pytest.approx(independent(p), abs=1e-6)
    values = p.range_matrix @ mix.alpha
    assert (values >= p.range_low - 1e-9).all()
    assert (values <= p.range_high + 1e-9).all()
    assert mix.alpha.min() >= -0.8 - 1e-9
    assert mix.alpha.max() <= 1.0 + 1e-9
    assert mix.alpha.sum() == pytest.approx(1, abs=1e-12)


def mixture(seed):
    """Everything that is convex at once: weights over four orders, ridges over twelve, corners, free ranges."""
    draw = np.random.default_rng([seed, 99])
    n = int(draw.integers(3, 30))
    k, q = int(draw.integers(0, min(n, 10) + 1)), int(draw.integers(0, 5))
    matrix = draw.uniform(-1, 1, (k, n))
    inside, alpha = draw.dirichlet(np.full(n, float(draw.choice([0.3, 3.0])))), draw.normal(size=n)
    target = matrix @ (alpha + (1 - alpha.sum()) / n)
    hard, rows = draw.random(k) < 0.3, draw.uniform(-1, 1, (q, n))
    low = rows @ inside - np.where(draw.random(q) < 0.3, np.inf, draw.choice([0, 0.01, 0.1, 1], q))
    high = rows @ inside + np.where(draw.random(q) < 0.3, np.inf, draw.choice([0, 0.01, 0.1, 1], q))
    bounds = {}
    if draw.random() < 0.6:
        free = draw.random(n) < 0.2
        bounds["alpha_low"] = np.where(free, -np.inf, np.minimum(inside, draw.choice([-0.5, -0.1, 0.0])))
    if draw.random() < 0.6:
        free = draw.random(n) < 0.2
        bounds["alpha_high"] = np.where(free, np.inf, np.maximum(inside, draw.choice([0.3, 0.6, 1.0])))
    ridge = float(draw.choice([0.0, 1e-6, 1e-3, 1.0, 1e3, 1e6]))
    return Problem(
        tuple(f"q{i}" for i in range(k)), matrix, np.where(hard, matrix @ inside, target), hard=hard,
        weight=10 ** draw.uniform(-2, 2, k), ridge=ridge,
        centre=np.eye(n)[0] if draw.random() < 0.3 else draw.dirichlet(np.ones(n)),
        range_names=tuple(f"r{i}" for i in range(q)), range_matrix=rows, range_low=low, range_high=high, **bounds,
    )  # fmt: skip


def unproven(p, alpha):
    """What is left of the gradient when the rows that hold with equality have taken their part [ridge]."""
    from scipy.optimize import lsq_linear

    soft, n = ~p.hard, len(alpha)
    gradient = 2 * p.matrix[soft].T @ (p.weight[soft] * (p.matrix[soft] @ alpha - p.target[soft]))
    gradient += 2 * p.ridge * (alpha - p.centre)
    ends = [(p.range_matrix, p.range_low, p.range_high)]
    ends.append(
        (np.eye(n), *(np.full(n, v) if b is None else b for v, b in ((-np.inf, p.alpha_low), (np.inf, p.alpha_high))))
    )
    columns = [(row, -np.inf, np.inf) for row in (np.ones(n), *p.matrix[p.hard])]
    for rows, low, high in ends:
        for row, least, most in zip(rows, low, high, strict=True):
            columns += [(row, 0, np.inf)] if row @ alpha - least < 1e-8 else []
            columns += [(-row, 0, np.inf)] if most - row @ alpha < 1e-8 else []
    rows, low, high = (np.array(part) for part in zip(*columns, strict=True))
    found = lsq_linear(rows.T, gradient, (low, high), tol=1e-14, max_iter=1000).x
    return np.abs(rows.T @ found - gradient).max() / (2 * p.ridge)


HARD_ONES = (190, 230, 290, 1367)  # of which HiGHS made nonsense, or a hair too much


@pytest.mark.parametrize("seed", [seed for seed in (*range(40), *HARD_ONES) if mixture(seed).ridge > 0])
def test_what_is_found_is_best_by_its_multipliers(seed):
    p = mixture(seed)
    alpha = CasADi().solve(p).alpha
    assert unproven(p, alpha) < 1e-6
    for value, low, high in (
        (p.range_matrix @ alpha, p.range_low, p.range_high),
        (alpha, -np.inf if p.alpha_low is None else p.alpha_low, np.inf if p.alpha_high is None else p.alpha_high),
        (p.matrix[p.hard] @ alpha, p.target[p.hard], p.target[p.hard]),
    ):
        assert (value >= low - 1e-8).all()
        assert (value <= high + 1e-8).all()


@pytest.mark.parametrize("seed", [1259, 1463, 827, 1183])
def test_without_a_ridge_too(seed):
    """Where HiGHS went round in circles for ever, and others ended where nothing was to be gained, but not nearest."""
    p = mixture(seed)
    assert p.ridge == 0
    assert CasADi().solve(p).alpha == pytest.approx(independent(p), abs=1e-6)


def test_nothing_is_printed(capfd):
    for seed in range(20):
        for norm in (1, 2):
            CasADi().solve(replace(mixture(seed), norm=norm))
    assert capfd.readouterr() == ("", "")


def test_a_batch_tells_no_reasons_but_the_same_answers():
    for seed in (0, 1, 2, 827):
        p = mixture(seed)
        alone, batch = CasADi().solve(p), CasADi().solve_many(p, p.target[None])
        assert batch.status == (alone.status,)
        assert batch.alpha[0] == pytest.approx(alone.alpha, abs=1e-12)


@SEEDS
@pytest.mark.parametrize("ridge", [1e-2, 1.0])
def test_equals_clarabel_in_norm_1(seed, ridge):
    p = problem(seed, ridge=ridge, norm=1)
    mix, other = CasADi().solve(p), independent(p)

    def cost(alpha):
        return p.weight @ (p.matrix @ alpha - p.target) ** 2 + ridge * np.abs(alpha - p.centre).sum()

    assert cost(mix.alpha) == pytest.approx(cost(other), abs=1e-7)
    assert p.matrix @ mix.alpha == pytest.approx(p.matrix @ other, abs=1e-5)


@SEEDS
def test_a_front_of_ridges_is_the_closed_forms(seed):
    free = {"range_names": (), "range_matrix": None, "range_low": None, "range_high": None}
    p = problem(seed, **free, alpha_low=None, alpha_high=None)
    ridges = np.logspace(-6, 2, 12)
    targets = np.tile(p.target, (12, 1))
    ours, closed = CasADi().solve_many(p, targets, ridges), KKT().solve_many(p, targets, ridges)
    assert ours.alpha == pytest.approx(closed.alpha, abs=1e-9)
    assert ours.status == closed.status


def test_a_range_that_does_not_press_costs_nothing():
    p = problem(alpha_low=None, alpha_high=None, range_low=np.full(2, -50.0), range_high=np.full(2, 50.0))
    closed = KKT().solve(replace(p, range_names=(), range_matrix=None, range_low=None, range_high=None))
    assert CasADi().solve(p).alpha == pytest.approx(closed.alpha, abs=1e-12)


@SEEDS
@pytest.mark.parametrize("ridge", [0.0, 0.1])
def test_what_should_be_still_moves_least(seed, ridge):
    """Both solvers; as hard rows would have it where there is freedom enough, as least squares where there is not."""
    free = {"range_names": (), "range_matrix": None, "range_low": None, "range_high": None}
    p = problem(seed, **free, alpha_low=None, alpha_high=None, ridge=ridge)
    still = np.random.default_rng([seed, 9]).uniform(-1, 1, (9, 12))
    for rows in (still[:3], still):
        asked = replace(p, still=rows)
        closed = KKT().solve(asked)
        assert CasADi().solve(asked).alpha == pytest.approx(closed.alpha, abs=1e-8)
        assert closed.residual == pytest.approx(KKT().solve(p).residual, abs=1e-9)
        moved = rows @ (closed.alpha - p.centre)
        if len(rows) == 3:
            assert moved == pytest.approx(np.zeros(3), abs=1e-9)
        else:
            exact = np.vstack([np.ones(12), p.matrix])
            start = closed.alpha
            basis = np.linalg.svd(exact)[2][5:].T
            better = np.linalg.lstsq(rows @ basis, -rows @ (start - p.centre), rcond=None)[0]
            assert np.abs(rows @ basis @ better).max() < 1e-8  # nothing is left to gain


def test_ranges_come_before_what_should_be_still():
    row = np.array([[-1.0, 0.0, 0.5, 1.0], [1.0, -1.0, 0.0, 0.4]])
    p = Problem((), np.empty((0, 4)), np.empty(0), ridge=0.0, still=row[:1], range_names=("q (range)",),
                range_matrix=row[1:], range_low=np.array([0.5]), range_high=np.array([np.inf]))  # fmt: skip
    alpha = CasADi().solve(p).alpha
    assert row @ alpha == pytest.approx([row[0].mean(), 0.5], abs=1e-8)


@pytest.mark.parametrize("value", [0.1, 0.3, -0.7734, 1 / 3])
@pytest.mark.parametrize("hard", [False, True])
def test_a_row_in_which_all_exemplars_agree_moves_nothing(value, hard):
    """Though centring leaves rounding noise of it, whose direction means nothing."""
    centre = np.random.default_rng(0).dirichlet(np.ones(12))
    p = Problem(("q",), np.full((1, 12), value), np.array([value + 1]), hard=np.full(1, hard), centre=centre, ridge=0.0)
    mix = CasADi().solve(p)
    assert mix.alpha == pytest.approx(centre, abs=1e-8)
    assert mix.status == "infeasible"
    assert [c.names for c in mix.conflicts] == [("q",)]
    assert mix.conflicts[0].alone == pytest.approx([-1], abs=1e-8)
    assert CasADi().solve(replace(p, target=np.array([value]))).status == "exact"
    other = np.random.default_rng(1).uniform(-1, 1, (2, 12))
    asked = Problem(("q",), other[:1], np.array([1.5]), centre=centre, ridge=0.0)
    for limits in ({}, {"alpha_high": np.full(12, 0.3)}):
        bound = replace(asked, **limits)
        still = CasADi().solve(replace(bound, still=p.matrix))
        assert still.alpha == pytest.approx(CasADi().solve(bound).alpha, abs=1e-8)
        both = CasADi().solve(replace(bound, still=np.vstack([p.matrix, other[1:]])))
        assert both.alpha == pytest.approx(CasADi().solve(replace(bound, still=other[1:])).alpha, abs=1e-8)


# What cannot be had


def test_bounds_that_leave_no_mix_are_told_where_nothing_else_is_asked():
    p = Problem((), np.empty((0, 3)), np.empty(0), ridge=0.0, alpha_high=np.full(3, 0.3))
    mix = CasADi().solve(p)
    assert mix.status == "infeasible"
    assert [c.names for c in mix.conflicts] == [(BOUNDS,)]
    assert mix.conflicts[0].alone == pytest.approx([1 / 3 - 0.3], abs=1e-8)
    assert CasADi().solve_many(p, np.empty((2, 0))).status == ("infeasible",) * 2
    for row in (np.array([0.2]), np.array([50.0])):  # met, or not
        asked = replace(p, names=("q",), matrix=np.array([[-1.0, 0.0, 1.0]]), target=row, weight=None, hard=None)
        assert CasADi().solve(asked).status == "infeasible"
    term = replace(p, objectives=(lambda a: (float(a @ a), 2 * a),))
    assert CasADi().solve(term).status == "infeasible"


def contradictory(seed):
    """Eight requirements that one alpha meets, and a ninth that clashes with two of them; its name, and by how much."""
    draw = np.random.default_rng(seed)
    n = 20
    rows = draw.uniform(-1, 1, (8, n))
    met = rows @ (draw.normal(0, 0.2, n) + 1 / n)
    i, j = draw.choice(6, 2, replace=False)
    amount = float(draw.uniform(0.1, 0.5))
    culprit = rows[i] - 2 * rows[j]  # demands what i and j together forbid
    alpha = np.linalg.lstsq(np.vstack([np.ones(n), rows]), np.append(1, met), rcond=None)[0]
    p = Problem(
        (*(f"q{k}" for k in range(6)), "culprit"),
        np.vstack([rows[:6], culprit]),
        np.append(rows[:6] @ alpha, culprit @ alpha + amount),
        hard=draw.random(7) < 0.5,
        range_names=("r6 (range)", "r7 (range)"),
        range_matrix=rows[6:],
        range_low=rows[6:] @ alpha - 0.1,
        range_high=rows[6:] @ alpha + 0.1,
        ridge=0.0,
    )
    return p, {f"q{i}", f"q{j}", "culprit"}, amount


@pytest.mark.parametrize("seed", range(20))
def test_a_planted_contradiction_is_named(seed):
    p, names, amount = contradictory(seed)
    mix = CasADi().solve(p)
    (conflict,) = mix.conflicts
    assert mix.status == "infeasible"
    assert set(conflict.names) == names
    assert conflict.alone[conflict.names.index("culprit")] == pytest.approx(-amount, abs=1e-7)
    target = np.array(p.target)
    target[[p.names.index(name) for name in conflict.names]] += conflict.amounts
    mended = CasADi().solve(replace(p, target=target))
    assert np.abs(mended.residual).max() < 1e-6
    assert mended.status in ("exact", "inexact")


@SEEDS
def test_the_one_that_is_in_everybodys_way_is_the_culprit(seed):
    """One target beyond two ranges, each of which forbids it on its own: no range giving way alone is enough."""
    draw = np.random.default_rng([seed, 1])
    rows = draw.uniform(-1, 1, (3, 20))
    p = Problem(
        ("beyond", "other"), rows[:2], np.array([1.0, 0.2]), hard=np.ones(2), ridge=0.0,
        range_names=("one (range)", "two (range)", "free (range)"),
        range_matrix=np.stack([rows[0], rows[0] + rows[1], rows[2]]),
        range_low=np.array([-1.0, -np.inf, -5.0]), range_high=np.array([0.5, 0.9, 5.0]),
    )  # fmt: skip
    mix = CasADi().solve(p)
    assert mix.conflicts[0].culprit == "beyond"
    alone = dict(zip(mix.conflicts[0].names, mix.conflicts[0].alone, strict=True))
    assert alone.pop("beyond") == pytest.approx(-0.5, abs=1e-8)  # to 0.5; the second range would leave it 0.7
    assert "one (range)" in alone or "two (range)" in alone
    assert "free (range)" not in alone
    assert np.isinf([size for name, size in alone.items() if name != "other"]).all()


def test_bounds_that_stand_in_the_way_are_named():
    p = Problem(
        ("q",), np.array([[-1.0, 0.0, 1.0]]), np.array([1.5]), hard=np.ones(1), ridge=0.0, alpha_low=np.zeros(3)
    )
    mix = CasADi().solve(p)
    (conflict,) = mix.conflicts
    assert mix.status == "infeasible"
    assert conflict.names == ("q", BOUNDS)
    # alpha = (-s, -s, 1 + 2 s) gives 1 + 3 s, so that 1.5 asks for s = 1/6
    assert conflict.alone == pytest.approx([-0.5, 1 / 6], abs=1e-8)
    assert mix.alpha == pytest.approx([0, 0, 1], abs=1e-8)


def test_bounds_that_leave_no_mix_at_all_are_named():
    p = Problem(("q",), np.array([[-1.0, 0.0, 1.0]]), np.array([0.1]), ridge=0.0, alpha_high=np.full(3, 0.2))
    mix = CasADi().solve(p)
    assert mix.status == "infeasible"
    assert mix.conflicts[0].names == (BOUNDS,)
    assert mix.conflicts[0].alone == pytest.approx([1.1 / 3 - 0.2], abs=1e-8)  # c − a = 0.1 with b = c at the bound
    assert mix.alpha == pytest.approx(np.full(3, 1 / 3), abs=1e-6)


def test_soft_targets_that_ranges_forbid_are_a_conflict_and_come_near():
    row = np.array([[-1.0, 0.0, 1.0]])
    p = Problem(("q",), row, np.array([1.0]), ridge=0.0, range_names=("q (range)",), range_matrix=row,
                range_low=np.array([-1.0]), range_high=np.array([0.4]))  # fmt: skip
    mix = CasADi().solve(p)
    assert mix.status == "infeasible"
    assert set(mix.conflicts[0].names) == {"q", "q (range)"}
    assert row @ mix.alpha == pytest.approx([0.4], abs=1e-9)
    assert dict(zip(mix.conflicts[0].names, mix.conflicts[0].alone, strict=True)) == pytest.approx(
        {"q": -0.6, "q (range)": 0.6}, abs=1e-8
    )


# Terms


class Quadratic:
    """(row·alpha − to)², as an expression or by value and gradient."""

    name = "drag"

    def __init__(self, row, to):
        self.row, self.to = np.array(row, float), to

    def __call__(self, alpha):
        off = self.row @ alpha - self.to
        return float(off**2), 2 * off * self.row


class Symbolic(Quadratic):
    def symbolic(self, alpha):
        return (casadi.dot(casadi.DM(self.row), alpha) - self.to) ** 2


@SEEDS
@pytest.mark.parametrize("kind", [Quadratic, Symbolic])
def test_an_objective_joins_the_squares(seed, kind):
    """A squared row as a term and as a row of the problem are one and the same."""
    p = problem(seed, ridge=0.1)
    as_row = CasADi().solve(p)
    rest = replace(p, names=p.names[1:], matrix=p.matrix[1:], target=p.target[1:], weight=p.weight[1:], hard=None)
    root = np.sqrt(p.weight[0])
    term = kind(root * p.matrix[0], float(root * p.target[0]))
    assert CasADi().solve(replace(rest, objectives=(term,))).alpha == pytest.approx(as_row.alpha, abs=1e-6)


@pytest.mark.parametrize("kind", [Quadratic, Symbolic])
def test_a_constraint_that_presses_is_met_with_equality(kind):
    """‖alpha − centre‖ least with (x·alpha)² ≥ 1 of a row on [-1, 1]: by hand, x·alpha = 1."""
    row = np.array([-1.0, -0.5, 0.2, 1.0])

    class Far(kind):
        def __call__(self, alpha):
            value, gradient = super().__call__(alpha)
            return 1 - value, -gradient

        if kind is Symbolic:

            def symbolic(self, alpha):
                return 1 - super().symbolic(alpha)

    p = Problem((), np.empty((0, 4)), np.empty(0), ridge=1.0, constraints=(Far(row, 0.0),))
    found = CasADi().solve(p).alpha
    mean = row.mean()
    sides = [1 / 4 + (side - mean) * (row - mean) / ((row - mean) ** 2).sum() for side in (1.0, -1.0)]
    assert min(np.abs(found - side).max() for side in sides) < 1e-6


def test_an_equality_is_kept():
    row = np.array([-1.0, 0.0, 0.5, 1.0])

    class Product:
        name = "product"

        def __call__(self, alpha):
            return float(alpha[0] * alpha[1] + 0.2), np.array([alpha[1], alpha[0], 0, 0])

    p = Problem(("q",), row[None], np.array([0.3]), hard=np.ones(1), ridge=1.0, equalities=(Product(),))
    mix = CasADi().solve(p)
    assert mix.status == "exact"
    assert mix.alpha[0] * mix.alpha[1] == pytest.approx(-0.2, abs=1e-8)
    assert row @ mix.alpha == pytest.approx(0.3, abs=1e-9)


def test_terms_that_clash_are_named_with_what_they_clash_with():
    row = np.array([[-1.0, 0.0, 1.0]])
    beyond = Quadratic(row[0], 2.0)
    beyond.name = "far"

    class Near:
        name = "far"

        def __call__(self, alpha):  # (x − 2)² ≤ 0.25, so x ≥ 1.5
            value, gradient = beyond(alpha)
            return value - 0.25, gradient

    p = Problem(("free",), np.array([[1.0, -1.0, 1.0]]), np.array([0.3]), ridge=1e-6, constraints=(Near(),),
                range_names=("q (range)",), range_matrix=row, range_low=np.array([-1.0]),
                range_high=np.array([1.0]))  # fmt: skip
    mix = CasADi().solve(p)
    assert mix.status == "infeasible"
    (conflict,) = mix.conflicts
    assert set(conflict.names) == {"far", "q (range)"}
    alone = dict(zip(conflict.names, conflict.alone, strict=True))
    assert alone["q (range)"] == pytest.approx(0.5, abs=1e-5)
    assert alone["far"] == pytest.approx(0.75, abs=1e-5)
    assert np.isfinite(mix.alpha).all()


def test_a_term_without_gradient_is_refused_by_name():
    def drag(alpha):
        return float(alpha[0]), None

    drag.name = "solved drag"
    p = Problem((), np.empty((0, 3)), np.empty(0), ridge=1.0, objectives=(drag,))
    with pytest.raises(SolveError, match=r"solved drag: has no gradient.*nlopt"):
        CasADi().solve(p)


def test_an_objective_without_least_value_says_so():
    p = Problem((), np.empty((0, 3)), np.empty(0), ridge=0.0, objectives=(lambda a: (float(a[0]), np.eye(3)[0]),))
    mix = CasADi(iterations=100).solve(p)
    assert mix.status == "failed"
    assert np.isfinite(mix.alpha).all()
    assert any(word in mix.message for word in ("no least value", "number of iterations"))


def test_what_a_term_raises_is_passed_on():
    def drag(alpha):
        raise ValueError("no wind")

    p = Problem((), np.empty((0, 3)), np.empty(0), ridge=1.0, objectives=(drag,))
    with pytest.raises(ValueError, match="no wind"):
        CasADi().solve(p)


@pytest.mark.parametrize("options", [{"ridge": -1.0}, {"ridge": np.nan}, {"iterations": 0}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError):
        CasADi(**options)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 5), st.integers(2, 9))
def test_invariants(seed, k, n):
    p = problem(seed, k, n, alpha_low=None, alpha_high=None)
    mix = CasADi().solve(p)
    assert mix.alpha.sum() == pytest.approx(1, abs=1e-9)
    assert mix.residual == pytest.approx(p.matrix @ mix.alpha - p.target, abs=1e-9)
    if mix.status == "exact":
        assert np.abs(mix.residual).max(initial=0.0) < 1e-6
    assert (mix.status == "infeasible") == bool(mix.conflicts)


@pytest.mark.parametrize("seed", range(25))
def test_any_mixture_of_demands_has_an_answer_that_is_told_true(seed):
    """Degenerate ones too: rows that repeat, ranges of one point, bounds that leave a corner."""
    draw = np.random.default_rng(seed)
    n, k, q = (int(draw.integers(*ends)) for ends in ((2, 20), (0, 6), (0, 4)))
    matrix, wide = draw.uniform(-1, 1, (k, n)), draw.uniform(-1, 1, (q, n))
    if k > 1 and draw.random() < 0.4:
        matrix[-1] = matrix[0]
    low = draw.uniform(-1, 0.5, q)
    bound = draw.choice([1.0, 0.5, 0.2])
    p = Problem(
        tuple(f"q{i}" for i in range(k)), matrix, draw.uniform(-1.5, 1.5, k), hard=draw.random(k) < 0.5,
        range_names=tuple(f"r{i}" for i in range(q)), range_matrix=wide, range_low=low,
        range_high=low + draw.choice([0.0, 0.1, 1.0], q), ridge=float(draw.choice([0, 1e-3, 1])),
        alpha_low=np.full(n, -bound), alpha_high=np.full(n, bound),
    )  # fmt: skip
    mix = CasADi().solve(p)
    values = wide @ mix.alpha
    kept = (values >= p.range_low - 1e-6).all() and (values <= p.range_high + 1e-6).all()
    kept = kept and np.abs(mix.alpha).max() <= bound + 1e-6 and np.abs(mix.residual[p.hard]).max(initial=0.0) <= 1e-6
    assert kept or mix.status == "infeasible"
    if mix.status == "exact":
        assert np.abs(mix.residual).max(initial=0.0) <= 1e-6


def test_a_requirement_without_a_value_is_a_failure_with_words():
    """Not an IndexError in the middle of a study."""
    nothing = Problem((), np.empty((0, 3)), np.empty(0), ridge=1.0)
    for where in ("constraints", "equalities"):
        mix = CasADi().solve(replace(nothing, **{where: (lambda alpha: (np.nan, np.full(3, np.nan)),)}))
        assert mix.status == "failed" and "no finite value" in mix.message
