"""The blended wing body: true meshes in and out of range, coefficients by AeroSandbox against lifting-line theory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.errors import InputError, PluginError
from lampopt.plugins import Plugins
from lampopt.testing import check_source
from lampopt.topology import topology
from lampopt_families.bwb import (
    CAMBER,
    HIGH,
    LOW,
    NAMES,
    THICKNESS,
    BwbSource,
    bwb_mesh,
    camber,
    family,
    half_thickness,
    stations,
)
from lampopt_families.bwb_aero import Condition, airplane, coefficients, evaluated, outline, reference

MIDDLE = (np.array(LOW) + HIGH) / 2
HALF = (np.array(HIGH) - LOW) / 2


def widened(factor):
    """Parameters from the range widened by `factor`."""
    return st.tuples(*[st.floats(-1, 1)] * 9).map(lambda u: MIDDLE + factor * HALF * np.array(u))


def changed(name, value):
    return np.where(np.array(NAMES) == name, value, MIDDLE)


# the shape


@settings(max_examples=40, deadline=None)
@given(parameters=widened(3), half=st.booleans())
def test_true_mesh_or_a_reason(parameters, half):
    """Over the range widened by 3: one closed body without handles, or a panel that is none, named."""
    least = (1, 1, 1 + 0.08 * parameters[5])
    too_narrow = [name for name, width, low in zip(NAMES[:3], parameters[:3], least, strict=True) if width <= low]
    if too_narrow:
        with pytest.raises(InputError, match=f"bwb: {too_narrow[0]}: expected more than .* mm"):
            bwb_mesh(parameters, half=half)
        return
    mesh = bwb_mesh(parameters, half=half, chordwise=32, spanwise=40)
    shape = topology(mesh)
    assert shape.closed and shape.bodies == 1 and shape.genus == 0
    assert mesh.is_winding_consistent and mesh.volume > 0
    assert (mesh.area_faces > 0).all()
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices) == len(np.unique(mesh.faces))


def test_connectivity_is_one():
    first, second = (bwb_mesh(np.array(ends)) for ends in (LOW, HIGH))
    np.testing.assert_array_equal(first.faces, second.faces)
    assert 20_000 <= len(first.faces) <= 40_000


@settings(max_examples=20, deadline=None)
@given(parameters=widened(1.5))
def test_planform_is_exact(parameters):
    """Each corner of the planform is a vertex; the lengths and sweeps between corners are the parameters."""
    if min(parameters[:3]) <= 10:
        return
    mesh = bwb_mesh(parameters)
    at = stations(parameters)
    corners = np.concatenate(
        [np.column_stack([at.leading_edge, at.y]), np.column_stack([at.leading_edge + at.chord, at.y])]
    )
    apart = np.linalg.norm(mesh.vertices[:, None, :2] - corners, axis=-1).min(axis=0)
    assert apart.max() < 1e-9
    np.testing.assert_allclose(np.diff(at.y), parameters[:3], rtol=1e-12)
    np.testing.assert_allclose(at.chord, [1000, *parameters[3:6]], rtol=1e-12)
    slopes = np.diff(at.leading_edge) / np.diff(at.y)
    np.testing.assert_allclose(np.degrees(np.arctan(slopes)), parameters[6:], rtol=1e-12)
    np.testing.assert_allclose(mesh.bounds[:, 1], [0, parameters[:3].sum()], atol=1e-9)


def test_volume_is_the_integral_of_the_sections():
    """Sections enclose 2 ∫ ¾√3 √ξ (1 − ξ) dξ = 2√3 / 5 of thickness times chord, whatever the camber."""
    at = stations(MIDDLE)
    y = np.linspace(0, at.y[-1], 20_001)
    chord, thickness = (np.interp(y, at.y, v) for v in (at.chord, at.thickness))
    area = 2 * np.sqrt(3) / 5 * thickness * chord**2
    rounding = 0.08 * at.chord[-1]
    area *= np.sqrt(1 - np.clip((y - at.y[-1] + rounding) / rounding, 0, 1) ** 2)
    np.testing.assert_allclose(bwb_mesh(MIDDLE).volume, np.trapezoid(area, y), rtol=2e-3)
    np.testing.assert_allclose(bwb_mesh(MIDDLE, half=False).volume, 2 * bwb_mesh(MIDDLE).volume, rtol=1e-12)


def test_whole_aircraft_is_its_own_mirror_image():
    vertices = np.asarray(bwb_mesh(MIDDLE, half=False).vertices)
    there, back = ({tuple(row) for row in (vertices * (1, sign, 1) + 0.0).tolist()} for sign in (1, -1))
    assert there == back


def test_sections():
    """Half as thick as said at a third of the chord; as cambered as said; no moment about the quarter chord.

    Thin-airfoil theory: the moment is (π/4)(A2 − A1), A_n the cosine coefficients of the camber line's slope.
    """
    share = np.linspace(0, 1, 100_001)
    assert half_thickness(share).max() == pytest.approx(0.5, abs=1e-9)
    assert half_thickness(np.array(1 / 3)) == pytest.approx(0.5, abs=1e-12)
    assert camber(share).max() == pytest.approx(CAMBER, abs=1e-9)
    angle = np.linspace(0, np.pi, 20_001)
    slope = np.gradient(camber((1 - np.cos(angle)) / 2), (1 - np.cos(angle)) / 2, edge_order=2)
    first, second = (2 / np.pi * np.trapezoid(slope * np.cos(n * angle), angle) for n in (1, 2))
    assert np.pi / 4 * (second - first) == pytest.approx(0, abs=1e-5)
    assert abs(first) > 0.01


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("B1", 0.0, "B1: expected more than 1 mm, got 0 mm"),
        ("B2", -25.0, "B2: expected more than 1 mm, got -25 mm"),
        ("B3", 6.0, "B3: expected more than 7 mm, got 6 mm"),
        ("C4", 0.5, "C4: expected more than 1 mm, got 0.5 mm"),
        ("S1", 90.0, "S1: expected a sweep within ±85°, got 90°"),
        ("S3", np.nan, "expected finite parameters, got S3 is nan"),
    ],
)
def test_parameters_that_make_no_aircraft(name, value, message):
    with pytest.raises(InputError, match=message):
        bwb_mesh(changed(name, value))


def test_where_the_widened_range_ends():
    """As docs/sources.md says: B2 from f = 1.65, B3 from 1.77, B1 from 2.98; nothing else up to 3."""
    made = family()
    for name, factor in (("B2", 1.65), ("B3", 1.76), ("B1", 2.97)):
        bwb_mesh(changed(name, made.widened(factor)[0][NAMES.index(name)]))
        with pytest.raises(InputError, match=f"bwb: {name}: expected more than"):
            bwb_mesh(changed(name, made.widened(factor + 0.03)[0][NAMES.index(name)]))
    low, high = made.widened(3)
    for name in NAMES[3:]:
        for end in (low, high):
            assert bwb_mesh(changed(name, end[NAMES.index(name)])).is_watertight


# the source


def test_source_conforms():
    check_source(BwbSource(count=6, chordwise=16, spanwise=20))


def test_source():
    exemplars = BwbSource(count=5)()
    assert Plugins.load().make("source", "bwb") == BwbSource()
    assert [q.name for q in exemplars.space] == list(NAMES)
    assert [q.unit for q in exemplars.space] == ["mm"] * 6 + ["deg"] * 3
    assert exemplars.unit == "mm"
    assert exemplars.measured == {name: f"bwb.{name}" for name in NAMES}
    assert exemplars.labels.shape == (5, 0)
    assert len(BwbSource(count=19, design="ends")()) == 19


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chordwise": 3}, "chordwise: expected a whole number from 4 to 2,000, got 3"),
        ({"spanwise": 2.5}, "spanwise: expected a whole number from 10 to 2,000, got 2.5"),
        ({"labels": "cfd"}, "labels: expected one of aerobuildup, vlm or none, got 'cfd'"),
        ({"alpha": 45.0}, "alpha: expected a number from -30 to 30, got 45.0"),
        ({"mach": 0}, "mach: expected a number more than 0 to 0.9, got 0"),
    ],
)
def test_options_that_make_no_family(options, message):
    with pytest.raises(InputError, match=message):
        BwbSource(**options)


# coefficients


@pytest.fixture(scope="module")
def asb():
    """AeroSandbox, or a skip that says so; its own warnings on import are not ours."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("aerosandbox", reason="AeroSandbox is not installed (the extra `aero`)")


