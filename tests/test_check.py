"""Checks: the mismatch against the formula of the paper, drift that catches what it misses, meshes that are broken."""

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt import Exemplars, Spec, build_bank, design, hookimpl
from lampopt.check import (
    BAND,
    DEFAULTS,
    Limits,
    alpha_checks,
    drift_checks,
    field_checks,
    measure_checks,
    mesh_checks,
    mismatches,
    stranger_checks,
)
from lampopt.errors import BankError, InputError, MeasureError, PluginError, StudyError
from lampopt.measured import values_of
from lampopt.mix import mixed_weights
from lampopt.plugins import Plugins
from lampopt.solve import pose
from lampopt.testing import shapes
from lampopt.types import Bank, Check, Design, Frame, Mix, Parameter, Result

sys.path[:0] = [p for p in (str(Path(__file__).parent),) if p not in sys.path]
import small  # noqa: E402

TUTORIAL = str(Path(__file__).parent.parent / "examples" / "third_party_decoder")
sys.path[:0] = [TUTORIAL] if TUTORIAL not in sys.path else []
GridSDF = importlib.import_module("lampopt_gridsdf").GridSDF

BOX = np.array([[-1.0] * 3, [1.0] * 3])


@dataclass(frozen=True)
class Hole:
    """Measure of a feature that may be missing."""

    names = ("radius", "depth")
    units = ("L", "L")

    def __call__(self, mesh):
        raise MeasureError("no hole is there")


@dataclass(frozen=True)
class Calls:
    """Measure that counts its calls, and one value that is not a number."""

    names = ("length", "nothing", "angle")
    units = ("L", "L", "deg")

    def __call__(self, mesh):
        CALLS.append(1)
        return np.array([mesh.extents[0], np.nan, 30.0])


CALLS = []


class Mine:
    @hookimpl
    def lampopt_measures(self):
        return {"gone": Hole, "calls": Calls}

    @hookimpl
    def lampopt_decoders(self):
        return {"grid": GridSDF}


PLUGINS = Plugins.load([("mine", Mine())])


@dataclass(frozen=True)
class Net:
    """A small nonlinear field: D = 5·hidden weights, tanh units; `linear` leaves the last layer alone to be mixed."""

    hidden: int = 6
    channels: int = 1

    bounds = BOX

    def evaluate(self, shared, weights, points):
        w = np.asarray(weights, float).reshape(self.channels, 5, self.hidden)
        hidden = np.tanh(np.einsum("mi,cih->cmh", points, w[:, :3]) + w[:, 3:4])
        return np.einsum("cmh,ch->mc", hidden, w[:, 4])


@dataclass(frozen=True)
class Linear:
    """Field that is linear in four weights, exact in float32 for small fractions of powers of two."""

    bounds = BOX

    def evaluate(self, shared, weights, points):
        return (np.column_stack([points, np.ones(len(points))]) @ np.asarray(weights, float))[:, None]


def bank_of(decoder, weights, points, **changes):
    n = len(weights)
    weights = np.asarray(weights, np.float32)
    given = {
        "space": (Parameter("length", "m", 1.0, 2.0),),
        "parameters": np.linspace(1, 2, n)[:, None],
        "label_space": (),
        "labels": np.empty((n, 0)),
        "names": tuple(f"e{i}" for i in range(n)),
        "weights": weights,
        "shared": {},
        "frame": Frame(0.5, np.array([0.1, 0.2, 0.3])),
        "decoder": Spec("none"),
        "probes": points,
        "probe_values": np.stack([decoder.evaluate({}, w, points) for w in weights]),
        "fit_error": np.zeros(n),
    }
    return Bank(**(given | changes))


def affine(seed, n):
    alpha = np.random.default_rng(seed).normal(size=n)
    return alpha + (1 - alpha.sum()) / n


def paper(decoder, bank, alpha):
    """N + 1 passes, point by point: |f(z; Σ alpha_i w_i) − Σ alpha_i f(z; w_i)| and both sides."""
    mixed = sum(a * w for a, w in zip(alpha, bank.weights.astype(float), strict=True))
    left = np.array([decoder.evaluate({}, mixed, z[None])[0] for z in bank.probes])
    right = sum(
        a * np.array([decoder.evaluate({}, w, z[None])[0] for z in bank.probes])
        for a, w in zip(alpha, bank.weights, strict=True)
    )
    return np.sqrt(((left - right) ** 2).sum(-1)), left, right


