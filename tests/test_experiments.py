"""Plans of targets: what each method promises in closed form, and that a grown plan computes only what is new."""

import itertools
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Experiments, Study
from lampopt.errors import InputError, StudyError
from lampopt.experiments import METHODS

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

RANGES = {"length": (2.1, 2.9), "width": (1.05, 1.35)}
DRAWN = METHODS[:-1]


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured={"length": "size.length"}))


def shares(bank, count, method, **options):
    """Where in its range each value lies (count, 2), from 0 to 1."""
    tables = lampopt.experiments(bank, RANGES, count, method=method, **options)
    low, high = np.array(list(RANGES.values())).T
    assert all(list(table) == list(RANGES) for table in tables)
    return (np.array([list(table.values()) for table in tables]) - low) / (high - low)


def cells(values, count):
    """How many values fall into each of `count` equal parts of [0, 1]."""
    return np.bincount(np.floor(values * count).astype(int), minlength=count).tolist()


# what the methods promise


@pytest.mark.parametrize("count", [1, 7, 64, 100])
@pytest.mark.parametrize("seed", [0, 5])
def test_a_latin_hypercube_has_one_target_in_every_part_of_every_range(bank, count, seed):
    for column in shares(bank, count, "latin-hypercube", seed=seed).T:
        assert cells(column, count) == [1] * count


@pytest.mark.parametrize("m", [1, 4, 6])
def test_a_sobol_plan_of_a_power_of_two_is_a_net(bank, m):
    """A (0, m, 2)-net in base 2: each dyadic box of volume 2^-m has one of the 2^m points."""
    x, y = shares(bank, 2**m, "sobol").T
    for k in range(m + 1):
        box = np.floor(x * 2**k) * 2 ** (m - k) + np.floor(y * 2 ** (m - k))
        assert sorted(box.astype(int)) == list(range(2**m))


def test_a_halton_plan_fills_each_range_by_its_prime(bank):
    """One point in each part: of 2^k for the first name, of 3^k for the second."""
    for k in range(1, 6):
        assert cells(shares(bank, 2**k, "halton")[:, 0], 2**k) == [1] * 2**k
        assert cells(shares(bank, 3**k, "halton")[:, 1], 3**k) == [1] * 3**k


def test_random_targets_are_uniform(bank):
    found = shares(bank, 20_000, "random")
    assert found.mean(axis=0) == pytest.approx([1 / 2, 1 / 2], abs=5 / np.sqrt(12 * 20_000))  # 5 standard errors
    assert np.cov(found.T) == pytest.approx(np.eye(2) / 12, abs=0.003)


def test_corners_are_all_of_them_in_the_order_of_a_sweep(bank):
    ranges = {"width": (1.1, "1300 mm"), "length": (2, 3), "drag": (0.3, 0.36)}
    found = lampopt.experiments(bank, ranges, method="corners")
    assert found == [
        {"width": width, "length": length, "drag": drag}
        for width, length, drag in itertools.product((1.1, 1.3), (2.0, 3.0), (0.3, 0.36))
    ]


@pytest.mark.parametrize("method", DRAWN)
def test_every_target_is_within_its_range(bank, method):
    found = shares(bank, 300, method)
    assert len(found) == 300
    assert (found >= 0).all() and (found <= 1).all()
    assert np.ptp(found, axis=0) == pytest.approx([1, 1], abs=0.02)


@pytest.mark.parametrize("method", DRAWN)
def test_the_same_seed_gives_the_same_plan_and_another_one_another(bank, method):
    one, two, other = (lampopt.experiments(bank, RANGES, 12, method=method, seed=seed) for seed in (3, 3, 4))
    assert one == two
    assert one != other


@pytest.mark.parametrize("method", DRAWN)
def test_the_order_in_which_ranges_are_written_does_not_matter(bank, method):
    turned = dict(reversed(RANGES.items()))
    assert lampopt.experiments(bank, RANGES, 12, method=method) == lampopt.experiments(bank, turned, 12, method=method)
    assert Experiments(RANGES, 12, method) == Experiments(turned, 12, method)


@pytest.mark.parametrize(("method", "continues"), [("sobol", 1), ("halton", 1), ("random", 1), ("latin-hypercube", 0)])
@pytest.mark.parametrize(("few", "many"), [(1, 2), (5, 64), (64, 65), (37, 300)])
def test_a_larger_plan_begins_with_the_smaller_where_the_method_allows(bank, method, continues, few, many):
    before, after = (lampopt.experiments(bank, RANGES, count, method=method) for count in (few, many))
    assert sum(one == two for one, two in zip(before, after[:few], strict=True)) == few * continues


