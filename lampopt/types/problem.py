"""What a solver sees, and what it returns."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from lampopt.errors import InputError
from lampopt.types.arrays import Array, assign, bounds, frozen_array, unique

Status = Literal["exact", "inexact", "infeasible", "failed"]
MISSED = 1e-3  # what a squared target may be off [half range]: below that it is too flat to be told
BOUNDS = "bounds on alpha"  # how these are called where they stand in the way


@runtime_checkable
class Term(Protocol):
    """A value that depends on the mix, and its gradient; None where the gradient is not known.

    It may have a `name`; it may be `Expressible`; and it may have an attribute `rough`, true where its values have the
    noise of single precision.
    """

    def __call__(self, alpha: Array, /) -> tuple[float, Array | None]:
        """The value at alpha (N,), and its gradient (N,)."""


@runtime_checkable
class Expressible(Term, Protocol):
    """A term that exists as a CasADi expression."""

    def symbolic(self, alpha: Any, /) -> Any:
        """Its value as an expression of alpha (N,), which is one."""


def rough(term: Term) -> bool:
    """Whether the values of a term have the noise of single precision."""
    return bool(getattr(term, "rough", False))


def gave(term: Term, amount: float) -> str | None:
    """How the limit of a term moves that gives way by `amount` [normalised], in words; None where it tells nothing."""
    limits = getattr(term, "limits", None)
    if limits is None:
        return None
    before, after = limits(amount)
    return f"{before:.6g} → {after:.6g} {getattr(term, 'unit', '')}".rstrip()


def called(term: Term, otherwise: str) -> str:
    """The name of a term, or `otherwise`."""
    return str(getattr(term, "name", otherwise))


def missed(terms: Iterable[Term], alpha: Array) -> list[str]:
    """The names of those that are soft targets, squared, and off by more than a square tells from 0."""
    asked = [term for term in terms if getattr(term, "target", False)]
    off = [term(alpha)[0] / getattr(term, "weight", 1.0) for term in asked]
    return [called(term, "a target") for term, square in zip(asked, off, strict=True) if not square <= MISSED**2]


@dataclass(frozen=True, eq=False)
class Problem:
    """What a solver sees: matrices and callables, never meshes or networks.

    Minimise Σ weight·(matrix·alpha − target)² + ridge·‖alpha − centre‖ (squared where `norm` is 2), subject to
    1ᵀalpha = 1, hard rows exactly, range_low ≤ range_matrix·alpha ≤ range_high, alpha_low ≤ alpha ≤ alpha_high
    (paper, equation (1) and appendix P). Where that leaves freedom, ‖still·(alpha − centre)‖ is least, then
    ‖alpha − centre‖.

    Parameters
    ----------
    names, matrix, target
        k rows: their names, (k, N) and (k,). Normalised, so that ±1 are the ends of the bank's range.
    weight
        (k,) positive; 1 by default. Ignored for hard rows.
    hard
        (k,) truth values; all False by default.
    range_names, range_matrix, range_low, range_high
        Ranges and linear inequalities: (r, N), (r,), (r,); a bound of ±inf is none.
    alpha_low, alpha_high
        (N,) bounds or None.
    centre
        (N,) summing to 1; 1/N by default.
    ridge
        ≥ 0, or None: the solver's own.
    norm
        1 or 2.
    still
        (s, N) rows that nobody asked for and that should not move either: a solver may take no notice of them.
    objectives, constraints, equalities
        Terms: to be minimised (summed); to be kept ≤ 0; to be kept at 0.
    directions
        (q, N) directions in alpha, each summing to 0, that a search may keep to where all of them are too many; None:
        no advice. The loop gives those that move one parameter each.
    """

    names: tuple[str, ...]
    matrix: Array
    target: Array
    weight: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    hard: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    range_names: tuple[str, ...] = ()
    range_matrix: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    range_low: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    range_high: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    alpha_low: Array | None = None
    alpha_high: Array | None = None
    centre: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    ridge: float | None = None
    norm: Literal[1, 2] = 2
    still: Array = field(default_factory=lambda: np.empty((0, 0)))
    objectives: tuple[Term, ...] = ()
    constraints: tuple[Term, ...] = ()
    equalities: tuple[Term, ...] = ()
    directions: Array | None = None

    def __post_init__(self) -> None:
        k, r = len(self.names), len(self.range_names)
        matrix = frozen_array(self.matrix, "matrix", (k, None))
        n = matrix.shape[1]
        if n == 0:
            raise InputError("problem: expected at least one exemplar, got a matrix without columns")
        unique((*self.names, *self.range_names), "row")
        assign(
            self,
            matrix=matrix,
            target=frozen_array(self.target, "target", (k,)),
            weight=frozen_array(np.ones(k) if self.weight is None else self.weight, "weight", (k,)),
            hard=frozen_array(np.zeros(k) if self.hard is None else self.hard, "hard", (k,), bool),
            range_matrix=frozen_array(
                np.empty((0, n)) if self.range_matrix is None else self.range_matrix, "range_matrix", (r, n)
            ),
            range_low=bounds(self.range_low, "range_low", r, -np.inf),
            range_high=bounds(self.range_high, "range_high", r, np.inf),
            centre=frozen_array(np.full(n, 1 / n) if self.centre is None else self.centre, "centre", (n,)),
        )
        assign(self, still=frozen_array(self.still if len(self.still) else np.empty((0, n)), "still", (None, n)))
        for name in ("alpha_low", "alpha_high"):
            if getattr(self, name) is not None:
                assign(self, **{name: bounds(getattr(self, name), name, n, 0.0)})
        if self.directions is not None:
            assign(self, directions=frozen_array(self.directions, "directions", (None, n)))
        if (self.weight <= 0).any():
            raise InputError(f"weight: expected positive values, got {self.weight.min()}")
        if self.ridge is not None and not (np.isfinite(self.ridge) and self.ridge >= 0):
            raise InputError(f"ridge: expected a number of at least 0, got {self.ridge}")
        if self.norm not in (1, 2):
            raise InputError(f"norm: expected 1 or 2, got {self.norm}")
        if abs(self.centre.sum() - 1) > 1e-9:
            raise InputError(f"centre: expected coefficients that sum to 1, got a sum of {self.centre.sum()}")


@dataclass(frozen=True, eq=False)
class Conflict:
    """Requirements that no alpha can meet together, and how far they would have to give [normalised].

    Parameters
    ----------
    names
        Rows, ranges, terms, or `BOUNDS`.
    amounts
        Added to their targets or limits, the least change of all together that makes them agree: by the sum of
        squares where all is linear, by the sum of sizes where a term is among them, so that few give.
    alone
        What each would have to give alone, all else that is asked kept; infinite where that is of no use. By default
        not known: NaN.
    """

    names: tuple[str, ...]
    amounts: Array
    alone: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        k = len(self.names)
        alone = np.array(self.alone, float) if len(self.alone) else np.full(k, np.nan)
        alone.setflags(write=False)
        assign(self, amounts=frozen_array(self.amounts, "amounts", (k,)), alone=alone)
        if alone.shape != (k,):
            raise InputError(f"alone: expected {k} numbers, got shape {alone.shape}")

    @property
    def culprit(self) -> str | None:
        """What alone has to give least for all else that is asked to be met; None where no one alone is enough."""
        size = np.abs(self.alone)
        return self.names[int(np.nanargmin(size))] if np.isfinite(size).any() else None


@dataclass(frozen=True, eq=False)
class Mix:
    """Affine mixing coefficients: what a solver returns.

    Parameters
    ----------
    alpha
        (N,), always finite, sums to 1: the nearest found where the problem has no solution.
    residual
        (k,) achieved minus target [normalised].
    status
        exact: every row is met. inexact: they could be, but weights or ridge held them off. infeasible: no alpha
        meets them all. failed: the solver found nothing better than `alpha`.
    message
        The status in plain words.
    conflicts
        Why it is infeasible.
    """

    alpha: Array
    residual: Array
    status: Status
    message: str = ""
    conflicts: tuple[Conflict, ...] = ()

    def __post_init__(self) -> None:
        assign(
            self,
            alpha=frozen_array(self.alpha, "alpha", (None,)),
            residual=frozen_array(self.residual, "residual", (None,)),
        )
        if self.status not in ("exact", "inexact", "infeasible", "failed"):
            raise InputError(f"status: expected exact, inexact, infeasible or failed, got {self.status!r}")
        if abs(self.alpha.sum() - 1) > 1e-6 * max(1.0, float(np.abs(self.alpha).sum())):
            raise InputError(f"alpha: expected coefficients that sum to 1, got a sum of {self.alpha.sum()}")


@dataclass(frozen=True, eq=False)
class MixBatch:
    """Many mixes as arrays: alpha (B, N), residual (B, k), status (B,)."""

    alpha: Array
    residual: Array
    status: tuple[Status, ...]

    def __post_init__(self) -> None:
        b = len(self.status)
        assign(
            self,
            alpha=frozen_array(self.alpha, "alpha", (b, None)),
            residual=frozen_array(self.residual, "residual", (b, None)),
        )

    @classmethod
    def one_by_one(
        cls, solve: Callable[[Problem], Mix], problem: Problem, targets: Array, ridges: Array | None = None
    ) -> MixBatch:
        """What `solve` makes of each of targets (B, k), one ridge (B,) each if given: a `solve_many` for any solver.

        Raises
        ------
        InputError
            If the shapes do not fit.
        """
        targets, k = np.asarray(targets, float), len(problem.names)
        if targets.ndim != 2 or targets.shape[1] != k:
            raise InputError(f"targets: expected shape (B, {k}), got {targets.shape}")
        if ridges is not None and np.shape(ridges) != (len(targets),):
            raise InputError(f"ridges: expected {len(targets)} numbers, got {ridges!r}")
        each = [problem.ridge] * len(targets) if ridges is None else [float(ridge) for ridge in ridges]
        mixes = [solve(replace(problem, target=t, ridge=r)) for t, r in zip(targets, each, strict=True)]
        return cls(
            np.reshape([mix.alpha for mix in mixes], (len(targets), len(problem.centre))),
            np.reshape([mix.residual for mix in mixes], (len(targets), k)),
            tuple(mix.status for mix in mixes),
        )

    def __len__(self) -> int:
        return len(self.status)
