"""Appendix R: the plate with a hole, each parameter alone swept over three times its range, measured against asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from trimesh import Trimesh

import lampopt
from lampopt.errors import MeasureError
from lampopt.metrics import mean_absolute_error, r_squared
from lampopt.types import Array

from .common import Bench, Row, counts, judged, line, share
from .grid import Grid, GridMix

WIDEST = 3.0  # range factor of the sweeps: the paper's ±100 %
MISS = 0.05  # of a parameter's range
MARGIN = 0.15  # of the grid around all shapes [m]


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Every design that is asked for: its targets (B, 6), and which parameter is swept."""

    names: tuple[str, ...]
    middle: Array
    half: Array
    asked: Array
    swept: Array

    @classmethod
    def of(cls, space: tuple[lampopt.Parameter, ...], count: int) -> Sweeps:
        low, high = np.array([q.low for q in space], float), np.array([q.high for q in space], float)
        middle, half = (low + high) / 2, (high - low) / 2
        swept = np.repeat(np.arange(len(space)), count)
        asked = np.tile(middle, (len(swept), 1))
        steps = np.tile(np.linspace(-WIDEST, WIDEST, count), len(space))
        asked[np.arange(len(swept)), swept] += steps * half[swept]
        return cls(tuple(q.name for q in space), middle, half, asked, swept)

    def within(self, f: float) -> Array:
        """Which designs (B,) lie inside the range widened by `f`."""
        return np.asarray((np.abs(self.asked - self.middle) <= f * self.half * (1 + 1e-9)).all(1))

    def label(self, i: int) -> str:
        k = self.swept[i]
        return f"{self.names[k]}={self.asked[i, k]:.4g}"

    def r2(self, found: Array, k: int, f: float, *, alone: bool = True) -> float:
        """R² of parameter k within `f`, over its own sweep, or over all sweeps."""
        rows = self.within(f) & ((self.swept == k) | (not alone))
        return r_squared(self.asked[rows, k], found[rows, k])


def measured(values: Mapping[str, float] | None, sweeps: Sweeps) -> Array:
    """The six values (6,) read off a mesh; the middle of the range where there is nothing to be read."""
    if values is None:
        return sweeps.middle
    return np.array([values[name] for name in sweeps.names])


def made(bench: Bench, bank: lampopt.Bank, sweeps: Sweeps, i: int) -> Row:
    """Design i by the decoder, judged and measured."""
    target = dict(zip(sweeps.names, sweeps.asked[i].tolist(), strict=True))

    def make() -> Row:
        result = lampopt.design(bank, target, resolution=bench.resolution, plugins=bench.plugins)
        return judged(result) | _read(bench, result.design.mesh)

    return bench.scores.get(["plate", bench.identity(bank), target], make)


def _read(bench: Bench, mesh: Trimesh | None) -> Row:
    """What is measured on `mesh`, or why nothing is."""
    if mesh is None:
        return {"measured": None, "why": "no mesh"}
    try:
        return {"measured": lampopt.measure("plate", mesh, plugins=bench.plugins), "why": ""}
    except MeasureError as error:
        return {"measured": None, "why": str(error)}


def designs(bench: Bench, bank: lampopt.Bank, sweeps: Sweeps, name: str) -> tuple[list[Row], Array]:
    """All designs by the decoder, and what was measured on them (B, 6)."""
    with bench.stage(f"{name}: {len(sweeps.asked)} designs") as tell:
        rows = []
        for i in range(len(sweeps.asked)):
            tell(i / len(sweeps.asked), sweeps.label(i))
            rows.append(made(bench, bank, sweeps, i))
    return rows, np.array([measured(row["measured"], sweeps) for row in rows])


def count(bench: Bench) -> int:
    return 6 if bench.quick else 20


def exemplars(bench: Bench) -> lampopt.Exemplars:
    return lampopt.exemplars("plate", plugins=bench.plugins)


def grid_mix(bench: Bench, source: lampopt.Exemplars, bank: lampopt.Bank, sweeps: Sweeps) -> GridMix:
    """True distances at the nodes of the decoder's own lattice of cells."""
    pitch = 2 / bench.resolution / bank.frame.scale
    assert source.mesh_at is not None
    boxes = [mesh.bounds for mesh in source.meshes] + [source.mesh_at(row).bounds for row in sweeps.asked]
    grid = Grid.around(boxes, pitch, MARGIN, bank.frame.centre - 1 / bank.frame.scale)
    with bench.stage(f"plate: distances at {len(source)} × {grid.size} nodes") as tell:
        return GridMix.of(source, grid, bench.cache, "plate", tell)


