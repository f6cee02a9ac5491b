"""The stages chained: designs in memory and in a folder, killed and begun again, grown, in the user's units."""

import hashlib
import json
import logging
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import Linear, Reduce, Spec, Study
from lampopt.errors import InputError, LampoptError, MeasureError, PluginError, SolveError, StudyError
from lampopt.meshfile import FORMATS, load_mesh
from lampopt.mixes import Mixes
from lampopt.record import passport
from lampopt.task import Task
from lampopt.testing import shapes
from lampopt.types import Frame, Mix
from lampopt.written import export_mesh
from lampopt_kkt.kkt import KKT

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402
import toys  # noqa: E402

TARGET = {"length": 2.9, "width": 1.2}
GRID = {"length": [2.1, 2.3, 2.5], "width": [1.1, 1.2]}
MEASURED = {"length": "extents.length", "width": "extents.width"}


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured=MEASURED))


@pytest.fixture(autouse=True)
def fresh():
    small.CALLS.clear()
    small.INTERRUPT[0] = 0


def run(study, folder=None, *extra):
    return lampopt.run(study, folder, report=False, plugins=small.plugins(*extra))


def sweep(study, grid=None, folder=None, *extra, **options):
    return lampopt.sweep(study, grid, folder, report=False, plugins=small.plugins(*extra), **options)


def table(folder, columns="*"):
    return table_of(folder, "designs", columns)


def table_of(folder, name, columns="*"):
    with closing(sqlite3.connect(Path(folder) / "runs.sqlite")) as database:
        return sorted(database.execute(f"SELECT {columns} FROM {name}").fetchall())


# all but the time
EVERYTHING = (
    "key, target, alpha, residual, status, message, conflicts, checks, accepted, provenance, mesh, digest, task"
)


# in memory


def test_the_shortest_way(bank):
    result = lampopt.design(bank, TARGET, plugins=small.plugins())
    assert result.accepted
    assert result.folder is None
    assert result.design.mesh.extents == pytest.approx([2.9, 1.2, 0.8], rel=1e-6)
    assert result.design.predicted == pytest.approx([2.9, 1.2])
    assert result.design.mix.status == "exact"
    assert result.design.mix.alpha.sum() == pytest.approx(1)
    assert result.design.target == TARGET
    checks = {check.name: check for check in result.checks}
    assert list(checks) == [
        *(
            "solved",
            "target",
            "alpha",
            "mismatch",
            "mesh",
            "watertight",
            "bodies",
            "genus",
            "drift.length",
            "drift.width",
        )
    ]
    assert checks["drift.length"].value == pytest.approx(0, abs=1e-6)
    assert checks["mismatch"].value < 1e-6


def test_a_field_is_also_judged_near_its_surface_and_by_its_room():
    found = {check.name for check in run(Study(small.bank(decoder="stretch-field"), targets=TARGET)).checks}
    assert {"mismatch", "mismatch.band", "clearance"} <= found


def test_design_takes_what_a_study_takes(bank):
    asked = {"keep": ("width",), "reference": "box_1", "objective": Reduce("drag", by=0.05), "level": "field"}
    asked |= {"solver": Spec("kkt", ridge=0.01), "limits": {"alpha": 9.0}, "measures": ("volume",), "resolution": 16}
    one = lampopt.design(bank, {"length": 2.5}, **asked, plugins=small.plugins())
    two = run(Study(bank, targets={"length": 2.5}, **asked))
    assert np.array_equal(one.design.mix.alpha, two.design.mix.alpha)
    assert [(c.name, c.value, c.limit) for c in one.checks] == [(c.name, c.value, c.limit) for c in two.checks]


@pytest.mark.parametrize(
    ("targets", "limits", "failed"),
    [
        ({"length": 9.0}, {}, {"alpha"}),
        (TARGET, {"alpha": 0.01}, {"alpha"}),
        ({"length": 2.5, "extents.length": 2.6}, {}, {"target"}),
        ({"length": -9.0, "width": -9.0}, {"alpha": 1e9}, {"mesh"}),
    ],
)
def test_a_rejected_design_is_a_result_with_its_reason(bank, targets, limits, failed):
    result = run(Study(bank, targets=targets, limits=limits))
    assert not result.accepted
    assert {check.name for check in result.checks if not check.passed} == failed


@dataclass(frozen=True)
class Flares(small.Stretch):
    """As linear as can be, and wrong: beyond the bank's length the width grows along."""

    def decode(self, shared, weights, *, resolution):
        size = weights[:3].astype(float)
        return shapes.box([size[0], size[1] + max(size[0] - 1.2, 0), size[2]])


class FlaresPlugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"flares": Flares}


def test_a_shape_that_is_linear_and_wrong_is_rejected_by_its_drift():
    plugin = ("flares", FlaresPlugin())
    bad = small.bank(small.boxes(measured=MEASURED), "flares", plugins=small.plugins(plugin))
    result = run(Study(bad, targets={"length": 3.6, "width": 1.2}), None, plugin)
    assert [check.name for check in result.checks if not check.passed] == ["drift.width"]
    assert result.check("mismatch").value < 1e-6
    assert run(Study(bad, targets=TARGET), None, plugin).accepted


def test_an_empty_mesh_is_a_failed_check(bank):
    result = run(Study(bank, targets={"length": -9.0, "width": 1.2}, measures=("volume",)))
    assert result.design.mesh is None
    check = result.check("mesh")
    assert (check.value, check.passed, check.note) == (0.0, False, "the field has no surface")
    assert not {"watertight", "drift.length", "volume.volume"} & {c.name for c in result.checks}


@pytest.mark.parametrize(("level", "decoded", "evaluated"), [("alpha", 0, 0), ("field", 0, 1), ("mesh", 1, 1)])
def test_a_mesh_is_made_when_it_is_looked_at_and_once(bank, level, decoded, evaluated):
    results = list(sweep(Study(bank, level=level), GRID))
    assert small.CALLS["decode"] == 6 * decoded
    assert small.CALLS["evaluate"] == 6 * evaluated
    assert {check.needs for result in results for check in result.checks} <= set(
        ("alpha", "field", "mesh")[: ("alpha", "field", "mesh").index(level) + 1]
    )
    assert results[0].design.mesh.extents[0] == pytest.approx(2.1)
    assert results[0].design.mesh is results[0].design.mesh
    assert small.CALLS["decode"] == 6 * decoded + (not decoded)


def test_a_sweep_is_every_combination_one_by_one(bank):
    results = sweep(Study(bank, targets={"length": 9.9}, keep=("drag",), level="alpha"), GRID)
    first = next(results)
    assert first.design.target == pytest.approx({"length": 2.1, "width": 1.1, "drag": np.nanmean(small.DRAG)})
    rest = [(r.design.target["length"], r.design.target["width"]) for r in results]
    assert [(2.1, 1.1), *rest] == [(length, width) for length in GRID["length"] for width in GRID["width"]]


