"""Solver `nlopt` against solutions found otherwise: closed forms, solver `casadi`, problems with a known optimum."""

import gc
import importlib
import itertools
import re
import signal
import sys
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

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
from lampopt_nlopt.solver import NLopt

BY_SLOPE = ("slsqp", "mma", "ccsaq")
WITHOUT = ("cobyla", "bobyqa")
SEEDS = pytest.mark.parametrize("seed", range(6))
EVERY = pytest.mark.parametrize("algorithm", [*BY_SLOPE, *WITHOUT])


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
        "range_low": np.array([-0.4, -np.inf]),
        "range_high": np.array([0.2, 0.1]),
        "alpha_low": np.full(n, -0.8),
        "alpha_high": np.full(n, 1.0),
    }
    return Problem(**(given | changes))


def free(n=3, **changes):
    """Nothing but terms over n exemplars."""
    none = {"names": (), "matrix": np.empty((0, n)), "target": np.empty(0), "ridge": 0.0}
    return Problem(**(none | changes))


class Parameters:
    """Terms over d parameters of n exemplars, and the directions that move one parameter each."""

    def __init__(self, d, n=14, seed=0, **names):
        self.rows = np.random.default_rng(seed).uniform(-1, 1, (d, n))
        self.directions = np.linalg.pinv(self.rows - self.rows.mean(1, keepdims=True)).T
        self.n = n

    def term(self, function, name=None, slope=True):
        """function(x) → value and derivatives by the parameters x; as a term that notes where it was asked."""
        rows = self.rows

        class Term:
            def __init__(self):
                self.asked = []
                if name is not None:
                    self.name = name

            def __call__(self, alpha):
                self.asked.append(np.array(alpha))
                value, by_x = function(rows @ alpha)
                return float(value), rows.T @ by_x if slope else None

        return Term()

    def problem(self, *objectives, **changes):
        return free(self.n, **({"objectives": objectives, "directions": self.directions} | changes))

    def at(self, mix):
        return self.rows @ mix.alpha


def bowl(centre, curved=1.0, lowest=0.3):
    """(x − centre)ᵀ diag(curved) (x − centre) + lowest."""
    return lambda x: (curved * (x - centre) @ (x - centre) + lowest, 2 * curved * (x - centre))


def rosenbrock(x):
    off = x[1:] - x[:-1] ** 2
    slope = np.zeros(len(x))
    slope[1:] += 200 * off
    slope[:-1] += -400 * off * x[:-1] - 2 * (1 - x[:-1])
    return 100 * off @ off + (1 - x[:-1]) @ (1 - x[:-1]), slope


def benchmark(name):
    """A module of benchmarks/, which is not installed."""
    sys.path[:0] = [p for p in (str(Path(__file__).resolve().parent.parent),) if p not in sys.path]
    return importlib.import_module(f"benchmarks.{name}")


def asked_by(term):
    return np.array(term.asked)


@pytest.mark.parametrize("algorithm", ["auto", *BY_SLOPE, *WITHOUT])
def test_conforms_by_every_algorithm(algorithm):
    from lampopt.testing import report

    found = report("solver", NLopt(algorithm))
    assert [str(r) for r in found if not r.passed] == []
    refused = {r.check for r in found if "not able to take" in r.message}
    constraints = {"check_constraints_are_kept_or_refused"} if algorithm == "bobyqa" else set()
    equalities = {"check_equalities_are_kept_or_refused"} if algorithm in ("mma", "ccsaq", "bobyqa") else set()
    assert refused == {"check_norm_1_is_used_or_refused"} | constraints | equalities


@solver_checks(NLopt())
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("solver", "nlopt") == NLopt()


def test_is_offered():
    import lampopt_nlopt

    assert Plugins.load(extra=(("nlopt", lampopt_nlopt),)).make("solver", "nlopt") == NLopt()


# Without terms


@SEEDS
@pytest.mark.parametrize("ridge", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize("hard", [0, 2])
def test_equals_casadi(seed, ridge, hard):
    p = problem(seed, ridge=ridge, hard=np.arange(4) < hard)
    mix, other = NLopt().solve(p), CasADi().solve(p)
    assert mix.alpha == pytest.approx(other.alpha, abs=1e-6)
    assert mix.status == other.status
    values = p.range_matrix @ mix.alpha
    assert (values >= p.range_low - 1e-8).all()
    assert (values <= p.range_high + 1e-8).all()
    assert mix.alpha.min() >= -0.8 - 1e-8
    assert mix.alpha.max() <= 1.0 + 1e-8


@SEEDS
@pytest.mark.parametrize("ridge", [0.0, 0.1])
@pytest.mark.parametrize("ranged", [False, True])
def test_what_should_be_still_moves_least(seed, ridge, ranged):
    still = np.random.default_rng([seed, 1]).uniform(-1, 1, (3, 12))
    p = problem(seed, ridge=ridge, still=still, alpha_low=None, alpha_high=None)
    if not ranged:
        p = replace(p, range_names=(), range_matrix=None, range_low=None, range_high=None)
    mix, other = NLopt().solve(p), CasADi().solve(p)
    moved = [np.linalg.norm(still @ (alpha - p.centre)) for alpha in (mix.alpha, other.alpha)]
    assert mix.alpha == pytest.approx(other.alpha, abs=1e-5)
    assert moved[0] <= moved[1] + 1e-6
    if not ranged:
        assert moved[0] < 1e-8


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
    mix = NLopt().solve(p)
    (conflict,) = mix.conflicts
    assert mix.status == "infeasible"
    assert set(conflict.names) == names
    assert conflict.alone[conflict.names.index("culprit")] == pytest.approx(-amount, abs=1e-7)
    target = np.array(p.target)
    target[[p.names.index(name) for name in conflict.names]] += conflict.amounts
    mended = NLopt().solve(replace(p, target=target))
    assert np.abs(mended.residual).max() < 1e-6
    assert mended.status in ("exact", "inexact")


def test_bounds_that_stand_in_the_way_are_named():
    p = Problem(
        ("q",), np.array([[-1.0, 0.0, 1.0]]), np.array([1.5]), hard=np.ones(1), ridge=0.0, alpha_low=np.zeros(3)
    )
    mix = NLopt().solve(p)
    (conflict,) = mix.conflicts
    assert mix.status == "infeasible"
    assert conflict.names == ("q", BOUNDS)
    assert conflict.alone[0] == pytest.approx(-0.5, abs=1e-8)
    assert mix.alpha == pytest.approx([0, 0, 1], abs=1e-8)


def test_bounds_that_leave_no_mix_at_all_are_named():
    p = Problem(("q",), np.array([[-1.0, 0.0, 1.0]]), np.array([0.0]), ridge=0.0, alpha_high=np.full(3, 0.2))
    mix = NLopt().solve(p)
    assert mix.status == "infeasible"
    assert mix.conflicts[0].names == (BOUNDS,)
    assert mix.conflicts[0].amounts == pytest.approx([1 / 3 - 0.2], abs=1e-12)
    assert mix.alpha == pytest.approx(np.full(3, 1 / 3), abs=1e-6)


def test_soft_targets_that_ranges_forbid_are_a_conflict_and_come_near():
    row = np.array([[-1.0, 0.0, 1.0]])
    p = Problem(("q",), row, np.array([1.0]), ridge=0.0, range_names=("q (range)",), range_matrix=row,
                range_low=np.array([-1.0]), range_high=np.array([0.4]))  # fmt: skip
    mix = NLopt().solve(p)
    assert mix.status == "infeasible"
    assert row @ mix.alpha == pytest.approx([0.4], abs=1e-8)
    alone = dict(zip(mix.conflicts[0].names, mix.conflicts[0].alone, strict=True))
    assert alone == pytest.approx({"q": -0.6, "q (range)": 0.6}, abs=1e-7)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 5), st.integers(2, 9), st.booleans())
