"""Designs that join their bank: boxes, of which every value is known in closed form."""

import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Parameter, Study, cli
from lampopt.errors import BankError, InputError
from lampopt.identity import whole
from lampopt.testing import shapes

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

MEASURED = {"length": "extents.length", "width": "extents.width"}
GRID = {"length": [2.1, 2.95], "width": [1.15, 1.25]}
PER_EXEMPLAR = ("parameters", "labels", "weights", "probe_values", "fit_error", "measured")
CALLS = small.CALLS


@dataclass(frozen=True)
class Stretches(small.Stretch):
    """Decodes every box a hundredth longer than its weights say."""

    def decode(self, shared, weights, *, resolution):
        return shapes.box(weights[:3].astype(float) * (1.01, 1, 1), centre=weights[3:].astype(float))


class Plugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"stretches": Stretches}


def plugins():
    return small.plugins(("stretches", Plugin()))


def build(exemplars=None, decoder="stretch", **options):
    return small.bank(exemplars or small.boxes(measured=MEASURED), decoder, plugins=plugins(), **options)


def enrich(bank, designs, **options):
    return lampopt.enrich(bank, designs, plugins=plugins(), **options)


def sweep(bank, folder=None, grid=GRID, **asked):
    """Results of a sweep of boxes."""
    return list(lampopt.sweep(Study(bank, **asked), grid, folder, report=False, plugins=plugins()))


@pytest.fixture(autouse=True)
def fresh():
    CALLS.clear()
    small.INTERRUPT[0] = 0


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    return build(store=tmp_path_factory.mktemp("bank") / "boxes.lamp")


@pytest.fixture(scope="module")
def folder(bank, tmp_path_factory):
    place = tmp_path_factory.mktemp("runs") / "roof"
    sweep(bank, place, measures=("volume",))
    return place


@pytest.fixture(scope="module")
def mixed(bank, tmp_path_factory):
    """A run of which the design of 3.4 m was rejected."""
    place = tmp_path_factory.mktemp("runs") / "mixed"
    found = sweep(bank, place, {"length": [2.1, 3.4, 2.3]}, limits={"alpha": 1.0}, keep=("width",))
    assert [result.accepted for result in found] == [True, False, True]
    return place


def names_of(folder):
    return tuple(result.folder.name for result in lampopt.results(folder, plugins=plugins()))


# the bank that comes of it


def test_the_bank_grows_and_those_that_were_there_stay(bank, folder):
    CALLS.clear()
    grown = enrich(bank, folder)
    assert (CALLS["prepare"], CALLS["fit"], CALLS["decode"]) == (0, 4, 0)  # meshes come from their files
    assert grown.names == (*bank.names, *names_of(folder))
    for name in PER_EXEMPLAR:
        assert getattr(grown, name)[:7].tobytes() == getattr(bank, name).tobytes(), name
    asked = [[2.1, 1.15], [2.1, 1.25], [2.95, 1.15], [2.95, 1.25]]
    assert grown.parameters[7:] == pytest.approx(np.array(asked), abs=1e-5)
    assert grown.measured[7:] == pytest.approx(np.array(asked), abs=1e-5)
    extents = np.column_stack([asked, np.full(4, 0.8)]) * bank.frame.scale
    assert grown.weights[7:, :3] == pytest.approx(extents, rel=1e-5)
    assert np.isnan(grown.labels[7:]).all()
    assert small.same(lampopt.load_bank(bank.path), bank)  # which is as it was


def test_asking_for_what_joined_gives_it_back(bank, folder):
    """Near the joined exemplar, its own parameters are that exemplar: alpha is one there, and its mesh comes back."""
    grown = enrich(bank, folder)
    joined = grown.names[-1]
    asked = dict(zip(("length", "width"), grown.parameters[-1], strict=True))
    result = lampopt.design(grown, asked, reference=joined, plugins=plugins())
    assert result.accepted
    assert result.design.mix.alpha == pytest.approx(np.eye(len(grown))[-1], abs=1e-9)
    before = next(r for r in lampopt.results(folder, plugins=plugins()) if r.folder.name == joined)
    assert result.design.mesh.bounds == pytest.approx(before.design.mesh.bounds, abs=1e-5)


