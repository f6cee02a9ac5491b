"""Coefficients of winged meshes by their sections, held against those of the aircraft that the meshes are of."""

import numpy as np
import pytest
from trimesh import Trimesh
from trimesh.util import concatenate

from lampopt.errors import InputError, MeasureError
from lampopt.testing import shapes
from lampopt_families.bwb import HIGH, LOW, bwb_mesh
from lampopt_families.bwb_aero import Condition, coefficients
from lampopt_families.wing_flow import WingFlow, airplane, sections

pytest.importorskip("aerosandbox", reason="AeroSandbox (extra aero) is not installed")
MIDDLE = (np.array(LOW) + HIGH) / 2


def aircraft(share=0.5, **options):
    mesh = bwb_mesh(np.array(LOW) + share * (np.array(HIGH) - LOW), **options)
    mesh.units = "mm"
    return mesh


@pytest.mark.parametrize(("method", "close"), [("aerobuildup", 0.02), ("vlm", 0.15)])  # drag by a lattice
def test_coefficients_are_those_of_the_aircraft(method, close):
    for share in (0.2, 0.8):
        parameters = np.array(LOW) + share * (np.array(HIGH) - LOW)
        cl, cd, cm, ld = WingFlow(method)(aircraft(share))
        true = coefficients(parameters, method)
        assert cl == pytest.approx(true.cl, rel=0.03)
        assert (cd, ld) == pytest.approx((true.cd, true.ld), rel=close)
        assert cm == pytest.approx(true.cm, abs=4e-3)


def test_half_whole_left_and_moved_along_are_one():
    right = aircraft()
    left = right.copy()
    left.vertices = left.vertices * [1, -1, 1]
    left.invert()
    ahead = right.copy()
    ahead.apply_translation([1234, -777, 56])
    found = [WingFlow()(mesh) for mesh in (right, left, ahead, aircraft(half=False))]
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-6, atol=1e-6)


def wing(low, high, chord=(1.0, 1.0), *, sweep=0.0, rounded=(), opened=()):
    """NACA 0012 from y = low to high, its quarter chords on lines swept from y = 0; ends flat, rounded, or open."""
    turn = np.linspace(0, np.pi / 2, 9)
    end = 0.06 * (1 - np.cos(turn))
    y = np.r_[low + end, np.linspace(low + 0.06, high - 0.06, 41)[1:-1], high - end[::-1]]
    full = np.ones(len(y))
    if "low" in rounded:
        full[:9] = np.sin(turn)
    if "high" in rounded:
        full[-9:] = np.cos(turn)
    s = (1 - np.cos(np.linspace(0, np.pi, 31))) / 2
    half = 0.6 * (0.2969 * np.sqrt(s) - s * (0.126 + s * (0.3516 - s * (0.2843 - 0.1036 * s))))
    along, up = np.r_[s, s[-2:0:-1]], np.r_[half, -half[-2:0:-1]]
    length = np.interp(y, (low, high), chord)[:, None]
    x = np.abs(y)[:, None] * np.tan(np.radians(sweep)) + length * (along - 0.25)
    points = np.stack([x, np.broadcast_to(y[:, None], x.shape), full[:, None] * length * up], -1).reshape(-1, 3)
    ring = np.arange(x.size).reshape(x.shape)
    on = np.roll(ring, -1, axis=1)
    faces = [(ring[:-1], on[:-1], on[1:]), (ring[:-1], on[1:], ring[1:])]
    faces += [
        (np.full(58, r[0]), r[1:-1], r[2:])
        for r, name in ((ring[0, ::-1], "low"), (ring[-1], "high"))
        if name not in opened
    ]
    mesh = Trimesh(points, np.concatenate([np.stack(abc, -1).reshape(-1, 3) for abc in faces]), process=False)
    mesh.invert()
    return mesh


WHOLE = wing(-3, 3, rounded=("low", "high"))


def rectangles():
    """Half models of `WHOLE`."""
    return [
        wing(0, 3, rounded=("high",)),
        wing(-3, 0, rounded=("low",)),
        wing(7, 10, rounded=("high",)),
        wing(0, 3, rounded=("high",), opened=("low",)),
    ]


def known(mesh, model=""):
    """Area, mean chord and span of reference, the longest section being one long."""
    made = airplane(mesh, 16, 1.0, model)
    return made.s_ref, made.c_ref, made.b_ref


@pytest.mark.parametrize("method", ["aerobuildup", "vlm"])
def test_half_and_whole_rectangles_fly_alike(method):
    found = [WingFlow(method)(mesh) for mesh in (WHOLE, *rectangles()[:2])]
    for half in found[1:]:
        np.testing.assert_allclose(half, found[0], rtol=5e-3, atol=1e-5)


def test_reference_of_a_rectangle():
    for mesh in (WHOLE, *rectangles()):
        assert known(mesh) == pytest.approx((6, 1, 6), rel=1e-3)
        mesh = mesh.copy()
        mesh.vertices = 2 * mesh.vertices
        assert known(mesh) == pytest.approx((6, 1, 6), rel=1e-3)


@pytest.mark.parametrize(("model", "ratio"), [("half", 12), ("whole", 6)])
def test_lift_and_induced_drag_are_those_of_the_lifting_line(model, ratio):
    """Prandtl's: 2 π α / (1 + 2 / Λ), which rectangles stay below, and cl² / (π Λ)."""
    cl, cd, _, _ = WingFlow("vlm", alpha=4.0, model=model)(wing(0, 6))
    assert cl == pytest.approx(2 * np.pi * np.radians(4) / (1 + 2 / ratio), rel=0.1)
    assert cd == pytest.approx(cl**2 / (np.pi * ratio), rel=0.05)


