"""3MF: a ZIP archive with one XML model, whose build items place objects made of meshes and of other objects.

Read here, in one pass that keeps numbers only: a parser that makes a tree of the model takes eight hundred bytes for
every vertex of thirty.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile.placing import Parts, Size
from lampopt.meshfile.xml import walk
from lampopt.reading import brief
from lampopt.types import Array

MODEL = "3d/3dmodel.model"
ENTRIES = 1000
ALWAYS, TIMES = 16 * 2**20, 20  # bytes unpacked: of any model, and as a multiple of a larger file


def threemf(data: bytes) -> tuple[int, Mapping[str, Any]]:
    """How many triangles the model promises, and what trimesh's parsers would return of it."""
    model = _Model()
    try:
        with (
            zipfile.ZipFile(io.BytesIO(data)) as archive,
            archive.open(_entry(archive, max(ALWAYS, TIMES * len(data)))) as file,
        ):
            model.read(file)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise InputError(f"expected a ZIP archive, got something else or a damaged one: {brief(error)}") from error
    return model.promised(), {"geometry": model.meshes(), "graph": list(model.graph())}


def _entry(archive: zipfile.ZipFile, most: int) -> zipfile.ZipInfo:
    """The one model; nothing else in the archive is unpacked."""
    entries = archive.infolist()
    if len(entries) > ENTRIES:
        raise InputError(f"expected at most {ENTRIES:,} files in the archive, got {len(entries):,}")
    models = [entry for entry in entries if entry.filename.lower().endswith(".model")]
    if len(models) != 1 or MODEL not in models[0].filename.lower():
        names = brief([entry.filename for entry in models])
        raise InputError(f"expected one model, 3D/3dmodel.model, got {names}: export all of it as one")
    if models[0].file_size > most:  # no more than this is unpacked
        raise InputError(f"expected a model of at most {most:,} bytes, got {models[0].file_size:,}")
    return models[0]


@dataclass
class _Object:
    vertices: array[float] = field(default_factory=lambda: array("d"))
    faces: array[int] = field(default_factory=lambda: array("q"))
    components: list[tuple[str, Array]] = field(default_factory=list)


class _Model:
    """What a model holds, taken down while it is walked through."""

    def __init__(self) -> None:
        self.objects, self.items = dict[str, _Object](), list[tuple[str, Array]]()
        self.open: _Object | None = None
        self.building = False

    def read(self, file: IO[bytes]) -> None:
        walk(file, self.start, self.end)

    def start(self, name: str, attributes: dict[str, str]) -> None:
        if name == "vertex" and self.open is not None:
            self.open.vertices.extend([_number(float, attributes.get(axis, "")) for axis in "xyz"])
        elif name == "triangle" and self.open is not None:
            self.open.faces.extend([_number(int, attributes.get(corner, "")) for corner in ("v1", "v2", "v3")])
        elif name == "object":
            key = attributes.get("id", "")
            if self.open is not None or key in self.objects:
                raise InputError(f"expected objects beside each other, each once, got {brief(key)!r} again")
            self.open = self.objects[key] = _Object()
        elif name == "build":
            self.building = True
        elif name in ("component", "item"):
            if any(key.endswith("path") for key in attributes):
                raise InputError("objects in other files of the archive are not read: export it as one model")
            placed = (attributes.get("objectid", ""), _matrix(attributes.get("transform")))
            if name == "component" and self.open is not None:
                self.open.components.append(placed)
            elif name == "item" and self.building:
                self.items.append(placed)

    def end(self, name: str, _: str) -> None:
        if name == "object":
            self.open = None
        elif name == "build":
            self.building = False

    def promised(self) -> int:
        parts = Parts()
        for key, found in self.objects.items():
            parts.add(key, Size(0, len(found.faces) // 3, len(found.vertices) // 3))
            for part, _ in found.components:
                parts.put(key, part)
        used = {key for key, _ in self.items}.union(*(ids for ids in parts.inside.values()))
        if missing := sorted(str(key) for key in used if key not in self.objects):
            raise InputError(f"it places objects that are not there: {brief(', '.join(missing))}")
        return parts.spread([key for key, _ in self.items])

    def meshes(self) -> dict[str, dict[str, Array]]:
        return {
            key: {
                "vertices": np.array(found.vertices).reshape(-1, 3),
                "faces": np.array(found.faces, np.int64).reshape(-1, 3),
            }
            for key, found in self.objects.items()
            if found.faces
        }

    def graph(self) -> Iterator[dict[str, Any]]:
        """Every object at every place of it; `promised` has seen to it that there are not too many."""
        waiting = list(reversed(self.items))
        number = 0
        while waiting:
            key, matrix = waiting.pop()
            yield {"frame_to": number, "matrix": matrix, "geometry": key}
            number += 1
            inside = self.objects[key].components
            waiting.extend((part, matrix @ place) for part, place in reversed(inside))


def _number(kind: type[Any], text: str) -> Any:
    try:
        return kind(text)
    except ValueError as error:
        raise InputError(f"expected numbers for every vertex and triangle, got {brief(text)!r}") from error


def _matrix(transform: str | None) -> Array:
    """A 3MF transform: twelve numbers, a matrix that is multiplied from the right."""
    matrix = np.eye(4)
    if transform is not None:
        numbers = [_number(float, text) for text in transform.split()]
        if len(numbers) != 12:
            raise InputError(f"transform: expected twelve numbers, got {len(numbers)}")
        matrix[:3] = np.array(numbers).reshape(4, 3).T
    return matrix
