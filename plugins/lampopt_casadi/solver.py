"""What is asked in one problem, by the program that it needs: least squares, a quadratic or a nonlinear program."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lampopt.errors import InputError
from lampopt.threads import one_thread
from lampopt.types import Array, Mix, MixBatch, Problem

from .nonlinear import Nonlinear
from .quadratic import Squares, least_squares
from .requirements import MET, Requirements
from .words import held_off, infeasible


@dataclass(frozen=True)
class CasADi:
    """Targets, ranges, bounds on alpha, either norm, and terms: objectives, constraints, equalities.

    Parameters
    ----------
    ridge
        Weight of ‖alpha − centre‖² (‖alpha − centre‖₁ in norm 1) where the problem names none (paper, appendix P).
    iterations
        At most so many of IPOPT.
    """

    ridge: float = 0.0
    iterations: int = 500

    def __post_init__(self) -> None:
        if not (np.isfinite(self.ridge) and self.ridge >= 0):
            raise InputError(f"ridge: expected a number of at least 0, got {self.ridge}")
        if self.iterations < 1:
            raise InputError(f"iterations: expected at least 1, got {self.iterations}")

    def solve(self, problem: Problem) -> Mix:
        """The mix; what cannot be met comes back as conflicts, with the alpha that comes nearest.

        Raises
        ------
        SolveError
            If a term has no gradient: `nlopt` can do without.
        """
        with one_thread():
            return self._solve(problem)

    def solve_many(self, problem: Problem, targets: Array, ridges: Array | None = None) -> MixBatch:
        """The mixes for targets (B, k), one ridge (B,) each if given, one after the other."""
        with one_thread():
            return MixBatch.one_by_one(partial(self._solve, reasons=False), problem, targets, ridges)

    def _solve(self, problem: Problem, *, reasons: bool = True) -> Mix:
        """The mix; a batch tells no `reasons`, which may take longer to find than the mix."""
        problem = replace(problem, ridge=self.ridge if problem.ridge is None else problem.ridge)
        must, asked = (Requirements.of(problem, soft=soft) for soft in (False, True))
        if not (possible := must.met):
            amounts, wider = must.give()
            must = must.relaxed(amounts).widened(wider)
        soft = ~problem.hard
        squares = Squares(
            problem.matrix[soft], problem.target[soft], problem.weight[soft], problem.ridge or 0.0, problem.centre,
            problem.norm,
            problem.still,
        )  # fmt: skip
        alpha = least_squares(squares, *must.parts())
        if problem.objectives or problem.constraints or problem.equalities:
            mix = Nonlinear(problem, must, squares, self.iterations).solve(alpha)
            if possible:
                return mix
            alpha = mix.alpha
        alpha = alpha + (1 - alpha.sum()) / len(alpha)
        residual = problem.matrix @ alpha - problem.target
        met = np.abs(asked.off(alpha)).max(initial=0.0) <= MET * (1 + np.abs(problem.target).max(initial=0.0))
        if possible and met:
            return Mix(alpha, residual, "exact", "every target is met")
        if possible and asked.met:
            return Mix(alpha, residual, "inexact", held_off(problem, residual))
        return infeasible(alpha, residual, asked.conflicts()) if reasons else Mix(alpha, residual, "infeasible")
