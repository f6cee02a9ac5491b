"""The command line: every command for people and as JSON, every exit code; docs/cli.md shows the real help.

`python tests/test_cli.py` writes the help into docs/cli.md anew.
"""

import importlib
import io
import json
import logging
import re
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import cli, experiments, hookimpl, load_bank, progress
from lampopt.cli import show
from lampopt.cli.answer import Answer, Command, _plain
from lampopt.errors import InputError
from lampopt.fitted import store_fitted
from lampopt.plugins import Plugins

HERE = Path(__file__).parent
DOC = HERE.parent / "docs" / "cli.md"
sys.path[:0] = [p for p in (str(HERE), str(HERE.parent / "examples" / "third_party_decoder")) if p not in sys.path]
gridsdf = importlib.import_module("lampopt_gridsdf")
toys = importlib.import_module("toys")
LOOSE = ["--limit", "drift=3", "--resolution", "32"]


@dataclass(frozen=True)
class Talkative(toys.Boxes):
    """Boxes, and prints."""

    loud: bool = False

    def __call__(self):
        print("hello", self.loud)
        return super().__call__()


class Extra:
    """A plugin with what these tests need, and one source that does not load."""

    @hookimpl
    def lampopt_decoders(self):
        return {"grid": gridsdf.GridSDF}

    @hookimpl
    def lampopt_sources(self):
        return {"boxes": Talkative, "gone": "no_such_module:Gone"}

    @hookimpl
    def lampopt_recorded(self, result):
        pass


@pytest.fixture(autouse=True, scope="module")
def installed():
    """What ships with lampopt, a plugin of our own, and one that does not work."""
    load = Plugins.load
    ours = [("extra", Extra()), ("odd", object())]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Plugins, "load", lambda: load(ours, block=["gridsdf"]))
        yield patch


@pytest.fixture(scope="module")
def folder(installed, tmp_path_factory):
    """Boxes as files beside a table, and the bank built of them through the shell."""
    place = tmp_path_factory.mktemp("cli")
    rows = ["mesh,length [m],angle [deg],drag [N]"]
    for i, (length, angle) in enumerate([(1.0, 0.0), (1.4, 0.0), (1.0, 8.0), (1.4, 8.0)]):
        size = (length, 0.8 + angle / 40, length / 2)
        trimesh.creation.box(size).export(place / f"car_{i}.stl")
        rows.append(f"car_{i}.stl,{length},{angle},{'' if i == 3 else i}")
    (place / "cars.csv").write_text("\n".join(rows))
    code = cli.main(build(place / "cars.csv", place / "cars.lamp"))
    assert code == 0
    return place


def build(table, out, *more):
    return [
        *("bank", "build", "--source", "table", "--set", f"table={table}", "--set", "labels=drag"),
        *("--decoder", "grid", "--decoder-set", "size=20", "--measured", "length=extents.length"),
        *("--out", str(out), *more),
    ]


@pytest.fixture
def call(capsys):
    """Run a command for people: (code, standard error); nothing is on standard output."""

    def run(*args):
        code = cli.main([str(a) for a in args])
        out, err = capsys.readouterr()
        assert out == ""
        return code, err

    return run


