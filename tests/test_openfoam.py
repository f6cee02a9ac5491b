"""openfoam-drag without OpenFOAM: its parts against known truths, and every way to fail by fakes of the tools."""

import importlib.metadata
import json
import os
import pickle
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from filelock import FileLock

import lampopt
from lampopt import identity
from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.plugins import Plugins
from lampopt.types import Spec
from lampopt_openfoam import case, flow, grid, kept
from lampopt_openfoam.drag import OPERATIONAL, OpenFoamDrag, _mean
from lampopt_openfoam.installed import _told, installed
from lampopt_openfoam.outcomes import OUTCOMES, FlowError
from lampopt_openfoam.pairs import change, paired
from lampopt_openfoam.placements import on_placements
from lampopt_openfoam.refinement import richardson
from lampopt_openfoam.running import _ending_with_us
from lampopt_openfoam.settled import first_settled, judged, standard_error
from lampopt_openfoam.smooth import ROUGH, roughness, smoothed
from lampopt_openfoam.surface import axes, cleaned

sys.path.insert(0, str(Path(__file__).parent))
import small

pytest.importorskip("foamlib", reason="the extra openfoam is not installed: pip install 'lampopt[openfoam]'")
FLOW = {"wind": "x", "up": "z", "half": "auto"}


# Settled: synthetic series with known means.


def both(drag):
    return np.stack([drag, np.zeros_like(drag)], axis=1)


def test_a_constant_is_settled_once_there_is_enough_of_it():
    assert judged(both(np.full(150, 0.3)), 0.005).state == "settling"
    told = judged(both(np.full(200, 0.3)), 0.005)
    assert (told.state, told.mean[0], told.error[0]) == ("settled", pytest.approx(0.3), pytest.approx(0, abs=1e-12))


@pytest.mark.parametrize("correlated", [0.0, 0.9])
def test_the_standard_error_of_noise_is_neither_too_small_nor_useless(correlated):
    draw, ratios = np.random.default_rng(0), []
    for _ in range(200):
        noise, x = draw.normal(size=600), np.zeros(600)
        for i in range(1, 600):
            x[i] = correlated * x[i - 1] + noise[i]
        truth = 1 / (1 - correlated) / np.sqrt(600)  # of the mean of such a process
        ratios.append(standard_error(x) / truth)
    assert 0.9 < np.median(ratios) < 1.8


def test_noise_settles_when_its_mean_is_known_and_not_before():
    series = 0.3 + 0.02 * np.random.default_rng(1).normal(size=1500)
    assert judged(both(0.3 + 20 * (series - 0.3)), 0.005).state == "settling"
    told = judged(both(series), 0.005)
    assert told.state == "settled" and abs(told.mean[0] - 0.3) < 3 * told.error[0]


def test_a_drift_does_not_settle():
    assert judged(both(0.3 + 0.1 * np.linspace(0, 1, 600)), 0.005).state == "settling"
    assert judged(both(0.3 + 0.3 * np.exp(-np.arange(260) / 200)), 0.005).state == "settling"
    assert judged(both(0.3 + 0.3 * np.exp(-np.arange(1500) / 100)), 0.005).state == "settled"


def test_an_oscillation_settles_by_its_mean():
    turns = np.arange(1000)
    told = judged(both(0.3 + 0.03 * np.sin(turns / 9)), 0.005)
    assert told.state == "settled" and told.mean[0] == pytest.approx(0.3, abs=0.002)
    assert judged(both(0.3 + 0.03 * np.sin(turns[:250] / 60)), 0.005).state == "settling"  # two thirds of a cycle


@pytest.mark.parametrize("bad", [1e33, -1e33, np.nan, np.inf])
def test_a_divergence_is_told_at_once(bad):
    series = both(np.full(60, 0.3))
    series[-1, 0] = bad
    assert judged(series, 0.005).state == "diverged"
    assert np.isnan(judged(series, 0.005).mean).all()


def test_a_wild_start_is_no_divergence():
    series = both(np.full(300, 0.3))
    series[:20, 0] = -2e3
    assert judged(series, 0.005).state == "settled"


def test_iterations_after_it_has_settled_do_not_count():
    series = both(0.3 + 0.1 * np.exp(-np.arange(1500) / 60) + 0.002 * np.sin(np.arange(1500)))
    told = first_settled(series, 0.005)
    assert told.state == "settled" and 200 < told.end < 600 and told.end % 20 == 0
    assert first_settled(series[: told.end + 7], 0.005) == told
    assert first_settled(series[: told.end - 20], 0.005).state == "settling"


def test_a_lift_that_swings_keeps_a_steady_drag_waiting():
    series = both(np.full(400, 0.3))
    series[:, 1] = np.where(np.arange(400) < 250, -0.3, 0.3)
    assert judged(series, 0.005).state == "settling"


# Richardson, pairs, placements.


@pytest.mark.parametrize("order", [1.0, 1.7, 2.0])
def test_richardson_finds_order_and_limit(order):
    cells = [0.25, 0.125, 1 / 12]
    told = richardson(cells, [0.25 + 3 * h**order for h in cells], [0.0, 1e-3, 2e-3])
    assert told.kind == "observed" and told.monotone
    share = 1 / (1.5**order - 1)
    assert told.noise == pytest.approx(np.hypot((1 + share) * 2e-3, share * 1e-3))
    assert (told.order, told.value) == (pytest.approx(order, abs=1e-6), pytest.approx(0.25, abs=1e-9))


def test_richardson_says_when_values_turn():
    for last in (0.27, 0.2601, 0.26):
        told = richardson([0.25, 0.125, 1 / 12], [0.30, 0.26, last], [0.0] * 3)
        assert (told.kind, told.monotone, told.order) == ("assumed", False, 2.0)
        assert told.error >= 0.0199  # half of what the levels differ by
    assert richardson([0.25, 0.125, 1 / 12], [0.26, 0.26, 0.30], [0.0] * 3).kind == "assumed"


def test_richardson_says_when_the_levels_differ_by_noise_only():
    told = richardson([0.25, 0.125, 1 / 12], [0.30, 0.29, 0.286], [0.003, 0.003, 0.003])
    assert told.kind == "assumed" and "noise" in told.message
    assert richardson([0.25, 0.125, 1 / 12], [0.30, 0.29, 0.286], [1e-4] * 3).kind == "observed"


def test_richardson_takes_an_order_beyond_the_schemes_for_chance():
    cells = [0.25, 0.125, 1 / 12]
    for values in ([0.25 + 3 * h**3.5 for h in cells], [0.30, 0.26, 0.2599999]):
        told = richardson(cells, values, [0.0] * 3)
        assert (told.kind, told.order) == ("observed", 2.0) and "taken as 2" in told.message
        assert told.error == pytest.approx(1.25 * abs(values[1] - values[2]) / (1.5**2 - 1))


def test_richardson_does_not_believe_an_order_that_cannot_be():
    told = richardson([0.25, 0.125, 1 / 12], [0.30, 0.2999, 0.28], [0.0] * 3)
    assert (told.kind, told.monotone) == ("assumed", True) and "no order" in told.message


def test_placements_are_distinct_and_even():
    points = np.array([grid.placement(k) for k in range(64)])
    assert ((points >= 0) & (points < 1)).all()
    apart = np.abs(points[:, None] - points[None]).max(axis=-1) + np.eye(64)
    assert apart.min() > 0.05
    assert np.abs(points.mean(axis=0) - 0.5).max() < 0.05