def test_nothing_is_computed_ahead(bank):
    results = sweep(Study(bank), GRID)
    assert small.CALLS["decode"] == 0
    next(results)
    assert small.CALLS["decode"] == 1


def test_a_sweep_of_the_study_itself_or_of_tables(bank):
    study = Study(bank, targets={"width": 1.2}, sweep={"length": (2.1, "230 cm")}, level="alpha")
    assert [r.design.target["length"] for r in sweep(study)] == pytest.approx([2.1, 2.3])
    tables = [{"length": 2.5}, {"width": 1.3}]
    assert [dict(r.design.target) for r in sweep(study, tables)] == [{"width": 1.2, "length": 2.5}, {"width": 1.3}]
    assert [r.design.target["length"] for r in sweep(study, {"length": np.array([2.1, 2.3])})] == [2.1, 2.3]


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (None, "sweep: expected values by name"),
        ({}, "sweep: expected values by name"),
        ([], "sweep: expected values by name"),
        ({"length": []}, "sweep: length: expected a list of values"),
        ({"length": "2.1"}, "sweep: length: expected a list of values, got '2.1'"),
        ({"length": 2.1}, "sweep: length: expected a list of values, got 2.1"),
        ({"roof": [1]}, "'roof': neither a parameter"),
        ("length", r"sweep: expected values by name, such as .*, or a list of tables .*, got 'length'"),
        (2.1, "sweep: expected values by name, .*, got 2.1"),
        ([2.1, 2.2], "sweep: expected values by name, .*, got a list with 2.1"),
        ([{"length": 2.1}, "width"], "sweep: expected values by name, .*, got a list with 'width'"),
        ({"length": [2.1, "long"]}, "length: expected a number or text"),
        ({"width": [1.1]}, "'width' is asked for twice"),
        ([{"length": 2.1}, {"roof": 1}], "'roof': neither a parameter"),
        ([{"length": 2.1}, {"drag": 0.3, "lift": 5}], "no exemplar has all of"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused_before_anything_is_computed(grid, message, tmp_path):
    labels = np.column_stack([small.DRAG, np.where(np.isnan(small.DRAG), [5.0, 5, 6, 5, 7, 5, 5], np.nan)])
    space = (lampopt.Parameter("drag"), lampopt.Parameter("lift"))
    given = small.bank(small.boxes(labels=labels, label_space=space))
    with pytest.raises(InputError, match=message):
        sweep(Study(given, keep=("width",)), grid, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_is_no_study_is_refused():
    for call in (lampopt.run, lampopt.sweep):
        with pytest.raises(StudyError, match=r"^expected a Study, got 'a\.toml'; read one with Study\.read\(path\)"):
            call("a.toml")


def test_a_sweep_of_too_many_is_refused_before_they_are_made(bank):
    grid = {"length": np.linspace(2, 3, 400), "width": np.linspace(1, 1.4, 400)}
    with pytest.raises(StudyError, match="160,000 combinations, at most 100,000 are made at once: give fewer values"):
        sweep(Study(bank), grid)


@pytest.mark.parametrize("name", ["keep", "measures"])
def test_one_name_is_no_list_of_them(bank, name):
    with pytest.raises(StudyError, match=f"^{name}: expected a list of names, got 'length'"):
        lampopt.design(bank, {}, **{name: "length"}, plugins=small.plugins())


def test_progress(bank):
    told = []
    list(sweep(Study(bank, level="alpha"), GRID, progress=lambda done, message="": told.append(done)))
    assert told == [i / 6 for i in range(7)]


def test_measures_are_reported_and_judge_nothing(bank):
    result = run(Study(bank, targets=TARGET, measures=("size", "plate")))
    assert result.check("size.volume").value == pytest.approx(2.9 * 1.2 * 0.8, rel=1e-6)
    assert result.check("size.volume").unit == "m^3"
    assert result.check("size.volume").sense == "info"
    assert np.isnan(result.check("plate.hole_radius").value)  # there is no hole
    assert result.check("plate.hole_radius").note
    assert result.accepted


def test_measure_of_a_mesh():
    assert lampopt.measure("extents", shapes.box([3, 2, 1]), plugins=small.plugins()) == pytest.approx(
        {"length": 3, "width": 2, "height": 1}
    )
    with pytest.raises(MeasureError, match="expected a mesh with faces"):
        lampopt.measure("extents", trimesh.Trimesh(), plugins=small.plugins())
    with pytest.raises(PluginError, match="measure 'extent' is not installed"):
        lampopt.measure("extent", shapes.box(), plugins=small.plugins())


# many at once


class Counting:
    """Solver `count`, which counts what it is asked."""

    @lampopt.hookimpl
    def lampopt_solvers(self):
        return {"count": Count, "able": Able, "careless": Careless}


@dataclass(frozen=True)
class Count(KKT):
    def solve(self, problem):
        small.CALLS["solve"] += 1
        return super().solve(problem)

    def solve_many(self, problem, targets, ridges=None):
        small.CALLS["solve_many"] += len(targets) > 1
        return super().solve_many(problem, targets, ridges)


@dataclass(frozen=True)
class Able(toys.Able):
    """Takes ranges."""

    def solve(self, problem):
        return super().solve(replace(problem, ridge=1e-6))


@dataclass(frozen=True)
class Careless(KKT):
    """Forgets them."""

    def solve(self, problem):
        return super().solve(replace(problem, range_names=(), range_matrix=None, range_low=None, range_high=None))


COUNTING = ("counting", Counting())


def same_results(many, one_by_one):
    assert len(many) == len(one_by_one)
    for one, two in zip(many, one_by_one, strict=True):
        assert one.design.target == pytest.approx(two.design.target)
        for name in ("alpha", "residual"):
            np.testing.assert_allclose(getattr(one.design.mix, name), getattr(two.design.mix, name), atol=1e-12)
        assert (one.design.mix.status, one.design.mix.message) == (two.design.mix.status, two.design.mix.message)
        assert [c.names for c in one.design.mix.conflicts] == [c.names for c in two.design.mix.conflicts]
        assert [(c.name, c.limit, c.passed, c.note) for c in one.checks] == [
            (c.name, c.limit, c.passed, c.note) for c in two.checks
        ]
        np.testing.assert_allclose([c.value for c in one.checks], [c.value for c in two.checks], atol=1e-9)


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"reference": "box_1"},
        {"targets": {"drag": 0.33, "length": 2.5}, "hard": ("length",)},
        {"solver": Spec("count", ridge=0.01)},
    ],
    ids=["plain", "reference", "hard and a label", "ridge"],
)
def test_a_sweep_is_solved_at_once_and_equals_one_by_one(bank, asked):
    asked = {"solver": "count", "level": "field", **asked}
    grid = {"length": np.linspace(1.8, 3.4, 30), "width": np.linspace(0.9, 1.5, 20)}
    many = list(sweep(Study(bank, **asked), grid, None, COUNTING))
    exact = many[0].design.mix.status == "exact"
    assert exact == ("ridge" not in str(asked["solver"]))
    assert small.CALLS["solve_many"] == (3 if exact else 0)  # 600 designs in batches of 256
    assert small.CALLS["solve"] == 3 + (0 if exact else 600)
    given = asked.pop("targets", {})
    singly = [
        run(Study(bank, targets={**given, "length": length, "width": width}, **asked), None, COUNTING)
        for length in grid["length"][::7]
        for width in grid["width"][::7]
    ]
    chosen = [many[20 * i + j] for i in range(0, 30, 7) for j in range(0, 20, 7)]
    same_results(chosen, singly)


