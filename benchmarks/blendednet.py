"""BlendedNet's tables of the paper (7 and 8) on our own family `bwb`, measured directly instead of by a surrogate.

    python -m benchmarks.blendednet --table interpolation     held-out designs in range: Chamfer distance, IoU, error
    python -m benchmarks.blendednet --table extrapolation     one and four parameters up to 50 % out of range: R², MMD

100 exemplars, as in the paper. Parameters are normalised to [-1, 1] over their range, shapes by the bank's frame (the
largest exemplar fills 0.6 of [-1, 1]³); the Chamfer distance is the paper's (appendix G: squared, both ways).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from threadpoolctl import threadpool_limits
from trimesh import Trimesh

import lampopt
from lampopt.errors import InputError, MeasureError
from lampopt.metrics import chamfer_distance, mean_absolute_error, minimum_matching_distance, r_squared, sample_surface
from lampopt_families import bwb

from .common import Bench, Row, judged, line, share
from .fidelity import plain, show, state

EXEMPLARS = 100
HELD_OUT = 200
OUT = 2.0  # range factor of the sweeps: the paper's ±50 %
STEPS = 10  # values of each parameter alone
TRIALS = 100
AT_ONCE = 4  # parameters out of range together
CLOUD = 2_048  # points of a shape for Chamfer distances
VOXELS = 64  # along the box, for IoU
PAPER = {"interpolation": "CD 0.0172, IoU 95.35 %, MAE 0.0031", "single": "MMD 0.035, MAE 0.305, R² 0.868",
         "multi": "MMD 0.037, MAE 0.353, R² 0.782"}  # fmt: skip
NARROWEST = 25.0  # mm: a panel below is none that could be measured


@dataclass(frozen=True)
class Space:
    """The nine parameters, normalised to [-1, 1] over their range."""

    middle: NDArray[np.float64]
    half: NDArray[np.float64]

    @classmethod
    def of(cls) -> Space:
        low, high = np.array(bwb.LOW), np.array(bwb.HIGH)
        return cls((low + high) / 2, (high - low) / 2)

    def normalised(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return (values - self.middle) / self.half

    def possible(self, k: int, value: float) -> bool:
        return not (bwb.NAMES[k].startswith("B") and value < NARROWEST)


def made(bench: Bench, bank: lampopt.Bank, target: dict[str, float], true: Trimesh | None) -> Row:
    """One design: its verdict, what is measured on it, its points in the box, and how it compares with the truth."""

    def make() -> Row:
        result = lampopt.design(bank, target, resolution=bench.resolution, plugins=bench.plugins)
        row = judged(result)
        mesh = result.design.mesh
        if mesh is None:
            return row | {"measured": None, "why": "no mesh", "cloud": None}
        boxed = bank.frame.to_box(mesh)
        row |= {"cloud": np.round(sample_surface(boxed, CLOUD), 5).tolist()}
        if true is not None:
            shape = bank.frame.to_box(true)
            row |= {
                "cd": chamfer_distance(np.array(row["cloud"]), sample_surface(shape, CLOUD, seed=1)),
                "floor": chamfer_distance(sample_surface(shape, CLOUD), sample_surface(shape, CLOUD, seed=1)),
                "iou": lampopt.metrics.iou(boxed, shape, VOXELS),
                "length": lampopt.metrics.surface_distance(mesh, true),
            }
        try:
            values = lampopt.measure("bwb", mesh, plugins=bench.plugins)
            return row | {"measured": [values[name] for name in bwb.NAMES], "why": ""}
        except MeasureError as error:
            return row | {"measured": None, "why": str(error)}

    code = bench.identity(bank)
    return bench.scores.get(["blendednet", code, target, true is not None], make)


def all_made(
    bench: Bench, bank: lampopt.Bank, name: str, targets: Sequence[dict[str, float]], truth: bool = False
) -> list[Row]:
    mesh_at = lampopt.exemplars("bwb", plugins=bench.plugins).mesh_at
    rows = []
    with bench.stage(f"{name}: {len(targets)} designs") as tell:
        for i, target in enumerate(targets):
            tell(i / len(targets))
            true = mesh_at(np.array([target[n] for n in bwb.NAMES])) if truth and mesh_at else None
            rows.append(made(bench, bank, target, true))
    return rows


def interpolation(bench: Bench, bank: lampopt.Bank, count: int) -> dict[str, Any]:
    """The paper's table 7: all nine parameters asked for, in range, none of the exemplars."""
    space = Space.of()
    rng = np.random.default_rng(bench.seed + 7)
    asked = space.middle + space.half * rng.uniform(-1, 1, (count, 9))
    targets = [dict(zip(bwb.NAMES, row.tolist(), strict=True)) for row in asked]
    rows = all_made(bench, bank, "interpolation", targets, truth=True)
    there = [row for row in rows if "cd" in row]
    wanted, found = np.array(
        [[space.normalised(a), space.normalised(_read(row, space))] for a, row in zip(asked, rows, strict=True)]
    ).transpose(1, 0, 2)
    mean = {key: float(np.mean([row[key] for row in there])) for key in ("cd", "floor", "iou", "length")}
    about = {"designs": count, "missing": count - len(there)}
    lines = [
        line("Chamfer distance [box²]", mean["cd"], **about),
        line("Chamfer distance of two samples of the true shape [box²]", mean["floor"], **about),
        line("root of the Chamfer distance [box]", float(np.mean([np.sqrt(row["cd"]) for row in there])), **about),
        line("distance of the surfaces [mm]", mean["length"], **about),
        line("IoU", mean["iou"], **about),
        line("MAE of the nine, measured [half ranges]", mean_absolute_error(wanted, found), **about),
        *(line(f"R² of {n}", r_squared(wanted[:, k], found[:, k]), **about) for k, n in enumerate(bwb.NAMES)),
        line("accepted", share([r for r in rows if r["accepted"]], rows), **about),
    ]
    return {"rows": lines, "notes": [f"the paper, by a surrogate on other shapes: {PAPER['interpolation']}"]}