def test_invariants(seed, k, n, bounded):
    p = problem(seed, k, n)
    p = p if bounded else replace(p, alpha_low=None, alpha_high=None)
    mix = NLopt().solve(p)
    assert mix.alpha.sum() == pytest.approx(1, abs=1e-9)
    assert mix.residual == pytest.approx(p.matrix @ mix.alpha - p.target, abs=1e-9)
    if mix.status == "exact":
        assert np.abs(mix.residual).max(initial=0.0) < 1e-6
    assert (mix.status == "infeasible") == bool(mix.conflicts)


# What is known to be the best


@SEEDS
@pytest.mark.parametrize("slope", [True, False])
def test_an_objective_joins_the_squares(seed, slope):
    """A squared row as a term and as a row of the problem are one and the same."""
    p = problem(seed, ridge=0.1)
    as_row = CasADi().solve(p)
    row, to = np.sqrt(p.weight[0]) * p.matrix[0], float(np.sqrt(p.weight[0]) * p.target[0])

    def term(alpha):
        off = row @ alpha - to
        return float(off**2), 2 * off * row if slope else None

    rest = replace(p, names=p.names[1:], matrix=p.matrix[1:], target=p.target[1:], weight=p.weight[1:], hard=None)
    mix = NLopt(evaluations=3000, tolerance=1e-9).solve(replace(rest, objectives=(term,)))
    assert mix.alpha == pytest.approx(as_row.alpha, abs=1e-5 if slope else 1e-3)


@pytest.mark.parametrize(("algorithm", "evaluations"), [("slsqp", 60), ("auto", 60), ("bobyqa", 300)])
def test_rosenbrock_has_its_least_value_at_1(algorithm, evaluations):
    over = Parameters(2)
    mix = NLopt(algorithm, evaluations=evaluations, tolerance=1e-8).solve(over.problem(over.term(rosenbrock)))
    assert over.at(mix) == pytest.approx([1, 1], abs=1e-3)


def suzuki(x):
    """Rosen & Suzuki: Hock & Schittkowski (1981), problem 43: −44 at (0, 1, 2, −1)."""
    value = x @ (x * [1, 1, 2, 1]) - x @ [5, 5, 21, -7]
    return value, 2 * x * [1, 1, 2, 1] - [5, 5, 21, -7]


SUZUKI = (
    lambda x: (x @ x + x @ [1, -1, 1, -1] - 8, 2 * x + [1, -1, 1, -1]),
    lambda x: (x @ (x * [1, 2, 1, 2]) + x @ [-1, 0, 0, -1] - 10, 2 * x * [1, 2, 1, 2] + [-1, 0, 0, -1]),
    lambda x: (x @ (x * [2, 1, 1, 0]) + x @ [2, -1, 0, -1] - 5, 2 * x * [2, 1, 1, 0] + [2, -1, 0, -1]),
)


@pytest.mark.parametrize(
    ("algorithm", "slope"), [*((name, True) for name in (*BY_SLOPE, "auto")), ("cobyla", False), ("auto", False)]
)
def test_constraints_of_rosen_and_suzuki(algorithm, slope):
    over = Parameters(4)
    p = over.problem(over.term(suzuki, slope=slope), constraints=[over.term(c, slope=slope) for c in SUZUKI])
    mix = NLopt(algorithm, evaluations=2000, tolerance=1e-9).solve(p)
    assert suzuki(over.at(mix))[0] == pytest.approx(-44, abs=1e-4)
    assert over.at(mix) == pytest.approx([0, 1, 2, -1], abs=2e-2)
    assert max(c(over.at(mix))[0] for c in SUZUKI) <= 1e-6
    assert mix.status == "exact"


