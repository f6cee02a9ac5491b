"""Measures that a study is given as objects or with options: reported, recorded, told apart, sent to workers."""

import copy
import importlib
import multiprocessing
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Exemplars, Parameter, Spec, Study
from lampopt.errors import InputError, MeasureError, StudyError
from lampopt.identity import given, offered
from lampopt.task import Task
from lampopt.testing import shapes

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402
import toys  # noqa: E402

TARGET = {"length": 2.9, "width": 1.2}


@dataclass(frozen=True)
class Diagonal:
    """The bounding box's, times something."""

    times: float = 1.0
    names = ("diagonal",)
    units = ("L",)

    def __call__(self, mesh):
        return np.array([self.times * np.linalg.norm(mesh.extents)])


@dataclass(frozen=True)
class Unsure:
    """Says how sure it is; beyond 2 it knows nothing."""

    names = ("guess", "other")
    units = ("L", "")

    def __call__(self, mesh):
        return np.array([mesh.extents[0], 1.0])

    def interval(self, mesh, level):
        return self(mesh)[:, None] + np.array([[-level, level], [0.0, 0.0]])

    def outside(self, mesh):
        return bool(mesh.extents[0] > 2.95)


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes())


def run(bank, measures, folder=None, targets=TARGET):
    return lampopt.run(Study(bank, targets, measures=measures), folder, report=False, plugins=small.plugins())


def test_an_object_is_measured_under_the_name_it_is_given(bank):
    result = run(bank, {"d": Diagonal(), "twice": Diagonal(2.0), "box": "extents"})
    wanted = np.linalg.norm([2.9, 1.2, 0.8])
    assert result.check("d.diagonal").value == pytest.approx(wanted, rel=1e-6)
    assert result.check("twice.diagonal").value == pytest.approx(2 * wanted, rel=1e-6)
    assert result.check("box.length").value == pytest.approx(2.9, rel=1e-6)
    assert result.check("d.diagonal").unit == "m"
    assert lampopt.measure(Diagonal(), shapes.box((3, 4, 12))) == {"diagonal": pytest.approx(13)}
    with pytest.raises(MeasureError, match="measure 'Diagonal': expected a mesh with faces"):
        lampopt.measure(Diagonal(), type(shapes.box((1, 1, 1)))())


def test_one_that_is_unsure_says_so(bank):
    result = run(bank, {"model": Unsure()})
    assert result.check("model.guess").note == "90% interval 2 to 3.8"
    assert result.check("model.other").note == "90% interval 1 to 1"
    assert result.check("model.guess").sense == "info"
    farther = run(bank, {"model": Unsure()}, targets={"length": 3.0, "width": 1.2})
    assert farther.check("model.guess").note.endswith("; outside what it was made for")


def test_a_learned_one_is_used_from_its_file_and_tells_when_it_changed(bank, tmp_path):
    file = tmp_path / "length.measure"
    lengths = np.linspace(2.0, 3.2, 9)

    def learn(change):
        known = Exemplars(
            parameters=(lengths + change)[:, None],
            space=(Parameter("length", "m"),),
            meshes=[shapes.box((length, 1.0, 0.8)) for length in lengths],
            names=tuple(f"b{i}" for i in range(9)),
        )
        lampopt.fit_surrogate(known, Spec("calibrated", by="extents.length"), store=file)

    learn(0.0)
    chosen = {"drawn": Spec("learned", file=str(file))}
    first = run(bank, chosen, tmp_path / "run").check("drawn.length")
    assert first.value == pytest.approx(2.9, rel=1e-6)
    assert first.note.startswith("90% interval")
    learn(5.0)  # the same name, another measure: what is recorded must not be taken for its answer
    assert run(bank, chosen, tmp_path / "run").check("drawn.length").value == pytest.approx(7.9, rel=1e-6)


def test_another_object_is_another_design(bank, tmp_path):
    for times in (1.0, 2.0, 1.0):
        small.CALLS.clear()
        result = run(bank, {"d": Diagonal(times)}, tmp_path / "run")
        assert result.check("d.diagonal").value == pytest.approx(times * np.linalg.norm([2.9, 1.2, 0.8]), rel=1e-6)
    assert small.CALLS["decode"] == 0  # the first is read back


