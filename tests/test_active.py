"""Active learning: a dear measure brought to its target with few evaluations, every one of them told."""

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import Maximise, Reduce, Study, cli
from lampopt.active import FARTHEST, spread_out
from lampopt.errors import InputError, MeasureError, SolveError, StudyError
from lampopt.plugins import Plugins

sys.path.insert(0, str(Path(__file__).parent))
import small
from test_closing import PLUGINS, Offer


@dataclass(frozen=True)
class Tunnel:
    """Curved in the volume; counts how often it is asked for a mesh that it has not seen."""

    longest: float = 9.0
    seen: list = field(default_factory=list, compare=False)
    names, units = ("drag",), ("",)

    def __call__(self, mesh):
        self.seen.append(round(float(mesh.volume), 9))
        if mesh.extents[0] > self.longest:
            raise MeasureError("too long for the tunnel")
        return np.array([0.1 * mesh.volume**1.5])


@pytest.fixture(scope="module")
def bank():
    return small.bank(decoder="blunt", plugins=PLUGINS)


def study(bank, tunnel, **more):
    asked = {"reference": "box_3", "keep": ("width",), "objective": Reduce("flow.drag", by=0.2), **more}
    return Study(bank, measures={"flow": tunnel}, **asked)


def test_the_target_is_met_and_every_evaluation_is_told(bank):
    tunnel = Tunnel()
    found = lampopt.active(study(bank, tunnel), plugins=PLUGINS, tolerance=1e-4)
    assert found.met
    assert found.evaluations == len(set(tunnel.seen)) <= 10
    start = found.trials[0]
    assert start.name == "box_3"
    assert found.wanted == pytest.approx(0.8 * start.value)
    mesh = found.result.design.mesh
    assert 0.1 * mesh.volume**1.5 == pytest.approx(found.value) == pytest.approx(found.wanted, rel=1e-3)
    width = found.result.design.predicted[1]
    assert width == pytest.approx(bank.parameters[3, 1])
    assert next(t.name for t in found.trials if np.isfinite(t.predicted)) == "design 1"


def test_what_it_learns_makes_its_predictions_better(bank):
    trials = lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, tolerance=1e-9, budget=9).trials
    off = [abs(t.predicted - t.value) for t in trials if np.isfinite(t.predicted)]
    assert off[-1] < off[0] / 100


def test_limits_of_what_it_corrects_itself_do_not_stand_in_its_way(bank):
    asked = study(bank, Tunnel(), measured={"flow.drag": "flow.drag"}, limits={"measured.flow.drag": 0.3})
    assert lampopt.active(asked, plugins=PLUGINS, tolerance=1e-3).met


def test_a_budget_that_is_spent_gives_the_best_of_all(bank):
    found = lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, tolerance=0.0, budget=5, first=3)
    assert (found.met, found.evaluations) == (False, 5)
    off = [abs(t.value - found.wanted) for t in found.trials if np.isfinite(t.predicted)]
    assert abs(found.value - found.wanted) == min(off)


def test_designs_that_cannot_be_measured_are_told_and_gone_around(bank):
    asked = study(bank, Tunnel(longest=2.62), objective=Reduce("flow.drag", by=-0.05), reference="box_6")
    found = lampopt.active(asked, plugins=PLUGINS, budget=12)
    assert np.isnan([t.value for t in found.trials]).any()
    assert found.met


@dataclass(frozen=True)
class Kept(Tunnel):
    """Keeps what it has said of a mesh."""

    folder: str = ""

    def kept_in(self, folder):
        return replace(self, folder=str(folder))

    def __call__(self, mesh):
        file = Path(self.folder) / f"{mesh.volume:.12g}"
        if file.exists():
            return np.array([float(file.read_text())])
        value = super().__call__(mesh)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(repr(float(value[0])))
        return value


def test_a_pursuit_that_was_stopped_goes_on(bank, tmp_path):
    whole = Kept()
    alone = lampopt.active(study(bank, whole), plugins=PLUGINS, folder=tmp_path / "one")
    assert len(whole.seen) == alone.evaluations  # none twice

    class StoppedError(Exception):
        pass

    def stop(done, message=""):
        if message == "design 2":
            raise StoppedError

    before, after = Kept(), Kept()
    with pytest.raises(StoppedError):
        lampopt.active(study(bank, before), plugins=PLUGINS, folder=tmp_path / "two", progress=stop)
    again = lampopt.active(study(bank, after), plugins=PLUGINS, folder=tmp_path / "two")
    np.testing.assert_array_equal(again.result.design.mix.alpha, alone.result.design.mix.alpha)
    assert len(before.seen) + len(after.seen) == alone.evaluations


def test_one_proposal_goes_no_farther_than_a_part_of_the_reference(bank):
    found = lampopt.active(study(bank, Tunnel(), objective=Reduce("flow.drag", by=0.5)), plugins=PLUGINS, budget=4)
    start, *_, proposed = found.trials
    assert proposed.predicted == pytest.approx((1 - FARTHEST) * start.value)