def table(bench: Bench) -> Row:
    """R² of all six parameters by the decoder and by the grid; what the checks reject."""
    source = exemplars(bench)
    bank = bench.bank("plate", source, bench.decoder)
    sweeps = Sweeps.of(bank.space, count(bench))
    rows, found = designs(bench, bank, sweeps, "plate")
    mix = grid_mix(bench, source, bank, sweeps)
    with bench.stage("plate: grid mixes") as tell:
        plain = []
        for i, row in enumerate(rows):
            tell(i / len(rows))
            known = ["plate grid", mix.name, row["alpha"], bench.code]
            alpha = np.array(row["alpha"])
            plain.append(bench.scores.get(known, lambda a=alpha: _read(bench, mix.mesh(a))))
    on_grid = np.array([measured(row["measured"], sweeps) for row in plain])
    lines = [
        line(
            f"R² {name}, f={f:g}",
            sweeps.r2(found, k, f),
            grid=sweeps.r2(on_grid, k, f),
            target=">= 0.98" if f == 1 else ">= grid",
            over_all=sweeps.r2(found, k, f, alone=False),
        )
        for f in (1.0, WIDEST)
        for k, name in enumerate(sweeps.names)
    ]
    return {
        "rows": lines + verdicts(rows, found, sweeps),
        "setting": {
            "exemplars": len(source),
            "designs": len(rows),
            "inside the range": int(sweeps.within(1.0).sum()),
            "cell [m]": mix.grid.pitch,
            "fit error [mm]": float(1000 * bank.fit_error.mean() / bank.frame.scale),
        },
        "failed": counts(rows),
        "unmeasured": {sweeps.label(i): row["why"] for i, row in enumerate(rows) if row["measured"] is None},
        "unmeasured_on_grid": {sweeps.label(i): row["why"] for i, row in enumerate(plain) if row["measured"] is None},
        "designs": [
            {
                "design": sweeps.label(i),
                "measured": row["measured"],
                "on_grid": plain[i]["measured"],
                "accepted": row["accepted"],
                "failed": row["failed"],
                "mismatch": row["checks"]["mismatch"],
            }
            for i, row in enumerate(rows)
        ],
        "notes": [
            "R² of a parameter is over its own sweep; over_all is over all sweeps' designs",
            "a design that cannot be measured, or has no mesh, counts as the middle of the range, and as off",
            "grid: true distances at the nodes of the decoder's lattice, the same alpha, scikit-image marching cubes",
        ],
    }


def verdicts(rows: list[Row], found: Array, sweeps: Sweeps) -> list[Row]:
    """How well the checks tell good designs from those that are off."""
    off = (np.abs(found - sweeps.asked) > MISS * 2 * sweeps.half).any(1)
    missed = [row for row, o in zip(rows, off, strict=True) if o or row["measured"] is None]
    good = [row for row, o in zip(rows, off, strict=True) if not o and row["measured"] is not None]
    rejected = [row for row in missed if not row["accepted"]]
    caught = [row for row in missed if any(not name.startswith("drift.") for name in row["failed"])]
    accepted = [row for row in rows if row["accepted"]]
    wrongly = [row for row in good if not row["accepted"]]
    unmeasured = counts(missed, without="drift.")
    return [
        line("off designs rejected", share(rejected, missed), target=">= 0.95" if missed else None, of=len(missed)),
        line("off designs rejected without measuring", share(caught, missed), of=len(missed), by=unmeasured),
        line("accepted", share(accepted, rows), of=len(rows)),
        line("good designs rejected", share(wrongly, good), of=len(good), by=counts(wrongly)),
    ]


def summary(bench: Bench, decoder: lampopt.Spec) -> Row:
    """R² and mean absolute error over the plate's sweeps by `decoder`: one row of the ablation."""
    bank = bench.bank("plate", exemplars(bench), decoder)
    sweeps = Sweeps.of(bank.space, count(bench))
    rows, found = designs(bench, bank, sweeps, f"plate {decoder}")
    off = (found - sweeps.asked) / (2 * sweeps.half)
    out: Row = {"bank": bank}
    for f in (1.0, WIDEST):
        each = [sweeps.r2(found, k, f) for k in range(len(sweeps.names))]
        out |= {f"r2_mean_f{f:g}": float(np.mean(each)), f"r2_least_f{f:g}": min(each)}
    out["mae_of_range"] = mean_absolute_error(np.zeros_like(off), off)
    out["accepted"] = share([row for row in rows if row["accepted"]], rows)
    return out
