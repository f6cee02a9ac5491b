"""Fronts of accuracy against reliability: against closed forms, and against studies with one ridge each."""

import json
import sys
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import lampopt
from lampopt import Reduce, Study, cli, front
from lampopt.errors import StudyError
from lampopt.pareto import knee
from lampopt.plugins import Plugins
from lampopt.reporting.fronts import picture
from lampopt.types import MixBatch

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402
import toys  # noqa: E402

LOWER = [0.0, 0.05, 0.1, 0.2]


@dataclass(frozen=True)
class Lazy(toys.KKT):
    """Solver that gives up below a ridge of 1."""

    def solve_many(self, p, targets, ridges=None):
        found = super().solve_many(p, targets, ridges)
        lost = np.asarray(ridges) < 1.0
        alpha = np.where(lost[:, None], p.centre, found.alpha)
        return MixBatch(alpha, alpha @ p.matrix.T - targets, tuple(np.where(lost, "failed", found.status).tolist()))


@dataclass(frozen=True)
class Pulled(small.Stretch):
    """Stretches a box by its extents; gradients exact."""

    def pullback(self, shared, weights, mesh, gradient):
        own = (np.asarray(mesh.vertices) - weights[3:]) / weights[:3]
        return np.append((gradient * own).sum(0), gradient.sum(0))


@dataclass(frozen=True)
class Aero:
    """Model: a bowl over length and width, least at (2.55, 1.15), and their product."""

    names, units, inputs = ("bowl", "lift"), ("N", "kg"), ("length", "width")

    def __call__(self, parameters):
        a, b = np.asarray(parameters).T
        return np.stack([(a - 2.55) ** 2 + 4 * (b - 1.15) ** 2 + 0.3, a * b], 1)

    def gradient(self, parameters):
        a, b = np.asarray(parameters).T
        return np.stack([np.stack([2 * (a - 2.55), 8 * (b - 1.15)], 1), np.stack([b, a], 1)], 1)


class More:
    """A plugin with what these tests need besides."""

    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"pulled": Pulled}

    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"mine": toys.Volume}

    @lampopt.hookimpl
    def lampopt_solvers(self):
        return {"toy": toys.KKT, "lazy": Lazy}


def _plugins():
    mine = ("kkt", "casadi", "measure")
    block = [p.name for p in entry_points(group="lampopt") if p.name not in mine]
    return Plugins.load([("small", small.Plugin()), ("more", More())], block=block)


PLUGINS = _plugins()


@pytest.fixture(scope="module")
def boxes():
    return small.bank()


TWO = {"targets": {"length": 3.4, "width": 1.8}}


def study(bank, **changes):
    return lampopt.Study(bank, **(TWO | changes))


def lowering(bank, **changes):
    given = {"targets": {"length": 2.6}, "keep": ("width",), "reference": "box_0"}
    return lampopt.Study(bank, **(given | {"objective": lampopt.Reduce("drag", by=0.1)} | changes))


def found(asked, **more):
    return front(asked, plugins=PLUGINS, **more)


STUDIES = {
    "two rows": {},
    "reference": {"reference": "box_3"},
    "one hard": {"hard": ("width",)},
    "a label": {"targets": {"length": 2.2, "width": 1.5, "drag": 0.25}},
    "one row": {"targets": {"length": 1.0}},
}
every = pytest.mark.parametrize("changes", STUDIES.values(), ids=STUDIES)


@every
@pytest.mark.parametrize("solver", ["kkt", "casadi"])
def test_error_grows_as_distance_shrinks(boxes, changes, solver):
    seen = found(study(boxes, **changes, solver=solver), ridges=40)
    assert len(seen) == 40
    assert (np.diff(seen.ridge) > 0).all()
    assert (np.diff(seen.error) >= -1e-9).all()
    assert "reference" in changes or (np.diff(seen.distance) <= 1e-9).all()
    assert seen.error[-1] > seen.error[0] + 0.1


