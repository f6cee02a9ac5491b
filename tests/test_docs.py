"""The documentation says what is so: its programs run, its lists are whole."""

import ast
import dataclasses
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import lampopt
from lampopt.check import DEFAULTS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
QUICK = 'lampopt.Spec("gridsdf", size=25)'


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def programs(page, language="python"):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A bank such as the programs build, so that it is built once."""
    path = tmp_path_factory.mktemp("bank") / "plates.lamp"
    lampopt.build_bank(lampopt.exemplars("plate"), decoder=lampopt.Spec("gridsdf", size=25), store=path)
    return path


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        "docs/quickstart.md",
        "docs/exploring.md",
        "docs/fronts.md",
        "docs/wishes.md",
        "docs/writing-others.md",
    ],
)
def test_programs_run(page, bank, tmp_path):
    for name in ("plates.lamp", "plates-sdf.lamp"):
        shutil.copy(bank, tmp_path / name)
    found = programs(ROOT / page)
    assert found
    for program in found:
        program = program.replace('decoder="mesh-template"', f"decoder={QUICK}")
        command = [sys.executable, "-W", "error", "-c", program]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr


def test_readme_program_is_short():
    (program,) = programs(ROOT / "README.md")
    assert len([line for line in program.splitlines() if line.strip()]) <= 12


def test_readme_has_a_line_for_each_folder():
    tracked = {path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith(".")}
    known = set(re.findall(r"^    (\w+)/ ", text("README.md"), re.MULTILINE))
    assert known <= tracked
    assert {"lampopt", "plugins", "examples", "docs", "tests"} <= known


def test_study_example_has_every_entry_and_can_be_read():
    example, plan = programs(ROOT / "docs/files.md", "toml")  # a study has a sweep or a plan, not both
    fields = {field.name for field in dataclasses.fields(lampopt.Study)}
    assert set(tomllib.loads(example)) | set(tomllib.loads(plan)) == fields
    assert set(tomllib.loads(plan)["experiments"]) == {field.name for field in dataclasses.fields(lampopt.Experiments)}
    for written in (example, example.partition("[sweep]")[0] + plan):
        study = lampopt.Study.from_toml(written)
        assert lampopt.Study.from_toml(study.to_toml()).to_toml() == study.to_toml()


def test_every_limit_is_explained_with_its_default():
    safety = text("docs/safety.md")
    for name, limit in DEFAULTS.items():
        assert re.search(rf"^\| `{re.escape(name)}[.`].*\| {limit:g}(\.0)?( cells)? \|", safety, re.MULTILINE), name


def test_every_check_made_is_explained(bank):
    safety = text("docs/safety.md")
    for check in lampopt.design(bank, {"length": 2.6}, resolution=48).checks:
        assert f"`{re.sub(r'^drift.*', 'drift.NAME', check.name)}`" in safety


def test_every_stage_has_a_section():
    stages = ("exemplars", "bank", "solve", "mix", "decode", "check", "record", "study")
    sections = re.findall(r"^## (\w+)$", text("docs/loop.md"), re.MULTILINE)
    assert sections == list(stages)
    assert all((ROOT / "lampopt" / f"{stage}.py").exists() for stage in stages)


def test_every_public_name_is_documented():
    api = text("docs/api.md")
    records = set(lampopt.types.__all__)
    for name in set(lampopt.__all__) - records:
        assert re.search(rf":: {name}$", api, re.MULTILINE), name


def imported_from_lampopt(code):
    """(module, name) of every import from lampopt in `code`."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "lampopt":
            yield from ((node.module, alias.name) for alias in node.names)


def test_every_name_that_an_example_imports_is_documented():
    api = text("docs/api.md")
    codes = [path.read_text(encoding="utf-8") for path in (ROOT / "examples").rglob("*.py")]
    codes += [program for page in PAGES for program in programs(page)]
    found = {pair for code in codes for pair in imported_from_lampopt(code)}
    assert ("lampopt.record", "passport") in found
    for module, name in found:
        assert f"`{module}`" in api.split("## ")[0], f"{module} is not among the public modules"
        if f"automodule:: {module}\n" not in api:
            current = api.split(f"currentmodule:: {module}\n")[1].split("```")[0]
            assert re.search(rf":: {name}$", current, re.MULTILINE), f"{module}.{name}"


def test_contents_are_listed_page_by_page():
    index = text("docs/index.md")
    assert ":glob:" not in index
    listed = re.findall(r"^[\w-]+$", "".join(programs(ROOT / "docs/index.md", "{toctree}")), re.MULTILINE)
    assert sorted(listed) == sorted(path.stem for path in (ROOT / "docs").glob("*.md") if path.stem != "index")


def test_no_optional_ability_is_promised_that_nothing_uses():
    """What docs/writing-a-decoder.md says of DesignChecks, Pullback and Displace."""
    core = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "lampopt").glob("*.py"))
    page = " ".join(text("docs/writing-a-decoder.md").split())
    assert "isinstance(decoder, DesignChecks)" in core
    used = any(re.search(rf"isinstance\(\w+, {ability}\)", core) for ability in ("Pullback", "Displace"))
    assert used != ("nothing calls them yet" in page)


def test_letters_are_defined_once():
    letters = [re.findall(r"^\| ([NdpDkrMCB]) \|", page.read_text(encoding="utf-8"), re.MULTILINE) for page in PAGES]
    assert sorted(letter for found in letters for letter in found) == sorted("NdpDkrMCB")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_that_are_named_exist(page):
    for path in re.findall(r"`((?:lampopt|plugins|examples|tests|docs|benchmarks)/[\w./]+)`", page.read_text("utf-8")):
        assert (ROOT / path).exists(), path
