"""What is asked, as an object and as TOML: one gives the other, and what cannot be asked is refused in words."""

import sys
from dataclasses import fields, replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lampopt
from lampopt import Experiments, Reduce, Spec, Study
from lampopt.errors import InputError, LampoptError, StudyError
from lampopt.experiments import METHODS
from lampopt.units import factor, number

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402


@pytest.fixture(scope="module")
def bank():
    return small.bank(measured={"length": "size.length"})


def plain(study):
    """Everything a study says, comparable."""
    said = {item.name: getattr(study, item.name) for item in fields(study)}
    said["bank"] = Path(said["bank"].path if isinstance(said["bank"], lampopt.Bank) else said["bank"])
    said["solver"] = (study.solver.name, dict(study.solver.options))
    for name in ("targets", "ranges", "limits", "sweep"):
        said[name] = dict(said[name])
    return said


# TOML

text = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=6)
number_ = st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.integers(-(2**60), 2**60))
value = st.one_of(number_, st.just("1420 mm"), text)
names = st.lists(text, max_size=3, unique=True).map(tuple)
options = st.dictionaries(text.filter(lambda t: t != "name"), st.one_of(number_, st.booleans(), text), max_size=3)


@st.composite
def studies(draw):
    pool = draw(st.lists(text, min_size=6, max_size=6, unique=True))
    objective = draw(st.one_of(st.none(), st.floats(-9.5, 0.99).map(lambda by: Reduce(pool[5], by))))
    ranges = st.dictionaries(text, st.tuples(value, value), min_size=1, max_size=2)
    plan = draw(st.none() | st.builds(Experiments, ranges, st.integers(1, 99), st.sampled_from(METHODS[:-1])))
    targets, keep = {name: draw(value) for name in pool[: draw(st.integers(0, 2))]}, tuple(pool[2:3])
    asked = [*targets, *keep]
    return Study(
        bank=draw(st.sampled_from(["a.lamp", "sub dir/ü.lamp", "/abs/b.lamp", Path("c.lamp")])),
        targets=targets,
        keep=keep,
        reference="r" if objective else draw(st.one_of(st.none(), text)),
        ranges={name: draw(st.tuples(value, value)) for name in pool[3:5]},
        hard=tuple(draw(st.lists(st.sampled_from(asked), unique=True))),
        objective=objective,
        solver=draw(st.one_of(text, st.builds(lambda n, o: Spec(n, **o), text, options))),
        measures=draw(names),
        checks=draw(names) + draw(st.just(()) | st.builds(lambda o: (Spec("with options", **o),), options)),
        limits=draw(st.dictionaries(text, st.floats(0, 1e9), max_size=2)),
        level=draw(st.sampled_from(["alpha", "field", "mesh"])),
        resolution=draw(st.integers(4, 4096)),
        sweep={} if plan else draw(st.dictionaries(text, st.lists(value, min_size=1, max_size=3), max_size=2)),
        experiments=plan,
        format=draw(st.sampled_from(["stl", "obj", "ply", "glb"])),
        requires=draw(names),
        seed=draw(st.integers(0, 2**60)),
    )


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(studies())
def test_toml_gives_the_study_back(study):
    assert plain(Study.from_toml(study.to_toml())) == plain(study)


def test_the_smallest_study_has_the_defaults():
    assert plain(Study.from_toml('bank = "a.lamp"')) == plain(Study("a.lamp"))


def test_numpy_numbers_are_numbers(bank):
    study = Study(
        "a.lamp",
        targets={"length": np.float32(2.5), "width": np.int64(1)},
        ranges={"a": np.array([1, 2])},
        sweep={"length": np.linspace(2, 3, 3)},
    )
    back = Study.from_toml(study.to_toml())
    assert back.asked(bank) == study.asked(bank) == {"length": 2.5, "width": 1.0}
    assert back.ranges == {"a": (1.0, 2.0)}
    assert back.sweep == {"length": (2.0, 2.5, 3.0)}


