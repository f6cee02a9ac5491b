"""Units: what a measure's "L" stands for, and values brought from one unit to another (pint)."""

from __future__ import annotations

import re

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
    import pint

    registry = pint.get_application_registry()
    try:
        return float(registry.Quantity(1.0, unit or "dimensionless").to(to or "dimensionless").magnitude)
    except (pint.PintError, ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"{what}: cannot bring [{unit or 'dimensionless'}] to [{to or 'dimensionless'}]: {error}"
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
        return number(float(found[1]) * (factor(found[2], unit, what) if found[2] else 1.0), unit, what)
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) == float("inf"):
        raise InputError(f"{what}: expected a finite number or text such as '1420 mm', got {value!r}")
    return float(value)
