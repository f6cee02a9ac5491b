"""Exemplars labelled by a measure: every shape as the bank makes it, whatever a flow solution of each may cost.

A design is compared with the bank's own shapes, so these are measured, not the meshes that they were fitted to. What is
measured stays beside the file that is written, exemplar by exemplar: labelling that is stopped goes on.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt import lamp
from lampopt.bank import decoder_of
from lampopt.crew import Crew, lost
from lampopt.decode import decode
from lampopt.errors import BankError, EmptyMesh, InputError, MeasureError, SweepError, may_pass
from lampopt.fitting import ranged
from lampopt.identity import asked_program, hashed, told
from lampopt.identity import whole as all_of
from lampopt.measured import keeping, values_of
from lampopt.partial import Partial
from lampopt.plugins import Plugins
from lampopt.pool import interruptible
from lampopt.progress import silent
from lampopt.protocols import External, Measure, Progress
from lampopt.reading import brief, path_of, why
from lampopt.types import Array, Bank, Parameter, Spec, expect_bank
from lampopt.units import filled, said, whole

if TYPE_CHECKING:
    from trimesh import Trimesh

MEASURED = ".measured"  # behind the file's name: where a measure keeps what it has worked out
LABELLED = "labelled."  # before a label's name in the provenance
PATIENCE = 1.0  # s between two looks at who works
log = logging.getLogger("lampopt")


def label(
    bank: Bank,
    measure: str | Spec | Measure,
    values: Sequence[str] | Mapping[str, str] = (),
    *,
    store: str | Path | None = None,
    resolution: int = 128,
    executor: Executor | None = None,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Bank:
    """A bank with labels that a measure tells of its exemplars; all else stays as it is.

    Parameters
    ----------
    bank
        The bank; it is not altered, nor is its file.
    measure
        An installed one by name or as a Spec, or an object.
    values
        Which of its values become labels: names, or ``{"cd": "drag"}`` where a label is to be called otherwise;
        by default all of them. A label of that name that is there is replaced.
    store
        The `.lamp` file to write. Labelling that was stopped goes on where it was; one that is finished is loaded.
    resolution
        Of the meshes, as a study has it.
    executor
        Who measures, as in `concurrent.futures`; by default this process, one after the other.
    progress
        Told how far it is.
    plugins
        What to choose from, if not all that is installed.

    Returns
    -------
    Bank
        The labels of exemplars that could not be measured are not known (NaN); why is logged, and stands in the
        provenance by ``labelled.NAME``, JSON, with who measured, by which options and version.

    Raises
    ------
    InputError
        For a value that the measure does not have, if no exemplar can be measured, or some could not for a reason that
        may pass: with `store` the same call goes on with these.
    SweepError
        If workers are lost; with `store` the same call goes on.
    BankError
        If `store` holds another bank, or another process is labelling it.
    MeasureError
        If the program that an `External` measure needs is not there.
    """
    expect_bank(bank, "bank")
    plugins = plugins or Plugins.load().report()
    choice = Spec.of(measure) if isinstance(measure, str | Spec) else measure
    called = choice.name if isinstance(choice, Spec) else type(choice).__name__
    made: object = plugins.make("measure", choice) if isinstance(choice, Spec) else choice
    if not isinstance(made, Measure):
        raise InputError(f"measure: expected an installed one's name, a Spec or a measure, got {said(measure):.80}")
    resolution = whole(resolution, "resolution", 4, 4096)
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise InputError(f"executor: expected one as in concurrent.futures, with submit, got {executor!r:.80}")
    names = _names(called, made, values)
    if taken := [name for name in names if name in {q.name for q in bank.space}]:
        raise InputError(f"values: {taken[0]!r} is a parameter of this bank: call the label otherwise")
    who = asked_program(choice, made, plugins) if isinstance(made, External) else told(choice, made, plugins)
    plan = hashed({"bank": all_of(bank), "label": names, "by": who, "resolution": resolution})
    path = None if store is None else path_of(store, "store")
    if path is not None and path.exists():
        return _finished(path, plan, names, made)
    program = made.program() if isinstance(made, External) else ""
    with nullcontext() if path is None else Partial.open(path, plan) as parts:
        if path is not None and path.exists():  # another process has finished it meanwhile
            return _finished(path, plan, names, made)
        if path is not None:
            made = keeping(made, path.absolute().with_name(path.name + MEASURED))
        work = _Work(bank, called, made, [*names.values()], resolution, parts, plugins, program)
        found, failed = work.done(executor, progress or silent)
        given = choice.options if isinstance(choice, Spec) else {}
        options = dict(made.depends_on() if isinstance(made, External) else given)
        by = {name: what for name, what in (("options", options), ("program", program), ("failed", failed)) if what}
        labelled = _with_labels(bank, called, made, names, found, by, plan)
        if path is None:
            return labelled
        stored = lamp.store_bank(labelled, path)
    Partial.beside(path, plan).remove()
    return stored


def _names(called: str, measure: Measure, values: object) -> dict[str, str]:
    """The measure's value behind each label."""
    if isinstance(values, Mapping):
        names = dict(values) or {value: value for value in measure.names}
    elif isinstance(values, Sequence) and not isinstance(values, str):
        names = {value: value for value in values or measure.names}
    else:
        raise InputError(f"values: expected names such as ['drag'], or {{'cd': 'drag'}}, got {said(values):.80}")
    if unknown := [value for value in names.values() if value not in measure.names]:
        raise InputError(f"values: measure {called!r} has no {said(unknown[0])}; it has {', '.join(measure.names)}")
    for name in names:
        Parameter(name)  # refuses what is no name
    return names


