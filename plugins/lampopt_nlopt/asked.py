"""What is asked of a mix, one linear requirement each: by how much no mix meets them, and which clash.

A requirement is low ≤ row·alpha ≤ high; a target has low = high. A set of which none can be left out for it to
contradict itself is found by leaving out one after the other (deletion filter, Chinneck, 2008, chapter 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lampopt.errors import SolveError
from lampopt.types import BOUNDS, Array, Conflict, Problem

from .least import Lines, Squares, least_squares

MET = 1e-8  # a requirement met to this [normalised] is met
MOST = 8  # conflicts that are told apart


@dataclass(frozen=True, eq=False)
class Asked:
    """m requirements on alpha (N,) by their names, and bounds (N,) on alpha itself."""

    names: tuple[str, ...]
    lines: Lines
    alpha_low: Array
    alpha_high: Array

    @classmethod
    def of(cls, problem: Problem, *, soft: bool) -> Asked:
        """The hard rows and ranges of `problem`, and its bounds; with `soft`, its other rows too."""
        taken = problem.hard | soft
        target, n = problem.target[taken], len(problem.centre)
        return cls(
            (*(name for name, use in zip(problem.names, taken, strict=True) if use), *problem.range_names),
            Lines(
                np.vstack([problem.matrix[taken], problem.range_matrix]),
                np.append(target, problem.range_low),
                np.append(target, problem.range_high),
            ),
            np.full(n, -np.inf) if problem.alpha_low is None else problem.alpha_low,
            np.full(n, np.inf) if problem.alpha_high is None else problem.alpha_high,
        )

    def only(self, chosen: Sequence[int]) -> Asked:
        """Those with the numbers `chosen`; the bounds stay."""
        at = np.asarray(chosen, int)
        return replace(self, names=tuple(self.names[i] for i in at), lines=self.lines.taken(at))

    def but(self, i: int) -> Asked:
        """All but number i."""
        return self.only([j for j in range(len(self.names)) if j != i])

    def relaxed(self, amounts: Array) -> Asked:
        """The same after they gave way by `amounts` (m,): a target moves, a range grows."""
        rows, low, high = self.lines.rows, self.lines.low, self.lines.high
        down, up = np.minimum(amounts, 0), np.maximum(amounts, 0)
        exact = low == high
        moved = Lines(rows, low + np.where(exact, amounts, down), high + np.where(exact, amounts, up))
        return replace(self, lines=moved)

    def widened(self, by: float) -> Asked:
        """The same with the bounds on alpha wider by so much."""
        return replace(self, alpha_low=self.alpha_low - by, alpha_high=self.alpha_high + by)

    @property
    def narrow(self) -> float:
        """By how much the bounds have to be wider for any alpha within them to sum to 1."""
        low, high = self.alpha_low, self.alpha_high
        by = max(float((low - high).max()) / 2, float(low.mean()) - 1 / len(low), 1 / len(low) - float(high.mean()))
        return by if by > MET else 0.0

    def whole(self) -> Lines:
        """The sum of 1, all requirements, and the bounds."""
        n = len(self.alpha_low)
        bounded = np.isfinite(self.alpha_low) | np.isfinite(self.alpha_high)
        return Lines(
            np.vstack([np.ones((1, n)), self.lines.rows, np.eye(n)[bounded]]),
            np.concatenate([[1.0], self.lines.low, self.alpha_low[bounded]]),
            np.concatenate([[1.0], self.lines.high, self.alpha_high[bounded]]),
        )

    def give(self) -> Array:
        """(m,) what they have to give at least, by the sum of squares, within the bounds; 0 where nothing.

        A range gives by an unknown of its own, which joins alpha.
        """
        rows, low, high = self.lines.rows, self.lines.low, self.lines.high
        (m, n), exact = rows.shape, low == high
        ranges = m - int(exact.sum())
        within = self.only([]).whole()
        square, own = np.zeros((m, n + ranges)), np.eye(ranges)
        square[exact, :n], square[~exact, n:] = rows[exact], own
        kept = np.block([[within.rows, np.zeros((len(within.rows), ranges))], [rows[~exact], own]])
        found = least_squares(
            Squares(
                square, np.where(exact, low, 0.0), np.ones(m), 0.0,
                np.append(np.full(n, 1 / n), np.zeros(ranges)), np.empty((0, n + ranges)),
            ),
            Lines(kept, np.append(within.low, low[~exact]), np.append(within.high, high[~exact])),
        )  # fmt: skip
        if found is None:
            raise SolveError("solver 'nlopt': found no mix within the bounds on alpha, though there is one")
        give = self.lines.off(found[:n])
        return np.where(np.abs(give) > MET * self.scale, give, 0.0)

    @property
    def scale(self) -> float:
        """1 and the largest target or limit."""
        ends = np.append(self.lines.low, self.lines.high)
        return 1 + float(np.abs(ends[np.isfinite(ends)]).max(initial=0.0))

    def conflicts(self) -> tuple[Conflict, ...]:
        """Smallest sets that contradict themselves; the next without what is most in the way of the rest."""
        if (wider := self.narrow) > 0:
            return (Conflict((BOUNDS,), np.array([wider]), np.array([wider])), *self.widened(wider).conflicts())
        found, left = list[Conflict](), self
        while len(found) < MOST and (give := left.give()).any():
            part = left.only(np.flatnonzero(give).tolist())._irreducible()
            found.append(part._conflict(self))
            rest = [np.abs(left.but(left.names.index(name)).give()).sum() for name in part.names]
            left = left.but(left.names.index(part.names[int(np.argmin(rest))]))
        return tuple(found)

    def _irreducible(self) -> Asked:
        """A set that no alpha meets, of which each is needed for that."""
        kept = self
        for name in self.names:
            rest = kept.but(kept.names.index(name))
            kept = rest if rest.give().any() else kept
        return kept

    def _conflict(self, whole: Asked) -> Conflict:
        """These, of which each has to give so much alone for all of `whole` to be met."""
        names, amounts = self.names, self.give()
        alone = [whole._alone(whole.names.index(n), float(a)) for n, a in zip(names, amounts, strict=True)]
        if not self.widened(np.inf).give().any():  # without the bounds there is no contradiction
            names, amounts, alone = (*names, BOUNDS), np.append(amounts, 0.0), [*alone, np.nan]
        return Conflict(names, amounts, np.array(alone))

    def _alone(self, i: int, sign: float) -> float:
        """What number i has to give, up or down as `sign`, for all others to be met; infinite where in vain."""
        own, n = self.only([i]).lines, len(self.alpha_low)
        aim = own.high if sign > 0 else own.low
        near = Squares(own.rows, aim, np.ones(1), 0.0, np.full(n, 1 / n), np.empty((0, n)))
        alpha = least_squares(near, self.but(i).whole())
        return np.inf if alpha is None else float(own.off(alpha)[0])