@pytest.mark.parametrize("seed", range(5))
def test_mismatch_is_the_papers_formula(seed):
    draw, decoder = np.random.default_rng(seed), Net()
    bank = bank_of(decoder, draw.normal(0, 0.5, (7, 30)), draw.uniform(-1, 1, (200, 3)))
    alpha = affine(seed, 7)
    gap, left, right = paper(decoder, bank, alpha)
    box, band = mismatches(bank, decoder, alpha, mixed_weights(bank, alpha))
    assert box == pytest.approx(gap.mean(), abs=1e-6)
    assert box > 0.01  # not by being nothing
    near = (np.minimum(np.abs(left), np.abs(right)) <= BAND)[:, 0]
    assert near.any()
    assert band == pytest.approx(gap[near].mean(), abs=1e-5)


def test_a_linear_decoder_has_none_at_all():
    draw = np.random.default_rng(0)
    weights, points = draw.integers(-8, 9, (4, 4)) / 8, draw.integers(-16, 17, (50, 3)) / 16
    bank = bank_of(Linear(), weights, points)
    alpha = np.array([2.0, -1.5, 1.0, -0.5])
    box, _ = mismatches(bank, Linear(), alpha, mixed_weights(bank, alpha))
    assert box == 0.0


def test_a_one_hot_mix_has_none():
    draw = np.random.default_rng(1)
    bank = bank_of(Net(), draw.normal(size=(3, 30)), draw.uniform(-1, 1, (100, 3)))
    for alpha in np.eye(3):
        assert mismatches(bank, Net(), alpha, mixed_weights(bank, alpha))[0] < 1e-6


def test_three_channels_have_no_band():
    draw, decoder = np.random.default_rng(2), Net(channels=3)
    bank = bank_of(decoder, draw.normal(0, 0.5, (4, 90)), draw.uniform(-1, 1, (60, 3)))
    alpha = affine(2, 4)
    gap, _, _ = paper(decoder, bank, alpha)
    box, band = mismatches(bank, decoder, alpha, mixed_weights(bank, alpha))
    assert box == pytest.approx(gap.mean(), abs=1e-6)  # the Euclidean length of the gap
    assert np.isnan(band)
    made = made_of(bank, alpha)
    assert [c.name for c in field_checks(bank, decoder, made, Limits.of(bank, {}))] == ["mismatch"]


def test_no_probe_near_the_surface_has_no_band():
    points = np.array([[0.5, 0, 0], [0.9, 0, 0]])
    bank = bank_of(Linear(), np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0.5]]), points)
    alpha = np.array([0.5, 0.5])
    assert np.isnan(mismatches(bank, Linear(), alpha, mixed_weights(bank, alpha))[1])


def made_of(bank, alpha, mesh=None):
    mix = Mix(alpha, np.zeros(1), "exact")
    return Design({"length": 1.0}, mix, alpha @ bank.parameters, mixed_weights(bank, alpha), lambda: mesh)


def test_field_checks_say_value_limit_and_where():
    draw = np.random.default_rng(3)
    bank = bank_of(Net(), draw.normal(0, 0.5, (5, 30)), draw.uniform(-1, 1, (200, 3)))
    alpha = affine(3, 5)
    checks = field_checks(bank, Net(), made_of(bank, alpha), Limits.of(bank, {"mismatch": 100.0}))
    assert [(c.name, c.sense, c.limit, c.unit, c.needs) for c in checks] == [
        ("mismatch", "<=", 100.0, "box", "field"),
        ("mismatch.band", "<=", 0.01, "box", "field"),
    ]
    assert [c.passed for c in checks] == [True, False]
    assert [c.value for c in checks] == list(mismatches(bank, Net(), alpha, mixed_weights(bank, alpha)))


