"""What a search evaluates is kept, so that one that was stopped goes on where it was."""

import sys
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Maximise, Reduce, Spec, Study
from lampopt.errors import SweepError
from lampopt.evaluations import FILE, Memory, evaluations
from lampopt.reporting.searched import searched

sys.path.insert(0, str(Path(__file__).parent))
import small
import toys
from test_wishes import PLUGINS

ASKED = {"targets": {"volume": 3.0}, "ranges": {"width": (1.0, 1.25)}, "measures": {"own": toys.Volume()}}


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    return small.bank(decoder="pulled", plugins=PLUGINS, store=tmp_path_factory.mktemp("bank") / "a.lamp")


def run(bank, folder, report=False, **asked):
    return lampopt.run(Study(bank, **{**ASKED, "solver": "casadi", **asked}), folder, report=report, plugins=PLUGINS)


def test_an_evaluation_is_kept_before_anybody_is_told_of_it(tmp_path):
    def stop(message):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Memory.at(tmp_path, "a", stop).tell("volume", np.ones(3), 3.5, None)
    assert Memory.at(tmp_path, "a").known("volume")[np.ones(3).tobytes()] == (3.5, None)


def test_what_is_told_is_known_again(tmp_path):
    memory = Memory.at(tmp_path, "a")
    alpha = np.array([0.1, 0.2, 0.7])
    memory.tell("volume", alpha, 3.5, alpha * 2)
    memory.tell("mass", alpha, float("nan"), None)
    Memory.at(tmp_path, "b").tell("volume", alpha, 9.0, None)
    again = Memory.at(tmp_path, "a")
    value, gradient = again.known("volume")[alpha.tobytes()]
    assert (value, gradient.tolist()) == (3.5, [0.2, 0.4, 1.4])
    assert np.isnan(again.known("mass")[alpha.tobytes()][0])
    assert [one.design for one in evaluations(tmp_path)] == ["a", "a", "b"]


@pytest.mark.parametrize(
    "odd", [b"{}", b"[1, 2]", b"null", b"[" * 5000, b'["a","v","zz",1,null,1]', b"\xff\xfe", b'["a","v","00",1,null,1]']
)
def test_lines_that_are_none_are_left_out(tmp_path, odd):
    memory = Memory.at(tmp_path, "a")
    memory.tell("volume", np.ones(2), 1.0, None)
    with (tmp_path / FILE).open("ab") as file:
        file.write(odd)  # a kill cut it short: no newline
    memory.tell("volume", np.zeros(2), 2.0, None)
    assert [one.value for one in evaluations(tmp_path)] == [1.0, 2.0]


