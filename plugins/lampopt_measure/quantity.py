"""Numbers that know how they change with a mesh's vertices, and the arithmetic that keeps it so."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from lampopt.types import Array

MANY = 2000  # vertices from which on repeated ones are added up, lest long formulas grow
ARITHMETIC: Mapping[np.ufunc, Callable[[Any, Any], Any]] = MappingProxyType(  # what a numpy number asks for beside one
    {np.add: operator.add, np.subtract: operator.sub, np.multiply: operator.mul, np.true_divide: operator.truediv}
)


@dataclass(frozen=True, eq=False)
class Quantity:
    """A number with its derivative by the vertices it depends on. Compared by `<`, `<=`, `>`, `>=` it is its value.

    Parameters
    ----------
    value
        The number.
    rows
        (k,) vertices; one may occur several times, its slopes then add up.
    slopes
        (k, 3) derivative by each one's position.
    """

    value: float
    rows: Array
    slopes: Array

    def gradient(self, vertices: int) -> Array:
        """The derivative by all of a mesh's `vertices`, (V, 3)."""
        gradient = np.empty((vertices, 3))
        for axis in range(3):
            gradient[:, axis] = np.bincount(self.rows, self.slopes[:, axis], vertices)
        return gradient

    def collected(self) -> Quantity:
        """The same with every vertex once."""
        rows, place = np.unique(self.rows, return_inverse=True)
        slopes = np.stack([np.bincount(place, self.slopes[:, axis], len(rows)) for axis in range(3)], axis=1)
        return Quantity(self.value, rows, slopes)

    def __float__(self) -> float:
        return self.value

    def __lt__(self, other: Number) -> bool:
        return self.value < float(other)

    def __le__(self, other: Number) -> bool:
        return self.value <= float(other)

    def __gt__(self, other: Number) -> bool:
        return self.value > float(other)

    def __ge__(self, other: Number) -> bool:
        return self.value >= float(other)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **_: Any) -> Quantity:
        if method == "__call__" and ufunc in ARITHMETIC and all(np.ndim(part) == 0 for part in inputs[:2]):
            first, second = (part if isinstance(part, Quantity) else float(part) for part in inputs)
            made: Quantity = ARITHMETIC[ufunc](first, second)
            return made
        raise TypeError(
            f"np.{ufunc.__name__}: keeps no derivative of a quantity; of lampopt_measure.pieces take sqrt, atan2, "
            "minimum, maximum, mean, median and + - * / **, or float(...) for a plain number"
        )

    def __add__(self, other: Number) -> Quantity:
        return combined(self.value + float(other), (self, 1.0), (other, 1.0))

    __radd__ = __add__

    def __sub__(self, other: Number) -> Quantity:
        return combined(self.value - float(other), (self, 1.0), (other, -1.0))

    def __rsub__(self, other: Number) -> Quantity:
        return -self + other

    def __mul__(self, other: Number) -> Quantity:
        return combined(self.value * float(other), (self, float(other)), (other, self.value))

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Quantity:
        below = float(other)
        return combined(self.value / below, (self, 1 / below), (other, -self.value / below**2))

    def __rtruediv__(self, other: Number) -> Quantity:
        return combined(float(other) / self.value, (self, -float(other) / self.value**2), (other, 1 / self.value))

    def __pow__(self, power: float) -> Quantity:
        if self.value < 0 and power != int(power):
            raise ValueError(f"expected a base of at least 0 for the power {power:g}, got {self.value:.6g}")
        return combined(self.value**power, (self, power * self.value ** (power - 1)))

    def __neg__(self) -> Quantity:
        return combined(-self.value, (self, -1.0))

    def __abs__(self) -> Quantity:
        return combined(abs(self.value), (self, math.copysign(1.0, self.value)))


Number = Quantity | float


def combined(value: float, *parts: tuple[Number, float]) -> Quantity:
    """`value`, whose derivative by each part is the number beside it; plain numbers do not change."""
    moving = [(part, by) for part, by in parts if isinstance(part, Quantity) and by != 0]
    if not moving:
        return Quantity(float(value), np.zeros(0, np.int64), np.zeros((0, 3)))
    rows = np.concatenate([part.rows for part, _ in moving])
    with np.errstate(invalid="ignore"):  # infinite slopes, of a root at 0, are refused when a gradient is asked for
        made = Quantity(float(value), rows, np.concatenate([by * part.slopes for part, by in moving]))
    return made.collected() if len(rows) > MANY else made


def sqrt(number: Number) -> Quantity:
    """Square root; at 0 it has no derivative (infinite slopes, which `gradient` refuses)."""
    root = math.sqrt(float(number))
    return combined(root, (number, 0.5 / root if root else math.inf))


def atan2(opposite: Number, adjacent: Number) -> Quantity:
    """Angle of the direction (adjacent, opposite) [deg], −180 to 180."""
    y, x = float(opposite), float(adjacent)
    by = math.degrees(1 / (x * x + y * y)) if x or y else math.inf
    return combined(math.degrees(math.atan2(y, x)), (opposite, by * x), (adjacent, -by * y))


def mean(numbers: Sequence[Number]) -> Quantity:
    """Arithmetic mean."""
    return combined(math.fsum(map(float, numbers)) / len(numbers), *((n, 1 / len(numbers)) for n in numbers))


def median(numbers: Sequence[Number]) -> Quantity:
    """The middle one; of an even count the mean of the two in the middle."""
    order = sorted(range(len(numbers)), key=lambda i: float(numbers[i]))
    half = len(order) // 2
    return mean([numbers[i] for i in (order[half : half + 1] if len(order) % 2 else order[half - 1 : half + 1])])


def minimum(*numbers: Number) -> Quantity:
    """The smallest; the first of equals speaks for the derivative."""
    return combined(0.0) + min(numbers, key=float)


def maximum(*numbers: Number) -> Quantity:
    """The largest; the first of equals speaks for the derivative."""
    return combined(0.0) + max(numbers, key=float)