def test_where_it_comes_from_is_kept(bank, folder, tmp_path):
    grown = enrich(bank, folder, store=tmp_path / "grown.lamp")
    for result in lampopt.results(folder, plugins=plugins()):
        key = result.folder.name
        record = json.loads(lampopt.load_bank(tmp_path / "grown.lamp").provenance[f"joined.{key}"])
        assert record == {"design": f"roof/{key}", "asked": dict(result.design.target), "bank": whole(bank)}
    assert grown.provenance["added"] == ", ".join(names_of(folder))
    # it stays there: what the bank makes names it by its plan, and does not carry every record along
    made = lampopt.design(grown, {"length": 2.5}, plugins=plugins())
    assert made.provenance["bank.plan"] == grown.provenance["plan"] != bank.provenance["plan"]
    assert not [name for name in made.provenance if "joined" in name]


def test_parameters_are_as_measured_where_the_bank_tells_how():
    """Boxes come out 1 % too long; width is what the mix predicts, for nothing measures it."""
    long = build(small.boxes(measured={"length": "extents.length"}), "stretches")
    (result,) = sweep(long, None, {"length": [2.5]}, keep=("width",), limits={"drift": 1.0})
    assert result.accepted
    grown = enrich(long, [result])
    assert result.design.predicted == pytest.approx([2.5, small.WIDTHS.mean()])
    assert grown.parameters[7] == pytest.approx([2.525, small.WIDTHS.mean()], rel=1e-6)
    assert grown.measured[7] == pytest.approx([2.525], rel=1e-6)
    unmeasured = build(small.boxes(), "stretches")
    (result,) = sweep(unmeasured, None, {"length": [2.5]}, keep=("width",))
    assert enrich(unmeasured, [result]).parameters[7, 0] == pytest.approx(2.5)


def test_what_is_measured_may_be_offset_and_scaled():
    """What is measured is 1.1 times the parameter and 0.2 m, and comes out 1 % too long: the parameter is corrected."""
    given = small.boxes()
    meshes = [shapes.box([1.1 * length + 0.2, width, 0.8]) for length, width in given.parameters]
    long = build(small.boxes(meshes=meshes, measured={"length": "extents.length"}), "stretches")
    (result,) = sweep(long, None, {"length": [2.5]}, keep=("width",), limits={"drift": 1.0})
    measured = 1.01 * (1.1 * 2.5 + 0.2)
    grown = enrich(long, result)
    assert grown.measured[7, 0] == pytest.approx(measured, rel=1e-6)
    assert grown.parameters[7, 0] == pytest.approx((measured - 0.2) / 1.1, rel=1e-6)


def test_measured_in_another_unit():
    given = small.boxes(measured={"length": "extents.length"})
    given = replace(
        given, parameters=given.parameters * (1000, 1), space=(Parameter("length", "mm"), Parameter("width", "m"))
    )
    long = build(given, "stretches")
    (result,) = sweep(long, None, {"length": ["2.5 m"]}, limits={"drift": 1.0})
    assert enrich(long, result).parameters[7, 0] == pytest.approx(2525, rel=1e-6)


def test_a_parameter_without_spread_gets_none():
    """Rounding in the mix would make a range of 1e-16 of it, which later targets would be stretched over."""
    given = small.boxes(measured={"length": "extents.length"})
    third = np.column_stack([given.parameters, np.full(7, 0.1 + 0.2)])
    given = replace(given, parameters=third, space=(*given.space, Parameter("height", "m")))
    flat = build(given)
    results = sweep(flat, None, {"length": np.linspace(2.05, 2.95, 12)})
    assert len({float(result.design.predicted[2]) for result in results}) > 1
    assert set(enrich(flat, results).parameters[:, 2]) == {0.1 + 0.2}


# who joins


def test_results_and_their_folder_are_the_same(bank, folder):
    found = list(lampopt.results(folder, plugins=plugins()))
    assert small.same(enrich(bank, found), enrich(bank, folder))
    assert small.same(enrich(bank, iter(found)), enrich(bank, folder))


def test_results_that_were_never_recorded(bank):
    first, *others = sweep(bank)
    grown = enrich(bank, [first])
    (name,) = grown.names[7:]
    assert len(name) == 24
    record = json.loads(grown.provenance[f"joined.{name}"])
    assert record == {"design": name, "asked": {"length": 2.1, "width": 1.15}, "bank": whole(bank)}
    assert enrich(bank, [first, *others]).names[7] == name  # the same design has the same name
    first.design.mesh.vertices[:] = 0  # what a caller holds is nobody's but theirs
    assert grown.measured[7] == pytest.approx([2.1, 1.15], abs=1e-5)
    with pytest.raises(InputError, match="twice"):
        enrich(bank, [others[0], others[0]])


