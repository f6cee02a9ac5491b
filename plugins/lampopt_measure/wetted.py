"""Wetted area: the outside surface of a body, parts that are sunk into one another united."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .basic import inside_out, shells, watertight
from .facets import surface, total

if TYPE_CHECKING:
    from trimesh import Trimesh

SAME = 1e-9  # relative difference of areas at which shells do not overlap


@dataclass(frozen=True)
class WettedArea:
    """Area of the outside of the union of all closed parts; walls of cavities are dry.

    Parts are told apart by their faces' connection, and united where they overlap. A part that crosses itself is not
    mended: its whole surface counts.
    """

    names = ("wetted_area",)
    units = ("L^2",)

    def __call__(self, mesh: Trimesh) -> Array:
        """The area (1,). Raises EmptyMesh, and MeasureError where the mesh is open or no part has its faces outward."""
        closed = watertight(mesh)
        shells = _outer(np.asarray(closed.vertices), np.asarray(closed.faces))
        if len(shells) == 1:
            return np.array([_size(*shells[0])])
        return np.array([_united(shells)])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivative by the vertices (1, V, 3). Raises as a call does, and where parts overlap or are loose."""
        if watertight(mesh) is not mesh:
            raise MeasureError("wetted-area: no derivative for loose triangles; join coinciding vertices first")
        shells = _outer(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        parts = sum(_size(*shell) for shell in shells)
        if len(shells) > 1 and abs(_united(shells) - parts) > SAME * parts:
            raise MeasureError("wetted-area: no derivative where parts overlap; unite them first")
        whole = surface(mesh)
        wet = np.isin(whole.rows[:, 0, 0], np.concatenate([faces.ravel() for _, faces in shells]))
        return total(whole.where(wet)).gradient(len(mesh.vertices))[None]


def _outer(vertices: Array, faces: Array) -> list[tuple[Array, Array]]:
    """The closed shells whose faces point outward, each as vertices and faces; the faces keep their numbers."""
    part, volume = shells(vertices, faces)
    outer = [(vertices, faces[part == k]) for k in np.flatnonzero(volume > 0)]
    if not outer:
        raise MeasureError("wetted-area: expected faces that point outward, got none; turn them round (mesh.invert())")
    if len(inward := inside_out(vertices, faces, part, volume)):
        raise MeasureError(
            f"wetted-area: expected faces that point outward, got {len(inward)} of its parts inside out, which are no "
            "cavities: turn them round (lampopt intake does)"
        )
    return outer


def _size(vertices: Array, faces: Array) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _united(shells: list[tuple[Array, Array]]) -> float:
    from manifold3d import Manifold, Mesh64, OpType

    parts = []
    for vertices, faces in shells:
        used, place = np.unique(faces, return_inverse=True)
        mesh = Mesh64(vertices[used], place.reshape(-1, 3).astype(np.uint64))
        part = Manifold(mesh)
        if part.is_empty():
            raise MeasureError(
                f"wetted-area: expected parts with an inside to unite, got one that has none: {part.status()}"
            )
        parts.append(part)
    union = Manifold.batch_boolean(parts, OpType.Add).to_mesh64()
    points, faces = np.asarray(union.vert_properties)[:, :3], np.asarray(union.tri_verts).astype(np.int64)
    return sum(_size(*shell) for shell in _outer(points, faces))
