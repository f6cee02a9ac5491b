"""How a measured label goes with the parameters: its slopes over the exemplars, and what each measured design teaches.

Mixing reaches nearly every combination of labels without moving the shape as far as the labels say: with more
exemplars than parameters, what parameters do not explain of a label (its curvature, noise) can be mixed at will, and
the least mix does so. A plane through what was measured asks for the part that shapes follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lampopt.types import Array, Bank

EXPLAINED = 0.5  # least R² of a label by the parameters, each exemplar left out in turn


@dataclass(frozen=True, eq=False)
class Plane:
    """A label near one measured design.

    Parameters
    ----------
    parameters
        (N, d) of the exemplars, in parts of their ranges.
    slope
        (d,) the label's.
    at, value
        (d,) the design's parameters, and what was measured there.
    """

    parameters: Array
    slope: Array
    at: Array
    value: float

    def through(self, alpha: Array, value: float) -> Plane:
        """The plane through another design, its slope the nearest that tells both (Broyden, 1965)."""
        at = alpha @ self.parameters
        step = at - self.at
        missed = value - self.value - self.slope @ step
        slope = self.slope + missed * step / size if (size := float(step @ step)) > 0 else self.slope
        return replace(self, slope=slope, at=at, value=value)

    @property
    def values(self) -> Array:
        """(N,) what it says of the exemplars."""
        return np.asarray(self.value + (self.parameters - self.at) @ self.slope)


def ranged_parameters(bank: Bank) -> Array:
    """(N, d) of the exemplars, in parts of their ranges."""
    spread = np.ptp(bank.parameters, axis=0)
    return np.asarray(bank.parameters / np.where(spread > 0, spread, 1.0))


def explained(bank: Bank, label: str) -> Plane | None:
    """The plane of a label over the exemplars; None where the parameters tell too little of it."""
    values = bank.labels[:, [q.name for q in bank.label_space].index(label)]
    parameters, known = ranged_parameters(bank), np.isfinite(values)
    middle, mean = parameters[known].mean(0), float(values[known].mean())
    rows, off = parameters[known] - middle, values[known] - mean
    inverse = np.linalg.pinv(rows, rcond=1e-8)
    share = 1 / len(rows) + np.einsum("nd,dn->n", rows, inverse)  # of its own value in what it is told
    if not (share < 1 - 1e-9).all():
        return None  # no fewer parameters than exemplars
    missed = (off - rows @ inverse @ off) / (1 - share)
    if missed @ missed > (1 - EXPLAINED) * (off @ off):
        return None
    return Plane(parameters, inverse @ off, middle, mean)