@pytest.fixture
def ask(capsys):
    """Run a command with --json: (code, document, standard error)."""

    def run(*args):
        code = cli.main([*(str(a) for a in args), "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out, parse_constant=pytest.fail), err

    return run


# plugins


def test_plugins(call, ask):
    code, document, err = ask("plugins")
    found = {entry["name"]: entry for entry in document["plugins"]}
    assert code == 0
    assert found["kkt"]["offers"] == {"solver": ["kkt"]}
    assert found["kkt"]["distribution"] == "lampopt"
    assert found["extra"]["observes"]
    assert found["extra"]["offers"] == {"decoder": ["grid"], "source": ["boxes", "gone"]}
    (problem,) = document["problems"]
    assert problem["plugin"] == "odd"
    assert "has no hooks" in problem["cause"]
    assert "WARNING: plugin 'odd'" in err
    code, err = call("plugins")
    assert code == 0
    assert "measure area, bwb" in err
    assert "plugin 'odd' (not installed -): has no hooks" in err


def test_blocked_plugins_are_listed(ask, monkeypatch):
    monkeypatch.setenv("LAMPOPT_BLOCK", "kkt, nobody, casadi")
    assert ask("plugins")[1]["blocked"] == ["casadi", "kkt"]


def test_sources(call, ask):
    code, document, _ = ask("sources")
    found = {entry["name"]: entry for entry in document["sources"]}
    assert code == 0
    options = {option["name"]: option for option in found["table"]["options"]}
    assert options["table"] == {"name": "table", "type": "str", "required": True, "default": None}
    assert options["unit"]["default"] == "m"
    assert found["boxes"]["about"] == "Boxes, and prints."
    assert any("no_such_module" in problem["cause"] for problem in document["problems"])
    code, err = call("sources")
    assert code == 0
    assert re.search(r"boxes +count +int +5 +Boxes, and prints", err)
    assert "not working: source 'gone'" in err


def test_options_of_one_are_told_with_what_they_are(call, ask):
    code, document, _ = ask("options", "decoder")
    offers = {entry["name"]: entry for entry in document["offers"]}
    assert code == 0
    assert {"grid", "mesh-template", "sdf-mlp"} <= set(offers)
    assert offers["vertex-template"]["options"] == []
    assert {"name": "octaves", "type": "int", "required": False, "default": 2} in offers["sdf-mlp"]["options"]
    assert "Fourier features sin" not in call("options", "decoder")[1]
    code, err = call("options", "decoder", "sdf-mlp")
    assert code == 0
    assert re.search(r"octaves +int +2", err)
    assert "Fourier features sin" in err
    assert "mesh-template" not in err


def test_options_of_what_is_not_there(call):
    code, err = call("options", "solver", "nobody")
    assert code == 2
    assert "solver 'nobody' is not installed; installed are: casadi" in err
    code, err = call("options", "source", "gone")
    assert code == 2
    assert "cannot load 'no_such_module:Gone'" in err
    assert call("options", "engine")[0] == 2


def test_check_plugin(call, ask):
    code, document, _ = ask("check-plugin", "kkt")
    assert (code, document["passed"]) == (0, True)
    assert {"plugin": "solver kkt", "check": "builds", "passed": True, "message": ""} in document["records"]
    code, document, _ = ask("check-plugin", "odd")
    assert (code, document["passed"]) == (1, False)
    code, err = call("check-plugin", "odd")
    assert code == 1
    assert "odd: 1 checks, 1 failed" in err
    code, document, _ = ask("check-plugin", "nobody")
    assert code == 2
    assert document["error"]["type"] == "PluginError"
    assert "known are: casadi, datasets" in document["error"]["message"]


# banks


def test_bank_info(call, ask, folder):
    code, document, _ = ask("bank", "info", folder / "cars.lamp")
    assert code == 0
    assert (document["exemplars"], document["weights"], document["unit"]) == (4, 8000, "m")
    assert document["decoder"] == {"name": "grid", "options": {"size": 20}}
    length = {"name": "length", "unit": "m", "low": 1.0, "high": 1.4, "measured_by": "extents.length"}
    assert document["parameters"][0] == length
    assert document["labels"] == [{"name": "drag", "unit": "N", "low": 0.0, "high": 2.0, "known": 3}]
    assert document["mesh_facts"] == {"bodies": 1, "genus": 0}
    bank = load_bank(folder / "cars.lamp")
    assert document["fit_error"]["by_exemplar"]["car_1"] == pytest.approx(bank.fit_error[1] / bank.frame.scale)
    assert document["fit_error"]["worst"] == pytest.approx(bank.fit_error.max() / bank.frame.scale)
    code, err = call("bank", "info", folder / "cars.lamp")
    assert code == 0
    assert re.search(r"length +m +1 to 1.4 +extents.length", err)
    assert "3 of 4" in err


def test_bank_build(call, ask, folder):
    """A finished bank is read; the same place for other inputs is refused."""
    before = (folder / "cars.lamp").stat().st_mtime_ns
    code, document, _ = ask(*build(folder / "cars.csv", folder / "cars.lamp"))
    assert (code, document["bank"]) == (0, str(folder / "cars.lamp"))
    assert (folder / "cars.lamp").stat().st_mtime_ns == before
    code, document, _ = ask(*build(folder / "cars.csv", folder / "cars.lamp", "--seed", "1"))
    assert code == 2
    assert "delete it or name another" in document["error"]["message"]
    code, err = call(*build(folder / "cars.csv", folder / "two.lamp", "--batch", "3", "-v"))
    assert code == 0
    assert "INFO: fitting exemplars 4 to 4 of 4" in err


@pytest.mark.parametrize(
    ("args", "kind", "message"),
    [
        (["--set", "cout=3"], "PluginError", "unknown option 'cout'; known are: count: int"),
        (["--set", "count=few"], "InputError", "--set count: expected a whole number, got 'few'"),
        (["--set", "loud=perhaps"], "InputError", "--set loud: expected true or false, got 'perhaps'"),
        (["--set", "count"], "InputError", "--set: expected NAME=VALUE, got 'count'"),
        (["--set", "count=3", "--set", "count=4"], "InputError", "count is given twice, as 3 and as 4"),
        (["--decoder", "gird"], "PluginError", "decoder 'gird' is not installed; installed are: grid"),
        (["--decoder-set", "size=2.5"], "InputError", "--decoder-set size: expected a whole number"),
        (["--measured", "lenth=extents.length"], "InputError", "['lenth'] are no parameters"),
        (["--out", "cars.csv/x.lamp"], "InputError", "no file can be written in"),
        (["--batch", "0"], "BadParameter", "--batch"),
        (["--bach", "0"], "NoSuchOption", "--batch"),
    ],
)
def test_bank_build_refuses(ask, folder, monkeypatch, args, kind, message):
    monkeypatch.chdir(folder)
    code, document, _ = ask("bank", "build", "--source", "boxes", "--decoder", "grid", "--out", "x.lamp", *args)
    assert code == 2
    assert document["error"]["type"] == kind
    assert message in document["error"]["message"]
    assert not (folder / "x.lamp").exists()


def test_what_a_plugin_prints_does_not_spoil_the_document(ask, folder):
    args = ("bank", "build", "--source", "boxes", "--set", "loud=yes", "--set", "count=2", "--decoder", "grid")
    code, document, err = ask(*args, "--decoder-set", "size=8", "--out", folder / "boxes.lamp")
    assert (code, document["exemplars"]) == (0, 2)
    assert "hello True" in err


@pytest.mark.parametrize("content", [None, b"", b"no bank"])
def test_bank_info_refuses(ask, call, tmp_path, content):
    if content is not None:
        (tmp_path / "x.lamp").write_bytes(content)
    code, document, _ = ask("bank", "info", tmp_path / "x.lamp")
    assert (code, document["error"]["type"]) == (2, "BankError")
    code, err = call("bank", "info", tmp_path / "x.lamp")
    assert code == 2
    assert err.startswith("error: ")
    assert "Traceback" not in err


# measure


def test_measure(call, ask, folder):
    code, document, _ = ask("measure", "extents", folder / "car_1.stl", "--unit", "mm")
    assert code == 0
    assert document["values"]["length"] == {"value": pytest.approx(1.4), "unit": "mm"}
    code, document, _ = ask("measure", "volume", folder / "car_0.stl", "--unit", "mm")
    assert document["values"] == {"volume": {"value": pytest.approx(0.4), "unit": "mm^3"}}
    code, err = call("measure", "extents", folder / "car_1.stl")
    assert code == 0
    assert re.search(r"length +1\.4 +m\b", err)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["extnts", "car_0.stl"], "installed are: aerosandbox, area, bwb"),
        (["extents", "none.stl"], "mesh none.stl: cannot be read"),
        (["extents", "cars.csv"], "mesh cars.csv: cannot be read"),
        (["plate", "car_0.stl"], "hole"),
        (["extents", "car_0.stl", "--set", "axis=x"], "unknown option 'axis'; known are: none"),
        (["extents", "car_0.stl", "--unit", "kg"], "--unit: cannot"),
    ],
)
def test_measure_refuses(ask, folder, monkeypatch, args, message):
    monkeypatch.chdir(folder)
    code, document, _ = ask("measure", *args)
    assert code == 2
    assert message in document["error"]["message"]


