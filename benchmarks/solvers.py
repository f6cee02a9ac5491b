"""Every solver on one table of problems whose answers are known otherwise: ``python -m benchmarks.solvers --help``.

Convex problems are solved by cvxpy with CLARABEL, then once more by numpy as the linear system of what CLARABEL says is
active; the others have closed forms, or come down to one equation in one unknown. What a solver says of its answer has
to be true (HiGHS tells what can be met), a planted culprit has to be named, and a front of 200 ridges quick.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from scipy.optimize import brentq, linprog
from threadpoolctl import threadpool_limits

from lampopt.errors import InputError, SolveError
from lampopt.plugins import Plugins
from lampopt.protocols import Solver
from lampopt.types import Array, Mix, Problem

from .common import ROOT, Row, extra, line, share
from .document import put, show, stamped

SIZES = (12, 24, 100)
CLOSE = 1e-6  # what is wanted of alpha, or of the cost where alpha is not unique
SEEDS = 5
PLANTED = 20
RIDGES = 200
LEAST, MOST = 5, 0.25  # a time is the median of so many calls, or of what fits in so many seconds
TIGHT = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12)
Known = tuple[Problem, Array, Callable[[Array], float] | None]  # a problem, its alpha, and its cost where that counts


# Problems


def drawn(seed: int, n: int, **changes: Any) -> Problem:
    """A third of n soft rows (a fifth of 100) on [-1, 1], out of the exemplars' range but within reach."""
    draw, k = np.random.default_rng([seed, n]), n // (5 if n == 100 else 3)
    matrix, alpha = draw.uniform(-1, 1, (k, n)), draw.normal(0, 3 / n**0.5, n)
    given = {
        "names": tuple(f"q{i}" for i in range(k)),
        "matrix": matrix,
        "target": matrix @ (alpha + (1 - alpha.sum()) / n),
        "ridge": 0.0,
    }
    return Problem(**(given | changes))