def test_names_may_be_given(bank, folder):
    found = list(lampopt.results(folder, plugins=plugins()))
    grown = enrich(bank, {"short": found[0], "long": found[3]})
    assert grown.names[7:] == ("short", "long")
    assert json.loads(grown.provenance["joined.long"])["design"] == f"roof/{found[3].folder.name}"
    assert lampopt.design(grown, {}, keep=("width",), reference="long", plugins=plugins()).accepted


def test_only_some(bank, folder):
    one, two, three, four = names_of(folder)
    assert enrich(bank, folder, only=[three]).names[7:] == (three,)
    assert enrich(bank, folder, leave_out=[three, one]).names[7:] == (two, four)
    with pytest.raises(InputError, match=rf"designs: no car, van among them; there are {one}, {two}"):
        enrich(bank, folder, only=["van"], leave_out=["car"])


def test_a_rejected_one_is_refused_by_name_with_what_it_failed(bank, mixed):
    one, rejected, three = names_of(mixed)
    with pytest.raises(InputError) as caught:
        enrich(bank, mixed)
    assert f"1 of 3 designs cannot join:\n  design '{rejected}': was rejected by alpha " in str(caught.value)
    assert "(expected <= 1)" in str(caught.value)
    assert not CALLS["fit"]
    for left in ("rejected", [rejected]):
        assert enrich(bank, mixed, leave_out=left).names[7:] == (one, three)
    with pytest.raises(InputError, match="expected at least one that was accepted and may join, got none of 3"):
        enrich(bank, mixed, only=[rejected], leave_out="rejected")


def test_many_that_were_rejected_are_counted(bank):
    found = sweep(bank, None, {"length": np.linspace(2.1, 2.9, 25)}, limits={"alpha": 0.0})
    with pytest.raises(InputError, match=r"(?s)25 of 25 designs cannot join:(\n  design '\w+'.*){20}\n  and 5 more"):
        enrich(bank, found)


@pytest.mark.parametrize("level", ["alpha", "field"])
def test_a_design_that_was_not_judged_by_its_mesh_is_refused(bank, tmp_path, level):
    found = sweep(bank, tmp_path, {"length": [2.5]}, level=level)
    for designs in (tmp_path, found):
        with pytest.raises(InputError, match=r"was not judged by its mesh: run its study with level = 'mesh'"):
            enrich(bank, designs)


def test_results_of_another_bank_are_refused_and_its_folder_is_not(bank, folder, tmp_path):
    """The folder knows its bank: what was predicted, and where it comes from, is by that one."""
    grown = enrich(bank, folder, only=names_of(folder)[:1])
    with pytest.raises(InputError, match="was made by another bank: name its run folder, which knows the bank"):
        enrich(grown, list(lampopt.results(folder, plugins=plugins())))
    both = enrich(grown, folder, leave_out=names_of(folder)[:1])
    assert small.same(replace(both, provenance={}), replace(enrich(bank, folder), provenance={}))
    for name in names_of(folder):
        assert json.loads(both.provenance[f"joined.{name}"])["bank"] == whole(bank) != whole(grown)
    with pytest.raises(InputError, match="already in the bank"):
        enrich(both, folder)


# labels


def test_a_label_by_its_address_as_recorded_or_measured_now(folder, tmp_path):
    unit = (Parameter("drag"), Parameter("room", "litre"))
    labels = np.column_stack([small.DRAG, 800 * small.LENGTHS * small.WIDTHS])
    known = build(small.boxes(labels=labels, label_space=unit, measured=MEASURED), store=tmp_path / "a.lamp")
    for measures in (("volume",), ()):
        found = sweep(known, None, measures=measures)
        grown = enrich(known, found, labels={"room": "volume.volume"})
        assert np.isnan(grown.labels[7:, 0]).all()
        expected = [800 * result.design.target["length"] * result.design.target["width"] for result in found]
        assert grown.labels[7:, 1] == pytest.approx(expected, rel=1e-5)
        record = json.loads(grown.provenance[f"joined.{grown.names[7]}"])
        assert record["labels"] == {"room": "volume.volume"}
    assert grown.label_space[1].unit == "litre"


