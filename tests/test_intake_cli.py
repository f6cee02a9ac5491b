"""`lampopt intake` and `lampopt wrap`: exit codes, the document, what people read."""

import json

import numpy as np
import pytest
import trimesh

from lampopt import cli
from lampopt.meshfile import load_mesh
from lampopt.testing import shapes


@pytest.fixture
def call(capsys):
    """Run a command for people: (code, standard error); nothing is on standard output."""

    def run(*args):
        code = cli.main([str(a) for a in args])
        out, err = capsys.readouterr()
        assert out == ""
        return code, " ".join(err.split())

    return run


@pytest.fixture
def ask(capsys):
    """Run a command with --json: (code, document)."""

    def run(*args):
        code = cli.main([*(str(a) for a in args), "--json"])
        return code, json.loads(capsys.readouterr().out, parse_constant=pytest.fail)

    return run


@pytest.fixture
def folder(tmp_path):
    """Boxes of six lengths beside a table."""
    lines = ["mesh,length [m],drag"]
    for i in range(6):
        shapes.box((1 + 0.1 * i, 0.8, 0.5)).export(tmp_path / f"box_{i}.stl")
        lines.append(f"box_{i}.stl,{1 + 0.1 * i},{i}")
    (tmp_path / "boxes.csv").write_text("\n".join(lines))
    return tmp_path


def scaled(folder, index, factor):
    path = folder / f"box_{index}.stl"
    load_mesh(path).apply_scale(factor).export(path)


def shifted(folder, index):
    path = folder / f"box_{index}.stl"
    load_mesh(path).apply_translation([9, 0, 0]).export(path)


def test_a_table_of_sound_meshes(call, ask, folder):
    code, document = ask("intake", folder / "boxes.csv")
    assert code == 0
    assert (document["verdict"], document["usable"], document["doubtful"], document["refused"]) == ("usable", 6, 0, 0)
    assert document["unit"] == "m"
    assert document["findings"] == []
    first = document["exemplars"][0]
    assert (first["name"], first["verdict"]) == ("box_0", "usable")
    assert first["health"]["closed"]
    assert first["health"]["extents"] == pytest.approx([1.0, 0.8, 0.5])
    code, err = call("intake", folder / "boxes.csv")
    assert code == 0
    assert "box_5 usable 192 yes 1 0 0 0 1.5 × 0.8 × 0.5" in err
    assert "6 meshes: 6 usable" in err


def test_doubts_exit_with_1_until_they_are_accepted(call, ask, folder):
    shifted(folder, 3)
    code, document = ask("intake", folder / "boxes.csv")
    assert (code, document["verdict"]) == (1, "doubtful")
    (finding,) = document["findings"]
    assert (finding["exemplar"], finding["kind"], finding["severity"]) == ("box_3", "place", "doubtful")
    assert not finding["accepted"]
    for name in ("box_3", "all"):
        code, document = ask("intake", folder / "boxes.csv", "--accept", name)
        assert (code, document["findings"][0]["accepted"]) == (0, True)
    code, err = call("intake", folder / "boxes.csv", "--accept", "box_3")
    assert code == 0
    assert "accepted box_3: expected a centre near" in err
    assert ask("intake", folder / "boxes.csv", "--accept", "box_9")[0] == 2


def test_refusals_exit_with_2_and_all_are_in_the_document(call, ask, folder):
    scaled(folder, 2, 1000)
    shifted(folder, 3)
    (folder / "box_4.stl").write_bytes(b"")
    code, document = ask("intake", folder / "boxes.csv")
    assert (code, document["verdict"]) == (2, "refused")
    verdicts = {e["name"]: e["verdict"] for e in document["exemplars"]}
    assert verdicts == dict.fromkeys(("box_0", "box_1", "box_5"), "usable") | {
        "box_2": "refused",
        "box_3": "doubtful",
        "box_4": "refused",
    }
    assert document["exemplars"][4]["health"] is None
    code, err = call("intake", folder / "boxes.csv")
    assert code == 2
    assert "refused box_2: expected a diagonal near" in err
    assert "6 meshes: 3 usable, 1 doubtful, 2 refused" in err


def test_a_table_with_its_folder_unit_and_options(ask, folder):
    (folder / "stl").mkdir()
    for path in folder.glob("*.stl"):
        path.rename(folder / "stl" / path.name)
    args = ("intake", folder / "boxes.csv", "--meshes", folder / "stl", "--unit", "mm", "--set", "labels=drag")
    code, document = ask(*args)
    assert (code, document["unit"]) == (0, "mm")


