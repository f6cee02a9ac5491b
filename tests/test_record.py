"""What a run folder keeps, and what it makes of an older, an altered and a hostile one."""

import json
import logging
import os
import shutil
import sqlite3
import stat
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Study
from lampopt.database import Reader
from lampopt.errors import InputError, StudyError
from lampopt.meshfile import FORMATS, load_mesh
from lampopt.task import Task
from lampopt.written import export_mesh

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

TARGET = {"length": 2.9, "width": 1.2}
GRID = {"length": [2.5, -9.0, 2.9], "width": [1.2]}  # the second has no surface
MEASURED = {"length": "extents.length", "width": "extents.width"}
OLD = HERE / "data" / "run_schema1"


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured=MEASURED))


@pytest.fixture(autouse=True)
def fresh():
    small.CALLS.clear()


def run(study, folder):
    return lampopt.run(study, folder, report=False, plugins=small.plugins())


def sweep(study, grid, folder, **options):
    return list(lampopt.sweep(study, grid, folder, report=False, plugins=small.plugins(), **options))


def results(folder, **options):
    return list(lampopt.results(folder, plugins=small.plugins(), **options))


def execute(folder, *statements):
    with closing(sqlite3.connect(folder / "runs.sqlite")) as database:
        for statement in statements:
            database.execute(*(statement if isinstance(statement, tuple) else (statement,)))
        database.commit()
        return database.execute("PRAGMA user_version").fetchone()[0]


