"""As a user gets it: wheels in a fresh environment, the checkout out of reach, and a plate made through the shell."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.slow


def run(*command, cwd, code=0):
    # The checkout and its metadata come in by way of these; the fresh environment is to know nothing of them.
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=kept, capture_output=True, text=True, timeout=600)
    assert done.returncode == code, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Built from copies, so that no build folder is left in the checkout."""
    place = tmp_path_factory.mktemp("wheels")
    for name, parts in {
        "lampopt": ("lampopt", "plugins", "pyproject.toml", "README.md", "LICENSE"),
        "gridsdf": ("examples/third_party_decoder/lampopt_gridsdf.py", "examples/third_party_decoder/pyproject.toml"),
    }.items():
        (place / name).mkdir()
        for part in parts:
            source, goal = ROOT / part, place / name / Path(part).name
            if source.is_dir():
                shutil.copytree(source, goal, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
            else:
                shutil.copy(source, goal)
        build = (
            "-m",
            "pip",
            "wheel",
            "-q",
            "--no-deps",
            "--no-index",
            "--no-build-isolation",
            "-w",
            place,
            place / name,
        )
        run(sys.executable, *build, cwd=place)
    return sorted(place.glob("*.whl"))


@pytest.fixture(scope="module")
def shell(wheels, tmp_path_factory):
    """The command `lampopt` of a fresh environment with the wheels; what they depend on is lent by this one."""
    place = tmp_path_factory.mktemp("fresh")
    venv.create(place, with_pip=False, symlinks=True)
    python = place / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python)
    run(*pip, "install", "-q", "--no-deps", "--no-index", *wheels, cwd=place)
    # Behind the fresh packages, and without this environment's own .pth files: those lead to the checkout.
    own = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=place).strip())
    (own / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return place / "bin" / "lampopt"


def test_wheel_holds_what_it_should(wheels):
    ours = next(wheel for wheel in wheels if wheel.name.startswith("lampopt-"))
    with zipfile.ZipFile(ours) as archive:
        names = archive.namelist()
    packages = {name.split("/")[0] for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert packages == {"lampopt", *(path.name for path in (ROOT / "plugins").iterdir() if path.is_dir())}
    for path in (ROOT / "lampopt").rglob("*.py"):
        assert path.relative_to(ROOT).as_posix() in names
    assert "lampopt/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_it_is_the_wheel_that_runs(shell, tmp_path):
    code = (
        "import lampopt, lampopt_kkt, lampopt_gridsdf as g; print(lampopt.__file__, lampopt_kkt.__file__, g.__file__)"
    )
    found = run(shell.with_name("python"), "-c", code, cwd=tmp_path).split()
    assert len(found) == 3
    assert all(Path(path).is_relative_to(shell.parent.parent) for path in found)


def test_plugin_passes_its_checks(shell, tmp_path):
    said = json.loads(run(shell, "check-plugin", "lampopt-gridsdf", "--json", cwd=tmp_path))
    assert "check_decode_gives_a_closed_mesh" in json.dumps(said)


def test_plate_through_the_shell(shell, tmp_path):
    build = ("--source", "plate", "--decoder", "gridsdf", "--decoder-set", "size=33", "--out", "plates.lamp")
    run(shell, "bank", "build", *build, cwd=tmp_path)
    ask = ("--target", "length=2.6", "--limit", "drift=0.3", "--out", "plate.stl", "--json")
    said = json.loads(run(shell, "make", "plates.lamp", *ask, cwd=tmp_path))
    assert said["accepted"] is True
    assert (tmp_path / "plate.stl").stat().st_size > 10_000
