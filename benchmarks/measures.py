"""Direct measures against truth, on true meshes and on what marching cubes make of them; their gradients; their time.

python -m benchmarks.measures --table accuracy     200 designs of each family at f = 1 and at f = 2: R² of each value
python -m benchmarks.measures --table gradients    derivatives by the vertices against central differences
python -m benchmarks.measures --table time         milliseconds a measure on a car of about 30,000 faces
"""

from __future__ import annotations

import argparse
import inspect
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits
from trimesh import Trimesh

import lampopt
from lampopt.errors import EmptyMesh, MeasureError
from lampopt.measured import values_of
from lampopt.metrics import mean_absolute_error, r_squared
from lampopt.protocols import Gradient, Measure

from .common import Bench, Row, core, key, line, parsed, source
from .document import put, show, stamped
from .truth import Known, families

FACTORS = {1.0: 0.999, 2.0: 0.99}  # f → least R²
MADE = ("true mesh", "marching cubes 128³")
FIELDS = 6  # smooth directions in which derivatives are compared
OUT_OF_LINE = 1e-6  # of the mesh's size: how far vertices are moved at random
SILHOUETTES = {"frontal-area": 1e-3, "wing": 2e-4}  # the same where faces seen edge-on decide
STEPS = (1e-8, 1e-7, 1e-9, 1e-6)  # of the mesh's size, for differences
AGREED = 1e-5  # difference at which no other step is tried
FLAT = 1e-9  # of the value: one that is the same for all designs has no R²


@dataclass(frozen=True)
class Read:
    """A family, the measures that its truth is known for, and a hash of all that a reading depends on."""

    bench: Bench
    known: Known
    names: tuple[str, ...]
    code: str

    @classmethod
    def of(cls, bench: Bench, known: Known) -> Read:
        from . import truth
        from .recut import recut

        family = known.family
        names = tuple(sorted({a.partition(".")[0] for a in _truth(known, (family.low + family.high) / 2)}))
        used = [bench.plugins.get("source", family.name), *(bench.plugins.get("measure", name) for name in names)]
        own = [inspect.getsource(part) for part in (cls, read)]
        files = [parsed(Path(inspect.getfile(part))) for part in (truth, recut)]
        code = [*(source(one.resolve()) for one in used), *files, *core("measured", "topology"), own]
        return cls(bench, known, names, key(code))

    def at(self, parameters: NDArray[np.float64]) -> Row:
        """What is true of one design, and by surface what is measured of it; None where nothing is found."""
        known = ["measures", self.known.family.name, parameters.tolist(), self.code]
        return self.bench.scores.get(known, lambda: self._at(parameters))

    def _at(self, parameters: NDArray[np.float64]) -> Row:
        from .recut import recut

        mesh = self.known.family.mesh(parameters)
        truth = self.known.at(parameters, mesh)
        shapes = dict(zip(MADE, (mesh, recut(mesh)), strict=True))
        found = {made: read(self.bench, self.names, shape) for made, shape in shapes.items()}
        return {"true": truth, **{made: {a: values.get(a) for a in truth} for made, values in found.items()}}


def read(bench: Bench, names: Sequence[str], mesh: Trimesh) -> dict[str, float]:
    """Every value of the measures `names` that is found on `mesh`, by address."""
    found: dict[str, float] = {}
    for name in names:
        measure: Measure = bench.plugins.make("measure", name)
        try:
            values = values_of(name, measure, mesh).tolist()
        except (MeasureError, EmptyMesh) as error:
            bench.console.print(f"{name}: {error}", highlight=False)
            continue
        found |= {f"{name}.{value}": v for value, v in zip(measure.names, values, strict=True)}
    return found


def drawn(known: Known, count: int, factor: float, seed: int) -> Iterator[tuple[NDArray[np.float64], int]]:
    """`count` designs from the range widened by `factor` that have a mesh, each with how many had none before it."""
    rng = np.random.default_rng(seed)
    low, high = known.family.widened(factor)
    refused = 0
    for _ in range(count):
        while True:
            parameters = rng.uniform(low, high)
            try:
                known.family.mesh(parameters)
            except lampopt.errors.InputError:
                refused += 1
                continue
            break
        yield parameters, refused


def accuracy(bench: Bench, names: Sequence[str], count: int) -> dict[str, Any]:
    """R² and mean absolute error of every value; a design that cannot be measured counts as the family's mean."""
    lines, notes = [], []
    for name in names:
        known = families()[name]
        reading = Read.of(bench, known)
        for factor, least in FACTORS.items():
            with bench.stage(f"{name} f={factor:g}: {count} designs") as tell:
                rows, refused = [], 0
                for parameters, again in drawn(known, count, factor, bench.seed):
                    tell(len(rows) / count)
                    rows.append(reading.at(parameters))
                    refused = again
            if refused:
                notes.append(f"{name} f={factor:g}: {refused} draws had no shape and were drawn again")
            for made in MADE:
                lines += compared(name, factor, made, rows, least)
    return {"rows": lines, "notes": notes}


