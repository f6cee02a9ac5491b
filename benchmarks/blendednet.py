"""BlendedNet's tables of the paper (7 and 8) on our own family `bwb`, measured directly, and by the paper's surrogate.

    python -m benchmarks.blendednet --table exemplars         what can be read off the decoded exemplars themselves
    python -m benchmarks.blendednet --table interpolation     held-out designs in range: Chamfer distance, IoU, error
    python -m benchmarks.blendednet --table extrapolation     one and four parameters up to 50 % out of range: R², MMD

100 exemplars, as in the paper. Parameters are normalised to [-1, 1] over their range, shapes by the bank's frame (the
largest exemplar fills 0.6 of [-1, 1]³); the Chamfer distance is the paper's (appendix G: squared, both ways). The
surrogate is `pointnet-lasso`, learned from true shapes of the family that marching cubes have cut like a decoder's.
Mixes out of range lie as near as can be to the mean of the bank, which is the paper's, or to the exemplar that is
nearest in what is asked for.
"""

from __future__ import annotations

import argparse
import inspect
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from threadpoolctl import threadpool_limits
from trimesh import Trimesh

import lampopt
from lampopt.decode import decode
from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.metrics import chamfer_distance, mean_absolute_error, minimum_matching_distance, r_squared, sample_surface
from lampopt_families import bwb
from lampopt_pointnet.cloud import Cut
from lampopt_pointnet.learned import Learned
from lampopt_pointnet.pooled import PointNet
from lampopt_pointnet.surrogates import PointNetLasso

from . import recut
from .common import Bench, Row, core, judged, key, line, parsed, share, source
from .document import put, show, stamped
from .recut import recut_in_box
from .truth import NARROWEST

EXEMPLARS = 100
HELD_OUT = 200
OUT = 2.0  # range factor of the sweeps: the paper's ±50 %
STEPS = 10  # values of each parameter alone
TRIALS = 100
AT_ONCE = 4  # parameters out of range together
LEARNT = 800  # shapes that the surrogate is learned from (paper, appendix H)
CENTRES = ("mean", "nearest")  # what a mix lies as near to as can be
READINGS = {"direct": "measured", "surrogate": "learned"}  # how a value is read → where a row has it
CLOUD = 2_048  # points of a shape for Chamfer distances
VOXELS = 64  # along the box, for IoU
PAPER = {
    "interpolation": "CD 0.0172, IoU 95.35 %, MAE 0.0031",
    "single": "MMD 0.035, MAE 0.305, R² 0.868",
    "multi": "MMD 0.037, MAE 0.353, R² 0.782",
}


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


