"""The conformance kit, tested: good plugins pass everything, a broken one fails exactly the check made for it."""

import copy
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lampopt import hookimpl, hookspecs, testing
from lampopt.errors import InputError, LampoptError, PluginError
from lampopt.plugins import Plugins
from lampopt.testing import CHECKS, ConformanceError, shapes

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE), str(HERE.parent / "examples" / "third_party_decoder")) if p not in sys.path]
toys = importlib.import_module("toys")
BROKEN = importlib.import_module("broken_more").BROKEN
Sloped = importlib.import_module("broken").Sloped
gridsdf = importlib.import_module("lampopt_gridsdf")
GridSDF = gridsdf.GridSDF
FRESH = "check_fresh_process_agrees"  # takes a second, so only where it is what is tested


@testing.decoder_checks(GridSDF(size=16), Sloped(size=12), toys.Radial())
def test_decoders_that_are_right(check):
    check()


@testing.solver_checks(toys.KKT(), toys.Able())
def test_solvers_that_are_right(check):
    check()


@testing.measure_checks(
    toys.Size(),
    toys.Volume(),
    toys.Linear().fit([shapes.box([x, 0.5, 0.4]) for x in (1, 2, 3)], np.array([[1], [2], [3]]), "l", "L", seed=0),
)
def test_measures_that_are_right(check):
    check()


@testing.surrogate_checks(toys.Linear())
def test_surrogates_that_are_right(check):
    check()


@testing.model_checks(toys.Drag(), toys.Roughly())
def test_models_that_are_right(check):
    check()


@testing.source_checks(toys.Boxes())
def test_sources_that_are_right(check):
    check()


@testing.checker_checks(toys.Nothing(), toys.Slender(), toys.Priced())
def test_checkers_that_are_right(check):
    check()


@pytest.mark.parametrize(("kind", "plugin", "check"), BROKEN, ids=[type(plugin).__name__ for _, plugin, _ in BROKEN])
def test_precisely_that_check_fails(kind, plugin, check, monkeypatch):
    if check != FRESH:
        monkeypatch.setattr(testing.decoders.fresh, "evaluate", lambda d, *a: d.evaluate(*copy.deepcopy(a)))
    failed = {r.check: r.message for r in testing.report(kind, plugin) if not r.passed}
    assert set(failed) == {check}, failed
    assert failed[check].startswith(f"{check}: ")
    assert "Why it matters" in failed[check]


def test_every_check_is_tested():
    noticed = {check for _, _, check in BROKEN}
    by_kind = {(kind, check) for kind, _, check in BROKEN}
    common = {check.__name__ for check in testing.engine.COMMON} | {"check_units_can_be_read"}
    for kind, checks in CHECKS.items():
        for check in checks:
            assert check.__name__ in noticed if check.__name__ in common else (kind, check.__name__) in by_kind
            assert check.__doc__, f"{check.__name__} does not say why it matters"


def test_the_first_failure_is_raised_with_its_reason():
    bad = next(plugin for _, plugin, check in BROKEN if check == "check_mesh_is_left")
    with pytest.raises(ConformanceError, match=r"check_mesh_is_left: .* Why it matters: Every check") as caught:
        testing.check_measure(bad)
    assert isinstance(caught.value, AssertionError)
    assert isinstance(caught.value, LampoptError)
    testing.check_measure(bad, expected_failures={"check_mesh_is_left": "it is a test"})


def test_excuses_are_strict():
    excuse = {"check_mesh_is_left": "not yet"}
    record = next(r for r in testing.report("measure", toys.Size(), excuse) if r.check in excuse)
    assert not record.passed
    assert "passes although excused" in record.message
    with pytest.raises(ConformanceError, match="drop the excuse"):
        testing.check_measure(toys.Size(), expected_failures=excuse)
    with pytest.raises(InputError, match="no check is called check_that"):
        testing.report("measure", toys.Size(), {"check_that": "?"})
    with pytest.raises(InputError, match="no check is called check_that"):
        testing.measure_checks(toys.Size(), expected_failures={"check_that": "?"})
    with pytest.raises(InputError, match="no check is called check_that"):
        testing.check_measure(toys.Size(), {"check_that": "?"})
    with pytest.raises(InputError, match="expected one of decoder, solver"):
        testing.report("mesure", toys.Size())


def test_decorator_gives_ids_and_strict_xfails():
    @testing.measure_checks(toys.Size(), expected_failures={"check_mesh_is_left": "not yet"})
    def decorated(check):
        check()

    cases = decorated.pytestmark[0].args[1]
    assert [c.id for c in cases][:2] == ["Size-check_protocol", "Size-check_options_rebuild_an_equal_object"]
    marks = {c.id: c.marks for c in cases if c.marks}
    assert list(marks) == ["Size-check_mesh_is_left"]
    assert marks["Size-check_mesh_is_left"][0].kwargs["strict"]


