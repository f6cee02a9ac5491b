"""A design that has proved itself joins the bank: its mesh is fitted as an exemplar, where it comes from is kept.

What is known of it goes by the mesh where a measure tells, by its mix where none does.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import isfinite, isnan, nan
from pathlib import Path

import numpy as np

from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.errors import InputError, MeasureError
from lampopt.identity import whole
from lampopt.joining import Meshes, Newcomer, chosen_of, given_by, named
from lampopt.loop import results
from lampopt.measured import following_ratio, measure_each, resolve_address, values_of
from lampopt.members import JOINED, add_exemplars
from lampopt.plugins import Plugins
from lampopt.protocols import Corresponding, Measure, Progress
from lampopt.reading import brief, path_of
from lampopt.study import Study
from lampopt.types import Array, Bank, Exemplars, Parameter, Result, Scalar, expect_bank
from lampopt.units import factor, filled, number, said

Known = float | str | None  # of a label: a number in its unit, text with a unit, or nothing
Labels = Mapping[str, str | Sequence[Known] | Mapping[str, Known]]


def enrich(
    bank: Bank,
    designs: str | Path | Result | Iterable[Result] | Mapping[str, Result],
    *,
    store: str | Path | None = None,
    only: Iterable[str] = (),
    leave_out: Iterable[str] = (),
    labels: Labels | None = None,
    accept: Iterable[str] = (),
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Bank:
    """A bank with accepted designs as more exemplars; those that are there keep their weights, bit for bit.

    Each design's mesh is fitted as `add_exemplars` does it. Its parameters are what its mix predicts, Pᵀalpha, those
    that its bank declares measurable as they are measured on its mesh; a parameter that does not differ over its bank
    stays as it is. The bank's `provenance` has an entry ``joined.NAME`` for each, JSON: `design`, the run and the key
    of the design; `asked`, the values that were asked for; `bank`, the hash of the bank that made it; `labels`, how
    those that were given came.

    Parameters
    ----------
    bank
        The bank; it is not altered, nor is its file.
    designs
        A run folder (the designs of the study that was asked last), or results that `bank` made, perhaps by the names
        that they are to have. Without names they are called by their keys, as their folders are.
    store
        The `.lamp` file to write. An interrupted addition of the same designs is resumed; a finished one is loaded.
    only
        Names of the designs that join; by default all.
    leave_out
        Names of designs that do not join, or "rejected": all that were.
    labels
        Of the new exemplars, by the name of the label: the address of a measured value ("volume.volume"), as the study
        recorded it or else measured now; or a value for each design, in order or by its name, a number in the label's
        unit, text with a unit, or None. Labels that are not named are not known.
    accept
        Names of designs that intake doubts and that are meant to be as they are, or "all".
    progress
        Told how far it is.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    InputError
        Naming every design that was rejected with the checks that it failed, or that was never judged by its mesh; or
        if there is none, it was made by another bank, a label or measured value is unknown, or `add_exemplars` refuses
        it.
    FitError
        Naming the design that cannot be fitted, and why.
    BankError
        If `store` holds another bank, or another process is building it.
    """
    expect_bank(bank, "bank")
    plugins = plugins or Plugins.load().report()
    if isinstance(designs, str | Path):
        folder = path_of(designs, "designs")
        maker = Study.read(folder / "study.toml").opened()
        found: Iterable[Newcomer] = (named(result, maker) for result in results(folder, plugins=plugins))
    else:
        maker, found = bank, given_by(bank, designs)
    chosen = chosen_of(found, only, leave_out)
    given = Exemplars(
        parameters=np.stack([newcomer.result.design.predicted for newcomer in chosen]),
        space=tuple(Parameter(q.name, q.unit) for q in maker.space),
        meshes=_meshes(maker, chosen, plugins),
        names=tuple(newcomer.name for newcomer in chosen),
        unit=maker.frame.unit,
    )
    wanted = _labels(bank, labels)
    values = [_values(q, labels[q.name], given, chosen, plugins) for q in wanted] if labels else []
    given = replace(
        given,
        parameters=_as_measured(maker, given, chosen, plugins),
        label_space=wanted,
        labels=np.array(values, float).reshape(len(wanted), len(given)).T,
    )
    ways = {name: way if isinstance(way, str) else "given" for name, way in (labels or {}).items()}
    told = _records(chosen, whole(maker), ways)
    return add_exemplars(bank, given, store=store, accept=accept, provenance=told, progress=progress, plugins=plugins)


def _meshes(maker: Bank, chosen: Sequence[Newcomer], plugins: Plugins) -> Meshes:
    """As they were recorded; decoded anew where vertices are to correspond, since files number them as they like."""
    decoder = decoder_of(maker, plugins)
    if not isinstance(decoder, Corresponding):
        return Meshes(chosen)
    return Meshes(chosen, lambda newcomer: decode(maker, decoder, newcomer.result.design.weights))


def _as_measured(maker: Bank, given: Exemplars, chosen: Sequence[Newcomer], plugins: Plugins) -> Array:
    """Parameters (n, d) as predicted, those that `maker` measures corrected by what was measured.

    A measured value may differ from its parameter by an offset or a factor. So it is by how far it is from the one
    predicted, Mᵀalpha, over their ratio, that the parameter is corrected.
    """
    values = np.array(given.parameters)
    alpha = np.stack([newcomer.result.design.mix.alpha for newcomer in chosen])
    measured = measure_each(given, maker.measured_by, plugins)
    places = {q.name: i for i, q in enumerate(maker.space)}
    for name, known, now in zip(maker.measured_by, maker.measured.T, measured.T, strict=True):
        place = places[name]
        if ratio := following_ratio(maker.parameters, place, known):
            values[:, place] += (now - alpha @ known) / ratio
    same = np.ptp(maker.parameters, axis=0) == 0  # what rounding makes of these would become a range of its own
    values[:, same] = maker.parameters[0, same]
    return values


def _labels(bank: Bank, labels: object) -> tuple[Parameter, ...]:
    """The labels that are named, as the bank knows them."""
    if not isinstance(labels, Mapping | None):
        raise InputError(f"labels: expected a table such as {{'drag': 'flow.drag'}}, got {said(labels):.80}")
    known = {q.name: Parameter(q.name, q.unit) for q in bank.label_space}
    if unknown := [name for name in labels or {} if name not in known]:
        there = ", ".join(known) or "none"
        raise InputError(f"labels: {said(unknown[0])} is no label of this bank; there are {there}")
    return tuple(known[name] for name in labels or {})


def _values(
    label: Parameter, way: object, given: Exemplars, chosen: Sequence[Newcomer], plugins: Plugins
) -> list[float]:
    """Values of one label (n,) [its unit], NaN where not known: measured at an address, or as they are given."""
    what = f"labels: {label.name}"
    if isinstance(way, str):
        return _at_address(way, label, given, chosen, plugins)
    if isinstance(way, Mapping):
        if strangers := [name for name in way if name not in given.names]:
            there = brief(", ".join(given.names))
            raise InputError(f"{what}: {said(strangers[0]):.80} is no design that joins; there are {there}")
        found = [way.get(name) for name in given.names]
    elif isinstance(way, Iterable):
        found = list(way)
    else:
        raise InputError(f"{what}: expected the address of a measured value, or values, got {said(way):.80}")
    if len(found) != len(chosen):
        raise InputError(f"{what}: expected {len(chosen)} values, one for each design, got {len(found)}")
    return [
        nan
        if value is None or (isinstance(value, float) and isnan(value))
        else number(value, label.unit, f"{what} of design {name!r}")
        for name, value in zip(given.names, found, strict=True)
    ]


def _at_address(
    address: str, label: Parameter, given: Exemplars, chosen: Sequence[Newcomer], plugins: Plugins
) -> list[float]:
    """A measured value of each design [the label's unit]: as its study recorded it, else measured now."""
    what = f"labels: {label.name}: {address!r}"
    values: list[float] = []
    found: tuple[str, Measure, int] | None = None
    for newcomer in chosen:
        recorded = [c for c in newcomer.result.checks if c.name == address and c.sense == "info"]
        if recorded:
            value, unit = recorded[0].value, recorded[0].unit
        else:
            name, measure, place = found = found or resolve_address(address, plugins)
            try:
                value = float(values_of(name, measure, newcomer.mesh())[place])
            except MeasureError as error:
                raise InputError(f"{what} cannot be read off design {newcomer.name!r}: {error}") from error
            unit = filled(measure.units[place], given.unit)
        values.append(value * factor(unit, label.unit, what) if isfinite(value) else nan)
    return values


def _records(chosen: Sequence[Newcomer], maker: str, labels: Mapping[str, str]) -> dict[str, Scalar]:
    """What is kept of each design that joins, JSON by ``joined.NAME``."""
    records: dict[str, Scalar] = {}
    for newcomer in chosen:
        record = {"design": newcomer.key, "asked": dict(newcomer.result.design.target), "bank": maker}
        records[JOINED + newcomer.name] = json.dumps(record | ({"labels": dict(labels)} if labels else {}))
    return records
