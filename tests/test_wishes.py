"""What a study may wish for: models, measures, sums, bounds, safety; and the gradients that lead there."""

import sys
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import casadi
import numpy as np
import pytest

import lampopt
from lampopt import Linear, Maximise, Minimise, Reduce, Spec, Study
from lampopt.chain import Chain
from lampopt.errors import InputError, PluginError, StudyError
from lampopt.plugins import Plugins
from lampopt.safeguards import LeastJacobian, Mismatch, judged_by, seen
from lampopt.task import Task
from lampopt.terms import model_value, shaped
from lampopt.testing import shapes
from lampopt.types import Parameter
from lampopt.workers import _packed, _unpacked

sys.path.insert(0, str(Path(__file__).parent))
import small
import toys

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


@dataclass(frozen=True)
class Pulled(small.Stretch):
    """Stretches a box's corners by its extents: motion linear in the weights, gradients exact."""

    def pullback(self, shared, weights, mesh, gradient):
        own = (np.asarray(mesh.vertices) - weights[3:]) / weights[:3]
        return np.append((gradient * own).sum(0), gradient.sum(0))

    def displace(self, shared, weights, points):
        return self.evaluate(shared, weights, points)


@dataclass(frozen=True)
class Drag:
    """Model: a little bowl over length and width, symbolic if need be; least at (2.55, 1.15)."""

    names, units, inputs = ("drag", "lift"), ("N", ""), ("length", "width")

    def __call__(self, parameters):
        a, b = np.asarray(parameters).T
        return np.stack([(a - 2.55) ** 2 + 4 * (b - 1.15) ** 2 + 0.3, a * b], 1)

    def gradient(self, parameters):
        a, b = np.asarray(parameters).T
        return np.stack([np.stack([2 * (a - 2.55), 8 * (b - 1.15)], 1), np.stack([b, a], 1)], 1)


@dataclass(frozen=True)
class SymbolicDrag(Drag):
    def symbolic(self, p):
        return casadi.vertcat((p[0] - 2.55) ** 2 + 4 * (p[1] - 1.15) ** 2 + 0.3, p[0] * p[1])


@dataclass(frozen=True)
class Slope:
    """Model that needs what no bank here has."""

    names, units, inputs = ("x",), ("",), ("slope",)

    def __call__(self, parameters):
        return parameters

    def gradient(self, parameters):
        return np.ones((len(parameters), 1, 1))


class Offer:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"pulled": Pulled}

    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"mine": toys.Volume}


PLUGINS = Plugins.load([("small", small.Plugin()), ("offer", Offer())])


@pytest.fixture(scope="module")
def bank():
    return small.bank(decoder="pulled", plugins=PLUGINS, measured={"length": "extents.length"})


def run(bank, **asked):
    return lampopt.run(Study(bank, **{"solver": "casadi", "level": "alpha", **asked}), plugins=PLUGINS)


def values(result):
    return dict(zip(("length", "width"), result.design.predicted.tolist(), strict=True))


# Names


def test_a_name_is_a_column_a_models_value_or_a_measures(bank):
    task = Task.of(Study(bank, models={"aero": Drag()}, measures={"own": toys.Volume()}), PLUGINS)
    known = task.wishes.quantities
    assert known["length"].column is not None
    assert known["lift"].name == "aero.lift"
    assert (known["aero.drag"].name, known["aero.drag"].unit) == ("aero.drag", "N")
    assert (known["volume"].name, known["volume"].unit) == ("own.volume", "m^3")
    assert known["mine.volume"].measure[0] == "mine"
    assert known["extents.length"].column is not None  # declared: linear in the mix
    assert known["extents.width"].measure is not None
    with pytest.raises(StudyError, match=r"'drag': may be 'drag' of the bank, or 'aero\.drag' of model 'aero'"):
        known["drag"]
    with pytest.raises(StudyError, match=r"'dragg': neither .* known are length, width, drag, .*aero\.drag"):
        known["dragg"]
    with pytest.raises(StudyError, match=r"'mine\.area': measure 'mine' has no such value; it has mine\.volume"):
        known["mine.area"]


def test_a_model_that_needs_what_is_not_there_is_named(bank):
    with pytest.raises(StudyError, match="model 'odd': needs slope; the bank's parameters are length, width"):
        run(bank, targets={"odd.x": 1.0}, models={"odd": Slope()})


@dataclass(frozen=True)
class Flattens(Drag):
    what: str = "values"

    def __call__(self, parameters):
        found = super().__call__(parameters)
        return found[:, 0] if self.what == "values" else found

    def gradient(self, parameters):
        found = super().gradient(parameters)
        return np.squeeze(found) if self.what == "gradient" else found


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("values", r"model 'aero': expected values of shape \(7, 2\), got \(7,\)"),
        ("gradient", r"aero.*gradient: expected shape \(1, 2, 2\), got \(2, 2\)"),
    ],
)
def test_a_model_of_another_shape_is_named(bank, what, message):
    with pytest.raises(PluginError, match=message):
        run(bank, targets={"aero.lift": 3.3}, models={"aero": Flattens(what=what)})


