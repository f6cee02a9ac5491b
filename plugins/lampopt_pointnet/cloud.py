"""A surface as a cloud of oriented points: the same in any order of faces, nearly so for any tessellation.

Nothing is drawn at random. Faces are halved across their longest edge until they are small, and the pieces that lie in
one cell of a grid and face alike are lumped into one point: their centroid, mean normal and area. A smooth function
summed over the cloud is its integral over the surface to second order in the cell's side.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import fsum
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import EmptyMesh, MeasureError
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

SIDE = 0.03  # of a cell [scale]
MOST = 60_000  # pieces, about, of one surface: what is far larger than the training meshes is cut more coarsely
SHIFT = np.array([0.382, 0.618, 0.271])  # of the grid [cells]: no plane of symmetry lies between two layers of cells


@dataclass(frozen=True, eq=False)
class Cloud:
    """M oriented points that stand for a surface.

    Parameters
    ----------
    points
        (M, 3) about the surface's area centroid [scale].
    normals
        (M, 3) mean outward normals, of length 1 where the surface is flat.
    areas
        (M,) of the surface that each point stands for [scale²].
    """

    points: Array
    normals: Array
    areas: Array


@dataclass(frozen=True, eq=False)
class Cut:
    """A surface cut into P pieces, each in one of F faces and in one of M cells: the way to a cloud and back.

    Parameters
    ----------
    faces
        (F, 3) that have an area.
    corners
        (F, 3, 3) their corners about the surface's area centroid [scale].
    count
        Vertices of the mesh, those of no face among them.
    scale
        Length that is 1 in the cloud [unit of the mesh].
    face, cell
        (P,) which face and which point of the cloud each piece belongs to.
    share, inside
        (P,) the part of its face's area that a piece has, (P, 3) barycentric coordinates of its centroid there.
    """

    faces: Array
    corners: Array
    count: int
    scale: float
    face: Array
    cell: Array
    share: Array
    inside: Array

    @classmethod
    def of(cls, mesh: Trimesh, scale: float, side: float) -> Cut:
        """Cut `mesh` by cells of `side` [scale].

        Raises
        ------
        EmptyMesh
            If no face has an area.
        MeasureError
            If a vertex of a face is not finite.
        """
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
        corners = vertices[faces] / scale
        if not np.isfinite(corners).all():
            raise MeasureError("expected finite vertices, got some that are not; repair the mesh first")
        double = np.linalg.norm(_cross(corners), axis=1)
        faces, corners, double = (array[double > 0] for array in (faces, corners, double))
        if not len(faces):
            raise EmptyMesh("expected a mesh with faces that have an area, got none")
        corners = corners - _centroid(corners, double)
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
        longest = max(side, np.sqrt(double.sum() / 2 / MOST), edges[edges > side].sum() / MOST)
        face, share, weights = _halved(corners, longest)
        inside = weights.mean(axis=1)
        places = np.floor(np.einsum("pi,pix->px", inside, corners[face]) / longest + SHIFT).astype(np.int64)
        cross = _cross(corners)
        axis = np.abs(cross).argmax(axis=1)
        facing = 2 * axis + (np.take_along_axis(cross, axis[:, None], axis=1)[:, 0] > 0)
        cell = np.unique(np.column_stack([places, facing[face]]), axis=0, return_inverse=True)[1].ravel()
        return cls(faces, corners, len(vertices), scale, face, cell, share, inside)

    @property
    def pieces(self) -> tuple[Array, Array, Array]:
        """Centroids (P, 3), vector areas (P, 3) and areas (P,)."""
        vectors = _cross(self.corners)[self.face] * self.share[:, None] / 2
        middles = np.einsum("pi,pix->px", self.inside, self.corners[self.face])
        return middles, vectors, np.linalg.norm(vectors, axis=1)

    def cloud(self) -> Cloud:
        """The cloud, its points in the order of the grid's cells."""
        middles, vectors, areas = self.pieces
        total = np.bincount(self.cell, areas)
        size = len(total)
        points = _summed(self.cell, areas[:, None] * middles, size) / total[:, None]
        return Cloud(points, _summed(self.cell, vectors, size) / total[:, None], total)

    def pullback(self, cloud: Cloud, by_points: Array, by_normals: Array, by_areas: Array) -> Array:
        """Gradient by vertices (V, 3) [1/unit] of what has these by a cloud's points, normals (M, 3) and areas (M,).

        Exact between two jumps of a piece from cell to cell.
        """
        middles, _, areas = self.pieces
        by_sum = by_points / cloud.areas[:, None]
        by_vectors = by_normals / cloud.areas[:, None]
        by_total = by_areas - (by_sum * cloud.points + by_vectors * cloud.normals).sum(axis=1)
        # of a piece: its area, vector area and centroid
        by_area = self.share * (by_total[self.cell] + (by_sum[self.cell] * middles).sum(axis=1))
        by_vector = self.share[:, None] * by_vectors[self.cell]
        by_middle = areas[:, None] * by_sum[self.cell]
        size = len(self.faces)
        area, vector = np.bincount(self.face, by_area, size), _summed(self.face, by_vector, size)
        place = np.stack([_summed(self.face, self.inside[:, [i]] * by_middle, size) for i in range(3)], axis=1)
        # the centroid moves against everything that is placed about it
        cross = _cross(self.corners)
        double = np.linalg.norm(cross, axis=1)
        shift, whole = -place.sum(axis=(0, 1)), double.sum() / 2
        area += self.corners.mean(axis=1) @ shift / whole
        place += (double / 6 / whole)[:, None, None] * shift
        by_cross = (area[:, None] * cross / double[:, None] + vector) / 2
        a, b, c = (self.corners[:, i] for i in range(3))
        place += np.stack([np.cross(p, by_cross) for p in (b - c, c - a, a - b)], axis=1)
        return _summed(self.faces.ravel(), place.reshape(-1, 3), self.count) / self.scale


