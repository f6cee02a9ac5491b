"""How often drag is evaluated until it is 10 % down: ``python -m benchmarks.active --help`` (docs/performance.md).

Three ways to one wish, the cases of benchmarks/drag.py: every exemplar labelled, then the closed loop; active learning,
which measures a few; COBYLA on the measure itself. Every mesh that a way has drag measured on counts once, those of the
exemplars and the reference too, up to the first design that is within half a percent of the reference's drag from the
target and has what is held, as it is read from the mesh, within a hundredth of its range from the reference's. With
`--flow` drag is OpenFOAM's, of the cars of `make drag` with their labels, length, width and roof held as they are
measured, which every way is told of.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from rich.console import Console
from trimesh import Trimesh

import lampopt
from lampopt.errors import LampoptError
from lampopt.plane import MODEL
from lampopt.types import Array

from .body import Body, judge_at
from .common import ROOT, Bench, Row, core, line, module_at, options, source, threads
from .document import put, show, stamped
from .drag import CUT, Once, Some, Studies, cases, of_body

CASES, FLOW_CASES = 20, 3
BUDGET = 100
CLOSE = 0.005  # of the reference's drag
KEPT = 0.01  # of a parameter's range: how far what is held may be off
WAYS = ("label, then solve", "active", "cobyla")
EXAMPLE = ROOT / "examples" / "drag"
LABELLED = {"level": "coarse", "placements": 3}  # how the labels of the example were made
HELD = {"length": "extents.length", "width": "extents.width", "roof": "extents.height"}  # as they are measured
TURNS = 20
EXEMPLARS, EDGE_MM = 24, 60.0  # of the example, by default


class Reached(KeyboardInterrupt):
    """A search is there: an interrupt, which nothing on the way may take for a failed measure."""


@dataclass(frozen=True, eq=False)
class Until(Once):
    """The same; what is said of designs that are `there` is noted in `met`, and ends the search if that `stops`."""

    there: Callable[[float, Trimesh], bool] = lambda value, mesh: False
    stops: bool = True
    met: list[float] = field(default_factory=list)

    def __call__(self, mesh: Trimesh) -> Array:
        value = super().__call__(mesh)
        if self.there(float(value[0]), mesh):
            self.met.append(float(value[0]))
            if self.stops:
                raise Reached
        return value


def asked(studies: Studies, reference: int, held: tuple[str, ...]) -> Callable[[float, Trimesh], bool]:
    """Whether a mesh of such drag is what was asked for, against the reference as the bank makes it."""
    first, space = studies.reference(reference), [q.name for q in studies.bank.space]
    places = [studies.reading.names.index(studies.reads.get(name, name).rpartition(".")[2]) for name in held]
    spread = np.ptp(studies.bank.parameters, axis=0)[[space.index(name) for name in held]]
    start, wanted = first["drag"], np.array(first["parameters"])[places]

    def there(value: float, mesh: Trimesh) -> bool:
        if not abs(value - (1 - CUT) * start) <= CLOSE * start:
            return False
        found = studies.read(mesh)["parameters"]
        return found is not None and bool((np.abs(np.array(found)[places] - wanted) <= KEPT * spread).all())

    return there


def way(studies: Studies, name: str, reference: int, held: tuple[str, ...]) -> Row:
    """Evaluations that one way takes for one case; None where it does not come close."""

    def make() -> Row:
        bench, bank = studies.bench, studies.bank
        drag = Until(studies.drag, there=asked(studies, reference, held), stops=name != "active")
        study = lampopt.Study(
            bank,
            keep=held,
            reference=bank.names[reference],
            measures={"truth": drag},
            measured={name: studies.reads[name] for name in held if name in studies.reads},
            turns=TURNS if studies.reads else 0,
            resolution=bench.resolution,
        )
        goal = lampopt.Reduce("drag", by=CUT)
        if name == "active":
            study = replace(study, objective=replace(goal, name="truth.drag"))
            trials = lampopt.active(study, budget=BUDGET, tolerance=CLOSE, plugins=bench.plugins).trials
            there = [k for k, trial in enumerate(trials, 1) if np.isfinite(trial.predicted)]  # no exemplars
            return {"evaluations": next((k for k in there if trials[k - 1].value in drag.met), None)}
        if name == "label, then solve":
            before = len(bank) - 1  # the reference is measured again
            study = replace(study, objective=goal, measured={**study.measured, "drag": "truth.drag"}, turns=TURNS)
        else:
            before = 0  # the reference is measured for the scale of drag, and is where the search starts
            solver = lampopt.Spec("nlopt", algorithm="cobyla", evaluations=BUDGET)
            first = studies.reference(reference)
            known = dict(zip(studies.reading.names, first["parameters"], strict=True))
            read = {where: known[where.rpartition(".")[2]] for where in study.measured.values()}
            still = tuple(name for name in held if name not in study.measured)
            targets = {"truth.drag": (1 - CUT) * first["drag"], **read}
            study = replace(
                study, targets=targets, keep=still, hard=(*still, *read), measured={}, turns=0, solver=solver
            )
        try:
            lampopt.run(study, plugins=bench.plugins)
        except Reached:
            return {"evaluations": before + len(drag.known)}
        return {"evaluations": None}

    ours = [*core("active", "evaluations", "fitted", "goals", "study"), source(sys.modules[__name__])]
    used = [source(studies.bench.plugins.get(*which).resolve()) for which in (("solver", "nlopt"), ("model", MODEL))]
    case = studies.known(name, reference, list(held), BUDGET, CLOSE, KEPT, ours, used)
    return studies.bench.scores.get(case, make)


def of_flow(bench: Bench, workers: int) -> Studies:
    """The cars of `make drag`, labelled as its seed 0 was; drag is OpenFOAM's on the same placements of the grid."""
    module_at(EXAMPLE / "picture.py")  # which the example imports
    example = module_at(EXAMPLE / "drag.py")
    cars, _ = example.cached(example.family(bench.cache / "cars", EXEMPLARS, 0, EDGE_MM), EXAMPLE / "labels.csv")
    flow = lampopt.Spec("openfoam-drag", **LABELLED, workers=workers, folder=str((bench.cache / "flows").absolute()))
    drag = Some(bench.plugins.make("measure", flow), ("drag",))
    code: list[object] = ["flow", LABELLED, drag.of.program()]
    return Studies(
        bench, bench.bank("cars", cars, bench.decoder), drag, bench.plugins.make("measure", "extents"), code, HELD
    )