def test_a_bank_with_a_file_is_named_by_it(tmp_path):
    stored = small.bank(store=tmp_path / "a.lamp")
    back = Study.from_toml(Study(stored).to_toml())
    assert back.bank == tmp_path / "a.lamp"
    assert small.same(back.opened(), stored)


def test_a_relative_bank_is_beside_the_study(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    stored = small.bank(store=tmp_path / "a.lamp")
    (tmp_path / "sub" / "study.toml").write_text('bank = "../a.lamp"\n', encoding="utf-8")
    monkeypatch.chdir("/")
    assert small.same(Study.read(tmp_path / "sub" / "study.toml").opened(), stored)
    assert small.same(Study.from_toml('bank = "a.lamp"', folder=tmp_path).opened(), stored)
    absolute = Study.from_toml(f"bank = '{tmp_path / 'a.lamp'}'", folder=Path("/somewhere/else"))
    assert small.same(absolute.opened(), stored)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("bank = ", "study: not valid TOML"),
        ("seed = " + "9" * 5000, "study: not valid TOML"),
        ("bank = 'a'\nseed = 0x" + "f" * 5000, "seed: expected a whole number"),
        ("bank = 'a'\nlimits = { alpha = 0x" + "f" * 5000 + " }", "limits: alpha: expected a finite number"),
        ("x = " + "[" * 100_000, "study: not valid TOML"),
        ("", "expected an entry `bank`"),
        ("bank = 5", "expected an entry `bank`"),
        (
            "bank = 'a'\ntarget = 1\nmodel = 2",
            "unknown entries model, target; known are alpha, bank, checks, .*targets",
        ),
        ("bank = 'a'\nsolver = { ridge = 1 }", "solver: expected a name, or a table with an entry `name`, got"),
        ("bank = 'a'\nsolver = { name = 5 }", "solver: expected a name, or a table with an entry `name`"),
        ("bank = 'a'\nsolver = { name = 'x', o = [1] }", r"solver: option 'o' of 'x': expected text, a number"),
        ("bank = 'a'\nsolver = 5", "solver: expected a name or a Spec, got 5"),
        ("bank = 'a'\nsolver = ['kkt']", "solver: expected a name or a Spec"),
        ("bank = 'a'\nobjective = 'drag'", "objective: expected { reduce = NAME, by = FRACTION }, .*got 'drag'"),
        ("bank = 'a'\nobjective = { reduce = 'drag' }", "objective: expected { reduce = NAME"),
        ("bank = 'a'\nobjective = { reduce = 'drag', by = 1, x = 2 }", "objective: expected { reduce = NAME"),
        ("bank = 'a'\nobjective = { reduce = 5, by = 0.1 }", "objective: expected { reduce = NAME"),
        ("bank = 'a'\nobjective = { reduce = 'drag', by = '10 %' }", "expected `by` as a fraction below 1"),
        ("bank = 'a'\nranges = { a = [1, 2, 3] }", "ranges: a: expected a low and a high value, got 3 values"),
        ("bank = 'a'\nranges = { a = [1, [2]] }", r"ranges: a: expected numbers or text such as '1420 mm', got \[2\]"),
        ("bank = 'a'\nsweep = { a = [1979-05-27] }", "sweep: a: expected numbers or text"),
        ("bank = 'a'\nsweep = { a = [true] }", "sweep: a: expected numbers or text such as '1420 mm', got True"),
        ("bank = 'a'\nsweep = { a = { b = 1 } }", "sweep: a: expected a list of values"),
        ("bank = 'a'\nlimits = { alpha = nan }", "limits: alpha: expected a finite number of at least 0, got nan"),
    ],
)
def test_toml_that_is_no_study_is_refused(toml, message):
    with pytest.raises(StudyError, match=message):
        Study.from_toml(toml)


def test_a_study_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(StudyError, match=r"missing\.toml: cannot be read as a study"):
        Study.read(tmp_path / "missing.toml")
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StudyError, match=r"a\.toml: cannot be read as a study"):
        Study.read(tmp_path / "a.toml")


def test_a_study_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfbank = 'a.lamp'\n")
    assert Study.read(tmp_path / "a.toml").bank == tmp_path / "a.lamp"


