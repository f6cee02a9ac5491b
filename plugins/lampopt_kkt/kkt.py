"""Equation (1) of the paper in closed form, with row weights, hard rows, ridge and centre.

Write alpha = centre + beta with 1ᵀbeta = 0, and centre every row of the matrix: M̃ = M − M11ᵀ/N. The sum-to-one
constraint is then gone, and what is left has the size of the rows, not of the bank:

    hard rows first:   beta₀ = H̃⁺ (t_H − H centre),
    then the others:   min ‖V½ (M̃ (beta₀ + γ) − r)‖² + ridge ‖γ‖²,   γ in the null space of H̃,
    then what is still: min ‖S̃ (beta₁ + δ)‖²,   δ in the null space of M̃,

each by one singular value decomposition of a (k, N) matrix. Each target after that costs a matrix product, so
thousands are one call. Least norm where rows leave freedom (Moore-Penrose).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError, SolveError
from lampopt.threads import one_thread
from lampopt.types import Array, Conflict, Mix, MixBatch, Problem, Status

RANK = 1e-10  # singular values below this part of the largest count as zero
NOISE = 1e-13  # and below this part of the rows' size: what centring leaves of a row that is constant
MET = 1e-8  # a row met to this [normalised] is met


@dataclass(frozen=True)
class KKT:
    """Closed form: targets (hard or weighted), ridge and centre in the 2-norm. No ranges, bounds or objectives.

    Parameters
    ----------
    ridge
        Weight of ‖alpha − centre‖² where the problem names none (paper, appendix P).
    """

    ridge: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.ridge) and self.ridge >= 0):
            raise InputError(f"ridge: expected a number of at least 0, got {self.ridge}")

    def solve(self, problem: Problem) -> Mix:
        """The mix for one problem; contradictions come back as conflicts with the nearest alpha."""
        batch = self.solve_many(problem, problem.target[None])
        status = batch.status[0]
        conflicts = _conflicts(problem) if status == "infeasible" else ()
        return Mix(
            batch.alpha[0], batch.residual[0], status, _message(problem, batch.residual[0], conflicts), conflicts
        )

    def solve_many(self, problem: Problem, targets: Array, ridges: Array | None = None) -> MixBatch:
        """The mixes for targets (B, k), from one decomposition for all of them and all ridges (B,)."""
        _refuse(problem)
        targets = np.asarray(targets, float)
        k = len(problem.names)
        if targets.ndim != 2 or targets.shape[1] != k or not np.isfinite(targets).all():
            raise InputError(f"targets: expected finite values of shape (B, {k}), got shape {targets.shape}")
        ridge = self.ridge if problem.ridge is None else problem.ridge
        each = np.full(len(targets), ridge) if ridges is None else np.asarray(ridges, float)
        if each.shape != (len(targets),) or not (np.isfinite(each) & (each >= 0)).all():
            raise InputError(f"ridges: expected {len(targets)} numbers of at least 0, got {ridges!r}")
        with one_thread():
            return _solve(problem, targets, each)


def _refuse(problem: Problem) -> None:
    lacking = [
        name
        for name, asked in (
            ("ranges", len(problem.range_names)),
            ("bounds on alpha", problem.alpha_low is not None or problem.alpha_high is not None),
            ("norm=1", problem.norm != 2),
            ("objectives (least or most of something, targets of models and measures)", len(problem.objectives)),
            ("constraints (safe, ranges of models and measures)", len(problem.constraints)),
            ("equalities (hard targets of models and measures)", len(problem.equalities)),
        )
        if asked
    ]
    if lacking:
        raise SolveError(
            f"solver 'kkt' is not able to take {', '.join(lacking)}: leave that out, or choose another "
            "solver, such as 'casadi', or 'nlopt' where meshes are measured"
        )


def _decompose(matrix: Array, least: float) -> tuple[Array, Array, Array]:
    """Thin singular value decomposition without what counts as zero: u (k, r), s (r,), vᵀ (r, N).

    That is what is below `least`, or tiny beside the largest.
    """
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    keep = s > max(RANK * float(s.max(initial=0.0)), least)
    return u[:, keep], s[keep], vt[keep]


def _noise(rows: Array) -> float:
    """Singular values of centred `rows` that rounding alone may make."""
    return max(NOISE * float(np.linalg.norm(rows)), 1e-300)


def _dependences(problem: Problem) -> Array:
    """(k, q) orthonormal: what each combination makes of the rows is the same for all alpha that sum to 1."""
    centred = problem.matrix - problem.matrix.mean(1, keepdims=True)
    u, s, _ = np.linalg.svd(centred, full_matrices=len(centred) > centred.shape[1])
    rank = int((s > max(RANK * s.max(initial=0.0), _noise(problem.matrix))).sum())
    return np.asarray(u[:, rank:])


def _solve(problem: Problem, targets: Array, ridges: Array) -> MixBatch:
    centred = problem.matrix - problem.matrix.mean(1, keepdims=True)
    gap = targets - problem.matrix @ problem.centre  # (B, k)
    hard, root = problem.hard, np.sqrt(problem.weight[~problem.hard])
    u, s, vt = _decompose(centred[hard], _noise(problem.matrix[hard]))
    beta = (gap[:, hard] @ u / s) @ vt
    soft = centred[~hard] - centred[~hard] @ vt.T @ vt  # what moves without moving a hard row
    # noise of the projection must not pass for a direction that is free to move
    size = float(np.linalg.norm(root[:, None] * centred[~hard]))
    u, s, vt = _decompose(root[:, None] * soft, max(RANK * size, _noise(root[:, None] * problem.matrix[~hard])))
    rest = (gap[:, ~hard] - beta @ centred[~hard].T) * root
    beta = beta + (rest @ u * (s / (s**2 + ridges[:, None]))) @ vt
    if len(problem.still):
        beta = beta + _settled(problem, centred, beta)
    alpha = problem.centre + beta
    alpha += (1 - alpha.sum(1, keepdims=True)) / alpha.shape[1]
    residual = alpha @ problem.matrix.T - targets
    scale = 1 + np.abs(targets).max(1, initial=0.0)
    clash = np.abs(gap @ _dependences(problem)).max(1, initial=0.0) > MET * scale
    missed = np.abs(residual).max(1, initial=0.0) > MET * scale
    status: tuple[Status, ...] = tuple(
        "infeasible" if c else "inexact" if m else "exact" for c, m in zip(clash, missed, strict=True)
    )
    return MixBatch(alpha, residual, status)


def _settled(problem: Problem, centred: Array, beta: Array) -> Array:
    """What to add to beta (B, N) for the still rows to move least, without moving a row that is asked for."""
    still = problem.still - problem.still.mean(1, keepdims=True)
    _, _, rows = _decompose(centred, _noise(problem.matrix))
    least = max(RANK * float(np.linalg.norm(still)), _noise(problem.still))
    u, s, vt = _decompose(still - still @ rows.T @ rows, least)
    return np.asarray(-(beta @ still.T @ u / s) @ vt)


def _conflicts(problem: Problem) -> tuple[Conflict, ...]:
    """Sets of rows that contradict each other: the left null vectors of the centred matrix, each as sparse as can be.

    A vector n with nᵀM̃ = 0 demands nᵀ(target − M centre) = 0. In reduced echelon form each vector names few rows.
    """
    gap = problem.target - problem.matrix @ problem.centre
    found, left = [], _dependences(problem)
    demanded = left.T @ gap  # of all rows together: one row alone mends it where its part of `left` points there
    scale = MET * (1 + np.abs(problem.target).max())
    for vector in _echelon(left.T):
        size = np.abs(vector).max()
        rows = np.flatnonzero(np.abs(vector) > 1e-6 * size)
        amount = -(vector[rows] @ gap[rows]) / (vector[rows] @ vector[rows]) * vector[rows]
        if np.abs(amount).max() > scale:
            part, alone = left[rows], np.full(len(rows), np.inf)
            step = -(part @ demanded) / (part**2).sum(1)
            enough = np.abs(demanded + step[:, None] * part).max(1) <= scale
            alone[enough] = step[enough]
            found.append(Conflict(tuple(problem.names[i] for i in rows), amount, alone))
    return tuple(found)


def _echelon(basis: Array) -> Array:
    """Reduced row echelon form of `basis` (q, k), pivots by size."""
    basis = basis.copy()
    for row in range(len(basis)):
        rest = np.abs(basis[row:])
        i, column = (int(j) for j in np.unravel_index(rest.argmax(), rest.shape))
        basis[[row, row + i]] = basis[[row + i, row]]
        basis[row] /= basis[row, column]
        for other in range(len(basis)):
            if other != row:
                basis[other] -= basis[other, column] * basis[row]
    return basis


def _message(problem: Problem, residual: Array, conflicts: tuple[Conflict, ...]) -> str:
    if conflicts:
        sets = "; ".join(
            f"{' + '.join(c.names)} contradict each other" if len(c.names) > 1 else f"{c.names[0]} cannot move"
            for c in conflicts
        )
        return f"no mix of these exemplars meets all targets: {sets}; the nearest is returned"
    if len(residual) and np.abs(residual).max() > MET * (1 + np.abs(problem.target).max()):
        worst = int(np.abs(residual).argmax())
        return f"targets could be met, but ridge or weights hold {problem.names[worst]} off by {residual[worst]:+.3g}"
    return "every target is met"