@every
@pytest.mark.parametrize("solver", ["kkt", "casadi"])
def test_the_ends_are_the_limits(boxes, changes, solver):
    """What is asked, met; and the centre, or of what meets the hard rows the mix nearest to it."""
    asked = study(boxes, **changes, solver=solver)
    seen = found(asked, ridges=20)
    run = lampopt.run(replace(asked, level="alpha"), plugins=PLUGINS)
    assert seen.ridge[0] == 0
    assert seen.alpha[0] == pytest.approx(run.design.mix.alpha, abs=1e-8)
    assert seen.worst[0] == pytest.approx(0, abs=1e-8)
    assert seen.status[0] == "exact"
    hard = {name: value for name, value in asked.targets.items() if name in asked.hard}
    last = lampopt.design(boxes, hard, reference=asked.reference, level="alpha", plugins=PLUGINS).design.mix.alpha
    known = np.ones(7, bool) if "drag" not in asked.targets else ~np.isnan(small.DRAG)
    last = last if known.all() else known / known.sum()
    assert seen.alpha[-1] == pytest.approx(last, abs=1e-4 * seen.distance[0])
    assert (seen.alpha[:, ~known] == 0).all()


@pytest.mark.parametrize("changes", [c for c in STUDIES.values() if "hard" not in c])
def test_the_first_ridge_and_the_last_are_near_the_ends(boxes, changes):
    """A thousandth of the way from what is asked, a millionth from the centre, at most."""
    seen = found(study(boxes, **changes))
    assert seen.error[1] <= 1.001e-3 * seen.error[-1]
    assert seen.error[1] > 1e-6 * seen.error[-1]
    assert seen.distance[-1] <= 1.5e-6 * seen.distance[0]


def test_all_of_it_is_what_alpha_says(boxes):
    asked = study(boxes, targets={"length": 2.2, "width": 1.5, "drag": 0.25})
    seen = found(asked, ridges=10)
    values = np.column_stack([boxes.parameters, np.nan_to_num(boxes.labels)])
    known = ~np.isnan(small.DRAG)
    low, high = np.append(boxes.parameters.min(0), 0.30), np.append(boxes.parameters.max(0), 0.38)
    off = 2 * (seen.alpha @ values - [2.2, 1.5, 0.25]) / (high - low)
    assert (tuple(seen.target), seen.units) == (("length", "width", "drag"), ("m", "m", ""))
    assert seen.error == pytest.approx(np.linalg.norm(off, axis=1))
    assert seen.worst == pytest.approx(np.abs(off).max(1))
    assert seen.distance == pytest.approx(np.linalg.norm(seen.alpha - known / known.sum(), axis=1))
    assert seen.predicted == pytest.approx(seen.alpha @ boxes.parameters)
    assert seen.reached == pytest.approx(seen.alpha @ values)


@every
def test_each_is_the_study_with_that_ridge(boxes, changes):
    asked = study(boxes, **changes)
    seen = found(asked, ridges=9)
    for i in (0, 3, 8):
        alone = replace(asked, solver=lampopt.Spec("kkt", ridge=float(seen.ridge[i])), level="field")
        run = lampopt.run(alone, plugins=PLUGINS)
        assert seen.alpha[i] == pytest.approx(run.design.mix.alpha, abs=1e-12)
        made, judged = seen.design(i), seen.result(i, "field")
        assert (made.mix.alpha == seen.alpha[i]).all()
        assert (made.mix.status, made.mix.message) == (run.design.mix.status, run.design.mix.message)
        assert made.target == run.design.target
        assert [(c.name, c.passed) for c in judged.checks] == [(c.name, c.passed) for c in run.checks]
    assert seen.design(np.int64(0)).mesh.extents[:2] == pytest.approx(seen.predicted[0])
    assert len(seen.result(0).checks) > len(seen.result(0, "alpha").checks)  # the study's own level is mesh