def test_the_value_at_the_reference(bank):
    task = Task.of(Study(bank, models={"aero": Drag()}, measures={"own": toys.Volume()}), PLUGINS)
    known = task.wishes.quantities
    assert known.at("aero.lift", "box_1") == pytest.approx(2.2 * 1.4)
    assert known.at("own.volume", "box_1") == pytest.approx(2.2 * 1.4 * 0.8, rel=1e-6)
    assert known.at("own.volume", None) == pytest.approx(2.5 * 1.2 * 0.8, rel=1e-6)
    assert known.at("length", "box_1", "extents.width") == pytest.approx(1.4, rel=1e-6)
    with pytest.raises(StudyError, match="reference 'box_9': no exemplar"):
        known.at("own.volume", "box_9")


# Wishes


@pytest.mark.parametrize("model", [Drag(), SymbolicDrag()])
@pytest.mark.parametrize("hard", [(), ("aero.lift",)])
def test_a_models_value_is_hit(bank, model, hard):
    result = run(bank, targets={"aero.lift": 3.3, "width": "1250 mm"}, models={"aero": model}, hard=hard)
    found = values(result)
    assert found["width"] == pytest.approx(1.25, abs=1e-5)
    assert found["length"] == pytest.approx(3.3 / 1.25, abs=1e-4)
    assert result.accepted
    assert result.check("target.aero.lift").passed
    assert "3.3, asked 3.3" in result.check("target.aero.lift").note


def test_a_models_value_that_cannot_be_hit_is_a_finding(bank):
    """The bowl's least value is 0.3: nothing has 0.1."""
    result = run(bank, targets={"aero.drag": 0.1}, models={"aero": SymbolicDrag()})
    assert not result.accepted
    spread = np.ptp(Drag()(bank.parameters)[:, 0])
    assert result.check("target.aero.drag").value == pytest.approx(0.2 * 2 / spread, rel=1e-4)
    assert values(result) == pytest.approx({"length": 2.55, "width": 1.15}, abs=1e-3)


@pytest.mark.parametrize("model", [Drag(), SymbolicDrag()])
def test_minimise_and_maximise(bank, model):
    best = run(bank, objective=Minimise("aero.drag"), models={"aero": model})
    assert values(best) == pytest.approx({"length": 2.55, "width": 1.15}, abs=1e-4)
    held = run(bank, objective=Minimise("aero.drag"), models={"aero": model}, targets={"width": 1.3}, hard=("width",))
    assert values(held) == pytest.approx({"length": 2.55, "width": 1.3}, abs=1e-4)
    most = run(bank, objective=Maximise("lift"), models={"aero": model}, ranges={"length": (2, 3), "width": (1, 1.4)})
    assert values(most) == pytest.approx({"length": 3.0, "width": 1.4}, abs=1e-5)


def test_a_label_may_be_minimised_within_bounds(bank):
    """Linear in alpha: at a corner of what the bounds leave."""
    result = run(bank, objective=Minimise("drag"), alpha=(0.0, 1.0))
    assert result.design.mix.alpha == pytest.approx(np.eye(7)[0], abs=1e-6)  # box_0 has the least drag
    assert not np.isnan(bank.labels[result.design.mix.alpha > 1e-6]).any()


def test_a_range_on_a_models_value(bank):
    result = run(
        bank, targets={"width": 1.2}, ranges={"aero.lift": (3.2, inf)}, hard=("width",), models={"aero": Drag()}
    )
    assert values(result)["length"] == pytest.approx(3.2 / 1.2, abs=1e-4)
    assert result.check("range.aero.lift").passed
    clash = run(bank, targets={"length": 2.0, "width": 1.0}, hard=("length", "width"),
                ranges={"aero.lift": (3.2, inf)}, models={"aero": Drag()})  # fmt: skip
    assert clash.design.mix.status == "infeasible"
    assert "aero.lift (range)" in clash.design.mix.conflicts[0].names
    assert not clash.check("range.aero.lift").passed


def test_which_end_of_a_models_range_is_in_the_way_is_told(bank):
    clash = run(bank, targets={"length": 2.0, "width": 1.0}, hard=("length", "width"),
                ranges={"aero.lift": (3.2, 4.0)}, models={"aero": Drag()})  # fmt: skip
    assert clash.design.mix.message.endswith("; aero.lift (range, low end) 3.2 → 2 would be enough")
    for name in ("target", "hard"):  # both are met: the reasons stand with what is not
        assert clash.check(name).passed and clash.check(name).note == ""


