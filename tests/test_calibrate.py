"""Limits by held-out exemplars: against a decoder whose error is known in closed form."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score

import lampopt
from lampopt import Spec, calibrate, design, store_bank
from lampopt.calibrate import _passing, _told_apart, limits_from
from lampopt.check import DEFAULTS, Limits
from lampopt.errors import InputError
from lampopt.holdout import chosen, outermost, own
from lampopt.metrics import surface_distance
from lampopt.testing import shapes
from lampopt.types import Calibration

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402


@dataclass(frozen=True)
class Cubic(small.Linear):
    """Weights are the cube roots of a box's extents: exact on every exemplar, off on every mix."""

    def fit(self, shared, meshes, *, seed, progress=None):
        weights, error = super().fit(shared, meshes, seed=seed, progress=progress)
        return np.hstack([np.cbrt(weights[:, :3]), weights[:, 3:]]), error

    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, _opened(weights), points)

    def decode(self, shared, weights, *, resolution):
        return super().decode(shared, _opened(weights), resolution=resolution)

    def probes(self, shared, count, seed):
        return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


@dataclass(frozen=True)
class Rounded(Cubic):
    """Every box that it fits is a fifth shorter than it was given."""

    def fit(self, shared, meshes, *, seed, progress=None):
        shorter = [shapes.box(mesh.extents * [0.8, 1, 1], centre=mesh.bounds.mean(0)) for mesh in meshes]
        return super().fit(shared, shorter, seed=seed, progress=progress)


def _opened(weights):
    return np.concatenate([weights[..., :3] ** 3, weights[..., 3:]], -1)


class Plugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"cubic": Cubic, "rounded": Rounded}


PLUGINS = small.plugins(("cubic", Plugin()))


@pytest.fixture(scope="module")
def boxes():
    return small.boxes(measured={"length": "size.length"})


@pytest.fixture(scope="module")
def bank(boxes):
    return small.bank(boxes, "cubic", probes=2000, plugins=PLUGINS)


@pytest.fixture(scope="module")
def made(bank, boxes):
    return calibrate(bank, 0.01, exemplars=boxes, plugins=PLUGINS)


def defaults(bank):
    return Limits.of(replace(bank, limits={}), {})


def test_the_evidence_is_the_true_error(bank, made):
    """Every error lies within what the least and the most of the exemplars' cube roots can be off by."""
    found = made.calibration
    assert len(found.errors) >= 2 * len(set(found.exemplars.tolist()))
    assert (found.errors > 0).all()
    assert found.errors.max() > 5 * found.errors.min()
    k = found.checks.index("mismatch")
    assert np.corrcoef(np.argsort(np.argsort(found.values[:, k])), np.argsort(np.argsort(found.errors)))[0, 1] > 0.8
    assert made.provenance["calibrated"] == "0.01 m against the exemplars' meshes"


def test_one_trial_in_closed_form(bank, boxes, made):
    """A box of the mixed extents, built here, is as far from the true one as the evidence says."""
    from lampopt.calibrate import _asked, _trials
    from lampopt.solve import pose, solve

    solver = PLUGINS.make("solver", "kkt")
    for i, (held, among) in enumerate(_trials(bank, solver, 0.02, np.random.default_rng(0))):
        alpha = solve(pose(bank, _asked(bank, held), among=among), solver).alpha
        assert alpha[held] == 0
        assert set(np.flatnonzero(alpha)) <= set(among.tolist())
        extents = (alpha @ np.cbrt(bank.frame.scale * np.array([m.extents for m in boxes.meshes]))) ** 3
        expected = surface_distance(shapes.box(extents / bank.frame.scale), boxes.meshes[held])
        assert made.calibration.exemplars[i] == held
        assert made.calibration.errors[i] == pytest.approx(expected, rel=1e-3)


def test_what_is_accepted_keeps_to_the_tolerance(made):
    """Within the range and beyond it, by the decoder's own closed form."""
    off, accepted = [], []
    for length in np.linspace(1.2, 3.8, 9):
        for width in np.linspace(0.8, 1.6, 7):
            result = design(made, {"length": length, "width": width}, plugins=PLUGINS)
            mesh = result.design.mesh
            off.append(np.inf if mesh is None else surface_distance(mesh, shapes.box([length, width, 0.8])))
            accepted.append(result.accepted)
    off, accepted = np.array(off), np.array(accepted)
    good = off <= made.calibration.tolerance
    assert 0.2 < good.mean() < 0.9
    assert off[accepted].max() < 2 * made.calibration.tolerance
    assert accepted[good].mean() > 0.7


