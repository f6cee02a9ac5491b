"""The designs of a sweep, made here or by an executor's workers; only this process writes them down."""

from __future__ import annotations

import logging
import pickle
import platform
import threading
import time
import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from lampopt.crew import Crew, clusters, given_up, lost
from lampopt.errors import BankError, LampoptError, MeasureError, PluginError, StudyError, SweepError, may_pass
from lampopt.evaluations import Memory
from lampopt.mixes import Mixes
from lampopt.plugins import Plugins
from lampopt.pool import interruptible
from lampopt.progress import silent
from lampopt.reading import brief, why
from lampopt.record import RunFolder
from lampopt.solve import solve
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import Check, Mix, Result, Scalar, Spec

if TYPE_CHECKING:
    from trimesh import Trimesh

Target = Mapping[str, float]
PATIENCE = 1.0  # s between two looks at work that may have been cancelled
log = logging.getLogger("lampopt")
OPENING = threading.Lock()


def judged(
    task: Task,
    asked: Sequence[Target],
    place: RunFolder | None = None,
    executor: Executor | None = None,
    file: Path | None = None,
    ahead: int | None = None,
    tell: Callable[[str], None] = silent,
) -> Generator[Result, None, None]:
    """One result for each target, in order: read back where it is recorded in `place`, else made and recorded there.

    One whose measure failed for a reason that may pass is left out, and told once all others are there.

    Parameters
    ----------
    task
        What makes them here.
    asked
        The targets.
    place
        Where they are recorded.
    executor
        Who makes them instead.
    file
        The bank's, for other processes.
    ahead
        How many designs may be under way or done and not taken; by default what suits the executor.
    tell
        Told what goes on in the making of one design; executors tell nothing.

    Raises
    ------
    SweepError
        If a worker is lost, or designs were left out.
    MeasureError
        If the only design was.
    """
    left_out = dict[int, Exception]()
    if executor is None:
        yield from _one_by_one(task, asked, place, tell, left_out)
    else:
        yield from _Ahead(task, asked, place, executor, file, ahead, left_out).results()
    if left_out:
        number, error = next(iter(left_out.items()))
        if len(asked) == 1:
            raise error
        kept = "" if place is None else f": {state(task, asked, place)}"
        raise SweepError(
            f"{len(left_out)} of {len(asked)} designs could not be measured for a reason that may pass "
            f"({dict(asked[number])}: {brief(str(error))}){kept}"
        ) from error


def _one_by_one(
    task: Task,
    asked: Sequence[Target],
    place: RunFolder | None,
    tell: Callable[[str], None],
    left_out: dict[int, Exception],
) -> Generator[Result, None, None]:
    mixes = Mixes(task.posed, task.solver, asked)
    for number, target in enumerate(asked):
        key = "" if place is None else task.key(target)
        result = None if place is None else _recorded(task, place, key)
        if result is None:
            began = time.perf_counter()
            try:
                if task.solves_long(target):
                    memory = (
                        Memory(listener=tell)
                        if place is None
                        else Memory.at(place.folder, task.search(key, target), tell)
                    )
                    found = task.solved(target, memory)
                else:
                    found = mixes.at(number)
                result = task.made(target, *found, tell)
            except MeasureError as error:
                if not may_pass(error):
                    raise
                _leave_out(left_out, number, error)
                continue
            result = _keep(task, place, key, result, time.perf_counter() - began)
        yield result


def _recorded(task: Task, place: RunFolder, key: str) -> Result | None:
    """What is recorded under `key`, if it is still this task's."""
    result = place.read(key, task.bank, task.designer)
    if result is not None and (other := task.outdated(result)):
        log.info("a design is made anew: %s", other)
        return None
    return result


def state(task: Task, asked: Sequence[Target], place: RunFolder) -> str:
    """How much of a sweep is done, for somebody whose sweep was stopped."""
    keys = {task.key(target) for target in asked}
    done = sum(place.has(key) for key in keys)
    return f"{done} of {len(keys)} designs are done and kept in {place.folder}; the same sweep goes on with the rest"


def _leave_out(left_out: dict[int, Exception], number: int, error: Exception) -> None:
    log.warning("design %d is left out: %s", number + 1, error)
    left_out[number] = error


def _keep(task: Task, place: RunFolder | None, key: str, result: Result, seconds: float) -> Result:
    if place is None:
        return result
    if lost := [check for check in result.checks if check.retry]:
        log.warning("a design is not recorded: %s: %s; the same study asks again", lost[0].name, lost[0].note)
        return result
    result = place.write(key, result, task.bank, task=task.identity, form=task.study.format, seconds=seconds)
    task.plugins.recorded(result, result.folder or place.folder)
    return result


