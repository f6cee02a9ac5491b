"""What somebody hostile, or only careless, may leave in a run folder, hand to a sweep or type: an error, no hang."""

import os
import sqlite3
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import Parameter, Study
from lampopt.cli import main
from lampopt.errors import InputError, PluginError, StudyError, SweepError
from lampopt.intake import wrap
from lampopt.types import Mix, MixBatch

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

GRID = {"length": [2.1, 2.3, 2.5], "width": [1.1]}


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes())


def sweep(study, folder=None, executor=None, grid=GRID, extra=(), report=False):
    chosen = small.plugins(*extra)
    return list(lampopt.sweep(study, grid, folder, executor=executor, report=report, plugins=chosen))


@pytest.fixture
def run(bank, tmp_path):
    sweep(Study(bank), tmp_path / "run")
    return tmp_path / "run"


def results(folder):
    return list(lampopt.results(folder, plugins=small.plugins()))


def edited(run, statement, *values):
    with closing(sqlite3.connect(run / "runs.sqlite")) as database, database:
        database.execute(statement, values)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_mesh_that_is_no_file_is_decoded_again(run, kind, caplog):
    found = results(run)[0]
    file = next(found.folder.glob("mesh.*"))
    kept, extents = file.read_bytes(), found.design.mesh.extents
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("/dev/zero")
    mesh = results(run)[0].design.mesh
    assert mesh.extents == pytest.approx(extents)
    assert "got a pipe or a device; it is decoded again" in caplog.text
    assert file.read_bytes() == kept


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("checks", '[["a",1,"<=",{},[],5,null]]'),
        ("checks", '[["a",1,"<=",1,"m","mesh","",1]]'),
        ("checks", "{}"),
        ("target", '{"length":"x"}'),
        ("target", '{"length":1e400}'),
        ("target", '{"length":true}'),
        ("target", '{"length":1' + 400 * "0" + "}"),
        ("target", "[1]"),
        ("provenance", "[1]"),
        ("conflicts", "[[[1],[0.5]]]"),
        ("message", b"\xff"),
    ],
)
def test_an_edited_row_is_damaged(run, column, text):
    edited(run, f"UPDATE designs SET {column} = ? WHERE rowid = 2", text)
    with pytest.raises(InputError, match="is damaged"):
        results(run)


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER t AFTER INSERT ON designs BEGIN DELETE FROM designs; END",
        "CREATE VIEW v AS SELECT 1",
        "CREATE UNIQUE INDEX i ON designs (key, status)",
        "CREATE TABLE other (x)",
    ],
)
def test_a_database_that_would_do_something_is_refused(bank, run, statement):
    edited(run, statement)
    with pytest.raises(InputError, match="and no more, got"):
        results(run)
    with pytest.raises(InputError, match="and no more, got"):
        sweep(Study(bank), run, grid={"length": [2.7], "width": [1.1]})
    with closing(sqlite3.connect(run / "runs.sqlite")) as database:
        assert database.execute("SELECT count(*) FROM designs").fetchone() == (3,)


def test_a_database_that_was_analysed_is_ours(run):
    edited(run, "ANALYZE")
    assert len(results(run)) == 3


def test_only_what_lampopt_was_writing_is_removed(bank, run):
    (run / "designs" / "thesis.writing").mkdir()
    mine = [run / "notes.writing", run / "designs" / "thesis.writing" / "one.txt"]
    key = results(run)[0].folder.name
    left = [run / "study.toml.writing", run / "report.html.writing", run / "designs" / f"{key}.12.mesh.writing"]
    for file in (*mine, *left):
        file.write_text("x")
    (run / "designs" / f"{key}.writing").mkdir()
    sweep(Study(bank), run)
    assert all(file.read_text() == "x" for file in mine)
    assert not any(file.exists() for file in (*left, run / "designs" / f"{key}.writing"))


def test_a_link_in_the_way_is_not_followed(bank, tmp_path):
    (tmp_path / "run").mkdir()
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / "run" / "study.toml.writing").symlink_to(victim)
    sweep(Study(bank), tmp_path / "run")
    assert victim.read_text() == "mine"