def test_a_class_that_no_other_process_finds_is_passed_over():
    class Local(GridSDF):
        pass

    record = next(r for r in testing.report("decoder", Local(size=12)) if r.check == FRESH)
    assert record.passed
    assert "cannot be imported by a fresh process" in record.message


class Offers:
    """A plugin: one class that is built by `example`, one that cannot be built."""

    @hookimpl
    def lampopt_measures(self):
        return {"size": toys.Size, "gone": "no_such_module:Gone"}

    @hookimpl
    def lampopt_sources(self):
        return {"boxes": Cheap, "table": Needy}


class Cheap(toys.Boxes):
    @classmethod
    def example(cls):
        return toys.Boxes(count=2)


class Needy(toys.Boxes):
    def __init__(self, table):
        raise AssertionError


def test_check_plugin_builds_and_checks_everything():
    plugins = Plugins.load([("mine", Offers()), ("odd", object())], block=_installed())
    records = testing.check_plugin(plugins, "mine")
    failed = {(r.plugin, r.check) for r in records if not r.passed}
    assert failed == {("measure gone", "builds"), ("source table", "builds")}
    passed = {r.plugin for r in records if r.passed}
    assert passed == {"measure size", "source boxes"}
    assert len(records) == 4 + len(CHECKS["measure"]) + len(CHECKS["source"])
    assert any("example()" in r.message for r in records)


def test_check_plugin_reports_what_does_not_load():
    plugins = Plugins.load([("odd", object())], block=_installed())
    (record,) = testing.check_plugin(plugins, "odd")
    assert not record.passed
    assert "has no hooks" in record.message
    assert str(record).startswith("FAILED odd: loads")
    with pytest.raises(PluginError, match=r"'nobody'.*not installed"):
        testing.check_plugin(plugins, "nobody")


def _installed():
    from importlib.metadata import entry_points

    return [point.name for point in entry_points(group="lampopt")]


def test_docs_list_every_check_with_its_reason():
    text = (HERE.parent / "docs" / "testing-plugins.md").read_text(encoding="utf-8")
    for check in {check for checks in CHECKS.values() for check in checks}:
        assert f"| `{check.__name__}` | {' '.join(inspect.getdoc(check).split())} |" in text


def test_docs_show_every_hook_with_its_signature():
    text = (HERE.parent / "docs" / "hooks.md").read_text(encoding="utf-8")
    hooks = {name: hook for name, hook in vars(hookspecs).items() if name.startswith("lampopt_")}
    assert hooks
    for name, hook in hooks.items():
        assert f"`{name}{inspect.signature(hook)}`".replace("'", "") in text


@pytest.mark.parametrize("sections", [7, 12, 32])
def test_plate_is_exact(sections):
    plate = shapes.plate_with_hole((1.0, 0.6, 0.1), 0.15, sections=sections)
    hole = sections / 2 * 0.15**2 * np.sin(2 * np.pi / sections)
    assert plate.is_watertight
    assert plate.is_winding_consistent
    assert plate.euler_number == 0
    assert plate.volume == pytest.approx((0.6 - hole) * 0.1)


def test_box_and_ellipsoid_are_exact():
    box, ball = shapes.box((1, 2, 3), centre=(1, 0, 0)), shapes.ellipsoid((1, 2, 3), divisions=4)
    assert box.volume == pytest.approx(6)
    assert box.bounds.tolist() == [[0.5, -1, -1.5], [1.5, 1, 1.5]]
    assert np.allclose(((ball.vertices / [1, 2, 3]) ** 2).sum(1), 1)
    assert ball.volume == pytest.approx(8 * np.pi, rel=0.01)


def test_torch_is_watched_where_only_the_decoder_loads_it():
    """In a process of its own: here other tests have loaded it."""
    program = """
import sys
from dataclasses import dataclass
from lampopt import testing
from lampopt_gridsdf import GridSDF

@dataclass(frozen=True)
class Seeds(GridSDF):
    def fit(self, shared, meshes, *, seed, progress=None):
        import torch
        torch.manual_seed(seed)
        return super().fit(shared, meshes, seed=seed)

assert "torch" not in sys.modules
failed = [r.check for r in testing.report("decoder", Seeds(size=12)) if not r.passed]
assert failed == ["check_global_random_state_is_left"], failed
"""
    tutorial = HERE.parent / "examples" / "third_party_decoder"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tutorial), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