@pytest.mark.parametrize("taper", [0.9, 0.7, 0.3])
def test_a_half_model_that_tapers_is_told_by_its_longer_end(taper):
    mean = 2 / 3 * (1 + taper + taper**2) / (1 + taper)
    for mesh in (wing(0, 3, (1, taper)), wing(-3, 0, (taper, 1))):
        assert known(mesh) == pytest.approx((3 * (1 + taper), mean, 6), rel=0.02)


@pytest.mark.parametrize(
    ("mesh", "why"),
    [
        (wing(0, 3), "both ends are cut flat, their chords are 1 and 1:"),
        (wing(-3, 3, sweep=20), "both ends are cut flat"),
        (wing(0, 3, opened=("low", "high")), "both ends are cut flat"),
        (wing(0, 3, (1, 0.8), rounded=("low", "high")), r"neither end is cut flat, their chords are 0\.99 and 0\.81:"),
    ],
)
def test_a_model_that_may_be_half_or_whole_is_not_guessed(mesh, why):
    with pytest.raises(MeasureError, match=f"may be a half model or a whole one: {why}"):
        WingFlow()(mesh)
    extent = np.ptp(mesh.bounds[:, 1])
    assert [sections(mesh, 6, model)[-1].y for model in ("whole", "half")] == pytest.approx([extent / 2, extent])


def test_tails_pods_and_cavities_do_not_vanish():
    tail = wing(-1, 1, rounded=("low", "high"))
    tail.vertices = 0.4 * tail.vertices + [3, 0, 0.2]
    with pytest.raises(MeasureError, match=r"a second outline, 0\.4 long beside one of 1: expected one wing"):
        WingFlow()(concatenate([WHOLE, tail]))
    hollow = wing(-2.5, 2.5, rounded=("low", "high"))
    hollow.vertices = hollow.vertices * [0.8, 1, 0.5] + [0.05, 0, 0]
    with pytest.raises(MeasureError, match="a second outline"):
        WingFlow()(concatenate([WHOLE, hollow]))
    speck = shapes.box([0.05, 0.05, 0.05])
    speck.apply_translation([2, 1.5, 0])
    for a, b in zip(sections(concatenate([WHOLE, speck]), 16), sections(WHOLE, 16), strict=True):
        np.testing.assert_allclose(a.outline, b.outline, atol=1e-9)


def test_size_tells_nothing_but_reynolds_number():
    large = aircraft()
    large.vertices = large.vertices * 7
    np.testing.assert_allclose(WingFlow()(large), WingFlow()(aircraft()), rtol=1e-5)
    assert WingFlow(chord_m=0.001)(large)[1] > 1.2 * WingFlow()(large)[1]


def test_sections_know_chord_twist_and_nose():
    mesh = aircraft(0.3)
    twist = np.radians(2.0)
    c, s = np.cos(twist), np.sin(twist)
    mesh.vertices = mesh.vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T  # nose up
    found = sections(mesh, 16)
    before = sections(aircraft(0.3), 16)
    assert [a.twist - b.twist for a, b in zip(found, before, strict=True)] == pytest.approx([2.0] * 16, abs=0.05)
    assert [a.chord for a in found] == pytest.approx([b.chord for b in before], rel=1e-3)


def test_lift_follows_the_angle_of_attack():
    lift = [WingFlow(alpha=angle)(aircraft())[0] for angle in (0.0, 2.0, 4.0)]
    assert np.diff(lift) == pytest.approx([0.1, 0.1], rel=0.5)
    assert WingFlow(alpha=2.0)(aircraft())[0] == pytest.approx(
        coefficients(MIDDLE, "aerobuildup", Condition(alpha=2.0)).cl, rel=0.02
    )


def test_without_drag_there_is_no_lift_over_it(monkeypatch):
    monkeypatch.setattr("lampopt_families.wing_flow.evaluated", lambda *args, **options: (0.3, -0.001, 0.0))
    np.testing.assert_array_equal(WingFlow(method="vlm")(aircraft()), [0.3, -0.001, 0.0, np.nan])


def test_what_is_no_wing():
    open_ended = shapes.box([1, 1, 1])
    open_ended.update_faces(open_ended.face_normals[:, 0] < 0.5)
    with pytest.raises(MeasureError, match="open or empty: expected a closed wing"):
        WingFlow()(open_ended)
    flat = shapes.box([1, 1, 1])
    flat.vertices = flat.vertices * [1, 0, 1]
    with pytest.raises(MeasureError, match="without extent across"):
        WingFlow()(flat)
    lost = aircraft()
    lost.vertices[7, 1] = np.nan
    with pytest.raises(MeasureError, match="expected finite vertices"):
        WingFlow()(lost)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "cfd"}, {"method": ["vlm"]}, {"stations": 2}, {"stations": 9.0}, {"mach": 2.0}, {"alpha": 90.0},
        {"beta": "0"}, {"chord_m": 0}, {"chord_m": "1 m"}, {"model": "quarter"}, {"model": True},
    ],
)  # fmt: skip
def test_options_that_make_no_flow(options):
    with pytest.raises(InputError, match=f"^aerosandbox: {next(iter(options))}: "):
        WingFlow(**options)
