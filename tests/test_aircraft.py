"""Measures of aircraft against wings in closed form, the family `bwb`, and marching cubes of it."""

from functools import partial

import igl
import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes

from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.plugins import Plugins
from lampopt.protocols import Gradient
from lampopt.testing import check_measure
from lampopt_families.bwb import HIGH, LOW, NAMES, THICKNESS, bwb_mesh, camber, half_thickness, stations
from lampopt_measure.aircraft import Bwb, Stations, Wing, example_wing
from lampopt_measure.silhouette import FrontalArea

MIDDLE = (np.array(LOW) + HIGH) / 2
HALF = (np.array(HIGH) - LOW) / 2
ORDER = [Bwb.names.index(name) for name in ("B1", "B2", "B3", "C2", "C3", "C4", "S1", "S2", "S3")]


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def draws(count, factor, seed):
    """Parameters from the range widened by `factor`, drawn again where there is no aircraft."""
    draw, rows = np.random.default_rng(seed), []
    while len(rows) < count:
        row = MIDDLE + factor * HALF * draw.uniform(-1, 1, 9)
        if (row[:3] > 20).all():  # a narrower panel is less than a few cells
            rows.append(row)
    return rows


def cells(parameters, count):
    """Marching cubes of the signed distance to the true mesh, `count` cells along each side of its box.

    Farther than a cell from the surface the distance is a rough one, with the right sign: no edge is cut there.
    """
    truth, at = bwb_mesh(parameters), stations(parameters)
    pad = 0.03 * truth.extents
    step = (truth.extents + 2 * pad) / count
    axes = [truth.bounds[0][k] - pad[k] + step[k] * np.arange(count + 1) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    x, y, z = points.T
    nose, chord, thickness = (np.interp(y, at.y, v) for v in (at.leading_edge, at.chord, at.thickness))
    share = np.clip((x - nose) / chord, 0, 1)
    height = np.abs(z - chord * camber(share)) - chord * thickness * half_thickness(share)
    distance = np.max([height, nose - x, x - nose - chord, -y, y - at.y[-1]], axis=0)
    near = np.abs(distance) < np.linalg.norm(step)
    distance[near] = igl.signed_distance(points[near], np.array(truth.vertices), np.array(truth.faces))[0]
    vertices, faces, _, _ = marching_cubes(distance.reshape((count + 1,) * 3), 0, spacing=tuple(step))
    mesh = trimesh.Trimesh(vertices + truth.bounds[0] - pad, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


@pytest.fixture(scope="module")
def cut():
    """Parameters and marching cubes of one aircraft."""
    (parameters,) = draws(1, 1, seed=5)
    return parameters, cells(parameters, 64)


def rectangle(span=3.0, chord=0.5, thickness=0.06):
    return trimesh.creation.box((chord, span, thickness))


def mirrored(mesh):
    turned = mesh.copy()
    turned.vertices = np.asarray(mesh.vertices) * (1, -1, 1)
    turned.invert()
    return turned


# wing


def test_rectangular_wing():
    np.testing.assert_allclose(Wing()(rectangle()), [3, 1.5, 6, 0.5], rtol=1e-9)


def test_half_model_counts_twice():
    np.testing.assert_allclose(Wing(model="half")(rectangle()), [6, 3, 12, 0.5], rtol=1e-9)


@pytest.mark.parametrize("half", [True, False])
def test_wing_of_the_family(half):
    """Area of the trapezoids between the stations, twice."""
    at = stations(MIDDLE)
    area = ((at.chord[1:] + at.chord[:-1]) * np.diff(at.y)).sum()
    span = 2 * at.y[-1]
    values = Wing()(bwb_mesh(MIDDLE, half=half))
    np.testing.assert_allclose(values, [span, area, span**2 / area, area / span], rtol=1e-6)


def test_area_that_marching_cubes_cut_off(cut):
    """Seen from above a hundredth of the area is gone; with the tails that the thickness tells a sixth of that is."""
    parameters, mesh = cut
    at = stations(parameters)
    area = ((at.chord[1:] + at.chord[:-1]) * np.diff(at.y)).sum()
    assert 2 * FrontalArea(forward="z", up="x")(mesh)[0] < 0.99 * area
    assert Wing()(mesh)[1] == pytest.approx(area, rel=2.5e-3)


def test_a_blunt_tail_ends_where_it_ends():
    """The last twentieth of each chord pressed flat into a wall: nothing is added beyond."""
    mesh, at = bwb_mesh(MIDDLE), stations(MIDDLE)
    x, y, z = np.asarray(mesh.vertices).T
    nose, chord = (np.interp(y, at.y, values) for values in (at.leading_edge, at.chord))
    mesh.vertices = np.stack([np.minimum(x, nose + 0.95 * chord), y, z], axis=1)
    area = ((at.chord[1:] + at.chord[:-1]) * np.diff(at.y)).sum()
    assert Wing()(mesh)[1] == pytest.approx(0.95 * area, rel=1e-6)


def tapered(taper, sweep, *, span=5.0, chord=1.0):
    """A wing on one side: a box whose tip is `taper` as long as its root and lies back by `sweep` [L]."""
    mesh = trimesh.creation.box((chord, span, 0.1)).apply_translation([chord / 2, span / 2, 0])
    for _ in range(4):
        mesh = mesh.subdivide()
    out = mesh.vertices[:, 1] / span
    mesh.vertices[:, 0] = mesh.vertices[:, 0] * (1 + (taper - 1) * out) + sweep * out
    return mesh


@pytest.mark.parametrize(("taper", "sweep"), [(0.5, 0), (0.78, 0), (0.82, 0), (0.9, 0), (0.85, 2)])
def test_a_half_wing_is_told_by_its_sections(taper, sweep):
    half = tapered(taper, sweep)
    whole = trimesh.util.concatenate([half, mirrored(half)])
    for mesh in (half, whole):
        assert Wing()(mesh)[:2] == pytest.approx([10, 5 * (1 + taper)], rel=1e-6)


@pytest.mark.parametrize("yaw_deg", [0.2, 1.0, 3.0])
@pytest.mark.parametrize(("taper", "sweep"), [(0.5, 0.5), (0.7, 0.0), (0.9, 2.0)])
def test_a_whole_wing_need_not_be_quite_straight(taper, sweep, yaw_deg):
    half = tapered(taper, sweep)
    whole = trimesh.util.concatenate([half, mirrored(half)])
    whole.apply_transform(trimesh.transformations.rotation_matrix(np.radians(yaw_deg), [0, 0, 1]))
    assert Wing()(whole)[0] == pytest.approx(10, rel=0.02)


def test_a_whole_wing_may_be_thicker_on_one_side():
    half = tapered(0.5, 0.5)
    other = mirrored(half)
    other.apply_scale([1, 1, 1.2])
    assert Wing()(trimesh.util.concatenate([half, other]))[:2] == pytest.approx([10, 7.5], rel=1e-6)


def test_what_may_be_half_or_whole_is_asked():
    """An untapered half swept back, and a whole one turned by two degrees: each section lies behind the last."""
    half, turned = tapered(1.0, 0.5), tapered(1.0, 0.0, span=10.0)
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.radians(2), [0, 0, 1]))
    for mesh in (half, turned):
        with pytest.raises(MeasureError, match="say model='half' or 'whole'"):
            Wing()(mesh)
    assert Wing(model="half")(half)[0] == pytest.approx(10)


