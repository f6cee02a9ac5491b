"""Exemplars added to a bank, or taken from it, without fitting the others again."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from lampopt import lamp
from lampopt.bank import FILL, decoder_of, hashed, uncalibrated
from lampopt.compress import expect_own_weights
from lampopt.errors import BankError, InputError
from lampopt.fitting import Fitting, InBox, probe_values, ranged
from lampopt.intake import ALL, Intake, intake, newcomers
from lampopt.measured import measure_each, resolve_address
from lampopt.partial import Partial
from lampopt.plugins import Plugins
from lampopt.protocols import Decoder, Progress
from lampopt.reading import path_of
from lampopt.types import Array, Bank, Exemplars, Parameter, Scalar

JOINED = "joined."  # before an exemplar's name in the provenance, of one that was a design
log = logging.getLogger("lampopt")


def add_exemplars(
    bank: Bank,
    exemplars: Exemplars,
    *,
    store: str | Path | None = None,
    accept: Iterable[str] = (),
    provenance: Mapping[str, Scalar] | None = None,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Bank:
    """A bank with more exemplars: those that are there keep their weights, bit for bit.

    The new ones are fitted from the bank's own start, in its frame, with its seed, each as in a batch of its own: what
    comes of one does not depend on which others are added. Ranges of parameters grow with them. Limits that were
    calibrated, and the evidence for them, are dropped: they were of other exemplars.

    Parameters
    ----------
    bank
        The bank; it is not altered, nor is its file.
    exemplars
        New ones, of the same parameters in the same units, with labels that the bank knows, or without.
    store
        The `.lamp` file to write. An interrupted addition of the same exemplars is resumed; a finished one is loaded.
    accept
        Names of exemplars that intake doubts and that are meant to be as they are, or "all". It doubts also what the
        bank's own do not lead to expect: of measured values, size, bodies and genus.
    provenance
        Facts to keep in the bank's provenance beside its own: plain values by names with a dot, "flow.solver".
    progress
        Told how far it is.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    InputError
        If they do not belong into this bank: another name, parameter or unit; or naming every exemplar that intake
        refuses or doubts, that is too large for the bank's frame, or unlike its own.
    FitError
        Naming the exemplar that cannot be fitted, and why.
    BankError
        If `store` holds another bank, or another process is building it.
    """
    expect_own_weights(bank, "bank")
    if not isinstance(exemplars, Exemplars):
        raise InputError(f"exemplars: expected lampopt.types.Exemplars, got {exemplars!r:.80}")
    exemplars = _in_order_of(bank, exemplars)
    told = _told(provenance)
    plugins = plugins or Plugins.load().report()
    decoder = decoder_of(bank, plugins)
    report, measured = _looked_at(bank, decoder, exemplars, accept, progress, plugins)
    exemplars, facts = report.exemplars, report.facts
    inputs = {
        "meshes": facts.hashes,
        "names": exemplars.names,
        "parameters": lamp.digest(exemplars.parameters),
        "labels": lamp.digest(exemplars.labels),
        "decoder": f"{bank.decoder!r} of {plugins.get('decoder', bank.decoder.name).exactly}",
    }
    plan = _plan(bank, added=inputs | ({"provenance": told} if told else {}))
    path = path_of(store, "store") if store is not None else None
    if path is not None and path.exists():
        return _finished(path, plan)
    with nullcontext() if path is None else Partial.open(path, plan) as partial:
        if path is not None and path.exists():  # another process has come to its end meanwhile
            return _finished(path, plan)
        called = bank.decoder.name
        fitting = Fitting(decoder, called, _seed(bank), partial, *([progress] if progress else []))
        weights, error = fitting.fit(bank.shared, InBox(exemplars.meshes, exemplars.names, bank.frame), 1)
        values = probe_values(decoder, called, bank.shared, weights, bank.probes)
        if weights.shape[1] != bank.weights.shape[1] or values.shape[2] != bank.probe_values.shape[2]:
            raise BankError(
                f"decoder {bank.decoder}: gives {weights.shape[1]} weights and {values.shape[2]} values now, the bank "
                f"has {bank.weights.shape[1]} and {bank.probe_values.shape[2]}: use the versions that built it"
            )
        parameters = np.concatenate([bank.parameters, exemplars.parameters])
        labels = np.concatenate([bank.labels, exemplars.labels])
        grown = replace(
            _told_uncalibrated(bank),
            space=ranged(bank.space, parameters),
            parameters=parameters,
            label_space=ranged(bank.label_space, labels),
            labels=labels,
            names=(*bank.names, *exemplars.names),
            weights=np.concatenate([bank.weights, weights]),
            probe_values=np.concatenate([bank.probe_values, values]),
            fit_error=np.concatenate([bank.fit_error, error]),
            measured=np.concatenate([bank.measured, measured]),
            mesh_facts=facts.common if dict(facts.common) == dict(bank.mesh_facts) else {},
            provenance={**_provenance(bank, plan, "added", exemplars.names, hashed(facts.hashes)), **told},
            path=None,
        )
        if path is None or partial is None:
            return grown
        grown = lamp.store_bank(grown, path)
        partial.remove()
        return grown


def remove_exemplars(bank: Bank, names: Sequence[str], *, store: str | Path | None = None) -> Bank:
    """A bank without the exemplars called `names`: the others keep their weights, bit for bit.

    Nothing is fitted; the start stays as it is, also where it was made from one that leaves. Ranges of parameters
    shrink to those that stay. Limits that were calibrated, and the evidence for them, are dropped.

    Parameters
    ----------
    bank
        The bank; it is not altered, nor is its file.
    names
        Who leaves.
    store
        The `.lamp` file to write.

    Raises
    ------
    InputError
        If the bank has no such exemplar, or none would stay.
    BankError
        If `store` holds another bank, or cannot be written.
    """
    expect_own_weights(bank, "bank")
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise InputError(f"names: expected a list of exemplars, such as ['{bank.names[0]}'], got {names!r:.80}")
    if unknown := [name for name in names if name not in bank.names]:
        raise InputError(f"{_listed(unknown)}: no exemplars of this bank; there are {', '.join(bank.names)}")
    stay = [i for i, name in enumerate(bank.names) if name not in set(names)]
    if not stay:
        raise InputError(f"names: expected at least one of the {len(bank)} exemplars to stay, got all of them")
    plan = _plan(bank, removed=sorted(set(names)))
    path = path_of(store, "store") if store is not None else None
    if path is not None and path.exists():
        return _finished(path, plan)
    gone = [name for name in bank.names if name in set(names)]
    left = replace(
        _told_uncalibrated(bank),
        space=ranged(bank.space, bank.parameters[stay]),
        label_space=ranged(bank.label_space, bank.labels[stay]),
        names=tuple(bank.names[i] for i in stay),
        **{
            name: getattr(bank, name)[stay]
            for name in ("parameters", "labels", "weights", "probe_values", "fit_error", "measured")
        },
        provenance=_provenance(bank, plan, "removed", gone),
        path=None,
    )
    return left if path is None else lamp.store_bank(left, path)


def _told(provenance: Mapping[str, Scalar] | None) -> dict[str, Scalar]:
    """Facts that a caller wants kept; names without a dot are the bank's own."""
    told: object = {} if provenance is None else provenance
    if not isinstance(told, Mapping) or not all(
        isinstance(name, str) and "." in name and isinstance(value, str | int | float) for name, value in told.items()
    ):
        raise InputError(
            f"provenance: expected texts, numbers and truth values by names with a dot, such as 'flow.solver', got "
            f"{told!r:.200}"
        )
    return dict(told)


