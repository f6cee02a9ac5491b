"""Units: what a measure's "L" stands for, and values brought from one unit to another (pint)."""

from __future__ import annotations

import re
from numbers import Real

from lampopt.errors import InputError

_LENGTH = re.compile(r"\bL\b")
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def filled(unit: str, length: str) -> str:
    """A measure's declared unit with L, L^2, L^3 replaced by the mesh's `length` unit: "L^2" → "mm^2"."""
    return _LENGTH.sub(length, unit)


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
    import pint

    registry = pint.get_application_registry()
    try:
        return float(registry.Quantity(value, unit or "dimensionless").to(to or "dimensionless").magnitude)
    except Exception as error:  # pint's parser raises whatever Python's tokenizer does
        raise InputError(
            f"{what}: cannot bring [{unit or 'dimensionless'}] to [{to or 'dimensionless'}]: {error!r}"
        ) from error


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
    if isinstance(given, bool) or not isinstance(given, Real) or not abs(value) < float("inf"):
        raise InputError(f"{what}: expected a finite number or text such as '1420 mm', got {value!r}")
    return float(value)