def boxes(lengths=(0.8, 1.0, 1.2), width=0.5, height=0.4, unit="m", parameter_unit="m", factor=1.0):
    """Boxes with their length, width and height as parameters."""
    rows = np.array([(length, width, height) for length in lengths])
    space = tuple(Parameter(name, parameter_unit) for name in ("length", "width", "height"))
    meshes = [shapes.box(row) for row in rows]
    measured = {name: f"extents.{name}" for name in ("length", "width", "height")}
    names = tuple(f"box {row[0]:g}" for row in rows)
    return Exemplars(rows * factor, space, meshes, names, unit=unit, measured=measured)


@pytest.fixture(scope="module")
def grid_bank():
    return build_bank(boxes(), Spec("grid", size=40), probes=2000, plugins=PLUGINS)


LOOSE = {"alpha": 10.0}  # so that the mesh has to speak


def test_the_dog_bone_is_rejected_though_its_mismatch_is_nothing(grid_bank):
    result = design(grid_bank, {"length": 1.9}, limits=LOOSE, resolution=64, plugins=PLUGINS)
    assert result.check("mismatch").value < 1e-6
    assert result.check("mismatch.band").value < 1e-6
    assert result.check("drift.length").passed  # the target itself is hit
    assert result.design.mesh.extents[0] == pytest.approx(1.9, abs=0.05)
    for name, true in (("width", 0.5), ("height", 0.4)):
        check = result.check(f"drift.{name}")
        assert not check.passed
        assert check.value > 0.5 * true  # the ends flare to well over half as wide again
        assert check.limit == pytest.approx(0.05 * true)  # no spread: a part of the value itself
        assert check.note.endswith(f"predicted {true:g}")
    assert not result.accepted
    assert {c.name for c in result.checks if not c.passed} == {"drift.width", "drift.height"}


def test_the_same_boxes_within_the_range_are_accepted(grid_bank):
    result = design(grid_bank, {"length": 1.1}, resolution=64, plugins=PLUGINS)
    assert result.accepted, [c for c in result.checks if not c.passed]
    assert result.design.mesh.extents == pytest.approx([1.1, 0.5, 0.4], abs=0.02)


def test_far_from_the_exemplars_alpha_alone_rejects(grid_bank):
    result = design(grid_bank, {"length": 2.6}, level="alpha", plugins=PLUGINS)
    check = result.check("alpha")
    # rows (-1, 0, 1): beta = t/2 (-1, 0, 1) with t = (2.6 - 1) / 0.2 = 8, so its length is 8 / √2
    assert check.value == pytest.approx(8 / np.sqrt(2))
    assert not check.passed
    assert not result.accepted


def test_a_box_too_long_for_the_decoders_box_is_cut(grid_bank):
    result = design(grid_bank, {"length": 2.1}, limits=LOOSE, resolution=48, plugins=PLUGINS)
    check = result.check("clearance")
    assert check.value == pytest.approx(0.5, abs=0.01)  # closed half a cell inside
    assert not check.passed
    assert result.check("watertight").passed


def told(mix, posed=None, bank=None, **limits):
    bank = bank or bank_of(Linear(), np.zeros((3, 4)), np.zeros((1, 3)))
    posed = posed or pose(bank, {"length": 1.5})
    return {check.name: check for check in alpha_checks(posed, mix, Limits.of(bank, limits))}


def test_unmet_targets_are_told_by_the_worst_row():
    middle = np.full(3, 1 / 3)
    checks = told(Mix(middle, np.array([0.1, -0.3, 0.2]), "inexact", "held off"))
    target = checks["target"]
    assert (target.value, target.limit, target.passed, target.note) == (0.3, 0.02, False, "held off")
    assert checks["alpha"].value == pytest.approx(0, abs=1e-12)
    assert {check.needs for check in checks.values()} == {"alpha"}
    assert told(Mix(middle, np.array([-0.3]), "inexact"), target=0.5)["target"].passed
    assert told(Mix(middle, np.zeros(1), "exact"))["target"].passed