@pytest.mark.parametrize("algorithm", ["auto", "cobyla"])
def test_ranges_constraint_and_equality_of_hock_and_schittkowski_71(algorithm):
    """17.0140173 at (1, 4.7429994, 3.8211503, 1.3794082), with 1 ≤ x ≤ 5; slsqp is stuck at the start, a corner."""
    over = Parameters(4)

    def cost(x):
        s = x[:3].sum()
        return x[0] * x[3] * s + x[2], x[0] * x[3] * np.array([1, 1, 1, 0]) + [x[3] * s, 0, 1, x[0] * s]

    def product(x):
        return 25 - x.prod(), -np.array([np.delete(x, i).prod() for i in range(4)])

    p = over.problem(
        over.term(cost), constraints=[over.term(product)], equalities=[over.term(lambda x: (x @ x - 40, 2 * x))],
        range_names=tuple("wxyz"), range_matrix=over.rows, range_low=np.ones(4), range_high=np.full(4, 5.0),
    )  # fmt: skip
    mix = NLopt(algorithm, evaluations=2000, tolerance=1e-9).solve(p)
    assert over.at(mix) == pytest.approx([1, 4.7429994, 3.8211503, 1.3794082], abs=1e-3)
    assert cost(over.at(mix))[0] == pytest.approx(17.0140173, abs=1e-4)
    assert mix.status == "exact"


@SEEDS
def test_without_derivatives_the_same_is_found(seed):
    draw = np.random.default_rng(seed)
    over = Parameters(3, seed=seed)
    function, limit = bowl(draw.uniform(-1, 1, 3), draw.uniform(0.2, 2, 3)), draw.uniform(-1, 1, 3)
    found = [
        NLopt(algorithm, evaluations=2000, tolerance=1e-9).solve(over.problem(over.term(function), **kept)).alpha
        for kept in ({}, {"constraints": [over.term(lambda x: (limit @ x + 0.2, limit))]})
        for algorithm in ("slsqp", "cobyla", "bobyqa")
        if algorithm != "bobyqa" or not kept
    ]
    assert found[1] == pytest.approx(found[0], abs=1e-4)
    assert found[2] == pytest.approx(found[0], abs=1e-4)
    assert found[4] == pytest.approx(found[3], abs=1e-4)


@SEEDS
def test_equals_casadi_with_terms_ranges_and_targets(seed):
    over = Parameters(5, seed=seed)
    draw = np.random.default_rng(seed)
    term, other = over.term(bowl(draw.uniform(-1, 1, 5))), over.term(bowl(np.zeros(5), lowest=-1.0))
    p = over.problem(
        term, constraints=[other], ridge=0.01, names=("a", "b"), matrix=over.rows[:2], target=np.array([0.4, -0.9]),
        hard=np.array([True, False]), range_names=("c",), range_matrix=over.rows[2:3], range_low=np.array([-0.2]),
        range_high=np.array([0.2]),
    )  # fmt: skip
    mix = NLopt(search="all", tolerance=1e-10).solve(p)
    assert mix.alpha == pytest.approx(CasADi().solve(p).alpha, abs=1e-4)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("algorithm", ["auto", "bobyqa", "cobyla"])
def test_the_unit_of_an_objective_does_not_matter(unit, algorithm):
    over, centre = Parameters(3), np.array([0.3, -0.4, 0.9])

    def function(x):
        value, slope = bowl(centre, np.array([1.0, 2.0, 0.5]))(x)
        return unit * value, unit * slope

    mix = NLopt(algorithm).solve(over.problem(over.term(function)))
    assert over.at(mix) == pytest.approx(centre, abs=2e-3)


def test_the_benchmark_of_searches_has_a_cell_for_all_that_can_be_taken():
    import lampopt_nlopt

    searches = benchmark("searches")
    *lines, _, worst = searches.table(Plugins.load(extra=(("nlopt", lampopt_nlopt),)), range(1), (3,)).splitlines()
    cells = {line.split("`")[1]: re.findall(r"\d+", line) for line in lines[2:]}
    assert {name: len(found) for name, found in cells.items()} == dict.fromkeys(searches.ALGORITHMS, 5) | {"bobyqa": 3}
    assert float(worst) < 1e-2
    for name in searches.ALGORITHMS:
        assert f"`{name}` |" in (Path(__file__).parent.parent / "docs" / "solvers.md").read_text("utf-8")


# The last digits


@pytest.mark.parametrize("n", [12, 24])
@pytest.mark.parametrize("case", ["ball", "valley", "exponential", "outside", "square"])
def test_where_terms_have_gradients_the_last_digits_are_those_of_closed_forms(case, n):
    make = getattr(benchmark("solver_problems"), case)
    for seed in range(3):
        p, alpha, _ = make(seed, n)
        mix = NLopt(evaluations=150, tolerance=1e-10).solve(p)
        assert mix.alpha == pytest.approx(alpha, abs=1e-8)
        assert "slsqp: " in mix.message


def test_a_search_from_where_squares_are_least_takes_no_longer():
    """There the slope is rounding, by which nothing can be scaled."""
    p, alpha, _ = benchmark("solver_problems").ball(3, 24)
    mix = NLopt("slsqp", evaluations=45).solve(p)
    assert mix.alpha == pytest.approx(alpha, abs=1e-3)
    assert "tolerance is reached" in mix.message


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("algorithm", [*BY_SLOPE, "auto"])
def test_the_answer_does_not_gain_by_being_beyond_a_limit(algorithm, unit):
    over = Parameters(4)

    def cost(x):
        value, slope = suzuki(x)
        return unit * value, unit * slope

    mix = NLopt(algorithm).solve(over.problem(over.term(cost), constraints=[over.term(c) for c in SUZUKI]))
    assert over.at(mix) == pytest.approx([0, 1, 2, -1], abs=1e-5)
    assert max(c(over.at(mix))[0] for c in SUZUKI) <= 1e-7


