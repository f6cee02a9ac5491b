"""Which decoder serves a family: against decoders that are right, wrong, dear, or refuse, by construction."""

import json
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt import Exemplars, Parameter, Spec, build_bank, cli, compare, design, holdout
from lampopt.errors import BankError, EmptyMesh, FitError, InputError, PluginError
from lampopt.holdout import chosen, outermost, parted
from lampopt.metrics import surface_distance
from lampopt.plugins import Plugins
from lampopt.recommend import Compared, counted, recommended
from lampopt.testing import shapes

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

HEIGHT = 0.8  # of every box [m]
FEW = 300  # points of a surface
CLOCK = [0.0]
SEEN = []  # extents of every mesh that the spy was shown


@dataclass(frozen=True)
class Spy(small.Stretch):
    """Right, and remembers what it was shown."""

    def prepare(self, meshes, *, mean, seed):
        SEEN.extend(tuple(mesh.extents) for mesh in [*meshes, mean])
        return super().prepare(meshes, mean=mean, seed=seed)

    def fit(self, shared, meshes, *, seed, progress=None):
        SEEN.extend(tuple(mesh.extents) for mesh in meshes)
        return super().fit(shared, meshes, seed=seed, progress=progress)


@dataclass(frozen=True)
class Noisy(small.Stretch):
    """Fits every box with extents that are off by a few hundredths."""

    by: float = 0.03

    def fit(self, shared, meshes, *, seed, progress=None):
        weights, error = super().fit(shared, meshes, seed=seed, progress=progress)
        rng = np.random.default_rng([seed, *(int(1e6 * mesh.extents[0]) for mesh in meshes)])
        weights[:, :3] *= 1 + self.by * rng.standard_normal((len(meshes), 3)).astype("f4")
        return weights, error


@dataclass(frozen=True)
class Swollen(small.Stretch):
    """Makes every box 0.02 larger along each side [the family's unit]."""

    def prepare(self, meshes, *, mean, seed):
        return {**super().prepare(meshes, mean=mean, seed=seed), "scale": np.array([mean.extents[2] / HEIGHT])}

    def decode(self, shared, weights, *, resolution):
        more = np.append(np.full(3, 0.02 * shared["scale"][0]), np.zeros(3))
        return super().decode(shared, weights + more, resolution=resolution)


@dataclass(frozen=True)
class Slow(small.Stretch):
    """Right, and takes 100 s, by the clock of these tests."""

    def fit(self, shared, meshes, *, seed, progress=None):
        CLOCK[0] += 100.0
        return super().fit(shared, meshes, seed=seed, progress=progress)


@dataclass(frozen=True)
class Picky(small.Stretch):
    """Fits no box that is long."""

    longest: float = 0.5

    def fit(self, shared, meshes, *, seed, progress=None):
        for mesh in meshes:
            if mesh.extents[0] > self.longest:
                raise FitError(f"exemplar {mesh.metadata['name']!r}: expected another topology")
        return super().fit(shared, meshes, seed=seed, progress=progress)


@dataclass(frozen=True)
class Choosy(small.Stretch):
    """Refuses all of them before any is fitted."""

    def prepare(self, meshes, *, mean, seed):
        raise FitError("expected meshes of one connectivity, got 24 and 36 faces")


@dataclass(frozen=True)
class Fading(small.Stretch):
    """Right, and without a surface where a box is shorter than the mean of what it was shown."""

    def prepare(self, meshes, *, mean, seed):
        least = np.array([np.mean([mesh.extents[0] for mesh in meshes])])
        return {**super().prepare(meshes, mean=mean, seed=seed), "least": least}

    def decode(self, shared, weights, *, resolution):
        if weights[0] < shared["least"][0]:
            raise EmptyMesh("too short")
        return super().decode(shared, weights, resolution=resolution)


class Plugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        offered = Spy, Noisy, Swollen, Slow, Picky, Choosy, Fading
        return {decoder.__name__.lower(): decoder for decoder in offered}

    @lampopt.hookimpl
    def lampopt_sources(self):
        return {"boxes": Boxes}


