"""Known truth out of the range of the rest: which exemplars are held out, and what the others make of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, overload

import numpy as np

from lampopt.bank import hashed
from lampopt.check import Limits, alpha_checks, field_checks, mesh_checks
from lampopt.decode import decode
from lampopt.errors import EmptyMesh, InputError
from lampopt.intake import intake
from lampopt.metrics import surface_distance
from lampopt.mix import mixed_weights, predicted
from lampopt.plugins import Plugins
from lampopt.protocols import Decoder, Solver
from lampopt.solve import Posed, pose, solve
from lampopt.types import ROUNDING, Array, Bank, Check, Design, Exemplars

if TYPE_CHECKING:
    from trimesh import Trimesh

SHARE = 1 / 3  # of the exemplars are held out: the outermost
MET = 1e-6  # of a parameter's range, within which a mix of the inner exemplars has to meet it


def normalised(parameters: Array) -> Array:
    """Those of the parameters (N, d) that differ, on [-1/2, 1/2] over the exemplars."""
    low, spread = parameters.min(0), np.ptp(parameters, axis=0)
    moved = spread > 0
    return np.asarray((parameters[:, moved] - low[moved]) / spread[moved] - 0.5)


def outermost(parameters: Array) -> Array:
    """The third of the exemplars with `parameters` (N, d) farthest from the middle of the range, and those just as far.

    Empty where the exemplars do not differ.
    """
    away = (normalised(parameters) ** 2).sum(1)
    least = np.sort(away)[-max(1, round(SHARE * len(away)))]
    return np.flatnonzero(away >= least * (1 - 1e-9)) if least > 0 else np.empty(0, int)


def parted(parameters: Array) -> tuple[Array, Array]:
    """The inner exemplars and those held out, by number: the outermost, so far as a mix of inner ones can meet them.

    Where it cannot (two exemplars for each parameter, varied one at a time), the nearest of those that are not met
    joins the inner ones, until all the others are.
    """
    at = normalised(parameters)
    held = outermost(parameters).tolist()
    held.sort(key=lambda i: float((at[i] ** 2).sum()))
    while True:
        inner = np.setdiff1d(np.arange(len(at)), np.array(held, int))
        unmet = next((i for i in held if not _met(at[inner], at[i])), None)
        if unmet is None:
            return inner, np.sort(np.array(held, int))
        held.remove(unmet)


def _met(inner: Array, wanted: Array) -> bool:
    """Whether coefficients that sum to one bring rows `inner` (n, d) to `wanted` (d,)."""
    if not len(inner):
        return False
    steps = (inner - inner[0]).T
    left = wanted - inner[0]
    return bool(np.abs(left - steps @ np.linalg.lstsq(steps, left, rcond=None)[0]).max(initial=0.0) <= MET)


def asked(bank: Bank, parameters: Array) -> dict[str, float]:
    """What a design with `parameters` (d,) is asked for: those that a mix of `bank` can move."""
    return {q.name: float(value) for q, value in zip(bank.space, parameters, strict=True) if q.spread > 0}


def designed(
    bank: Bank,
    decoder: Decoder,
    solver: Solver,
    targets: dict[str, float],
    resolution: int,
    among: Sequence[int] | Array | None = None,
) -> tuple[Posed, Design]:
    """The problem that `targets` pose to the exemplars in `among` (None: all), and its design, decoded."""
    posed = pose(bank, targets, among=among)
    mix = solve(posed, solver)
    weights = mixed_weights(bank, mix.alpha)
    mesh = decoded(bank, decoder, weights, resolution)
    return posed, Design(targets, mix, predicted(bank, mix.alpha), weights, partial(_itself, mesh))


def evidence(
    bank: Bank, decoder: Decoder, posed: Posed, design: Design, resolution: int, limits: Limits, plugins: Plugins
) -> list[Check]:
    """All checks of a design, as a study without measures makes them."""
    checks = [*alpha_checks(posed, design.mix, limits), *field_checks(bank, decoder, design, limits)]
    return checks + mesh_checks(bank, decoder, design, resolution, limits, plugins)


def decoded(bank: Bank, decoder: Decoder, weights: Array, resolution: int) -> Trimesh | None:
    """The mesh of `weights` (D,) [the bank's unit]; None where there is no surface."""
    try:
        return decode(bank, decoder, weights, resolution=resolution)
    except EmptyMesh:
        return None


def off(mesh: Trimesh | None, true: Trimesh, seed: int) -> float:
    """How far `mesh` is from the `true` one [their unit]; NaN where it has no surface."""
    return np.nan if mesh is None or not len(mesh.faces) else surface_distance(mesh, true, seed=seed)


def chosen(exemplars: Exemplars, rows: Sequence[int] | Array) -> Exemplars:
    """Some of `exemplars`, by number; their meshes are loaded when they are looked at."""
    numbers = [int(row) for row in rows]
    return replace(
        exemplars,
        parameters=exemplars.parameters[numbers],
        labels=exemplars.labels[numbers],
        names=tuple(exemplars.names[i] for i in numbers),
        meshes=_Chosen(exemplars.meshes, numbers),
    )


def _itself(mesh: Trimesh | None) -> Trimesh | None:
    return mesh


class _Chosen(Sequence["Trimesh"]):
    """Some of `meshes`, loaded when they are looked at."""

    def __init__(self, meshes: Sequence[Trimesh], rows: Sequence[int]) -> None:
        self._meshes, self._rows = meshes, rows

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> _Chosen: ...
    def __getitem__(self, index: int | slice) -> Trimesh | _Chosen:
        if isinstance(index, slice):
            return _Chosen(self._meshes, self._rows[index])
        return self._meshes[self._rows[index]]


def own(bank: Bank, exemplars: Exemplars, *, altered: bool = False) -> Exemplars:
    """`exemplars` in the order of `bank`, mended as they were when it was built.

    Raises
    ------
    InputError
        If one is missing, or they have another unit, other parameters or, unless `altered`, other meshes than the bank
        was built from.
    """
    what = "exemplars: expected those that the bank was built from"
    if exemplars.unit != bank.frame.unit:
        raise InputError(f"{what}, in {bank.frame.unit!r}, got {exemplars.unit!r}")
    place = {name: i for i, name in enumerate(exemplars.names)}
    if missing := [name for name in bank.names if name not in place]:
        raise InputError(f"{what}, {', '.join(missing)} missing")
    rows = [place[name] for name in bank.names]
    quantities = [(q.name, q.unit) for q in exemplars.space]
    if quantities != [(q.name, q.unit) for q in bank.space] or not np.allclose(
        exemplars.parameters[rows], bank.parameters, rtol=ROUNDING, atol=0
    ):
        raise InputError(f"{what}, got other parameters")
    report = intake(chosen(exemplars, rows), accept="all", fellows=False, crossings=False)
    report.refuse()
    changed = {"added", "removed"} & set(bank.provenance)  # then the hash is not that of all meshes together
    if not (altered or changed) and bank.provenance.get("meshes") not in (None, hashed(report.facts.hashes)):
        raise InputError(f"{what}, got other meshes under their names")
    return report.exemplars