def test_a_solver_that_gave_up_is_no_answer():
    checks = told(Mix(np.full(3, 1 / 3), np.zeros(1), "failed", "no progress"))
    assert not checks["solved"].passed
    assert checks["solved"].note == "no progress"
    for status in ("exact", "inexact", "infeasible"):
        assert told(Mix(np.full(3, 1 / 3), np.zeros(1), status))["solved"].passed


def test_hard_targets_have_no_room():
    bank = bank_of(Linear(), np.zeros((3, 4)), np.zeros((1, 3)), measured_by={"length": "extents.length"},
                   measured=np.array([[1.0], [2.0], [1.5]]))  # fmt: skip
    posed = pose(bank, {"length": 1.5, "extents.length": 1.5}, hard=["extents.length"])
    near = Mix(np.full(3, 1 / 3), np.array([0.01, 0.0]), "inexact")
    assert told(near, posed, bank)["hard"].passed
    assert told(near, posed, bank)["target"].passed
    off = told(Mix(np.full(3, 1 / 3), np.array([0.0, 0.01]), "inexact"), posed, bank)
    assert off["target"].passed
    assert not off["hard"].passed
    assert "hard" not in told(near)


@pytest.mark.parametrize(("alpha", "outside"), [([0, 1, 0], 0), ([1, 0, 0], 0.4), ([0, 0, 1], 0.4), ([0, -1, 2], 1.4)])
def test_ranges_are_judged_though_no_solver_kept_them(alpha, outside):
    bank = bank_of(Linear(), np.zeros((3, 4)), np.zeros((1, 3)))  # lengths 1, 1.5, 2: -1, 0, 1 over the bank
    posed = pose(bank, {}, ranges={"length": (1.2, 1.8)})
    check = told(Mix(np.array(alpha, float), np.zeros(0), "exact"), posed, bank)["range"]
    assert check.value == pytest.approx(outside, abs=1e-12)
    assert check.passed == (outside == 0)
    assert ("length (range)" in check.note) == (outside > 0)
    assert "range" not in told(Mix(np.array(alpha, float), np.zeros(1), "exact"))


def test_alpha_is_counted_from_the_reference():
    bank = bank_of(Linear(), np.zeros((3, 4)), np.zeros((1, 3)))
    away = Mix(np.array([1.0, 0, 0]), np.zeros(1), "exact")
    posed = pose(bank, {"length": 1.0}, reference="e2")
    assert told(away, posed, bank)["alpha"].value == pytest.approx(np.sqrt(2))


def test_limits_are_the_studys_then_the_banks_then_the_defaults():
    bank = bank_of(
        Linear(), np.zeros((3, 4)), np.zeros((1, 3)), measured_by={"length": "extents.length"},
        measured=np.ones((3, 1)), limits={"mismatch": 0.2, "drift.length": 0.3, "alpha": 7.0},
    )  # fmt: skip
    limits = Limits.of(bank, {"mismatch": 0.1, "target": 0.5})
    assert limits["mismatch"] == 0.1
    assert limits["target"] == 0.5
    assert limits["alpha"] == 7.0
    assert limits["clearance"] == DEFAULTS["clearance"]
    assert limits["mismatch.band"] == DEFAULTS["mismatch.band"]
    # drift holds for every parameter without a limit of its own, the study's before the bank's
    assert limits["drift.length"] == 0.3
    assert limits["drift"] == DEFAULTS["drift"]
    assert Limits.of(bank, {"drift": 0.01})["drift.length"] == 0.01
    assert Limits.of(bank, {"drift": 0.01, "drift.length": 0.02})["drift.length"] == 0.02
    # the band has a limit of its own, which one for the whole box does not touch
    assert Limits.of(bank, {"mismatch": 0.5})["mismatch.band"] == DEFAULTS["mismatch.band"]
    assert Limits.of(bank, {"drift.length": 0.01})["drift.length"] == 0.01
    plain = replace(bank, limits={})
    assert Limits.of(plain, {})["drift.length"] == DEFAULTS["drift"]
    assert Limits.of(plain, {"drift": 0.01})["drift.length"] == 0.01


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, True, "0.1"])
def test_a_limit_is_a_number_of_at_least_nothing(bad):
    bank = bank_of(Linear(), np.zeros((3, 4)), np.zeros((1, 3)))
    with pytest.raises(StudyError, match="limits: alpha: expected a finite number of at least 0"):
        Limits.of(bank, {"alpha": bad})
    with pytest.raises(BankError, match="limits of the bank: alpha: expected a finite number of at least 0"):
        Limits.of(replace(bank, limits={"alpha": bad}), {})
    with pytest.raises(BankError, match="limits of the bank: unknown alhpa"):
        Limits.of(replace(bank, limits={"alhpa": 1.0}), {})