def test_a_looser_tolerance_gives_no_tighter_limit(bank, boxes):
    found = [calibrate(bank, t, exemplars=boxes, plugins=PLUGINS).limits["mismatch"] for t in (0.005, 0.01, 0.02, 0.04)]
    assert found == sorted(found)
    assert found[0] < found[-1]


def test_text_with_a_unit_and_the_file(bank, boxes, tmp_path):
    made = calibrate(bank, "10 mm", store=tmp_path / "a.lamp", plugins=PLUGINS)
    assert made.calibration.tolerance == pytest.approx(0.01)
    assert made.provenance["calibrated"] == "0.01 m against the exemplars' decoded shapes"
    assert small.same(made, lampopt.load_bank(tmp_path / "a.lamp"))
    assert bank.calibration is None  # the bank given is as it was


def test_same_seed_same_limits(bank, boxes, made):
    assert small.same(made, calibrate(bank, 0.01, exemplars=boxes, plugins=PLUGINS))


def test_without_a_bad_design_nothing_is_learned_and_that_is_said(boxes, caplog):
    """An affine decoder is never off: no limit is tightened, none of the mismatch loosened."""
    made = calibrate(small.bank(boxes, "stretch"), 0.003, exemplars=boxes, plugins=small.plugins())
    assert made.calibration.good.all()
    assert made.limits["mismatch"] == DEFAULTS["mismatch"]
    assert made.limits["drift.length"] == DEFAULTS["drift"]
    assert "target" not in made.limits
    assert "no held-out design is off by more than 0.003 m" in caplog.text


def test_rounding_tells_nothing():
    """A mismatch of 1e-8 that is the larger, the worse the design, is no limit: exemplars themselves have as much."""
    values = np.array([[1e-9], [2e-9], [4e-9], [8e-9]])
    found = Calibration(0.003, ("mismatch",), values, np.array([0.001, 0.002, 0.004, 0.008]), np.arange(4))
    assert limits_from(found, Limits.of(small.bank(), {})) == {"mismatch": 2 * DEFAULTS["mismatch"]}
    found = replace(found, values=values * 1e4)
    assert limits_from(found, Limits.of(small.bank(), {}))["mismatch"] == pytest.approx(np.sqrt(2e-5 * 4e-5))


def test_what_a_bank_was_built_from_is_known_again_among_more():
    """A column that rounding alone divides is even in the bank, not where another exemplar differs in it."""
    third = np.array([0.3, 0.1 + 0.2] * 3 + [0.9])
    more = small.boxes()
    space = (*more.space, lampopt.Parameter("third", "m"))
    more = replace(more, parameters=np.column_stack([more.parameters, third]), space=space)
    bank = small.bank(chosen(more, range(6)))
    assert bank.space[2].spread == 0 and more.parameters[1, 2] != bank.parameters[1, 2]
    assert own(bank, more).names == bank.names


def test_one_parameter_at_a_time():
    """Two exemplars a parameter: held out together they could not be asked for, so each is held out alone."""
    low, high, middle = np.array([1.0, 0.5]), np.array([3.0, 1.5]), np.array([2.0, 1.0])
    rows = [middle, [low[0], middle[1]], [high[0], middle[1]], [middle[0], low[1]], [middle[0], high[1]]]
    meshes = [shapes.box([*row, 0.8]) for row in rows]
    found = lampopt.Exemplars(
        np.array(rows), (lampopt.Parameter("length", "m"), lampopt.Parameter("width", "m")), meshes, tuple("abcde")
    )
    made = calibrate(small.bank(found, "cubic", plugins=PLUGINS), 0.05, exemplars=found, plugins=PLUGINS)
    assert set(made.calibration.exemplars.tolist()) == {1, 2, 3, 4}


def test_too_few_exemplars_are_told(boxes):
    few = small.bank(small.boxes(count=3), "cubic", plugins=PLUGINS)
    with pytest.raises(InputError, match="no exemplar can be made by others, so that its 2 parameters are met"):
        calibrate(few, 0.003, plugins=PLUGINS)


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [
        (0, "above 0"),
        (-1, "above 0"),
        (float("nan"), "finite number"),
        ("5 kg", "cannot bring"),
        ("soon", "expected a number or text"),
        (1e-12, "below the error of every held-out exemplar, the least of"),
    ],
)
def test_a_tolerance_that_cannot_be(bank, boxes, tolerance, message):
    with pytest.raises(InputError, match=message):
        calibrate(bank, tolerance, exemplars=boxes, plugins=PLUGINS)