@pytest.mark.parametrize("unit", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("algorithm", BY_SLOPE)
def test_the_unit_of_a_constraint_does_not_matter(algorithm, unit):
    """What moves alpha by nothing may still be beyond a limit."""
    over = Parameters(4)
    kept = [over.term(lambda x, c=c: tuple(unit * part for part in c(x))) for c in SUZUKI]
    mix = NLopt(algorithm).solve(over.problem(over.term(suzuki), constraints=kept))
    assert over.at(mix) == pytest.approx([0, 1, 2, -1], abs=1e-5)
    assert mix.status == "exact"


@pytest.mark.parametrize("size", [[1, 3, 5], [1, 10, 3]])
@pytest.mark.parametrize("algorithm", BY_SLOPE)
def test_a_cost_that_bends_down_across_a_limit(algorithm, size):
    """The largest box of three sides, size·x ≤ 3: each has a third of it."""
    over = Parameters(3)
    volume = over.term(lambda x: (-x.prod(), -np.array([np.delete(x, i).prod() for i in range(3)])))
    p = over.problem(
        volume, range_names=("size", "a", "b", "c"), range_matrix=np.vstack([size @ over.rows, over.rows]),
        range_low=np.array([-np.inf, 0.1, 0.1, 0.1]), range_high=np.array([3.0, np.inf, np.inf, np.inf]),
    )  # fmt: skip
    assert size * over.at(NLopt(algorithm).solve(p)) == pytest.approx(np.ones(3), abs=1e-5)


def test_what_bends_nothing_does_not_hide_the_last_digits():
    """Four of 59 variables matter; a gradient of 1e4 tells of the others by rounding alone."""
    over = Parameters(4, n=60)
    term = over.term(lambda x: tuple(1e4 * part for part in suzuki(x)))
    p = over.problem(term, constraints=[over.term(c) for c in SUZUKI])
    assert over.at(NLopt("ccsaq", search="all").solve(p)) == pytest.approx([0, 1, 2, -1], abs=1e-5)


def test_a_gradient_that_leads_astray_does_not_cost_the_best():
    over, centre = Parameters(3), np.array([0.6, 0.2, -0.3])
    term = over.term(lambda x: (bowl(centre)(x)[0], bowl(centre + 0.1)(x)[1]))
    mix = NLopt("mma").solve(over.problem(term))
    values = [bowl(centre)(over.rows @ alpha)[0] for alpha in term.asked]
    assert bowl(centre)(over.at(mix))[0] == min(values) < values[-1]


def test_where_newtons_steps_lead_no_nearer_they_end_soon():
    """Noise that no term tells of."""
    over, centre, counts = Parameters(4), np.array([0.6, 0.2, -0.3, 0.8]), []

    def noisy(x):
        value, slope = bowl(centre)(x)
        return value, slope + 1e-2 * np.sin(1e5 * x)

    for told in (True, False):
        term = over.term(noisy)
        term.rough = told
        mix = NLopt("mma").solve(over.problem(term))
        counts.append(len(term.asked))
        assert over.at(mix) == pytest.approx(centre, abs=1e-2)
    assert counts[0] < counts[1] <= counts[0] + 8


@pytest.mark.parametrize("limit", ["range", "bound"])
def test_ranges_and_bounds_that_press_are_met_with_equality(limit):
    """A sum of exp(x) is least where each x is; that all of alpha add to 1 is in its way."""
    p = free(
        4, objectives=(lambda a: (float(np.exp(a).sum()), np.exp(a)),),
        **({"range_names": ("r",), "range_matrix": np.eye(4)[:1], "range_low": np.array([0.4])} if limit == "range"
           else {"alpha_low": np.array([0.4, *np.full(3, -1.0)])}),
    )  # fmt: skip
    assert NLopt().solve(p).alpha == pytest.approx([0.4, 0.2, 0.2, 0.2], abs=1e-8)


def test_what_has_the_noise_of_single_precision_is_spared_its_last_digits():
    over, asked = Parameters(4), []
    for noise in (False, True):
        term, *kept = (over.term(function) for function in (suzuki, *SUZUKI))
        kept[0].rough = noise
        NLopt("ccsaq").solve(over.problem(term, constraints=kept))
        asked.append(asked_by(term))
    smooth, rough = asked
    assert len(rough) < len(smooth)
    assert np.array_equal(rough, smooth[: len(rough)])


def test_the_last_digits_are_within_the_budget():
    over, counts = Parameters(4), []
    for most in (200, *range(20, 30)):
        term, *kept = (over.term(function) for function in (suzuki, *SUZUKI))
        mix = NLopt("ccsaq", evaluations=most).solve(over.problem(term, constraints=kept))
        counts.append(len(term.asked))
        assert (f"budget of {most} evaluations is spent" in mix.message) == (most < counts[0])
    assert 20 < counts[0] < 30
    assert counts[1:] == [min(most, counts[0]) for most in range(20, 30)]


def test_a_wall_before_the_last_digits_is_kept_clear_of():
    """The search ends near the least value; just there the term has none."""
    over, centre = Parameters(3), np.array([0.6, 0.2, -0.3])

    def drag(x):
        value, slope = bowl(centre)(x)
        return value + ((x - centre) ** 4).sum(), slope + 4 * (x - centre) ** 3

    hole = over.term(walled(drag, lambda x: np.abs(x - centre).max() < 1e-4))
    mix = NLopt("slsqp").solve(over.problem(hole))
    assert 1e-4 <= np.abs(over.at(mix) - centre).max() < 1e-2
    assert len(hole.asked) < 100


# Where is searched


@EVERY
@pytest.mark.parametrize("search", ["parameters", "all"])
def test_the_sum_and_hard_rows_hold_at_every_evaluation(algorithm, search):
    over = Parameters(5)
    term = over.term(bowl(np.array([0.9, -0.8, 0.7, 0.1, 0.0]), np.array([1.0, 5.0, 0.1, 1.0, 1.0])))
    p = over.problem(
        term, ridge=1e-4, names=("a", "b"), matrix=over.rows[[0, 3]], target=np.array([1.7, -0.6]), hard=np.ones(2)
    )
    mix = NLopt(algorithm, search=search).solve(p)
    asked = asked_by(term)
    assert len(asked) > 5
    assert np.abs(asked.sum(1) - 1).max() < 1e-12
    assert np.abs(asked @ p.matrix.T - p.target).max() < 1e-12
    assert mix.status == "exact"
    if (algorithm, search) != ("cobyla", "all"):  # which has not come there yet
        assert over.at(mix)[[1, 2, 4]] == pytest.approx([-0.8, 0.7, 0.0], abs=0.05)


def test_parameters_are_what_is_searched():
    over = Parameters(3)
    term = over.term(bowl(np.array([0.5, 0.2, -0.4])))
    mix = NLopt().solve(over.problem(term, directions=over.directions[:2]))
    moved = mix.alpha - 1 / over.n
    inside = np.linalg.lstsq(over.directions[:2].T, moved, rcond=None)[0] @ over.directions[:2]
    assert moved == pytest.approx(inside, abs=1e-12)
    assert over.at(mix) == pytest.approx([0.5, 0.2, over.rows[2].mean()], abs=1e-3)
    assert "of 2 variables" in mix.message
    assert "of 13 variables" in NLopt(search="all").solve(over.problem(term)).message


def test_directions_that_others_tell_already_are_dropped():
    over = Parameters(2)
    twice = np.vstack([over.directions, over.directions.sum(0), np.zeros(over.n)])
    mix = NLopt().solve(over.problem(over.term(bowl(np.array([0.5, 0.2]))), directions=twice))
    assert "of 2 variables" in mix.message
    assert over.at(mix) == pytest.approx([0.5, 0.2], abs=1e-3)


@pytest.mark.parametrize("algorithm", WITHOUT)
def test_the_first_steps_are_a_part_of_a_parameters_range(algorithm):
    over = Parameters(3)
    term = over.term(bowl(np.ones(3)), slope=False)
    NLopt(algorithm, step=0.1).solve(over.problem(term))
    step = (term.asked[1] - term.asked[0]) @ over.rows.T
    assert np.linalg.norm(step) == pytest.approx(0.1)


def test_what_leaves_nothing_to_search_is_evaluated_once():
    over = Parameters(2)
    term = over.term(bowl(np.zeros(2)))
    p = over.problem(term, names=("a", "b"), matrix=over.rows, target=np.array([0.3, 0.4]), hard=np.ones(2))
    mix = NLopt().solve(p)
    assert len(term.asked) == 1
    assert mix.status == "exact"
    assert "nothing to search, search='all'" in mix.message
    single = Problem((), np.empty((0, 1)), np.empty(0), ridge=0.0, objectives=(lambda a: (1.0, None),))
    assert NLopt().solve(single).alpha == pytest.approx([1.0])


@pytest.mark.parametrize("algorithm", ["auto", *WITHOUT])
def test_one_variable(algorithm):
    over = Parameters(1)
    mix = NLopt(algorithm).solve(over.problem(over.term(bowl(np.array([0.8])), slope=False)))
    assert over.at(mix) == pytest.approx([0.8], abs=1e-3)


# Evaluations


@EVERY
@pytest.mark.parametrize("most", [1, 2, 7, 23])
def test_the_budget_of_evaluations_is_kept_and_the_best_of_them_returned(algorithm, most):
    over = Parameters(6)
    function = bowl(np.full(6, 0.9), np.array([1.0, 9.0, 0.1, 3.0, 1.0, 0.5]))
    term = over.term(function)
    mix = NLopt(algorithm, evaluations=most, tolerance=1e-12).solve(over.problem(term))
    assert len(term.asked) == most
    values = [function(over.rows @ alpha)[0] for alpha in term.asked]
    assert np.array_equal(mix.alpha, term.asked[int(np.argmin(values))])
    assert f"budget of {most} evaluations is spent" in mix.message
    assert f"{most} evaluation" in mix.message
    assert mix.status == "exact"


@EVERY
def test_each_term_is_asked_once_an_alpha(algorithm):
    over = Parameters(4)
    terms = [over.term(bowl(np.full(4, 0.5))), over.term(bowl(np.zeros(4), np.arange(4.0)))]
    kept = [] if algorithm == "bobyqa" else [over.term(bowl(np.zeros(4), lowest=-0.6))]
    mix = NLopt(algorithm).solve(over.problem(*terms, constraints=kept))
    for term in (*terms, *kept):
        asked = {alpha.tobytes() for alpha in term.asked}
        assert len(asked) == len(term.asked)
        assert asked == {alpha.tobytes() for alpha in terms[0].asked}
    assert f"{algorithm}: {len(terms[0].asked)} evaluations of 4 variables" in mix.message


@EVERY
def test_the_budget_of_time_is_kept(algorithm):
    over = Parameters(5)

    def slow(x):
        time.sleep(0.05)
        return rosenbrock(x)

    term = over.term(slow)
    mix = NLopt(algorithm, seconds=0.2).solve(over.problem(term))
    assert 1 <= len(term.asked) <= 5
    assert "its 0.2 s are spent" in mix.message
    assert mix.status == "exact"


@EVERY
def test_the_same_is_asked_again(algorithm):
    over = Parameters(3)
    runs = []
    for _ in range(2):
        term = over.term(bowl(np.array([0.3, 0.9, -0.2]), np.array([1.0, 4.0, 0.3])))
        mix = NLopt(algorithm).solve(over.problem(term))
        runs.append((asked_by(term), mix.alpha))
        NLopt(algorithm).solve(over.problem(over.term(rosenbrock)))
    assert np.array_equal(runs[0][0], runs[1][0])
    assert np.array_equal(runs[0][1], runs[1][1])


@EVERY
def test_a_search_that_was_killed_goes_on_where_it_stopped(algorithm):
    """As the core resumes: what was evaluated is remembered, the search asks for the same again."""
    over, memory, computed = Parameters(3), {}, []
    function = over.term(bowl(np.array([0.3, 0.9, -0.2]), np.array([1.0, 4.0, 0.3])))

    def remembered(alpha, dies_at=None):
        key = alpha.tobytes()
        if key not in memory:
            if len(computed) == dies_at:
                raise KeyboardInterrupt
            computed.append(key)
            memory[key] = function(alpha)
        return memory[key]

    with pytest.raises(KeyboardInterrupt):
        NLopt(algorithm).solve(over.problem(lambda alpha: remembered(alpha, 9)))
    assert len(computed) == 9
    mix = NLopt(algorithm).solve(over.problem(remembered))
    assert len(computed) == len(set(computed)) == len(function.asked)
    alone = NLopt(algorithm).solve(over.problem(over.term(bowl(np.array([0.3, 0.9, -0.2]), np.array([1.0, 4.0, 0.3])))))
    assert np.array_equal(mix.alpha, alone.alpha)


def test_solves_beside_each_other_do_not_meet():
    over = Parameters(4)

    def one(seed):
        centre = np.random.default_rng(seed).uniform(-1, 1, 4)
        return NLopt("cobyla").solve(over.problem(over.term(bowl(centre)))).alpha

    alone = [one(seed) for seed in range(6)]
    with ThreadPoolExecutor(4) as pool:
        assert np.array_equal(alone, list(pool.map(one, range(6))))


def test_nothing_of_a_solve_is_kept_alive():
    over = Parameters(3)
    term = over.term(rosenbrock)
    kept = weakref.ref(term)
    NLopt().solve(over.problem(term))
    del term
    gc.collect()
    assert kept() is None


def test_terms_cannot_alter_alpha():
    def term(alpha):
        with pytest.raises(ValueError, match="read-only"):
            alpha[0] = 5.0
        return float(alpha @ alpha), 2 * alpha

    assert NLopt().solve(free(3, objectives=(term,))).alpha == pytest.approx(np.full(3, 1 / 3), abs=1e-6)


# What terms do


class Odd(BaseException):
    """What no handler expects."""


@EVERY
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, RuntimeError, Odd])
@pytest.mark.parametrize("at", [1, 2, 6])
def test_what_a_term_raises_is_passed_on_and_nothing_is_asked_after(algorithm, error, at):
    over = Parameters(4)
    raised = error("no wind")
    calls = itertools.count(1)

    def drag(x):
        number = next(calls)
        assert number <= at
        if number == at:
            raise raised
        return rosenbrock(x)

    kinds = ["objectives"] if algorithm == "bobyqa" else ["objectives", "constraints"]
    for kind in kinds:
        calls = itertools.count(1)
        with pytest.raises(error) as caught:
            NLopt(algorithm).solve(over.problem(**{kind: (over.term(drag),)}))
        assert caught.value is raised