class _Work:
    """The exemplars that are still to be measured."""

    def __init__(
        self,
        bank: Bank,
        called: str,
        measure: Measure,
        wanted: Sequence[str],
        resolution: int,
        parts: Partial | None,
        plugins: Plugins,
        program: str,
    ) -> None:
        self._bank, self._called, self._measure = bank, called, measure
        self._made_by = f"-{hashed(program)}" if program else ""  # what one version has measured is no other's
        self._resolution, self._parts = resolution, parts
        self._wanted = [tuple(measure.names).index(value) for value in wanted]
        self._decoder = decoder_of(bank, plugins)

    def done(self, executor: Executor | None, tell: Progress) -> tuple[Array, dict[str, str]]:
        """Values (N, p), and why those that are NaN could not be measured, by exemplar.

        Raises
        ------
        InputError
            If none can be measured, or some could not for a reason that may pass; what was measured is kept.
        SweepError
            If workers are lost.
        """
        count = len(self._bank)
        values, failed = np.full((count, len(self._measure.names)), np.nan), dict[str, str]()
        left = list[int]()
        for number in range(count):
            if (kept := self._kept(number)) is None:
                left.append(number)
            else:
                values[number] = kept
        finished = count - len(left)
        tell(finished / count, f"{finished} of {count} exemplars are there already")
        passing = dict[str, str]()
        for number, answer in self._answers(left, executor):
            finished, name = finished + 1, self._bank.names[number]
            if isinstance(answer, _Missing):
                failed[name] = answer.why
                log.warning("exemplar %r has no label: %s", name, answer.why)
                if answer.passing:
                    passing[name] = answer.why
            else:
                values[number] = answer
                self._keep(number, answer)
            tell(finished / count, f"exemplar {name}")
        if passing:
            name, reason = next(iter(passing.items()))
            raise InputError(
                f"{len(passing)} of {count} exemplars could not be measured for a reason that may pass ({name}: "
                f"{brief(reason)}); where a file is written the others are kept: the same call goes on with the rest"
            )
        if len(failed) == count:
            raise InputError(f"measure {self._called!r} can tell of no exemplar: {brief(next(iter(failed.values())))}")
        return values, failed

    def _kept(self, number: int) -> Array | None:
        found = None if self._parts is None else self._parts.read(self._part(number))
        return None if found is None else found["values"]

    def _keep(self, number: int, answer: Array) -> None:
        if self._parts is not None:
            self._parts.write(self._part(number), {"values": answer})

    def _part(self, number: int) -> str:
        return f"values_{number:05d}{self._made_by}"

    def _answers(self, numbers: Sequence[int], executor: Executor | None) -> Iterator[tuple[int, Array | _Missing]]:
        ask = partial(_measured, self._called, self._measure, self._wanted)
        if executor is None:
            for number in numbers:
                yield number, ask(self._mesh(number))
            return
        sent, waiting, crew = dict[Future[Array | _Missing], int](), list(numbers), Crew(executor)
        try:
            while waiting or sent:
                while waiting and len(sent) < crew.ahead:
                    number = waiting.pop(0)
                    sent[executor.submit(ask, self._mesh(number))] = number
                finished = wait(sent, PATIENCE, FIRST_COMPLETED).done
                crew.expect()
                for future in finished:
                    answer = future.result()
                    yield sent.pop(future), answer
        except Exception as error:
            if not lost(error):
                raise
            raise SweepError(f"a worker was lost: killed, out of memory, or shut down ({why(error)})") from error
        finally:  # what others have finished is kept, whatever one of them came to
            for future, number in sent.items():
                done = not future.cancel() and future.done() and future.exception() is None
                if done and not isinstance(answer := future.result(), _Missing):
                    self._keep(number, answer)

    def _mesh(self, number: int) -> Trimesh | None:
        weights = np.asarray(self._bank.weights[number])
        try:
            return decode(self._bank, self._decoder, weights, resolution=self._resolution)
        except EmptyMesh:
            return None