def test_the_solvers_agree(boxes):
    for changes in [{**TWO, **changes} for changes in STUDIES.values()]:
        closed, other = (found(study(boxes, **changes, solver=name), ridges=25) for name in ("kkt", "casadi"))
        assert (closed.ridge == other.ridge).all()
        assert other.alpha == pytest.approx(closed.alpha, abs=1e-6)
        assert closed.knee == other.knee or len(changes["targets"]) == 1  # which is a straight front
        toy = found(study(boxes, **changes, solver="toy"), ridges=closed.ridge[1:])
        assert "reference" in changes or toy.alpha == pytest.approx(closed.alpha[1:], abs=1e-6)


def test_kkt_is_asked_once(boxes, monkeypatch):
    """One decomposition for the whole front: no solve of its own."""
    from lampopt_kkt import kkt

    calls = []
    many = kkt.KKT.solve_many
    monkeypatch.setattr(kkt.KKT, "solve_many", lambda self, *given: calls.append(len(given[1])) or many(self, *given))
    found(study(boxes))
    assert calls == [200]
    found(lowering(boxes), reduce=LOWER)
    assert calls == [200] * 6


def test_the_knee_is_where_the_front_is_parallel_to_its_chord(boxes):
    """error·d(error) = −ridge·distance·d(distance) along the front, so there error/distance·(chord's slope) = ridge."""
    for changes in (STUDIES["two rows"], STUDIES["a label"]):
        seen = found(study(boxes, **changes), ridges=2000)
        chord = seen.error[-1] / seen.distance[0]
        i = seen.knee
        assert seen.bends
        assert 0 < i < 1999
        assert seen.ridge[i] == pytest.approx(seen.error[i] / seen.distance[i] * chord, rel=0.02)
        gap = 1 - seen.error / seen.error[-1] - seen.distance / seen.distance[0]
        assert gap[i] >= gap.max() - 1e-6


def test_a_straight_front_has_no_knee(boxes):
    """One target: error and distance shrink in proportion."""
    for solver in ("kkt", "casadi"):
        seen = found(study(boxes, targets={"length": 2.9}, solver=solver), ridges=50)
        assert seen.error / seen.error[-1] + seen.distance / seen.distance[0] == pytest.approx(1, abs=1e-6)
        assert not seen.bends
        assert not discs(seen.svg(), "knee")
        assert discs(seen.svg(), "front")


def test_the_knee_of_a_quarter_circle_is_in_its_middle():
    angle = np.linspace(0, np.pi / 2, 91)
    points = np.column_stack([3 - 3 * np.cos(angle), 10 - 10 * np.sin(angle)])
    assert knee(points) == 45
    assert knee(points[::-1]) == 45


def test_ridges_may_be_given(boxes):
    seen = found(study(boxes), ridges=[1.0, 0, 0.1, 1.0])
    assert seen.ridge.tolist() == [0, 0.1, 1.0]
    assert found(study(boxes), ridges=2).ridge[0] == 0
    assert len(found(study(boxes), ridges=np.int64(3))) == 3


def test_contradictory_targets_leave_an_error(boxes):
    two = small.bank(small.boxes(count=2))  # longer is wider, always
    seen = found(study(two))
    assert set(seen.status) == {"infeasible"}
    # With t = alpha[1], length 2 + 0.2 t and width 1 + 0.4 t are 2t − 1 both, normalised; asked are 13 and 3.
    assert 2 * seen.alpha[0, 1] - 1 == pytest.approx(8)
    assert seen.error[0] == pytest.approx(np.hypot(5, 5))
    assert seen.design(0).mix.conflicts[0].names == ("length", "width")
    assert (np.diff(seen.error) >= 0).all()


def test_ranges_are_kept_all_along(boxes):
    asked = study(boxes, targets={"length": 3.4}, ranges={"width": (1.3, 1.35)}, solver="casadi")
    seen = found(asked, ridges=15)
    assert (np.diff(seen.error) >= -1e-9).all()
    assert (seen.predicted[:, 1] >= 1.3 - 1e-7).all()
    assert seen.predicted[-1, 1] == pytest.approx(1.3, abs=1e-6)  # the mean is 1.2: as near as the range lets it
    nearest = lampopt.design(boxes, {"width": 1.3}, level="alpha", plugins=PLUGINS).design.mix.alpha
    assert seen.alpha[-1] == pytest.approx(nearest, abs=1e-5)


