"""A search run again from the start, by what was told of its evaluations so far."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, isnan
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Problem
from lampopt.units import said

SAME = 1e-9  # what a replay comes to is what was told of, to this part: another machine rounds otherwise


@dataclass(frozen=True, eq=False)
class Told:
    """What was told of one alpha (N,): its value, and derivatives (N,) by alpha."""

    alpha: Array
    value: float
    gradient: Array | None


class Unknown(Exception):  # noqa: N818  # no error: it stops a replay
    """The first alpha of a replay that nothing was told of."""

    def __init__(self, alpha: Array) -> None:
        super().__init__()
        self.alpha = alpha


class Astray(Exception):  # noqa: N818  # told as an InputError, which a solver's caller would take for the solver's
    """A replay that comes to another alpha than was told of."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@dataclass(eq=False)
class Replay:
    """The term of one replay: the so-manieth new alpha is the so-manieth that was told of.

    `active` are the exemplars that take part; `size` is N.
    """

    told: list[Told]
    active: Array
    size: int
    scale: float
    name: str = "value"
    seen: dict[bytes, Told] = field(default_factory=dict)

    def __call__(self, alpha: Array) -> tuple[float, Array | None]:
        """Value and gradient, as they were told."""
        key = alpha.tobytes()
        if key not in self.seen:
            full = np.zeros(self.size)
            full[self.active] = alpha
            if len(self.seen) == len(self.told):
                raise Unknown(full)
            known = self.told[len(self.seen)]
            if apart(known.alpha, full):
                raise Astray(len(self.seen))
            self.seen[key] = known
        found = self.seen[key]
        gradient = None if found.gradient is None else found.gradient[self.active] / self.scale
        return found.value / self.scale, gradient


def read(told: Any, n: int) -> Told:
    """One entry of a file."""
    alpha, value, gradient = numbers(told["alpha"]), told["value"], told.get("gradient")
    slope = None if gradient is None else numbers(gradient)
    if alpha.shape != (n,) or (slope is not None and slope.shape != (n,)):
        raise InputError(f"told: expected {n} coefficients, got shape {alpha.shape}")
    return Told(alpha, np.nan if value is None else float(value), slope)


def numbers(given: Any) -> Array:
    """`given` as finite numbers. Raises InputError where it is something else."""
    try:
        found = np.asarray(given, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"expected numbers, got {said(given):.80}") from error
    if not np.isfinite(found).all():
        raise InputError("gradient: expected finite numbers, got others")
    return found


def apart(one: Array, other: Array) -> bool:
    """Whether two alphas (N,) differ by more than rounding."""
    return one.shape != other.shape or bool(np.abs(one - other).max() > SAME * (1 + np.abs(other).max()))


def merit(problem: Problem, alpha: Array) -> tuple[float, float]:
    """How far alpha (n,) is from what it has to meet, and what else it costs."""
    rows, between = problem.matrix @ alpha - problem.target, problem.range_matrix @ alpha
    low = -inf if problem.alpha_low is None else problem.alpha_low
    high = inf if problem.alpha_high is None else problem.alpha_high
    off = [
        *np.abs(rows[problem.hard]),
        *(problem.range_low - between), *(between - problem.range_high),
        *(low - alpha), *(alpha - high),
        *(term(alpha)[0] for term in problem.constraints),
        *(abs(term(alpha)[0]) for term in problem.equalities),
    ]  # fmt: skip
    soft, apart = ~problem.hard, alpha - problem.centre
    cost = problem.weight[soft] @ rows[soft] ** 2 + (problem.ridge or 0.0) * (apart @ apart)
    total = float(cost) + sum(term(alpha)[0] for term in problem.objectives)
    worst = max(0.0, *(inf if isnan(value) else float(value) for value in off))
    return worst, inf if isnan(total) else total
