"""What a row of a run's database says, which anybody may have edited: read back as records, or refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np

from lampopt.reading import brief
from lampopt.types import Check, Conflict, Scalar


def written_checks(checks: tuple[Check, ...]) -> str:
    """`checks` as they stand in a row."""
    # JSON knows no NaN.
    return json.dumps([[c.name, None if c.value != c.value else c.value, *_rest(c)] for c in checks])


def read_checks(text: str) -> tuple[Check, ...]:
    """The checks of a row. Raises ValueError or TypeError where one is none."""
    rows = _expect(list, json.loads(text), "checks")
    return tuple(
        Check(name, float("nan") if value is None else value, sense, limit, unit, needs, note)
        for name, value, sense, limit, unit, needs, note in rows
    )


def read_target(text: str) -> dict[str, float]:
    """What was asked, finite numbers by name. Raises ValueError or OverflowError where it is no such table."""
    found = _expect(dict, json.loads(text), "target")
    for name, value in found.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise ValueError(f"target {brief(name)!r}: expected a finite number, got {brief(repr(value))}")
    return {name: float(value) for name, value in found.items()}


def read_conflicts(text: str) -> tuple[Conflict, ...]:
    """The rows that no mix could meet together. Raises ValueError or TypeError where they are none."""
    found = _expect(list, json.loads(text), "conflicts")
    return tuple(
        Conflict(
            tuple(_expect(str, name, "conflict") for name in _expect(list, names, "conflict")),
            np.array(amounts),
            *(np.array([np.nan if v is None else float(v) for v in alone]) for alone in more),
        )
        for names, amounts, *more in found
    )


def written_conflicts(conflicts: Sequence[Conflict]) -> str:
    """What `read_conflicts` reads; a number that is not known as null, as JSON has it."""
    return json.dumps(
        [
            [c.names, c.amounts.tolist(), [None if v != v else "inf" if v == np.inf else v for v in c.alone.tolist()]]
            for c in conflicts
        ]
    )


def read_provenance(text: str) -> dict[str, Scalar]:
    """Where a design comes from, plain scalars by name. Raises ValueError where it is no such table."""
    found = _expect(dict, json.loads(text), "provenance")
    if odd := [name for name, value in found.items() if not isinstance(value, str | int | float | None)]:
        raise ValueError(f"provenance: expected texts, numbers and truth values, got others for {brief(odd)}")
    return dict(found)


def _rest(check: Check) -> tuple[Any, ...]:
    return check.sense, check.limit, check.unit, check.needs, check.note


def _expect(kind: type, value: Any, what: str) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{what}: expected a {kind.__name__}, got {brief(repr(value))}")
    return value