def test_mixes_that_a_solver_gave_up_are_no_knee(boxes):
    asked = study(boxes)
    lost, whole = (found(replace(asked, solver=name)) for name in ("lazy", "toy"))
    assert "failed" in lost.status
    assert lost.status[lost.knee] != "failed"
    with_label = found(lowering(boxes, solver="lazy"), ridges=[0.0, 0.5, 2.0, 8.0], reduce=LOWER).reduction
    assert with_label.efficient.reshape(4, 4)[:, :2].sum() == 0
    assert with_label.efficient.any()
    assert whole.status[0] == "exact"


# what is not linear, and other wishes


def test_a_models_value_may_be_asked(boxes):
    asked = study(boxes, targets={"lift": 5.0, "width": 1.5}, models={"aero": Aero()}, solver="casadi")
    seen = found(asked, ridges=12)
    assert (tuple(seen.target), seen.units) == (("lift", "width"), ("kg", "m"))
    assert seen.reached[:, 0] == pytest.approx(seen.predicted.prod(1))
    assert seen.reached[0] == pytest.approx([5.0, 1.5], abs=1e-5)
    assert seen.predicted[-1] == pytest.approx([2.5, 1.2], abs=1e-4)
    lifts = boxes.parameters.prod(1)
    off = 2 * (seen.reached - [5.0, 1.5]) / [np.ptp(lifts), 0.4]
    assert seen.error == pytest.approx(np.linalg.norm(off, axis=1))
    assert (np.diff(seen.error) >= -1e-6).all()
    assert (np.diff(seen.distance) <= 1e-6).all()
    run = lampopt.run(replace(asked, ridge=float(seen.ridge[4]), level="alpha"), plugins=PLUGINS)
    assert seen.alpha[4] == pytest.approx(run.design.mix.alpha, abs=1e-6)
    judged = seen.result(4, "alpha")
    assert judged.check("target.lift").value == pytest.approx(abs(off[4, 0]))
    assert "ridge" in judged.design.mix.message


def test_a_models_value_may_be_lowered(boxes):
    wish = lampopt.Reduce("bowl", by=0.1)
    asked = lowering(boxes, targets={}, objective=wish, models={"aero": Aero()}, solver="casadi")
    more = found(asked, ridges=4, reduce=[0.0, 0.1]).reduction
    before = float(Aero()(boxes.parameters[:1])[0, 0])
    assert (more.name, more.unit, more.before) == ("bowl", "N", before)
    assert more.value == pytest.approx(Aero()(more.predicted)[:, 0])
    assert more.value[[0, 4]] == pytest.approx([before, 0.9 * before], abs=1e-5)


def test_a_measured_value_may_be_asked(boxes):
    bank = small.bank(decoder="pulled", plugins=PLUGINS)
    seen = found(study(bank, targets={"mine.volume": 4.0}, solver="casadi"), ridges=4)
    assert seen.reached[0, 0] == pytest.approx(4.0, abs=1e-3)
    assert seen.reached[:, 0] == pytest.approx(0.8 * seen.predicted.prod(1), rel=1e-5)
    assert seen.reached[-1, 0] == pytest.approx(2.5 * 1.2 * 0.8, rel=1e-3)


def test_norm_1_has_a_front_of_its_own(boxes):
    seen = found(study(boxes, norm=1, solver="casadi"), ridges=25)
    assert seen.distance == pytest.approx(np.abs(seen.alpha - 1 / 7).sum(1))
    assert (np.diff(seen.error) >= -1e-7).all()
    assert (np.diff(seen.distance) <= 1e-7).all()
    assert seen.worst[0] == pytest.approx(0, abs=1e-7)
    assert seen.alpha[-1] == pytest.approx(np.full(7, 1 / 7), abs=1e-8)
    assert 0 < seen.knee < 24


