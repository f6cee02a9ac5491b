"""Weights of many exemplars by few directions: (N, D) as middle + coefficients @ directions, never spread out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lampopt.errors import InputError
from lampopt.types.arrays import Array, assign, frozen_array


@dataclass(frozen=True, eq=False)
class LowRank:
    """Takes the place of an array (N, D) float32 that is mixed, read row by row, or multiplied from the left.

    Parameters
    ----------
    middle
        (D,) float32.
    coefficients
        (N, r) float32.
    directions
        (r, D) float32.
    """

    middle: Array
    coefficients: Array
    directions: Array

    dtype = np.dtype(np.float32)
    ndim = 2
    __array_ufunc__ = None  # so that numpy leaves array @ LowRank to it

    def __post_init__(self) -> None:
        directions = frozen_array(self.directions, "directions", (None, None), np.float32)
        rank, size = directions.shape
        assign(
            self,
            middle=frozen_array(self.middle, "middle", (size,), np.float32),
            coefficients=frozen_array(self.coefficients, "coefficients", (None, rank), np.float32),
            directions=directions,
        )
        largest = np.abs(self.coefficients).sum(1, dtype=float).max(initial=0) * _largest(directions)
        if not largest + _largest(self.middle) < float(np.finfo(np.float32).max):
            raise InputError("weights: expected finite values, got directions and coefficients whose products are none")

    @property
    def shape(self) -> tuple[int, int]:
        """(N, D)."""
        return len(self.coefficients), len(self.middle)

    @property
    def nbytes(self) -> int:
        """What is held."""
        return self.middle.nbytes + self.coefficients.nbytes + self.directions.nbytes

    def __len__(self) -> int:
        return len(self.coefficients)

    def __iter__(self) -> Iterator[Array]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, at: Any) -> Array:
        """Rows by number, slice or mask, and columns, as of an array; spread out."""
        rows, columns = at if isinstance(at, tuple) else (at, slice(None))
        return np.asarray(self.middle[columns] + self.coefficients[rows] @ self.directions[:, columns])

    def __matmul__(self, other: Array) -> Array:
        """(N, D) @ (D,) or (D, k)."""
        other = np.asarray(other)
        if other.shape[0] != len(self.middle):
            raise InputError(f"weights: expected {len(self.middle)} rows to multiply by, got shape {other.shape}")
        return np.asarray(self.coefficients @ (self.directions @ other) + self.middle @ other)

    def __rmatmul__(self, other: Array) -> Array:
        """(N,) or (B, N) @ (N, D): the mix."""
        other = np.asarray(other)
        if other.shape[-1] != len(self):
            raise InputError(f"weights: expected {len(self)} coefficients, got shape {other.shape}")
        return np.asarray((other @ self.coefficients) @ self.directions + other.sum(-1)[..., None] * self.middle)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        """All of it, spread out."""
        if copy is False:
            raise ValueError("weights by few directions are no array yet: a copy is needed")
        return np.asarray(self[:], dtype)


def _largest(values: Array) -> float:
    return max(float(values.max(initial=0)), -float(values.min(initial=0)))
