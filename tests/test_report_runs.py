"""What a report draws of a run as a whole: parallel coordinates, what is traded for what, how a search converged."""

import importlib
import math
import re
import sys
from dataclasses import replace
from html import escape
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt.pareto import knee, pareto
from lampopt.plugins import Plugins
from lampopt.reporting import charts, write, write_report
from lampopt.reporting.convergence import bests, converged, convergence
from lampopt.reporting.gather import Evaluation, Gathered, Line, gather
from lampopt.reporting.parallel import LOW, TOP, Axis, Strand, parallel, parallel_coordinates
from lampopt.reporting.quantities import Quantity, judged, measured, objective
from lampopt.reporting.searched import Search, searched
from lampopt.reporting.trade import Traded, trade, traded
from lampopt.types import Check

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
small = importlib.import_module("small")
HOSTILE = "</title><script>alert(1)</script>\"'&"
NAN, INF = float("nan"), float("inf")
LENGTHS = (1.8, 2.2, 2.6, 3.0, 3.4)


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured={"length": "extents.length", "width": "extents.width"}))


@pytest.fixture(scope="module")
def study(bank):
    return lampopt.Study(bank, sweep={"length": LENGTHS}, reference="box_3", resolution=16, measures=("extents",))


@pytest.fixture(scope="module")
def results(study):
    return list(lampopt.sweep(study, plugins=small.plugins()))


def drawing(svg):
    """An SVG as a browser reads it, which has to be sound XML, and says what it is."""
    root = ElementTree.fromstring(str(svg))
    assert root.tag == "svg"
    assert root.get("role") == "img"
    assert root.find("title").text == root.get("aria-label")
    assert root.find("desc").text
    assert not re.search(r"nan|inf", re.sub(r">[^<]*<", "><", str(svg)).replace("infeasible", ""))
    assert "script" not in {part.tag for part in root.iter()}
    return root


def having(root, kind):
    """The parts of class `kind`, by document order."""
    return [part for part in root.iter() if kind in (part.get("class") or "").split()]


def corners(way):
    """The pieces of a path, each (n, 2)."""
    pieces = [piece.removesuffix("h0") for piece in way.split("M")[1:]]
    return [np.array([[float(v) for v in point.split()] for point in piece.split("L")]) for piece in pieces]


def words(root):
    return [part.text for part in root.iter("text")]


def made(number, *, x=1.0, y=1.0, good=True, error=0.0, mismatch=None, values=(), target=None, predicted=None):
    """A line of a run: distance x, measured size y, unless `values` tell more."""
    checks = {"target": Check("target", error, "<=", 0.02, "half range", "alpha"), "alpha": _alpha(x)}
    if mismatch is not None:
        checks["mismatch"] = Check("mismatch", mismatch, "<=", 0.01, "box", "field")
    told = {"size.volume": (y, "m^3"), **dict(values)}
    failed = () if good else ("odd",)
    return Line(number, target or {}, predicted or {}, good, failed, "odd", 0.5 if good else 2.0, told, checks)


def _alpha(x):
    return Check("alpha", x, "<=", 3.0, "", "alpha")


def run(lines, shown=()):
    return Gathered(tuple(lines), dict.fromkeys(shown))


# Quantities


def test_what_is_not_finite_is_not_known():
    found = Quantity.of("a", "m", "asked", [1.0, NAN, INF, -INF, 1e200, -3.0])
    assert found.known.tolist() == [True, False, False, False, False, True]
    assert (found.low, found.high, found.common, found.label) == (-3.0, 1.0, False, "a [m]")
    assert not Quantity.of("a", "", "asked", []).tells
    assert not Quantity.of("a", "", "asked", [NAN, NAN]).tells


def test_rounding_does_not_tell_designs_apart():
    assert Quantity.of("a", "", "asked", [1.2, 1.3]).tells
    assert not Quantity.of("a", "", "asked", [1.2, 1.2]).tells
    assert not Quantity.of("a", "", "measured", [1.2, float(np.float32(1.2))]).tells
    assert not Quantity.of("a", "", "measured", [0.0, 1e-15]).tells
    assert Quantity.of("a", "", "judged", [0.0, 1e-3], 0.02).tells
    assert not Quantity.of("a", "", "judged", [0.0, 1e-5], 0.02).tells


