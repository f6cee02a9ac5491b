"""Which sizes are odd: one among many, or groups of files in different units."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import exp, log

import numpy as np

from lampopt.intake.records import Finding, Health
from lampopt.types import Array

FEW = 4  # meshes below which nothing is usual
FACTOR = 5.0  # of the usual size, from which on a size is odd
UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048, "m": 1.0, "km": 1e3}  # [m]
NEAR = 1.6  # factor within which a size is explained by another unit
WILD = 30.0  # of the usual size, from which on no unit is needed to refuse
WIDE = 6.0  # times what is usual among fellows, from which on a difference is odd
TIGHT = 0.2  # what the sizes of a group may differ by, beside how far groups are apart (both as logarithms)
ALIKE = 1.25  # factor within which two groups are a unit apart


def sizes(family: Sequence[Health], unit: str, parameters: Array) -> Iterator[Finding]:
    """Odd sizes in a family with parameters (N, d): one a mesh at the most."""
    kept = [i for i, health in enumerate(family) if diagonal(health) > 0]
    known = [family[i] for i in kept]
    if len(known) < 2:
        return
    logs = np.log([diagonal(h) for h in known])
    if (groups := _groups(logs)) and not _explained(logs, groups, parameters[kept]):
        yield from _mixed(known, logs, groups, unit)
        return
    for i, health in enumerate(known):
        others = np.delete(logs, i) if len(known) < FEW else logs
        usual = float(np.median(others))
        spread = float(np.median(np.abs(others - usual)))
        ratio = exp(logs[i] - usual)
        if abs(log(ratio)) <= max(log(FACTOR), WIDE * spread):
            continue
        if len(known) < FEW and _unit_of(ratio, unit) is None:
            continue  # of two or three, who is to say which is odd
        yield odd(health, exp(usual), unit, "a diagonal near", "as its fellows have")


def odd(health: Health, usual: float, unit: str, what: str, whose: str) -> Finding:
    """A size that is off: refused where another unit explains it or nothing can, doubtful otherwise."""
    ratio = diagonal(health) / usual
    guess = _unit_of(ratio, unit)
    about = f"expected {what} {usual:.3g} {unit}, {whose}, got {diagonal(health):.3g}"
    times = f"{ratio:.3g} times as large" if ratio > 1 else f"{1 / ratio:.3g} times as small"
    if guess is not None:
        why = f"as a file in {guess} among files in {unit}; scale it by {UNITS[guess] / UNITS[unit]:.4g}"
        return Finding(health.name, "size", "refused", f"{about}: {times}, {why}")
    if (unit not in UNITS and _by_a_unit(ratio, NEAR)) or max(ratio, 1 / ratio) > WILD:
        return Finding(health.name, "size", "refused", f"{about}: {times}; is it in another unit? Scale or remove it")
    return Finding(health.name, "size", "doubtful", f"{about}: {times}; look at it, and accept or remove it")


def diagonal(health: Health) -> float:
    """Of the bounding box [unit]."""
    return float(np.linalg.norm(health.extents))


def _groups(logs: Array) -> list[Array]:
    """Tight groups of sizes, units apart, none of them more than half of all; empty where there are none such.

    A median tells the odd ones among many; of halves it lies between, and all is as far from it as is usual.
    """
    order = np.argsort(logs, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(logs[order]) > log(FACTOR) / 2) + 1)
    if len(groups) < 2 or min(map(len, groups)) < 2 or 2 * max(map(len, groups)) > len(logs):
        return []
    middles = [float(np.median(logs[group])) for group in groups]
    apart = [exp(b - a) for a, b in pairwise(middles)]
    widest = max(float(np.ptp(logs[group])) for group in groups)
    tight = widest <= TIGHT * log(min(apart))
    return groups if tight and all(ratio > FACTOR and _by_a_unit(ratio, ALIKE) for ratio in apart) else []


def _explained(logs: Array, groups: list[Array], parameters: Array) -> bool:
    """Whether a parameter tells the groups apart as their sizes do, or as areas or volumes do then."""
    sizes = np.diff([np.median(logs[group]) for group in groups])
    for column in np.abs(parameters).T:
        if (column == 0).any():
            continue
        values = [np.log(column[group]) for group in groups]
        steps = np.diff([np.median(value) for value in values])
        if any((np.abs(steps - power * sizes) <= power * log(ALIKE)).all() for power in (1, 2, 3)):
            return True
    return False


def _mixed(known: Sequence[Health], logs: Array, groups: list[Array], unit: str) -> Iterator[Finding]:
    near = [f"{exp(float(np.median(logs[group]))):.3g}" for group in groups]
    listed = " and ".join(f"{len(group)} near {size} {unit}" for group, size in zip(groups, near, strict=True))
    ratio = exp(float(np.median(logs[groups[-1]]) - np.median(logs[groups[-2]])))
    guess = _unit_of(ratio, unit) or _unit_of(1 / ratio, unit)
    units = f"as files in [{guess}] and [{unit}] have" if guess else "as files in different units have"
    for group in groups:
        for i in group.tolist():
            message = (
                f"expected one unit throughout, got a diagonal of {diagonal(known[i]):.3g} {unit} where diagonals are "
                f"{listed}, {units}; which are right cannot be known: scale the others, or accept by name all that are "
                "meant as they are"
            )
            yield Finding(known[i].name, "size", "refused", message)


def _unit_of(ratio: float, unit: str) -> str | None:
    """The unit that a mesh would be in if `ratio` came of taking it to be in `unit`."""
    if unit not in UNITS:
        return None
    away = {other: abs(log(ratio * size / UNITS[unit])) for other, size in UNITS.items() if other != unit}
    best = min(away, key=lambda other: away[other])
    return best if away[best] <= log(NEAR) else None


def _by_a_unit(ratio: float, near: float) -> bool:
    factors = {abs(log(a / b)) for a in UNITS.values() for b in UNITS.values() if a != b}
    return any(abs(abs(log(ratio)) - factor) <= log(near) for factor in factors)
