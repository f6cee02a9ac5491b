"""What surrounds a design: against closed forms on boxes, and against designs made one by one."""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import cli, explore
from lampopt.errors import MeasureError, StudyError
from lampopt.plugins import Plugins
from lampopt.types import Check, Mix, MixBatch

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402
import toys  # noqa: E402

FREE = {"alpha": 1e9, "mismatch": 1e9, "mismatch.band": 1e9}
STEP = 1e-3  # of the range: how exactly an end is known


@dataclass(frozen=True)
class Curved:
    """Solver: alpha as by `KKT`, bent by the square of the targets along a direction that sums to zero."""

    def solve(self, p):
        mix = toys.KKT().solve(p)
        way = np.zeros(len(mix.alpha))
        way[:2] = 1, -1
        return Mix(mix.alpha + (p.target @ p.target) * way, mix.residual, "inexact")

    def solve_many(self, p, targets, ridges=None):
        mixes = [self.solve(replace(p, target=t)) for t in targets]
        return MixBatch(
            np.stack([m.alpha for m in mixes]), np.stack([m.residual for m in mixes]), ("exact",) * len(mixes)
        )


@dataclass(frozen=True)
class Gap:
    """Checker: no length between 2.6 and 2.9 is liked."""

    needs = "alpha"

    def __call__(self, bank, design):
        return [Check("gap", float(2.6 < design.predicted[0] < 2.9), "=", 0.0, "", "alpha")]


@dataclass(frozen=True)
class License:
    """Checker: the fourth time that it is asked its server is down."""

    needs = "alpha"

    def __call__(self, bank, design):
        ASKED.append(design)
        if len(ASKED) == 4:
            error = MeasureError("no licence now")
            error.passing = True
            raise error
        return []


ASKED = []
SEEN = {"alpha": [], "mesh": []}


@dataclass(frozen=True)
class Early:
    """Checker: notes how far from the mean a design is that it is asked about."""

    needs = "alpha"

    def __call__(self, bank, design):
        SEEN[self.needs].append(np.linalg.norm(design.mix.alpha - 1 / len(bank)))
        return []


@dataclass(frozen=True)
class Late(Early):
    """The same where there is a mesh."""

    needs = "mesh"


@dataclass(frozen=True)
class Able(toys.Able):
    """Solver that takes ranges, with a ridge of its own."""

    def solve(self, p):
        return super().solve(p if p.ridge is not None else replace(p, ridge=self.ridge))


class More:
    """A plugin with what these tests need besides."""

    @lampopt.hookimpl
    def lampopt_solvers(self):
        return {"curved": Curved, "able": Able, "ridged": toys.KKT}

    @lampopt.hookimpl
    def lampopt_checks(self):
        return {"gap": Gap, "early": Early, "late": Late, "licence": License}


PLUGINS = small.plugins(("more", More()))


def bank(**kinds):
    return small.bank(plugins=PLUGINS, **kinds)


@pytest.fixture(scope="module")
def boxes():
    return bank()


def found(study, level="alpha", **more):
    return explore(study, level=level, plugins=PLUGINS, **more)


def at(study, exploration, name, value, level):
    """The study's own design with one parameter elsewhere and the others as they are."""
    design = exploration.design.design
    space = study.opened().space
    held = {q.name: float(v) for q, v in zip(space, design.predicted, strict=True)}
    others = {key: value for key, value in study.asked(study.opened()).items() if key not in held}
    moved = replace(study, targets={**held, **others, name: value}, keep=(), objective=None, level=level)
    return lampopt.run(moved, plugins=PLUGINS)


def failed(result):
    return next((check.name for check in result.checks if not check.passed), "")


def hold(study, exploration, level):
    """Each end passes; a little beyond it the check that is named is the first to fail."""
    spreads = {q.name: q.spread for q in study.opened().space}
    for interval in exploration.intervals:
        assert interval.low <= interval.value <= interval.high
        for end, by, sign in ((interval.low, interval.low_by, -1), (interval.high, interval.high_by, 1)):
            assert failed(at(study, exploration, interval.name, end, level)) == ""
            beyond = end + 1.01 * sign * STEP * spreads[interval.name]
            if by:
                assert failed(at(study, exploration, interval.name, beyond, level)) == by


# intervals