def test_quantities_are_what_the_checks_found(bank, study, results):
    lines = gather(results, bank, 100).lines
    (length, width, height) = measured(lines)
    assert [q.label for q in (length, width, height)] == [
        "extents.length [m]",
        "extents.width [m]",
        "extents.height [m]",
    ]
    assert length.values == pytest.approx(LENGTHS)
    distance = judged(lines, "alpha")
    assert distance.values.tolist() == [next(c.value for c in r.checks if c.name == "alpha") for r in results]
    assert distance.limit == 3.0
    assert objective(study, bank, lines) is None


def test_values_in_another_unit_are_not_compared():
    lines = [made(1), made(2, values={"size.volume": (3.0, "mm^3")}), made(3, y=2.0)]
    assert measured(lines)[0].values.tolist()[::2] == [1.0, 2.0]
    assert measured(lines)[0].known.tolist() == [True, False, True]


# Parallel coordinates


@given(
    rows=st.lists(
        st.tuples(*[st.one_of(st.floats(-1e9, 1e9), st.just(NAN), st.integers(-2, 2).map(float))] * 3),
        min_size=1,
        max_size=9,
    )
)
@settings(deadline=None)
def test_a_line_is_where_its_values_are(rows):
    """Every corner of every line tells its value back, and gaps are gaps."""
    columns = [[v for v in column if v == v] or [0.0] for column in zip(*rows, strict=True)]
    axes = [Axis(f"a{i}", "asked", min(c), max(c), "m") for i, c in enumerate(columns)]
    strands = [Strand(row, "ok" if i % 2 else "bad", f"d{i}", f"t{i}") for i, row in enumerate(rows)]
    root = drawing(parallel_coordinates(axes, strands, "title", "said"))
    places = [float(part.get("x1")) for part in having(root, "axis")]
    assert np.diff(places) == pytest.approx(places[1] - places[0])
    found = {part.get("data-key"): part for part in having(root, "strand")}
    for i, row in enumerate(rows):
        if all(v != v for v in row):
            assert f"d{i}" not in found
            continue
        points = np.concatenate(corners(found[f"d{i}"].find("path").get("d")))
        known = [k for k, v in enumerate(row) if v == v]
        assert points[:, 0] == pytest.approx([places[k] for k in known], abs=0.06)
        for k, y in zip(known, points[:, 1], strict=True):
            low, high = axes[k].low, axes[k].high
            share = (LOW - y) / (LOW - TOP)
            wanted = (row[k] - low) / (high - low) if high > low else 0.5
            assert share == pytest.approx(wanted, abs=0.001)


def test_gaps_stay_open():
    axes = [Axis(name, "asked", 0.0, 1.0) for name in "abcde"]
    pieces = {
        (0.0, 1.0, NAN, 1.0, 0.0): [2, 2],
        (0.5, NAN, 0.5, NAN, 0.5): [1, 1, 1],
        (NAN, 0.1, 0.2, 0.3, NAN): [3],
        (NAN,) * 5: [],
    }
    for values, lengths in pieces.items():
        root = drawing(parallel_coordinates(axes, [Strand(values, "ok", "", "")], "title", "said"))
        ways = [corners(part.get("d")) for part in having(root, "way")]
        assert [len(piece) for way in ways for piece in way] == lengths
        assert len(having(root, "strand")) == bool(lengths)


def test_accepted_and_rejected_differ_in_more_than_colour():
    axes = [Axis("a", "asked", 0.0, 1.0), Axis("b", "judged", 0.0, 1.0)]
    strands = [Strand((0.0, 1.0), "ok", "d1", "one"), Strand((1.0, 0.0), "bad", "d2", "two")]
    root = drawing(parallel_coordinates(axes, strands, "title", "said"))
    rejected, accepted = having(root, "strand")  # the accepted on top
    assert (accepted.get("data-key"), rejected.get("data-key")) == ("d1", "d2")
    assert [part.tag for part in accepted] == ["path", "circle", "title"]
    assert [part.tag for part in rejected] == ["path", "path", "title"]
    style = Path(charts.__file__).with_name("page.css").read_text(encoding="utf-8")
    assert re.search(r"\.strand\.bad \.way \{[^}]*stroke-dasharray", style)


