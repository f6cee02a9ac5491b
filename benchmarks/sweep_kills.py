"""A sweep killed again and again: it finishes once, and no design that is finished is made or recorded a second time.

    python -m benchmarks.sweep_kills                    1,000 designs, killed ten times, by each of three ways
    python -m benchmarks.sweep_kills --by dask          through a Dask cluster of two workers alone (extra `dask`)

Each attempt is a process of its own that a SIGKILL ends once so many designs are recorded as were drawn, and up to the
time of two designs later. Those who make the designs note when they begin one, the process that records them when it
has recorded one; after each kill all that is there is read and compared with an unbroken run's. The Dask cluster
outlives its callers, and loses one of its workers too. Designs under way when something is killed are begun again, and
counted.
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
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import lampopt
from benchmarks import resume
from lampopt.plugins import Plugins
from lampopt.pool import processes

WAYS = ("alone", "processes", "dask")
LOOK = 0.01  # s between two looks at the notes
PAUSE = 0.02  # s that a design takes beside what its box takes
WORKERS = 2
UNDER_WAY = 2 * max(os.cpu_count() or 1, WORKERS)  # designs, at most


@dataclass(frozen=True)
class Witness(resume.Witness):
    """Check that notes which design is begun, and takes its time."""

    def __call__(self, bank, design):
        nothing = super().__call__(bank, design)
        time.sleep(PAUSE)
        return nothing


class Plugin:
    """Offers boxes, and notes what is begun and what is recorded."""

    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"boxes": resume.Boxes}

    @lampopt.hookimpl
    def lampopt_checks(self):
        return {"witness": Witness}

    @lampopt.hookimpl
    def lampopt_recorded(self, result, folder):
        resume.begun(f"recorded {resume.told(dict(result.design.target))}")


def plugins() -> Plugins:
    others = [p.name for p in entry_points(group="lampopt") if p.name not in ("kkt", "measure")]
    return Plugins.load([("kills", Plugin())], block=others)


def tables(count: int) -> list[dict[str, float]]:
    """Targets, all different; every tenth has no surface."""
    return [
        {"length": -9.0 - i / count if i % 10 == 9 else 2 + i / count, "width": 1 + 0.4 * (7 * i % count) / count}
        for i in range(count)
    ]


@contextmanager
def executor(way: str, address: str) -> Iterator[Executor | None]:
    if way == "dask":
        from distributed import Client

        with Client(address) as client:
            yield client.get_executor()
    else:
        with nullcontext() if way == "alone" else processes(WORKERS) as found:
            yield found


def attempt(way: str, address: str, folder: Path, count: int, number: int) -> None:
    """The sweep, in this process."""
    study = lampopt.Study(folder / "bank.lamp", checks=("witness",), measures=("extents",))
    with executor(way, address) as found:
        resume.begun(f"attempt {number}")
        made = lampopt.sweep(study, tables(count), folder / "run", executor=found, report=False, plugins=plugins())
        (folder / "results").write_text(str(sum(1 for _ in made)), encoding="utf-8")


@dataclass
class Tally:
    """What was seen of one way; `faults` says in words what should not have been."""

    designs: int
    sweep_killed: int = 0
    worker_killed: int = 0
    recorded: int = 0
    begun: int = 0
    begun_again: int = 0  # they were under way when the sweep or a worker was killed
    finished_and_begun_again: int = 0
    recorded_again: int = 0
    recorded_when_killed: list[int] = field(default_factory=list)
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)


def lines(log: Path) -> list[str]:
    return log.read_text(encoding="utf-8").splitlines() if log.exists() else []


def judge(noted: list[str], finished: list[set[str]], tally: Tally) -> None:
    """Read the notes: `finished` has the designs that each attempt found recorded."""
    begun, recorded = Counter[str](), Counter[str]()
    number = -1
    for note in noted:
        kind, _, what = note.partition(" ")
        if kind == "attempt":
            number = int(what)
            continue
        (recorded if kind == "recorded" else begun)[what] += 1
        if f"design {what}" in finished[number]:
            tally.finished_and_begun_again += kind == "design"
            tally.faults.append(f"attempt {number}: finished, and {kind} again: {what}")
    tally.begun, tally.begun_again = begun.total(), begun.total() - len(begun)
    tally.recorded_again = recorded.total() - len(recorded)
    if tally.recorded_again:
        tally.faults.append(f"recorded more than once: {[what for what, times in recorded.items() if times > 1]}")
    most = tally.sweep_killed + tally.worker_killed
    if most and tally.begun_again > most * UNDER_WAY:
        tally.faults.append(f"{tally.begun_again} designs begun again, more than can have been under way")


def killed(way: str, folder: Path, whole: Path, count: int, kills: int, draws: random.Random) -> Tally:
    """The sweep by one way, killed and started again."""
    tally, log, began = Tally(count), folder / "log", time.perf_counter()
    os.environ[resume.LOG] = str(log)
    events = [(draws.randint(1, count - 1), "sweep") for _ in range(kills)]
    events += [(draws.randint(1, count - 1), "worker")] if way == "dask" else []
    with cluster(way) as (address, kill_worker):
        finished = [set[str]()]
        process = _start(way, address, folder, count, 0)
        for recorded, what in sorted(events):
            while process.is_alive() and sum(note.startswith("recorded") for note in lines(log)) < recorded:
                time.sleep(LOOK)
            while process.is_alive() and f"attempt {len(finished) - 1}" not in lines(log):
                time.sleep(LOOK)  # what was drawn is recorded already: killed right after its start
            time.sleep(draws.uniform(0, 2 * PAUSE))
            if what == "worker":
                kill_worker(draws)
                tally.worker_killed += 1
                continue
            process.kill()
            process.join()
            tally.sweep_killed += process.exitcode == -signal.SIGKILL
            finished.append(_read(folder, whole, tally))
            if gone := finished[-2] - finished[-1]:
                tally.faults.append(f"attempt {len(finished) - 2}: recorded before, and gone: {sorted(gone)}")
            tally.recorded_when_killed.append(len(finished[-1]))
            process = _start(way, address, folder, count, len(finished) - 1)
        process.join()
    if process.exitcode or (folder / "results").read_text(encoding="utf-8") != str(count):
        tally.faults.append(f"the last attempt ended with {process.exitcode}, not with {count} results")
    if tally.sweep_killed != kills:
        tally.faults.append(f"killed {tally.sweep_killed} times, not {kills}")
    judge(lines(log), finished, tally)
    tally.recorded = len(_read(folder, whole, tally))
    if tally.recorded != count:
        tally.faults.append(f"{tally.recorded} of {count} designs are recorded at the end")
    if left := resume.left_over(folder):
        tally.faults.append(f"left over: {left}")
    with closing(sqlite3.connect(folder / "run" / "runs.sqlite")) as database:  # a row written anew has a new number
        written = database.execute("SELECT max(rowid) FROM designs").fetchone()[0]
    if written != tally.recorded:
        tally.faults.append(f"{written} rows were written for {tally.recorded} designs")
    tally.seconds = round(time.perf_counter() - began, 1)
    return tally


@contextmanager
def cluster(way: str) -> Iterator[tuple[str, Callable[[random.Random], None]]]:
    """The address of a Dask cluster of two workers, and what kills one; nothing where it is not asked for."""
    if way != "dask":
        yield "", lambda draws: None
        return
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as made,
        Client(made) as client,
    ):
        pids = sorted(client.run(os.getpid).values())
        yield made.scheduler_address, lambda draws: os.kill(draws.choice(pids), signal.SIGKILL)


def _read(folder: Path, whole: Path, tally: Tally) -> set[str]:
    """The designs that are there, all that stands under its final name compared with an unbroken run's."""
    try:
        return set(resume.designs(folder / "run", whole / "run"))
    except (AssertionError, OSError, ValueError, lampopt.errors.LampoptError, sqlite3.Error) as error:
        tally.faults.append(repr(error))
        return set()


