"""The benchmarks: what they compare with is right, what they promise is there."""

import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt

HERE = Path(__file__).resolve().parent
sys.path[:0] = [p for p in (str(HERE.parent),) if p not in sys.path]
common, document, grid, plate, body, fidelity, measures, sections, warp = (
    importlib.import_module(f"benchmarks.{name}")
    for name in ("common", "document", "grid", "plate", "body", "fidelity", "measures", "sections", "warp")
)
PITCH = 0.05


@pytest.fixture(scope="module")
def plates():
    return lampopt.exemplars("plate")


@pytest.fixture(scope="module")
def mix(plates, tmp_path_factory):
    boxes = [m.bounds for m in plates.meshes] + [[[-2.0, -1, -0.2], [2, 1, 0.2]]]
    lattice = grid.Grid.around(boxes, PITCH, 0.15)
    return grid.GridMix.of(plates, lattice, tmp_path_factory.mktemp("grid"), "plate", lambda *_: None)


def test_one_hot_alpha_gives_the_exemplar(mix, plates):
    for i in (0, 2, 8):
        mesh = mix.mesh(np.eye(len(plates))[i])
        assert mesh.is_watertight
        assert mesh.volume > 0
        found = np.array(list(lampopt.measure("plate", mesh).values()))
        assert np.abs(found - plates.parameters[i]).max() < PITCH / 5


def test_distances_mix_to_the_closed_form(mix, plates):
    """Within the plate, far from its rim, the distance is |z| − thickness / 2: linear, so mixing is exact there."""
    low, high = plates.names.index("thickness_low"), plates.names.index("thickness_high")
    alpha = np.zeros(len(plates))
    alpha[[low, high]] = 1.4, -0.4
    thickness = float(alpha @ plates.parameters[:, 2])
    points = mix.grid.nodes(0, mix.grid.size)
    far = (np.abs(points[:, 0] - 0.75) < 0.15) & (np.abs(points[:, 1]) < 0.15) & (np.abs(points[:, 2]) < 0.2)
    assert far.sum() > 50
    truth = np.abs(points[far, 2]) - thickness / 2
    assert np.abs(alpha @ mix.distances[:, far] - truth).max() < 1e-6


def test_no_surface_is_none_and_a_cut_one_is_closed(mix):
    assert mix.grid.mesh(np.ones(mix.grid.size)) is None
    assert mix.grid.mesh(-np.ones(mix.grid.size)).is_watertight


def test_interrupted_distances_go_on(mix, plates, tmp_path):
    small = lampopt.Exemplars(plates.parameters[:2], plates.space, plates.meshes[:2], plates.names[:2])
    lattice = grid.Grid(mix.grid.origin, 0.2, np.ceil(mix.grid.count * PITCH / 0.2).astype(int))
    whole = grid.GridMix.of(small, lattice, tmp_path / ".", "whole", lambda *_: None)
    partial = tmp_path / f"{whole.name.replace('whole', 'part')}.partial.npy"
    rows = np.array(whole.distances)
    rows[1] = np.nan
    np.save(partial, rows)
    again = grid.GridMix.of(small, lattice, tmp_path, "part", lambda *_: None)
    np.testing.assert_array_equal(again.distances, whole.distances)
    assert not partial.exists()


def test_sweeps_are_those_of_the_issue(plates):
    space = tuple(lampopt.Parameter(q.name, q.unit, -1.0, 1.0) for q in plates.space)
    sweeps = plate.Sweeps.of(space, 20)
    assert sweeps.asked.shape == (120, 6)
    assert ((sweeps.asked != 0).sum(1) == 1).all()
    assert (sweeps.asked.min(), sweeps.asked.max()) == (-3, 3)
    assert sweeps.within(1).sum() == 6 * 6
    assert sweeps.r2(sweeps.asked, 0, 3) == 1
    assert sweeps.r2(np.zeros((120, 6)), 0, 3) == pytest.approx(0)


