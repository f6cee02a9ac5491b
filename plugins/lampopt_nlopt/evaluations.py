"""The terms of a problem at one alpha after the other: each once, within a budget, the best kept."""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np

from lampopt.errors import SolveError
from lampopt.types import Array, Problem, Term, called

from .least import Lines, Squares

HELD = 1e-6  # what is met to this is met
REMEMBERED = 64  # points that a search may come back to


class Spent(Exception):  # noqa: N818  # no error: the search has had what it was given
    """The budget of evaluations or of time is spent."""


@dataclass(frozen=True, eq=False)
class Point:
    """What is known at one alpha (N,).

    Parameters
    ----------
    cost, slope
        What is to be least, and its derivatives (N,).
    kept, slopes
        Values (m,) and derivatives (m, N) of the constraints, to be kept ≤ 0, then of the equalities, to be kept at 0.
    level
        The terms that tell no derivatives; theirs are NaN.
    violation
        How far the farthest requirement is from being met.
    """

    alpha: Array
    cost: float
    slope: Array
    kept: Array
    slopes: Array
    level: tuple[str, ...]
    violation: float

    @property
    def known(self) -> bool:
        """Whether all terms have a value."""
        return bool(np.isfinite(self.cost) and np.isfinite(self.kept).all())

    @property
    def steep(self) -> bool:
        """Whether all terms have a value and derivatives."""
        return self.known and bool(np.isfinite(self.slope).all() and np.isfinite(self.slopes).all())

    def better(self, other: Point | None) -> bool:
        """Whether this is the better answer: what is met comes first, then what it costs."""
        if not self.known or other is None:
            return self.known
        if max(self.violation, other.violation) <= HELD:
            return self.cost < other.cost
        return self.violation < other.violation

    def gained(self, before: Point | None, tolerance: float) -> bool:
        """Whether this is better than a point before by more than `tolerance` of what is to be gained upon."""
        if before is None:
            return True
        if max(before.violation, self.violation) > HELD:
            return before.violation - self.violation > tolerance * self.violation
        return before.cost - self.cost > tolerance * abs(self.cost)


@dataclass(eq=False)
class Evaluations:
    """The terms of `problem`, evaluated; `squares` join the cost, `within` what is to be met.

    At most `most` evaluations within `seconds`.
    """

    problem: Problem
    squares: Squares
    within: Lines
    most: int
    seconds: float
    count: int = 0
    lost: list[int] = field(default_factory=list)  # which of them had no value
    best: Point | None = None
    _began: float = field(default_factory=time.monotonic)
    _recent: OrderedDict[bytes, Point] = field(default_factory=OrderedDict)

    @property
    def recent(self) -> list[Point]:
        """The last of the points, oldest first."""
        return list(self._recent.values())

    @property
    def terms(self) -> list[tuple[str, Term]]:
        """Constraints, then equalities, by their names."""
        p = self.problem
        return [*_named(p.constraints, "constraint"), *_named(p.equalities, "equality")]

    def __call__(self, alpha: Array) -> Point:
        """The point at alpha (N,).

        Raises
        ------
        Spent
            If it is not known yet and the budget is spent.
        """
        key = alpha.tobytes()
        if self.best is not None and key == self.best.alpha.tobytes():
            return self.best
        if key not in self._recent:
            if self.count >= self.most:
                raise Spent(f"its budget of {self.most} evaluations is spent")
            if self.count and time.monotonic() - self._began >= self.seconds:
                raise Spent(f"its {self.seconds:g} s are spent")
            self._recent[key] = self._point(alpha)
            if len(self._recent) > REMEMBERED:
                self._recent.popitem(last=False)
        return self._recent[key]

    def _point(self, alpha: Array) -> Point:
        self.count += 1
        alpha = alpha.copy()
        alpha.setflags(write=False)
        value, slope, level = _values(_named(self.problem.objectives, "objective"), alpha)
        kept, slopes, also = _values(self.terms, alpha)
        inequalities = len(self.problem.constraints)
        violation = max(
            self.within.worst(alpha),
            float(kept[:inequalities].max(initial=0.0)),
            float(np.abs(kept[inequalities:]).max(initial=0.0)),
        )
        cost, steep = self.squares(alpha) + float(value.sum()), self.squares.gradient(alpha) + slope.sum(0)
        point = Point(alpha, cost, steep, kept, slopes, (*level, *also), violation)
        if not point.known:
            self.lost.append(self.count)
        if point.better(self.best):
            self.best = point
        return point


def _named(terms: tuple[Term, ...], kind: str) -> list[tuple[str, Term]]:
    return [(called(term, f"{kind} {i}"), term) for i, term in enumerate(terms, 1)]


def _values(terms: list[tuple[str, Term]], alpha: Array) -> tuple[Array, Array, tuple[str, ...]]:
    """Values (m,) of terms, their derivatives (m, N), and the names of those that have none: NaN."""
    values, slopes, level = np.zeros(len(terms)), np.full((len(terms), len(alpha)), np.nan), []
    for i, (name, term) in enumerate(terms):
        value, slope = term(alpha)
        values[i] = float(value)
        if slope is None:
            level.append(name)
        elif np.size(slope) == len(alpha):
            slopes[i] = np.reshape(slope, len(alpha))
        else:
            raise SolveError(f"{name}: expected a gradient of {len(alpha)} numbers, got shape {np.shape(slope)}")
    return values, slopes, tuple(level)
