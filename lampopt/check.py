"""Design → checks: each one line of evidence, in the order alpha, field, mesh.

The paper's mismatch tests linearity in the weights (assumption A2) and nothing else: a decoder that is exactly linear
scores 0 on a wrong shape. So a design is accepted when every check passes, never the mismatch alone (docs/safety.md).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.angles import deviations
from lampopt.errors import (
    BankError,
    EmptyMesh,
    InputError,
    MeasureError,
    PluginError,
    StudyError,
    may_pass,
)
from lampopt.measured import resolve_address, values_of
from lampopt.plugins import Plugins
from lampopt.protocols import Checker, Decoder, DesignChecks, Interval, Measure
from lampopt.solve import Posed, columns
from lampopt.topology import topology
from lampopt.types import Array, Bank, Check, Design, Mix, Needs
from lampopt.units import factor, filled, said

if TYPE_CHECKING:
    from trimesh import Trimesh

DEFAULTS: Mapping[str, float] = {
    "target": 0.02,  # worst unmet target [half of the bank's range]
    "hard": 1e-6,  # the same of the targets that must be met exactly
    "hard.search": 1e-5,  # the same where a model or a measure tells it: a search ends near it
    "measured": 0.02,  # what a study declares measurable, against what was asked [half of the bank's range]
    "range": 1e-4,  # farthest out of a range that was asked for [half of the bank's range]
    "bounds": 1e-6,  # farthest beyond the bounds on alpha that were asked for
    "alpha": 3.0,  # ‖alpha − centre‖; a swap of one exemplar for another is 1.41
    "mismatch": 0.01,  # the paper's epsilon [box]
    "mismatch.band": 0.01,  # the same near the surface
    "angles": 0.005,  # what is off if angles act by their tangents [box]
    "drift": 0.05,  # [range of the measured value over the bank]
    "clearance": 1.5,  # between the surface and the box [cells]
}
LEVEL = 0.9  # coverage of the intervals that are told
OUTSIDE = "outside what it was made for"  # of a learned measure
LEAST = 2e-5  # range [frame's size] that a parameter has which is 0 on all exemplars: a twentieth is rounding
BAND = 0.05  # half the width of the narrow band about the surface [box]


@dataclass(frozen=True)
class Limits:
    """The limits in force: the study's, else the bank's, else the defaults; `drift.length` before `drift` for all."""

    study: Mapping[str, float]
    bank: Mapping[str, float]
    names: frozenset[str]  # of the checks that a limit can be set for

    @classmethod
    def of(cls, bank: Bank, limits: Mapping[str, float], measured: Iterable[str] = ()) -> Limits:
        """Those for a study with `limits` of its own, which declares `measured` names measurable.

        Raises
        ------
        StudyError, BankError
            If one of the study or of the bank is for a check that does not exist, or no number of at least 0.
        """
        known = frozenset({*DEFAULTS, *(f"drift.{p}" for p in bank.measured_by), *(f"measured.{p}" for p in measured)})
        any_study = known | {f"measured.{q.name}" for q in (*bank.space, *bank.label_space)}
        _usable(limits, known, "limits", StudyError)
        _usable(bank.limits, any_study, "limits of the bank", BankError)
        return cls(limits, bank.limits, known)

    def __getitem__(self, name: str) -> float:
        names = (name,) if name in DEFAULTS else (name, name.partition(".")[0])
        tables = (self.study, self.bank, DEFAULTS)
        return float(next(table[key] for table in tables for key in names if key in table))


def _usable(limits: Mapping[str, float], known: frozenset[str], what: str, error: type[InputError]) -> None:
    if unknown := sorted(set(limits) - known):
        raise error(
            f"{what}: unknown {', '.join(unknown)}; known are {', '.join(sorted(known))}; checks that plugins bring "
            "have their own"
        )
    for name, limit in limits.items():
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 <= limit <= sys.float_info.max:
            raise error(f"{what}: {name}: expected a finite number of at least 0, got {said(limit)}")


def alpha_checks(posed: Posed, mix: Mix, limits: Limits) -> list[Check]:
    """What alpha alone tells: is it an answer, are targets and ranges met, how far is it from the centre."""
    said = "" if mix.status == "exact" else mix.message  # told by what fails
    found = [
        Check("solved", float(mix.status != "failed"), "=", 1.0, "", "alpha", said if mix.status == "failed" else ""),
        _met("target", mix.residual, limits, said),
    ]
    problem = posed.problem
    if problem.hard.any():
        found.append(_met("hard", mix.residual[problem.hard], limits, said))
    if len(problem.range_names):
        values = problem.range_matrix @ mix.alpha[posed.active]
        outside = np.maximum(problem.range_low - values, values - problem.range_high).clip(0.0)
        worst = problem.range_names[int(outside.argmax())]
        found.append(_met("range", outside, limits, f"the worst is {worst}" if outside.any() else ""))
    if problem.alpha_low is not None and problem.alpha_high is not None:
        alpha = mix.alpha[posed.active]
        beyond = float(np.maximum(problem.alpha_low - alpha, alpha - problem.alpha_high).max(initial=0.0))
        note = "" if beyond <= limits["bounds"] else said
        found.append(Check("bounds", beyond, "<=", limits["bounds"], "", "alpha", note))
    distance = float(np.linalg.norm(mix.alpha - posed.centre()))
    return [*found, Check("alpha", distance, "<=", limits["alpha"], "", "alpha", "‖alpha − centre‖")]


def _met(name: str, off: Array, limits: Limits, note: str) -> Check:
    """The worst of what is `off` [half of the bank's range]."""
    worst, limit = float(np.abs(off).max(initial=0.0)), limits[name]
    return Check(name, worst, "<=", limit, "half range", "alpha", "" if worst <= limit else note)


def _summed(alpha: Array, values: Array) -> Array:
    """Σ alpha_i values_i: (..., M, C) of (..., N) and (N, M, C).

    One mix row by row: as a product, numpy would widen all values first, and BLAS's threads stand in the decoder's way.
    """
    if alpha.ndim > 1:
        return np.asarray(np.tensordot(alpha, values, 1))
    total = np.zeros(values.shape[1:])
    for share, row in zip(alpha.tolist(), values, strict=True):
        total += share * row
    return total


def mismatches(
    bank: Bank, decoder: Decoder, alpha: Array, weights: Array, chosen: Array | None = None
) -> tuple[Array, Array]:
    """The linearity mismatch over all probes and over those within `BAND` of the surface (...,) [box].

    The mean of |f(z; Wᵀalpha) − Σ alpha_i f(z; w_i)| (paper, section 3), with f(z; w_i) stored in the bank: one
    forward pass and one product in place of N + 1 passes. The band's is NaN for decoders whose values are no
    distances (C > 1), or where no probe is near. Takes alpha (..., N) with weights (..., D), and which probes count;
    None: all.

    Raises
    ------
    BankError
        If the decoder answers in another shape than it did when the bank was built.
    """
    probes, values = bank.probes, bank.probe_values
    if chosen is not None and not chosen.all():
        probes, values = probes[chosen], values[:, chosen]
    mixed = np.asarray(decoder.evaluate(bank.shared, weights, probes), float)
    linear = _summed(alpha, values)
    if mixed.shape != linear.shape:
        raise BankError(
            f"decoder {bank.decoder.name!r}: expected values of shape {linear.shape} at the probes, as when the bank "
            f"was built, got {mixed.shape}: another version of the decoder, or a damaged bank; build it anew"
        )
    gap = np.linalg.norm(mixed - linear, axis=-1)
    box = gap.mean(-1)
    if mixed.shape[-1] != 1:
        return box, np.full_like(box, np.nan)
    near = np.minimum(np.abs(mixed), np.abs(linear))[..., 0] <= BAND
    count = near.sum(-1)
    return box, np.where(count > 0, (gap * near).sum(-1) / np.maximum(count, 1), np.nan)


def linearity_checks(found: Sequence[float], limits: Limits) -> list[Check]:
    """The lines of evidence about what was `found`: both of `mismatches`, then `deviations` [box]; NaN: none."""
    notes = {
        "mismatch": "linearity, all of the box",
        "mismatch.band": f"linearity within {BAND} of the surface",
        "angles": "what is off if angles act by their tangents",
    }
    return [
        Check(name, value, "<=", limits[name], "box", "field", note)
        for (name, note), value in zip(notes.items(), found, strict=True)
        if name == "mismatch" or not np.isnan(value)
    ]


def field_checks(
    bank: Bank, decoder: Decoder, design: Design, limits: Limits, chosen: Array | None = None
) -> list[Check]:
    """What the decoder's values at the probes, or at those `chosen` (M,), tell, without a mesh."""
    alpha = design.mix.alpha
    found = (*mismatches(bank, decoder, alpha, design.weights, chosen), deviations(bank, decoder, alpha))
    return linearity_checks([float(value) for value in found], limits)


def mesh_checks(
    bank: Bank,
    decoder: Decoder,
    design: Design,
    resolution: int,
    limits: Limits,
    plugins: Plugins,
    wanted: Mapping[str, float] | None = None,
) -> list[Check]:
    """What the mesh tells: its health, and every parameter that can be measured on it.

    `wanted` are the values that some of these should have, where something else than the mix tells them.
    """
    mesh = design.mesh
    faces = 0 if mesh is None else len(mesh.faces)
    found = [Check("mesh", float(faces), ">=", 1.0, "faces", "mesh", "" if faces else "the field has no surface")]
    if mesh is None or not faces:
        return found
    shape = topology(mesh)
    outward = shape.closed and float(mesh.volume) > 0
    inward = "faces point inward" if shape.closed and not outward else ""
    found.append(Check("watertight", float(outward), "=", 1.0, "", "mesh", inward))
    for name, value in (("bodies", shape.bodies), ("genus", shape.genus)):
        expected = bank.mesh_facts.get(name)
        if expected is None:
            found.append(
                Check(name, _nan(value), "info", None, "", "mesh", "the exemplars differ in it, or are not closed")
            )
        else:
            found.append(Check(name, _nan(value), "=", float(expected), "", "mesh", "as the exemplars"))
    if bank.probe_values.shape[-1] == 1:
        found.append(_clearance(bank, decoder, mesh, resolution, limits))
    found += drift_checks(bank, design.mix.alpha, mesh, limits, plugins, wanted)
    if isinstance(decoder, DesignChecks):
        theirs = decoder.design_checks(bank.shared, design.weights, bank.frame.to_box(mesh))
        found += _checks(f"decoder {bank.decoder.name!r}: design_checks", theirs)
    return found


def _nan(value: int | None) -> float:
    return float("nan") if value is None else float(value)


def _clearance(bank: Bank, decoder: Decoder, mesh: Trimesh, resolution: int, limits: Limits) -> Check:
    """Whether the surface keeps clear of the box, where it would be cut."""
    low, high = decoder.bounds
    at = (np.asarray(mesh.bounds) - bank.frame.centre) * bank.frame.scale
    cell = float((high - low).max()) / resolution
    room = float(min((at[0] - low).min(), (high - at[1]).min())) / cell
    return Check(
        "clearance", room, ">=", limits["clearance"], "cells", "mesh", "the surface is cut by the box below that"
    )


def drift_checks(
    bank: Bank,
    alpha: Array,
    mesh: Trimesh,
    limits: Limits,
    plugins: Plugins,
    wanted: Mapping[str, float] | None = None,
) -> list[Check]:
    """Every parameter declared measurable, against what the mix predicts for it.

    The prediction is Mᵀalpha with M what was measured on the exemplars: Pᵀalpha wherever the measurement is the
    parameter, and still right where it differs by an offset or a factor (a parameter given as a change of length).
    Where the ask was corrected so that a `wanted` value is measured, that is what counts.
    """
    found, known, wanted, asked = [], _Measured(mesh, plugins), wanted or {}, columns(bank)
    least = LEAST / bank.frame.scale
    for (parameter, address), values in zip(bank.measured_by.items(), bank.measured.T, strict=True):
        unit, spread = asked[address].unit, asked[address].spread
        expected = wanted.get(parameter, float(alpha @ values))
        limit = limits[f"drift.{parameter}"] * max(spread or abs(float(values.mean())), least)
        try:
            value = known(address, bank.frame.unit, unit)
        except (MeasureError, EmptyMesh) as error:
            note = f"{address}: {error}"
            lost = Check(f"drift.{parameter}", float("nan"), "<=", limit, unit, "mesh", note, may_pass(error))
            found.append(lost)
            continue
        note = f"{address} {value:.6g}, {'wanted' if parameter in wanted else 'predicted'} {expected:.6g}"
        found.append(Check(f"drift.{parameter}", abs(value - expected), "<=", limit, unit, "mesh", note))
    return found


class _Measured:
    """Values read off one mesh, each measure called once."""

    def __init__(self, mesh: Trimesh, plugins: Plugins) -> None:
        self._mesh, self._plugins = mesh, plugins
        self._values: dict[str, Array | MeasureError | EmptyMesh] = {}

    def __call__(self, address: str, length: str, unit: str) -> float:
        name, measure, place = resolve_address(address, self._plugins)
        if name not in self._values:
            try:
                self._values[name] = values_of(name, measure, self._mesh)
                if isinstance(measure, Interval) and measure.outside(self._mesh):
                    raise MeasureError(f"this shape is {OUTSIDE}, so that its value tells nothing")
            except (MeasureError, EmptyMesh) as error:
                self._values[name] = error
        values = self._values[name]
        if isinstance(values, (MeasureError, EmptyMesh)):
            raise values
        return float(values[place]) * factor(filled(measure.units[place], length), unit, address)


def measure_checks(bank: Bank, mesh: Trimesh, measures: Mapping[str, Measure]) -> list[Check]:
    """Values that a study wants to know; they judge nothing.

    One that was learned says how far to trust it: its interval, and whether the shape is outside what it knows.
    """
    found = []
    for name, measure in measures.items():
        retry = False
        try:
            values = values_of(name, measure, mesh)
            notes = _trust(name, measure, mesh) if isinstance(measure, Interval) else [""] * len(values)
        except (MeasureError, EmptyMesh) as error:
            values, notes = np.full(len(measure.names), np.nan), [str(error)] * len(measure.names)
            retry = may_pass(error)
        for value, label, unit, note in zip(values, measure.names, measure.units, notes, strict=True):
            found.append(
                Check(f"{name}.{label}", float(value), "info", None, filled(unit, bank.frame.unit), "mesh", note, retry)
            )
    return found


def trusted(name: str, measure: Interval, mesh: Trimesh) -> tuple[Array, bool]:
    """Low and high (p, 2) of a learned measure's values at coverage LEVEL, and whether `mesh` is outside its range.

    Raises
    ------
    PluginError
        If it returns something else. What it raises is passed on.
    """
    ends = np.asarray(measure.interval(mesh, LEVEL), float)  # infinite ends promise nothing, and may
    names: tuple[str, ...] = getattr(measure, "names", ())
    if ends.shape != (wanted := (len(names), 2)) or np.isnan(ends).any():
        raise PluginError(f"measure {name!r}: interval: expected {wanted} low and high ends, got {ends!r:.100}")
    return ends, bool(measure.outside(mesh))


def _trust(name: str, measure: Interval, mesh: Trimesh) -> list[str]:
    ends, outside = trusted(name, measure, mesh)
    told = f"; {OUTSIDE}" if outside else ""
    return [f"{LEVEL:.0%} interval {low:.6g} to {high:.6g}{told}" for low, high in ends]


def stranger_checks(bank: Bank, design: Design, checkers: Mapping[str, Checker], needs: Needs) -> list[Check]:
    """What plugins' checkers of this level say; one that cannot judge this design fails, with its reason.

    Raises
    ------
    PluginError
        If one raises anything but MeasureError or EmptyMesh, or returns no checks; its name is told.
    """
    found: list[Check] = []
    for name, checker in checkers.items():
        if checker.needs != needs:
            continue
        try:
            answer = checker(bank, design)
        except (MeasureError, EmptyMesh) as error:
            found.append(Check(name, float("nan"), "=", 1.0, "", needs, f"cannot judge: {error}", may_pass(error)))
        except Exception as error:  # whatever a stranger's checker raises
            raise PluginError(f"check {name!r}: raised {error!r}") from error
        else:
            found += _checks(f"check {name!r}", answer)
    return found


def expect_told(checks: Iterable[Check], more: str = "") -> None:
    """Raise MeasureError, one that may pass, where one of `checks` has to be tried again; `more` ends its message."""
    if lost := next((check for check in checks if check.retry), None):
        error = MeasureError(f"{lost.name}: {lost.note}{more}")
        error.passing = True
        raise error


def _checks(who: str, answer: object) -> Sequence[Check]:
    if not isinstance(answer, Sequence) or not all(isinstance(check, Check) for check in answer):
        raise PluginError(f"{who}: expected a list of lampopt.Check, got {answer!r:.80}")
    return answer