@dataclass(frozen=True)
class Boxes:
    """The family as a source."""

    count: int = 12

    def __call__(self):
        return family(self.count)


PLUGINS = small.plugins(("compared", Plugin()))


def family(count=12, **more):
    """Boxes of a length and a width that were drawn."""
    rows = np.random.default_rng(0).uniform([2.0, 1.0], [3.0, 1.4], (count, 2))
    meshes = [shapes.box([*row, HEIGHT]) for row in rows]
    space = (Parameter("length", "m"), Parameter("width", "m"))
    names = tuple(f"box_{i}" for i in range(count))
    return Exemplars(rows, space, meshes, names, **{"measured": {"length": "size.length"}, **more})


@pytest.fixture(autouse=True, scope="module")
def few():
    """Surfaces compared at fewer points: boxes are plain, and there are many of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(holdout, "surface_distance", partial(surface_distance, samples=FEW))
        yield patch


@pytest.fixture(scope="module")
def boxes():
    return family()


@pytest.fixture(scope="module")
def found(boxes, few):
    SEEN.clear()
    return compare(boxes, ["noisy", "spy", "picky", "choosy"], plugins=PLUGINS)


def test_the_right_decoder_is_recommended_and_the_reason_says_why(found):
    assert found.best == "spy"
    good, bad, nothing = (found.row(name) for name in ("spy", "noisy", "nothing"))
    assert good.worst < 1e-6
    assert good.fit_worst < 1e-6
    assert good.accepted == 1
    assert 1e-3 < bad.mean < nothing.mean
    assert f"against {bad.mean:.3g} m of noisy, closer on 4 of 4" in found.reason
    assert f"the nearest exemplar as it is would be {nothing.mean:.3g} m off" in found.reason
    assert "4 of 4 designs pass every check" in found.reason
    assert [row.name for row in found.rows] == ["noisy", "spy", "picky", "choosy", "nothing"]


def test_a_refusal_is_a_row(found):
    for name, why in (("picky", "expected another topology"), ("choosy", "expected meshes of one connectivity")):
        row = found.row(name)
        assert why in row.refusal
        assert np.isnan(row.errors).all()
        assert np.isnan([row.mean, row.worst, row.fit_mean, row.accepted, row.build_seconds]).all()
        assert f"{name} refuses: " in found.reason
        assert why in found.reason
    assert {row.name for row in found.rows if row.refusal is None} == {"noisy", "spy", "nothing"}


def test_held_out_are_the_outermost_third_and_no_decoder_sees_them(boxes, found):
    at = (boxes.parameters - boxes.parameters.min(0)) / np.ptp(boxes.parameters, axis=0) - 0.5
    farthest = np.argsort(np.linalg.norm(at, axis=1))[-4:]
    assert set(found.held_out) == {boxes.names[i] for i in farthest}
    assert set(found.held_out) | set(found.inner) == set(boxes.names)
    inner = [i for i, name in enumerate(boxes.names) if name in found.inner]
    scale = build_bank(chosen(boxes, inner), "spy", plugins=PLUGINS).frame.scale
    shown = {round(float(length / scale), 6) for length, *_ in SEEN}
    assert shown == {round(float(boxes.meshes[i].extents[0]), 6) for i in inner}
    assert not shown & {round(float(boxes.meshes[i].extents[0]), 6) for i in farthest}


def test_figures_are_those_of_designs_made_one_by_one(boxes, found):
    """By `build_bank` and `design`, as a user would; the baseline by hand."""

    def apart(mesh, i):
        return surface_distance(mesh, boxes.meshes[i], samples=FEW)

    inner, held = ([boxes.names.index(name) for name in names] for names in (found.inner, found.held_out))
    bank = build_bank(chosen(boxes, inner), "noisy", plugins=PLUGINS)
    asked = [dict(zip(("length", "width"), boxes.parameters[i], strict=True)) for i in held]
    results = [design(bank, targets, plugins=PLUGINS) for targets in asked]
    errors = [apart(result.design.mesh, i) for result, i in zip(results, held, strict=True)]
    row = found.row("noisy")
    assert row.errors == pytest.approx(errors)
    assert (row.mean, row.worst) == (pytest.approx(np.mean(errors)), pytest.approx(max(errors)))
    assert row.accepted == np.mean([r.accepted for r in results])
    extents = np.asarray(bank.weights)[:, :3] / bank.frame.scale
    fits = [apart(shapes.box(e, centre=boxes.meshes[i].bounds.mean(0)), i) for e, i in zip(extents, inner, strict=True)]
    assert row.fit_errors == pytest.approx(fits, rel=1e-3)
    assert row.fit_mean == pytest.approx(np.mean(fits), rel=1e-3)
    assert row.fit_worst == pytest.approx(max(fits), rel=1e-3)
    assert row.weights == 6
    assert row.build_seconds > 0
    assert row.design_seconds > 0
    spread = np.ptp(boxes.parameters, axis=0)
    for i, error in zip(held, found.row("nothing").errors, strict=True):
        away = [np.linalg.norm((boxes.parameters[j] - boxes.parameters[i]) / spread) for j in inner]
        assert error == pytest.approx(apart(boxes.meshes[inner[int(np.argmin(away))]], i))


def test_a_box_that_is_off_by_a_hundredth_all_around_is_said_to_be():
    """In closed form, at all the points that users get: every face of a box 0.02 larger is 0.01 away, edges a bit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(holdout, "surface_distance", surface_distance)
        found = compare(family(8), ["swollen"], plugins=PLUGINS)
    assert found.row("swollen").errors == pytest.approx(0.01, rel=0.02)
    assert found.row("swollen").fit_errors == pytest.approx(0.01, rel=0.02)


