"""Exemplars added to a bank and taken from it: the others stay as they are, bit for bit."""

import json
import logging
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import cli
from lampopt.errors import BankError, FitError, InputError
from lampopt.testing import shapes
from lampopt.types import Calibration, Parameter

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

MEASURED = {"length": "extents.length", "width": "extents.width"}
PER_EXEMPLAR = ("parameters", "labels", "weights", "probe_values", "fit_error", "measured")
CALLS = small.CALLS


@pytest.fixture(autouse=True)
def fresh():
    CALLS.clear()
    small.INTERRUPT[0] = 0


@pytest.fixture(scope="module")
def bank():
    return small.bank(few(range(4)))


def few(rows, **changes):
    """Some of the seven boxes."""
    rows = list(rows)
    every = small.boxes(measured=MEASURED)
    chosen = {
        "parameters": every.parameters[rows],
        "labels": every.labels[rows],
        "names": tuple(every.names[i] for i in rows),
        "meshes": [every.meshes[i] for i in rows],
        "mesh_at": None,
    }
    return replace(every, **{**chosen, **changes})


def add(bank, exemplars, **options):
    return lampopt.add_exemplars(bank, exemplars, plugins=small.plugins(), **options)


def test_what_is_there_stays_and_the_new_is_fitted_from_the_same_start(bank):
    CALLS.clear()
    grown = add(bank, few([5, 4]))
    assert (CALLS["prepare"], CALLS["fit"], CALLS["batches"]) == (0, 2, 2)
    assert grown.names == (*bank.names, "box_5", "box_4")
    for name in PER_EXEMPLAR:
        assert getattr(grown, name)[:4].tobytes() == getattr(bank, name).tobytes(), name
    assert {name: array.tobytes() for name, array in grown.shared.items()} == {
        name: array.tobytes() for name, array in bank.shared.items()
    }
    assert grown.probes.tobytes() == bank.probes.tobytes()
    assert (grown.frame.scale, grown.frame.centre.tolist()) == (bank.frame.scale, bank.frame.centre.tolist())
    # a box's weights are its extents and middle in the bank's frame: the very values, whoever fitted them
    extents = np.column_stack([small.LENGTHS, small.WIDTHS, np.full(7, 0.8)])[[5, 4]] * bank.frame.scale
    assert grown.weights[4:, :3] == pytest.approx(extents, rel=1e-6)
    assert grown.measured[4:] == pytest.approx(grown.parameters[4:])
    assert [(q.low, q.high) for q in grown.space] == [(2.0, 3.0), (1.0, 1.4)]
    assert bank.space[0].high == 2.6  # the given one is not altered
    assert dict(grown.mesh_facts) == dict(bank.mesh_facts) == {"bodies": 1, "genus": 0}
    assert grown.provenance["added"] == "box_5, box_4"
    assert grown.provenance["plan"] != bank.provenance["plan"]
    assert grown.provenance["start"] == bank.provenance["start"]


def test_what_comes_of_one_does_not_depend_on_the_others(bank):
    together, alone = add(bank, few([4, 5, 6])), add(bank, few([5]))
    assert together.weights[5].tobytes() == alone.weights[4].tobytes()
    assert together.probe_values[5].tobytes() == alone.probe_values[4].tobytes()


def test_a_grown_bank_makes_designs(bank):
    grown = add(bank, few([5]))
    result = lampopt.design(grown, {"length": 2.9, "width": 1.2}, plugins=small.plugins())
    assert result.accepted
    assert result.design.mesh.extents == pytest.approx([2.9, 1.2, 0.8], rel=1e-5)


def test_added_and_removed_again_is_as_before(bank):
    back = lampopt.remove_exemplars(add(bank, few([5, 6])), ["box_6", "box_5"])
    for name in (*PER_EXEMPLAR, "probes"):
        assert getattr(back, name).tobytes() == getattr(bank, name).tobytes(), name
    assert (back.names, back.space, back.label_space) == (bank.names, bank.space, bank.label_space)
    assert (back.provenance["added"], back.provenance["removed"]) == ("box_5, box_6", "box_5, box_6")


