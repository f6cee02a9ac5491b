"""Problems with terms: which algorithm, from where, and what follows when it ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import SolveError
from lampopt.threads import one_thread
from lampopt.types import BOUNDS, Array, Conflict, Problem

from .evaluations import HELD, Evaluations, Point, Spent
from .least import Lines, Squares
from .polish import Polish
from .search import BY_SLOPE, FROM_WITHIN, REACHED, SLACK, Met, Search
from .space import Space

if TYPE_CHECKING:
    from .solver import NLopt

FLOOR = 1e-9  # least ridge: of all mixes that do as well, the nearest to the centre
EACH = 8  # evaluations a variable from which bobyqa finds more than cobyla
MANY = 300  # variables beyond which slsqp, cubic in their number, takes longer than a mesh
LEVEL = 1e-6  # a slope less than this part of the curvature is rounding: the start is where squares are least
LATE = 5  # an end so soon after a point without a value was forced by it
NOTHING = "hard rows leave nothing to search"
FREE = "no requirement presses on what is nearest to the targets"
FARTHEST = 1e4  # ‖alpha − centre‖ that only an objective without least value leads to


@dataclass(frozen=True, eq=False)
class Found:
    """The best alpha (N,) of a search, None where no evaluation had a value; how it went; what alpha does not meet."""

    alpha: Array | None
    words: str
    conflicts: tuple[Conflict, ...]
    endless: bool = False  # there is no best alpha


@dataclass(frozen=True, eq=False)
class Nonlinear:
    """One problem with terms.

    Parameters
    ----------
    problem
        The problem.
    lines
        What is to be met of it that is linear, after it gave way where no alpha meets it.
    squares
        Its other rows and ridge.
    options
        How to search.
    """

    problem: Problem
    lines: Lines
    squares: Squares
    options: NLopt

    def search(self, near: Array) -> Found:
        """Search from `near` (N,), which meets the lines.

        Raises
        ------
        SolveError
            If the algorithm needs derivatives that a term does not tell.
        """
        options, everywhere = self.options, self.options.search == "all"
        exact = self.lines.low == self.lines.high
        equal, within = self.lines.taken(exact), self.lines.taken(~exact)
        with one_thread():
            space = Space.around(near, equal, None if everywhere else self.problem.directions, options.step)
            middle, _ = equal.free(self.problem.centre)
        evaluations = Evaluations(self.problem, self.squares, within, int(options.evaluations), options.seconds)
        tried: list[str] = []
        try:
            first = evaluations(space.start)
            if first.known and first.violation <= HELD and not self.problem.objectives:
                return self._found(evaluations, space, tried, FREE)
            for start in ((space.start + middle) / 2, middle):
                first = first if first.known else evaluations(start)
            why = self._run(evaluations, space.at(first.alpha if first.known else space.start), first, tried)
        except Spent as spent:
            why = str(spent)
        return self._found(evaluations, space, tried, why)

    def _run(self, evaluations: Evaluations, space: Space, first: Point, tried: list[str]) -> str:
        """Search from the start of `space`, known as `first`; why it ended. `tried` grows by the algorithms."""
        if not (count := space.axes.shape[1]):
            return NOTHING if self.options.search == "all" else f"{NOTHING}, search='all' may find more"
        algorithm = self._algorithm(first, count, bool(len(space.along(evaluations.within).rows)))
        while True:
            tried.append(algorithm)
            before = evaluations.best
            why = self._once(algorithm, evaluations, space, before or first)
            by_slope = self.options.algorithm in ("auto", *BY_SLOPE)
            if by_slope and Polish(evaluations, space, self.options.tolerance).run():
                return REACHED
            forced = why != REACHED or any(evaluations.count - lost < LATE for lost in evaluations.lost)
            then, best = "cobyla" if self.options.algorithm == "auto" else algorithm, evaluations.best
            if best is None or not forced or (then == algorithm and not best.gained(before, self.options.tolerance)):
                return why
            left = self.options.evaluations - evaluations.count
            if (then in BY_SLOPE and not best.steep) or (then not in BY_SLOPE and left <= count):
                return why
            algorithm, space = then, space.at(best.alpha)

    def _once(self, algorithm: str, evaluations: Evaluations, space: Space, first: Point) -> str:
        search = Search(algorithm, evaluations, space, self.options.tolerance)
        if algorithm not in BY_SLOPE:
            return search.run()
        slope = float(np.linalg.norm(space.axes.T @ first.slope))
        if slope < LEVEL * (bends := float(np.linalg.norm(self.squares.curvature(space.axes), 2))):
            slope = bends
        search = replace(search, unit=max(slope, self.options.tolerance * abs(first.cost)) or 1.0)
        try:
            return replace(search, until_met=algorithm in FROM_WITHIN and first.violation > SLACK).run()
        except Met as met:
            return replace(search, space=space.at(met.point.alpha)).run()

    def _algorithm(self, first: Point, count: int, within: bool) -> str:
        """What searches `count` variables, with or without ranges and bounds, from `first`."""
        p, chosen = self.problem, self.options.algorithm
        if chosen == "auto":
            if first.steep and len(p.equalities) <= count:
                return "ccsaq" if count > MANY and not p.equalities else "slsqp"
            free = not (within or p.constraints or p.equalities)
            return "bobyqa" if free and 1 < count <= self.options.evaluations / EACH else "cobyla"
        if chosen in BY_SLOPE and not first.steep:
            raise SolveError(
                f"{', '.join(first.level) or 'a term'}: has no gradient at the start, which algorithm {chosen!r} of "
                "solver 'nlopt' needs: choose 'auto', 'cobyla' or 'bobyqa'"
            )
        return "cobyla" if chosen == "bobyqa" and count == 1 else chosen  # bobyqa needs two

    def _found(self, evaluations: Evaluations, space: Space, tried: list[str], why: str) -> Found:
        best, count, lost = evaluations.best, space.axes.shape[1], len(evaluations.lost)
        words = f"{_counted(evaluations.count, 'evaluation')} of {_counted(count, 'variable')}, {why}"
        words = f"{' then '.join(dict.fromkeys(tried))}: {words}" if tried else words
        if lost:
            words += f"; {lost} of the evaluations had no value"
        if best is None:
            return Found(None, words, ())
        endless = self.squares.ridge <= FLOOR and np.linalg.norm(best.alpha - self.problem.centre) > FARTHEST
        return Found(best.alpha, words, self._conflicts(evaluations, best), bool(endless))

    def _conflicts(self, evaluations: Evaluations, best: Point) -> tuple[Conflict, ...]:
        """What is not met at the best point, and how far it would have to give."""
        if best.violation <= HELD:
            return ()
        p, low = self.problem, np.where(np.arange(len(best.kept)) < len(self.problem.constraints), -np.inf, 0.0)
        names = [*p.range_names, *(name for name, _ in evaluations.terms), BOUNDS]
        values = p.range_matrix @ best.alpha
        off = [
            *(np.minimum(values - p.range_low, 0) + np.maximum(values - p.range_high, 0)),
            *(np.maximum(best.kept, 0) + np.minimum(best.kept - low, 0)),
            _beyond(p, best.alpha),
        ]
        part = [i for i, amount in enumerate(off) if abs(amount) > HELD]
        return (Conflict(tuple(names[i] for i in part), np.array([off[i] for i in part])),)


def _beyond(problem: Problem, alpha: Array) -> float:
    """How far alpha is beyond its bounds."""
    low = 0.0 if problem.alpha_low is None else float((problem.alpha_low - alpha).max())
    high = 0.0 if problem.alpha_high is None else float((alpha - problem.alpha_high).max())
    return max(low, high, 0.0)


def _counted(number: int, what: str) -> str:
    """`1 variable`, `2 variables`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
