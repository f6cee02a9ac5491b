"""Accuracy against reliability: all mixes from what is asked to the centre (paper, appendix Multi-Objective LAMP).

Minimising ‖matrix·alpha − target‖² + ridge·‖alpha − centre‖² for one ridge after the other gives every mix that can be
nearer to the centre only by missing more of what is asked: a front, from one decomposition where the solver is `kkt`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real

import numpy as np

from lampopt.errors import InputError, StudyError
from lampopt.goals import Reduce
from lampopt.pareto import knee, pareto
from lampopt.plugins import Plugins
from lampopt.protocols import Progress
from lampopt.solve import Posed, column, solve, solve_path
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import LEVELS, Array, Design, Mix, MixBatch, Needs, Problem, Result, Status
from lampopt.types.arrays import Table, assign, frozen_array
from lampopt.units import number, said, whole

MOST = 20_000  # mixes of a front
NEAR = 1e-3  # of the least squared singular value: the first ridge after 0 takes this part of the way at most
FAR = 1e-6  # of the way is left at the last ridge
RANK = 1e-10  # singular values of what may give way below this part of the rows' size count as zero


@dataclass(frozen=True, eq=False)
class _Asked:
    """What one front asks, and how its mixes become designs."""

    task: Task
    target: dict[str, float]
    posed: Posed

    def path(self, ridges: Array) -> MixBatch:
        """The mixes for all ridges (B,)."""
        targets = np.tile(self.posed.problem.target, (len(ridges), 1))
        return solve_path(self.posed, targets, ridges, self.task.solver)

    def mix(self, ridge: float, alpha: Array) -> Mix:
        """One of them with what the solver says of it."""
        problem = replace(self.posed.problem, ridge=float(ridge))
        found = solve(replace(self.posed, problem=problem), self.task.solver)
        residual = problem.matrix @ alpha[self.posed.active] - problem.target
        return Mix(alpha, residual, found.status, found.message, found.conflicts)

    def design(self, ridge: float, alpha: Array) -> Design:
        """The design of one of them, not judged."""
        return self.task.designer(self.target, self.mix(ridge, alpha))

    def result(self, ridge: float, alpha: Array, level: Needs | None) -> Result:
        """The same, judged up to `level`, by default the study's."""
        if level is not None and level not in LEVELS:
            raise StudyError(f"level: expected one of {', '.join(LEVELS)}, got {said(level)}")
        task = replace(self.task, study=replace(self.task.study, level=level or self.task.study.level))
        return task.judge(self.target, self.posed, self.mix(ridge, alpha))


@dataclass(frozen=True, eq=False)
class Reduction:
    """How far the label of a study's objective is lowered, against all else: B mixes, each by one fraction and ridge.

    Parameters
    ----------
    name, unit
        The label's.
    before
        Its value at the reference [unit].
    by, ridge
        (B,) the fraction that was asked for, and the ridge.
    error
        (B,) as in `Front`, of all that is asked but the label, whose value speaks for itself.
    distance, status
        (B,) as in `Front`.
    value
        (B,) what the mix predicts for the label [unit].
    alpha, predicted
        (B, N) and (B, d).
    efficient
        (B,) truth values: no other is as good in error, distance and value, and better in one of them.
    """

    name: str
    unit: str
    before: float
    by: Array
    ridge: Array
    error: Array
    distance: Array
    status: tuple[Status, ...]
    value: Array
    alpha: Array
    predicted: Array
    efficient: Array
    _asked: tuple[_Asked, ...] = field(repr=False)

    def __post_init__(self) -> None:
        count = len(self.status)
        for name in ("by", "ridge", "error", "distance", "value"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count,))})
        for name in ("alpha", "predicted"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count, None))})
        assign(self, efficient=frozen_array(self.efficient, "efficient", (count,), bool))

    def design(self, number: int) -> Design:
        """The design of one mix, by its number from 0; not judged. StudyError if there is none."""
        i = _whole(number, "number", 0, len(self.status) - 1)
        return self._of(i).design(self.ridge[i], self.alpha[i])

    def result(self, number: int, level: Needs | None = None) -> Result:
        """The same, judged up to `level`, by default the study's."""
        i = _whole(number, "number", 0, len(self.status) - 1)
        return self._of(i).result(self.ridge[i], self.alpha[i], level)

    def _of(self, i: int) -> _Asked:
        return self._asked[i * len(self._asked) // len(self.status)]


@dataclass(frozen=True, eq=False)
class Front:
    """B mixes from what is asked to the centre; letters as everywhere: N exemplars, d parameters, k targets.

    Parameters
    ----------
    target
        What was asked, by name [the bank's units].
    units
        (k,) of these.
    ridge
        (B,) the weight of ‖alpha − centre‖², growing.
    error
        (B,) root of the weighted sum of squared residuals [half of the bank's range].
    worst
        (B,) the largest residual of each [half of the bank's range].
    distance
        (B,) ‖alpha − centre‖.
    alpha, predicted, reached
        (B, N), (B, d), and (B, k) what the mix predicts for each target [the bank's units].
    status
        (B,) as in `Mix`.
    knee
        The number of the mix farthest from the chord between the ends of the front, both axes normalised by these. A
        straight front, as that of one target is, has none: then it is any.
    reduction
        What lowering the objective's label costs, where fractions were given.
    """

    target: Mapping[str, float]
    units: tuple[str, ...]
    ridge: Array
    error: Array
    worst: Array
    distance: Array
    alpha: Array
    predicted: Array
    reached: Array
    status: tuple[Status, ...]
    knee: int
    reduction: Reduction | None
    _asked: _Asked = field(repr=False)

    def __post_init__(self) -> None:
        count = len(self.status)
        assign(self, target=Table(self.target))
        for name in ("ridge", "error", "worst", "distance"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count,))})
        for name in ("alpha", "predicted", "reached"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count, None))})

    def __len__(self) -> int:
        return len(self.status)

    def design(self, number: int) -> Design:
        """The design of one mix, by its number from 0; not judged. StudyError if there is none."""
        i = _whole(number, "number", 0, len(self) - 1)
        return self._asked.design(self.ridge[i], self.alpha[i])

    def result(self, number: int, level: Needs | None = None) -> Result:
        """The same, judged up to `level`, by default the study's: how safe it is where the front has it."""
        i = _whole(number, "number", 0, len(self) - 1)
        return self._asked.result(self.ridge[i], self.alpha[i], level)

    def svg(self) -> str:
        """A picture: error over distance, and beside it the label over distance where there is a reduction."""
        from lampopt.reporting.fronts import picture

        more = self.reduction
        beside = None if more is None else (more.distance, more.value, more.error, more.efficient)
        label = "" if more is None else f"{more.name} [{more.unit}]" if more.unit else more.name
        return picture(self.distance, self.error, self.knee, beside, label)