def _start(way: str, address: str, folder: Path, count: int, number: int) -> multiprocessing.Process:
    # Spawned: a fork of a process with a cluster's threads may hang.
    process = multiprocessing.get_context("spawn").Process(target=attempt, args=(way, address, folder, count, number))
    process.start()
    return process


def measured(ways: list[str], count: int, kills: int, seed: int) -> dict[str, Any]:
    """Every way's tally."""
    draws, found, by = random.Random(seed), dict[str, Any](), " ".join(ways)
    with tempfile.TemporaryDirectory() as folder:
        places = {name: Path(folder) / name for name in ("whole", *ways)}
        for place in places.values():
            place.mkdir()
        os.environ[resume.LOG] = str(places["whole"] / "log")
        bank = places["whole"] / "bank.lamp"
        lampopt.build_bank(resume.exemplars(), "boxes", probes=64, store=bank, plugins=plugins())
        began = time.perf_counter()
        attempt("alone", "", places["whole"], count, 0)
        seconds = round(time.perf_counter() - began, 1)
        for way in ways:
            shutil.copy(bank, places[way])
            found[way] = asdict(killed(way, places[way], places["whole"], count, kills, draws))
    return {
        "what": "a sweep killed by SIGKILL at random moments and started again, compared with an unbroken one",
        "command": f"python -m benchmarks.sweep_kills --designs {count} --kills {kills} --by {by} --seed {seed}",
        "seconds_of_the_unbroken_run": seconds,
        **found,
    }


def main() -> int:
    ask = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    ask.add_argument("--designs", type=int, default=1000)
    ask.add_argument("--kills", type=int, default=10)
    ask.add_argument("--by", nargs="+", choices=WAYS, default=list(WAYS))
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--json", action="store_true", help="print the document and nothing else")
    ask.add_argument("--out", type=Path, help="write it there too")
    chosen = ask.parse_args()
    found = measured(chosen.by, chosen.designs, chosen.kills, chosen.seed)
    text = json.dumps(found, indent=2)
    if chosen.out:
        chosen.out.write_text(text + "\n", encoding="utf-8")
    if chosen.json:
        print(text)
    else:
        for way in chosen.by:
            tally = found[way]
            print(
                f"{way}: {tally['designs']} designs, the sweep killed {tally['sweep_killed']} times and "
                f"{tally['worker_killed']} workers, {tally['seconds']} s"
            )
            print(f"  {tally['recorded']} recorded, {tally['recorded_again']} of them twice")
            print(f"  {tally['begun']} begun: {tally['begun_again']} of them again, having been under way")
            print("  " + ("\n  ".join(tally["faults"]) or "no fault: the end is that of an unbroken run"))
    return 1 if any(found[way]["faults"] for way in chosen.by) else 0


if __name__ == "__main__":
    from benchmarks import sweep_kills  # by its own name, which other processes know it by

    sys.exit(sweep_kills.main())