def test_a_signal_ends_it():
    over = Parameters(4)
    term = over.term(lambda x: (signal.raise_signal(signal.SIGINT) if len(term.asked) == 5 else None, rosenbrock(x))[1])
    with pytest.raises(KeyboardInterrupt):
        NLopt().solve(over.problem(term))
    assert len(term.asked) == 5


def walled(function, bad):
    """`function` without a value where bad(x)."""
    return lambda x: (np.nan, np.full(len(x), np.nan)) if bad(x) else function(x)


@pytest.mark.parametrize(
    ("algorithm", "slope"),
    [*((name, True) for name in ("auto", *BY_SLOPE)), *((name, False) for name in ("auto", *WITHOUT))],
)
def test_a_region_without_values_is_never_the_answer(algorithm, slope):
    over = Parameters(3)
    function = bowl(np.array([0.9, 0.2, -0.3]))
    term = over.term(walled(function, lambda x: x[0] > 0.5), slope=slope)
    mix = NLopt(algorithm).solve(over.problem(term))
    start = function(over.rows.mean(1))[0]
    assert over.at(mix)[0] <= 0.5
    assert function(over.at(mix))[0] < start - 0.1
    assert "of the evaluations had no value" in mix.message
    assert np.isfinite(mix.alpha).all()


@pytest.mark.parametrize("algorithm", ["auto", *BY_SLOPE, *WITHOUT])
def test_a_hole_in_the_way_is_gone_around(algorithm):
    over = Parameters(2)
    centre, start = np.array([1.2, 0.9]), over.rows.mean(1)
    hole = start + 0.2 * (centre - start)
    term = over.term(walled(bowl(centre), lambda x: np.abs(x - hole).max() < 0.05))
    mix = NLopt(algorithm).solve(over.problem(term))
    assert over.at(mix) == pytest.approx(centre, abs=1e-2)


