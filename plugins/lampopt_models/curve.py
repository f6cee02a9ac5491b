"""One label as a function of scaled parameters: what the models of this package are made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, frozen_array

VAST = 1e130  # no fit writes more, and what is computed of such numbers is still a number


class Curve(Protocol):
    """One label as a function of d scaled parameters."""

    kind: ClassVar[str]

    def __call__(self, z: Array) -> Array:
        """Values (B,) at (B, d)."""

    def gradient(self, z: Array) -> Array:
        """Derivatives (B, d) at (B, d)."""

    def deviation(self, z: Array) -> Array:
        """(B,) how uncertain the values are, in relation to each other."""

    def state(self) -> Mapping[str, Array]:
        """Everything it holds: ``cls(**state)`` makes it again."""

    def check_inputs(self, d: int) -> None:
        """Raise InputError if it is not of d parameters."""


@runtime_checkable
class SymbolicCurve(Curve, Protocol):
    """A curve that exists as a CasADi expression."""

    def symbolic(self, z: Any) -> Any:
        """The value as an expression of scaled parameters (d,)."""


def check_arrays(record: object, *, nan: bool = False, **shapes: tuple[int | None, ...]) -> None:
    """Make named fields of a frozen record read-only arrays of numbers of these shapes (None: any length).

    Raises
    ------
    InputError
        If one is not, or holds what is not finite, unless `nan` allows gaps, or is larger than any fit writes.
    """
    for name, shape in shapes.items():
        array = frozen_array(np.ascontiguousarray(getattr(record, name)), name, shape, np.float64, nan=nan)
        check_range(name, array, -VAST, VAST)
        object.__setattr__(record, name, array)


def check_indices(record: object, **shapes: tuple[int | None, ...]) -> None:
    """As `check_arrays`, for whole numbers. Raises InputError."""
    for name, shape in shapes.items():
        array = np.ascontiguousarray(getattr(record, name))
        if array.dtype.kind not in "iu":
            raise InputError(f"{name}: expected whole numbers, got {array.dtype}")
        object.__setattr__(record, name, frozen_array(array, name, shape, array.dtype))


def check_range(name: str, array: Array, low: float, high: float) -> None:
    """Raise InputError if a value lies beyond `low` or `high`; gaps do not."""
    if ((array < low) | (array > high)).any():
        raise InputError(f"{name}: expected values from {low:g} to {high:g}, got some beyond")
