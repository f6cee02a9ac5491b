"""What surrounds a design: how far each parameter may go, what is still free, how the mix follows its targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import ceil

import numpy as np

from lampopt.check import expect_told
from lampopt.errors import InputError, StudyError
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Progress, Solver
from lampopt.solve import Column, Posed, columns, solve, solve_many
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import LEVELS, Array, Bank, Design, Mix, Needs, Result
from lampopt.types.arrays import assign, frozen_array
from lampopt.units import number as in_unit
from lampopt.units import said

FARTHEST = 5.0  # range factor up to which intervals are searched
STEP = 1 / 8  # of the bank's range, by which a search goes outward
TOLERANCE = 1e-3  # of the bank's range, to which the end of an interval is known
SHIFT = 1e-2  # of half the bank's range, by which a target is moved for a derivative
RANK = 1e-10  # singular values of what is asked below this part of the largest count as zero
SEEN = 1e-6  # of the box: a direction of length 1 that changes the probes by less changes nothing
PROBES = 4096  # that are looked at together


@dataclass(frozen=True)
class SafeInterval:
    """How far one parameter may go from a design, all others held, with every check passing.

    It is the connected piece around the current `value`: what may pass again beyond an end is not looked at.

    Parameters
    ----------
    name, unit
        The parameter's.
    value
        What the current mix predicts for it [unit].
    low, high
        The ends, both of which pass [unit]; a thousandth of the bank's range farther out a check fails. Where the
        current design is itself rejected both are `value`.
    low_by, high_by
        The first check that fails beyond; "" where none did as far as was searched, 5 times the bank's range.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    low_by: str
    high_by: str


@dataclass(frozen=True, eq=False)
class Exploration:
    """What surrounds the design that a study asks for; letters as everywhere: N exemplars, k targets.

    Parameters
    ----------
    design
        The design, judged up to `level`.
    level
        How far it and its neighbours were judged.
    unit
        Length unit of the bank.
    intervals
        One a parameter that differs over the bank, in its order.
    free
        (q, N) directions in alpha, the one that changes the shape most first: each sums to zero, leaves every target
        as it is, and has length 1; no two have anything in common, neither in alpha nor at the probes.
    sizes
        (q,) how far the shape changes along 1 of each [unit]: root mean square of the decoder's values at the probes.
    names, units
        The k targets: targets of the study, what it keeps, its objective.
    by_target
        (N, k) d(alpha)/d(target) [1 by the target's unit].
    make
        The design with other coefficients (N,).
    """

    design: Result
    level: Needs
    unit: str
    intervals: tuple[SafeInterval, ...]
    free: Array
    sizes: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    by_target: Array
    make: Callable[[Array], Design] = field(repr=False)

    def __post_init__(self) -> None:
        n = len(self.design.design.mix.alpha)
        free = frozen_array(self.free, "free", (None, n))
        assign(
            self,
            free=free,
            sizes=frozen_array(self.sizes, "sizes", (len(free),)),
            by_target=frozen_array(self.by_target, "by_target", (n, len(self.names))),
        )

    def interval(self, name: str) -> SafeInterval:
        """The interval of parameter `name`; StudyError if it has none."""
        for found in self.intervals:
            if found.name == name:
                return found
        raise StudyError(f"{name!r}: expected a parameter that differs over the bank, one of {self._parameters}")

    def along(self, number: int, step: float | str) -> Design:
        """The design `step` away along a free direction, every target as it is; not judged.

        Parameters
        ----------
        number
            Which direction, from 0.
        step
            How far the shape changes [unit], root mean square at the probes: a number, or text such as "20 mm".

        Raises
        ------
        StudyError
            If there is no such direction, or the step is no length.
        """
        count = len(self.free)
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or not 0 <= number < count:
            there_are = f"expected a whole number from 0 to {count - 1}" if count else "nothing is free in this design"
            raise StudyError(f"number: {there_are}, got {said(number)}")
        try:
            length = in_unit(step, self.unit, "step")
        except InputError as error:
            raise StudyError(str(error)) from error
        return self.make(self.design.design.mix.alpha + length / self.sizes[number] * self.free[number])

    @property
    def _parameters(self) -> str:
        return ", ".join(found.name for found in self.intervals)


