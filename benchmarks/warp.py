"""A volume mesh that goes along with a design: ``python -m benchmarks.warp --help`` (docs/performance.md).

The space between the template of the judge's Hybrid and a box around it is filled with tetrahedra (TetGen, extra
`bench`), as a flow solver's mesh would; then it is moved to designs with all parameters drawn out of range. A cell is
inverted where its volume changes its sign.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.markup import escape
from trimesh import Trimesh
from trimesh.creation import box

import lampopt
from lampopt.errors import LampoptError
from lampopt.types import Array

from .body import Body, judge_at
from .common import Bench, Row, extra, line, options, threads
from .document import put, show, stamped

ROOM = 1.0  # between the body and the box [body's length]
WIDEST = 2.0  # range factor
MILLION = 1_000_000


def filled(body: Trimesh, largest: float) -> tuple[Array, Array]:
    """Points (M, 3) and tetrahedra (K, 4) of the space between `body` and a box around it."""
    length = float(body.extents.max())
    around = box(body.extents + 2 * ROOM * length)
    for _ in range(4):
        around = around.subdivide()
    around.apply_translation(body.bounds.mean(0))
    corners = np.concatenate([body.vertices, around.vertices])
    faces = np.concatenate([body.faces, around.faces + len(body.vertices)]).astype(np.int32)
    made = extra("tetgen").TetGen(corners, faces)
    face = int(body.area_faces.argmax())
    made.add_hole((body.triangles_center[face] - 1e-3 * length * body.face_normals[face]).tolist())
    points, cells, *_ = made.tetrahedralize(
        plc=True, quality=True, minratio=1.4, mindihedral=10, fixedvolume=True, maxvolume=largest
    )
    return np.asarray(points, float), np.asarray(cells, np.int64)


def volumes(points: Array, cells: Array) -> Array:
    """(K,) signed."""
    a, b, c, d = points[cells].transpose(1, 0, 2)
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6)


def table(bench: Bench, body: Body, count: int, largest: float) -> Row:
    """Inverted cells over `count` designs, the worst that a cell is compressed, and the time."""
    extra("tetgen")  # told before anything is fitted
    bank = body.bank(body.exemplars(), bench.decoder, [])
    template = lampopt.template_of(bank, plugins=bench.plugins)
    with bench.stage("tetrahedra"):
        points, cells = filled(template, largest)
    before = volumes(points, cells)
    sense = np.sign(before.sum())
    if not (sense * before > 0).all():
        raise LampoptError(f"the mesh came with {int((sense * before <= 0).sum())} cells inside out")
    unit = np.random.default_rng(bench.seed).uniform(-WIDEST, WIDEST, (count, len(body.names)))
    rows = []
    for at in unit:
        target = body.middle + at * (body.judge.HIGH - body.judge.LOW) / 2
        asked = dict(zip(body.names, target.tolist(), strict=True))
        result = lampopt.design(bank, asked, resolution=bench.resolution, plugins=bench.plugins)
        began = time.perf_counter()
        moved = lampopt.warp(bank, result.design, points, plugins=bench.plugins)
        seconds = time.perf_counter() - began
        ratio = volumes(moved, cells) / before
        mesh = result.design.mesh
        assert mesh is not None
        on = float(np.abs(moved[: len(template.vertices)] - mesh.vertices).max())
        rows.append(
            {"inverted": int((ratio <= 0).sum()), "least": float(ratio.min()), "on": on, "seconds": seconds}
            | {"accepted": result.accepted}
        )
    least = [row["least"] for row in rows]
    seconds = float(np.median([row["seconds"] for row in rows]))
    return {
        "rows": [
            line("designs with an inverted cell", sum(row["inverted"] > 0 for row in rows), target="<= 0", of=count),
            line("least ratio of a cell's volume, all designs", min(least)),
            line("the same, median over designs", float(np.median(least))),
            line("accepted", sum(row["accepted"] for row in rows), of=count),
            line("farthest that a wall point leaves the design [mm]", 1000 * max(row["on"] for row in rows)),
            line("seconds per million points", seconds / len(points) * MILLION),
        ],
        "setting": {
            "body": body.name,
            "points": len(points),
            "cells": len(cells),
            "largest cell [m³]": largest,
            "f": WIDEST,
        },
        "designs": rows,
        "notes": [
            "TetGen: radius to edge at most 1.4, dihedral angles of 10°, walls cut further where it needs to",
            "time: the median of one warp",
        ],
    }


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.warp", description=__doc__)
    parser.add_argument("--designs", type=int, default=20)
    parser.add_argument("--largest", type=float, default=0.005, help="cell [m³]")
    options(parser, decoder="mesh-template")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    try:
        judge = judge_at(args.judge)
        bench = Bench(args.cache, lampopt.Spec(args.decoder), args.resolution, seed=args.seed, console=talk)
        with threads(args.threads):
            found = table(bench, Body(bench, judge, "Hybrid"), args.designs, args.largest)
    except LampoptError as error:
        talk.print("[bold red]error[/bold red]", escape(str(error)), highlight=False)
        return 2
    if not args.json:
        show(Console(), "warp", found)
    document = stamped("warp", decoder=args.decoder, seed=args.seed, threads=args.threads)
    document |= {"tables": {"warp": found}, "seconds": bench.seconds}
    put(document, args.out and args.out / "warp.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
