"""Least squares over alpha under linear requirements: in closed form, or by non-negative least squares.

Equalities go first: alpha = start + basis·y, with basis an orthonormal null space. Inequalities make a least-distance
problem, whose dual is one non-negative least squares (Lawson & Hanson, Solving least squares problems, 1974, chapter
23). It tells which of them hold with equality, and those join the equalities, to machine precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space, solve_triangular
from scipy.optimize import nnls

from lampopt.types import Array

RANK = 1e-10  # singular values below this part of the largest count as zero
FLOOR = 1e-9  # least ridge, as part of the largest row: of all best mixes nearly the nearest
EXACT = 1e-9  # what an answer may be off a limit, or worse than the first one
MUCH = 100.0  # what is gained at most by going 1 beyond a limit, as part of the value
MET = 1e-7  # an answer that is farther off a limit is none


@dataclass(frozen=True, eq=False)
class Lines:
    """low ≤ rows·alpha ≤ high, rows (m, N); targets have low = high."""

    rows: Array
    low: Array
    high: Array

    def off(self, alpha: Array) -> Array:
        """(m,) what has to be added to each target or limit for alpha (N,) to meet it; 0 where it does."""
        values = self.rows @ alpha
        return np.asarray(np.minimum(values - self.low, 0) + np.maximum(values - self.high, 0))

    def worst(self, alpha: Array) -> float:
        """How far alpha is beyond the farthest limit."""
        return float(np.abs(self.off(alpha)).max(initial=0.0))

    def taken(self, chosen: Array) -> Lines:
        """Those that `chosen` (m,) or (c,) selects."""
        return Lines(self.rows[chosen], self.low[chosen], self.high[chosen])

    def joined(self, rows: Array, values: Array) -> Lines:
        """These, and rows·alpha = values."""
        return Lines(np.vstack([self.rows, rows]), np.append(self.low, values), np.append(self.high, values))

    def free(self, near: Array) -> tuple[Array, Array]:
        """For targets: the point nearest to `near` that meets them, an orthonormal basis (N, q) of what is free."""
        at = near
        for _ in range(2):  # the second time for what the first left by rounding
            at = at + np.linalg.lstsq(self.rows, self.low - self.rows @ at, rcond=RANK)[0]
        return at, np.asarray(null_space(self.rows, rcond=RANK))


@dataclass(frozen=True, eq=False)
class Squares:
    """Σ weight·(rows·alpha − target)² + ridge·‖alpha − centre‖².

    Where that leaves freedom, still·alpha stays nearest to still·centre, then alpha to the centre.
    """

    rows: Array
    target: Array
    weight: Array
    ridge: float
    centre: Array
    still: Array

    def __call__(self, alpha: Array) -> float:
        """The value at alpha."""
        off, apart = self.rows @ alpha - self.target, alpha - self.centre
        return float(self.weight @ off**2 + self.ridge * (apart @ apart))

    def gradient(self, alpha: Array) -> Array:
        """Its derivatives (N,)."""
        off = self.rows @ alpha - self.target
        return np.asarray(2 * self.rows.T @ (self.weight * off) + 2 * self.ridge * (alpha - self.centre))

    def curvature(self, axes: Array) -> Array:
        """(q, q) its second derivatives along `axes` (N, q)."""
        along = np.sqrt(self.weight)[:, None] * (self.rows @ axes)
        return np.asarray(2 * (along.T @ along + self.ridge * axes.T @ axes))

    def least(self, equal: Lines) -> Array:
        """Where it is least among what meets the targets `equal`, in closed form."""
        start, basis = equal.free(self.centre)
        alpha = np.asarray(start + basis @ _smallest(*self.system(start, basis, self.ridge), self.size))
        if (then := self.then) is None:
            return alpha
        start, basis = equal.joined(self.rows, self.rows @ alpha).free(alpha)
        return np.asarray(start + basis @ _smallest(*then.system(start, basis, 0.0), then.size))

    def system(self, start: Array, basis: Array, ridge: float) -> tuple[Array, Array]:
        """Matrix and right side whose squares at y are these at start + basis·y."""
        root, damp = np.sqrt(self.weight), np.sqrt(ridge)
        return (
            np.vstack([root[:, None] * self.rows @ basis, damp * np.eye(basis.shape[1])]),
            np.append(root * (self.target - self.rows @ start), damp * (basis.T @ (self.centre - start))),
        )

    @property
    def lengths(self) -> Array:
        """Of the weighted rows."""
        return np.asarray(np.sqrt(self.weight) * np.linalg.norm(self.rows, axis=1))

    @property
    def size(self) -> float:
        """Length of the largest weighted row; what is far below is noise."""
        return float(self.lengths.max(initial=0.0))

    @property
    def then(self) -> Squares | None:
        """What is to be least next, these rows held: the movement of what should stay still."""
        if not len(self.still):
            return None
        rows = self.still - self.still.mean(1, keepdims=True)
        return Squares(rows, rows @ self.centre, np.ones(len(rows)), 0.0, self.centre, self.still[:0])


def _smallest(matrix: Array, right: Array, size: float) -> Array:
    """The least-squares solution of least norm; singular values far below `size` are what others left of a row."""
    largest = np.linalg.norm(matrix, 2) if matrix.size else 0.0
    cutoff = max(RANK, RANK * size / largest) if largest > 0 else RANK
    return np.asarray(np.linalg.pinv(matrix, rcond=cutoff) @ right)


def least_squares(squares: Squares, lines: Lines) -> Array | None:
    """Where `squares` is least among what meets `lines`, of such the nearest to the centre; None if nothing does."""
    exact = lines.low == lines.high
    equal, within = lines.taken(exact), lines.taken(~exact)
    alpha = squares.least(equal)
    if equal.worst(alpha) > MET * (1 + np.abs(equal.low).max(initial=0.0)):
        return None
    if within.worst(alpha) <= EXACT:
        return alpha
    found = _within(squares, equal, within)
    if found is not None and (then := squares.then) is not None:
        settled = _within(then, equal.joined(squares.rows, squares.rows @ found), within)
        found = found if settled is None else settled
    return found


def _within(squares: Squares, equal: Lines, within: Lines) -> Array | None:
    start, basis = equal.free(squares.centre)
    lengths = squares.lengths[squares.lengths > 0]
    ridge = max(squares.ridge, FLOOR * float(lengths.min()) ** 2) if len(lengths) else 1.0  # the least counts too
    matrix, right = squares.system(start, basis, ridge)
    above, below = np.isfinite(within.low), np.isfinite(within.high)
    rows = np.vstack([within.rows[above], -within.rows[below]])
    limits = np.append(within.low[above], -within.high[below]) - rows @ start
    found = _least_distance(matrix, right, rows @ basis, limits - EXACT / 10)
    if found is None:
        return None
    y, active = found
    alpha = np.asarray(start + basis @ y)
    beyond = within.worst(alpha)
    better = squares.least(equal.joined(rows[active], (limits + rows @ start)[active]))
    same = squares(better) <= squares(alpha) + (EXACT + MUCH * beyond) * (1 + squares(alpha))
    if same and max(within.worst(better), equal.worst(better)) <= 10 * EXACT:
        return better
    return alpha if beyond <= MET * (1 + np.abs(limits).max(initial=0.0)) else None


def _least_distance(matrix: Array, right: Array, rows: Array, limits: Array) -> tuple[Array, Array] | None:
    """Least ‖matrix·y − right‖ with rows·y ≥ limits, matrix of full rank: y, and which limits press; None if none."""
    if not matrix.shape[1]:
        return None if (limits > EXACT).any() else (np.zeros(0), np.zeros(len(limits), bool))
    q, r = np.linalg.qr(matrix)
    free = solve_triangular(r, q.T @ right)
    slope = solve_triangular(r, rows.T, trans="T")  # (q, m): in z = r (y − free) the rows are these
    gap = limits - rows @ free
    length = np.linalg.norm(slope, axis=0)
    flat = length <= RANK * length.max(initial=0.0)
    if (gap[flat] > EXACT).any():
        return None
    active = np.zeros(len(flat), bool)
    if flat.all():
        return free, active
    slope, gap = slope[:, ~flat] / length[~flat], gap[~flat] / length[~flat]
    scale = np.abs(gap).max(initial=0.0) or 1.0
    press, _ = nnls(np.vstack([slope, gap / scale]), np.append(np.zeros(len(slope)), 1.0), maxiter=100 * len(gap) + 100)
    rest = 1 - gap @ press / scale
    if rest <= 1e-12:
        return None
    active[~flat] = press > 0
    return free + solve_triangular(r, scale * (slope @ press) / rest), active
