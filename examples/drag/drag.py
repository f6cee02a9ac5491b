"""Ten per cent less drag, confirmed by a flow solver: ``make drag`` or ``python examples/drag/drag.py --help``.

A sedan in seven deformations; each exemplar is solved by OpenFOAM. Length, width and roof held, 10 % less drag are
asked of the mix, what comes is solved and the ask corrected. At last design and reference are solved anew, both on the
same placements of the grid, which the search never saw. Everything is kept in FOLDER; the same command goes on there.
"""

import argparse
import csv
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
from picture import pictures
from rich.console import Console
from rich.table import Table

import lampopt
from lampopt.errors import InputError, LampoptError
from lampopt.meshfile import load_mesh
from lampopt.plugins import Plugins
from lampopt.pool import processes
from lampopt.progress import progress_bar
from lampopt.types import Parameter, Spec

HERE = Path(__file__).parent
HELD = {"length": "extents.length", "width": "extents.width", "roof": "extents.height"}
CUT = 0.10
PAIRED = 0.026  # standard deviation of a change of drag from placement to placement (benchmarks/flow.py)
FRESH = 100  # number of the first placement that the search never saw
FINER = {"coarse": "medium", "medium": "fine"}


def family(folder, count, seed, edge, wider=1.0):
    """Exemplars: the middle car of the family `car` and its deformations, those that are not held `wider` as far."""
    folder.mkdir(parents=True, exist_ok=True)
    sedan = lampopt.exemplars("car", design="ends", count=33, edge=edge).meshes[0]
    sedan.export(folder / "sedan.stl")
    known = tomllib.loads((HERE / "family.toml").read_text(encoding="utf-8"))
    free = {name: one for name, one in known.items() if name not in HELD}
    ranges = ", ".join(f"{name}={wider * one['low']:g}:{wider * one['high']:g}" for name, one in free.items())
    options = {"custom": HERE / "family.toml", "deformations": [*known], "ranges": ranges, "count": count, "seed": seed}
    return lampopt.exemplars("morph", mesh=folder / "sedan.stl", unit="mm", **options)


def cached(cars, file):
    """Exemplars with the drag that an earlier run has left in `file`, and at which level it was solved."""
    with file.open(newline="", encoding="utf-8") as table:
        known = {row.pop("exemplar"): row for row in csv.DictReader(table)}
    labels, levels = [], set()
    for name, parameters in zip(cars.names, cars.parameters, strict=True):
        row = known.get(name, {})
        levels.add(row.get("level") or "of no level told")
        told = [float(row.get(q.name) or "nan") for q in cars.space]
        if not np.allclose(told, parameters, rtol=1e-4, atol=1e-6):
            raise InputError(f"{file}: has no drag of {name} as it is here: made of another family, number or seed")
        labels.append([float(row.get("drag") or "nan")])
    return replace(cars, labels=np.array(labels), label_space=(Parameter("drag"),)), " and ".join(sorted(levels))