@dataclass(frozen=True)
class Trial:
    """What designs are made and read with, and a hash of all of it."""

    bench: Bench
    bank: lampopt.Bank
    learned: Learned
    code: str

    @classmethod
    def of(cls, bench: Bench, bank: lampopt.Bank) -> Trial:
        learned, seen = surrogate(bench, bank)
        used = [PointNetLasso, bwb.BwbSource, bench.plugins.get("measure", "bwb").resolve()]
        own = [CLOUD, VOXELS, inspect.getsource(cls)]
        return cls(bench, bank, learned, key([bench.identity(bank), seen, *map(source, used), own]))

    def reference(self, centre: str, target: dict[str, float]) -> str | None:
        """The exemplar that is nearest in what is asked for; None for the mean."""
        if centre == "mean":
            return None
        space, columns = Space.of(), [bwb.NAMES.index(name) for name in target]
        apart = (np.array(self.bank.parameters)[:, columns] - list(target.values())) / space.half[columns]
        return self.bank.names[int((apart**2).sum(axis=1).argmin())]

    def made(self, target: dict[str, float], centre: str, true: Trimesh | None) -> Row:
        """One design: its verdict, how it is read, its points in the box, and how it compares with the truth."""
        reference = self.reference(centre, target)
        known = ["blendednet", self.code, target, reference, true is not None]
        return self.bench.scores.get(known, lambda: self._made(target, reference, true))

    def _made(self, target: dict[str, float], reference: str | None, true: Trimesh | None) -> Row:
        resolution, plugins = self.bench.resolution, self.bench.plugins
        result = lampopt.design(self.bank, target, reference=reference, resolution=resolution, plugins=plugins)
        row, mesh = judged(result), result.design.mesh
        row |= dict.fromkeys(("measured", "learned", "outside", "cloud")) | {"why": "no mesh"}
        if mesh is None:
            return row
        boxed = self.bank.frame.to_box(mesh)
        row["cloud"] = np.round(sample_surface(boxed, CLOUD), 5).tolist()
        if true is not None:
            shape, cloud = self.bank.frame.to_box(true), np.array(row["cloud"])
            row |= {
                "cd": chamfer_distance(cloud, sample_surface(shape, CLOUD, seed=1)),
                "floor": chamfer_distance(sample_surface(shape, CLOUD), sample_surface(shape, CLOUD, seed=1)),
                "iou": lampopt.metrics.iou(boxed, shape, VOXELS),
                "length": lampopt.metrics.surface_distance(mesh, true),
            }
        try:
            row |= {"learned": self.learned(mesh).tolist(), "outside": bool(self.learned.outside(mesh))}
            values = lampopt.measure("bwb", mesh, plugins=plugins)
            return row | {"measured": [values[name] for name in bwb.NAMES], "why": ""}
        except (MeasureError, EmptyMesh) as error:
            return row | {"why": str(error)}

    def decoded(self, i: int) -> Row:
        """Exemplar `i` as its own weights give it, read directly."""

        def make() -> Row:
            decoder = self.bench.plugins.make("decoder", self.bank.decoder)
            mesh = decode(self.bank, decoder, np.asarray(self.bank.weights[i]), resolution=self.bench.resolution)
            try:
                values = lampopt.measure("bwb", mesh, plugins=self.bench.plugins)
            except MeasureError as error:
                return {"measured": None, "why": str(error)}
            return {"measured": [values[name] for name in bwb.NAMES], "why": ""}

        return self.bench.scores.get(["blendednet exemplar", self.code, i], make)

    def all_made(self, name: str, targets: Sequence[dict[str, float]], centre: str, truth: bool = False) -> list[Row]:
        rows = []
        with self.bench.stage(f"{name}: {len(targets)} designs") as tell:
            for i, target in enumerate(targets):
                tell(i / len(targets))
                true = bwb.bwb_mesh(np.array([target[n] for n in bwb.NAMES])) if truth else None
                rows.append(self.made(target, centre, true))
        return rows


def surrogate(bench: Bench, bank: lampopt.Bank) -> tuple[Learned, str]:
    """The paper's surrogate (appendix H), and a hash of the LEARNT shapes that it is learned from.

    Marching cubes cut them in the bank's box.
    """
    kind = PointNetLasso()
    low, high = np.array(bwb.LOW), np.array(bwb.HIGH)
    parameters = np.random.default_rng([bench.seed, LEARNT]).uniform(low, high, (LEARNT, 9))
    scale = float(bwb.bwb_mesh((low + high) / 2).extents.max()) / 2
    code = [source(Cut), source(PointNet), source(bwb.BwbSource), core("decode"), parsed(Path(recut.__file__ or ""))]
    frame = [bank.frame.scale, bank.frame.centre.tolist()]
    seen = key([code, frame, bench.resolution, kind.neurons, bench.seed, LEARNT, scale])
    path = bench.cache / f"blendednet-features-{seen}.npy"
    features = list(np.load(path)) if path.exists() else []
    pooled = kind.pooled(bench.seed)
    with bench.stage(f"surrogate: {LEARNT} shapes") as tell:
        for row in parameters[len(features) :]:
            features.append(
                pooled(Cut.of(recut_in_box(bwb.bwb_mesh(row), bank.frame, bench.resolution), scale).cloud())
            )
            tell(len(features) / LEARNT)
            if len(features) % 50 == 0 or len(features) == LEARNT:
                partial = path.with_suffix(".partial.npy")
                np.save(partial, features)
                partial.replace(path)
        units = [unit for _, _, unit in bwb.SPACE.values()]
        return kind.fit_features(scale, np.array(features), parameters, bwb.NAMES, units, seed=bench.seed), seen