def test_one_sided_ranges_and_sums(bank):
    result = run(bank, targets={"length": 3.0, "width": 1.4}, weights={"length": 1e4},
                 linear={"sum": Linear({"length": 1, "width": 1}, high=4.0)})  # fmt: skip
    assert values(result) == pytest.approx({"length": 3.0, "width": 1.0}, abs=1e-3)
    assert result.design.mix.status == "infeasible"
    assert {"length", "width", "sum (range)"} == set(result.design.mix.conflicts[0].names)
    assert "sum (range) up to 4 →" in result.design.mix.message
    low = run(bank, ranges={"length": (2.8, inf)})
    assert values(low)["length"] == pytest.approx(2.8, abs=1e-6)
    with pytest.raises(StudyError, match="no mix can change it"):
        run(bank, linear={"nothing": Linear({"length": 0.0}, high=1.0)})
    shares = np.array([[0.7, 0.2, 0.1], [0.3, 0.3, 0.4], [1 / 3, 1 / 3, 1 / 3], [0.6, 0.1, 0.3]])
    assert np.ptp(shares[:, 0] + shares[:, 1] + shares[:, 2]) > 0  # by rounding
    space = tuple(lampopt.Parameter(name) for name in ("front", "middle", "rear"))
    parted = small.bank(replace(small.boxes(count=4), parameters=shares, space=space, measured={}), plugins=PLUGINS)
    with pytest.raises(StudyError, match="linear: whole: all exemplars have 1: no mix can change it"):
        run(parted, linear={"whole": Linear(dict.fromkeys(("front", "middle", "rear"), 1.0), low=1.05)})


def test_weights_tell_what_gives_way(bank):
    free = {"targets": {"length": 2.9, "extents.length": 2.7}}
    even = run(bank, **free)
    assert values(even)["length"] == pytest.approx(2.8, abs=1e-5)
    tipped = run(bank, **free, weights={"length": 3.0})
    assert values(tipped)["length"] == pytest.approx(2.85, abs=1e-5)


@pytest.mark.parametrize("asked", [{"weights": {"width": 2.0}}, {"measured": {"width": "extents.width"}}])
def test_what_is_not_asked_for_has_no_weight_and_no_measure(bank, asked):
    with pytest.raises(
        StudyError, match=rf"{next(iter(asked))}: \['width'\] are not asked for; asked for are \['length'\]"
    ):
        run(bank, targets={"length": 2.5}, **asked)
    (grown,) = lampopt.sweep(
        Study(bank, targets={"length": 2.5}, level="alpha", **asked), {"width": [1.2]}, plugins=PLUGINS
    )
    assert grown.accepted


def test_ridge_norm_and_bounds_reach_the_solver(bank):
    near = run(bank, targets={"length": 2.9}, ridge=100.0)
    assert values(near)["length"] < 2.6
    few = run(bank, targets={"length": 2.9}, norm=1, hard=("length",))
    apart = np.abs(few.design.mix.alpha - 1 / 7)
    assert (apart > 1e-6).sum() == 2  # the shortest and the longest box
    inside = run(bank, targets={"length": 3.5}, alpha=(0.0, 1.0))
    assert inside.design.mix.alpha.min() >= -1e-8
    assert inside.design.mix.status == "infeasible"
    assert "bounds on alpha" in inside.design.mix.conflicts[0].names


def test_bounds_that_leave_nothing_are_told_by_how_much(bank):
    result = run(bank, targets={"length": 2.5}, alpha=(-1.0, 0.1))
    assert result.design.mix.status == "infeasible"
    assert not result.check("bounds").passed and not result.accepted
    assert result.check("bounds").value == pytest.approx(result.design.mix.alpha.max() - 0.1)
    assert "bounds on alpha wider by 0.04" in result.check("bounds").note  # 1/7 − 0.1, and what the length asks besides
    assert "; ; " not in result.design.mix.message
    assert "→ " not in result.design.mix.message


def test_with_a_reference_and_one_parameter_asked_the_others_stay(bank):
    for solver in ("kkt", "casadi"):
        result = run(bank, targets={"length": 2.9}, reference="box_1", solver=solver)
        assert values(result) == pytest.approx({"length": 2.9, "width": 1.4}, abs=1e-8)
    free = run(bank, targets={"drag": 0.31}, reference="box_1")  # a label moves because parameters do
    assert abs(values(free)["width"] - 1.4) > 1e-3


@pytest.mark.parametrize("solver", ["kkt"])
def test_a_solver_that_is_not_able_to_says_so(bank, solver):
    with pytest.raises(lampopt.errors.SolveError, match="is not able to take objectives"):
        run(bank, objective=Minimise("lift"), models={"aero": Drag()}, solver=solver)


