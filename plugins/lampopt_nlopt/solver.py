"""What is asked in one problem: its linear part in closed form, and from there a search where there are terms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lampopt.errors import InputError, SolveError
from lampopt.threads import one_thread
from lampopt.types import Array, Mix, MixBatch, Problem, missed

from .asked import MET, Asked
from .evaluations import HELD
from .least import Lines, Squares, least_squares
from .nonlinear import FLOOR, Nonlinear
from .search import ALGORITHMS

CHOICES = ("auto", *ALGORITHMS)
SPACES = ("parameters", "all")
UNABLE = {  # what algorithms are not able to take
    "mma": ("equalities",),
    "ccsaq": ("equalities",),
    "bobyqa": ("ranges", "bounds on alpha", "constraints", "equalities"),
}


@dataclass(frozen=True)
class NLopt:
    """Terms of any kind, each evaluated once an alpha; targets, ranges and bounds on alpha; norm 2.

    By derivatives where all terms have them, else without, and at every evaluation within the sum of 1 and the hard
    rows. Where derivatives lead, Newton's steps from the best point add the last digits, unless terms have the noise of
    single precision. Problems without terms are solved in closed form.

    Parameters
    ----------
    algorithm
        "auto": slsqp where all terms have derivatives at the start (ccsaq beyond 300 variables); else bobyqa where
        nothing but hard rows has to be met and there are 8 evaluations a variable, cobyla otherwise. cobyla goes on
        where these were forced to end and Newton's steps do not lead to a least value either. mma, ccsaq and bobyqa
        take no equalities, bobyqa no ranges, bounds and constraints either.
    ridge
        Weight of ‖alpha − centre‖² where the problem names none (paper, appendix P).
    evaluations
        At most so many, a problem.
    seconds
        None is begun after that.
    tolerance
        The search stops where the cost or the variables change less than this part of them (bobyqa: the variables).
    step
        Length of first steps, in halves of a parameter's range (in ‖alpha‖ where all of alpha is searched).
    search
        "parameters": along the directions of the problem, if it has any: those that move one parameter each.
        "all": all of alpha.
    """

    algorithm: str = "auto"
    ridge: float = 0.0
    evaluations: int = 200
    seconds: float = np.inf
    tolerance: float = 1e-6
    step: float = 0.25
    search: str = "parameters"

    def __post_init__(self) -> None:
        for name, value, known in (("algorithm", self.algorithm, CHOICES), ("search", self.search, SPACES)):
            if value not in known:
                raise InputError(f"{name}: expected one of {', '.join(known)}, got {value!r}")
        if not (np.isfinite(self.ridge) and self.ridge >= 0):
            raise InputError(f"ridge: expected a number of at least 0, got {self.ridge}")
        if not float(self.evaluations).is_integer() or self.evaluations < 1:
            raise InputError(f"evaluations: expected a whole number of at least 1, got {self.evaluations}")
        if not self.seconds > 0:
            raise InputError(f"seconds: expected a number above 0, got {self.seconds}")
        if not 0 < self.tolerance < 1:
            raise InputError(f"tolerance: expected a number between 0 and 1, got {self.tolerance}")
        if not (np.isfinite(self.step) and self.step > 0):
            raise InputError(f"step: expected a number above 0, got {self.step}")

    def solve(self, problem: Problem) -> Mix:
        """The mix; what cannot be met comes back as conflicts, with the alpha that comes nearest.

        Raises
        ------
        SolveError
            If the norm is 1, or the algorithm is not able to take what the problem has.
        """
        problem = replace(problem, ridge=self.ridge if problem.ridge is None else problem.ridge)
        self._refuse(problem)
        with one_thread():
            lines = _lines(problem)
            squares = _squares(problem)
            start = least_squares(squares, lines)
        if start is None:
            raise SolveError("solver 'nlopt': found no mix that meets ranges and bounds, though there is one")
        if not (problem.objectives or problem.constraints or problem.equalities):
            return _told(problem, start + (1 - start.sum()) / len(start), "", MET)
        floored = replace(squares, ridge=max(squares.ridge, FLOOR))
        found = Nonlinear(problem, lines, floored, self).search(start)
        if found.alpha is None:
            words = f"no evaluation had a value, the mix is where the search began; {found.words}"
            return Mix(start, problem.matrix @ start - problem.target, "failed", words)
        if found.endless:
            words = f"the objective has no least value: add safe=('alpha',), bounds on alpha or a ridge; {found.words}"
            return Mix(found.alpha, problem.matrix @ found.alpha - problem.target, "failed", words)
        if not found.conflicts:
            mix = _told(problem, found.alpha, found.words, HELD)
            if mix.status == "exact" and (wished := missed(problem.objectives, found.alpha)):
                words = f"{', '.join(wished)} cannot be had nearby, or is held off; {found.words}"
                return replace(mix, status="inexact", message=words)
            return mix
        names = ", ".join(found.conflicts[0].names)
        words = f"no mix was found that meets {names}; the one nearest to it is returned; {found.words}"
        mix = _told(problem, found.alpha, words, HELD)
        message = mix.message if mix.conflicts else words
        return replace(mix, status="infeasible", message=message, conflicts=(*mix.conflicts, *found.conflicts))

    def solve_many(self, problem: Problem, targets: Array, ridges: Array | None = None) -> MixBatch:
        """The mixes for targets (B, k), one ridge (B,) each if given, one after the other."""
        return MixBatch.one_by_one(self.solve, problem, targets, ridges)

    def _refuse(self, problem: Problem) -> None:
        if problem.norm != 2:
            raise SolveError("solver 'nlopt' is not able to take norm=1: take norm=2, or solver 'casadi'")
        bounded = problem.alpha_low is not None or problem.alpha_high is not None
        asked = {
            "ranges": bool(problem.range_names),
            "bounds on alpha": bounded,
            "constraints": bool(problem.constraints),
            "equalities": bool(problem.equalities),
        }
        names = [name for name in UNABLE.get(self.algorithm, ()) if asked[name]]
        if names and (problem.objectives or problem.constraints or problem.equalities):
            raise SolveError(
                f"algorithm {self.algorithm!r} of solver 'nlopt' is not able to take {', '.join(names)}: leave that "
                "out, or choose 'auto', 'slsqp' or 'cobyla'"
            )


def _lines(problem: Problem) -> Lines:
    """The sum of 1, hard rows, ranges and bounds, after they gave way where no alpha meets them."""
    must = Asked.of(problem, soft=False)
    must = must.widened(must.narrow)
    return must.relaxed(must.give()).whole()


def _squares(problem: Problem) -> Squares:
    soft = ~problem.hard
    return Squares(
        problem.matrix[soft], problem.target[soft], problem.weight[soft], problem.ridge or 0.0, problem.centre,
        problem.still,
    )  # fmt: skip


def _told(problem: Problem, alpha: Array, words: str, held: float) -> Mix:
    """The mix of alpha, with what is to be said of all that is linear; met is what is met to `held`."""
    residual = problem.matrix @ alpha - problem.target
    with one_thread():
        asked = Asked.of(problem, soft=True)
        met = asked.narrow == 0 and asked.whole().worst(alpha) <= held * asked.scale
        conflicts = () if met else asked.conflicts()
    after = f"; {words}" if words else ""
    if met:
        only = words if not problem.names else ""
        return Mix(alpha, residual, "exact", only or f"every target is met{after}")
    if not conflicts:
        return Mix(alpha, residual, "inexact", f"{_held_off(problem, residual)}{after}")
    sets = "; ".join(
        f"{' + '.join(c.names)} contradict each other" if len(c.names) > 1 else f"{c.names[0]} cannot be met"
        for c in conflicts
    )
    said = f"no mix of these exemplars meets all that is asked: {sets}; the nearest is returned"
    return Mix(alpha, residual, "infeasible", f"{said}{after}", conflicts)


def _held_off(problem: Problem, residual: Array) -> str:
    if not len(residual):
        return "nothing is asked"
    worst = int(np.abs(residual).argmax())
    why = "ridge, weights, objectives or constraints hold"
    return f"targets could be met, but {why} {problem.names[worst]} off by {residual[worst]:+.3g}"