@pytest.mark.parametrize("ground", ["fixed", "moving", "none"])
@pytest.mark.parametrize("half", [True, False])
def test_the_body_lies_within_the_boxes_and_these_in_the_domain(ground, half):
    for number in range(5):
        made = grid.Grid("coarse", number, 0.45, 0.33, half, ground, 0.0).settings()
        low, high = (np.array([made[f"{axis}{end}"] for axis in "xyz"]) for end in ("Min", "Max"))
        assert (low <= [-3, -0.225 * (not half), 0]).all() and (high > [6, 1, 1.9]).all()
        assert low[2] == 0 or ground == "none"
        for box in ("near", "wake"):
            assert (np.array(made[f"{box}Min"]) <= [0, -0.225, 0]).all()
            assert (np.array(made[f"{box}Max"]) >= [1, 0.225, 0.33]).all()
        inside = np.array(made["inside"])
        assert (inside > low).all() and (inside < high).all()
        cells = (inside - low) / ((high - low) / [made["nx"], made["ny"], made["nz"]]) * 2**grid.FINEST
        assert (np.abs(cells - cells.round()) > 1e-3).all()  # on no cell's face


def test_finer_levels_have_smaller_cells():
    assert grid.CELL["coarse"] > grid.CELL["medium"] > grid.CELL["fine"]


def test_errors_are_those_from_placement_to_placement_and_no_less_than_of_settling():
    assert _mean([0.30, 0.32, 0.34], [0.01, 0.01, 0.01], 9)[1] == pytest.approx(0.02 / np.sqrt(3))
    assert _mean([0.30, 0.30, 0.30], [0.01, 0.01, 0.01], 9)[1] == pytest.approx(0.01 / np.sqrt(3))
    assert _mean([0.30, 0.32, 0.34], [0.0, 0.0, 0.0], 9) == (pytest.approx(0.32), pytest.approx(0.02 / np.sqrt(3)))
    assert _mean([0.3], [0.003], 0.004)[1] == pytest.approx(0.005)


def test_a_change_that_all_placements_share_is_told():
    none = np.zeros(3)
    assert change(np.array([-0.050, -0.052, -0.049]), none).verdict == "lower"
    assert change(np.array([0.050, 0.052, 0.049]), none).verdict == "higher"
    told = change(np.array([-0.05, 0.04, 0.02]), none)
    assert told.verdict == "not told apart" and told.low < told.value < told.high and told.p > 0.05
    assert change(np.array([-0.050, -0.052, -0.049]), np.full(3, 0.1)).verdict == "not told apart"


# The surface.


def car(scale=1.0):
    """A box-like body with a cabin, mirrored exactly."""
    low, cabin = trimesh.creation.box((4, 1.6, 0.6)), trimesh.creation.box((2, 1.4, 0.5))
    cabin.apply_translation([0.2, 0, 0.5])
    made = trimesh.boolean.union([low, cabin], engine="manifold")
    for _ in range(2):
        made = made.subdivide()
    made.apply_scale(scale)
    return made


def test_a_clean_mesh_is_left_as_it_is():
    made = cleaned(car(), **FLOW)
    assert made.notes == () and made.half
    assert (made.length, made.width, made.height) == (pytest.approx(4), pytest.approx(0.4), pytest.approx(1.05 / 4))
    assert made.frontal_area == pytest.approx((1.6 * 0.6 + 1.4 * 0.45) / 16, rel=1e-6)


def test_place_scale_and_order_make_no_difference():
    first = cleaned(car(), **FLOW)
    moved = car(1000.0)
    moved.apply_translation([3e3, -5e2, 7e2])
    draw = np.random.default_rng(0)
    order = draw.permutation(len(moved.vertices))
    faces = np.argsort(order)[moved.faces][draw.permutation(len(moved.faces))]
    again = cleaned(trimesh.Trimesh(moved.vertices[order], faces, process=False), **FLOW)
    assert again.digest == first.digest and again.stl(0.0) == first.stl(0.0)
    assert (again.width, again.height) == (first.width, first.height)  # a grid's, and so of what is kept
    assert again.length == pytest.approx(4000)


def test_which_side_of_zero_rounding_leaves_makes_no_difference():
    first = cleaned(car(), **FLOW)
    vertices = np.where(np.abs(first.vertices) < 1e-12, -0.0, first.vertices)
    assert np.signbit(vertices[vertices == 0]).any()
    assert replace(first, vertices=vertices).digest == first.digest


def test_axes_turn_the_body_into_the_wind():
    turned = car()
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1]))
    assert cleaned(turned, wind="y", up="z", half="auto").length == pytest.approx(4)
    for wind, up in (("x", "z"), ("-y", "z"), ("z", "-x")):
        assert np.linalg.det(axes(wind, up)) == pytest.approx(1)
    with pytest.raises(InputError, match="across up"):
        axes("z", "-z")
    with pytest.raises(InputError, match="wind: expected one of"):
        axes("q", "z")


def test_a_small_part_that_floats_is_dropped_with_a_note():
    crumb = trimesh.creation.icosphere(1, 0.05)
    crumb.apply_translation([0, 0, 1.5])
    made = cleaned(trimesh.util.concatenate([car(), crumb]), **FLOW)
    assert made.digest == cleaned(car(), **FLOW).digest
    assert made.notes == ("dropped 1 part that floated beside the body, up to 2.5% of its length",)


def test_a_part_that_touches_stays():
    mirrors = [trimesh.creation.icosphere(2, 0.1).apply_translation([0, side * 0.8, 0.2]) for side in (-1, 1)]
    assert cleaned(trimesh.util.concatenate([car(), *mirrors]), **FLOW).width == pytest.approx(1.8 / 4, rel=1e-2)


def test_large_faces_touch_and_cross_where_no_vertex_is():
    """A wing through the body; a plate on a post, whose corners are far from it."""
    wing = trimesh.creation.box((1, 5, 0.1))
    assert cleaned(trimesh.util.concatenate([car(), wing]), **FLOW).width == pytest.approx(5 / 4)
    post = trimesh.creation.box((0.05, 0.05, 0.4)).apply_translation([-1.5, 0, 0.4])
    for side in (0.35, 1.2):
        plate = trimesh.creation.box((0.35, side, 0.02)).apply_translation([-1.5, 0, 0.61])
        made = cleaned(trimesh.util.concatenate([car(), post, plate]), **FLOW)
        assert (made.notes, made.height) == ((), pytest.approx(1.05 / 4))
        assert len(made.faces) == len(car().faces) + 24


def test_a_large_part_that_floats_is_refused_and_wheels_are_kept():
    wing = trimesh.creation.box((1, 1, 0.1)).apply_translation([0, 0, 2.0])
    with pytest.raises(FlowError, match=r"25% as long as the body that floats") as caught:
        cleaned(trimesh.util.concatenate([car(), wing]), **FLOW)
    assert caught.value.outcome == "refused-mesh"
    wheels = [trimesh.creation.box((0.6, 0.2, 0.6)).apply_translation([x, y, -0.65]) for x in (-1, 1) for y in (-1, 1)]
    assert "kept 4 parts" in cleaned(trimesh.util.concatenate([car(), *wheels]), **FLOW).notes[-1]