OWN = """
from lampopt_measure.pieces import extent, measure, surface

TIMES = {times}

@measure(size="L")
def own(mesh):
    return {{"size": TIMES * extent(surface(mesh), "x")}}
"""


def test_a_function_that_was_edited_is_another_design(bank, tmp_path, monkeypatch):
    """Its own text, and what else its file holds."""
    monkeypatch.syspath_prepend(tmp_path)
    for times in (1.0, 1000.0):
        (tmp_path / "own_size.py").write_text(OWN.format(times=times))
        importlib.invalidate_caches()
        sys.modules.pop("own_size", None)
        shutil.rmtree(tmp_path / "__pycache__", ignore_errors=True)
        own = importlib.import_module("own_size").own()
        result = run(bank, {"own": own}, tmp_path / "run")
        assert result.check("own.size").value == pytest.approx(2.9 * times, rel=1e-6)
    small.CALLS.clear()
    run(bank, {"own": own}, tmp_path / "run")
    assert small.CALLS["decode"] == 0  # the same again is read back


class Plain:
    """No dataclass; what it holds is in no repr."""

    names = ("size",)
    units = ("L",)

    def __init__(self, table):
        self.table = table

    def __call__(self, mesh):
        return np.array([self.table[1000] * mesh.extents[0]])


def test_all_that_an_object_holds_tells_it(bank, tmp_path):
    for times in (1.0, 2.0):
        table = np.zeros(2000)
        table[1000] = times
        result = run(bank, {"own": Plain(table)}, tmp_path / "run")
        assert result.check("own.size").value == pytest.approx(2.9 * times, rel=1e-6)


def test_one_that_cannot_be_pickled_is_measured_each_time(bank, tmp_path):
    calls = []
    own = Plain(np.ones(2000))
    own.told = lambda mesh: calls.append(mesh)
    for _ in range(2):
        small.CALLS.clear()
        run(bank, {"own": own}, tmp_path / "run")
        assert small.CALLS["decode"] == 1


def test_a_run_with_an_object_is_read_back_but_not_run_from_its_file(bank, tmp_path):
    run(bank, {"d": Diagonal(), "size": "size"}, tmp_path / "run")
    (found,) = lampopt.results(tmp_path / "run", plugins=small.plugins())
    assert found.check("d.diagonal").value == pytest.approx(np.linalg.norm([2.9, 1.2, 0.8]), rel=1e-6)
    assert lampopt.report(tmp_path / "run", plugins=small.plugins()).exists()
    study = Study.read(tmp_path / "run" / "study.toml")
    with pytest.raises(StudyError, match=r"d: was given as a Python object, .*test_own_measures\.Diagonal"):
        lampopt.run(study, plugins=small.plugins())


def test_toml_holds_names_and_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = Study("b.lamp", TARGET, measures={"a": "extents", "b": Spec("learned", file="x.measure")})
    again = Study.from_toml(study.to_toml(), folder=Path("/elsewhere"))  # written absolute: it is the same file
    assert dict(again.measures) == {"a": Spec("extents"), "b": Spec("learned", file=str(tmp_path / "x.measure"))}
    assert 'measures = [\n    "extents",\n]' in Study("b.lamp", TARGET, measures=("extents",)).to_toml()
    written = 'bank = "b.lamp"\n[measures]\nsize = "extents"\ndrag = { name = "learned", file = "d.measure" }\n'
    assert dict(Study.from_toml(written, folder=Path("/here")).measures) == {
        "size": Spec("extents"),
        "drag": Spec("learned", file="/here/d.measure"),
    }


@pytest.mark.parametrize(
    ("measures", "message"),
    [
        ({"d": Diagonal}, "measures: d: expected the name of a measure, a Spec or a measure"),
        ({"d": 5}, "measures: d: expected the name of a measure"),
        ({"a.b": "extents"}, "expected a name without dots"),
        ({5: "extents"}, "expected a table of names"),
        (Diagonal(), "needs a name, under which its values are"),
        (["extents", Diagonal()], "needs a name, under which its values are"),
        ([Spec("extents")], "needs a name"),
        ([5], "expected a list of names"),
    ],
)
def test_what_is_no_measure_is_refused(measures, message):
    with pytest.raises(StudyError, match=message):
        Study("b.lamp", TARGET, measures=measures)