def test_what_toml_cannot_say_is_refused(bank):
    with pytest.raises(StudyError, match="bank: is in no file"):
        Study(bank).to_toml()
    with pytest.raises(StudyError, match="has an option `name`"):
        Study("a.lamp", solver=Spec("x", name="y")).to_toml()


# what is refused when a study is made


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"bank": 5}, "bank: expected a Bank or the path of a .lamp file, got 5"),
        ({"keep": "length"}, "keep: expected a list of names, got 'length'"),
        ({"measures": 5}, "measures: expected a list of names, got 5"),
        ({"checks": [5]}, "checks: expected a list of names"),
        ({"requires": {"a": 1}}, "requires: expected a list of names"),
        ({"measures": ["size", "area", "size"]}, "measures: size twice"),
        ({"targets": ["length"]}, "targets: expected a table of names and values"),
        ({"targets": {1: 2}}, "targets: expected a table of names and values"),
        ({"limits": 5}, "limits: expected a table of names and values"),
        ({"limits": {"alpha": 10**400}}, "limits: alpha: expected a finite number of at least 0, got 1000"),
        ({"seed": 10**400}, "seed: expected a whole number of at least 0 and below"),
        ({"limits": {"alpha": -1}}, "limits: alpha: expected a finite number of at least 0, got -1"),
        ({"limits": {"alpha": float("inf")}}, "limits: alpha: expected a finite number"),
        ({"limits": {"alpha": True}}, "limits: alpha: expected a finite number"),
        ({"limits": {"alpha": "3"}}, "limits: alpha: expected a finite number"),
        ({"ranges": {"a": 5}}, "ranges: a: expected a list of values, got 5"),
        ({"ranges": {"a": "8 to 16"}}, "ranges: a: expected a list of values, got '8 to 16'"),
        ({"ranges": {"a": (1,)}}, "ranges: a: expected a low and a high value, got 1 values"),
        ({"ranges": {"a": (None, 2)}}, "ranges: a: expected numbers or text such as '1420 mm', got None"),
        ({"sweep": {"a": []}}, "sweep: a: expected a list of values, got none"),
        ({"sweep": {"a": [date(2026, 1, 1)]}}, "sweep: a: expected numbers or text"),
        ({"level": "meshes"}, "level: expected one of alpha, field, mesh, got 'meshes'"),
        ({"format": "step"}, "format: expected one of stl, obj, ply, glb, got 'step'"),
        ({"resolution": 3}, "resolution: expected a whole number from 4 to 4096, got 3"),
        ({"resolution": 4097}, "resolution: expected a whole number"),
        ({"resolution": 64.0}, "resolution: expected a whole number"),
        ({"resolution": True}, "resolution: expected a whole number"),
        ({"seed": -1}, r"seed: expected a whole number of at least 0 and below 2\*\*63, got -1"),
        ({"seed": 0.5}, "seed: expected a whole number"),
        ({"solver": None}, "solver: expected a name or a Spec, got None"),
        ({"objective": "drag"}, r"objective: expected Reduce, Minimise or Maximise"),
        ({"objective": Reduce("drag", by=0.1)}, "needs a reference; name an exemplar"),
        ({"targets": {"a": 1}, "keep": ("a",)}, "'a' is asked for twice"),
        ({"targets": {"a": 1}, "ranges": {"a": (0, 1)}}, "'a' is asked for twice"),
        ({"keep": ("a",), "ranges": {"a": (0, 1)}}, "'a' is asked for twice"),
        ({"keep": ("a", "a")}, "keep: a twice"),
        (
            {"targets": {"a": 1}, "objective": Reduce("a", by=0.1), "reference": "r"},
            "'a' is asked for twice: name it in one of targets, keep, ranges and objective",
        ),
        ({"hard": ("a",), "targets": {"b": 1}}, r"hard: \['a'\] are not asked for; asked for are \['b'\]"),
    ],
)
def test_a_study_that_contradicts_itself_is_refused(fields, message):
    with pytest.raises(StudyError, match=message):
        Study(**{"bank": "a.lamp", **fields})


