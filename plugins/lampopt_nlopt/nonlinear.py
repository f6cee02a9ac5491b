"""Problems with terms: which algorithm, from where, and what follows when it ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lampopt.errors import SolveError
from lampopt.threads import one_thread
from lampopt.types import BOUNDS, Array, Conflict, Problem

from .evaluations import HELD, Evaluations, Point, Spent
from .least import Lines, Squares
from .search import BY_SLOPE, FROM_WITHIN, REACHED, SLACK, Met, Search
from .space import Space

FLOOR = 1e-9  # least ridge: of all mixes that do as well, the nearest to the centre
EACH = 8  # evaluations a variable from which bobyqa finds more than cobyla
MANY = 300  # variables beyond which slsqp, cubic in their number, takes longer than a mesh
LATE = 5  # an end so soon after a point without a value was forced by it
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
    algorithm, evaluations, seconds, tolerance, step, everywhere
        Options of `NLopt`; `everywhere` stands for search="all".
    """

    problem: Problem
    lines: Lines
    squares: Squares
    algorithm: str
    evaluations: int
    seconds: float
    tolerance: float
    step: float
    everywhere: bool

    def search(self, near: Array) -> Found:
        """Search from `near` (N,), which meets the lines.

        Raises
        ------
        SolveError
            If the algorithm needs derivatives that a term does not tell.
        """
        exact = self.lines.low == self.lines.high
        equal, within = self.lines.taken(exact), self.lines.taken(~exact)
        with one_thread():
            space = Space.around(near, equal, None if self.everywhere else self.problem.directions, self.step)
            middle, _ = equal.free(self.problem.centre)
        evaluations = Evaluations(self.problem, self.squares, within, self.evaluations, self.seconds)
        tried: list[str] = []
        try:
            first = evaluations(space.start)
            for start in ((space.start + middle) / 2, middle):
                first = first if first.known else evaluations(start)
            why = self._run(evaluations, space.at(first.alpha if first.known else space.start), first, tried)
        except Spent as spent:
            why = str(spent)
        return self._found(evaluations, space, tried, why)

    def _run(self, evaluations: Evaluations, space: Space, first: Point, tried: list[str]) -> str:
        """Search from the start of `space`, known as `first`; why it ended. `tried` grows by the algorithms."""
        if not (count := space.axes.shape[1]):
            return "hard rows leave nothing to search" + ("" if self.everywhere else ", search='all' may find more")
        algorithm = self._algorithm(first, count, bool(len(space.along(evaluations.within).rows)))
        while True:
            tried.append(algorithm)
            before = evaluations.best
            why = self._once(algorithm, evaluations, space, before or first)
            forced = why != REACHED or any(evaluations.count - lost < LATE for lost in evaluations.lost)
            then = "cobyla" if self.algorithm == "auto" else algorithm
            if evaluations.best is None or not forced or (then == algorithm and not self._gained(before, evaluations)):
                return why
            algorithm, space = then, space.at(evaluations.best.alpha)

    def _once(self, algorithm: str, evaluations: Evaluations, space: Space, first: Point) -> str:
        search = Search(algorithm, evaluations, space, self.tolerance)
        if algorithm not in BY_SLOPE:
            return search.run()
        slope = float(np.linalg.norm(space.axes.T @ first.slope))
        search = replace(search, unit=max(slope, self.tolerance * abs(first.cost)) or 1.0)
        try:
            return replace(search, until_met=algorithm in FROM_WITHIN and first.violation > SLACK).run()
        except Met as met:
            return replace(search, space=space.at(met.point.alpha)).run()

    def _gained(self, before: Point | None, evaluations: Evaluations) -> bool:
        now = evaluations.best
        if before is None or now is None:
            return before is not now
        if max(before.violation, now.violation) > HELD:
            return before.violation - now.violation > self.tolerance * now.violation
        return before.cost - now.cost > self.tolerance * abs(now.cost)

    def _algorithm(self, first: Point, count: int, within: bool) -> str:
        """What searches `count` variables, with or without ranges and bounds, from `first`."""
        p = self.problem
        if self.algorithm == "auto":
            if first.steep and len(p.equalities) <= count:
                return "ccsaq" if count > MANY and not p.equalities else "slsqp"
            free = not (within or p.constraints or p.equalities)
            return "bobyqa" if free and 1 < count <= self.evaluations / EACH else "cobyla"
        if self.algorithm in BY_SLOPE and not first.steep:
            names = ", ".join(first.level) or "the terms"
            raise SolveError(
                f"{names}: no derivatives at the start, which algorithm {self.algorithm!r} of solver 'nlopt' needs: "
                "choose 'cobyla', 'bobyqa' or 'auto'"
            )
        return "cobyla" if self.algorithm == "bobyqa" and count == 1 else self.algorithm  # it needs two

    def _found(self, evaluations: Evaluations, space: Space, tried: list[str], why: str) -> Found:
        best, count, lost = evaluations.best, space.axes.shape[1], len(evaluations.lost)
        words = f"{count_of(evaluations.count, 'evaluation')} of {count_of(count, 'variable')}, {why}"
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


def count_of(number: int, what: str) -> str:
    """`1 variable`, `2 variables`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