def explore(
    study: Study, *, level: Needs = "field", plugins: Plugins | None = None, progress: Progress | None = None
) -> Exploration:
    """What surrounds the design that `study` asks for.

    Parameters
    ----------
    study
        The question; its own `level` and `sweep` do not matter here.
    level
        Up to where neighbours have to pass: "alpha" and "field" cost little, "mesh" is complete and makes a mesh of
        each that passes the others.
    plugins
        What to choose from, if not all that is installed.
    progress
        Told how far it is.

    Raises
    ------
    StudyError
        If the study asks for what cannot be, or `level` is none.
    MeasureError
        If a check could not judge for a reason that may pass; the same call tries again.
    """
    if not isinstance(study, Study):
        raise StudyError(f"study: expected a Study, got {said(study):.80}; read one with Study.read(path)")
    task = Task.of(replace(study, level=level), plugins)
    task.refuse_corrections("explore")
    task.refuse_terms("explore", task.asked({}))
    target = task.asked({})
    posed = task.posed(target)
    mix = solve(posed, task.solver)
    result = task.judge(target, posed, mix)
    free, sizes = _free(task.bank, posed)
    slopes = slopes_by_target(posed, target, task.solver)

    def make(alpha: Array) -> Design:
        return task.designer(target, Mix(alpha, mix.residual, mix.status, mix.message, mix.conflicts))

    return Exploration(
        design=result,
        level=level,
        unit=task.bank.frame.unit,
        intervals=_intervals(task, result, posed, progress or silent),
        free=free,
        sizes=sizes,
        names=posed.problem.names,
        units=tuple(row.unit for row in posed.rows),
        by_target=slopes,
        make=make,
    )


def _intervals(task: Task, result: Result, posed: Posed, progress: Progress) -> tuple[SafeInterval, ...]:
    values = dict(zip([q.name for q in task.bank.space], result.design.predicted.tolist(), strict=True))
    movable = {q.name: values[q.name] for q in task.bank.space if q.spread > 0}
    known = columns(task.bank)
    if by := _failed(result):  # a rejected design has no neighbourhood that would be safe
        progress(1.0, f"the design itself is rejected by {by}")
        return tuple(SafeInterval(name, known[name].unit, v, v, v, by, by) for name, v in movable.items())
    failing, found = _judged(task, posed, result.design.mix, movable), []
    for i, (name, value) in enumerate(movable.items()):
        ends = []
        for side, sign in enumerate((-1, 1)):
            progress((2 * i + side) / (2 * len(movable)), f"{name} {('down', 'up')[side]}")
            ends.append(_end(failing, known[name], value, sign))
        (low, low_by), (high, high_by) = ends
        found.append(SafeInterval(name, known[name].unit, value, low, high, low_by, high_by))
    progress(1.0, f"{len(movable)} parameters")
    return tuple(found)


def _judged(task: Task, posed: Posed, mix: Mix, predicted: dict[str, float]) -> Callable[[str, float], str]:
    """(name, value) → the first check that fails where that parameter alone has that value, "" where all pass.

    Everything is measured from the design `mix`: parameters are held at what it has `predicted`, what is asked besides
    (labels, measured values) at what it reaches, and the mix is the nearest to it. It is judged as the study's own.
    """
    alpha = mix.alpha[posed.active]
    reached = {row.name: float(row.values[posed.active] @ alpha) for row in posed.rows if row.name not in predicted}
    held = {**predicted, **reached}
    about = task.posed(held)
    centre = alpha + (1 - alpha.sum()) / len(alpha)
    levels = LEVELS[: LEVELS.index(task.study.level) + 1]
    # Level by level, so that a mesh is made only of what passes all else; measures judge nothing.
    judges = [replace(task, study=replace(task.study, level=level), measures={}) for level in levels]

    def failing(name: str, value: float) -> str:
        target = {**held, name: value}
        row = about.normalised(np.array([list(target.values())]))[0]
        asked = replace(about, problem=replace(about.problem, target=row))
        found = solve(replace(asked, problem=replace(asked.problem, centre=centre)), task.solver)
        return next(filter(None, (_failed(one.judge(target, asked, found)) for one in judges)), "")

    return failing


