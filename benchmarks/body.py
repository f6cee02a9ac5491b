"""A real car body morphed by eight parameters, all drawn at once: produced against true surfaces, by the judge."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from trimesh import Trimesh

import lampopt
from lampopt.errors import InputError
from lampopt.types import Array

from .common import ROOT, Bench, Row, counts, judged, key, line, module_at, share
from .grid import Grid, GridMix

FACTORS = (1.0, 1.5, 2.0, 3.0)
MEASURED = {"length": "extents.length", "width": "extents.width"}
RATIOS = {2.0: 0.75, 3.0: 0.75}  # wanted of the grid's error, by range factor
MOVED = {1.0: 0.44, 1.5: 0.27, 2.0: 0.28, 3.0: 0.20}  # the same of a moved template
MARGIN = 0.25  # of the grid around all shapes [m]


def find_judge(path: str | None) -> ModuleType | None:
    """The evaluator at `path` (its folder), by default beside the repository; None where it, or its data, is absent."""
    folder = Path(path) if path else ROOT.parent / "shared" / "judge"
    if not (folder / "judge.py").exists():
        return None
    judge = module_at(folder / "judge.py")
    return judge if judge.DATA.is_dir() else None


def judge_at(path: str | None) -> ModuleType:
    """As `find_judge`. Raises InputError where it finds none."""
    if (judge := find_judge(path)) is None:
        raise InputError("no judge.py with its car bodies was found (--judge FOLDER)")
    return judge


@dataclass(frozen=True, eq=False)
class Body:
    """One body's family: a table of exemplars, and targets by range factor."""

    bench: Bench
    judge: ModuleType
    name: str

    @property
    def size(self) -> tuple[int, int, float, int]:
        """Exemplars, targets a factor, pitch [m], samples of a judged surface."""
        return (12, 2, 0.08, 2_000) if self.bench.quick else (24, 16, 0.04, 20_000)

    @property
    def factors(self) -> tuple[float, ...]:
        return (1.0, 2.0) if self.bench.quick else FACTORS

    @property
    def ratios(self) -> Mapping[float, float]:
        """What is wanted of the grid's error, by range factor."""
        return MOVED if self.bench.decoder.name == "mesh-template" else RATIOS

    @property
    def metre(self) -> float:
        """How long a metre is in the meshes' unit."""
        return 1.0

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.judge.NAMES)

    @property
    def middle(self) -> Array:
        """(d,) the middle of the range."""
        return np.asarray((self.judge.LOW + self.judge.HIGH) / 2)

    def base(self) -> Trimesh:
        return self.judge.body(self.name)

    def truth(self, target: Array) -> Trimesh:
        """The true surface at `target`."""
        return self.judge.morph(self.base(), target)

    def targets(self, f: float) -> Array:
        return np.asarray(self.judge.targets(f, self.size[1], seed=0))

    def exemplars(self) -> lampopt.Exemplars:
        """The judge's table of meshes, each with a triangulation of its own, as a user would bring it."""
        number, _, pitch, _ = self.size
        folder = self.bench.cache / f"body-{self.name}-{number}-{pitch:g}"
        if not (folder / "cars.csv").exists():
            with self.bench.stage(f"body: table of {number} meshes"):
                partial = folder.with_name(folder.name + ".partial")
                shutil.rmtree(partial, ignore_errors=True)
                self.judge.write_table(partial, self.base(), self.judge.exemplars(number, seed=0), pitch=pitch)
                partial.replace(folder)
        options = {"table": str(folder / "cars.csv"), "meshes": str(folder / "stl"), "labels": "drag", "unit": "m"}
        return lampopt.exemplars("table", plugins=self.bench.plugins, **options)

    def bank(self, source: lampopt.Exemplars, decoder: lampopt.Spec, notes: list[str]) -> lampopt.Bank:
        """The bank, with as many of `MEASURED` declared as lampopt accepts; what it refuses is noted, in its words."""
        measured = dict(MEASURED)
        while True:
            try:
                return self.bench.bank(f"body-{self.name}", source, decoder, measured)
            except InputError as error:
                refused = [name for name, address in measured.items() if f"{address!r} does not follow" in str(error)]
                if not refused:
                    raise
                notes.append(f"not declared: {error}")
                del measured[refused[0]]

    def grid_mix(self, source: lampopt.Exemplars) -> GridMix:
        truth = [self.truth(target) for f in self.factors for target in self.targets(f)]
        boxes = [m.bounds for m in (*source.meshes, *truth)]
        grid = Grid.around(boxes, self.size[2] * self.metre, MARGIN * self.metre)
        with self.bench.stage(f"body: distances at {len(source)} × {grid.size} nodes") as tell:
            return GridMix.of(source, grid, self.bench.cache, "body", tell)

    def error(self, produced: Trimesh, target: Array) -> Row:
        """How far `produced` is off, by the judge [m]."""
        found = self.judge.surface_error(produced, self.truth(target), samples=self.size[3])
        return found | {name: found[name] / self.metre for name in ("mean", "p99")}

    def where(self, target: Array) -> list[object]:
        return [
            self.name,
            *self.size,
            target.tolist(),
            key(Path(self.judge.__file__ or "").read_text(encoding="utf-8")),
        ]

    def made(self, bank: lampopt.Bank, target: Array) -> Row:
        """The design at `target` by the decoder: judged by its checks, held against the truth."""
        asked = dict(zip(self.names, target.tolist(), strict=True))

        def make() -> Row:
            result = lampopt.design(bank, asked, resolution=self.bench.resolution, plugins=self.bench.plugins)
            mesh = result.design.mesh
            return judged(result) | {"error": None if mesh is None else self.error(mesh, target)}

        return self.bench.scores.get(["body", self.bench.identity(bank), self.where(target)], make)

    def nothing(self, target: Array) -> Row:
        """The body at the middle of the range, whatever is asked."""

        def make() -> Row:
            return self.error(self.truth(self.middle), target)

        return self.bench.scores.get(["nothing", self.where(target)], make)

    def on_grid(self, mix: GridMix, alpha: Array, target: Array) -> Row:
        def make() -> Row:
            mesh = mix.mesh(alpha)
            return self.nothing(target) if mesh is None else self.error(mesh, target)

        return self.bench.scores.get(["grid", mix.name, alpha.tolist(), self.where(target)], make)

    def designs(self, bank: lampopt.Bank, f: float) -> list[Row]:
        """All designs at factor `f`; one without a mesh counts as doing nothing."""
        targets = self.targets(f)
        with self.bench.stage(f"body: {len(targets)} designs, {bank.decoder}, f={f:g}") as tell:
            rows = []
            for i, target in enumerate(targets):
                tell(i / len(targets))
                row = self.made(bank, target)
                rows.append(row | {"error": row["error"] or self.nothing(target)})
        return rows


