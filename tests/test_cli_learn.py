"""`lampopt surrogate fit`, `model fit`, `model predict`, `measure learned`, and measures with options in a shell."""

import csv
import json

import numpy as np
import pytest

from lampopt.cli import main
from lampopt.testing import shapes


@pytest.fixture(scope="module")
def cars(tmp_path_factory):
    """A table of 16 boxes, their length and width known, and as a label twice the length."""
    folder = tmp_path_factory.mktemp("cars")
    rng = np.random.default_rng(1)
    with (folder / "cars.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["mesh", "length [m]", "width [m]", "drag"])
        for i in range(16):
            length, width = rng.uniform([1.0, 0.4], [2.0, 0.8])
            shapes.box((length, width, 0.5)).export(folder / f"car_{i}.stl")
            rows.writerow([f"car_{i}.stl", length, width, 2 * length])
    return folder


def asked(capsys, *args):
    code = main([*map(str, args), "--json"])
    out = capsys.readouterr().out
    return code, json.loads(out)


def source(cars):
    return ["--source", "table", "--set", f"table={cars / 'cars.csv'}", "--set", "labels=drag"]


def test_a_measure_is_learned_and_used(cars, tmp_path, capsys):
    file, mesh = tmp_path / "drag.measure", cars / "car_0.stl"
    args = ["surrogate", "fit", "calibrated", *source(cars), "--option", "by=extents.length", "--for", "drag"]
    code, told = asked(capsys, *args, "--out", file)
    assert code == 0
    assert told["told"]["drag"]["r2"] == pytest.approx(1.0)
    assert told["told"]["drag"]["mean_absolute_error"] == pytest.approx(0.0, abs=1e-6)
    assert told["exemplars"] == 16
    code, said = asked(capsys, "measure", "learned", mesh, "--set", f"file={file}")
    assert code == 0
    with (cars / "cars.csv").open() as table:
        wanted = float(next(iter(csv.DictReader(table)))["drag"])
    assert said["values"]["drag"]["value"] == pytest.approx(wanted, rel=1e-5)
    low, high = said["values"]["drag"]["interval"]
    assert low <= said["values"]["drag"]["value"] <= high
    assert said["outside"] is False
    shapes.box((9.0, 0.5, 0.5)).export(tmp_path / "long.stl")
    assert asked(capsys, "measure", "learned", tmp_path / "long.stl", "--set", f"file={file}")[1]["outside"] is True


def test_a_model_is_fitted_and_asked(cars, tmp_path, capsys):
    file = tmp_path / "drag.model"
    code, told = asked(capsys, "model", "fit", "linear", *source(cars), "--out", file)
    assert code == 0
    assert told["told"]["drag"]["r2"] == pytest.approx(1.0, abs=1e-3)
    code, said = asked(capsys, "model", "predict", file, "--at", "length=1.5", "--at", "width=0.6")
    assert code == 0
    assert said["at"] == {"length": 1.5, "width": 0.6}
    assert said["values"]["drag"]["value"] == pytest.approx(3.0, abs=0.01)
    assert said["outside"] is False
    low, high = said["values"]["drag"]["interval"]
    assert low <= 3.0 <= high
    assert asked(capsys, "model", "predict", file, "--at", "length=15", "--at", "width=0.6")[1]["outside"] is True


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--at", "length=1.5"], "missing are width"),
        (["--at", "length=1.5", "--at", "width=1", "--at", "roof=2"], "unknown are roof"),
        (["--at", "length=long", "--at", "width=1"], "expected a number"),
    ],
)
def test_what_a_model_needs_is_said(cars, tmp_path, capsys, args, message):
    file = tmp_path / "drag.model"
    asked(capsys, "model", "fit", "linear", *source(cars), "--out", file)
    code, said = asked(capsys, "model", "predict", file, *args)
    assert code == 2
    assert message in said["error"]["message"]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["model", "fit", "linear", "--out", "x.model"], "expected --bank or --source, one of them"),
        (["model", "fit", "linear", "--bank", "b", "--source", "table", "--out", "x.model"], "one of them"),
        (["model", "fit", "linear", "--bank", "b", "--set", "a=b", "--out", "x.model"], "--set: belongs to --source"),
        (["surrogate", "fit", "nothing", "--source", "plate", "--out", "x.m"], "surrogate 'nothing' is not installed"),
        (["measure", "learned", "x.stl"], "expected the option `file`"),
    ],
)
def test_what_is_asked_wrongly_is_said(tmp_path, monkeypatch, capsys, args, message):
    monkeypatch.chdir(tmp_path)
    shapes.box((1, 1, 1)).export("x.stl")
    code, said = asked(capsys, *args)
    assert code == 2
    assert message in said["error"]["message"]