def test_weights_and_bounds_of_the_study_hold(boxes):
    asked = study(boxes, weights={"width": 9.0}, alpha=(-0.5, 0.7), solver="casadi")
    seen = found(asked, ridges=15)
    off = 2 * (seen.predicted - [3.4, 1.8]) / [1.0, 0.4]
    assert seen.error == pytest.approx(np.sqrt(off**2 @ [1, 9]))
    assert seen.alpha.min() >= -0.5 - 1e-8
    assert seen.alpha.max() <= 0.7 + 1e-8
    assert (np.diff(seen.error) >= -1e-8).all()


def test_what_has_no_least_value_is_no_end(boxes):
    asked = study(boxes, targets={"length": 2.8}, objective=lampopt.Minimise("width"), solver="casadi")
    seen = found(asked, ridges=6)
    assert seen.status[0] == "failed"  # without a ridge nothing keeps the width from becoming less and less
    assert seen.knee > 0
    with pytest.raises(StudyError, match="reduce: expected a study with an objective, Reduce"):
        found(asked, reduce=[0.1])


# lowering a label


def test_a_label_is_lowered_by_each_fraction(boxes):
    seen = found(lowering(boxes), reduce=[0.2, 0.0, 0.1, 0.05], ridges=30)
    more = seen.reduction
    assert (more.name, more.unit, more.before) == ("drag", "", 0.3)
    assert more.by.reshape(4, 30)[:, 0].tolist() == LOWER
    assert (more.ridge.reshape(4, 30) == seen.ridge).all()
    first = more.value.reshape(4, 30)[:, 0]
    assert first == pytest.approx(0.3 * (1 - np.array(LOWER)))
    assert more.error.reshape(4, 30)[:, 0] == pytest.approx(0, abs=1e-9)
    assert more.value.reshape(4, 30)[:, -1] == pytest.approx(0.3, abs=1e-5)  # the reference
    assert (np.diff(more.distance.reshape(4, 30)[:, 0]) > 0).all()  # more costs more
    # the study's own fraction is the front itself, but for what the label's row adds to the error
    own = more.by == 0.1
    assert more.alpha[own] == pytest.approx(seen.alpha, abs=1e-12)
    label = 2 * (seen.reached[:, 2] - 0.27) / 0.08
    assert more.error[own] ** 2 + label**2 == pytest.approx(seen.error**2)
    assert seen.reached[:, 2] == pytest.approx(more.value[own])


def test_efficient_ones_are_beaten_by_none(boxes):
    more = found(lowering(boxes), reduce=[-0.3, *LOWER], ridges=20).reduction
    points = np.column_stack([more.error, more.distance, more.value])
    for i, best in enumerate(more.efficient):
        beaten = ((points <= points[i]).all(1) & (points < points[i]).any(1)).any()
        assert best == (not beaten)
    assert more.efficient.any()
    assert not more.efficient.all()  # who asks for more drag than there is gets what others beat


def test_designs_of_a_reduction(boxes):
    more = found(lowering(boxes), reduce=LOWER, ridges=5).reduction
    for i in (0, 7, 19):
        made = more.design(i)
        assert made.target["drag"] == pytest.approx(0.3 * (1 - more.by[i]))
        assert (made.mix.alpha == more.alpha[i]).all()
        assert made.predicted == pytest.approx(more.predicted[i])
        assert more.result(i, "alpha").design.target == made.target
    with pytest.raises(StudyError, match="number: expected at least 0 and at most 19, a whole number, got 20"):
        more.design(20)


def test_a_label_below_zero_shrinks_too(boxes):
    """A moment of −0.3 lowered by a tenth is one of −0.27: nearer to nothing is better."""
    asked = lowering(small.bank(small.boxes(labels=-small.DRAG[:, None])))
    one, other = (found(a, reduce=LOWER, ridges=12).reduction for a in (lowering(boxes), asked))
    assert other.before == -0.3
    assert other.value == pytest.approx(-one.value)
    assert (one.efficient == other.efficient).all()


# what cannot be asked