def test_what_the_study_recorded_is_not_measured_again(bank, folder):
    """It may have been dear: no measure of that name needs to be there any more."""
    found = list(lampopt.results(folder, plugins=plugins()))
    checks = [replace(c, name="flow.drag", unit="") if c.name == "volume.volume" else c for c in found[0].checks]
    grown = enrich(bank, [replace(found[0], checks=tuple(checks))], labels={"drag": "flow.drag"})
    assert grown.labels[7, 0] == pytest.approx(2.1 * 1.15 * 0.8, rel=1e-5)


def test_labels_as_values(bank, folder):
    one, *_, four = names_of(folder)
    listed = enrich(bank, folder, labels={"drag": [0.31, None, float("nan"), "35 %"]})
    assert listed.labels[7:, 0] == pytest.approx([0.31, np.nan, np.nan, 0.35], nan_ok=True)
    named = enrich(bank, folder, labels={"drag": {four: 0.35, one: np.float32(0.25)}})
    assert named.labels[7:, 0] == pytest.approx([0.25, np.nan, np.nan, 0.35], nan_ok=True)
    assert json.loads(named.provenance[f"joined.{one}"])["labels"] == {"drag": "given"}
    asked = lampopt.design(named, {"drag": 0.35}, reference=four, plugins=plugins())
    assert asked.design.mix.alpha == pytest.approx(np.eye(11)[10], abs=1e-9)  # a label that is known can be asked for


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"lift": [1, 2, 3, 4]}, "labels: 'lift' is no label of this bank; there are drag"),
        (["drag"], r"labels: expected a table such as \{'drag': 'flow.drag'\}, got \['drag'\]"),
        ({"drag": [1, 2]}, "labels: drag: expected 4 values, one for each design, got 2"),
        ({"drag": 5}, "labels: drag: expected the address of a measured value, or values, got 5"),
        ({"drag": {"car": 5}}, "labels: drag: 'car' is no design that joins; there are "),
        ({"drag": [1, 2, "many", 4]}, "labels: drag of design '.*': expected a number or text such as"),
        ({"drag": [1, 2, float("inf"), 4]}, "labels: drag of design '.*': expected a finite number"),
        ({"drag": "volume"}, "measured value 'volume': expected 'measure.value', one of volume.volume"),
        ({"drag": "size.volume"}, r"labels: drag: 'size.volume': cannot bring \[m\^3\] to \[dimensionless\]"),
        ({"drag": "size.mass"}, "measured value 'size.mass': expected 'measure.value', one of size.length"),
    ],
)
def test_labels_that_cannot_be_are_refused(bank, folder, labels, message):
    with pytest.raises(InputError, match=message):
        enrich(bank, folder, labels=labels)
    assert not CALLS["fit"]


# what is refused