def tree(folder):
    """Every file in `folder` with its bytes."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# read without being run


def test_shapes_too_far_away_for_a_files_digits_are_refused(tmp_path):
    """Single precision, five million metres from the origin: half a metre."""
    bank = small.bank(small.boxes(shift=(4.5e5, 5.4e6, 0)))
    study = Study(bank, {"length": 2.5})
    with pytest.raises(StudyError, match=r"format: a \.stl file has single precision.* take format 'obj'"):
        lampopt.run(study, tmp_path, plugins=small.plugins())
    result = lampopt.run(replace(study, format="obj"), tmp_path, plugins=small.plugins())
    (back,) = lampopt.results(tmp_path, plugins=small.plugins())
    np.testing.assert_allclose(back.design.mesh.extents, result.design.mesh.extents, atol=1e-6)
    with pytest.raises(InputError, match="single precision"):
        export_mesh(result.design.mesh, tmp_path / "box.stl")


def test_results_are_those_recorded_the_last_asked_first(bank, tmp_path):
    made = [*sweep(Study(bank), GRID, tmp_path), run(Study(bank, targets=TARGET, level="alpha"), tmp_path)]
    made = [made[-1], *made[:-1]]
    small.CALLS.clear()
    before = tree(tmp_path)
    found = results(tmp_path, every=True)
    assert [dict(r.design.target) for r in found] == [dict(r.design.target) for r in made]
    assert [r.accepted for r in found] == [True, True, False, True]
    assert [r.folder for r in found] == [r.folder for r in made]
    for one, two in zip(found, made, strict=True):
        assert [check.name for check in one.checks] == [check.name for check in two.checks]
        assert np.array_equal(one.design.mix.alpha, two.design.mix.alpha)
        assert np.array_equal(one.design.weights, two.design.weights)
        assert dict(one.provenance) == dict(two.provenance)
    assert found[1].design.mesh.extents == pytest.approx([2.5, 1.2, 0.8])
    assert small.CALLS["decode"] == 0
    assert found[2].design.mesh is None
    assert tree(tmp_path) == before


def test_what_is_no_run_is_said(bank, tmp_path):
    with pytest.raises(InputError, match=r"study\.toml: cannot be read as a study"):
        lampopt.results(tmp_path)
    run(Study(bank, targets=TARGET), tmp_path)
    (tmp_path / "runs.sqlite").unlink()
    with pytest.raises(InputError, match=r"runs\.sqlite: no such file: expected the folder of a run"):
        results(tmp_path)
    (tmp_path / "runs.sqlite").touch()
    with pytest.raises(InputError, match=r"runs\.sqlite: is empty"):
        results(tmp_path)
    (tmp_path / "runs.sqlite").write_text("no database " * 100)
    with pytest.raises(InputError, match=r"runs\.sqlite: is damaged or no database"):
        results(tmp_path)


def test_a_folder_that_cannot_be_written_is_read(bank, tmp_path):
    folder = tmp_path / "run"
    made = sweep(Study(bank), GRID, folder)
    (made[0].folder / "mesh.stl").unlink()
    places = [folder, folder / "designs", *(folder / "designs").iterdir()]
    for place in places:
        place.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        found = results(folder)
        assert [r.accepted for r in found] == [True, False, True]
        assert found[0].design.mesh.extents == pytest.approx([2.5, 1.2, 0.8])
    finally:
        for place in places:
            place.chmod(0o755)


def test_while_a_sweep_goes_on_what_is_there_can_be_read(bank, tmp_path):
    begun = lampopt.sweep(Study(bank), GRID, tmp_path, report=False, plugins=small.plugins())
    next(begun), next(begun)
    assert len(results(tmp_path)) == 2
    begun.close()


def test_designs_of_another_bank_are_left_out(bank, tmp_path, caplog):
    run(Study(bank, targets=TARGET), tmp_path)
    for other in (small.bank(small.boxes(count=6)), replace(bank, provenance={**bank.provenance, "plan": "other"})):
        caplog.clear()
        run(Study(other, targets=TARGET), tmp_path)
        assert len(results(tmp_path)) == 1
        assert "designs are of other studies and left out" in caplog.text
        assert len(results(tmp_path, every=True)) == 1
        assert "designs are of another bank and left out" in caplog.text


def test_each_design_is_decoded_at_its_own_resolution(bank, tmp_path, monkeypatch):
    asked = []
    decode = small.Stretch.decode
    monkeypatch.setattr(
        small.Stretch, "decode", lambda *a, resolution: asked.append(resolution) or decode(*a, resolution=resolution)
    )
    for resolution in (16, 48):
        made = run(Study(bank, targets=TARGET, resolution=resolution), tmp_path)
        (made.folder / "mesh.stl").unlink()
    asked.clear()
    for result in results(tmp_path, every=True):
        assert result.design.mesh is not None
    assert asked == [48, 16]  # the one asked for last comes first


def test_results_are_of_the_study_that_was_asked_last(bank, tmp_path, caplog):
    loose, strict = Study(bank, limits={"alpha": 9.0}), Study(bank, limits={"alpha": 0.2})
    lengths = {"length": [2.5, 2.9], "width": [1.2]}
    sweep(loose, lengths, tmp_path)
    assert [r.accepted for r in results(tmp_path)] == [True, True]
    assert not caplog.records
    sweep(strict, {"length": [2.9], "width": [1.2]}, tmp_path)
    assert [r.accepted for r in results(tmp_path)] == [False]  # one verdict for one target
    assert f"{tmp_path}: 2 of 3 designs are of other studies and left out; results(folder, every=True)" in caplog.text
    assert len(results(tmp_path, every=True)) == 3
    sweep(strict, [{"length": 2.5, "width": 1.2}], tmp_path)  # a sweep that grows, however it is asked, is one
    run(replace(strict, targets=TARGET, sweep={"length": [2.1]}), tmp_path)
    assert [r.design.target["length"] for r in results(tmp_path)] == [2.9, 2.5]
    sweep(loose, lengths, tmp_path)  # read back, none recorded
    assert [r.accepted for r in results(tmp_path)] == [True, True]


def test_a_study_that_cannot_be_written_leaves_the_one_that_was_asked(bank, tmp_path, monkeypatch):
    run(Study(bank, targets=TARGET), tmp_path)
    before = (tmp_path / "study.toml").read_text()
    monkeypatch.setattr("lampopt.record.os.replace", lambda *_: os.rename("", ""))
    with pytest.raises(InputError, match="cannot be written"):
        run(Study(bank, targets=TARGET, level="alpha"), tmp_path)
    assert (tmp_path / "study.toml").read_text() == before
    assert [len(r.checks) > 5 for r in results(tmp_path)] == [True]


ADDS = """
import sys
sys.path.insert(0, {here!r})
import lampopt, small
grid = {{"length": [2 + i / 1000 for i in range({count})], "width": [1.2]}}
study = lampopt.Study({bank!r}, level="alpha")
for _ in lampopt.sweep(study, grid, {folder!r}, report=False, plugins=small.plugins()):
    pass