def _in_order_of(bank: Bank, exemplars: Exemplars) -> Exemplars:
    """`exemplars` with parameters and labels in the bank's order; labels that they lack are not known."""
    if twice := [name for name in exemplars.names if name in bank.names]:
        raise InputError(f"{_listed(twice)}: already in the bank; rename them, or remove those that are there first")
    if exemplars.unit != bank.frame.unit:
        raise InputError(f"unit: expected meshes in {bank.frame.unit!r}, as the bank's, got {exemplars.unit!r}")
    if sorted(map(str, exemplars.space)) != sorted(map(str, bank.space)):
        raise InputError(f"parameters: expected {_listed(bank.space)}, as the bank's, got {_listed(exemplars.space)}")
    known = [str(q) for q in bank.label_space]
    if strange := [q for q in exemplars.label_space if str(q) not in known]:
        raise InputError(f"labels: expected some of {_listed(known) or 'none'}, as the bank's, got {_listed(strange)}")
    names = [q.name for q in exemplars.space]
    labels = np.full((len(exemplars), len(known)), np.nan)
    for q, column in zip(exemplars.label_space, exemplars.labels.T, strict=True):
        labels[:, known.index(str(q))] = column
    return replace(
        exemplars,
        space=bank.space,
        parameters=exemplars.parameters[:, [names.index(q.name) for q in bank.space]],
        label_space=bank.label_space,
        labels=labels,
        mesh_at=None,  # takes parameters in its own order; the bank has its mean already
    )


