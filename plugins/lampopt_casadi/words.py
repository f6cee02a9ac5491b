"""How a mix that falls short is told."""

from __future__ import annotations

import numpy as np

from lampopt.types import Array, Conflict, Mix, Problem


def held_off(problem: Problem, residual: Array) -> str:
    """Which row is missed most though it could be met."""
    if not len(residual):
        return "nothing is asked"
    worst = int(np.abs(residual).argmax())
    name, off = problem.names[worst], residual[worst]
    return f"targets could be met, but ridge, weights or objectives hold {name} off by {off:+.3g}"


def infeasible(alpha: Array, residual: Array, conflicts: tuple[Conflict, ...]) -> Mix:
    """The nearest mix where requirements contradict each other."""
    sets = "; ".join(
        f"{' + '.join(c.names)} contradict each other" if len(c.names) > 1 else f"{c.names[0]} cannot be met"
        for c in conflicts
    )
    words = f"no mix of these exemplars meets all that is asked: {sets}; the nearest is returned"
    return Mix(alpha, residual, "infeasible", words, conflicts)