"""


def add(bank, folder, count):
    code = ADDS.format(here=str(HERE), bank=str(bank.path), folder=str(folder), count=count)
    subprocess.run([sys.executable, "-c", code], check=True)


def test_what_was_recorded_is_read_whatever_another_process_adds(bank, tmp_path):
    """A database that was closed is read without locks; one that is opened again is another file, page by page."""
    stored, folder = lampopt.store_bank(bank, tmp_path / "a.lamp"), tmp_path / "run"
    add(stored, folder, 300)
    assert not list(folder.glob("runs.sqlite-*"))
    begun = lampopt.results(folder, plugins=small.plugins())
    found = [next(begun)]
    add(stored, folder, 900)
    found += begun
    assert [r.design.target["length"] for r in found] == [2 + i / 1000 for i in range(300)]
    assert len(results(folder)) == 900


def test_a_statement_is_answered_as_of_one_moment(bank, tmp_path, monkeypatch):
    """A writer between the looking and the answer: it is asked again."""
    sweep(Study(bank, level="alpha"), GRID, tmp_path)
    found, asked = Reader._found, []

    def disturbed(reader, *given, **options):
        rows = found(reader, *given, **options)
        asked.append(len(rows))
        if len(asked) == 1:
            run(Study(bank, targets={"length": 2.7}, level="alpha"), tmp_path)
        return rows

    monkeypatch.setattr(Reader, "_found", disturbed)
    assert len(Reader(tmp_path / "runs.sqlite").rows("SELECT key FROM designs")) == 4
    assert asked == [3, 4]
    monkeypatch.setattr(Reader, "_state", lambda _: (False, len(asked), 0, asked.append(0) or 0))
    with pytest.raises(InputError, match=r"runs\.sqlite: is written again and again while it is read"):
        Reader(tmp_path / "runs.sqlite").rows("SELECT key FROM designs")


def test_a_row_that_is_deleted_meanwhile_is_missed(bank, tmp_path):
    grid = {"length": np.linspace(2, 3, 300).tolist(), "width": [1.2]}
    made = sweep(Study(bank, level="alpha"), grid, tmp_path)
    begun = lampopt.results(tmp_path, plugins=small.plugins())
    next(begun)
    execute(tmp_path, "DELETE FROM designs WHERE rowid = 299")
    with pytest.raises(InputError, match=r"design '[0-9a-f]{24}' was deleted while the run is read"):
        list(begun)
    assert len(made) == 300


# older


def test_a_run_of_schema_1_is_read_as_it_is(tmp_path):
    shutil.copytree(OLD, tmp_path / "run")
    shutil.copy(HERE / "data" / "run_schema1.lamp", tmp_path)
    before = tree(tmp_path / "run")
    found = results(tmp_path / "run")
    assert [dict(r.design.target) for r in found] == [{"width": 1.2, "length": v} for v in (2.5, -9.0, 2.9)]
    assert [r.accepted for r in found] == [True, False, True]
    assert found[0].design.mesh.extents == pytest.approx([2.5, 1.2, 0.8])
    assert found[0].check("size.volume").value == pytest.approx(2.5 * 1.2 * 0.8)
    assert small.CALLS["decode"] == 0
    assert tree(tmp_path / "run") == before


def todays_keys(folder, task):
    """A key holds versions and the files of plugins, this test's own among them: it is made anew here."""
    with closing(sqlite3.connect(folder / "runs.sqlite")) as database, database:
        for key, target in database.execute("SELECT key, target FROM designs").fetchall():
            new = task.key(task.asked(json.loads(target)))
            database.execute(
                "UPDATE designs SET key = ?, mesh = replace(mesh, ?, ?) WHERE key = ?", (new, key, new, key)
            )
            if (folder / "designs" / key).exists():
                (folder / "designs" / key).rename(folder / "designs" / new)


def test_a_run_of_schema_1_goes_on(tmp_path):
    shutil.copytree(OLD, tmp_path / "run")
    shutil.copy(HERE / "data" / "run_schema1.lamp", tmp_path)
    study = Study.read(tmp_path / "run" / "study.toml")
    todays_keys(tmp_path / "run", Task.of(study, small.plugins()))
    assert [r.accepted for r in sweep(study, {"length": [2.5, -9.0, 2.9, 2.7]}, tmp_path / "run")][:1] == [True]
    assert small.CALLS["decode"] == 1
    assert execute(tmp_path / "run") == 2
    with closing(sqlite3.connect(tmp_path / "run" / "runs.sqlite")) as database:
        digests, tasks = zip(*database.execute("SELECT digest, task FROM designs ORDER BY rowid"), strict=True)
    assert digests[:3] == (None,) * 3
    assert digests[-1] is not None
    assert tasks[:3] == ("",) * 3
    assert len(tasks[-1]) == 24
    assert [dict(r.design.target)["length"] for r in results(tmp_path / "run")][:3] == [2.5, -9.0, 2.9]