@dataclass(frozen=True)
class _Answer:
    """What a worker sends back; the rest of a design follows from its mix."""

    mix: Mix
    checks: tuple[Check, ...]
    provenance: Mapping[str, Scalar]
    made: bool  # whether the mesh was asked for at all
    mesh: Trimesh | None
    seconds: float


class _Ahead:
    """A few designs more than there are workers are under way; each is recorded as soon as it is there."""

    def __init__(
        self,
        task: Task,
        asked: Sequence[Target],
        place: RunFolder | None,
        executor: Executor,
        file: Path | None,
        ahead: int | None,
        left_out: dict[int, Exception],
    ) -> None:
        self._task, self._asked, self._place, self._executor = task, asked, place, executor
        self._left_out = left_out
        self._mixes = Mixes(task.posed, task.solver, asked)
        self._keys = [task.key(target) for target in asked] if place is not None else []
        self._crew, self._ahead = Crew(executor), ahead
        # Threads share what is open; other processes open it for themselves, once.
        self._setup = None if isinstance(executor, ThreadPoolExecutor) else _packed(task, file)
        self._sent, self._next = dict[int, Future[_Answer]](), 0
        self._done = dict[int, Result]()
        self._loose = dict[str, Result]()  # by key: made and not recorded
        self._taken = False  # whether the executor has taken any work

    def results(self) -> Generator[Result, None, None]:
        """In order."""
        try:
            for number in range(len(self._asked)):
                self._send()
                while number in self._sent:
                    self._take()
                found = self._done.pop(number) if number in self._done else self._read(number)
                if found is not None:
                    yield found
        except Exception as error:
            if not lost(error):
                raise
            self._stop()
            left = "" if self._place is None else f": {state(self._task, self._asked, self._place)}"
            said = f" ({why(error)})" if str(error) else ""
            raise SweepError(f"a worker was lost: killed, out of memory, or shut down{said}{left}") from error
        finally:
            self._stop()

    def _send(self) -> None:
        """Keep the workers busy; what is recorded, or under way for the same target, is not made again."""
        most = self._ahead or self._crew.ahead
        while self._next < len(self._asked) and len(self._sent) + len(self._done) < most:
            number, target = self._next, self._asked[self._next]
            if self._place is None or not (
                self._keys[number] in {self._keys[n] for n in self._sent}
                or _recorded(self._task, self._place, self._keys[number])
            ):
                # What takes long to solve is solved there too; the rest here, many together.
                mix = None if self._task.solves_long(target) else self._mixes.at(number)[1]
                self._sent[number] = self._submit(target, mix)
            self._next += 1

    def _submit(self, target: Target, mix: Mix | None) -> Future[_Answer]:
        try:
            if self._setup is None:
                future: object = self._executor.submit(_judge, self._task, target, mix)
            else:
                # A name of its own: who keeps what equal calls have given, as Dask does, is to make it anew.
                call = uuid.uuid4().hex
                future = self._executor.submit(_judge_there, self._setup, dict(target), mix, call)
        except Exception as error:  # whatever a stranger's executor raises
            if lost(error) or isinstance(error, LampoptError):
                raise
            if self._taken:
                raise BrokenExecutor(f"it takes no more work: {why(error)}") from error
            raise StudyError(f"executor: expected one that takes work, got one that does not: {why(error)}") from error
        if not isinstance(future, Future):
            raise StudyError(
                f"executor: expected one whose submit returns a concurrent.futures.Future, got {brief(repr(future))}"
            )
        self._taken = True
        return future

    def _take(self) -> None:
        """Wait for a design, and record all that are there, those beside one that failed too."""
        futures = [*self._sent.values()]
        while not any(future.done() for future in futures):  # one that is cancelled in its queue wakes nobody
            wait(futures, PATIENCE, FIRST_COMPLETED)
            self._crew.expect()
        self._keep_finished()
        for number, future in self._sent.items():
            if future.done():
                try:
                    future.result()  # raises: the others are recorded
                except Exception as error:
                    if may_pass(error):
                        del self._sent[number]
                        _leave_out(self._left_out, number, error)
                        return
                    if clusters(error):  # it gives up this one design; a pool of processes any that it had
                        raise BrokenExecutor(f"design {dict(self._asked[number])}: {given_up(error)}") from error
                    raise

    def _keep_finished(self) -> None:
        for number, future in list(self._sent.items()):
            if future.done() and not future.cancelled() and future.exception() is None:
                del self._sent[number]
                answer: object = future.result()
                if not isinstance(answer, _Answer):
                    raise StudyError(f"executor: expected what its work returned, got {brief(repr(answer))}")
                result = _result(self._task, self._asked[number], answer)
                key = self._keys[number] if self._place is not None else ""
                self._done[number] = kept = _keep(self._task, self._place, key, result, answer.seconds)
                if kept.folder is None:
                    self._loose[key] = kept

    def _stop(self) -> None:
        """Ask for no more, and keep what has been finished meanwhile."""
        try:
            for future in self._sent.values():
                future.cancel()
            self._keep_finished()
        except Exception as error:  # noqa: BLE001  # what stopped it counts, the same perhaps
            log.info("a finished design is not kept: %s", why(error))
        self._sent.clear()

    def _read(self, number: int) -> Result | None:
        """What is recorded, or was made for the same target; None where that was left out."""
        if self._place is None:
            return None
        key = self._keys[number]
        return _recorded(self._task, self._place, key) or self._loose.get(key)