# designs


def test_make_accepted(call, ask, folder, tmp_path):
    args = ["make", folder / "cars.lamp", "--target", "length=1200 mm", "--target", "angle=4 deg", *LOOSE]
    code, document, _ = ask(*args, "--measure", "extents", "--out", tmp_path / "car.stl")
    failed = [check for check in document["checks"] if not check["passed"]]
    assert (code, document["accepted"], failed) == (0, True, [])
    assert document["target"] == {"length": pytest.approx(1.2), "angle": pytest.approx(4.0)}
    assert document["mesh"] == str(tmp_path / "car.stl")
    assert document["predicted"]["length"] == {"value": pytest.approx(1.2), "unit": "m"}
    assert trimesh.load_mesh(tmp_path / "car.stl").extents[0] == pytest.approx(1.2, abs=0.2)
    assert "extents.length" in {check["name"] for check in document["checks"]}
    code, err = call(*args, "--out", tmp_path / "car.ply")
    assert code == 0
    assert (tmp_path / "car.ply").exists()
    assert "accepted: every check passed" in err
    assert re.search(r"mismatch +[\d.e-]+ +<= +0\.01 +box +yes", err)
    assert re.search(r"length +1\.2 +1\.2 +m +1 to 1\.4", err)


def test_make_rejected_is_written_all_the_same(call, ask, folder, tmp_path):
    args = ["make", folder / "cars.lamp", "--keep", "angle", "--target", "length=1.2", *LOOSE]
    args += ["--limit", "drift.length=0", "--out", tmp_path / "car.stl"]
    code, document, _ = ask(*args)
    assert (code, document["accepted"]) == (1, False)
    assert (tmp_path / "car.stl").exists()
    code, err = call(*args)
    assert code == 1
    assert "REJECTED: drift.length" in err
    assert "although the design is rejected" in err


def test_make_without_a_surface_writes_nothing(call, ask, folder, tmp_path):
    args = ["make", folder / "cars.lamp", "--target", "length=-30", "--target", "angle=-600", *LOOSE]
    code, document, _ = ask(*args, "--out", tmp_path / "car.stl")
    assert (code, document["mesh"]) == (1, None)
    assert list(tmp_path.iterdir()) == []
    code, err = call(*args, "--level", "alpha", "--out", tmp_path / "car.stl")
    assert code == 1
    assert "is not written: the design has no surface" in err