def sweep(bank, measures, folder=None, executor=None):
    study = Study(bank, {"width": 1.2}, measures=measures)
    grid = {"length": [2.3, 2.5, 2.7]}
    found = lampopt.sweep(study, grid, folder, executor=executor, report=False, plugins=small.plugins())
    return [r.check("size.volume").value for r in found]


def test_workers_measure_with_it_too(bank, tmp_path):
    wanted = sweep(bank, {"size": toys.Size()})
    with ThreadPoolExecutor(2) as executor:
        assert sweep(bank, {"size": toys.Size()}, executor=executor) == wanted
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as executor:
        assert sweep(bank, {"size": toys.Size()}, tmp_path / "run", executor) == wanted


def test_one_that_cannot_be_sent_is_said(bank, tmp_path):
    class Local(toys.Size):
        pass

    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as executor,
        pytest.raises(StudyError, match="the measures or models size cannot be sent to other processes"),
    ):
        sweep(bank, {"size": Local()}, tmp_path / "run", executor)


def told_by_file(tmp_path, change=0.0):
    """A bank whose parameter `length` is told by a learned measure, and that measure's file."""
    file = tmp_path / "length.measure"
    lengths = np.linspace(1.9, 3.1, 9)
    known = Exemplars(
        parameters=(lengths + change)[:, None],
        space=(Parameter("length", "m"),),
        meshes=[shapes.box((length, 1.0, 0.8)) for length in lengths],
        names=tuple(f"b{i}" for i in range(9)),
    )
    lampopt.fit_surrogate(known, Spec("calibrated", by="extents.length"), store=file)
    return small.bank(small.boxes(measured={"length": f"{file}:length"})), file


def test_a_parameter_is_told_by_a_learned_measure(tmp_path):
    bank, file = told_by_file(tmp_path)
    assert bank.measured_by == {"length": f"{file}:length"}
    result = run(bank, ())
    assert result.check("drift.length").value == pytest.approx(0, abs=1e-6)
    assert result.accepted
    beyond = run(bank, (), targets={"length": 3.5, "width": 1.2}).check("drift.length")  # learned up to 3.1
    assert not beyond.passed
    assert "outside what it was made for" in beyond.note
    file.unlink()
    with pytest.raises(InputError, match=r"length\.measure"):
        run(bank, ())


def test_another_learned_measure_is_another_design(tmp_path):
    bank, _ = told_by_file(tmp_path)
    first = run(bank, (), tmp_path / "run").check("drift.length")
    told_by_file(tmp_path, change=1.0)
    assert run(bank, (), tmp_path / "run").check("drift.length").value == pytest.approx(1.0, abs=1e-6)
    assert first.passed