def _looked_at(
    bank: Bank,
    decoder: Decoder,
    exemplars: Exemplars,
    accept: Iterable[str],
    progress: Progress | None,
    plugins: Plugins,
) -> tuple[Intake, Array]:
    """The intake of newcomers, by themselves and against the bank, and their measured values (n, p).

    All that stands in the way is told in one message.
    """
    tell = progress and (lambda _, message="": progress(0.0, message))
    report = intake(exemplars, accept=accept, progress=tell)
    by_bank = [f for f in report.findings if f.kind != "size"]  # sizes are held against the bank's, not each other's
    report = replace(report, findings=tuple(by_bank))
    told = [*newcomers.fitting(bank, decoder.bounds, report.health), *newcomers.shaped(bank, report.health)]
    usable = report.exemplars
    try:
        measured = measure_each(usable, bank.measured_by, plugins)
    except InputError:
        replace(report, findings=(*report.findings, *told)).refuse()  # which may be why
        raise
    odd = list(newcomers.measured(bank, usable.names, usable.parameters, measured))
    lengths = any(_is_length(address, plugins) for address in bank.measured_by.values())
    known = set(usable.names) - {finding.exemplar for finding in odd} if lengths else set()
    told += [*newcomers.sized(bank, FILL / bank.frame.scale, report.health, known), *odd]
    told = sorted([*report.findings, *told], key=lambda f: [*exemplars.names, ""].index(f.exemplar))
    report = replace(report, findings=tuple(told))
    report.refuse()
    rows = [i for i, name in enumerate(usable.names) if accept != ALL and name not in report.accepted]
    if rows and (wrong := list(newcomers.unfollowed(bank, usable.parameters[rows], measured[rows]))):
        raise InputError(
            f"measured: with these exemplars {'; '.join(wrong)}: their table or their meshes are wrong, or accept them"
        )
    return report, measured


def _is_length(address: str, plugins: Plugins) -> bool:
    _, measure, place = resolve_address(address, plugins)
    return measure.units[place].startswith("L")


def _seed(bank: Bank) -> int:
    """The seed that the bank was built with."""
    seed = bank.provenance.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise BankError(f"bank: expected a whole number as seed in its provenance, got {seed!r}: build it anew")
    return seed


def _told_uncalibrated(bank: Bank) -> Bank:
    if bank.calibration is not None:
        log.warning("the bank's limits were calibrated for other exemplars: they are dropped; calibrate it again")
    return uncalibrated(bank)


def _plan(bank: Bank, **change: object) -> str:
    """A hash of all that the changed bank depends on."""
    before = {
        "plan": bank.provenance.get("plan"),
        "weights": lamp.digest(bank.weights),
        "labels": [*(str(q) for q in bank.label_space), lamp.digest(bank.labels)],
        "names": bank.names,
        "measured_by": dict(bank.measured_by),
        "limits": dict(bank.limits),
    }
    return hashed(before | change)


def _provenance(bank: Bank, plan: str, what: str, names: Sequence[str], meshes: str = "") -> Mapping[str, Scalar]:
    """The bank's own, with the change: who was added or removed, after those of earlier changes."""
    from importlib.metadata import version

    known = dict(uncalibrated(bank).provenance)
    if what == "removed":
        known = {name: value for name, value in known.items() if name not in {JOINED + gone for gone in names}}
    before = [str(known[what])] if what in known else []
    known |= {"plan": plan, "lampopt": version("lampopt"), what: ", ".join([*before, *names])}
    if meshes:
        known["meshes"] = hashed([known.get("meshes"), meshes])
    return known


def _finished(path: Path, plan: str) -> Bank:
    """The bank at `path`, if it is the one asked for."""
    bank = lamp.load_bank(path)
    if bank.provenance.get("plan") != plan:
        raise BankError(f"{path}: holds another bank: name another file, or delete it if it is stale")
    Partial.beside(path, plan).remove()  # left where this was killed in its very last moment
    return bank


def _listed(names: Iterable[str | Parameter]) -> str:
    return ", ".join(map(str, names))
