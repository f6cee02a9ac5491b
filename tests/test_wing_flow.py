"""Coefficients of winged meshes by their sections, held against those of the aircraft that the meshes are of."""

import numpy as np
import pytest

from lampopt.errors import InputError, MeasureError
from lampopt.testing import shapes
from lampopt_families.bwb import HIGH, LOW, bwb_mesh
from lampopt_families.bwb_aero import Condition, coefficients
from lampopt_families.wing_flow import WingFlow, sections

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
        {"beta": "0"}, {"chord_m": 0}, {"chord_m": "1 m"},
    ],
)  # fmt: skip
def test_options_that_make_no_flow(options):
    with pytest.raises(InputError, match=f"^aerosandbox: {next(iter(options))}: "):
        WingFlow(**options)