def test_one_design_and_axes_on_which_all_are_alike():
    axes = [Axis("a", "asked", 2.0, 2.0, "m"), Axis("b", "judged", 0.0, 0.0)]
    root = drawing(parallel_coordinates(axes, [Strand((2.0, 0.0), "ok", "d1", "t")], "title", "said"))
    ((points,),) = [corners(part.get("d")) for part in having(root, "way")]
    assert points[:, 1] == pytest.approx([(LOW + TOP) / 2] * 2)
    assert words(root).count("2 m") == 1
    assert drawing(parallel_coordinates(axes[:1], [], "title", "said")) is not None


def test_ends_have_numbers_and_units():
    axes = [
        Axis("length", "asked", 1.8, 3.4, "m"),
        Axis("near", "measured", 1.00001, 1.00002, "m"),
        Axis("mismatch", "judged", 1e-5, 0.1, "box", 0.01, True),
    ]
    root = drawing(parallel_coordinates(axes, [], "title", "said"))
    assert {"length", "1.8 m", "3.4 m", "1.00001 m", "1.00002 m", "mismatch (log)", "1e−5 box", "0.1 box"} <= {
        *words(root)
    }
    assert [text for text in words(root) if text in ("asked", "measured", "judged")] == ["asked", "measured", "judged"]
    (limit,) = having(root, "crossbar")
    assert (LOW - float(limit.get("y1"))) / (LOW - TOP) == pytest.approx(0.75, abs=1e-3)  # three decades of four
    assert "mismatch: the limit is 0.01 box" in [part.text for part in root.iter("title")]


@pytest.mark.parametrize("count", [1, 2, 3, 7, 10])
def test_names_and_numbers_of_axes_do_not_meet(count):
    """Whatever they are: long names are cut, and stand on two levels. The browser's own look is in report_opened."""
    axes = [Axis(f"{'long name ' * 9}{i}", "asked", -1.2345e-6, 1e6, "kg/m^3") for i in range(count)]
    root = drawing(parallel_coordinates(axes, [], "title", "said"))
    boxes = [(float(t.get("x")), float(t.get("y")), len(t.text) * 6.3) for t in root.iter("text")]
    wide = float(root.get("viewBox").split()[2])
    for i, (x, y, long) in enumerate(boxes):
        assert x - long / 2 >= 0
        assert x + long / 2 <= wide
        assert all(abs(y - v) > 10 or abs(x - u) > (long + w) / 2 for u, v, w in boxes[:i])
    assert all(f"{axis.name} [kg/m^3]" in [part.text for part in root.iter("title")] for axis in axes)


def test_axes_are_asked_measured_and_judged(bank, study):
    study = replace(study, reference=None)  # with a reference the width would be the same for all
    results = list(lampopt.sweep(study, plugins=small.plugins()))
    found = gather(results, bank, 100)
    told = parallel(study, bank, found, found.shown)
    root = drawing(told["svg"])
    names = [part.text for part in having(root, "label")]
    assert names == ["length", "extents.length", "extents.width", "‖alpha − centre‖", "worst / limit"]
    assert "All 5 designs are drawn." in told["said"]
    assert "the same for all: extents.height 0.8 m" in told["said"]
    ways = {part.get("data-key"): corners(part.find("path").get("d"))[0] for part in having(root, "strand")}
    for number, result in enumerate(results, 1):
        values = {check.name: check.value for check in result.checks}
        wanted = [
            [result.design.target["length"] for result in results],
            *([next(c.value for c in r.checks if c.name == name) for r in results] for name in names[1:3]),
            [next(c.value for c in r.checks if c.name == "alpha") for r in results],
            [result.score for result in results],
        ]
        mine = [
            result.design.target["length"],
            values["extents.length"],
            values["extents.width"],
            values["alpha"],
            result.score,
        ]
        heights = [(v - min(all_)) / (max(all_) - min(all_)) for v, all_ in zip(mine, wanted, strict=True)]
        assert (LOW - ways[f"d{number}"][:, 1]) / (LOW - TOP) == pytest.approx(heights, abs=1e-3)
        assert f"design {number}: length {charts.number(mine[0])} m; extents.length" in told["svg"]


