"""One search by NLopt (Johnson, https://github.com/stevengj/nlopt) over a space.

One of x is the first step, and the cost is divided by its slope at the start, so that first steps have about that
length whatever the unit of an objective. A point where a term has no value, or no derivatives where the search goes by
them, is a wall: worse than all that was seen, and level.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import nlopt
import numpy as np

from lampopt.types import Array

from .evaluations import HELD, Evaluations, Point
from .space import Space

ALGORITHMS = {
    "mma": nlopt.LD_MMA,
    "ccsaq": nlopt.LD_CCSAQ,
    "slsqp": nlopt.LD_SLSQP,
    "cobyla": nlopt.LN_COBYLA,
    "bobyqa": nlopt.LN_BOBYQA,
}
BY_SLOPE = ("mma", "ccsaq", "slsqp")
FROM_WITHIN = ("mma", "ccsaq")  # from elsewhere NLopt's own way in leaves them astray
LONG = 30  # evaluations without a gain after which a search that goes by derivatives is ended
AGAIN = 100  # times its budget that a search may ask for what is known
SLACK = HELD / 1000  # a limit is met to this: a start that is on it must not count as beyond
HALTS = (nlopt.ForcedStop, nlopt.RoundoffLimited, getattr(nlopt, "runtime_error", RuntimeError), RuntimeError)
REACHED = "its tolerance is reached"
HALTED = "it finds nothing better nearby"
ENDS = {
    nlopt.FTOL_REACHED: REACHED,
    nlopt.XTOL_REACHED: REACHED,
    nlopt.ROUNDOFF_LIMITED: "rounding hides what is left to gain",
}


class Stalled(Exception):  # noqa: N818  # no error: a search that goes by derivatives gets no farther
    """Nothing was gained for long."""


class Met(Exception):  # noqa: N818  # no error: what was looked for is found
    """A point that meets all constraints."""

    def __init__(self, point: Point) -> None:
        super().__init__()
        self.point = point


@dataclass(eq=False)
class Search:
    """One run of one algorithm from the start of `space`.

    Parameters
    ----------
    algorithm
        One of `ALGORITHMS`.
    evaluations
        What is known at a point.
    tolerance
        It stops where the cost (not for bobyqa) or the variables change relatively less.
    unit
        Of the cost.
    until_met
        Whether it ends at the first point that meets all constraints.
    """

    algorithm: str
    evaluations: Evaluations
    space: Space
    tolerance: float
    unit: float = 1.0
    until_met: bool = False
    _optimiser: Any = None  # only while it runs: each would keep the other alive
    _raised: BaseException | None = None
    _seen: list[float] = field(default_factory=list)  # the least and the largest cost

    def __post_init__(self) -> None:
        within = self.space.along(self.evaluations.within)
        above, below = np.isfinite(within.low), np.isfinite(within.high)
        # rows·alpha ≤ limits
        self._rows = np.vstack([-within.rows[above], within.rows[below]])
        self._limits = np.append(-within.low[above], within.high[below])
        self._by_slope = self.algorithm in BY_SLOPE
        self._inequalities = len(self.evaluations.problem.constraints)
        self._mark = self.evaluations.count, self.evaluations.best

    def run(self) -> str:
        """Search; why it ended by itself.

        Raises
        ------
        Spent
            If the budget ended it.
        Met
            If that ended it.
        BaseException
            What a term raised. NLopt has come to its end by then.
        """
        optimiser = nlopt.opt(ALGORITHMS[self.algorithm], self.space.axes.shape[1])
        optimiser.set_min_objective(self._cost)
        if count := len(self._limits) + self._inequalities:
            optimiser.add_inequality_mconstraint(self._below, np.full(count, SLACK))
        if count := len(self.evaluations.problem.equalities):
            optimiser.add_equality_mconstraint(self._equal, np.full(count, HELD / 10))
        optimiser.set_xtol_rel(self.tolerance)
        if self._by_slope:
            optimiser.set_xtol_abs(self.tolerance)
        if self.algorithm != "bobyqa":  # which gains little for a while, then much
            optimiser.set_ftol_rel(self.tolerance)
        optimiser.set_initial_step(1.0)
        optimiser.set_maxeval(AGAIN * self.evaluations.most)
        self._optimiser = optimiser
        try:
            optimiser.optimize(np.zeros(self.space.axes.shape[1]))
        except HALTS:
            pass  # what a term raised is held, and why it ended is asked below
        finally:
            self._optimiser = None
        if isinstance(self._raised, Stalled):
            return HALTED
        if self._raised is not None:
            raise self._raised
        return ENDS.get(optimiser.last_optimize_result(), HALTED)

    def _cost(self, x: Array, slope: Array) -> float:
        point = self._point(x)
        slope[:] = 0.0 if point is None or not slope.size else self.space.axes.T @ point.slope / self.unit
        if point is None:
            low, high = self._seen or (0.0, 0.0)
            return (high + ((high - low) or abs(high) or 1.0)) / self.unit
        self._seen[:] = min([*self._seen[:1], point.cost]), max([*self._seen[1:], point.cost])
        return point.cost / self.unit

    def _below(self, values: Array, x: Array, slopes: Array) -> None:
        point, count = self._point(x), len(self._limits)
        values[:count] = self._rows @ self.space.alpha(x) - self._limits - SLACK
        values[count:] = 1.0 if point is None else point.kept[: self._inequalities] - SLACK
        if slopes.size:
            slopes[:count] = self._rows @ self.space.axes
            slopes[count:] = 0.0 if point is None else point.slopes[: self._inequalities] @ self.space.axes

    def _equal(self, values: Array, x: Array, slopes: Array) -> None:
        point = self._point(x)
        values[:] = 1.0 if point is None else point.kept[self._inequalities :]
        if slopes.size:
            slopes[:] = 0.0 if point is None else point.slopes[self._inequalities :] @ self.space.axes

    def _point(self, x: Array) -> Point | None:
        """What is known at x; None for a wall, and after an end, which NLopt is told of by its own means."""
        if self._raised is None and np.isfinite(x).all():
            try:
                point = self.evaluations(self.space.alpha(x))
                self._watch()
                if not (point.steep if self._by_slope else point.known):
                    return None
                if not self.until_met or point.violation > SLACK:
                    return point
                raise Met(point)
            except BaseException as raised:  # noqa: BLE001  # Ctrl-C too: it must not run through NLopt
                self._raised = raised
        self._optimiser.force_stop()
        return None

    def _watch(self) -> None:
        count, before = self._mark
        now = self.evaluations.best
        if self._by_slope and self.evaluations.count >= count + LONG:
            if now is None or not now.gained(before, self.tolerance):
                raise Stalled
            self._mark = self.evaluations.count, now