def test_same_seed_same_figures(boxes, found):
    again = compare(boxes, ["spy", "noisy"], plugins=PLUGINS)
    assert again.row("noisy").errors.tobytes() == found.row("noisy").errors.tobytes()
    other = compare(boxes, ["noisy"], seed=1, plugins=PLUGINS)
    assert (other.row("noisy").errors != found.row("noisy").errors).any()


def test_of_two_that_are_alike_the_cheaper_is_taken(boxes, monkeypatch):
    monkeypatch.setattr(sys.modules["lampopt.compare"], "perf_counter", lambda: CLOCK[0])
    found = compare(boxes, ["slow", "spy"], plugins=PLUGINS)
    assert found.best == "spy"
    assert "slow is alike" in found.reason
    assert "and dearer: 100 s against 0 s" in found.reason
    assert [row.build_seconds for row in found.rows] == [100, 0, 0]


def test_where_there_is_no_surface_the_worst_of_the_others_counts(boxes):
    found = compare(boxes, ["fading", "noisy"], plugins=PLUGINS)
    fading, noisy, nothing = found.rows
    gone = np.isnan(fading.errors)
    assert 0 < gone.sum() == fading.lost < len(gone)
    assert fading.errors[~gone] == pytest.approx(0, abs=1e-6)
    assert fading.mean == pytest.approx(np.maximum(noisy.errors, nothing.errors)[gone].sum() / len(gone), abs=1e-6)
    assert 0 < np.isnan(fading.fit_errors).sum() < len(fading.fit_errors)
    assert fading.fit_worst < 1e-6
    assert f"fading has no surface for {fading.lost} of 4" in found.reason


def test_none_serves(boxes):
    found = compare(boxes, [Spec("noisy", by=0.5), "choosy"], plugins=PLUGINS)
    assert found.best is None
    assert "none is closer than the nearest exemplar as it is" in found.reason
    assert "choosy refuses" in found.reason
    found = compare(boxes, ["choosy"], plugins=PLUGINS)
    assert found.best is None
    assert "try another decoder" in found.reason


def test_the_solver_and_the_options_named_are_used(boxes, found):
    ridged = compare(boxes, ["spy"], solver=Spec("kkt", ridge=1e-2), plugins=PLUGINS)
    assert ridged.row("spy").mean > 1e-4
    twice = compare(boxes, [Spec("noisy", by=0.01), Spec("noisy", by=0.05)], plugins=PLUGINS)
    assert twice.best == "noisy by=0.01"