@pytest.mark.parametrize(
    ("places", "what"),
    [
        ([(0, 0, -2.0)], "15% as long as the body that floats"),  # far below
        ([(-1, 0, -0.65), (1, 0, -0.85)], "15% as long as the body that floats"),  # one of them higher than the other
        ([(-1, 0, -0.65), (1, 0, -0.65)], ""),
        ([(-1, 0, -0.65), (1, 0, -0.63)], ""),
    ],
)
def test_large_parts_below_the_body_stand_on_one_ground_or_are_refused(places, what):
    crumb = trimesh.creation.icosphere(1, 0.05).apply_translation([0, 0, -1.5])  # is not what they stand on
    legs = [trimesh.creation.box((0.6, 0.6, 0.6)).apply_translation(place) for place in places]
    mesh = trimesh.util.concatenate([car(), *legs, crumb])
    if what:
        with pytest.raises(FlowError, match=what):
            cleaned(mesh, **FLOW)
        return
    made = cleaned(mesh, **FLOW)
    assert made.height == pytest.approx((0.75 + 0.95) / 4)
    assert made.notes[0].startswith("dropped 1 part") and made.notes[1].startswith("kept 2 parts")


def test_flipped_faces_are_turned_with_a_note():
    mesh = car()
    faces = np.array(mesh.faces)
    turn = np.random.default_rng(0).random(len(faces)) < 0.3
    faces[turn] = faces[turn][:, ::-1]
    made = cleaned(trimesh.Trimesh(mesh.vertices, faces, process=False), **FLOW)
    assert made.digest == cleaned(car(), **FLOW).digest
    assert made.notes and made.notes[0].startswith("turned")


def test_a_small_hole_is_closed_with_a_note():
    mesh = trimesh.creation.icosphere(4, 0.5)
    whole = cleaned(mesh, **FLOW)
    mesh.update_faces(np.argsort(np.linalg.norm(mesh.triangles_center - [0, 0, 0.5], axis=1)).argsort() >= 20)
    made = cleaned(mesh, **FLOW)
    assert made.notes[0].startswith("closed a small hole of")
    assert made.frontal_area == pytest.approx(whole.frontal_area, rel=1e-3)


def test_a_large_hole_is_refused_with_what_to_do():
    mesh = car()
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.7)
    with pytest.raises(FlowError, match=r"expected a closed surface.*lampopt\.wrap\(mesh, gap=") as caught:
        cleaned(mesh, **FLOW)
    assert caught.value.outcome == "refused-mesh" and isinstance(caught.value, MeasureError)


@pytest.mark.parametrize(
    ("mesh", "what"),
    [
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False), "finite"),
        (trimesh.creation.box((0.01, 1, 1)), "along the wind"),
    ],
)
def test_what_is_no_body_is_refused(mesh, what):
    with pytest.raises(FlowError, match=what):
        cleaned(mesh, **FLOW)


def test_what_is_no_mesh_is_told():
    for mesh in (None, [1, 2], trimesh.PointCloud([[0, 0, 0]])):
        with pytest.raises(InputError, match=r"expected a mesh \(trimesh.Trimesh\), got"):
            OpenFoamDrag()(mesh)


def test_an_empty_mesh_is_refused_as_by_other_measures():
    with pytest.raises(EmptyMesh):
        OpenFoamDrag()(trimesh.Trimesh(np.empty((0, 3)), np.empty((0, 3), int)))


def rough(amplitude):
    mesh = trimesh.creation.icosphere(5, 0.5)
    height = amplitude * np.random.default_rng(0).normal(size=len(mesh.vertices))
    return trimesh.Trimesh(mesh.vertices * (1 + height[:, None] / 0.5), mesh.faces, process=False)


@pytest.mark.parametrize("amplitude", [1e-3, 3e-3])
def test_roughness_is_measured_in_the_length(amplitude):
    mesh = rough(amplitude)
    everywhere, there = roughness(mesh.vertices, mesh.faces)
    assert everywhere == pytest.approx(amplitude, rel=0.15)
    assert everywhere <= there < 1.4 * amplitude


def test_what_is_smooth_or_has_edges_is_not_rough():
    for mesh in (rough(0.0), car(0.25), trimesh.creation.box((1, 1, 1))):
        assert max(roughness(mesh.vertices, np.asarray(mesh.faces))) < ROUGH / 3


def test_smoothing_keeps_the_size():
    mesh = rough(1e-3)
    better = smoothed(mesh.vertices, mesh.faces)
    assert max(roughness(better, mesh.faces)) <= ROUGH
    assert np.linalg.norm(better, axis=1).mean() == pytest.approx(0.5, abs=1e-3)
    made = cleaned(mesh, **FLOW)
    assert made.notes[0].startswith("smoothed: rough by 0.1")
    low, high = made.vertices.min(0), made.vertices.max(0)
    np.testing.assert_allclose([*low[[0, 2]], high[0], low[1] + high[1]], [0, 0, 1, 0], atol=1e-12)  # stands again
    assert made.length == pytest.approx(np.ptp(better[:, 0]), abs=1e-9) and made.length < np.ptp(mesh.vertices[:, 0])


def test_what_is_too_rough_is_refused():
    with pytest.raises(FlowError, match="rough by"):
        cleaned(rough(8e-3), **FLOW)


@pytest.mark.parametrize("amplitude", [1e-3, 8e-3])
def test_roughness_in_places_counts_too(amplitude):
    """A quarter of the surface is rough: the median over all of it does not notice."""
    mesh, even = rough(amplitude), rough(0.0)
    top = even.vertices[:, 2] > 0.25
    mesh.vertices[~top] = even.vertices[~top]
    everywhere, there = roughness(mesh.vertices, mesh.faces)
    assert everywhere < ROUGH / 3 and there == pytest.approx(amplitude, rel=0.2)
    if amplitude > 4e-3:
        with pytest.raises(FlowError, match="in places"):
            cleaned(mesh, **FLOW)
    else:
        made = cleaned(mesh, **FLOW)
        told = re.search(r"in places by ([\d.]+)%", made.notes[0])
        assert told and float(told[1]) / 100 == pytest.approx(amplitude, rel=0.2)
        assert max(roughness(made.vertices, made.faces)) <= ROUGH


def with_box(side):
    """The car with a box of few vertices on one flank."""
    box = trimesh.creation.box((0.2, 0.06, 0.1))
    box.apply_translation([0.1, side * 0.21, 0.0])
    return trimesh.util.concatenate([car(0.25), box])


@pytest.mark.parametrize("side", [-1, 1])
def test_what_few_vertices_of_one_side_draw_makes_it_lopsided(side):
    one, other = with_box(side), with_box(-side)
    assert not cleaned(one, **FLOW).half
    assert cleaned(trimesh.util.concatenate([one, other]), **FLOW).half


def test_the_frontal_area_is_that_of_the_half_that_is_solved():
    """One side is wider by a share: the middle moves, and the cabin lies on it no more."""
    for share, half in ((0.01, "auto"), (0.4, "yes")):
        mesh = car()
        mesh.vertices[:, 1] *= np.where(mesh.vertices[:, 1] > 0, 1 + share, 1)
        made = cleaned(mesh, wind="x", up="z", half=half)
        assert made.half
        area = 2 * (0.6 * (0.8 + 0.4 * share) + 0.45 * (0.7 + 0.3 * share)) / 16
        assert made.frontal_area == pytest.approx(area, rel=1e-6)


