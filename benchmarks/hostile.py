"""Broken and hostile files, thousands of them: none may crash, hang, or take memory beyond its size (docs/files.md).

    python -m benchmarks.hostile [--lamp 10000] [--others 2000] [--seed 0] [--json] [--out FOLDER]

Each file is read by a process that may be killed, as a user would read it. It may be read, or refused with a
LampoptError; anything else fails the run: another exception, more than SECONDS, more than ROOM bytes beyond the file's
size, a reader that dies or does not answer.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from .mutate import mutated

SECONDS = 5.0  # that one file may take
ROOM = 200 * 2**20  # bytes that reading may take beyond the file's size
SILENT = 30.0  # seconds without an answer after which a reader is killed
TURN = 500  # files that one process reads
MESHES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf", ".dae")
OTHERS = (*MESHES, "ascii.stl", "ascii.ply", "scene.glb", "scene.dae", ".csv", ".parquet", "zstd.parquet", ".toml")
Case = dict[str, Any]


def seeds() -> dict[str, bytes]:
    """Good files by the end of their names."""
    import pyarrow as pa
    import trimesh
    from pyarrow import parquet
    from trimesh.exchange.gltf import export_gltf
    from trimesh.exchange.ply import export_ply

    ball = trimesh.creation.icosphere(subdivisions=1)
    scene = trimesh.Scene([ball, trimesh.creation.box()])
    scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    found = {suffix: ball.export(file_type=suffix[1:]) for suffix in MESHES if suffix != ".gltf"}
    found[".gltf"] = export_gltf(trimesh.Scene(ball), embed_buffers=True)["model.gltf"]
    found["ascii.stl"], found["ascii.ply"] = ball.export(file_type="stl_ascii"), export_ply(ball, encoding="ascii")
    found["scene.glb"], found["scene.dae"] = scene.export(file_type="glb"), _instances(found[".dae"])
    rows = [f"{name}.ply,{length},{drag}" for name, length, drag in (("a", 1.0, 0.3), ("b", 1.5, ""), ("c", 2.0, 0.2))]
    found[".csv"] = "\n".join(["mesh,length [m],drag", *rows]) + "\n"
    columns = {"mesh": ["a.ply", "b.ply", "c.ply"], "length [m]": [1.0, 1.5, 2.0], "drag": [0.3, None, 0.2]}
    for end, codec in ((".parquet", "snappy"), ("zstd.parquet", "zstd")):
        sink = pa.BufferOutputStream()
        parquet.write_table(pa.table({**columns, "tags": [["x"], [], None]}), sink, compression=codec)
        found[end] = sink.getvalue().to_pybytes()
    found[".toml"] = STUDY
    found[".lamp"] = _bank()
    return {name: data.encode() if isinstance(data, str) else bytes(data) for name, data in found.items()}


STUDY = """bank = "cars.lamp"
keep = ["length"]
hard = ["roof"]
reference = "car_017"
level = "mesh"
resolution = 128
seed = 0
solver = { name = "kkt", ridge = 1e-3 }
[targets]
roof = "1420 mm"
[ranges]
ramp = [8.0, 16.0]
[objective]
reduce = "drag"
by = 0.10
[limits]
mismatch = 0.005
[sweep]
tail = [1.30, 1.36, 1.42]
"""


def _instances(dae: bytes | str) -> bytes:
    """A COLLADA document whose scene uses a node of a library twice."""
    text = dae.decode() if isinstance(dae, bytes) else dae
    first, last = text.index("<node "), text.index("</node>") + len("</node>")
    library = f"<library_nodes>{text[first:last].replace('node0', 'part')}</library_nodes>"
    uses = '<node id="n"><translate>3 0 0</translate><instance_node url="#part"/></node><instance_node url="#part"/>'
    uses = uses.replace("</node><instance", '</node><node id="m"><instance') + "</node>"
    text = text[:first] + uses + text[last:]
    return text.replace("<library_visual_scenes>", library + "<library_visual_scenes>").encode()


def _bank() -> bytes:
    """A small bank with everything that a bank can have."""
    from lampopt.lamp import store_bank
    from lampopt.types import Bank, Calibration, Frame, Parameter, Spec

    rng = np.random.default_rng(0)
    n = 6
    parameters = rng.uniform(1, 2, (n, 2))
    space = tuple(Parameter(name, "m", *ends) for name, ends in zip("ab", [(1.0, 2.0)] * 2, strict=True))
    bank = Bank(
        space=space,
        parameters=parameters,
        label_space=(Parameter("drag", "", 0.1, 0.4),),
        labels=np.array([0.1, 0.2, np.nan, 0.4, 0.3, 0.2])[:, None],
        names=tuple(f"car_{i}" for i in range(n)),
        weights=rng.normal(size=(n, 40)).astype("f4"),
        shared={"mean": rng.normal(size=3), "faces": np.arange(12, dtype=np.int32).reshape(4, 3)},
        frame=Frame(0.3, np.zeros(3), "m"),
        decoder=Spec("stretch", size=4, rate=0.1, name_of="x"),
        probes=rng.normal(size=(8, 3)),
        probe_values=rng.normal(size=(n, 8, 1)).astype("f4"),
        fit_error=np.full(n, 0.001),
        measured_by={"a": "size.x"},
        measured=parameters[:, :1],
        mesh_facts={"bodies": 1, "genus": 0},
        limits={"mismatch": 0.02},
        calibration=Calibration(0.01, ("mismatch",), rng.uniform(size=(4, 1)), rng.uniform(size=4), np.arange(4)),
        provenance={"seed": 0, "lampopt": "0.1.0"},
    )
    with tempfile.TemporaryDirectory() as folder:
        store_bank(bank, Path(folder) / "seed.lamp")
        return (Path(folder) / "seed.lamp").read_bytes()


def reader(suffix: str) -> Callable[[Path], object]:
    """What a user would read such a file with."""
    from lampopt import Study, exemplars, load_bank
    from lampopt.meshfile import load_mesh

    if suffix in (".csv", ".parquet"):
        return lambda path: exemplars("table", table=str(path), labels="drag")
    if suffix == ".toml":
        return Study.read
    return load_bank if suffix == ".lamp" else load_mesh


def case(kind: str, number: int, seed: int, good: dict[str, bytes], folder: Path) -> Case:
    """Make file `number` of `kind` (lamp or others), read it, and tell what came of it."""
    from lampopt.errors import LampoptError

    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(kind == "lamp", number)))
    name = ".lamp" if kind == "lamp" else OTHERS[number % len(OTHERS)]
    suffix = Path(f"x{name}").suffix
    data, how = mutated(good[name], suffix, rng)
    if suffix in MESHES and rng.integers(25) == 0:
        suffix, how = MESHES[rng.integers(len(MESHES))], f"{how}+suffix"
    path = folder / f"hostile{suffix}"
    path.write_bytes(data)
    size = len(data)
    del data
    read, before, said = reader(suffix), _peak(), ""
    began = time.perf_counter()
    try:
        read(path)
        outcome = "read"
    except LampoptError as error:
        outcome, said = "refused", f"{type(error).__name__}: {error}"
    except Exception as error:  # noqa: BLE001  # what this is here to find
        outcome, said = f"exception {type(error).__name__}", repr(error)[:500]
    seconds = time.perf_counter() - began
    return {
        "number": number,
        "file": name,
        "how": how,
        "bytes": size,
        "outcome": outcome,
        "message": said[:2000],
        "seconds": seconds,
        "grown": max(_peak() - before, 0),
    }


def _peak() -> int:
    """The most memory that this process has ever held [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def warm(good: dict[str, bytes], folder: Path) -> None:
    """Read every good file, so that what is imported on the way counts for none of the others."""
    for name in "abc":  # which the tables name
        (folder / f"{name}.ply").write_bytes(good[".ply"])
    for name, data in good.items():
        path = folder / f"good{Path(f'x{name}').suffix}"
        path.write_bytes(data)
        reader(path.suffix)(path)


def work(kind: str, first: int, last: int, seed: int) -> None:
    """Read files `first` to `last`, telling of each as one line of JSON: its number before, what came of it after."""
    resource.setrlimit(resource.RLIMIT_AS, (8 * 2**30, 8 * 2**30))  # the machine is others' too
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # whatever a library prints is no answer
    good = seeds()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        warm(good, folder)
        base = _peak()
        for number in range(first, last):
            out.write(json.dumps({"begun": number}) + "\n")
            out.write(json.dumps({**case(kind, number, seed, good, folder), "beyond": _peak() - base}) + "\n")


def turn(kind: str, first: int, last: int, seed: int) -> Iterator[Case]:
    """What comes of files `first` to `last`; a reader that dies or falls silent is replaced after the file it read."""
    while first < last:
        words = [sys.executable, "-m", "benchmarks.hostile", "--worker", kind, str(first), str(last), str(seed)]
        begun = first
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            for told in _lines(process):
                if "begun" in told:
                    begun = told["begun"]
                else:
                    yield told
                    first = told["number"] + 1
            code = process.poll()
            process.kill()
        if first < last:
            outcome = "hang" if code is None else f"died {code}"
            yield {"number": begun, "file": "?", "outcome": outcome, "seconds": SILENT, "beyond": 0, "bytes": 0}
            first = max(begun, first) + 1


def _lines(process: subprocess.Popen[bytes]) -> Iterator[Case]:
    assert process.stdout is not None
    pending = b""
    while select.select([process.stdout], [], [], SILENT if pending else 4 * SILENT)[0]:
        piece = os.read(process.stdout.fileno(), 2**16)
        if not piece:
            process.wait()
            return
        *lines, pending = (pending + piece).split(b"\n")
        yield from map(json.loads, lines)


def wrong(told: Case) -> str:
    """Why a file fails the run; "" where it does not."""
    if told["outcome"] not in ("read", "refused"):
        return str(told["outcome"])
    if told["seconds"] > SECONDS:
        return "slow"
    return "memory" if told.get("grown", 0) and told["beyond"] > ROOM + told["bytes"] else ""


def summary(told: Sequence[Case]) -> Case:
    """What came of many files."""
    bad = [case for case in told if wrong(case)]
    return {
        "files": len(told),
        "outcomes": dict(sorted(Counter(case["outcome"] for case in told).items())),
        "by_file": {name: sum(case["file"] == name for case in told) for name in sorted({c["file"] for c in told})},
        "failed": len(bad),
        "worst_seconds": round(max((case["seconds"] for case in told), default=0.0), 3),
        "worst_beyond_bytes": max((case["beyond"] - case["bytes"] for case in told), default=0),
        "failures": [{**case, "why": wrong(case)} for case in bad[:50]],
    }


def main(given: Sequence[str] | None = None) -> int:
    """Run it; 1 where the claim fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lamp", type=int, default=10_000, help="banks")
    parser.add_argument("--others", type=int, default=2_000, help="meshes, tables and studies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument("--out", type=Path, help="folder for hostile.json")
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args(given)
    if args.worker:
        kind, *numbers = args.worker
        work(kind, *map(int, numbers))
        return 0
    talk = Console(stderr=True)
    began, tables = time.perf_counter(), {}
    for kind, count in (("lamp", args.lamp), ("others", args.others)):
        told = []
        for first in range(0, count, TURN):
            told += turn(kind, first, min(first + TURN, count), args.seed)
            talk.print(f"[dim]{kind}: {len(told)} of {count}, {sum(map(bool, map(wrong, told)))} failed[/dim]")
        tables[kind] = summary(told)
    from .document import put, stamped  # not in the workers: what they import counts as theirs

    allowed = {"seconds": SECONDS, "bytes_beyond_the_file": ROOM}
    seconds = round(time.perf_counter() - began, 1)
    document = stamped("hostile", seed=args.seed, allowed=allowed) | {"tables": tables, "seconds": seconds}
    put(document, args.out and args.out / "hostile.json", out=args.json)
    if not args.json:
        Console().print_json(data=document)
    return int(any(table["failed"] for table in tables.values()))


if __name__ == "__main__":
    sys.exit(main())