def test_a_measurement_that_the_inner_ones_do_not_bear_out_is_left_out(boxes, caplog):
    found = compare(boxes, ["spy"], measured={"width": "size.length"}, plugins=PLUGINS)
    assert "'size.length' does not follow parameter 'width' over the 8 exemplars" in caplog.text
    assert found.row("spy").accepted == 1


# what is held out


def test_one_parameter_at_a_time():
    """Both ends of a parameter cannot be held out: no mix of the others would move it."""
    rows = np.array([[2, 1], [1, 1], [3, 1], [2, 0.5], [2, 1.5]])
    inner, held = parted(rows)
    assert 0 in inner
    assert len(inner) == 3
    assert {rows[i, 0] for i in inner} in ({1, 2}, {2, 3})
    meshes = [shapes.box([*row, HEIGHT]) for row in rows]
    space = (Parameter("length", "m"), Parameter("width", "m"))
    found = compare(Exemplars(rows, space, meshes, tuple("abcde")), ["spy"], plugins=PLUGINS)
    assert found.row("spy").worst < 1e-6
    assert len(found.held_out) == len(held) == 2


@settings(deadline=None)
@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 10_000), st.booleans())
def test_a_mix_of_the_inner_ones_meets_all_that_are_held_out(count, d, seed, coarse):
    rows = np.random.default_rng(seed).uniform(size=(count, d))
    rows = np.round(2 * rows) if coarse else rows
    inner, held = parted(rows)
    assert sorted([*inner, *held]) == list(range(count))
    assert set(held) <= set(outermost(rows).tolist())
    system = np.vstack([rows[inner].T, np.ones(len(inner))])
    for i in held:
        wanted = np.append(rows[i], 1.0)
        assert system @ np.linalg.lstsq(system, wanted, rcond=None)[0] == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize(
    ("count", "message"),
    [(1, "expected some that differ in a parameter"), (2, "expected at least 3"), (3, "expected at least 4.*got 3")],
)
def test_too_few_exemplars(count, message):
    with pytest.raises(InputError, match=message):
        compare(family(count), ["spy"], plugins=PLUGINS)


def test_four_exemplars_hold_one_out():
    found = compare(family(4, measured={}), ["spy"], plugins=PLUGINS)
    assert len(found.held_out) == 1
    assert "off on 1 held-out exemplar;" in found.reason


# what is asked wrongly


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"decoders": "spy"}, InputError, "expected a list of names or Specs"),
        ({"decoders": []}, InputError, "expected a list of names or Specs"),
        ({"decoders": ["spy", 3]}, InputError, "got a list with 3"),
        ({"decoders": ["spy", Spec("spy")]}, InputError, "'spy' is given twice"),
        ({"decoders": ["spy", "gone"]}, PluginError, "'gone' is not installed"),
        ({"decoders": [Spec("noisy", wide=3)]}, PluginError, "unknown option 'wide'"),
        ({"solver": "gone"}, PluginError, "'gone' is not installed"),
        ({"seed": -1}, InputError, "seed: expected at least 0"),
        ({"resolution": 2}, InputError, "resolution: expected at least 4"),
        ({"folder": ""}, InputError, "folder: expected a path"),
        ({"measured": "size"}, InputError, "measured: expected a mapping"),
        ({"accept": ["nobody"]}, InputError, "got 'nobody'"),
    ],
)
def test_wrong_arguments_are_told_before_anything_is_fitted(boxes, options, error, message):
    before = small.CALLS["prepare"]
    with pytest.raises(error, match=message):
        compare(boxes, **{"decoders": ["spy"], "plugins": PLUGINS, **options})
    assert small.CALLS["prepare"] == before


def test_other_things_than_exemplars_are_refused():
    with pytest.raises(InputError, match=r"exemplars: expected lampopt.types.Exemplars, got \[\]"):
        compare([], ["spy"], plugins=PLUGINS)
    with pytest.raises(InputError, match="row 'gone': not compared; there are"):
        compare(family(6), ["spy"], plugins=PLUGINS).row("gone")


# what is kept


