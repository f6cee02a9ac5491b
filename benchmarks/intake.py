"""Intake on real files, and how near a wrap keeps to them: ``python -m benchmarks.intake`` (docs/intake.md)."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits
from trimesh import Trimesh

import lampopt
from lampopt.meshfile import load_mesh
from lampopt.metrics import sample_surface
from lampopt.topology import topology
from lampopt.types import Array

from .common import ROOT, Row
from .document import put, show

GAP = 1 / 60  # of the length
RAYS = 100  # from a point on the surface, to see how much of the outside it sees
SEEN = 0.2  # least share of them that are free


def wrapped(mesh: Trimesh, seed: int) -> Row:
    """The wrap of `mesh`, and the distances between both in parts of the length."""
    length = float(mesh.extents.max())
    made = lampopt.wrap(mesh, gap=GAP * length)
    shape = topology(made)
    added = _distances(sample_surface(made, 5_000, seed), mesh) / length
    left_out = _distances(_visible(mesh, 2_000, seed), made) / length
    return {
        "closed, outward, one body": shape.closed and shape.bodies == 1 and made.volume > 0,
        "genus": shape.genus,
        "faces": len(made.faces),
        "from the wrap, mean": float(added.mean()),
        "from the wrap, 99th percentile": float(np.percentile(added, 99)),
        "from the visible surface, mean": float(left_out.mean()),
        "from the visible surface, 99th percentile": float(np.percentile(left_out, 99)),
    }


def _distances(points: Array, mesh: Trimesh) -> Array:
    import igl

    corners = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    return np.sqrt(igl.point_mesh_squared_distance(np.ascontiguousarray(points, float), *corners)[0])


def _visible(mesh: Trimesh, count: int, seed: int) -> Array:
    """Points on `mesh` that see enough of the outside from one of their two sides."""
    import igl
    import trimesh

    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals, off = mesh.face_normals[faces], 1e-4 * float(mesh.extents.max())
    corners = np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(mesh.faces, np.int64)
    hidden = [
        igl.ambient_occlusion(*corners, np.ascontiguousarray(points + off * side), np.ascontiguousarray(side), RAYS)
        for side in (normals, -normals)
    ]
    return np.asarray(points)[np.minimum(*(np.ravel(share) for share in hidden)) < 1 - SEEN]


def files(data: Path) -> list[Path]:
    return sorted(path for folder in ("cars/raw", "parts") for path in (data / folder).iterdir())


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.intake", description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="with cars/raw and parts")
    parser.add_argument("--seed", type=int, default=0, help="of the points that are compared")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    args = parser.parse_args(given)
    os.environ["IGL_NUM_THREADS"] = "1"  # read by libigl on its first parallel loop
    if not (args.data / "cars" / "raw").is_dir():
        Console(stderr=True).print(f"no real files in {args.data}: name their folder with --data")
        return 2
    rows = []
    with threadpool_limits(1, user_api="blas"):
        for path in files(args.data):
            mesh = load_mesh(path)
            alone = lampopt.Exemplars(np.zeros((1, 1)), (lampopt.Parameter("none"),), [mesh], (path.stem,))
            report = lampopt.intake(alone)
            row: Row = {"name": path.name, "verdict": "refused" if report.problems else "used"}
            row["repairs"] = "; ".join(report.health[0].repairs) if report.health else ""
            rows.append(row | (wrapped(mesh, args.seed) if path.parent.name == "raw" else {}))
    table = {"rows": rows, "notes": [f"distances in parts of the length, gap {GAP:.4f} of it"]}
    put(table, None, out=args.json)
    if not args.json:
        cars = [row for row in rows if "faces" in row]
        show(Console(width=160), "wraps", table | {"rows": cars})
        show(Console(width=160), "parts", {"rows": [row for row in rows if "faces" not in row], "notes": []})
    return 0


if __name__ == "__main__":
    sys.exit(main())
