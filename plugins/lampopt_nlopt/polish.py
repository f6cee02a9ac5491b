"""The last digits where all terms have derivatives: Newton's steps from the best point of a search.

A step goes where the Lagrangian is least to second order, among what meets all requirements to first order (Nocedal &
Wright, Numerical optimization, 2006, chapter 18). The curvature of squares and ridge is known. That of terms costs no
evaluation of its own: it is what their derivatives at the points that the search came by tell, by symmetric updates of
rank one (chapter 6.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls

from lampopt.threads import one_thread
from lampopt.types import Array, rough

from .evaluations import HELD, Evaluations, Point
from .least import Lines, Squares, least_squares
from .space import Space

STEPS = 30  # evaluations at most
FAR = 1.0  # a step longer than the first of the search is no matter of last digits
FAILS = 3  # so many steps in a row that lead no nearer are the last
APART = 1e-7  # points nearer to each other tell of rounding, not of curvature
ASKEW = 1e-6  # nor does a point whose cosine with what is not known yet is less
FLAT = 1e-8  # less curvature, as part of the largest, is rounding
STIFF = 100.0  # curvature that is given to what presses, as part of the largest
PRESSES = 1e-8  # a limit that a step comes so near may press
EQUAL = 1e-9  # costs that are this part of them apart are equal


@dataclass(frozen=True, eq=False)
class Step:
    """A step x (q,), and what the cost would gain (m,) by each requirement that gave way, by so much: multipliers."""

    x: Array
    weights: Array

    @property
    def length(self) -> float:
        """Of the step."""
        return float(np.linalg.norm(self.x))


@dataclass(frozen=True, eq=False)
class Polish:
    """From the best of `evaluations`, along `space`, until a step would move alpha by less than `tolerance` of it."""

    evaluations: Evaluations
    space: Space
    tolerance: float

    def run(self) -> bool:
        """Whether the best point is now one that nothing nearby betters.

        Raises
        ------
        Spent
            If the budget ended it.
        """
        point, p = self.evaluations.best, self.evaluations.problem
        if point is None or not point.steep or any(map(rough, (*p.objectives, *p.constraints, *p.equalities))):
            return False
        step, reach, failed = self._step(point, None), FAR, 0
        for _ in range(STEPS):
            if step is None or step.length > FAR or failed == FAILS:
                return False
            if self._short(point, step, self.tolerance):
                return self._taken(point, step)
            part = min(1.0, reach / step.length)
            after = self.evaluations(self.space.at(point.alpha).alpha(part * step.x))
            # What is left from either end, by the same curvature, which knows of both: else they could not be compared.
            left = self._step(point, step.weights)
            then = self._step(after, step.weights) if after.steep else None
            if left is not None and then is not None and then.length <= (1 - part / 2) * left.length:
                point, step, failed = after, then, 0
            elif self._short(point, step, HELD):  # rounding hides the rest
                return self._taken(point, step)
            else:
                reach, failed = part * step.length / 2, failed + 1
                step = left
        return False

    def _short(self, point: Point, step: Step, tolerance: float) -> bool:
        moved = np.linalg.norm(self.space.axes @ step.x)
        return point.violation <= HELD and bool(moved <= tolerance * np.linalg.norm(point.alpha))

    def _taken(self, point: Point, step: Step) -> bool:
        """Whether `point` is no worse than the best, of which what it gains by being beyond limits does not count."""
        best = self.evaluations.best
        assert best is not None
        price, here = np.abs(step.weights), np.zeros(len(step.x))
        new, old = (one.cost + price @ np.abs(self._lines(one).off(here)) for one in (point, best))
        if new > old + EQUAL * abs(old):
            return False
        self.evaluations.best = point
        return True

    def _step(self, point: Point, weights: Array | None) -> Step | None:
        """From `point`, by the curvature for these `weights`; None if it can meet no requirements."""
        with one_thread():
            lines = self._lines(point)
            if weights is not None:
                return self._least(point, lines, weights)
            first = self._least(point, lines, np.zeros(len(lines.rows)))
            return None if first is None else self._least(point, lines, first.weights)

    def _lines(self, point: Point) -> Lines:
        """What is asked of a step from `point`: ranges and bounds, then constraints and equalities to first order."""
        within = self.space.along(self.evaluations.within)
        values = within.rows @ point.alpha
        bound = np.arange(len(point.kept)) >= len(self.evaluations.problem.constraints)
        return Lines(
            np.vstack([within.rows, point.slopes]) @ self.space.axes,
            np.append(within.low - values, np.where(bound, -point.kept, -np.inf)),
            np.append(within.high - values, -point.kept),
        )

    def _least(self, point: Point, lines: Lines, weights: Array) -> Step | None:
        slope, curved = self.space.axes.T @ point.slope, self._curvature(point, weights)
        # Across what presses the Lagrangian may bend down. Curvature that is added there does not change the step.
        lengths, most = np.linalg.norm(lines.rows, axis=1), np.linalg.norm(curved, 2)
        pressing = lines.rows[weights != 0] / lengths[weights != 0, None]
        sizes, ways = np.linalg.eigh(curved + STIFF * most * pressing.T @ pressing)
        sizes = np.maximum(np.abs(sizes), FLAT * most) / most if most else np.ones(len(slope))
        root = np.sqrt(sizes)
        none = np.zeros((0, len(slope)))
        aim = -(ways.T @ slope) / (root * (most or 1.0))
        x = least_squares(
            Squares(root[:, None] * ways.T, aim, np.ones(len(root)), 0.0, np.zeros(len(root)), none), lines
        )
        if x is None:
            return None
        values = lines.rows @ x
        high, low = values >= lines.high - PRESSES * lengths, values <= lines.low + PRESSES * lengths
        new, sides = np.zeros(len(lengths)), np.vstack([lines.rows[high], -lines.rows[low]])
        if len(sides):  # of no columns nnls makes a crash
            press, _ = nnls(sides.T, -(slope + curved @ x), maxiter=100 * len(sides) + 100)
            new[high] += press[: high.sum()]
            new[low] -= press[high.sum() :]
        return Step(x, new)

    def _curvature(self, point: Point, weights: Array) -> Array:
        """(q, q) of the Lagrangian at `point`; of all points seen, the nearest have the last word."""
        curved = self.evaluations.squares.curvature(self.space.axes)
        terms = weights[len(weights) - len(point.kept) :]
        seen = [point, *(p for p in self.evaluations.recent if p.steep)]
        apart = np.array([p.alpha - point.alpha for p in seen]) @ self._back
        slope = point.slope + terms @ point.slopes
        bent = np.array([p.slope + terms @ p.slopes - slope for p in seen]) @ self.space.axes
        lengths = np.linalg.norm(apart, axis=1)
        for i in np.argsort(-lengths):
            rest = bent[i] - curved @ apart[i]
            along = float(apart[i] @ rest)
            if lengths[i] > APART and abs(along) > ASKEW * lengths[i] * np.linalg.norm(rest):
                curved = curved + np.outer(rest, rest / along)
        return curved

    @cached_property
    def _back(self) -> Array:
        """(N, q) from alpha to x."""
        return np.asarray(np.linalg.pinv(self.space.axes).T)