def test_make_judges_as_far_as_it_is_told(ask, call, folder):
    args = ["make", folder / "cars.lamp", "--target", "length=1.2", "--level", "field", "--reference", "car_1"]
    code, document, _ = ask(*args, "--solver-set", "ridge=0.5")
    assert code == 1
    assert {check["needs"] for check in document["checks"]} == {"alpha", "field"}
    assert (document["status"], document["mesh"]) == ("inexact", None)
    code, err = call(*args)
    assert code == 0
    assert "without --out" in err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "--target: expected at least one wanted value"),
        (["--target", "lenth=1"], "known are length, angle, drag"),
        (["--target", "length=long"], "length: expected a number or text such as '1420 mm'"),
        (["--target", "length=3 deg"], "cannot bring [deg] to [m]"),
        (["--target", "length=nan"], "length: expected a number"),
        (["--target", "length=1", "--keep", "length"], "asked for twice"),
        (["--keep", "length", "--reference", "car_9"], "there are car_0"),
        (["--target", "length=1", "--limit", "mismatch=small"], "--limit mismatch: expected a number"),
        (["--target", "length=1", "--limit", "mismatc=1"], "limits: unknown mismatc"),
        (["--target", "length=1", "--solver", "ktk"], "installed are: casadi, kkt"),
        (["--target", "length=1", "--solver-set", "ridge=-1"], "ridge"),
        (["--target", "length=1", "--resolution", "1"], "resolution: expected a whole number from 4"),
        (["--target", "length=1", "--level", "all"], "'alpha', 'field', 'mesh'"),
        (["--target", "length=1", "--measure", "extnts"], "installed are: aerosandbox, area"),
        (["--target", "length=1", "--out", "car.step"], "expected a file ending in .stl"),
        (["--target", "length=1", "--out", "none/car.stl"], "in a folder that exists"),
    ],
)
def test_make_refuses(ask, folder, monkeypatch, args, message):
    monkeypatch.chdir(folder)
    code, document, _ = ask("make", "cars.lamp", *args)
    assert code == 2
    assert message in document["error"]["message"]


BROAD = ["--level", "alpha", "--solver", "casadi"]


@pytest.fixture(scope="module")
def model(folder):
    """The file of a model that tells drag from length and angle."""
    regression = Plugins.load().make("model", "linear")
    rows = np.array([[length, angle] for length in (1.0, 1.2, 1.4) for angle in (0.0, 4.0, 8.0)])
    drag = rows @ [[2.0], [0.1]] - 1.5
    fitted = regression.fit(rows, drag, inputs=("length", "angle"), names=("drag",), units=("N",), seed=0)
    store_fitted(fitted, folder / "drag.model", "model", "linear")
    return folder / "drag.model"


def test_label(call, ask, folder, tmp_path):
    code, document, _ = ask("label", folder / "cars.lamp", "area", "--value", "wet=area", "--out", tmp_path / "a.lamp")
    assert code == 0
    assert document["by"] == "area"
    assert document["labels"]["wet"]["car_0"] == pytest.approx(2 * (0.8 + 0.5 + 0.4), rel=0.2)
    assert document["labels"]["drag"]["car_3"] is None
    code, document, _ = ask("label", folder / "cars.lamp", "centroid", "--out", tmp_path / "b.lamp")
    assert [*document["labels"]] == ["drag", *Plugins.load().make("measure", "centroid").names]
    code, err = call("label", folder / "cars.lamp", "area", "--value", "wet=aera", "--out", tmp_path / "c.lamp")
    assert code == 2
    assert "has no 'aera'" in err


def test_make_with_ranges_weights_and_what_is_hard(ask, folder):
    args = ["make", folder / "cars.lamp", *BROAD, "--target", "length=1.3", "--hard", "length"]
    code, document, _ = ask(*args, "--range", "angle=2 deg:6")
    assert (code, document["status"]) == (0, "exact")
    assert document["predicted"]["length"]["value"] == pytest.approx(1.3, abs=1e-6)
    assert 2 - 1e-4 <= document["predicted"]["angle"]["value"] <= 6 + 1e-4
    code, document, _ = ask(*args, "--range", "angle=6.5:")
    assert document["predicted"]["angle"]["value"] == pytest.approx(6.5, abs=1e-3)
    code, document, _ = ask(*args, "--range", "angle=: 1.5 deg", "--ridge", "0", "--norm", "1", "--alpha", "-2:")
    assert document["predicted"]["angle"]["value"] == pytest.approx(1.5, abs=1e-3)
    clash = ["--target", "length=1.2", "--target", "extents.length=1.4"]
    for weight, nearer in (("100", 1.2), ("0.01", 1.4)):
        code, document, _ = ask("make", folder / "cars.lamp", *BROAD, *clash, "--weight", f"length={weight}")
        assert code == 1
        assert document["predicted"]["length"]["value"] == pytest.approx(nearer, abs=0.01)