def keep_labels(bank, level, file):
    with file.open("w", newline="", encoding="utf-8") as table:
        write = csv.writer(table).writerow
        write(["exemplar", *(q.name for q in bank.space), "drag", "level"])
        for name, parameters, label in zip(bank.names, bank.parameters, bank.labels, strict=True):
            write([name, *(f"{value:.6g}" for value in parameters), label[0], level])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("demo/openfoam"))
    parser.add_argument("--exemplars", type=int, default=24)
    parser.add_argument("--edge", type=float, default=60.0, help="of the sedan's mesh [mm]")
    parser.add_argument("--wider", type=float, default=1.0, help="factor on the ranges of what is not held")
    parser.add_argument("--decoder", default="mesh-template")
    parser.add_argument(
        "--level", default="coarse", choices=["coarse", "medium", "fine"], help="of the flows that are searched with"
    )
    parser.add_argument(
        "--label-level", choices=["coarse", "medium", "fine"], help="of the exemplars' flows, if not the same"
    )
    parser.add_argument(
        "--half",
        default="auto",
        choices=["auto", "yes", "no"],
        help="of a car is solved; yes: left stands for right too",
    )
    parser.add_argument("--placements", type=int, default=3, help="of the grid, for each exemplar")
    parser.add_argument("--closing", type=int, default=16, help="placements in the closed loop")
    parser.add_argument("--fresh", type=int, default=8, help="placements that design and reference are solved on anew")
    parser.add_argument("--finer", action="store_true", help="and again one level finer")
    parser.add_argument("--turns", type=int, default=8, help="corrections of the ask, as far as noise lets tell them")
    parser.add_argument("--seed", type=int, default=0, help="of the family and its fits")
    parser.add_argument("--reference", default="base", help="the exemplar that is to lose drag")
    parser.add_argument("--labels", type=Path, help="labels.csv of an earlier run: exemplars are not solved")
    parser.add_argument("--workers", type=int, default=2, help="flows at a time")
    args = parser.parse_args()
    if args.finer and args.level not in FINER:
        parser.error(f"--finer: nothing is finer than {args.level}")
    if args.fresh < 2:
        parser.error("--fresh: expected two placements or more, of which a standard error can be told")
    if 2 * max(args.closing, args.placements) > FRESH:
        parser.error(f"--closing, --placements: expected {FRESH // 2} or fewer: from {FRESH} on placements are fresh")
    if not 0 < args.wider <= 3:
        parser.error("--wider: expected a factor from 0 to 3, 1 for the family as it is")
    if args.labels and not args.labels.is_file():
        parser.error(f"--labels: {args.labels} is not there")
    if args.labels and args.label_level:
        parser.error("--label-level: the exemplars' flows are in --labels already: leave one of the two out")
    try:
        confirmed = study(args)
    except LampoptError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if confirmed else 1