def test_those_of_a_batch_that_cannot_be_met_have_their_reasons(bank):
    lengths = [2.5, 2.6, 2.7, 2.5]
    study = Study(bank, targets={"extents.length": 2.5, "width": 1.2}, solver="count", level="alpha")
    many = list(sweep(study, {"length": lengths}, None, COUNTING))
    assert [r.design.mix.status for r in many] == ["exact", "infeasible", "infeasible", "exact"]
    assert small.CALLS["solve_many"] == 1
    assert small.CALLS["solve"] == 3  # the first, and those that are to be explained
    assert "length 2.6 → 2.55 m" in many[1].design.mix.message
    assert "length 2.7 → 2.6 m" in many[2].design.mix.message
    same_results(many, [run(replace(study, targets={**study.targets, "length": v}), None, COUNTING) for v in lengths])


def test_batches_are_of_neighbours_that_ask_for_the_same(bank):
    tables = [{"length": 2.1}, {"length": 2.2}, {"width": 1.1}, {"length": 2.3}, {"length": 2.4}, {}, {}]
    study = Study(bank, solver="count", level="alpha")
    many = list(sweep(study, tables, None, COUNTING))
    assert small.CALLS["solve_many"] == 3
    assert [dict(r.design.target) for r in many] == tables
    same_results(many, [run(replace(study, targets=t), None, COUNTING) for t in tables])


def test_batches_are_found_once_and_not_again_for_each(bank):
    """Of alternating tables every target is a batch: each is looked at a few times, however many there are."""
    asked = Looked([{"length": 2.1}, {"width": 1.1}] * 200)
    mixes = Mixes(Task.of(Study(bank), small.plugins()).posed, KKT(), asked)
    for number in range(len(asked)):
        posed, _ = mixes.at(number)
        assert posed.problem.names == (("length",), ("width",))[number % 2]
    assert asked.looks <= 5 * len(asked)


class Looked(list):
    """A list that counts how often somebody looks at one of it."""

    looks = 0

    def __getitem__(self, place):
        self.looks += 1
        return super().__getitem__(place)


def test_a_solver_that_takes_ranges_is_held_to_them(bank):
    study = Study(bank, targets={"width": 1.2}, ranges={"length": (2.2, 2.4)}, solver="able", level="alpha")
    result = run(study, None, COUNTING)
    assert result.accepted
    assert 2.2 - 1e-4 <= result.design.predicted[0] <= 2.4 + 1e-4
    result = run(replace(study, solver="careless"), None, COUNTING)
    assert [check.name for check in result.checks if not check.passed] == ["range"]
    assert result.check("range").value == pytest.approx(2 * (result.design.predicted[0] - 2.4))  # of 2 to 3 m
    assert "range" not in [c.name for c in run(Study(bank, targets=TARGET, level="alpha")).checks]


def test_what_is_read_back_is_not_solved_again(bank, tmp_path):
    study = Study(bank, solver="count", level="alpha")
    list(sweep(study, GRID, tmp_path, COUNTING))
    small.CALLS.clear()
    list(sweep(study, GRID, tmp_path, COUNTING))
    assert not small.CALLS


def test_provenance_is_read_once_a_sweep(bank, monkeypatch):
    asked = []
    monkeypatch.setattr("lampopt.task.version", lambda name: asked.append(name) or "1")
    results = list(sweep(Study(bank, level="alpha"), GRID))
    assert len(asked) == 1
    assert {r.provenance["lampopt"] for r in results} == {"1"}
    assert results[0].provenance is not results[1].provenance


# what is asked


def test_a_bank_in_mm_far_from_the_origin_comes_back_there(tmp_path):
    far = (2e5, -4e4, 1e3)
    bank = small.bank(small.boxes(unit="mm", scale=1000.0, shift=far, measured=MEASURED), store=tmp_path / "a.lamp")
    result = run(Study(bank, targets={"length": "2.9 m", "width": "120 cm"}, measures=("extents",)), tmp_path / "run")
    assert result.accepted
    assert result.design.target == pytest.approx({"length": 2900, "width": 1200})
    assert result.design.mesh.bounds.mean(0) == pytest.approx(far)
    assert result.design.mesh.extents == pytest.approx([2900, 1200, 800], rel=1e-5)
    assert (result.design.mesh.units, result.check("extents.length").unit) == ("mm", "mm")
    written = trimesh.load_mesh(result.folder / "mesh.stl")
    assert written.bounds == pytest.approx(result.design.mesh.bounds, rel=1e-6)


def test_exemplars_without_the_label_take_no_part(bank):
    result = run(Study(bank, targets={"drag": 0.35, "length": 2.4}, level="alpha"))
    assert result.design.mix.status == "exact"
    assert np.flatnonzero(result.design.mix.alpha == 0).tolist() == [2, 4]
    assert np.nansum(result.design.mix.alpha * small.DRAG) == pytest.approx(0.35)
    assert result.design.predicted[0] == pytest.approx(2.4)
    whole = run(Study(bank, targets={"length": 2.4}, level="alpha"))
    assert (whole.design.mix.alpha != 0).all()


def test_without_targets_the_centre_comes_back(bank):
    assert run(Study(bank, level="alpha")).design.mix.alpha == pytest.approx(np.full(7, 1 / 7))
    one = run(Study(bank, level="alpha", reference="box_3")).design.mix.alpha
    assert one == pytest.approx([0, 0, 0, 1, 0, 0, 0])


def test_with_a_reference_the_design_is_near_it(bank):
    asked = {"targets": {"length": 2.62}, "keep": ("width",), "level": "alpha"}
    near, free = (run(Study(bank, reference=reference, **asked)) for reference in ("box_3", None))
    step = near.design.mix.alpha - np.eye(7)[3]
    assert near.check("alpha").value == pytest.approx(np.linalg.norm(step))
    assert np.linalg.norm(step) < 0.1 < np.linalg.norm(free.design.mix.alpha - np.eye(7)[3])
    assert near.design.predicted == pytest.approx([2.62, 1.3])  # kept at the reference's, else at the mean
    assert free.design.predicted == pytest.approx([2.62, small.WIDTHS.mean()])


def test_a_reference_without_the_label_is_refused(bank):
    with pytest.raises(StudyError, match="reference 'box_2': lacks a label"):
        run(Study(bank, targets={"drag": 0.35}, reference="box_2"))
    with pytest.raises(StudyError, match="reference 'box_9': no exemplar of this bank; there are box_0, box_1"):
        run(Study(bank, targets=TARGET, reference="box_9"))