def test_a_lopsided_body_is_solved_whole():
    mesh = car()
    mesh.vertices[:, 2] += 0.2 * mesh.vertices[:, 1]
    assert not cleaned(mesh, **FLOW).half
    told = cleaned(mesh, wind="x", up="z", half="yes")
    assert told.half and "as asked" in told.notes[-1]
    assert not cleaned(car(), wind="x", up="z", half="no").half


# The measure as a plugin.


def test_it_is_installed_and_can_be_sent_to_a_worker():
    plugins = Plugins.load()
    made = plugins.make("measure", "openfoam-drag")
    assert made == OpenFoamDrag() and pickle.loads(pickle.dumps(made)) == made
    assert len(made.names) == len(made.units) == 6
    names = {e.name for e in importlib.metadata.entry_points(group="lampopt")}
    assert "openfoam" in names


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"level": "finest"}, "level: expected one of coarse, medium, fine"),
        ({"ground": "wet"}, "ground: expected one of"),
        ({"half": "maybe"}, "half: expected one of auto, yes, no"),
        ({"placements": 0}, "placements: expected a whole number, 1 or more"),
        ({"first": -1}, "first: expected"),
        ({"reynolds": 0.0}, "reynolds: expected a number from"),
        ({"reynolds": "4e6"}, "reynolds: expected a number from"),
        ({"reynolds": float("nan")}, "reynolds: expected a number from"),
        ({"clearance": True}, "clearance: expected a number from"),
        ({"timeout_s": None}, "timeout_s: expected a number from"),
        ({"level": ["coarse"]}, "level: expected one of"),
        ({"half": ["auto"]}, "half: expected one of"),
        ({"wind": ["x"]}, "wind: expected one of x"),
        ({"up": None}, "up: expected one of x"),
        ({"placements": True}, "placements: expected a whole number"),
        ({"first": False}, "first: expected a whole number"),
        ({"folder": 3}, "folder: expected a path"),
        ({"command": None}, "command: expected words"),
        ({"command": 'docker "run'}, "command: expected words .* No closing quotation"),
        ({"wind": "z"}, "wind: expected an axis across up"),
    ],
)
def test_wrong_options_are_refused(options, what):
    with pytest.raises(InputError, match=what):
        OpenFoamDrag(**options)


@pytest.mark.parametrize(
    ("said", "found"),
    [
        ("Using: OpenFOAM- (1912) - visit www.openfoam.com\nBuild:  (patch=200626)", ("openfoam.com", "1912")),
        ("Using: OpenFOAM-v2312 (2312) - visit www.openfoam.com", ("openfoam.com", "2312")),
        ("Using: OpenFOAM-10 (see https://openfoam.org)\nBuild: 10-c4cf895ad8fa", ("openfoam.org", "10")),
        ("Using: OpenFOAM-dev (see https://openfoam.org)", ("openfoam.org", "99")),
        ("sh: simpleFoam: not found", None),
    ],
)
def test_versions_are_told_apart(said, found):
    assert _told(said) == found


def test_a_failure_says_whether_trying_again_may_help():
    lasting = {"refused-mesh", "bad-grid", "diverged", "not-settled"}
    for name in OUTCOMES:
        error = pickle.loads(pickle.dumps(FlowError("why", name)))
        assert (error.outcome, error.passing) == (name, name not in lasting)
    assert not MeasureError("not there").passing


# Fakes of the tools.

SOLVE = """
last=$(ls -d [1-9]* 2>/dev/null | sort -n | tail -1); last=${last:-0}
mkdir -p postProcessing/forceCoeffs/$last
out=postProcessing/forceCoeffs/$last/coefficient.dat
echo '# Time Cd Cs Cl' > $out
awk -v s=$last 'BEGIN { for (i = s + 1; i <= s + 260; i++) printf "%d %.6f 0 0.1\\n", i, VALUE }' >> $out
echo 'smoothSolver:  Solving for Ux, Initial residual = 1e-05, Final residual = 1e-06'
echo 'GAMG:  Solving for p, Initial residual = 1e-04, Final residual = 1e-06'
n=0; while ! grep -q '^stopAt.*writeNow' system/controlDict && [ $n -lt 100 ]; do sleep 0.05; n=$((n + 1)); done
"""
GRADIENT = """
cat > '0/grad(Phi)' <<X
FoamFile { version 2.0; format ascii; class volVectorField; object grad; }
dimensions [0 1 -1 0 0 0 0];
internalField nonuniform List<vector> 1((-1 0 0));
X
"""
CHECK = """
echo '    cells:            16000'
echo '    Number of regions: 1 (OK).'
echo '                    body     2485     2710  multiply connected'
echo '    Total volume = 1.0.  Cell volumes OK.'
echo '    Mesh non-orthogonality Max: 49.2 average: 9.5'
echo '    Max skewness = 2.4 OK.'
"""
TOOLS = {
    "blockMesh": "mkdir -p constant/polyMesh",
    "snappyHexMesh": "",
    "checkMesh": CHECK,
    "potentialFoam": "",
    "postProcess": GRADIENT,
    "simpleFoam": SOLVE.replace("VALUE", "0.3 + 0.001 * sin(i / 3)"),
}