@pytest.mark.parametrize("name", ["mismach", "drift.width", "watertight", ""])
def test_a_limit_for_no_check_is_refused(name):
    bank = bank_of(
        Linear(), np.zeros((3, 4)), np.zeros((1, 3)),
        measured_by={"length": "extents.length"}, measured=np.ones((3, 1)),
    )  # fmt: skip
    with pytest.raises(StudyError, match=f"limits: unknown {name}; known are alpha, .*drift.length"):
        Limits.of(bank, {name: 1.0})


def plain_bank(**changes):
    """A bank in whose frame the box [-1, 1]³ is 4 m wide about (0.1, 0.2, 0.3)."""
    facts = {"mesh_facts": {"bodies": 1, "genus": 0}}
    return bank_of(Linear(), np.zeros((3, 4)), np.zeros((1, 3)), **(facts | changes))


def judged(mesh, bank=None, decoder=None, resolution=40, limits=None):
    bank = bank or plain_bank()
    made = made_of(bank, np.full(3, 1 / 3), mesh)
    found = mesh_checks(bank, decoder or Linear(), made, resolution, Limits.of(bank, limits or {}), PLUGINS)
    return {check.name: check for check in found}


def failed(checks):
    return {name for name, check in checks.items() if not check.passed}


def test_a_sound_mesh_passes():
    checks = judged(shapes.box((1, 1, 1)))
    assert list(checks) == ["mesh", "watertight", "bodies", "genus", "clearance"]
    assert not failed(checks)
    assert all(check.needs == "mesh" for check in checks.values())
    assert checks["mesh"].value == 12 * 4**2


@pytest.mark.parametrize("mesh", [None, trimesh.Trimesh()], ids=["none", "without faces"])
def test_no_mesh_is_one_failed_check(mesh):
    checks = judged(mesh, plain_bank(measured_by={"length": "extents.length"}, measured=np.ones((3, 1))))
    assert failed(checks) == set(checks) == {"mesh"}
    assert checks["mesh"].note == "the field has no surface"


def test_an_open_mesh():
    mesh = shapes.box()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    checks = judged(mesh)
    assert failed(checks) == {"watertight", "genus"}
    assert np.isnan(checks["genus"].value)


def test_a_flipped_face():
    mesh = shapes.box()
    faces = np.array(mesh.faces)
    faces[3] = faces[3][::-1]
    assert failed(judged(trimesh.Trimesh(mesh.vertices, faces, process=False))) == {"watertight", "genus"}


def test_a_mesh_turned_inside_out():
    mesh = shapes.box()
    mesh.invert()
    checks = judged(mesh)
    assert failed(checks) == {"watertight"}
    assert checks["watertight"].note == "faces point inward"


def test_a_body_too_many():
    apart = shapes.box((0.3, 0.3, 0.3), centre=(1, 1, 1))
    checks = judged(trimesh.util.concatenate([shapes.box(), apart]))
    assert failed(checks) == {"bodies"}
    assert (checks["bodies"].value, checks["bodies"].limit, checks["bodies"].sense) == (2, 1, "=")


def test_a_hole_too_many():
    checks = judged(shapes.plate_with_hole())
    assert failed(checks) == {"genus"}
    assert checks["genus"].value == 1
    assert not failed(judged(shapes.plate_with_hole(), plain_bank(mesh_facts={"bodies": 1, "genus": 1})))


def test_what_the_exemplars_differ_in_only_informs():
    checks = judged(shapes.plate_with_hole(), plain_bank(mesh_facts={}))
    assert checks["genus"].sense == checks["bodies"].sense == "info"
    assert not failed(checks)