def test_a_learned_measure_is_found_from_any_folder_and_moves_with_the_bank(tmp_path, monkeypatch):
    """Not whatever file of its name lies where one happens to be."""
    (tmp_path / "here").mkdir()
    told_by_file(tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    measured = {"length": "length.measure:length"}
    bank = small.bank(small.boxes(measured=measured), store="a.lamp")
    assert bank.measured_by == {"length": f"{tmp_path}/here/length.measure:length"}
    monkeypatch.chdir(tmp_path)
    told_by_file(tmp_path, change=1.0)
    assert run(bank, ()).check("drift.length").value == pytest.approx(0, abs=1e-6)
    identity = Task.of(Study(bank, TARGET), small.plugins()).identity
    shutil.move(tmp_path / "here", tmp_path / "there")
    moved = lampopt.load_bank(tmp_path / "there" / "a.lamp")
    assert moved.measured_by == {"length": f"{tmp_path}/there/length.measure:length"}
    assert run(moved, ()).accepted
    assert Task.of(Study(moved, TARGET), small.plugins()).identity == identity


def test_a_learned_measure_that_lies_elsewhere_stays_there(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    bank, file = told_by_file(tmp_path)
    lampopt.store_bank(bank, tmp_path / "here" / "a.lamp")
    shutil.move(tmp_path / "here", tmp_path / "there")
    assert lampopt.load_bank(tmp_path / "there" / "a.lamp").measured_by == {"length": f"{file}:length"}


def test_where_a_file_is_named_from_makes_no_other_design(bank, tmp_path, monkeypatch):
    told_by_file(tmp_path)
    monkeypatch.chdir(tmp_path)
    study = Study(bank, TARGET, measures={"drawn": Spec("learned", file="length.measure")})
    whole = replace(study, measures={"drawn": Spec("learned", file=str(tmp_path / "length.measure"))})
    one, other = (Task.of(each, small.plugins()).identity for each in (study, whole))
    assert one == other
    there, here = (offered("measure", Spec("size", file=file), small.plugins()) for file in ("x", f"{tmp_path}/x"))
    assert there == here


class Choice(StrEnum):
    A = "a"


def test_options_are_plain_values():
    found = Spec("kkt", ridge=np.float64(1e-6), kind=Choice.A, on=True)
    assert repr(found) == "Spec('kkt', kind='a', on=True, ridge=1e-06)"


@dataclass(frozen=True)
class Side:
    side: str = "left"
    names, units = ("x",), ("L",)

    def __call__(self, mesh):
        return mesh.extents[:1]


def test_an_object_is_told_by_its_options_not_by_how_they_are_held():
    """Equal texts may be one object here and two in the next process."""
    assert given(Side("side")) == given(Side("".join(["si", "de"]))) != given(Side("left"))


class Made(list):
    """Holds its options where pickles of most objects have none."""

    names, units = ("x",), ("L",)

    def __init__(self, times, items=(), state=None):
        super().__init__(items)
        self.times, self.state = times, state

    def __reduce__(self):
        return (Made, (self.times, list(self))) if self.state is None else (Made, (self.times,), {"state": self.state})

    def __call__(self, mesh):
        return self.times * mesh.extents[:1]


class Listed(list):
    """Holds an option, and more as a list does."""

    names, units, times = ("x",), ("L",), 1.0

    def __init__(self, *items):
        super().__init__(items)
        self.times = 2.0

    def __call__(self, mesh):
        return self.times * mesh.extents[:1]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Listed(1), Listed(2)),
        (Made(1), Made(2)),
        (Made(1, state="s"), Made(2, state="s")),
        (Made(1, [1]), Made(1, [2])),
        (Side("a"), Side("b")),
    ],
)
def test_whatever_an_object_is_made_of_tells_it(one, other):
    assert given(one) == given(copy.deepcopy(one)) != given(other)


def test_a_learned_address_is_said_where_it_is_wrong(tmp_path):
    _, file = told_by_file(tmp_path)
    with pytest.raises(InputError, match=r"one of .*length\.measure:length"):
        small.bank(small.boxes(measured={"length": f"{file}:width"}))
    with pytest.raises(InputError, match=r"or .file:value. of a learned one"):
        small.bank(small.boxes(measured={"length": ":length"}))


def test_what_a_measure_keeps_of_its_own_work_makes_it_no_other():
    """Nor does the order of a set, which is another in each process."""

    @dataclass(frozen=True)
    class Keeps:
        names: tuple = ("a",)
        units: tuple = ("",)
        words: frozenset = frozenset({"one", "two", "three"})
        mesh: object = field(default_factory=lambda: shapes.box([1, 1, 1]))

        @cached_property
        def dear(self):
            return 5.0

        def __call__(self, mesh):
            return np.array([self.dear])

    made = Keeps()
    before = given(made)
    made(None)
    _ = made.mesh.area, made.mesh.is_watertight
    assert given(made) == before == given(Keeps(words=frozenset({"three", "two", "one"})))
    assert given(Keeps(words=frozenset({"one"}))) != before
    assert given(Keeps(mesh=shapes.box([1, 1, 1.001]))) != before
