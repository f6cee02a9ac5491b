"""Evaluations that solver `nlopt` takes by algorithm, on smooth problems like drag: ``python -m benchmarks.searches``.

Each cell of the table in docs/solvers.md: the median over problems, for 3, 6 and 12 parameters. Below, the median of
what the mix costs more than the best of all algorithms, relatively, in the worst of these groups.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from lampopt import Spec
from lampopt.plugins import Plugins
from lampopt.types import Array, Problem

ALGORITHMS = ("slsqp", "mma", "ccsaq", "cobyla", "bobyqa")
COUNTS = (3, 6, 12)
SEEDS = range(5)
MOST = 3000


@dataclass(frozen=True, eq=False)
class Drag:
    """0.3 + bends·tanh(weights·x + at) + slope·x + 0.01 x·x over parameters x = rows·alpha; one bend of four."""

    rows: Array
    weights: Array
    at: Array
    bends: Array
    slope: Array

    @classmethod
    def drawn(cls, rows: Array, seed: int) -> Drag:
        """One of them, at random."""
        draw, d = np.random.default_rng(seed), len(rows)
        weights, at, bends = draw.normal(size=(4, d)), draw.normal(size=4), 0.05 * draw.normal(size=4)
        return cls(rows, weights, at, bends, 0.002 * draw.normal(size=d))

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient at alpha (N,)."""
        x = self.rows @ alpha
        bent = np.tanh(self.weights @ x + self.at)
        slope = self.weights.T @ (self.bends * (1 - bent**2)) + self.slope + 0.02 * x
        return float(0.3 + self.bends @ bent + self.slope @ x + 0.01 * x @ x), self.rows.T @ slope


@dataclass(frozen=True, eq=False)
class Ball:
    """(x − 0.5)² ≤ 0.3 over parameters x = rows·alpha."""

    rows: Array

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient at alpha (N,)."""
        off = self.rows @ alpha - 0.5
        return float(off @ off - 0.3), 2 * self.rows.T @ off


def problems(d: int, seed: int) -> dict[str, Problem]:
    """One problem of each kind, with d parameters of 3 d + 8 exemplars."""
    rows = np.random.default_rng([seed, d]).uniform(-1, 1, (d, 3 * d + 8))
    none = np.empty((0, rows.shape[1]))
    plain = Problem(
        (), none, np.empty(0), ridge=0.0, objectives=(Drag.drawn(rows, seed),),
        directions=np.linalg.pinv(rows - rows.mean(1, keepdims=True)).T,
    )  # fmt: skip
    names, limit = tuple(f"p{i} (range)" for i in range(d)), np.full(d, 0.8)
    targets = {"names": ("a", "b"), "matrix": rows[:2], "target": np.array([0.3, -0.5])}
    return {
        "no constraint": plain,
        "ranges": replace(plain, range_names=names, range_matrix=rows, range_low=-limit, range_high=limit),
        "a curved constraint": replace(plain, constraints=(Ball(rows),)),
        "two hard targets": replace(plain, **targets, hard=np.ones(2), weight=np.ones(2)),
        "two soft targets": replace(plain, **targets, hard=np.zeros(2), weight=np.ones(2)),
    }


def cost(problem: Problem, alpha: Array) -> float:
    """What the solver minimises."""
    soft = ~problem.hard
    off = problem.matrix[soft] @ alpha - problem.target[soft]
    return float(problem.weight[soft] @ off**2) + sum(term(alpha)[0] for term in problem.objectives)


def measured(plugins: Plugins, d: int, seed: int) -> dict[tuple[str, str], tuple[int, float]]:
    """Evaluations and cost by algorithm and kind of problem."""
    found = {}
    for algorithm in ALGORITHMS:
        solver = plugins.make("solver", Spec("nlopt", algorithm=algorithm, evaluations=MOST))
        for kind, problem in problems(d, seed).items():
            if algorithm == "bobyqa" and (problem.range_names or problem.constraints):
                continue
            mix = solver.solve(problem)
            count = re.search(r"(\d+) evaluation", mix.message)
            found[algorithm, kind] = int(count[1]) if count else 0, cost(problem, mix.alpha)
    return found


def table(plugins: Plugins, seeds: range = SEEDS, counts: tuple[int, ...] = COUNTS) -> str:
    """The table, in Markdown, and what stands below it."""
    runs = {(d, seed): measured(plugins, d, seed) for d in counts for seed in seeds}
    kinds = list(problems(counts[0], 0))
    least = {
        (at, kind): min(run[algorithm, kind][1] for algorithm in ALGORITHMS if (algorithm, kind) in run)
        for at, run in runs.items()
        for kind in kinds
    }
    lines, worst = [f"| algorithm | {' | '.join(kinds)} |", "|---" * (len(kinds) + 1) + "|"], 0.0
    for algorithm in ALGORITHMS:
        cells = []
        for kind in kinds:
            able = all((algorithm, kind) in run for run in runs.values())
            groups = [[(d, seed) for seed in seeds] for d in counts] if able else []
            found = [[runs[at][algorithm, kind] for at in group] for group in groups]
            cells.append(", ".join(f"{np.median([count for count, _ in group]):.0f}" for group in found))
            for at, group in zip(groups, found, strict=True):
                over = [value / least[one, kind] - 1 for one, (_, value) in zip(at, group, strict=True)]
                worst = max(worst, float(np.median(over)))
        lines.append(f"| `{algorithm}` | {' | '.join(cells)} |")
    return "\n".join([*lines, "", f"{worst:.0e}"])


if __name__ == "__main__":
    with threadpool_limits(1):
        Console(soft_wrap=True).out(table(Plugins.load()))