def test_a_rejected_design_does_not_meet_the_target(bank):
    asked = study(bank, Tunnel(), limits={"alpha": 0.1})
    found = lampopt.active(asked, plugins=PLUGINS, tolerance=0.05)
    assert abs(found.value - found.wanted) < 0.05 * found.trials[0].value
    assert not found.met
    assert not found.result.accepted


def test_a_design_that_stays_rejected_does_not_take_the_whole_budget(bank, caplog):
    tunnel = Tunnel()
    found = lampopt.active(study(bank, tunnel, limits={"alpha": 0.1}), plugins=PLUGINS, budget=16)
    assert abs(found.value - found.wanted) < 0.005 * found.trials[0].value
    assert (found.met, found.evaluations) == (False, len(set(tunnel.seen)))
    assert found.evaluations <= 8
    assert "nothing else is proposed than a design that is on target and was rejected" in caplog.text


def test_an_installed_measure_can_be_sought(bank):
    plugins = Plugins.load([("small", small.Plugin()), ("offer", Offer()), ("wind", Wind())])
    found = lampopt.active(study(bank, Tunnel(), objective=Reduce("tunnel.drag", by=0.2)), plugins=plugins)
    assert found.met and found.value == pytest.approx(found.wanted, rel=0.01)


def test_the_sought_value_can_have_a_weight_and_be_hard(bank):
    for more in ({"weights": {"flow.drag": 2.0}}, {"hard": ("flow.drag",)}):
        assert lampopt.active(study(bank, Tunnel(), **more), plugins=PLUGINS).met


def test_what_may_pass_is_told_as_such(bank):
    @dataclass(frozen=True)
    class Killed(Tunnel):
        def __call__(self, mesh):
            if len(self.seen) == 3:
                error = MeasureError("killed")
                error.passing = True
                raise error
            return super().__call__(mesh)

    with pytest.raises(MeasureError, match=r"flow\S*: .*killed; with a folder the same call goes on") as caught:
        lampopt.active(study(bank, Killed()), plugins=PLUGINS)
    assert caught.value.passing


def test_a_folder_keeps_one_bank_and_the_best_design(bank, tmp_path):
    asked = study(bank, Tunnel(), limits={"alpha": 0.5})
    found = lampopt.active(asked, plugins=PLUGINS, tolerance=1e-9, budget=9, folder=tmp_path)
    assert len([*tmp_path.glob("bank-*.lamp")]) == 1
    (kept,) = lampopt.results(tmp_path, plugins=PLUGINS)
    np.testing.assert_array_equal(kept.design.mix.alpha, found.result.design.mix.alpha)
    designs = found.evaluations - sum(np.isnan(t.predicted) for t in found.trials)
    assert len([*lampopt.results(tmp_path, every=True, plugins=PLUGINS)]) == designs > 2


def test_other_values_of_the_measure_can_be_asked(bank):
    @dataclass(frozen=True)
    class Two(Tunnel):
        names, units = ("drag", "volume"), ("", "L^3")

        def __call__(self, mesh):
            return np.append(super().__call__(mesh), mesh.volume)

    asked = study(bank, Two(), ranges={"flow.volume": (0, 9)})
    asked = replace(asked, solver="nlopt")
    plugins = Plugins.load([("small", small.Plugin()), ("offer", Offer())])
    assert lampopt.active(asked, plugins=plugins).met


class Girth:
    """Tells width, and some of the length with it."""

    names, units = ("girth",), ("L",)

    def __call__(self, mesh):
        return np.array([mesh.extents[1] + 0.2 * mesh.extents[0] ** 2])


def test_what_is_held_is_held_as_it_is_measured_before_the_dear_value_is(bank):
    held, reference = [], lampopt.run(Study(bank, reference="box_3"), plugins=PLUGINS).design.mesh
    for turns in (0, 6):
        tunnel = Tunnel()
        asked = replace(
            study(bank, tunnel, measured={"width": "girth.girth"}, turns=turns, limits={"measured.width": 5.0}),
            measures={"flow": tunnel, "girth": Girth()},
        )
        found = lampopt.active(asked, plugins=PLUGINS, tolerance=1e-3)
        assert found.met
        assert found.evaluations == len(set(tunnel.seen)) <= 12
        held.append(abs(Girth()(found.result.design.mesh) - Girth()(reference))[0])
    assert held[1] < 1e-4 < 0.05 < held[0]


def test_rows_are_spread_out():
    rows = np.array([[0.0, 0], [0.1, 0], [1, 0], [1, 1], [0.9, 0.9]])
    assert spread_out(rows, 0, 3) == [0, 3, 2]


