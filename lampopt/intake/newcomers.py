"""Exemplars that come to a bank later, held against what it knows of its own.

A bank keeps no meshes: it knows how large the largest is (the frame), how measured values follow from parameters, and
how many bodies and through-holes all have. Which way its shapes face it can tell only by what is measured.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from math import log

import numpy as np

from lampopt.intake.records import Finding, Health
from lampopt.intake.sizes import FACTOR, diagonal, odd
from lampopt.measured import FOLLOWS, follows
from lampopt.types import Array, Bank

OFF = 0.25  # of what a value varies by, up to which newcomers may differ from what the bank's own lead to expect
WORSE = 3.0  # times the largest difference among the bank's own
ROOM = 0.05  # least part of the box, on each side, that a newcomer leaves free


def fitting(bank: Bank, box: Array, health: Sequence[Health]) -> Iterator[Finding]:
    """Refuse meshes that the `box` (2, 3) of the decoder would cut, or nearly."""
    low, high = np.asarray(box, float)
    room = ROOM * (high - low)
    least, most = ((corner / bank.frame.scale + bank.frame.centre) for corner in (low + room, high - room))
    for one in health:
        half = np.array(one.extents) / 2
        below, above = one.centre - half, one.centre + half
        if (below < least).any() or (above > most).any():
            between, got = (
                f"{np.round(a, 6).tolist()} and {np.round(b, 6).tolist()} {bank.frame.unit}"
                for a, b in ((least, most), (below, above))
            )
            message = (
                f"too large or too far off for this bank: expected a mesh between {between}, got one between {got}"
            )
            message += ": build the bank anew with it among the exemplars"
            yield Finding(one.name, "frame", "refused", message)


def sized(bank: Bank, reach: float, health: Sequence[Health], known: Collection[str]) -> Iterator[Finding]:
    """Those far off the size of the bank's largest, which reaches `reach` [unit] from its middle to a side.

    The `known` ones have lengths that agree with their parameters: their sizes are explained.
    """
    for one in health:
        ratio = max(one.extents) / (2 * reach)
        if one.name not in known and ratio > 0 and abs(log(ratio)) > log(FACTOR):
            usual = diagonal(one) / ratio
            yield odd(one, usual, bank.frame.unit, "a diagonal up to", "as the bank's own have")


def shaped(bank: Bank, health: Sequence[Health]) -> Iterator[Finding]:
    """Those of other bodies or genus than all of the bank's own have."""
    for what in ("bodies", "genus"):
        if what not in bank.mesh_facts:
            continue
        usual = bank.mesh_facts[what]
        for one in health:
            if (value := getattr(one, what)) != usual:
                got = "an open surface, which has none" if value is None else f"{value}"
                message = f"expected {what} {usual}, as all of the bank's own have, got {got}"
                message += "; mend it, or accept it: then designs are not held to either any more"
                yield Finding(one.name, what, "doubtful", message)


def measured(bank: Bank, names: Sequence[str], parameters: Array, values: Array) -> Iterator[Finding]:
    """Those whose measured `values` (n, m) are not what their `parameters` (n, d) lead to expect."""
    index = {q.name: i for i, q in enumerate(bank.space)}
    for j, (parameter, address) in enumerate(bank.measured_by.items()):
        q = bank.space[index[parameter]]
        own, new = bank.measured[:, j], values[:, j]
        expected, limit = _expected(bank.parameters, own, parameters, index[parameter])
        bad = np.abs(new - expected) > limit
        for i in np.flatnonzero(bad).tolist():
            message = (
                f"expected {address!r} near {expected[i]:.4g} {q.unit} by its parameters, as the bank's own have it, "
                f"got {new[i]:.4g} (off by more than {limit[i]:.3g})"
            )
            hint = "is it turned, in another unit, or of another row? Mend it, or accept it"
            yield Finding(names[i], "measured", "doubtful", f"{message}; {hint}")


def unfollowed(bank: Bank, parameters: Array, values: Array) -> Iterator[str]:
    """Which measured values cease to follow their parameters with newcomers' `values` (n, m), in words."""
    index = {q.name: i for i, q in enumerate(bank.space)}
    every = np.concatenate([bank.parameters, parameters])
    for j, (parameter, address) in enumerate(bank.measured_by.items()):
        before = follows(bank.parameters, index[parameter], bank.measured[:, j])
        r2 = follows(every, index[parameter], np.append(bank.measured[:, j], values[:, j]))
        if r2 < min(FOLLOWS, before):
            yield f"{address!r} does not follow parameter {parameter!r} any more (R² {r2:.2f}, expected {FOLLOWS})"


def _expected(parameters: Array, own: Array, given: Array, index: int) -> tuple[Array, Array]:
    """What values (n,) the bank's `own` (N,) lead to expect at parameters `given` (n, d), and how far off is fine.

    A value that a parameter is measured by is in its unit: it is expected to change as much as the parameter does,
    corrected by a plane through what the bank's own differ from that, where they are enough to tell one.
    """
    count, d = parameters.shape
    middle, spread = parameters.mean(0), np.ptp(parameters, axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    used = spread > 0
    if count < d + 3:
        used = used & (np.arange(d) == index) & (count > 2)
    at, there = (np.column_stack([np.ones(len(p)), ((p - middle) / scale)[:, used]]) for p in (parameters, given))
    plane = np.linalg.lstsq(at, own - parameters[:, index], rcond=None)[0]
    left = float(np.abs(own - parameters[:, index] - at @ plane).max())
    expected = given[:, index] + there @ plane
    beyond = np.maximum(0, np.maximum(own.min() - expected, expected - own.max()))
    varies = float(np.ptp(own)) or float(np.abs(own).max())
    return expected, np.maximum(WORSE * left, OFF * (varies + beyond))
