"""Deformations of a user's own, from a TOML file: a table each, in fractions of the body or in its coordinates."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import brief, content, why

from .body import MESH_AXES, Body
from .deformation import AXES, BOX, Deformation, Region, Vector, finite

KEYS = ("kind", "direction", "low", "high", "region", "falloff", "over", "about", "fixed", "symmetric")
LARGEST = 2**20  # bytes of a file
FALLOFF = 0.15  # fraction, unless the file says otherwise


def read_deformations(path: str | Path, body: Body) -> tuple[Deformation, ...]:
    """The deformations in the TOML file `path`, for `body`.

    Raises
    ------
    InputError
        If it cannot be read, or a table describes none; the file and the table are named.
    """
    try:
        tables = tomllib.loads(content(path, largest=LARGEST).decode())
    except (InputError, ValueError, RecursionError) as error:  # tomllib's own error is a ValueError
        raise InputError(f"deformations {path}: cannot be read: {why(error)}") from error
    if not tables:
        raise InputError(f"deformations {path}: expected tables such as [spoiler], got none")
    found = []
    for name, table in tables.items():
        try:
            found.append(_deformation(name, table, body))
        except InputError as error:
            raise InputError(f"deformations {path}: [{name}]: {error}") from error
    return tuple(found)


def _deformation(name: str, table: object, body: Body) -> Deformation:
    if not isinstance(table, Mapping):
        raise InputError(f"expected a table, got {table!r:.80}")
    if unknown := sorted(set(table) - set(KEYS)):
        raise InputError(f"unknown {', '.join(unknown)}; known are {', '.join(KEYS)}")
    if missing := [key for key in ("direction", "low", "high") if key not in table]:
        raise InputError(f"expected {', '.join(missing)} too, got only {', '.join(table) or 'an empty table'}")
    symmetric = table.get("symmetric", True)
    if not isinstance(symmetric, bool):
        raise InputError(f"symmetric: expected true or false, got {symmetric!r:.80}")
    kind = _text(table, "kind", "move")
    region = _region(table.get("region", {}), body)
    return Deformation(
        name,
        kind,
        _direction(table["direction"], body, symmetric and kind != "turn"),
        table["low"],
        table["high"],
        along=region[0],
        across=region[1],
        up=region[2],
        falloff=_falloff(table.get("falloff", FALLOFF), body),
        over=str(_direction(_text(table, "over", ""), body, symmetric)),
        about=_about(table.get("about", {}), body),
        fixed=table.get("fixed", 0.5),
        symmetric=symmetric,
    )


def _text(table: Mapping[str, Any], key: str, default: str) -> str:
    value = table.get(key, default)
    if not isinstance(value, str):
        raise InputError(f"{key}: expected text, got {value!r:.80}")
    return value


def _direction(value: object, body: Body, mirrored: bool) -> str | Vector:
    """A body's direction as it is; the mesh's x, -x, y, ... by the body's name; a vector in the body's axes."""
    if isinstance(value, str):
        if value not in MESH_AXES:
            return value
        index, sign = MESH_AXES[value]
        axis = body.index.index(index)
        names = (("rear", "front"), ("out", "in") if mirrored else ("right", "left"), ("up", "down"))
        return names[axis][0 if sign == body.sign[axis] else 1]
    x, y, z = body.vectors(np.array([_numbers(value, "direction", 3)]))[0].tolist()
    return x, y, z


def _by_axis(table: object, what: str, body: Body, count: int) -> dict[int, list[float]]:
    """Numbers by body axis, in fractions, from a table with keys along, across, up (fractions) and x, y, z [unit]."""
    if not isinstance(table, Mapping):
        raise InputError(f"{what}: expected a table with some of {', '.join(AXES)}, x, y, z, got {table!r:.80}")
    found: dict[int, list[float]] = {}
    for key, value in table.items():
        if key not in (*AXES, *"xyz"):
            raise InputError(f"{what}: unknown {key}; known are {', '.join(AXES)}, x, y, z")
        numbers = _numbers(value, f"{what} {key}", count)
        axis = AXES.index(key) if key in AXES else body.index.index("xyz".index(key))
        if key not in AXES and what == "falloff":
            numbers = [number / float(body.size[axis]) for number in numbers]
        elif key not in AXES:
            points = np.zeros((count, 3))
            points[:, body.index[axis]] = numbers
            numbers = sorted(body.fractions(points)[:, axis].tolist())
        if axis in found:
            raise InputError(f"{what}: {key} and {AXES[axis]} are one axis of this body: expected one of them")
        found[axis] = numbers
    return found


def _region(value: object, body: Body) -> tuple[Region, Region, Region]:
    given = _by_axis(value, "region", body, 2)
    (a, b), (c, d), (e, f) = (given.get(axis, BOX[axis]) for axis in range(3))
    return (a, b), (c, d), (e, f)


def _falloff(value: object, body: Body) -> Vector:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (value, value, value)
    given = _by_axis(value, "falloff", body, 1)
    a, b, c = (given.get(axis, [FALLOFF])[0] for axis in range(3))
    return a, b, c


def _about(value: object, body: Body) -> Vector:
    given = _by_axis(value, "about", body, 1)
    a, b, c = (given.get(axis, [sum(BOX[axis]) / 2])[0] for axis in range(3))
    return a, b, c


def _numbers(value: Any, what: str, count: int) -> list[float]:
    values = value if isinstance(value, list) else [value]
    if len(values) != count or not all(map(finite, values)):
        raise InputError(f"{what}: expected {count} number{'s' if count > 1 else ''}, got {brief(value)}")
    return [float(v) for v in values]