def test_make_says_what_clashes_and_by_how_much(ask, call, folder):
    args = ["make", folder / "cars.lamp", *BROAD, "--target", "length=1.2", "--range", "extents.length=1.3:"]
    code, document, _ = ask(*args)
    assert (code, document["status"]) == (1, "infeasible")
    assert [sorted(names) for names in document["conflicts"]] == [["extents.length (range)", "length"]]
    assert "extents.length (range) down to 1.3 →" in document["message"]
    code, err = call(*args)
    assert code == 1
    said = " ".join(err.split())
    assert re.search(r"infeasible mix: .*length 1\.2 → 1\.\d+ m.* would agree; .* alone would be enough", said)


def test_make_with_an_objective(ask, folder):
    args = ["make", folder / "cars.lamp", *BROAD, "--keep", "angle", "--reference", "car_1"]
    code, document, _ = ask(*args, "--reduce", "drag=0.5")
    assert document["target"] == {"angle": 0.0, "drag": pytest.approx(0.5)}
    inside = ["--alpha", "0:1", "--range", "length=1.1:1.3"]
    for option, length in (("--minimise", 1.1), ("--maximise", 1.3)):
        more = ["--keep", "angle", "--hard", "angle", *inside, option, "extents.length"]
        code, document, _ = ask("make", folder / "cars.lamp", *BROAD, *more)
        assert (code, document["status"]) == (0, "exact")
        assert document["predicted"]["length"]["value"] == pytest.approx(length, abs=1e-3)
        assert min(document["alpha"].values()) > -1e-6


def test_make_asks_for_a_models_value_safely(ask, call, folder, model):
    args = ["make", folder / "cars.lamp", *BROAD, "--model", f"aero={model}", "--target", "aero.drag=0.8"]
    code, document, _ = ask(*args)
    check = next(check for check in document["checks"] if check["name"] == "target.aero.drag")
    assert (code, check["passed"]) == (0, True)
    code, document, _ = ask("make", folder / "cars.lamp", *BROAD, "--target", "length=9", "--safe", "alpha")
    assert next(check for check in document["checks"] if check["name"] == "alpha")["value"] <= 3 + 1e-3
    assert any("safe alpha" in names for names in document["conflicts"])


def test_make_measures_and_corrects(ask, folder):
    args = ["make", folder / "cars.lamp", "--target", "length=1.2", *LOOSE, "--turns", "2"]
    code, document, _ = ask(*args, "--measured", "length=extents.length")
    assert code == 0
    assert document["provenance"]["turns"] <= 2
    assert "measured.length" in {check["name"] for check in document["checks"]}


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--hard", "angle"], "hard: ['angle'] are not asked for"),
        (["--weight", "length=much"], "--weight length: expected a number, got 'much'"),
        (["--weight", "angle=2"], "weights: ['angle'] are not asked for"),
        (["--range", "angle"], "--range: expected NAME=VALUE, got 'angle'"),
        (["--range", "angle=8"], "--range: expected angle=LOW:HIGH, one of the two perhaps left out, got '8'"),
        (["--range", "angle=:"], "--range: expected angle=LOW:HIGH"),
        (["--range", "angle=1:2:3"], "--range: expected angle=LOW:HIGH"),
        (["--range", "angle=1 m:2"], "cannot bring [m] to [deg]"),
        (["--range", "angle=low:2"], "angle: expected a number or text"),
        (["--range", "angle=3:2"], "expected low ≤ high, got 3 to 2"),
        (["--range", "angle=1:2"], "solver 'kkt' is not able to take ranges"),
        (["--reduce", "drag"], "--reduce: expected NAME=VALUE, got 'drag'"),
        (["--reduce", "drag=all"], "--reduce drag: expected a number"),
        (["--reduce", "drag=1.5"], "Reduce('drag'): expected `by` as a fraction below 1"),
        (["--reduce", "drag=0.1"], "needs a reference"),
        (["--minimise", "drag", "--maximise", "drag"], "--minimise: expected one objective, got --maximise too"),
        (["--model", "drag.model"], "--model: expected NAME=VALUE"),
        (["--model", "aero=none.model"], "none.model"),
        (["--measured", "angle=panels.ramp"], "measured: ['angle'] are not asked for"),
        (["--safe", "quality"], "'alpha', 'mismatch', 'jacobian'"),
        (["--alpha", "0"], "--alpha: expected LOW:HIGH"),
        (["--alpha", "zero:1"], "--alpha: expected a number, got 'zero'"),
        (["--alpha", "1:0"], "alpha: expected the lowest and the highest coefficient"),
        (["--ridge", "-1"], "ridge: expected a number of at least 0"),
        (["--norm", "3"], "1<=x<=2"),
        (["--turns", "101"], "0<=x<=100"),
    ],
)
def test_make_refuses_wishes(ask, folder, monkeypatch, args, message):
    monkeypatch.chdir(folder)
    code, document, _ = ask("make", "cars.lamp", "--target", "length=1.2", *args)
    assert code == 2
    assert message in document["error"]["message"]


@pytest.fixture
def study(folder, tmp_path):
    """A study file beside its bank."""
    (tmp_path / "cars.lamp").write_bytes((folder / "cars.lamp").read_bytes())
    text = 'bank = "cars.lamp"\nresolution = 24\n[targets]\nangle = 4\nlength = 1.2\n[limits]\ndrift = 3\n'
    path = tmp_path / "roof.toml"
    path.write_text(text + "[sweep]\nlength = [1.1, '1300 mm']\n")
    return path


