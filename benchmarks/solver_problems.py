"""Problems whose answers are known otherwise than by our solvers, and such as have none (benchmarks/solvers.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import brentq

from lampopt.types import Array, Problem

from .common import extra
from .solver_answers import Known, convex, linear, quadratic, spent


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
