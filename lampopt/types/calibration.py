"""Where a bank's limits come from: designs of known error, and what the checks said of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError
from lampopt.types.arrays import Array, assign, frozen_array, unique


@dataclass(frozen=True, eq=False)
class Calibration:
    """The evidence behind calibrated limits: held-out exemplars made by the others (`lampopt.calibrate`).

    Parameters
    ----------
    tolerance
        The error up to which a design is good [the bank's length unit].
    checks
        The k checks that were looked at.
    values
        (B, k) what they said of each design, in the checks' units; NaN where one said nothing.
    errors
        (B,) mean distance between the design's surface and the true one [the bank's length unit]; NaN where there was
        no surface.
    exemplars
        (B,) which exemplar was held out and asked for.
    """

    tolerance: float
    checks: tuple[str, ...]
    values: Array
    errors: Array
    exemplars: Array

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance) and self.tolerance > 0):
            raise InputError(f"calibration: expected a positive tolerance, got {self.tolerance}")
        unique(self.checks, "check")
        errors = frozen_array(self.errors, "calibration errors", (None,), nan=True)
        assign(
            self,
            tolerance=float(self.tolerance),
            checks=tuple(self.checks),
            values=frozen_array(self.values, "calibration values", (len(errors), len(self.checks)), nan=True),
            errors=errors,
            exemplars=frozen_array(self.exemplars, "calibration exemplars", (len(errors),), np.int64),
        )

    @property
    def good(self) -> Array:
        """(B,) which designs kept to the tolerance; none without a surface did."""
        return np.asarray(self.errors <= self.tolerance)