@pytest.mark.parametrize(("room", "good"), [(1.6, True), (1.4, False), (0.5, False)])
def test_clearance_is_counted_in_cells_of_the_decoders_box(room, good):
    # 40 cells of 0.1 m over 4 m about (0.1, 0.2, 0.3): the box's upper wall is at y = 2.2
    mesh = shapes.box((1, 1, 1), centre=(0.1, 2.2 - room * 0.1 - 0.5, 0.3))
    check = judged(mesh)["clearance"]
    assert check.value == pytest.approx(room)
    assert check.unit == "cells"
    assert check.passed == good
    below = shapes.box((1, 1, 1), centre=(0.1, 0.2, -1.7 + room * 0.1 + 0.5))
    assert judged(below)["clearance"].value == pytest.approx(room)


def test_templates_are_not_cut_by_a_box():
    bank = bank_of(Net(channels=3), np.zeros((3, 90)), np.zeros((1, 3)))
    assert "clearance" not in judged(shapes.box(), bank, Net(channels=3))


def measuring(by, values, unit="m", **changes):
    """A bank of three whose parameter `length` is measured by `by` as `values` on the exemplars."""
    return plain_bank(
        space=(Parameter("length", unit, 1.0, 2.0),), measured_by={"length": by}, measured=np.array(values)[:, None],
        **changes,
    )  # fmt: skip


def drift(bank, alpha, mesh, **limits):
    (check,) = drift_checks(bank, np.array(alpha), mesh, Limits.of(bank, limits), PLUGINS)
    return check


def test_drift_is_what_is_measured_against_what_is_mixed():
    bank = measuring("extents.length", [1.0, 1.5, 2.0])
    check = drift(bank, [-1.0, 0, 2.0], shapes.box((3.02, 1, 1)))
    assert check.name == "drift.length"
    assert check.value == pytest.approx(0.02)  # 3.02 against 2·2 − 1·1
    assert check.limit == pytest.approx(0.05 * 1.0)
    assert check.passed
    assert check.note == "extents.length 3.02, predicted 3"
    assert not drift(bank, [-1.0, 0, 2.0], shapes.box((2.9, 1, 1))).passed  # too short is drift, too
    assert not drift(bank, [-1.0, 0, 2.0], shapes.box((3.02, 1, 1)), **{"drift.length": 0.01}).passed
    assert drift(bank, [-1.0, 0, 2.0], shapes.box((2.9, 1, 1)), drift=0.2).passed


def test_an_offset_between_parameter_and_measurement_is_no_drift():
    bank = measuring("extents.length", [11.0, 11.5, 12.0])  # the parameter says 1 to 2
    check = drift(bank, [0.5, 0, 0.5], shapes.box((11.5, 1, 1)))
    assert check.value == pytest.approx(0)


def test_a_parameter_in_millimetres_on_a_mesh_in_metres():
    bank = measuring("extents.length", [1000.0, 1500.0, 2000.0], "mm")
    check = drift(bank, [0, 1.0, 0], shapes.box((1.52, 1, 1)))
    assert check.unit == "mm"
    assert check.value == pytest.approx(20)
    assert check.limit == pytest.approx(50)
    assert check.note == "extents.length 1520, predicted 1500"


def test_an_area_in_square_centimetres_on_a_mesh_in_millimetres():
    bank = measuring("area.area", [6.0, 7.0, 8.0], "cm^2", frame=Frame(0.1, np.zeros(3), "mm"))
    check = drift(bank, [1.0, 0, 0], shapes.box((10, 10, 10)))  # 600 mm²
    assert check.value == pytest.approx(0, abs=1e-9)


def test_units_come_right_through_a_whole_bank():
    bank = build_bank(
        boxes(unit="m", parameter_unit="mm", factor=1000.0), Spec("grid", size=24), probes=200, plugins=PLUGINS
    )
    np.testing.assert_allclose(bank.measured, bank.parameters)
    result = design(bank, {"length": "1.1 m"}, resolution=48, plugins=PLUGINS)
    check = result.check("drift.length")
    assert (check.unit, check.passed) == ("mm", True)
    assert "predicted 1100" in check.note