def test_a_measures_value_is_hit_by_gradients(bank):
    """Length and width are free: volume 3 with the least motion."""
    result = run(bank, targets={"volume": 3.0}, measures={"own": toys.Volume()}, level="mesh")
    assert result.check("target.volume").value < 1e-3
    assert result.check("own.volume").value == pytest.approx(3.0, abs=1e-3)
    assert result.accepted


def test_who_waits_is_told_of_every_evaluation(bank):
    told = []
    asked = Study(bank, targets={"own.volume": 3.0}, measures={"own": toys.Volume()}, solver="casadi")
    lampopt.run(asked, plugins=PLUGINS, progress=lambda done, message="": told.append(message))
    evaluations = [message for message in told if "evaluation" in message]
    assert evaluations[0].startswith("design 1 of 1, evaluation 1: own.volume ")
    assert float(evaluations[-1].split()[-1]) == pytest.approx(3.0, abs=1e-2)


def test_a_measure_without_gradient_is_refused_by_name(bank):
    with pytest.raises(lampopt.errors.SolveError, match=r"own\.fill: has no gradient.*nlopt"):
        run(bank, targets={"own.fill": 0.9}, measures={"own": toys.Size()})


# Gradients


def test_the_chain_rule_leads_back_to_alpha(bank):
    """Volume of a box: the product of its extents, each a mix of the exemplars'."""
    chain = Chain(bank, Pulled(), 32)
    alpha = np.array([0.5, -0.2, 0.3, 0.1, 0.4, -0.3, 0.2])
    extents = np.column_stack([bank.parameters, np.full(7, 0.8)])
    a, b, c = alpha @ extents
    exact = extents @ [b * c, a * c, a * b]
    assert chain.differentiable(toys.Volume())
    assert chain.values("own", toys.Volume(), alpha)[0] == pytest.approx(a * b * c, rel=1e-5)
    assert chain.gradient("own", toys.Volume(), 0, alpha) == pytest.approx(exact, rel=1e-5)
    assert np.isnan(chain.values("own", toys.Volume(), np.append(-alpha[:-1], 0.0))).all()  # negative extents
    assert not chain.differentiable(toys.Size())


def test_shaped_terms_have_the_slopes_of_what_they_are():
    inner = model_value("lift", SymbolicDrag(), 1, small.boxes().parameters)
    alpha = np.array([0.5, -0.2, 0.3, 0.1, 0.4, -0.3, 0.2])
    symbol = casadi.MX.sym("alpha", 7)
    for power in (1, 2):
        term = shaped("lift", inner, offset=3.0, factor=-2.0, power=power, weight=0.7)
        value, gradient = term(alpha)
        lift = (alpha @ small.boxes().parameters).prod()
        assert value == pytest.approx(0.7 * (-2 * (lift - 3)) ** power)
        steps = 1e-6 * np.eye(7)
        rough = [(term(alpha + step)[0] - term(alpha - step)[0]) / 2e-6 for step in steps]
        assert gradient == pytest.approx(np.array(rough), rel=1e-6)
        told = casadi.Function("f", [symbol], [term.symbolic(symbol)])(alpha)
        assert float(told) == pytest.approx(value)
    assert not hasattr(shaped("lift", model_value("lift", Drag(), 1, np.eye(2)), offset=0.0, factor=1.0), "symbolic")


# Safety in the solve


@dataclass(frozen=True)
class Bent(small.Linear):
    """A field that bends with its weights, and knows its adjoint."""

    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights, points) + 0.5 * (weights[..., None, :1] ** 2)

    def adjoint(self, shared, weights, points, gradient):
        steps = 1e-4 * np.eye(6)
        up, down = (self.evaluate(shared, np.asarray(weights, float) + sign * steps, points) for sign in (1, -1))
        return ((up - down) / 2e-4 * gradient).sum((1, 2))


class OfferBent:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"bent": Bent, "bent-blind": type("Blind", (Bent,), {"adjoint": None})}


@pytest.mark.parametrize("decoder", [Bent(), small.Linear()])
def test_the_mismatch_has_its_gradient(decoder):
    given = Plugins.load([("small", small.Plugin()), ("bent", OfferBent())])
    bank = small.bank(decoder="bent" if isinstance(decoder, Bent) else "stretch-field", plugins=given, probes=64)
    term = Mismatch("mismatch", bank, decoder, lambda alpha: alpha, np.arange(7))
    alpha = np.array([0.9, -0.5, 0.3, 0.6, 0.4, -0.9, 0.2])
    value, gradient = term(alpha)
    chosen = seen(64)
    linear = np.tensordot(alpha, bank.probe_values[:, chosen].astype(float), 1)
    mixed = decoder.evaluate(bank.shared, alpha @ bank.weights, bank.probes[chosen])
    assert value == pytest.approx(np.abs(mixed - linear).mean(), rel=1e-4)
    along = np.array([1.0, 0, -1, 0, 0.5, -0.5, 0])
    rough = (term(alpha + 1e-3 * along)[0] - term(alpha - 1e-3 * along)[0]) / 2e-3
    assert gradient @ along == pytest.approx(rough, rel=2e-2)


