"""Exemplars → bank: fit every exemplar with one decoder from one shared start (paper, section 3).

The work is cut into batches that are fixed up front. Each finished batch is written to `<store>.partial/`, so that an
interrupted build goes on where it stopped and ends with the very same bank.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from math import isfinite
from pathlib import Path

import numpy as np

from lampopt import lamp
from lampopt.errors import BankError, InputError
from lampopt.fitting import Fitting, InBox, probe_values, ranged
from lampopt.intake import Facts, Intake, intake
from lampopt.measured import measure_all
from lampopt.partial import Partial
from lampopt.plugins import Plugins, returned
from lampopt.protocols import Decoder, Progress, Shared
from lampopt.reading import path_of, readdressed
from lampopt.types import Array, Bank, Exemplars, Frame, Scalar, Spec
from lampopt.units import whole

FILL = 0.6  # part of the box that the largest exemplar takes: the rest is room to extrapolate
PROBES = 16384  # points where linearity is tested; about 2 % of them fall near the surface
log = logging.getLogger("lampopt")


def build_bank(
    exemplars: Exemplars,
    decoder: str | Spec = "mesh-template",
    *,
    seed: int = 0,
    store: str | Path | None = None,
    measured: Mapping[str, str] | None = None,
    limits: Mapping[str, float] | None = None,
    batch: int = 8,
    probes: int = PROBES,
    accept: Iterable[str] = (),
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Bank:
    """Fit `exemplars` with `decoder` from a shared start.

    Parameters
    ----------
    exemplars
        N meshes with parameters.
    decoder
        Name, or Spec with options.
    seed
        Same seed, same bank, bit for bit at equal thread count on one kind of processor.
    store
        The `.lamp` file to write. An interrupted build of the same inputs is resumed from beside it; a finished one
        is loaded.
    measured
        Which parameters can be measured on a mesh, and how, beyond what the source declares:
        ``{"length": "extents.length"}``.
    limits
        Limits of checks that replace the defaults for designs of this bank: ``{"mismatch": 0.02}``. By default those
        of a finished store are left as they are.
    batch
        Exemplars fitted together.
    probes
        Points where linearity is tested later.
    accept
        Names of exemplars that intake doubts and that are meant to be as they are, or "all".
    progress
        Told how far it is.

    Raises
    ------
    FitError
        Naming the exemplar that cannot be fitted, and why.
    BankError
        If `store` holds a bank, or the beginning of one, made from other inputs, or another process is building it.
    InputError
        Naming every exemplar that intake refuses or doubts (see `lampopt.intake`), or an argument that cannot be used.
    PluginError
        If a plugin is missing, or does not do what it should.
    """
    if not isinstance(exemplars, Exemplars):
        raise InputError(f"exemplars: expected lampopt.types.Exemplars, got {exemplars!r:.80}")
    if measured is not None and not _texts(measured):
        raise InputError(f"measured: expected a mapping such as {{'length': 'extents.length'}}, got {measured!r:.80}")
    seed, batch, probes = whole(seed, "seed", 0), whole(batch, "batch", 1), whole(probes, "probes", 1)
    plugins = plugins or Plugins.load().report()
    made: Decoder = plugins.make("decoder", decoder)
    spec = plugins.complete("decoder", decoder)
    limits = None if limits is None else _limits(limits)
    path = path_of(store, "store") if store is not None else None
    report = looked_at(exemplars, accept, finished=path is not None and path.exists(), progress=progress)
    exemplars, facts = report.exemplars, report.facts
    plan = _plan(exemplars, facts, f"{spec!r} of {plugins.get('decoder', spec.name).exactly}", seed, batch, probes)
    measured_by = {
        name: readdressed(address, lambda file: str(Path(file).absolute()))  # it is read from other folders too
        for name, address in {**exemplars.measured, **(measured or {})}.items()
    }
    if path is not None and path.exists():
        return _finished(path, plan, exemplars, measured_by, limits, plugins)
    values = measure_all(exemplars, measured_by, plugins)
    with nullcontext() if path is None else Partial.open(path, plan) as partial:
        if path is not None and path.exists():  # another process has come to its end meanwhile
            return _finished(path, plan, exemplars, measured_by, limits, plugins)
        frame = _frame(facts.bounds, exemplars.unit)
        meshes = InBox(exemplars.meshes, exemplars.names, frame)
        fitting = Fitting(made, spec.name, seed, partial, *([progress] if progress else []))
        shared = fitting.start(exemplars, meshes)
        weights, error = fitting.fit(shared, meshes, batch)
        points = returned(f"decoder {spec.name!r}: probes", made.probes(shared, probes, seed), (probes, 3))
        bank = Bank(
            space=ranged(exemplars.space, exemplars.parameters),
            parameters=exemplars.parameters,
            label_space=ranged(exemplars.label_space, exemplars.labels),
            labels=exemplars.labels,
            names=exemplars.names,
            weights=weights,
            shared=shared,
            frame=frame,
            decoder=spec,
            probes=points,
            probe_values=probe_values(made, spec.name, shared, weights, points),
            fit_error=error,
            measured_by=measured_by,
            measured=values,
            mesh_facts=facts.common,
            limits=limits or {},
            provenance=_provenance(plan, facts, shared, plugins, spec, seed, batch),
        )
        if path is None or partial is None:
            return bank
        bank = lamp.store_bank(bank, path)
        partial.remove()
        return bank


def looked_at(exemplars: Exemplars, accept: Iterable[str], *, finished: bool, progress: Progress | None) -> Intake:
    """The intake of `exemplars`; what a finished bank was made of needs no second look at its crossings."""
    tell = progress and (lambda _, message="": progress(0.0, message))
    report = intake(exemplars, accept=accept, crossings=not finished, progress=tell)
    report.refuse()
    return report


def _texts(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(t, str) for pair in value.items() for t in pair)


def _limits(limits: Mapping[str, float]) -> dict[str, float]:
    """`limits` as a file can hold them; which names there are is known to the checks, a later stage."""
    for name, limit in limits.items():
        number: object = limit
        good = isinstance(number, (int, float, np.number)) and not isinstance(number, (bool, np.complexfloating))
        if not (good and isfinite(limit) and limit >= 0):
            raise InputError(f"limits: expected names with finite numbers, 0 or more, got {name!r}: {limit!r}")
    return {name: float(limit) for name, limit in limits.items()}


def decoder_of(bank: Bank, plugins: Plugins) -> Decoder:
    """The decoder that `bank` was fitted by, rebuilt from its Spec."""
    made: Decoder = plugins.make("decoder", bank.decoder)
    return made


def uncalibrated(bank: Bank) -> Bank:
    """`bank` without the limits that were found for its exemplars, and without the evidence for them."""
    if bank.calibration is None:
        return bank
    limits = {name: limit for name, limit in bank.limits.items() if name not in bank.calibration.checks}
    provenance = {name: value for name, value in bank.provenance.items() if name != "calibrated"}
    return replace(bank, limits=limits, calibration=None, provenance=provenance)


def _frame(bounds: Array, unit: str) -> Frame:
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    centre = (low + high) / 2
    reach = float(np.abs(bounds - centre).max())
    if reach == 0:
        raise InputError("exemplars: expected meshes with an extent, got a single point")
    return Frame(FILL / reach, centre, unit)


def _plan(exemplars: Exemplars, facts: Facts, decoder: str, seed: int, batch: int, probes: int) -> str:
    """A hash of all that a bank depends on."""
    inputs = {
        "meshes": facts.hashes,
        "mean": facts.mean,
        "names": exemplars.names,
        "parameters": lamp.digest(exemplars.parameters),
        "labels": lamp.digest(exemplars.labels),
        "space": [str(q) for q in (*exemplars.space, *exemplars.label_space)],
        "unit": exemplars.unit,
        "decoder": decoder,
        "seed": seed,
        "batch": batch,
        "probes": probes,
    }
    return hashed(inputs)


def hashed(inputs: object) -> str:
    """A hash of plain values."""
    return hashlib.blake2b(json.dumps(inputs, sort_keys=True).encode(), digest_size=16).hexdigest()


def _finished(
    path: Path,
    plan: str,
    exemplars: Exemplars,
    measured_by: Mapping[str, str],
    limits: Mapping[str, float] | None,
    plugins: Plugins,
) -> Bank:
    """The bank at `path`, with what can change without fitting brought up to date."""
    bank = lamp.load_bank(path)
    if bank.provenance.get("plan") != plan:
        raise BankError(f"{path}: holds a bank made from other exemplars, options or seed: delete it or name another")
    Partial.beside(path, plan).remove()  # left where a build was killed in its very last moment
    now = bank
    if dict(bank.measured_by) != measured_by:
        changed = {f"drift.{name}" for name, _ in bank.measured_by.items() ^ measured_by.items()}
        now = replace(now, measured_by=measured_by, measured=measure_all(exemplars, measured_by, plugins))
        known = {*bank.limits, *(bank.calibration.checks if bank.calibration else ())}
        if changed & known:  # limits of what was measured before
            now = uncalibrated(now)
            now = replace(now, limits={name: limit for name, limit in now.limits.items() if name not in changed})
    if limits is not None and dict(bank.limits) != limits:
        now = replace(uncalibrated(now), limits=limits)
    return bank if now is bank else lamp.store_bank(now, path)


def _provenance(
    plan: str, facts: Facts, shared: Shared, plugins: Plugins, spec: Spec, seed: int, batch: int
) -> dict[str, Scalar]:
    from importlib.metadata import version

    offer = plugins.get("decoder", spec.name)
    return {
        "plan": plan,
        "meshes": hashed(facts.hashes),
        "start": hashed({name: lamp.digest(array) for name, array in shared.items()}),
        "seed": seed,
        "batch": batch,
        "lampopt": version("lampopt"),
        "decoder": f"{offer.distribution} {offer.version}",
    }