def test_a_unit_that_cannot_be_brought_over_is_an_error():
    with pytest.raises(InputError, match=r"extents.length: cannot bring \[m\] to \[kg\]"):
        drift(measuring("extents.length", [1.0, 1.5, 2.0], "kg"), [1.0, 0, 0], shapes.box())


def test_a_feature_that_is_gone_is_a_failed_check():
    check = drift(measuring("gone.radius", [1.0, 1.5, 2.0]), [1.0, 0, 0], shapes.box())
    assert np.isnan(check.value)
    assert not check.passed
    assert check.note == "gone.radius: no hole is there"


def test_a_measure_that_says_nan_does_not_pass():
    check = drift(measuring("calls.nothing", [1.0, 1.5, 2.0]), [1.0, 0, 0], shapes.box())
    assert not check.passed


def test_a_measure_is_called_once_for_all_its_values():
    bank = plain_bank(
        space=(Parameter("a", "m", 1, 2), Parameter("b", "rad", 0, 1)), parameters=np.zeros((3, 2)),
        measured_by={"a": "calls.length", "b": "calls.angle"}, measured=np.array([[1, 0.4], [1.5, 0.5], [2, 0.6]]),
    )  # fmt: skip
    CALLS.clear()
    a, b = drift_checks(bank, np.array([1.0, 0, 0]), shapes.box((1, 1, 1)), Limits.of(bank, {}), PLUGINS)
    assert len(CALLS) == 1
    assert a.value == pytest.approx(0)
    assert b.value == pytest.approx(np.pi / 6 - 0.4)  # 30 degrees in the parameter's radians


def test_no_spread_and_no_value_leaves_room_for_rounding_alone():
    check = drift(measuring("extents.length", [0.0, 0.0, 0.0]), [1.0, 0, 0], shapes.box((1, 1, 1)))
    assert 0 < check.limit < 1e-5
    assert not check.passed


def made(*names):
    return {name: PLUGINS.make("measure", name) for name in names}


def test_wanted_measures_inform_and_judge_nothing():
    bank = plain_bank(frame=Frame(1.0, np.zeros(3), "mm"))
    found = measure_checks(bank, shapes.box((1, 2, 3)), made("extents", "volume", "gone"))
    assert [(c.name, c.value, c.unit) for c in found[:4]] == [
        ("extents.length", 1, "mm"), ("extents.width", 2, "mm"), ("extents.height", 3, "mm"),
        ("volume.volume", pytest.approx(6), "mm^3"),
    ]  # fmt: skip
    assert all(c.passed and c.sense == "info" for c in found)
    assert np.isnan(found[4].value)
    assert found[4].note == "no hole is there"
    assert all(np.isnan(c.value) for c in measure_checks(bank, trimesh.Trimesh(), made("extents")))


class Own:
    """A decoder with a check of its own."""

    bounds = BOX

    def __getattr__(self, name):
        return getattr(Linear(), name)

    def design_checks(self, shared, weights, mesh):
        reach = float(np.abs(mesh.vertices).max())  # in the decoder's box
        return [Check("own.reach", reach, "<=", 0.3, "box", "mesh")]


def test_a_decoders_own_checks_see_the_mesh_in_its_box():
    mesh = shapes.box((1, 1, 1), centre=(0.1, 0.2, 0.3))
    check = judged(mesh, decoder=Own())["own.reach"]
    assert check.value == pytest.approx(0.25)  # half a metre, two metres to the box
    assert check.passed


@dataclass(frozen=True)
class Asked:
    needs: str

    def __call__(self, bank, design):
        return [Check(f"asked.{self.needs}", 0.0, "info", None, "", self.needs)]


def test_strangers_speak_at_their_own_level():
    bank = plain_bank()
    made = made_of(bank, np.full(3, 1 / 3))
    checkers = {"a": Asked("alpha"), "b": Asked("mesh"), "c": Asked("alpha")}
    assert [c.name for c in stranger_checks(bank, made, checkers, "mesh")] == ["asked.mesh"]
    assert len(stranger_checks(bank, made, checkers, "alpha")) == 2
    assert not stranger_checks(bank, made, checkers, "field")


