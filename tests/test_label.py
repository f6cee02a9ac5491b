"""Exemplars labelled by a measure: each as the bank makes it, resumable, none left unsaid."""

import json
import sys
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import lampopt
from lampopt import Spec
from lampopt.errors import BankError, InputError, MeasureError, SweepError
from lampopt.partial import Partial
from lampopt.pool import processes
from lampopt.task import Task

sys.path.insert(0, str(Path(__file__).parent))
import small
from lethal import Dear, Dies
from test_closing import PLUGINS

CALLS = []


class Air:
    """Drag and lift of a box by its volume; too long ones cannot be told."""

    names, units = ("drag", "lift", "wet"), ("", "", "L^2")

    def __call__(self, mesh):
        CALLS.append(mesh.extents[0])
        if mesh.extents[0] > 2.85:
            raise MeasureError("too long for the tunnel")
        return np.array([mesh.volume, -mesh.volume, mesh.area])


@pytest.fixture(autouse=True)
def forget():
    CALLS.clear()


def test_labels_are_of_the_shapes_that_the_bank_makes():
    bank = small.bank(decoder="blunt", plugins=PLUGINS)
    made = lampopt.label(bank, Air(), {"cd": "drag", "wet": "wet"}, plugins=PLUGINS)
    assert [(q.name, q.unit) for q in made.label_space] == [("drag", ""), ("cd", ""), ("wet", "m^2")]
    for name, cd, wet in zip(made.names, *made.labels.T[1:], strict=True):
        mesh = lampopt.run(lampopt.Study(bank, reference=name), plugins=PLUGINS).design.mesh
        if mesh.extents[0] > 2.85:
            assert np.isnan([cd, wet]).all()
        else:
            assert (cd, wet) == pytest.approx((mesh.volume, mesh.area))
    np.testing.assert_array_equal(made.labels[:, 0], bank.labels[:, 0])
    assert bank.label_space != made.label_space
    told = json.loads(made.provenance["labelled.cd"])
    assert told == {"by": "Air.drag", "failed": {"box_5": "too long for the tunnel"}}


@dataclass(frozen=True)
class Solver:
    """Asks a program, whose version may change, with so many workers."""

    workers: int = 1
    stops_after: int = 99
    names, units = ("drag",), ("",)
    version: ClassVar[str] = "1"

    def depends_on(self):
        return {}

    def program(self):
        if not self.version:
            raise MeasureError("no solver here")
        return f"solver {self.version}"

    def __call__(self, mesh):
        CALLS.append(mesh.volume)
        if len(CALLS) > self.stops_after:
            error = MeasureError("killed")
            error.passing = True
            raise error
        return np.array([float(self.version) * mesh.volume])


def test_how_fast_a_program_works_makes_no_other_labels(tmp_path):
    with pytest.raises(InputError, match="4 of 7 exemplars could not be measured for a reason that may pass"):
        lampopt.label(small.bank(), Solver(1, stops_after=3), store=tmp_path / "a.lamp", plugins=small.plugins())
    CALLS.clear()
    made = lampopt.label(small.bank(), Solver(2), store=tmp_path / "a.lamp", plugins=small.plugins())
    assert len(CALLS) == 4 and np.isfinite(made.labels).all()


def test_labels_of_another_version_are_told(tmp_path, monkeypatch, caplog):
    def made():
        return lampopt.label(small.bank(), Solver(), store=tmp_path / "a.lamp", plugins=small.plugins())

    first = made()
    assert small.same(made(), first) and "was labelled by" not in caplog.text
    monkeypatch.setattr(Solver, "version", "")  # a finished file needs none
    assert small.same(made(), first) and "was labelled by" not in caplog.text
    monkeypatch.setattr(Solver, "version", "2")
    assert small.same(made(), first)
    assert "was labelled by solver 1, here is solver 2" in caplog.text


