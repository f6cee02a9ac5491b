"""Two designs compared on the same placements: what a placement does to both cancels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lampopt.errors import InputError

from .drag import Flow

LEVEL = 0.95  # of confidence at which a verdict is given


@dataclass(frozen=True)
class Change:
    """A relative change, design over reference − 1.

    Parameters
    ----------
    value, error
        Mean over the placements, and its standard error.
    low, high
        Student's interval at `LEVEL`.
    p
        How likely a difference as large is where there is none (two-sided t).
    verdict
        "lower", "higher", or "not told apart" at `LEVEL`.
    by_placement
        Of each.
    """

    value: float
    error: float
    low: float
    high: float
    p: float
    verdict: Literal["lower", "higher", "not told apart"]
    by_placement: tuple[float, ...]


@dataclass(frozen=True)
class Paired:
    """`design` held against `reference`: the change of the coefficient, and of it times the frontal area."""

    design: Flow
    reference: Flow
    drag: Change
    drag_area: Change


def paired(design: Flow, reference: Flow) -> Paired:
    """The comparison of two flows, solved alike. Raises InputError unless on two or more common placements."""
    one, other = ({p.number: p for p in flow.placed} for flow in (design, reference))
    common = sorted(set(one) & set(other))
    alike = (design.level, design.half, design.openfoam) == (reference.level, reference.half, reference.openfoam)
    if len(common) < 2 or not alike:
        raise InputError(
            "expected two flows of one level, both of halves or both whole, on two or more common placements, got "
            f"{design.level}, half={design.half}, {len(design.placed)} placements and {reference.level}, "
            f"half={reference.half}, {len(reference.placed)}, {len(common)} of them common"
        )
    ratios = np.array([one[k].drag / other[k].drag for k in common])
    settled = [np.hypot(one[k].drag_error / one[k].drag, other[k].drag_error / other[k].drag) for k in common]
    areas = design.frontal_area / reference.frontal_area
    noise = np.array(settled)
    return Paired(design, reference, change(ratios - 1, noise), change(ratios * areas - 1, noise * areas))


def change(values: np.ndarray, noise: np.ndarray) -> Change:
    """The mean of relative changes by placement (n,), each known to `noise` (n,), with its verdict."""
    from scipy.stats import t

    n = len(values)
    value = float(values.mean())
    error = float(np.sqrt(max(values.var(ddof=1), np.mean(np.square(noise))) / n))
    wide = float(t.ppf(0.5 + LEVEL / 2, n - 1)) * error
    p = float(2 * t.sf(abs(value) / error, n - 1)) if error > 0 else float(value == 0)
    sure = p < 1 - LEVEL
    verdict: Literal["lower", "higher", "not told apart"] = (
        "not told apart" if not sure else "lower" if value < 0 else "higher"
    )
    return Change(value, error, value - wide, value + wide, p, verdict, tuple(values.tolist()))