def test_removed_are_gone_and_the_others_stay(bank):
    CALLS.clear()
    left = lampopt.remove_exemplars(bank, ["box_0", "box_2"])
    assert not CALLS
    assert left.names == ("box_1", "box_3")
    for name in PER_EXEMPLAR:
        assert getattr(left, name).tobytes() == getattr(bank, name)[[1, 3]].tobytes(), name
    assert [(q.low, q.high) for q in left.space] == [(2.2, 2.6), (1.3, 1.4)]
    assert left.label_space[0].low == pytest.approx(0.34)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["box_9", "box_0"], r"box_9: no exemplars of this bank; there are box_0, box_1, box_2, box_3"),
        ([f"box_{i}" for i in range(4)], "expected at least one of the 4 exemplars to stay, got all"),
        ("box_0", r"expected a list of exemplars, such as \['box_0'\], got 'box_0'"),
        ([], "expected a list of exemplars"),
    ],
)
def test_what_cannot_be_removed_is_said(bank, names, message):
    with pytest.raises(InputError, match=message):
        lampopt.remove_exemplars(bank, names)


def test_labels_go_by_name_and_may_lack(bank):
    grown = add(bank, few([5], labels=None, label_space=()))
    assert np.isnan(grown.labels[4]).all()
    assert add(bank, few([5])).labels[4, 0] == 0.36


def test_parameters_go_by_name(bank):
    swapped = few([5, 6])
    other = replace(swapped, space=swapped.space[::-1], parameters=swapped.parameters[:, ::-1])
    assert add(bank, other).parameters.tobytes() == add(bank, swapped).parameters.tobytes()


@pytest.mark.parametrize(
    ("exemplars", "message"),
    [
        (lambda: few([5, 2, 3]), "box_2, box_3: already in the bank; rename them"),
        (lambda: few([5], unit="mm"), "expected meshes in 'm', as the bank's, got 'mm'"),
        (
            lambda: few([5], space=(Parameter("length", "m"), Parameter("height", "m")), measured={}),
            "parameters: expec",
        ),
        (
            lambda: few([5], space=(Parameter("length", "mm"), Parameter("width", "m")), measured={}),
            "parameters: expec",
        ),
        (lambda: few([5], label_space=(Parameter("lift"),)), r"labels: expected some of drag, as the bank's, got lift"),
        (lambda: [1, 2], r"exemplars: expected lampopt\.types\.Exemplars"),
    ],
)
def test_what_does_not_belong_is_refused(bank, exemplars, message):
    with pytest.raises(InputError, match=message):
        add(bank, exemplars())
    assert not CALLS["fit"]


def test_a_mesh_too_large_for_the_frame_is_refused_by_name(bank):
    large = few([4, 5, 6])
    meshes = [mesh.copy() for mesh in large.meshes]
    meshes[1].apply_scale([1.4, 1, 1])  # 4.2 m: the box ends at 2.6 / 0.6 m, 5 % of it is to stay free
    with pytest.raises(InputError, match=r"'box_5': too large or too far off.*build the bank anew with it"):
        add(bank, replace(large, meshes=meshes))
    meshes[1] = large.meshes[1].copy()
    meshes[2] = large.meshes[2].copy().apply_translation([0, 0, 30])
    with pytest.raises(InputError, match=r"box_6"):
        add(bank, replace(large, meshes=meshes))
    assert not CALLS["fit"]


def altered(rows, number, change, **changes):
    """Some of the seven boxes, the mesh of one of them altered."""
    made = few(rows, **changes)
    made.meshes[number] = change(made.meshes[number].copy())
    return made


def shrunk(mesh):
    return mesh.apply_scale(1e-3)


def turned(mesh):
    return mesh.apply_transform(np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))


def unroofed(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[(mesh.triangles[:, :, 2] < 0.39).any(1)], process=False)


def pierced(mesh):
    """A torus of the extents of a box."""
    torus = trimesh.creation.torus(1, 0.3, major_sections=24, minor_sections=12)
    return torus.apply_scale(mesh.extents / torus.extents)