@pytest.mark.parametrize("reference", [None, "box_3"])
def test_an_end_by_alpha_is_the_closed_form(boxes, reference):
    """‖centre + P̃⁺(p + t e − Pᵀcentre) − centre‖ = limit is a quadratic in t."""
    limit = 1.5
    study = lampopt.Study(boxes, {"length": 2.5}, reference=reference, limits={"alpha": limit})
    seen = found(study)
    centre = np.full(7, 1 / 7) if reference is None else np.eye(7)[3]
    values = boxes.parameters
    inverse = np.linalg.pinv((values - values.mean(0)).T)
    predicted = seen.design.design.predicted
    start = inverse @ (predicted - centre @ values)
    for k, interval in enumerate(seen.intervals):
        way = inverse[:, k]
        roots = np.roots([way @ way, 2 * way @ start, start @ start - limit**2])
        expected = np.sort(predicted[k] + roots.real)
        assert interval.value == predicted[k]
        assert [interval.low, interval.high] == pytest.approx(expected, abs=STEP * np.ptp(values[:, k]))
        assert (interval.low_by, interval.high_by) == ("alpha", "alpha")
        assert expected[0] <= interval.low
        assert interval.high <= expected[1]
    hold(study, seen, "alpha")


def test_where_nothing_is_ever_off_the_search_ends_at_five_ranges(boxes):
    seen = found(lampopt.Study(boxes, {"length": 2.4}, limits=FREE), "field")
    length, width = seen.intervals
    assert (length.name, length.unit, length.low_by, length.high_by) == ("length", "m", "", "")
    assert (length.low, length.high) == pytest.approx((0.0, 5.0))
    assert (width.low, width.high) == pytest.approx((0.2, 2.2))


def test_ends_in_the_field_are_those_of_designs_made_one_by_one():
    limits = {"mismatch": 0.02, "mismatch.band": 0.05, "alpha": 2.5}
    study = lampopt.Study(bank(decoder="stretch-field", probes=200), {"length": 2.45}, limits=limits)
    seen = found(study, "field")
    assert {by for one in seen.intervals for by in (one.low_by, one.high_by)} >= {"mismatch"}
    hold(study, seen, "field")


def test_ends_by_mesh():
    """The box cuts a length when (1 − L scale / 2) is 1.5 cells of 2 / resolution; a box of no size has no surface."""
    made = bank(decoder="stretch-field", probes=20)
    study = lampopt.Study(made, {"width": 1.2, "length": 2.5}, limits=FREE, resolution=64)
    seen = found(study, "mesh")
    length = seen.interval("length")
    assert length.high_by == "clearance"
    assert length.high == pytest.approx((1 - 1.5 * 2 / 64) * 2 / made.frame.scale, abs=STEP)
    assert length.low_by == "mesh"
    assert 0 < length.low <= STEP
    hold(study, seen, "mesh")
    assert found(study, "field").interval("length").high_by == ""


def test_no_mesh_is_made_of_what_fails_before(boxes):
    before = small.CALLS["decode"]
    found(lampopt.Study(boxes, {"length": 2.5}), "field")
    assert small.CALLS["decode"] == before
    for seen in SEEN.values():
        seen.clear()
    found(lampopt.Study(boxes, {"length": 2.5}, limits={"alpha": 1.0}, checks=("early", "late")), "mesh")
    assert max(SEEN["alpha"]) > 1.0
    assert 0.9 < max(SEEN["mesh"]) <= 1.0


def test_a_rejected_design_has_no_room(boxes):
    study = lampopt.Study(boxes, {"length": 9.0}, limits={"alpha": 1.0})
    seen = found(study)
    assert not seen.design.accepted
    for interval in seen.intervals:
        assert interval.low == interval.value == interval.high
        assert (interval.low_by, interval.high_by) == ("alpha", "alpha")
    assert seen.interval("length").value == pytest.approx(9.0)
    assert len(seen.free) == 1


def test_an_interval_is_the_piece_around_the_design(boxes):
    study = lampopt.Study(boxes, {"length": 2.4, "width": 1.2}, limits=FREE, checks=("gap",))
    seen = found(study)
    assert seen.interval("length").high == pytest.approx(2.6, abs=STEP)
    assert seen.interval("length").high_by == "gap"
    assert seen.interval("width").high_by == ""
    above = found(replace(study, targets={"length": 3.0, "width": 1.2}))
    assert above.interval("length").low == pytest.approx(2.9, abs=STEP)