def table(studies: Studies, chosen: Sequence[tuple[int, tuple[str, ...]]]) -> Row:
    """Medians over the cases by way, and how many came close."""
    bench, count = studies.bench, len(chosen)
    lines = []
    for name in WAYS:
        with bench.stage(name) as tell:
            rows = []
            for number, (reference, held) in enumerate(chosen):
                tell(number / count)
                rows.append(way(studies, name, reference, held)["evaluations"])
                bench.console.print(f"[dim]{name}, case {number + 1}: {rows[-1]}[/dim]", highlight=False)
        found = [row for row in rows if row is not None]
        middle = float(np.median([np.inf if row is None else row for row in rows]))
        lines.append(line(f"{name}: evaluations, median", middle, of=len(rows), by={"came close": len(found)}))
        lines.append(line(f"{name}: evaluations, most of those that came close", float(max(found, default=np.nan))))
    within = f"within {CLOSE:.1%} of the reference's drag, what is held within {KEPT:.0%} of its range"
    return {"rows": lines, "notes": [f"{within}; at most {BUDGET} evaluations"]}


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.active", description=__doc__)
    parser.add_argument("--body", default="Hybrid", help="of the judge's")
    parser.add_argument("--cases", type=int, help=f"by default {CASES}, with --flow {FLOW_CASES}")
    parser.add_argument("--flow", action="store_true", help="drag by OpenFOAM, of the cars of examples/drag")
    parser.add_argument("--workers", type=int, default=2, help="flows at a time")
    options(parser, decoder="mesh-template")
    parser.add_argument("--quick", action="store_true", help="does it run at all; no figures to quote")
    args = parser.parse_args(given)
    talk, body = Console(stderr=True), "flow" if args.flow else args.body
    try:
        bench = Bench.of(args, talk)
        with threads(args.threads):
            notes = list[str]()
            if args.flow:
                studies, count = of_flow(bench, args.workers), args.cases or FLOW_CASES
                base, draw = studies.bank.names.index("base"), np.random.default_rng(args.seed)
                others = draw.permutation(np.delete(np.arange(len(studies.bank)), base))
                chosen = [(k, tuple(HELD)) for k in (base, *others[: count - 1].tolist())]
            else:
                studies = of_body(Body(bench, judge_at(args.judge), args.body), notes)
                names = [q.name for q in studies.bank.space]
                chosen = cases(args.cases or CASES, len(studies.bank), names, args.seed)
            found = table(studies, chosen)
        found["notes"] += notes
        if not args.json:
            show(Console(), f"{body}, {args.decoder}", found)
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    settings = {"decoder": args.decoder, "seed": args.seed, "resolution": args.resolution, "cases": len(chosen)}
    document = stamped("active", body=body, **settings) | {"tables": {"evaluations": found}}
    put(document | {"seconds": bench.seconds}, args.out and args.out / f"active-{body}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
