"""Units: what L stands for, factors by the definitions of the units, text as users write it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lampopt.errors import InputError
from lampopt.units import factor, filled, number


@pytest.mark.parametrize(
    ("declared", "length", "full"),
    [
        ("L", "mm", "mm"),
        ("L^2", "mm", "mm^2"),
        ("L^3", "inch", "inch^3"),
        ("kg/L^3", "m", "kg/m^3"),
        ("1/L", "m", "1/m"),
        ("L*L^2", "m", "m*m^2"),
        ("deg", "m", "deg"),
        ("", "m", ""),
        ("kL", "m", "kL"),  # a litre is no length
        ("Lm", "m", "Lm"),
    ],
)
def test_l_is_the_meshs_length(declared, length, full):
    assert filled(declared, length) == full


@pytest.mark.parametrize(
    ("unit", "to", "value"),
    [
        ("m", "mm", 1000),
        ("inch", "mm", 25.4),
        ("ft", "m", 0.3048),
        ("m^2", "mm^2", 1e6),
        ("mm^3", "m^3", 1e-9),
        ("deg", "rad", math.pi / 180),
        ("rad", "deg", 180 / math.pi),
        ("N", "kg*m/s^2", 1),
        ("lbf", "N", 4.4482216152605),
        ("km/h", "m/s", 1 / 3.6),
        ("", "", 1),
        ("percent", "", 0.01),
        ("whatever it is", "whatever it is", 1),  # the same on both sides needs no meaning
    ],
)
def test_factor(unit, to, value):
    assert factor(unit, to, "x") == pytest.approx(value, rel=1e-12)


@given(st.sampled_from(["m", "mm", "inch", "ft", "km"]), st.sampled_from(["m", "mm", "inch", "ft", "km"]))
def test_there_and_back(a, b):
    assert factor(a, b, "x") * factor(b, a, "x") == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "to"),
    [
        ("deg", ""),
        ("", "rad"),
        ("percent", "deg"),
        ("m", "kg"),
        ("m", "m^2"),
        ("", "m"),
        ("m", ""),
        ("nonsense", "m"),
        ("m", "nonsense"),
        ("!!", "m"),
        ("m)", "m"),
    ],
)
def test_what_cannot_become_the_other_is_named(unit, to):
    said = rf"^roof: cannot bring \[{unit or 'dimensionless'}\] to \[{to or 'dimensionless'}\]: ".replace("m)", r"m\)")
    with pytest.raises(InputError, match=said.replace("^2", r"\^2")):
        factor(unit, to, "roof")


@pytest.mark.parametrize(
    "unit",
    ["m**(9**9**9)", "m**9**9**9", "m^9^9", "m" * 61, "m*", "m cubed cubed cubed cubed", "sq square cubic m^9", "m⁹⁹⁹",
     "2*m", "m^99", "[m]", "m +m", "__m", "%%",
     "((m))", "m^(9)"],
)  # fmt: skip
def test_a_unit_is_names_and_powers(unit):
    said = "^x: .*expected a unit such as 'mm' or 'm/s\\^2', got "
    for one, to in ((unit, "m"), ("m", unit)):
        with pytest.raises(InputError, match=said):
            factor(one, to, "x")
    with pytest.raises(InputError, match=r"^x: "):
        number(f"1 {unit}", "m", "x")


@pytest.mark.parametrize(
    ("unit", "to"),
    [("kg m**2 / s**2", "J"), ("N*s", "kg*m*s^-1"), ("m²", "m^2"), ("1/s", "Hz"), ("°C", "degC"), ("°", "deg"),
     ("µm", "micrometer"), ("metric_ton", "Mg"), ("(N)", "N")],
)  # fmt: skip
def test_plain_units_pass(unit, to):
    assert number(f"1 {unit}", to, "x") == pytest.approx(1)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [("30 arcmin", "deg", 0.5), ("0.1 turn", "deg", 36), ("5 milliradian", "rad", 0.005), ("60 rpm", "deg/s", 360)],
)
def test_angles_by_any_name(text, unit, value):
    assert number(text, unit, "x") == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("text", "unit"), [("1 deg/s", "1/s"), ("1 rpm", "Hz"), ("0.1 millirad", "")])
def test_angles_are_no_plain_numbers(text, unit):
    with pytest.raises(InputError, match="x: cannot bring"):
        number(text, unit, "x")


@pytest.mark.parametrize("given", [10**400, -(10**400), 10**5000], ids=["large", "negative", "too long to be shown"])
def test_whole_numbers_beyond_any_float(given):
    with pytest.raises(InputError, match=r"^roof: expected a finite number"):
        number(given, "m", "roof")


def test_a_length_unit_is_no_template():
    assert filled("L^2", r"\1") == r"\1^2"


def test_no_factor_leads_from_celsius_to_kelvin():
    for pair in (("degC", "K"), ("K", "degC"), ("degF", "degC")):
        with pytest.raises(InputError, match="different zeros"):
            factor(*pair, "x")
    assert factor("degC", "degC", "x") == 1
    assert number("20 degC", "degC", "x") == 20
    assert number("293.15 K", "degC", "x") == pytest.approx(20)  # a value has a zero to count from
    assert number("50 degF", "degC", "x") == pytest.approx(10)


@pytest.mark.parametrize(
    ("given", "value"),
    [
        (1.42, 1.42),
        (1, 1.0),
        (-3, -3.0),
        ("1.42", 1.42),
        ("1420 mm", 1.42),
        ("1420mm", 1.42),
        ("  1420  mm  ", 1.42),
        ("-0.5 m", -0.5),
        ("+0.5 m", 0.5),
        (".5 m", 0.5),
        ("5. m", 5.0),
        ("1e3 mm", 1.0),
        ("1.5E-3 km", 1.5),
        ("10 inch", 0.254),
        (np.float64(2), 2.0),
        (np.float32(0.5), 0.5),
        (np.int64(2), 2.0),
    ],
)
def test_numbers_and_text(given, value):
    found = number(given, "m", "roof")
    assert type(found) is float
    assert found == pytest.approx(value, rel=1e-12)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_float_survives_as_text(value):
    assert number(repr(value), "m", "x") == value == number(value, "m", "x")
    assert number(f"{value!r} m", "m", "x") == value


@pytest.mark.parametrize("unit", ["", "deg"])
def test_text_without_a_unit_is_in_the_parameters(unit):
    assert number("12", unit, "ramp") == 12


@pytest.mark.parametrize(
    "given",
    ["", " ", "mm", "m 3", "nan", "inf", "-inf m", "1e400", "1e400 m", None, True, False, [1.0], float("nan"),
     float("inf"), 1j, b"1 m", "1,5 m", "1 420 mm", "0x10 m", "1 kg", "1 m^2", "1 m; rm"],
)  # fmt: skip
def test_anything_else_is_refused(given):
    with pytest.raises(InputError, match=r"^roof: "):
        number(given, "m", "roof")