@pytest.mark.parametrize("crew", [False, True])
def test_a_run_folder_does_not_mix_versions_of_a_program(tmp_path, monkeypatch, crew):
    study = lampopt.Study(small.bank(), {"width": 1.2}, measures={"flow": Solver()})

    def values():
        with ThreadPoolExecutor(2) as threads:
            found = lampopt.sweep(
                study, {"length": [2.1, 2.5]}, tmp_path, report=False, plugins=small.plugins(),
                executor=threads if crew else None,
            )  # fmt: skip
            return [(r.check("flow.drag").value, r.provenance["program.flow"]) for r in found]

    first = values()
    assert values() == first and len(CALLS) == 2
    monkeypatch.setattr(Solver, "version", "")  # what is recorded needs none
    assert values() == first and len(CALLS) == 2
    monkeypatch.setattr(Solver, "version", "2")
    assert values() == [(pytest.approx(2 * drag), "solver 2") for drag, _ in first]
    assert len(CALLS) == 4
    assert len([*lampopt.results(tmp_path, every=True, plugins=small.plugins())]) == 2


def test_a_program_that_only_reports_keeps_no_search_from_going_on(monkeypatch):
    study = lampopt.Study(
        small.bank(), {"size.volume": 1.9}, measures={"flow": Solver(), "size": "size"}, solver="nlopt"
    )
    first = Task.of(study, PLUGINS)
    monkeypatch.setattr(Solver, "version", "2")
    assert Task.of(study, PLUGINS).search("key", {}) == first.search("key", {}) == "key"
    asked = replace(study, targets={"flow.drag": 1.9})
    assert Task.of(asked, PLUGINS).search("key", {}) != "key"
    assert Task.of(study, PLUGINS).search("key", {"flow.drag": 1.9}) == Task.of(asked, PLUGINS).search("key", {})


def test_a_search_does_not_mix_versions_of_a_program(tmp_path, monkeypatch):
    """What an older one found better than the newer ever can is not where the search stays."""
    study = lampopt.Study(
        small.bank(), reference="box_0", objective=lampopt.Minimise("flow.drag"), measures={"flow": Solver()},
        solver="nlopt", alpha=(-0.2, 1.2),
    )  # fmt: skip

    def found(folder):
        return lampopt.run(study, tmp_path / folder, report=False, plugins=PLUGINS)

    monkeypatch.setattr(Solver, "version", "3")
    found("kept")
    monkeypatch.setattr(Solver, "version", "1")
    CALLS.clear()
    whole, asked = found("fresh"), len(CALLS)
    CALLS.clear()
    again = found("kept")
    assert asked == len(CALLS) > 1
    np.testing.assert_array_equal(again.design.mix.alpha, whole.design.mix.alpha)


def test_a_label_of_that_name_is_replaced():
    bank = small.bank()
    made = lampopt.label(bank, Air(), ["drag"], plugins=small.plugins())
    assert [q.name for q in made.label_space] == ["drag"]
    assert made.labels[0, 0] == pytest.approx(bank.parameters[0].prod() * 0.8)
    low, high = made.label_space[0].low, made.label_space[0].high
    assert (low, high) == (np.nanmin(made.labels), np.nanmax(made.labels))


def test_a_labelled_bank_can_be_asked():
    bank = lampopt.label(small.bank(), "volume", plugins=small.plugins())
    goal = lampopt.Reduce("volume", by=0.1)
    made = lampopt.run(lampopt.Study(bank, reference="box_3", keep=("width",), objective=goal), plugins=small.plugins())
    assert made.accepted


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor(3)])
def test_what_is_measured_is_kept_when_it_is_stopped(tmp_path, executor, monkeypatch):
    bank, store = small.bank(), tmp_path / "labelled.lamp"
    real = Air.__call__

    def stopped(self, mesh):
        if len(CALLS) == 4:
            raise KeyboardInterrupt
        return real(self, mesh)

    with monkeypatch.context() as patch:
        patch.setattr(Air, "__call__", stopped)
        with pytest.raises(KeyboardInterrupt):
            lampopt.label(bank, Air(), ["drag"], store=store, executor=executor, plugins=small.plugins())
    assert not store.exists()
    before = len(CALLS)
    made = lampopt.label(bank, Air(), ["drag"], store=store, executor=executor, plugins=small.plugins())
    assert len(CALLS) < before + len(bank)
    again = lampopt.label(bank, Air(), ["drag"], store=store, plugins=small.plugins())
    assert small.same(made, again)
    assert [path.name for path in tmp_path.iterdir()] == ["labelled.lamp"]
    with pytest.raises(BankError, match="holds another bank"):
        lampopt.label(bank, Air(), ["lift"], store=store, plugins=small.plugins())