def test_reduce_is_a_target_below_the_reference(bank):
    study = Study(bank, objective=Reduce("drag", by=0.10), reference="box_5", keep=("length",), level="alpha")
    result = run(study)
    assert result.design.target == pytest.approx({"length": 3.0, "drag": 0.9 * 0.36})
    assert np.nansum(result.design.mix.alpha * small.DRAG) == pytest.approx(0.9 * 0.36)


def test_what_cannot_be_had_is_said_in_the_users_units(bank):
    result = run(Study(bank, targets={"length": "2500 mm", "extents.length": 2.6, "width": 1.2}, level="alpha"))
    assert result.design.mix.status == "infeasible"
    (conflict,) = result.design.mix.conflicts
    assert set(conflict.names) == {"length", "extents.length"}
    assert not result.check("target").passed
    for said in (result.design.mix.message, result.check("target").note):
        assert "length 2.5 → 2.55 m" in said
        assert "extents.length 2.6 → 2.55 m" in said
        assert "width" not in said
    assert result.design.predicted == pytest.approx([2.55, 1.2])


def test_hard_targets_are_met_at_the_cost_of_the_others(bank):
    asked = {"length": 2.5, "extents.length": 2.6}
    for hard, length in (("length", 2.5), ("extents.length", 2.6)):
        result = run(Study(bank, targets=asked, hard=(hard,), level="alpha"))
        assert result.design.predicted[0] == pytest.approx(length)


def test_a_target_that_no_mix_can_move_is_refused():
    flat = small.bank(small.boxes(count=1))
    with pytest.raises(StudyError, match="'length': all exemplars have 2 m: no mix can change it"):
        run(Study(flat, targets={"length": 2.5}))


@pytest.mark.parametrize(
    ("study", "error", "message"),
    [
        ({"solver": "kkkt"}, PluginError, "solver 'kkkt' is not installed; installed are: (casadi, )?kkt"),
        ({"solver": Spec("kkt", rigde=1)}, PluginError, "unknown option 'rigde'; known are: ridge: float"),
        ({"measures": ("extent",)}, PluginError, "measure 'extent' is not installed; installed are: area"),
        ({"limits": {"aplha": 1.0}}, StudyError, "limits: unknown aplha; known are alpha, .*drift.length"),
        ({"ranges": {"width": (1.3, 1.1)}}, StudyError, "ranges: expected low ≤ high, got 1.3 to 1.1"),
        ({"ranges": {"width": (1.1, 1.3)}}, SolveError, "solver 'kkt' is not able to take ranges"),
        ({"requires": ("lampopt-x",)}, PluginError, "study requires lampopt-x, not installed"),
        ({"bank": "/no/such.lamp"}, InputError, "no such file"),
    ],
)
def test_what_cannot_be_asked_is_refused(bank, study, error, message):
    with pytest.raises(error, match=message):
        run(Study(**{"bank": bank, "targets": {"length": 2.5}, **study}))
    assert small.CALLS["decode"] == 0


# in a folder


def test_what_a_run_leaves(bank, tmp_path):
    folder = tmp_path / "runs" / "a"
    study = Study(bank, targets={"length": "2900 mm", "width": 1.2}, measures=("size",), resolution=32)
    result = run(study, folder)
    stored = Study.read(folder / "study.toml").opened()
    assert re.fullmatch(r"bank-[0-9a-f]{24}\.lamp", stored.path.name)
    assert sorted(p.name for p in folder.iterdir()) == [
        stored.path.name,
        "designs",
        "runs.lock",
        "runs.sqlite",
        "study.toml",
    ]
    assert sorted(p.name for p in result.folder.iterdir()) == ["mesh.stl", "passport.json"]
    assert result.folder.parent == folder / "designs"

    ((key, target, alpha, residual, status, _, _, checks, accepted, provenance, mesh, seconds, digest, task),) = table(
        folder
    )
    assert key == result.folder.name
    assert json.loads(target) == TARGET
    assert np.array_equal(np.frombuffer(alpha), result.design.mix.alpha)
    assert np.abs(np.frombuffer(residual)).max() < 1e-9
    assert (status, accepted, mesh) == ("exact", 1, "mesh.stl")
    assert [check[0] for check in json.loads(checks)] == [check.name for check in result.checks]
    assert json.loads(provenance) == dict(result.provenance)
    assert 0 < seconds < 60
    assert digest == hashlib.blake2b((result.folder / "mesh.stl").read_bytes(), digest_size=16).hexdigest()

    passport = json.loads((result.folder / "passport.json").read_text(encoding="utf-8"))
    assert passport["accepted"] is True
    assert passport["target"] == TARGET
    assert passport["predicted"]["length"] == {"value": pytest.approx(2.9), "unit": "m"}
    assert passport["alpha"] == pytest.approx(dict(zip(bank.names, result.design.mix.alpha, strict=True)))
    assert passport["unit"] == "m"
    size = next(check for check in passport["checks"] if check["name"] == "size.volume")
    assert size["value"] == pytest.approx(2.9 * 1.2 * 0.8, rel=1e-6)

    assert table_of(folder, "asked") == [(task,)]

    left = Study.read(folder / "study.toml")
    assert (dict(left.targets), left.resolution) == (dict(study.targets), 32)
    assert small.same(stored, bank)
    written = trimesh.load_mesh(result.folder / "mesh.stl")
    assert written.extents == pytest.approx([2.9, 1.2, 0.8], rel=1e-6)
    assert written.is_watertight


def test_a_study_that_was_left_runs_again_and_finds_its_rows(bank, tmp_path):
    list(sweep(Study(bank), GRID, tmp_path))
    small.CALLS.clear()
    again = list(sweep(Study.read(tmp_path / "study.toml"), None, tmp_path))
    assert len(again) == 6
    assert small.CALLS["decode"] == 0


def test_a_large_sweep_leaves_a_study_that_is_read(bank, tmp_path):
    lengths = [2 + i / 3e5 for i in range(14_000)]  # with all their digits more than 300 kB
    begun = sweep(Study(bank, level="alpha"), {"length": lengths}, tmp_path)
    next(begun)
    begun.close()
    assert Study.read(tmp_path / "study.toml").sweep["length"] == tuple(lengths)
    assert len(list(lampopt.results(tmp_path, plugins=small.plugins()))) == 1


def test_tables_leave_what_they_have_in_common(bank, tmp_path):
    study = Study(bank, targets={"width": 1.2}, sweep={"length": [2.1]}, level="alpha")
    list(sweep(study, [{"length": 2.5}, {"length": 2.6}], tmp_path))
    left = Study.read(tmp_path / "study.toml")
    assert (dict(left.targets), dict(left.sweep)) == ({"width": 1.2}, {})
    assert len(list(lampopt.results(tmp_path, plugins=small.plugins()))) == 2