def test_wrong_input_is_told(boxes):
    asked = study(boxes)
    with pytest.raises(StudyError, match=r"study: expected a Study, got 'a\.toml'; read one with Study\.read"):
        front("a.toml")
    for ridges in (1, 0, -3, 20_001, True, None, [], [0.1, -1], ["0.1"], "200", [np.nan], [10**400], 3.5):
        with pytest.raises(StudyError, match="ridges: "):
            found(asked, ridges=ridges)
    with pytest.raises(StudyError, match="reduce: expected a study with an objective"):
        found(asked, reduce=[0.1])
    for fractions in ([1.0], [-10], [np.inf], ["0.1"], "0.1", None, [True]):
        with pytest.raises(StudyError, match="reduce: "):
            found(lowering(boxes), reduce=fractions)
    with pytest.raises(StudyError, match="at most 20,000 mixes in all, got 22,000"):
        found(lowering(boxes), ridges=11_000, reduce=[0.1])
    for nothing in ({"targets": {}}, {"hard": ("length", "width")}):
        with pytest.raises(StudyError, match="expected targets that may be missed, got none"):
            found(study(boxes, **nothing))
    with pytest.raises(StudyError, match="'drag' is 0 at the reference"):
        nought = small.bank(small.boxes(labels=small.DRAG[:, None] - 0.3))
        found(lowering(nought), reduce=[0.1])
    seen = found(asked, ridges=3)
    for number in (3, -1, 0.5, True, "0"):
        with pytest.raises(StudyError, match="number: expected at least 0 and at most 2"):
            seen.design(number)
    with pytest.raises(StudyError, match="level: expected one of alpha, field, mesh, got 'all'"):
        seen.result(0, "all")


def test_what_is_found_cannot_be_changed(boxes):
    seen = found(lowering(boxes), ridges=4, reduce=LOWER)
    for record in (seen, seen.reduction):
        for array in (record.ridge, record.error, record.distance, record.alpha, record.predicted):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0


def test_progress_is_told(boxes):
    told = []
    found(lowering(boxes), reduce=LOWER, ridges=3, progress=lambda done, message="": told.append((done, message)))
    assert told[0] == (0.0, "3 ridges")
    assert told[-1] == (0.8, "drag by 0.2")


# pictures and the command line


def discs(svg, kind):
    return [e for e in ElementTree.fromstring(svg).iter() if e.get("class") == kind]


def test_the_picture_shows_it(boxes):
    seen = found(study(boxes), ridges=50)
    (line,) = discs(seen.svg(), "front")
    x, y = np.array([p.split(",") for p in line.get("points").split()], float).T
    assert len(x) == 50
    (mark,) = discs(seen.svg(), "knee")
    assert (float(mark.get("cx")), float(mark.get("cy"))) == (x[seen.knee], y[seen.knee])
    assert np.corrcoef(x, seen.distance)[0, 1] == pytest.approx(1)
    assert np.corrcoef(y, seen.error)[0, 1] == pytest.approx(-1)  # pixels go down
    both = found(lowering(boxes), ridges=20, reduce=[-0.3, *LOWER])
    assert len(discs(both.svg(), "efficient")) == both.reduction.efficient.sum()
    assert len(discs(both.svg(), "other")) == 100 - both.reduction.efficient.sum()
    assert "drag" in both.svg()


def test_what_is_not_known_is_left_out_of_the_picture():
    """A mix whose mesh lacks what is measured."""
    error, distance = np.array([0.1, np.nan, 0.5]), np.array([2.0, 1.0, 0.0])
    beside = (distance, np.array([1.0, np.nan, 3.0]), error, np.array([True, False, True]))
    svg = picture(distance, error, 0, beside, "drag")
    assert "nan" not in svg.lower()
    assert len(discs(svg, "front")[0].get("points").split()) == 2
    assert len(discs(svg, "efficient")) == 2
    nothing = np.full(3, np.nan)
    assert "nan" not in picture(distance, nothing, 0, (distance, nothing, nothing, beside[3]), "drag").lower()