def test_workers_tell_the_same(tmp_path):
    bank = small.bank()
    alone = lampopt.label(bank, "area", store=tmp_path / "one.lamp", plugins=small.plugins())
    with ThreadPoolExecutor(3) as executor:
        crew = lampopt.label(bank, "area", store=tmp_path / "two.lamp", executor=executor, plugins=small.plugins())
    assert small.same(alone, crew)


def test_a_dear_measure_keeps_its_work_beside_the_file_and_in_the_run(tmp_path):
    bank = small.bank()
    lampopt.label(bank, Dear(), store=tmp_path / "labelled.lamp", plugins=small.plugins())
    assert len([*(tmp_path / "labelled.lamp.measured").iterdir()]) == len(bank)
    study = lampopt.Study(bank, targets={"length": 2.3}, measures={"air": Dear()})
    lampopt.run(study, tmp_path / "run", plugins=small.plugins())
    assert len([*(tmp_path / "run" / "measured" / "air").iterdir()]) == 1
    told = Dear(str(tmp_path / "elsewhere"))
    lampopt.label(bank, told, store=tmp_path / "other.lamp", plugins=small.plugins())
    assert len([*(tmp_path / "elsewhere").iterdir()]) == len(bank)


def test_a_dear_measure_keeps_its_work_where_others_make_the_designs(tmp_path):
    study = lampopt.Study(small.bank(), measures={"air": Dear()})
    with processes(2) as executor:
        made = lampopt.sweep(
            study,
            {"length": [2.2, 2.4, 2.6]},
            tmp_path / "run",
            executor=executor,
            report=False,
            plugins=small.plugins(),
        )
        assert len([*made]) == 3
    assert len([*(tmp_path / "run" / "measured" / "air").iterdir()]) == 3


def test_a_file_that_another_process_has_finished_meanwhile_is_read(tmp_path, monkeypatch):
    bank, store = small.bank(), tmp_path / "labelled.lamp"
    lampopt.label(bank, Air(), ["drag"], store=tmp_path / "other.lamp", plugins=small.plugins())
    CALLS.clear()
    real = Partial.open

    @contextmanager
    def late(path, plan):
        with real(path, plan) as parts:
            (tmp_path / "other.lamp").rename(store)
            yield parts

    monkeypatch.setattr(Partial, "open", late)
    assert len(lampopt.label(bank, Air(), ["drag"], store=store, plugins=small.plugins())) == len(bank)
    assert not CALLS


class Now(Executor):
    """Does at once what it is given, and breaks the first."""

    def __init__(self):
        self.count = 0

    def submit(self, work, *given):
        future = Future()
        self.count += 1
        if self.count == 1:
            future.set_exception(RuntimeError("broken"))
        else:
            future.set_result(work(*given))
        return future


def test_what_others_have_finished_is_kept_when_one_breaks(tmp_path):
    bank, store = small.bank(), tmp_path / "labelled.lamp"
    with pytest.raises(RuntimeError, match="broken"):
        lampopt.label(bank, Air(), ["drag"], store=store, executor=Now(), plugins=small.plugins())
    done = len(CALLS)
    assert done >= 2
    lampopt.label(bank, Air(), ["drag"], store=store, plugins=small.plugins())
    assert len(CALLS) == len(bank)


