"""Least squares over alpha with equalities and inequalities.

Equalities go first: alpha = start + basis·y, with basis an orthonormal null space, so that they hold exactly. Where
the least squares that are left meet the inequalities, they are the answer; else a quadratic program (DAQP, PIQP or
IPOPT, through CasADi) tells which inequalities hold with equality, and those join the equalities, to machine precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from scipy.linalg import null_space

from lampopt.errors import SolveError
from lampopt.types import Array

RANK = 1e-10  # singular values below this part of the largest count as zero
NOISE = 1e-13  # of a row's size, all that rounding leaves when a row that is constant is centred
ACTIVE = 1e-6  # an inequality this near to its limit may hold with equality
METHODS: dict[str, dict[str, Any]] = {  # the next where one gives up, or its multipliers do not prove its answer
    "daqp": {"daqp": {"primal_tol": 1e-11, "dual_tol": 1e-12}},
    "piqp": {"piqp": {"eps_abs": 1e-13, "eps_rel": 1e-13, "max_iter": 500}},
    "daqp, by proximal steps": {"daqp": {"primal_tol": 1e-11, "dual_tol": 1e-12, "eps_prox": 1e-8}},
    "nlpsol": {
        "nlpsol": "ipopt",
        "nlpsol_options": {
            "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "bound_relax_factor": 0.0, "max_iter": 500},
            "print_time": False,
            "error_on_fail": False,
        },
    },
}
GOOD = 1e-7  # and where that is enough to leave the last method out, which takes a second for a hundred exemplars
PROVEN = 1e-12  # what may be left of the gradient [of its largest term] when the multipliers are taken from it
LAST = "nlpsol"
POLISHED = 30  # times that the set of inequalities that hold with equality is bettered, at most
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
        keep = above(system, RANK * size)  # what hard rows leave of a row may be noise
        alpha = np.asarray(start + basis @ (np.linalg.pinv(system, rcond=keep) @ gap))
        if (settled := self.settled(alpha)) is None:
            return alpha
        start, basis = equal.joined(self.rows, self.rows @ alpha).free(alpha)
        rows = settled.rows @ basis
        size = np.linalg.norm(settled.rows, axis=1).max()
        return np.asarray(start + basis @ (np.linalg.pinv(rows, rcond=above(rows, RANK * size)) @ settled.off(start)))

    def nearest(self, alpha: Array) -> Squares:
        """The same, but where that leaves freedom it is to stay nearest to alpha."""
        return replace(self, still=None, centre=alpha if self.ridge == 0 else self.centre)

    def multipliers(self, alpha: Array, equal: Equalities, rows: Array) -> Array:
        """How much of each of `rows` the gradient at alpha holds, what equalities take of it aside; noise is 0."""
        _, basis = equal.free(alpha)
        parts = 2 * self.weight * (self.rows @ alpha - self.target)
        gradient = parts @ self.rows + 2 * self.ridge * (alpha - self.centre)
        found = np.linalg.lstsq((rows @ basis).T, basis.T @ gradient, rcond=RANK)[0]
        size = np.abs(self.weight[:, None] * self.rows * self.target[:, None]).max(initial=0.0)
        return np.where(np.abs(found) > EXACT * np.abs(found).max(initial=NOISE * size), found, 0.0)

    def off(self, alpha: Array) -> Array:
        """What the rows lack at alpha."""
        return np.asarray(self.target - self.rows @ alpha)

    def settled(self, alpha: Array) -> Squares | None:
        """What is to be least next, with these rows as they are at `alpha`: the movement of what should stay still."""
        if self.still is None or not len(self.still):
            return None
        rows = self.still - self.still.mean(1, keepdims=True)
        rows = rows[np.linalg.norm(rows, axis=1) > NOISE * np.linalg.norm(self.still, axis=1)]
        if not len(rows):
            return None
        return Squares(rows, rows @ self.centre, np.ones(len(rows)), 0.0, self.centre, self.norm)


def above(system: Array, least: float) -> float:
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
        alpha = _polished(squares.nearest(alpha), equal, within, alpha)
        equal, squares = equal.joined(squares.rows, squares.rows @ alpha), settled
        alpha = _program(squares, equal, within, alpha)
    if squares.ridge == 0:
        alpha = _polished(squares.nearest(alpha), equal, within, alpha)
        equal = equal.joined(squares.rows, squares.rows @ alpha)
        squares = Squares(squares.rows[:0], squares.target[:0], squares.weight[:0], 1.0, squares.centre, squares.norm)
        alpha = _program(squares, equal, within, alpha)
    return _polished(squares, equal, within, alpha)


def _polished(squares: Squares, equal: Equalities, within: Inequalities, alpha: Array) -> Array:
    """The same in norm 2 with what holds with equality as equalities: to machine precision, if that is as good.

    What the answer then leaves joins them, what its multipliers would rather leave goes, the worst first.
    """
    if squares.norm == 1:
        return _polished_in_norm_1(squares, equal, within, alpha)
    best, least = alpha, squares(alpha) + EXACT * (1 + squares(alpha))
    side = _sides(within, alpha)
    for _ in range(POLISHED):
        held = side != 0
        limits = np.where(side < 0, within.low, within.high)[held]
        found = squares.least(equal.joined(within.rows[held], limits))
        values = within.rows @ found
        beyond = np.where(held, 0.0, np.maximum(within.low - values, values - within.high))
        if within.worst(found) <= EXACT and squares(found) <= least:
            best, least = found, squares(found)
        if beyond.max(initial=0.0) > EXACT:
            worst = int(beyond.argmax())
            side[worst] = -1 if values[worst] < within.low[worst] else 1
            continue
        pull = np.zeros(len(side))
        pull[held] = squares.multipliers(found, equal, within.rows[held]) * side[held]
        if not held.any() or pull.max() <= 0:
            break
        side[int(pull.argmax())] = 0
    return best


def _polished_in_norm_1(squares: Squares, equal: Equalities, within: Inequalities, alpha: Array) -> Array:
    """The same with the coefficients that are at the centre's held there, and the signs of the others' changes."""
    apart = alpha - squares.centre
    sign = np.where(np.abs(apart) <= ACTIVE, 0.0, np.sign(apart))
    side = _sides(within, alpha)
    held, still = side != 0, sign == 0
    limits = np.where(side < 0, within.low, within.high)[held]
    equal = equal.joined(within.rows[held], limits).joined(np.eye(len(alpha))[still], squares.centre[still])
    start, basis = equal.free(alpha)
    rows = _left(squares.rows, basis)
    hessian = 2 * rows.T @ (squares.weight[:, None] * rows)
    slope = 2 * rows.T @ (squares.weight * (squares.rows @ start - squares.target)) + squares.ridge * basis.T @ sign
    found = np.asarray(start - basis @ (np.linalg.pinv(hessian, rcond=RANK, hermitian=True) @ slope))
    same = (sign * (found - squares.centre) >= -EXACT).all() and within.worst(found) <= EXACT
    return found if same and squares(found) <= squares(alpha) + EXACT * squares.ridge else alpha


def _sides(within: Inequalities, alpha: Array) -> Array:
    """Which limits alpha is at: -1 the lower one, 1 the upper one, 0 none."""
    values = within.rows @ alpha
    return np.where(values - within.low <= ACTIVE, -1, np.where(within.high - values <= ACTIVE, 1, 0))


def _program(squares: Squares, equal: Equalities, within: Inequalities, start: Array | None = None) -> Array:
    """In what the equalities leave free; in norm 1 with alpha − centre as the difference of two parts."""
    near, basis = equal.free(squares.centre if start is None else start)
    n, q = basis.shape
    rows = _left(squares.rows, basis)
    hessian = 2 * rows.T @ (squares.weight[:, None] * rows)
    linear = 2 * rows.T @ (squares.weight * (squares.rows @ near - squares.target))
    a, base = _left(within.rows, basis), within.rows @ near
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


def _left(rows: Array, basis: Array) -> Array:
    """What the equalities leave of `rows`: of those that they tell already nothing, not rounding, which scales up."""
    found = rows @ basis
    found[np.linalg.norm(found, axis=1) <= RANK * np.linalg.norm(rows, axis=1)] = 0.0
    return np.asarray(found)


def quadratic_program(
    hessian: Array, linear: Array, rows: Array, low: Array, high: Array, x_low: Array, x_high: Array
) -> Array:
    """Least ½ xᵀ hessian x + linearᵀ x with low ≤ rows·x ≤ high and x_low ≤ x ≤ x_high.

    No method is believed. HiGHS is none of them: it calls answers optimal that are not, nor even within the limits, may
    go round in circles for ever, and prints.

    Raises
    ------
    SolveError
        If none is found.
    """
    if not len(linear):
        return np.zeros(0)
    felt = np.isfinite(low) | np.isfinite(high)
    rows, low, high = rows[felt], low[felt], high[felt]
    all_rows = np.vstack([rows, np.eye(len(linear))])
    limits = Inequalities(all_rows, np.concatenate([low, x_low]), np.concatenate([high, x_high]))
    shape = {"h": casadi.Sparsity.dense(*hessian.shape), "a": casadi.Sparsity.dense(*rows.shape)}
    scale = np.abs(hessian).max() or np.abs(linear).max() or 1.0
    hessian, linear = hessian / scale, linear / scale
    given = {"h": hessian, "g": linear, "a": rows, "lba": low, "uba": high, "lbx": x_low, "ubx": x_high}
    best, least, status = None, np.inf, {}
    for name, settings in METHODS.items():
        plugin = name.partition(",")[0]
        if least <= (GOOD if plugin == LAST else PROVEN):
            break
        if not casadi.has_conic(plugin):
            continue
        program = casadi.conic("program", plugin, shape, {"error_on_fail": False, **settings})
        found = program(**given)
        x, *multipliers = (np.asarray(found[key], float).ravel() for key in ("x", "lam_a", "lam_x"))
        status[name] = program.stats().get("return_status")
        if np.isfinite(x).all() and limits.worst(x) <= ACTIVE:
            doubt = _doubt(hessian, linear, limits, x, np.concatenate(multipliers))
            if doubt < least or best is None:
                best, least = x, doubt
    if best is None:
        raise SolveError(f"solver 'casadi': its quadratic program failed: {status}")
    return best


def _doubt(hessian: Array, linear: Array, limits: Inequalities, x: Array, multipliers: Array) -> float:
    """What is left of the gradient at x when the multipliers are taken from it, in parts of its largest term.

    A multiplier counts only at the limit that it belongs to: positive at the upper one, negative at the lower one. How
    far x is beyond its limits is in doubt too.
    """
    values = limits.rows @ x
    at_low, at_high = values - limits.low <= EXACT, limits.high - values <= EXACT
    held = np.where(at_high, multipliers.clip(0), 0) + np.where(at_low, multipliers.clip(None, 0), 0)
    curved, pushed = hessian @ x, limits.rows.T @ held
    size = max(np.abs(part).max(initial=0.0) for part in (curved, linear, pushed))
    left = np.abs(curved + linear + pushed).max()
    if not np.isfinite(left):
        return np.inf
    return max(float(left / size) if left > NOISE else 0.0, limits.worst(x) * PROVEN / EXACT)