def test_run(call, ask, study):
    code, document, _ = ask("run", study)
    place = study.parent / "runs" / "roof"
    assert (code, document["accepted"], document["folder"]) == (0, True, str(place))
    assert len(list((place / "designs").glob("*/passport.json"))) == 1
    code, err = call("run", study, "--folder", study.parent / "elsewhere")
    assert code == 0
    assert f"recorded in {study.parent / 'elsewhere'}" in err
    study.write_text(study.read_text().replace("drift = 3", "drift = 0"))
    assert ask("run", study)[0] == 1


def test_sweep(call, ask, study):
    code, document, _ = ask("sweep", study)
    assert (code, document["accepted"], document["rejected"]) == (0, 2, 0)
    targets = [{"angle": 4.0, "length": pytest.approx(1.1)}, {"angle": 4.0, "length": pytest.approx(1.3)}]
    assert [design["target"] for design in document["designs"]] == targets
    assert [design["failed"] for design in document["designs"]] == [None, None]
    code, err = call("sweep", study, "--set", "length=1.1,-30", "--set", "angle=0,4 deg")
    assert code == 1
    assert "2 of 4 designs are accepted" in err
    assert re.search(r"1 +0 +1\.1 +yes", err)
    assert re.search(r"3 +0 +-30 +NO +target|3 +0 +-30 +NO +alpha", err)
    assert "length [m]" in err
    place = study.parent / "runs" / "roof"
    with closing(sqlite3.connect(place / "runs.sqlite")) as database:
        rows = database.execute("SELECT mesh FROM designs").fetchall()
    assert len(rows) == 5
    assert len(list((place / "designs").iterdir())) == 5 - rows.count((None,))  # a folder where there is a mesh


def test_sweep_over_a_models_value(ask, call, study, model):
    text = study.read_text().partition("[targets]")[0] + 'solver = "casadi"\nlevel = "alpha"\n'
    study.write_text(text + f"[models]\naero = '{model}'\n[ranges]\nlength = [1.0, inf]\n'aero.drag' = [-inf, 5]\n")
    code, err = call("sweep", study, "--set", "aero.drag=0.7,0.9")
    assert code == 2
    assert "asked for twice" in err
    study.write_text(study.read_text().replace("'aero.drag' = [-inf, 5]\n", ""))
    code, err = call("sweep", study, "--set", "aero.drag=0.7,0.9")
    assert code == 0, err
    assert "aero.drag [N]" in err
    study.write_text(study.read_text() + "'aero.drag' = [-inf, 5]\n[targets]\nangle = 4\n")
    assert ask("run", study)[0] == 0


def test_sweep_of_experiments(ask, study):
    level = "level = 'alpha'\n"
    study.write_text(level + study.read_text())
    ranges = {"length": (1.1, 1.3), "angle": (0.0, 4.0)}
    options = ["--set", "length=1.1,1300 mm", "--set", "angle=0,4 deg"]
    bank = study.parent / "cars.lamp"

    def targets(*args):
        code, document, _ = ask("sweep", study, *args)
        assert code in (0, 1)
        return [{name: pytest.approx(design["target"][name]) for name in ranges} for design in document["designs"]]

    assert targets("--experiments", 5, *options) == experiments(bank, ranges, 5)
    assert targets("--experiments", 6, "--method", "sobol", "--seed", 3, *options) == experiments(
        bank, ranges, 6, method="sobol", seed=3
    )
    corners = experiments(bank, ranges, method="corners")
    assert targets("--method", "corners", *options) == corners
    text = study.read_text().partition("[sweep]")[0]
    plan = "[experiments]\ncount = 3\nmethod = 'halton'\nranges = { length = [1.1, 1.3], angle = [0, 4] }\n"
    study.write_text(text + plan)
    assert targets() == experiments(bank, ranges, 3, method="halton")
    assert targets("--experiments", 5) == experiments(bank, ranges, 5, method="halton")  # a plan that grows
    assert targets("--method", "sobol", "--seed", 1) == experiments(bank, ranges, 3, method="sobol", seed=1)
    assert targets("--method", "corners") == corners
    assert len(targets("--set", "length=1.1,1.2,1.3")) == 3  # without them, --set is values