@pytest.mark.parametrize("slope", [True, False])
def test_a_start_without_a_value_is_left_for_one_with(slope):
    """The targets ask for what cannot be evaluated; half the way from the centre can be."""
    over = Parameters(3)
    centre = np.array([0.4, 0.2, -0.3])
    term = over.term(walled(bowl(centre), lambda x: x[0] > 1.0), slope=slope)
    p = over.problem(term, names=("a",), matrix=over.rows[:1], target=np.array([1.5]), weight=np.full(1, 1e-3))
    mix = NLopt().solve(p)
    assert over.at(mix) == pytest.approx(centre, abs=5e-2)
    assert mix.status == "inexact"
    assert "a off by" in mix.message


def test_a_start_that_alone_has_a_value_is_the_answer():
    """More is asked in vain than is remembered."""
    over = Parameters(6)
    start = over.rows.mean(1)
    term = over.term(walled(bowl(start + 1), lambda x: np.abs(x - start).max() > 1e-9))
    mix = NLopt(evaluations=500).solve(over.problem(term))
    assert over.at(mix) == pytest.approx(start)
    assert 64 < len(term.asked) < 500


@pytest.mark.parametrize("algorithm", ["auto", *WITHOUT])
def test_no_value_anywhere_is_a_failure(algorithm):
    term = Parameters(3).term(lambda x: (np.nan, x), slope=False)
    mix = NLopt(algorithm).solve(Parameters(3).problem(term))
    assert mix.status == "failed"
    assert "no evaluation had a value" in mix.message
    assert mix.alpha == pytest.approx(np.full(14, 1 / 14))