def compared(name: str, factor: float, made: str, rows: Sequence[Row], least: float) -> list[Row]:
    """A line for each value; one that is the same for all designs is held against it, as it has no R²."""
    truth: dict[str, list[float]] = defaultdict(list)
    found: dict[str, list[float | None]] = defaultdict(list)
    for row in rows:
        for address, value in row["true"].items():
            truth[address].append(value)
            found[address].append(row[made][address])
    lines = []
    own = families()[name].own if made == MADE[0] else frozenset()  # there it would be held against itself
    for address, given in truth.items():
        if address in own:
            continue
        true, missing = np.array(given), sum(value is None for value in found[address])
        values = np.array([true.mean() if v is None else v for v in found[address]], float)
        about = {"f": factor, "on": made, "designs": len(true), "missing": missing}
        error = float(mean_absolute_error(true, values))
        if np.ptp(true) <= FLAT * max(abs(true).max(), 1e-9):
            off = float(np.abs(values - true).max())
            lines.append(
                line(f"{name} {address}, all {true[0]:g}: largest error", off, target=None, mae=error, **about)
            )
        else:
            about |= {"calibrated": calibrated(true, values), "mae": error}
            lines.append(line(f"{name} {address}: R²", r_squared(true, values), target=f">= {least}", **about))
    return lines


