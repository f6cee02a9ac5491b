"""Exemplars labelled by a measure: every shape as the bank makes it, whatever a flow solution of each may cost.

A design is compared with the bank's own shapes, so these are measured, not the meshes that they were fitted to. What is
measured stays beside the file that is written, exemplar by exemplar: labelling that is stopped goes on.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt import lamp
from lampopt.bank import decoder_of
from lampopt.crew import Crew
from lampopt.decode import decode
from lampopt.errors import BankError, EmptyMesh, InputError, MeasureError
from lampopt.fitting import ranged
from lampopt.identity import hashed, told, whole
from lampopt.measured import values_of
from lampopt.partial import Partial
from lampopt.plugins import Plugins
from lampopt.protocols import Keeping, Measure, Progress
from lampopt.reading import brief, path_of
from lampopt.types import Array, Bank, Parameter, Spec
from lampopt.units import filled, said

if TYPE_CHECKING:
    from trimesh import Trimesh

MEASURED = ".measured"  # behind the file's name: where a measure keeps what it has worked out
LABELLED = "labelled."  # before a label's name in the provenance
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
        provenance by ``labelled.NAME``, JSON, with who measured.

    Raises
    ------
    InputError
        For a value that the measure does not have, or if no exemplar can be measured.
    BankError
        If `store` holds another bank, or another process is labelling it.
    """
    if not isinstance(bank, Bank):
        raise InputError(f"bank: expected a Bank, got {bank!r:.80}; read one with load_bank(path)")
    plugins = plugins or Plugins.load().report()
    choice = Spec.of(measure) if isinstance(measure, str | Spec) else measure
    called = choice.name if isinstance(choice, Spec) else type(choice).__name__
    made: Measure = plugins.make("measure", choice) if isinstance(choice, Spec) else choice
    names = _names(called, made, values)
    if taken := [name for name in names if name in {q.name for q in bank.space}]:
        raise InputError(f"values: {taken[0]!r} is a parameter of this bank: call the label otherwise")
    who = told(choice, made, plugins)
    plan = hashed({"bank": whole(bank), "label": names, "by": who, "resolution": resolution})
    path = None if store is None else path_of(store, "store")
    if path is not None and path.exists():
        return _finished(path, plan)
    with nullcontext() if path is None else Partial.open(path, plan) as partial:
        if path is not None and isinstance(made, Keeping):
            made = made.kept_in(path.with_name(path.name + MEASURED))
        work = _Work(bank, called, made, resolution, partial, plugins)
        found, failed = work.done(executor, progress or (lambda done, message="", /: None))
        labelled = _with_labels(bank, called, made, names, found, failed, plan)
        if path is None:
            return labelled
        stored = lamp.store_bank(labelled, path)
    Partial.beside(path, plan).remove()
    return stored


def _names(called: str, measure: Measure, values: object) -> dict[str, str]:
    """The measure's value behind each label."""
    if isinstance(values, Mapping):
        names = dict(values)
    elif isinstance(values, Sequence) and not isinstance(values, str):
        names = {value: value for value in values or measure.names}
    else:
        raise InputError(f"values: expected names such as ['drag'], or {{'cd': 'drag'}}, got {said(values):.80}")
    if unknown := [value for value in names.values() if value not in measure.names]:
        raise InputError(f"values: measure {called!r} has no {said(unknown[0])}; it has {', '.join(measure.names)}")
    if strange := [name for name in names if not isinstance(name, str) or not name]:
        raise InputError(f"values: expected labels' names, got {said(strange[0])}")
    return names


