"""Problems with terms: IPOPT through CasADi, symbolically where the terms are, else by their gradients.

alpha = start + basis·y keeps the sum of 1 and the hard rows at every step. Where nothing meets all that is asked, each
requirement may give way by a slack, and the least sum of slacks tells which clash: those that give, and those whose
multiplier says that they press on these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi
import numpy as np

from lampopt.types import BOUNDS, Array, Conflict, Expressible, Mix, Problem, Status, Term, called, missed

from .outside import Outside
from .quadratic import Squares
from .requirements import Requirements
from .words import held_off, infeasible

FLOOR = 1e-9  # least ridge: of all mixes that do as well, the nearest to the centre
STILL = 1e4  # what movement of what should stay still weighs beside the distance from the centre
FARTHEST = 1e4  # ‖alpha − centre‖ that only an objective without least value leads to
HELD = 1e-6  # what is met to this [normalised] is met
PRESSING = 1e-4  # a multiplier this large [at most 1] tells that a requirement presses on those that give
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
WORDS = {
    "Solve_Succeeded": "the best mix nearby is found",
    "Solved_To_Acceptable_Level": "the best mix nearby is found, to a looser tolerance",
    "Maximum_Iterations_Exceeded": "the search was stopped by its number of iterations: allow more",
    "Diverging_Iterates": "the objective has no least value: add safe=('alpha',), bounds on alpha or a ridge",
    "Infeasible_Problem_Detected": "no mix nearby meets all constraints",
    "Restoration_Failed": "no mix nearby was found that meets all constraints",
    "Search_Direction_Becomes_Too_Small": "the search came to a halt: a term may not be smooth",
    "Invalid_Number_Detected": "a term has no finite value or gradient where the search went; 'nlopt' needs none",
}


@dataclass(frozen=True, eq=False)
class Nonlinear:
    """One problem with terms.

    Parameters
    ----------
    problem
        The problem.
    must
        Its hard rows, ranges and bounds, after they gave way where no alpha meets them.
    squares
        Its other rows and ridge.
    iterations
        At most so many of IPOPT.
    """

    problem: Problem
    must: Requirements
    squares: Squares
    iterations: int

    def solve(self, near: Array) -> Mix:
        """The mix, searched from `near` (N,)."""
        problem, squares = self.problem, self.squares
        if not problem.objectives and self._kept(near):  # the constraints do not press
            residual = problem.matrix @ near - problem.target
            if np.abs(residual).max(initial=0.0) <= HELD * (1 + np.abs(problem.target).max(initial=0.0)):
                return Mix(near + (1 - near.sum()) / len(near), residual, "exact", "every target is met")
        rest = [*problem.objectives, *problem.constraints, *problem.equalities]
        program = _Program(self.must, near, all(isinstance(term, Expressible) for term in rest), self.iterations)
        alpha = program.alpha
        off = casadi.DM(squares.rows) @ alpha - casadi.DM(squares.target)
        cost = casadi.dot(casadi.DM(squares.weight) * off, off)
        cost += max(squares.ridge, FLOOR) * program.distance(squares)
        for i, term in enumerate(problem.objectives, 1):
            cost += program.value(term, called(term, f"objective {i}"))
        for name, term, low in self._terms():
            program.keep(program.value(term, name), low, 0.0)
        found, status = program.least(cost)
        if squares.ridge < FLOOR and not problem.objectives and self._kept(found):
            found = self._nearer(found)
        residual = problem.matrix @ found - problem.target
        if squares.ridge < FLOOR and np.linalg.norm(found - problem.centre) > FARTHEST:
            status = "Diverging_Iterates"
        words = WORDS.get(status, f"IPOPT ended with {status}")
        solved = status in SOLVED
        off = np.abs(residual).max(initial=0.0) > HELD * (1 + np.abs(problem.target).max(initial=0.0))
        wished = missed(problem.objectives, found)
        if solved and not off and wished and self._kept(found):
            return Mix(found, residual, "inexact", f"{', '.join(wished)} cannot be had nearby, or is held off; {words}")
        if solved and not off and self._kept(found):
            return Mix(found, residual, "exact", f"every target is met; {words}" if len(problem.names) else words)
        asked = _Elastic(Requirements.of(problem, soft=True), self._terms(), near, self.iterations)
        if conflicts := asked.conflicts():
            nearest = found if solved and self._kept(found) else asked.nearest
            return infeasible(nearest, problem.matrix @ nearest - problem.target, conflicts)
        kind: Status = "inexact" if solved else "failed"
        return Mix(found, residual, kind, f"{held_off(problem, residual)}; {words}" if solved else words)

    def _nearer(self, found: Array) -> Array:
        """Of all alpha with the rows of `found` that keep all constraints, the stillest and nearest; or `found`."""
        rows, still = self.squares.rows, self.problem.still
        program = _Program(
            self.must, found, all(isinstance(term, Expressible) for _, term, _ in self._terms()), self.iterations
        )
        if len(rows):
            program.keep(casadi.DM(rows) @ program.alpha, rows @ found, rows @ found)
        for name, term, low in self._terms():
            program.keep(program.value(term, name), low, 0.0)
        moved = casadi.DM(still) @ (program.alpha - casadi.DM(self.problem.centre)) if len(still) else casadi.DM(0)
        nearer, status = program.least(program.distance(self.squares) + STILL * casadi.sumsqr(moved))
        return nearer if status in SOLVED and self._kept(nearer) else found

    def _terms(self) -> list[tuple[str, Term, float]]:
        """Constraints and equalities: name, term and the least value that it may have; the largest is 0."""
        p = self.problem
        return [(called(term, f"constraint {i}"), term, -np.inf) for i, term in enumerate(p.constraints, 1)] + [
            (called(term, f"equality {i}"), term, 0.0) for i, term in enumerate(p.equalities, 1)
        ]

    def _kept(self, alpha: Array) -> bool:
        terms = [max(value, low - value) for _, term, low in self._terms() for value in [term(alpha)[0]]]
        return all(value <= HELD for value in [*terms, float(np.abs(self.must.off(alpha)).max(initial=0.0))])


@dataclass(eq=False)
class _Program:
    """Grows to a nonlinear program over what the sum of 1 and the targets of `must` leave free."""

    must: Requirements
    near: Array
    exact: bool  # whether all is symbolic: second derivatives are known then
    iterations: int
    variables: list[Any] = field(default_factory=list)
    start: list[Array] = field(default_factory=list)
    kept: list[tuple[Any, Array, Array]] = field(default_factory=list)
    outside: Outside = field(default_factory=Outside)

    def __post_init__(self) -> None:
        equal, within = self.must.parts()
        at, basis = equal.free(self.near)
        y = self.variable(basis.T @ (self.near - at))
        self.alpha = casadi.DM(at) + casadi.DM(basis) @ y
        if len(within.rows):
            self.keep(casadi.DM(within.rows) @ self.alpha, within.low, within.high)

    def variable(self, start: Array) -> Any:
        """New variables that start there."""
        self.variables.append(casadi.MX.sym("x", len(start)))
        self.start.append(start)
        return self.variables[-1]

    def keep(self, value: Any, low: Array | float, high: Array | float) -> None:
        """Demand low ≤ value ≤ high."""
        count = value.numel()
        self.kept.append((casadi.vec(value), np.broadcast_to(low, count), np.broadcast_to(high, count)))

    def value(self, term: Term, name: str) -> Any:
        """A term as an expression."""
        return self.outside.expression(term, self.alpha, name)

    def distance(self, squares: Squares) -> Any:
        """‖alpha − centre‖² or ‖alpha − centre‖₁."""
        apart = self.alpha - casadi.DM(squares.centre)
        if squares.norm == 2:
            return casadi.dot(apart, apart)
        size = np.abs(self.near - squares.centre)
        bound = self.variable(size)
        self.keep(bound - apart, 0.0, np.inf)
        self.keep(bound + apart, 0.0, np.inf)
        return casadi.sum1(bound)

    def least(self, cost: Any) -> tuple[Array, str]:
        """Alpha where `cost` is least nearby, and what IPOPT says of it."""
        found, status = self.run(cost)
        alpha = casadi.Function("alpha", [casadi.vertcat(*self.variables)], [self.alpha])(found["x"])
        alpha = np.asarray(alpha, float).ravel()
        if not np.isfinite(alpha).all():
            return self.near, status
        return alpha + (1 - alpha.sum()) / len(alpha), status

    def run(self, cost: Any) -> tuple[dict[str, Any], str]:
        """IPOPT's answer and status."""
        settings: dict[str, Any] = {
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": self.iterations,
                "tol": 1e-10,
                "constr_viol_tol": 1e-10,
                "acceptable_iter": 8 if self.outside.rough else 0,
                "acceptable_tol": 1e-4,  # a slope that noise does not let become less
                "acceptable_obj_change_tol": 1e-9,
                "bound_relax_factor": 0.0,
                "hessian_approximation": "exact" if self.exact else "limited-memory",
            },
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
        }
        x = casadi.vertcat(*self.variables)
        g = casadi.vertcat(*(value for value, _, _ in self.kept)) if self.kept else casadi.MX(0, 1)
        solver = casadi.nlpsol("program", "ipopt", {"x": x, "f": casadi.densify(cost), "g": g}, settings)
        low = np.concatenate([np.zeros(0), *(low for _, low, _ in self.kept)])
        high = np.concatenate([np.zeros(0), *(high for _, _, high in self.kept)])
        found = solver(x0=np.concatenate(self.start), lbg=low, ubg=high)
        self.outside.check()
        return found, str(solver.stats()["return_status"])


