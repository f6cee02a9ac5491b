"""One label as a function of scaled parameters: what the models of this package are made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from lampopt.types import Array, frozen_array


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


@runtime_checkable
class SymbolicCurve(Curve, Protocol):
    """A curve that exists as a CasADi expression."""

    def symbolic(self, z: Any) -> Any:
        """The value as an expression of scaled parameters (d,)."""


def check_arrays(record: object, **shapes: tuple[int | None, ...]) -> None:
    """Make named fields of a frozen record read-only arrays of these shapes (None: any length), finite.

    Raises
    ------
    InputError
        If one is not.
    """
    for name, shape in shapes.items():
        array = np.asarray(getattr(record, name))
        object.__setattr__(record, name, frozen_array(np.ascontiguousarray(array), name, shape, array.dtype))