def _cross(corners: Array) -> Array:
    """Normals (F, 3) of triangles (F, 3, 3), twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _centroid(corners: Array, double: Array) -> Array:
    """(3,) area centroid of triangles (F, 3, 3), to the bit the same in any order of them.

    About the lowest corner, so that a far-off mesh loses no digits.
    """
    low = corners.min(axis=(0, 1))
    moments = double[:, None] * (corners - low).mean(axis=1)
    centre: Array = low + np.array([fsum(moment) for moment in moments.T]) / fsum(double)
    return centre


def _summed(index: Array, rows: Array, size: int) -> Array:
    """(size, 3) sums of the `rows` (P, 3) of each index."""
    return np.stack([np.bincount(index, rows[:, k], size) for k in range(3)], axis=1)


def _halved(corners: Array, longest: float) -> tuple[Array, Array, Array]:
    """Triangles (F, 3, 3) halved across their longest edge until none is longer than `longest`.

    Returns
    -------
    face, share, weights
        Of each piece: (P,) its triangle, (P,) its part of the triangle's area, (P, 3, 3) barycentric coordinates of its
        corners.
    """
    face = np.arange(len(corners))
    share, weights = np.ones(len(corners)), np.broadcast_to(np.eye(3), corners.shape)
    done = []
    while len(face):
        at = weights @ corners[face]
        edges = np.linalg.norm(at - np.roll(at, -1, axis=1), axis=2)
        small = edges.max(axis=1) <= longest
        done.append((face[small], share[small], weights[small]))
        face, share, weights, edges = face[~small], share[~small], weights[~small], edges[~small]
        rows, start = np.arange(len(face)), edges.argmax(axis=1)
        end = (start + 1) % 3
        middle = (weights[rows, start] + weights[rows, end]) / 2
        halves = []
        for corner in (start, end):
            half = weights.copy()
            half[rows, corner] = middle
            halves.append(half)
        face, share, weights = np.tile(face, 2), np.tile(share / 2, 2), np.concatenate(halves)
    return tuple(np.concatenate(parts) for parts in zip(*done, strict=True))  # type: ignore[return-value]