@pytest.fixture
def study_file(tmp_path, monkeypatch):
    small.bank(store=tmp_path / "boxes.lamp")
    monkeypatch.setattr(Plugins, "load", lambda: PLUGINS)
    file = tmp_path / "roof.toml"
    file.write_text(
        'bank = "boxes.lamp"\nreference = "box_0"\nkeep = ["width"]\nobjective = { reduce = "drag", by = 0.1 }\n'
        "[targets]\nlength = 2.6\n[limits]\nalpha = 1.5\n"
    )
    return file


def test_the_command_line_tells_the_same(study_file, tmp_path, capsys):
    file = tmp_path / "pictures" / "front.svg"
    given = ["--ridges", "30", "--reduce", "0,0.05,0.1", "--out", str(file), "--json"]
    assert cli.main(["front", str(study_file), *given]) == 0
    told = json.loads(capsys.readouterr().out)
    seen = found(lampopt.Study.read(study_file), ridges=30, reduce=[0, 0.05, 0.1])
    assert (told["knee"], told["level"], told["picture"]) == (seen.knee, "field", str(file))
    assert told["target"] == dict(seen.target)
    for name in ("ridge", "error", "worst", "distance"):
        assert [point[name] for point in told["points"]] == pytest.approx(getattr(seen, name).tolist())
    for name in ("alpha", "predicted", "reached"):
        assert [list(point[name].values()) for point in told["points"]] == pytest.approx(getattr(seen, name))
    assert list(told["points"][0]["alpha"]) == [f"box_{i}" for i in range(7)]
    numbers = [one["number"] for one in told["judged"]]
    assert {0, 29, seen.knee} <= set(numbers)
    for one in told["judged"]:
        result = seen.result(one["number"], "field")
        failed = [check.name for check in result.checks if not check.passed]
        assert one["accepted"] == result.accepted
        assert one["failed"] == (failed or [None])[0]
        assert one["besides_target"] == ([name for name in failed if name != "target"] or [None])[0]
    assert told["judged"][0]["failed"] == "alpha"
    more = told["reduction"]
    assert (more["name"], more["before"], len(more["points"])) == ("drag", 0.3, 90)
    assert [p["efficient"] for p in more["points"]] == seen.reduction.efficient.tolist()
    assert [p["value"] for p in more["points"]] == pytest.approx(seen.reduction.value.tolist())
    assert file.read_text(encoding="utf-8") == seen.svg()


def test_people_see_tables(study_file, capsys):
    assert cli.main(["front", str(study_file), "--level", "alpha", "--reduce", "0,0.1"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    for words in (
        "knee",
        "length [m]",
        "misses targets",
        "rejected by alpha",
        "what lowering drag costs",
        "judged by alpha",
    ):
        assert words in err


def test_the_command_line_refuses(study_file, tmp_path, capsys):
    def refused(*given):
        assert cli.main(["front", str(study_file), *given, "--json"]) == 2
        return json.loads(capsys.readouterr().out)["error"]["message"]

    assert "expected fractions such as 0,0.05,0.1, got '5%'" in refused("--reduce", "5%")
    (tmp_path / "file").touch()
    assert "--out" in refused("--out", str(tmp_path / "file" / "x.svg"))
    assert "ridges" in refused("--ridges", "1")
    assert "at least 2 and at most 20,000" in refused("--ridges", "20001")


def test_efficient_ones_of_a_label_that_is_raised():
    """More of it is better: what meets the raise is beaten by nothing that changes less."""
    bank = small.bank(small.boxes(labels=0.1 * small.LENGTHS[:, None]))
    study = Study(bank, keep=("width",), reference="box_0", objective=Reduce("drag", by=-0.1))
    found = lampopt.front(study, reduce=[0.0, -0.1, -0.2], ridges=5, plugins=small.plugins()).reduction
    points = np.column_stack([found.error, found.distance, -found.value])
    beaten = [any((other <= one).all() and (other < one).any() for other in points) for one in points]
    assert found.efficient.tolist() == [not one for one in beaten]
    met = (found.by < 0) & (found.error < 1e-9)
    assert met.any() and found.efficient[met].all()