@pytest.mark.parametrize("lacks", [None, np.nan])
def test_a_point_without_derivatives_is_a_wall_for_who_goes_by_them(lacks):
    over, centre = Parameters(3), np.array([0.6, 0.2, -0.3])
    slopes = over.term(bowl(centre))

    def term(alpha):
        value, slope = slopes(alpha)
        if len(slopes.asked) in (2, 4):
            slope = None if lacks is None else np.full(over.n, lacks)
        return value, slope

    for algorithm in ("auto", *BY_SLOPE):
        slopes.asked.clear()
        assert over.at(NLopt(algorithm).solve(over.problem(term))) == pytest.approx(centre, abs=1e-2)


def test_noise_does_not_lead_astray():
    over, centre = Parameters(4), np.array([0.6, 0.2, -0.3, 0.8])

    def noisy(x):
        value, slope = bowl(centre)(x)
        return value + 1e-5 * np.sin(1e5 * x.sum()), slope

    for slope in (True, False):
        mix = NLopt().solve(over.problem(over.term(noisy, slope=slope)))
        assert over.at(mix) == pytest.approx(centre, abs=3e-2)


# What cannot be had


@pytest.mark.parametrize("algorithm", ["auto", "cobyla"])
def test_terms_that_cannot_be_met_are_named_with_what_they_lack(algorithm):
    """q ≤ 1 and (q − 2)² ≤ 0.25: where both lack the same, q = 1 + s with (1 − s)² − 0.25 = s, s = (3 − √6)/2."""
    row = np.array([[-1.0, 0.0, 1.0]])

    def far(alpha):
        off = row[0] @ alpha - 2
        return off**2 - 0.25, 2 * off * row[0]

    far.name = "far"
    p = Problem(("free",), np.array([[1.0, -1.0, 1.0]]), np.array([0.3]), ridge=1e-6, constraints=(far,),
                range_names=("q (range)",), range_matrix=row, range_low=np.array([-1.0]),
                range_high=np.array([1.0]))  # fmt: skip
    mix = NLopt(algorithm).solve(p)
    (conflict,) = mix.conflicts
    assert mix.status == "infeasible"
    assert conflict.names == ("q (range)", "far")
    assert conflict.amounts == pytest.approx(np.full(2, (3 - np.sqrt(6)) / 2), abs=1e-4)
    assert "no mix was found that meets q (range), far" in mix.message


def test_an_equality_that_cannot_be_met_is_named_with_what_it_lacks():
    over = Parameters(2)
    p = over.problem(equalities=[over.term(bowl(np.array([0.2, 0.1])), name="lift")])
    mix = NLopt(evaluations=500).solve(p)
    assert mix.status == "infeasible"
    assert mix.conflicts[0].names == ("lift",)
    assert mix.conflicts[0].amounts == pytest.approx([0.3], abs=1e-4)
    assert over.at(mix) == pytest.approx([0.2, 0.1], abs=1e-2)


def test_hard_rows_that_clash_are_named_and_the_rest_is_searched():
    over = Parameters(3)
    term = over.term(bowl(np.array([0.0, 0.5, 0.5])))
    p = over.problem(term, names=("a", "b"), matrix=over.rows[[0, 0]], target=np.array([0.2, -0.2]), hard=np.ones(2))
    mix = NLopt().solve(p)
    assert mix.status == "infeasible"
    assert mix.conflicts[0].names == ("a", "b")
    assert over.at(mix) == pytest.approx([0.0, 0.5, 0.5], abs=1e-3)
    assert "evaluations of 2 variables" in mix.message


def test_an_objective_that_holds_a_target_off_is_told():
    over = Parameters(2)
    p = over.problem(over.term(bowl(np.array([0.0, 0.5]))), names=("a",), matrix=over.rows[:1], target=np.array([0.4]))
    mix = NLopt().solve(p)
    assert mix.status == "inexact"
    assert mix.residual == pytest.approx([-0.2], abs=1e-3)
    assert "hold a off by -0.2" in mix.message


@pytest.mark.parametrize("algorithm", [*BY_SLOPE, "bobyqa"])
def test_an_objective_without_least_value_is_told(algorithm):
    p = free(3, objectives=(lambda a: (float(a[0]), np.eye(3)[0]),))
    mix = NLopt(algorithm).solve(p)
    assert mix.status == "failed"
    assert np.isfinite(mix.alpha).all()
    assert "no least value" in mix.message


def test_a_search_that_gets_nowhere_is_ended_early():
    """A gradient that points the wrong way: slsqp alone would try on; cobyla does without."""
    over, centre = Parameters(3), np.array([0.6, 0.2, -0.3])

    def wrong(x):
        value, slope = bowl(centre)(x)
        return value, -slope

    term = over.term(wrong)
    mix = NLopt().solve(over.problem(term))
    assert "slsqp then cobyla" in mix.message
    assert over.at(mix) == pytest.approx(centre, abs=1e-2)
    alone = NLopt("slsqp", evaluations=1000).solve(over.problem(term))
    assert "evaluations is spent" not in alone.message


def test_many_variables_are_searched_by_ccsaq():
    n = 400
    aim = np.random.default_rng(0).normal(0, 0.1, n)
    aim += (1 - aim.sum()) / n
    mix = NLopt(tolerance=1e-9).solve(free(n, objectives=(lambda a: ((a - aim) @ (a - aim), 2 * (a - aim)),)))
    assert mix.alpha == pytest.approx(aim, abs=1e-4)
    assert "ccsaq: " in mix.message


# What is refused


def test_norm_1_is_refused():
    with pytest.raises(SolveError, match=r"norm=1.*casadi"):
        NLopt().solve(problem(norm=1))


