"""How faces hang together: which edges have one face, two, or more; in which parts; around which holes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of faces (F, 3), told by half-edges: 3 f + k runs from corner k of face f to the next one.

    Parameters
    ----------
    start, end
        (3F,) vertices of the half-edges.
    lone
        (b,) half-edges of edges with one face: the surface is open there.
    paired
        (m, 2) half-edges of edges with two faces.
    crowded
        How many edges have three faces or more.
    """

    start: Array
    end: Array
    lone: Array
    paired: Array
    crowded: int

    @classmethod
    def of(cls, faces: Array) -> Edges:
        """The edges of `faces` (F, 3)."""
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        low, high = np.minimum(start, end), np.maximum(start, end)
        order = np.lexsort((high, low))
        new = np.append(True, (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0))
        first = np.flatnonzero(new[: len(order)])
        count = np.diff(np.append(first, len(order)))
        two = first[count == 2]
        paired = np.stack([order[two], order[two + 1]], 1)
        return cls(start, end, order[first[count == 1]], paired, int((count > 2).sum()))

    @property
    def agree(self) -> Array:
        """(m,) whether the two faces of a pair run through their edge in opposite directions, as they should."""
        return np.asarray(self.start[self.paired[:, 0]] != self.start[self.paired[:, 1]])

    def parts(self) -> tuple[int, Array]:
        """How many parts edges with two faces hold together, and (F,) which one each face belongs to."""
        one, other = self.paired.T // 3
        return components(one, other, len(self.start) // 3)

    def holes(self) -> tuple[int, Array]:
        """How many holes the lone edges lie around, and (b,) around which one each does."""
        if not len(self.lone):
            return 0, np.empty(0, np.int64)
        vertices, ends = np.unique(np.stack([self.start[self.lone], self.end[self.lone]]), return_inverse=True)
        one, other = ends.reshape(2, -1)
        _, label = components(one, other, len(vertices))
        names, which = np.unique(label[one], return_inverse=True)
        return len(names), which


def arrays(mesh: Trimesh) -> tuple[Array, Array]:
    """Vertices about their middle, in parts of the size so that no product is lost, and faces, as libigl takes them."""
    faces = np.ascontiguousarray(mesh.faces, np.int64)
    vertices = np.asarray(mesh.vertices, float)
    low, high = vertices[faces].min((0, 1)), vertices[faces].max((0, 1))
    return np.ascontiguousarray((vertices - (low + high) / 2) / (float((high - low).max()) or 1.0)), faces


def components(one: Array, other: Array, count: int) -> tuple[int, Array]:
    """How many groups links `one` – `other` make of `count` things, and (count,) in which each is."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(one), bool), (one, other)), (count, count))
    found, label = connected_components(links, directed=False)
    return int(found), np.asarray(label, np.int64)