@pytest.mark.parametrize("by", [1, 1.5, -10, float("nan"), "0.1", None])
def test_reduce_by_a_fraction_below_1(by):
    with pytest.raises(StudyError, match=r"Reduce\('drag'\): expected `by` as a fraction below 1, such as 0.10"):
        Reduce("drag", by=by)


def test_less_is_nearer_to_nothing_whatever_the_sign():
    assert Reduce("lift", by=0.1).of(2.0) == pytest.approx(1.8)
    assert Reduce("lift", by=0.1).of(-2.0) == pytest.approx(-1.8)
    assert Reduce("lift", by=-0.1).of(-2.0) == pytest.approx(-2.2)


def test_checks_have_options_as_others_have(tmp_path):
    checks = ["early", Spec("slim", most=2.5)]
    study = Study("a.lamp", checks=checks)
    assert study.checks == ("early", Spec("slim", most=2.5))
    assert 'checks = [\n    "early",\n    { name = "slim", most = 2.5 },\n]' in study.to_toml()
    assert Study.from_toml(study.to_toml()).checks == study.checks
    with pytest.raises(StudyError, match="checks: expected a list of names, or of Spec"):
        Study("a.lamp", checks="slim")
    with pytest.raises(StudyError, match="checks: expected a list of names, or of Spec"):
        Study("a.lamp", checks=[1])
    with pytest.raises(StudyError, match="checks: slim twice"):
        Study("a.lamp", checks=["slim", Spec("slim", most=2.5)])
    with pytest.raises(StudyError, match="option `name`"):
        Study("a.lamp", checks=[Spec("slim", name="x")]).to_toml()


def test_a_checks_file_is_beside_the_study(tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    (tmp_path / "study.toml").write_text("bank = 'a.lamp'\nchecks = ['a', { name = 'wall', file = 'x.txt' }]\n")
    assert Study.read(tmp_path / "study.toml").checks == ("a", Spec("wall", file=f"{tmp_path}/x.txt"))
    monkeypatch.chdir(tmp_path)
    text = Study("a.lamp", checks=[Spec("wall", file="x.txt")]).to_toml()
    assert Study.from_toml(text, folder=Path("/elsewhere")).checks == (Spec("wall", file=f"{tmp_path}/x.txt"),)


def test_a_learned_measures_file_is_beside_the_study(tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    (tmp_path / "study.toml").write_text("bank = 'a.lamp'\n[measured]\na = 'sub/a.measure:a'\nb = 'size.b'\n")
    found = Study.read(tmp_path / "study.toml")
    assert dict(found.measured) == {"a": f"{tmp_path}/sub/a.measure:a", "b": "size.b"}
    monkeypatch.chdir(tmp_path)
    text = Study("a.lamp", measured={"a": "sub/a.measure:a"}).to_toml()
    assert dict(Study.from_toml(text, folder=Path("/elsewhere")).measured) == {"a": f"{tmp_path}/sub/a.measure:a"}


def test_a_study_keeps_what_it_was_given():
    targets = {"a": 1.0}
    study = Study("a.lamp", targets=targets)
    targets["b"] = 2.0
    assert dict(study.targets) == {"a": 1.0}
    with pytest.raises(TypeError):
        study.targets["c"] = 3.0


# what is refused when it meets the bank


def test_asked_is_in_the_banks_units(bank):
    study = Study(
        bank,
        targets={"length": "2600 mm"},
        keep=("width",),
        objective=Reduce("drag", by=0.10),
        reference="box_1",
        hard=("drag",),
    )
    assert study.asked(bank) == pytest.approx({"length": 2.6, "width": 1.4, "drag": 0.9 * 0.34})
    assert list(study.asked(bank)) == ["length", "width", "drag"]
    ranged = Study(bank, ranges={"length": ("210 cm", 2.9), "size.length": (2, "3 m")})
    bounds = ranged.bounds(bank)
    assert list(bounds) == ["length", "size.length"]
    assert np.allclose(list(bounds.values()), [(2.1, 2.9), (2, 3)])


def test_keep_without_a_reference_is_the_mean_of_those_that_have_it(bank):
    asked = Study(bank, keep=("length", "drag")).asked(bank)
    assert asked == pytest.approx({"length": small.LENGTHS.mean(), "drag": np.nanmean(small.DRAG)})


@pytest.mark.parametrize(
    ("study", "message"),
    [
        ({"targets": {"roof": 1}}, "'roof': neither a parameter.*; known are length, width, drag, size.length"),
        ({"keep": ("roof",)}, "'roof': neither a parameter"),
        ({"ranges": {"roof": (0, 1)}}, "'roof': neither a parameter"),
        ({"targets": {"length": "2.6 s"}}, r"length: cannot bring \[s\] to \[m\]"),
        ({"targets": {"length": "long"}}, "length: expected a number or text such as '1420 mm', got 'long'"),
        ({"targets": {"length": "2.6 m("}}, r"length: cannot bring \[m\(\] to \[m\]"),
        ({"targets": {"length": [2.6]}}, "length: expected a finite number or text"),
        ({"targets": {"length": None}}, "length: expected a finite number or text"),
        ({"targets": {"length": True}}, "length: expected a finite number or text"),
        ({"targets": {"length": float("nan")}}, "length: expected a finite number"),
        ({"targets": {"length": "1e999 m"}}, "length: expected a finite number"),
        ({"keep": ("width",), "reference": "box_9"}, "reference 'box_9': no exemplar of this bank; there are box_0"),
        ({"keep": ("drag",), "reference": "box_2"}, "'drag': the reference 'box_2' has no value for it"),
    ],
)
def test_what_the_bank_does_not_have_is_refused(bank, study, message):
    with pytest.raises(InputError, match=message):
        lampopt.run(Study(bank, level="alpha", **study), plugins=small.plugins())


# units


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (1.5, "m", 1.5),
        (2, "", 2.0),
        ("1420 mm", "m", 1.42),
        ("1420mm", "m", 1.42),
        (" -1.5e2  cm ", "m", -1.5),
        ("3", "m", 3.0),
        ("90 deg", "rad", np.pi / 2),
        ("10 %", "", 0.1),
        ("2 m^2", "cm^2", 20000.0),
        ("20 degC", "K", 293.15),
        ("20 degC", "degC", 20.0),
    ],
)
def test_values_are_brought_to_the_unit(value, unit, expected):
    assert number(value, unit, "x") == pytest.approx(expected)


