"""Units: what a measure's "L" stands for, and values brought from one unit to another (pint)."""

from __future__ import annotations

import re
from numbers import Integral, Real
from typing import Any

from lampopt.errors import InputError

_LENGTH = re.compile(r"\bL\b")
_NAME = r"°?[^\W\d_⁰¹²³⁴-⁹](?:[^\W\d⁰¹²³⁴-⁹]|[0-9])*"
_POWER = r"(?:(?:\*\*|\^)-?[0-9]|[²³])?"
_PLAIN = re.compile(rf"|[%°]|(?:1\s*/\s*)?{_NAME}{_POWER}(?:(?:\s*[*/]\s*|\s+){_NAME}{_POWER})*")
_POWERS_IN_WORDS = re.compile(r"\s(?:squared|cubed)|(?:cubic|square|sq)\s")
_LONGEST = 60  # characters of a unit
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def filled(unit: str, length: str) -> str:
    """A measure's declared unit with L, L^2, L^3 replaced by the mesh's `length` unit: "L^2" → "mm^2"."""
    return _LENGTH.sub(lambda _: length, unit)


def factor(unit: str, to: str, what: str) -> float:
    """What a value in `unit` is multiplied by to be in unit `to`.

    Raises
    ------
    InputError
        Naming `what` and both units, if one cannot become the other.
    """
    if unit == to:
        return 1.0
    if _converted(0.0, unit, to, what) != 0:
        raise InputError(f"{what}: [{unit}] and [{to}] have different zeros, no factor brings one to the other")
    return _converted(1.0, unit, to, what)


def _converted(value: float, unit: str, to: str, what: str) -> float:
    if unit == to:
        return value
    for text in (unit, to):
        if not _plain(text):
            raise InputError(
                f"{what}: cannot bring [{_named(unit)}] to [{_named(to)}]: "
                f"expected a unit such as 'mm' or 'm/s^2', got {text[:_LONGEST]!r}"
            )
    import pint

    registry = pint.get_application_registry()
    try:
        given = registry.Quantity(value, unit or "dimensionless").to(to or "dimensionless")
        if _turns(registry, unit) != _turns(registry, to):  # to pint, an angle is a number
            raise pint.DimensionalityError(unit or "dimensionless", to or "dimensionless")
        return float(given.magnitude)
    except Exception as error:  # pint's parser raises whatever Python's tokenizer does
        why = str(error) if isinstance(error, pint.DimensionalityError) else repr(error)
        raise InputError(f"{what}: cannot bring [{_named(unit)}] to [{_named(to)}]: {why}") from error


def _turns(registry: Any, unit: str) -> float:
    """The power of an angle in `unit`: 1 of degrees, −1 of what is per radian."""
    root = registry.Quantity(1.0, unit or "dimensionless").to_root_units()
    return float(dict(root.unit_items()).get("radian", 0))


def _plain(unit: str) -> bool:
    """Whether `unit` is names and powers, in brackets or not: pint would work out m**(9**9**9), in words too."""
    if unit.startswith("(") and unit.endswith(")"):
        unit = unit[1:-1]
    return len(unit) <= _LONGEST and _PLAIN.fullmatch(unit) is not None and not _POWERS_IN_WORDS.search(unit)


def _named(unit: str) -> str:
    return unit[:_LONGEST] or "dimensionless"


def said(value: object) -> str:
    """`value` as it is typed, for a message; Python writes no whole number of thousands of digits."""
    try:
        return repr(value)
    except ValueError:
        return "a number that is too long to be shown"


def number(value: float | str, unit: str, what: str) -> float:
    """`value` in `unit`: a number is taken to be in it already, text such as "1420 mm" is converted.

    Raises
    ------
    InputError
        If it is neither.
    """
    if isinstance(value, str):
        found = _QUANTITY.fullmatch(value)
        if not found:
            raise InputError(f"{what}: expected a number or text such as '1420 mm', got {value!r}")
        return number(_converted(float(found[1]), found[2] or unit, unit, what), unit, what)
    given: object = value  # numpy's numbers are welcome too
    try:
        if not isinstance(given, bool) and isinstance(given, Real) and abs(value) < float("inf"):
            return float(value)
    except OverflowError:  # a whole number beyond any float
        pass
    raise InputError(f"{what}: expected a finite number or text such as '1420 mm', got {said(value)}")


def whole(value: object, what: str, least: int, most: int | None = None) -> int:
    """`value` as a whole number of at least `least` and at most `most`.

    Raises
    ------
    InputError
        If it is none.
    """
    given: object = value if isinstance(value, int) else int(value) if isinstance(value, Integral) else None
    if isinstance(given, int) and not isinstance(given, bool) and least <= given and (most is None or given <= most):
        return given
    up_to = "" if most is None else f" and at most {most:,}"
    raise InputError(f"{what}: expected at least {least}{up_to}, a whole number, got {said(value):.80}")
