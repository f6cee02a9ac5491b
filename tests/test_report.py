"""The report: what it says is what was found, its pictures show the shapes, nothing in it leads outside."""

import base64
import hashlib
import importlib
import io
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from trimesh import Trimesh, creation, util

import lampopt
from lampopt.errors import InputError
from lampopt.measured import following_ratio
from lampopt.plugins import Plugins
from lampopt.reporting import charts, figures, write_report
from lampopt.reporting.gather import Spread, gather
from lampopt.reporting.layout import laid_out, scaled
from lampopt.reporting.measuring import is_itself, read_back
from lampopt.reporting.render import ABOVE, BELOW, LEVEL, colours, pictures, reach, views
from lampopt.reporting.shapes import drawn, signed_distance, sky_seen, spread_over
from lampopt.reporting.words import check_row
from lampopt.testing import shapes
from lampopt.types import Check, Parameter

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
small = importlib.import_module("small")
HOSTILE = "</script><script>alert(1)</script>\"'&"
LENGTHS = (1.8, 2.2, 2.6, 3.0, 3.4)


class Page(HTMLParser):
    """A report as a browser reads it: its words, scripts, and all that could lead out of it."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.scripts, self.words, self.leads, self.handlers, self._in = [], [], [], [], []
        self.tags = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag in ("script", "style"):
            self._in.append(tag)
        if tag == "script":
            self.scripts.append([dict(attributes), ""])
        for name, value in attributes:
            if name in ("src", "href", "action", "srcset", "data", "data-heat", "poster") and not value.startswith(
                "data:"
            ):
                self.leads.append((tag, name, value))
            if name.startswith("on"):
                self.handlers.append((tag, name))

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._in.pop()

    def handle_data(self, data):
        if not self._in:
            self.words.append(data)
        elif self._in[-1] == "script":
            self.scripts[-1][1] += data

    @property
    def said(self):
        return " ".join(" ".join(self.words).split())

    @property
    def config(self):
        (found,) = (text for given, text in self.scripts if given.get("id") == "config")
        return json.loads(found)


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured={"length": "extents.length", "width": "extents.width"}))


@pytest.fixture(scope="module")
def study(bank):
    return lampopt.Study(bank, sweep={"length": LENGTHS}, reference="box_3", resolution=16, measures=("size",))


@pytest.fixture(scope="module")
def results(study):
    return list(lampopt.sweep(study, plugins=small.plugins()))


def report(folder, study, results, **options):
    return write_report(folder, study, study.opened(), results, plugins=small.plugins(), **options)


@pytest.fixture(scope="module")
def page(tmp_path_factory, study, results):
    path = report(tmp_path_factory.mktemp("boxes"), study, results)
    return Page(path.read_text(encoding="utf-8"))


def pixels(uri):
    data = base64.b64decode(uri.removeprefix("data:image/webp;base64,"))
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))


def box(*extents, centre=(0, 0, 0)):
    return shapes.box(extents, centre=np.asarray(centre, float))


# What is said


def test_verdicts_and_checks_are_all_there(page, results):
    good = sum(result.accepted for result in results)
    assert f"{good} of {len(results)} designs are accepted" in page.said or good in (0, len(results))
    for name in {check.name for result in results for check in result.checks}:
        assert name in page.said
    assert page.said.count("box_3") >= 2  # the reference: of the study, and of the distances
    assert "length" in page.said
    assert "1.8, 2.2, 2.6, 3, 3.4" in page.said


def test_measured_values_meet_what_was_asked(page):
    """A stretched box has exactly the length that it was asked for."""
    assert "measured on 5 designs. R² 1.0000" in page.said


def test_every_design_is_in_the_viewer(page, results):
    meshes = {given["id"]: (given, text) for given, text in page.scripts if given.get("type") == "text/plain"}
    for number in range(1, len(results) + 1):
        given, text = meshes[f"m-d{number}"]
        vertices, faces = int(given["data-vertices"]), int(given["data-faces"])
        assert len(base64.b64decode(text)) == 6 * vertices + 3 * faces * 2 + 4 * vertices + vertices
    assert page.config["designs"]["d1"] == {"title": "Design 1", "reference": "e3", "beside": "box_3"}
    assert "m-e3" in meshes


def test_nothing_leads_outside(page):
    assert page.leads == []
    assert page.handlers == []
    assert [given for given, _ in page.scripts if given.get("src")] == []


def test_the_policy_admits_one_script_and_nothing_from_outside(page):
    """It stands before all that it is to rule."""
    ((place, policy),) = (
        (i, given["content"])
        for i, (_, given) in enumerate(page.tags)
        if given.get("http-equiv") == "Content-Security-Policy"
    )
    assert [tag for tag, _ in page.tags[:place]] == ["html", "head", "meta"]
    (script,) = (text for given, text in page.scripts if not given)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert dict(rule.split(maxsplit=1) for rule in policy.split(";")) == {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": "'unsafe-inline'",
        "script-src": f"'sha256-{digest}'",
    }


def test_the_same_run_gives_the_same_file(tmp_path, study, results):
    once = report(tmp_path, study, results).read_bytes()
    again = report(tmp_path, study, iter(results), out=tmp_path / "again.html").read_bytes()
    assert once == again
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.html", "report.html"]


def test_a_single_design_is_seen_from_four_sides(tmp_path, bank):
    study = lampopt.Study(bank, targets={"length": 2.7}, keep=("width",), reference="box_1", resolution=16)
    found = Page(report(tmp_path, study, [lampopt.run(study, plugins=small.plugins())]).read_text(encoding="utf-8"))
    assert "The design is accepted" in found.said
    for view in ("three-quarter", "side", "front", "top"):
        assert f"{view}, distance to box_1" in found.said
    assert "kept as in box_1" in found.said
    assert "Asked against" not in found.said


def test_why_a_design_is_rejected(tmp_path, bank):
    study = lampopt.Study(bank, targets={"length": 40.0}, resolution=16)
    result = lampopt.run(study, plugins=small.plugins())
    found = Page(report(tmp_path, study, [result]).read_text(encoding="utf-8"))
    assert "The design is rejected" in found.said
    (check,) = (check for check in result.checks if check.name == "alpha")
    assert f"alpha is {charts.number(check.value)}, at most 3 is allowed" in found.said


def test_conflicts_are_told_in_the_parameters_units(tmp_path, bank):
    """Length cannot be 2 by the parameter and 3 by its measurement: each would have to give half a metre."""
    study = lampopt.Study(bank, targets={"length": 2.0, "extents.length": 3.0}, level="alpha")
    result = lampopt.run(study, plugins=small.plugins())
    assert result.design.mix.status == "infeasible"
    found = Page(report(tmp_path, study, [result]).read_text(encoding="utf-8"))
    assert "length 2 → 2.5 m, extents.length 3 → 2.5 m would agree" in found.said


@pytest.mark.parametrize("level", ["alpha", "field"])
def test_no_shape_is_made_for_a_report_of_lesser_levels(tmp_path, bank, level):
    study = lampopt.Study(bank, sweep={"length": LENGTHS}, level=level)
    before = small.CALLS["decode"]
    found = Page(report(tmp_path, study, lampopt.sweep(study, plugins=small.plugins())).read_text(encoding="utf-8"))
    assert small.CALLS["decode"] == before
    assert f"No shape was made: the study judges by {level} alone." in found.said
    assert "Asked against mixed" in found.said
    assert "R² 1.0000" in found.said


def test_a_design_without_surface_is_told(tmp_path, bank):
    study = lampopt.Study(bank, sweep={"length": [2.5, -9.0]}, resolution=16)
    found = Page(report(tmp_path, study, lampopt.sweep(study, plugins=small.plugins())).read_text(encoding="utf-8"))
    assert "no shape: the field has no surface" in found.said
    assert "1 of 2 designs is accepted" in found.said


def test_hostile_names_are_words(tmp_path):
    space = (Parameter("length <b>&\"'", "m"), Parameter("</title><img src onerror><script>alert(1)</script>", "m"))
    plain = small.boxes()
    names = (HOSTILE, "{{ 7 * 7 }}", "</template><svg onload=alert(1)>", *plain.names[3:])
    exemplars = lampopt.Exemplars(plain.parameters, space, plain.meshes, names, unit="m")
    study = lampopt.Study(small.bank(exemplars), sweep={space[0].name: [2.4, 2.5]}, reference=HOSTILE, resolution=16)
    folder = tmp_path / "<i>run"
    folder.mkdir()
    path = report(folder, study, lampopt.sweep(study, plugins=small.plugins()))
    found = Page(path.read_text(encoding="utf-8"))
    assert (found.leads, found.handlers) == ([], [])
    kinds = [given.get("type", "script") for given, _ in found.scripts]
    assert kinds.count("script") == 1
    assert "alert" not in next(text for given, text in found.scripts if not given)
    assert found.config["designs"]["d1"]["beside"] == HOSTILE
    for name in (HOSTILE, "{{ 7 * 7 }}", names[2], *(q.name for q in space), "<i>run"):
        assert name in found.said


def test_a_drawing_that_fails_loses_nothing(tmp_path, study, results, monkeypatch, caplog):
    def broken(*_, **__):
        raise RuntimeError("no memory <for> that")

    monkeypatch.setattr(figures, "drawn", broken)
    found = Page(report(tmp_path, study, results).read_text(encoding="utf-8"))
    assert "this shape cannot be drawn: no memory <for> that" in found.said
    assert "watertight" in found.said
    assert "cannot be drawn" in caplog.text


def test_exemplars_that_cannot_be_decoded_lose_nothing(tmp_path, study, results, monkeypatch, caplog):
    def broken(*_, **__):
        raise RuntimeError("a stranger's decoder")

    monkeypatch.setattr(figures, "decode", broken)
    found = Page(report(tmp_path, study, results).read_text(encoding="utf-8"))
    assert "cannot be decoded" in caplog.text
    assert "this shape cannot be drawn" not in found.said
    assert len([given for given, _ in found.scripts if given.get("type") == "text/plain"]) == len(results)
    assert "distance to" not in found.said


def test_a_measure_that_fails_is_left_out(tmp_path, bank, study, results, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr("lampopt.reporting.measuring.values_of", broken)
    found = Page(report(tmp_path, study, results).read_text(encoding="utf-8"))
    assert "length is not measured" in found.said
    assert "this shape cannot be drawn" not in found.said


def test_what_cannot_be_written_is_refused(tmp_path, study, results):
    with pytest.raises(InputError, match="expected at least one result"):
        report(tmp_path, study, [])
    with pytest.raises(InputError, match="cannot be written"):
        report(tmp_path, study, results[:1], out=tmp_path / "none" / "report.html")


def test_a_report_holds_no_mesh(tmp_path, bank):
    study = lampopt.Study(bank, sweep={"length": [2.4, 2.5, 2.6]}, resolution=16)
    made = []

    def told():
        for result in lampopt.sweep(study, plugins=small.plugins()):
            result.design.__dict__.pop("mesh", None)  # as read back from a run folder
            made.append(result)
            yield result

    report(tmp_path, study, told())
    assert len(made) == 3
    assert not any("mesh" in result.design.__dict__ for result in made)


# What is gathered


def many(count, accepts, bank):
    """Results of `count` designs of which those that `accepts` says are accepted; none of them can be decoded."""
    study = lampopt.Study(bank, targets={"length": 2.5}, level="alpha")
    one = lampopt.run(study, plugins=small.plugins())
    for i in range(count):
        check = Check("odd", 0.5 if accepts(i) else 2.0, "<=", 1.0, "", "alpha")
        yield lampopt.Result(one.design, (check,), one.provenance)


def test_ten_thousand_designs_are_counted_and_a_hundred_shown(bank):
    found = gather(many(10_000, lambda i: i % 4 == 0, bank), bank, 100)
    assert (len(found.lines), found.accepted) == (10_000, 2_500)
    assert found.rejections() == [("odd", 7_500)]
    assert len(found.shown) == 100
    assert sum(result.accepted for result in found.shown.values()) == 25
    numbers = np.array(list(found.shown))
    assert (np.diff(numbers) > 0).all()
    assert numbers[0] <= 200
    assert numbers[-1] > 9_700
    assert np.diff(numbers).max() < 400


def test_the_few_accepted_are_always_shown(bank):
    found = gather(many(3_000, lambda i: i in (7, 1500, 2999), bank), bank, 100)
    assert {number for number, result in found.shown.items() if result.accepted} == {8, 1501, 3000}
    assert len(found.shown) == 100
    assert len(gather(many(30, lambda i: True, bank), bank, 100).shown) == 30


@pytest.mark.parametrize("count", [0, 1, 9, 10, 21, 1000, 12_345])
def test_spread_keeps_few_and_evenly(count):
    spread = Spread(10)
    for i in range(count):
        spread.add(i)
    kept = spread.take(10**9)
    assert len(kept) <= 20
    assert len(kept) >= min(count, 10)
    assert len(set(np.diff(kept))) <= 1
    assert len(spread.take(4)) == min(4, count)


def test_a_line_tells_the_check_that_the_score_is_of(bank):
    def line(*checks):
        (one,) = many(1, lambda i: True, bank)
        result = lampopt.Result(one.design, checks, one.provenance)
        (found,) = gather([result], bank, 1).lines
        assert found.score == result.score
        return found.worst, found.score, found.accepted

    near = Check("near", 0.9, "<=", 1.0, "", "alpha")
    beyond = Check("beyond", 1.0, ">=", 3.0, "", "mesh")
    assert line() == ("", 0.0, True)
    assert line(near, Check("told", 7.0, "info", None, "", "mesh")) == ("near", 0.9, True)
    assert line(near, beyond) == ("beyond", 3.0, False)
    assert line(near, beyond, Check("unknown", np.nan, "<=", 1.0, "", "mesh")) == ("unknown", np.inf, False)
    assert check_row(beyond)["part"] == "3 of the limit"


def test_what_is_read_back_from_a_measurement():
    """A length for a parameter that is a change of length: 2.6 measured where 2.5 is meant is 0.1 more of it."""
    plain = small.boxes(measured={"length": "extents.length"})
    changes = lampopt.Exemplars(
        plain.parameters - [2.0, 0.0], plain.space, plain.meshes, plain.names, measured=plain.measured
    )
    as_it_is, as_change = small.bank(plain), small.bank(changes)
    assert is_itself(as_it_is, "length")
    assert is_itself(as_it_is, "width")
    assert not is_itself(as_change, "length")
    mixed = {"length": 0.5, "extents.length": 2.5}
    assert read_back(as_it_is, "length", 2.6, mixed) == 2.6
    assert read_back(as_change, "length", 2.6, mixed) == pytest.approx(0.6)


def followed(count, size, *, others=0.0):
    """Draws of `size` parameters over unlike ranges, and what follows the first: 1.25 times it and 3, beside others."""
    parameters = np.random.default_rng(count).uniform(-1, 1, (count, size)) * np.geomspace(0.3, 300, size) + 5
    return parameters, 1.25 * parameters[:, 0] + 3 + others * parameters[:, 1:].sum(1)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 9, 40])
def test_what_follows_one_parameter_alone_does_so_with_any_number_of_exemplars(count):
    assert following_ratio(*followed(count, 5)[:1], 0, followed(count, 5)[1]) == pytest.approx(1.25)


@pytest.mark.parametrize("count", [6, 7, 8, 40])
def test_the_share_of_other_parameters_is_taken_out_where_they_can_be_told_apart(count):
    parameters, values = followed(count, 5, others=0.4)
    assert following_ratio(parameters, 0, values) == pytest.approx(1.25)
    assert following_ratio(parameters[:, ::-1], 4, values) == pytest.approx(1.25)
    held = np.column_stack([parameters, np.full(count, 7.0)])
    assert following_ratio(held, 0, values) == pytest.approx(1.25)
    assert following_ratio(held, 5, values) == 0.0


@pytest.mark.parametrize("count", [4, 5, 7])
def test_few_exemplars_are_read_back_as_many(count):
    """A change of length, read off a box whose width makes it longer too: 0.1 m more measured is 0.1 m more of it."""
    plain = small.boxes(count=count)
    meshes = [box(length + 0.5 * width, width, 0.8) for length, width in plain.parameters]
    exemplars = lampopt.Exemplars(
        plain.parameters - [2.0, 0.0],
        plain.space,
        meshes,
        plain.names,
        unit="m",
        measured={"length": "extents.length"},
    )
    found = small.bank(exemplars)
    assert not is_itself(found, "length")
    mixed = {"length": 0.5, "extents.length": 3.1}
    assert read_back(found, "length", 3.2, mixed) == pytest.approx(0.6)


def test_names_whose_curve_is_not_drawn_are_told(tmp_path):
    """Fourteen parameters, all asked for in two values."""
    plain = small.boxes()
    space = tuple(Parameter(f"p{i}", "m") for i in range(14))
    parameters = np.random.default_rng(0).uniform(1, 2, (len(plain), 14))
    bank = small.bank(lampopt.Exemplars(parameters, space, plain.meshes, plain.names, unit="m"))
    asked = [dict.fromkeys((q.name for q in space), value) for value in (1.4, 1.6)]
    study, other = (lampopt.Study(bank, targets=targets, level="alpha") for targets in asked)
    results = [lampopt.run(s, plugins=small.plugins()) for s in (study, other)]
    found = Page(report(tmp_path, study, results).read_text(encoding="utf-8"))
    assert found.said.count("is not measured") == 12
    assert "12 of 14 names asked for in several values are drawn; not: p12, p13." in found.said


# What is drawn


def test_sharp_edges_stay_sharp_and_smooth_ones_smooth():
    cube = drawn(box(2, 2, 2), faces=12)
    assert len(cube.vertices) == 24
    assert np.sort(np.abs(cube.normals), axis=1) == pytest.approx(np.tile([0, 0, 1], (24, 1)))
    assert cube.vertices == pytest.approx(np.sign(cube.vertices))
    ball = creation.icosphere(subdivisions=3, radius=5)
    smooth = drawn(ball, faces=len(ball.faces))
    assert len(smooth.vertices) == len(ball.vertices)
    assert np.abs(smooth.normals - smooth.vertices).max() < 0.03
    assert smooth.half == pytest.approx(5, rel=1e-3)


def test_heavy_meshes_are_made_light_and_coarse_ones_fine():
    ball = creation.icosphere(subdivisions=5, radius=0.01)
    light = drawn(ball, faces=2000)
    assert len(light.faces) <= 2000
    assert np.linalg.norm(light.points, axis=1) == pytest.approx(0.01, rel=0.02)
    assert 600 < len(drawn(box(1, 1, 1), faces=3000).faces) <= 3000


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_distances_are_signed_and_in_the_users_unit(scale):
    outer, inner = box(3 * scale, 3 * scale, 3 * scale), box(2 * scale, 2 * scale, 2 * scale)
    centre = np.array([[1.5, 0, 0], [0, 0, -1.5]]) * scale
    assert signed_distance(centre, inner) == pytest.approx(0.5 * scale)
    assert signed_distance(centre / 1.5 * 0.9, inner) == pytest.approx(-0.1 * scale)
    assert drawn(outer, faces=12, reference=inner).distance == pytest.approx(0.5 * scale * 3**0.5)
    assert drawn(inner, faces=12, reference=outer).distance == pytest.approx(-0.5 * scale)


def test_colours_tell_outside_from_inside():
    found = colours(np.array([-2.0, -1.0, 0.0, 1.0, 5.0]), 1.0)
    assert found == pytest.approx(np.stack([BELOW, BELOW, LEVEL, ABOVE, ABOVE]))
    assert BELOW[2] > BELOW[0]
    assert ABOVE[0] > ABOVE[2]


def test_sky_is_open_above_and_shut_inside():
    cube = box(2, 2, 2)
    corners, faces = np.asarray(cube.vertices), np.asarray(cube.faces)
    up = np.array([[0.0, 0.0, 1.0]])
    assert sky_seen(corners, faces, np.array([[0.0, 0.0, 1.0]]), up) == 1.0
    assert sky_seen(corners, faces, np.zeros((1, 3)), up) == 0.0
    beside = sky_seen(corners, faces, np.array([[1.05, 0.0, -0.9]]), up)[0]  # a wall takes half of it
    assert 0.35 < beside < 0.65


@pytest.mark.parametrize("view", views(0) + views(1), ids=lambda view: view.name)
def test_a_ball_is_a_disc_from_everywhere(view):
    ball = drawn(creation.icosphere(subdivisions=4, radius=2.0), faces=6000)
    image = pixels(pictures(ball, view, pixel=0.05, size=(160, 120))[0])
    solid = (image[..., 3] > 250).sum() * 0.05**2
    assert solid == pytest.approx(np.pi * 4, rel=0.03)
    row, column = np.nonzero(image[..., 3] > 250)
    assert (column.mean(), row.mean()) == pytest.approx((79.5, 59.5), abs=0.5)


def test_views_are_what_their_names_say():
    """An L: long along x, a tower at its high end; to one scale in every view."""
    shape = drawn(util.concatenate([box(4, 1, 0.5), box(0.5, 1, 2, centre=(1.75, 0, 1.25))]), faces=24)
    _, side, front, top = views(0)
    assert reach(shape, side) == pytest.approx([4, 2.5])
    assert reach(shape, front) == pytest.approx([1, 2.5])
    assert reach(shape, top) == pytest.approx([4, 1])
    seen = pixels(pictures(shape, side, pixel=0.05, size=(120, 80))[0])[..., 3] > 128
    row, column = np.nonzero(seen)
    assert np.ptp(column) + 1 == pytest.approx(80, abs=1)
    assert np.ptp(row) + 1 == pytest.approx(50, abs=1)
    assert column[row < 30].min() > 80  # the tower is on the right, and on top
    for long in (0, 1):
        for view in views(long):
            assert view.frame @ view.frame.T == pytest.approx(np.eye(3))
            assert np.linalg.det(view.frame) == pytest.approx(1)
            assert view.frame[1, 2] >= 0  # nothing stands on its head


def test_pictures_are_coloured_by_distance():
    plate, view = drawn(box(2, 2, 1), faces=3000, reference=box(1.6, 2.4, 1)), views(0)[0]
    plain, heat = (pixels(uri).astype(int) for uri in pictures(plate, view, pixel=0.02, size=(200, 150), spread=0.2))
    red, blue = heat[..., 0] - heat[..., 2] > 60, heat[..., 2] - heat[..., 0] > 60
    assert red[heat[..., 3] > 200].sum() > 100
    assert blue[heat[..., 3] > 200].sum() > 100
    assert not (np.abs(plain[..., 0] - plain[..., 2]) > 60).any()
    assert (np.abs(heat[..., 3] - plain[..., 3]) <= 2).all()


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[5, 5, 5], [5, 5, 5], [5, 5, 5]],
        [[0, 0, 0], [1e90, 0, 0], [0, 1e90, 0]],
        [[1e7, 0, 0], [1e7 + 1, 0, 0], [1e7, 1, 0]],
    ],
    ids=["triangle", "line", "point", "huge", "far"],
)
def test_what_is_hardly_a_shape_is_drawn_without_a_warning(corners):
    scrap = Trimesh(corners, [[0, 1, 2]], process=False)
    shape = drawn(scrap, faces=100, reference=scrap)
    assert np.abs(shape.distance).max() < 1e-6 * max(shape.half, 1)
    for view in views(0):
        plain, heat = pictures(shape, view, pixel=shape.half / 40, size=(120, 90), spread=shape.half)
        assert pixels(plain).shape == pixels(heat).shape == (90, 120, 4)
    assert figures.packed(shape, shape.half).faces == len(shape.faces)


@pytest.mark.parametrize("corners", [[[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 0, 0], [1, 0, 0], [0, np.inf, 0]]])
def test_what_is_no_shape_is_refused(corners):
    with pytest.raises(InputError, match="finite vertices"):
        drawn(Trimesh(corners, [[0, 1, 2]], process=False), faces=100)
    with pytest.raises(InputError, match="expected faces"):
        drawn(Trimesh(np.zeros((3, 3)), np.zeros((0, 3), int), process=False), faces=100)


def test_a_mesh_survives_the_packing():
    shape = drawn(creation.icosphere(subdivisions=3), faces=2000, reference=box(1, 1, 1))
    packed = figures.packed(shape, 0.5)
    data = base64.b64decode(packed.data)
    count, faces = packed.vertices, packed.faces
    place = np.frombuffer(data, "<u2", 3 * count).reshape(-1, 3) / 65535 * 2 - 1
    corners = np.frombuffer(data, "<u2", 3 * faces, 6 * count).reshape(-1, 3)
    look = np.frombuffer(data, np.int8, 4 * count, 6 * count + 6 * faces).reshape(-1, 4) / 127
    off = np.frombuffer(data, np.int8, count, 10 * count + 6 * faces) / 127 * 0.5
    assert np.abs(place - shape.vertices).max() <= 1 / 65535
    assert (corners == shape.faces).all()
    assert np.abs(look[:, :3] - shape.normals).max() < 0.005
    assert np.abs(off - shape.distance.clip(-0.5, 0.5)).max() < 0.003


# What is laid out


def test_scaling_keeps_distances_that_fit_a_plane():
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(60, 2)) * [3, 1]
    turned = plane @ np.linalg.qr(rng.normal(size=(20, 20)))[0][:2]
    layout = scaled(turned)
    given, kept = (np.linalg.norm(p[:, None] - p, axis=-1) for p in (plane, layout.places))
    assert kept == pytest.approx(given)
    assert layout.stress < 1e-6
    assert scaled(rng.normal(size=(60, 20))).stress > 0.3  # twenty ways to differ do not fit a plane
    assert np.ptp(layout.places[:, 0]) > np.ptp(layout.places[:, 1])


def test_growing_balls_lie_on_a_line_in_their_order():
    radii = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.4])
    balls = [drawn(creation.icosphere(subdivisions=3, radius=r), faces=2000) for r in radii]
    balls[-1] = drawn(creation.icosphere(subdivisions=4, radius=1.4), faces=6000)  # the same shape, other triangles
    layout = laid_out(balls)
    along = np.abs(layout.places[:, 0] - layout.places[0, 0])
    assert along == pytest.approx(radii - 1, abs=0.01)  # as far apart as their surfaces are [user's unit]
    assert np.abs(layout.places[:, 1]).max() < 0.01
    assert layout.stress < 0.05


def test_points_are_spread_over_the_surface_by_area():
    plate = drawn(box(4, 2, 0.001), faces=3000)
    points = spread_over(plate, 400)
    assert points.shape == (400, 3)
    assert np.abs(points.mean(0)).max() < 0.1
    assert np.std(points[:, 0]) == pytest.approx(4 / 12**0.5, rel=0.05)


# Charts


def test_ticks_are_round_and_inside():
    assert charts.ticks(0, 1) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert charts.ticks(-0.37, 0.22) == pytest.approx([-0.2, 0, 0.2])
    for low, high in ((1e-9, 3e-9), (-5e6, 2e6), (1.0, 1.0001)):
        found = charts.ticks(low, high)
        assert 2 <= len(found) <= 9
        assert all(low - 1e-9 * abs(low) <= v <= high + 1e-9 * abs(high) for v in found)


def test_numbers_are_short():
    told = [
        charts.number(v)
        for v in (None, float("nan"), float("inf"), 0.0, -1e-17, 12345678.0, -17824.0, 0.000012345, -2.5)
    ]
    assert told == ["–", "–", "∞", "0", "0", "1.235e7", "−17,824", "1.234e−5", "−2.5"]
    assert [charts.rounded_up(v) for v in (0.11, 1.0, 7.2, 850.0)] == pytest.approx([0.15, 1.0, 8.0, 1000.0])


def test_asked_against_found_has_the_right_fit():
    x = np.linspace(1, 3, 9)
    points = [charts.Point(a, a + 0.1 * (-1) ** i, "ok", "", "d") for i, a in enumerate(x)]
    svg, r2 = charts.asked_against_found(points, "length [m]", "measured", (1.5, 2.5), "t<itle")
    assert r2 == pytest.approx(1 - 9 * 0.01 / ((x - 2) ** 2).sum())
    assert svg.count("<circle") == 9
    assert "t<itle" not in svg
    flat = [charts.Point(2.0, 2.0, "bad", "d1", "d")]
    assert np.isnan(charts.asked_against_found(flat, "l", "m", (2.0, 2.0), "t")[1])


def test_scores_beyond_any_chart_are_drawn_at_its_edge():
    points = [charts.Point(i, v, "bad", "", "") for i, v in enumerate((0.0, 0.5, float("inf"), 1e9))]
    svg = charts.scores(points, "s")
    assert not re.search(r"nan|inf", svg)
    assert svg.count("<path") == 4


# From a shell


def test_report_of_a_run_folder(tmp_path, capsys, monkeypatch, study):
    from lampopt.cli import main

    ready = small.plugins()
    monkeypatch.setattr(Plugins, "load", lambda: ready)
    for _ in lampopt.sweep(study, folder=tmp_path / "run", plugins=ready):
        pass
    assert (tmp_path / "run" / "report.html").exists()
    out = tmp_path / "elsewhere.html"
    assert main(["report", str(tmp_path / "run"), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"report": str(out), "bytes": out.stat().st_size}
    assert out.read_bytes() == (tmp_path / "run" / "report.html").read_bytes()
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert main(["report", str(tmp_path / "run"), "--out", str(tmp_path / "no" / "x.html")]) == 2