def test_nothing_to_be_told_is_said(tmp_path, capsys):
    code, said = asked(capsys, "model", "fit", "linear", "--source", "plate", "--out", tmp_path / "x.model")
    assert code == 2
    assert "have no labels" in said["error"]["message"]


def test_a_design_is_measured_with_options(cars, tmp_path, capsys):
    file, bank = tmp_path / "drag.measure", tmp_path / "cars.lamp"
    args = ["surrogate", "fit", "calibrated", *source(cars), "--option", "by=extents.length", "--for", "drag"]
    asked(capsys, *args, "--out", file)
    asked(capsys, "bank", "build", *source(cars), "--decoder", "gridsdf", "--decoder-set", "size=25", "--out", bank)
    code, said = asked(
        capsys, "make", bank, "--target", "length=1.5", "--resolution", 32,
        "--measure", f"learned:file={file}", "--measure", "hole:which=2,along=x",
        "--measure", "stations:stations=0.25,0.5",
    )  # fmt: skip
    assert code in (0, 1)
    checks = {check["name"]: check for check in said["checks"]}
    assert checks["learned.drag"]["value"] == pytest.approx(3.0, abs=0.3)
    assert "90% interval" in checks["learned.drag"]["note"]
    assert "hole.radius" in checks
    assert {"stations.sweep_25", "stations.sweep_50"} <= {*checks}
    code, said = asked(capsys, "make", bank, "--target", "length=1.5", "--measure", "hole:which=2,along=x,")
    assert code == 2 and "expected NAME=VALUE, got ''" in said["error"]["message"]
    code, said = asked(capsys, "make", bank, "--target", "length=1.5", "--measure", "hole:wich=2")
    assert code == 2
    assert "unknown option 'wich'" in said["error"]["message"]


def test_a_model_needs_no_shapes(tmp_path, capsys):
    """A table of parameters and labels alone."""
    rng = np.random.default_rng(2)
    rows = [f"{a},{b},{3 * a - b}" for a, b in rng.uniform(1, 2, (20, 2))]
    (tmp_path / "runs.csv").write_text("\n".join(["roof [m],ramp [deg],drag", *rows]))
    args = ["--source", "table", "--set", f"table={tmp_path / 'runs.csv'}", "--set", "labels=drag"]
    code, said = asked(capsys, "model", "fit", "linear", *args, "--out", tmp_path / "drag.model")
    assert code == 2
    assert "is read with meshes='none'" in said["error"]["message"]
    args += ["--set", "meshes=none"]
    assert asked(capsys, "model", "fit", "linear", *args, "--out", tmp_path / "drag.model")[0] == 0
    code, said = asked(capsys, "model", "predict", tmp_path / "drag.model", "--at", "roof=1.5", "--at", "ramp=1.5")
    assert said["values"]["drag"]["value"] == pytest.approx(3.0, abs=0.01)
    code, said = asked(capsys, "surrogate", "fit", "calibrated", *args, "--out", tmp_path / "drag.measure")
    assert code == 2
    assert "has no mesh: it serves for models" in said["error"]["message"]
