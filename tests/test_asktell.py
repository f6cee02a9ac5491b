"""Ask and tell: a search by what others evaluate goes the very way of one that calls them itself."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import AskTell, Linear, Maximise, Reduce, Study
from lampopt.errors import InputError, StudyError
from lampopt.plugins import Plugins
from lampopt.task import Task
from lampopt.testing import shapes

sys.path.insert(0, str(Path(__file__).parent))
import small
import toys


class Drag:
    """Least at a length of 2.7 m and a width of 1.25 m."""

    names, units = ("drag",), ("",)

    def __call__(self, mesh):
        length, width = mesh.extents[:2]
        return np.array([(length - 2.7) ** 2 + 3 * (width - 1.25) ** 2 + 0.1 * (length - 2.7) * (width - 1.25)])


class Offer:
    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"bulk": toys.Volume}


PLUGINS = Plugins.load([("small", small.Plugin()), ("offer", Offer())])
BY_PARAMETERS = {"length": 2.7, "width": 1.25}


@pytest.fixture(scope="module")
def bank():
    return small.bank(plugins=PLUGINS)


def test_what_contradicts_itself_is_missed_alike_by_all():
    """Two lengths at once: every candidate misses by as much, but for rounding, so that the value decides."""
    bank = small.bank(small.boxes(measured={"length": "extents.length"}), plugins=PLUGINS)
    found = AskTell(Study(bank, {"length": 2.5, "extents.length": 2.6}), plugins=PLUGINS)
    values = []
    while len(values) < 12 and (asked := found.ask()) is not None:
        values.append(float((asked.design.predicted[1] - 1.3) ** 2))
        found.tell(asked, values[-1])
    assert len(values) > 3 and found.best().value == min(values) < values[0]


def drag(candidate):
    return float(Drag()(candidate.mesh)[0])


def slopes(candidate):
    length, width = candidate.mesh.extents[:2]
    return {
        "length": 2 * (length - 2.7) + 0.1 * (width - 1.25),
        "width": 6 * (width - 1.25) + 0.1 * (length - 2.7),
    }


def search(study, **options):
    return AskTell(study, plugins=PLUGINS, **options)


def go_on(search, tell=lambda search, candidate: search.tell(candidate, drag(candidate)), most=10**6):
    while (candidate := search.ask()) is not None and candidate.number < most:
        tell(search, candidate)
    return search


def by_slopes(search, candidate):
    search.tell(candidate, drag(candidate), slopes(candidate))


def alphas(search):
    return np.array([candidate.alpha for candidate in search.told])


class Direct:
    """The same, called by the solver itself."""

    def __init__(self, task, posed, sloped):
        self.task, self.posed, self.sloped, self.asked = task, posed, sloped, []

    def __call__(self, alpha):
        full = self.posed.spread_out(alpha)
        self.asked.append(full)
        mesh = self.task.wishes.quantities.chain.mesh(full)
        by = None
        if self.sloped:
            found = slopes(type("Made", (), {"mesh": mesh}))
            by = (self.task.bank.parameters @ [found["length"], found["width"]])[self.posed.active]
        return float(Drag()(mesh)[0]), by


def direct(bank, sloped=False, solver="nlopt", **asked):
    """What solver `nlopt` asks for, and the mix it ends with."""
    task = Task.of(Study(bank, solver=solver, **asked), PLUGINS)
    posed = task.posed(task.asked({}))
    term = Direct(task, posed, sloped)
    mix = task.solver.solve(replace(posed.problem, objectives=(term,)))
    return np.array(term.asked), posed.spread_out(mix.alpha), mix.message


CASES = pytest.mark.parametrize(
    ("asked", "sloped"),
    [
        ({}, False),
        ({}, True),
        ({"keep": ("width",), "hard": ("width",), "reference": "box_1"}, False),
        ({"keep": ("width",), "hard": ("width",), "reference": "box_1"}, True),
        ({"ranges": {"length": (2.0, 2.5)}}, False),
        ({"linear": {"sum": Linear({"length": 1, "width": 1}, high=3.8)}}, True),
        ({"alpha": (-0.5, 0.5), "ridge": 1e-3}, False),
        ({"solver": lampopt.Spec("nlopt", algorithm="cobyla", evaluations=23)}, False),
        ({"solver": lampopt.Spec("nlopt", evaluations=12)}, False),
        ({"solver": lampopt.Spec("nlopt", ridge=0.3), "reference": "box_1"}, False),
    ],
)


@CASES
def test_goes_the_way_of_a_direct_run(bank, asked, sloped):
    wanted, alpha, message = direct(bank, sloped, **asked)
    study = Study(bank, **asked)
    found = go_on(search(study), by_slopes if sloped else lambda s, c: s.tell(c, drag(c)))
    assert len(found.told) == len(wanted)
    np.testing.assert_array_equal(alphas(found), wanted)
    result = found.result()
    np.testing.assert_array_equal(result.design.mix.alpha, alpha)
    assert result.design.mix.message == message
    assert found.best().value == pytest.approx(drag(result.design), abs=1e-13)  # rounding chooses between the last


def test_finds_what_is_least_and_says_how(bank):
    found = go_on(search(Study(bank)), by_slopes)
    assert dict(zip(("length", "width"), found.best().design.predicted, strict=True)) == pytest.approx(
        BY_PARAMETERS, abs=1e-3
    )
    assert found.best().value == min(candidate.value for candidate in found.told)
    assert "slsqp" in found.result().design.mix.message
    assert found.result().design.mesh.extents[:2] == pytest.approx([2.7, 1.25], abs=1e-3)


def test_targets_are_kept_but_those_with_a_weight(bank):
    kept = go_on(search(Study(bank, targets={"length": "2400 mm"})))
    assert all(c.design.predicted[0] == pytest.approx(2.4, abs=1e-9) for c in kept.told)
    given = go_on(search(Study(bank, targets={"length": 2.4}, weights={"length": 0.01})))
    assert given.best().design.predicted[0] > 2.5


def test_a_reduced_label_is_a_target(bank):
    study = Study(bank, objective=Reduce("drag", by=0.05), reference="box_3")
    found = go_on(search(study), most=10)
    assert found.result().design.target["drag"] == pytest.approx(0.95 * 0.38)
    labels = np.nan_to_num(bank.labels[:, 0])
    assert alphas(found) @ labels == pytest.approx(0.95 * 0.38)


def test_targets_on_measured_values_are_looked_after(bank):
    study = Study(bank, targets={"bulk.volume": 2.4}, hard=("bulk.volume",), measures=("bulk",))
    best = go_on(search(study)).best()
    assert best.mesh.volume == pytest.approx(2.4, abs=1e-4)
    lengths = np.linspace(2, 3, 1001)  # of boxes of that volume
    at = np.array([[length, 3.0 / length, 0.8] for length in lengths])
    lowest = lengths[np.argmin([Drag()(shapes.box(extents))[0] for extents in at])]
    assert best.mesh.extents[0] == pytest.approx(lowest, abs=0.01)


def test_the_same_is_asked_until_it_is_told(bank):
    found = search(Study(bank))
    first = found.ask()
    assert found.ask() is first
    assert first.value is None
    assert found.told == ()
    found.tell(first.number, 1.0)
    assert found.ask().number == 1
    assert [c.value for c in found.told] == [1.0]


def test_the_first_is_the_answer_without_what_is_told(bank):
    first = search(Study(bank, targets={"length": 2.3})).ask()
    mix = lampopt.run(Study(bank, targets={"length": 2.3}), plugins=PLUGINS).design.mix
    assert first.alpha == pytest.approx(mix.alpha)


@pytest.mark.parametrize("tell", [by_slopes, lambda s, c: s.tell(c, drag(c))])
@pytest.mark.parametrize("every", [1, 5])
def test_goes_on_from_a_file(bank, tmp_path, tell, every):
    study, file = Study(bank, keep=("width",), reference="box_1"), tmp_path / "search.json"
    whole = go_on(search(study), tell)
    part = search(study)
    while part.ask() is not None:
        go_on(part, tell, most=len(part.told) + every)
        assert part.save(file) == file
        part = AskTell.load(file, study, plugins=PLUGINS)
    np.testing.assert_array_equal(alphas(part), alphas(whole))
    assert [c.value for c in part.told] == [c.value for c in whole.told]
    np.testing.assert_array_equal(part.result().design.mix.alpha, whole.result().design.mix.alpha)


def test_what_another_machine_rounds_otherwise_is_still_known(bank, tmp_path):
    study, file = Study(bank), go_on(search(Study(bank)), most=8).save(tmp_path / "search.json")
    document = json.loads(file.read_text())
    for told in document["told"]:
        told["alpha"] = [value + 1e-13 for value in told["alpha"]]
    file.write_text(json.dumps(document))
    assert AskTell.load(file, study, plugins=PLUGINS).ask().number == 8


def test_another_way_is_an_error(bank, tmp_path):
    study, file = Study(bank), go_on(search(Study(bank)), most=8).save(tmp_path / "search.json")
    document = json.loads(file.read_text())
    document["told"][3]["value"] += 1.0
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"goes another way than it did, from candidate \d on"):
        AskTell.load(file, study, plugins=PLUGINS)


@pytest.mark.parametrize(
    ("other", "scale"),
    [({"keep": ("width",)}, 1.0), ({"ridge": 0.1}, 1.0), ({}, 2.0), ({"solver": lampopt.Spec("nlopt", step=0.5)}, 1.0)],
)
def test_the_search_of_another_study_is_refused(bank, tmp_path, other, scale):
    file = go_on(search(Study(bank)), most=3).save(tmp_path / "search.json")
    with pytest.raises(InputError, match=r"search\.json: is the search of another bank, study or scale"):
        AskTell.load(file, Study(bank, **other), scale=scale, plugins=PLUGINS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "cannot be read as a search"),
        ("[]", "cannot be read as a search"),
        ("[" * 100_000, "cannot be read as a search"),
        ("{}", "cannot be read as a search"),
        ('{"schema": 2, "search": "", "told": []}', "expected schema 1, got 2: take a newer lampopt"),
    ],
)
def test_what_is_no_search_is_refused(bank, tmp_path, text, said):
    (tmp_path / "search.json").write_text(text)
    with pytest.raises(InputError, match=rf"search\.json: {said}"):
        AskTell.load(tmp_path / "search.json", Study(bank), plugins=PLUGINS)
    with pytest.raises(InputError, match=r"nothing\.json: cannot be read as a search: no such file"):
        AskTell.load(tmp_path / "nothing.json", Study(bank), plugins=PLUGINS)


def test_who_reports_or_judges_makes_no_other_search(bank, tmp_path):
    """What was told was dear; a measure that only reports may be another next week."""
    file = go_on(search(Study(bank)), most=3).save(tmp_path / "search.json")
    other = Study(bank, measures=["volume"], limits={"alpha": 9.0}, level="alpha", resolution=32)
    assert AskTell.load(file, other, plugins=PLUGINS).ask().number == 3


def test_a_limit_that_the_search_keeps_to_makes_another_one(bank, tmp_path):
    study = Study(bank, safe=["alpha"], limits={"alpha": 3.0})
    file = go_on(search(study), most=3).save(tmp_path / "search.json")
    assert AskTell.load(file, study, plugins=PLUGINS).ask().number == 3
    with pytest.raises(InputError, match="is the search of another bank, study or scale"):
        AskTell.load(file, replace(study, limits={"alpha": 0.5}), plugins=PLUGINS)


@pytest.mark.parametrize("told", [[{}], [3], 3, [{"alpha": [1.0], "value": 1.0}], [{"alpha": "x", "value": 1.0}]])
def test_damaged_entries_are_refused(bank, tmp_path, told):
    file = go_on(search(Study(bank)), most=1).save(tmp_path / "search.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | {"told": told}))
    with pytest.raises(InputError, match=r"search\.json: cannot be read as a search"):
        AskTell.load(file, Study(bank), plugins=PLUGINS)


def test_a_place_that_cannot_be_written_is_named(bank, tmp_path):
    with pytest.raises(InputError, match=r"search\.json: cannot be written: No such file"):
        search(Study(bank)).save(tmp_path / "nowhere" / "search.json")


def test_an_unknown_candidate_is_an_error(bank):
    found = search(Study(bank))
    other = go_on(search(Study(bank, keep=("width",), reference="box_1")), most=1)
    first = found.ask()
    for wrong, said in (
        (-1, r"candidate -1: is not what this search asks, which is number 0"),
        (7, r"candidate 7: is not what this search asks, which is number 0"),
        (other.told[0], r"candidate 0: is not what this search asks, which is number 0"),
        ("first", r"candidate: expected what ask\(\) returned, or its number, got 'first'"),
        (True, r"candidate: expected what ask\(\) returned"),
        (None, r"candidate: expected what ask\(\) returned"),
    ):
        with pytest.raises(InputError, match=said):
            found.tell(wrong, 1.0)
    found.tell(first, 1.0)
    with pytest.raises(InputError, match=r"candidate 0: was told of already: 1"):
        found.tell(first, 2.0)


def test_nothing_is_told_after_the_end(bank):
    found = go_on(search(Study(bank, solver=lampopt.Spec("nlopt", evaluations=5))))
    assert len(found.told) == 5
    with pytest.raises(InputError, match=r"candidate 5: the search is at its end"):
        found.tell(5, 1.0)


@pytest.mark.parametrize("value", ["1", None, True, [1.0], 10**400])
def test_a_value_is_a_number(bank, value):
    found = search(Study(bank))
    with pytest.raises(InputError, match="value: expected a number, NaN where there is none"):
        found.tell(found.ask(), value)
    assert found.told == ()


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf])
def test_where_there_is_no_value_the_search_keeps_off(bank, tmp_path, nothing):
    def tell(search, candidate):
        length = candidate.design.predicted[0]
        search.tell(candidate, nothing if length > 2.6 else drag(candidate))

    study = Study(bank, solver=lampopt.Spec("nlopt", evaluations=60))
    found = go_on(search(study), tell)
    lost = [c for c in found.told if np.isnan(c.value)]
    assert lost
    assert found.best().design.predicted == pytest.approx([2.6, 1.25], abs=0.05)
    assert f"{len(lost)} of the evaluations had no value" in found.result().design.mix.message
    again = AskTell.load(found.save(tmp_path / "search.json"), study, plugins=PLUGINS)
    assert again.ask() is None
    np.testing.assert_array_equal(again.best().alpha, found.best().alpha)


def test_the_best_is_worth_its_ridge_too(bank):
    found = go_on(search(Study(bank, solver=lampopt.Spec("nlopt", ridge=0.3), reference="box_1")))
    np.testing.assert_allclose(found.best().alpha, found.result().design.mix.alpha, atol=1e-6)
    assert found.best().value > min(candidate.value for candidate in found.told)


def test_where_nothing_has_a_value_there_is_no_best(bank):
    found = go_on(search(Study(bank, solver=lampopt.Spec("nlopt", evaluations=4))), lambda s, c: s.tell(c, np.nan))
    assert found.best() is None
    assert found.result().design.mix.status == "failed"


def test_a_result_is_judged_on_the_way(bank):
    found = go_on(search(Study(bank, targets={"length": 2.4})), most=3)
    result = found.result()
    np.testing.assert_array_equal(result.design.mix.alpha, found.best().alpha)
    assert result.design.mix.message == "the best of 3 evaluations of a search that goes on"
    assert result.design.mix.status == "exact"
    assert result.check("target").passed


def test_gradients_by_vertices_alpha_and_parameters_lead_the_same_way(tmp_path):
    boxes = small.boxes()
    bank = lampopt.build_bank(boxes, lampopt.Spec("mesh-template", faces=600, cell=0.3), probes=16)
    volume = toys.Volume()

    def tell(search, candidate, gradient):
        off = float(volume(candidate.mesh)[0]) - 2.4
        search.tell(candidate, off**2, gradient(candidate, 2 * off))

    def by_vertices(candidate, factor):
        return factor * volume.gradient(candidate.mesh)[0]

    found = [lampopt.AskTell(Study(bank, keep=("width",), reference="box_1")) for _ in range(2)]
    go_on(found[0], lambda s, c: tell(s, c, by_vertices), most=6)

    def by_alpha(candidate, factor):
        chain = Task.of(Study(bank), None).wishes.quantities.chain
        return factor * chain.back(candidate.alpha, volume.gradient(candidate.mesh)[0])

    go_on(found[1], lambda s, c: tell(s, c, by_alpha), most=6)
    assert alphas(found[1]) == pytest.approx(alphas(found[0]), abs=1e-7)
    assert found[0].best().mesh.volume == pytest.approx(2.4, abs=0.01)


def test_gradients_that_cannot_be_used_are_refused(bank):
    found = search(Study(bank))
    first = found.ask()
    for gradient, said in (
        ({"height": 1.0}, "'height'.* no parameters; known are length, width"),
        (np.ones(3), r"gradient: expected \(7,\) by alpha"),
        (np.ones((8, 3)), r"gradient: expected \(7,\) by alpha"),  # this decoder is no Pullback
        ("steep", "expected numbers, got 'steep'"),
        ([10**400] * 7, "expected numbers"),
        (np.full(7, np.nan), "gradient: expected finite numbers"),
    ):
        with pytest.raises(InputError, match=said):
            found.tell(first, 1.0, gradient)
    by_slopes(found, first)
    second = found.ask()
    with pytest.raises(InputError, match="gradient: expected one, as was told before"):
        found.tell(second, 1.0)
    found.tell(second, np.nan)  # nothing has no derivatives


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"objective": Maximise("drag")}, r"objective: the value that is told is to be least"),
        ({"turns": 1}, "turns: a search corrects nothing"),
        ({"solver": "casadi"}, "solver: expected 'nlopt', got 'casadi'"),
        ({"solver": lampopt.Spec("nlopt", seconds=3)}, "solver: seconds: a search that is replayed has no clock"),
    ],
)
def test_studies_that_cannot_be_searched_are_refused(bank, asked, said):
    with pytest.raises(StudyError, match=said):
        search(Study(bank, **asked))


def test_wrong_arguments_are_refused(bank):
    for scale in (0, -1.0, np.nan, np.inf, "1", True):
        with pytest.raises(StudyError, match="scale: expected a positive number"):
            search(Study(bank), scale=scale)
    with pytest.raises(StudyError, match="study: expected a Study"):
        AskTell(bank)


def test_the_best_so_far_is_exact_only_where_all_of_it_is_met():
    """Ranges and hard targets on what is measured count too, while the search goes on."""
    bank, plugins = small.bank(), Plugins.load([("small", small.Plugin())])
    measured = {"measures": {"own": toys.Volume()}, "solver": "nlopt"}
    for asked in ({"targets": {"own.volume": 4.0}, "hard": ("own.volume",)}, {"ranges": {"own.volume": (4.0, 5.0)}}):
        search = AskTell(Study(bank, **asked, **measured), plugins=plugins)
        search.tell(search.ask(), 1.0)
        result = search.result()
        assert result.design.mix.status == "inexact" and not result.accepted