@pytest.mark.parametrize(
    ("rows", "number", "change", "messages"),
    [
        ([4, 5], 0, shrunk, ["diagonal up to", "times as small", "'extents.length' near 2.8 m", "got 0.0028"]),
        ([5], 0, shrunk, ["as a file in km among files in m", "got 0.003"]),
        (
            [4, 5, 6],
            2,
            turned,
            ["'extents.length' near 2.5 m", "got 1.4", "'extents.width' near 1.4 m", "is it turned"],
        ),
        ([4], 0, pierced, ["expected genus 0, as all of the bank's own have, got 1"]),
        ([4], 0, unroofed, ["expected genus 0", "an open surface"]),
        (
            [4, 5],
            1,
            lambda m: trimesh.util.concatenate([m, shapes.box([0.1] * 3, centre=(0, 0, 1))]),
            ["expected bodies 1, as all of the bank's own have, got 2"],
        ),
    ],
)
def test_a_newcomer_unlike_the_banks_own_is_refused_by_name(bank, rows, number, change, messages):
    with pytest.raises(InputError) as caught:
        add(bank, altered(rows, number, change))
    name = f"box_{rows[number]}"
    told = "".join(line for line in str(caught.value).splitlines() if line.startswith(f"  exemplar '{name}'"))
    assert [message for message in messages if message not in told] == []
    assert not [f for f in few(rows).names if f != name and f"exemplar '{f}'" in str(caught.value)]
    assert not CALLS["fit"]


def test_all_that_are_unlike_are_named_at_once_and_may_be_accepted(bank):
    odd = altered([4, 5, 6], 0, turned)
    odd.meshes[1] = pierced(odd.meshes[1])
    with pytest.raises(InputError, match=r"(?s)'box_4': expected 'extents.*'box_5': expected genus 0.*--accept box_5"):
        add(bank, odd)
    with pytest.raises(InputError, match="box_5") as caught:
        add(bank, odd, accept=["box_4"])
    assert "'box_4'" not in str(caught.value)
    for accept in (["box_4", "box_5"], "all"):
        grown = add(bank, odd, accept=accept)
        assert grown.measured[4].tolist() == pytest.approx([1.2, 2.8])
        assert dict(grown.mesh_facts) == {}


def test_meshes_of_other_rows_are_refused(bank):
    """The bank's own meshes, their parameters the other way round."""
    again = few(range(4), names=("a", "b", "c", "d"))
    with pytest.raises(InputError, match=r"(?s)'a': expected 'extents.length'.*'d': expected 'extents.length'"):
        add(bank, replace(again, parameters=again.parameters[::-1]))
    assert add(bank, again).measured[4:].tolist() == bank.measured.tolist()


def test_measured_values_go_on_following_their_parameters(bank):
    """Many, each within what is expected of one, and together unrelated to their parameters."""
    lengths = np.tile([2.2, 2.32], 12)
    parameters = np.column_stack([lengths, np.tile([1.0, 1.1, 1.2, 1.3], 6)])
    meshes = [shapes.box([4.52 - length, width, 0.8]) for length, width in parameters]
    names = tuple(f"new_{i}" for i in range(24))
    wrong = few(range(4), parameters=parameters, meshes=meshes, names=names, labels=None, label_space=())
    with pytest.raises(InputError, match=r"'extents.length' does not follow parameter 'length' any more \(R² 0"):
        add(bank, wrong)
    assert len(add(bank, wrong, accept="all")) == 28


def test_a_bank_that_measures_nothing_knows_its_size():
    bank = small.bank(few(range(4), measured={}))
    with pytest.raises(InputError, match=r"'box_5': expected a diagonal up to .* as a file in km"):
        add(bank, altered([4, 5], 1, shrunk, measured={}))
    tenth = altered([5], 0, lambda m: m.apply_scale(0.1), measured={})
    with pytest.raises(InputError, match=r"'box_5': expected a diagonal .* 8.67 times as small; look at it"):
        add(bank, tenth)
    assert len(add(bank, tenth, accept="all")) == 5