def test_other_exemplars_are_refused(bank, boxes):
    with pytest.raises(InputError, match="in 'm', got 'mm'"):
        calibrate(bank, 0.003, exemplars=small.boxes(unit="mm"), plugins=PLUGINS)
    with pytest.raises(InputError, match="box_6 missing"):
        calibrate(bank, 0.003, exemplars=small.boxes(count=6), plugins=PLUGINS)
    with pytest.raises(InputError, match="got other parameters"):
        calibrate(bank, 0.003, exemplars=small.boxes(scale=1.1), plugins=PLUGINS)
    names = replace(boxes, space=tuple(reversed(boxes.space)), measured={})
    with pytest.raises(InputError, match="got other parameters"):
        calibrate(bank, 0.003, exemplars=names, plugins=PLUGINS)
    larger = [mesh.copy().apply_scale(1.3) for mesh in boxes.meshes]
    with pytest.raises(InputError, match="got other meshes under their names"):
        calibrate(bank, 0.003, exemplars=replace(boxes, meshes=larger), plugins=PLUGINS)


def test_exemplars_may_come_in_another_order_and_be_more(bank, boxes, made):
    rows = [6, 0, 3, 1, 5, 2, 4]
    shuffled = replace(
        boxes,
        parameters=boxes.parameters[rows],
        labels=boxes.labels[rows],
        names=tuple(boxes.names[i] for i in rows),
        meshes=[boxes.meshes[i] for i in rows],
    )
    assert small.same(made, calibrate(bank, 0.01, exemplars=shuffled, plugins=PLUGINS))


def test_the_truth_is_the_meshes_where_they_are_given(boxes):
    """A decoder that makes every box 20 % shorter is a tenth of the length off, though it agrees with itself."""
    bank = replace(small.bank(boxes, "rounded", plugins=PLUGINS), measured_by={}, measured=np.empty((len(boxes), 0)))
    by_itself = calibrate(bank, 0.1, plugins=PLUGINS).calibration.errors
    by_meshes = calibrate(bank, 0.1, exemplars=boxes, plugins=PLUGINS).calibration.errors
    assert np.median(by_itself) < 0.02
    assert np.median(by_meshes) > 0.04


def test_the_solver_named_is_the_one_that_mixes(bank, boxes):
    """A ridge leaves the targets unmet by a little, so its mixes are other mixes."""
    plain = calibrate(bank, 0.01, exemplars=boxes, plugins=PLUGINS).calibration
    ridged = calibrate(bank, 0.01, exemplars=boxes, solver=Spec("kkt", ridge=1e-3), plugins=PLUGINS).calibration
    held = plain.exemplars[0]
    one, other = (c.values[c.exemplars == held][0, c.checks.index("alpha")] for c in (plain, ridged))
    assert one != other
    assert one == pytest.approx(other, rel=0.2)


def test_limits_of_ones_own_that_calibration_does_not_set_are_kept(bank, boxes):
    mine = replace(bank, limits={"clearance": 4.0, "target": 0.001, "mismatch": 0.5})
    limits = calibrate(mine, 0.01, exemplars=boxes, plugins=PLUGINS).limits
    assert (limits["clearance"], limits["target"]) == (4.0, 0.001)
    assert limits["mismatch"] != 0.5


def test_the_outermost_third_and_ties():
    bank = small.bank(plugins=PLUGINS)
    at = 2 * (bank.parameters - bank.parameters.min(0)) / np.ptp(bank.parameters, axis=0) - 1
    away = np.linalg.norm(at, axis=1)
    held = outermost(bank.parameters)
    assert len(held) >= round(len(bank) / 3)
    assert away[held].min() > np.delete(away, held).max()


def evidence(values, errors, tolerance=1.0, checks=("mismatch",)):
    values = np.asarray(values, float).reshape(len(errors), -1)
    return Calibration(tolerance, checks, values, errors, np.zeros(len(errors), int))


def test_where_the_error_passes_the_tolerance(bank):
    """error = 100 · value: the limit lies between the designs on either side of 1."""
    values = np.array([0.002, 0.005, 0.009, 0.0121, 0.02, 0.05])
    found = limits_from(evidence(values, 100 * values), defaults(bank))
    assert found == {"mismatch": pytest.approx(np.sqrt(0.009 * 0.0121))}