def exemplars(trial: Trial) -> dict[str, Any]:
    """How well the exemplars' own networks show their parameters: what no mix of them can be expected to better."""
    space, parameters = Space.of(), np.array(trial.bank.parameters)
    with trial.bench.stage(f"exemplars: {len(parameters)} decoded"):
        rows = [trial.decoded(i) for i in range(len(parameters))]
    found = np.array([_read(row["measured"], space) for row in rows])
    about = {"designs": len(rows), "missing": sum(row["measured"] is None for row in rows)}
    lines = []
    for k, n in enumerate(bwb.NAMES):
        off = float(np.sqrt(np.mean((found[:, k] - parameters[:, k]) ** 2)))
        unit = list(bwb.SPACE.values())[k][2]
        lines += [
            line(f"R² of {n}", r_squared(parameters[:, k], found[:, k]), **about),
            line(f"root mean square error of {n} [{unit}]", off, **about),
        ]
    return {"rows": lines, "notes": ["decoded from their own weights, measured by `bwb`"]}


def interpolation(trial: Trial, count: int) -> dict[str, Any]:
    """The paper's table 7: all nine parameters asked for, in range, none of the exemplars."""
    space = Space.of()
    rng = np.random.default_rng(trial.bench.seed + 7)
    asked = space.middle + space.half * rng.uniform(-1, 1, (count, 9))
    targets = [dict(zip(bwb.NAMES, row.tolist(), strict=True)) for row in asked]
    rows = trial.all_made("interpolation", targets, "mean", truth=True)
    there = [row for row in rows if "cd" in row]
    mean = {what: float(np.mean([row[what] for row in there])) for what in ("cd", "floor", "iou", "length")}
    about = {"designs": count, "missing": count - len(there)}
    lines = [
        line("Chamfer distance [box²]", mean["cd"], **about),
        line("Chamfer distance of two samples of the true shape [box²]", mean["floor"], **about),
        line("root of the Chamfer distance [box]", float(np.mean([np.sqrt(row["cd"]) for row in there])), **about),
        line("distance of the surfaces [mm]", mean["length"], **about),
        line("median of the distances [mm]", float(np.median([row["length"] for row in there])), **about),
        line("IoU", mean["iou"], **about),
        line("accepted", share([r for r in rows if r["accepted"]], rows), **about),
    ]
    wanted = space.normalised(asked)
    for reading, where in READINGS.items():
        found = space.normalised(np.array([_read(row[where], space) for row in rows]))
        about = {"designs": count, "missing": sum(row[where] is None for row in rows)}
        lines += [
            line(f"{reading}: MAE of the nine [half ranges]", mean_absolute_error(wanted, found), **about),
            line(f"{reading}: median error of the nine [half ranges]", median_error(wanted, found), **about),
            *(
                line(f"{reading}: R² of {n}", r_squared(wanted[:, k], found[:, k]), **about)
                for k, n in enumerate(bwb.NAMES)
            ),
        ]
    lines.append(line("surrogate: outside", share([r for r in there if r["outside"]], there), designs=len(there)))
    return {"rows": lines, "notes": [f"the paper, by its surrogate: {PAPER['interpolation']}"]}


def _read(values: Sequence[float] | None, space: Space) -> NDArray[np.float64]:
    """What was read; the middle of the range where nothing could be."""
    return space.middle if values is None else np.array(values)


def median_error(wanted: NDArray[np.float64], found: NDArray[np.float64]) -> float:
    """The median of the absolute errors: a few shapes in pieces do not speak for the rest."""
    return float(np.median(np.abs(wanted - found)))


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


def extrapolation(trial: Trial, count: int) -> dict[str, Any]:
    """The paper's table 8, from the mean of the bank and from the nearest exemplar, read in both ways."""
    space, lines, notes, bench = Space.of(), [], [], trial.bench
    meshes = lampopt.exemplars("bwb", count=EXEMPLARS, plugins=bench.plugins).meshes
    known = [sample_surface(trial.bank.frame.to_box(mesh), CLOUD, seed=1) for mesh in meshes]
    asked = {
        "single": single_targets(space),
        "multi": multi_targets(space, np.random.default_rng(bench.seed + 8), count),
    }
    for name, targets in asked.items():
        for centre in CENTRES:
            rows = trial.all_made(f"{name}, {centre}", targets, centre)
            lines += outcome(f"{name}, from the {centre}", targets, rows, known)
            if why := sorted({row["why"] for row in rows if row["why"]}):
                notes.append(f"{name}, {centre}: not measured, taken as the middle of the range: {'; '.join(why[:3])}")
        notes.append(f"{name}: the paper, from the mean, by its surrogate: {PAPER[name]}")
    notes.append(f"panels narrower than {NARROWEST:g} mm are not asked for: B2 would be below 0 at f = 2")
    return {"rows": lines, "notes": notes}