def test_the_least_jacobian_of_boxes_is_the_product_of_their_stretches():
    bank = small.bank(decoder="pulled", plugins=PLUGINS, probes=64)
    term = LeastJacobian("jacobian", bank, Pulled(), np.arange(7))
    alpha = np.array([1.5, -0.2, 0.3, -1.1, 0.4, -0.1, 0.2])
    extents = np.asarray(bank.weights[:, :3], float)
    stretched = alpha @ extents
    value, gradient = term(alpha)
    # the same everywhere, so that the smooth least value is below by log(M) / SHARP
    count = int(seen(64).sum())
    assert value == pytest.approx(stretched.prod() - np.log(count) / 200, abs=1e-4)
    rest = np.array([stretched[1] * stretched[2], stretched[0] * stretched[2], stretched[0] * stretched[1]])
    assert gradient == pytest.approx(extents @ rest, rel=1e-3)


def test_safety_keeps_the_solver_from_what_would_be_rejected(bank):
    far = run(bank, targets={"length": 6.0}, limits={"alpha": 1.0})
    assert not far.check("alpha").passed
    near = run(bank, targets={"length": 6.0}, limits={"alpha": 1.0}, safe=("alpha",))
    assert near.check("alpha").passed
    assert near.check("alpha").value == pytest.approx(1.0, abs=1e-5)
    assert near.design.mix.status == "infeasible"
    assert "safe alpha" in near.design.mix.conflicts[0].names


def test_what_safety_would_have_to_give_is_told_as_its_check_tells_it(bank):
    asked = {"length": 4.6, "width": 1.5}
    result = run(bank, targets=asked, hard=tuple(asked), limits={"alpha": 0.5}, safe=("alpha",))
    rows = np.vstack([np.ones(7), bank.parameters[:, :2].T])
    least = np.linalg.norm(np.linalg.lstsq(rows, [1.0, 4.6, 1.5])[0] - 1 / 7)
    assert f"safe alpha 0.5 → {least:.4g}" in result.design.mix.message
    assert "half ranges" not in result.design.mix.message


def test_safety_holds_the_mismatch_and_is_judged_elsewhere():
    given = Plugins.load([("small", small.Plugin()), ("bent", OfferBent())])
    bank = small.bank(decoder="bent", plugins=given, probes=64)
    asked = {"targets": {"length": 3.4}, "limits": {"mismatch": 0.05, "mismatch.band": 9.0}, "level": "field"}
    free = lampopt.run(Study(bank, solver="casadi", **asked), plugins=given)
    assert not free.check("mismatch").passed
    safe = lampopt.run(Study(bank, solver="casadi", safe=("mismatch",), **asked), plugins=given)
    assert safe.check("mismatch").value == pytest.approx(0.05, rel=0.1)
    assert not (judged_by(bank, ("mismatch",)) & seen(64)).any()
    assert judged_by(bank, ()).all()


def test_safety_that_means_nothing_is_refused(bank):
    plain = small.bank(plugins=PLUGINS)
    with pytest.raises(StudyError, match="'jacobian' is of decoders that move space and a template"):
        run(plain, targets={"length": 2.5}, safe=("jacobian",))
    with pytest.raises(
        StudyError, match=r"safe: \['quality'\] cannot be kept by a solver; what can are alpha, mismatch"
    ):
        Study(bank, safe=("quality",))


# As objects and as TOML


