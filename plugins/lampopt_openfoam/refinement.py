"""Grid study: one body on finer and finer grids, and what that says of a grid without error (Richardson)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .drag import Flow
from .grid import CELL, Level

ORDERS = (0.3, 4.0)  # observed orders that are believed; beyond them the theoretical one is used
THEORY = 2.0  # order of the schemes
FACTORS = {"observed": 1.25, "assumed": 3.0}  # Roache's, on the last difference


@dataclass(frozen=True)
class Extrapolated:
    """What three values on cells of three sizes come to.

    Parameters
    ----------
    value
        On cells of size 0, and its uncertainty in `error` (grid convergence index, no statistics in it).
    order
        By which the error falls with the cell size; `kind` says whether it was observed or assumed.
    monotone
        Whether the values go one way.
    message
        In words.
    """

    value: float
    error: float
    order: float
    kind: Literal["observed", "assumed"]
    monotone: bool
    message: str


@dataclass(frozen=True)
class Refined:
    """A grid study: a flow by level, or why there is none, and drag extrapolated from those that there are."""

    flows: dict[Level, Flow]
    failures: dict[Level, str]
    drag: Extrapolated | None


def refined(flows: dict[Level, Flow], failures: dict[Level, str]) -> Refined:
    """The study of what was solved. Extrapolated from three levels."""
    drag = None
    if len(flows) == 3:
        levels = sorted(flows, key=lambda level: -CELL[level])
        drag = richardson([CELL[level] for level in levels], [flows[level].drag for level in levels])
    return Refined(flows, failures, drag)


def richardson(cells: list[float], values: list[float]) -> Extrapolated:
    """Values on cells of three sizes, coarse to fine, extrapolated to none.

    The observed order p solves (f1 − f2)/(f2 − f3) = (h1^p − h2^p)/(h2^p − h3^p). Where the values turn, or no order
    within `ORDERS` does, the schemes' own is assumed, with a larger uncertainty.
    """
    h, f = np.asarray(cells, float), np.asarray(values, float)
    first, last = f[0] - f[1], f[1] - f[2]
    monotone = bool(first * last > 0)
    observed = _order(h, first / last) if monotone else None
    kind: Literal["observed", "assumed"] = "assumed" if observed is None else "observed"
    order = THEORY if observed is None else observed
    ratio = (h[1] / h[2]) ** order
    step = last / (ratio - 1)
    said = f"observed order {order:.2f}" if kind == "observed" else f"order {order:g} assumed: "
    if kind == "assumed":
        said += "no order explains the values" if monotone else "the values do not go one way"
    return Extrapolated(float(f[2] - step), float(FACTORS[kind] * abs(step)), float(order), kind, monotone, said)


def _order(h: np.ndarray, ratio: float) -> float | None:
    from scipy.optimize import brentq

    def off(p: float) -> float:
        return float((h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - ratio)

    low, high = ORDERS
    if off(low) * off(high) > 0:
        return None
    return float(brentq(off, low, high))