@pytest.mark.parametrize(
    ("sense", "limit", "values"),
    [
        ("<=", 1.0, {0.5: True, 1.0: True, 1.5: False}),
        (">=", 1.0, {0.5: False, 1.0: True, 1.5: True}),
        ("=", 1.0, {0.5: False, 1.0: True}),
        ("info", None, {0.5: True, float("nan"): True}),
    ],
)
def test_senses(sense, limit, values):
    for value, passed in values.items():
        assert Check("c", value, sense, limit, "", "mesh").passed is passed
    if limit is not None:
        assert not Check("c", float("nan"), sense, limit, "", "mesh").passed
        with pytest.raises(InputError, match="a limit belongs to every sense but info"):
            Check("c", 1.0, sense, None, "", "mesh")
    else:
        with pytest.raises(InputError, match="a limit belongs to every sense but info"):
            Check("c", 1.0, sense, 1.0, "", "mesh")


@pytest.mark.parametrize("answer", [None, 3.0, [1.0, 2.0], ["a"], [[1.0]]], ids=repr)
def test_a_measure_that_answers_garbage_is_named(answer):
    class Garbage:
        names, units = ("size",), ("L",)

        def __call__(self, mesh):
            return answer

    with pytest.raises(PluginError, match="garbage"):
        values_of("garbage", Garbage(), shapes.box([1, 1, 1]))


anything = st.floats() | st.sampled_from([0.0, -0.0, 1.0, np.nextafter(1, 2), 5e-324])


@settings(deadline=None)
@given(st.sampled_from(["<=", ">=", "="]), anything, st.floats(allow_nan=False) | st.sampled_from([0.0, 1.0]))
def test_a_score_of_at_most_one_is_a_check_that_passes(sense, value, limit):
    check = Check("a", value, sense, limit, "", "alpha")
    assert (check.score <= 1) == check.passed
    assert check.score >= 0


def test_scores_in_closed_form():
    def score(value, sense, limit):
        return Check("a", value, sense, limit, "", "alpha").score

    assert score(0.5, "<=", 2.0) == 0.25
    assert score(3.0, "<=", 2.0) == 1.5
    assert score(3.0, ">=", 1.5) == 0.5
    assert score(1.0, ">=", 1.5) == 1.5
    assert (score(1.0, "=", 1.0), score(0.0, "=", 1.0)) == (0.0, np.inf)
    assert (score(0.0, "<=", 0.0), score(1e-9, "<=", 0.0)) == (0.0, np.inf)
    assert score(np.nan, "<=", 2.0) == np.inf
    assert score(7.0, "info", None) == 0.0


def test_a_result_is_as_bad_as_its_worst_check():
    result = design(small.bank(), {"length": 2.3}, plugins=small.plugins())
    assert result.score == max(check.score for check in result.checks)
    worse = Result(result.design, (*result.checks, Check("own", 3.0, "<=", 1.0, "", "mesh")))
    assert (worse.score, worse.accepted) == (3.0, False)
    assert Result(result.design, ()).score == 0.0


@pytest.mark.parametrize(("off", "passed"), [(0.0, True), (1e-8, True), (1e-3, False)])
def test_a_measured_parameter_that_is_nought_on_all_exemplars_drifts_by_more_than_rounding(off, passed):
    """Its range tells no scale: single precision's part of the frame does."""

    class Place:
        names, units = ("x",), ("L",)

        def __call__(self, mesh):
            return np.array([off])

    class Offer:
        @hookimpl
        def lampopt_measures(self):
            return {"place": Place}

    plain = small.boxes(count=3)
    at, space = np.column_stack([plain.parameters, np.zeros(3)]), (*plain.space, Parameter("middle", "m"))
    plugins = small.plugins(("place", Offer()))
    bank = small.bank(replace(plain, parameters=at, space=space, measured={"middle": "place.x"}), plugins=plugins)
    bank = replace(bank, measured=np.zeros((3, 1)))
    assert lampopt.run(lampopt.Study(bank, {"length": 2.3}), plugins=plugins).check("drift.middle").passed == passed