def test_a_small_newcomer_whose_measures_agree_is_no_stranger(bank):
    """A box of a tenth of the length, and its parameters say so."""
    parameters = np.array([[0.3, 0.12]])
    tiny = few([4], parameters=parameters, meshes=[shapes.box([0.3, 0.12, 0.1])])
    assert add(bank, tiny).measured[4] == pytest.approx(parameters[0])


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_a_bank_of_few_lets_its_like_in(count):
    assert len(add(small.bank(few(range(count))), few([5, 6]))) == count + 2


def test_an_exemplar_that_cannot_be_fitted_is_named(bank):
    bad = few([5, 6])
    bad.meshes[1] = bad.meshes[1].copy()
    bad.meshes[1].update_faces(np.arange(len(bad.meshes[1].faces)) > 1)
    with pytest.raises((FitError, InputError), match="box_6"):
        add(bank, bad)


def test_calibrated_limits_go_with_what_they_were_found_for(bank, caplog):
    evidence = Calibration(0.01, ("mismatch",), np.ones((3, 1)), np.ones(3), np.arange(3))
    known = replace(bank, limits={"mismatch": 0.5, "alpha": 2.0}, calibration=evidence)
    for change in (lambda: add(known, few([5])), lambda: lampopt.remove_exemplars(known, ["box_0"])):
        changed = change()
        assert changed.calibration is None
        assert dict(changed.limits) == {"alpha": 2.0}
        assert "the bank's limits were calibrated for other exemplars" in caplog.text
        caplog.clear()
    assert dict(add(replace(bank, limits={"alpha": 2.0}), few([5])).limits) == {"alpha": 2.0}
    assert not caplog.records


# in files


def test_an_interrupted_addition_goes_on_and_ends_the_same(bank, tmp_path, caplog):
    whole = add(bank, few([4, 5, 6]), store=tmp_path / "whole.lamp")
    CALLS.clear()
    small.INTERRUPT[0] = 2
    store = tmp_path / "grown.lamp"
    with caplog.at_level(logging.WARNING, "lampopt"), pytest.raises(KeyboardInterrupt):
        add(bank, few([4, 5, 6]), store=store)
    assert "interrupted: 1 of 3 exemplars are fitted and kept in" in caplog.text
    assert not store.exists()
    small.INTERRUPT[0] = 0
    CALLS.clear()
    assert small.same(add(bank, few([4, 5, 6]), store=store), whole)
    assert CALLS["fit"] == 2
    assert store.read_bytes() == (tmp_path / "whole.lamp").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["grown.lamp", "whole.lamp"]
    CALLS.clear()
    assert small.same(add(bank, few([4, 5, 6]), store=store), whole)
    assert not CALLS


def test_a_store_of_another_bank_is_refused(bank, tmp_path):
    store = tmp_path / "grown.lamp"
    lampopt.store_bank(bank, store)
    for change in (lambda: add(bank, few([5]), store=store), lambda: remove(bank, store)):
        with pytest.raises(BankError, match="holds another bank: name another file, or delete it"):
            change()
    assert small.same(lampopt.load_bank(store), bank)


def remove(bank, store):
    return lampopt.remove_exemplars(bank, ["box_1"], store=store)


def test_removed_into_a_file(bank, tmp_path):
    left = remove(bank, tmp_path / "left.lamp")
    assert left.path == tmp_path / "left.lamp"
    assert small.same(left, lampopt.remove_exemplars(bank, ["box_1"]))
    assert small.same(remove(bank, tmp_path / "left.lamp"), left)  # once more changes nothing
    assert dict(left.provenance)["removed"] == "box_1"
    assert os.listdir(tmp_path) == ["left.lamp"]


def test_other_labels_make_another_bank(bank, tmp_path):
    remove(bank, tmp_path / "left.lamp")
    labelled = lampopt.label(bank, "volume", plugins=small.plugins())
    for other in (labelled, replace(bank, labels=2 * bank.labels)):
        with pytest.raises(BankError, match="holds another bank"):
            remove(other, tmp_path / "left.lamp")


def test_a_newcomers_source_need_not_know_the_banks_order(bank):
    """Its parameters come the other way round, and its shape at their mean is nobody's business."""

    def at(row):
        raise AssertionError("asked for a mean that the bank has already")

    new = few([5])
    swapped = {"space": new.space[::-1], "parameters": new.parameters[:, ::-1]}
    grown = add(bank, replace(new, **swapped, mesh_at=at))
    assert grown.parameters[-1].tolist() == new.parameters[0].tolist()