def uneven(seed: int, n: int) -> dict[str, Any]:
    draw = np.random.default_rng([seed, n, 1])
    return {"weight": draw.uniform(0.3, 3, n // (5 if n == 100 else 3)), "centre": draw.dirichlet(np.ones(n))}


def ranged(seed: int, n: int, low: float, high: float) -> dict[str, Any]:
    """As many ranges as a sixth of n on rows of their own."""
    r, draw = n // 6, np.random.default_rng([seed, n, 2])
    names = tuple(f"r{i} (range)" for i in range(r))
    rows = {"range_names": names, "range_matrix": draw.uniform(-1, 1, (r, n))}
    return rows | {"range_low": np.full(r, low), "range_high": np.full(r, high)}


def bounded(n: int) -> dict[str, Any]:
    """About half of them are felt."""
    return {"alpha_low": np.full(n, -0.5 / n**0.5), "alpha_high": np.full(n, 1.5 / n**0.5)}


def hard(seed: int, n: int) -> Array:
    k = n // (5 if n == 100 else 3)
    return np.arange(k) < k // 3


class Linear:
    """row·alpha, by value and gradient."""

    def __init__(self, row: Array) -> None:
        self.row = row

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        return float(self.row @ alpha), self.row


class Told(Linear):
    """The same, as an expression too."""

    def symbolic(self, alpha: Any) -> Any:
        casadi = extra("casadi")
        return casadi.dot(casadi.DM(self.row), alpha)


class Ball:
    """‖rows·alpha‖² − radius²."""

    def __init__(self, rows: Array, radius: float) -> None:
        self.rows, self.radius = rows, radius

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        at = self.rows @ alpha
        return float(at @ at - self.radius**2), 2 * self.rows.T @ at


class Of:
    """A smooth function of row·alpha, with its derivative."""

    def __init__(self, row: Array, value: Callable[[float], float], slope: Callable[[float], float]) -> None:
        self.row, self.value, self.slope = row, value, slope

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        at = float(self.row @ alpha)
        return self.value(at), self.slope(at) * self.row


class Rosenbrock:
    """(1 − u)² + 100 (v − u²)² of two rows: a bent valley, least at u = v = 1."""

    def __init__(self, rows: Array) -> None:
        self.rows = rows

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        u, v = self.rows @ alpha
        slope = np.array([-2 * (1 - u) - 400 * u * (v - u**2), 200 * (v - u**2)])
        return float((1 - u) ** 2 + 100 * (v - u**2) ** 2), slope @ self.rows


# Answers found otherwise


def linear(p: Problem) -> Array:
    """Alpha of rows and ridge alone, in the null space of what is exact; then what should be still; least norm."""
    n = len(p.centre)
    root = np.sqrt(p.weight[~p.hard])[:, None]
    steps: list[tuple[Array, Array]] = [
        (np.ones((1, n)), np.ones(1)),
        (p.matrix[p.hard], p.target[p.hard]),
        (
            np.vstack([root * p.matrix[~p.hard], np.sqrt(p.ridge or 0.0) * np.eye(n)]),
            np.concatenate([root[:, 0] * p.target[~p.hard], np.sqrt(p.ridge or 0.0) * p.centre]),
        ),
    ]
    alpha, basis = p.centre, np.eye(n)
    for rows, values in steps if not len(p.still) else steps[:2]:
        alpha, basis = _then(alpha, basis, rows, values)
    if len(p.still):  # rows first, as the ridge has them; then what is free moves
        asked = linear(replace(p, still=None))
        alpha, basis = _then(alpha, basis, p.matrix[~p.hard], p.matrix[~p.hard] @ asked)
        alpha, basis = _then(alpha, basis, p.still, p.still @ p.centre)
    return alpha


def _then(alpha: Array, basis: Array, rows: Array, values: Array) -> tuple[Array, Array]:
    """rows·alpha nearest to `values` by moving along `basis` alone, and what that leaves of it."""
    if not len(rows) or not basis.shape[1]:
        return alpha, basis
    inner = rows @ basis
    step = np.linalg.lstsq(inner, values - rows @ alpha, rcond=1e-11)[0]
    _, sizes, right = np.linalg.svd(inner)
    return alpha + basis @ step, basis @ right[int((sizes > 1e-11 * sizes.max()).sum()) :].T


def convex(p: Problem, *, row: Array | None = None) -> Array:
    """Alpha by CLARABEL; nearest to the centre where a ridge of 0 leaves freedom. `row` is a linear objective."""
    cp = extra("cvxpy")
    alpha, soft = cp.Variable(len(p.centre)), ~p.hard
    kept = [cp.sum(alpha) == 1]
    kept += [p.matrix[p.hard] @ alpha == p.target[p.hard]] if p.hard.any() else []
    for rows, low, high in _limits(p):
        kept += [rows[np.isfinite(low)] @ alpha >= low[np.isfinite(low)]] if np.isfinite(low).any() else []
        kept += [rows[np.isfinite(high)] @ alpha <= high[np.isfinite(high)]] if np.isfinite(high).any() else []
    apart = alpha - p.centre
    size = cp.sum_squares(apart) if p.norm == 2 else cp.norm1(apart)
    cost = (p.ridge or 0.0) * size
    if soft.any():
        off = p.matrix[soft] @ alpha - p.target[soft]
        cost += cp.sum_squares(cp.multiply(np.sqrt(p.weight[soft]), off))
    cost += row @ alpha if row is not None else 0.0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Solution may be inaccurate")  # than 1e-12: `settled` makes it exact
        cp.Problem(cp.Minimize(cost), kept).solve(solver=cp.CLARABEL, **TIGHT)
        if not p.ridge and row is None:
            kept.append(p.matrix[soft] @ alpha == np.array(p.matrix[soft] @ alpha.value))
            cp.Problem(cp.Minimize(size), kept).solve(solver=cp.CLARABEL, **TIGHT)
    return np.array(alpha.value)


def _limits(p: Problem) -> list[tuple[Array, Array, Array]]:
    n = len(p.centre)
    low = np.full(n, -np.inf) if p.alpha_low is None else p.alpha_low
    high = np.full(n, np.inf) if p.alpha_high is None else p.alpha_high
    return [(p.range_matrix, p.range_low, p.range_high), (np.eye(n), low, high)]


def settled(p: Problem, near: Array) -> Array:
    """The answer near `near` once more, with what holds with equality there as hard rows: exact, not iterated."""
    rows, values = [p.matrix[p.hard]], [p.target[p.hard]]
    for matrix, low, high in _limits(p):
        at = matrix @ near
        for limit in (low, high):
            felt = np.abs(at - limit) < 1e-5
            rows.append(matrix[felt])
            values.append(limit[felt])
    exact, to = np.vstack(rows), np.concatenate(values)
    soft = ~p.hard
    return linear(
        Problem(
            tuple(f"q{i}" for i in range(len(exact) + int(soft.sum()))),
            np.vstack([exact, p.matrix[soft]]),
            np.concatenate([to, p.target[soft]]),
            np.concatenate([np.ones(len(exact)), p.weight[soft]]),
            np.arange(len(exact) + int(soft.sum())) < len(exact),
            centre=p.centre,
            ridge=p.ridge,
        )
    )


def quadratic(p: Problem) -> Known:
    near = convex(p)
    answer = settled(p, near)
    apart = np.abs(answer - near).max()
    if apart > 1e-4:
        raise ArithmeticError(f"two independent answers are {apart:.1e} apart: this problem tells nothing")
    return p, answer, None


def spent(p: Problem) -> Callable[[Array], float]:
    """What alpha costs."""

    def cost(alpha: Array) -> float:
        apart, off = alpha - p.centre, p.matrix[~p.hard] @ alpha - p.target[~p.hard]
        away = apart @ apart if p.norm == 2 else np.abs(apart).sum()
        return float(p.weight[~p.hard] @ off**2 + (p.ridge or 0.0) * away)

    return cost


# The table


def few(seed: int, n: int) -> Known:
    p = drawn(seed, n)
    return p, linear(p), None


def many(seed: int, n: int) -> Known:
    """More rows than mixes can meet."""
    draw = np.random.default_rng([seed, n, 3])
    rows, targets = draw.uniform(-1, 1, (n + n // 4, n)), draw.uniform(-1, 1, n + n // 4)
    p = Problem(tuple(f"q{i}" for i in range(len(rows))), rows, targets, ridge=0.0)
    return p, linear(p), None


def some_hard(seed: int, n: int) -> Known:
    p = drawn(seed, n, hard=hard(seed, n), ridge=0.3)
    return p, linear(p), None


def ridged(seed: int, n: int) -> Known:
    p = drawn(seed, n, ridge=10.0 ** (seed % 4 - 3))
    return p, linear(p), None


def weighed(seed: int, n: int) -> Known:
    p = drawn(seed, n, ridge=0.1, **uneven(seed, n))
    return p, linear(p), None


def referred(seed: int, n: int) -> Known:
    p = drawn(seed, n, centre=np.eye(n)[seed % n])
    return p, linear(p), None


def still(seed: int, n: int) -> Known:
    p = drawn(
        seed, n, centre=np.eye(n)[seed % n], still=np.random.default_rng([seed, n, 4]).uniform(-1, 1, (n // 4, n))
    )
    return p, linear(p), None


def still_crowd(seed: int, n: int) -> Known:
    """More rows that should be still than there is freedom, and a ridge."""
    rows = np.random.default_rng([seed, n, 5]).uniform(-1, 1, (n, n))
    p = drawn(seed, n, ridge=0.1, centre=np.eye(n)[seed % n], still=rows)
    return p, linear(p), None


def ranges_active(seed: int, n: int) -> Known:
    return quadratic(drawn(seed, n, ridge=0.1, **uneven(seed, n), **ranged(seed, n, -0.05, 0.05)))


def ranges_inactive(seed: int, n: int) -> Known:
    p = drawn(seed, n, ridge=0.1, **ranged(seed, n, -50.0, 50.0))
    bare = replace(p, range_names=(), range_matrix=None, range_low=None, range_high=None)
    return p, linear(bare), None


def bounds_active(seed: int, n: int) -> Known:
    return quadratic(drawn(seed, n, ridge=0.1, **bounded(n)))


def bounds_least(seed: int, n: int) -> Known:
    """Without a ridge: of all best mixes the nearest to the centre."""
    return quadratic(drawn(seed, n, **uneven(seed, n), **bounded(n)))


def everything(seed: int, n: int) -> Known:
    """Hard rows, weights, centre, ridge, ranges and bounds together."""
    p = drawn(seed, n, hard=hard(seed, n), ridge=0.03, **uneven(seed, n), **ranged(seed, n, -0.1, 0.1), **bounded(n))
    # Hard rows and ranges as a mix within the bounds has them, so that there is one.
    inside = np.random.default_rng([seed, n, 6]).dirichlet(np.full(n, 5.0))
    middle = p.range_matrix @ inside
    target = np.where(p.hard, p.matrix @ inside, p.target)
    return quadratic(replace(p, target=target, range_low=middle - 0.05, range_high=middle + 0.05))


def one_norm(seed: int, n: int) -> Known:
    p = drawn(seed, n, ridge=0.2, norm=1, **uneven(seed, n), **ranged(seed, n, -0.2, 0.2))
    return p, convex(p), spent(p)


def _programmed(seed: int, n: int, kind: type[Linear]) -> Known:
    row = np.random.default_rng([seed, n, 7]).uniform(-1, 1, n)
    limits = ranged(seed, n, -0.1, 0.1) | bounded(n)
    p = Problem((), np.empty((0, n)), np.empty(0), ridge=0.0, objectives=(kind(row),), **limits)
    return p, convex(p, row=row), lambda alpha: float(row @ alpha)


def linear_told(seed: int, n: int) -> Known:
    return _programmed(seed, n, Told)


def linear_called(seed: int, n: int) -> Known:
    return _programmed(seed, n, Linear)


def ball(seed: int, n: int) -> Known:
    """Least squares within ‖rows·alpha‖ ≤ half of what they would make of it: one equation in the multiplier."""
    rows = np.random.default_rng([seed, n, 8]).uniform(-1, 1, (3, n))
    p = drawn(seed, n, ridge=0.1)
    within = Ball(rows, 0.5 * float(np.linalg.norm(rows @ linear(p))))

    def pulled(multiplier: float) -> Array:
        return linear(
            replace(
                p, names=(*p.names, "x", "y", "z"), matrix=np.vstack([p.matrix, rows]), hard=None,
                target=np.append(p.target, np.zeros(3)), weight=np.append(p.weight, np.full(3, multiplier)),
            )
        )  # fmt: skip

    at = brentq(lambda m: np.linalg.norm(rows @ pulled(m)) - within.radius, 1e-9, 1e6, xtol=1e-15, rtol=1e-14)
    return replace(p, constraints=(within,)), pulled(at), None


def valley(seed: int, n: int) -> Known:
    """Rosenbrock's, of two rows; of all mixes that have the least value, the nearest to the centre."""
    rows = np.random.default_rng([seed, n, 9]).uniform(-1, 1, (2, n))
    p = Problem((), np.empty((0, n)), np.empty(0), ridge=0.0, objectives=(Rosenbrock(rows),))
    return p, linear(Problem(("u", "v"), rows, np.ones(2), ridge=0.0)), None


def exponential(seed: int, n: int) -> Known:
    """ridge·‖alpha − centre‖² + exp(row·alpha): alpha moves against the row, by one equation in x."""
    row, ridge = np.random.default_rng([seed, n, 10]).uniform(-1, 1, n), 0.5
    centre = np.full(n, 1 / n)
    way = row - row.mean()
    at = brentq(lambda x: x - row @ centre + np.exp(x) * (way @ way) / (2 * ridge), -50, 50, xtol=1e-15)
    p = Problem((), np.empty((0, n)), np.empty(0), ridge=ridge, objectives=(Of(row, np.exp, np.exp),))
    return p, centre - np.exp(at) / (2 * ridge) * way, None


def outside(seed: int, n: int) -> Known:
    """(row·alpha − middle)² ≥ 1, not convex: the nearer side. The middle is off the centre's value, so that one is."""
    row = np.random.default_rng([seed, n, 11]).uniform(-1, 1, n)
    centre, way = np.full(n, 1 / n), row - row.mean()
    middle = float(row @ centre) + 0.3
    term = Of(row, lambda x: 1 - (x - middle) ** 2, lambda x: -2 * (x - middle))
    p = Problem((), np.empty((0, n)), np.empty(0), ridge=1.0, constraints=(term,))
    return p, centre + (middle - 1 - row @ centre) / (way @ way) * way, None


def square(seed: int, n: int) -> Known:
    """An equality that is not linear, (row·alpha)³ = 0.2, with hard rows."""
    row = np.random.default_rng([seed, n, 12]).uniform(-1, 1, n)
    p = drawn(seed, n, ridge=1.0, hard=np.ones(n // (5 if n == 100 else 3)))
    as_row = replace(
        p, names=(*p.names, "cube"), matrix=np.vstack([p.matrix, row]), target=np.append(p.target, 0.2 ** (1 / 3)),
        hard=np.ones(len(p.names) + 1), weight=None,
    )  # fmt: skip
    term = Of(row, lambda x: x**3 - 0.2, lambda x: 3 * x**2)
    return replace(p, equalities=(term,)), linear(as_row), None


CASES: dict[str, Callable[[int, int], Known]] = {
    "least squares": few,
    "least squares, more rows than exemplars": many,
    "hard rows and a ridge": some_hard,
    "ridge": ridged,
    "uneven weights": weighed,
    "centre on a reference": referred,
    "still rows": still,
    "more still rows than freedom": still_crowd,
    "ranges, active": ranges_active,
    "ranges, not active": ranges_inactive,
    "bounds on alpha": bounds_active,
    "bounds on alpha, no ridge": bounds_least,
    "hard rows, ranges, bounds, ridge": everything,
    "norm 1, with ranges (cost)": one_norm,
    "linear objective in bounds, an expression (cost)": linear_told,
    "linear objective in bounds, by gradient (cost)": linear_called,
    "quadratic constraint": ball,
    "Rosenbrock's valley": valley,
    "exponential objective": exponential,
    "outside a band, not convex": outside,
    "cubic equality and hard rows": square,
}


def terms(p: Problem) -> bool:
    return bool(p.objectives or p.constraints or p.equalities)


def tried(solver: Solver, p: Problem) -> Mix | None:
    """The mix; None where the solver returns none that can be used."""
    try:
        return solver.solve(p)
    except InputError:
        return None


def takes(solver: Solver, p: Problem) -> bool:
    """Whether it does not refuse; nor, of what it may, takes no notice."""
    try:
        found = tried(solver, p)
    except SolveError:
        return False
    if found is None or not len(p.still):
        return True
    return np.abs(found.alpha - solver.solve(replace(p, still=None)).alpha).max() > 1e-9


def timed(work: Callable[[], object]) -> float:
    """Milliseconds, the median of several calls."""
    spans: list[float] = []
    while len(spans) < LEAST or (sum(spans) < MOST and len(spans) < 200):
        began = time.perf_counter()
        work()
        spans.append(time.perf_counter() - began)
    return 1000 * float(np.median(spans))


def solved(name: str, solver: Solver, n: int, known: Sequence[Known]) -> Row:
    """How far off a solver is at most, and how long one problem takes it."""
    off = []
    for p, answer, cost in known:
        if (mix := tried(solver, p)) is None:
            off.append(np.inf)
        elif cost is None:
            off.append(float(np.abs(mix.alpha - answer).max()))
        else:
            off.append(abs(cost(mix.alpha) - cost(answer)))
    took = timed(lambda: solver.solve(known[0][0]))
    return line(
        f"{name}, N = {n}", max(off), target=f"<= {CLOSE:g}", of=len(known), ms=round(took, 3), by={"ms": f"{took:.2f}"}
    )


# What cannot be had


def contradictory(seed: int, *, ranges: bool) -> Problem:
    """Rows that one alpha meets, and a target, "culprit", that clashes with two sets of them: it alone can mend it."""
    draw = np.random.default_rng([seed, 13])
    n = 20
    rows = draw.uniform(-1, 1, (6, n))
    a, b, c = rows[:3]
    rows = np.vstack([rows, a - 2 * b + c])  # is met where a, b and c are
    alpha = draw.normal(0, 0.2, n) + 1 / n
    alpha += (1 - alpha.sum()) / n
    culprit, amount = a - 2 * b, float(draw.choice([-1, 1]) * draw.uniform(0.1, 0.5))
    asked = np.vstack([rows, culprit])
    order = draw.permutation(8)
    names = np.array(["a", "b", "c", "d", "e", "f", "sum", "culprit"])
    given = {
        "matrix": asked[order],
        "target": (asked @ alpha + amount * (np.arange(8) == 7))[order],
        "hard": draw.random(8) < 0.5 if ranges else None,
        "ridge": 0.0,
    }
    if ranges:
        wide = draw.uniform(-1, 1, (2, n))
        given |= {"range_names": ("r (range)", "s (range)"), "range_matrix": wide}
        given |= {"range_low": wide @ alpha - 0.1, "range_high": wide @ alpha + 0.1}
    return Problem(tuple(names[order].tolist()), **given)


def impossible(seed: int, n: int) -> list[tuple[str, Problem]]:
    """Problems without an answer, of every kind, and why."""
    draw, row = np.random.default_rng([seed, n, 14]), drawn(seed, n).matrix[:1]
    nothing = {"names": (), "matrix": np.empty((0, n)), "target": np.empty(0), "ridge": 0.0}
    two = np.vstack([row, row])
    one = {"range_names": ("r (range)",), "range_matrix": row, "range_low": np.array([1.0])}
    high = np.full(n, 1.0)
    low = np.zeros(n)
    far = Of(row[0], lambda x: x**2 + 0.1, lambda x: 2 * x)
    beyond = np.array([1.1 * float(row.max())])
    return [
        ("hard rows", Problem(("p", "q"), two, np.array([0.0, 0.3]), hard=np.ones(2), ridge=0.0)),
        ("soft rows", Problem(("p", "q"), two, np.array([0.0, 0.3]), ridge=0.0)),
        ("a row that cannot move", Problem(("p",), np.full((1, n), draw.uniform(-1, 1)), np.array([2.0]), ridge=0.0)),
        ("a row and a range", Problem(("q",), row, np.array([0.2]), ridge=0.0, **one)),
        ("two ranges", Problem(**nothing, **one | {
            "range_names": ("r (range)", "s (range)"), "range_matrix": two, "range_low": np.array([1.0, -np.inf]),
            "range_high": np.array([np.inf, 0.5])})),
        ("bounds alone", Problem(**nothing, alpha_high=0.9 * high / n)),
        ("bounds and a row", Problem(("q",), row, beyond, ridge=0.0, alpha_low=low, hard=np.ones(1))),
        ("bounds and a range", Problem(**nothing, alpha_low=low, **one | {"range_low": beyond})),
        ("a constraint", Problem(**nothing | {"ridge": 1.0}, constraints=(far,))),
    ]  # fmt: skip


def recognised(solver: Solver, sizes: Sequence[int], seeds: int) -> list[Row]:
    """Of problems that have no answer, how many are called so, with reasons."""
    told: dict[str, list[bool]] = {}
    for n in sizes:
        for seed in range(seeds):
            for why, p in impossible(seed, n):
                if takes(solver, p):
                    mix = tried(solver, p)
                    good = mix is not None and mix.status == "infeasible" and bool(mix.conflicts)
                    told.setdefault(why, []).append(good)
    return [
        line(f"no answer: {why}", share([x for x in all_ if x], all_), target=">= 1", of=len(all_))
        for why, all_ in told.items()
    ]


def possible(p: Problem) -> bool:
    """Whether some alpha meets all targets, ranges and bounds, by HiGHS."""
    upper, lower = np.isfinite(p.range_high), np.isfinite(p.range_low)
    none = np.full(len(p.centre), np.inf)
    found = linprog(
        np.zeros(len(p.centre)),
        A_ub=np.vstack([p.range_matrix[upper], -p.range_matrix[lower]]),
        b_ub=np.append(p.range_high[upper], -p.range_low[lower]),
        A_eq=np.vstack([np.ones(len(p.centre)), p.matrix]),
        b_eq=np.append(1.0, p.target),
        bounds=np.column_stack([-none if p.alpha_low is None else p.alpha_low,
                                none if p.alpha_high is None else p.alpha_high]),
    )  # fmt: skip
    return bool(found.status == 0)


def truthful(solver: Solver, known: Sequence[Known]) -> Row:
    """Of problems without terms, how often the status is what it means."""
    right = []
    for p, _, _ in known:
        if (mix := tried(solver, p)) is None:
            right.append(False)
            continue
        met = np.abs(p.matrix @ mix.alpha - p.target).max(initial=0.0) <= CLOSE
        wanted = ("exact" if met else "inexact") if possible(p) else "infeasible"
        right.append(mix.status == wanted and bool(mix.conflicts) == (wanted == "infeasible"))
    return line("status is true", share([x for x in right if x], right), target=">= 1", of=len(right))


def named(solver: Solver, *, ranges: bool) -> Row | None:
    """How often the planted culprit is what alone has to give, and by what it was planted."""
    right, ms = [], []
    for seed in range(PLANTED):
        p = contradictory(seed, ranges=ranges)
        if not takes(solver, p):
            return None
        began = time.perf_counter()
        mix = solver.solve(p)
        ms.append(1000 * (time.perf_counter() - began))
        touching = [c for c in mix.conflicts if "culprit" in c.names]
        good = bool(touching) and mix.status == "infeasible" and all(c.culprit == "culprit" for c in touching)
        if good:
            alone = float(touching[0].alone[touching[0].names.index("culprit")])
            target = p.target + alone * np.array([name == "culprit" for name in p.names])
            good = solver.solve(replace(p, target=target)).status != "infeasible"
        right.append(good)
    asked = "targets and ranges" if ranges else "targets alone"
    took = float(np.median(ms))
    return line(
        f"culprit named, {asked}", share([x for x in right if x], right), target=">= 1", of=len(right),
        ms=round(took, 3), by={"ms": f"{took:.2f}"},
    )  # fmt: skip


# The path


def paths(solvers: dict[str, Solver], seeds: int) -> list[Row]:
    """200 ridges at N = 100: how long it takes, and how far each is from the closed form ridge by ridge."""
    rows, n = [], 100
    ridges = np.append(0.0, np.geomspace(1e-3, 1e6, RIDGES - 1))
    for name, solver in solvers.items():
        off, first = [], drawn(0, n, **uneven(0, n))
        for seed in range(seeds if name == "kkt" else 1):
            p = drawn(seed, n, **uneven(seed, n))
            path = solver.solve_many(p, np.tile(p.target, (RIDGES, 1)), ridges).alpha
            off.append(max(np.abs(a - linear(replace(p, ridge=r))).max() for a, r in zip(path, ridges, strict=True)))
        targets = np.tile(first.target, (RIDGES, 1))
        began = time.perf_counter()
        solver.solve_many(first, targets, ridges)
        took = 1000 * (time.perf_counter() - began)
        if name == "kkt":
            took = timed(lambda: solver.solve_many(first, targets, ridges))  # noqa: B023  # called at once
            rows.append(line(f"{name}: {RIDGES} ridges, N = {n} [ms]", round(took, 3), target="<= 10"))
        more = {} if name == "kkt" else {"ms": round(took, 1), "by": {"ms": f"{took:.0f}"}}
        rows.append(
            line(f"{name}: {RIDGES} ridges, N = {n}", float(max(off)), target=f"<= {CLOSE:g}", of=RIDGES, **more)
        )
    return rows


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solvers", description=__doc__)
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)), help="numbers of exemplars")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="problems of each kind and size")
    parser.add_argument("--only", help="one solver")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "solvers.json")
    options = parser.parse_args(given)
    talk, plugins, tables = Console(stderr=True), Plugins.load().report(), {}
    sizes = [int(size) for size in options.sizes.split(",")]
    names = [name for kind, name in plugins.offers if kind == "solver" and options.only in (None, name)]
    solvers: dict[str, Solver] = {name: plugins.make("solver", name) for name in sorted(names)}
    with threadpool_limits(options.threads):
        known = {(case, n): [make(s, n) for s in range(options.seeds)] for case, make in CASES.items() for n in sizes}
        for name, solver in solvers.items():
            taken = {key: problems for key, problems in known.items() if takes(solver, problems[0][0])}
            rows = [solved(case, solver, n, problems) for (case, n), problems in taken.items()]
            plain = [one for problems in taken.values() for one in problems if not terms(one[0])]
            rows += [truthful(solver, plain), *recognised(solver, sizes, options.seeds)]
            rows += [row for ranges in (False, True) if (row := named(solver, ranges=ranges))]
            lacking = [case for case in CASES if not any(case == key[0] for key in taken)]
            notes = [
                "largest difference of alpha (cost: of the cost) from the independent answer; median ms of one solve"
            ]
            tables[name] = {"rows": rows, "notes": [*notes, *([f"not taken: {'; '.join(lacking)}"] if lacking else [])]}
            show(talk, name, tables[name])
        if 100 in sizes:
            notes = ["from the closed form, ridge by ridge"]
            tables["path of ridges"] = {"rows": paths(solvers, options.seeds), "notes": notes}
            show(talk, "path of ridges", tables["path of ridges"])
    packages = {name: version(name) for name in ("numpy", "scipy", "casadi", "cvxpy", "clarabel")}
    settings = {"sizes": sizes, "seeds": options.seeds, "threads": options.threads, **packages}
    put(stamped("solvers", **settings) | {"tables": tables}, options.out, out=True)
    return 0 if all(row["met"] is not False for found in tables.values() for row in found["rows"]) else 1


if __name__ == "__main__":
    sys.exit(main())