def test_verdicts_count_the_unmeasured_as_off(plates):
    space = tuple(lampopt.Parameter(q.name, q.unit, -1.0, 1.0) for q in plates.space)
    sweeps = plate.Sweeps.of(space, 4)
    found = sweeps.asked.copy()
    good = {"accepted": True, "failed": [], "measured": {}}
    rows = [dict(good) for _ in found]
    rows[0] |= {"measured": None}  # off, yet accepted
    rows[1] |= {"accepted": False, "failed": ["drift.width"]}  # good, yet rejected
    rows[2] |= {"accepted": False, "failed": ["drift.length", "genus"]}
    found[2, 0] += 0.2
    off, blind, accepted, wrongly = plate.verdicts(rows, found, sweeps)
    assert (off["value"], off["of"], off["met"]) == (0.5, 2, False)
    assert (blind["value"], blind["by"]) == (0.5, {"genus": 1})
    assert accepted["value"] == pytest.approx(22 / 24)
    assert (wrongly["value"], wrongly["of"]) == (pytest.approx(1 / 22), 22)


def test_kept_rows_survive_a_kill(tmp_path):
    path = tmp_path / "scores.jsonl"
    assert common.Scores(path).get("a", lambda: {"x": 1.0}) == {"x": 1.0}
    path.write_text(path.read_text() + '{"key": "cut', encoding="utf-8")
    kept = common.Scores(path)
    assert kept.get("a", lambda: pytest.fail("made again")) == {"x": 1.0}
    kept.get("b", lambda: {"x": 2.0})
    assert set(common.Scores(path).rows) == set(kept.rows)


def test_rows_are_kept_until_what_they_depend_on_alters(tmp_path, monkeypatch):
    """By comments and by other modules it does not alter; by a module imported within a function it does."""
    package = tmp_path / "measured_package"
    package.mkdir()
    text = {"__init__": "", "used": "LIMIT = 1\n", "other": "LIMIT = 2\n"}
    text["first"] = "def f():\n    from .used import LIMIT\n\n    return LIMIT\n"
    for name, code in text.items():
        (package / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    first = importlib.import_module("measured_package.first")
    before = common.source(first)
    (package / "first.py").write_text('"""What it is."""\n' + text["first"].replace("LIMIT\n\n", "LIMIT  # why\n"))
    (package / "other.py").write_text("LIMIT = 3\n")
    assert common.source(first) == before
    (package / "used.py").write_text("LIMIT = 3\n")
    assert common.source(first) != before


def test_a_straight_line_is_taken_out_of_what_is_measured():
    """Left out one by one: the same as a fit without each, by numpy's own."""
    rng = np.random.default_rng(0)
    true = rng.uniform(1, 2, 30)
    assert measures.calibrated(true, 3 + 0.5 * true) == pytest.approx(1)
    values = 0.9 * true + 0.1 * rng.normal(size=30)
    left_out = []
    for i in range(30):
        rest = np.arange(30) != i
        left_out.append(np.polyval(np.polyfit(values[rest], true[rest], 1), values[i]))
    wanted = 1 - ((true - left_out) ** 2).sum() / ((true - true.mean()) ** 2).sum()
    assert measures.calibrated(true, values) == pytest.approx(wanted)


def test_targets_are_judged():
    assert common.line("x", 0.5, target=">= 0.4")["met"] is True
    assert common.line("x", 0.5, grid=0.4, target="<= grid")["met"] is False
    assert common.line("x", float("nan"), grid=0.4, target=">= grid")["met"] is False
    assert common.line("x", 0.5)["met"] is None


def test_without_the_judge_bodies_are_left_out(tmp_path):
    assert body.find_judge(str(tmp_path)) is None


def test_the_plate_table_end_to_end(tmp_path, capsys):
    """The example decoder mixes distances too: on the grid's own nodes it and the grid mix must agree."""
    given = ["--quick", "--table", "plate", "--decoder", "gridsdf", "--decoder-set", "size=33", "--resolution", "32"]
    given += ["--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "out"), "--json"]
    assert fidelity.main(given) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "out" / "fidelity-plate-gridsdf-quick.json").read_text(encoding="utf-8"))
    rows = document["tables"]["plate"]["rows"]
    assert all({"name", "value", "grid", "target", "met"} <= set(row) for row in rows)
    assert len(rows) == 2 * 6 + 4
    for row in rows[:12]:
        assert row["value"] == pytest.approx(row["grid"], abs=0.05), row["name"]
    assert len(document["tables"]["plate"]["designs"]) == 36
    assert fidelity.main(given) == 0  # from what was kept
    assert json.loads(capsys.readouterr().out)["tables"] == document["tables"]


def test_wrong_options_are_said_and_exit_2(tmp_path, capsys):
    assert fidelity.main(["--decoder", "no-such", "--table", "plate", "--quick", "--cache", str(tmp_path)]) == 2
    assert "no-such" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["steps", "=3", ""])