@pytest.mark.parametrize(
    ("text", "args", "message"),
    [
        (None, [], "cannot be read as a study"),
        ("bank = ", [], "not valid TOML"),
        ('bank = "none.lamp"', [], "none.lamp: no such file"),
        ('bank = "cars.lamp"', [], "has no [sweep] table, and no [experiments]: add one, or name values"),
        ('bank = "cars.lamp"', ["--experiments", "4"], "expected a low and a high value for each name, as in --set"),
        ('bank = "cars.lamp"', ["--experiments", "4", "--set", "length=1"], "a low and a high value, got 1 values"),
        ('bank = "cars.lamp"', ["--method", "sobol", "--set", "length=1,2"], "count: expected a whole number from 1"),
        ('bank = "cars.lamp"', ["--experiments", "4", "--method", "corners", "--set", "length=1,2"], "expected none"),
        ('bank = "cars.lamp"', ["--method", "corners", "--set", "lenth=1,2"], "known are length"),
        ('bank = "cars.lamp"', ["--set", "length=1,"], "expected values between commas"),
        ('bank = "cars.lamp"', ["--set", "lenth=1"], "known are length"),
        ('bank = "cars.lamp"', ["--set", "length=1", "--folder", "cars.lamp"], "--folder"),
    ],
)
def test_sweep_refuses(ask, study, monkeypatch, text, args, message):
    monkeypatch.chdir(study.parent)
    study.unlink() if text is None else study.write_text(text)
    code, document, _ = ask("sweep", "roof.toml", *args)
    assert code == 2
    assert message in document["error"]["message"]


# what all commands have in common


def leaves(group=cli.cli, path=("lampopt",)):
    """Every command with its path."""
    for name, command in sorted(group.commands.items()):
        if isinstance(command, click.Group):
            yield from leaves(command, (*path, name))
        else:
            yield (*path, name), command


def test_every_command_takes_json_and_verbose():
    for path, command in leaves():
        assert isinstance(command, Command), path
        assert {"as_json", "verbose"} <= {parameter.name for parameter in command.params}, path


def test_mistyped_names_are_answered_with_a_suggestion(ask, call):
    code, document, _ = ask("sorces")
    assert code == 2
    assert "sorces" in document["error"]["message"]
    code, err = call("make", "cars.lamp", "--targt", "length=1")
    assert code == 2
    assert "--target" in err


