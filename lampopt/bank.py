"""Exemplars → bank: fit every exemplar with one decoder from one shared start (paper, section 3).

The work is cut into batches that are fixed up front. Each finished batch is written to `<store>.partial/`, so that an
interrupted build goes on where it stopped and ends with the very same bank.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np

from lampopt import lamp
from lampopt.errors import BankError, FitError, InputError, PluginError
from lampopt.measured import measure_all
from lampopt.meshfile import indexed
from lampopt.partial import Partial
from lampopt.plugins import Plugins, returned
from lampopt.protocols import Decoder, Progress, Shared
from lampopt.topology import topology
from lampopt.types import Array, Bank, Exemplars, Frame, Parameter, Scalar, Spec
from lampopt.types.arrays import frozen_arrays

if TYPE_CHECKING:
    from trimesh import Trimesh

FILL = 0.6  # part of the box that the largest exemplar takes: the rest is room to extrapolate
PROBES = 16384  # points where linearity is tested; about 2 % of them fall near the surface
log = logging.getLogger("lampopt")


def build_bank(
    exemplars: Exemplars,
    decoder: str | Spec = "sdf-mlp",
    *,
    seed: int = 0,
    store: str | Path | None = None,
    measured: Mapping[str, str] | None = None,
    limits: Mapping[str, float] | None = None,
    batch: int = 8,
    probes: int = PROBES,
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
        Same seed, same bank, bit for bit at equal thread count.
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
    progress
        Told how far it is.

    Raises
    ------
    FitError
        Naming the exemplar that cannot be fitted, and why.
    BankError
        If `store` holds a bank, or the beginning of one, made from other inputs, or another process is building it.
    InputError, PluginError
        If an argument cannot be used.
    """
    if not isinstance(exemplars, Exemplars):
        raise InputError(f"exemplars: expected lampopt.types.Exemplars, got {exemplars!r:.80}")
    if measured is not None and not _texts(measured):
        raise InputError(f"measured: expected a mapping such as {{'length': 'extents.length'}}, got {measured!r:.80}")
    seed, batch, probes = _whole("seed", seed, 0), _whole("batch", batch, 1), _whole("probes", probes, 1)
    plugins = plugins or Plugins.load().report()
    spec = Spec.of(decoder)
    made: Decoder = plugins.make("decoder", spec)
    limits = None if limits is None else _limits(limits)
    facts = _survey(exemplars)
    plan = _plan(exemplars, facts, f"{spec!r} of {plugins.get('decoder', spec.name)}", seed, batch, probes)
    path = Path(store) if store is not None else None
    measured_by = {**exemplars.measured, **(measured or {})}
    if path is not None and path.exists():
        return _finished(path, plan, exemplars, measured_by, limits, plugins)
    values = measure_all(exemplars, measured_by, plugins)
    with nullcontext() if path is None else Partial.open(path, plan) as partial:
        if path is not None and path.exists():  # another process has come to its end meanwhile
            return _finished(path, plan, exemplars, measured_by, limits, plugins)
        frame = _frame(facts.bounds, exemplars.unit)
        meshes = _InBox(exemplars.meshes, exemplars.names, frame)
        shared, weights, error = _fit(exemplars, meshes, frame, made, spec.name, seed, batch, partial, progress)
        points = returned(f"decoder {spec.name!r}: probes", made.probes(shared, probes, seed), (probes, 3))
        bank = Bank(
            space=_ranged(exemplars.space, exemplars.parameters),
            parameters=exemplars.parameters,
            label_space=_ranged(exemplars.label_space, exemplars.labels),
            labels=exemplars.labels,
            names=exemplars.names,
            weights=weights,
            shared=shared,
            frame=frame,
            decoder=spec,
            probes=points,
            probe_values=_values(made, spec.name, shared, weights, points),
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


def _texts(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(t, str) for pair in value.items() for t in pair)


def _whole(name: str, value: object, least: int) -> int:
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        raise InputError(f"{name}: expected at least {least}, a whole number, got {value!r}")
    return int(value)


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


@dataclass(frozen=True)
class _Facts:
    """What one look at every mesh tells."""

    bounds: Array  # (N, 2, 3)
    hashes: tuple[str, ...]
    mean: str | None  # hash of the mesh at the mean design, where the source knows it
    common: Mapping[str, int]


def _survey(exemplars: Exemplars) -> _Facts:
    from trimesh import Trimesh

    bounds, shapes, hashes = [], set(), list[str]()
    for i, name in enumerate(exemplars.names):
        mesh: object = exemplars.meshes[i]  # by index: a loader's IndexError would end an iteration
        if not isinstance(mesh, Trimesh):
            raise FitError(f"exemplar {name!r}: expected a trimesh.Trimesh, got {mesh!r:.80}")
        if not indexed(mesh) or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
            raise FitError(f"exemplar {name!r}: expected a mesh with faces and finite vertices; repair or remove it")
        bounds.append(mesh.bounds)
        found = _digest(mesh)
        first = hashes.index(found) if found in hashes else i
        if not np.array_equal(exemplars.parameters[first], exemplars.parameters[i]):
            both = (exemplars.names[first], name)
            log.warning("exemplars %r and %r: one mesh, different parameters; one of the two may be wrong", *both)
        hashes.append(found)
        shapes.add(shape := topology(mesh))
    common = {} if len(shapes) > 1 or shape.genus is None else {"bodies": shape.bodies, "genus": shape.genus}
    mean = None if exemplars.mesh_at is None else _digest(exemplars.mesh_at(exemplars.parameters.mean(0)))
    return _Facts(np.array(bounds), tuple(hashes), mean, common)


def _digest(mesh: Trimesh) -> str:
    return lamp.digest(np.asarray(mesh.vertices, float)) + lamp.digest(np.asarray(mesh.faces, np.int64))


def _frame(bounds: Array, unit: str) -> Frame:
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    centre = (low + high) / 2
    reach = float(np.abs(bounds - centre).max())
    if reach == 0:
        raise InputError("exemplars: expected meshes with an extent, got a single point")
    return Frame(FILL / reach, centre, unit)


class _InBox(Sequence["Trimesh"]):
    """The exemplars' meshes in the decoder's box, moved there on access; `metadata["name"]` says whose."""

    def __init__(self, meshes: Sequence[Trimesh], names: Sequence[str], frame: Frame) -> None:
        self._meshes, self._names, self._frame = meshes, names, frame

    def __len__(self) -> int:
        return len(self._meshes)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> _InBox: ...
    def __getitem__(self, index: int | slice) -> Trimesh | _InBox:
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            return _InBox([self._meshes[i] for i in chosen], [self._names[i] for i in chosen], self._frame)
        mesh = self._frame.to_box(self._meshes[index])
        mesh.metadata["name"] = self._names[index]
        return mesh


def _mean_mesh(exemplars: Exemplars, meshes: Sequence[Trimesh], frame: Frame) -> Trimesh:
    """The mesh at the mean design where the source knows it, else the exemplar nearest to the mean."""
    mean = exemplars.parameters.mean(0)
    if exemplars.mesh_at is not None:
        mesh = frame.to_box(exemplars.mesh_at(mean))
        mesh.metadata["name"] = "mean design"
        return mesh
    spread = np.ptp(exemplars.parameters, axis=0)
    away = (exemplars.parameters - mean) / np.where(spread > 0, spread, 1.0)
    return meshes[int((away**2).sum(1).argmin())]


def _fit(
    exemplars: Exemplars,
    meshes: _InBox,
    frame: Frame,
    decoder: Decoder,
    called: str,
    seed: int,
    batch: int,
    partial: Partial | None,
    progress: Progress | None,
) -> tuple[Shared, Array, Array]:
    """The shared start, weights (N, D) and errors (N,); what `partial` holds already is taken from it."""
    starts = range(0, len(meshes), batch)
    steps = 1 + len(starts)
    tell = progress or (lambda done, message="": None)
    begun: Shared | None = partial.read("shared") if partial else None
    if begun is None:
        tell(0.0, "shared start")
        if partial:
            partial.clear()  # batches from a start that is lost
        begun = _prepared(called, decoder.prepare(meshes, mean=_mean_mesh(exemplars, meshes, frame), seed=seed))
        if partial:
            partial.write("shared", begun)
    shared = frozen_arrays(begun, "shared")  # what one batch did to it, the next would start from
    weights, errors = list[Array](), list[Array]()
    for number, start in enumerate(starts):
        chosen = meshes[start : start + batch]
        done = partial.read(f"batch_{number:04d}") if partial else None
        if done is None:
            what = f"exemplars {start + 1} to {start + len(chosen)} of {len(meshes)}"
            log.info("fitting %s", what)
            names = exemplars.names[start : start + batch]
            try:
                answer = decoder.fit(
                    shared,
                    chosen,
                    seed=seed,
                    progress=_part(tell, (1 + number) / steps, 1 / steps, what),
                )
            except FitError as failure:
                if any(name in str(failure) for name in names):
                    raise
                raise FitError(f"among the exemplars {', '.join(names)}: {failure}") from failure
            done = _fitted(called, answer, len(chosen), weights[0].shape[1] if weights else None)
            if partial:
                partial.write(f"batch_{number:04d}", done)
        weights.append(done["weights"])
        errors.append(done["error"])
    tell(1.0, "done")
    return shared, np.concatenate(weights), np.concatenate(errors)


def _prepared(called: str, answer: object) -> Shared:
    try:
        if not isinstance(answer, Mapping) or not all(isinstance(name, str) for name in answer):
            raise TypeError(f"{answer!r:.80}")
        return frozen_arrays(answer, "shared")
    except (TypeError, ValueError) as error:
        raise PluginError(f"decoder {called!r}: prepare: expected names with arrays, got {error}") from error


def _fitted(called: str, answer: object, count: int, wide: int | None) -> dict[str, Array]:
    what = f"decoder {called!r}: fit"
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        raise PluginError(f"{what}: expected a pair of weights and errors, got {answer!r:.80}")
    weights = returned(f"{what}: weights", answer[0], (count, wide), np.float32)
    return {"weights": weights, "error": returned(f"{what}: error", answer[1], (count,))}


def _values(decoder: Decoder, called: str, shared: Shared, weights: Array, points: Array) -> Array:
    values: list[Array] = []
    for w in weights:
        shape = (len(points), values[0].shape[1] if values else None)
        values.append(returned(f"decoder {called!r}: evaluate", decoder.evaluate(shared, w, points), shape))
    return np.stack(values)


def _part(tell: Progress, start: float, share: float, what: str) -> Callable[..., None]:
    def progress(done: float, message: str = "", /) -> None:
        tell(start + share * done, f"{what}: {message}" if message else what)

    return progress


def _ranged(space: Sequence[Parameter], values: Array) -> tuple[Parameter, ...]:
    """`space` with the range that `values` (N, d) span; a label nobody has spans none."""

    def each() -> Iterator[Parameter]:
        for q, column in zip(space, values.T, strict=True):
            known = column[~np.isnan(column)]
            yield (
                replace(q, low=float(known.min()), high=float(known.max()))
                if len(known)
                else replace(q, low=None, high=None)
            )

    return tuple(each())


def _plan(exemplars: Exemplars, facts: _Facts, decoder: str, seed: int, batch: int, probes: int) -> str:
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
    return _hash(inputs)


def _hash(inputs: object) -> str:
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
        now = replace(now, measured_by=measured_by, measured=measure_all(exemplars, measured_by, plugins))
    if limits is not None and dict(bank.limits) != limits:
        now = replace(now, limits=limits)
    return bank if now is bank else lamp.store_bank(now, path)


def _provenance(
    plan: str, facts: _Facts, shared: Shared, plugins: Plugins, spec: Spec, seed: int, batch: int
) -> dict[str, Scalar]:
    from importlib.metadata import version

    offer = plugins.get("decoder", spec.name)
    return {
        "plan": plan,
        "meshes": _hash(facts.hashes),
        "start": _hash({name: lamp.digest(array) for name, array in shared.items()}),
        "seed": seed,
        "batch": batch,
        "lampopt": version("lampopt"),
        "decoder": f"{offer.distribution} {offer.version}",
    }