def test_an_option_without_a_value_is_said_and_exits_2(text, capsys):
    with pytest.raises(SystemExit) as caught:
        fidelity.main(["--decoder-set", text])
    assert caught.value.code == 2
    assert f"--decoder-set: expected NAME=VALUE, got {text!r}" in capsys.readouterr().err


def test_options_of_the_decoder_are_read():
    given = ["--decoder-set", "steps=40", "--decoder-set", "rate=1e-3", "--decoder-set", "kind=a=b"]
    assert dict(fidelity.arguments(given).decoder_set) == {"steps": 40, "rate": 1e-3, "kind": "a=b"}


def test_documents_name_no_folder_of_the_machine():
    said = "no room in /home/me/flows, its log is /tmp/x-1/case/log.solver; docs at https://example.org/a/b, 3 m/s"
    wanted = "no room in …/flows, its log is …/log.solver; docs at https://example.org/a/b, 3 m/s"
    assert document.plain({"a": [said]}) == {"a": [wanted]}
    for path in (HERE.parent / "benchmarks" / "results").glob("*.json"):
        found = json.loads(path.read_text(encoding="utf-8"))
        assert found == document.plain(found), path.name


def test_the_page_that_it_names_exists():
    (page,) = re.findall(r"docs/\S+\.md", fidelity.__doc__)
    assert (HERE.parent / page).exists()


def test_sections_read_a_block_and_a_wedge():
    """A block of 4 × 2 × 1 m, and one whose roof falls by 0.1 m a metre."""
    block = trimesh.creation.box([4.0, 2.0, 1.0]).subdivide()
    read = sections.readings(block)
    assert read == pytest.approx([4, 2, 2, 1, 1, 0, 0, 0, 0, 0], abs=1e-6)
    wedge = block.copy()
    up = wedge.vertices[:, 2] > 0
    wedge.vertices[up, 2] -= 0.1 * (wedge.vertices[up, 0] + 2)
    read = sections.readings(wedge)
    assert read[8:] == pytest.approx(np.degrees(np.arctan([-0.1, -0.1])), abs=1e-4)
    assert read[6:8] == pytest.approx([0, 0], abs=1e-6)
    roofed = block.copy()  # its upper half leans in by 0.3 m a side: 0.6 m a metre of height
    roofed.vertices[up, 1] -= 0.3 * np.sign(roofed.vertices[up, 1])
    assert sections.readings(roofed)[5] == pytest.approx(np.degrees(np.arctan(0.6)), abs=1e-4)


@pytest.mark.parametrize(("name", "package"), [("warp", "tetgen"), ("registration", "pycpd")])
def test_a_package_that_is_absent_is_said_before_anything_is_fitted(name, package, monkeypatch, tmp_path, capsys):
    (tmp_path / "judge.py").write_text("from pathlib import Path\nDATA = Path(__file__).parent\n", encoding="utf-8")
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, "judge", None)  # the one above does not stay there
    given = ["--judge", str(tmp_path)] + (["--cache", str(tmp_path / "cache")] if name == "warp" else [])
    assert importlib.import_module(f"benchmarks.{name}").main(given) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said == f"error {package} is not installed: pip install -c constraints.txt -e '.[bench]'"


@pytest.mark.parametrize("name", ["warp", "registration", "sweeps", "optimizers"])
def test_without_the_judge_it_says_so(name, tmp_path, capsys):
    assert importlib.import_module(f"benchmarks.{name}").main(["--judge", str(tmp_path)]) == 2
    assert "--judge FOLDER" in capsys.readouterr().err


def test_volumes_of_cells_have_a_sign():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    assert warp.volumes(corners, np.array([[0, 1, 2, 3], [1, 0, 2, 3]])) == pytest.approx([1.0, -1.0])


def test_a_reading_is_calibrated_on_exemplars():
    """Parameters that are other units and offsets of what is read come back; what is cut off cannot be read."""
    sizes = np.random.default_rng(0).uniform([3, 1.5, 0.8], [5, 2.5, 1.4], (14, 3))
    blocks = [trimesh.creation.box(size).subdivide() for size in sizes]
    parameters = np.zeros((14, 8))
    parameters[:, 0], parameters[:, 1], parameters[:, 2] = 1000 * sizes[:, 0] - 7, sizes[:, 1] / 2, sizes[:, 2] + 3
    reading = sections.Reading.of(blocks, parameters)
    asked = trimesh.creation.box([6.0, 3.0, 0.7]).subdivide()
    assert reading(asked)[:3] == pytest.approx([5993, 1.5, 3.7], rel=1e-5)
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert np.isnan(reading(flat)).all()


