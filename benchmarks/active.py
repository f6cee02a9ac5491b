"""How often drag is evaluated until it is 10 % down: ``python -m benchmarks.active --help`` (docs/performance.md).

Three ways to one wish, the cases of benchmarks/drag.py: every exemplar labelled, then the closed loop; active learning,
which measures a few; COBYLA on the measure itself. Every mesh that a way has drag measured on counts once, those of the
exemplars and the reference too, up to the first that is within half a percent of the reference's drag from the target.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console

import lampopt
from lampopt.errors import LampoptError

from .body import Body, judge_at
from .common import Bench, Row, line, options, source, threads
from .document import put, show, stamped
from .drag import CUT, Once, Studies, cases, of_body

CASES = 20
BUDGET = 100
CLOSE = 0.005  # of the reference's drag
WAYS = ("label, then solve", "active", "cobyla")


def until(asked: Once, start: float, before: int) -> int | None:
    """How many meshes there were to the first that is close, with those `before`; None where none is."""
    wanted = (1 - CUT) * start
    close = [k for k, value in enumerate(asked.known.values(), 1) if abs(value[0] - wanted) <= CLOSE * start]
    return before + close[0] if close else None


def way(studies: Studies, name: str, reference: int, held: tuple[str, ...]) -> Row:
    """Evaluations that one way takes for one case."""

    def make() -> Row:
        bench, bank = studies.bench, studies.bank
        drag = Once(studies.drag)
        start = float(studies.reference(reference)["drag"])
        asked = lampopt.Study(
            bank, keep=held, reference=bank.names[reference], measures={"truth": drag}, resolution=bench.resolution
        )
        before = 0
        if name == "label, then solve":
            before = len(bank) - 1  # the reference is measured again
            goal = lampopt.Reduce("drag", by=CUT)
            lampopt.run(
                replace(asked, objective=goal, measured={"drag": "truth.drag"}, turns=20), plugins=bench.plugins
            )
        elif name == "active":
            goal = lampopt.Reduce("truth.drag", by=CUT)
            lampopt.active(replace(asked, objective=goal), budget=BUDGET, tolerance=CLOSE, plugins=bench.plugins)
        else:
            solver = lampopt.Spec("nlopt", algorithm="cobyla", evaluations=BUDGET)
            target = {"truth.drag": (1 - CUT) * start}
            before = 1  # the reference tells the target
            lampopt.run(replace(asked, targets=target, hard=held, solver=solver), plugins=bench.plugins)
        return {"evaluations": until(drag, start, before)}

    known = studies.known(name, reference, list(held), BUDGET, CLOSE, source(sys.modules[__name__]))
    return studies.bench.scores.get(known, make)


def table(studies: Studies, count: int) -> Row:
    """Medians over the cases by way, and how many came close."""
    names, bench = [q.name for q in studies.bank.space], studies.bench
    lines = []
    chosen = cases(count, len(studies.bank), names, bench.seed)
    for name in WAYS:
        with bench.stage(name) as tell:
            rows = []
            for number, (reference, held) in enumerate(chosen):
                tell(number / count)
                rows.append(way(studies, name, reference, held)["evaluations"])
        found = [row for row in rows if row is not None]
        middle = float(np.median([np.inf if row is None else row for row in rows]))
        lines.append(line(f"{name}: evaluations, median", middle, of=len(rows), by={"came close": len(found)}))
        lines.append(line(f"{name}: evaluations, most of those that came close", float(max(found, default=np.nan))))
    return {"rows": lines, "notes": [f"within {CLOSE:.1%} of the reference's drag; at most {BUDGET} evaluations"]}


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.active", description=__doc__)
    parser.add_argument("--body", default="Hybrid", help="of the judge's")
    parser.add_argument("--cases", type=int, default=CASES)
    options(parser, decoder="mesh-template")
    parser.add_argument("--quick", action="store_true", help="does it run at all; no figures to quote")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    try:
        bench = Bench.of(args, talk)
        with threads(args.threads):
            found = table(of_body(Body(bench, judge_at(args.judge), args.body), notes := []), args.cases)
        found["notes"] += notes
        if not args.json:
            show(Console(), f"{args.body}, {args.decoder}", found)
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    settings = {"decoder": args.decoder, "seed": args.seed, "resolution": args.resolution, "cases": args.cases}
    document = stamped("active", body=args.body, **settings) | {"tables": {"evaluations": found}}
    put(document | {"seconds": bench.seconds}, args.out and args.out / f"active-{args.body}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
