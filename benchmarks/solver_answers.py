"""Answers that are found otherwise than by our solvers: numpy's closed forms, cvxpy with CLARABEL made exact."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lampopt.types import Array, Problem

from .common import extra

TIGHT = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12)
Known = tuple[Problem, Array, Callable[[Array], float] | None]  # a problem, its alpha, and its cost where that counts


def linear(p: Problem) -> Array:
    """Alpha of rows and ridge alone, in the null space of what is exact; then what should be still; least norm."""
    n = len(p.centre)
    root = np.sqrt(p.weight[~p.hard])[:, None]
    steps: list[tuple[Array, Array]] = [
        (np.ones((1, n)), np.ones(1)),
        (p.matrix[p.hard], p.target[p.hard]),
        (
            np.vstack([root * p.matrix[~p.hard], np.sqrt(p.ridge or 0.0) * np.eye(n)]),
            np.concatenate([root[:, 0] * p.target[~p.hard], np.sqrt(p.ridge or 0.0) * p.centre]),
        ),
    ]
    alpha, basis = p.centre, np.eye(n)
    for rows, values in steps if not len(p.still) else steps[:2]:
        alpha, basis = _then(alpha, basis, rows, values)
    if len(p.still):  # rows first, as the ridge has them; then what is free moves
        asked = linear(replace(p, still=p.still[:0]))
        alpha, basis = _then(alpha, basis, p.matrix[~p.hard], p.matrix[~p.hard] @ asked)
        alpha, basis = _then(alpha, basis, p.still, p.still @ p.centre)
    return alpha


def _then(alpha: Array, basis: Array, rows: Array, values: Array) -> tuple[Array, Array]:
    """rows·alpha nearest to `values` by moving along `basis` alone, and what that leaves of it."""
    if not len(rows) or not basis.shape[1]:
        return alpha, basis
    inner = rows @ basis
    step = np.linalg.lstsq(inner, values - rows @ alpha, rcond=1e-11)[0]
    _, sizes, right = np.linalg.svd(inner)
    return alpha + basis @ step, basis @ right[int((sizes > 1e-11 * sizes.max()).sum()) :].T


def convex(p: Problem, *, row: Array | None = None) -> Array:
    """Alpha by CLARABEL; nearest to the centre where a ridge of 0 leaves freedom. `row` is a linear objective."""
    cp = extra("cvxpy")
    alpha, soft = cp.Variable(len(p.centre)), ~p.hard
    kept = [cp.sum(alpha) == 1]
    kept += [p.matrix[p.hard] @ alpha == p.target[p.hard]] if p.hard.any() else []
    for rows, low, high in _limits(p):
        kept += [rows[np.isfinite(low)] @ alpha >= low[np.isfinite(low)]] if np.isfinite(low).any() else []
        kept += [rows[np.isfinite(high)] @ alpha <= high[np.isfinite(high)]] if np.isfinite(high).any() else []
    apart = alpha - p.centre
    size = cp.sum_squares(apart) if p.norm == 2 else cp.norm1(apart)
    cost = (p.ridge or 0.0) * size
    if soft.any():
        off = p.matrix[soft] @ alpha - p.target[soft]
        cost += cp.sum_squares(cp.multiply(np.sqrt(p.weight[soft]), off))
    cost += row @ alpha if row is not None else 0.0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Solution may be inaccurate")  # than 1e-12: `settled` makes it exact
        cp.Problem(cp.Minimize(cost), kept).solve(solver=cp.CLARABEL, **TIGHT)
        if not p.ridge and row is None:
            kept.append(p.matrix[soft] @ alpha == np.array(p.matrix[soft] @ alpha.value))
            cp.Problem(cp.Minimize(size), kept).solve(solver=cp.CLARABEL, **TIGHT)
    return np.array(alpha.value)


def _limits(p: Problem) -> list[tuple[Array, Array, Array]]:
    n = len(p.centre)
    low = np.full(n, -np.inf) if p.alpha_low is None else p.alpha_low
    high = np.full(n, np.inf) if p.alpha_high is None else p.alpha_high
    return [(p.range_matrix, p.range_low, p.range_high), (np.eye(n), low, high)]


def settled(p: Problem, near: Array) -> Array:
    """The answer near `near` once more, with what holds with equality there as hard rows: exact, not iterated."""
    rows, values = [p.matrix[p.hard]], [p.target[p.hard]]
    for matrix, low, high in _limits(p):
        at = matrix @ near
        for limit in (low, high):
            felt = np.abs(at - limit) < 1e-5
            rows.append(matrix[felt])
            values.append(limit[felt])
    exact, to = np.vstack(rows), np.concatenate(values)
    soft = ~p.hard
    return linear(
        Problem(
            tuple(f"q{i}" for i in range(len(exact) + int(soft.sum()))),
            np.vstack([exact, p.matrix[soft]]),
            np.concatenate([to, p.target[soft]]),
            np.concatenate([np.ones(len(exact)), p.weight[soft]]),
            np.arange(len(exact) + int(soft.sum())) < len(exact),
            centre=p.centre,
            ridge=p.ridge,
        )
    )


def quadratic(p: Problem) -> Known:
    near = convex(p)
    answer = settled(p, near)
    apart = np.abs(answer - near).max()
    if apart > 1e-4:
        raise ArithmeticError(f"two independent answers are {apart:.1e} apart: this problem tells nothing")
    return p, answer, None


def spent(p: Problem) -> Callable[[Array], float]:
    """What alpha costs."""

    def cost(alpha: Array) -> float:
        apart, off = alpha - p.centre, p.matrix[~p.hard] @ alpha - p.target[~p.hard]
        away = apart @ apart if p.norm == 2 else np.abs(apart).sum()
        return float(p.weight[~p.hard] @ off**2 + (p.ridge or 0.0) * away)

    return cost