@dataclass(eq=False)
class _Elastic:
    """All that is asked, as requirements and terms that may give way."""

    asked: Requirements
    terms: Sequence[tuple[str, Term, float]]
    near: Array
    iterations: int

    def __post_init__(self) -> None:
        self.names = [*self.asked.names, *(name for name, _, _ in self.terms)]
        self.nearest, self.given, self.pressure, self.pressed = self._least(range(len(self.names)))

    def conflicts(self) -> tuple[Conflict, ...]:
        """What clashes; nothing where all of it can be met."""
        if np.abs(self.given).max(initial=0.0) <= HELD:
            return ()
        part = np.flatnonzero((np.abs(self.given) > HELD) | (self.pressure > PRESSING))
        if not len(part):  # a term without a value tells of none
            return ()
        names, amounts, alone = [self.names[i] for i in part], self.given[part], [self._alone(int(i)) for i in part]
        if self.pressed:
            names, amounts, alone = [*names, BOUNDS], np.append(amounts, 0.0), [*alone, np.nan]
        return (Conflict(tuple(names), amounts, np.array(alone)),)

    def _alone(self, i: int) -> float:
        alpha, given, _, _ = self._least([i])
        others = np.delete(self._off(alpha), i)
        return float(given[i]) if np.abs(others).max(initial=0.0) <= HELD else np.inf

    def _off(self, alpha: Array) -> Array:
        values = [term(alpha)[0] for _, term, _ in self.terms]
        terms = [max(v, 0.0) + min(v - low, 0.0) for v, (_, _, low) in zip(values, self.terms, strict=True)]
        return np.append(self.asked.off(alpha), terms)

    def _least(self, elastic: Sequence[int]) -> tuple[Array, Array, Array, bool]:
        """Alpha with the least sum of what those numbered `elastic` give, what all give, and who presses."""
        bounds = self.asked.only([])
        program = _Program(
            bounds, self.near, all(isinstance(term, Expressible) for _, term, _ in self.terms), self.iterations
        )
        start = self._off(self.near)
        count, chosen = program.kept[0][0].numel() if program.kept else 0, set(elastic)
        up, down = program.variable(np.maximum(start, 0) + 0.01), program.variable(np.maximum(-start, 0) + 0.01)
        m = len(self.names)
        program.keep(casadi.vertcat(up, down), 0.0, np.tile([np.inf if i in chosen else 0.0 for i in range(m)], 2))
        rows = casadi.DM(self.asked.rows) @ program.alpha
        terms = [program.value(term, name) for name, term, _ in self.terms]
        low = np.append(self.asked.low, [low for _, _, low in self.terms])
        high = np.append(self.asked.high, np.zeros(len(self.terms)))
        program.keep(casadi.vertcat(rows, *terms) - up + down, low, high)
        found, _ = program.run(casadi.sum1(up) + casadi.sum1(down))
        multipliers = np.abs(np.asarray(found["lam_g"], float).ravel())
        alpha = casadi.Function("alpha", [casadi.vertcat(*program.variables)], [program.alpha])(found["x"])
        alpha = np.asarray(alpha, float).ravel()
        alpha = alpha if np.isfinite(alpha).all() else self.near
        alpha = alpha + (1 - alpha.sum()) / len(alpha)
        pressed = bool(count and (multipliers[:count] > PRESSING).any())
        return alpha, self._off(alpha), multipliers[-m:], pressed