def _read(row: Row, space: Space) -> NDArray[np.float64]:
    """What was measured; the middle of the range where nothing could be."""
    return space.middle if row["measured"] is None else np.array(row["measured"])


def single_targets(space: Space) -> list[dict[str, float]]:
    """Ten values of each parameter over the range widened by OUT, the others free."""
    steps = np.linspace(-OUT, OUT, STEPS)
    asked = [(k, space.middle[k] + s * space.half[k]) for k in range(9) for s in steps]
    return [{bwb.NAMES[k]: float(value)} for k, value in asked if space.possible(k, value)]


def multi_targets(space: Space, rng: np.random.Generator, count: int) -> list[dict[str, float]]:
    """Four parameters of each trial out of range, up to OUT, to either side."""
    found: list[dict[str, float]] = []
    while len(found) < count:
        chosen = rng.choice(9, AT_ONCE, replace=False)
        steps = rng.uniform(1, OUT, AT_ONCE) * rng.choice([-1, 1], AT_ONCE)
        values = space.middle[chosen] + steps * space.half[chosen]
        if all(space.possible(k, v) for k, v in zip(chosen, values, strict=True)):
            found.append({bwb.NAMES[k]: float(v) for k, v in zip(chosen, values, strict=True)})
    return found


def extrapolation(bench: Bench, bank: lampopt.Bank, count: int) -> dict[str, Any]:
    """The paper's table 8."""
    space, lines, notes = Space.of(), [], []
    meshes = lampopt.exemplars("bwb", count=EXEMPLARS, plugins=bench.plugins).meshes
    known = [sample_surface(bank.frame.to_box(mesh), CLOUD, seed=1) for mesh in meshes]
    asked = {
        "single": single_targets(space),
        "multi": multi_targets(space, np.random.default_rng(bench.seed + 8), count),
    }
    for name, targets in asked.items():
        rows = all_made(bench, bank, name, targets)
        wanted, found, which = [], [], []
        for target, row in zip(targets, rows, strict=True):
            values = space.normalised(_read(row, space))
            for parameter, value in target.items():
                k = bwb.NAMES.index(parameter)
                which.append(k)
                wanted.append((value - space.middle[k]) / space.half[k])
                found.append(values[k])
        w, f, k = np.array(wanted), np.array(found), np.array(which)
        clouds = [np.array(row["cloud"]) for row in rows if row["cloud"] is not None]
        about = {"designs": len(rows), "missing": sum(row["measured"] is None for row in rows)}
        lines += [
            line(f"{name}: R²", r_squared(w, f), **about),
            line(f"{name}: MAE [half ranges]", mean_absolute_error(w, f), **about),
            line(f"{name}: MMD [box²]", minimum_matching_distance(clouds, known), **about),
            line(f"{name}: accepted", share([r for r in rows if r["accepted"]], rows), **about),
        ]
        lines += [line(f"{name}: R² of {n}", r_squared(w[k == i], f[k == i]), **about) for i, n in enumerate(bwb.NAMES)]
        notes.append(f"{name}: the paper, by a surrogate on other shapes: {PAPER[name]}")
        if why := sorted({row["why"] for row in rows if row["why"]}):
            notes.append(f"{name}: not measured, taken as the middle of the range: {'; '.join(why[:3])}")
    notes.append(f"panels narrower than {NARROWEST:g} mm are not asked for: B2 would be below 0 at f = 2")
    return {"rows": lines, "notes": notes}


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blendednet", description=__doc__.partition("\n")[0])
    parser.add_argument("--table", choices=("interpolation", "extrapolation", "all"), default="all")
    parser.add_argument("--held-out", type=int, default=HELD_OUT, help="designs in range")
    parser.add_argument("--trials", type=int, default=TRIALS, help="designs with four parameters out of range")
    parser.add_argument("--resolution", type=int, default=256, help="cells along the decoder's box")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("runs/benchmarks"), help="where bank and designs are kept")
    parser.add_argument("--out", type=Path, default=None, help="folder for a JSON document")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    args = parser.parse_args(given)
    os.environ["IGL_NUM_THREADS"] = str(args.threads)  # read by libigl on its first parallel loop
    import torch

    torch.set_num_threads(args.threads)
    bench = Bench(args.cache, lampopt.Spec("sdf-mlp"), args.resolution, seed=args.seed)
    try:
        with threadpool_limits(args.threads, user_api="blas"):
            exemplars = lampopt.exemplars("bwb", count=EXEMPLARS, plugins=bench.plugins)
            bank = bench.bank("bwb-100", exemplars, bench.decoder)
            make: dict[str, Callable[[], dict[str, Any]]] = {
                "interpolation": lambda: interpolation(bench, bank, args.held_out),
                "extrapolation": lambda: extrapolation(bench, bank, args.trials),
            }
            tables = {name: make[name]() for name in make if args.table in (name, "all")}
    except InputError as error:
        bench.console.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    document = {
        "benchmark": "blendednet",
        "decoder": {"name": bank.decoder.name, "options": dict(bank.decoder.options)},
        "fit_error_mm": {"mean": float(bank.fit_error.mean()), "worst": float(bank.fit_error.max())},
        "resolution": args.resolution,
        "seed": args.seed,
        "lampopt": version("lampopt"),
        "commit": state(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "tables": tables,
        "seconds": bench.seconds,
    }
    text = json.dumps(plain(document), indent=1, allow_nan=False, ensure_ascii=False)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "blendednet.json").write_text(text + "\n", encoding="utf-8")
    if args.json:
        sys.stdout.write(text + "\n")
    else:
        for name, table in tables.items():
            show(Console(width=160), f"blendednet: {name}", table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
