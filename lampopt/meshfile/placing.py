"""Scenes whose parts stand in several places: how much comes of them, and the one mesh that they are."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import brief
from lampopt.types import Array

PLACES = 10_000  # that parts may stand in
ALWAYS = 500_000  # triangles and vertices that may come of any file by placing its parts again and again
TIMES = 4  # as many as the file holds may come of a larger one


class Size(NamedTuple):
    """What a part comes to: in how many places, how many triangles and vertices in all of them."""

    places: int = 0
    triangles: int = 0
    vertices: int = 0

    def plus(self, other: Size) -> Size:
        """Both together."""
        return Size(*(a + b for a, b in zip(self, other, strict=True)))


@dataclass
class Parts:
    """Parts of a scene by key: what each holds itself, and which others it contains, as often as it does."""

    own: dict[Hashable, Size] = field(default_factory=dict)
    inside: dict[Hashable, list[Hashable]] = field(default_factory=dict)

    def add(self, key: Hashable, size: Size) -> None:
        """`size` more is held by `key` itself."""
        self.own[key] = self.own.get(key, Size()).plus(size)

    def put(self, key: Hashable, part: Hashable) -> None:
        """`part` is in `key` once more."""
        self.inside.setdefault(key, []).append(part)

    def spread(self, roots: Sequence[Hashable]) -> int:
        """How many triangles come of `roots`.

        Raises
        ------
        InputError
            If a part contains itself, or so much comes of the scene that its file cannot be meant.
        """
        try:
            order = list(TopologicalSorter(self.inside).static_order())  # what is inside comes first
        except CycleError as error:
            raise InputError(f"expected parts within parts, got one that contains itself: {brief(error)}") from error
        sizes: dict[Hashable, Size] = dict(self.own)
        for key in order:
            sizes[key] = _sum([Size(1), self.own.get(key, Size()), *(sizes[part] for part in self.inside.get(key, ()))])
        whole = _sum(sizes.get(root, Size()) for root in roots)
        held = _sum(self.own.values())
        most = max(ALWAYS, TIMES * (held.triangles + held.vertices))
        if whole.places > PLACES or whole.triangles + whole.vertices > most:
            raise InputError(
                f"its parts stand in {_count(whole.places)} places and come to {_count(whole.triangles)} triangles, of "
                f"{_count(held.triangles)} in the file: more than can be meant; export it as one mesh"
            )
        return whole.triangles


def _sum(sizes: Iterable[Size]) -> Size:
    total = Size()
    for size in sizes:
        total = total.plus(size)
    return total


def _count(value: int) -> str:
    return f"{value:,}" if value < 10**12 else "more than a million million"


def placed(parsed: Mapping[str, Any]) -> tuple[Array, Array]:
    """Vertices (V, 3) and faces (F, 3) of what trimesh's parsers return: every part at every place of it.

    Raises
    ------
    InputError
        If a part is put where nothing is.
    """
    parts = [
        _moved(mesh, matrix) for mesh, matrix in _places(parsed) if "faces" in mesh and mesh.get("faces") is not None
    ]
    parts = [(vertices, faces) for vertices, faces in parts if len(faces)]
    if not parts:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [_within(faces, len(vertices)) + start for (vertices, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _within(faces: Array, vertices: int) -> Array:
    if faces.min() < 0 or faces.max() >= vertices:
        raise InputError(
            f"expected faces whose corners are 0 to {vertices - 1}, got {faces.min()} to {faces.max()}: "
            "the file is damaged"
        )
    return faces


def _places(parsed: Mapping[str, Any]) -> Iterable[tuple[Mapping[str, Any], Array]]:
    still = np.eye(4)
    meshes = parsed.get("geometry")
    if meshes is None:
        yield parsed, still
        return
    graph = parsed.get("graph")
    if graph is None:
        yield from ((mesh, still) for mesh in meshes.values())
        return
    base = parsed.get("base_frame", "world")
    frames: dict[Hashable, Array] = {base: still}
    for edge in graph:  # a parent comes before its children
        start = frames.get(edge.get("frame_from", base))
        if start is None:
            raise InputError(f"{brief(edge['frame_to'])} is put within {brief(edge['frame_from'])}, which is not there")
        frames[edge["frame_to"]] = matrix = start @ np.asarray(edge.get("matrix", still), float)
        if edge.get("geometry") in meshes:
            yield meshes[edge["geometry"]], matrix


def _moved(mesh: Mapping[str, Any], matrix: Array) -> tuple[Array, Array]:
    from trimesh.geometry import triangulate_quads

    vertices = np.asarray(mesh["vertices"], np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError(f"expected vertices of three coordinates, got an array of shape {vertices.shape}")
    faces = np.asarray(triangulate_quads(mesh["faces"]), np.int64).reshape(-1, 3)
    if not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) < 0:  # mirrored: outward stays outward
            faces = faces[:, ::-1]
    return vertices, faces