@pytest.mark.parametrize("number", [3, 99, -1])
def test_a_newer_schema_is_refused(bank, tmp_path, number):
    run(Study(bank, targets=TARGET), tmp_path)
    execute(tmp_path, f"PRAGMA user_version = {number}")
    before = tree(tmp_path)
    for read in (results, lambda folder: run(Study(bank, targets=TARGET), folder)):
        with pytest.raises(InputError, match=rf"runs\.sqlite: has schema {number}, this lampopt reads 1 to 2"):
            read(tmp_path)
    assert tree(tmp_path) == before


# altered


@pytest.mark.parametrize("how", ["deleted", "folder deleted", "cut short", "empty", "another mesh"])
@pytest.mark.parametrize("again", ["run", "results"])
@pytest.mark.parametrize("form", FORMATS)
def test_a_mesh_that_is_not_what_was_written_is_made_anew(bank, tmp_path, how, again, form, caplog):
    study = Study(bank, targets=TARGET, format=form)
    first = run(study, tmp_path)
    file = first.folder / f"mesh.{form}"
    before = tree(tmp_path / "designs")
    if how == "deleted":
        file.unlink()
    elif how == "folder deleted":
        shutil.rmtree(first.folder)
    elif how == "another mesh":
        load_mesh(file).apply_scale(1.01).export(file)
    else:
        file.write_bytes(file.read_bytes()[: 500 if how == "cut short" else 0])
    (result,) = [run(study, tmp_path)] if again == "run" else results(tmp_path)
    assert result.checks == first.checks
    assert result.design.mesh.extents == pytest.approx([2.9, 1.2, 0.8])
    assert tree(tmp_path / "designs") == before
    assert small.CALLS["decode"] == 2
    assert ("is not what was written; it is decoded again" in caplog.text) == (how not in ("deleted", "folder deleted"))
    assert run(study, tmp_path).design.mesh.extents == pytest.approx([2.9, 1.2, 0.8])
    assert small.CALLS["decode"] == 2  # from the file that is there again


def test_a_mesh_that_decodes_otherwise_now_is_not_written_as_if_it_were_the_one(bank, tmp_path, monkeypatch, caplog):
    first = run(Study(bank, targets=TARGET), tmp_path)
    (first.folder / "mesh.stl").unlink()
    decode = small.Stretch.decode
    monkeypatch.setattr(small.Stretch, "decode", lambda *a, **k: decode(*a, **k).apply_scale(1 + 1e-5))
    (result,) = results(tmp_path)
    assert result.design.mesh.extents == pytest.approx([2.9, 1.2, 0.8], rel=1e-3)
    assert "decodes to another mesh than was recorded" in caplog.text
    assert sorted(p.name for p in first.folder.iterdir()) == ["passport.json"]


def test_a_passport_is_left_alone_while_its_mesh_is_there(bank, tmp_path):
    first = run(Study(bank, targets=TARGET), tmp_path)
    (first.folder / "passport.json").write_text("{}")
    assert run(Study(bank, targets=TARGET), tmp_path).design.mesh is not None
    assert (first.folder / "passport.json").read_text() == "{}"


def test_a_bank_altered_in_memory_is_stored_and_not_named_by_its_old_file(bank, tmp_path):
    stored = lampopt.store_bank(bank, tmp_path / "a.lamp")
    stricter = replace(stored, limits={"alpha": 0.25})
    assert stricter.path == stored.path
    assert not run(Study(stricter, targets=TARGET), tmp_path / "run").accepted
    again = Study.read(tmp_path / "run" / "study.toml").opened()
    assert dict(again.limits) == {"alpha": 0.25}
    assert again.path == next((tmp_path / "run").glob("bank-*.lamp"))
    (tmp_path / "a.lamp").unlink()  # a file that is gone names nothing either
    run(Study(stored, targets=TARGET), tmp_path / "other")
    assert small.same(Study.read(tmp_path / "other" / "study.toml").opened(), bank)


