"""Active learning: a dear measure brought to its target with few evaluations, every one of them told."""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Maximise, Reduce, Study
from lampopt.active import spread_out
from lampopt.errors import InputError, MeasureError, StudyError

sys.path.insert(0, str(Path(__file__).parent))
import small
from test_closing import PLUGINS


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


def test_a_budget_that_is_spent_gives_the_best_of_all(bank):
    found = lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, tolerance=0.0, budget=5, first=3)
    assert (found.met, found.evaluations) == (False, 5)
    off = [abs(t.value - found.wanted) for t in found.trials if np.isfinite(t.predicted)]
    assert abs(found.value - found.wanted) == min(off)


def test_designs_that_cannot_be_measured_are_told_and_gone_around(bank):
    asked = study(bank, Tunnel(longest=2.62), objective=Reduce("flow.drag", by=-0.05), reference="box_6")
    found = lampopt.active(asked, plugins=PLUGINS, budget=12)
    assert found.met or np.isnan([t.value for t in found.trials]).any()
    assert np.isfinite(found.value)


def test_a_pursuit_that_was_stopped_goes_on(bank, tmp_path):
    whole = lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, folder=tmp_path / "one")
    tunnel = Tunnel()

    class StoppedError(Exception):
        pass

    def stop(done, message=""):
        if len(tunnel.seen) == 5:
            raise StoppedError

    with pytest.raises(StoppedError):
        lampopt.active(study(bank, tunnel), plugins=PLUGINS, folder=tmp_path / "two", progress=stop)
    again = lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, folder=tmp_path / "two")
    np.testing.assert_array_equal(again.result.design.mix.alpha, whole.result.design.mix.alpha)


def test_rows_are_spread_out():
    rows = np.array([[0.0, 0], [0.1, 0], [1, 0], [1, 1], [0.9, 0.9]])
    assert spread_out(rows, 0, 3) == [0, 3, 2]


def test_what_cannot_be_pursued(bank):
    with pytest.raises(StudyError, match="expected an objective such as Reduce"):
        lampopt.active(study(bank, Tunnel(), objective=Maximise("flow.drag")), plugins=PLUGINS)
    with pytest.raises(StudyError, match="'drag' is not measured"):
        lampopt.active(study(bank, Tunnel(), objective=Reduce("drag", by=0.1)), plugins=PLUGINS)
    with pytest.raises(StudyError, match="leave turns out"):
        lampopt.active(replace(study(bank, Tunnel()), turns=2), plugins=PLUGINS)
    with pytest.raises(InputError, match="budget: expected more than the 3 exemplars measured first"):
        lampopt.active(study(bank, Tunnel()), plugins=PLUGINS, budget=3)
    with pytest.raises(InputError, match="the reference 'box_5' has no"):
        lampopt.active(study(bank, Tunnel(longest=2.7), reference="box_5"), plugins=PLUGINS)