def test_a_bank_in_a_file_is_named_not_copied(bank, tmp_path):
    stored = lampopt.store_bank(bank, tmp_path / "a.lamp")
    run(Study(stored, targets=TARGET), tmp_path / "run")
    assert not (tmp_path / "run" / "bank.lamp").exists()
    document = tomllib.loads((tmp_path / "run" / "study.toml").read_text(encoding="utf-8"))
    assert document["bank"] == str(tmp_path / "a.lamp")


def test_a_relative_bank_is_named_in_full(bank, tmp_path, monkeypatch):
    lampopt.store_bank(bank, tmp_path / "a.lamp")
    monkeypatch.chdir(tmp_path)
    run(Study("a.lamp", targets=TARGET), "run")
    assert Study.read("run/study.toml").bank == tmp_path / "a.lamp"


@pytest.mark.parametrize("level", ["alpha", "field"])
def test_a_design_without_mesh_leaves_none(bank, tmp_path, level):
    result = run(Study(bank, targets=TARGET, level=level), tmp_path)
    assert result.folder == tmp_path
    assert not list((tmp_path / "designs").iterdir())
    assert table(tmp_path, "mesh") == [(None,)]
    assert small.CALLS["decode"] == 0
    again = run(Study(bank, targets=TARGET, level=level), tmp_path)
    assert again.folder == tmp_path
    assert again.design.mesh.extents[0] == pytest.approx(2.9)
    assert not list((tmp_path / "designs").iterdir())


def test_rejected_and_empty_designs_are_rows_too(bank, tmp_path):
    study = Study(bank, targets={"width": 1.2}, measures=("plate",))
    results = list(sweep(study, {"length": [2.5, -9.0]}, tmp_path))
    assert sorted(accepted for (accepted,) in table(tmp_path, "accepted")) == [0, 1]
    assert [(r.folder / "mesh.stl").exists() for r in results] == [True, False]
    assert [r.folder == tmp_path for r in results] == [False, True]
    again = list(sweep(study, {"length": [2.5, -9.0]}, tmp_path))
    for one, two in zip(results, again, strict=True):
        assert [(c.name, c.passed, c.note) for c in one.checks] == [(c.name, c.passed, c.note) for c in two.checks]
        assert np.allclose([c.value for c in one.checks], [c.value for c in two.checks], equal_nan=True, rtol=0)
        text = json.dumps(passport(two, bank))
        json.loads(text, parse_constant=lambda name: pytest.fail(name))
        if two.folder != tmp_path:
            assert json.loads((two.folder / "passport.json").read_text()) == json.loads(text)
    assert again[1].design.mesh is None


def test_what_is_there_is_read_back(bank, tmp_path):
    study = Study(bank, targets={"length": 2.5, "extents.length": 2.6}, measures=("size",), reference="box_1")
    first = run(study, tmp_path)
    small.CALLS.clear()
    again = run(study, tmp_path)
    assert small.CALLS["decode"] == small.CALLS["evaluate"] == 0
    assert np.array_equal(again.design.mix.alpha, first.design.mix.alpha)
    assert np.array_equal(again.design.weights, first.design.weights)
    assert again.design.mix.status == first.design.mix.status == "infeasible"
    assert again.design.mix.message == first.design.mix.message
    (clash,), (before,) = again.design.mix.conflicts, first.design.mix.conflicts
    assert clash.names == before.names == ("length", "extents.length")
    assert np.array_equal(clash.amounts, before.amounts)
    assert again.checks == first.checks
    assert dict(again.provenance) == dict(first.provenance)
    assert again.folder == first.folder
    assert again.design.mesh.extents == pytest.approx(first.design.mesh.extents, rel=1e-6)
    assert small.CALLS["decode"] == 0  # from the file
    (first.folder / "mesh.stl").unlink()
    assert run(study, tmp_path).design.mesh.extents == pytest.approx(first.design.mesh.extents)
    assert small.CALLS["decode"] == 1  # the file was lost: made again


@pytest.mark.parametrize("lost", ["mesh", "folder", "half", "empty"])
def test_a_mesh_that_was_lost_is_made_again(bank, tmp_path, lost, caplog):
    first = run(Study(bank, targets=TARGET), tmp_path)
    file = first.folder / "mesh.stl"
    if lost == "mesh":
        file.unlink()
    elif lost == "folder":
        shutil.rmtree(first.folder)
    else:
        file.write_bytes(file.read_bytes()[:500] if lost == "half" else b"")
    again = run(Study(bank, targets=TARGET), tmp_path)
    assert again.folder == first.folder
    assert again.checks == first.checks
    assert again.design.mesh.extents == pytest.approx(first.design.mesh.extents)
    assert small.CALLS["decode"] == 2
    assert ("it is decoded again" in caplog.text) == (lost in ("half", "empty"))


def test_a_mesh_that_is_read_back_is_closed_and_has_its_unit(tmp_path):
    millimetres = small.bank(small.boxes(unit="mm", scale=1000.0))
    for form in ("stl", "glb"):
        study = Study(millimetres, targets={"length": 2500.0}, format=form)
        made = run(study, tmp_path).design.mesh
        again = run(study, tmp_path).design.mesh
        assert again.units == made.units == "mm"
        assert isinstance(again, trimesh.Trimesh)
        assert again.is_watertight
        assert len(again.vertices) == len(made.vertices)


def other_schema(database):
    database.execute("PRAGMA user_version = 7")


def older_schema(database):
    database.execute("PRAGMA user_version = 0")


@pytest.mark.parametrize(("change", "number"), [(other_schema, 7), (older_schema, 0)])
def test_a_database_of_another_schema_is_refused(bank, tmp_path, change, number):
    run(Study(bank, targets=TARGET), tmp_path)
    with closing(sqlite3.connect(tmp_path / "runs.sqlite")) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (2,)
        change(database)
        database.commit()
    before = (tmp_path / "runs.sqlite").read_bytes()
    with pytest.raises(InputError, match=rf"runs\.sqlite: has schema {number}, this lampopt reads 1 to 2"):
        run(Study(bank, targets=TARGET), tmp_path)
    assert (tmp_path / "runs.sqlite").read_bytes() == before


@pytest.mark.parametrize("form", FORMATS)
def test_a_mesh_is_exported_by_its_suffix(tmp_path, form):
    path = export_mesh(shapes.box([3, 2, 1]), tmp_path / f"box.{form.upper()}")
    assert load_mesh(path).extents == pytest.approx([3, 2, 1])
    with pytest.raises(InputError, match=re.escape(f"ending in .{', .'.join(FORMATS)}")):
        export_mesh(shapes.box(), tmp_path / "box.off")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("form", ["stl", "obj", "ply", "glb"])
def test_meshes_are_written_as_asked(bank, tmp_path, form):
    result = run(Study(bank, targets=TARGET, format=form), tmp_path)
    assert (result.folder / f"mesh.{form}").exists()
    again = run(Study(bank, targets=TARGET, format=form), tmp_path)
    assert again.design.mesh.extents == pytest.approx([2.9, 1.2, 0.8], rel=1e-6)
    assert small.CALLS["decode"] == 1