@pytest.mark.parametrize(
    ("algorithm", "changes", "named"),
    [
        ("mma", {"equalities": ["t"]}, "equalities"),
        ("ccsaq", {"equalities": ["t"]}, "equalities"),
        ("bobyqa", {"equalities": ["t"]}, "equalities"),
        ("bobyqa", {"constraints": ["t"]}, "constraints"),
        ("bobyqa", {"objectives": ["t"], "alpha_low": np.zeros(3)}, "bounds on alpha"),
        (
            "bobyqa",
            {"objectives": ["t"], "range_names": ("r",), "range_matrix": np.eye(3)[:1], "range_low": np.zeros(1)},
            "ranges",
        ),
    ],
)
def test_what_an_algorithm_is_not_able_to_take_is_refused_by_name(algorithm, changes, named):
    def term(alpha):
        raise AssertionError("asked")

    p = free(3, **{name: (term,) if isinstance(value, list) else value for name, value in changes.items()})
    with pytest.raises(SolveError, match=rf"'{algorithm}'.*not able to take {named}"):
        NLopt(algorithm).solve(p)


@pytest.mark.parametrize("algorithm", BY_SLOPE)
def test_a_term_without_gradient_is_refused_by_name_where_one_is_needed(algorithm):
    def drag(alpha):
        return float(alpha[0]), None

    drag.name = "solved drag"
    with pytest.raises(SolveError, match=rf"solved drag: has no gradient.*'{algorithm}'.*'auto'"):
        NLopt(algorithm).solve(free(3, ridge=1.0, objectives=(drag,)))
    assert NLopt().solve(free(3, ridge=1.0, objectives=(drag,))).status == "exact"


def test_a_gradient_of_another_length_is_refused_by_name():
    with pytest.raises(SolveError, match=r"objective 1: expected a gradient of 3 numbers, got shape \(2,\)"):
        NLopt().solve(free(3, objectives=(lambda a: (0.0, np.zeros(2)),)))


@pytest.mark.parametrize(
    "options",
    [
        {"algorithm": "newton"},
        {"search": "some"},
        {"ridge": -1.0},
        {"ridge": np.nan},
        {"evaluations": 0},
        {"evaluations": 1.5},
        {"evaluations": np.inf},
        {"seconds": 0.0},
        {"seconds": np.nan},
        {"tolerance": 0.0},
        {"tolerance": 1.0},
        {"step": 0.0},
        {"step": np.inf},
    ],
)
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        NLopt(**options)


@pytest.mark.parametrize("solver", [NLopt(), CasADi()])
def test_what_alone_is_enough_is_so_for_all_that_is_asked(solver):
    """a − 2b + c is met; a − 2b is not, in whose way are a and b, and c and the sum too: no one of these is enough."""
    draw = np.random.default_rng(0)
    rows, alpha = draw.uniform(-1, 1, (3, 12)), draw.dirichlet(np.ones(12))
    a, b, c = rows
    matrix = np.vstack([rows, a - 2 * b + c, a - 2 * b])
    p = Problem(("a", "b", "c", "sum", "culprit"), matrix, matrix @ alpha + [0, 0, 0, 0, 0.3], ridge=0.0)
    mix = solver.solve(p)
    assert mix.status == "infeasible"
    for conflict in mix.conflicts:
        alone = dict(zip(conflict.names, conflict.alone, strict=True))
        assert alone.pop("culprit") == pytest.approx(-0.3, abs=1e-7)
        assert np.isinf([*alone.values()]).all()
        assert conflict.culprit == "culprit"


def at_most(most):
    """A term: the first coefficient, to be kept at `most` or below."""
    return lambda alpha: (float(alpha[0] - most), np.eye(len(alpha))[0])


@pytest.mark.parametrize("solver", [NLopt(), CasADi()])
def test_what_should_stay_still_does_beside_a_constraint_that_does_not_press(solver):
    """Of all mixes that meet the row, the one in which the still rows do not move: the closed form of `kkt`."""
    still = np.array([[0.3, -0.2, 0.9, 0.1, -0.7], [0.5, 0.1, -0.3, 0.8, 0.2]])
    asked = problem(k=1, n=5, range_names=(), range_matrix=None, range_low=None, range_high=None)
    asked = replace(asked, alpha_low=None, alpha_high=None, still=still)
    wide = replace(asked, constraints=(at_most(1e3),))
    mix, plain = solver.solve(wide), KKT().solve(asked)
    np.testing.assert_allclose(mix.alpha, plain.alpha, atol=1e-6)
    np.testing.assert_allclose(still @ mix.alpha, still @ asked.centre, atol=1e-6)
    assert mix.status == "exact"


def test_what_should_stay_still_does_beside_a_constraint_that_presses():
    still = np.array([[0.3, -0.2, 0.9, 0.1, -0.7], [0.5, 0.1, -0.3, 0.8, 0.2]])
    asked = problem(k=1, n=5, range_names=(), range_matrix=None, range_low=None, range_high=None)
    asked = replace(asked, alpha_low=None, alpha_high=None, still=still)
    before = CasADi().solve(asked).alpha
    tight = replace(asked, constraints=(at_most(before[0] - 0.1),))
    mix = CasADi().solve(tight)
    np.testing.assert_allclose(mix.alpha[0], before[0] - 0.1, atol=1e-6)
    np.testing.assert_allclose(still @ mix.alpha, still @ asked.centre, atol=1e-4)
    np.testing.assert_allclose(asked.matrix @ mix.alpha, asked.target, atol=1e-6)


def test_far_apart_weights_beside_a_range():
    """The lighter of two targets counts, as far as the heavier leaves it open: `casadi` agrees."""
    for seed in range(20):
        draw = np.random.default_rng(seed)
        rows, wide, target = draw.uniform(-1, 1, (2, 8)), draw.uniform(-1, 1, (1, 8)), draw.uniform(-1, 1, 2)
        asked = Problem(("a", "b"), rows, target, np.array([1e5, 1e-4]), ridge=0.0)
        low = wide @ NLopt().solve(asked).alpha + 0.2
        asked = replace(asked, range_names=("r",), range_matrix=wide, range_low=low, range_high=np.array([np.inf]))
        assert NLopt().solve(asked).status == CasADi().solve(asked).status == "exact"
