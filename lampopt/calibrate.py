"""Limits that mean something: exemplars that are held out, made by the others, and compared with what they are.

The outermost third of a bank is known truth out of the range of the rest. Each of them is asked for by its parameters,
mixed from others alone, decoded and measured against its own surface; what the checks said of designs of known error
gives each check the limit at which the error passes the user's tolerance.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import ceil
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from lampopt import lamp
from lampopt.bank import decoder_of, uncalibrated
from lampopt.check import Limits
from lampopt.decode import decode
from lampopt.errors import EmptyMesh, InputError
from lampopt.holdout import asked, designed, evidence, off, outermost, own
from lampopt.plugins import Plugins
from lampopt.protocols import Decoder, Progress, Solver
from lampopt.reading import path_of
from lampopt.solve import pose, solve
from lampopt.types import Array, Bank, Calibration, Check, Exemplars, Spec
from lampopt.units import number, whole

if TYPE_CHECKING:
    from trimesh import Trimesh

TRIALS = 64  # designs at least, as far as there are different ones
TELLING = 0.75  # least area under the ROC curve of a check that decides
NOISE = 1e-6  # [box, range]: what is below is the rounding of single precision, and tells nothing
BACKSTOP = 2.0  # times what was seen, for one that does not
TRIES = 50  # draws of others that could meet them
UNCALIBRATED = ("target", "hard", "range", "clearance")  # limits of what was asked and of the box, not of the shape
log = logging.getLogger("lampopt")


def calibrate(
    bank: Bank,
    tolerance: float | str,
    *,
    exemplars: Exemplars | None = None,
    solver: str | Spec = "kkt",
    resolution: int = 128,
    seed: int = 0,
    store: str | Path | None = None,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Bank:
    """`bank` with limits at which the surface's error passes `tolerance`, and the evidence for them.

    Parameters
    ----------
    bank
        N exemplars, a few more than parameters.
    tolerance
        The mean distance between surfaces up to which a design is good: a number in the bank's length unit, or text
        such as "5 mm".
    exemplars
        What the bank was built from: the truth is their meshes. By default it is what the bank decodes for them, so
        that the error leaves out how well they were fitted.
    solver, resolution
        As in a `Study`.
    seed
        For the choice of others that make a held-out exemplar, and for the points where surfaces are compared.
    store
        The `.lamp` file to write, which may be the bank's own.

    Raises
    ------
    InputError
        If the tolerance is below what any held-out exemplar reaches, no exemplar can be made by others, or `exemplars`
        are not the bank's.
    """
    if not isinstance(bank, Bank):
        raise InputError(f"bank: expected a Bank, got {bank!r:.80}; load one with load_bank(path)")
    if not isinstance(exemplars, Exemplars | None):
        raise InputError(f"exemplars: expected Exemplars, got {exemplars!r:.80}")
    seed, resolution = whole(seed, "seed", 0), whole(resolution, "resolution", 4, 4096)
    plugins = plugins or Plugins.load().report()
    allowed = number(tolerance, bank.frame.unit, "tolerance")
    if allowed <= 0:
        raise InputError(f"tolerance: expected a length above 0, got {allowed:g} {bank.frame.unit}")
    truth = lru_cache(maxsize=1)(_truth(bank, exemplars, decoder_of(bank, plugins), resolution))
    found = _evidence(bank, allowed, truth, solver, resolution, seed, progress, plugins)
    if found.good.all():
        log.warning(
            "no held-out design is off by more than %g %s, the worst by %.3g: nothing tells where designs go wrong, so "
            "no limit that is learned is tighter than its default; a smaller tolerance would tell",
            *(allowed, bank.frame.unit, found.errors.max()),
        )
    before = uncalibrated(bank)
    foretold = {"angles": allowed * bank.frame.scale}
    limits = {**before.limits, **limits_from(found, Limits.of(replace(bank, limits={}), {}), foretold)}
    provenance = {**before.provenance, "calibrated": f"{allowed:g} {bank.frame.unit} against {_against(exemplars)}"}
    made = replace(bank, limits=limits, calibration=found, provenance=provenance, path=None)
    return made if store is None else lamp.store_bank(made, path_of(store, "store"))


def _against(exemplars: Exemplars | None) -> str:
    return "the exemplars' decoded shapes" if exemplars is None else "the exemplars' meshes"


def limits_from(
    found: Calibration, defaults: Limits, foretold: Mapping[str, float] = MappingProxyType({})
) -> dict[str, float]:
    """The limit of each check by the evidence, as `Study.limits` takes them.

    A check that tells bad designs from good ones gets the value at which the error, made to rise with the value
    (isotonic regression of its logarithm), passes the tolerance. One that does not is a backstop, at twice its default
    or twice the largest value seen on a good design; without the factor where no design is bad at all. A drift says how
    well a parameter is met, which is more than the tolerance asks: it is looked at over designs that all others let
    through, and tightened only if bad ones are left there; else good designs widen it.
    What is `foretold` is the error itself by a law, and reaches farther than held-out exemplars do: its limit is the
    tolerance as given there, or the largest value seen on a good design.

    Raises
    ------
    InputError
        If no design is good.
    """
    good, errors = found.good, found.errors
    if not good.any():
        raise InputError(
            f"tolerance: {found.tolerance:g} is below the error of every held-out exemplar, the least of {len(errors)} "
            f"is {np.min(errors[~np.isnan(errors)], initial=np.inf):.3g}: allow more, or fit the exemplars better"
        )
    limits: dict[str, float] = {}
    left = np.ones(len(errors), bool)
    for drift, name in sorted((name.startswith("drift."), name) for name in found.checks):
        values = found.values[:, found.checks.index(name)]
        values = np.where(values < NOISE, 0.0, values)
        known = ~np.isnan(values) & (left if drift else True)
        if not (known & good).any():
            continue
        largest = float(values[known & good].max())
        if name in foretold:
            limits[name] = max(foretold[name], largest)
            left &= ~(values > limits[name])
            continue
        seen = max(largest, defaults[name])
        telling = _told_apart(values[known], good[known]) >= TELLING
        if telling:
            limits[name] = max(_passing(values[known], errors[known], found.tolerance), NOISE)
        else:
            limits[name] = seen if drift or good.all() else BACKSTOP * seen
        left &= ~(values > limits[name])
    return {name: limits[name] for name in found.checks if name in limits}


def _told_apart(values: Array, good: Array) -> float:
    """How often a bad design has the larger value than a good one (the area under the ROC curve)."""
    known = ~np.isnan(values)
    high, low = values[known & ~good], values[known & good]
    if not (len(high) and len(low)):
        return 0.5
    return float((np.sign(high[:, None] - low[None]) + 1).mean() / 2)


def _passing(values: Array, errors: Array, tolerance: float) -> float:
    """The value at which the error, rising with it, passes the tolerance; between two designs their geometric mean."""
    from scipy.optimize import isotonic_regression

    order = np.argsort(values, kind="stable")
    worst = 10 * max(float(np.nanmax(errors)), tolerance)  # of designs without a surface
    rising = isotonic_regression(np.log(np.nan_to_num(errors[order], nan=worst).clip(1e-9 * tolerance))).x
    over = np.flatnonzero(rising > np.log(tolerance) + 1e-9)  # a mean of equal errors may round up
    if not len(over):
        return float(values.max())
    high = float(values[order[over[0]]])
    if over[0] == 0:
        return high / 2
    return float(np.sqrt(float(values[order[over[0] - 1]]) * high))


def _evidence(
    bank: Bank,
    tolerance: float,
    truth: Callable[[int], Trimesh],
    solver: str | Spec,
    resolution: int,
    seed: int,
    progress: Progress | None,
    plugins: Plugins,
) -> Calibration:
    decoder, solving = decoder_of(bank, plugins), plugins.make("solver", solver)
    limits = Limits.of(replace(bank, limits={}), {})
    trials = list(_trials(bank, solving, limits["target"], np.random.default_rng(seed)))
    rows: list[Mapping[str, float]] = []
    errors = []
    for number_, (held, among) in enumerate(trials):
        if progress:
            progress(number_ / len(trials), f"{bank.names[held]} made by {len(among)} others")
        posed, design = designed(bank, decoder, solving, _asked(bank, held), resolution, among)
        rows.append(_as_limited(evidence(bank, decoder, posed, design, resolution, limits, plugins), limits))
        errors.append(np.nan if design.mesh is None else off(design.mesh, truth(held), seed))
    if progress:
        progress(1.0, f"{len(trials)} designs")
    names = list(dict.fromkeys(name for row in rows for name in row))
    return Calibration(
        tolerance,
        tuple(names),
        np.array([[row.get(name, np.nan) for name in names] for row in rows]).reshape(len(rows), len(names)),
        np.array(errors),
        np.array([held for held, _ in trials]),
    )


def _as_limited(checks: Sequence[Check], limits: Limits) -> dict[str, float]:
    """The values of the checks whose limits can be set, on the scale of these limits."""
    known = limits.names - set(UNCALIBRATED)
    return {
        check.name: check.value / check.limit * limits[check.name] if np.isfinite(check.value) else np.nan
        for check in checks
        if check.name in known and check.limit
    }


def _asked(bank: Bank, held: int) -> dict[str, float]:
    """The parameters of an exemplar, as far as a mix can move them."""
    return asked(bank, bank.parameters[held])


def _trials(bank: Bank, solver: Solver, met: float, rng: np.random.Generator) -> Iterator[tuple[int, Array]]:
    """Which exemplar is held out, and by which others it is made: first by the inner ones, then by any that can."""
    held = outermost(bank.parameters)
    if not len(held):
        raise InputError("calibration: the exemplars of this bank do not differ in any parameter")
    inner = np.setdiff1d(np.arange(len(bank)), held)
    rounds = max(2, ceil(TRIALS / len(held)))
    count = 0
    for one in held:
        seen = set[tuple[int, ...]]()
        for among in _choices(bank, int(one), inner, rng):
            if tuple(among) not in seen and _reaches(bank, int(one), among, solver, met):
                seen.add(tuple(among))
                count += 1
                yield int(one), among
            if len(seen) == rounds:
                break
    if not count:
        raise InputError(
            f"calibration: no exemplar can be made by others, so that its {len(_asked(bank, 0))} parameters are met: "
            f"more exemplars than the {len(bank)} of this bank are needed, or a solver that meets targets"
        )


def _choices(bank: Bank, held: int, inner: Array, rng: np.random.Generator) -> Iterator[Array]:
    others = np.setdiff1d(np.arange(len(bank)), [held])
    least = min(len(_asked(bank, held)) + 1, len(others))
    yield from (inner, others)
    for _ in range(TRIES):
        yield np.sort(rng.choice(others, rng.integers(least, len(others) + 1), replace=False))


def _reaches(bank: Bank, held: int, among: Array, solver: Solver, met: float) -> bool:
    """Whether `among` meet the parameters of `held` to `met` [half of the bank's range], as a design would have to."""
    if not len(among):
        return False
    mix = solve(pose(bank, _asked(bank, held), among=among), solver)
    return bool(np.abs(mix.residual).max(initial=0.0) <= met)


def _truth(bank: Bank, exemplars: Exemplars | None, decoder: Decoder, resolution: int) -> Callable[[int], Trimesh]:
    """The true mesh of each exemplar by number."""
    if exemplars is not None:
        meshes = own(bank, exemplars).meshes
        return lambda i: meshes[i]

    def decoded(i: int) -> Trimesh:
        try:
            return decode(bank, decoder, np.asarray(bank.weights[i]), resolution=resolution)
        except EmptyMesh as error:
            raise InputError(
                f"exemplar {bank.names[i]!r}: {error}: give the exemplars that the bank was built from"
            ) from error

    return decoded