def _result(task: Task, target: Target, answer: _Answer) -> Result:
    design = task.designer(target, answer.mix)
    if answer.made:
        design = replace(design, make_mesh=lambda: answer.mesh)
        _ = design.mesh  # it counts as made
    found = task.result(design, answer.checks)
    return replace(found, provenance={**found.provenance, **answer.provenance})


def _judge(task: Task, target: Target, mix: Mix | None) -> _Answer:
    began = time.perf_counter()
    posed = task.posed(target)
    result = task.made(target, posed, solve(posed, task.solver) if mix is None else mix)
    known = result.design.__dict__
    return _Answer(
        result.design.mix,
        result.checks,
        result.provenance,
        "mesh" in known,
        known.get("mesh"),
        time.perf_counter() - began,
    )


def _judge_there(setup: bytes, target: Target, mix: Mix | None, call: str) -> _Answer:
    with interruptible():
        with OPENING:  # threads of one process would open it once each
            task = _unpacked(setup)
        return _judge(task, target, mix)


def _packed(task: Task, file: Path | None) -> bytes:
    """All that another process needs to open the same task, and to know that it is the same."""
    if file is None:
        raise StudyError(
            "executor: other processes read the bank from its file, and this one is in none: name a folder for the "
            "sweep, or store the bank with store_bank"
        )
    owners, manager = task.plugins.owners, task.plugins.manager
    extra = [(name, manager.get_plugin(name)) for name, (owner, _) in owners.items() if owner == "not installed"]
    study = replace(task.study, bank=str(file.resolve())).to_toml()
    given = {name: choice for name, choice in task.study.to_be_measured().items() if not isinstance(choice, Spec)}
    models = {name: choice for name, choice in task.study.models.items() if not isinstance(choice, str | Path)}
    if main := [name for name, choice in (*given.items(), *models.items()) if type(choice).__module__ == "__main__"]:
        raise StudyError(
            f"executor: the measures or models {', '.join(main)} cannot be sent to other processes, which have "
            "another main program: define them in a module, or use a ThreadPoolExecutor"
        )
    try:
        objects = pickle.dumps((given, models))
    except Exception as error:  # whatever a stranger's __reduce__ raises
        raise StudyError(
            f"executor: the measures or models {', '.join([*given, *models])} cannot be sent to other processes "
            f"({why(error)}): define them in a module, or use a ThreadPoolExecutor"
        ) from error
    try:
        return pickle.dumps((study, objects, task.identity, list(owners), extra, task.kept_in))
    except Exception as error:  # whatever a stranger's __reduce__ raises
        raise PluginError(
            f"executor: the plugins {', '.join(name for name, _ in extra)} are not installed and cannot be sent to "
            f"other processes ({why(error)}): install them, or use a ThreadPoolExecutor"
        ) from error


@lru_cache(maxsize=1)  # opening the bank reads all of it: once a worker, not once a design
def _unpacked(setup: bytes) -> Task:
    try:
        text, objects, identity, names, extra, kept_in = pickle.loads(setup)  # by the process that this one works for
        measures, models = pickle.loads(objects)
    except Exception as error:  # whatever a stranger's module raises
        raise PluginError(
            f"a worker, on {platform.node()}, cannot import a plugin or measure that was sent to it ({why(error)}): "
            "define it in a module that is installed there too"
        ) from error
    installed = {point.name for point in entry_points(group="lampopt")}
    study = Study.from_toml(text)
    study = replace(study, measures={**study.to_be_measured(), **measures}, models={**study.models, **models})
    try:
        task = Task.of(study, Plugins.load(extra, block=installed - set(names)))
    except BankError as error:
        raise BankError(
            f"a worker, on {platform.node()}, cannot read the bank: {error}; workers read its file: put it where all "
            "of them see it by the same path"
        ) from error
    if task.identity != identity:
        raise PluginError(
            "a worker would make other designs: its bank, plugins or versions differ from those of the process that "
            "asked; install the same in both"
        )
    return task if kept_in is None else task.keeping(kept_in)