def test_answers_of_the_solvers_benchmark_are_right_and_found(tmp_path, capsys):
    """Two independent answers to one problem agree; a quick run of kkt meets all that is wanted."""
    answers = importlib.import_module("benchmarks.solver_answers")
    problems = importlib.import_module("benchmarks.solver_problems")
    p, answer, _ = problems.some_hard(0, 12)
    assert answers.convex(p) == pytest.approx(answer, abs=1e-6)
    p, answer, _ = problems.still(1, 12)
    assert p.still @ answer == pytest.approx(p.still @ p.centre)
    assert p.matrix @ answer == pytest.approx(p.target)
    p, answer, _ = problems.exponential(0, 12)
    gradient = 2 * p.ridge * (answer - p.centre) + p.objectives[0](answer)[1]
    assert gradient == pytest.approx(np.full(12, gradient.mean()), abs=1e-9)
    out = tmp_path / "solvers.json"
    run = importlib.import_module("benchmarks.solvers").main
    assert run(["--sizes", "12", "--seeds", "1", "--only", "kkt", "--out", str(out)]) == 0
    document = json.loads(out.read_text(encoding="utf-8"))
    assert json.loads(capsys.readouterr().out) == document
    rows = {row["name"]: row for row in document["tables"]["kkt"]["rows"]}
    assert rows["still rows, N = 12"]["value"] < 1e-9
    assert rows["culprit named, targets alone"]["value"] == 1
    assert not any("bounds" in name for name in rows)


def test_the_speed_benchmark_end_to_end(tmp_path, capsys):
    """Its answers agree with the rivals'; speed itself is not asserted."""
    run = importlib.import_module("benchmarks.speed").main
    races = ["--race", "mismatch", "--race", "mix", "--race", "memory", "--race", "import"]
    given = ["--quick", "--pairs", "1", "--threads", "1", "--json", *races, "--cache", str(tmp_path)]
    assert run(given) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert all({"name", "ratio", "target", "met"} <= set(row) for row in rows.values())
    for name in ("both mismatches apart", "both mixes apart", "torch imported by `lampopt plugins`"):
        assert rows[name]["met"], name


def test_rivals_are_what_they_are_called():
    rivals, speed = (importlib.import_module(f"benchmarks.{name}") for name in ("rivals", "speed"))
    torch = importlib.import_module("torch")
    rng = np.random.default_rng(0)
    first, second = rivals.siren(2, 8, 2, 0), rivals.siren(2, 8, 2, 0)
    assert all(torch.equal(a, b) and len(a) == 2 for a, b in zip(first, second, strict=True))
    hidden = rng.uniform(-1, 1, (5, 3)).astype("f4")
    values = rivals.forward(first, torch.as_tensor(hidden).expand(2, 5, 3))
    for k in range(0, 6, 2):
        hidden = hidden @ first[k][0].detach().numpy() + first[k + 1][0].detach().numpy()
        hidden = np.sin(30 * hidden) if k < 4 else hidden
    assert values[0].detach().numpy() == pytest.approx(hidden[:, 0], abs=1e-4)
    distances = torch.linspace(-0.09, 0.09, 7)
    logits = torch.logit((distances + 0.1) / 0.2)
    assert rivals.distances(logits).numpy() == pytest.approx(distances.numpy(), abs=1e-6)
    labels = (distances + 0.1) / 0.2
    least = -(labels * labels.log() + (1 - labels) * (1 - labels).log()).mean()  # the entropy, which no loss is below
    assert float(rivals.of_labels(logits, distances)) == pytest.approx(float(least), rel=1e-4)
    points = torch.as_tensor(rng.uniform(-1, 1, (1, 4000, 3)).astype("f4"))
    surface = points[:, :500] / points[:, :500].norm(dim=-1, keepdim=True) / 2
    samples = points, points.norm(dim=-1) - 0.5, surface
    found = rivals.fitted(
        rivals.siren(1, 64, 2, 0), samples, rivals.of_distances, lambda f: f, points=512, error=0.06, most=3000
    )
    assert found.error <= 0.06 and 10 <= found.steps < 3000 and found.step_s > 0
    one, other = trimesh.creation.box([1, 1, 1]), trimesh.creation.box([1, 1, 1.2])
    assert speed.apart(one, other) == pytest.approx(0.1)
