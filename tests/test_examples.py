"""Every example runs, top to bottom, in a folder of its own; the slow decoder is replaced by a quick one."""

import json
import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

import lampopt

EXAMPLES = Path(__file__).parent.parent / "examples"
SLOW, QUICK = '"mesh-template"', 'lampopt.Spec("gridsdf", size=25)'


def run(script, folder, *arguments):
    """What `script` prints, run in `folder` with warnings as errors."""
    text = (EXAMPLES / script).read_text(encoding="utf-8")
    copy = folder / script
    copy.write_text(text.replace(f"decoder={SLOW}", f"decoder={QUICK}"), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES), "COLUMNS": "120"}
    command = [sys.executable, "-W", "error", str(copy), *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_demo(tmp_path):
    said = run("demo.py", tmp_path, "out")
    out = tmp_path / "out"
    checks = json.loads((out / "checks.json").read_text(encoding="utf-8"))
    assert checks["target"] == {"hole_radius": 0.3}
    assert all(check["name"] in said for check in checks["checks"])
    assert ("accepted" if checks["accepted"] else "rejected") in said
    assert lampopt.measure("plate", trimesh.load_mesh(out / "plate.stl"))["hole_radius"] == pytest.approx(0.3, abs=0.03)
    assert (out / "plate.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "plate.lamp").exists()


def test_table_of_meshes(tmp_path):
    said = run("01_table_of_meshes.py", tmp_path, "out")
    assert "drift.length" in said
    assert trimesh.load_mesh(tmp_path / "out" / "new.stl").extents[0] == pytest.approx(2.7, abs=0.1)


def test_sweep(tmp_path):
    said = run("02_sweep.py", tmp_path, "out")
    assert said.count("volume") == 7
    assert ": accepted" in said  # the middle of the range
    assert "drift.thickness" in said  # far beyond it
    database = tmp_path / "out" / "run" / "runs.sqlite"
    with sqlite3.connect(database) as rows:
        before = rows.execute("SELECT key, seconds FROM designs").fetchall()
    rows.close()
    assert len(before) == 7
    assert run("02_sweep.py", tmp_path, "out") == said
    with sqlite3.connect(database) as rows:  # nothing was computed again
        assert rows.execute("SELECT key, seconds FROM designs").fetchall() == before
    rows.close()


def test_own_measure(tmp_path):
    said = dict(line.split() for line in run("03_own_measure.py", tmp_path, "out").splitlines())
    assert float(said["stance.aspect"]) > 1
    assert 0 < float(said["stance.fill"]) < 1


def test_morph(tmp_path):
    said = run("04_morph.py", tmp_path, "out")
    assert "roof_high    4.200 m long, 1.410 m high" in said
    assert "drift.length" in said
    assert trimesh.load_mesh(tmp_path / "out" / "new.stl").extents[2] == pytest.approx(1.26 + 0.08, abs=0.03)


def test_measure_and_learn(tmp_path):
    said = run("05_measure_and_learn.py", tmp_path, "out")
    assert "wheels {'wheelbase': 2720.0" in said
    assert "windscreen {'angle': 32.0}" in said
    assert "roof up [1." in said  # the height of the roof rises as the roof does
    assert (tmp_path / "out" / "drag.measure").exists()
    (line,) = [line for line in said.splitlines() if line.startswith("model")]
    predicted, true = line.removeprefix("model [[").split("]] true [[")
    assert float(predicted) == pytest.approx(float(true.removesuffix("]]")), abs=0.005)


def test_every_example_is_tested():
    tests = Path(__file__).read_text(encoding="utf-8")
    scripts = {path.name for path in EXAMPLES.glob("*.py")} - {"picture.py"}  # imported by demo.py
    assert all(f'"{name}"' in tests for name in scripts)
    assert all(len((EXAMPLES / name).read_text(encoding="utf-8").splitlines()) <= 60 for name in scripts)