def test_ranges_end_intervals(boxes):
    study = lampopt.Study(
        boxes, {"length": 2.5}, ranges={"width": (1.1, 1.3)}, limits=FREE, solver="able", reference="box_4"
    )
    seen = found(study)
    width = seen.interval("width")
    assert (width.low, width.high) == pytest.approx((1.1, 1.3), abs=0.01)
    assert {width.low_by, width.high_by} <= {"target", "range"}
    assert seen.interval("length").high_by == ""


def test_a_label_that_is_asked_for_is_held(boxes):
    """Among the five that have a drag; drag keeps its value wherever the length goes."""
    study = lampopt.Study(
        boxes, {"length": 2.5}, reference="box_5", objective=lampopt.Reduce("drag", by=0.05), limits={"alpha": 1.5}
    )
    seen = found(study)
    length = seen.interval("length")
    assert length.low < length.value < length.high
    hold(study, seen, "alpha")
    end = at(study, seen, "length", length.high, "alpha").design.mix.alpha
    assert end[[2, 4]] == pytest.approx(0)
    known = [0, 1, 3, 5, 6]
    assert end[known] @ small.DRAG[known] == pytest.approx(0.95 * 0.36)


def test_a_parameter_that_cannot_move_alone_stays(boxes):
    """Three boxes, the drag of which goes with their length and width: it cannot be held."""
    study = lampopt.Study(bank(exemplars=small.boxes(count=4)), {"drag": 0.34})
    seen = found(study)
    assert {one.low_by for one in seen.intervals} == {"target"}
    for one in seen.intervals:
        assert one.high - one.low < 0.1 * (one.high + one.low)


def test_a_ridge_starts_from_what_was_reached(boxes):
    """The design of a solver that gives way lies within its own intervals, at the value that it predicts."""
    study = lampopt.Study(boxes, {"length": 2.6, "width": 1.3}, solver=lampopt.Spec("ridged", ridge=1e-3))
    seen = found(study)
    assert seen.design.design.predicted[0] != pytest.approx(2.6, abs=1e-6)
    for one in seen.intervals:
        assert one.low < one.value < one.high


def test_progress_comes_to_its_end(boxes):
    told = []
    found(lampopt.Study(boxes, {"length": 2.5}), progress=lambda done, _="": told.append(done))
    assert told == sorted(told)
    assert (told[0], told[-1]) == (0.0, 1.0)


# free directions


def test_what_is_free_is_the_closed_form(boxes):
    """With the length asked for, of six free directions one alone changes the box: its width."""
    seen = found(lampopt.Study(boxes, {"length": 2.5}))
    (way,) = seen.free
    rows = np.vstack([np.ones(7), boxes.parameters[:, 0]])
    width = boxes.parameters[:, 1]
    expected = width - np.linalg.pinv(rows) @ (rows @ width)
    largest = np.abs(expected).argmax()
    expected *= np.sign(expected[largest]) / np.linalg.norm(expected)
    assert way == pytest.approx(expected, abs=1e-5)
    moved = np.sqrt((boxes.probes[:, 1] ** 2).mean())  # of a point by a width that is 1 larger
    assert seen.sizes == pytest.approx([abs(way @ width) * moved], rel=1e-5)


def test_a_step_along_a_free_direction_keeps_targets_and_has_its_length(boxes):
    seen = found(lampopt.Study(boxes, {"length": 2.5}))
    design = seen.along(0, "100 mm")
    assert design.predicted[0] == pytest.approx(2.5)
    assert design.mesh.extents[[0, 2]] == pytest.approx([2.5, 0.8], abs=1e-5)
    start = seen.design.design
    change = (boxes.probe_values.T @ (design.mix.alpha - start.mix.alpha)).T / boxes.frame.scale
    assert np.sqrt((change**2).sum(-1).mean()) == pytest.approx(0.1, rel=1e-4)
    wider = design.mesh.extents[1] - start.mesh.extents[1]
    assert abs(wider) == pytest.approx(0.1 / np.sqrt((boxes.probes[:, 1] ** 2).mean()), rel=1e-4)
    back = seen.along(np.int64(0), -0.1)
    assert back.mix.alpha + design.mix.alpha == pytest.approx(2 * start.mix.alpha)
    assert design.target == start.target


