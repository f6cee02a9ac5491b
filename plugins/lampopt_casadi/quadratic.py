"""Least squares over alpha with equalities and inequalities.

Equalities go first: alpha = start + basis·y, with basis an orthonormal null space, so that they hold exactly. Where
the least squares that are left meet the inequalities, they are the answer; else a quadratic program (DAQP or
IPOPT, through CasADi) tells which inequalities hold with equality, and those join the equalities, to machine precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from scipy.linalg import null_space

from lampopt.errors import SolveError
from lampopt.types import Array

RANK = 1e-10  # singular values below this part of the largest count as zero
ACTIVE = 1e-6  # an inequality this near to its limit may hold with equality
# An active set, exact and quick; it needs a hessian without free directions.
ACTIVE_SET: dict[str, Any] = {"daqp": {"primal_tol": 1e-11, "dual_tol": 1e-11}}
# An interior point takes everything that has an inside, and ends a little apart from the limits.
INTERIOR: dict[str, Any] = {
    "nlpsol": "ipopt",
    "nlpsol_options": {
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "bound_relax_factor": 0.0, "max_iter": 500},
        "print_time": False,
        "error_on_fail": False,
    },
}
DEFINITE = 1e-8  # least eigenvalue of a hessian, in parts of the largest, for the active set
ROOM = 1e-7  # that limits give where nothing else helps
EXACT = 1e-9  # what the polished answer may be off a limit, or worse than the program's


@dataclass(frozen=True, eq=False)
class Inequalities:
    """low ≤ rows·alpha ≤ high, with rows (m, N)."""

    rows: Array
    low: Array
    high: Array

    def worst(self, alpha: Array) -> float:
        """How far alpha is beyond the farthest limit."""
        values = self.rows @ alpha
        return float(np.maximum(self.low - values, values - self.high).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class Equalities:
    """rows·alpha = values, with rows (e, N)."""

    rows: Array
    values: Array

    def free(self, near: Array) -> tuple[Array, Array]:
        """The point nearest to `near` that meets them (N,), and an orthonormal basis (N, q) of what stays free."""
        step = np.linalg.lstsq(self.rows, self.values - self.rows @ near, rcond=RANK)[0]
        return near + step, np.asarray(null_space(self.rows, rcond=RANK))

    def joined(self, rows: Array, values: Array) -> Equalities:
        """These and others."""
        return Equalities(np.vstack([self.rows, rows]), np.concatenate([self.values, values]))


@dataclass(frozen=True, eq=False)
class Squares:
    """Σ weight·(rows·alpha − target)² + ridge·‖alpha − centre‖², or ridge·Σ|alpha − centre| where `norm` is 1.

    Where that leaves freedom, still·alpha stays nearest to still·centre, then alpha to the centre.
    """

    rows: Array
    target: Array
    weight: Array
    ridge: float
    centre: Array
    norm: int = 2
    still: Array | None = None

    def __call__(self, alpha: Array) -> float:
        """The value at alpha."""
        off, apart = self.rows @ alpha - self.target, alpha - self.centre
        away = apart @ apart if self.norm == 2 else np.abs(apart).sum()
        return float(self.weight @ off**2 + self.ridge * away)

    def least(self, equal: Equalities) -> Array:
        """Where it is least among what meets the equalities, and of all such alpha the nearest to the centre."""
        start, basis = equal.free(self.centre)
        root = np.sqrt(self.weight)[:, None]
        damp = np.sqrt(self.ridge)
        system = np.vstack([root * self.rows @ basis, damp * np.eye(basis.shape[1])])
        gap = np.concatenate([root[:, 0] * (self.target - self.rows @ start), np.zeros(basis.shape[1])])
        size = np.linalg.norm(root * self.rows, axis=1).max(initial=0.0)
        keep = _above(system, RANK * size)  # what hard rows leave of a row may be noise
        alpha = np.asarray(start + basis @ (np.linalg.pinv(system, rcond=keep) @ gap))
        if (settled := self.settled(alpha)) is None:
            return alpha
        start, basis = equal.joined(self.rows, self.rows @ alpha).free(alpha)
        rows = settled.rows @ basis
        size = np.linalg.norm(settled.rows, axis=1).max()
        return np.asarray(start + basis @ (np.linalg.pinv(rows, rcond=_above(rows, RANK * size)) @ settled.off(start)))

    def off(self, alpha: Array) -> Array:
        """What the rows lack at alpha."""
        return np.asarray(self.target - self.rows @ alpha)

    def settled(self, alpha: Array) -> Squares | None:
        """What is to be least next, with these rows as they are at `alpha`: the movement of what should stay still."""
        if self.still is None or not len(self.still):
            return None
        rows = self.still - self.still.mean(1, keepdims=True)
        return Squares(rows, rows @ self.centre, np.ones(len(rows)), 0.0, self.centre, self.norm)


def _above(system: Array, least: float) -> float:
    """The relative cutoff of singular values that is `least` in size."""
    largest = np.linalg.norm(system, 2) if system.size else 0.0
    return max(RANK, float(least / largest)) if largest > 0 else RANK


def least_squares(squares: Squares, equal: Equalities, within: Inequalities) -> Array:
    """Where `squares` is least among what meets both; nearest to the centre where that leaves freedom.

    Raises
    ------
    SolveError
        If the quadratic program has no solution: whether there is one is to be told beforehand.
    """
    if squares.norm == 2:
        alpha = squares.least(equal)
        if within.worst(alpha) <= EXACT:
            return alpha
    alpha = _program(squares, equal, within)
    if (settled := squares.settled(alpha)) is not None:
        equal, squares = equal.joined(squares.rows, squares.rows @ alpha), settled
        alpha = _program(squares, equal, within, alpha)
    if squares.ridge == 0:
        rows = equal.joined(squares.rows, squares.rows @ alpha)
        alpha = _program(Squares(squares.rows[:0], squares.target[:0], squares.weight[:0], 1.0, squares.centre,
                                 squares.norm), rows, within, alpha)  # fmt: skip
    return _polished(squares, equal, within, alpha) if squares.norm == 2 else alpha


def _polished(squares: Squares, equal: Equalities, within: Inequalities, alpha: Array) -> Array:
    values = within.rows @ alpha
    at_low, at_high = values - within.low <= ACTIVE, within.high - values <= ACTIVE
    active = at_low | at_high
    limits = np.where(at_low, within.low, within.high)[active]
    better = squares.least(equal.joined(within.rows[active], limits))
    same = squares(better) <= squares(alpha) + EXACT * (1 + squares(alpha))
    return better if within.worst(better) <= EXACT and same else alpha


def _program(squares: Squares, equal: Equalities, within: Inequalities, start: Array | None = None) -> Array:
    """By HiGHS, in what the equalities leave free; in norm 1 with alpha − centre as the difference of two parts."""
    near, basis = equal.free(squares.centre if start is None else start)
    n, q = basis.shape
    rows = squares.rows @ basis
    hessian = 2 * rows.T @ (squares.weight[:, None] * rows)
    linear = 2 * rows.T @ (squares.weight * (squares.rows @ near - squares.target))
    a, base = within.rows @ basis, within.rows @ near
    low, high = within.low - base, within.high - base
    box = np.full(q, np.inf)
    if squares.norm == 2:
        hessian = hessian + 2 * squares.ridge * np.eye(q)
        linear = linear + 2 * squares.ridge * basis.T @ (near - squares.centre)
        y = quadratic_program(hessian, linear, a, low, high, -box, box)
    else:
        hessian = np.pad(hessian, ((0, 2 * n), (0, 2 * n)))
        linear = np.concatenate([linear, np.full(2 * n, squares.ridge)])
        parts = np.hstack([basis, -np.eye(n), np.eye(n)])
        a = np.vstack([np.pad(a, ((0, 0), (0, 2 * n))), parts])
        gap = squares.centre - near
        low, high = np.concatenate([low, gap]), np.concatenate([high, gap])
        y = quadratic_program(
            hessian, linear, a, low, high, np.append(-box, np.zeros(2 * n)), np.append(box, np.full(2 * n, np.inf))
        )[:q]
    return np.asarray(near + basis @ y)


def quadratic_program(
    hessian: Array, linear: Array, rows: Array, low: Array, high: Array, x_low: Array, x_high: Array
) -> Array:
    """Least ½ xᵀ hessian x + linearᵀ x with low ≤ rows·x ≤ high and x_low ≤ x ≤ x_high.

    Raises
    ------
    SolveError
        If none is found.
    """
    if not len(linear):
        return np.zeros(0)
    shape = {"h": casadi.Sparsity.dense(*hessian.shape), "a": casadi.Sparsity.dense(*rows.shape)}
    given = {"h": hessian, "g": linear, "a": rows, "lba": low, "uba": high, "lbx": x_low, "ubx": x_high}
    curved = np.linalg.eigvalsh(hessian)
    rounded = hessian + 10 * DEFINITE * (curved[-1] or 1.0) * np.eye(len(hessian))
    # What can be met by a hair only, a linear program tells to be met.
    wider = {"lba": low - ROOM, "uba": high + ROOM, "lbx": x_low - ROOM, "ubx": x_high + ROOM}
    tries = [("nlpsol", INTERIOR, {}), ("daqp", {}, {"h": rounded, **wider})]
    if curved[0] > DEFINITE * curved[-1]:
        tries.insert(0, ("daqp", ACTIVE_SET, {}))
    for name, settings, changed in tries:
        program = casadi.conic("program", name, shape, {"error_on_fail": False, **settings})
        x = np.asarray(program(**{**given, **changed})["x"], float).ravel()
        if program.stats()["success"] and np.isfinite(x).all():
            return x
    raise SolveError(
        f"solver 'casadi': its quadratic programs failed: {program.stats().get('return_status', 'no reason is given')}"
    )