def test_five_thousand_designs_are_few_lines_and_small(bank, study):
    rng = np.random.default_rng(0)
    lines = [
        made(
            i,
            x=float(rng.uniform(0, 4)),
            good=bool(rng.random() < 0.3),
            mismatch=float(rng.uniform(0, 0.02)),
            target={"length": float(rng.uniform(1, 4)), "width": float(rng.uniform(1, 2))},
            values={f"extents.{name}": (float(rng.uniform(1, 4)), "m") for name in ("length", "width", "height")},
        )
        for i in range(1, 5001)
    ]
    found = run(lines, shown=range(1, 5001, 50))
    told = parallel(study, bank, found, found.shown)
    assert len(told["svg"]) < 150_000
    strands = having(drawing(told["svg"]), "strand")
    assert len(strands) == 400
    assert {s.get("data-key") for s in strands if s.get("data-key")} == {f"d{n}" for n in range(1, 5001, 50)}
    assert (
        "400 of 5,000 designs are drawn: those of the gallery, then others evenly spread over the run." in told["said"]
    )
    numbers = sorted(int(s.find("title").text.split(":")[0].removeprefix("design ")) for s in strands)
    assert np.diff(numbers).max() < 30
    told = trade(study, bank, found, found.shown)
    assert len(told["svg"]) < 400_000
    assert "1,500 of the" in told["said"]


def test_what_is_left_out_is_said(bank, study):
    lines = [made(1, x=1.0, y=NAN), made(2, x=2.0, y=5.0), made(3, x=INF, y=6.0), made(4, x=3.0, y=6.0)]
    lines = [*lines, made(5, x=2.5, y=7.0, values={"rare.value": (1.0, "m")})]
    found = run([replace(line, target={"length": 2.5}) for line in lines])
    told = parallel(study, bank, found, found.shown)
    assert "2 designs have no finite value on some axis, and a gap there." in told["said"]
    assert "the same for all: length 2.5 m, worst / limit 0.5." in told["said"]
    assert "most designs have no value of it: rare.value." in told["said"]
    many = [
        made(i, x=i / 2, values={f"m.{k}": (float(i + k), "m") for k in range(12)}, target={"length": i / 2})
        for i in (1, 2, 3)
    ]
    told = parallel(study, bank, run(many), {})
    assert len(having(drawing(told["svg"]), "axis")) == 10
    assert "for want of room: m.8, m.9, m.10, m.11." in told["said"]


def test_without_two_things_that_differ_there_is_no_chart(bank, study):
    assert parallel(study, bank, run([made(1)]), {}) is None
    assert parallel(study, bank, run([made(1), made(2)]), {}) is None
    assert parallel(study, bank, run([made(1), made(2, y=2.0)]), {}) is None
    two = parallel(study, bank, run([made(1), made(2, x=1.5, y=2.0)]), {})
    assert len(having(drawing(two["svg"]), "strand")) == 2
    assert trade(study, bank, run([made(1)]), {}) is None
    assert trade(study, bank, run([made(1), made(2)]), {}) is None
    assert trade(study, bank, run([made(1, x=1.0, y=NAN), made(2, x=2.0, y=1.0), made(3, x=NAN, y=3.0)]), {}) is None


# What is traded for what


def test_the_front_is_drawn_where_its_designs_are(bank, study):
    rng = np.random.default_rng(2)
    points = rng.uniform(0.2, 2.8, (60, 2))
    good = rng.random(60) < 0.7
    lines = [
        made(i, x=x, y=y, good=g) for i, ((x, y), g) in enumerate(zip(points.tolist(), good.tolist(), strict=True), 1)
    ]
    told = trade(study, bank, run(lines, shown=(1, 2)), {1: None, 2: None})
    root = drawing(told["svg"])
    front = np.flatnonzero(good)[pareto(points[good])]
    front = front[np.argsort(points[front, 0])]
    (way,) = [corners(part.get("d"))[0] for part in having(root, "front")]
    assert len(way) == len(front) > 3
    to_data = _scales(root)
    assert np.column_stack([to_data[0](way[:, 0]), to_data[1](way[:, 1])]) == pytest.approx(points[front], abs=0.005)
    best = int(np.flatnonzero(good)[knee(points[good])])
    (ring,) = having(root, "knee")
    assert (to_data[0](float(ring.get("cx"))), to_data[1](float(ring.get("cy")))) == pytest.approx(
        points[best], abs=0.005
    )
    assert f"knee: design {best + 1}" in words(root)
    assert f"joins the {len(front)} of {good.sum()} accepted designs" in told["said"]
    assert f"from design {front[0] + 1} to design {front[-1] + 1}. Its knee" in told["said"]
    marks = having(root, "mark")
    assert sum(part.find("circle") is not None for part in marks) == good.sum()
    assert sum(part.find("path") is not None for part in marks) == (~good).sum()
    assert {part.get("data-key") for part in marks} == {None, "d1", "d2"}


