"""The stages chained: the only module that knows them all.

source ─ exemplars ─► bank ─► solve ─► mix ─► decode ─► check ─► record
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt import lamp
from lampopt.bank import decoder_of
from lampopt.choices import Value
from lampopt.closing import correctable
from lampopt.designer import Designer
from lampopt.errors import BankError, InputError, LampoptError, MeasureError, StudyError, SweepError
from lampopt.experiments import MOST
from lampopt.goals import Objective
from lampopt.identity import whole
from lampopt.measured import values_of
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Decoder, Measure, Progress
from lampopt.reading import brief, path_of, why
from lampopt.record import RunFolder, recorded
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import Bank, Needs, Result, Spec
from lampopt.units import said
from lampopt.workers import judged, state
from lampopt.written import expect_precise

if TYPE_CHECKING:
    from trimesh import Trimesh

Grid = Mapping[str, Sequence[Value]] | Sequence[Mapping[str, Value]]
MEASURED = "measured"  # in a run folder: where measures keep what they work out
log = logging.getLogger("lampopt")


def measure(name: str | Spec | Measure, mesh: Trimesh, *, plugins: Plugins | None = None) -> dict[str, float]:
    """The values of a measure, an installed one or an object, on `mesh` [the mesh's unit], by name.

    Raises
    ------
    MeasureError
        If a feature is not there.
    """
    if isinstance(name, str | Spec):
        called = Spec.of(name).name
        made: Measure = (plugins or Plugins.load().report()).make("measure", name)
    else:
        called, made = type(name).__name__, name
    if len(mesh.faces) == 0:
        raise MeasureError(f"measure {called!r}: expected a mesh with faces, got none")
    values = values_of(called, made, mesh)
    return {value: float(v) for value, v in zip(made.names, values, strict=True)}


def design(
    bank: Bank | Path | str,
    targets: Mapping[str, Value],
    *,
    keep: Sequence[str] = (),
    reference: str | None = None,
    objective: Objective | None = None,
    solver: str | Spec = "kkt",
    measures: Sequence[str] | Mapping[str, str | Spec | Measure] = (),
    limits: Mapping[str, float] | None = None,
    level: Needs = "mesh",
    resolution: int = 128,
    plugins: Plugins | None = None,
) -> Result:
    """One design, the shortest way: ``design(bank, {"roof": 1.42, "ramp": 12.0})``. Arguments as in `Study`."""
    study = Study(
        bank,
        targets=targets,
        keep=keep,  # type: ignore[arg-type]  # as it came: Study says what is wrong with it
        reference=reference,
        objective=objective,
        solver=solver,
        measures=measures,
        limits=limits or {},
        level=level,
        resolution=resolution,
    )
    return run(study, plugins=plugins)


def run(
    study: Study,
    folder: str | Path | None = None,
    *,
    report: bool = True,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Result:
    """The design that `study` asks for; with `folder` recorded there, or read back if it is there already.

    `report` says whether `report.html` is written there too; `progress` is told of each evaluation and correction.

    Raises
    ------
    StudyError
        Before anything is computed, if the study asks for what cannot be.
    MeasureError
        If what the design depends on could not be measured for a reason that may pass (its `passing`); the same call
        tries again. What only reports on the design gives a check that says so (its `retry`), and nothing is recorded.
    """
    _expect_study(study)
    (result,) = _results(Task.of(study, plugins), [{}], folder, progress, None, report)
    return result


def sweep(
    study: Study,
    grid: Grid | None = None,
    folder: str | Path | None = None,
    *,
    executor: Executor | None = None,
    ahead: int | None = None,
    report: bool = True,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Generator[Result, None, None]:
    """One design for each target of `grid`, yielded in order as they come; nothing is held.

    Parameters
    ----------
    study
        What all designs have in common; `grid` replaces its targets of the same names.
    grid
        Values by name, every combination of which is made, or a list of target tables, such as `lampopt.experiments`
        makes; default: `study.sweep` or `study.experiments`.
    folder
        Where results are recorded. Designs that are there already are read back, not computed again.
    executor
        Who makes them, as in `concurrent.futures`, many at once: threads, processes, a Dask cluster
        (``client.get_executor()``); by default this process, one after the other. The results are the same. Other
        processes read the bank from its file, or from `folder`. It is not shut down.
    ahead
        How many designs the executor may have, under way or done and not taken. Default: twice its workers, as far as
        it tells, or twice this machine's cores if that is more.
    report
        Whether `report.html` is written into `folder` when all are there.
    progress
        Told how far it is.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    StudyError
        Before anything is computed, if the study asks for what cannot be.
    SweepError
        If a worker is lost, or at the end if designs could not be measured for a reason that may pass: what is
        finished is recorded, and the same sweep goes on with the rest.
    """
    _expect_study(study)
    if executor is not None and (isinstance(executor, type) or not callable(getattr(executor, "submit", None))):
        raise StudyError(f"executor: expected one as in concurrent.futures, with submit, got {executor!r:.80}")
    if ahead is not None and (executor is None or isinstance(ahead, bool) or not isinstance(ahead, int) or ahead < 1):
        raise StudyError(
            f"ahead: expected a whole number from 1 and an executor, got {ahead!r:.80} and {executor!r:.80}"
        )
    if grid is not None:  # tables have no place in a study
        study = replace(study, sweep=grid if isinstance(grid, Mapping) else {}, experiments=None)
    changes = _combinations(study.sweep) if grid is None or isinstance(grid, Mapping) else _tables(grid)
    if not changes and study.experiments is None:
        raise StudyError("sweep: expected values by name, such as {'roof': [1.30, 1.36]}, or experiments, got none")
    task = Task.of(study, plugins)
    if study.experiments is not None:
        changes = study.experiments.tables(task.bank)
    return _results(task, changes, folder, progress, executor, report, ahead)


def results(folder: str | Path, *, every: bool = False, plugins: Plugins | None = None) -> Iterator[Result]:
    """The results recorded in a run folder of the study that was asked last, in the order of its last sweep.

    Designs that other studies left in the same folder are left out, which is said; `every` has them too. Nothing is
    computed: a mesh is read from its file when it is looked at; only one that is gone or was altered is decoded again,
    and written anew where that can be. A folder that cannot be written, or is still being written, can be read.

    Raises
    ------
    InputError
        If no run is recorded in `folder`, or what is recorded there is damaged.
    """
    folder = path_of(folder, "folder")
    study = Study.read(folder / "study.toml")
    return _recorded(folder, study, study.opened(), plugins, every)


def report(folder: str | Path, *, plugins: Plugins | None = None) -> Path:
    """Write `report.html` into a run folder: what was asked, what came, the evidence. Returns its path.

    Raises
    ------
    InputError
        As `results`, or if it cannot be written.
    """
    folder = path_of(folder, "folder")
    study = Study.read(folder / "study.toml")
    return _report(folder, study, study.opened(), plugins)


def _recorded(folder: Path, study: Study, bank: Bank, plugins: Plugins | None, every: bool = False) -> Iterator[Result]:
    def decoder() -> Decoder:
        return decoder_of(bank, plugins or Plugins.load().report())

    return recorded(folder, bank, Designer(bank, decoder, study.resolution), every=every)


def _report(folder: Path, study: Study, bank: Bank, plugins: Plugins | None) -> Path:
    from lampopt.reporting import write_report

    written: Path = write_report(folder, study, bank, _recorded(folder, study, bank, plugins), plugins=plugins)
    return written


def _combinations(grid: Mapping[str, Sequence[Value]]) -> Sequence[Mapping[str, Value]]:
    if not grid:
        return []
    count = math.prod(len(values) for values in grid.values())
    if count > MOST:
        raise StudyError(
            f"sweep: {count:,} combinations, at most {MOST:,} are made at once: give fewer values, or sweep parts of "
            "them, one after the other, into the same folder"
        )
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def _tables(grid: object) -> Sequence[Mapping[str, Value]]:
    """`grid` as a list of target tables."""
    wanted = "sweep: expected values by name, such as {'roof': [1.30, 1.36]}, or a list of tables {'roof': 1.30}"
    if isinstance(grid, str) or not isinstance(grid, Iterable):
        raise StudyError(f"{wanted}, got {said(grid)}")
    tables = list(itertools.islice(grid, MOST + 1))
    if len(tables) > MOST:
        raise StudyError(f"sweep: more than {MOST:,} tables; sweep parts of them into the same folder")
    if wrong := [table for table in tables if not isinstance(table, Mapping)]:
        raise StudyError(f"{wanted}, got a list with {said(wrong[0])}")
    return [dict(table) for table in tables]


def _expect_study(study: object) -> None:
    if not isinstance(study, Study):
        raise StudyError(f"expected a Study, got {study!r}; read one with Study.read(path)")


def _results(
    task: Task,
    changes: Sequence[Mapping[str, Value]],
    folder: str | Path | None,
    progress: Progress | None,
    executor: Executor | None,
    report: bool,
    ahead: int | None = None,
) -> Generator[Result, None, None]:
    """Check every target first, then yield the results one by one."""
    if folder is not None:
        task = task.keeping(path_of(folder, "folder").absolute() / MEASURED)
        if task.study.level == "mesh":
            frame = task.bank.frame
            expect_precise(task.study.format, frame.centre + np.array([[-1.0] * 3, [1.0] * 3]) / frame.scale)
    asked = [task.asked(change) for change in changes]
    expect_possible(task, asked)
    return _yield(task, asked, folder, progress, executor, report, ahead)


def expect_possible(task: Task, asked: Sequence[Mapping[str, float]]) -> None:
    """Raise StudyError, before the first design, where a target is asked that cannot be."""
    every = sorted({name for target in asked for name in target})
    for what, named in (("weights", task.study.weights), ("measured", task.study.measured)):
        if unknown := sorted(set(named) - set(every)):
            raise StudyError(f"{what}: {brief(unknown)} are not asked for; asked for are {brief(every)}")
    for target in {tuple(target): target for target in asked}.values():  # one for each set of names
        task.posed(target)
        correctable(task.study, task.wishes.quantities, target)


def _yield(
    task: Task,
    asked: Sequence[Mapping[str, float]],
    folder: str | Path | None,
    progress: Progress | None,
    executor: Executor | None,
    report: bool,
    ahead: int | None = None,
) -> Generator[Result, None, None]:
    tell = progress or silent
    with RunFolder.open(folder) if folder is not None else nullcontext() as place:
        file = None
        if place is not None:
            file = _bank_file(task, place.folder)
            name = file.name if file.parent == place.folder else str(file.resolve())
            keys = [task.key(target) for target in asked]
            place.write_study(replace(task.study, bank=name).to_toml(), task.identity, keys)
        elif executor is not None and task.bank.path is not None and _holds(task.bank.path, task.bank):
            file = task.bank.path
        number = 0

        def tell_of_design(message: str) -> None:
            tell(number / len(asked), f"design {number + 1} of {len(asked)}, {message}")

        made = judged(task, asked, place, executor, file, ahead, tell_of_design)
        with _said_when_stopped(task, asked, place), closing(made):
            tell(0.0, f"design 1 of {len(asked)}")
            for result in made:
                number += 1
                yield result
                if number < len(asked):
                    tell(number / len(asked), f"design {number + 1} of {len(asked)}")
        tell(1.0, f"{len(asked)} designs")
        if place is not None and report:
            _report_if_possible(task, place.folder)


def _bank_file(task: Task, folder: Path) -> Path:
    """The file that holds the bank; one that is in none, or was altered since it was read, is stored in `folder`.

    It is named after what it holds: another bank's rows in the same folder go on having theirs.
    """
    bank = task.bank
    read_just_now = not isinstance(task.study.bank, Bank)
    if bank.path is not None and (read_just_now or _holds(bank.path, bank)):
        return bank.path
    file = own_file(bank, folder)
    if not _holds(file, bank):
        if file.exists():
            raise InputError(f"{file}: is not the bank that its name tells: remove it, and it is written anew")
        lamp.store_bank(bank, file)
    return file


def own_file(bank: Bank, folder: Path) -> Path:
    """Where in a run folder a bank is stored that is in no file."""
    return folder / f"bank-{whole(bank)}.lamp"


def _holds(file: Path, bank: Bank) -> bool:
    """Whether `file` holds `bank`, which may have been altered in memory since it was read from there."""
    try:
        return whole(lamp.load_bank(file)) == whole(bank)
    except BankError:
        return False


@contextmanager
def _said_when_stopped(task: Task, asked: Sequence[Mapping[str, float]], place: RunFolder | None) -> Iterator[None]:
    """Say how much of a sweep is done where something stops it; a consumer who wants no more is not told."""
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        if place is not None and len(asked) > 1 and not isinstance(error, SweepError):  # which says so itself
            with suppress(LampoptError):
                stopped = "interrupted" if isinstance(error, KeyboardInterrupt) else "stopped"
                log.warning("%s: %s", stopped, state(task, asked, place))
        raise


def _report_if_possible(task: Task, folder: Path) -> None:
    """What is recorded matters more than a picture of it."""
    try:
        _report(folder, Study.read(folder / "study.toml"), task.bank, task.plugins)
    except Exception as error:  # noqa: BLE001  # whatever a picture or a chart fails of
        kind = "" if isinstance(error, LampoptError) else f"{type(error).__name__}: "
        log.warning("%s: the report is not written: %s%s; `lampopt report` tries again", folder, kind, why(error))
