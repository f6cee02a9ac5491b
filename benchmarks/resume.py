"""Builds and sweeps killed at random moments and started again: what is lost, what is done twice.

    python -m benchmarks.resume --kills 100

Each attempt is a process of its own that a SIGKILL ends: half of them after a random part of the time that an unbroken
run takes, half of them right before a random operation on files, so that every gap between two of these is met. After
each kill all that stands under its final name is read and compared, and what is finished is noted; started again, none
of that may be begun a second time. A trial ends when an attempt comes to its end; what is there then has to be what an
unbroken run leaves, byte for byte but for the seconds that designs took.

The shapes are boxes and the decoder fits them exactly, so that files, not fitting, take the time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

import lampopt
from lampopt import lamp
from lampopt.plugins import Plugins
from lampopt.testing import shapes
from lampopt.types import Exemplars, Parameter

COUNT = 12  # exemplars of a build
GRID = {"length": [2.1, 2.3, 2.5, -9.0], "width": [1.1, 1.2, 1.3]}  # designs of a negative length have no surface
LOG = "RESUME_LOG"  # environment variable: where work that is begun is noted
FILES = ("open", "os.", "shutil.", "sqlite3.")  # audit events that come before operations on files
COLUMNS = "key, target, alpha, residual, status, message, conflicts, checks, accepted, provenance, mesh, digest"


def begun(what: str) -> None:
    """Note a piece of work in one write, which a kill cannot cut in two."""
    file = os.open(os.environ[LOG], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, f"{what}\n".encode())
    os.close(file)


@dataclass(frozen=True)
class Boxes:
    """Decoder: weights are a box's extents and middle."""

    @property
    def bounds(self) -> np.ndarray:
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes, *, mean, seed):
        begun("start")
        return {"corners": np.asarray(shapes.box([1, 1, 1]).vertices)}

    def fit(self, shared, meshes, *, seed, progress=None):
        begun("fit " + " ".join(mesh.metadata["name"] for mesh in meshes))
        weights = [np.append(mesh.extents, mesh.bounds.mean(0)) for mesh in meshes]
        return np.stack(weights).astype("f4"), np.zeros(len(meshes))

    def evaluate(self, shared, weights, points):
        return points * weights[..., None, :3] + weights[..., None, 3:]

    def decode(self, shared, weights, *, resolution):
        if (weights[:3] <= 0).any():
            raise lampopt.errors.EmptyMesh("a box of no size")
        return shapes.box(weights[:3].astype(float), centre=weights[3:].astype(float))

    def probes(self, shared, count, seed):
        return np.random.default_rng(seed).choice(shared["corners"], count)


@dataclass(frozen=True)
class Witness:
    """Check that notes which design is begun, and judges nothing."""

    needs = "alpha"

    def __call__(self, bank, design):
        begun(f"design {told(dict(design.target))}")
        return ()


class Plugin:
    """Offers both."""

    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"boxes": Boxes}

    @lampopt.hookimpl
    def lampopt_checks(self):
        return {"witness": Witness}


def plugins() -> Plugins:
    """Ours and this one."""
    others = [p.name for p in entry_points(group="lampopt") if p.name not in ("kkt", "measure")]
    return Plugins.load([("resume", Plugin())], block=others)


def told(target: Mapping[str, float]) -> str:
    """A target as text, whatever the order of its names."""
    return json.dumps(target, sort_keys=True)


def exemplars(first: int = 0, count: int = COUNT) -> Exemplars:
    """Boxes that differ in length and width."""
    draws = np.random.default_rng(0).uniform([2.0, 1.0], [3.0, 1.4], (100, 2))[first : first + count]
    names = tuple(f"box_{i}" for i in range(first, first + count))
    meshes = [shapes.box([*row, 0.8]) for row in draws]
    measured = {"length": "extents.length", "width": "extents.width"}
    return Exemplars(draws, (Parameter("length", "m"), Parameter("width", "m")), meshes, names, measured=measured)


# what is killed: each in a folder that holds bank.lamp, of the first exemplars


def build(folder: Path) -> None:
    lampopt.build_bank(exemplars(), "boxes", batch=2, probes=64, store=folder / "built.lamp", plugins=plugins())


def add(folder: Path) -> None:
    bank = lampopt.load_bank(folder / "bank.lamp")
    lampopt.add_exemplars(bank, exemplars(20, 6), store=folder / "built.lamp", plugins=plugins())


def sweep(folder: Path, executor: ThreadPoolExecutor | None = None) -> None:
    study = lampopt.Study(folder / "bank.lamp", checks=("witness",), measures=("extents",))
    for _ in lampopt.sweep(study, GRID, folder / "run", executor=executor, report=False, plugins=plugins()):
        pass


def sweep_by_threads(folder: Path) -> None:
    with ThreadPoolExecutor(2) as threads:
        sweep(folder, threads)