def _scales(root):
    """Pixels → values, by the numbers that stand at the grid's lines."""
    frame = [part for part in root.iter("text") if part.get("class") is None]
    across = [(float(t.get("x")), float(t.text.replace("−", "-"))) for t in frame if t.get("text-anchor") == "middle"]
    up = [(float(t.get("y")) - 4, float(t.text.replace("−", "-"))) for t in frame if t.get("text-anchor") == "end"]
    return [np.poly1d(np.polyfit(*np.array(pairs).T, 1)) for pairs in (across, up)]


def test_which_two_are_traded(bank):
    plain = lampopt.Study(bank)
    wants = lampopt.Study(bank, objective=lampopt.Reduce("drag", by=0.1), reference="box_0")
    gains = lampopt.Study(bank, objective=lampopt.Reduce("drag", by=-0.1), reference="box_0")

    def picked(study, **kinds):
        lines = [
            made(i, **{name: values[i - 1] for name, values in {"x": [1.0, 2.0], "y": [5.0, 4.0], **kinds}.items()})
            for i in (1, 2)
        ]
        found = traded(study, bank, lines)
        return None if found is None else [q and q.name for q in (found.x, found.y, found.tint)]

    far, error, off = "‖alpha − centre‖", "largest error", "mismatch"
    drag = {"predicted": [{"drag": 0.3}, {"drag": 0.2}]}
    assert picked(plain) == [far, "size.volume", None]
    assert picked(plain, mismatch=[0.001, 0.002]) == [far, "size.volume", off]
    assert picked(plain, error=[0.01, 0.0]) == [error, far, "size.volume"]
    assert picked(plain, error=[0.01, 0.0], y=[1.0, 1.0], mismatch=[0.001, 0.002]) == [error, far, off]
    assert picked(wants, error=[0.01, 0.0], **drag) == [far, "drag", error]
    assert picked(wants, x=[1.0, 1.0], error=[0.01, 0.0], **drag) == ["drag", error, "size.volume"]
    assert picked(wants, predicted=[{"drag": 0.3}] * 2) == [far, "size.volume", None]
    assert picked(plain, x=[1.0, 1.0]) is None
    lines = [made(i, x=float(x), predicted={"drag": float(y)}) for i, (x, y) in enumerate([(1, 1), (2, 3), (3, 2)], 1)]
    assert traded(wants, bank, lines).front.tolist() == [True, False, False]
    assert traded(gains, bank, lines).front.tolist() == [True, True, False]
    told = trade(gains, bank, run(lines), {})
    assert "less of the former is better, and more of drag" in told["said"]
    assert "drag is as the mix should have it" in told["said"]
    assert "it has no knee" in told["said"]


def test_a_front_of_what_more_is_better_of_bends_the_other_way():
    x, y = [0.0, 0.1, 1.0], [0.0, 0.9, 1.0]
    up = Quantity("y", "", "mixed", np.array(y), more=True)
    found = Traded.of(Quantity.of("x", "", "judged", x), up, None, np.ones(3, bool))
    assert (found.front.tolist(), found.bend) == ([True] * 3, 1)
    assert Traded.of(
        Quantity.of("x", "", "judged", x), Quantity.of("y", "", "mixed", y), None, np.ones(3, bool)
    ).along() == [0]


def test_rejected_designs_far_out_do_not_hide_the_accepted(bank, study):
    lines = [made(1, x=1.0, y=2.0), made(2, x=1.2, y=1.0), made(3, x=1.4, y=3.0, good=False)]
    lines += [made(4, x=900.0, y=1.0, good=False), made(5, x=NAN, y=1.0), made(6, x=2.0, y=INF)]
    told = trade(study, bank, run(lines), {})
    assert len(having(drawing(told["svg"]), "mark")) == 3
    assert "1 design is outside of the picture" in told["said"]
    assert "2 designs are left out, having no finite value of one of both." in told["said"]