def test_what_cannot_be_pursued(bank):
    with pytest.raises(StudyError, match="expected an objective such as Reduce"):
        lampopt.active(study(bank, Tunnel(), objective=Maximise("flow.drag")), plugins=PLUGINS)
    with pytest.raises(StudyError, match="'drag' is not measured"):
        lampopt.active(study(bank, Tunnel(), objective=Reduce("drag", by=0.1)), plugins=PLUGINS)
    with pytest.raises(StudyError, match="no exemplar of this bank"):
        lampopt.active(study(bank, Tunnel(), reference="box_99"), plugins=PLUGINS)
    tunnel = Tunnel()
    with pytest.raises(StudyError, match="neither a parameter"):
        lampopt.active(study(bank, tunnel, keep=("widht",)), plugins=PLUGINS)
    cannot = [
        ({"alpha": (0, 1)}, SolveError, "not able to take bounds on alpha"),
        ({"ranges": {"length": (1, 9)}}, SolveError, "not able to take ranges"),
        ({"weights": {"length": 2.0}}, StudyError, r"weights: \['length'\] are not asked for"),
        ({"measured": {"length": "extents.length"}}, StudyError, r"measured: \['length'\] are not asked for"),
        ({"turns": 3}, StudyError, "turns: nothing that is asked can be measured"),
    ]
    for more, error, message in cannot:
        with pytest.raises(error, match=message):
            lampopt.active(study(bank, tunnel, **more), plugins=PLUGINS)
    assert not tunnel.seen  # told before anything is measured
    for wrong in ({"budget": "9"}, {"budget": 5.5}, {"first": 1}, {"tolerance": float("nan")}, {"folder": 3}):
        with pytest.raises(InputError):
            lampopt.active(study(bank, tunnel), plugins=PLUGINS, **wrong)
    with pytest.raises(StudyError, match="expected a Study"):
        lampopt.active(None)
    with pytest.raises(InputError, match="budget: expected more than the 3 exemplars measured first"):
        lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, budget=3)
    with pytest.raises(InputError, match="of the reference 'box_5' is nan"):
        lampopt.active(study(bank, Tunnel(longest=2.7), reference="box_5"), plugins=PLUGINS)


# from a shell


class Wind:
    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"tunnel": Tunnel}


@pytest.fixture
def study_file(tmp_path, monkeypatch):
    plugins = Plugins.load([("small", small.Plugin()), ("offer", Offer()), ("wind", Wind())])
    small.bank(decoder="blunt", plugins=plugins, store=tmp_path / "boxes.lamp")
    monkeypatch.setattr(Plugins, "load", lambda: plugins)
    file = tmp_path / "glide.toml"
    file.write_text(
        'bank = "boxes.lamp"\nreference = "box_3"\nkeep = ["width"]\nobjective = { reduce = "flow.drag", by = 0.2 }\n'
        '[measures]\nflow = { name = "tunnel" }\n'
    )
    return file


def test_the_command_line_tells_the_same(study_file, tmp_path, capsys):
    out = tmp_path / "design.stl"
    given = ["--budget", "10", "--first", "3", "--tolerance", "1e-4", "--out", str(out), "--json"]
    assert cli.main(["active", str(study_file), *given]) == 0
    told = json.loads(capsys.readouterr().out)
    seen = lampopt.active(Study.read(study_file), budget=10, first=3, tolerance=1e-4)
    assert (told["met"], told["wanted"], told["evaluations"]) == (True, seen.wanted, seen.evaluations)
    assert told["value"] == pytest.approx(seen.value)
    assert [t["name"] for t in told["trials"]] == [t.name for t in seen.trials]
    assert [t["value"] for t in told["trials"]] == pytest.approx([t.value for t in seen.trials])
    assert [t["predicted"] for t in told["trials"][:4]] == [None] * 3 + [pytest.approx(seen.trials[3].predicted)]
    assert list(told["trials"][0]["parameters"]) == ["length", "width"]
    assert told["design"]["accepted"] is True
    assert told["mesh"] == str(out)
    assert 0.1 * trimesh.load_mesh(out).volume ** 1.5 == pytest.approx(told["value"], rel=1e-5)
    assert told["folder"] == str(tmp_path / "runs" / "glide")
    assert len([*(tmp_path / "runs" / "glide" / "designs").iterdir()]) == told["evaluations"] - 3


def test_people_see_a_table_and_whether_it_is_met(study_file, tmp_path, capsys):
    assert cli.main(["active", str(study_file), "--folder", str(tmp_path / "run")]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    for words in ("against the reference", "design 1", "box_3", "+0.00%", "met by an accepted design", "recorded in"):
        assert words in err
    assert cli.main(["active", str(study_file), "--budget", "4", "--first", "3", "--tolerance", "0"]) == 1
    assert "NOT MET: " in capsys.readouterr().err


def test_the_command_line_refuses(study_file, tmp_path, capsys):
    def refused(*given):
        assert cli.main(["active", str(study_file), *given, "--json"]) == 2
        return json.loads(capsys.readouterr().out)["error"]["message"]

    assert "expected a file ending in" in refused("--out", str(tmp_path / "design.xyz"))
    assert "budget: expected more than the 3 exemplars" in refused("--budget", "3")
    assert "--first" in refused("--first", "1")
    assert "tolerance: expected a part" in refused("--tolerance", "2")
    study_file.write_text(study_file.read_text().replace('objective = { reduce = "flow.drag", by = 0.2 }', ""))
    assert "expected an objective such as Reduce" in refused()
    assert not (tmp_path / "runs").exists()
