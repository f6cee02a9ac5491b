"""Values by targets, and their derivatives against differences and against what is known."""

import sys
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Reduce, Response, Study
from lampopt.errors import StudyError
from lampopt.plugins import Plugins

sys.path.insert(0, str(Path(__file__).parent))
import small
import toys


class Offer:
    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"bulk": toys.Volume}


PLUGINS = Plugins.load([("small", small.Plugin()), ("offer", Offer())])
VALUES = ["extents.length", "bulk.volume", "size.fill", "width"]


@pytest.fixture(scope="module")
def bank():
    return small.bank(plugins=PLUGINS)


@pytest.fixture(scope="module")
def moving():
    """Of a decoder that pulls derivatives back."""
    return lampopt.build_bank(small.boxes(), lampopt.Spec("mesh-template", faces=600, cell=0.3), probes=16)


def response(bank, values=VALUES, **asked):
    return Response(Study(bank, **asked), values, plugins=PLUGINS)


def differences(made, targets, step=1e-4):
    found = {}
    for name, value in made.targets.items():
        at = targets.get(name, value)
        ahead, behind = (made({**targets, name: at + sign * step}) for sign in (1, -1))
        found |= {(value, name): (ahead[value] - behind[value]) / (2 * step) for value in ahead}
    return found


def test_boxes_are_known_in_closed_form(bank):
    made = response(bank, targets={"length": "2400 mm", "width": 1.2})
    assert dict(made.targets) == {"length": 2.4, "width": 1.2}
    assert dict(made.input_units) == {"length": "m", "width": "m"}
    assert dict(made.units) == {"extents.length": "m", "bulk.volume": "m^3", "size.fill": "", "width": "m"}
    assert made({}) == pytest.approx({
        "extents.length": 2.4, "bulk.volume": 2.4 * 1.2 * 0.8, "size.fill": 1.0, "width": 1.2,
    }, rel=1e-5)  # fmt: skip
    slopes = made.slopes({"length": "2.6 m"})
    assert slopes["extents.length", "length"] == pytest.approx(1.0, rel=1e-4)
    assert slopes["bulk.volume", "length"] == pytest.approx(1.2 * 0.8, rel=1e-4)
    assert slopes["bulk.volume", "width"] == pytest.approx(2.6 * 0.8, rel=1e-4)
    assert slopes["width", "width"] == pytest.approx(1.0)
    assert slopes["width", "length"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("keep", [(), ("width",)])
def test_derivatives_go_through_decoder_and_measure(moving, keep):
    targets = {"length": 2.5} if keep else {"length": 2.5, "width": 1.2}
    made = response(moving, ["volume.volume", "bulk.volume"], targets=targets, keep=keep, reference="box_1")
    at = {"length": 2.7}
    assert made.slopes(at) == pytest.approx(differences(made, at), rel=2e-3, abs=1e-4)


def test_one_mesh_is_enough_where_there_are_derivatives(bank, moving):
    exact, along = (response(b, ["bulk.volume"], targets={"length": 2.5}) for b in (moving, bank))
    assert exact.slopes({})["bulk.volume", "length"] > 0
    exact({})
    before = small.CALLS["decode"]
    along({})
    along.slopes({})
    assert small.CALLS["decode"] == before + 3  # the design itself, and one to either side


def test_what_the_bank_tells_of_its_exemplars_is_measured_all_the_same():
    bank = small.bank(plugins=PLUGINS, measured={"length": "extents.length"})
    before = small.CALLS["decode"]
    assert response(bank, ["extents.length"], targets={"length": 2.5})({}) == pytest.approx({"extents.length": 2.5})
    assert small.CALLS["decode"] == before + 1


def test_labels_models_and_what_is_reduced(bank):
    def taken(parameters):
        return parameters[:, :1] ** 2

    class Square:
        names, units, inputs = ("square",), ("m^2",), ("length",)

        def __call__(self, parameters):
            return taken(np.asarray(parameters))

        def gradient(self, parameters):
            return 2 * np.asarray(parameters)[:, None, :1]

    made = response(
        bank, ["drag", "curve.square"], targets={"length": 2.6}, objective=Reduce("drag", by=0.05),
        reference="box_3", models={"curve": Square()},
    )  # fmt: skip
    assert made({}) == pytest.approx({"drag": 0.95 * 0.38, "curve.square": 2.6**2})
    assert made.slopes({}) == pytest.approx({("drag", "length"): 0.0, ("curve.square", "length"): 5.2}, abs=1e-6)
    assert [*made.targets] == ["length"]


def test_what_has_no_mesh_has_no_value(bank):
    made = response(bank, ["bulk.volume"], targets={"length": 2.5})
    assert np.isnan(made({"length": -3.0})["bulk.volume"])
    assert np.isnan(made.slopes({"length": -3.0})["bulk.volume", "length"])


@pytest.mark.parametrize(
    ("asked", "values", "said"),
    [
        ({}, VALUES, "targets: expected some, which are the inputs"),
        ({"targets": {"length": 2.5}}, "width", "values: expected a list of names"),
        ({"targets": {"length": 2.5}}, [], "values: expected a list of names"),
        ({"targets": {"length": 2.5}}, ["height"], "'height': neither a parameter"),
        ({"targets": {"length": 2.5}, "turns": 2}, VALUES, "turns: derivatives do not go through corrections"),
        ({"targets": {"bulk.volume": 2.5}}, VALUES, "'bulk.volume' is not linear in the mix"),
    ],
)
def test_what_cannot_be_followed_is_refused(bank, asked, values, said):
    with pytest.raises(StudyError, match=said):
        response(bank, values, **asked)


def test_unknown_targets_are_refused(bank):
    made = response(bank, targets={"length": 2.5}, keep=("width",))
    with pytest.raises(StudyError, match="targets: 'width': expected some of length"):
        made({"width": 1.2})
    with pytest.raises(StudyError, match="study: expected a Study"):
        Response(bank, VALUES)


def test_differences_stand_in_where_a_measure_has_no_derivative_on_this_very_mesh(moving):
    class Sometimes(toys.Volume):
        def gradient(self, mesh):
            raise lampopt.errors.MeasureError("none here")

    asked = {"length": 2.4, "width": 1.2}
    made = Response(Study(moving, asked, measures={"own": Sometimes()}), ["own.volume"], plugins=Plugins.load())
    found = made.slopes({})
    assert found["own.volume", "length"] == pytest.approx(1.2 * 0.8, rel=0.02)
    assert found["own.volume", "width"] == pytest.approx(2.4 * 0.8, rel=0.02)
