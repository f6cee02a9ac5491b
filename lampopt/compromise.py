"""One study asked with many ridges: the mixes, how far each misses what is asked, and the ridges worth asking for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real

import numpy as np

from lampopt.errors import InputError, StudyError
from lampopt.solve import Posed, solve, solve_path
from lampopt.task import Task
from lampopt.types import LEVELS, Array, Design, Mix, MixBatch, Needs, Result, Status
from lampopt.units import number, said, whole
from lampopt.wishes import Goal

MOST = 20_000  # mixes of a front
NEAR = 1e-3  # of the least squared strength: the first ridge after 0 takes this part of the way at most
FAR = 1e-6  # of the way is left at the last ridge
STEP = 1e-4  # of alpha, for a slope that only spaces ridges
RANK = 1e-10  # strengths of what may give way below this part of the rows' size count as zero


@dataclass(frozen=True, eq=False)
class Asked:
    """What one front asks, and how its mixes become designs."""

    task: Task
    target: dict[str, float]
    posed: Posed

    @classmethod
    def of(cls, task: Task) -> Asked:
        """What the study of `task` asks."""
        target = task.asked({})
        return cls(task, target, task.posed(target))

    def path(self, ridges: Array) -> MixBatch:
        """The mixes for all ridges (B,)."""
        targets = np.tile(self.posed.problem.target, (len(ridges), 1))
        return solve_path(self.posed, targets, ridges, self.task.solver)

    @cached_property
    def goals(self) -> dict[str, Goal]:
        """The targets that are not linear in alpha."""
        goals = self.task.wishes.goals(self.target)
        return {goal.quantity.name: goal for goal in goals if goal.low == goal.high and goal.name.startswith("target.")}

    def reached(self, alpha: Array) -> Array:
        """(B, k) what mixes (B, N) predict for each target [the bank's units]; NaN where it cannot be told."""
        rows, told = {row.name: row.values for row in self.posed.rows}, self.task.wishes.value
        columns = [
            alpha[:, self.posed.active] @ rows[name][self.posed.active]
            if name in rows
            else np.array([told(self._goal(name), one) for one in alpha])
            for name in self.target
        ]
        return np.array(columns, float).reshape(len(self.target), len(alpha)).T

    def off(self, reached: Array) -> Array:
        """(B, k) by how much they miss them [half ranges]."""
        spreads = {row.name: row.spread for row in self.posed.rows}
        scale = [spreads[name] if name in spreads else self._goal(name).spread for name in self.target]
        return np.asarray(2 * (reached - [*self.target.values()]) / np.array(scale))

    def error(self, off: Array, but: str | None = None) -> Array:
        """(B,) of misses (B, k), that of the target called `but` left out."""
        weights = self.task.study.weights
        weight = np.array([0.0 if name == but else weights.get(name, 1.0) for name in self.target])
        return np.asarray(np.sqrt(off**2 @ weight))

    def distance(self, alpha: Array) -> Array:
        """(B,) how far they are from the centre, in the norm that the study has chosen."""
        return np.asarray(np.linalg.norm(alpha - self.posed.centre(), self.posed.problem.norm, axis=1))

    def _goal(self, name: str) -> Goal:
        return self.goals[self.task.wishes.quantities[name].name]

    def mix(self, ridge: float, alpha: Array, status: Status) -> Mix:
        """One of them with what the solver says of it, where that is told at once."""
        problem = replace(self.posed.problem, ridge=float(ridge))
        residual = problem.matrix @ alpha[self.posed.active] - problem.target
        if self.posed.nonlinear:
            return Mix(alpha, residual, status, f"one of a front, with a ridge of {ridge:.3g}")
        found = solve(replace(self.posed, problem=problem), self.task.solver)
        return Mix(alpha, residual, found.status, found.message, found.conflicts)

    def design(self, ridge: float, alpha: Array, status: Status) -> Design:
        """The design of one of them, not judged."""
        return self.task.designer(self.target, self.mix(ridge, alpha, status))

    def result(self, ridge: float, alpha: Array, status: Status, level: Needs | None) -> Result:
        """The same, judged up to `level`, by default the study's."""
        if level is not None and level not in LEVELS:
            raise StudyError(f"level: expected one of {', '.join(LEVELS)}, got {said(level)}")
        task = replace(self.task, study=replace(self.task.study, level=level or self.task.study.level))
        return task.judge(self.target, self.posed, self.mix(ridge, alpha, status))


def ridges_of(given: int | Sequence[float], asked: Asked) -> Array:
    """(B,) as given, growing; or so many, from 0 to the centre."""
    low, high = _span(asked)
    if isinstance(given, Iterable):
        found = numbers(given, "ridges", "expected how many, or numbers of at least 0")
        if not found or found[0] < 0:
            raise StudyError(f"ridges: expected how many, or numbers of at least 0, got {said(given):.80}")
        return np.array(found)
    count = whole_number(given, "ridges", 2, MOST)
    return np.append(0.0, np.geomspace(high, low, count - 1)[::-1])


def _span(asked: Asked) -> tuple[float, float]:
    """The ridges between which the front is. StudyError where nothing may give way.

    What may give way, a singular vector of strength s, is s² / (s² + ridge) of its way from the centre. In norm 1 all
    stays at the centre where the ridge is as large as the slope there.
    """
    p, study = asked.posed.problem, asked.task.study
    exact = np.vstack([np.ones(len(p.centre)), p.matrix[p.hard]])
    _, size, held = np.linalg.svd(exact, full_matrices=False)
    held = held[size > RANK * size.max()]
    soft = [name for name, hard in zip(p.names, p.hard, strict=True) if not hard]
    goals = [goal for goal in asked.goals.values() if not goal.hard]
    root = np.sqrt([*p.weight[~p.hard], *(goal.weight for goal in goals)])
    rows = root[:, None] * np.vstack([p.matrix[~p.hard], *(_slope(goal, asked) for goal in goals)])
    strengths = np.linalg.svd(rows - rows @ held.T @ held, compute_uv=False)
    strengths = strengths[strengths > RANK * np.linalg.norm(rows)]
    if not len(strengths):
        raise StudyError("front: expected targets that may be missed, got none: without them there is no compromise")
    if study.norm == 2:
        return NEAR * float(strengths.min()) ** 2, float(strengths.max()) ** 2 / FAR
    off = dict(zip(asked.target, asked.off(asked.reached(asked.posed.centre()[None]))[0], strict=True))
    names = {asked.task.wishes.quantities[name].name: name for name in asked.target}
    missed = root * np.nan_to_num([*(off[name] for name in soft), *(off[names[g.quantity.name]] for g in goals)])
    steepest = float(np.ptp(2 * missed @ rows)) or 1.0
    return FAR * steepest, steepest


def _slope(goal: Goal, asked: Asked) -> Array:
    """(1, N) how a value that is not linear in alpha changes with it at the centre [half ranges].

    Of one that is measured on meshes this would be long to find: it is taken to change as a parameter does.
    """
    n = len(asked.posed.active)
    if goal.quantity.model is None:
        return np.linspace(-1, 1, n)[None]
    centre, spread_out = asked.posed.problem.centre, asked.posed.spread_out

    def value(step: Array) -> float:
        return asked.task.wishes.value(goal, spread_out(centre + step))

    change = [value(STEP * way) - value(-STEP * way) for way in np.eye(n) - 1 / n]
    return np.array([change]) / (STEP * goal.spread)


def numbers(given: object, what: str, expected: str) -> list[float]:
    """Finite numbers, growing, none twice."""
    wrong = f"{what}: {expected}, got {said(given):.80}"
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise StudyError(wrong)
    values: list[object] = [*given]
    real = [value for value in values if isinstance(value, Real)]
    if len(real) < len(values):
        raise StudyError(wrong)
    try:
        return sorted({number(float(value), "", what) for value in real})
    except (InputError, OverflowError) as error:  # not finite, or a whole number beyond any float
        raise StudyError(wrong) from error


def whole_number(given: object, what: str, least: int, most: int) -> int:
    """A whole number from `least` to `most`. StudyError where it is none."""
    try:
        return whole(given, what, least, most)
    except InputError as error:
        raise StudyError(str(error)) from error