@pytest.mark.parametrize(
    ("designs", "options", "message"),
    [
        (5, {}, "designs: expected a run folder or results, such as those of lampopt.run, got 5"),
        ([5], {}, "designs: expected a run folder or results, .* got 5"),
        ([], {}, "designs: expected at least one that was accepted and may join, got none of 0"),
        ({"a": 5}, {}, "designs: expected a run folder or results"),
        ("nowhere", {}, "nowhere/study.toml: cannot be read as a study"),
        ([], {"only": "a"}, "only: expected a list of names of designs, got 'a'"),
        (
            [],
            {"leave_out": "a"},
            "leave_out: expected a list of names of designs, or 'rejected' for all that were, got",
        ),
        ([], {"leave_out": [5]}, "leave_out: expected a list of names of designs, .*, got one with 5"),
    ],
)
def test_what_is_no_design_is_refused(bank, designs, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        enrich(bank, designs, **options)


def test_what_is_no_bank_is_refused(folder):
    with pytest.raises(InputError, match=r"bank: expected a Bank, got 'cars\.lamp'; read one with load_bank"):
        enrich("cars.lamp", folder)


def test_a_name_that_is_none_is_refused(bank):
    (result,) = sweep(bank, None, {"length": [2.5]})
    for name in ("", 5):
        with pytest.raises(InputError, match="expected results by the names that they are to have, got"):
            enrich(bank, {name: result})


def test_a_design_whose_mesh_is_not_of_its_bank_is_doubted(bank):
    """Intake holds it against the bank's own, as every newcomer."""
    (result,) = sweep(bank, None, {"length": [2.5]})
    pair = shapes.box([2.5, 1.2, 0.8]) + shapes.box([0.1] * 3, centre=(0, 0, 1))
    odd = replace(result, design=replace(result.design, make_mesh=lambda: pair))
    with pytest.raises(InputError, match="'odd': expected bodies 1, as all of the bank's own have, got 2"):
        enrich(bank, {"odd": odd})
    assert enrich(bank, {"odd": odd}, accept=["odd"]).names[7:] == ("odd",)
    gone = replace(result, design=replace(result.design, make_mesh=lambda: None))
    with pytest.raises(InputError, match="design 'gone': its mesh is gone and cannot be made again"):
        enrich(bank, {"gone": gone})


# facts that add_exemplars is told


def test_facts_are_kept_beside_the_banks_own(bank):
    new = replace(small.boxes(measured=MEASURED), names=tuple(f"new_{i}" for i in range(7)))
    plain, told = (
        lampopt.add_exemplars(bank, new, provenance=facts, plugins=plugins()) for facts in (None, {"flow.mesh": 3})
    )
    assert told.provenance["flow.mesh"] == 3
    assert plain.provenance["plan"] != told.provenance["plan"]
    assert lampopt.remove_exemplars(told, ["new_1"]).provenance["flow.mesh"] == 3
    for wrong in ({"plan": "x"}, {"flow.mesh": [1]}, ["flow.mesh"], {5: 6}):
        with pytest.raises(InputError, match="provenance: expected texts, numbers and truth values by names with a"):
            lampopt.add_exemplars(bank, new, provenance=wrong, plugins=plugins())


# in files, and from the shell


def test_an_interrupted_one_goes_on_and_ends_the_same(bank, folder, tmp_path):
    store = tmp_path / "grown.lamp"
    small.INTERRUPT[0] = 2
    with pytest.raises(KeyboardInterrupt):
        enrich(bank, folder, store=store)
    assert not store.exists()
    small.INTERRUPT[0] = 0
    CALLS.clear()
    grown = enrich(bank, folder, store=store)
    assert CALLS["fit"] == 3
    assert small.same(grown, enrich(bank, folder))
    CALLS.clear()
    assert small.same(enrich(bank, folder, store=store), grown)  # once more only reads
    assert not CALLS["fit"]
    with pytest.raises(BankError, match="holds another bank"):
        enrich(bank, folder, store=store, only=names_of(folder)[:1])


def test_from_the_shell(bank, mixed, tmp_path, monkeypatch, capsys):
    one, rejected, three = names_of(mixed)
    offered = plugins()
    monkeypatch.setattr("lampopt.plugins.Plugins.load", lambda: offered)

    def ask(*args):
        code = cli.main(["bank", "enrich", *map(str, args), "--json"])
        return code, json.loads(capsys.readouterr().out)

    code, document = ask(bank.path, mixed, "--out", tmp_path / "a.lamp")
    assert code == 2
    assert f"'{rejected}': was rejected by alpha" in document["error"]["message"]
    assert "--leave-out rejected" in document["error"]["message"]
    code, document = ask(bank.path, mixed, "--leave-out", "rejected", "--out", tmp_path / "a.lamp")
    assert (code, document["exemplars"], document["provenance"]["added"]) == (0, 9, f"{one}, {three}")
    assert json.loads(document["provenance"][f"joined.{one}"])["design"] == f"mixed/{one}"
    label = ("--label", "drag=extents.length")
    code, document = ask(bank.path, mixed, three, *label, "--out", tmp_path / "b.lamp")
    assert code == 2
    assert "labels: drag: 'extents.length': cannot bring [m] to [dimensionless]" in document["error"]["message"]
    code, document = ask(bank.path, mixed, three, "--leave-out", rejected, "--out", tmp_path / "b.lamp")
    assert (code, document["provenance"]["added"]) == (0, three)
    code, document = ask(bank.path, mixed, "none", "--out", tmp_path / "c.lamp")
    assert code == 2
    assert "no none among them" in document["error"]["message"]
    assert sorted(os.listdir(tmp_path)) == ["a.lamp", "b.lamp"]


def test_what_is_known_of_a_design_goes_with_its_exemplar(tmp_path):
    """Else another exemplar of that name would count as the design."""
    known = {"joined.box_1": "{}", "joined.box_2": "{}"}
    bank = small.bank()
    bank = replace(bank, provenance={**bank.provenance, **known})
    fewer = lampopt.remove_exemplars(bank, ["box_1"])
    assert "joined.box_1" not in fewer.provenance and "joined.box_2" in fewer.provenance
