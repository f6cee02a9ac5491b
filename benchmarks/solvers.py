"""Every solver on one table of problems whose answers are known otherwise: ``python -m benchmarks.solvers --help``.

Convex problems are solved by cvxpy with CLARABEL, then once more by numpy as the linear system of what CLARABEL says is
active; the others have closed forms, or come down to one equation in one unknown. What a solver says of its answer has
to be true (HiGHS tells what can be met), a planted culprit has to be named, and a front of 200 ridges quick.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.optimize import linprog
from threadpoolctl import threadpool_limits

from lampopt import Spec
from lampopt.errors import InputError, SolveError
from lampopt.plugins import Plugins
from lampopt.protocols import Solver
from lampopt.types import Mix, Problem

from .common import ROOT, Row, line, share
from .document import put, show, stamped
from .solver_answers import Known, linear
from .solver_problems import CASES, contradictory, drawn, impossible, uneven

SIZES = (12, 24, 100)
CLOSE = 1e-6  # what is wanted of alpha, or of the cost where alpha is not unique
SEEDS = 5
EXACT = {"nlopt": {"evaluations": 2_000, "tolerance": 1e-10}}  # options of a search that else ends earlier
PLANTED = 20
RIDGES = 200
LEAST, MOST, LONG = 5, 0.25, 5.0  # a time is the median of so many calls or seconds of them; few of what takes long


def terms(p: Problem) -> bool:
    return bool(p.objectives or p.constraints or p.equalities)


def tried(solver: Solver, p: Problem) -> Mix | None:
    """The mix; None where the solver returns none that can be used."""
    try:
        return solver.solve(p)
    except InputError:
        return None


def takes(solver: Solver, p: Problem) -> bool:
    """Whether it does not refuse; nor, of what it may, takes no notice."""
    try:
        found = tried(solver, p)
    except SolveError:
        return False
    if found is None or not len(p.still):
        return True
    return np.abs(found.alpha - solver.solve(replace(p, still=p.still[:0])).alpha).max() > 1e-9


def timed(work: Callable[[], object]) -> float:
    """Milliseconds, the median of several calls."""
    spans: list[float] = []
    while not spans or (len(spans) < LEAST and sum(spans) < LONG) or (sum(spans) < MOST and len(spans) < 200):
        began = time.perf_counter()
        work()
        spans.append(time.perf_counter() - began)
    return 1000 * float(np.median(spans))


def solved(name: str, solver: Solver, n: int, known: Sequence[Known]) -> Row:
    """How far off a solver is at most, and how long one problem takes it."""
    off = []
    for p, answer, cost in known:
        if (mix := tried(solver, p)) is None:
            off.append(np.inf)
        elif cost is None:
            off.append(float(np.abs(mix.alpha - answer).max()))
        else:
            off.append(abs(cost(mix.alpha) - cost(answer)))
    took = timed(lambda: solver.solve(known[0][0]))
    return line(
        f"{name}, N = {n}", max(off), target=f"<= {CLOSE:g}", of=len(known), ms=round(took, 3), by={"ms": f"{took:.2f}"}
    )


def recognised(solver: Solver, sizes: Sequence[int], seeds: int) -> list[Row]:
    """Of problems that have no answer, how many are called so, with reasons."""
    told: dict[str, list[bool]] = {}
    for n in sizes:
        for seed in range(seeds):
            for why, p in impossible(seed, n):
                if takes(solver, p):
                    mix = tried(solver, p)
                    good = mix is not None and mix.status == "infeasible" and bool(mix.conflicts)
                    told.setdefault(why, []).append(good)
    return [
        line(f"no answer: {why}", share([x for x in all_ if x], all_), target=">= 1", of=len(all_))
        for why, all_ in told.items()
    ]


def possible(p: Problem) -> bool:
    """Whether some alpha meets all targets, ranges and bounds, by HiGHS."""
    upper, lower = np.isfinite(p.range_high), np.isfinite(p.range_low)
    none = np.full(len(p.centre), np.inf)
    found = linprog(
        np.zeros(len(p.centre)),
        A_ub=np.vstack([p.range_matrix[upper], -p.range_matrix[lower]]),
        b_ub=np.append(p.range_high[upper], -p.range_low[lower]),
        A_eq=np.vstack([np.ones(len(p.centre)), p.matrix]),
        b_eq=np.append(1.0, p.target),
        bounds=np.column_stack([-none if p.alpha_low is None else p.alpha_low,
                                none if p.alpha_high is None else p.alpha_high]),
    )  # fmt: skip
    return bool(found.status == 0)


def truthful(solver: Solver, known: Sequence[Known]) -> Row:
    """Of problems without terms, how often the status is what it means."""
    right = []
    for p, _, _ in known:
        if (mix := tried(solver, p)) is None:
            right.append(False)
            continue
        met = np.abs(p.matrix @ mix.alpha - p.target).max(initial=0.0) <= CLOSE
        wanted = ("exact" if met else "inexact") if possible(p) else "infeasible"
        right.append(mix.status == wanted and bool(mix.conflicts) == (wanted == "infeasible"))
    return line("status is true", share([x for x in right if x], right), target=">= 1", of=len(right))


def named(solver: Solver, *, ranges: bool) -> Row | None:
    """How often the planted culprit is what alone has to give, and by what it was planted."""
    right, ms = [], []
    for seed in range(PLANTED):
        p = contradictory(seed, ranges=ranges)
        if not takes(solver, p):
            return None
        began = time.perf_counter()
        mix = solver.solve(p)
        ms.append(1000 * (time.perf_counter() - began))
        touching = [c for c in mix.conflicts if "culprit" in c.names]
        good = bool(touching) and mix.status == "infeasible" and all(c.culprit == "culprit" for c in touching)
        if good:
            alone = float(touching[0].alone[touching[0].names.index("culprit")])
            target = p.target + alone * np.array([name == "culprit" for name in p.names])
            good = solver.solve(replace(p, target=target)).status != "infeasible"
        right.append(good)
    asked = "targets and ranges" if ranges else "targets alone"
    took = float(np.median(ms))
    return line(
        f"culprit named, {asked}", share([x for x in right if x], right), target=">= 1", of=len(right),
        ms=round(took, 3), by={"ms": f"{took:.2f}"},
    )  # fmt: skip


# The path


def paths(solvers: dict[str, Solver], seeds: int) -> list[Row]:
    """200 ridges at N = 100: how long it takes, and how far each is from the closed form ridge by ridge."""
    rows, n = [], 100
    ridges = np.append(0.0, np.geomspace(1e-3, 1e6, RIDGES - 1))
    for name, solver in solvers.items():
        off, first = [], drawn(0, n, **uneven(0, n))
        for seed in range(seeds if name == "kkt" else 1):
            p = drawn(seed, n, **uneven(seed, n))
            path = solver.solve_many(p, np.tile(p.target, (RIDGES, 1)), ridges).alpha
            off.append(max(np.abs(a - linear(replace(p, ridge=r))).max() for a, r in zip(path, ridges, strict=True)))
        targets = np.tile(first.target, (RIDGES, 1))
        began = time.perf_counter()
        solver.solve_many(first, targets, ridges)
        took = 1000 * (time.perf_counter() - began)
        if name == "kkt":
            took = timed(lambda: solver.solve_many(first, targets, ridges))  # noqa: B023  # called at once
            rows.append(line(f"{name}: {RIDGES} ridges, N = {n} [ms]", round(took, 3), target="<= 10"))
        more = {} if name == "kkt" else {"ms": round(took, 1), "by": {"ms": f"{took:.0f}"}}
        rows.append(
            line(f"{name}: {RIDGES} ridges, N = {n}", float(max(off)), target=f"<= {CLOSE:g}", of=RIDGES, **more)
        )
    return rows


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solvers", description=__doc__)
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)), help="numbers of exemplars")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="problems of each kind and size")
    parser.add_argument("--only", help="one solver")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "solvers.json")
    options = parser.parse_args(given)
    talk, plugins, tables = Console(stderr=True), Plugins.load().report(), {}
    sizes = [int(size) for size in options.sizes.split(",")]
    names = [name for kind, name in plugins.offers if kind == "solver" and options.only in (None, name)]
    specs = {name: Spec(name, **EXACT.get(name, {})) for name in sorted(names)}
    solvers: dict[str, Solver] = {name: plugins.make("solver", spec) for name, spec in specs.items()}
    with threadpool_limits(options.threads):
        known = {(case, n): [make(s, n) for s in range(options.seeds)] for case, make in CASES.items() for n in sizes}
        for name, solver in solvers.items():
            taken = {key: problems for key, problems in known.items() if takes(solver, problems[0][0])}
            rows = [solved(case, solver, n, problems) for (case, n), problems in taken.items()]
            plain = [one for problems in taken.values() for one in problems if not terms(one[0])]
            rows += [truthful(solver, plain), *recognised(solver, sizes, options.seeds)]
            rows += [row for ranges in (False, True) if (row := named(solver, ranges=ranges))]
            lacking = [case for case in CASES if not any(case == key[0] for key in taken)]
            notes = [
                "largest difference of alpha (cost: of the cost) from the independent answer; median ms of one solve"
            ]
            tables[name] = {"rows": rows, "notes": [*notes, *([f"not taken: {'; '.join(lacking)}"] if lacking else [])]}
            show(talk, str(specs[name]), tables[name])
        if 100 in sizes:
            notes = ["from the closed form, ridge by ridge"]
            tables["path of ridges"] = {"rows": paths(solvers, options.seeds), "notes": notes}
            show(talk, "path of ridges", tables["path of ridges"])
    settings = {"solvers": {name: str(spec) for name, spec in specs.items()}}
    packages = {name: version(name) for name in ("numpy", "scipy", "casadi", "cvxpy", "clarabel")}
    settings |= {"sizes": sizes, "seeds": options.seeds, "threads": options.threads, **packages}
    put(stamped("solvers", **settings) | {"tables": tables}, options.out, out=True)
    return 0 if all(row["met"] is not False for found in tables.values() for row in found["rows"]) else 1


if __name__ == "__main__":
    sys.exit(main())