def test_a_left_half_is_as_good_as_a_right_one():
    mesh = bwb_mesh(MIDDLE, chordwise=32, spanwise=50)
    for measure in (Wing(), Stations(), Bwb()):
        np.testing.assert_allclose(measure(mirrored(mesh)), measure(mesh), rtol=1e-6)


def test_whole_and_half_model_agree():
    half, whole = (bwb_mesh(MIDDLE, half=half, chordwise=32, spanwise=50) for half in (True, False))
    for measure in (Wing(), Stations(), Bwb()):
        np.testing.assert_allclose(measure(whole), measure(half), rtol=1e-5)


# stations


def test_stations_of_the_family():
    """At 60 and 80 % of the half span lies the third panel: its sweep, its thickness."""
    measure = Stations(stations="0.6,0.8")
    assert measure.names == ("sweep_60", "thickness_60", "sweep_80", "thickness_80")
    values = measure(bwb_mesh(MIDDLE))
    np.testing.assert_allclose(values[::2], MIDDLE[8], atol=0.01)
    np.testing.assert_allclose(values[1::2], THICKNESS[3], rtol=3e-3)


def test_thickness_where_it_tapers():
    """Half-way along the second panel, from 0.17 to 0.16 of the chord: as much of it before the station as behind."""
    half_span = MIDDLE[:3].sum()
    place = round((MIDDLE[0] + MIDDLE[1] / 2) / half_span, 6)
    _, thickness = Stations(stations=f"{place}")(bwb_mesh(MIDDLE))
    assert thickness == pytest.approx((THICKNESS[1] + THICKNESS[2]) / 2, abs=5e-5)