def _failed(result: Result) -> str:
    expect_told(result.checks)
    return next((check.name for check in result.checks if not check.passed), "")


def _end(failing: Callable[[str, float], str], row: Column, value: float, sign: int) -> tuple[float, str]:
    """How far the parameter `row` may go from `value`, up or down, and the check that ends it.

    Outward in even steps until a check fails, so that a gap that is narrower may be passed over, then by halves.
    """
    far = row.low + row.spread / 2 + sign * FARTHEST / 2 * row.spread
    if sign * (far - value) <= 0:
        return value, ""
    good = value
    for at in np.linspace(value, far, ceil(abs(far - value) / (STEP * row.spread)) + 1)[1:].tolist():
        if by := failing(row.name, at):
            bad = at
            break
        good = at
    else:
        return good, ""
    while abs(bad - good) > TOLERANCE * row.spread:
        middle = (good + bad) / 2
        if not good < middle < bad and not bad < middle < good:  # no number lies between them
            break
        if reason := failing(row.name, middle):
            bad, by = middle, reason
        else:
            good = middle
    return good, by


def _free(bank: Bank, posed: Posed) -> tuple[Array, Array]:
    """Directions (q, N) that keep every row, and how far the shape changes along 1 of each (q,) [user's unit].

    They are the principal axes of the probes' values over all alpha that keep the rows and sum to zero, found by a
    matrix of at most (N, N).
    """
    count = len(posed.active)
    rows = np.vstack([np.full(count, count**-0.5), posed.problem.matrix])
    _, strengths, right = np.linalg.svd(rows)
    basis = right[int((strengths > RANK * strengths.max()).sum()) :]  # (m, active)
    probes = bank.probe_values.shape[1]
    gram = np.zeros((len(basis), len(basis)))
    for first in range(0, probes, PROBES):  # part by part: in double precision all of them may be much to hold
        values = bank.probe_values[posed.active, first : first + PROBES].astype(float)
        change = basis @ values.reshape(count, -1)
        gram += change @ change.T
    squares, axes = np.linalg.eigh(gram / max(probes, 1))
    sizes = np.sqrt(squares.clip(0.0))[::-1]
    directions = axes.T[::-1] @ basis
    seen = sizes > SEEN
    directions, sizes = directions[seen], sizes[seen]
    largest = np.abs(directions).argmax(1)
    directions *= np.sign(directions[np.arange(len(directions)), largest])[:, None]  # of two signs always the same
    return posed.spread_out(directions), sizes / bank.frame.scale


def slopes_by_target(posed: Posed, target: dict[str, float], solver: Solver) -> Array:
    """(N, k) d(alpha)/d(target) by central differences: exact where alpha is affine in targets, or quadratic."""
    if not posed.rows:
        return np.zeros((posed.size, 0))
    moved, steps = [], []
    for row in posed.rows:
        behind, ahead = (target[row.name] + sign * SHIFT * row.spread / 2 for sign in (-1, 1))
        moved += [{**target, row.name: behind}, {**target, row.name: ahead}]
        steps.append(ahead - behind)
    alpha = np.array([mix.alpha for mix in solve_many(posed, moved, solver)])
    return np.asarray((alpha[1::2] - alpha[::2]).T / steps)
