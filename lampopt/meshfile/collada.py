"""COLLADA: one XML document whose scene places geometries, by nodes that may use other nodes."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Hashable
from itertools import count

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile.placing import Parts, Size
from lampopt.meshfile.xml import walk
from lampopt.reading import brief
from lampopt.types import Array

FLAT = ("triangles", "polylist", "polygons", "tristrips", "trifans")  # what has faces
INDICES = ("p", "vcount")
MOST_INPUTS = 32  # values that belong to one corner
ELEMENTS = 200_000  # of the document: the parser makes a tree of them, thirty times as large


def collada(data: bytes) -> int:
    """No archive, no nodes within themselves, indices as promised. The number of triangles."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        raise InputError("expected an XML document, got a ZIP archive: unpack it")
    return _Document().triangles(data)


class _Document:
    """What a document holds, counted while it is walked through."""

    def __init__(self) -> None:
        self.parts, self.scenes, self.chosen = Parts(), dict[str, Hashable](), list[str]()
        self.path: list[Hashable] = []  # nodes and scenes that are open
        self.geometry: str | None = None
        self.flat = ""
        self.stride = 0
        self.lists: dict[str, list[Array]] = {}
        self.unnamed, self.elements = count(), 0
        self.root = ""

    def triangles(self, data: bytes) -> int:
        walk(io.BytesIO(data), self.start, self.end, texts=frozenset(INDICES))
        if self.root != "COLLADA":
            raise InputError(f"expected a document COLLADA, got {brief(self.root)!r}")
        if wrong := [name for name in self.chosen if name not in self.scenes]:
            raise InputError(f"expected one of its scenes, got {brief(wrong[0])!r}")
        return self.parts.spread([self.scenes[name] for name in self.chosen])

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self.root, self.elements = self.root or name, self.elements + 1
        if self.elements > ELEMENTS:
            raise InputError(f"expected at most {ELEMENTS:,} elements, got more: export it as one mesh")
        if name in ("node", "visual_scene"):
            key = (name, attributes.get("id") or next(self.unnamed))
            if self.path:
                self.parts.put(self.path[-1], key)
            if name == "visual_scene":
                self.scenes[str(key[1])] = key
            self.path.append(key)
        elif name in ("instance_node", "instance_geometry") and self.path:
            kind = name.removeprefix("instance_")
            self.parts.put(self.path[-1], (kind, _local(attributes)))
        elif name == "instance_visual_scene":
            self.chosen.append(_local(attributes))
        elif name == "geometry":
            self.geometry = attributes.get("id", "")
        elif self.geometry is not None and name in FLAT:
            self.flat, self.stride, self.lists = name, 1, {kind: [] for kind in INDICES}
        elif self.flat and name == "input":
            offset = attributes.get("offset", "")
            if not (offset.isascii() and offset.isdigit()) or len(offset) > 3 or int(offset) >= MOST_INPUTS:
                raise InputError(f"input: expected an offset from 0 to {MOST_INPUTS - 1}, got {brief(offset)!r}")
            self.stride = max(self.stride, int(offset) + 1)

    def end(self, name: str, text: str) -> None:
        if name in ("node", "visual_scene"):
            self.path.pop()
        elif name == "geometry":
            self.geometry = None
        elif self.flat and name in INDICES:
            self.lists[name].append(_numbers(text))
        elif name == self.flat and self.geometry is not None:
            triangles = self._triangles()
            self.parts.add(("geometry", self.geometry), Size(1, triangles, 3 * triangles))
            self.flat = ""

    def _triangles(self) -> int:
        corners = [len(numbers) / self.stride for numbers in self.lists["p"]]
        if any(number != int(number) for number in corners):
            raise InputError(f"{self.flat}: expected {self.stride} indices for each corner, got some left over")
        if self.flat == "triangles":
            return int(sum(corners)) // 3
        if self.flat != "polylist":
            return sum(max(int(number) - 2, 0) for number in corners)
        sides = np.concatenate([np.zeros(0, np.int64), *self.lists["vcount"]])
        if sides.sum() != sum(corners) or (sides < 0).any():
            raise InputError(f"polylist: its vcount promises {sides.sum():,} corners, got {int(sum(corners)):,}")
        return int(np.maximum(sides - 2, 0).sum())


def _local(attributes: dict[str, str]) -> str:
    """What an instance is one of: something in this very file."""
    url = attributes.get("url", "")
    if not url.startswith("#"):
        raise InputError(f"expected an instance of something in the file (#…), got {brief(url)!r}: no other is opened")
    return url[1:]


def _numbers(text: str) -> Array:
    try:
        return np.array(text.split(), np.int64)
    except (ValueError, OverflowError) as error:
        raise InputError(f"expected indices, got {brief(error)}") from error