@dataclass(frozen=True)
class _Missing:
    """Why an exemplar has no value, and whether trying again may help."""

    why: str
    passing: bool = False


def _measured(called: str, measure: Measure, wanted: Sequence[int], mesh: Trimesh | None) -> Array | _Missing:
    """Values (p,), those in the places `wanted` finite, or why there are none."""
    if mesh is None:
        return _Missing("it has no surface")
    try:
        with interruptible():
            values = values_of(called, measure, mesh)
    except (MeasureError, EmptyMesh) as error:
        return _Missing(str(error), may_pass(error))
    if (strange := values[wanted][~np.isfinite(values[wanted])]).size:
        return _Missing(f"{called} says {strange[0]}")
    return values


def _with_labels(
    bank: Bank,
    called: str,
    measure: Measure,
    names: Mapping[str, str],
    values: Array,
    by: Mapping[str, object],
    plan: str,
) -> Bank:
    """`bank` with columns of `values` (N, p) among its labels, and how they came about in `by`."""
    places = [tuple(measure.names).index(value) for value in names.values()]
    space = [
        Parameter(name, filled(measure.units[place], bank.frame.unit))
        for name, place in zip(names, places, strict=True)
    ]
    others = [k for k, q in enumerate(bank.label_space) if q.name not in names]
    labels = np.concatenate([bank.labels[:, others], values[:, places]], axis=1)
    known = {f"{LABELLED}{name}": json.dumps({"by": f"{called}.{value}", **by}) for name, value in names.items()}
    return replace(
        bank,
        labels=labels,
        label_space=ranged([*(bank.label_space[k] for k in others), *space], labels),
        provenance={**bank.provenance, **known, "labels": plan},
        path=None,
    )


def _finished(path: Path, plan: str, names: Iterable[str], measure: Measure) -> Bank:
    """The bank in `path`; it is said where its labels are another program's than the one that is there now."""
    bank = lamp.load_bank(path)
    if bank.provenance.get("labels") != plan:
        raise BankError(f"{path}: holds another bank, or other labels: name another file, or delete it if it is stale")
    if isinstance(measure, External):
        then = {json.loads(str(bank.provenance[f"{LABELLED}{name}"])).get("program", "?") for name in names}
        with suppress(MeasureError):  # which is needed for what is not labelled yet only
            if then != {now := measure.program()}:
                log.warning("%s: was labelled by %s, here is %s", path, " and ".join(sorted(then)), now)
    Partial.beside(path, plan).remove()  # left where this was killed in its very last moment
    return bank
