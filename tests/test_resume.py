"""Killed, interrupted, out of room, begun twice: what is finished stays, and the end is that of an unbroken run."""

import errno
import importlib
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

import lampopt
from lampopt.errors import BankError, InputError, LampoptError

HERE = Path(__file__).resolve().parent
sys.path[:0] = [p for p in (str(HERE.parent), str(HERE)) if p not in sys.path]
resume = importlib.import_module("benchmarks.resume")
kills = importlib.import_module("benchmarks.sweep_kills")
SHELL = [sys.executable, "-c", "from lampopt.cli import main; raise SystemExit(main())"]
KILLS = 20
DESIGNS = 16
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A folder with the bank that all work begins from."""
    folder = tmp_path_factory.mktemp("start")
    os.environ[resume.LOG] = str(folder / "log")
    lampopt.build_bank(resume.exemplars(), "boxes", probes=64, store=folder / "bank.lamp", plugins=resume.plugins())
    yield folder
    del os.environ[resume.LOG]


@pytest.fixture(scope="module")
def whole(start):
    """What unbroken runs leave, by the name of the work."""
    for name, work in resume.WORK.items():
        shutil.copytree(start, start / name, ignore=lambda _, names: [n for n in names if n != "bank.lamp"])
        work(start / name)
    return {name: start / name for name in resume.WORK}


@pytest.fixture
def folder(start, tmp_path):
    return fresh(start, tmp_path / "work")


def test_killed_at_random_moments():
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "benchmarks.resume", "--kills", str(KILLS), "--json"],
        cwd=HERE.parent,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["kills"] == KILLS
    assert found["faults"] == []
    assert found["pieces_found_finished"] > 0  # they were killed in the middle of it


def test_the_killing_sees_what_is_done_twice(monkeypatch):
    """The judge judged: a build that forgets a finished batch is found out."""
    read = resume.lampopt.partial.Partial.read
    monkeypatch.setattr(
        "lampopt.partial.Partial.read", lambda self, name: None if name == "batch_0001" else read(self, name)
    )
    faults = resume.measured(60, 0)["faults"]
    assert faults
    assert "finished, and begun again" in faults[0]


# no room


class NoRoom:
    """From the `last` file that is opened to be written, made or renamed in `folder` on, the disk is full."""

    def __init__(self, folder):
        self.folder, self.last, self.seen, self.places = str(folder), None, 0, []
        sys.addaudithook(self)

    def __call__(self, event, arguments):
        if event not in ("open", "os.mkdir", "os.rename") or not any(self.folder in str(a) for a in arguments):
            return
        if event == "open" and not arguments[2] & WRITES:
            return
        self.seen += 1
        self.places.append(f"{event} {arguments[0]}")
        if self.last is not None and self.seen >= self.last:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def without_room(name, folder, last, pipe):
    """In a process of its own: an audit hook cannot be taken off again."""
    disk = NoRoom(folder)
    disk.last = last
    try:
        resume.WORK[name](folder)
        pipe.send((None, disk.seen))
    except BaseException as error:  # noqa: BLE001  # told to the test
        pipe.send((error, disk.seen))


def tried(name, folder, last):
    here, there = multiprocessing.get_context("fork").Pipe()
    process = multiprocessing.get_context("fork").Process(target=without_room, args=(name, folder, last, there))
    process.start()
    answer = here.recv()
    process.join()
    return answer


@pytest.mark.parametrize("name", ["build", "add", "sweep"])
def test_a_disk_that_fills_up_at_every_write_one_after_the_other(name, whole, start, folder):
    assert tried(name, folder, None)[0] is None
    count = tried(name, fresh(start, folder.parent / "counted"), None)[1]
    assert count > 20
    for last in range(1, count + 1):
        place = fresh(start, folder.parent / f"full-at-{last}")
        error, _ = tried(name, place, last)
        if error is not None:  # what is only tidied at the end may fail unsaid
            assert isinstance(error, LampoptError), f"write {last}: {error!r}"
            assert "No space left on device" in str(error)
            assert str(place) in str(error)
        finished = set(resume.intact(name, place, whole[name]))
        log(place).unlink(missing_ok=True)
        resume.WORK[name](place)
        assert not finished & set(log(place).read_text().splitlines() if log(place).exists() else ())
        assert set(resume.intact(name, place, whole[name])) == set(resume.intact(name, whole[name], whole[name]))
        assert not resume.left_over(place)
        shutil.rmtree(place)


def fresh(start, folder):
    folder.mkdir()
    shutil.copy(start / "bank.lamp", folder)
    os.environ[resume.LOG] = str(log(folder))  # elsewhere: it has its own room
    return folder


def log(folder):
    return folder.parent / f"log-{folder.name}"


@contextmanager
def small_disk(folder, size):
    """A file system of `size` kB."""
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(folder)], capture_output=True)
    if done.returncode:
        pytest.skip(f"no small disk can be mounted here: {done.stderr.decode().strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("name", ["build", "add", "sweep"])
def test_a_real_disk_that_is_full(name, whole, start, tmp_path):
    """SQLite's and safetensors' own writes too; as much room as the end needs is given step by step."""
    os.environ[resume.LOG] = str(tmp_path / "log")
    with small_disk(tmp_path / "disk", 24) as disk:
        shutil.copy(start / "bank.lamp", disk)
        place, errors, size, finished = disk, 0, 24, set()
        while size < 2048:
            (tmp_path / "log").unlink(missing_ok=True)
            try:
                resume.WORK[name](place)
            except LampoptError as error:
                assert str(disk) in str(error)
                errors += 1
                now = set(resume.intact(name, place, whole[name]))
                assert now >= finished
                begun = (tmp_path / "log").read_text().splitlines() if (tmp_path / "log").exists() else []
                assert not finished & set(begun)
                finished = now
                size += 16
                subprocess.run(["mount", "-o", f"remount,size={size}k", str(disk)], check=True)
            else:
                break
        assert errors > 2
        subprocess.run(["mount", "-o", f"remount,size={size + 512}k", str(disk)], check=True)
        resume.WORK[name](place)  # what was too much to be tidied before
        assert set(resume.intact(name, place, whole[name])) == set(resume.intact(name, whole[name], whole[name]))
        assert not resume.left_over(place)


# two at once


@pytest.mark.parametrize("name", ["build", "add", "sweep"])
def test_two_processes_at_once(name, whole, folder):
    """Begun together, again and again: one works, the other says so, or finds all done; nothing is lost."""
    fork = multiprocessing.get_context("fork")
    for _ in range(4):
        pipes = [fork.Pipe() for _ in range(2)]
        pair = [fork.Process(target=without_room, args=(name, folder, None, there)) for _, there in pipes]
        for process in pair:
            process.start()
        errors = [here.recv()[0] for here, _ in pipes]
        for process in pair:
            process.join()
        assert None in errors
        for error in filter(None, errors):
            assert isinstance(error, (BankError, InputError))
            assert "another process" in str(error)
        assert set(resume.intact(name, folder, whole[name])) == set(resume.intact(name, whole[name], whole[name]))
        assert not resume.left_over(folder)
        begun = log(folder).read_text().splitlines()
        assert len(begun) == len(set(begun))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study file of a few designs that take a while, beside its bank."""
    folder = tmp_path_factory.mktemp("study")
    values = [0.1 + 0.01 * i for i in range(DESIGNS)]
    (folder / "study.toml").write_text(f'bank = "plates.lamp"\n[sweep]\nhole_radius = {values}\n')
    plates = lampopt.exemplars("plate", count=3, design="lhs")
    decoder = lampopt.Spec("sdf-mlp", width=8, depth=1, steps=2)
    lampopt.build_bank(plates, decoder, probes=64, store=folder / "plates.lamp", accept="all")
    return folder / "study.toml"