def test_a_study_with_every_wish_comes_back_from_toml(tmp_path):
    study = Study(
        "a.lamp",
        targets={"length": 2.0, "aero.lift": 3.0},
        ranges={"width": (1.0, inf)},
        weights={"length": 2.0},
        linear={"sum": Linear({"length": 1, "width": -2}, high=0.5)},
        alpha=(-1, 2.5),
        ridge=1e-3,
        norm=1,
        safe=("alpha", "mismatch"),
        models={"aero": tmp_path / "aero.model"},
        measured={"length": "extents.length"},
        turns=2,
        objective=Maximise("lift", weight=3.0),
    )
    again = Study.from_toml(study.to_toml())
    for name in ("weights", "linear", "alpha", "ridge", "norm", "safe", "measured", "turns", "objective", "ranges"):
        assert getattr(again, name) == getattr(study, name), name
    assert again.models == {"aero": str(tmp_path / "aero.model")}
    assert isinstance(Study.from_toml(Study("a.lamp", objective=Minimise("x")).to_toml()).objective, Minimise)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"targets": {"length": 1}, "weights": {"length": 0}}, "weights: length: expected a positive number"),
        ({"linear": {"s": {"of": {}}}}, "linear: expected factors by name"),
        ({"linear": {"s": {"of": {"a": 1}}}}, "linear: expected low ≤ high, one of them a number"),
        ({"linear": {"s": 5}}, "linear: s: expected"),
        ({"linear": {"s": {"of": {"a": "b"}, "high": 1}}}, "linear: expected factors by name"),
        ({"alpha": (1, 0)}, "alpha: expected the lowest and the highest coefficient"),
        ({"alpha": 3}, "alpha: expected the lowest"),
        ({"ridge": -1}, "ridge: expected a number of at least 0"),
        ({"norm": 3}, "norm: expected 1 or 2"),
        ({"turns": -1}, "turns: expected a whole number from 0 to 100"),
        ({"turns": True}, "turns: expected a whole number"),
        ({"models": {"a.b": "x"}}, "models: expected a name without dots"),
        ({"models": {"a": 5}}, "models: a: expected the file of a model"),
        ({"targets": {"length": 1}, "measured": {"length": 5}}, "measured: length: expected an address"),
        ({"objective": Reduce("drag", by=0.1)}, "needs a reference"),
    ],
)
def test_wishes_that_cannot_be_are_refused(fields, message):
    with pytest.raises(StudyError, match=message):
        Study("a.lamp", **fields)


@pytest.mark.parametrize("weight", [0, -1, inf, "much", True])
def test_an_objectives_weight_is_a_positive_number(weight):
    with pytest.raises(StudyError, match=r"Minimise\('drag'\): expected a positive weight"):
        Minimise("drag", weight)


def test_a_sum_of_what_is_not_linear_is_refused(bank):
    with pytest.raises(StudyError, match=r"linear: s: 'aero\.lift' is not linear in the mix"):
        run(bank, linear={"s": Linear({"aero.lift": 1}, high=2)}, models={"aero": Drag()})


def test_a_model_from_a_file(bank, tmp_path):
    file = tmp_path / "drag.model"
    labels = Drag()(bank.parameters)[:, 1:]
    known = small.boxes(labels=labels, label_space=(Parameter("lift"),))
    lampopt.fit_model(known, "quadratic", store=file)
    result = run(bank, targets={"aero.lift": 3.3, "width": 1.25}, models={"aero": file})
    assert values(result)["length"] == pytest.approx(3.3 / 1.25, abs=1e-3)
    with pytest.raises(StudyError, match="was given as a Python object"):
        run(bank, models={"aero": "<somewhere.Model>"}, targets={"length": 2.5})


def test_the_solver_is_said_in_the_provenance(bank):
    assert run(bank, solver=Spec("casadi", ridge=0.1)).provenance["solver"].startswith("Spec('casadi', ridge=0.1)")


# What a review found


class Other:
    """A measure of the study's own under an installed one's name."""

    names, units = ("area",), ("L^2",)

    def __call__(self, mesh):
        return np.array([-7.0])


def test_a_measure_of_the_study_hides_an_installed_one_of_its_name(bank):
    known = Task.of(Study(bank, measures={"mine": Other()}), PLUGINS).wishes.quantities
    assert known["mine.area"].measure[1] is not toys.Volume
    with pytest.raises(StudyError, match=r"'mine\.volume': measure 'mine' has no such value; it has mine\.area"):
        known["mine.volume"]


def test_what_is_declared_may_be_reported_too(bank):
    result = run(bank, targets={"extents.length": 2.7}, measures=("extents",), level="mesh")
    assert result.check("extents.length").value == pytest.approx(2.7, abs=1e-5)


def test_ridge_0_is_another_question_than_the_solvers_own(bank):
    study = Study(bank, targets={"length": 3.4}, solver=Spec("casadi", ridge=0.5))
    other = Study(bank, targets={"length": 3.4}, solver=Spec("casadi", ridge=0.5), ridge=0.0)
    assert Task.of(study, PLUGINS).identity != Task.of(other, PLUGINS).identity


def test_who_measures_is_part_of_the_question(bank):
    class OfferOther(Offer):
        @lampopt.hookimpl
        def lampopt_measures(self):
            return {"mine": Twice}

    others = Plugins.load([("small", small.Plugin()), ("another", OfferOther())])
    for asked in ({"objective": Minimise("mine.volume")}, {"ranges": {"mine.volume": (1, 2)}}):
        one, two = (Task.of(Study(bank, **asked), given) for given in (PLUGINS, others))
        assert one.identity != two.identity
    one, two = (Task.of(Study(bank), given).key({"mine.volume": 2.0}) for given in (PLUGINS, others))
    assert one != two