def front(
    study: Study,
    *,
    ridges: int | Sequence[float] = 200,
    reduce: Sequence[float] = (),
    plugins: Plugins | None = None,
    progress: Progress | None = None,
) -> Front:
    """Every compromise between what `study` asks and nearness to the centre: accuracy against reliability.

    Parameters
    ----------
    study
        The question; its `level` says how designs of the front are judged when they are, its `sweep` does not matter.
    ridges
        How many, from 0, which is the study's own answer without a ridge, to one that leaves a millionth of the way
        from the centre; or the ridges themselves.
    reduce
        Fractions by which the label of the study's objective is to be lowered, each with every ridge.
    plugins
        What to choose from, if not all that is installed.
    progress
        Told how far it is.

    Raises
    ------
    StudyError
        If the study asks for what cannot be, or for nothing that may give way.
    """
    if not isinstance(study, Study):
        raise StudyError(f"study: expected a Study, got {said(study):.80}; read one with Study.read(path)")
    task, fractions, tell = (
        Task.of(study, plugins),
        _fractions(study, reduce),
        progress or (lambda done, message="": None),
    )
    task.refuse_turns_and_terms("front", task.asked({}))
    asked = _asked(task)
    given = _ridges(ridges, asked.posed.problem)
    if (1 + len(fractions)) * len(given) > MOST:
        raise StudyError(f"ridges: expected at most {MOST:,} mixes in all, got {(1 + len(fractions)) * len(given):,}")
    tell(0.0, f"{len(given)} ridges")
    batch = asked.path(given)
    problem, alpha = asked.posed.problem, batch.alpha
    error, distance = _error(problem, batch.residual), _distance(asked.posed, alpha)
    solved = np.array([status != "failed" for status in batch.status])
    at = np.flatnonzero(solved | ~solved.any())
    return Front(
        target=asked.target,
        units=tuple(row.unit for row in asked.posed.rows),
        ridge=given,
        error=error,
        worst=np.abs(batch.residual).max(1, initial=0.0),
        distance=distance,
        alpha=alpha,
        predicted=alpha @ task.bank.parameters,
        reached=_reached(asked.posed, alpha),
        status=batch.status,
        knee=int(at[knee(np.column_stack([distance, error])[at])]),
        reduction=_reduction(task, fractions, given, tell) if fractions else None,
        _asked=asked,
    )


def _asked(task: Task) -> _Asked:
    target = task.asked({})
    return _Asked(task, target, task.posed(target))


def _error(problem: Problem, residual: Array, but: str | None = None) -> Array:
    """(B,) of residuals (B, k), those of the target called `but` left out."""
    counted = np.array([name != but for name in problem.names], bool)
    return np.asarray(np.sqrt(residual[:, counted] ** 2 @ problem.weight[counted]))