class Aero:
    """Model: lift by length."""

    names, units, inputs = ("lift",), ("",), ("length",)

    def __call__(self, parameters):
        return parameters**2

    def gradient(self, parameters):
        return 2 * parameters[:, None]


CHANGES = [
    {"targets": {"length": 2.8, "width": 1.2}},
    {"targets": {"length": 2.9}},
    {"keep": ("drag",)},
    {"objective": Reduce("drag", by=0.1)},
    {"ranges": {"drag": (0.3, 0.4)}},
    {"checks": ("quiet",)},
    {"reference": "box_3"},
    {"hard": ("length",)},
    {"weights": {"length": 2.0}},
    {"linear": {"size": Linear({"length": 1.0, "width": 2.0}, high=9.0)}},
    {"alpha": (-5.0, 5.0)},
    {"ridge": 0.1},
    {"norm": 1},
    {"safe": ("alpha",)},
    {"models": {"aero": Aero()}},
    {"measured": {"length": "extents.length"}},
    {"turns": 1, "measured": {"length": "extents.length"}},
    {"solver": Spec("kkt", ridge=0.1)},
    {"measures": ("volume",)},
    {"limits": {"alpha": 1.0}},
    {"level": "field"},
    {"resolution": 64},
    {"format": "ply"},
    {"seed": 1},
]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: next(iter(change)))
def test_another_question_is_another_design(bank, tmp_path, change):
    extra = (COUNTING, ("second", Second()))
    study = Study(bank, targets=TARGET, reference="box_1", solver="able")
    run(study, tmp_path, *extra)
    run(replace(study, **change), tmp_path, *extra)
    assert len(table(tmp_path)) == 2
    small.CALLS.clear()
    run(study, tmp_path, *extra)
    assert small.CALLS["evaluate"] == 0


def test_each_thing_that_a_study_asks_is_among_these():
    alone = {"bank", "sweep", "experiments", "requires"}  # a bank has its own test; the others alter no design
    assert {name for change in CHANGES for name in change} == {item.name for item in fields(Study)} - alone


@pytest.mark.parametrize(
    "name",
    [
        "limits",
        "solver",
        "reference",
        "hard",
        "measures",
        "checks",
        "format",
        "seed",
        "weights",
        "linear",
        "alpha",
        "ridge",
        "norm",
        "safe",
        "models",
        "measured",
        "turns",
    ],
)
def test_each_alters_the_key_itself(bank, name):
    """Not by way of the target or the evidence: the identity of what is asked."""
    given = small.plugins(COUNTING, ("second", Second()))
    study = Study(bank, targets=TARGET, reference="box_1", solver="able")
    change, *_ = [change for change in CHANGES if name in change]
    assert Task.of(study, given).identity != Task.of(replace(study, **change), given).identity


@pytest.mark.parametrize(
    "change",
    [
        {"targets": {"length": 2.1}},
        {"targets": {}, "keep": ("width",)},
        {"sweep": {"width": [1.1]}},
        {"requires": ("kkt",)},
    ],
    ids=lambda change: [*change][-1],
)
def test_targets_and_sweeps_are_no_part_of_the_identity(bank, change):
    study = Study(bank, targets=TARGET)
    assert Task.of(study, small.plugins()).identity == Task.of(replace(study, **change), small.plugins()).identity


class Second:
    """Another plugin that measures and judges as the first does, or does not."""

    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"mine": toys.Size, "its": toys.Volume}

    @lampopt.hookimpl
    def lampopt_checks(self):
        return {"quiet": toys.Nothing, "silent": toys.Nothing}


@pytest.mark.parametrize(
    ("one", "two"),
    [
        ({"measures": ("mine",)}, {"measures": ("its",)}),
        ({"checks": ("quiet",)}, {"checks": ("silent",)}),
        ({"measures": ("mine",)}, {"measures": ("mine", "its")}),
    ],
)
def test_other_measures_or_checks_of_one_plugin_are_another_design(bank, tmp_path, one, two):
    for asked in (one, two):
        result = run(Study(bank, targets=TARGET, **asked), tmp_path, ("second", Second()))
    assert len(table(tmp_path)) == 2
    names = {check.name.partition(".")[0] for check in result.checks}
    assert set(asked.get("measures", ())) <= names


@pytest.mark.parametrize("asked", [{"measures": ("mine",)}, {"checks": ("quiet",)}], ids=["measures", "checks"])
def test_a_measure_or_check_of_another_plugin_is_another_design(bank, tmp_path, asked):
    for name in ("second", "third"):
        run(Study(bank, targets=TARGET, **asked), tmp_path, (name, Second()))
    assert len(table(tmp_path)) == 2


@pytest.mark.parametrize(("level", "count"), [("mesh", 2), ("field", 1)])
def test_drift_measured_by_another_plugin_is_another_design(tmp_path, level, count):
    plugins = small.plugins(("second", Second()))
    given = small.bank(small.boxes(measured={"length": "mine.length"}), plugins=plugins)
    for name in ("second", "third"):
        run(Study(given, targets=TARGET, level=level), tmp_path, (name, Second()))
    assert len(table(tmp_path)) == count


def other_banks(bank):
    yield replace(bank, frame=Frame(bank.frame.scale, [9, 9, 9], bank.frame.unit))
    yield replace(bank, frame=Frame(bank.frame.scale, bank.frame.centre, "mm"))
    yield replace(bank, weights=bank.weights * np.float32(1.01))
    yield replace(bank, shared={**bank.shared, "mean": np.zeros(3)})
    yield replace(bank, limits={"alpha": 2.0})
    yield replace(bank, names=tuple(f"b{i}" for i in range(7)))
    yield replace(bank, mesh_facts={})
    yield replace(bank, provenance={**bank.provenance, "plan": "other"})


def all_other_banks(bank):
    yield from other_banks(bank)
    yield replace(bank, space=(replace(bank.space[0], unit="dm"), bank.space[1]))
    yield replace(bank, label_space=(lampopt.Parameter("force"),))
    yield replace(bank, decoder=Spec("stretch-field"))
    yield replace(bank, measured_by={"length": "extents.length", "width": "extents.height"})
    for name in ("parameters", "labels", "probes", "probe_values", "fit_error", "measured"):
        found = getattr(bank, name).copy()
        found.flat[0] += 0.125
        yield replace(bank, **{name: found})


def test_whatever_differs_in_a_bank_it_has_other_designs(bank):
    others = list(all_other_banks(bank))
    names = [next(n for n, value in plain(bank).items() if value != plain(other)[n]) for other in others]
    assert set(names) == plain(bank).keys() - {"path", "calibration"}  # which alter no design
    keys = {Task.of(Study(b, targets=TARGET), small.plugins()).key(TARGET) for b in [bank, *others]}
    assert len(keys) == 1 + len(others)


