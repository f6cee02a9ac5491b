"""A cubic B-spline lattice: a smooth displacement of space, linear in its coefficients.

u(x) = Σ_k B_k(x) c_k over the nodes k of a regular grid, B_k the tensor product of three cardinal cubic B-splines
(de Boor 2001; free-form deformation as in Rueckert et al. 1999). Any affine map is among its displacements.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np

from lampopt.types import Array

Sparse = Any  # scipy.sparse.csr_array, which has no stubs
QUADRATURE = 4  # Gauss points a span: exact for products of cubics


@dataclass(frozen=True, eq=False)
class Lattice:
    """`spans` (3,) cells of edge `cell` from the corner `low` (3,) on; one basis function more a side and axis."""

    low: Array
    cell: float
    spans: Array

    @classmethod
    def around(cls, points: Array, cell: float, margin: float) -> Lattice:
        """The lattice whose cells cover the box of `points` (M, 3) with `margin` around it, centred on it."""
        low, high = points.min(0) - margin, points.max(0) + margin
        spans = np.maximum(np.ceil((high - low) / cell - 1e-9).astype(int), 1)
        return cls((low + high - spans * cell) / 2, cell, spans)

    @property
    def high(self) -> Array:
        """(3,) the corner opposite to `low`."""
        return self.low + self.spans * self.cell

    @property
    def count(self) -> Array:
        """(3,) basis functions by axis."""
        return self.spans + 3

    @property
    def size(self) -> int:
        """How many basis functions there are."""
        return int(np.prod(self.count))

    @cached_property
    def nodes(self) -> Array:
        """(size, 3) where the functions are centred: with their coordinates as coefficients, u(x) = x."""
        axes = [self.low[k] + self.cell * (np.arange(self.count[k]) - 1) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def rows(self, points: Array, derivative: int | None = None) -> Sparse:
        """(M, size) values of the functions at `points` (M, 3), or their derivatives along an axis.

        Beyond the lattice the outermost cells' polynomials go on.
        """
        from scipy.sparse import csr_array

        at = (points - self.low) / self.cell
        span = np.clip(np.floor(at).astype(np.int64), 0, self.spans - 1)
        values = [_values(at[:, k] - span[:, k], 1 if k == derivative else 0) for k in range(3)]
        if derivative is not None:
            values[derivative] = values[derivative] / self.cell
        which = [span[:, k, None] + np.arange(4) for k in range(3)]
        weights = values[0][:, :, None, None] * values[1][:, None, :, None] * values[2][:, None, None, :]
        _, ny, nz = self.count
        index = (which[0][:, :, None, None] * ny + which[1][:, None, :, None]) * nz + which[2][:, None, None, :]
        shape = (len(points), self.size)
        return csr_array((weights.ravel(), index.ravel(), np.arange(0, weights.size + 1, 64)), shape=shape)

    def displacement(self, points: Array, coefficients: Array) -> Array:
        """(M, 3) u at `points` (M, 3) within the lattice, without its matrix: for many points and one motion."""
        from scipy.ndimage import map_coordinates

        at = ((points - self.low) / self.cell + 1).T
        grids = np.moveaxis(coefficients.reshape(*self.count, 3), -1, 0)
        return np.stack([map_coordinates(grid, at, order=3, mode="nearest", prefilter=False) for grid in grids], -1)

    def bending(self) -> Sparse:
        """(size, size) the quadratic form of ∫ |∂²u|² over the lattice, of one coordinate: 0 for affine u alone."""
        from scipy.sparse import csr_array, kron

        total = csr_array((self.size, self.size))
        for one, other in itertools.product(range(3), repeat=2):  # ∂²u / ∂one ∂other
            orders = np.bincount([one, other], minlength=3)
            total = total + reduce(kron, [self._gram(axis, int(order)) for axis, order in enumerate(orders)])
        return csr_array(total)

    def _gram(self, axis: int, order: int) -> Sparse:
        """∫ of the products of the functions' derivatives along one axis."""
        from scipy.sparse import csr_array

        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        values = _values((nodes + 1) / 2, order) / self.cell**order
        span = np.einsum("q,qi,qj->ij", weights / 2 * self.cell, values, values)
        gram = np.zeros((self.count[axis],) * 2)
        for first in range(self.spans[axis]):
            gram[first : first + 4, first : first + 4] += span
        return csr_array(gram)