def test_interrupted(call, ask, study, installed, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("lampopt.cli.designs.run_study", stop)
    code, err = call("run", study)
    assert code == 130
    assert "the same command goes on where it stopped" in err
    code, document, _ = ask("run", study)
    assert (code, document["error"]["type"]) == (130, "Interrupted")


def test_a_bug_keeps_its_traceback_and_is_no_rejection(call, ask, study, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("who divided?")

    monkeypatch.setattr("lampopt.cli.designs.run_study", broken)
    code, err = call("run", study)
    assert code == 70
    assert "Traceback" in err
    code, document, err = ask("run", study)
    assert (code, document["error"]["message"]) == (70, "who divided?")
    assert "Traceback" in err


@pytest.mark.parametrize("code", [0, 1, None])
def test_a_plugin_that_ends_the_program_is_a_bug(call, ask, study, monkeypatch, code):
    monkeypatch.setattr("lampopt.cli.designs.run_study", lambda *_, **__: sys.exit(code))
    assert call("run", study)[0] == 70
    found, document, _ = ask("run", study)
    assert (found, document["error"]["type"]) == (70, "SystemExit")


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_end_well(capsys, option):
    assert cli.main([option]) == 0
    assert "lampopt" in capsys.readouterr().out


def test_a_reader_that_leaves_is_no_bug():
    code = "import sys; from lampopt.cli import main; sys.exit(main(['plugins', '--json']))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_json_has_null_where_nothing_is_known():
    value = {"a": [float("nan"), (float("inf"), np.float64("nan"))], "b": 1.5}
    assert _plain(value) == {"a": [None, [None, None]], "b": 1.5}
    assert replace(Answer({}), code=1).code == 1


def test_logging_is_left_as_it_was(call):
    log = logging.getLogger("lampopt")
    before = log.level, list(log.handlers)
    call("plugins", "-v")
    assert (log.level, list(log.handlers)) == before


def test_nothing_heavy_is_loaded_to_list_and_help():
    """A bare process: help, version and the list of plugins need none of these."""
    program = (
        "import sys; from lampopt.cli import main\n"
        "assert [main(a) for a in (['--help'], ['--version'], ['plugins', '--json'], ['make', '-h'])] == [0] * 4\n"
        "heavy = {'torch', 'trimesh', 'skimage', 'scipy', 'igl', 'pint', 'casadi'} & set(sys.modules)\n"
        "sys.exit(f'loaded: {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_the_command_is_installed():
    command = Path(sys.executable).with_name("lampopt")
    done = subprocess.run([command, "bank", "info", "none.lamp", "--json"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, "")
    assert json.loads(done.stdout)["error"]["type"] == "BankError"


# progress


def shown(monkeypatch, *, terminal):
    from rich.console import Console

    file = io.StringIO()
    made = Console(file=file, force_terminal=terminal, width=120)
    monkeypatch.setattr(progress, "console", lambda: made)
    return file


def test_a_bar_on_a_terminal(monkeypatch):
    file = shown(monkeypatch, terminal=True)
    with progress.progress_bar("fitting [x]") as tell:
        tell(0.5, "exemplars 1 to 8")
    assert "fitting [x]" in file.getvalue()


def test_a_line_now_and_then_elsewhere(monkeypatch):
    file = shown(monkeypatch, terminal=False)
    with progress.progress_bar("fitting") as tell:
        tell(0.25)
    assert file.getvalue() == ""
    clock = iter([0.0, 10.0, 40.0, 50.0, 100.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with progress.progress_bar("fitting") as tell:
        for done in (0.25, 0.5, 0.6, 1.0):
            tell(done, "exemplars 1 to 8")
    assert file.getvalue().splitlines() == [
        "fitting: 50%, 0:00:40 elapsed, 0:01:00 left (exemplars 1 to 8)",
        "fitting: 100%, 0:01:40 elapsed, 0:00:00 left (exemplars 1 to 8)",
    ]


def test_progress_lets_errors_through(monkeypatch):
    for terminal in (True, False):
        shown(monkeypatch, terminal=terminal)
        with pytest.raises(InputError), progress.progress_bar("fitting"):
            raise InputError("no")


# documentation


def helps():
    """The help of every command by how it is called."""
    top = click.Context(cli.cli, info_name="lampopt", terminal_width=100, help_option_names=["-h", "--help"])
    found = {"lampopt": cli.cli.get_help(top)}
    for path, command in leaves():
        context = top
        for name in path[1:]:
            context = click.Context(context.command.commands[name], info_name=name, parent=context)
        found[" ".join(path)] = command.get_help(context)
    return found


def refreshed(text):
    """docs/cli.md with every block of help as it is now."""
    real = helps()

    def block(match):
        return f"<!-- help: {match[1]} -->\n```text\n{real[match[1]]}\n```"

    return re.sub(r"<!-- help: (.+?) -->\n```text\n.*?```", block, text, flags=re.DOTALL)


def test_docs_show_the_real_help():
    text = DOC.read_text(encoding="utf-8")
    documented = re.findall(r"<!-- help: (.+?) -->", text)
    assert sorted(documented) == sorted(helps())
    assert text.split() == refreshed(text).split(), "run `python tests/test_cli.py` to write the help anew"


if __name__ == "__main__":
    DOC.write_text(refreshed(DOC.read_text(encoding="utf-8")), encoding="utf-8")


def test_what_rounding_leaves_is_shown_as_nothing():
    length = lampopt.Parameter("length", "m", -0.3, 0.3)
    assert show._unrounded(-2e-19, length) == 0.0
    assert show._unrounded(1e-9, length) == 1e-9
    assert show._unrounded(2e-19, lampopt.Parameter("tiny", "m", 0.0, 1e-18)) == 2e-19


def test_what_a_plugins_own_program_prints_does_not_spoil_the_document(tmp_path):
    """Nor what is printed in processes that a command begins."""
    code = """
import os, sys
from lampopt import cli
from lampopt.plugins import Plugins
Plugins.load = lambda real=Plugins.load: (os.system("echo hello"), print("hello"), real())[2]
sys.exit(cli.main(["plugins", "--json"]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert json.loads(done.stdout)["plugins"] and done.stderr.count("hello") == 2


def test_names_and_all_may_be_said_together(ask, tmp_path):
    made = ask("bank", "build", "--source", "boxes", "--decoder", "grid", "--accept", "all", "--accept", "box_0",
               "--out", tmp_path / "new" / "b.lamp")  # fmt: skip
    assert made[0] == 0, made


def test_options_that_would_do_nothing_are_refused(ask, tmp_path):
    code, document, _ = ask("intake", "--source", "boxes", "--unit", "mm")
    assert code == 2 and "--unit go with a table" in document["error"]["message"]
    for command in ("flow", "flow-study"):
        code, document, _ = ask(command, tmp_path / "car.stl", "--unit", "kg")
        assert code == 2 and "--unit" in document["error"]["message"]
    code, document, _ = ask("wrap", tmp_path / "car.stl", "--gap", "0.1", "--out", tmp_path / "car.step")
    assert code == 2 and ".step" in document["error"]["message"]


def test_a_label_that_is_asked_for_is_shown_with_what_it_is_worth(call, ask, folder):
    args = ["make", folder / "cars.lamp", "--reference", "car_0", "--reduce", "drag=0.01", *LOOSE, "--level", "alpha"]
    _, err = call(*args)
    assert re.search(r"drag \(as labels mix\) +\S+ +\S+", err)
    assert "drag: mixed from the exemplars' labels, which shapes need not follow" in " ".join(err.split())
    _, err = call("make", folder / "cars.lamp", "--target", "length=1.2", *LOOSE, "--level", "alpha")
    assert "labels" not in err


def test_a_sweep_says_where_each_design_is(call, ask, study):
    _, document, _ = ask("sweep", study)
    for design in document["designs"]:
        assert (Path(document["folder"]) / "designs" / design["design"] / "mesh.stl").exists()
    _, err = call("sweep", study)
    assert all(design["design"] in err for design in document["designs"])


def test_the_folder_of_out_is_made_before_long_work(ask, folder, tmp_path):
    out = tmp_path / "new" / "drag.model"
    asked = ["model", "fit", "linear", "--bank", folder / "cars.lamp", "--label", "drag", "--out", out]
    code, document, _ = ask(*asked)
    assert (code, out.exists()) == (0, True), document