def plain(bank):
    """A bank's fields, comparable."""

    def comparable(value):
        if isinstance(value, np.ndarray):
            return value.tobytes()
        if isinstance(value, Frame):
            return (value.scale, value.centre.tolist(), value.unit)
        return {k: comparable(v) for k, v in value.items()} if isinstance(value, Mapping) else value

    return {item.name: comparable(getattr(bank, item.name)) for item in fields(bank)}


def test_another_bank_is_another_design(bank, tmp_path):
    run(Study(bank, targets=TARGET), tmp_path)
    others = list(other_banks(bank))
    for count, other in enumerate(others, 2):
        result = run(Study(other, targets=TARGET), tmp_path)
        assert len(table(tmp_path)) == count
    moved = run(Study(others[0], targets=TARGET), tmp_path)
    assert moved.design.mesh.bounds.mean(0) == pytest.approx([9, 9, 9])
    assert result.accepted


def test_the_same_question_in_other_words_is_the_same_design(bank, tmp_path):
    stored = lampopt.store_bank(bank, tmp_path / "a.lamp")
    run(Study(bank, targets=TARGET), tmp_path / "run")
    for given in (stored, str(tmp_path / "a.lamp"), tmp_path / "a.lamp"):
        run(Study(given, targets={"width": "1200 mm", "length": 2.9}, solver=Spec("kkt")), tmp_path / "run")
    assert len(table(tmp_path / "run")) == 1


def test_a_grown_sweep_reuses_its_rows(bank, tmp_path):
    study = Study(bank)
    list(sweep(study, {"length": [2.1, 2.2], "width": [1.2]}, tmp_path))
    small.CALLS.clear()
    results = list(sweep(study, {"length": [2.1, 2.15, 2.2], "width": [1.2, 1.3]}, tmp_path))
    assert len(results) == len(table(tmp_path)) == 6
    assert small.CALLS["decode"] == 4
    run(Study(bank, targets={"length": 2.15, "width": 1.3}), tmp_path)  # one of them on its own is there too
    assert small.CALLS["decode"] == 4


# killed and begun again


def test_a_sweep_that_is_left_midway_goes_on(bank, tmp_path):
    list(sweep(Study(bank), GRID, tmp_path / "whole"))
    small.CALLS.clear()
    begun = sweep(Study(bank), GRID, tmp_path / "run")
    next(begun), next(begun)
    begun.close()
    assert len(table(tmp_path / "run")) == 2
    results = list(sweep(Study(bank), GRID, tmp_path / "run"))
    assert small.CALLS["decode"] == 6
    assert len(results) == 6
    assert table(tmp_path / "run", EVERYTHING) == table(tmp_path / "whole", EVERYTHING)


class Interrupts:
    """An observer that presses Ctrl-C."""

    @lampopt.hookimpl
    def lampopt_recorded(self, result, folder):
        raise KeyboardInterrupt


def test_interrupted_after_a_result_is_on_disk(bank, tmp_path):
    for count in range(1, 7):
        with pytest.raises(KeyboardInterrupt):
            list(sweep(Study(bank), GRID, tmp_path, ("stop", Interrupts())))
        assert len(table(tmp_path)) == count
    assert len(list(sweep(Study(bank), GRID, tmp_path))) == 6
    assert small.CALLS["decode"] == 6


def test_what_was_left_half_written_is_written_again(bank, tmp_path):
    first = run(Study(bank, targets=TARGET), tmp_path)
    with closing(sqlite3.connect(tmp_path / "runs.sqlite")) as database:  # killed before the row was written
        database.execute("DELETE FROM designs")
        database.commit()
    aside = first.folder.with_name(first.folder.name + ".writing")
    aside.mkdir()
    (aside / "mesh.stl").write_bytes(b"solid half")
    (first.folder / "mesh.stl").write_bytes(b"")
    again = run(Study(bank, targets=TARGET), tmp_path)
    assert not aside.exists()
    assert trimesh.load_mesh(again.folder / "mesh.stl").is_watertight
    assert len(table(tmp_path)) == 1


SWEEP = """
import sys
sys.path.insert(0, {here!r})
import lampopt, small
study = lampopt.Study({bank!r})
for result in lampopt.sweep(study, {grid!r}, {folder!r}, report=False, plugins=small.plugins()):
    print(result.folder.name, flush=True)
"""


def begin(bank, folder, **environment):
    code = SWEEP.format(here=str(HERE), bank=str(bank), grid=GRID, folder=str(folder))
    return subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize(("after", "delay"), [(2, 0.0), (3, 0.13)])
def test_a_killed_sweep_goes_on(bank, tmp_path, after, delay):
    stored, folder = lampopt.store_bank(bank, tmp_path / "a.lamp"), tmp_path / "run"
    list(sweep(Study(stored), GRID, tmp_path / "whole"))
    with begin(stored.path, folder, SMALL_SLOW="0.15") as process:
        for _ in range(after):
            process.stdout.readline()
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
    done = len(table(folder))
    assert after <= done < 6
    small.CALLS.clear()
    assert len(list(sweep(Study(stored), GRID, folder))) == 6
    assert small.CALLS["decode"] == 6 - done
    assert table(folder, EVERYTHING) == table(tmp_path / "whole", EVERYTHING)
    written = sorted(p.relative_to(folder) for p in (folder / "designs").rglob("*"))
    assert written == sorted(p.relative_to(tmp_path / "whole") for p in (tmp_path / "whole" / "designs").rglob("*"))


def test_a_folder_that_another_process_has_is_refused(bank, tmp_path):
    stored, folder = lampopt.store_bank(bank, tmp_path / "a.lamp"), tmp_path / "run"
    with begin(stored.path, folder, SMALL_SLOW="0.2") as process:
        process.stdout.readline()
        with pytest.raises(InputError, match=r"run: another process is running here; wait for it or name another"):
            next(sweep(Study(stored), GRID, folder))
        process.send_signal(signal.SIGKILL)
    assert run(Study(stored, targets=TARGET), folder).accepted  # the lock died with it


def test_a_folder_is_free_once_a_sweep_is_left(bank, tmp_path):
    begun = sweep(Study(bank, level="alpha"), GRID, tmp_path)
    next(begun)
    with pytest.raises(InputError, match="another process is running here"):
        run(Study(bank, level="alpha", targets=TARGET), tmp_path)
    begun.close()
    assert run(Study(bank, level="alpha", targets=TARGET), tmp_path).accepted


def test_a_folder_that_cannot_be_one_is_refused(bank, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be used as a run folder"):
        run(Study(bank, targets=TARGET), tmp_path / "file")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "runs.sqlite").write_text("no database " * 100)
    with pytest.raises(InputError, match=r"runs\.sqlite: is damaged or no database"):
        run(Study(bank, targets=TARGET), tmp_path / "run")