def test_a_bank_in_the_folder_is_never_replaced(bank, tmp_path):
    mine = lampopt.store_bank(bank, tmp_path / "bank.lamp")
    before = (tmp_path / "bank.lamp").read_bytes()
    altered = replace(mine, limits={"alpha": 0.25})
    assert not run(Study(altered, targets=TARGET), tmp_path).accepted
    assert (tmp_path / "bank.lamp").read_bytes() == before
    first = {file: file.read_bytes() for file in tmp_path.glob("bank-*.lamp")}
    run(Study(replace(mine, limits={"alpha": 0.5}), targets=TARGET), tmp_path)
    run(Study(altered, targets=TARGET), tmp_path)  # from the file that it has
    found = {file: file.read_bytes() for file in tmp_path.glob("bank-*.lamp")}
    assert len(first) == 1 and len(found) == 2 and found.items() >= first.items()
    limits = {float(lampopt.load_bank(file).limits["alpha"]) for file in found}
    assert limits == {0.25, 0.5}
    (file,) = first
    file.write_bytes(before)
    with pytest.raises(InputError, match=r"bank-[0-9a-f]{24}\.lamp: is not the bank that its name tells: remove it"):
        run(Study(altered, targets=TARGET), tmp_path)
    assert file.read_bytes() == before


def test_a_folder_that_stores_its_bank_as_it_was_once_named_goes_on(bank, tmp_path):
    lampopt.store_bank(bank, tmp_path / "bank.lamp")
    made = run(Study(tmp_path / "bank.lamp", targets=TARGET), tmp_path)
    small.CALLS.clear()
    assert run(replace(Study.read(tmp_path / "study.toml"), targets=TARGET), tmp_path).checks == made.checks
    run(Study(bank, targets=TARGET), tmp_path)  # the same bank in memory has the same designs
    assert not small.CALLS
    assert len(results(tmp_path)) == 1


# hostile


@pytest.mark.parametrize("name", ["../../secret.stl", "/etc/passwd", "mesh.exe", "mesh", "MESH.STL", 5, b"mesh.stl"])
def test_only_a_mesh_beside_its_passport_is_read(bank, tmp_path, name):
    run(Study(bank, targets=TARGET), tmp_path)
    execute(tmp_path, ("UPDATE designs SET mesh = ?", (name,)))
    for read in (results, lambda folder: run(Study(bank, targets=TARGET), folder)):
        with pytest.raises(InputError, match=r"row of design .* is damaged: expected a mesh file such as mesh\.stl"):
            read(tmp_path)


@pytest.mark.parametrize(
    "key", ["../../elsewhere", "/", "", "0" * 23, "0" * 25, "g" * 24, "0" * 24 + "\n", 7, b"0" * 24]
)
def test_only_a_key_names_a_folder(bank, tmp_path, key):
    run(Study(bank, targets=TARGET), tmp_path)
    execute(tmp_path, ("UPDATE designs SET key = ?", (key,)))
    with pytest.raises(InputError, match=r"is damaged: expected a key of 24 hexadecimal digits"):
        results(tmp_path)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("alpha", b"x"),
        ("alpha", 5),
        ("alpha", b"\xff" * 56),
        ("residual", "text"),
        ("status", "splendid"),
        ("target", "{"),
        ("target", "[" * 100_000),
        ("checks", "[[1]]"),
        ("conflicts", "5"),
        ("provenance", "[1]"),
        ("provenance", '{"resolution": "fine"}'),
        ("digest", "nonsense"),
    ],
)
def test_a_damaged_row_is_named_or_does_no_harm(bank, tmp_path, column, value, caplog):
    run(Study(bank, targets=TARGET), tmp_path)
    execute(tmp_path, (f"UPDATE designs SET {column} = ?", (value,)))
    if column == "digest" or (column, value) == ("provenance", '{"resolution": "fine"}'):
        found = results(tmp_path)  # the latter is of no bank that we know
        assert all(r.design.mesh.extents == pytest.approx([2.9, 1.2, 0.8]) for r in found)
        assert caplog.records
        return
    with pytest.raises(InputError, match=r"row of design [0-9a-f]{24} is damaged: .*delete that row"):
        results(tmp_path)


@pytest.mark.parametrize("statement", ["DROP TABLE designs", "ALTER TABLE designs DROP COLUMN digest"])
def test_another_table_is_said(bank, tmp_path, statement):
    run(Study(bank, targets=TARGET), tmp_path)
    execute(tmp_path, statement, "CREATE TABLE other (a)")
    with pytest.raises(InputError, match=r"runs\.sqlite: expected the tables designs and asked and no more"):
        results(tmp_path)
    with pytest.raises(InputError, match=r"runs\.sqlite: expected the tables designs and asked and no more"):
        run(Study(bank, targets=TARGET), tmp_path)