def test_a_search_that_was_stopped_goes_on(bank, tmp_path, monkeypatch):
    whole = run(bank, tmp_path / "whole")
    decoded = len({one.alpha.tobytes() for one in evaluations(tmp_path / "whole")})
    assert decoded > 4
    real, count = toys.Volume.__call__, [0]

    def stopped(self, mesh):
        count[0] += 1
        if count[0] == 4:
            raise KeyboardInterrupt
        return real(self, mesh)

    monkeypatch.setattr(toys.Volume, "__call__", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(bank, tmp_path / "cut")
    before = [one.alpha.tobytes() for one in evaluations(tmp_path / "cut")]
    assert 0 < len(before) < decoded
    again = run(bank, tmp_path / "cut")
    after = [one.alpha.tobytes() for one in evaluations(tmp_path / "cut")]
    assert again.design.mix.alpha.tolist() == whole.design.mix.alpha.tolist()
    assert after[: len(before)] == before
    assert len(after) == len(set(after)) == decoded  # nothing twice


@pytest.mark.parametrize("solver", ["casadi", "nlopt"])
def test_a_full_disk_is_told_as_that(bank, tmp_path, monkeypatch, solver):
    """Not as a fault of the solver, through which the search notes what it evaluates."""
    real = Path.open

    def full(self, mode="r", *more, **named):
        if self.name == FILE and "a" in mode:
            raise OSError(28, "No space left on device")
        return real(self, mode, *more, **named)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(SweepError, match=rf"{FILE}: cannot be written: .*No space left"):
        run(bank, tmp_path, solver=solver)


def test_the_report_shows_how_it_converged(bank, tmp_path):
    run(bank, tmp_path, report=True)
    search = searched(tmp_path, Study(bank, **ASKED), bank, PLUGINS)
    found = search.steps
    assert (search.label, search.unit) == ("|own.volume − asked|", "m^3")
    assert [one.number for one in found] == [*range(1, len(found) + 1)]
    assert found[-1].value < 1e-3 < found[0].value
    assert all(one.seconds >= 0 for one in found)
    assert 'id="convergence"' in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_what_is_maximised_is_sought_from_above(bank, tmp_path):
    noted(tmp_path, bank, 1.5)
    study = Study(bank, objective=Maximise("volume"), ranges={"own.volume": (2.0, 8.0)}, measures=ASKED["measures"])
    search = searched(tmp_path, study, bank, PLUGINS)
    (step,) = search.steps
    assert (search.label, search.unit, step.value, step.violation) == ("−volume", "m^3", -1.5, 0.5)
    assert not step.feasible


def noted(folder, bank, *values):
    """A search that measured the volume at each exemplar in turn."""
    memory = Memory.at(folder, "a")
    for alpha, value in zip(np.eye(len(bank)), values, strict=False):
        memory.tell("own.volume", alpha, value, None)


@pytest.mark.parametrize("ends", [(2.0, 3.0), ("2 m^3", "3 m^3"), (2.0, "3000 dm^3")])
def test_whatever_unit_a_range_is_given_in_it_tells_what_is_feasible(bank, tmp_path, ends):
    noted(tmp_path, bank, 5.0, 2.5, 1.5)
    study = Study(bank, ranges={"volume": ends}, measures={"own": toys.Volume()}, objective=Maximise("width"))
    found = searched(tmp_path, study, bank, PLUGINS)
    assert [one.violation for one in found.steps] == pytest.approx([2.0, 0.0, 0.5])
    assert [one.value for one in found.steps] == pytest.approx((-bank.parameters[:3, 1]).tolist())  # the mix tells it
    assert (found.label, found.unit) == ("−width", "m")


def test_a_hard_target_has_to_be_met(bank, tmp_path):
    noted(tmp_path, bank, 5.0, 3.00001)
    for wanted in (3.0, "3 m^3"):
        study = Study(bank, targets={"volume": wanted}, hard=("volume",), measures={"own": toys.Volume()})
        found = searched(tmp_path, study, bank, PLUGINS)
        assert [one.feasible for one in found.steps] == [False, True]
        assert [one.value for one in found.steps] == pytest.approx([2.0, 0.00001])


def test_where_some_exemplars_take_no_part_the_report_tells_what_was_measured(bank, tmp_path):
    study = Study(
        bank, {"drag": 0.33}, ranges={"volume": (2.0, 2.6)}, measures=ASKED["measures"], objective=Maximise("width"),
        solver=Spec("nlopt", evaluations=20),
    )  # fmt: skip
    lampopt.run(study, tmp_path, report=True, plugins=PLUGINS)
    found = searched(tmp_path, study, bank, PLUGINS)
    assert found.steps and found.label == "own.volume"
    assert (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    "asked", [{"objective": Reduce("own.volume", by=0.1)}, {"keep": ("own.volume",)}, {"sweep": {"own.volume": [2.9]}}]
)
def test_whatever_way_a_measured_value_is_asked_for_the_report_shows_how_far_off_it_is(bank, tmp_path, asked):
    noted(tmp_path, bank, 2.5, 3.0)
    study = Study(bank, measures={"own": toys.Volume()}, reference="box_3", **asked)
    found = searched(tmp_path, study, bank, PLUGINS, {"own.volume": 2.9})
    assert found.label == "|own.volume − asked|"
    assert [one.value for one in found.steps] == pytest.approx([0.4, 0.1])