@dataclass(frozen=True)
class Twice(toys.Volume):
    def __call__(self, mesh):
        return 2 * super().__call__(mesh)


def test_models_without_state_are_told_by_their_class_and_options(bank):
    one, two = (Task.of(Study(bank, models={"aero": Drag()}), PLUGINS).identity for _ in range(2))
    assert one == two
    assert one != Task.of(Study(bank, models={"aero": SymbolicDrag()}), PLUGINS).identity


def test_a_soft_target_that_is_missed_is_not_called_met(bank):
    result = run(bank, targets={"length": 2.5, "aero.drag": 0.01}, hard=("length",), models={"aero": SymbolicDrag()})
    assert result.design.mix.status == "inexact"
    assert "aero.drag cannot be had" in result.design.mix.message


@pytest.mark.parametrize("solver", ["casadi", "nlopt"])
def test_what_a_model_cannot_have_is_no_met_target(bank, solver):
    """The model's least is 0.3: 1 % less is within what a soft target may miss, not within a hard one's."""
    asked = {"models": {"aero": SymbolicDrag()}, "solver": solver}
    soft = run(bank, targets={"aero.drag": -1.0}, **asked)
    assert soft.design.mix.status == "inexact" and "aero.drag cannot be had" in soft.design.mix.message
    assert run(bank, targets={"aero.drag": 0.297}, **asked).accepted
    hard = run(bank, targets={"aero.drag": 0.297}, hard=("aero.drag",), **asked)
    assert not hard.accepted and hard.check("target.aero.drag").value > 0.01
    assert run(bank, targets={"aero.drag": 0.35}, hard=("aero.drag",), **asked).accepted


@pytest.mark.parametrize("solver", ["casadi", "nlopt"])
@pytest.mark.parametrize("limit", [0.5, 1.0, 3.0])
def test_what_keeps_to_the_check_passes_it(bank, solver, limit):
    result = run(bank, objective=Minimise("drag"), safe=("alpha",), limits={"alpha": limit}, solver=solver)
    assert result.accepted and result.check("alpha").value == pytest.approx(limit, rel=1e-5)


@pytest.mark.parametrize("norm", [1, 2])
def test_parameters_that_go_together_are_no_trouble(norm):
    """The wheelbase is six tenths of the length: what one leaves of the other is rounding."""
    boxes = small.boxes()
    parameters = np.insert(boxes.parameters, 1, 0.6 * boxes.parameters[:, 0], 1)
    space = (boxes.space[0], Parameter("wheelbase", "m"), boxes.space[1])
    bank = small.bank(replace(boxes, parameters=parameters, space=space), plugins=PLUGINS)
    for reference in (None, "box_1"):
        held = run(bank, targets={"length": 2.7}, hard=("length",), reference=reference, norm=norm)
        assert held.design.predicted[:2] == pytest.approx([2.7, 1.62])
        pulled = {"targets": {"length": 2.9, "wheelbase": 1.6}, "hard": ("length",), "reference": reference}
        result = run(bank, **pulled, ranges={"width": (1.1, 1.15)}, norm=norm)
        assert result.check("hard").passed
        assert result.design.predicted[0] == pytest.approx(2.9)


def test_what_can_be_known_to_be_wrong_is_told_before_anything_is_measured(bank):
    measured = []

    class Counted(toys.Volume):
        def __call__(self, mesh):
            measured.append(1)
            return super().__call__(mesh)

    asked = {"measures": {"vol": Counted()}, "solver": Spec("nlopt", evaluations=30), "level": "mesh"}
    aero = {"models": {"aero": SymbolicDrag()}, "targets": {"aero.drag": 0.4}}
    cannot = [
        ({"ranges": {"vol.volume": (2.4, 2.2)}}, r"ranges: vol\.volume: expected low ≤ high, got 2\.4 to 2\.2"),
        ({"targets": {"drag": 0.3}, "measured": {"drag": "extents.nosuch"}}, r"extents\.nosuch"),
        ({"targets": {"drag": 0.3}, "measured": {"drag": "extents.length"}}, r"'extents\.length' for 'drag'"),
        ({**aero, "measured": {"aero.drag": "vol.volume"}}, "told by model 'aero', not by the mix"),
    ]
    for wish, message in cannot:
        with pytest.raises(InputError, match=message):
            run(bank, **asked, **wish)
    assert not measured


def test_a_slack_range_on_a_mesh_costs_no_search(bank):
    small.CALLS.clear()
    result = run(bank, targets={"length": 2.6}, ranges={"volume": (0.1, 99.0)}, measures={"own": toys.Volume()})
    assert result.design.mix.status == "exact"
    assert small.CALLS["decode"] < 20