# left by a kill


def test_what_was_being_written_is_removed_at_the_next_start(bank, tmp_path):
    first = run(Study(bank, targets=TARGET), tmp_path)
    for name in ("designs/" + "0" * 24 + ".writing", "designs/" + "1" * 24 + ".77.mesh.writing"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mesh.stl").write_bytes(b"solid half")
    for name in ("study.toml.writing", "bank.lamp.123.writing", "report.html.writing"):
        (tmp_path / name).write_text("half")
    orphan = tmp_path / "designs" / ("2" * 24)  # written, but killed before its row: nothing names it
    shutil.copytree(first.folder, orphan)
    run(Study(bank, targets=TARGET), tmp_path)
    assert not list(tmp_path.rglob("*.writing"))


def test_a_full_disk_leaves_no_half_design(bank, tmp_path, monkeypatch):
    def full(mesh, path, form):
        path.write_bytes(b"solid half")
        raise OSError(28, "No space left on device")

    made = sweep(Study(bank), {"length": [2.5], "width": [1.2]}, tmp_path)
    before = tree(tmp_path / "designs")
    monkeypatch.setattr("lampopt.record.write_mesh", full)
    with pytest.raises(InputError, match=r"cannot be written: .*No space left.*; what is recorded there is kept"):
        sweep(Study(bank), GRID, tmp_path)
    assert tree(tmp_path / "designs") == before
    assert [r.folder for r in results(tmp_path)] == [made[0].folder, tmp_path]  # the second has no mesh


def test_the_report_is_written_at_the_end_and_loses_nothing(bank, tmp_path, monkeypatch, caplog):
    def fails(*_, **__):
        raise RuntimeError("no pictures today")

    asked = []

    def writes(folder, study, bank, results, **_):
        asked.append(([dict(r.design.target) for r in results], bank.names))
        (folder / "report.html").write_text("a report")
        return folder / "report.html"

    monkeypatch.setattr("lampopt.reporting.write_report", fails, raising=False)
    with caplog.at_level(logging.WARNING, "lampopt"):
        assert len(list(lampopt.sweep(Study(bank), GRID, tmp_path, plugins=small.plugins()))) == 3
    assert "the report is not written: RuntimeError: no pictures today" in caplog.text
    monkeypatch.setattr("lampopt.reporting.write_report", writes, raising=False)
    begun = lampopt.sweep(Study(bank), GRID, tmp_path, plugins=small.plugins())
    next(begun)
    begun.close()
    assert not asked  # left by its consumer
    list(lampopt.sweep(Study(bank), GRID, tmp_path, plugins=small.plugins()))
    lampopt.run(Study(bank, targets=TARGET), tmp_path, plugins=small.plugins())
    assert lampopt.report(tmp_path, plugins=small.plugins()) == tmp_path / "report.html"
    lengths = [[target["length"] for target in targets] for targets, _ in asked]
    swept = [2.5, -9.0, 2.9]
    assert lengths == [
        swept,
        [2.9, 2.5, -9.0],
        [2.9, 2.5, -9.0],
    ]  # the last was recorded already; it was asked for last
    assert {names for _, names in asked} == {bank.names}


def test_a_passport_of_every_design_is_plain_json(bank, tmp_path):
    for made in sweep(Study(bank, measures=("plate",)), GRID, tmp_path):
        if made.folder != tmp_path:
            text = (made.folder / "passport.json").read_text(encoding="utf-8")
            json.loads(text, parse_constant=lambda name: pytest.fail(name))


def test_a_missing_table_or_column_is_said(bank, tmp_path):
    run(Study(bank, targets=TARGET), tmp_path)
    execute(tmp_path, "ALTER TABLE designs DROP COLUMN digest")
    for read in (results, lambda folder: run(Study(bank, targets=TARGET), folder)):
        with pytest.raises(InputError, match=r"runs\.sqlite: is damaged or no database of a run: no such column"):
            read(tmp_path)


def test_files_are_readable_by_others_as_the_user_has_it(bank, tmp_path):
    before = os.umask(0o022)
    try:
        made = run(Study(bank, targets=TARGET), tmp_path / "run")
    finally:
        os.umask(before)
    for file in (tmp_path / "run").rglob("*"):
        assert file.stat().st_mode & 0o044 == 0o044, file
    assert made.accepted
