"""Grid study: one body on finer and finer grids, and what that says of a grid without error (Richardson)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .drag import Flow
from .grid import CELL, Level

LEAST = 0.5  # observed order that is believed; below it the extrapolation is as large as the grid's own error
MOST = 20.0  # order that is sought
THEORY = 2.0  # order of the schemes: an observed one beyond it is chance
FACTORS = {"observed": 1.25, "assumed": 3.0}  # Roache's, on the last difference
APART = 2.0  # standard errors by which two levels differ, or their difference tells no order


@dataclass(frozen=True)
class Extrapolated:
    """What three values on cells of three sizes come to.

    Parameters
    ----------
    value
        On cells of size 0.
    error
        Its uncertainty by the grids (grid convergence index); where no order is observed no less than half of the
        values' range.
    noise
        Its standard error by those of the three values, at this order.
    order
        By which the error falls with the cell size; `kind` says whether it was observed or assumed.
    monotone
        Whether the values go one way.
    message
        In words.
    """

    value: float
    error: float
    noise: float
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
        found = [flows[level] for level in levels]
        drag = richardson([CELL[level] for level in levels], [f.drag for f in found], [f.drag_error for f in found])
    return Refined(flows, failures, drag)


def richardson(cells: list[float], values: list[float], errors: list[float]) -> Extrapolated:
    """Values on cells of three sizes, coarse to fine, each with its standard error, extrapolated to none.

    The observed order p solves (f1 − f2)/(f2 − f3) = (h1^p − h2^p)/(h2^p − h3^p). Where the values turn, differ by no
    more than their noise, or no order explains them, the schemes' own is assumed, with a larger uncertainty.
    """
    h, f, e = (np.asarray(given, float) for given in (cells, values, errors))
    first, last = f[0] - f[1], f[1] - f[2]
    monotone = bool(first * last > 0)
    told = bool((np.abs([first, last]) > APART * np.hypot(e[:2], e[1:])).all())
    observed = _order(h, first / last) if monotone and told else None
    kind: Literal["observed", "assumed"] = "assumed" if observed is None else "observed"
    order = THEORY if observed is None else min(observed, THEORY)
    share = 1 / ((h[1] / h[2]) ** order - 1)
    error = FACTORS[kind] * abs(share * last)
    if observed is None:
        error = max(error, float(np.ptp(f)) / 2)
        why = "the values do not go one way" if not monotone else "no order explains the values"
        said = f"order {order:g} assumed: {'the levels do not differ beyond their noise' if not told else why}"
    else:
        said = f"observed order {observed:.2f}" + (f", taken as {order:g}" if observed > order else "")
    noise = float(np.hypot((1 + share) * e[2], share * e[1]))
    return Extrapolated(float(f[2] - share * last), float(error), noise, float(order), kind, monotone, said)


def _order(h: np.ndarray, ratio: float) -> float | None:
    """The order that explains the differences' ratio; infinite beyond all that are sought, None below `LEAST`."""
    from scipy.optimize import brentq

    def off(p: float) -> float:
        return float((h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - ratio)

    if off(LEAST) > 0:
        return None
    return float(brentq(off, LEAST, MOST)) if off(MOST) > 0 else np.inf
