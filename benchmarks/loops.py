"""The closed loop and the neighbourhood of a reference, on the judge's bodies: ``python -m benchmarks.loops --help``.

Closed loop: all eight parameters drawn at once at range factor 2; the parameters that explain the mesh best
(benchmarks/inverse.py) against what was asked, before and after corrections; the judge's surface error beside.
Neighbourhood: "this car, roof lower": one parameter asked of a reference, the other seven read before and after.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from rich.console import Console

import lampopt
from lampopt.errors import LampoptError
from lampopt.types import Array

from .body import Body, judge_at
from .common import Bench, Row, counts, judged, line, options, share, threads
from .document import put, show, stamped
from .drag import Studies, of_body

FACTOR = 2.0
REFERENCES = 6
STEP = 0.5  # of the range, to the side where there is more of it


def closed(body: Body, studies: Studies, turns: int) -> Row:
    """Errors of all designs at the factor, before and after."""
    bench = studies.bench
    spread = np.asarray(body.judge.HIGH - body.judge.LOW)
    found: dict[int, list[Row]] = {0: [], turns: []}
    with bench.stage(f"{body.name}: {len(body.targets(FACTOR))} designs at f={FACTOR:g}") as tell:
        for number, target in enumerate(body.targets(FACTOR)):
            tell(number / len(body.targets(FACTOR)))
            for count, rows in found.items():
                rows.append(_made(body, studies, target, count))
    lines = []
    before, after = (_off(rows, spread, body.targets(FACTOR)) for rows in found.values())
    lines.append(line("measured error, open loop [range]", before))
    lines.append(line("measured error, closed loop [range]", after))
    lines.append(line("of before", after / before, target="<= 0.2"))
    for name, rows in zip(("open", "closed"), found.values(), strict=True):
        errors = [row["error"]["mean"] for row in rows if row["error"]]
        lines.append(line(f"surface error, {name} loop [mm]", 1000 * float(np.mean(errors))))
        lines.append(
            line(
                f"accepted, {name} loop", share([r for r in rows if r["accepted"]], rows), of=len(rows), by=counts(rows)
            )
        )
    return {"rows": lines, "notes": [f"mean over {len(found[0])} designs and 8 parameters; {turns} corrections"]}


def _made(body: Body, studies: Studies, target: Array, turns: int) -> Row:
    bench, read = studies.bench, studies.reading

    def make() -> Row:
        study = lampopt.Study(
            studies.bank,
            targets=dict(zip(read.names, target.tolist(), strict=True)),
            measures={"family": read},
            measured={name: f"family.{name}" for name in read.names},
            turns=turns,
            resolution=bench.resolution,
        )
        result = lampopt.run(study, plugins=bench.plugins)
        mesh = result.design.mesh
        error = None if mesh is None else body.error(mesh, target)
        return judged(result) | {"read": studies.read(mesh), "error": error}

    return bench.scores.get(studies.known("loop", target.tolist(), turns, body.where(target)), make)


def _off(rows: list[Row], spread: Array, targets: Array) -> float:
    """Mean of what is off [range]; where nothing can be read, as if the middle of the range had been made."""
    asked = targets / spread
    middle = np.zeros(len(spread))
    read = [
        middle if row["read"]["parameters"] is None else np.array(row["read"]["parameters"]) / spread for row in rows
    ]
    return float(np.abs(np.array(read) - asked).mean())


def neighbourhood(body: Body, studies: Studies) -> Row:
    """One parameter asked of a reference: how far the others move [range]."""
    bench, bank = studies.bench, studies.bank
    names, spread = list(body.judge.NAMES), np.asarray(body.judge.HIGH - body.judge.LOW)
    low, high = np.asarray(body.judge.LOW), np.asarray(body.judge.HIGH)
    moved, asked, rows = [], [], []
    with bench.stage(f"{body.name}: neighbourhood") as tell:
        for reference in range(REFERENCES):
            tell(reference / REFERENCES)
            first = np.array(studies.reference(reference)["parameters"]) / spread
            for k, name in enumerate(names):
                at = float(bank.parameters[reference, k])
                side = 1.0 if at < (low[k] + high[k]) / 2 else -1.0
                row = _near(studies, reference, name, at + side * STEP * float(spread[k]))
                found = np.array(row["read"]["parameters"]) / spread
                change = found - first
                asked.append(abs(change[k] - side * STEP))
                moved.append(np.abs(np.delete(change, k)))
                rows.append(row)
    lines = [
        line("largest move of an untouched parameter [range]", float(np.max(moved)), target="<= 0.02"),
        line("mean move of an untouched parameter [range]", float(np.mean(moved))),
        line("the asked one is off by [range]", float(np.mean(asked))),
        line("accepted", share([row for row in rows if row["accepted"]], rows), of=len(rows), by=counts(rows)),
    ]
    return {"rows": lines, "notes": [f"{REFERENCES} references, each parameter alone by {STEP:g} of its range"]}


def _near(studies: Studies, reference: int, name: str, value: float) -> Row:
    def make() -> Row:
        resolution = studies.bench.resolution
        study = lampopt.Study(
            studies.bank, targets={name: value}, reference=studies.bank.names[reference], resolution=resolution
        )
        result = lampopt.run(study, plugins=studies.bench.plugins)
        return judged(result) | {"read": studies.read(result.design.mesh)}

    return studies.bench.scores.get(studies.known("near", reference, name, value), make)


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.loops", description=__doc__)
    parser.add_argument("--body", action="append", help="of the judge's; repeatable; default: all")
    parser.add_argument("--turns", type=int, default=3, help="corrections in closed loop")
    options(parser, decoder="mesh-template")
    parser.add_argument("--quick", action="store_true", help="does it run at all; no figures to quote")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    tables = {}
    try:
        judge = judge_at(args.judge)
        bench = Bench.of(args, talk)
        with threads(args.threads):
            for name in args.body or list(judge.LENGTH):
                body, notes = Body(bench, judge, name), list[str]()
                studies = of_body(body, notes)
                for what, table in (
                    ("closed loop", closed(body, studies, args.turns)),
                    ("neighbourhood", neighbourhood(body, studies)),
                ):
                    table["notes"] += notes
                    tables[f"{name}, {what}"] = table
                    if not args.json:
                        show(Console(), f"{name}, {args.decoder}, {what}", table)
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    settings = {"decoder": args.decoder, "seed": args.seed, "resolution": args.resolution, "turns": args.turns}
    document = stamped("loops", **settings) | {"tables": tables, "seconds": bench.seconds}
    file = "-".join(["loops", *(args.body or []), args.decoder])
    put(document, args.out and args.out / f"{file}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
