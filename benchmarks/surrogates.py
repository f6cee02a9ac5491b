"""Learned measures by the paper's protocol on families of known truth: ``python -m benchmarks.surrogates --help``."""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits
from trimesh import Trimesh

from lampopt.errors import InputError
from lampopt.types import Array
from lampopt_families import bwb, car
from lampopt_pointnet.cloud import Cut
from lampopt_pointnet.learned import Learned
from lampopt_pointnet.pooled import PointNet, Waves
from lampopt_pointnet.surrogates import FourierRidge, PointNetLasso

from .common import ROOT, Row, key
from .recut import recut

CHUNK = 50  # shapes kept together
FAMILIES: dict[str, ModuleType] = {"car": car, "bwb": bwb}
SURROGATES: dict[str, PointNetLasso | FourierRidge] = {
    "pointnet-lasso": PointNetLasso(),
    "fourier-ridge": FourierRidge(),
}
RESULT = ROOT / "benchmarks" / "results" / "surrogates.json"
LEVEL, FAR, SEED = 0.9, 3.0, 0
FEW = 200  # shapes that a Gaussian process looks for its kernel on: on all of them that takes minutes
FULL = 800, 200, 800, 200  # to learn from (paper, appendix H), to test on, held out besides, out of range
QUICK = 100, 50, 0, 50
RECUT = {128: 40, 64: 40}  # of the test shapes, as marching cubes on so many cells give them back
QUICK_RECUT = {64: 5}
LEARNT, LEARNT_CELLS = 200, 64  # shapes of marching cubes that a second measure is learned from
DOZENS = 60  # shapes that a third one is learned from
Tell = Callable[[str], None]
EDGE, CHORDWISE, SPANWISE = 60.0, 40, 60  # coarser meshes than by default: thousands are made


