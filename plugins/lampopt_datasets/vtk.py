"""Surfaces in legacy VTK files (VTK user's guide, "Simple Legacy Formats"), versions 1 to 5, text and binary."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile import join
from lampopt.reading import brief, content, why
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

TYPES = {
    "char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "vtkidtype": "i8",
    "vtktypeint64": "i8",
    "float": "f4",
    "double": "f8",
}
TRIANGLE, POLYGON, QUAD = 5, 7, 9  # kinds of cells that are surfaces
FLAT = (1, 2, 3, 4)  # vertices and lines
LONGEST_LINE = 256
LONGEST_NUMBER = 64  # characters of text, blanks beside it included


def load_vtk(path: Path) -> Trimesh:
    """The surface in a legacy VTK file, polygons cut into triangles; what is known at points and cells is left.

    Raises
    ------
    InputError
        If it cannot be read, or holds no surface; the file is named.
    """
    from trimesh import Trimesh

    try:
        mesh = Trimesh(*_read(content(path)), process=False)
        join(mesh)
    except (InputError, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise InputError(f"mesh {brief(path)}: cannot be read: {why(error)}") from error
    return mesh


class _Cursor:
    """A place in the bytes of a file that moves on with what is read."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place, self.binary = data, 0, False

    def line(self) -> str:
        """The next line that is not blank, "" at the end."""
        while self.place < len(self.data):
            end = self.data.find(b"\n", self.place)
            end = len(self.data) if end < 0 else end
            text = self.data[self.place : min(end, self.place + LONGEST_LINE)].decode("latin-1").strip()
            self.place = end + 1
            if text:
                return text
        return ""

    def numbers(self, count: int, kind: str) -> Array:
        """The next `count` numbers of a VTK type."""
        if kind.lower() not in TYPES:
            raise InputError(f"expected numbers of a VTK type, got {brief(kind)!r}")
        if not 0 <= count <= len(self.data):
            raise InputError(f"it promises {count:,} numbers and has {len(self.data):,} bytes")
        dtype = np.dtype(TYPES[kind.lower()]).newbyteorder(">")
        if self.binary:
            if self.place + count * dtype.itemsize > len(self.data):
                raise InputError("it is cut short")
            found = np.frombuffer(self.data, dtype, count, self.place)
            self.place += count * dtype.itemsize
            return found.astype(dtype.newbyteorder("="))
        end = self.place + LONGEST_NUMBER * (count + 1)  # not all that follows: there may be many short arrays
        *words, rest = [*self.data[self.place : end].split(None, count), b""][: count + 1]
        if len(words) < count or (not rest and end < len(self.data)):
            cut = end >= len(self.data)
            raise InputError("it is cut short" if cut else f"expected numbers below {LONGEST_NUMBER} characters")
        self.place = min(end, len(self.data)) - len(rest)
        if dtype.kind == "f":
            return np.fromiter(map(float, words), float, count)
        return np.fromiter(map(int, words), np.int64, count)

    def whole(self, count: int, kind: str) -> Array:
        """The next `count` numbers of a VTK type that has no fractions."""
        found = self.numbers(count, kind)
        if found.dtype.kind == "f":
            raise InputError(f"expected whole numbers, got the type {brief(kind)!r}")
        return found.astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells one behind the other: those of cell k are ``corners[ends[k] : ends[k + 1]]``."""

    corners: Array  # (n,)
    ends: Array  # (c + 1,) from 0 to n

    def __len__(self) -> int:
        return len(self.ends) - 1

    def triangles(self, chosen: Array | slice = slice(None)) -> Array:
        """(F, 3): each of the `chosen` polygons as a fan from its first corner."""
        first, sizes = self.ends[:-1][chosen], np.diff(self.ends)[chosen]
        fans = np.maximum(sizes - 2, 0)
        first = np.repeat(first, fans)
        step = np.arange(len(first)) - np.repeat(np.cumsum(fans) - fans, fans)
        faces: Array = self.corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]
        return faces


def _read(data: bytes) -> tuple[Array, Array]:
    """Vertices (V, 3) and triangles (F, 3)."""
    cursor = _Cursor(data)
    if not cursor.line().startswith("# vtk DataFile Version"):
        raise InputError("expected a legacy VTK file, which begins with '# vtk DataFile Version'")
    newline = data.find(b"\n", cursor.place)
    cursor.place = newline + 1  # the title, which may be blank
    form = cursor.line().upper()
    if form not in ("ASCII", "BINARY"):
        raise InputError(f"expected ASCII or BINARY in the third line, got {brief(form)!r}")
    cursor.binary = form == "BINARY"
    dataset = cursor.line().upper().split()
    if dataset not in (["DATASET", "POLYDATA"], ["DATASET", "UNSTRUCTURED_GRID"]):
        raise InputError(f"expected DATASET POLYDATA or UNSTRUCTURED_GRID, got {brief(' '.join(dataset))!r}")
    vertices, cells, kinds = np.empty((0, 3)), _Cells(np.empty(0, int), np.zeros(1, int)), np.empty(0, int)
    while line := cursor.line():
        word, *rest = line.split()
        section = word.upper()
        if section in ("POINT_DATA", "CELL_DATA"):
            break
        if section == "POINTS":
            vertices = cursor.numbers(3 * int(rest[0]), rest[1]).reshape(-1, 3).astype(float)
        elif section in ("POLYGONS", "CELLS"):
            cells = _cells(cursor, int(rest[0]), int(rest[1]))
        elif section in ("VERTICES", "LINES"):
            _cells(cursor, int(rest[0]), int(rest[1]))
        elif section == "CELL_TYPES":
            kinds = cursor.whole(int(rest[0]), "int")
        elif section == "FIELD":
            _skip_field(cursor, int(rest[1]))
        elif section == "METADATA":
            _skip_metadata(cursor)
        else:
            raise InputError(f"expected points and polygons, got the section {brief(word)!r}")
    faces = cells.triangles(_surfaces(cells, kinds) if dataset[1] == "UNSTRUCTURED_GRID" else slice(None))
    if len(faces) == 0:
        raise InputError("expected polygons, got none")
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise InputError(f"expected finite points and corners among its {len(vertices):,} points, got others")
    return vertices, faces


def _cells(cursor: _Cursor, count: int, size: int) -> _Cells:
    """The corners of each cell: in version 5 as offsets and connectivity, before as counts among the corners."""
    start = cursor.place
    following = cursor.line().split()
    if following and following[0].upper() == "OFFSETS":
        ends = cursor.whole(count, following[1]) if count else np.zeros(1, int)
        corners = cursor.whole(size, cursor.line().split()[1])
        if ends[0] != 0 or ends[-1] != size or (np.diff(ends) < 0).any():
            raise InputError(f"expected offsets of cells that rise from 0 to {size:,}, got others")
        return _Cells(corners, ends)
    cursor.place = start
    numbers = cursor.whole(size, "int")
    counts = _counts(numbers.tolist(), count)
    corners = np.delete(numbers, counts)
    return _Cells(corners, np.r_[counts - np.arange(count), len(corners)])


def _counts(numbers: list[int], count: int) -> Array:
    """(count,) places of the numbers that say how many corners follow."""
    places, place = [], 0
    for _ in range(count):
        if place >= len(numbers) or numbers[place] < 0:
            break
        places.append(place)
        place += 1 + numbers[place]
    if len(places) != count or place != len(numbers):
        raise InputError(
            f"expected {count:,} cells in {len(numbers):,} numbers, got cells cut short or numbers left over"
        )
    return np.array(places, int)


def _surfaces(cells: _Cells, kinds: Array) -> Array:
    """Which cells are surfaces."""
    if len(kinds) != len(cells):
        raise InputError(f"expected a type for each of {len(cells):,} cells, got {len(kinds):,}")
    if strange := sorted(set(kinds.tolist()) - {TRIANGLE, POLYGON, QUAD, *FLAT}):
        raise InputError(f"expected a surface of triangles, quads and polygons, got cells of type {strange}")
    return ~np.isin(kinds, FLAT)


def _skip_field(cursor: _Cursor, arrays: int) -> None:
    for _ in range(arrays):
        _, width, count, kind = cursor.line().split()
        cursor.numbers(int(width) * int(count), kind)


def _skip_metadata(cursor: _Cursor) -> None:
    """It ends at the first blank line."""
    end = cursor.data.find(b"\n\n", cursor.place)
    cursor.place = len(cursor.data) if end < 0 else end + 2