def test_what_cannot_be():
    bank = small.bank()
    with pytest.raises(InputError, match="measure 'Air' has no 'mass'; it has drag, lift, wet"):
        lampopt.label(bank, Air(), ["mass"], plugins=small.plugins())
    with pytest.raises(InputError, match="'width' is a parameter of this bank"):
        lampopt.label(bank, Air(), {"width": "drag"}, plugins=small.plugins())
    with pytest.raises(InputError, match="expected a Bank"):
        lampopt.label("cars.lamp", Air())
    with pytest.raises(InputError, match="values: expected names"):
        lampopt.label(bank, Air(), "drag", plugins=small.plugins())


class Never:
    names, units = ("drag",), ("",)

    def __call__(self, mesh):
        raise MeasureError("no flow solver is installed")


def test_a_measure_that_tells_of_no_exemplar_is_refused():
    with pytest.raises(InputError, match="can tell of no exemplar: no flow solver is installed"):
        lampopt.label(small.bank(), Never(), plugins=small.plugins())


def test_by_name_and_with_options():
    made = lampopt.label(small.bank(), Spec("extents"), {"long": "length"}, plugins=small.plugins())
    np.testing.assert_allclose(made.labels[:, -1], small.LENGTHS, atol=1e-6)


class Tired:
    """Fails in passing once for each exemplar named."""

    names, units = ("drag",), ("",)
    left = 2

    def __call__(self, mesh):
        CALLS.append(mesh.extents[0])
        if mesh.extents[0] < 2.3 and Tired.left:
            Tired.left -= 1
            error = MeasureError("the disk is full")
            error.passing = True
            raise error
        return np.array([mesh.volume])


def test_what_may_pass_is_tried_again(tmp_path):
    bank, store = small.bank(), tmp_path / "labelled.lamp"
    with pytest.raises(InputError, match=r"2 of 7 exemplars could not be measured for a reason that may pass"):
        lampopt.label(bank, Tired(), store=store, plugins=small.plugins())
    assert not store.exists()
    made = lampopt.label(bank, Tired(), store=store, plugins=small.plugins())
    assert np.isfinite(made.labels[:, -1]).all()
    assert len(CALLS) == 7 + 2


class Odd:
    names, units = ("drag", "side"), ("", "")

    def __call__(self, mesh):
        return np.array([np.inf if mesh.extents[0] > 2.85 else 1 + mesh.volume, np.nan])


def test_values_that_are_not_finite_are_none_and_told():
    made = lampopt.label(small.bank(), Odd(), {"cd": "drag"}, plugins=small.plugins())
    assert np.isnan(made.labels[5, -1]) and np.isfinite(made.labels[:5, -1]).all()
    assert json.loads(made.provenance["labelled.cd"])["failed"] == {"box_5": "Odd says inf"}
    with pytest.raises(InputError, match="can tell of no exemplar: Odd says nan"):
        lampopt.label(small.bank(), Odd(), ["side"], plugins=small.plugins())


def test_arguments_are_looked_at_first():
    bank = small.bank()
    for wrong in ({"measure": None}, {"measure": 3}, {"executor": 3}, {"resolution": 0}, {"resolution": "64"}):
        with pytest.raises(InputError):
            lampopt.label(bank, **{"measure": Air(), **wrong}, plugins=small.plugins())
    assert not CALLS
    every = lampopt.label(bank, Air(), {}, plugins=small.plugins())
    assert [q.name for q in every.label_space] == ["drag", "lift", "wet"]


def test_by_processes_and_what_becomes_of_lost_ones(tmp_path, monkeypatch):
    bank = small.bank()
    with processes(2) as executor:
        made = lampopt.label(bank, "area", executor=executor, plugins=small.plugins())
    np.testing.assert_array_equal(made.labels, lampopt.label(bank, "area", plugins=small.plugins()).labels)
    (tmp_path / "fatal").write_text("2.4")
    monkeypatch.setenv("LETHAL", str(tmp_path / "fatal"))
    with processes(1) as executor, pytest.raises(SweepError, match="a worker was lost"):
        lampopt.label(bank, Dies(), {"long": "length"}, executor=executor, plugins=small.plugins())