@dataclass(frozen=True, eq=False)
class Shapes:
    """Features of random designs of a family, made once and kept in chunks, so that a killed run goes on."""

    name: str
    module: ModuleType
    cache: Path

    def mesh(self, parameters: Array) -> Trimesh:
        if self.module is car:
            return car.car_mesh(parameters, edge=EDGE)
        return bwb.bwb_mesh(parameters, chordwise=CHORDWISE, spanwise=SPANWISE)

    def seen(self, mesh: Trimesh) -> dict[str, Array]:
        """Features (F,) by surrogate."""
        cloud = Cut.of(mesh, self.scale).cloud()
        return {name: pooled(cloud) for name, pooled in self.pooled.items()}

    @cached_property
    def pooled(self) -> dict[str, PointNet | Waves]:
        return {name: surrogate.pooled(SEED) for name, surrogate in SURROGATES.items()}

    @cached_property
    def scale(self) -> float:
        """Half the longest side of the first shape that is learned from [mm], as `fit` takes it."""
        return float(next(self._drawn("train", 1, 1.0, 0))[1].extents.max()) / 2

    @cached_property
    def folder(self) -> Path:
        """Named by what is seen of two shapes made anew: edits that change no feature keep what is there."""
        ends = [self.seen(self.mesh(np.array(end))) for end in (self.module.LOW, self.module.HIGH)]
        seen = key([{name: features.round(6).tolist() for name, features in end.items()} for end in ends])
        folder = self.cache / f"surrogates-{self.name}-{seen}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _drawn(self, part: str, count: int, factor: float, chunk: int) -> Iterator[tuple[Array, Trimesh, int]]:
        """Parameters, mesh and refused draws before it, all parameters drawn at once from the widened range."""
        low, high = np.array(self.module.LOW), np.array(self.module.HIGH)
        rng = np.random.default_rng([sum(map(ord, part)), chunk])
        for _ in range(count):
            refused = 0
            while True:
                drawn = (low + high) / 2 + factor * (high - low) / 2 * rng.uniform(-1, 1, len(low))
                try:
                    mesh = self.mesh(drawn)
                except InputError:
                    refused += 1
                    continue
                yield drawn, mesh, refused
                break

    def part(
        self, part: str, count: int, factor: float, tell: Tell, cells: int = 0
    ) -> tuple[Array, dict[str, Array], int]:
        """Parameters (count, d), features (count, F) by surrogate, and how many draws the family refused on the way.

        With `cells`, of the shapes as marching cubes on so many give them back.
        """
        found = []
        for chunk in range(-(-count // CHUNK)):
            size = min(CHUNK, count - chunk * CHUNK)
            path = self.folder / f"{part}-{chunk}-{size}-{cells}.npz"
            if not path.exists():
                rows = []
                for parameters, mesh, refused in self._drawn(part, size, factor, chunk):
                    seen = self.seen(recut(mesh, cells) if cells else mesh)
                    rows.append({"parameters": parameters, "refused": np.array(refused)} | seen)
                _keep(path, **{name: np.stack([row[name] for row in rows]) for name in rows[0]})
            with np.load(path) as kept:
                found.append(dict(kept))
            tell(f"{self.name}: {part} {chunk * CHUNK + size} of {count}" + (f", {cells} cells" if cells else ""))
        whole = {name: np.concatenate([one[name] for one in found]) for name in found[0]}
        refused = int(whole.pop("refused").sum())
        return whole.pop("parameters"), whole, refused


def _keep(path: Path, **arrays: Any) -> None:
    partial = path.with_suffix(".partial.npz")
    np.savez(partial, **arrays)
    partial.replace(path)


def r2(truth: Array, found: Array) -> list[float]:
    share = 1 - ((truth - found) ** 2).sum(axis=0) / ((truth - truth.mean(axis=0)) ** 2).sum(axis=0)
    return [round(float(v), 4) for v in share]


def judged(shapes: Shapes, sizes: tuple[int, int, int, int], recuts: Mapping[int, int], tell: Tell) -> Row:
    """What both surrogates reach on a family: the paper's protocol, coverage, range, and regressions compared."""
    learned_from, tested, more, far = sizes
    names = shapes.module.NAMES
    train, seen, _ = shapes.part("train", learned_from, 1.0, tell)
    test, seen_test, _ = shapes.part("test", tested, 1.0, tell)
    beyond, seen_beyond, refused = shapes.part("far", far, FAR, tell)
    held, seen_held = test, seen_test
    if more:
        others, seen_others, _ = shapes.part("held", more, 1.0, tell)
        held = np.concatenate([test, others])
        seen_held = {name: np.concatenate([seen_test[name], seen_others[name]]) for name in SURROGATES}
    again = {cells: shapes.part("test", count, 1.0, tell, cells) for cells, count in recuts.items()}
    cut, seen_cut, _ = shapes.part("train", min(LEARNT, learned_from), 1.0, tell, LEARNT_CELLS)
    row: Row = {"parameters": names, "train": len(train), "test": len(test), "held_out": len(held)}
    row |= {"far": len(beyond), "refused_draws": refused, "factor": FAR}
    for name, surrogate in SURROGATES.items():
        tell(f"{shapes.name}: {name}")
        measure = surrogate.fit_features(shapes.scale, seen[name], train, names, [""] * len(names), seed=SEED)
        row[name] = told(measure, held, seen_held[name], len(test))
        row[name]["r2_cross_validated"] = {n: round(v["r2"], 4) for n, v in measure.cross_validated.items()}
        row[name]["caught"] = round(float(np.mean([*map(measure.beyond, seen_beyond[name])])), 4)
        some = slice(0, DOZENS)
        few = surrogate.fit_features(shapes.scale, seen[name][some], train[some], names, [""] * len(names), seed=SEED)
        row[name]["learned_from_few"] = {"train": len(train[some])} | told(few, held, seen_held[name], len(test))
        row[name]["learned_from_few"]["caught"] = round(float(np.mean([*map(few.beyond, seen_beyond[name])])), 4)
        row[name]["recut"] = {
            str(cells): {"shapes": len(truth)} | told(measure, truth, seen_again[name], len(truth))
            for cells, (truth, seen_again, _) in again.items()
        }
        alike = surrogate.fit_features(shapes.scale, seen_cut[name], cut, names, [""] * len(names), seed=SEED)
        truth, seen_again, _ = again[LEARNT_CELLS]
        row[name]["learned_from_recut"] = {"cells": LEARNT_CELLS, "train": len(cut)} | told(
            alike, truth, seen_again[name], len(truth)
        )
    row["compared"] = compared(seen, train, seen_test, test)
    return row


def told(measure: Learned, truth: Array, seen: Array, tested: int) -> Row:
    """R² on the first `tested` shapes; coverage and false alarms on all."""
    found = np.array([*map(measure.at, seen)])
    covered = np.abs(found - truth) <= measure.half_widths(LEVEL)
    return {
        "r2": dict(zip(measure.names, r2(truth[:tested], found[:tested]), strict=True)),
        "covered": round(float(covered.mean()), 4),
        "covered_by_name": dict(zip(measure.names, covered.mean(axis=0).round(3).tolist(), strict=True)),
        "false_alarms": round(float(np.mean([*map(measure.beyond, seen)])), 4),
    }


def compared(seen: dict[str, Array], train: Array, seen_test: dict[str, Array], test: Array) -> Row:
    """Mean and least R² over the parameters, for both kinds of features by three regressions of scikit-learn's."""
    from sklearn.cross_decomposition import PLSRegression
    from sklearn.decomposition import PCA
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    kernel = ConstantKernel(10.0, (1e-3, 1e6)) * RBF(10.0, (0.1, 1e4)) + WhiteKernel(1e-3, (1e-10, 1.0))
    few = slice(0, FEW)
    regressions = {
        "ridge": (slice(None), make_pipeline(StandardScaler(), RidgeCV(np.geomspace(1e-6, 1e3, 19)))),
        "partial least squares": (slice(None), make_pipeline(StandardScaler(), PLSRegression(40))),
        f"Gaussian process, {FEW} shapes": (
            few,
            make_pipeline(StandardScaler(), PCA(100), GaussianProcessRegressor(kernel, normalize_y=True)),
        ),
    }
    table: Row = {}
    for name in SURROGATES:
        for regression, (rows, model) in regressions.items():
            if regression.startswith("Gaussian") and len(train) < FEW:
                continue
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore", ConvergenceWarning
                )  # a kernel at the end of its range is judged as it is
                scores = r2(test, model.fit(seen[name][rows], train[rows]).predict(seen_test[name]))
            table[f"{name}'s features, {regression}"] = {"mean": round(float(np.mean(scores)), 4), "least": min(scores)}
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and write `benchmarks/results/surrogates.json`; families not asked for keep their lines there."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.surrogates", description=__doc__)
    parser.add_argument("--family", choices=tuple(FAMILIES), action="append", help="all by default")
    parser.add_argument("--quick", action="store_true", help="a tenth of the shapes, nothing written")
    asked = parser.parse_args(arguments)
    tell = Console(stderr=True).log
    for name in asked.family or FAMILIES:
        shapes = Shapes(name, FAMILIES[name], ROOT / "runs" / "benchmarks")
        with threadpool_limits(1):
            row = judged(shapes, *((QUICK, QUICK_RECUT) if asked.quick else (FULL, RECUT)), tell)
        result = (json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}) | {name: row}
        if asked.quick:
            print(json.dumps(row, indent=1))
        else:
            RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
