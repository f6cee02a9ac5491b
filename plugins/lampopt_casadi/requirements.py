"""What a mix has to meet, one linear requirement each, and by how much no mix can: linear programs over alpha.

A requirement is low ≤ row·alpha ≤ high; a target has low = high. A set of which none can be left out for it to
contradict itself is found by leaving out one after the other (deletion filter, Chinneck, 2008, chapter 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog

from lampopt.errors import SolveError
from lampopt.types import BOUNDS, Array, Conflict, Problem

from .quadratic import Equalities, Inequalities, Squares, least_squares

MET = 1e-8  # a requirement met to this [normalised] is met
MOST = 8  # conflicts that are told apart


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
        n, at = self.rows.shape[1], np.asarray(elastic, int)
        give = np.zeros((len(self.names), 2 * len(at)))
        give[at, np.arange(len(at))], give[at, len(at) + np.arange(len(at))] = 1.0, -1.0
        rows, upper, lower = np.hstack([self.rows, give]), np.isfinite(self.high), np.isfinite(self.low)
        return _linear_program(
            np.concatenate([np.zeros(n), np.ones(2 * len(at))]),
            np.vstack([rows[upper], -rows[lower]]),
            np.concatenate([self.high[upper], -self.low[lower]]),
            [*zip(self.alpha_low, self.alpha_high, strict=True), *[(0, np.inf)] * (2 * len(at))],
            n,
        )

    def too_narrow(self) -> float:
        """By how much the bounds on alpha would have to be wider for all else to be met; infinite where in vain."""
        n, m = self.rows.shape[1], len(self.names)
        above, below = np.isfinite(self.alpha_high), np.isfinite(self.alpha_low)
        upper, lower = np.isfinite(self.high), np.isfinite(self.low)
        one, rows = np.hstack([np.eye(n), -np.ones((n, 1))]), np.hstack([self.rows, np.zeros((m, 1))])
        other = np.hstack([-np.eye(n), -np.ones((n, 1))])
        size, _ = _linear_program(
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
        ends = np.concatenate([self.low, self.high])
        scale = 1 + np.abs(ends[np.isfinite(ends)]).max(initial=0.0)
        return self.violation(range(len(self.names)))[0] <= MET * float(scale)

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
        left = [*range(len(self.names))]
        while len(found) < MOST and not self.only(left).met:
            part = [left[i] for i in self.only(left).irreducible()]
            found.append(self._conflict(part))
            if not part:
                break  # the bounds alone
            rest = [
                self.only(kept).violation(range(len(kept)))[0] for kept in ([j for j in left if j != i] for i in part)
            ]
            left.remove(part[int(np.argmin(rest))])
        return tuple(found)

    def irreducible(self) -> list[int]:
        """The numbers of a set that no alpha meets, of which each is needed for that."""
        kept = [*range(len(self.names))]
        for i in range(len(self.names)):
            rest = [j for j in kept if j != i]
            if not self.only(rest).met:
                kept = rest
        return kept

    def _conflict(self, part: list[int]) -> Conflict:
        own = self.only(part)
        amounts, _ = own.give()
        names, alone = list(own.names), [self._alone(i) for i in part]
        if own.widened(np.inf).met:  # without the bounds there is no contradiction
            names.append(BOUNDS)
            amounts, alone = np.append(amounts, 0.0), [*alone, self.too_narrow()]
        return Conflict(tuple(names), amounts, np.array(alone))

    def _alone(self, i: int) -> float:
        size, alpha = self.violation([i])
        return float(self.only([i]).off(alpha)[0]) if np.isfinite(size) else np.inf


def _linear_program(
    cost: Array, rows: Array, high: Array, box: Sequence[tuple[float, float]], n: int
) -> tuple[float, Array]:
    """Least cost·x with rows·x ≤ high, x within `box` and x[:n] summing to 1: its value and x[:n]."""
    one = np.concatenate([np.ones(n), np.zeros(len(cost) - n)])[None]
    tight = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = linprog(cost, A_ub=rows, b_ub=high, A_eq=one, b_eq=[1.0], bounds=box, method="highs", options=tight)
    if found.status == 2:
        return np.inf, np.full(n, 1 / n)
    if found.x is None:
        raise SolveError(f"solver 'casadi': its linear program failed: {found.message}")
    return float(found.fun), np.asarray(found.x[:n])