def test_an_interrupted_comparison_goes_on(tmp_path, monkeypatch):
    """Ten inner exemplars are two batches: the first decoder is whole, the second half done, when Ctrl-C comes."""
    boxes, choices = family(15), ["spy", Spec("noisy", by=0.01)]
    monkeypatch.setattr(small, "INTERRUPT", [small.CALLS["batches"] + 4])
    with pytest.raises(KeyboardInterrupt):
        compare(boxes, choices, folder=tmp_path / "kept", plugins=PLUGINS)
    small.INTERRUPT[0] = 0
    noted = {path.name: json.loads(path.read_text()) for path in (tmp_path / "kept").glob("*.seconds")}
    assert len(noted) == 2
    before = small.CALLS["fit"]
    found = compare(boxes, choices, folder=tmp_path / "kept", plugins=PLUGINS)
    assert small.CALLS["fit"] - before == 2
    spy, noisy, _ = found.rows
    assert spy.build_seconds == noted[spy.bank.with_suffix(".seconds").name]
    assert noisy.build_seconds > noted[noisy.bank.with_suffix(".seconds").name]
    fresh = compare(boxes, choices, plugins=PLUGINS)
    for one, other in zip(found.rows, fresh.rows, strict=True):
        assert one.errors.tobytes() == other.errors.tobytes()
        assert one.fit_errors.tobytes() == other.fit_errors.tobytes()
    assert lampopt.load_bank(spy.bank).names == found.inner
    before = small.CALLS["fit"]
    again = compare(boxes, choices, folder=tmp_path / "kept", plugins=PLUGINS)
    assert small.CALLS["fit"] == before
    assert [row.build_seconds for row in again.rows] == [row.build_seconds for row in found.rows]


def test_a_time_that_nobody_counted_is_not_known(boxes, tmp_path):
    found = compare(boxes, ["spy"], folder=tmp_path, plugins=PLUGINS)
    for broken in ("-3.0", None):
        note = found.row("spy").bank.with_suffix(".seconds")
        note.unlink(missing_ok=True)
        if broken is not None:
            note.write_text(broken)
        again = compare(boxes, ["spy"], folder=tmp_path, plugins=PLUGINS)
        assert np.isnan(again.row("spy").build_seconds)
        assert again.best == "spy"


def test_a_folder_of_another_comparison_is_not_written_over(boxes, tmp_path):
    compare(boxes, ["spy"], folder=tmp_path, plugins=PLUGINS)
    with pytest.raises(BankError, match="other exemplars, options or seed"):
        compare(boxes, ["spy"], seed=1, folder=tmp_path, plugins=PLUGINS)


def test_progress_rises_to_one(boxes):
    told = []
    compare(boxes, ["spy", "choosy", "noisy"], progress=lambda done, message="": told.append(done), plugins=PLUGINS)
    assert told == sorted(told)
    assert told[-1] == 1.0


# what is told from noise: `recommended` by itself


def row(name, errors, weights=10, seconds=1.0, decoder=True):
    errors = np.asarray(errors, float)
    spec = Spec("x") if decoder else None
    return Compared(
        name, spec, errors, errors / 4, accepted=0.5, build_seconds=seconds, design_seconds=0.0, weights=weights
    )


def advised(*rows, nothing=9.0):
    return recommended(counted([*rows, row("nothing", np.full(8, nothing), decoder=False)]), "mm", 0)


BASE = np.array([1.0, 1.4, 0.8, 1.2, 1.1, 0.9, 1.3, 1.0])
NOISE = np.array([0.3, -0.3, 0.2, -0.25, 0.3, -0.2, 0.1, -0.2])