WORK: dict[str, Callable[[Path], None]] = {"build": build, "add": add, "sweep": sweep, "threads": sweep_by_threads}


def attempt(work: str, folder: Path, last: int | None) -> None:
    """Do the work in this process; be killed right before its `last` operation on files in `folder`, if it is given."""
    seen = 0

    def count(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal seen
        if event.startswith(FILES) and any(str(folder) in str(argument) for argument in arguments):
            seen += 1
            if seen == last:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    WORK[work](folder)
    (folder / "operations").write_text(str(seen), encoding="utf-8")


# what is there


def intact(work: str, folder: Path, whole: Path) -> list[str]:
    """What is finished in `folder`, after reading all that stands there under its final name.

    Raises
    ------
    AssertionError
        If something is half written, or not what an unbroken run writes.
    """
    if work in ("build", "add"):
        return parts(folder, whole)
    return designs(folder / "run", whole / "run")


def parts(folder: Path, whole: Path) -> list[str]:
    """Finished parts of a bank, by what notes them when they are begun."""
    store, partial = folder / "built.lamp", folder / "built.lamp.partial"
    if store.exists():
        assert store.read_bytes() == (whole / "built.lamp").read_bytes(), "another bank than that of an unbroken run"
    plan = partial / "plan.json"
    assert not plan.exists() or json.loads(plan.read_text())["plan"], "a plan that is half written"
    names = lampopt.load_bank(whole / "built.lamp").names
    names, batch = (names[-6:], 1) if "box_20" in names else (names, 2)
    found = []
    for part in sorted(partial.glob("*.safetensors")):
        lamp.read(part)  # raises where a hash is not that of what is there
        number = part.stem.removeprefix("batch_")
        first = int(number) * batch if number.isdigit() else 0
        found.append("start" if number == "shared" else "fit " + " ".join(names[first : first + batch]))
    every = ["start"] + ["fit " + " ".join(names[i : i + batch]) for i in range(0, len(names), batch)]
    return every if store.exists() else found


def designs(run: Path, whole: Path) -> list[str]:
    """Finished designs of a run, by what notes them when they are begun."""
    study = (whole / "study.toml").read_text().replace(str(whole.parent), str(run.parent))
    assert not (run / "study.toml").exists() or (run / "study.toml").read_text() == study, (
        "a study that is half written"
    )
    for design in [p for p in (run / "designs").glob("*") if p.suffix != ".writing"]:
        for file in ("mesh.stl", "passport.json"):
            assert (design / file).read_bytes() == (whole / "designs" / design.name / file).read_bytes(), design
    rows = table(run)
    every = table(whole)
    for key, row in rows.items():
        assert row == every[key], f"row {key} is another than that of an unbroken run"
        assert row["mesh"] is None or (run / "designs" / key / row["mesh"]).exists(), f"row {key} has lost its mesh"
    return [f"design {told(json.loads(row['target']))}" for row in rows.values()]


def table(run: Path) -> dict[str, dict[str, Any]]:
    """The rows of a run by key, read from a copy: reading would mend what a kill has left."""
    if not (run / "runs.sqlite").exists():
        return {}
    with tempfile.TemporaryDirectory() as aside:
        try:
            for file in run.glob("runs.sqlite*"):
                shutil.copy(file, aside)
        except FileNotFoundError:  # a journal that went meanwhile: what was copied does not belong together
            return table(run)
        with closing(sqlite3.connect(Path(aside) / "runs.sqlite")) as database:
            assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",), "the database is damaged"
            if not database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                return {}
            database.row_factory = sqlite3.Row
            return {row["key"]: dict(row) for row in database.execute(f"SELECT {COLUMNS} FROM designs")}


def left_over(folder: Path) -> list[str]:
    """Files that only unfinished work has."""
    wanted = ("*.writing", "*.partial", "*-wal", "*-shm", "*-journal")
    return sorted(str(p.relative_to(folder)) for kind in wanted for p in folder.rglob(kind))


# the trials


@dataclass
class Tally:
    """What was seen; `faults` says in words what should not have been."""

    kills: Counter[str] = field(default_factory=Counter)
    trials: Counter[str] = field(default_factory=Counter)
    begun: int = 0
    finished_before: int = 0
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Bench:
    """Where it happens, by which draws."""

    folder: Path
    draws: random.Random
    tally: Tally

    def fresh(self, name: str) -> Path:
        """A folder with a bank in it."""
        folder = self.folder / name
        folder.mkdir(parents=True)
        shutil.copy(self.folder / "bank.lamp", folder)
        return folder

    def unbroken(self, work: str) -> tuple[Path, float, int]:
        """What an unbroken run leaves, the seconds that it takes, and its operations on files."""
        folder = self.fresh(f"{work}-whole")
        os.environ[LOG] = str(folder / "log")
        began = time.perf_counter()
        _start(work, folder, None).join()
        seconds = time.perf_counter() - began
        assert not left_over(folder), left_over(folder)
        return folder, seconds, int((folder / "operations").read_text(encoding="utf-8"))

    def trial(self, work: str, whole: Path, seconds: float, operations: int, kills: int) -> int:
        """One piece of work, killed `kills` times at most; returns how many times it was."""
        tally, folder = self.tally, self.fresh(f"{work}-{self.tally.trials[work]}")
        tally.trials[work] += 1
        log, finished, killed = folder / "log", set[str](), 0
        os.environ[LOG] = str(log)
        while True:
            log.unlink(missing_ok=True)
            ended, how = False, ""
            if killed < kills:
                how = self.draws.choice(("time", "file operation"))
                timed = how == "time"
                process = _start(work, folder, None if timed else self.draws.randint(1, operations))
                process.join(self.draws.uniform(0, seconds) if timed else None)
                ended = process.exitcode == 0
                process.kill()
            else:
                process = _start(work, folder, None)
            process.join()
            if how and not ended and process.exitcode == -signal.SIGKILL:
                killed += 1
                tally.kills[f"{work}, by {how}"] += 1
            elif process.exitcode:
                tally.faults.append(f"{folder.name}: failed with {process.exitcode}")
                return killed
            now = log.read_text().splitlines() if log.exists() else []
            tally.begun += len(now)
            tally.finished_before += len(finished)
            if twice := finished & set(now):
                tally.faults.append(f"{folder.name}: finished, and begun again: {sorted(twice)}")
            if double := [what for what, count in Counter(now).items() if count > 1]:
                tally.faults.append(f"{folder.name}: begun twice in one attempt: {double}")
            try:
                finished = set(intact(work, folder, whole))
            except (AssertionError, OSError, ValueError, lampopt.errors.LampoptError, sqlite3.Error) as error:
                tally.faults.append(f"{folder.name}: {error!r}")
                return killed
            if process.exitcode == 0:
                break
        if left := left_over(folder):
            tally.faults.append(f"{folder.name}: left over {left}")
        if finished != set(intact(work, whole, whole)):
            tally.faults.append(f"{folder.name}: not all is there at the end")
        shutil.rmtree(folder)
        return killed


def _start(work: str, folder: Path, operations: int | None) -> multiprocessing.Process:
    # Forked: what was imported need not be imported again, so that the work itself is what is killed.
    process = multiprocessing.get_context("fork").Process(target=attempt, args=(work, folder, operations))
    process.start()
    return process


def measured(kills: int, seed: int) -> dict[str, Any]:
    """Kill and start again until there were `kills`, spread over all kinds of work."""
    tally = Tally()
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        os.environ[LOG] = str(Path(folder) / "log")
        lampopt.build_bank(exemplars(), "boxes", probes=64, store=Path(folder) / "bank.lamp", plugins=plugins())
        bench = Bench(Path(folder), random.Random(seed), tally)
        whole = {work: bench.unbroken(work) for work in WORK}
        left = kills
        while left > 0 and not tally.faults:
            for work, found in whole.items():
                left -= bench.trial(work, *found, kills=min(left, 5))
    return {
        "what": "SIGKILL at random moments over builds and sweeps, each started again",
        "command": f"python -m benchmarks.resume --kills {kills} --seed {seed}",
        "kills": sum(tally.kills.values()),
        "kills_by_kind": dict(sorted(tally.kills.items())),
        "trials": dict(tally.trials),
        "file_operations_of_an_unbroken_run": {work: operations for work, (_, _, operations) in whole.items()},
        "pieces_begun": tally.begun,
        "pieces_found_finished": tally.finished_before,
        "faults": tally.faults,
        "seconds": round(time.perf_counter() - began, 1),
    }


def main() -> int:
    ask = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    ask.add_argument("--kills", type=int, default=100)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--json", action="store_true", help="print the document and nothing else")
    ask.add_argument("--out", type=Path, help="write it there too")
    chosen = ask.parse_args()
    found = measured(chosen.kills, chosen.seed)
    text = json.dumps(found, indent=2)
    if chosen.out:
        chosen.out.write_text(text + "\n", encoding="utf-8")
    if chosen.json:
        print(text)
    else:
        print(f"{found['kills']} kills in {sum(found['trials'].values())} trials, {found['seconds']} s")
        for kind, count in found["kills_by_kind"].items():
            print(f"  {count:4d}  {kind}")
        print(f"{found['pieces_begun']} pieces of work begun; {found['pieces_found_finished']} found finished, kept")
        print("\n".join(found["faults"]) or "no fault: nothing half written, nothing done twice, every end the same")
    return 1 if found["faults"] else 0


if __name__ == "__main__":
    sys.exit(main())
