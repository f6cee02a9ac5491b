"""What steps, points and precision make of `sdf-mlp`: ``python -m benchmarks.optimizers --help`` (docs/performance.md).

The bank of one body's morphs by several options, one after another. How well a mixed network is at targets of which the
true surface is known is told by the mean of |f| on that surface: no mesh is made, so no cell is in the way.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence

import numpy as np
import torch
from rich.console import Console

import lampopt
from lampopt.errors import LampoptError
from lampopt.mix import mixed_weights
from lampopt.types import Array, Bank, Problem, Spec

from .body import Body, judge_at
from .common import Bench, Row, options, threads
from .document import put, show, stamped

TARGETS, ON_SURFACE = 8, 4000  # a factor, and points on each true surface
ADAM = {"optimizer": "adam", "steps": 500, "points": 4096}
WAYS = {
    "Adam, float32, 500 steps of 4,096 points": {**ADAM, "precision": "float32"},
    "Adam, bfloat16, the same": {**ADAM, "precision": "bfloat16"},
    "Adam, float32, 600 of 1,024": {"optimizer": "adam", "precision": "float32"},
    "Muon, float32, 600 of 1,024": {"precision": "float32"},
    "Muon, bfloat16, 600 of 1,024 (default)": {"precision": "bfloat16"},
    "Muon, bfloat16, 300 of 1,024": {"precision": "bfloat16", "steps": 300},
    "Muon, bfloat16, 300 of 4,096": {"precision": "bfloat16", "steps": 300, "points": 4096},
}


def off(bank: Bank, body: Body, solver: lampopt.protocols.Solver, decoder: lampopt.protocols.Decoder) -> Array:
    """(factors,) mean |f| [mm] of the mixes at targets, on the targets' true surfaces."""
    names = tuple(q.name for q in bank.space)
    order = [body.names.index(name) for name in names]
    found = []
    for f in body.factors:
        values = []
        for target in body.targets(f)[:TARGETS]:
            alpha = solver.solve(Problem(names, bank.parameters.T, np.asarray(target)[order])).alpha
            true = bank.frame.to_box(body.truth(target)).sample(ON_SURFACE, seed=0)
            values.append(np.abs(decoder.evaluate(bank.shared, mixed_weights(bank, alpha), true)).mean())
        found.append(1e3 * np.mean(values) / bank.frame.scale / body.metre)
    return np.array(found)


def table(bench: Bench, body: Body) -> Row:
    """A line for each way: seconds, how well exemplars are met, how well targets are."""
    exemplars, lines = body.exemplars(), []
    solver = bench.plugins.make("solver", "kkt")
    quick = {"start_steps": 200, "steps": 50, "samples": 10_000} if bench.quick else {}
    for name, chosen in WAYS.items():
        spec = Spec("sdf-mlp", **{**chosen, **quick})
        began = time.perf_counter()
        with bench.stage(name):
            bank = lampopt.build_bank(exemplars, spec, seed=bench.seed, batch=len(exemplars), plugins=bench.plugins)
        seconds = time.perf_counter() - began
        errors = off(bank, body, solver, bench.plugins.make("decoder", spec))
        met = 1e3 * float(bank.fit_error.mean()) / bank.frame.scale / body.metre
        away = float(np.linalg.norm(bank.weights - bank.shared["start"], axis=1).mean())
        shown = {f"f = {f:g} [mm]": float(error) for f, error in zip(body.factors, errors, strict=True)}
        told = ", ".join(f"{key} {error:.2f}" for key, error in shown.items())
        lines.append({"name": name, "value": met, "bank [s]": seconds, **shown, "from the start": away})
        lines[-1]["note"] = f"{seconds:.1f} s; {told}; {away:.2f} from the start"
    return {
        "rows": lines,
        "notes": [
            f"value: exemplars [mm]; {TARGETS} targets a factor; seconds of the whole bank, intake and sampling too"
        ],
    }


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.optimizers", description=__doc__)
    parser.add_argument("--body", default="Hybrid", help="of the judge's")
    options(parser, decoder="sdf-mlp")
    parser.set_defaults(threads=os.cpu_count())
    parser.add_argument("--quick", action="store_true", help="does it run at all; no figures to quote")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    torch.set_num_threads(args.threads)
    try:
        bench = Bench.of(args, talk)
        with threads(args.threads):
            found = table(bench, Body(bench, judge_at(args.judge), args.body))
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    if not args.json:
        show(Console(), f"{args.body}, sdf-mlp", found)
    document = stamped("optimizers", body=args.body, threads=args.threads, seed=args.seed) | {"tables": {"ways": found}}
    put(document | {"seconds": bench.seconds}, args.out and args.out / "optimizers.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