@pytest.fixture
def fakes(tmp_path, monkeypatch):
    """A function that puts fakes of all tools on the PATH, some of them with another body; returns their calls."""
    folder = tmp_path / "bin"

    def put(**bodies):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for name, body in {**TOOLS, **bodies}.items():
            script = folder / name
            help_ = "case $1 in -help) echo 'Using: OpenFOAM-v2312 (2312) - visit www.openfoam.com'; exit;; esac"
            script.write_text(f"#!/bin/sh\n{help_}\necho {name} >> {tmp_path}/calls\n{body}\necho End\n")
            script.chmod(script.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
        return tmp_path / "calls"

    return put


def measure(tmp_path, **options):
    return OpenFoamDrag(**{"placements": 1, "folder": str(tmp_path / "kept"), "timeout_s": 60.0, **options})


def outcome(measure, mesh=None):
    with pytest.raises(FlowError) as caught:
        measure(car() if mesh is None else mesh)
    assert caught.value.outcome in OUTCOMES and caught.value.outcome in str(caught.value)
    return caught.value


def test_a_flow_from_its_files_to_its_coefficients(tmp_path, fakes):
    calls = fakes()
    values = dict(zip(OpenFoamDrag.names, measure(tmp_path)(car()), strict=True))
    assert values["drag"] == pytest.approx(0.3, abs=1e-3) and values["lift"] == pytest.approx(0.1)
    assert values["frontal_area"] == pytest.approx(1.6 * 0.6 + 1.4 * 0.45) and values["cells"] == 16000
    assert calls.read_text().split() == [*TOOLS]
    measure(tmp_path)(car(10.0))  # another unit, the same flow
    assert calls.read_text().split() == [*TOOLS]
    flow = measure(tmp_path).solve(car())
    assert flow.openfoam == "openfoam.com 2312" and flow.half and flow.placed[0].iterations == 200


def test_the_case_says_what_was_asked(tmp_path, fakes):
    from foamlib import FoamFile

    fakes()
    measure(tmp_path, ground="fixed", reynolds=1e6)(car())
    (settings,) = (tmp_path / "kept").glob("*/system/settings")
    told = FoamFile(settings)
    assert told["groundFlow"] == "noSlip" and told["middleType"] == "symmetryPlane"
    assert told["viscosity"] == pytest.approx(1e-6)
    assert told["frontalArea"] == pytest.approx((1.6 * 0.6 + 1.4 * 0.45) / 16 / 2)  # half a model, half its area
    assert "// " in settings.read_text().split("viscosity")[1].splitlines()[0]  # its comments stay


def test_a_solver_that_is_told_to_stop_finds_its_settings_whole(tmp_path, fakes):
    fakes()
    measure(tmp_path, placements=1)(car())
    (settings,) = (tmp_path / "kept").glob("*/system/controlDict")
    whole, done, read = settings.read_text(), threading.Event(), []

    def reader():
        while not done.is_set():
            read.append(settings.read_text())

    other = threading.Thread(target=reader)
    other.start()
    for _ in range(200):
        case.stop(settings.parent.parent)
        case.go_on(settings.parent.parent)
    done.set()
    other.join()
    assert len(read) > 50
    assert {text.replace("writeNow", "endTime") for text in read} == {whole.replace("writeNow", "endTime")}


def test_value_and_interval_without_a_folder_are_one_flow(tmp_path, fakes):
    calls = fakes()
    made = measure(tmp_path, folder="", placements=2, first=7)
    values, ends = made(car()), made.interval(car(), 0.95)
    assert calls.read_text().split() == [*TOOLS] * 2
    assert (ends[:, 0] <= values).all() and (values <= ends[:, 1]).all() and ends[0, 1] > ends[0, 0]
    assert not made.outside(car())
    assert made.outside(trimesh.creation.box((1, 4, 0.2)))


@pytest.mark.parametrize(
    "option", sorted({f.name for f in fields(OpenFoamDrag)} - {"up", "folder"})
)  # turns the body, keeps
def test_results_are_kept_by_every_setting_that_matters(option, tmp_path, fakes):
    other = {
        "level": "medium", "placements": 2, "first": 1, "reynolds": 5e6, "wind": "-x", "half": "no", "ground": "fixed",
        "clearance": 0.01, "command": "env", "timeout_s": 50.0, "workers": 2,
    }  # fmt: skip
    calls = fakes()
    measure(tmp_path)(car())
    measure(tmp_path, **{option: other[option]})(car())
    same = option in ("command", "timeout_s", "workers")
    assert calls.read_text().split().count("blockMesh") == (1 if same else 2)


@pytest.mark.parametrize(
    ("tools", "name"),
    [
        ({}, ""),
        ({"checkMesh": CHECK.replace("16000", "400")}, "bad-grid"),
        ({"simpleFoam": SOLVE.replace("VALUE", "1e33")}, "diverged"),
        ({"simpleFoam": "mkdir 100; exit 1"}, "failed"),
    ],
)
def test_large_files_stay_only_where_they_are_gone_on_from(tools, name, tmp_path, fakes):
    fakes(**tools)
    made = measure(tmp_path)
    assert outcome(made).outcome == name if name else len(made(car()))
    for record in (tmp_path / "kept").glob("*.json"):
        folders = {path.name for path in record.with_suffix("").iterdir() if path.is_dir()}
        assert folders - {"postProcessing"} == {"system"}
    assert bool([*(tmp_path / "kept").glob("*/constant/polyMesh")]) == (name == "failed")


def test_absent_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "no simpleFoam on the PATH" in str(outcome(measure(tmp_path)))
    assert outcome(measure(tmp_path, command="no-such-container run")).outcome == "absent"


def test_a_tool_that_is_missing_from_a_container_is_told(tmp_path, fakes):
    fakes(snappyHexMesh="exit 127")
    assert outcome(measure(tmp_path, command="env A={case}")).outcome == "absent"


def test_tools_run_on_another_host_where_a_shell_takes_words_apart(tmp_path, fakes):
    fakes()
    ssh = tmp_path / "bin" / "ssh"
    ssh.write_text('#!/bin/sh\nshift\ncd /\nexec sh -c "$*"\n')  # as ssh does: one line of all words
    ssh.chmod(0o755)
    made = measure(tmp_path, command="ssh cluster cd {case} && timeout 1h")
    assert made.solve(car()).drag == pytest.approx(0.3, abs=1e-3)


def test_a_version_that_is_not_told_is_absent(tmp_path, monkeypatch):
    script = tmp_path / "simpleFoam"
    script.write_text("#!/bin/sh\necho hello\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with pytest.raises(FlowError, match="does not say its version: hello"):
        installed("", tmp_path)


def test_divergence_is_told_and_ended_at_once(tmp_path, fakes):
    endless = SOLVE.replace("VALUE", "i < 50 ? 0.3 : 1e33").replace("-lt 100", "-lt 1000")
    fakes(simpleFoam=endless)
    began = time.monotonic()
    error = outcome(measure(tmp_path))
    assert error.outcome == "diverged" and "1e+33" in str(error) and "log.simpleFoam" in str(error)
    assert time.monotonic() - began < 20


def test_a_floating_point_exception_of_the_solver_is_a_divergence(tmp_path, fakes):
    fakes(simpleFoam="kill -FPE $$")
    assert outcome(measure(tmp_path)).outcome == "diverged"


def test_what_never_settles_is_told(tmp_path, fakes):
    calls = fakes(simpleFoam=SOLVE.replace("VALUE", "0.3 + i / 1000").replace("-lt 100", "-lt 1"))
    error = outcome(measure(tmp_path))
    assert error.outcome == "not-settled" and "260 iterations" in str(error)
    outcome(measure(tmp_path))  # it would come again: it is kept
    assert calls.read_text().split().count("simpleFoam") == 1


def test_a_flow_with_large_residuals_has_not_settled(tmp_path, fakes):
    fakes(simpleFoam=TOOLS["simpleFoam"].replace("1e-04", "0.3"))
    assert "residual 0.3" in str(outcome(measure(tmp_path)))


@pytest.mark.parametrize(
    ("was", "now", "what"),
    [
        ("16000", "400", "400 cells, expected 1000 or more"),
        ("regions: 1", "regions: 3", "a part of the air is cut off"),
        ("2485", "0", "no face on the body"),
        ("volume = 1.0", "volume = 1e9", "the air has got into it"),
        ("skewness = 2.4", "skewness = 12", "skewness up to 12"),
        ("Max: 49.2", "Max: 88", "non-orthogonality up to 88"),
        ("    Mesh non", " ***Zero or negative cell volume detected\n    Mesh non", "negative cell volume"),
    ],
)
def test_a_bad_grid_is_refused_saying_why(was, now, what, tmp_path, fakes):
    assert was in CHECK
    calls = fakes(checkMesh=CHECK.replace(was, now))
    error = outcome(measure(tmp_path))
    assert error.outcome == "bad-grid" and what in str(error)
    assert "simpleFoam" not in calls.read_text()


def test_a_tool_with_an_error_of_its_own_is_told_with_its_words(tmp_path, fakes):
    fakes(potentialFoam="echo '--> FOAM FATAL ERROR:'; echo cannot find entry nu; exit 1")
    error = outcome(measure(tmp_path))
    assert error.outcome == "failed" and "cannot find entry nu" in str(error)


FATAL = "echo '--> FOAM FATAL ERROR:'; echo 'Did not find a cell'"


@pytest.mark.parametrize("tool", ["snappyHexMesh", "checkMesh"])
@pytest.mark.parametrize("end", ["exit 1", "exit 0", "kill -ABRT $$"])
def test_a_mesher_with_an_error_of_its_own_has_made_no_grid(tool, end, tmp_path, fakes):
    calls = fakes(**{tool: f"{FATAL}; {end}"})
    error = outcome(measure(tmp_path))
    assert error.outcome == "bad-grid" and "Did not find a cell" in str(error)
    tried = calls.read_text()
    outcome(measure(tmp_path))  # it would come again: it is kept
    assert calls.read_text() == tried


@pytest.mark.parametrize(
    ("end", "name"),
    [
        ("exit 255", "failed"),  # ssh lost
        (f"{FATAL}; exit 255", "failed"),
        (f"{FATAL}; exit 125", "failed"),  # docker's own
        ("exit 1", "failed"),
        ("echo '--> FOAM FATAL IO ERROR:'; exit 1", "failed"),  # a file, not the grid
        ("echo '--> FOAM FATAL ERROR:'; echo 'cannot find file \"system/controlDict\"'; exit 1", "failed"),
        ("echo std::bad_alloc; kill -ABRT $$", "failed"),
        ("exit 134", "failed"),
        ("kill -SEGV $$", "failed"),
        ("kill -FPE $$", "failed"),
        ("exit 137", "killed"),
        ("kill -KILL $$", "killed"),
    ],
)
@pytest.mark.parametrize("tool", ["blockMesh", "snappyHexMesh", "checkMesh"])
def test_a_mesher_that_was_broken_off_says_nothing_of_the_grid(end, name, tool, tmp_path, fakes):
    fakes(**{tool: end})
    assert outcome(measure(tmp_path)).outcome == name
    fakes()
    measure(tmp_path)(car())  # nothing is kept


@pytest.mark.parametrize("code", [125, 255])
def test_a_failure_of_what_runs_a_tool_elsewhere_is_told_as_that(code, tmp_path, fakes):
    fakes(simpleFoam=f"exit {code}")
    assert f"was lost by what runs it, with exit code {code}" in str(outcome(measure(tmp_path)))


def test_a_tool_that_cannot_be_started_says_nothing_of_the_grid(tmp_path, fakes, monkeypatch):
    fakes()
    start = subprocess.Popen

    def short(words, **options):
        if "snappyHexMesh" in words:
            raise OSError(12, "Cannot allocate memory")
        return start(words, **options)

    monkeypatch.setattr(subprocess, "Popen", short)
    error = outcome(measure(tmp_path))
    assert error.outcome == "failed" and "cannot be started" in str(error)


def test_a_full_disk_is_told_before_and_during(tmp_path, fakes, monkeypatch):
    fakes(snappyHexMesh="echo 'write failed: No space left on device'; exit 1")
    assert outcome(measure(tmp_path)).outcome == "disk-full"
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    assert "free disk" in str(outcome(measure(tmp_path, first=3)))


def test_a_record_that_cannot_be_written_is_a_full_disk(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FlowError, match="disk-full"):
        kept.write_pressure(tmp_path / "a.npz", np.zeros((1, 3)), np.zeros(1))
    assert not list(tmp_path.iterdir())  # nothing half-written is left


def test_time_is_up(tmp_path, fakes):
    fakes(simpleFoam="sleep 30")
    began = time.monotonic()
    assert outcome(measure(tmp_path, timeout_s=1.5)).outcome == "timed-out"
    assert time.monotonic() - began < 15


FIELDS = "for f in U p k omega nut phi; do echo x > 100/$f; done"


def test_a_killed_solver_goes_on_where_it_was(tmp_path, fakes):
    half = SOLVE.replace("260", "100").replace("VALUE", "0.3").split("n=0;")[0] + f"mkdir 100; {FIELDS}; kill -KILL $$"
    calls = fakes(simpleFoam=half)
    error = outcome(measure(tmp_path))
    assert error.outcome == "killed" and "SIGKILL" in str(error)
    calls.unlink()
    fakes()
    flow = measure(tmp_path).solve(car())
    assert calls.read_text().split() == ["simpleFoam"]  # grid and start are there
    assert flow.placed[0].iterations == 200 and flow.drag == pytest.approx(0.3, abs=1e-3)


def test_a_grid_that_was_broken_off_is_made_again(tmp_path, fakes):
    calls = fakes(snappyHexMesh="kill -TERM $$")
    assert outcome(measure(tmp_path)).outcome == "killed"
    calls.unlink()
    fakes()
    measure(tmp_path)(car())
    assert calls.read_text().split() == [*TOOLS]


def test_what_cannot_be_gone_on_with_is_begun_anew(tmp_path, fakes):
    half = SOLVE.replace("260", "100").replace("VALUE", "0.3").split("n=0;")[0] + f"mkdir 100; {FIELDS}; kill -KILL $$"
    fakes(simpleFoam=half)
    outcome(measure(tmp_path))
    broken = "if [ -d 100 ]; then echo '--> FOAM FATAL IO ERROR: premature end'; exit 1; fi\n" + TOOLS["simpleFoam"]
    calls = fakes(simpleFoam=broken)
    assert measure(tmp_path).solve(car()).placed[0].iterations == 200
    assert calls.read_text().split().count("simpleFoam") == 3


def test_an_interrupt_ends_the_tool(tmp_path, fakes, monkeypatch):
    fakes(simpleFoam="echo $$ > pid; sleep 60")

    def interrupted(self):
        if list((tmp_path / "kept").glob("*/pid")):
            raise KeyboardInterrupt
        return False

    monkeypatch.setattr("lampopt_openfoam.flow._Watch.look", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure(tmp_path)(car())
    (pid,) = (tmp_path / "kept").glob("*/pid")
    time.sleep(0.2)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), signal.SIGCONT)


def test_a_tool_ends_with_the_process_that_is_killed(tmp_path, fakes):
    """Debian has setpriv; without it a tool that was left running is ended when the case is gone on with."""
    if not _ending_with_us():
        pytest.skip("no setpriv that knows --pdeathsig")
    fakes(simpleFoam="echo $$ > pid; exec sleep 60")
    car().export(tmp_path / "car.stl")
    code = (
        "import trimesh; from lampopt_openfoam.drag import OpenFoamDrag\n"
        "OpenFoamDrag(folder='kept', placements=1)(trimesh.load('car.stl'))"
    )
    ours = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path)
    while not (said := [path for path in tmp_path.glob("kept/*/pid") if path.read_text()]):
        assert ours.poll() is None
        time.sleep(0.05)
    tool = Path("/proc") / said[0].read_text().strip()
    assert tool.exists()
    ours.kill()
    ours.wait()
    for _ in range(100):
        with suppress(FileNotFoundError, ProcessLookupError):
            if "State:\tZ" not in (tool / "status").read_text():  # nobody may be there to bury it
                time.sleep(0.05)
                continue
        return
    raise AssertionError("it goes on without us")