@pytest.mark.parametrize(
    ("column", "value"),
    [("alpha", b"x"), ("alpha", 5), ("target", "{"), ("checks", "[[1]]"), ("checks", "5"), ("conflicts", None)],
)
def test_a_damaged_row_is_named(bank, tmp_path, column, value):
    study = Study(bank, targets=TARGET, level="alpha")
    run(study, tmp_path)
    with closing(sqlite3.connect(tmp_path / "runs.sqlite")) as database:
        ((key,),) = database.execute("SELECT key FROM designs").fetchall()
        database.execute("UPDATE OR IGNORE designs SET " + column + " = ?", (value if value is not None else "x",))
        database.commit()
    with pytest.raises(InputError, match=rf"row of design {key} is damaged: .*delete that row .*it is made anew"):
        run(study, tmp_path)
    with closing(sqlite3.connect(tmp_path / "runs.sqlite")) as database:
        database.execute("DELETE FROM designs")
        database.commit()
    assert run(study, tmp_path).accepted


@pytest.mark.parametrize("place", ["study.toml.writing", "runs.lock"])
def test_what_cannot_be_written_is_said_and_the_rest_kept(bank, tmp_path, place):
    study = Study(bank, targets=TARGET)
    run(study, tmp_path)
    (tmp_path / place).unlink(missing_ok=True)
    (tmp_path / place).mkdir()
    with pytest.raises(InputError, match=r"cannot be written: .*; what is recorded there is kept"):
        run(study, tmp_path)
    (tmp_path / place).rmdir()
    small.CALLS.clear()
    assert run(study, tmp_path).accepted
    assert not small.CALLS


def test_a_full_disk_is_said(bank, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(trimesh.Trimesh, "export", full)
    with pytest.raises(InputError, match=r"cannot be written: .*No space left.*; what is recorded there is kept"):
        run(Study(bank, targets=TARGET), tmp_path)


def test_a_locked_database_is_not_damaged(bank, tmp_path, monkeypatch):
    def locked(*_):
        raise sqlite3.OperationalError("database is locked")

    monkeypatch.setattr("lampopt.database._schema", locked)
    with pytest.raises(InputError, match=r"runs\.sqlite: cannot be used: database is locked"):
        run(Study(bank, targets=TARGET), tmp_path)


def test_a_mesh_is_not_exported_where_no_file_can_be(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a.stl", tmp_path / "a\0.stl", tmp_path / ("a" * 300 + ".stl")):
        with pytest.raises(InputError, match="cannot be written"):
            export_mesh(shapes.box(), path)


# plugins in the loop


class Broken:
    """Solvers and decoders that are none, and a solver whose coefficients do not sum to one."""

    @lampopt.hookimpl
    def lampopt_solvers(self):
        return {"none": object, "lost": Lost, "failed": Failed}


@dataclass(frozen=True)
class Lost:
    def solve(self, problem):
        return Mix(np.zeros(problem.matrix.shape[1]), np.zeros(len(problem.names)), "exact")

    def solve_many(self, problem, targets, ridges=None):
        raise NotImplementedError


@dataclass(frozen=True)
class Failed(Lost):
    def solve(self, problem):
        return Mix(problem.centre, problem.matrix @ problem.centre - problem.target, "failed", "gave up")


def test_solvers_that_do_not_do(bank):
    broken = ("broken", Broken())
    with pytest.raises(PluginError, match=r"lacks what lampopt\.protocols.Solver asks for"):
        run(Study(bank, solver="none"), None, broken)
    with pytest.raises(LampoptError, match="sum to 1"):
        run(Study(bank, targets=TARGET, solver="lost"), None, broken)
    result = run(Study(bank, targets=TARGET, solver="failed", level="alpha"), None, broken)
    assert {check.name for check in result.checks if not check.passed} == {"solved", "target"}
    assert result.check("target").note == result.check("solved").note == "gave up"
    # one who gives up where there is nothing to miss is not accepted either
    result = run(Study(bank, solver="failed", level="alpha"), None, broken)
    assert [check.name for check in result.checks if not check.passed] == ["solved"]


@dataclass(frozen=True)
class Shrinks(toys.Size):
    """Measure that works on the very mesh it was given."""

    def __call__(self, mesh):
        values = super().__call__(mesh)
        mesh.apply_scale(0.9)
        return values


@dataclass(frozen=True)
class Nudges(toys.Nothing):
    """Check that moves one vertex in place."""

    needs = "mesh"

    def __call__(self, bank, design):
        design.mesh.vertices[0] += 1e-9
        return ()


class Spoiling:
    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"shrinks": Shrinks}

    @lampopt.hookimpl
    def lampopt_checks(self):
        return {"nudges": Nudges}


@pytest.mark.parametrize(
    ("asked", "who"), [({"measures": ("shrinks",)}, "measure 'shrinks'"), ({"checks": ("nudges",)}, "check 'nudges'")]
)
def test_a_plugin_that_alters_the_mesh_is_named(bank, tmp_path, asked, who):
    with pytest.raises(PluginError, match=f"^{who} altered the mesh that it was given"):
        run(Study(bank, targets=TARGET, **asked), tmp_path, ("careless", Spoiling()))
    assert table(tmp_path) == []


@dataclass(frozen=True)
class Says:
    """Checker of level alpha that answers `what`."""

    what: object = None
    needs = "alpha"

    def __call__(self, bank, design):
        return self.what


@pytest.mark.parametrize("answer", [None, 5, "fine", ["fine"], [None], {"a": 1}], ids=str)
def test_what_is_no_list_of_checks_is_named(bank, answer):
    class Plugin:
        @lampopt.hookimpl
        def lampopt_checks(self):
            return {"says": type("Answers", (Says,), {"__call__": lambda *_: answer})}

    with pytest.raises(PluginError, match=r"^check 'says': expected a list of lampopt\.Check, got "):
        run(Study(bank, targets=TARGET, level="alpha", checks=("says",)), None, ("says", Plugin()))


@pytest.mark.parametrize("answer", [None, 5, ["fine"]], ids=str)
def test_design_checks_that_are_none_are_named(bank, monkeypatch, answer):
    monkeypatch.setattr(small.Stretch, "design_checks", lambda *_: answer, raising=False)
    with pytest.raises(
        PluginError, match=r"^decoder 'stretch': design_checks: expected a list of lampopt\.Check, got "
    ):
        run(Study(bank, targets=TARGET))


def test_a_measured_parameter_that_alters_the_mesh_is_named(bank):
    spoilt = replace(bank, measured_by={"length": "shrinks.length", "width": "extents.width"})
    with pytest.raises(PluginError, match=r"one of shrinks\.length, extents\.width, or the decoder, altered the mesh"):
        run(Study(spoilt, targets=TARGET), None, ("careless", Spoiling()))


def test_problems_are_said_once_and_nothing_else_is(bank, caplog, monkeypatch):
    monkeypatch.setenv("LAMPOPT_BLOCK", "")
    with caplog.at_level(logging.WARNING, "lampopt"):
        with pytest.raises(PluginError, match="decoder 'stretch' is not installed"):
            lampopt.run(Study(bank, targets=TARGET))
        run(Study(bank, targets=TARGET))
    assert not caplog.records
