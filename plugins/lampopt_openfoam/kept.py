"""Results kept in a folder: one JSON record a placement, by what it depends on. A damaged one is made again."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from hashlib import blake2b
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.types import Array

from .outcomes import LASTING, ROOM, FlowError

SCHEMA = 2  # raise it when records come to mean something else


@dataclass(frozen=True)
class Placed:
    """The flow on one placement of the grid.

    Parameters
    ----------
    number
        Of the placement.
    drag, lift, drag_error, lift_error
        Coefficients, referred to the frontal area, and the standard errors of their settled means.
    cells, iterations, seconds
        Of the grid; of the solver; all tools together.
    skewness, non_orthogonality, residual
        The grid's worst [-, deg]; the largest residual at the end.
    """

    number: int
    drag: float
    lift: float
    drag_error: float
    lift_error: float
    cells: int
    iterations: int
    seconds: float
    skewness: float
    non_orthogonality: float
    residual: float


def key(**facts: object) -> str:
    """A short hash of everything that a result depends on."""
    text = json.dumps({"schema": SCHEMA, **facts}, sort_keys=True, default=str)
    return blake2b(text.encode(), digest_size=10).hexdigest()


def hash_of(folder: Path) -> str:
    """A hash of all files in `folder`, by name and content."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    content = b"".join(path.relative_to(folder).as_posix().encode() + path.read_bytes() for path in files)
    return blake2b(content, digest_size=10).hexdigest()


def read(path: Path) -> Placed | FlowError | None:
    """What is kept at `path`: a result, a failure that would come again, or nothing of use."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record.get("outcome") in LASTING:
            return FlowError(str(record["message"]), record["outcome"])
        found = Placed(**{field.name: record[field.name] for field in fields(Placed)})
        numbers = [value for value in asdict(found).values() if isinstance(value, int | float)]
        whole = len(numbers) == len(fields(Placed)) and all(map(isfinite, numbers))
        return found if whole and found.cells > 0 else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def write(path: Path, what: Placed | FlowError) -> None:
    """Keep a result, or a failure that would come again; whole or not at all."""
    if isinstance(what, FlowError):
        if what.outcome not in LASTING:
            return
        record: Mapping[str, Any] = {"outcome": what.outcome, "message": what.args[0]}
    else:
        record = asdict(what)
    _put(path, json.dumps(record, indent=1, allow_nan=False).encode())


def write_pressure(path: Path, points: Array, pressure: Array) -> None:
    """Keep a picture: points (n, 3) and the pressure coefficient there (n,), as float32."""
    from io import BytesIO

    data = BytesIO()
    np.savez_compressed(data, points=points.astype(np.float32), pressure=pressure.astype(np.float32))
    _put(path, data.getvalue())


def read_pressure(path: Path) -> tuple[Array, Array] | None:
    """What `write_pressure` has kept, or nothing of use."""
    from zipfile import BadZipFile
    from zlib import error as BadStream  # noqa: N812  # a class

    damage = (OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, BadZipFile, BadStream)
    with suppress(*damage), path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        points, pressure = arrays["points"], arrays["pressure"]
        return (points, pressure) if points.shape == (len(pressure), 3) else None
    return None


def _put(path: Path, data: bytes) -> None:
    """Write by renaming. Raises FlowError where there is no room."""
    half = path.with_suffix(f".{os.getpid()}.part")
    try:
        with half.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        half.replace(path)
    except OSError as error:
        with suppress(OSError):
            half.unlink()
        raise FlowError(f"{path} cannot be written: {error}; {ROOM}", "disk-full") from error