def _distance(posed: Posed, alpha: Array) -> Array:
    return np.asarray(np.linalg.norm(alpha - posed.centre(), axis=1))


def _reached(posed: Posed, alpha: Array) -> Array:
    rows = np.array([row.values[posed.active] for row in posed.rows]).reshape(len(posed.rows), len(posed.active))
    return np.asarray(alpha[:, posed.active] @ rows.T)


def _reduction(task: Task, fractions: Sequence[float], ridges: Array, tell: Progress) -> Reduction:
    objective = task.study.objective
    assert objective is not None  # told by _fractions
    name, reference = objective.name, task.bank.names.index(str(task.study.reference))
    found = column(task.bank, name)
    before = float(found.values[reference])
    if before == 0:
        raise StudyError(f"reduce: {name!r} is 0 at the reference, of which there are no fractions")
    asked, batches = [], []
    for done, by in enumerate(fractions, 1):
        tell(done / (1 + len(fractions)), f"{name} by {by:g}")
        asked.append(_asked(replace(task, study=replace(task.study, objective=Reduce(name, by)))))
        batches.append(asked[-1].path(ridges))
    posed, alpha = asked[0].posed, np.concatenate([batch.alpha for batch in batches])
    error = _error(posed.problem, np.concatenate([batch.residual for batch in batches]), but=name)
    distance, status = _distance(posed, alpha), tuple(s for batch in batches for s in batch.status)
    value = _reached(posed, alpha)[:, posed.problem.names.index(name)]
    solved = np.flatnonzero([s != "failed" for s in status])
    efficient = np.zeros(len(status), bool)
    efficient[solved] = pareto(np.column_stack([error, distance, value / before])[solved])
    return Reduction(
        name=name,
        unit=found.unit,
        before=before,
        by=np.repeat(fractions, len(ridges)),
        ridge=np.tile(ridges, len(fractions)),
        error=error,
        distance=distance,
        status=status,
        value=value,
        alpha=alpha,
        predicted=alpha @ task.bank.parameters,
        efficient=efficient,
        _asked=tuple(asked),
    )


def _ridges(given: int | Sequence[float], problem: Problem) -> Array:
    """(B,) as given, growing; or so many, from 0 to the centre."""
    low, high = _span(problem)
    if isinstance(given, Iterable):
        found = _numbers(given, "ridges", "expected how many, or numbers of at least 0")
        if not found or found[0] < 0:
            raise StudyError(f"ridges: expected how many, or numbers of at least 0, got {said(given):.80}")
        return np.array(found)
    count = _whole(given, "ridges", 2, MOST)
    return np.append(0.0, np.geomspace(high, low, count - 1)[::-1])


def _span(problem: Problem) -> tuple[float, float]:
    """The ridges between which the front is: what may give way has strengths s, and moves s² / (s² + ridge) of its way.

    StudyError where nothing may give way.
    """
    exact = np.vstack([np.ones(len(problem.centre)), problem.matrix[problem.hard]])
    _, size, held = np.linalg.svd(exact, full_matrices=False)
    held = held[size > RANK * size.max()]
    rows = np.sqrt(problem.weight[~problem.hard])[:, None] * problem.matrix[~problem.hard]
    strengths = np.linalg.svd(rows - rows @ held.T @ held, compute_uv=False)
    strengths = strengths[strengths > RANK * np.linalg.norm(rows)]
    if not len(strengths):
        raise StudyError("front: expected targets that may be missed, got none: without them there is no compromise")
    return NEAR * float(strengths.min()) ** 2, float(strengths.max()) ** 2 / FAR


def _fractions(study: Study, given: Sequence[float]) -> list[float]:
    found = _numbers(given, "reduce", "expected fractions below 1, such as 0.10")
    if found and not isinstance(study.objective, Reduce):
        raise StudyError("reduce: expected a study with an objective, Reduce(name, by=...), got one without")
    if found and not -10 < min(found) <= max(found) < 1:
        raise StudyError(f"reduce: expected fractions below 1, such as 0.10, got {said(given):.80}")
    return found


def _numbers(given: object, what: str, expected: str) -> list[float]:
    """Finite numbers, growing, none twice."""
    wrong = f"{what}: {expected}, got {said(given):.80}"
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise StudyError(wrong)
    values: list[object] = [*given]
    if not all(isinstance(value, Real) for value in values):
        raise StudyError(wrong)
    try:
        return sorted({number(value, "", what) for value in values})  # type: ignore[arg-type]  # told just now
    except InputError as error:
        raise StudyError(wrong) from error


def _whole(given: object, what: str, least: int, most: int) -> int:
    try:
        return whole(given, what, least, most)
    except InputError as error:
        raise StudyError(str(error)) from error