def test_no_factor_between_units_of_different_zeros():
    assert factor("m^2", "cm^2", "x") == pytest.approx(1e4)
    with pytest.raises(InputError, match="different zeros"):
        factor("degC", "K", "x")


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(st.sampled_from("0123456789.eE+-* /^()[]{}'\"mkg%@_,:;=\\\x00\né"), max_size=12))
def test_any_text_is_a_number_or_refused(text):
    try:
        assert isinstance(number(text, "m", "x"), float)
    except LampoptError as error:
        assert str(error).startswith("x: ")


def test_the_largest_sweep_is_read_back_and_what_is_larger_is_not_written(tmp_path):
    values = tuple(np.nextafter(1.0, 2.0) * (1 + i * 1e-5) for i in range(100_000))  # with all their digits
    study = Study("a.lamp", sweep={"length": values})
    (tmp_path / "study.toml").write_text(study.to_toml())
    assert Study.read(tmp_path / "study.toml").sweep["length"] == values
    with pytest.raises(StudyError, match=r"bytes as TOML, of which at most 4,194,304 are read back: sweep parts of it"):
        Study("a.lamp", sweep={"length": [f"{i:040d} mm" for i in range(100_000)]}).to_toml()


def test_what_only_a_sweep_asks_may_be_hard():
    study = Study(small.bank(), hard=("length",), sweep={"length": [2.1, 2.3]}, level="alpha")
    for result, wanted in zip(lampopt.sweep(study, plugins=small.plugins()), (2.1, 2.3), strict=True):
        assert result.design.predicted[0] == pytest.approx(wanted)
    with pytest.raises(StudyError, match=r"hard: \['width'\] are not asked for; asked for are \['length'\]"):
        replace(study, hard=("width",))