def test_fronts_of_none_and_of_one(bank, study):
    bad = [made(i, x=float(i), y=float(i % 2), good=False) for i in range(1, 5)]
    told = trade(study, bank, run(bad), {})
    assert "there is no front" in told["said"]
    assert having(drawing(told["svg"]), "front") == having(drawing(told["svg"]), "knee") == []
    told = trade(study, bank, run([*bad, made(5, x=2.0, y=0.5)]), {})
    assert "Design 5 is better than any other accepted one in both." in told["said"]
    two = trade(study, bank, run([made(1, x=1.0, y=2.0), made(2, x=2.0, y=1.0)]), {})
    assert len(having(drawing(two["svg"]), "mark")) == 2
    assert "from design 1 to design 2; it has no knee." in two["said"]


def test_colour_tells_the_third_quantity_of_the_accepted(bank, study):
    lines = [made(i, x=float(i), y=5.0 - i, mismatch=0.001 * i, good=i != 2) for i in (1, 2, 3, 4)]
    lines.append(made(5, x=2.0, y=3.0))
    told = trade(study, bank, run(lines), {})
    assert told["scale"] == {"name": "mismatch", "low": "0.001 box", "high": "0.004 box"}
    marks = {m.find("title").text.split(":")[0]: m.get("style") for m in having(drawing(told["svg"]), "mark")}
    assert marks == {
        "design 1": "--tint:0%",
        "design 2": None,
        "design 3": "--tint:67%",
        "design 4": "--tint:100%",
        "design 5": None,
    }


def test_a_front_of_thousands_stays_small(bank, study):
    x = np.linspace(0.1, 2.9, 5000)
    lines = [made(i, x=float(a), y=float(1 / a)) for i, a in enumerate(x, 1)]
    told = trade(study, bank, run(lines), {})
    root = drawing(told["svg"])
    assert len(told["svg"]) < 100_000
    assert 300 <= len(having(root, "mark")) <= 301
    assert "joins the 5,000 of 5,000" in told["said"]
    assert re.search(r"beats in both \(30[01] of which are drawn\)", told["said"])
    bend = int(np.abs(x - (0.1 * 2.9) ** 0.5).argmin()) + 1  # there 1/x has the slope of its chord
    assert f"knee: design {bend}" in words(root)


# How a search converged


def test_the_best_so_far_is_the_best_feasible_one():
    values = [5.0, 3.0, 1.0, 4.0, NAN, 2.0, 2.0, -INF, 1.5]
    off = [0.0, 0.0, 0.1, 0.0, 0.0, -1.0, 0.0, 0.0, NAN]
    steps = [Evaluation(i, v, o, 0.5) for i, (v, o) in enumerate(zip(values, off, strict=True), 1)]
    assert [one.number for one in bests(steps)] == [1, 2, 6]
    told = converged(steps, "drag", "N")
    root = drawing(told["svg"])
    marks = having(root, "mark")
    assert sum(part.find("circle") is not None for part in marks) == 5
    assert sum(part.find("path") is not None for part in marks) == 2
    to_data = _scales(root)
    (way,) = [corners(part.get("d"))[0] for part in having(root, "best")]
    found = np.column_stack([to_data[0](way[:, 0]), to_data[1](way[:, 1])])
    assert found == pytest.approx(np.array([[1, 5], [2, 5], [2, 3], [6, 3], [6, 2], [9, 2]]), abs=0.03)
    for mark in marks:
        number, value = re.match(r"evaluation (\d+): (\S+) N", mark.find("title").text).groups()
        if (disc := mark.find("circle")) is not None:
            place = to_data[0](float(disc.get("cx"))), to_data[1](float(disc.get("cy")))
            assert place == pytest.approx((int(number), float(value)), abs=0.03)
    assert "9 evaluations in 4.5 s, 7 of them feasible" in told["said"]
    assert "from 5 N to 2 N, at evaluation 6." in told["said"]
    assert "2 without a finite value are left out." in told["said"]
    assert "best: 2 N, evaluation 6" in words(root)


def test_a_search_over_decades_has_a_logarithmic_axis():
    root = drawing(convergence([Evaluation(i, 10.0**-i, 0.0, 0.1) for i in range(5)], "f", "t", "said"))
    assert {"0.0001", "0.001", "0.01", "0.1", "1"} <= {*words(root)}
    heights = sorted(float(m.find("circle").get("cy")) for m in having(root, "mark"))
    assert np.diff(heights) == pytest.approx(np.diff(heights).mean(), abs=0.11)