def study(args):
    """Whether the design is accepted, its drag lower for certain, and as far as was asked."""
    plugins, folder = Plugins.load().report(), args.folder
    kept = str((folder / "flows").absolute())
    flow = {"level": args.level, "half": args.half, "placements": args.placements, "folder": kept}
    plugins.make("measure", Spec("openfoam-drag", **flow))  # a wrong option is told before anything is solved
    cars = family(folder, args.exemplars, args.seed, args.edge, args.wider)
    solved_at = args.label_level or args.level
    if args.labels:
        cars, solved_at = cached(cars, args.labels)
    if args.reference not in cars.names:
        raise InputError(f"--reference: expected one of {', '.join(cars.names)}, got {args.reference!r}")
    wider = "" if args.wider == 1 else f"-wider-{args.wider:g}"
    name = f"{args.decoder}-{args.exemplars}-{args.seed}{wider}{'-given' if args.labels else ''}"
    with progress_bar("building the bank") as progress:
        bank = lampopt.build_bank(
            cars, args.decoder, seed=args.seed, store=folder / f"{name}.lamp", progress=progress, plugins=plugins
        )
    if not args.labels:
        with progress_bar("solving the exemplars") as progress, processes(args.workers) as executor:
            bank = lampopt.label(
                bank, Spec("openfoam-drag", **flow | {"level": solved_at}), {"drag": "drag"},
                store=folder / f"{name}-{solved_at}.lamp", executor=executor, progress=progress, plugins=plugins,
            )  # fmt: skip
        keep_labels(bank, solved_at, folder / "labels.csv")
    known = dict(zip(bank.names, bank.labels[:, 0].tolist(), strict=True))
    drags = [drag for drag in known.values() if np.isfinite(drag)]  # a car without a grid has none
    noise = 2 * PAIRED / args.closing**0.5  # what the loop's placements do not tell apart
    model = lampopt.fit_model(bank, "best", ["drag"], plugins=plugins)
    wish = lampopt.Study(
        bank, reference=args.reference, keep=tuple(HELD), objective=lampopt.Reduce("drag", by=CUT),
        measures={"flow": Spec("openfoam-drag", **flow | {"placements": args.closing, "workers": args.workers})},
        measured={"drag": "flow.drag", **HELD}, turns=args.turns,
        limits={"measured.drag": 2 * noise * known[args.reference] / np.ptp(drags)},
    )  # fmt: skip
    with progress_bar("solving and correcting the ask") as progress:
        result = lampopt.run(wish, folder / f"run-{name}-{args.reference}", progress=progress, plugins=plugins)
    if result.design.mesh is None or result.folder is None:
        raise LampoptError("the design has no surface, or could not be measured for a reason that may pass: see above")
    before = lampopt.run(lampopt.Study(bank, reference=args.reference), plugins=plugins).design
    alpha = np.array([before.mix.alpha, result.design.mix.alpha])
    before.mesh.export(folder / "reference.stl")  # confirmed is what is handed over: the files' meshes
    shutil.copy(result.folder / "mesh.stl", folder / "design.stl")
    reference, design = (load_mesh(folder / f"{which}.stl") for which in ("reference", "design"))
    predicted = model(alpha @ bank.parameters[:, [[q.name for q in bank.space].index(i) for i in model.inputs]])[:, 0]
    compared = {}
    with progress_bar("solving design and reference anew") as progress:
        for done, level in enumerate(levels := [args.level, *([FINER[args.level]] if args.finer else [])]):
            progress(done / len(levels), level)
            anew = flow | {"level": level, "placements": args.fresh, "first": FRESH, "workers": args.workers}
            compared[level] = plugins.make("measure", Spec("openfoam-drag", **anew)).compared(design, reference)
    r2 = model.cross_validated["drag"]["r2"]
    told(result, (reference, design), bank, predicted, f"labels {solved_at}, R² left out {r2:.2f}", compared)
    pictures(reference, design, compared[args.level], folder / "drag.png")
    print(
        *(folder / part for part in ("drag.png", "design.stl", f"{result.folder.parent.parent.name}/report.html")),
        sep="\n",
    )
    drag = compared[args.level].drag
    return result.accepted and drag.verdict == "lower" and as_asked(drag)


def as_asked(change):
    return abs(change.value + CUT) <= 2 * change.error


def told(result, meshes, bank, predicted, labels, compared):
    """What was asked of the second of two meshes, predicted, solved and held, and whether every check passed."""
    shown = Table("", "asked", "found", "", title="10 % less drag, the rest held")
    change = 100 * (predicted[1] / predicted[0] - 1)
    shown.add_row("drag, by the model of the labels", f"{-100 * CUT:+.1f} %", f"{change:+.1f} %", labels)
    for level, pair in compared.items():
        c, area = pair.drag, pair.drag_area
        verdict = f"{c.verdict}, p = {c.p:.2g}; {'' if as_asked(c) else 'not '}as asked"
        shown.add_row(
            f"drag, solved anew, {level}",
            f"{-100 * CUT:+.1f} %",
            f"{100 * c.value:+.1f} ± {100 * c.error:.1f} %",
            verdict,
        )
        shown.add_row("  times frontal area", "", f"{100 * area.value:+.1f} ± {100 * area.error:.1f} %", area.verdict)
    for name, address in HELD.items():
        values = [lampopt.measure(address.partition(".")[0], mesh)[address.partition(".")[2]] for mesh in meshes]
        part = abs(values[1] - values[0]) / float(np.ptp(bank.parameters[:, [q.name for q in bank.space].index(name)]))
        shown.add_row(f"{name}, measured", f"{values[0]:.0f} mm", f"{values[1]:.0f} mm", f"{part:.2%} of its range off")
    failed = [check.name for check in result.checks if not check.passed]
    shown.add_row("checks", "", "accepted" if result.accepted else "rejected", ", ".join(failed))
    Console().print(shown)


if __name__ == "__main__":
    sys.exit(main())