@pytest.mark.parametrize("what", ["stop", "start_from_potential"])
def test_a_disk_that_fills_up_anywhere_has_a_name(what, tmp_path, fakes, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    fakes()
    with monkeypatch.context() as patch:
        patch.setattr(case, what, full)
        error = outcome(measure(tmp_path))
    assert (error.outcome, error.passing) == ("disk-full", True) and "No space left" in str(error)
    measure(tmp_path)(car())


def test_a_run_of_another_crew_is_the_same_measure(tmp_path):
    """Where and how fast it is solved is nothing that values depend on; the rest is."""
    slow = Spec("openfoam-drag", folder=str(tmp_path), workers=2, timeout_s=9.0)
    plugins = Plugins.load()
    other = Spec("openfoam-drag", level="medium")
    who = [identity.told(spec, plugins.make("measure", spec), plugins) for spec in (slow, Spec("openfoam-drag"), other)]
    assert who[0] == who[1] != who[2]
    assert OpenFoamDrag().depends_on().keys() == {f.name for f in fields(OpenFoamDrag)} - {*OPERATIONAL}


def test_labels_know_by_what_they_were_made_and_no_version_takes_anothers(tmp_path, fakes, monkeypatch):
    plugins = Plugins.load([("small", small.Plugin())])
    bank, store = small.bank(small.boxes(count=3)), tmp_path / "a.lamp"
    calls = fakes()
    real = OpenFoamDrag.__call__
    monkeypatch.setattr(OpenFoamDrag, "program", lambda self: VERSION[0])
    VERSION, asked = ["openfoam.com 1912"], []

    def until(self, mesh):
        if len(asked) == 2:
            raise KeyboardInterrupt
        asked.append(mesh)
        return real(self, mesh)

    def label(**options):
        return lampopt.label(
            bank, Spec("openfoam-drag", placements=1, **options), ["drag"], store=store, plugins=plugins
        )

    with monkeypatch.context() as patch:
        patch.setattr(OpenFoamDrag, "__call__", until)
        with pytest.raises(KeyboardInterrupt):
            label()
    VERSION[0] = "openfoam.com 2312"
    made = label(workers=2, timeout_s=77.0)
    assert len(list((tmp_path / "a.lamp.measured").glob("*.json"))) == 3
    by = json.loads(made.provenance["labelled.drag"])
    assert (by["by"], by["program"]) == ("openfoam-drag.drag", "openfoam.com 2312")
    assert by["options"]["level"] == "coarse" and "workers" not in by["options"]
    assert calls.read_text().split().count("simpleFoam") == 3  # the flows themselves know their version
    VERSION[0] = "openfoam.com 2406"
    assert small.same(label(), made)  # what is finished is read


def test_what_a_killed_process_left_running_is_ended(tmp_path):
    from lampopt_openfoam.running import end_left_over

    left = subprocess.Popen(["sleep", "60"], cwd=tmp_path, start_new_session=True)
    (tmp_path / "running").write_text(str(left.pid))
    end_left_over(tmp_path)
    assert left.wait(5) == -signal.SIGKILL
    other = subprocess.Popen(["sleep", "60"], cwd="/", start_new_session=True)  # not of this case
    (tmp_path / "running").write_text(str(other.pid))
    end_left_over(tmp_path)
    assert other.poll() is None
    other.kill()
    other.wait()


@pytest.mark.parametrize("damage", ["", "{", '{"drag": 1}', "null", '{"number": 0, "drag": NaN}'])
def test_a_damaged_record_is_made_again(damage, tmp_path, fakes):
    calls = fakes()
    first = measure(tmp_path)(car())
    (record,) = (tmp_path / "kept").glob("*.json")
    whole = json.loads(record.read_text())
    record.write_text(damage)
    assert measure(tmp_path)(car()) == pytest.approx(first)
    assert calls.read_text().split().count("blockMesh") == 2
    assert json.loads(record.read_text())["drag"] == whole["drag"]


@pytest.mark.parametrize("damage", [None, b"", b"junk", b"PK\x03\x04", "half", "flipped", "other"])
def test_a_record_without_its_picture_is_made_again(damage, tmp_path, fakes):
    calls = fakes()
    first = measure(tmp_path)(car())
    (picture,) = (tmp_path / "kept").glob("*.npz")
    whole = picture.read_bytes()
    if damage is None:
        picture.unlink()
    elif damage == "other":
        np.savez(picture, points=np.zeros((2, 3)), pressure=np.zeros(3))
    else:
        cut = {"half": whole[: len(whole) // 2], "flipped": whole[:60] + b"\xff" * 40 + whole[100:]}
        picture.write_bytes(cut.get(damage, damage))
    assert measure(tmp_path)(car()) == pytest.approx(first)
    assert calls.read_text().split().count("blockMesh") == 2
    points, pressure = kept.read_pressure(picture)
    assert points.shape == (0, 3) and pressure.shape == (0,)


def test_designs_are_compared_on_the_same_placements(tmp_path, fakes):
    fakes()
    made = measure(tmp_path, placements=3)
    told = made.compared(car(), car(2.0))
    assert told.drag.value == 0 and told.drag.verdict == "not told apart" and len(told.drag.by_placement) == 3
    assert told.drag_area.value == pytest.approx(-0.75)
    whole = replace(made, half="no").solve(car())
    with pytest.raises(InputError, match="both of halves or both whole"):
        paired(told.design, whole)
    with pytest.raises(InputError, match="placements: expected two or more"):
        measure(tmp_path).compared(car(), car(2.0))
    with pytest.raises(InputError, match="two or more common placements"):
        paired(told.design, measure(tmp_path, placements=2, first=9).solve(car()))


def test_a_placement_without_a_grid_of_one_design_serves_neither(tmp_path, fakes, monkeypatch):
    fakes()
    tall = car().apply_scale([1, 1, 1.2])
    height = cleaned(car(), **FLOW).height
    bad = {(True, 0), (False, 1)}  # of the lower one, of the taller one

    def solved(surface, grid, *rest, **options):
        if (surface.height == height, grid.number) in bad:
            raise FlowError("no grid", "bad-grid")
        return flow.solved(surface, grid, *rest, **options)

    monkeypatch.setattr("lampopt_openfoam.drag.solved", solved)
    made = measure(tmp_path, placements=2)
    for told in (made.compared(tall, car()), replace(made, folder="").compared(car(), tall)):
        assert [one.number for one in told.design.placed] == [one.number for one in told.reference.placed] == [2, 3]
        assert len(told.drag.by_placement) == 2 and "another placement serves" in told.design.notes[-1]
    bad.add((False, 3))
    with pytest.raises(FlowError, match="no grid") as caught:
        measure(tmp_path, placements=2, clearance=0.0).compared(car(), tall)
    assert caught.value.outcome == "bad-grid"


def test_workers_solve_at_the_same_time_and_change_nothing(tmp_path, fakes):
    meet = f"""case $PWD in *alone*) ;; *)
    n=0; touch {tmp_path}/here.$$
    while [ $(ls {tmp_path}/here.* | wc -l) -lt 2 ] && [ $n -lt 200 ]; do sleep 0.05; n=$((n + 1)); done
    [ $(ls {tmp_path}/here.* | wc -l) -ge 2 ] || exit 1;; esac
    """  # the mesher of one placement waits for that of the other
    seen = "0.3 + 0.00001 * '$(grep -o 'xMin[^;]*' system/settings | tr -dc 0-9 | tail -c 3)' + 0.001 * sin(i / 3)"
    fakes(snappyHexMesh=meet, simpleFoam=SOLVE.replace("VALUE", seen))
    together = measure(tmp_path, placements=2, workers=2).solve(car())
    alone = measure(tmp_path, placements=2, folder=str(tmp_path / "alone")).solve(car())
    assert [(p.number, p.drag) for p in together.placed] == [(p.number, p.drag) for p in alone.placed]
    assert together.placed[0].drag != together.placed[1].drag


def test_what_others_solve_is_ended_when_one_fails(tmp_path, fakes):
    fakes(snappyHexMesh=f"mkdir {tmp_path}/first 2>/dev/null && {{ sleep 0.5; exit 1; }}; sleep 30")
    began = time.monotonic()
    assert outcome(measure(tmp_path, placements=4, workers=2)).outcome == "failed"
    assert time.monotonic() - began < 15
    assert (tmp_path / "calls").read_text().split().count("snappyHexMesh") == 2  # the others were never begun


def test_who_waits_for_another_process_stops_waiting_when_a_placement_fails(tmp_path, fakes):
    fakes()
    measure(tmp_path)(car())
    (record,) = (tmp_path / "kept").glob("*.json")
    record.unlink()
    fakes(snappyHexMesh="exit 1")  # of the other placement
    free = threading.Timer(20, lambda: lock.release(force=True))
    with FileLock(record.with_suffix(".lock"), thread_local=False) as lock:  # as a process does that solves the first
        free.start()
        began = time.monotonic()
        assert outcome(measure(tmp_path, placements=2, workers=2)).outcome == "failed"
        assert time.monotonic() - began < 15
        free.cancel()


@pytest.mark.parametrize("workers", [1, 3])
def test_placements_without_a_grid_are_made_up_for_whoever_solves(workers):
    def solve(number, stop):
        if number in (1, 4):
            raise FlowError("no grid", "bad-grid")
        return number

    done, bad = on_placements(solve, 0, 4, workers)
    assert done == [0, 2, 3, 5]
    assert len(bad) == 2
    with pytest.raises(FlowError, match="no grid"):
        on_placements(lambda number, stop: solve(1, stop), 0, 4, workers)


def test_a_study_goes_on_past_a_level_that_fails(tmp_path, fakes):
    fakes(checkMesh=f"grep -q '^nx *80' system/settings && {{ {FATAL}; exit 1; }}\n" + CHECK)
    told = measure(tmp_path).refined(car())
    assert [*told.flows] == ["coarse", "fine"] and told.drag is None
    assert "bad-grid" in told.failures["medium"]
    fakes()
    told = measure(tmp_path, folder=str(tmp_path / "other")).refined(car())
    assert len(told.flows) == 3 and told.drag is not None and not told.drag.monotone


def test_a_study_of_which_nothing_is_solved_raises(tmp_path, fakes):
    fakes(checkMesh=f"{FATAL}; exit 1")
    assert outcome(measure(tmp_path).refined).outcome == "bad-grid"
    with pytest.raises(InputError, match="levels: expected one or more"):
        measure(tmp_path).refined(car(), [])


def test_the_cli_tells_people_and_programs(tmp_path, fakes, capsys):
    from lampopt import cli

    fakes()
    mesh, folder = tmp_path / "car.stl", str(tmp_path / "kept")
    car().export(mesh)
    options = ["--folder", folder, "--set", "placements=2"]
    assert cli.main(["flow", str(mesh), *options, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["drag"]["value"] == pytest.approx(0.3, abs=1e-3) and told["frontal_area"]["unit"] == "m^2"
    assert cli.main(["flow", str(mesh), "--against", str(mesh), *options, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["change"]["drag"]["verdict"] == "not told apart"
    assert cli.main(["flow-study", str(mesh), *options, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [*told["levels"]] == ["coarse", "medium", "fine"] and told["extrapolated"]["kind"] == "assumed"
    for command in (["flow", str(mesh), "--against", str(mesh)], ["flow-study", str(mesh)]):
        assert cli.main([*command, *options]) == 0
        assert "drag" in capsys.readouterr().err
    fakes(simpleFoam="kill -FPE $$")
    assert cli.main(["flow", str(mesh), "--folder", str(tmp_path / "new"), "--json"]) == 2
    assert "diverged" in json.loads(capsys.readouterr().out)["error"]["message"]
    assert cli.main(["flow-study", str(mesh), "--levels", "finest"]) == 2


def test_the_cli_says_when_the_measure_is_not_there(tmp_path, monkeypatch, capsys):
    from lampopt import cli

    monkeypatch.setenv("LAMPOPT_BLOCK", "openfoam")
    assert cli.main(["flow", str(tmp_path / "car.stl")]) == 2
    assert "the measure openfoam-drag is not there" in capsys.readouterr().err


def test_templates_are_whole_and_every_setting_is_used():
    from foamlib import FoamFile

    text = "".join(path.read_text() for path in case.TEMPLATES.glob("*/*") if path.name != "settings")
    settings = FoamFile(case.TEMPLATES / "system" / "settings")
    for name in settings:
        if name != "FoamFile":
            assert f"${name}" in text, name
    made = grid.Grid("coarse", 0, 0.4, 0.3, True, "fixed", 0.0).settings()
    given = case.settings(reynolds=1e6, ground="none", half=True, frontal_area=0.1, iterations=10)
    assert set(made) | set(given) <= set(settings)
    for ground in case.GROUND.values():
        assert set(ground) <= set(settings)


def test_a_solver_notices_at_once_that_it_is_to_stop(tmp_path):
    case.write(tmp_path / "case", {}, b"")
    control = tmp_path / "case" / "system" / "controlDict"
    case.go_on(tmp_path / "case")
    before = control.stat().st_mtime
    case.stop(tmp_path / "case")
    assert control.stat().st_mtime > before + 60  # OpenFOAM asks for ten seconds between two changes
    assert "stopAt writeNow;" in " ".join(control.read_text().split())


def test_coefficients_are_read_by_their_columns(tmp_path):
    for start, rows in (("0", "1 9 0.3 7 0.1\n2 9 0.31 7 0.1\n3 9 0.9 7 0.1\n"), ("2", "3 9 0.32 7 0.1\n4 9 0.3")):
        folder = tmp_path / "postProcessing" / "forceCoeffs" / start
        folder.mkdir(parents=True)
        (folder / "forceCoeffs.dat").write_text("# Force coefficients\n# Time Cm Cd Cl(f) Cl\n" + rows)
    assert case.coefficients(tmp_path).tolist() == [[0.3, 0.1], [0.31, 0.1], [0.32, 0.1]]
    assert case.coefficients(Path(tmp_path) / "nothing").shape == (0, 2)


def test_a_lift_that_has_not_settled_is_what_is_told():
    """Beside a drag that stands still it is the reason, so the words name it."""
    n = np.arange(400)
    told = judged(np.column_stack([np.full(400, 0.35), 0.5 * np.sin(n / 60)]), 0.005)
    assert told.state == "settling"
    assert re.search(r"drag 0\.3500 ± 0\.0000.*lift ± 0\.\d+, asked for ± 0\.02", told.message)
