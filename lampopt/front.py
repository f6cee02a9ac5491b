"""Accuracy against reliability: all mixes from what is asked to the centre (paper, appendix Multi-Objective LAMP).

Minimising ‖matrix·alpha − target‖² + ridge·‖alpha − centre‖² for one ridge after the other gives every mix that can be
nearer to the centre only by missing more of what is asked: a front, from one decomposition where the solver is `kkt`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lampopt.compromise import MOST, Asked, numbers, ridges_of, whole_number
from lampopt.errors import StudyError
from lampopt.goals import Reduce
from lampopt.pareto import bends, knee, pareto
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Progress
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import Array, Design, Needs, Result, Status
from lampopt.types.arrays import Table, assign, frozen_array
from lampopt.units import said


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
    _asked: tuple[Asked, ...] = field(repr=False)

    def __post_init__(self) -> None:
        count = len(self.status)
        for name in ("by", "ridge", "distance"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count,))})
        for name in ("error", "value"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count,), nan=True)})
        for name in ("alpha", "predicted"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count, None))})
        assign(self, efficient=frozen_array(self.efficient, "efficient", (count,), bool))

    def design(self, number: int) -> Design:
        """The design of one mix, by its number from 0; not judged. StudyError if there is none."""
        i = whole_number(number, "number", 0, len(self.status) - 1)
        return self._of(i).design(self.ridge[i], self.alpha[i], self.status[i])

    def result(self, number: int, level: Needs | None = None) -> Result:
        """The same, judged up to `level`, by default the study's."""
        i = whole_number(number, "number", 0, len(self.status) - 1)
        return self._of(i).result(self.ridge[i], self.alpha[i], self.status[i], level)

    def _of(self, i: int) -> Asked:
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
        The number of the mix farthest from the chord between the ends of the front, both axes normalised by these.
    bends
        Whether there is such a knee: a straight front, as that of one target is, has none, and `knee` is any.
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
    bends: bool
    reduction: Reduction | None
    _asked: Asked = field(repr=False)

    def __post_init__(self) -> None:
        count = len(self.status)
        assign(self, target=Table(self.target))
        for name in ("ridge", "distance"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count,))})
        for name in ("error", "worst"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count,), nan=True)})
        for name in ("alpha", "predicted"):
            assign(self, **{name: frozen_array(getattr(self, name), name, (count, None))})
        assign(self, reached=frozen_array(self.reached, "reached", (count, None), nan=True))

    def __len__(self) -> int:
        return len(self.status)

    def design(self, number: int) -> Design:
        """The design of one mix, by its number from 0; not judged. StudyError if there is none."""
        i = whole_number(number, "number", 0, len(self) - 1)
        return self._asked.design(self.ridge[i], self.alpha[i], self.status[i])

    def result(self, number: int, level: Needs | None = None) -> Result:
        """The same, judged up to `level`, by default the study's: how safe it is where the front has it."""
        i = whole_number(number, "number", 0, len(self) - 1)
        return self._asked.result(self.ridge[i], self.alpha[i], self.status[i], level)

    def svg(self) -> str:
        """A picture: error over distance, and beside it the label over distance where there is a reduction."""
        from lampopt.reporting.fronts import picture

        more = self.reduction
        beside = None if more is None else (more.distance, more.value, more.error, more.efficient)
        label = "" if more is None else f"{more.name} [{more.unit}]" if more.unit else more.name
        return picture(self.distance, self.error, self.knee if self.bends else None, beside, label)


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
        progress or silent,
    )
    task.refuse_corrections("front")
    asked = Asked.of(task)
    given = ridges_of(ridges, asked)
    if (1 + len(fractions)) * len(given) > MOST:
        raise StudyError(f"ridges: expected at most {MOST:,} mixes in all, got {(1 + len(fractions)) * len(given):,}")
    tell(0.0, f"{len(given)} ridges")
    batch = asked.path(given)
    alpha, reached = batch.alpha, asked.reached(batch.alpha)
    off, distance = asked.off(reached), asked.distance(alpha)
    error = asked.error(off)
    known = _solved(batch.status) & np.isfinite(error)
    at = np.flatnonzero(known) if known.any() else np.zeros(1, int)
    points = np.column_stack([distance, np.nan_to_num(error)])[at]
    return Front(
        target=asked.target,
        units=tuple(task.wishes.quantities[name].unit for name in asked.target),
        ridge=given,
        error=error,
        worst=np.abs(off).max(1),
        distance=distance,
        alpha=alpha,
        predicted=alpha @ task.bank.parameters,
        reached=reached,
        status=batch.status,
        knee=int(at[knee(points)]),
        bends=bends(points),
        reduction=_reduction(task, fractions, given, tell) if fractions else None,
        _asked=asked,
    )


def _solved(status: Sequence[Status]) -> Array:
    return np.array([one != "failed" for one in status])


def _reduction(task: Task, fractions: Sequence[float], ridges: Array, tell: Progress) -> Reduction:
    objective = task.study.objective
    assert isinstance(objective, Reduce)  # told by _fractions
    name = objective.name
    before = task.wishes.quantities.at(name, task.study.reference)
    if before == 0:
        raise StudyError(f"reduce: {name!r} is 0 at the reference, of which there are no fractions")
    asked, batches = [], []
    for done, by in enumerate(fractions, 1):
        tell(done / (1 + len(fractions)), f"{name} by {by:g}")
        asked.append(Asked.of(replace(task, study=replace(task.study, objective=Reduce(name, by)))))
        batches.append(asked[-1].path(ridges))
    reached = [one.reached(batch.alpha) for one, batch in zip(asked, batches, strict=True)]
    errors = [one.error(one.off(values), but=name) for one, values in zip(asked, reached, strict=True)]
    alpha, error = np.concatenate([batch.alpha for batch in batches]), np.concatenate(errors)
    distance, status = asked[0].distance(alpha), tuple(s for batch in batches for s in batch.status)
    value = np.concatenate(reached)[:, [*asked[0].target].index(name)]
    better = -1 if objective.by < 0 else 1  # which raises the label
    points = np.column_stack([error, distance, better * value / before])
    points[~_solved(status)] = np.nan  # which is on no front
    return Reduction(
        name=name,
        unit=task.wishes.quantities[name].unit,
        before=before,
        by=np.repeat(fractions, len(ridges)),
        ridge=np.tile(ridges, len(fractions)),
        error=error,
        distance=distance,
        status=status,
        value=value,
        alpha=alpha,
        predicted=alpha @ task.bank.parameters,
        efficient=pareto(points),
        _asked=tuple(asked),
    )


def _fractions(study: Study, given: Sequence[float]) -> list[float]:
    found = numbers(given, "reduce", "expected fractions below 1, such as 0.10")
    if found and not isinstance(study.objective, Reduce):
        raise StudyError("reduce: expected a study with an objective, Reduce(name, by=...), got one without")
    if found and not -10 < min(found) <= max(found) < 1:
        raise StudyError(f"reduce: expected fractions below 1, such as 0.10, got {said(given):.80}")
    return found