class _Work:
    """The exemplars that are still to be measured."""

    def __init__(
        self, bank: Bank, called: str, measure: Measure, resolution: int, partial: Partial | None, plugins: Plugins
    ) -> None:
        self._bank, self._called, self._measure = bank, called, measure
        self._resolution, self._partial = resolution, partial
        self._decoder = decoder_of(bank, plugins)

    def done(self, executor: Executor | None, tell: Progress) -> tuple[Array, dict[str, str]]:
        """Values (N, p), and why those that are NaN could not be measured, by exemplar."""
        count = len(self._bank)
        values, failed = np.full((count, len(self._measure.names)), np.nan), dict[str, str]()
        kept = [number for number in range(count) if self._kept(number) is not None]
        left = [number for number in range(count) if number not in kept]
        finished = len(kept)
        for number in kept:
            values[number] = self._kept(number)
        tell(finished / count, f"{finished} of {count} exemplars are there already")
        for number, answer in self._answers(left, executor):
            finished, name = finished + 1, self._bank.names[number]
            if isinstance(answer, str):
                failed[name] = answer
                log.warning("exemplar %r has no label: %s", name, answer)
            else:
                values[number] = answer
                self._keep(number, answer)
            tell(finished / count, f"exemplar {name}")
        if len(failed) == count:
            raise InputError(f"measure {self._called!r} can tell of no exemplar: {brief(next(iter(failed.values())))}")
        return values, failed

    def _kept(self, number: int) -> Array | None:
        found = None if self._partial is None else self._partial.read(f"values_{number:05d}")
        return None if found is None else found["values"]

    def _keep(self, number: int, answer: Array) -> None:
        if self._partial is not None:
            self._partial.write(f"values_{number:05d}", {"values": answer})

    def _answers(self, numbers: Sequence[int], executor: Executor | None) -> Iterator[tuple[int, Array | str]]:
        if executor is None:
            for number in numbers:
                yield number, _measured(self._called, self._measure, self._mesh(number))
            return
        sent, waiting, most = dict[Future[Array | str], int](), list(numbers), Crew(executor).ahead
        try:
            while waiting or sent:
                while waiting and len(sent) < most:
                    number = waiting.pop(0)
                    mesh = self._mesh(number)
                    sent[executor.submit(_measured, self._called, self._measure, mesh)] = number
                for future in wait(sent, return_when=FIRST_COMPLETED).done:
                    answer = future.result()
                    yield sent.pop(future), answer
        finally:  # what others have finished is kept, whatever one of them came to
            for future, number in sent.items():
                done = not future.cancel() and future.done() and future.exception() is None
                if done and not isinstance(answer := future.result(), str):
                    self._keep(number, answer)

    def _mesh(self, number: int) -> Trimesh | None:
        weights = np.asarray(self._bank.weights[number])
        try:
            return decode(self._bank, self._decoder, weights, resolution=self._resolution)
        except EmptyMesh:
            return None


def _measured(called: str, measure: Measure, mesh: Trimesh | None) -> Array | str:
    """Values (p,), or why there are none."""
    if mesh is None:
        return "it has no surface"
    try:
        return values_of(called, measure, mesh)
    except (MeasureError, EmptyMesh) as error:
        return str(error)


def _with_labels(
    bank: Bank,
    called: str,
    measure: Measure,
    names: Mapping[str, str],
    values: Array,
    failed: Mapping[str, str],
    plan: str,
) -> Bank:
    """`bank` with columns of `values` (N, p) among its labels."""
    places = [tuple(measure.names).index(value) for value in names.values()]
    space = [
        Parameter(name, filled(measure.units[place], bank.frame.unit))
        for name, place in zip(names, places, strict=True)
    ]
    others = [k for k, q in enumerate(bank.label_space) if q.name not in names]
    labels = np.concatenate([bank.labels[:, others], values[:, places]], axis=1)
    known = {
        f"{LABELLED}{name}": json.dumps({"by": f"{called}.{value}", **({"failed": dict(failed)} if failed else {})})
        for name, value in names.items()
    }
    return replace(
        bank,
        labels=labels,
        label_space=ranged([*(bank.label_space[k] for k in others), *space], labels),
        provenance={**bank.provenance, **known, "labels": plan},
        path=None,
    )


def _finished(path: Path, plan: str) -> Bank:
    bank = lamp.load_bank(path)
    if bank.provenance.get("labels") != plan:
        raise BankError(f"{path}: holds another bank: delete it or name another")
    Partial.beside(path, plan).remove()  # left where this was killed in its very last moment
    return bank