def test_a_sum_needs_a_name_of_its_own_and_its_parts_may_move(bank):
    with pytest.raises(StudyError, match="linear: 'length' is the name of something else"):
        run(bank, linear={"length": Linear({"width": 1.0}, high=2.0)})
    total = Linear({"length": 1.0, "width": 1.0}, high=3.2)
    result = run(bank, targets={"length": 2.2}, reference="box_1", linear={"sum": total})
    assert values(result) == pytest.approx({"length": 2.2, "width": 1.0}, abs=1e-6)


def test_who_looks_at_linear_targets_alone_says_so(bank):
    asked = {"targets": {"aero.lift": 3.0}, "models": {"aero": Drag()}}
    with pytest.raises(StudyError, match=r"explore: expected what is linear in the mix .*aero\.lift"):
        lampopt.explore(Study(bank, **asked), plugins=PLUGINS)
    for look, who in ((lampopt.explore, "explore"), (lampopt.front, "front")):
        with pytest.raises(StudyError, match=f"{who}: looks at what is asked"):
            look(Study(bank, targets={"length": 2.5}, turns=2), plugins=PLUGINS)


def test_numbers_beyond_any_float_are_refused():
    for make in (
        lambda: Reduce("drag", 10**400),
        lambda: Minimise("drag", 10**400),
        lambda: Linear({"a": 10**400}, high=1),
    ):
        with pytest.raises(StudyError):
            make()
    for asked in (
        {"ridge": 10**400},
        {"alpha": (0, 10**400)},
        {"targets": {"a": 1}, "weights": {"a": 10**400}},
        {"alpha": (True, 2)},
    ):
        with pytest.raises(StudyError):
            Study("a.lamp", **asked)
    for ends in ((inf, inf), (-inf, -inf), (inf, 2.0)):
        with pytest.raises(StudyError, match="expected low ≤ high"):
            Linear({"a": 1}, *ends)


def test_models_go_to_other_processes(bank, tmp_path):
    file = tmp_path / "a.lamp"
    lampopt.store_bank(bank, file)
    task = Task.of(Study(lampopt.load_bank(file), targets={"aero.lift": 3.0}, models={"aero": Drag()}), PLUGINS)
    there = _unpacked(_packed(task, file))
    assert there.identity == task.identity
    assert there.models == task.models


def test_what_is_measured_at_the_reference_is_in_the_labels_unit():
    bank = small.bank(small.boxes(labels=100 * small.LENGTHS[:, None], label_space=(Parameter("span", "cm"),)),
                      decoder="pulled", plugins=PLUGINS)  # fmt: skip
    known = Task.of(Study(bank), PLUGINS).wishes.quantities
    assert known.at("span", "box_1", "extents.length") == pytest.approx(220.0, rel=1e-6)


def test_a_measured_target_beside_a_reference_at_nought_is_no_question_of_rounding():
    """The middle of the reference is 0 but for single precision, which is no scale for what is asked."""

    @dataclass(frozen=True)
    class Middle:
        names, units = ("x",), ("L",)

        def __call__(self, mesh):
            return mesh.bounds.mean(0)[:1] + 1e-9

    parameters = np.array([[2.0, -0.1], [2.2, 0.0], [2.6, 0.1], [2.7, 0.0], [2.3, 0.05]])
    meshes = [shapes.box([length, 1.0, 0.8], centre=np.array([x, 0.0, 0.0])) for length, x in parameters]
    space = (Parameter("length", "m"), Parameter("shift", "m"))
    exemplars = lampopt.Exemplars(parameters, space, meshes, tuple("abcde"))
    plugins = Plugins.load([("small", small.Plugin())])
    bank = lampopt.build_bank(exemplars, "stretch", probes=16, plugins=plugins)
    for wanted in (0.08, 0.0):
        study = Study(bank, {"middle.x": wanted}, measures={"middle": Middle()}, keep=("length",), reference="b")
        result = lampopt.run(replace(study, solver="nlopt"), plugins=plugins)
        assert result.accepted, [check for check in result.checks if not check.passed]
        np.testing.assert_allclose(result.design.predicted, [2.2, wanted], atol=1e-4)


def test_an_end_that_never_matters_does_not_loosen_the_other():
    """What a range is off is told by the value at the start, whatever else is asked."""
    bank, plugins = small.bank(), Plugins.load([("small", small.Plugin())])
    off = []
    for high in (inf, 1e9):
        asked = {"ranges": {"size.volume": (3.0, high)}, "keep": ("length", "width"), "reference": "box_0"}
        study = Study(bank, solver="nlopt", hard=("length", "width"), measures={"size": toys.Size()}, **asked)
        off.append(lampopt.run(study, plugins=plugins).check("range.size.volume"))
    assert not off[0].passed and not off[1].passed
    assert off[0].value == pytest.approx(off[1].value) == pytest.approx((3.0 - 1.6) * 2 / (0.2 * 1.6), rel=1e-3)