@pytest.mark.parametrize(
    "asked",
    [
        {"targets": {"drag": 0.33}},
        {"targets": {"width": 1.2}, "keep": ("length",), "reference": "box_5"},
        {"targets": {"width": 1.2}, "reference": "box_5", "objective": lampopt.Reduce("drag", by=0.1)},
        {},
    ],
)
def test_directions_keep_every_row_and_are_principal(asked):
    """Against a singular value decomposition of all values at once."""
    made = bank(decoder="stretch-field", probes=300)
    study = lampopt.Study(made, **asked)
    seen = found(study)
    active = ~np.isnan(small.DRAG) if any("drag" in str(one) for one in asked.values()) else np.ones(7, bool)
    asked_for = {"length": made.parameters[:, 0], "width": made.parameters[:, 1], "drag": made.labels[:, 0]}
    rows = np.array([np.ones(7), *(asked_for[name] for name in seen.names)])[:, active]
    assert (seen.free[:, ~active] == 0).all()
    assert np.abs(seen.free[:, active] @ rows.T).max() < 1e-12
    assert seen.free @ seen.free.T == pytest.approx(np.eye(len(seen.free)), abs=1e-12)
    values = made.probe_values[active].reshape(active.sum(), -1).astype(float)
    keeping = np.eye(active.sum()) - np.linalg.pinv(rows) @ rows
    strengths = np.linalg.svd(keeping @ values, compute_uv=False) / np.sqrt(300) / made.frame.scale
    count = len(seen.free)
    assert 0 < count <= active.sum() - len(rows)
    assert seen.sizes == pytest.approx(strengths[:count], rel=1e-6)
    assert strengths[count:] == pytest.approx(0, abs=1e-6 / made.frame.scale)
    changes = seen.free[:, active] @ values
    assert changes @ changes.T == pytest.approx(np.diag(300 * (seen.sizes * made.frame.scale) ** 2), abs=1e-9)


def test_nothing_is_free_where_all_is_asked_for(boxes):
    """What is left of alpha changes no box."""
    seen = found(lampopt.Study(boxes, {"length": 2.5, "width": 1.2}))
    assert seen.free.shape == (0, 7)
    assert seen.sizes.shape == (0,)
    with pytest.raises(StudyError, match="nothing is free in this design"):
        seen.along(0, 0.1)


# how alpha follows the targets


def test_alpha_follows_targets_by_the_pseudo_inverse(boxes):
    study = lampopt.Study(boxes, {"length": 2.5, "width": 1.25}, limits=FREE)
    seen = found(study)
    values = boxes.parameters
    assert (seen.names, seen.units) == (("length", "width"), ("m", "m"))
    assert seen.by_target == pytest.approx(np.linalg.pinv((values - values.mean(0)).T), abs=1e-10)
    other = lampopt.run(replace(study, targets={"length": 2.9, "width": 1.25}, level="alpha"), plugins=PLUGINS)
    step = other.design.mix.alpha - seen.design.design.mix.alpha
    assert step == pytest.approx(0.4 * seen.by_target[:, 0], abs=1e-10)


def test_exemplars_without_a_label_do_not_follow_it(boxes):
    seen = found(lampopt.Study(boxes, {"drag": 0.33}))
    known = ~np.isnan(small.DRAG)
    centred = small.DRAG[known] - small.DRAG[known].mean()
    assert seen.by_target[known, 0] == pytest.approx(centred / (centred @ centred))
    assert (seen.by_target[~known] == 0).all()


def test_alpha_follows_targets_less_by_a_ridge(boxes):
    ridge = 0.1
    seen = found(lampopt.Study(boxes, {"length": 2.5, "width": 1.25}, solver=lampopt.Spec("kkt", ridge=ridge)))
    low, spread = boxes.parameters.min(0), np.ptp(boxes.parameters, axis=0)
    rows = (2 * (boxes.parameters - low) / spread - 1).T
    rows -= rows.mean(1, keepdims=True)
    expected = rows.T @ np.linalg.inv(rows @ rows.T + ridge * np.eye(2)) * 2 / spread
    assert seen.by_target == pytest.approx(expected, abs=1e-10)