def average(rows: list[Row]) -> Row:
    """The mean over designs: mean and 99th percentile [mm], IoU."""
    mean, p99, iou = (float(np.mean([row[name] for row in rows])) for name in ("mean", "p99", "iou"))
    return {"mean_mm": 1000 * mean, "p99_mm": 1000 * p99, "iou": iou}


def table(body: Body) -> Row:
    """A row a range factor: the decoder's mixes beside the grid's and beside doing nothing."""
    bench, source = body.bench, body.exemplars()
    notes: list[str] = []
    bank = body.bank(source, bench.decoder, notes)
    mix = body.grid_mix(source)
    lines, kept = [], []
    for f in body.factors:
        rows, targets = body.designs(bank, f), body.targets(f)
        with bench.stage(f"body: grid mixes and doing nothing, f={f:g}") as tell:
            grid, nothing = [], []
            for i, (row, target) in enumerate(zip(rows, targets, strict=True)):
                tell(i / len(rows))
                grid.append(body.on_grid(mix, np.array(row["alpha"]), target))
                nothing.append(body.nothing(target))
        lines += _lines(f, rows, grid, nothing, body.ratios.get(f))
        kept += [
            {"f": f, "design": i, "error": row["error"], "on_grid": grid[i], "nothing": nothing[i]}
            | {name: row[name] for name in ("accepted", "failed", "empty")}
            | {"mismatch": row["checks"]["mismatch"]}
            for i, row in enumerate(rows)
        ]
    return {
        "rows": lines,
        "setting": {
            "body": body.name,
            "exemplars": len(source),
            "targets a factor": body.size[1],
            "measured": dict(bank.measured_by),
            "grid pitch [m]": mix.grid.pitch / body.metre,
            "decoder's cell [m]": 2 / bench.resolution / bank.frame.scale / body.metre,
            "fit error [mm]": float(1000 * bank.fit_error.mean() / bank.frame.scale / body.metre),
        },
        "designs": kept,
        "notes": [
            *notes,
            "means over all designs, rejected ones too; a design without a mesh counts as doing nothing",
            "nothing: the true body at the middle of the range",
            "grid: true distances of the exemplars' meshes, the same alpha, scikit-image marching cubes",
        ],
    }


def _lines(f: float, rows: list[Row], grid: list[Row], nothing: list[Row], wanted: float | None) -> list[Row]:
    made, plain, still = average([row["error"] for row in rows]), average(grid), average(nothing)
    targets = {"mean_mm": "<= grid", "iou": ">= 0.97"} if f == 1 else {}
    lines = [
        line(f"{name}, f={f:g}", made[name], grid=plain[name], nothing=still[name], target=targets.get(name), f=f)
        for name in ("mean_mm", "p99_mm", "iou")
    ]
    ratio = made["mean_mm"] / plain["mean_mm"]
    accepted = share([row for row in rows if row["accepted"]], rows)
    empty = [i for i, row in enumerate(rows) if row["empty"]]
    mismatch = float(np.median([row["checks"]["mismatch"] for row in rows]))
    return [
        *lines,
        line(f"mean_mm over the grid's, f={f:g}", ratio, target=f"<= {wanted}" if wanted else None, f=f),
        line(f"accepted, f={f:g}", accepted, f=f, of=len(rows), by=counts(rows), empty=empty),
        line(f"median mismatch [box], f={f:g}", mismatch, f=f),
    ]