def test_another_source(ask):
    code, document = ask("intake", "--source", "plate", "--set", "count=4", "--set", "design=lhs")
    assert (code, len(document["exemplars"])) == (0, 4)


def test_files_and_folders_each_by_itself(call, ask, folder):
    scaled(folder, 2, 1000)  # beside strangers a size says nothing
    code, document = ask("intake", folder / "box_0.stl", folder / "box_2.stl")
    assert (code, [e["name"] for e in document["exemplars"]]) == (0, [str(folder / f"box_{i}.stl") for i in (0, 2)])
    code, document = ask("intake", folder)
    assert (code, document["usable"]) == (0, 6)
    code, document = ask("intake", folder / "box_0.stl", folder / "gone.stl")
    assert (code, document["refused"]) == (2, 1)


def test_an_open_mesh_comes_with_the_command_that_wraps_it(call, folder):
    solid = shapes.box((1.2, 0.8, 0.5))
    path = folder / "open box.stl"
    trimesh.Trimesh(solid.vertices, solid.faces[:-1], process=False).export(path)
    code, err = call("intake", path)
    assert code == 0
    assert f"lampopt wrap '{path}' --gap 0.02 --out '{path.with_suffix('')}_wrapped.ply'" in err


def test_repairs_are_made_unless_they_are_not_wanted(ask, folder):
    solid = shapes.box()
    path = folder / "inward.ply"
    trimesh.Trimesh(solid.vertices, solid.faces[:, ::-1], process=False).export(path)
    code, document = ask("intake", path)
    assert (code, document["exemplars"][0]["health"]["repairs"]) == (0, ["turned all faces outward"])
    code, document = ask("intake", path, "--no-repair")
    assert (code, document["findings"][0]["kind"]) == (1, "hollow")


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["empty"],
        ["gone.csv"],
        ["boxes.csv", "box_0.stl"],
        ["boxes.csv", "--source", "plate"],
        ["--source", "plate", "--meshes", "."],
        ["box_0.stl", "--meshes", "."],
        ["box_0.stl", "--set", "labels=drag"],
    ],
)
def test_what_cannot_be_asked_is_refused(ask, folder, monkeypatch, args):
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir()
    code, document = ask("intake", *args)
    assert (code, set(document)) == (2, {"error"})


def test_bank_build_takes_accept(ask, folder):
    shifted(folder, 3)
    build = ("bank", "build", "--source", "table", "--set", f"table={folder / 'boxes.csv'}", "--out", folder / "a.lamp")
    code, document = ask(*build)
    assert (code, document["error"]["type"]) == (2, "InputError")
    assert "exemplar 'box_3': expected a centre near" in document["error"]["message"]
    assert "--accept box_3" in document["error"]["message"]
    assert not (folder / "a.lamp").exists()


def test_wrap_writes_a_closed_mesh(call, ask, folder):
    solid = shapes.box((1.2, 0.8, 0.5))
    open_one = trimesh.Trimesh(solid.vertices, np.delete(solid.faces, [0, 1], axis=0), process=False)
    open_one.export(folder / "open.stl")
    gap = 0.35  # wider than the two triangles that are missing
    code, document = ask("wrap", folder / "open.stl", "--gap", gap, "--out", folder / "closed.ply")
    assert code == 0
    made = load_mesh(folder / "closed.ply")
    assert made.is_watertight
    assert document["faces"] == len(made.faces)
    assert document["volume"] == pytest.approx(made.volume, rel=1e-5)
    code, err = call("wrap", folder / "open.stl", "--gap", gap, "--resolution", 12, "--out", folder / "closed.stl")
    assert code == 0
    assert "closed.stl: closed," in err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["box_0.stl", "--gap", "0", "--out", "a.ply"], "gap: expected a length above 0"),
        (["box_0.stl", "--gap", "0.1", "--out", "a.txt"], "expected a file ending in .stl"),
        (["box_0.stl", "--gap", "0.1", "--out", "gone/boxes.csv/a.ply"], None),
        (["gone.stl", "--gap", "0.1", "--out", "a.ply"], "gone.stl"),
    ],
)
def test_wrap_refuses(ask, folder, monkeypatch, args, message):
    monkeypatch.chdir(folder)
    code, document = ask("wrap", *args)
    assert code == 2
    assert message is None or message in document["error"]["message"]
    assert not (folder / "a.ply").exists()