def _values(t: Array, order: int) -> Array:
    """(n, 4) the four cubics of a span, or their first or second derivatives, at t (n,) in units of the span."""
    if order == 0:
        parts = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    elif order == 1:
        parts = [-3 * (1 - t) ** 2, 9 * t**2 - 12 * t, -9 * t**2 + 6 * t + 3, 3 * t**2]
    else:
        parts = [6 * (1 - t), 18 * t - 12, -18 * t + 6, 6 * t]
    return np.stack(parts, -1) / 6


@dataclass(frozen=True, eq=False)
class Refined:
    """A lattice, and of the one with half its cells those functions that are `chosen` (k,): finer where it is asked."""

    coarse: Lattice
    chosen: Array

    @cached_property
    def fine(self) -> Lattice:
        """The lattice with half the cells, all of its functions."""
        return Lattice(self.coarse.low, self.coarse.cell / 2, 2 * self.coarse.spans)

    @property
    def size(self) -> int:
        """How many functions there are: the coarse ones first."""
        return self.coarse.size + len(self.chosen)

    def rows(self, points: Array, derivative: int | None = None) -> Sparse:
        """(M, size) as `Lattice.rows`."""
        from scipy.sparse import csr_array, hstack

        coarse = self.coarse.rows(points, derivative)
        if not len(self.chosen):
            return coarse
        return csr_array(hstack([coarse, self.fine.rows(points, derivative)[:, self.chosen]]))

    def displacement(self, points: Array, coefficients: Array) -> Array:
        """(M, 3) as `Lattice.displacement`."""
        coarse, fine = np.split(coefficients, [self.coarse.size])
        moved = self.coarse.displacement(points, coarse)
        if len(self.chosen):
            everywhere = np.zeros((self.fine.size, 3))
            everywhere[self.chosen] = fine
            moved += self.fine.displacement(points, everywhere)
        return moved

    def bending(self) -> Sparse:
        """(size, size) as `Lattice.bending`, of all functions together."""
        from scipy.sparse import csr_array, eye_array, hstack

        if not len(self.chosen):
            return self.coarse.bending()
        finer = csr_array(reduce(_kron, [_halved(int(n)) for n in self.coarse.count]))  # coarse functions by fine ones
        span = csr_array(hstack([finer, eye_array(self.fine.size, format="csr")[:, self.chosen]]))
        return csr_array(span.T @ self.fine.bending() @ span)

    def affine(self, values: Array) -> Array:
        """(size, 3) coefficients of the affine displacement that is `values` (coarse size, 3) at the coarse nodes."""
        return np.concatenate([values, np.zeros((len(self.chosen), 3))])

    def mirrored(self, axis: int) -> Array:
        """(size,) which function each one becomes when space is mirrored along `axis` about the lattice's middle."""
        coarse = np.flip(np.arange(self.coarse.size).reshape(self.coarse.count), axis).ravel()
        fine = np.flip(np.arange(self.fine.size).reshape(self.fine.count), axis).ravel()
        place = np.full(self.fine.size, -1)
        place[self.chosen] = np.arange(len(self.chosen))
        return np.concatenate([coarse, self.coarse.size + place[fine[self.chosen]]])

    def where(self, points: Array) -> Array:
        """Which fine functions have most of their weight where `points` (M, 3) are: those about the points' cells."""
        at = np.floor((points - self.fine.low) / self.fine.cell).astype(np.int64)
        at = np.unique(np.clip(at, 0, self.fine.spans - 1), axis=0)
        corners = np.stack(np.meshgrid([1, 2], [1, 2], [1, 2], indexing="ij"), -1).reshape(8, 3)
        near = (at[:, None] + corners).reshape(-1, 3)
        return np.unique(np.ravel_multi_index(tuple(near.T), tuple(self.fine.count)))


def _kron(one: Sparse, other: Sparse) -> Sparse:
    from scipy.sparse import kron

    return kron(one, other, format="csr")


def _halved(count: int) -> Sparse:
    """(2 count − 3, count) a function of one axis by those of half the cell: 1, 4, 6, 4, 1 eighths."""
    from scipy.sparse import coo_array, csr_array

    fine, coarse = 2 * (count - 3) + 3, np.arange(count)
    row = 2 * coarse[:, None] - 3 + np.arange(5)
    weights = np.broadcast_to(np.array([1, 4, 6, 4, 1]) / 8, row.shape)
    inside = (row >= 0) & (row < fine)
    column = np.broadcast_to(coarse[:, None], row.shape)
    return csr_array(coo_array((weights[inside], (row[inside], column[inside])), shape=(fine, count)))
