"""Chain-rule gradients against differences, and what they save: ``python -m benchmarks.gradients --help``.

A measure's value on the mesh, by alpha: d value / d alpha = W · pullback(d value / d vertices). Compared with central
differences along every exemplar's direction, both freed of their part along the sum: the cosine of the two. Then the
same drag, 10 % below the reference's, sought by MMA with these gradients and by COBYLA without.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence

import numpy as np
from rich.console import Console

import lampopt
from lampopt.bank import decoder_of
from lampopt.chain import Chain
from lampopt.errors import LampoptError
from lampopt.protocols import Measure
from lampopt.types import Array

from .body import Body, judge_at
from .common import Bench, Row, line, options, threads
from .document import put, show, stamped

STEP = 0.01  # of alpha, to either side
PLACES = 4  # mixes at which gradients are compared
CUT = 0.10
NEAR = 0.3  # size of alpha − centre at those


def places(count: int, n: int, seed: int) -> Array:
    """(count, n) random mixes near the mean."""
    draw = np.random.default_rng(seed).normal(size=(count, n))
    draw -= draw.mean(1, keepdims=True)
    return 1 / n + NEAR * draw / np.linalg.norm(draw, axis=1, keepdims=True)


def cosines(chain: Chain, name: str, measure: Measure, place: int, at: Array, step: float) -> list[float]:
    """Of the chain rule's gradients and those by differences."""
    found = []
    for alpha in at:
        exact = chain.gradient(name, measure, place, alpha)
        rough = np.array(
            [
                chain.values(name, measure, alpha + side)[place] - chain.values(name, measure, alpha - side)[place]
                for side in step * (np.eye(len(alpha)) - 1 / len(alpha))
            ]
        )
        exact = exact - exact.mean()
        rough = rough - rough.mean()
        found.append(float(exact @ rough / np.linalg.norm(exact) / np.linalg.norm(rough)))
    return found


def compared(bench: Bench, bank: lampopt.Bank, measures: dict[str, tuple[Measure, str]], step: float) -> list[Row]:
    chain = Chain(bank, decoder_of(bank, bench.plugins), bench.resolution)
    at, lines = places(PLACES, len(bank), bench.seed), []
    for name, (measure, value) in measures.items():
        place = tuple(measure.names).index(value)
        with bench.stage(f"{bank.decoder.name}: {name}.{value}"):
            found = cosines(chain, name, measure, place, at, step)
        lines.append(line(f"{bank.decoder.name}: {name}.{value}, least cosine", min(found), target=">= 0.999"))
    return lines


def searched(bench: Bench, bank: lampopt.Bank, drag: Measure, most: int) -> list[Row]:
    """Evaluations to a drag 10 % below the reference's, by algorithm."""
    lines = []
    for algorithm in ("mma", "slsqp", "cobyla"):
        reference = lampopt.design(bank, {}, reference=bank.names[0], measures={"drag": drag}, plugins=bench.plugins)
        wanted = (1 - CUT) * reference.check("drag.drag").value
        study = lampopt.Study(
            bank, targets={"drag.drag": wanted}, reference=bank.names[0], measures={"drag": drag},
            solver=lampopt.Spec("nlopt", algorithm=algorithm, evaluations=most), resolution=bench.resolution,
        )  # fmt: skip
        with bench.stage(f"search by {algorithm}"):
            result = lampopt.run(study, plugins=bench.plugins)
        off = abs(result.check("drag.drag").value / wanted - 1)
        count = re.search(r"(\d+) evaluations", result.design.mix.message)
        lines.append(
            line(f"evaluations by {algorithm}", float(count.group(1)) if count else float("nan"), off=off,
                 accepted=result.accepted)
        )  # fmt: skip
    return lines


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients", description=__doc__)
    parser.add_argument("--body", default="hatchback", help="of the judge's")
    parser.add_argument("--evaluations", type=int, default=200, help="at most, of each search")
    parser.add_argument("--fields", default="sdf-mlp", help="decoder of signed distances; none: leave it out")
    options(parser, decoder="mesh-template")
    parser.add_argument("--quick", action="store_true", help="does it run at all; no figures to quote")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    tables: dict[str, Row] = {}
    try:
        judge = judge_at(args.judge)
        bench = Bench.of(args, talk)
        with threads(args.threads):
            body = Body(bench, judge, args.body)
            cars = body.exemplars()
            bank = body.bank(cars, bench.decoder, notes := [])
            with bench.stage("surrogate of drag"):
                drag = lampopt.fit_surrogate(
                    cars, "pointnet-lasso", names=("drag",), seed=args.seed, plugins=bench.plugins
                )
            made = {name: bench.plugins.make("measure", name) for name in ("volume", "area")}
            sizes = {name: (measure, measure.names[0]) for name, measure in made.items()}
            lines = compared(bench, bank, {"pointnet": (drag, "drag"), **sizes}, STEP)
            if args.fields != "none":
                fields = body.bank(cars, lampopt.Spec(args.fields), notes)
                lines += compared(bench, fields, sizes, STEP)
            tables["cosines"] = {"rows": lines, "notes": [f"{PLACES} mixes, ‖alpha − 1/N‖ = {NEAR:g}", *notes]}
            rows = searched(bench, bank, drag, args.evaluations)
            tables["evaluations"] = {"rows": rows, "notes": ["to a surrogate's drag 10 % below the reference's"]}
            for name, table in tables.items():
                if not args.json:
                    show(Console(), f"{args.body}, {name}", table)
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    settings = {"decoder": args.decoder, "seed": args.seed, "resolution": args.resolution}
    document = stamped("gradients", body=args.body, **settings) | {"tables": tables, "seconds": bench.seconds}
    put(document, args.out and args.out / f"gradients-{args.body}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
