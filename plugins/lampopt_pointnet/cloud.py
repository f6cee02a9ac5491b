"""A surface as a cloud of small triangles: the same in any order of faces, nearly so for any tessellation.

Nothing is drawn at random and nothing is lumped. A face is a triangle of the cloud as it stands; only one that is long
is split, into equal parts as many as its longest edge asks for. What is pooled over the cloud moves smoothly with the
vertices, but for a face that comes to be split otherwise, whose parts give what they gave before to a high order.
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

SIDE = 0.103  # no piece is longer [scale]; not a round part of 1, at which all faces of a box would be split at once
FARTHEST = 1e12  # coordinate [scale]: the powers of it that are reckoned with stay numbers
MOST = 60_000  # pieces, about, made by splitting: what is far larger than the training meshes is split more coarsely


@dataclass(frozen=True, eq=False)
class Cloud:
    """P triangles that are a surface.

    Parameters
    ----------
    corners
        (P, 3, 3) about the surface's area centroid [scale].
    normals
        (P, 3) outward, of length 1.
    areas
        (P,) [scale²].
    """

    corners: Array
    normals: Array
    areas: Array


@dataclass(frozen=True, eq=False)
class Cut:
    """A surface of F faces cut into P pieces: the way to a cloud and back.

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
    face, share, weights
        Of each piece: (P,) its face, (P,) its part of the face's area, (P, 3, 3) barycentric coordinates of its corners
        there.
    """

    faces: Array
    corners: Array
    count: int
    scale: float
    face: Array
    share: Array
    weights: Array

    @classmethod
    def of(cls, mesh: Trimesh, scale: float) -> Cut:
        """Cut `mesh`.

        Raises
        ------
        EmptyMesh
            If no face has an area.
        MeasureError
            If a vertex of a face is not finite, or too far out to be reckoned with.
        """
        corners = _corners(mesh)
        if not np.abs(corners).max(initial=0.0) <= FARTHEST * scale:
            raise MeasureError(f"expected coordinates within {FARTHEST * scale:.3g}, far beyond what was learned from")
        corners, faces = corners / scale, np.asarray(mesh.faces, np.int64)
        double = np.linalg.norm(_cross(corners), axis=1)
        faces, corners, double = (array[double > 0] for array in (faces, corners, double))
        if not len(faces):
            raise EmptyMesh("expected a mesh with faces that have an area, got none")
        corners = corners - _centroid(corners, double)
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
        number = np.ceil(edges / SIDE)
        # by a power of two, so that it is not another one for every move of a vertex
        coarser = 2 ** np.ceil(np.log2(max(1.0, np.sqrt((number[number > 1] ** 2).sum() / MOST))))
        return cls(faces, corners, len(mesh.vertices), scale, *_split(np.ceil(number / coarser).astype(np.int64)))

    def cloud(self) -> Cloud:
        """The cloud, pieces of one face having its normal."""
        cross = _cross(self.corners)
        double = np.linalg.norm(cross, axis=1)
        normals, areas = cross / double[:, None], double / 2
        return Cloud(self.weights @ self.corners[self.face], normals[self.face], areas[self.face] * self.share)

    def pullback(self, by_corners: Array, by_normals: Array, by_areas: Array) -> Array:
        """Gradient by vertices (V, 3) [1/unit] of what has these by a cloud's corners, normals and areas."""
        size = len(self.faces)
        place = _summed(self.face, (self.weights.transpose(0, 2, 1) @ by_corners).reshape(-1, 9), size)
        place = place.reshape(size, 3, 3)
        normal, area = _summed(self.face, by_normals, size), np.bincount(self.face, by_areas * self.share, size)
        # the centroid moves against everything that is placed about it
        cross = _cross(self.corners)
        double = np.linalg.norm(cross, axis=1)
        outward, shift, whole = cross / double[:, None], -place.sum(axis=(0, 1)), double.sum() / 2
        area += self.corners.mean(axis=1) @ shift / whole
        place += (double / 6 / whole)[:, None, None] * shift
        turned = normal - (normal * outward).sum(axis=1)[:, None] * outward
        by_cross = area[:, None] * outward / 2 + turned / double[:, None]
        a, b, c = (self.corners[:, i] for i in range(3))
        place += np.stack([np.cross(p, by_cross) for p in (b - c, c - a, a - b)], axis=1)
        return _summed(self.faces.ravel(), place.reshape(-1, 3), self.count) / self.scale


def size(mesh: Trimesh) -> float:
    """The longest side of the box about a mesh's faces [unit of the mesh].

    Raises EmptyMesh where it has none, MeasureError where a vertex is not finite or its square would be no number.
    """
    corners = _corners(mesh)
    if not np.abs(corners).max(initial=0.0) <= 1e100:
        raise MeasureError("expected coordinates up to 1e100; take another unit")
    longest = float(np.ptp(corners.reshape(-1, 3), axis=0).max()) if len(corners) else 0.0
    if longest < 1e-100:
        raise EmptyMesh(f"expected a mesh with faces that have an area, got {len(corners)} of size {longest:.3g}")
    return longest


def _corners(mesh: Trimesh) -> Array:
    """(F, 3, 3) of a mesh's faces [unit of the mesh]."""
    corners: Array = np.asarray(mesh.vertices, float).reshape(-1, 3)[np.asarray(mesh.faces, np.int64).reshape(-1, 3)]
    if not np.isfinite(corners).all():
        raise MeasureError("expected finite vertices, got some that are not; repair the mesh first")
    return corners


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
    """(size, k) sums of the `rows` (P, k) of each index."""
    return np.stack([np.bincount(index, column, size) for column in rows.T], axis=1)


def _split(number: Array) -> tuple[Array, Array, Array]:
    """Triangles split along lines parallel to their edges, edges into `number` (F,) parts each.

    Returns
    -------
    face, share, weights
        Of each piece: (P,) its triangle, (P,) its part of the triangle's area, (P, 3, 3) barycentric coordinates of its
        corners.
    """
    made = []
    for n in np.unique(number):
        faces = np.flatnonzero(number == n)
        corners = _lattice(int(n))
        made.append(
            (np.repeat(faces, n * n), np.full(len(faces) * n * n, 1 / n**2), np.tile(corners, (len(faces), 1, 1)))
        )
    face, share, weights = (np.concatenate(parts) for parts in zip(*made, strict=True))
    return face, share, weights


def _lattice(n: int) -> Array:
    """(n², 3, 3) barycentric corners of the equal parts of a triangle, those that stand as it does first."""
    i, j = (index.ravel() for index in np.mgrid[:n, :n])
    low = np.column_stack([i, j])[:, None]
    standing = low[i + j < n] + np.array([[0, 0], [1, 0], [0, 1]])
    turned = low[i + j < n - 1] + np.array([[1, 1], [0, 1], [1, 0]])
    at = np.concatenate([standing, turned])
    corners: Array = np.concatenate([n - at.sum(axis=2, keepdims=True), at], axis=2) / n
    return corners