def test_units_are_brought_to_the_banks(bank):
    told = {"length": ("2100 mm", "290 cm"), "width": (np.float32(1.0), "1.25"), "size.length": ("2.0 m", 3)}
    plain = {"length": (2.1, 2.9), "width": (1.0, 1.25), "size.length": (2.0, 3.0)}
    one, two = (lampopt.experiments(bank, ranges, 9) for ranges in (told, plain))
    for first, second in zip(one, two, strict=True):
        assert first == pytest.approx(second)
        assert all(type(value) is float for value in first.values())


def test_the_bank_may_be_a_file(bank, tmp_path):
    lampopt.store_bank(bank, tmp_path / "a.lamp")
    assert lampopt.experiments(tmp_path / "a.lamp", RANGES, 5) == lampopt.experiments(bank, RANGES, 5)


# what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (({}, 5), "experiments: ranges: expected a low and a high value by name, got none"),
        ((["length"], 5), "experiments: ranges: expected a table of names and values"),
        (({"length": 2.1}, 5), "experiments: ranges: length: expected a list of values, got 2.1"),
        (({"length": (2.1, 2.5, 2.9)}, 5), "ranges: length: expected a low and a high value, got 3 values"),
        (({"length": (2.1, None)}, 5), "ranges: length: expected numbers or text such as '1420 mm', got None"),
        (({"length": (2.9, 2.1)}, 5), "length: expected a low value below a high one, got 2.9 and 2.1 m: what is held"),
        (({"length": (2.1, "2100 mm")}, 5), "length: expected a low value below a high one, got 2.1 and 2.1 m"),
        (({"drag": (0.3, 0.3)}, 5), "drag: expected a low value below a high one, got 0.3 and 0.3: what is held"),
        (({"length": (2.1, "3 kg")}, 5), r"experiments: length: cannot bring \[kg\] to \[m\]"),
        (({"length": (2.1, float("inf"))}, 5), "experiments: length: expected a finite number"),
        (({"roof": (1, 2)}, 5), "'roof': neither a parameter, a label nor a measured value; known are length, width"),
        ((RANGES, None), "count: expected a whole number from 1 to 100,000 for latin-hypercube, got None"),
        ((RANGES, 0), "count: expected a whole number from 1"),
        ((RANGES, 100_001), "count: expected a whole number from 1"),
        ((RANGES, 8.0), "count: expected a whole number from 1"),
        ((RANGES, True), "count: expected a whole number from 1"),
        ((RANGES, 5, "lhs"), "method: expected one of latin-hypercube, sobol, halton, random, corners, got 'lhs'"),
        ((RANGES, 5, ["sobol"]), "method: expected one of"),
        ((RANGES, 4, "corners"), r"count: expected none, for corners are all 2\^d, got 4"),
        (({f"p{i}": (0, 1) for i in range(17)}, None, "corners"), "17 ranges have more than 100,000 corners"),
        ((RANGES, 5, "sobol", -1), r"seed: expected a whole number of at least 0 and below 2\*\*63, got -1"),
        ((RANGES, 5, "sobol", 0.5), "seed: expected a whole number"),
    ],
)
def test_what_is_no_plan_is_refused(bank, arguments, message):
    ranges, count, *rest = arguments
    options = dict(zip(("method", "seed"), rest, strict=False))
    with pytest.raises(InputError, match=message):
        lampopt.experiments(bank, ranges, count, **options)


def test_what_is_no_bank_is_refused():
    with pytest.raises(StudyError, match=r"bank: expected a Bank or the path of a \.lamp file, got 5"):
        lampopt.experiments(5, RANGES, 5)


def test_what_no_mix_can_change_is_refused():
    same = small.boxes()
    same = replace(same, parameters=same.parameters * (1, 0) + (0, 1.2))
    with pytest.raises(StudyError, match=r"'width': all exemplars have 1\.2 m: no mix can change it"):
        lampopt.experiments(small.bank(same), RANGES, 5)


# as part of a study


def test_a_plan_is_a_record():
    ranges = {"length": [2.1, 2.9]}
    plan = Experiments(ranges, np.int64(8), "sobol", np.int64(1))
    ranges["width"] = (1, 2)
    assert plan == Experiments({"length": (2.1, 2.9)}, 8, "sobol", 1)
    assert len({plan, Experiments({"length": (2.1, 2.9)}, 8, "sobol", 1)}) == 1
    assert pickle.loads(pickle.dumps(plan)) == plan
    with pytest.raises(TypeError):
        plan.ranges["width"] = (1, 2)