def slope(plane, method="vlm"):
    """Lift slope [1/rad] between −1 and 1 degree at low speed."""
    low, high = (evaluated(plane, method, Condition(mach=0.05, alpha=a))[0] for a in (-1.0, 1.0))
    return (high - low) / np.radians(2)


def plane_of(asb, span, chords, y):
    """A flat, straight wing of the given chords at y, quarter chords in line."""
    sections = [
        asb.WingXSec(xyz_le=[-c / 4, at, 0], chord=c, airfoil=asb.Airfoil(coordinates=outline(0.02) * (1, 0)))
        for at, c in zip(y, chords, strict=True)
    ]
    wing = asb.Wing(xsecs=sections, symmetric=True)
    area = 2 * np.trapezoid(chords, y)
    return asb.Airplane(wings=[wing], s_ref=area, c_ref=area / span, b_ref=span), span**2 / area


def test_lift_slope_of_an_elliptic_wing(asb):
    """Lifting-line theory: 2π / (1 + 2 / A) for an elliptic wing of aspect ratio A; lattices give 2 to 6 % less."""
    turn = np.linspace(0, np.pi / 2, 9)
    plane, ratio = plane_of(asb, 10.0, np.maximum(np.cos(turn), 0.02), 5 * np.sin(turn))
    theory = 2 * np.pi / (1 + 2 / ratio)
    assert 0.93 * theory < slope(plane) < 1.01 * theory