class Fickle:
    """Cannot tell the length of a long box, and says NaN instead of why."""

    names, units = ("length",), ("L",)

    def __call__(self, mesh):
        return np.where(mesh.extents[:1] > 2.9, np.nan, mesh.extents[:1])


class Offer:
    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"fickle": Fickle}


@pytest.mark.parametrize("rows", [(4, 5), range(7)])
def test_a_value_that_is_none_is_told_by_its_exemplar_before_anything_is_fitted(rows):
    measured, plugins = {"length": "fickle.length"}, small.plugins(("offer", Offer()))
    with pytest.raises(InputError, match=r"measured: 'fickle\.length' is nan for exemplar 'box_5'"):
        small.bank(few(rows, measured={}), measured=measured, plugins=plugins)
    assert not CALLS["fit"]
    bank = small.bank(few(range(4), measured={}), measured=measured, plugins=plugins)
    CALLS.clear()
    with pytest.raises(InputError, match="is nan for exemplar 'box_5'"):
        lampopt.add_exemplars(bank, few([5], measured={}), accept="all", plugins=plugins)
    assert not CALLS["fit"]


def test_removing_is_one_step_and_needs_no_folder(bank, tmp_path, monkeypatch):
    def opened(*_):
        raise AssertionError("a folder for parts, and nothing is fitted")

    monkeypatch.setattr("lampopt.partial.Partial.open", opened)
    assert remove(bank, tmp_path / "left.lamp").names == ("box_0", "box_2", "box_3")


def test_a_build_goes_on_after_members_changed(bank, tmp_path):
    """Added to, taken from and added to again: each is told from the other by its plan."""
    one = add(bank, few([5]))
    two = add(one, few([6]))
    both = add(bank, few([5, 6]))
    plans = {b.provenance["plan"] for b in (bank, one, two, both)}
    assert len(plans) == 4
    assert two.weights.tobytes() == both.weights.tobytes()
    assert two.provenance["added"] == both.provenance["added"] == "box_5, box_6"


# from the shell


@dataclass(frozen=True)
class More:
    """Source of one more box."""

    number: int = 5

    def __call__(self):
        return few([self.number])


class Sources:
    @lampopt.hookimpl
    def lampopt_sources(self):
        return {"more": More}


def test_added_and_removed_from_the_shell(bank, tmp_path, monkeypatch, capsys):
    offered = small.plugins(("more", Sources()))
    monkeypatch.setattr("lampopt.plugins.Plugins.load", lambda: offered)
    first, grown, left = (tmp_path / name for name in ("a.lamp", "b.lamp", "c.lamp"))
    lampopt.store_bank(bank, first)

    def ask(*args):
        code = cli.main([*map(str, args), "--json"])
        return code, json.loads(capsys.readouterr().out)

    more = ("--source", "more", "--set", "number=6")
    code, document = ask("bank", "add", first, *more, "--out", grown)
    assert (code, document["exemplars"], document["provenance"]["added"]) == (0, 5, "box_6")
    code, document = ask("bank", "remove", grown, "box_6", "box_0", "--out", left)
    assert (code, document["exemplars"], document["provenance"]["removed"]) == (0, 3, "box_0, box_6")
    assert lampopt.load_bank(left).weights.tobytes() == bank.weights[1:].tobytes()
    for command, said in (
        (("bank", "add", grown, *more, "--out", tmp_path / "d.lamp"), "box_6: already in the bank"),
        (("bank", "add", first, "--source", "more", "--out", grown), "holds another bank"),
        (("bank", "remove", first, "box_9", "--out", tmp_path / "d.lamp"), "box_9: no exemplars of this bank"),
        (("bank", "remove", first, *bank.names, "--out", tmp_path / "d.lamp"), "at least one of the 4 exemplars to st"),
    ):
        code, document = ask(*command)
        assert code == 2
        assert said in document["error"]["message"]
    assert sorted(os.listdir(tmp_path)) == ["a.lamp", "b.lamp", "c.lamp"]