def test_a_solver_that_bends_is_followed(boxes):
    """d(tᵀt)/dt = 2t in normalised targets, beside the affine part."""
    seen = found(lampopt.Study(boxes, {"length": 2.8, "width": 1.3}, solver="curved", limits=FREE))
    values = boxes.parameters
    low, spread = values.min(0), np.ptp(values, axis=0)
    expected = np.linalg.pinv((values - values.mean(0)).T)
    bent = 2 * (2 * (np.array([2.8, 1.3]) - low) / spread - 1) * 2 / spread
    expected[0] += bent
    expected[1] -= bent
    assert seen.by_target == pytest.approx(expected, abs=1e-8)


def test_nothing_asked_is_nothing_to_follow(boxes):
    seen = found(lampopt.Study(boxes, reference="box_2"))
    assert (seen.names, seen.by_target.shape) == ((), (7, 0))
    assert len(seen.free) == 2
    assert seen.interval("width").value == pytest.approx(1.1)


# what cannot be asked


def test_wrong_input_is_told(boxes):
    study = lampopt.Study(boxes, {"length": 2.5})
    with pytest.raises(StudyError, match=r"study: expected a Study, got 'a\.toml'; read one with Study\.read"):
        explore("a.toml")
    with pytest.raises(StudyError, match="level: expected one of alpha, field, mesh, got 'all'"):
        explore(study, level="all")
    with pytest.raises(StudyError, match="'roof': neither a parameter"):
        found(lampopt.Study(boxes, {"roof": 1.0}))
    seen = found(study)
    with pytest.raises(StudyError, match=r"'drag': expected a parameter .* one of length, width"):
        seen.interval("drag")
    for number in (1, -1, 0.5, True, "0"):
        with pytest.raises(StudyError, match="number: expected a whole number from 0 to 0"):
            seen.along(number, 0.1)
    for step in ("3 deg", float("nan"), None):
        with pytest.raises(StudyError, match="step: "):
            seen.along(0, step)


def test_what_is_found_cannot_be_changed(boxes):
    seen = found(lampopt.Study(boxes, {"length": 2.5}))
    for array in (seen.free, seen.sizes, seen.by_target):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0


# from a shell


@pytest.fixture
def study_file(tmp_path, monkeypatch):
    bank(store=tmp_path / "boxes.lamp")
    monkeypatch.setattr(Plugins, "load", lambda: PLUGINS)
    file = tmp_path / "roof.toml"
    file.write_text('bank = "boxes.lamp"\nlevel = "mesh"\n[targets]\nlength = 2.5\n[limits]\nalpha = 1.5\n')
    return file


def test_the_command_line_tells_the_same(study_file, capsys):
    assert cli.main(["explore", str(study_file), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    seen = found(lampopt.Study.read(study_file), "field")
    assert (told["level"], told["unit"], told["accepted"], told["failed"]) == ("field", "m", True, None)
    for one, interval in zip(told["parameters"], seen.intervals, strict=True):
        assert {**one, "low_by": one["low_by"] or "", "high_by": one["high_by"] or ""} == vars(interval)
    assert [one["size"] for one in told["free"]] == pytest.approx(seen.sizes.tolist())
    assert [list(one["alpha"].values()) for one in told["free"]] == pytest.approx(seen.free)
    (length,) = told["by_target"]
    assert (length["name"], length["unit"]) == ("length", "m")
    assert list(length["alpha"].values()) == pytest.approx(seen.by_target[:, 0].tolist())
    assert list(length["alpha"]) == [f"box_{i}" for i in range(7)]


def test_people_see_tables(study_file, capsys):
    assert cli.main(["explore", str(study_file), "--level", "alpha"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    for words in ("length", "alpha", "box_6", "change of shape [m]"):
        assert words in err


def test_a_rejected_design_is_said(study_file, capsys):
    study_file.write_text(study_file.read_text().replace("2.5", "9.5"))
    assert cli.main(["explore", str(study_file), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["accepted"], told["failed"]) == (False, "alpha")
    assert cli.main(["explore", str(study_file)]) == 1
    assert "REJECTED" in capsys.readouterr().err
    assert cli.main(["explore", str(study_file.parent / "none.toml"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["type"] == "StudyError"


def test_a_check_that_cannot_judge_now_ends_no_range(boxes):
    study = lampopt.Study(boxes, {"length": 2.5}, checks=["licence"])
    ASKED.clear()
    with pytest.raises(MeasureError, match="licence: cannot judge: no licence now") as caught:
        found(study)
    assert caught.value.passing
    assert found(study).interval("length").low < 2.0