@pytest.mark.parametrize(
    "plan",
    [
        Experiments({"roof": (1.30, "1420 mm"), "ra mp": (8, 16)}, 64, "sobol", 3),
        Experiments({"roof": (1.30, 1.42)}, 5),
        Experiments({"roof": (1.30, 1.42)}, method="corners"),
    ],
)
def test_toml_gives_the_plan_back(plan):
    study = Study("a.lamp", experiments=plan)
    back = Study.from_toml(study.to_toml())
    assert back.experiments == plan
    assert list(back.experiments.ranges) == list(plan.ranges)
    assert not back.sweep


def test_a_plan_as_people_write_it():
    study = Study.from_toml('bank = "a.lamp"\n[experiments]\ncount = 64\nranges = { roof = [1.30, 1.42] }\n')
    assert study.experiments == Experiments({"roof": (1.30, 1.42)}, 64, "latin-hypercube", 0)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (
            "experiments = 5",
            "experiments: expected a table with ranges, and count, method and seed where .* got 5",
        ),
        ("experiments = { count = 5 }", "experiments: expected a table with ranges"),
        ("experiments = { ranges = {}, design = 'lhs' }", "experiments: expected a table with ranges"),
        ("experiments = { ranges = 5 }", "experiments: ranges: expected a table of names and values, got 5"),
        ("experiments = { ranges = { a = [1, 2] }, count = '5' }", "count: expected a whole number .* got '5'"),
        ("sweep = { a = [1] }\nexperiments = { ranges = { b = [1, 2] }, count = 5 }", "expected one of them, got both"),
    ],
)
def test_toml_that_is_no_plan_is_refused(toml, message):
    with pytest.raises(StudyError, match=message):
        Study.from_toml(f"bank = 'a'\n{toml}")


def test_what_is_no_plan_has_no_place_in_a_study():
    with pytest.raises(StudyError, match=r"experiments: expected Experiments\(ranges, count\), got \{'a': \(1, 2\)\}"):
        Study("a.lamp", experiments={"a": (1, 2)})
    with pytest.raises(StudyError, match="sweep and experiments: expected one of them, got both: leave one out"):
        Study("a.lamp", sweep={"a": [1]}, experiments=Experiments({"b": (1, 2)}, 5))


def sweep(study, grid=None, folder=None):
    return [dict(r.design.target) for r in lampopt.sweep(study, grid, folder, report=False, plugins=small.plugins())]


def test_a_sweep_makes_the_plan_of_its_study(bank):
    plan = Experiments({"length": (2.1, 2.9)}, 6, "halton", 2)
    study = Study(bank, targets={"length": 2.0, "width": 1.2}, experiments=plan, level="alpha")
    planned = lampopt.experiments(bank, plan.ranges, 6, method="halton", seed=2)
    assert sweep(study) == [{"length": table["length"], "width": 1.2} for table in planned]
    assert sweep(study, planned) == sweep(study)  # as a list of tables it is the same sweep
    assert sweep(study, {"length": [2.5]}) == [{"length": 2.5, "width": 1.2}]  # a grid takes the plan's place


def test_a_plan_that_contradicts_its_study_is_refused_before_anything_is_computed(bank, tmp_path):
    plan = Experiments({"length": (2.1, 2.9)}, 6)
    with pytest.raises(StudyError, match="'length' is asked for twice"):
        sweep(Study(bank, keep=("length",), experiments=plan), None, tmp_path / "run")
    with pytest.raises(StudyError, match="'roof': neither a parameter"):
        sweep(Study(bank, experiments=Experiments({"roof": (1, 2)}, 6)), None, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_plan_that_has_grown_computes_only_what_is_new(bank, tmp_path):
    plan = Experiments(RANGES, 5, "sobol")
    study = Study(bank, experiments=plan, level="mesh")
    small.CALLS.clear()
    first = sweep(study, None, tmp_path)
    assert small.CALLS["decode"] == 5
    grown = sweep(replace(study, experiments=replace(plan, count=8)), None, tmp_path)
    assert small.CALLS["decode"] == 8
    assert grown[:5] == first
    kept = Study.read(tmp_path / "study.toml")  # the folder knows its plan: the same sweep is made of it again
    assert kept.experiments == replace(plan, count=8)
    assert sweep(kept, None, tmp_path) == grown
    assert [dict(r.design.target) for r in lampopt.results(tmp_path, plugins=small.plugins())] == grown
    assert small.CALLS["decode"] == 8
