"""The paper's table 4 on the judge's bodies: ``python -m benchmarks.sweeps --help`` (docs/performance.md).

50 exemplars a body, each parameter alone swept to ±100 % (range factor 3), read off the mesh that was made and
calibrated on the exemplars (benchmarks/sections.py); every design counts. Beside it the same on the true shapes: what
the reading itself costs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console

import lampopt
from lampopt.errors import LampoptError
from lampopt.metrics import mean_absolute_error, r_squared
from lampopt.types import Array

from . import sections
from .body import Body, judge_at
from .common import Bench, Row, counts, judged, line, options, share, source, threads
from .document import put, show, stamped
from .sections import Reading

EXEMPLARS, STEPS, WIDEST = 50, 11, 3.0
PAPER = "0.97, 0.99, 0.93 (sports car, SUV, convertible)"


@dataclass(frozen=True, eq=False)
class Family(Body):
    """A body with as many exemplars as the paper has."""

    @property
    def size(self) -> tuple[int, int, float, int]:
        return (20, 2, 0.12, 2_000) if self.bench.quick else (EXEMPLARS, 16, 0.04, 20_000)

    @property
    def asked(self) -> Array:
        """(8, STEPS, 8) parameters of the sweeps."""
        middle, half = (self.judge.LOW + self.judge.HIGH) / 2, (self.judge.HIGH - self.judge.LOW) / 2
        at = np.tile(middle, (len(middle), STEPS, 1))
        for k in range(len(middle)):
            at[k, :, k] += np.linspace(-WIDEST, WIDEST, STEPS) * half[k]
        return at

    def read(self, bank: lampopt.Bank, reading: Reading, target: Array) -> Row:
        """What the design at `target` is judged and read as."""
        asked = dict(zip(self.judge.NAMES, target.tolist(), strict=True))
        known = ["sweep", self.bench.identity(bank), source(sections), reading.lines.tolist(), self.where(target)]

        def make() -> Row:
            result = lampopt.design(bank, asked, resolution=self.bench.resolution, plugins=self.bench.plugins)
            mesh = result.design.mesh
            return judged(result) | {"read": None if mesh is None else reading(mesh).tolist()}

        return self.bench.scores.get(known, make)


def table(family: Family) -> Row:
    """R² and mean absolute error of each parameter over its own sweep, and of the body."""
    bench, judge = family.bench, family.judge
    cars = family.exemplars()
    bank = family.bank(cars, bench.decoder, notes := [])
    with bench.stage(f"{family.name}: reading exemplars"):
        reading = Reading.of(cars.meshes, np.asarray(cars.parameters))
    asked, base = family.asked, family.base()
    rows, found = [], np.empty(asked.shape[:2])
    for k, sweep in enumerate(asked):
        with bench.stage(f"{family.name}: {judge.NAMES[k]}") as tell:
            for i, target in enumerate(sweep):
                tell(i / len(sweep))
                row = family.read(bank, reading, target)
                value = np.nan if row["read"] is None or row["read"][k] is None else float(row["read"][k])
                found[k, i] = value if np.isfinite(value) else asked[k, STEPS // 2, k]  # what is not read: the middle
                rows.append(row)
    with bench.stage(f"{family.name}: true shapes"):
        true = np.array([[reading(judge.morph(base, target))[k] for target in sweep] for k, sweep in enumerate(asked)])
    wanted = np.array([sweep[:, k] for k, sweep in enumerate(asked)])
    spread = (judge.HIGH - judge.LOW)[:, None]
    each = [r_squared(w, f) for w, f in zip(wanted, found, strict=True)]
    lines = [
        line(f"R² {name}", each[k], true=r_squared(wanted[k], true[k]), mae=mean_absolute_error(wanted[k], found[k]))
        for k, name in enumerate(judge.NAMES)
    ]
    lines += [
        line(
            "R² of the body",
            r_squared((wanted / spread).ravel(), (found / spread).ravel()),
            target=">= 0.99",
            paper=PAPER,
        ),
        line("least R² of a parameter", min(each)),
        line("mean absolute error [range]", mean_absolute_error((wanted / spread).ravel(), (found / spread).ravel())),
        line(
            "the same of true shapes [range]", mean_absolute_error((wanted / spread).ravel(), (true / spread).ravel())
        ),
        line("accepted", share([row for row in rows if row["accepted"]], rows), of=len(rows), by=counts(rows)),
    ]
    return {"rows": lines, "notes": [*notes, "a design that cannot be read counts as the middle of the range"]}


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sweeps", description=__doc__)
    parser.add_argument("--body", action="append", help="of the judge's; repeatable; default: all")
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
                tables[name] = table(Family(bench, judge, name))
                if not args.json:
                    show(Console(), f"{name}: {args.decoder}", tables[name])
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    settings = {"decoder": args.decoder, "seed": args.seed, "resolution": args.resolution, "threads": args.threads}
    document = stamped("sweeps", **settings) | {"tables": tables, "seconds": bench.seconds}
    name = "-".join(["sweeps", *(args.body or []), args.decoder])
    put(document, args.out and args.out / f"{name}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
