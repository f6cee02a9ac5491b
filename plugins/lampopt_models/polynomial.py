"""Polynomials of first and second order: ridge regression, its penalty chosen by leaving each row out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .curve import check_arrays

PENALTIES = np.logspace(-9, 5, 57)  # a row
SHARES = (1.0, 0.3, 0.1, 0.03)  # weight of second-order terms against linear ones
MOST = 40  # parameters whose products are used: beyond, the terms outgrow any table


@dataclass(frozen=True, eq=False)
class Polynomial:
    """constant (1,) + zᵀ slope (d,) + zᵀ bend (d, d) z; `bend` is symmetric."""

    constant: Array
    slope: Array
    bend: Array

    kind: ClassVar[str] = "polynomial"

    def __post_init__(self) -> None:
        check_arrays(self, constant=(1,), slope=(None,))
        check_arrays(self, bend=(len(self.slope), len(self.slope)))

    def check_inputs(self, d: int) -> None:
        """Raise InputError if it is not of d parameters."""
        if len(self.slope) != d:
            raise InputError(f"slope: expected {d} parameters, got {len(self.slope)}")

    def __call__(self, z: Array) -> Array:
        """Values (B,) at (B, d)."""
        values: Array = self.constant + z @ self.slope + ((z @ self.bend) * z).sum(axis=1)
        return values

    def gradient(self, z: Array) -> Array:
        """Derivatives (B, d) at (B, d)."""
        slopes: Array = self.slope + 2 * z @ self.bend
        return slopes

    def deviation(self, z: Array) -> Array:
        """(B,) ones: it knows of no place that is less certain."""
        return np.ones(len(z))

    def symbolic(self, z: Any) -> Any:
        """The value as a CasADi expression of z (d,)."""
        import casadi

        bend, slope = casadi.DM(self.bend), casadi.DM(self.slope)
        return float(self.constant[0]) + casadi.dot(slope, z) + casadi.dot(z, casadi.mtimes(bend, z))

    def state(self) -> Mapping[str, Array]:
        """Its arrays."""
        return {"constant": self.constant, "slope": self.slope, "bend": self.bend}


def constant(value: float, d: int) -> Polynomial:
    """What is learned of a label that is the same everywhere."""
    return Polynomial(np.array([value]), np.zeros(d), np.zeros((d, d)))


def second_order(z: Array) -> Array:
    """Squares and products (n, d (d + 1) / 2) of z (n, d); squares alone where d is large."""
    d = z.shape[1]
    first, second = np.triu_indices(d) if d <= MOST else (np.arange(d), np.arange(d))
    products: Array = z[:, first] * z[:, second]
    return products


def ridge(terms: Array, y: Array) -> tuple[Array, float]:
    """Coefficients of centred terms (n, m), and the mean square that they miss rows by that are left out.

    The penalty is the one of `PENALTIES` that misses least, each row left out in closed form: with the hat matrix H,
    row i is missed by residual / (1 − H_ii) (Allen, PRESS, 1974).
    """
    n = len(y)
    left, singular, right = np.linalg.svd(terms, full_matrices=False)
    shrunk = singular**2 / (singular**2 + n * PENALTIES[:, None])  # (penalties, m)
    projected = left.T @ y
    residual = y - (shrunk * projected) @ left.T
    kept = 1 - 1 / n - shrunk @ (left**2).T
    missed = ((residual / np.maximum(kept, 1e-13)) ** 2).mean(axis=1)
    best = int(missed.argmin())
    inverse = np.divide(shrunk[best], singular, out=np.zeros_like(singular), where=singular > 0)
    return right.T @ (inverse * projected), float(missed[best])


def polynomial(z: Array, y: Array, shares: Sequence[float]) -> Polynomial:
    """The polynomial through y (n,) at z (n, d): linear without `shares`, else with the best of these weights."""
    d, scale = z.shape[1], y.std()
    middle, target = z.mean(axis=0), (y - y.mean()) / scale
    products = second_order(z) if shares else np.zeros((len(z), 0))
    typical = products.mean(axis=0)
    found = []
    for share in shares or (0.0,):
        coefficients, missed = ridge(np.hstack([z - middle, share * (products - typical)]), target)
        found.append((missed, coefficients * np.append(np.ones(d), np.full(products.shape[1], share))))
    _, coefficients = min(found, key=lambda pair: pair[0])
    slope, second = scale * coefficients[:d], scale * coefficients[d:]
    bend = np.zeros((d, d))
    if shares:
        bend[np.triu_indices(d) if d <= MOST else np.diag_indices(d)] = second
    return Polynomial(np.array([y.mean() - middle @ slope - typical @ second]), slope, (bend + bend.T) / 2)
