"""What a mix has to meet, one linear requirement each, and by how much no mix can: linear programs over alpha.

A requirement is low ≤ row·alpha ≤ high; a target has low = high. A set of which none can be left out for it to
contradict itself is found by leaving out one after the other (deletion filter, Chinneck, 2008, chapter 6), of those
that the multipliers name (Farkas). Where only targets press, linear algebra takes the place of linear programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog

from lampopt.errors import SolveError
from lampopt.types import BOUNDS, Array, Conflict, Problem

from .quadratic import RANK, Equalities, Inequalities, Squares, above, least_squares

MET = 1e-8  # a requirement met to this [normalised] is met
MOST = 8  # conflicts that are told apart
TRIED = 100  # requirements in those that are told, after which no more are looked for
PRESSING = 1e-7  # a multiplier this large [at most 1] tells that a requirement is part of a contradiction


@dataclass(frozen=True, eq=False)
class Requirements:
    """m requirements on alpha (N,): names, rows (m, N), low and high (m,); and bounds (N,) on alpha itself."""

    names: tuple[str, ...]
    rows: Array
    low: Array
    high: Array
    alpha_low: Array
    alpha_high: Array

    @classmethod
    def of(cls, problem: Problem, *, soft: bool) -> Requirements:
        """The ranges and hard rows of `problem`; with `soft`, its other rows too."""
        taken = np.ones(len(problem.names), bool) if soft else problem.hard
        n = len(problem.centre)
        targets = problem.target[taken]
        return cls(
            (*(name for name, use in zip(problem.names, taken, strict=True) if use), *problem.range_names),
            np.vstack([problem.matrix[taken], problem.range_matrix]),
            np.concatenate([targets, problem.range_low]),
            np.concatenate([targets, problem.range_high]),
            np.full(n, -np.inf) if problem.alpha_low is None else problem.alpha_low,
            np.full(n, np.inf) if problem.alpha_high is None else problem.alpha_high,
        )

    def only(self, chosen: Sequence[int]) -> Requirements:
        """Those with the numbers `chosen`; the bounds stay."""
        at = np.asarray(chosen, int)
        names = tuple(self.names[i] for i in at)
        return replace(self, names=names, rows=self.rows[at], low=self.low[at], high=self.high[at])

    def off(self, alpha: Array) -> Array:
        """(m,) what has to be added to each target or limit for alpha (N,) to meet it; 0 where it does."""
        values = self.rows @ alpha
        return np.asarray(np.minimum(values - self.low, 0) + np.maximum(values - self.high, 0))

    def relaxed(self, amounts: Array) -> Requirements:
        """The same after they gave way by `amounts` (m,): a target moves, a range grows."""
        exact = self.low == self.high
        low = self.low + np.where(exact, amounts, np.minimum(amounts, 0))
        high = self.high + np.where(exact, amounts, np.maximum(amounts, 0))
        return replace(self, low=low, high=high)

    def widened(self, by: float) -> Requirements:
        """The same with the bounds on alpha wider by so much."""
        return replace(self, alpha_low=self.alpha_low - by, alpha_high=self.alpha_high + by)

    def parts(self) -> tuple[Equalities, Inequalities]:
        """The sum of 1 and the targets; the ranges and the bounds."""
        n = self.rows.shape[1]
        exact = self.low == self.high
        bounded = np.isfinite(self.alpha_low) | np.isfinite(self.alpha_high)
        equal = Equalities(np.vstack([np.ones((1, n)), self.rows[exact]]), np.append(1.0, self.low[exact]))
        within = Inequalities(
            np.vstack([self.rows[~exact], np.eye(n)[bounded]]),
            np.concatenate([self.low[~exact], self.alpha_low[bounded]]),
            np.concatenate([self.high[~exact], self.alpha_high[bounded]]),
        )
        return equal, within

    def violation(self, elastic: Sequence[int]) -> tuple[float, Array]:
        """The least sum of what those numbered `elastic` have to give, all others kept, and alpha there.

        Infinite, with an alpha that means nothing, where that is not enough.
        """
        return self._elastic(elastic)[:2]

    def _elastic(self, elastic: Sequence[int]) -> tuple[float, Array, Array]:
        """The same, and the multipliers of the requirements and of the bounds (m + n,)."""
        n, at = self.rows.shape[1], np.asarray(elastic, int)
        give = np.zeros((len(self.names), 2 * len(at)))
        give[at, np.arange(len(at))], give[at, len(at) + np.arange(len(at))] = 1.0, -1.0
        rows, upper, lower = np.hstack([self.rows, give]), np.isfinite(self.high), np.isfinite(self.low)
        size, alpha, (of_rows, of_bounds) = _linear_program(
            np.concatenate([np.zeros(n), np.ones(2 * len(at))]),
            np.vstack([rows[upper], -rows[lower]]),
            np.concatenate([self.high[upper], -self.low[lower]]),
            [*zip(self.alpha_low, self.alpha_high, strict=True), *[(0, np.inf)] * (2 * len(at))],
            n,
        )
        pressure = np.zeros(len(self.names))
        pressure[upper] += of_rows[: upper.sum()]
        pressure[lower] += of_rows[upper.sum() :]
        return size, alpha, np.append(pressure, of_bounds[:n])

    def too_narrow(self) -> float:
        """By how much the bounds on alpha would have to be wider for all else to be met; infinite where in vain."""
        n, m = self.rows.shape[1], len(self.names)
        above, below = np.isfinite(self.alpha_high), np.isfinite(self.alpha_low)
        upper, lower = np.isfinite(self.high), np.isfinite(self.low)
        one, rows = np.hstack([np.eye(n), -np.ones((n, 1))]), np.hstack([self.rows, np.zeros((m, 1))])
        other = np.hstack([-np.eye(n), -np.ones((n, 1))])
        size, _, _ = _linear_program(
            np.append(np.zeros(n), 1.0),
            np.vstack([rows[upper], -rows[lower], one[above], other[below]]),
            np.concatenate([self.high[upper], -self.low[lower], self.alpha_high[above], -self.alpha_low[below]]),
            [(-np.inf, np.inf)] * n + [(0, np.inf)],
            n,
        )
        return size

    @property
    def met(self) -> bool:
        """Whether some alpha meets all of them."""
        return self.lacking() <= self._tolerance

    @property
    def _tolerance(self) -> float:
        ends = np.concatenate([self.low, self.high])
        return MET * (1 + float(np.abs(ends[np.isfinite(ends)]).max(initial=0.0)))

    def lacking(self) -> float:
        """How far they are from being met all together, in sum or as a root of squares; infinite where in vain."""
        if self._linear:
            return float(np.linalg.norm(self._missed()))
        return self.violation(range(len(self.names)))[0]

    @property
    def _linear(self) -> bool:
        """Whether there are only targets."""
        free = np.isinf(self.alpha_low).all() and np.isinf(self.alpha_high).all()
        return bool(free and (self.low == self.high).all())

    def _missed(self) -> Array:
        """(m,) what targets lack at the least squares: orthogonal to what alpha can do, so that it proves a clash."""
        if not len(self.names):
            return np.zeros(0)
        centred = self.rows - self.rows.mean(1, keepdims=True)
        gap = self.low - self.rows.mean(1)
        least = above(centred, RANK * float(np.linalg.norm(self.rows)))
        return np.asarray(gap - centred @ (np.linalg.pinv(centred, rcond=least) @ gap))

    def give(self) -> tuple[Array, float]:
        """(m,) what they have to give at least, by the sum of squares; first by how much the bounds have to be wider.

        The bounds only where no alpha within them sums to 1.
        """
        if not np.isfinite(self.violation(range(len(self.names)))[0]):
            wider = self.only([]).too_narrow() * (1 + MET)
            return self.widened(wider).give()[0], wider
        equal, within = self.parts()
        (n, m), exact = (self.rows.shape[1], len(self.names)), self.low == self.high
        equal_give, within_give = np.zeros((len(equal.rows), m)), np.zeros((len(within.rows), m))
        equal_give[1:, exact] = -np.eye(int(exact.sum()))
        within_give[: int((~exact).sum()), ~exact] = -np.eye(int((~exact).sum()))
        found = least_squares(
            Squares(np.eye(m, n + m, n), np.zeros(m), np.ones(m), 0.0, np.append(np.full(n, 1 / n), np.zeros(m))),
            replace(equal, rows=np.hstack([equal.rows, equal_give])),
            replace(within, rows=np.hstack([within.rows, within_give])),
        )
        return self.off(found[:n]), 0.0

    def conflicts(self) -> tuple[Conflict, ...]:
        """Smallest sets that contradict themselves; the next without what is most in the way of the rest."""
        found: list[Conflict] = []
        left, tried = [*range(len(self.names))], 0
        enough: set[int] | None = None  # those without which all the others can be met: they are in every set
        while len(found) < MOST and tried <= TRIED and not self.only(left).met:
            part = [left[i] for i in self.only(left).irreducible()]
            without = [self.only([j for j in left if j != i]) for i in part]
            rest = [one.lacking() for one in without]
            if enough is None:
                enough = {i for i, one, size in zip(part, without, rest, strict=True) if size <= one._tolerance}
            found.append(self._conflict(part, enough))
            if not part:
                break  # the bounds alone
            left.remove(part[int(np.argmin(rest))])
            tried += len(part)
        return tuple(found)

    def irreducible(self) -> list[int]:
        """The numbers of a set that no alpha meets, of which each is needed for that; none where it is the bounds."""
        kept, own = self._pressing()
        if not kept:
            return kept
        for i in [*kept]:
            rest = [j for j in kept if j != i]
            if not own.only(rest).met:
                kept = rest
        return kept

    def _pressing(self) -> tuple[list[int], Requirements]:
        """The numbers of those that prove that no alpha meets all; and all, without the bounds if these need not be."""
        count = len(self.names)
        if self._linear:
            pressure = self._missed()
            pressure = np.abs(pressure) / np.abs(pressure).max(initial=1e-300)
            own = self
        else:
            size, _, multipliers = self._elastic(range(count))
            if not np.isfinite(size):
                return [], self
            pressure, bounds = multipliers[:count], multipliers[count:]
            own = self if (bounds > PRESSING).any() else self.widened(np.inf)
        kept = np.flatnonzero(pressure > PRESSING).tolist()
        return (kept, own) if not own.only(kept).met else ([*range(count)], self)

    def _conflict(self, part: list[int], enough: set[int]) -> Conflict:
        own = self.only(part)
        amounts, _ = own.give()
        names, alone = list(own.names), [self._alone(i) if i in enough else np.inf for i in part]
        if own.widened(np.inf).met:  # without the bounds there is no contradiction
            names.append(BOUNDS)
            amounts, alone = np.append(amounts, 0.0), [*alone, self.too_narrow()]
        return Conflict(tuple(names), amounts, np.array(alone))

    def _alone(self, i: int) -> float:
        size, alpha = self.violation([i])
        return float(self.only([i]).off(alpha)[0]) if np.isfinite(size) else np.inf


def _linear_program(
    cost: Array, rows: Array, high: Array, box: Sequence[tuple[float, float]], n: int
) -> tuple[float, Array, tuple[Array, Array]]:
    """Least cost·x with rows·x ≤ high, x within `box` and x[:n] summing to 1: its value, x[:n], how much each presses.

    That is the size of the multipliers of rows and box.
    """
    one = np.concatenate([np.ones(n), np.zeros(len(cost) - n)])[None]
    tight = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = linprog(cost, A_ub=rows, b_ub=high, A_eq=one, b_eq=[1.0], bounds=box, method="highs", options=tight)
    if found.status == 2:
        return np.inf, np.full(n, 1 / n), (np.zeros(len(rows)), np.zeros(len(cost)))
    if found.x is None:
        raise SolveError(f"solver 'casadi': its linear program failed: {found.message}")
    pressure = np.abs(found.ineqlin.marginals), np.abs(found.lower.marginals) + np.abs(found.upper.marginals)
    return float(found.fun), np.asarray(found.x[:n]), pressure