def test_a_pool_that_is_shut_down_meanwhile_ends_the_sweep(bank):
    begun, go = Event(), Event()
    with ThreadPoolExecutor(1) as executor:
        executor.submit(lambda: (begun.set(), go.wait(60)))  # what is asked stays in the queue
        begun.wait(60)

        def close():
            executor.shutdown(wait=False, cancel_futures=True)
            go.set()

        class Closing:
            def submit(self, *task):
                future = executor.submit(*task)
                if not closer.is_alive():
                    closer.start()
                closer.join()
                return future

        closer = Thread(target=close)
        with pytest.raises((SweepError, StudyError)):
            sweep(lampopt.Study(bank), None, Local(Closing()), grid={"length": [2.1], "width": [1.1]})


class Local(ThreadPoolExecutor):
    """Threads, by its kind; what is asked of it goes to another."""

    def __init__(self, other):
        super().__init__(1)
        self.other = other

    def submit(self, *task, **named):
        return self.other.submit(*task, **named)


class Answering:
    def __init__(self, answer):
        self.answer = answer

    def submit(self, *_):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def cancelled():
    future = Future()
    future.cancel()
    return future


def finished(value):
    future = Future()
    future.set_result(value)
    return future


@pytest.mark.parametrize(
    ("answer", "error", "said"),
    [
        (cancelled(), SweepError, "a worker was lost"),
        (finished("x"), StudyError, "expected what its work returned, got 'x'"),
        (finished(None), StudyError, "expected what its work returned, got None"),
        (None, StudyError, "returns a concurrent.futures.Future, got None"),
        ("text", StudyError, "returns a concurrent.futures.Future, got 'text'"),
        (OSError("no room"), StudyError, "one that does not: no room"),
        (ValueError(), StudyError, "one that does not: ValueError"),
    ],
)
def test_an_executor_that_is_none(bank, answer, error, said):
    with pytest.raises(error, match=said):
        sweep(Study(bank), None, Local(Answering(answer)))


def test_the_class_of_an_executor_is_none(bank):
    with pytest.raises(StudyError, match="expected one as in concurrent"):
        sweep(Study(bank), None, ThreadPoolExecutor)


@pytest.mark.parametrize("name", [5, b"abc", True, "a\0b", ""])
def test_what_is_no_path(bank, name):
    def store():
        small.bank(small.boxes(), store=name)

    asked = (
        lambda: sweep(Study(bank), name),
        lambda: lampopt.results(name),
        lambda: lampopt.report(name),
        lambda: lampopt.store_bank(bank, name),
        lambda: lampopt.remove_exemplars(bank, ["box_1"], store=name),
        store,
    )
    for ask in asked:
        with pytest.raises(InputError, match="expected a path, got"):
            ask()


def test_names_that_are_no_text(bank, tmp_path):
    odd = tmp_path / os.fsdecode(b"a\xffb")
    odd.mkdir()
    sweep(Study(bank), odd)
    written = lampopt.report(odd, plugins=small.plugins())
    assert "a?b" in written.read_text(encoding="utf-8")
    stored = lampopt.store_bank(bank, odd / "bank.lamp")
    with pytest.raises(InputError, match="cannot be written"):
        sweep(Study(stored), tmp_path / "other")
    for call in (lambda: Parameter("length", "\ud800"), lambda: Parameter("\ud800")):
        with pytest.raises(InputError, match="half of a character"):
            call()


