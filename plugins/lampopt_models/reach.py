"""What a model was not trained on: how far parameters lie beyond those that it has seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .curve import check_arrays, check_range

MARGIN = 3.0  # mean gaps between neighbouring rows: one more row falls beyond an end by so much once in e³ = 20 times
RANK = 1e-6  # of the largest singular value
FAR = 1e100  # where there is no limit; a file holds finite numbers
STEEPEST = 1e10  # an axis: 1 / (RANK × deviation)


@dataclass(frozen=True, eq=False)
class Reach:
    """Where n rows of d parameters lie: a box, and an ellipsoid within the flat that they span.

    Parameters
    ----------
    low, high
        (d,) their range, three mean gaps wider at each end.
    axes
        (r, d) directions that they vary in, each divided by its singular value [scaled parameters].
    limits
        (3,) 1 / n; the largest leverage of a row on the model of all others;
        the farthest from their flat. Both 1e100 where there are too few rows to tell.
    """

    low: Array
    high: Array
    axes: Array
    limits: Array

    def __post_init__(self) -> None:
        check_arrays(self, low=(None,), limits=(3,))
        check_arrays(self, high=(len(self.low),), axes=(None, len(self.low)))
        check_range("axes", self.axes, -STEEPEST, STEEPEST)
        if len(self.axes) > len(self.low):
            raise InputError(f"axes: expected at most {len(self.low)}, got {len(self.axes)}")

    @classmethod
    def of(cls, parameters: Array, z: Array) -> Reach:
        """The reach of parameters (n, d), which are z (n, d) when scaled."""
        n = len(parameters)
        low, high = parameters.min(axis=0), parameters.max(axis=0)
        margin = MARGIN / n * (high - low) + 1e-9 * np.maximum(np.abs(low), np.abs(high))
        left, singular, right = np.linalg.svd(z, full_matrices=False)
        used = singular > RANK * singular.max(initial=0.0)
        leverage = 1 / n + (left[:, used] ** 2).sum(axis=1)
        told = used.sum() < n - 1
        farthest = (leverage / np.maximum(1 - leverage, 1e-12)).max() if told else FAR
        off = np.linalg.norm(z - z @ right[used].T @ right[used], axis=1).max()
        limits = np.array([1 / n, farthest, 3 * off + RANK if told else FAR])
        return cls(low - margin, high + margin, right[used] / singular[used, None], limits)

    def outside(self, parameters: Array, z: Array) -> Array:
        """(B,) whether parameters (B, d), which are z (B, d) when scaled, lie beyond the box, ellipsoid or flat."""
        beyond = ((parameters < self.low) | (parameters > self.high)).any(axis=1)
        along = z @ self.axes.T
        leverage = self.limits[0] + (along**2).sum(axis=1)
        flat = self.axes / np.maximum((self.axes**2).sum(axis=1, keepdims=True), 1e-300)
        off = np.linalg.norm(z - along @ flat, axis=1)
        found: Array = beyond | (leverage > self.limits[1]) | (off > self.limits[2])
        return found

    def state(self) -> Mapping[str, Array]:
        """Its arrays."""
        return {"low": self.low, "high": self.high, "axes": self.axes, "limits": self.limits}
