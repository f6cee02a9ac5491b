"""Learned measures by the paper's protocol on families of known truth: ``python -m benchmarks.surrogates --help``."""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from types import ModuleType

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits
from trimesh import Trimesh

from lampopt.errors import InputError
from lampopt.types import Array
from lampopt_families import bwb, car
from lampopt_pointnet.cloud import SIDE, Cloud, Cut
from lampopt_pointnet.surrogates import FourierRidge, PointNetLasso

from .common import ROOT, Row, key

CHUNK = 50  # shapes kept together
FAMILIES: dict[str, ModuleType] = {"car": car, "bwb": bwb}
SURROGATES = {"pointnet-lasso": PointNetLasso(), "fourier-ridge": FourierRidge()}
RESULT = ROOT / "benchmarks" / "results" / "surrogates.json"
LEVEL, FAR, SEED = 0.9, 3.0, 0
FEW = 200  # shapes that a Gaussian process looks for its kernel on: on all of them that takes minutes
FULL = 800, 200, 800, 200  # to learn from (paper, appendix H), to test on, held out besides, out of range
QUICK = 100, 50, 0, 50
Tell = Callable[[str], None]
EDGE, CHORDWISE, SPANWISE = 60.0, 40, 60  # coarser meshes than by default: thousands are made


@dataclass(frozen=True, eq=False)
class Shapes:
    """Clouds of random designs of a family, made once and kept in chunks, so that a killed run goes on."""

    name: str
    module: ModuleType
    cache: Path

    @cached_property
    def code(self) -> str:
        """What kept clouds depend on, found by making two anew: edits that change no shape keep what is there."""
        ends = [
            Cut.of(self.mesh(np.array(end)), self.scale, SIDE).cloud() for end in (self.module.LOW, self.module.HIGH)
        ]
        return key([array.round(6).tolist() for cloud in ends for array in (cloud.points, cloud.normals, cloud.areas)])

    def mesh(self, parameters: Array) -> Trimesh:
        if self.module is car:
            return car.car_mesh(parameters, edge=EDGE)
        return bwb.bwb_mesh(parameters, chordwise=CHORDWISE, spanwise=SPANWISE)

    @cached_property
    def scale(self) -> float:
        """Half the longest side of the first shape that is learned from [mm], as `fit` takes it."""
        return float(next(self._drawn("train", 1, 1.0, 0))[1].extents.max()) / 2

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

    def part(self, part: str, count: int, factor: float, tell: Tell) -> tuple[Array, dict[str, Array], int]:
        """Parameters (count, d), features (count, F) by surrogate, and how many draws the family refused on the way."""
        pooled = {name: surrogate.pooled(SEED) for name, surrogate in SURROGATES.items()}
        drawn = key({name: [getattr(p, f.name).tolist() for f in fields(p)] for name, p in pooled.items()})
        found = []
        for chunk in range(-(-count // CHUNK)):
            path = self.folder / f"{part}-{chunk}-{drawn}.npz"
            if not path.exists():
                parameters, clouds, refused = self._clouds(part, factor, chunk)
                seen = {name: np.stack([*map(p, clouds)]) for name, p in pooled.items()}
                _keep(path, parameters=parameters, refused=refused, **seen)
            with np.load(path) as kept:
                found.append(dict(kept))
            tell(f"{self.name}: {part} {min(count, (chunk + 1) * CHUNK)} of {count}")
        features = {name: np.concatenate([one[name] for one in found])[:count] for name in SURROGATES}
        parameters = np.concatenate([one["parameters"] for one in found])[:count]
        return parameters, features, sum(int(one["refused"]) for one in found)

    @cached_property
    def folder(self) -> Path:
        folder = self.cache / f"surrogates-{self.name}-{self.code}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _clouds(self, part: str, factor: float, chunk: int) -> tuple[Array, list[Cloud], int]:
        """The shapes of a chunk; their clouds are kept too, so that other features cost no new meshes."""
        path = self.folder / f"{part}-{chunk}.npz"
        if not path.exists():
            made = [
                (p, Cut.of(mesh, self.scale, SIDE).cloud(), n) for p, mesh, n in self._drawn(part, CHUNK, factor, chunk)
            ]
            rows = [np.column_stack([c.points, c.normals, c.areas]).astype(np.float32) for _, c, _ in made]
            refused = sum(n for _, _, n in made)
            parameters, sizes = np.array([p for p, _, _ in made]), np.array([len(r) for r in rows])
            _keep(path, parameters=parameters, sizes=sizes, rows=np.concatenate(rows), refused=refused)
        with np.load(path) as kept:
            parts = np.split(kept["rows"].astype(float), np.cumsum(kept["sizes"])[:-1])
            return kept["parameters"], [Cloud(r[:, :3], r[:, 3:6], r[:, 6]) for r in parts], int(kept["refused"])


def _keep(path: Path, **arrays: object) -> None:
    partial = path.with_suffix(".partial.npz")
    np.savez(partial, **arrays)
    partial.replace(path)


def r2(truth: Array, found: Array) -> list[float]:
    share = 1 - ((truth - found) ** 2).sum(axis=0) / ((truth - truth.mean(axis=0)) ** 2).sum(axis=0)
    return [round(float(v), 4) for v in share]


def judged(shapes: Shapes, sizes: tuple[int, int, int, int], tell: Tell) -> Row:
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
    row: Row = {"parameters": names, "train": len(train), "test": len(test), "held_out": len(held)}
    row |= {"far": len(beyond), "refused_draws": refused, "factor": FAR}
    for name, surrogate in SURROGATES.items():
        tell(f"{shapes.name}: {name}")
        measure = surrogate.fit_features(shapes.scale, seen[name], train, names, [""] * len(names), seed=SEED)
        found = np.array([*map(measure.at, seen_held[name])])
        covered = np.abs(found - held) <= measure.half_widths(LEVEL)
        row[name] = {
            "r2": dict(zip(names, r2(test, found[: len(test)]), strict=True)),
            "r2_cross_validated": {n: round(v["r2"], 4) for n, v in measure.cross_validated.items()},
            "covered": round(float(covered.mean()), 4),
            "covered_by_name": dict(zip(names, covered.mean(axis=0).round(3).tolist(), strict=True)),
            "false_alarms": round(float(np.mean([*map(measure.beyond, seen_held[name])])), 4),
            "caught": round(float(np.mean([*map(measure.beyond, seen_beyond[name])])), 4),
        }
    row["compared"] = compared(seen, train, seen_test, test)
    return row


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
            row = judged(shapes, QUICK if asked.quick else FULL, tell)
        result = (json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}) | {name: row}
        if asked.quick:
            print(json.dumps(row, indent=1))
        else:
            RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