def calibrated(true: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """R² once a straight line from measured to true is taken out (paper, appendix H), each design left out of its own.

    What a surface of cells lacks everywhere alike, such as the area of its cut-off edges, is gone then.
    """
    design = np.column_stack([np.ones(len(values)), values - values.mean()])
    q, _ = np.linalg.qr(design)
    off = (true - q @ (q.T @ true)) / np.maximum(1 - (q**2).sum(1), 1e-9)
    return r_squared(true, true - off)


def fields(mesh: Trimesh, rng: np.random.Generator) -> Iterator[NDArray[np.float64]]:
    """Smooth motions of the vertices (V, 3), of about the mesh's size."""
    vertices, size = np.asarray(mesh.vertices), float(max(mesh.extents))
    for _ in range(FIELDS):
        waves, phase, ways = rng.normal(0, 2.5, (4, 3)), rng.uniform(0, 2 * np.pi, 4), rng.normal(size=(4, 3))
        yield size * np.sin(vertices / size @ waves.T + phase) @ ways / 4


def gradients(bench: Bench, names: Sequence[str], count: int) -> dict[str, Any]:
    """The worst difference between a derivative and a central difference, in parts of the largest of the directions.

    Every vertex is moved out of line first: where flat ends, walls or edges tie there is no derivative, only one to
    either side. Of several steps the one that agrees best counts, for each direction: a long one may take a point
    into what is measured or out of it, a short one drowns in rounding; a wrong derivative agrees with none.
    """
    lines = []
    for name in names:
        known = families()[name]
        used = {a.partition(".")[0] for p, _ in drawn(known, 1, 1.0, bench.seed) for a in _truth(known, p)}
        for measure_name in sorted(used):
            measure: Measure = bench.plugins.make("measure", measure_name)
            if not isinstance(measure, Gradient):
                continue
            moved = SILHOUETTES.get(measure_name, OUT_OF_LINE)
            worst = np.zeros(len(measure.names))
            with bench.stage(f"{name} {measure_name}: {count} designs"):
                for i, (parameters, _) in enumerate(drawn(known, count, 1.0, bench.seed + 1)):
                    mesh, rng = known.family.mesh(parameters), np.random.default_rng([bench.seed, i])
                    off = moved * float(max(mesh.extents)) * rng.normal(size=mesh.vertices.shape)
                    generic = Trimesh(mesh.vertices + off, mesh.faces, process=False)
                    worst = np.maximum(worst, difference(measure, generic, rng))
            for value, off_by in zip(measure.names, worst.tolist(), strict=True):
                about = {"designs": count, "out_of_line": moved}
                lines.append(line(f"{name} {measure_name}.{value}", off_by, target="<= 1e-4", **about))
    return {"rows": lines, "notes": []}


def difference(measure: Measure, mesh: Trimesh, rng: np.random.Generator) -> NDArray[np.float64]:
    """(p,) worst of the directions."""
    assert isinstance(measure, Gradient)
    vertices, gradient = np.asarray(mesh.vertices), np.asarray(measure.gradient(mesh))
    ways = list(fields(mesh, rng))
    told = np.array([(gradient * field).sum((1, 2)) for field in ways])
    off, scale = np.full(told.shape, np.inf), np.zeros(told.shape[1])
    for step in STEPS:
        for i in np.flatnonzero((off > AGREED * np.where(scale > 0, scale, 0)).any(axis=1)):
            ends = [measure(Trimesh(vertices + sign * step * ways[i], mesh.faces, process=False)) for sign in (-1, 1)]
            off[i] = np.minimum(off[i], np.abs(told[i] - (ends[1] - ends[0]) / (2 * step)))
        scale = np.abs(told).max(0)
    worst: NDArray[np.float64] = off.max(0) / np.where(scale > 0, scale, 1.0)
    return worst


def _truth(known: Known, parameters: NDArray[np.float64]) -> dict[str, float]:
    return known.at(parameters, known.family.mesh(parameters))


def times(bench: Bench, repeats: int) -> dict[str, Any]:
    """Median of `repeats`, each on a mesh object of its own: what trimesh remembers of one is not counted on."""
    known = families()["car"]
    mesh = known.family.mesh((known.family.low + known.family.high) / 2)
    lines = []
    used = sorted({address.partition(".")[0] for address in _truth(known, (known.family.low + known.family.high) / 2)})
    for name in used:
        measure: Measure = bench.plugins.make("measure", name)
        calls = [("", measure)] + ([(" with gradient", measure.gradient)] if isinstance(measure, Gradient) else [])
        for what, call in calls:
            spent = []
            for _ in range(repeats + 1):  # the first loads what is imported late
                fresh = Trimesh(np.array(mesh.vertices), np.array(mesh.faces), process=False)
                began = time.perf_counter()
                call(fresh)
                spent.append(time.perf_counter() - began)
            milliseconds = round(1000 * float(np.median(spent[1:])), 2)
            lines.append(line(f"{name}{what} [ms]", milliseconds, faces=len(mesh.faces)))
    return {"rows": lines, "notes": [f"a car of {len(mesh.faces):,} faces, median of {repeats}"]}


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.measures", description=__doc__.partition("\n")[0])
    parser.add_argument("--table", choices=("accuracy", "gradients", "time"), default="accuracy")
    parser.add_argument("--family", action="append", choices=tuple(families()), help="default: all; repeatable")
    parser.add_argument("--count", type=int, default=200, help="designs of each family and factor")
    parser.add_argument("--seed", type=int, default=0, help="of the draws")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("runs/benchmarks"), help="where rows are kept")
    parser.add_argument("--out", type=Path, default=None, help="folder for a JSON document, and the table for docs")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    args = parser.parse_args(given)
    os.environ["IGL_NUM_THREADS"] = str(args.threads)  # read by libigl on its first parallel loop
    import torch

    torch.set_num_threads(args.threads)
    bench = Bench(args.cache, lampopt.Spec("sdf-mlp"), seed=args.seed)
    names = args.family or tuple(families())
    make = {
        "accuracy": partial(accuracy, bench, names, args.count),
        "gradients": partial(gradients, bench, names, min(args.count, 3)),
        "time": partial(times, bench, min(args.count, 7)),
    }[args.table]
    with threadpool_limits(args.threads, user_api="blas"):
        table = make()
    met = [sum(row["met"] is wanted for row in table["rows"]) for wanted in (True, False)]
    document = stamped("measures", table=args.table, seed=args.seed, threads=args.threads)
    document |= {"met": met, **table, "seconds": bench.seconds}
    put(document, args.out and args.out / f"measures-{args.table}.json", out=args.json)
    if args.out and args.table == "accuracy":
        (args.out / "measures-accuracy.md").write_text(markdown(pivot(table)), encoding="utf-8")
    if args.json:
        return 0
    if args.table == "accuracy":
        first, *rest = pivot(table)
        out = Table(*first, caption="\n".join(table["notes"]))
        for cells in rest:
            out.add_row(*cells)
        Console(width=180).print(out)
    else:
        show(Console(width=160), f"measures: {args.table}", table)
    return 0


def pivot(table: dict[str, Any]) -> list[list[str]]:
    """A line for each value, a column for each surface and factor: R² (* falls short), or what a constant is off.

    Where R² falls short, what it is once a straight line is taken out stands behind it.
    """
    heads = [(made, factor) for made in MADE for factor in FACTORS]
    cells: dict[str, dict[tuple[str, float], str]] = defaultdict(dict)
    for row in table["rows"]:
        name, _, what = row["name"].rpartition(": ")
        text = f"{row['value']:.5f}" if what == "R²" else f"± {row['value']:.2g}"
        if row["met"] is False:
            text += f"* (calibrated {row['calibrated']:.5f})"
        missed = f" ({row['missing']} not found)" if row["missing"] else ""
        cells[name.partition(",")[0]][row["on"], row["f"]] = text + missed
    first = ["value", *(f"{made}, f = {factor:g}" for made, factor in heads)]
    return [first, *([name, *(found.get(head, "") for head in heads)] for name, found in cells.items())]


def markdown(lines: list[list[str]]) -> str:
    """The table as docs/measures.md includes it."""
    first, *rest = (f"| {' | '.join(cells)} |\n" for cells in lines)
    return first + "|---" * len(lines[0]) + "|\n" + "".join(rest)


if __name__ == "__main__":
    sys.exit(main())