def test_stations_on_marching_cubes(cut):
    """The steps of 64 cells even out over the sections, beside the plane of symmetry too."""
    parameters, mesh = cut
    at = stations(parameters)
    first, *places = np.array([0.035, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9])
    assert (at.y[2] / at.y[3] < min(places) - 0.03) and at.y[1] / at.y[3] > first + 0.03
    values = Stations(stations=",".join(f"{place:g}" for place in (first, *places)))(mesh)
    assert values[0] == pytest.approx(parameters[6], abs=0.15)
    off = values[2::2] - parameters[8]
    assert np.sqrt(np.mean(off**2)) < 1.2  # 5.3 from sections a third as far apart
    np.testing.assert_allclose(values[3::2], THICKNESS[3], rtol=0.05)


def test_stations_of_a_rectangle():
    """A box has no round nose: its sections' own ends count."""
    np.testing.assert_allclose(Stations(stations="0.5")(rectangle()), [0, 0.12], atol=1e-9)


def test_names_of_stations():
    assert Stations(stations="0.125").names == ("sweep_12_5", "thickness_12_5")


@pytest.mark.parametrize("text", ["", "half", "0.5,0.5", "0.0", "0.5,1", "nan"])
def test_stations_that_are_none(text):
    with pytest.raises(InputError, match=r"stations: expected distinct shares of the half span from 0.035 to 0.95"):
        Stations(stations=text)


# bwb


@pytest.mark.parametrize(
    "parameters",
    [
        [150, 4, 450, 700, 230, 75, 50, 50, 32],
        # the third panel lies beyond where sections are taken; a kink's rounding was taken for the second one
        [173.3, 255.7, 11.6, 727.2, 174.4, 87.1, 62.7, 39.8, 43.5],
    ],
)
def test_a_panel_too_narrow_to_tell_is_refused(parameters):
    with pytest.raises(MeasureError, match=r"bwb: expected panels of at least 1% of the half span"):
        Bwb()(bwb_mesh(np.array(parameters)))


@pytest.mark.parametrize("factor", [1, 2])
def test_parameters_are_read_off_the_true_mesh(factor):
    """Lengths to 0.1 mm of 1000, angles to 0.05°, in range and out of it."""
    for parameters in draws(3, factor, seed=factor):
        values = Bwb()(bwb_mesh(parameters))
        np.testing.assert_allclose(values[ORDER][:6], parameters[:6], atol=0.1)
        np.testing.assert_allclose(values[ORDER][6:], parameters[6:], atol=0.05)
        assert abs(values[Bwb.names.index("C1")] - 1000) < 0.1


@pytest.mark.parametrize("half", [True, False])
def test_kinks_are_exact_where_facets_are_fine(half):
    values = Bwb()(bwb_mesh(MIDDLE, half=half, chordwise=160, spanwise=40))
    np.testing.assert_allclose(values[ORDER], MIDDLE, rtol=2e-5)


def test_parameters_are_read_off_marching_cubes(cut):
    """Cells of 16 mm along the chord, which cut nose and tail short by up to 4; the values are right to a part of it"""
    parameters, mesh = cut
    values = Bwb()(mesh)[ORDER]
    np.testing.assert_allclose(values[:6], parameters[:6], atol=1.5)
    np.testing.assert_allclose(values[6:], parameters[6:], atol=0.2)


def test_a_few_bad_sections_do_not_matter():
    """A spike that one vertex makes reaches the sections next to it only."""
    mesh = bwb_mesh(MIDDLE)
    clean = Bwb()(mesh)
    spoilt = mesh.copy()
    vertices = np.array(mesh.vertices)
    spike = int(np.abs(vertices - (480, 450, 10)).sum(axis=1).argmin())
    vertices[spike, 2] += 60
    spoilt.vertices = vertices
    np.testing.assert_allclose(Bwb()(spoilt), clean, rtol=1e-3)


def test_gradient_is_the_inverse_of_the_family():
    """Along the change of the mesh by a parameter, that parameter's value grows by one and no other's does."""
    made = partial(bwb_mesh, chordwise=128, spanwise=50)
    gradient, step = Bwb().gradient(made(MIDDLE))[ORDER], 1e-3
    changes = [
        (made(MIDDLE + step * one).vertices - made(MIDDLE - step * one).vertices) / (2 * step) for one in np.eye(9)
    ]
    np.testing.assert_allclose(np.einsum("pvk,qvk->pq", gradient, changes), np.eye(9), atol=1e-3)