def outcome(
    name: str, targets: Sequence[dict[str, float]], rows: Sequence[Row], known: Sequence[NDArray[np.float64]]
) -> list[Row]:
    """The lines of one kind of trial."""
    space, kinds = Space.of(), [bwb.NAMES.index(parameter) for target in targets for parameter in target]
    which = np.array(kinds)
    w = np.array([v for target in targets for v in target.values()])
    w = (w - space.middle[which]) / space.half[which]
    clouds = [np.array(row["cloud"]) for row in rows if row["cloud"] is not None]
    about = {"designs": len(rows), "missing": len(rows) - len(clouds)}
    lines = [
        line(f"{name}: MMD [box²]", minimum_matching_distance(clouds, known), **about),
        line(f"{name}: accepted", share([r for r in rows if r["accepted"]], rows), **about),
    ]
    for reading, where in READINGS.items():
        values = [space.normalised(_read(row[where], space)) for row in rows]
        f = np.array([v[bwb.NAMES.index(n)] for v, target in zip(values, targets, strict=True) for n in target])
        about = {"designs": len(rows), "missing": sum(row[where] is None for row in rows)}
        lines += [
            line(f"{name}, {reading}: R²", r_squared(w, f), **about),
            line(f"{name}, {reading}: MAE [half ranges]", mean_absolute_error(w, f), **about),
            line(f"{name}, {reading}: median error [half ranges]", median_error(w, f), **about),
            *(
                line(f"{name}, {reading}: R² of {n}", r_squared(w[which == i], f[which == i]), **about)
                for i, n in enumerate(bwb.NAMES)
                if (which == i).sum() > 1
            ),
        ]
    outside = [row["outside"] for row in rows if row["outside"] is not None]
    return [*lines, line(f"{name}, surrogate: outside", float(np.mean(outside)), designs=len(outside))]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blendednet", description=__doc__.partition("\n")[0])
    parser.add_argument("--table", choices=("exemplars", "interpolation", "extrapolation", "all"), default="all")
    parser.add_argument("--held-out", type=int, default=HELD_OUT, help="designs in range, 2 or more")
    parser.add_argument("--trials", type=int, default=TRIALS, help="designs with four parameters out of range")
    parser.add_argument("--resolution", type=int, default=256, help="cells along the decoder's box")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("runs/benchmarks"), help="where bank and designs are kept")
    parser.add_argument("--out", type=Path, default=None, help="folder for a JSON document")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    args = parser.parse_args(arguments)
    if args.held_out < 2 or args.trials < 2:
        parser.error("expected 2 designs or more: of one there is no R²")
    os.environ["IGL_NUM_THREADS"] = str(args.threads)  # read by libigl on its first parallel loop
    import torch

    torch.set_num_threads(args.threads)
    bench = Bench(args.cache, lampopt.Spec("sdf-mlp"), args.resolution, seed=args.seed)
    try:
        with threadpool_limits(args.threads, user_api="blas"):
            given = lampopt.exemplars("bwb", count=EXEMPLARS, plugins=bench.plugins)
            bank = bench.bank("bwb-100", given, bench.decoder)
            trial = Trial.of(bench, bank)
            make: dict[str, Callable[[], dict[str, Any]]] = {
                "exemplars": lambda: exemplars(trial),
                "interpolation": lambda: interpolation(trial, args.held_out),
                "extrapolation": lambda: extrapolation(trial, args.trials),
            }
            tables = {name: make[name]() for name in make if args.table in (name, "all")}
    except InputError as error:
        bench.console.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    decoder = {"name": bank.decoder.name, "options": dict(bank.decoder.options)}
    document = stamped("blendednet", decoder=decoder, seed=args.seed, resolution=args.resolution, threads=args.threads)
    error = bank.fit_error / bank.frame.scale
    document |= {
        "fit_error_mm": {"mean": float(error.mean()), "worst": float(error.max())},
        "surrogate": {"r2_cross_validated": {n: v["r2"] for n, v in trial.learned.cross_validated.items()}},
        "tables": tables,
        "seconds": bench.seconds,
    }
    put(document, args.out and args.out / "blendednet.json", out=args.json)
    if not args.json:
        for name, table in tables.items():
            show(Console(width=160), f"blendednet: {name}", table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
