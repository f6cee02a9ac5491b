"""Flow solutions held against experiments, against themselves, and against what goes wrong (docs/flow.md).

    python -m benchmarks.flow --study ahmed --levels coarse,medium
    python -m benchmarks.flow --study repeatability --levels coarse
    python -m benchmarks.flow --study refinement --levels coarse,medium,fine
    python -m benchmarks.flow --study pairs
    python -m benchmarks.flow --study hostile
    python -m benchmarks.flow --study outcomes

Flows are kept in --cache: a study that was broken off goes on, a failed flow is a row that says why.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from trimesh import Trimesh
from trimesh.creation import icosphere

import lampopt
from lampopt.errors import LampoptError
from lampopt.meshfile import load_mesh
from lampopt.plugins import Plugins

from .body import judge_at
from .common import ROOT, Row
from .document import put, stamped

AS_IT_IS = "as it is"
EXPERIMENT = {"0": 0.250, "12.5": 0.230, "25": 0.285, "35": 0.257}  # Ahmed, Ramm and Faltin (1984), by slant [deg]
AHMED = ROOT.parent / "shared" / "data" / "ahmed"
UNDER, LENGTH = 50.0, 1044.0  # mm below the Ahmed body, and its length
ROUGH_M, CRUMB_M, HOLE = 0.005, 0.05, 60  # what is done to a car of 4.5 m; faces missing in the hole
CHANGES = {"roof": 0.10, "trunk": 8.0, "length": 0.15}  # of one parameter at a time [m, deg, m]


def drag(cache: Path, **options: Any) -> Any:
    return Plugins.load().report().make("measure", lampopt.Spec("openfoam-drag", folder=str(cache), **options))


def told(solve: Callable[[], Any], **row: Any) -> Row:
    """One row: a flow, or the outcome that stands in its place."""
    began = time.perf_counter()
    try:
        flow = solve()
    except LampoptError as error:
        return {**row, "outcome": getattr(error, "outcome", type(error).__name__), "message": str(error)}
    values = [one.drag for one in flow.placed]
    return {
        **row,
        "outcome": "solved",
        "drag": flow.drag,
        "error": flow.drag_error,
        "lift": flow.lift,
        "lift_error": flow.lift_error,
        "cells": flow.cells,
        "by_placement": values,
        "numbers": [one.number for one in flow.placed],
        "scatter": float(np.std(values, ddof=1) / np.mean(values)) if len(values) > 1 else float("nan"),
        "seconds": sum(one.seconds for one in flow.placed) / len(values),
        "waited": round(time.perf_counter() - began, 1),
        "openfoam": flow.openfoam,
        "notes": list(flow.notes),
    }


def ahmed(args: argparse.Namespace, _: ModuleType) -> list[Row]:
    rows = []
    for level in args.levels:
        made = drag(
            args.cache,
            level=level,
            half=args.half,
            workers=args.workers,
            placements=args.placements,
            ground="fixed",
            clearance=UNDER / LENGTH,
        )
        for slant, experiment in EXPERIMENT.items():
            mesh = load_mesh(AHMED / f"ahmed_{slant}.stl")
            rows.append(told(lambda made=made, mesh=mesh: made.solve(mesh), name=f"{slant} deg", level=level))
            rows[-1]["experiment"] = experiment
            args.tell(rows[-1])
    return rows


def repeatability(args: argparse.Namespace, judge: ModuleType) -> list[Row]:
    rows = []
    for level in args.levels:
        for name in args.bodies:
            made = drag(args.cache, level=level, half=args.half, workers=args.workers, placements=args.placements)
            rows.append(told(lambda made=made, name=name: made.solve(judge.body(name)), name=name, level=level))
            args.tell(rows[-1])
    return rows


def refinement(args: argparse.Namespace, judge: ModuleType) -> list[Row]:
    """Each body on several levels, and its drag extrapolated to a grid without error (Richardson)."""
    rows = []
    for name in args.bodies:
        made = drag(args.cache, half=args.half, workers=args.workers, placements=args.placements)
        study = made.refined(judge.body(name), args.levels)
        rows += [told(lambda flow=flow: flow, name=name, level=level) for level, flow in study.flows.items()]
        rows += [{"name": name, "level": level, "outcome": why} for level, why in study.failures.items()]
        if (found := study.drag) is not None:
            row = {"name": name, "level": "extrapolated", "outcome": found.message, "drag": found.value}
            rows.append({**row, "error": found.error, "noise": found.noise, "order": found.order})
            args.tell(rows[-1])
    return rows


def pairs(args: argparse.Namespace, judge: ModuleType) -> list[Row]:
    """One parameter changed at a time: what is told from how many placements."""
    rows = []
    for level in args.levels:
        made = drag(args.cache, level=level, half=args.half, workers=args.workers, placements=args.placements)
        for name in args.bodies:
            base = judge.body(name)
            for parameter, by in CHANGES.items():
                mesh = judge.morph(base, by * (np.array(judge.NAMES) == parameter))
                row: Row = {"name": f"{name}, {parameter} {by:+g}", "level": level}
                try:
                    pair = made.compared(mesh, base)
                except LampoptError as error:
                    rows.append({**row, "outcome": getattr(error, "outcome", ""), "message": str(error)})
                    continue
                change = pair.drag
                rows.append(
                    {**row, "outcome": change.verdict, "drag": change.value, "error": change.error, "p": change.p}
                )
                rows[-1]["by_placement"] = list(change.by_placement)
                args.tell(rows[-1])
    return rows


def spoilt(base: Trimesh) -> dict[str, Trimesh]:
    """A car [m] as it comes out of decoders and files."""
    draw = np.random.default_rng(0)
    crumb = icosphere(2, CRUMB_M)
    crumb.apply_translation([base.bounds[0, 0] + 1.0, 0.3, base.bounds[1, 2] + 0.15])
    centres = base.triangles_center
    at = centres[np.argmax(centres[:, 2])]
    near = np.argsort(np.linalg.norm(centres - at, axis=1))
    few, many = np.ones(len(near), bool), np.ones(len(near), bool)
    few[near[:12]] = many[near[:HOLE]] = False
    faces = np.array(base.faces)
    turn = draw.random(len(faces)) < 0.3
    faces[turn] = faces[turn][:, ::-1]
    height = draw.normal(size=(len(base.vertices), 1))
    away = {amplitude: base.vertices + amplitude * height * base.vertex_normals for amplitude in (ROUGH_M, 8 * ROUGH_M)}
    return {
        AS_IT_IS: base,
        "fragment of 10 cm": _joined(base, crumb),
        "hole of 12 faces": Trimesh(base.vertices, base.faces[few], process=False),
        f"hole of {HOLE} faces": Trimesh(base.vertices, base.faces[many], process=False),
        "30 % of faces flipped": Trimesh(base.vertices, faces, process=False),
        "5 mm rough": Trimesh(away[ROUGH_M], base.faces, process=False),
        "40 mm rough": Trimesh(away[8 * ROUGH_M], base.faces, process=False),
    }


def _joined(one: Trimesh, other: Trimesh) -> Trimesh:
    faces = np.vstack([one.faces, other.faces + len(one.vertices)])
    return Trimesh(np.vstack([one.vertices, other.vertices]), faces, process=False)


def hostile(args: argparse.Namespace, judge: ModuleType) -> list[Row]:
    """Meshes with something wrong: cleaned with a note, or refused; drag beside that of the mesh as it should be."""
    rows = []
    for level in args.levels:
        made = drag(args.cache, level=level, half=args.half, workers=args.workers, placements=args.placements)
        good: dict[int, float] = {}
        for name, mesh in spoilt(judge.body(args.bodies[0])).items():
            rows.append(told(lambda mesh=mesh, made=made: made.solve(mesh), name=name, level=level))
            if rows[-1]["outcome"] == "solved":
                values = dict(zip(rows[-1]["numbers"], rows[-1]["by_placement"], strict=True))
                good = values if name == AS_IT_IS else good
                same = sorted(good.keys() & values)  # another placement may serve for one of them
                rows[-1]["off"] = float(np.mean([values[k] / good[k] for k in same]) - 1) if same else float("nan")
            args.tell(rows[-1])
    return rows


def outcomes(args: argparse.Namespace, judge: ModuleType) -> list[Row]:
    """What stands in the way of a real solver: every one has a name."""
    base, rows = judge.body(args.bodies[0]), []

    def one(expected: str, name: str, **options: Any) -> None:
        with tempfile.TemporaryDirectory() as folder:
            made = drag(Path(options.pop("folder", folder)), **{"placements": 1, "first": 90, **options})
            rows.append(told(lambda: made.solve(base), name=name, expected=expected))
        rows[-1]["met"] = rows[-1]["outcome"] == expected
        args.tell(rows[-1])

    path = os.environ["PATH"]
    os.environ["PATH"] = "/nowhere"
    one("absent", "OpenFOAM absent")
    os.environ["PATH"] = path
    with _killing("simpleFoam"):
        one("killed", "solver killed after a second")
    with _killing("snappyHexMesh"):
        one("killed", "mesher killed after a second")
    one("timed-out", "time up", timeout_s=8.0)
    case = importlib.import_module("lampopt_openfoam.case")
    kept, case.start_from_potential = case.start_from_potential, lambda _: None
    one("diverged", "potentialFoam's velocity taken as it is")
    case.start_from_potential = kept
    if args.small:
        with _filling(args.small, lambda: True):
            one("disk-full", "disk full from the start", folder=args.small / "flows")
        for tool in ("snappyHexMesh", "simpleFoam"):
            shutil.rmtree(args.small / "flows", ignore_errors=True)
            with _filling(args.small, lambda tool=tool: bool([*args.small.glob(f"flows/*/log.{tool}")])):
                one("disk-full", f"disk filled while {tool} runs", folder=args.small / "flows")
    with tempfile.TemporaryDirectory() as folder:
        made = drag(Path(folder), placements=1, first=90)
        with _killing("simpleFoam", after_s=8.0):
            broken = told(lambda: made.solve(base))
        again = told(lambda: made.solve(base))
        whole = told(lambda: drag(args.cache, placements=1, first=90).solve(base))
        both = again["outcome"] == whole["outcome"] == "solved"
        off = abs(again["drag"] / whole["drag"] - 1) if both else float("nan")
        rows.append({"name": "killed after 8 s, begun again", "expected": "solved", "outcome": again["outcome"]})
        rows[-1] |= {"first": broken["outcome"], "off": off, "seconds": again.get("seconds"), "met": bool(off < 0.01)}
        args.tell(rows[-1])
    return rows


@contextmanager
def _meanwhile(act: Callable[[threading.Event], None]) -> Iterator[None]:
    done = threading.Event()
    thread = threading.Thread(target=act, args=(done,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextmanager
def _killing(tool: str, after_s: float = 1.0) -> Iterator[None]:
    """Within it, one process of ours called `tool` is killed once it has run for a while."""

    def ours(status: Path) -> bool:
        with suppress(OSError, ValueError, IndexError):
            name, _, rest = status.read_text().partition("(")[2].rpartition(")")
            return name == tool[:15] and int(rest.split()[1]) == os.getpid()
        return False

    def act(done: threading.Event) -> None:
        while not done.wait(0.05):
            for status in filter(ours, Path("/proc").glob("[0-9]*/stat")):
                done.wait(after_s)
                if ours(status):  # and not one that only was asked for its version
                    os.kill(int(status.parent.name), 9)
                    return

    with _meanwhile(act):
        yield


@contextmanager
def _filling(folder: Path, when: Callable[[], bool]) -> Iterator[None]:
    """Within it, the disk of `folder` is filled up as soon as `when` says so."""
    filler = folder / "filler"

    def act(done: threading.Event) -> None:
        while not when():
            if done.wait(0.02):
                return
        with suppress(OSError), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(2**16))

    with _meanwhile(act):
        if when():
            time.sleep(1.0)
        yield
    filler.unlink(missing_ok=True)


STUDIES = {
    "ahmed": ahmed,
    "repeatability": repeatability,
    "refinement": refinement,
    "pairs": pairs,
    "hostile": hostile,
    "outcomes": outcomes,
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--study", choices=STUDIES, required=True)
    parser.add_argument("--levels", default="coarse", help="coarse, medium, fine, separated by commas")
    parser.add_argument("--bodies", default="Hybrid", help="of the judge, separated by commas")
    parser.add_argument("--placements", type=int, default=3)
    parser.add_argument("--half", choices=("auto", "yes", "no"), default="auto", help="one half of the body is solved")
    parser.add_argument("--workers", type=int, default=1, help="flows at a time")
    parser.add_argument("--small", type=Path, help="outcomes: a folder on a disk of some 100 MB, to be filled up")
    parser.add_argument("--cache", type=Path, default=Path("runs/flows"), help="where flows are kept")
    parser.add_argument("--judge", help="folder of judge.py (../shared/judge beside the repository)")
    parser.add_argument("--out", type=Path, help="folder for the JSON document")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    args = parser.parse_args(arguments)
    args.levels, args.bodies = args.levels.split(","), args.bodies.split(",")
    talk = Console(stderr=True)
    args.tell = lambda row: talk.print({k: v for k, v in row.items() if k != "message"}, highlight=False)
    began = time.perf_counter()
    try:
        rows = STUDIES[args.study](args, judge_at(args.judge))
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    document = stamped(
        f"flow-{args.study}", levels=args.levels, bodies=args.bodies, placements=args.placements, half=args.half
    )
    document |= {"rows": rows, "seconds": round(time.perf_counter() - began, 1)}
    name = "-".join(["flow", args.study, *args.levels])
    put(document, args.out and args.out / f"{name}.json", out=args.json)
    if not args.json:
        Console().print(_table(args.study, rows))
    return 0


def _table(study: str, rows: Sequence[Row]) -> Table:
    names = ("name", "level", "outcome", "drag", "error", "noise", "scatter", "experiment", "off", "cells", "seconds")
    names += ("notes",)
    shown = [name for name in names if any(name in row for row in rows)]
    table = Table(*shown, title=study)
    for row in rows:
        cells = [row.get(name, "") for name in shown]
        table.add_row(*(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells))
    return table


if __name__ == "__main__":
    sys.exit(main())
