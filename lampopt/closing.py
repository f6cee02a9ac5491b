"""The closed loop: measure what was made, correct the ask, and make it again, so that what is measured hits the target.

What is off is mostly the same nearby (a decoder's blunting, a label that is not linear in the mix), so that asking for
as much more or less takes nearly all of it away. The first correction takes one unit asked for one unit measured; each
turn then teaches how they really go together (Broyden, 1965). A label of which the parameters tell something is asked
by a plane through what was measured (lampopt.plane), from the first turn, and always from the design that came nearest.
It ends where what is off is within the noise that the measure tells. The best of all turns counts.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from lampopt.check import OUTSIDE, Limits
from lampopt.errors import StudyError
from lampopt.mix import predicted
from lampopt.plane import Plane, explained
from lampopt.progress import silent
from lampopt.quantities import Quantities, Quantity, error_of, teller
from lampopt.solve import Column, Posed, columns
from lampopt.study import Study
from lampopt.types import Array, Bank, Check, Mix
from lampopt.units import factor

CLOSE = 1e-4  # what is off by less [half of the bank's range] needs no other turn
WITHIN = 0.5  # nor what is off by less than this part of the standard error that its measure tells
BESIDE = 1e-2  # nor, beside one of those, what is off by less [half of the bank's range]: each turn costs its measuring
FARTHEST = 1.0  # correction in one turn [half of the bank's range]
Solve = Callable[[Mapping[str, float], Mapping[str, Array]], tuple[Posed, Mix]]
log = logging.getLogger("lampopt")


@dataclass(frozen=True, eq=False)
class Reading:
    """One asked value that can be measured: by what, and what should be read there.

    Parameters
    ----------
    column
        What is asked.
    quantity
        What is measured for it, `factor` times which is in the column's unit.
    wanted
        What it should be, in the column's unit.
    slope
        How much more is read for one unit more asked.
    """

    column: Column
    quantity: Quantity
    factor: float
    wanted: float
    slope: float


@dataclass(frozen=True, eq=False)
class Closed:
    """What the closed loop ends with: the problem and mix of the best turn, and what each name was read as.

    `asked` are the corrected values [the bank's units], `read` and `wanted` those measured and those that should have
    been; `expected` is what the bank's own measurements of what is asked should read; `turns` counts corrections.
    """

    posed: Posed
    mix: Mix
    asked: Mapping[str, float]
    read: Mapping[str, float] = field(default_factory=dict)
    wanted: Mapping[str, float] = field(default_factory=dict)
    turns: int = 0
    expected: Mapping[str, float] = field(default_factory=dict)


def measurable(study: Study, bank: Bank, asked: Iterable[str]) -> dict[str, str]:
    """Which measured value tells an asked one, by name: what the study says, then what the bank declares."""
    own = set(bank.measured_by.values())  # asked for as what is measured
    return {
        name: address
        for name in asked
        if (address := study.measured.get(name) or bank.measured_by.get(name) or (name if name in own else None))
    }


def correctable(study: Study, quantities: Quantities, asked: Iterable[str]) -> dict[str, str]:
    """Which measured value an asked one is corrected by, by name; a measure's own is not: its term sees every mesh.

    Raises
    ------
    StudyError
        If there is no such value, or it is to correct what the mix does not tell; if the study has turns and nothing
        that they could correct.
    InputError
        If its unit cannot become that of what is asked.
    """
    found = dict[str, str]()
    for name, address in measurable(study, quantities.bank, asked).items():
        if (column := quantities[name].column) is not None:
            if study.turns or name in study.measured:  # else nothing asks for it before the mesh is there
                factor(quantities.measured(address).unit, column.unit, f"{address!r} for {name!r}")
            found[name] = address
        elif address != quantities[name].name:
            raise StudyError(
                f"measured: {name!r} is told by {teller(quantities[name])}, not by the mix, so that nothing corrects "
                f"it: ask for {address!r} itself"
            )
    if not found and study.turns:
        raise StudyError(
            "turns: nothing that is asked can be measured: declare it with measured={'name': 'measure.value'}, in the "
            "study or when the bank is built"
        )
    return found


def closed(
    study: Study,
    quantities: Quantities,
    target: Mapping[str, float],
    solve: Solve,
    start: tuple[Posed, Mix],
    tell: Callable[[str], None] = silent,
) -> Closed:
    """The best of the study's turns.

    Parameters
    ----------
    target
        What is asked [the bank's units].
    solve
        Makes the mix of what is asked instead; (N,) what columns are taken to be over the exemplars besides.
    start
        What it makes of `target` itself.
    tell
        Told how far off each turn is.

    Raises
    ------
    StudyError
        If nothing that is asked can be measured.
    """
    posed, mix = start
    readings = _readings(study, quantities, target, mix)
    if not readings:
        return Closed(posed, mix, dict(target))
    planes = _planes(study, quantities, readings)
    corrected = [name not in planes for name in readings]
    jacobian = np.diag([reading.slope for reading in readings.values()])[np.ix_(corrected, corrected)]
    scale = np.array([reading.column.spread / 2 for reading in readings.values()])
    wanted = np.array([reading.wanted for reading in readings.values()])
    ask = {**target, **_begun(study, quantities, target, [name for name in readings if name not in planes])}
    if planes or ask != target:
        posed, mix = _next(solve, ask, readings, planes)
    best: tuple[tuple[bool, float], Closed] | None = None
    before: tuple[Array, Array] | None = None
    for turn in range(study.turns + 1):
        read = _read(readings, quantities, mix)
        off = (read - wanted) / scale
        worst = float(np.abs(off).max()) if np.isfinite(off).all() else np.inf
        values, aims = (dict(zip(readings, v.tolist(), strict=True)) for v in (read, wanted))
        told = Closed(posed, mix, dict(ask), values, aims, turn)
        rank = (mix.status in ("infeasible", "failed"), worst)  # what nothing meets is no better for being measured
        if best is None or rank < best[0]:
            best = rank, told
        if study.turns:
            what = f"correction {turn} of {study.turns}" if turn else "as asked"
            tell(f"{what}: off by {worst:.3g} half ranges")
        log.debug("turn %d: off by %.4g half ranges", turn, worst)
        if turn == study.turns or worst == np.inf or (np.abs(off) <= _near(readings, quantities, mix)).all():
            break
        planes = {
            name: planes[name].through(mix.alpha, value)
            for name, value in zip(readings, read.tolist(), strict=True)
            if name in planes
        }
        at, error = np.array([ask[name] for name in readings])[corrected], off[corrected]
        if before is not None:
            step, change = (at - before[0]) / scale[corrected], error - before[1]
            if (size := float(step @ step)) > 0:
                jacobian = jacobian + np.outer(change - jacobian @ step, step) / size
        before = at, error
        correction = np.linalg.lstsq(jacobian, -error, rcond=1e-3)[0] if len(at) else at
        correction = correction * min(1.0, FARTHEST / max(float(np.abs(correction).max(initial=0)), 1e-300))
        names = [name for name in readings if name not in planes]
        ask |= dict(zip(names, (at + scale[corrected] * correction).tolist(), strict=True))
        posed, mix = _next(solve, ask, readings, planes)
    assert best is not None
    return replace(best[1], expected=_expected(study, quantities.bank, target, readings, best[1].mix))


def _expected(
    study: Study, bank: Bank, target: Mapping[str, float], readings: Mapping[str, Reading], mix: Mix
) -> dict[str, float]:
    """What the bank's own measurements of what is asked should read; not known where the study has another measure."""
    found = {name: _by_exemplars(bank, name, target, mix)[0] for name in target if name in bank.measured_by}
    for name, address in study.measured.items():
        if name in found and name in readings:
            del found[name]
            if address == bank.measured_by[name]:
                found[name] = readings[name].wanted  # as the bank keeps them: in the parameter's unit
    return found


def _next(
    solve: Solve, ask: Mapping[str, float], readings: Mapping[str, Reading], planes: Mapping[str, Plane]
) -> tuple[Posed, Mix]:
    """The mix of the next turn: labels by their planes, as far as one turn goes."""
    steps = {}
    for name, plane in planes.items():
        farthest = FARTHEST * readings[name].column.spread / 2
        steps[name] = plane.value + float(np.clip(readings[name].wanted - plane.value, -farthest, farthest))
    return solve({**ask, **steps}, {name: plane.values for name, plane in planes.items()})


def _planes(study: Study, quantities: Quantities, readings: Mapping[str, Reading]) -> dict[str, Plane]:
    """The labels of which parameters tell something, by planes through what is measured at the start."""
    bank, found = quantities.bank, dict[str, Plane]()
    if not study.turns:
        return found
    n = len(bank)
    start = np.full(n, 1 / n) if study.reference is None else np.eye(n)[bank.names.index(study.reference)]
    for name in readings:
        if name in {q.name for q in bank.label_space}:
            value = quantities.at(name, study.reference, study.measured[name])
            if (plane := explained(bank, name, start, value, quantities.plugins)) is not None:
                found[name] = replace(plane, wanted=readings[name].wanted)
    return found


def _begun(study: Study, quantities: Quantities, target: Mapping[str, float], names: Iterable[str]) -> dict[str, float]:
    """Where the ask begins: what is asked and what is measured for it may lie apart, as they do at the reference."""
    if study.reference is None or not study.turns:
        return {}
    apart = {
        name: quantities.at(name, study.reference) - quantities.at(name, study.reference, study.measured[name])
        for name in names
        if name in study.measured
    }
    return {name: target[name] + by for name, by in apart.items()}


def _near(readings: Mapping[str, Reading], quantities: Quantities, mix: Mix) -> Array:
    """(k,) what is off by no more needs no other turn, which could but follow the noise [half of the bank's range]."""
    found = []
    for r in readings.values():
        error = r.factor * quantities.value(told, mix.alpha) if (told := error_of(r.quantity)) else np.nan
        found.append(WITHIN * error / (r.column.spread / 2))
    near = np.array(found)
    noisy = np.isfinite(near)
    return np.maximum(np.where(noisy, near, BESIDE if noisy.any() else 0.0), CLOSE)


def _read(readings: Mapping[str, Reading], quantities: Quantities, mix: Mix) -> Array:
    return np.array([r.factor * quantities.value(r.quantity, mix.alpha) for r in readings.values()])


def _readings(study: Study, quantities: Quantities, target: Mapping[str, float], mix: Mix) -> dict[str, Reading]:
    bank, found = quantities.bank, dict[str, Reading]()
    for name, address in correctable(study, quantities, target).items():
        column, quantity = quantities[name].column, quantities.measured(address)
        assert column is not None
        scale = factor(quantity.unit, column.unit, f"{address!r} for {name!r}")
        if name not in bank.measured_by or name in study.measured:
            found[name] = Reading(column, quantity, scale, target[name], 1.0)
        else:
            wanted, slope = _by_exemplars(bank, name, target, mix)
            found[name] = Reading(column, quantity, scale, wanted, slope)
    return found


def _by_exemplars(bank: Bank, name: str, target: Mapping[str, float], mix: Mix) -> tuple[float, float]:
    """What should be read at the parameters that are asked for, and its change with `name`.

    What `mix` makes of the exemplars' readings, and by their slopes (least squares over the exemplars) from what it
    reaches to what is asked: a measurement may differ from its parameter by an offset, a factor, and what other
    parameters do to it.
    """
    reached = predicted(bank, mix.alpha)
    asked = np.array([target.get(q.name, reached[k]) for k, q in enumerate(bank.space)])
    values = bank.measured[:, [*bank.measured_by].index(name)]
    spread = np.ptp(bank.parameters, axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    rows = (bank.parameters - bank.parameters.mean(0)) / scale
    slopes = np.linalg.lstsq(rows, values - values.mean(), rcond=1e-8)[0] / scale
    return float(mix.alpha @ values + (asked - reached) @ slopes), float(
        slopes[[q.name for q in bank.space].index(name)]
    )


def told_without_turns(study: Study, name: str) -> bool:
    """Whether what the study declares for `name` is held against the ask without corrections.

    What a reference has is then taken from its label, which may lie apart from what is measured: that tells nothing.
    """
    return name in study.measured and name not in (*study.keep, study.objective and study.objective.name)


def read_checks(study: Study, quantities: Quantities, found: Closed, limits: Limits) -> list[Check]:
    """Whether what the study itself declares measurable was measured as asked; the bank's own are checked for drift.

    A study that stops before a mesh is judged makes no such check: then all that was read is told here.
    """
    others = [] if study.level == "mesh" else [name for name in found.read if name not in study.measured]
    checks = [_drifted(quantities, name, found, limits) for name in others]
    for name, address in study.measured.items():
        told = study.turns or told_without_turns(study, name)
        if told and name in found.read and (column := quantities[name].column) is not None:
            read, wanted = found.read[name], found.wanted[name]
            off = abs(read - wanted) * 2 / column.spread
            note = f"{address} {read:.6g}, asked {wanted:.6g} {column.unit}".rstrip()
            if quantities.outside(quantities.measured(address), found.mix.alpha):
                off, note = float("nan"), f"{note}; {OUTSIDE}"
            checks.append(Check(f"measured.{name}", off, "<=", limits[f"measured.{name}"], "half range", "mesh", note))
    return checks


def _drifted(quantities: Quantities, name: str, found: Closed, limits: Limits) -> Check:
    address = quantities.bank.measured_by[name]
    unit, spread = columns(quantities.bank)[address].unit, columns(quantities.bank)[address].spread
    read, wanted = found.read[name], found.wanted[name]
    limit = limits[f"drift.{name}"] * spread
    note = f"{address} {read:.6g}, wanted {wanted:.6g}"
    return Check(f"drift.{name}", abs(read - wanted), "<=", limit, unit, "mesh", note)
