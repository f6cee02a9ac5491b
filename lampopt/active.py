"""Active learning: a dear measure (a flow solution) brought to a target with as few evaluations as can be.

Labelling a bank asks for one solution an exemplar. Here the reference and a few exemplars far apart are measured and a
plane over the parameters is laid through them; the design that it proposes is made and measured, the plane is moved and
turned to tell it too, and so on until the target is met or the budget is spent.

A measure with noise is met on the noise that the search saw: of a flow, on the placements of the grid that its designs
were solved on, which a search may have suited. Confirm the final design, and its reference, on fresh ones:
``OpenFoamDrag(first=100).compared(design, reference)``, or in a shell ``lampopt flow design.stl --against
reference.stl --set first=100``.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lampopt.check import expect_told
from lampopt.errors import InputError, StudyError
from lampopt.goals import Reduce
from lampopt.loop import MEASURED, expect_possible, own_file, run
from lampopt.plane import Plane, in_ranges
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Progress
from lampopt.reading import path_of
from lampopt.record import RunFolder
from lampopt.solve import solve
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import Array, Bank, Parameter, Result, Spec
from lampopt.units import said, whole

SAME = 1e-3  # of mixing coefficients: a proposal no farther from the last one makes no other design
FARTHEST = 0.15  # of the reference's value: how far one proposal may go beyond what was measured
log = logging.getLogger("lampopt")


@dataclass(frozen=True, eq=False)
class Trial:
    """One evaluation.

    Parameters
    ----------
    name
        The exemplar's, or ``design 1``, ``design 2``, ...
    parameters
        (d,) of the mix that was measured [the bank's units].
    predicted
        What the plane had said; NaN of exemplars.
    value
        What was measured; NaN where it could not be.
    """

    name: str
    parameters: Array
    predicted: float
    value: float


@dataclass(frozen=True, eq=False)
class Pursuit:
    """What the evaluations led to: the accepted design nearest to `wanted`, a rejected one where none was accepted.

    `met` says whether it is accepted and within the tolerance, by the measure as the search asked it: its noise is in
    it. `trials` are all that was measured on the way.
    """

    result: Result
    wanted: float
    value: float
    met: bool
    trials: tuple[Trial, ...]

    @property
    def evaluations(self) -> int:
        """How often the measure was asked."""
        return len(self.trials)


def active(
    study: Study,
    *,
    budget: int = 16,
    first: int | None = None,
    tolerance: float = 0.005,
    folder: str | Path | None = None,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Pursuit:
    """Bring a measured value to its target by proposing, measuring, and learning from it.

    Parameters
    ----------
    study
        With a reference, an objective ``Reduce("flow.drag", by=0.1)`` that names a value of one of its `measures`, and
        whatever else it asks (targets, keeps, ranges). Its `turns` correct what of that is measured (its `measured`,
        the bank's own), each time before the value that is sought is measured.
    budget
        Evaluations of the measure at most, the reference's included; fewer where the plane proposes nothing but a
        design that is on target and rejected. One may be several solver runs: `openfoam-drag`
        solves as many flows as it has `placements`.
    first
        How many of them are exemplars, the reference included; by default half as many as there are parameters, and
        two more.
    tolerance
        Of the reference's value, within which the target is met by an accepted design.
    folder
        A run folder, where each proposal is recorded, the best one as what was asked last, and measures that can
        (`Keeping`) keep their work, so that an interrupted pursuit goes on.
    progress
        Told how far it is.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    StudyError
        If the study has no such objective.
    InputError
        For a budget that leaves no proposal, or where the reference cannot be measured.
    MeasureError
        If something could not be measured for a reason that may pass.
    """
    if not isinstance(study, Study):
        raise StudyError(f"active: expected a Study, got {study!r:.80}")
    if not isinstance(study.objective, Reduce) or study.reference is None:
        raise StudyError(f"active: expected an objective such as Reduce('flow.drag', by=0.1), got {study.objective}")
    goal, name = study.objective, study.objective.name
    task = Task.of(study, plugins)
    bank = task.bank
    count = min(len(bank), (len(bank.space) + 1) // 2 + 2) if first is None else whole(first, "first", 2, len(bank))
    budget = whole(budget, "budget", 1)
    if count >= budget:
        raise InputError(f"budget: expected more than the {count} exemplars measured first, got {said(budget)}")
    if not (isinstance(tolerance, int | float) and 0 <= tolerance < 1):
        raise InputError(f"tolerance: expected a part of the reference's value, got {said(tolerance)}")
    if study.reference not in bank.names:
        raise StudyError(f"reference {study.reference!r}: no exemplar of this bank; there are {', '.join(bank.names)}")
    if folder is not None:
        folder = path_of(folder, "folder")
        task = task.keeping(folder.absolute() / MEASURED)
    quantities = task.wishes.quantities
    quantity = quantities[name]
    if quantity.measure is None:
        raise StudyError(f"active: {name!r} is not measured: name a value of one of the study's measures")
    if (key := quantity.measure[0]) not in task.measures:  # an installed one, which is to be reported too
        study = replace(study, measures={**study.to_be_measured(), key: Spec(key)})
        task = Task.of(study, plugins)
        task = task if folder is None else task.keeping(folder.absolute() / MEASURED)
        quantities = task.wishes.quantities
        quantity = quantities[name]
    parameters, space = in_ranges(bank), bank.parameters
    rows = spread_out(parameters, bank.names.index(study.reference), count)
    flat = Plane(parameters, np.ones_like, ((parameters[rows[0]], 1.0),))
    _expect_possible(Task.of(_asked(study, bank, name, flat, 0.9), plugins))
    tell = progress or silent
    trials, seen = list[Trial](), list[tuple[Array, float]]()

    def measured(alpha: Array, called: str, predicted: float, value: float) -> None:
        tell(len(trials) / budget, called)
        trials.append(Trial(called, alpha @ space, predicted, value))
        if np.isfinite(value):
            seen.append((alpha @ parameters, value))
        log.info("active: %s: %s %.6g", called, name, value)

    for row in rows:
        alpha = np.eye(len(bank))[row]
        measured(alpha, bank.names[row], float("nan"), quantities.value(quantity, alpha))
    start = trials[0].value
    if not (np.isfinite(start) and start != 0 and len(seen) > 1):
        raise InputError(
            f"active: {name} of the reference {study.reference!r} is {start:g}, and {len(seen)} of {count} exemplars "
            "have one: expected a reference with a value other than 0, and one more exemplar; lampopt.label tells why "
            "a measure cannot say anything of an exemplar"
        )
    wanted, reach = goal.of(start), 1.0
    plane = Plane(parameters, np.zeros_like, (*seen[1:], seen[0]))
    best: tuple[tuple[bool, float], float, Result] | None = None
    stuck, shelf = np.full(len(bank), np.nan), _Shelf(folder)
    for number in range(1, budget - len(trials) + 1):
        most = FARTHEST * abs(start)
        aim = plane.value + reach * float(np.clip(wanted - plane.value, -most, most))
        asked = _asked(study, bank, name, plane, aim)
        proposed = _proposed(Task.of(asked, plugins))
        if (np.abs(proposed - stuck) <= SAME).all():
            log.warning("active: nothing else is proposed than a design that is on target and was rejected")
            break
        result = run(asked, folder, report=False, plugins=plugins)
        alpha = result.design.mix.alpha
        expect_told(result.checks, "; with a folder the same call goes on from here")
        told = [check.value for check in result.checks if check.name == quantity.name and check.sense == "info"]
        value = told[0] if told else quantities.value(quantity, alpha)  # it is measured once where meshes are judged
        measured(alpha, f"design {number}", float(alpha @ plane.values), value)
        off = abs(value - wanted) / abs(start)
        if better := bool(np.isfinite(off)) and (best is None or (not result.accepted, off) < best[0]):
            best = (not result.accepted, off), value, result
        shelf.put(asked, better)
        stuck = proposed if off <= tolerance else np.full(len(bank), np.nan)
        if best is not None and best[0] <= (False, tolerance):
            break
        if np.isfinite(value):
            plane, reach = plane.through(alpha, value), 1.0
        else:
            reach /= 2  # from where something could be measured
    if best is None:
        raise InputError(f"active: none of {len(trials) - count} designs could be measured by {name}")
    tell(1.0, f"{len(trials)} evaluations")
    return Pursuit(best[2], wanted, best[1], best[0] <= (False, tolerance), tuple(trials))


def spread_out(parameters: Array, start: int, count: int) -> list[int]:
    """`count` rows of (N, d), each as far as can be from those before it, from `start` on (Gonzalez, 1985)."""
    rows, away = [start], np.linalg.norm(parameters - parameters[start], axis=1)
    while len(rows) < count:
        rows.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(parameters - parameters[rows[-1]], axis=1))
    return rows


def _expect_possible(task: Task) -> None:
    """Raise StudyError or SolveError, before anything dear is measured, where no design can be proposed."""
    target = task.asked({})
    expect_possible(task, [target])
    _proposed(task)


def _proposed(task: Task) -> Array:
    """(N,) the mix before corrections; NaN where that takes more than a moment."""
    posed = task.posed(task.asked({}))
    return np.full(len(task.bank), np.nan) if posed.nonlinear else solve(posed, task.solver).alpha


class _Shelf:
    """A pursuit's run folder: every proposal has a bank of its own; the best one's is kept, as what was asked last."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._best: tuple[Path, tuple[str, str, list[str]]] | None = None

    def put(self, study: Study, better: bool) -> None:
        """What was run last there, which is better than all before, or not."""
        if self._folder is None or not isinstance(study.bank, Bank):
            return
        file = spent = own_file(study.bank, self._folder)
        with RunFolder.open(self._folder) as place:
            if better or self._best is None:
                spent = file if self._best is None else self._best[0]
                self._best = file, place.asked()
            else:
                place.write_study(*self._best[1])
        if spent != self._best[0]:
            spent.unlink(missing_ok=True)


def _asked(study: Study, bank: Bank, name: str, plane: Plane, aim: float) -> Study:
    """The study with the plane's values as a label of all exemplars, which is asked for in place of the measure's."""
    label = f"{name.replace('.', ' ')} by a plane"

    def renamed(key: str) -> str:
        return label if key == name else key

    told = np.column_stack([bank.labels, plane.values])
    space = (*bank.label_space, Parameter(label, low=float(told[:, -1].min()), high=float(told[:, -1].max())))
    return replace(
        study,
        bank=replace(bank, labels=told, label_space=space, path=None),
        targets={**study.targets, label: aim},
        objective=None,
        weights={renamed(key): weight for key, weight in study.weights.items()},
        hard=tuple(renamed(key) for key in study.hard),
        measured={key: where for key, where in study.measured.items() if key != name},
        limits={check: limit for check, limit in study.limits.items() if check != f"measured.{name}"},
    )