def test_a_search_that_came_to_the_smallest_number_there_is_is_drawn():
    root = drawing(converged([Evaluation(1, 1.0, 0.0, 0.1), Evaluation(2, 5e-324, 0.0, 0.1)], "f")["svg"])
    assert len(having(root, "mark")) == 2


def test_searches_of_nothing_and_of_one_step():
    assert converged([], "f") is None
    told = converged([Evaluation(1, NAN, 0.0, 1.0)], "f")
    assert told["svg"] == ""
    assert "1 without a finite value is left out." in told["said"]
    assert "no best" in told["said"]
    root = drawing(converged([Evaluation(7, 0.0, 0.0, NAN)], "f")["svg"])
    assert len(having(root, "mark")) == len(having(root, "best")) == 1
    assert having(drawing(converged([Evaluation(7, 1.0, 2.0, 1.0)], "f")["svg"]), "best") == []


@given(
    st.lists(
        st.builds(Evaluation, st.integers(0, 10**6), st.floats(), st.floats(), st.floats(0, 1e9)),
        max_size=20,
    )
)
@settings(deadline=None, max_examples=200)
def test_any_search_can_be_drawn(steps):
    told = converged(steps, "f")
    if told is not None and told["svg"]:
        assert len(having(drawing(told["svg"]), "mark")) == sum(abs(one.value) < 1e100 for one in steps)


def test_a_search_of_a_hundred_thousand_steps_stays_small():
    steps = [Evaluation(i, 1.0 / (1 + i), 0.0, 0.01) for i in range(100_000)]
    told = converged(steps, "f")
    root = drawing(told["svg"])
    assert len(told["svg"]) < 350_000
    assert len(having(root, "mark")) == 1500
    (way,) = [corners(part.get("d"))[0] for part in having(root, "best")]
    assert len(way) < 1700
    assert (np.diff(way[:, 0]) >= 0).all()
    assert (np.diff(way[:, 1]) >= 0).all()
    assert f"from 1 to {charts.number(steps[-1].value)}" in told["said"]


# In the page


def test_a_page_has_them_in_their_sections(tmp_path, bank, study, results):
    path = write_report(tmp_path, study, bank, results, plugins=small.plugins())
    text = path.read_text(encoding="utf-8")
    assert '<section id="parallel">' in text
    assert '<section id="trade">' in text
    assert '<section id="convergence">' not in text
    one = write_report(tmp_path, study, bank, results[:1], plugins=small.plugins()).read_text(encoding="utf-8")
    assert not re.search(r'<section id="(parallel|trade|convergence)">', one)
    two = write_report(tmp_path, study, bank, results[:2], plugins=small.plugins()).read_text(encoding="utf-8")
    assert '<section id="parallel">' in two


def test_a_run_that_was_searched_has_its_convergence(tmp_path, bank, results, monkeypatch):
    assert searched(tmp_path, lampopt.Study(bank), bank, small.plugins()).steps == ()
    wants = lampopt.Study(bank, objective=lampopt.Reduce("drag", by=0.1), reference="box_0", resolution=16)
    asked = []
    steps = (Evaluation(1, 0.4, 0.0, 1.0), Evaluation(2, 0.3, 0.0, 1.0))
    monkeypatch.setattr(write, "searched", lambda folder, *_: asked.append(folder) or Search(steps, "drag"))
    text = write_report(tmp_path, wants, bank, results[:1], plugins=small.plugins()).read_text(encoding="utf-8")
    assert asked == [tmp_path]
    assert '<section id="convergence">' in text
    assert "The line is the best feasible drag so far: from 0.4 to 0.3, at evaluation 2." in text


def test_hostile_names_and_units_are_words(bank, study):
    values = [{HOSTILE: (float(i), HOSTILE), f"{HOSTILE}.b": (float(i * i), "m")} for i in (1, 2, 3)]
    lines = [made(i, y=1.0, values=values[i - 1], target={HOSTILE: float(i)}, good=False) for i in (1, 2, 3)]
    lines = [replace(line, failed=(HOSTILE,)) for line in lines]
    found = run(lines, shown=(1, 2, 3))
    for told in (parallel(study, bank, found, found.shown), trade(study, bank, found, found.shown)):
        if told is not None:
            assert "<script" not in told["svg"]
            assert escape(HOSTILE) in told["svg"]
            drawing(told["svg"])
    steps = [Evaluation(i, 1.0 / i, 0.0, 1.0) for i in (1, 2)]
    svg = converged(steps, HOSTILE, HOSTILE)["svg"]
    assert "<script" not in svg
    drawing(svg)