def test_a_design_without_a_surface_is_bad(bank):
    values = np.array([0.002, 0.004, 0.006, 0.008])
    found = limits_from(evidence(values, [0.1, 0.2, np.nan, np.nan]), defaults(bank))
    assert 0.004 < found["mismatch"] < 0.006


def test_a_check_that_tells_nothing_is_a_backstop(bank):
    rng = np.random.default_rng(0)
    errors = rng.uniform(0.1, 2, 200)
    found = limits_from(
        evidence(np.column_stack([errors / 100, rng.uniform(1, 4, 200)]), errors, checks=("mismatch", "alpha")),
        defaults(bank),
    )
    assert found["mismatch"] == pytest.approx(0.01, rel=0.05)
    assert 7.5 < found["alpha"] <= 8.0


def test_drift_is_widened_by_good_designs_and_tightened_only_by_bad_ones_that_the_others_let_through(bank):
    mismatch = [0.001, 0.001, 0.001, 0.05, 0.001, 0.001]
    errors = [0.1, 0.2, 0.3, 9.0, 0.2, 0.1]
    names = ("mismatch", "drift.length")
    wide = evidence(np.column_stack([mismatch, [0.01, 0.08, 0.02, 0.5, 0.01, 0.02]]), errors, checks=names)
    assert limits_from(wide, defaults(bank))["drift.length"] == 0.08
    errors = [0.1, 0.2, 0.3, 9.0, 2.0, 3.0]
    tight = evidence(np.column_stack([mismatch, [0.01, 0.012, 0.02, 0.5, 0.03, 0.04]]), errors, checks=names)
    found = limits_from(replace(tight, values=tight.values[:, 1:], checks=names[1:]), defaults(bank))
    assert 0.02 < found["drift.length"] < 0.03


finite = st.floats(1e-6, 1e3)


@settings(deadline=None)
@given(st.lists(st.tuples(finite, finite), min_size=2, max_size=30), finite)
def test_passing_lies_among_the_values(pairs, tolerance):
    values, errors = np.array(pairs).T
    limit = _passing(values, errors, tolerance)
    assert values.min() / 2 * (1 - 1e-9) <= limit <= values.max() * (1 + 1e-9)
    if (errors <= tolerance).all():
        assert limit == values.max()
    if (errors > 1.001 * tolerance).all():
        assert limit == values.min() / 2


@settings(deadline=None)
@given(st.lists(st.tuples(finite, st.booleans()), min_size=2, max_size=40))
def test_told_apart_is_the_area_under_the_roc_curve(pairs):
    values, good = np.array([v for v, _ in pairs]), np.array([g for _, g in pairs])
    if good.all() or not good.any():
        assert _told_apart(values, good) == 0.5
    else:
        assert _told_apart(values, good) == pytest.approx(roc_auc_score(~good, values))


def test_evidence_is_checked():
    with pytest.raises(InputError, match="positive tolerance"):
        evidence([1.0], [1.0], tolerance=0.0)
    with pytest.raises(InputError, match="shape"):
        Calibration(1.0, ("a", "b"), [[1.0]], [1.0], [0])
    with pytest.raises(InputError, match="distinct"):
        Calibration(1.0, ("a", "a"), [[1.0, 2.0]], [1.0], [0])
    with pytest.raises(InputError, match="exemplars from 0 to"):
        replace(small.bank(), calibration=Calibration(1.0, ("a",), [[1.0]], [1.0], [99]))


def test_a_calibrated_bank_is_not_the_same_run(bank, made, tmp_path):
    """Results under other limits are other results."""
    store_bank(bank, tmp_path / "a.lamp")
    one = design(bank, {"length": 2.5}, plugins=PLUGINS)
    two = design(made, {"length": 2.5}, plugins=PLUGINS)
    assert one.check("mismatch").limit != two.check("mismatch").limit
    assert Spec.of(bank.decoder) == made.decoder


def test_limits_of_ones_own_end_the_calibration(boxes, tmp_path):
    """Evidence and limits belong together: what `build_bank` is given replaces both; a plain build leaves both."""

    def build(**options):
        return small.bank(boxes, "cubic", probes=2000, plugins=PLUGINS, store=tmp_path / "a.lamp", **options)

    calibrate(build(), 0.01, exemplars=boxes, store=tmp_path / "a.lamp", plugins=PLUGINS)
    assert build().calibration is not None
    mine = build(limits={"alpha": 1.0})
    assert (mine.calibration, dict(mine.limits)) == (None, {"alpha": 1.0})
    assert "calibrated" not in mine.provenance