def test_induced_drag_of_an_elliptic_wing(asb):
    """CL² / (π A), the least that there is."""
    turn = np.linspace(0, np.pi / 2, 9)
    plane, ratio = plane_of(asb, 10.0, np.maximum(np.cos(turn), 0.02), 5 * np.sin(turn))
    cl, cd, _ = evaluated(plane, "vlm", Condition(mach=0.05, alpha=4.0))
    assert cd == pytest.approx(cl**2 / (np.pi * ratio), rel=0.06)


def test_lift_slope_of_a_rectangular_wing(asb):
    """Glauert's series solution of the lifting line, 40 terms, aspect ratio 8."""
    ratio = 8.0
    plane, _ = plane_of(asb, ratio, np.ones(5), np.linspace(0, ratio / 2, 5))
    n = np.arange(1, 80, 2)
    turn = np.pi / 2 * np.arange(1, len(n) + 1) / len(n)
    factor = 2 * np.pi / (4 * ratio)  # a0 c / (4 b)
    matrix = np.sin(np.outer(turn, n)) * (np.sin(turn)[:, None] + factor * n)
    first = np.linalg.solve(matrix, factor * np.sin(turn))[0]
    theory = np.pi * ratio * first
    assert 0.94 * theory < slope(plane) < 1.01 * theory


@pytest.mark.parametrize("method", ["aerobuildup", "vlm"])
def test_lift_and_moment_by_angle(method, asb):
    """Lift grows, drag is positive, sideslip to the right and to the left are alike."""
    found = [coefficients(MIDDLE, method, Condition(alpha=a)) for a in (-2.0, 2.0, 6.0)]
    lift = [c.cl for c in found]
    assert lift[0] < lift[1] < lift[2]
    assert all(c.cd > 0 for c in found)
    assert found[1].ld == found[1].cl / found[1].cd
    right, left = (coefficients(MIDDLE, method, Condition(beta=b)) for b in (5.0, -5.0))
    assert right.cl == pytest.approx(left.cl, rel=0.02)  # AeroBuildup itself is 0.6 % uneven


def test_references_are_those_of_the_planform(asb):
    """Closed forms against AeroSandbox's own geometry."""
    plane = airplane(stations(MIDDLE))
    wing = plane.wings[0]
    area, chord, about = reference(stations(MIDDLE))
    assert (wing.area(), wing.mean_aerodynamic_chord()) == (pytest.approx(area), pytest.approx(chord))
    assert wing.aerodynamic_center()[0] == pytest.approx(about)
    assert wing.span() == pytest.approx(2 * MIDDLE[:3].sum() / 1000)
    assert [section.airfoil.max_thickness() for section in wing.xsecs] == pytest.approx(list(THICKNESS), rel=2e-3)


def test_labels_name_their_method(asb):
    exemplars = BwbSource(count=2, labels="vlm", alpha=2.0)()
    assert [q.name for q in exemplars.label_space] == ["cl_vlm", "cd_vlm", "cm_vlm", "ld_vlm"]
    found = coefficients(exemplars.parameters[1], "vlm", Condition(alpha=2.0))
    np.testing.assert_array_equal(exemplars.labels[1], [found.cl, found.cd, found.cm, found.ld])


def test_unknown_method():
    with pytest.raises(InputError, match="method: expected one of aerobuildup, vlm, got 'cfd'"):
        coefficients(MIDDLE, "cfd")


def test_without_aerosandbox(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "aerosandbox", None)
    with pytest.raises(PluginError, match=r"not installed: pip install 'lampopt\[aero\]'"):
        BwbSource(count=1, labels="vlm")()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"half": half}, "half: expected true or false, got") for half in (1, "no", None)),
        *(
            ({option: value}, f"{option}: expected a whole number from {least} to 2,000, got")
            for option, least in (("chordwise", 4), ("spanwise", 10))
            for value in (True, "64", 64.0, np.nan, 0, -64, 10**9)
        ),
    ],
)
def test_options_that_make_no_mesh(options, message):
    for refused in (lambda: BwbSource(**options), lambda: bwb_mesh(MIDDLE, **options)):
        with pytest.raises(InputError, match=f"bwb: {message}"):
            refused()


def test_coefficients_from_threads(asb):
    """The same as one after the other, and the filters of warnings stay as they are."""
    import warnings
    from concurrent.futures import ThreadPoolExecutor

    jobs = [(changed(name, LOW[k]), method) for k, name in enumerate(NAMES[:4]) for method in ("aerobuildup", "vlm")]
    alone = [coefficients(*job) for job in jobs]
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda job: coefficients(*job), jobs)) == alone
    assert warnings.filters == before