def test_ends_are_told_apart():
    assert charts.ends(1.0, 2.0) == ("1", "2")
    assert charts.ends(1.000001, 1.000002) == ("1.000001", "1.000002")
    assert charts.ends(3.0, 3.0) == ("3", "3")
    assert charts.ends(12_345.0, 12_346.0) == ("12,345", "12,346")
    assert charts.ends(12_345.1, 12_345.3) == ("12345.1", "12345.3")
    assert math.isclose(float(charts.ends(0.1, math.nextafter(0.1, 1.0))[1]), 0.1)
    assert charts.shortened("abcdefghij", 4 * charts.LETTER) == "abc…"
    assert charts.shortened("abcd", 4 * charts.LETTER) == "abcd"
    assert charts.shortened("abcd", 0.0) == "…"


def test_designs_of_one_run_may_ask_for_different_names(tmp_path):
    """A measure that only follows its parameter is read back for all of them."""
    exemplars = small.boxes()
    changes = exemplars.parameters - [2.0, 0.0]
    measured = {"length": "extents.length", "width": "extents.width"}
    bank = small.bank(replace(exemplars, parameters=changes), measured=measured, store=tmp_path / "b.lamp")
    for grid in ({"length": [0.3, 0.5]}, {"width": [1.1, 1.2]}):
        [*lampopt.sweep(lampopt.Study(bank), grid, folder=tmp_path / "run", plugins=small.plugins(), report=False)]
    text = lampopt.report(tmp_path / "run", plugins=small.plugins()).read_text(encoding="utf-8")
    assert text.count("R² 1.0000 against the line") == 2


def test_what_is_minimised_is_traded(tmp_path):
    labels = np.array([0.30, 0.34, 0.32, 0.38, 0.33, 0.36, 0.33])[:, None]
    bank, every = small.bank(small.boxes(labels=labels)), Plugins.load([("small", small.Plugin())])
    asked = {"objective": lampopt.Minimise("drag"), "alpha": (-0.5, 1.0), "ridge": 0.1, "level": "alpha"}
    study = lampopt.Study(bank, solver="casadi", reference="box_0", **asked)
    results = lampopt.sweep(study, {"length": [2.1, 2.3, 2.5]}, report=False, plugins=every)
    found = traded(study, bank, gather(results, bank, 9).lines)
    assert [found.x.name, found.y.name] == ["‖alpha − centre‖", "drag"]


def test_what_the_study_declares_measurable_is_shown_as_measured(tmp_path):
    bank, plugins = small.bank(store=tmp_path / "b.lamp"), small.plugins()
    study = lampopt.Study(bank, measured={"length": "size.length"}, measures=("size",), turns=1)
    [*lampopt.sweep(study, {"length": [2.1, 2.3]}, folder=tmp_path / "run", plugins=plugins)]
    text = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "<b>length</b> measured on 2 designs" in text and "is not measured" not in text


def test_a_range_is_shown_in_the_banks_unit(tmp_path):
    every = Plugins.load([("small", small.Plugin())])
    ranges = {"width": ("1100 mm", "1.3 m")}
    study = lampopt.Study(small.bank(), {"length": 2.3}, ranges=ranges, solver="casadi", level="alpha")
    lampopt.run(study, tmp_path, plugins=every)
    assert "between 1.1 and 1.3</td><td>m</td>" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_an_infinite_measurement_does_not_cost_the_report(tmp_path):
    class Odd:
        names, units = ("length",), ("L",)

        def __call__(self, mesh):
            return np.array([np.inf if mesh.extents[0] > 3.2 else mesh.extents[0]])

    class Offer:
        @lampopt.hookimpl
        def lampopt_measures(self):
            return {"odd": Odd}

    plugins = small.plugins(("odd", Offer()))
    bank = small.bank(measured={"length": "odd.length"}, plugins=plugins, store=tmp_path / "b.lamp")
    made = [*lampopt.sweep(lampopt.Study(bank), {"length": [2.3, 3.4]}, folder=tmp_path / "run", plugins=plugins)]
    assert [result.accepted for result in made] == [True, False]
    assert "measured on 1 of 2 designs" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