@pytest.mark.parametrize("wrong", ["nan", "sum", "status"])
@pytest.mark.parametrize("many", [True, False])
def test_a_solver_that_returns_nonsense_is_named(bank, wrong, many):
    class Nonsense:
        def _rows(self, rows, problem):
            alpha = np.full((rows, len(problem.centre)), np.nan if wrong == "nan" else 1.0)
            if wrong == "status":
                alpha /= len(problem.centre)
            return alpha

        def solve(self, problem):
            status = "happy" if wrong == "status" else "exact"
            return Mix(self._rows(1, problem)[0], np.zeros(len(problem.names)), status)

        def solve_many(self, problem, targets, ridges=None):
            if not many:
                return MixBatch(
                    np.tile(problem.centre, (len(targets), 1)), np.zeros(targets.shape), ("inexact",) * len(targets)
                )
            status = "happy" if wrong == "status" else "exact"
            return MixBatch(self._rows(len(targets), problem), np.zeros(targets.shape), (status,) * len(targets))

    class Offer:
        @lampopt.hookimpl
        def lampopt_solvers(self):
            return {"nonsense": Nonsense}

    with pytest.raises(PluginError, match="solver Nonsense"):
        sweep(Study(bank, solver="nonsense"), extra=[("nonsense", Offer())])


def test_a_plugin_that_cannot_be_sent(bank, tmp_path):
    class Stubborn:
        @lampopt.hookimpl
        def lampopt_measures(self):
            return {}

        def __reduce__(self):
            raise OSError("not today")

    executor = Answering(finished(None))
    with pytest.raises(PluginError, match="not today"):
        sweep(Study(bank), tmp_path, executor, extra=[("stubborn", Stubborn())])


def test_wrap_asks_for_a_mesh_and_a_length():
    box = trimesh.creation.box()
    for mesh in ("x", trimesh.Scene(box), trimesh.PointCloud(np.eye(3)), None):
        with pytest.raises(InputError, match="expected a mesh with faces"):
            wrap(mesh, gap=0.1)
    with pytest.raises(InputError, match="gap"):
        wrap(trimesh.creation.box((3, 3, 3)), gap=True)


def test_wrap_does_not_overwrite_what_it_reads(tmp_path, capsys):
    file = tmp_path / "body.ply"
    trimesh.creation.box().export(file)
    before = file.read_bytes()
    (tmp_path / "link.ply").symlink_to(file)
    for out in ("body.ply", "link.ply"):
        assert main(["wrap", str(file), "--gap", "0.2", "--out", str(tmp_path / out)]) == 2
        assert "is the mesh that is to be wrapped" in capsys.readouterr().err.replace("\n", " ")
    assert file.read_bytes() == before


@pytest.mark.parametrize("unit", ["kg", "", "deg", "m^2"])
def test_the_unit_of_meshes_is_a_length(tmp_path, unit, capsys):
    trimesh.creation.box().export(tmp_path / "box.ply")
    assert main(["intake", str(tmp_path / "box.ply"), "--unit", unit]) == 2
    assert "--unit" in capsys.readouterr().err
    assert main(["intake", str(tmp_path / "box.ply"), "--unit", "mm"]) != 2


@pytest.mark.parametrize("given", [["x" * 300], ["--source", "run", "--set", "folder=" + "x" * 300]])
def test_a_name_that_is_too_long(given, capsys):
    assert main(["intake", *given]) == 2
    assert "error" in capsys.readouterr().err


def test_a_folder_that_may_not_be_looked_into(tmp_path, monkeypatch, capsys):
    def denied(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", denied)
    assert main(["intake", str(tmp_path)]) == 2
    assert "cannot be opened: Permission denied" in capsys.readouterr().err.replace("\n", " ")


def test_no_name_of_a_file_reaches_the_terminal_as_it_is(tmp_path, capsys):
    file = tmp_path / "b\x1b[31mPWN.stl"
    trimesh.creation.box().export(tmp_path / "b.stl")
    (tmp_path / "b.stl").rename(file)
    assert main(["intake", str(file)]) != 2
    broken = tmp_path / "c\x1b[31mPWN.stl"
    broken.write_bytes(b"solid")
    assert main(["intake", str(broken)]) == 2
    assert main(["wrap", str(broken), "--gap", "1", "--out", str(tmp_path / "o.ply")]) == 2
    said = capsys.readouterr()
    assert "PWN" in said.err
    assert "\x1b" not in said.err + said.out