def differences(measure, mesh, move, step):
    """Central differences of the values as the vertices move, (p,)."""
    ends = []
    for sign in (-1, 1):
        moved = mesh.copy()
        moved.vertices = np.asarray(mesh.vertices) + sign * step * move
        ends.append(measure(moved))
    return (ends[1] - ends[0]) / (2 * step)


@pytest.mark.parametrize("measure", [Wing(), Stations(), Bwb()], ids=["wing", "stations", "bwb"])
@pytest.mark.parametrize("half", [True, False])
def test_gradient_against_central_differences(measure, half):
    """Vertices of one y keep to one y: the plane of symmetry and a tip stay flat, of which a tilt has no derivative."""
    draw = np.random.default_rng(17 + half)
    mesh = bwb_mesh(MIDDLE + HALF * draw.uniform(-1, 1, 9), half=half, chordwise=48, spanwise=50)
    assert isinstance(measure, Gradient)
    x, y, z = (np.asarray(mesh.vertices) / np.ptp(mesh.vertices[:, 1])).T
    a, b, c, d = draw.uniform(20, 60, 4)
    move = np.stack(
        [a * np.sin(3 * y) + b * x + c * z, d * y + c * np.sin(2 * y), b * z * np.cos(y) + a * x * y], axis=1
    )
    slope = differences(measure, mesh, move, 1e-5)
    np.testing.assert_allclose((measure.gradient(mesh) * move).sum(axis=(1, 2)), slope, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("measure", [Wing(), Stations(), Bwb()], ids=["wing", "stations", "bwb"])
def test_gradient_on_marching_cubes(measure, cut):
    """A tapered stretch, on a mesh whose sections are ragged."""
    x, y, z = np.asarray(cut[1].vertices).T / 1000
    move = np.stack([30 * np.sin(2 * y) + 20 * x, 40 * y, 30 * z * (1 - y)], axis=1)
    slope = differences(measure, cut[1], move, 1e-5)
    np.testing.assert_allclose((measure.gradient(cut[1]) * move).sum(axis=(1, 2)), slope, rtol=1e-4, atol=1e-5)


# all of them


@pytest.mark.parametrize("measure", [Wing(), Stations(), Bwb()], ids=["wing", "stations", "bwb"])
def test_conformance(measure):
    check_measure(measure)


def test_they_come_in_by_the_front_door():
    plugins = Plugins.load()
    assert [plugins.make("measure", name) for name in ("wing", "stations", "bwb")] == [Wing(), Stations(), Bwb()]


@pytest.mark.parametrize("kind", [Wing, Stations, Bwb])
def test_what_is_no_wing(kind):
    with pytest.raises(EmptyMesh):
        kind()(trimesh.Trimesh())
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]], process=False)
    with pytest.raises(MeasureError, match="extends along y, got a flat mesh"):
        kind()(flat)
    with pytest.raises(InputError, match="model: expected 'half', 'whole' or ''"):
        kind(model="left")


@pytest.mark.parametrize("mesh", [rectangle(), trimesh.creation.icosphere(3), example_wing().convex_hull])
def test_what_has_no_three_panels(mesh):
    with pytest.raises(MeasureError, match="bwb: expected"):
        Bwb()(mesh)


def test_inward_faces_are_refused():
    mesh = bwb_mesh(MIDDLE, chordwise=16, spanwise=20)
    mesh.invert()
    with pytest.raises(MeasureError, match="turn the faces round"):
        Bwb(model="half")(mesh)


def test_a_weak_kink_beside_a_strong_one_is_found():
    """An aircraft of the range whose first kink turns the edges by 2° and 1°, the second by far more."""
    parameters = np.array([113.56, 127.25, 572.86, 655.33, 244.77, 64.36, 47.94, 50.19, 39.41])
    found = dict(zip(Bwb.names, Bwb()(bwb_mesh(parameters)), strict=True))
    assert [found[name] for name in NAMES] == pytest.approx(parameters, rel=1e-3)


def test_a_tail_behind_the_wing_is_told_by_the_stations():
    wing = bwb_mesh(MIDDLE)
    tail = wing.copy()
    tail.vertices = tail.vertices * [0.25, 0.4, 0.4] + [1300.0, 0.0, 100.0]
    with pytest.raises(MeasureError, match="expected one wing in each section across, got two parts"):
        Stations()(trimesh.util.concatenate([wing, tail]))
    pod = trimesh.creation.icosphere(3)
    pod.vertices = pod.vertices * [80, 20, 20] + [500.0, wing.extents[1] * 0.25, -90.0]
    below = trimesh.util.concatenate([wing, pod])
    np.testing.assert_allclose(Stations()(below), Stations()(wing), atol=1e-3)
