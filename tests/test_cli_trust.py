"""`lampopt bank calibrate` and `bank volume`: for people and as JSON."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from lampopt import build_bank, calibrate, cli, exemplars, extrapolation_volume, load_bank
from lampopt.plugins import Plugins
from lampopt.types import Spec

HERE = Path(__file__).parent
EXAMPLE = str(HERE.parent / "examples" / "third_party_decoder")
sys.path[:0] = [p for p in (EXAMPLE,) if p not in sys.path]
gridsdf = importlib.import_module("lampopt_gridsdf")


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(sys.modules["lampopt.calibrate"], "TRIALS", 6)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("trust") / "plates.lamp"
    build_bank(exemplars("plate"), Spec("gridsdf", size=24), store=path, probes=500)
    return path


def as_json(capsys, *args):
    code = cli.main([*map(str, args), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_limits_are_written_with_their_evidence(file, tmp_path, capsys):
    out = tmp_path / "b.lamp"
    options = ("--tolerance", "100 mm", "--source", "plate", "--resolution", 24, "--out", out)
    code, said = as_json(capsys, "bank", "calibrate", file, *options)
    expected = calibrate(load_bank(file), 0.1, exemplars=exemplars("plate"), resolution=24)
    assert code == 0
    assert said["limits"] == dict(expected.limits) == dict(load_bank(out).limits)
    assert said["designs"] == len(expected.calibration.errors)
    assert said["good"] == int(expected.calibration.good.sum())
    errors = [np.nan if error is None else error for error in said["evidence"]["errors"]]  # JSON knows no NaN
    assert errors == pytest.approx(expected.calibration.errors.tolist(), nan_ok=True)
    assert said["against"] == "0.1 m against the exemplars' meshes"
    assert load_bank(file).calibration is None


def test_people_see_a_line_a_check(file, tmp_path, capsys):
    out = tmp_path / "b.lamp"
    assert (
        cli.main(["bank", "calibrate", str(file), "--tolerance", "30 mm", "--resolution", "24", "--out", str(out)]) == 0
    )
    said = capsys.readouterr().err
    assert "mismatch" in said
    assert "within 0.03 m" in said


@pytest.mark.parametrize(
    ("tolerance", "message"), [("soon", "expected a number"), ("1e-9", "below the error of every")]
)
def test_what_cannot_be_is_told_and_nothing_is_written(file, tmp_path, capsys, tolerance, message):
    out = tmp_path / "b.lamp"
    code, said = as_json(capsys, "bank", "calibrate", file, "--tolerance", tolerance, "--resolution", 24, "--out", out)
    assert code == 2
    assert message in said["error"]["message"]
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "count=3"], "--set: belongs to --source"),
        (["--out", "precious.csv"], "expected the name of a new .lamp file"),
        (["--out", "there.lamp"], "expected the name of a new .lamp file"),
    ],
)
def test_no_other_file_is_written_over(file, tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    for name in ("precious.csv", "there.lamp"):
        Path(name).write_text("mine")
    code, said = as_json(capsys, "bank", "calibrate", file, "--tolerance", "30 mm", *options)
    assert code == 2
    assert message in said["error"]["message"]
    assert {Path(name).read_text() for name in ("precious.csv", "there.lamp")} == {"mine"}


def test_the_volume(file, capsys):
    code, said = as_json(capsys, "bank", "volume", file, "--factor", 1.5, "--count", 300, "--limit", "alpha=2")
    found = extrapolation_volume(load_bank(file), 1.5, 300, limits={"alpha": 2.0})
    assert code == 0
    assert 0 < found.share < 1
    assert (said["share"], said["ratio"], said["rejected"]) == (found.share, found.ratio, dict(found.rejected))
    assert np.isclose(said["ratio"], 1.5**6 * said["share"])
    assert cli.main(["bank", "volume", str(file), "--count", "10", "--parameter", "length"]) == 0
    assert "volume reached safely" in capsys.readouterr().err


def test_the_decoder_is_installed():
    """The tests above choose it by name."""
    assert Plugins.load().get("decoder", "gridsdf").resolve() is gridsdf.GridSDF