@contextmanager
def sweeping(study, folder):
    """`lampopt sweep` with two workers, left to run until the first design is there."""
    command = [*SHELL, "sweep", str(study), "--no-report", "--workers", "2", "--folder", str(folder)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        while process.poll() is None and not resume.table(folder):
            time.sleep(0.02)
        yield process


def test_a_command_that_is_interrupted_says_how_to_go_on(study, tmp_path):
    """Ctrl-C in the shell: exit code 130, what is left, and the same command goes on."""
    with sweeping(study, tmp_path) as process:
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate(timeout=120)[1]
    done = len(resume.table(tmp_path))
    if process.returncode not in (0, 1):  # it may have come to its end before
        assert process.returncode == 130, said
        if done < DESIGNS:
            assert f"interrupted: {done} of {DESIGNS} designs are done and kept in {tmp_path}" in said
        assert "the same command goes on where it stopped" in said
        assert "Traceback" not in said
    with sweeping(study, tmp_path) as process:
        assert process.wait(timeout=120) in (0, 1)
    assert len(resume.table(tmp_path)) == DESIGNS


def test_workers_die_with_the_one_that_is_killed(study, tmp_path):
    with sweeping(study, tmp_path) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        workers = children.read_text().split() if children.exists() else []
        process.kill()
    for _ in range(1000):
        left = [pid for pid in workers if Path(f"/proc/{pid}").exists() and not _zombie(pid)]
        if not left:
            break
        time.sleep(0.02)
    assert not left


def _zombie(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


# a sweep of many designs


def killed(*arguments):
    """`benchmarks.sweep_kills`, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "benchmarks.sweep_kills", *arguments, "--json"],
        cwd=HERE.parent,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_sweep_killed_again_and_again_finishes_once():
    done = killed("--designs", "40", "--kills", "2", "--by", "alone")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)["alone"]
    assert (found["recorded"], found["sweep_killed"], found["recorded_again"]) == (40, 2, 0)
    assert found["begun"] == 40 + found["begun_again"]


@pytest.mark.parametrize(
    ("notes", "fault"),
    [
        ("attempt 0, design a, recorded a, design b, attempt 1, design b, recorded b", None),
        ("attempt 0, design a, recorded a, attempt 1, design a, design b, recorded b", "finished, and design again: a"),
        (
            "attempt 0, design a, recorded a, attempt 1, design b, recorded b, recorded a",
            "finished, and recorded again: a",
        ),
        (
            "attempt 0, design b, recorded b, recorded b, attempt 1, design a, recorded a",
            "recorded more than once: ['b']",
        ),
    ],
)
def test_the_notes_of_a_sweep_are_read(notes, fault):
    notes = notes.split(", ")
    first = {f"design {note[-1]}" for note in notes[: notes.index("attempt 1")] if note.startswith("recorded")}
    tally = kills.Tally(2, sweep_killed=1)
    kills.judge(notes, [set(), first], tally)
    assert [fault in found for found in tally.faults[:1]] == [True] if fault else tally.faults == []
    assert tally.begun_again == tally.begun - 2


def test_a_decoder_that_was_typed_is_nobody_elses(tmp_path):
    """Its code is in no file: a bank that another process built by the same name is refused, not read."""
    program = """
import lampopt, small
from lampopt.plugins import Plugins

class Typed(small.Stretch):
    def fit(self, shared, meshes, *, seed, progress=None):
        weights, error = super().fit(shared, meshes, seed=seed)
        return weights * {factor}, error

class Offer:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {{"typed": Typed}}

small.bank(decoder="typed", plugins=small.plugins(("typed", Offer())), store="typed.lamp")
"""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])}
    said = []
    for factor in (1.0, 0.5):
        command = [sys.executable, "-c", program.format(factor=factor)]
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
        said.append((done.returncode, "made from other exemplars, options or seed" in done.stderr))
    assert said == [(0, False), (1, True)]