def test_a_difference_that_every_exemplar_shows_decides_whatever_it_costs():
    best, reason = advised(row("dear", BASE, weights=9999, seconds=1e4), row("cheap", 2 * BASE))
    assert best == "dear"
    assert reason.startswith("dear: 1.09 mm off on 8 held-out exemplars, against 2.17 mm of cheap, closer on 8 of 8")


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(BASE + NOISE + 0.02, id="noise"),
        pytest.param(1.03 * BASE, id="less than anybody would choose for"),
        pytest.param(np.append(0.98 * BASE[:-1], 4.0), id="one exemplar that went wrong"),
    ],
)
def test_what_is_alike_is_decided_by_cost(other):
    for seconds, weights, said in [
        ((50.0, 2.0), (10, 10), "dear is alike with 1.09 mm"),
        ((1.5, 1.0), (500, 10), "and dearer: 500 weights an exemplar against 10"),
    ]:
        dear, cheap = row("dear", BASE, weights[0], seconds[0]), row("cheap", other, weights[1], seconds[1])
        best, reason = advised(dear, cheap)
        assert best == "cheap"
        assert said in reason


def test_where_cost_does_not_tell_either_the_closer_is_taken():
    best, reason = advised(row("other", BASE + 0.02), row("closer", BASE))
    assert best == "closer"
    assert "other is alike" in reason
    assert "and no cheaper" in reason


def test_what_is_next_to_nothing_is_not_told_apart():
    """Two that are exact but for rounding, one of them always a little more."""
    best, reason = advised(row("rounded", 1e-7 * BASE, weights=11), row("more", 3e-7 * BASE))
    assert best == "more"
    assert "rounded is alike" in reason


def test_a_fit_that_limits_is_told_and_so_is_what_the_baseline_leaves_open():
    poor = replace(row("poor", BASE), fit_errors=0.9 * BASE)
    best, reason = advised(poor, nothing=1.1)
    assert best == "poor"
    assert "poor is 0.979 mm off on exemplars that it was fitted to: a better fit may change this" in reason
    assert "which the held-out exemplars do not tell apart" in reason
    assert "do not tell apart" not in advised(poor)[1]


# the shell


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(Plugins, "load", lambda: PLUGINS)


def as_json(capsys, *args):
    code = cli.main([*map(str, args), "--json"])
    return code, json.loads(capsys.readouterr().out, parse_constant=pytest.fail)


def test_the_document(installed, found, tmp_path, capsys):
    asked = ["--decoder", "noisy:by=0.03", "--decoder", "spy", "--decoder", "choosy", "--folder", tmp_path / "kept"]
    code, said = as_json(capsys, "bank", "compare", "--source", "boxes", *asked)
    assert code == 0
    assert said["best"] == "spy"
    assert "spy: " in said["reason"]
    assert (said["unit"], tuple(said["inner"]), tuple(said["held_out"])) == ("m", found.inner, found.held_out)
    noisy, spy, choosy, nothing = said["rows"]
    assert noisy["decoder"] == {"name": "noisy", "options": {"by": 0.03}}
    assert list(noisy["errors"].values()) == found.row("noisy").errors.tolist()
    assert noisy["mean"] == found.row("noisy").mean
    assert noisy["fit_error"]["mean"] == found.row("noisy").fit_mean
    assert list(noisy["fit_error"]["by_exemplar"]) == list(found.inner)
    assert Path(spy["bank"]).parent == tmp_path / "kept"
    assert "one connectivity" in choosy["refusal"]
    assert (choosy["mean"], choosy["errors"], choosy["weights"]) == (None, None, None)
    assert (nothing["name"], nothing["decoder"], nothing["accepted"]) == ("nothing", None, None)


def test_people_see_a_line_a_decoder_and_the_reason(installed, capsys):
    assert cli.main(["bank", "compare", "--source", "boxes", "--decoder", "spy", "--decoder", "choosy"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "held out [m]" in err
    assert "recommended: spy" in err
    assert "choosy refuses: expected meshes of one connectivity" in err


def test_exit_codes(installed, capsys):
    code, said = as_json(capsys, "bank", "compare", "--source", "boxes", "--decoder", "choosy")
    assert (code, said["best"]) == (1, None)
    code, said = as_json(capsys, "bank", "compare", "--source", "boxes", "--set", "count=3", "--decoder", "spy")
    assert code == 2
    assert "expected at least 4" in said["error"]["message"]
    code, said = as_json(capsys, "bank", "compare", "--source", "gone", "--decoder", "spy:wide=3")
    assert code == 2
    assert "unknown option 'wide'" in said["error"]["message"]
