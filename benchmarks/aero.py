"""The family `bwb`: how many designs are watertight, what AeroSandbox says of them: ``python -m benchmarks.aero``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from lampopt.errors import InputError
from lampopt.topology import topology
from lampopt.types import Array
from lampopt_families.bwb import bwb_mesh, family
from lampopt_families.bwb_aero import COEFFICIENTS, METHODS, Condition, coefficients

from .common import Row
from .document import put, show, stamped

DESIGNS = 100
FACTORS = (1.0, 2.0, 3.0)
CONDITIONS = (  # within those of BlendedNet: altitude to 12,192 m, Mach 0.05 to 0.5
    Condition(mach=0.1, altitude=0.0, alpha=0.0),
    Condition(mach=0.2, altitude=1000.0, alpha=2.0),
    Condition(mach=0.3, altitude=3000.0, alpha=4.0),
    Condition(mach=0.4, altitude=8000.0, alpha=6.0),
    Condition(mach=0.5, altitude=12000.0, alpha=8.0),
)


def drawn(factor: float, seed: int) -> Array:
    """(`DESIGNS`, 9) independent draws from BlendedNet's ranges, widened by `factor`."""
    low, high = family().widened(factor)
    return low + (high - low) * np.random.default_rng(seed).random((DESIGNS, len(low)))


def watertight(factor: float, half: bool, seed: int) -> Row:
    """How many designs are a closed body without handles, faces outward; how many are refused, and by what."""
    good, refused, seconds, faces = 0, 0, [], 0
    by: dict[str, int] = {}
    for parameters in drawn(factor, seed):
        began = time.perf_counter()
        try:
            mesh = bwb_mesh(parameters, half=half)
        except InputError as error:
            refused += 1
            for reason in str(error).removeprefix("bwb: ").split("; "):
                by[reason.split(":")[0]] = by.get(reason.split(":")[0], 0) + 1
            continue
        seconds.append(time.perf_counter() - began)
        shape, faces = topology(mesh), len(mesh.faces)
        good += bool(
            shape.closed and shape.bodies == 1 and shape.genus == 0 and mesh.is_winding_consistent and mesh.volume > 0
        )
    return {
        "name": f"{'half' if half else 'whole'}, f = {factor:g}",
        "designs": DESIGNS,
        "watertight, one body, genus 0, outward": good,
        "refused, the parameter named": refused,
        "refused because of": ", ".join(f"{name} {count}" for name, count in sorted(by.items())),
        "faces": faces,
        "median s to make": round(float(np.median(seconds)), 4),
    }


def coefficient_rows(method: str, seed: int) -> list[Row]:
    """Coefficients of all designs at each condition, and the time of one evaluation."""
    designs = drawn(1.0, seed)
    coefficients(designs[0], method)  # what is loaded once counts for no design
    rows = []
    for condition in CONDITIONS:
        seconds, values = [], []
        for parameters in designs:
            began = time.perf_counter()
            found = coefficients(parameters, method, condition)
            seconds.append(time.perf_counter() - began)
            values.append([getattr(found, name) for name in COEFFICIENTS])
        table = np.array(values)
        row: Row = {
            "name": f"{method}, Mach {condition.mach:g}, {condition.altitude:g} m, {condition.alpha:g}°",
            "evaluations": len(table),
            "finite": int(np.isfinite(table).all(axis=1).sum()),
        }
        for k, name in enumerate(COEFFICIENTS):
            low, middle, high = np.percentile(table[:, k], [0, 50, 100])
            row[f"{name}_{method}"] = f"{middle:.4g} ({low:.4g} to {high:.4g})"
        row["mean cl"] = float(table[:, 0].mean())
        row["median s"] = round(float(np.median(seconds)), 4)
        rows.append(row)
    return rows


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.aero", description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of the designs")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="folder for aero.json")
    args = parser.parse_args(given)
    console, began = Console(width=160), time.perf_counter()
    with threadpool_limits(1):
        shapes = [watertight(factor, half, args.seed) for half in (True, False) for factor in FACTORS]
        show(console, "bwb: meshes", {"rows": shapes, "notes": []})
        tables = {"watertight": shapes}
        for method in METHODS:
            tables[method] = coefficient_rows(method, args.seed)
            show(console, f"bwb: {METHODS[method]}", {"rows": tables[method], "notes": []})
    lift = {method: np.array([row["mean cl"] for row in tables[method]]) for method in METHODS}
    document = stamped("aero", seed=args.seed, aerosandbox=version("aerosandbox"))
    document |= {
        "notes": [
            "coefficients: median (least to largest) over the designs; reference is planform area and mean chord",
            "the vortex lattice's drag is the induced one alone",
        ],
        "mean cl of the vortex lattice over that of AeroBuildup, by condition": (
            lift["vlm"] / lift["aerobuildup"]
        ).tolist(),
        "tables": tables,
        "seconds": round(time.perf_counter() - began, 1),
    }
    put(document, args.out / "aero.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
