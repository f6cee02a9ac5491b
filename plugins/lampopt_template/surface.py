"""A triangulated surface that is asked where it is nearest: closest points, normals that respect edges, samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

CREASE = np.cos(np.radians(40.0))  # faces that meet at a wider angle do not share a normal
CURVED = 0.75  # how far a closest point leaves its flat face for the curved surface (Boubekeur and Alexa 2008)


@dataclass(frozen=True, eq=False)
class Near:
    """Where a surface is nearest to some points: `points` and unit `normals` (M, 3) there, `faces` (M,), and weights of
    the faces' corners (M, 3)."""

    points: Array
    normals: Array
    faces: Array
    weights: Array


class Surface:
    """Vertices (V, 3) and faces (F, 3), faces outward."""

    def __init__(self, vertices: Array, faces: Array) -> None:
        self.vertices: Array = np.ascontiguousarray(vertices, float)
        self.faces: Array = np.ascontiguousarray(faces, np.int64)

    @classmethod
    def of(cls, mesh: Trimesh, *, every: bool = False) -> Surface:
        """That of a mesh, of `every` vertex or those that faces have; a closed one that is inside out is turned."""
        faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
        used, place = np.unique(faces, return_inverse=True)
        if not every and len(used) < len(vertices):
            vertices, faces = vertices[used], place.reshape(faces.shape)
        return cls(vertices, faces[:, ::-1] if mesh.is_watertight and mesh.volume < 0 else faces)

    @cached_property
    def crosses(self) -> Array:
        """(F, 3) normals of the faces, as long as twice their areas."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> Array:
        """(F,) of the faces."""
        return np.asarray(np.linalg.norm(self.crosses, axis=1) / 2)

    @cached_property
    def normals(self) -> Array:
        """(F, 3) unit normals of the faces; of one without area zero."""
        return unit(self.crosses)

    @cached_property
    def vertex_areas(self) -> Array:
        """(V,) a third of the faces about each vertex."""
        return np.bincount(self.faces.ravel(), np.repeat(self.areas / 3, 3), len(self.vertices))

    @cached_property
    def vertex_normals(self) -> Array:
        """(V, 3) unit normals at the vertices, faces counting by their areas."""
        corner = self.faces.ravel()
        sums = [np.bincount(corner, np.repeat(self.crosses[:, k], 3), len(self.vertices)) for k in range(3)]
        return unit(np.stack(sums, -1))

    @cached_property
    def corner_normals(self) -> Array:
        """(F, 3, 3) unit normals at the faces' corners, over those faces about a vertex that are smooth there."""
        corners = self.faces.ravel()
        order = np.argsort(corners, kind="stable")
        count = np.bincount(corners, minlength=len(self.vertices))
        first = np.cumsum(count) - count
        about = count[corners]  # how many faces meet where each corner is
        mine = np.repeat(np.arange(len(corners)), about)
        step = np.arange(len(mine)) - np.repeat(np.cumsum(about) - about, about)
        other = order[first[corners[mine]] + step] // 3
        smooth = (self.normals[mine // 3] * self.normals[other]).sum(1) > CREASE
        sums = [np.bincount(mine[smooth], self.crosses[other[smooth], k], len(corners)) for k in range(3)]
        return unit(np.stack(sums, -1)).reshape(-1, 3, 3)

    def near(self, points: Array, *, curved: bool = False) -> Near:
        """The closest points to `points` (M, 3), on the flat faces with their normals; or, with `curved`, on the smooth
        surface that faces approximate, with its normals."""
        _, faces, closest = self._tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points, float))
        weights = self._weights(faces, closest)
        if not curved:
            return Near(closest, self.normals[faces], faces, weights)
        at, across = self.vertices[self.faces[faces]], self.corner_normals[faces]
        out = np.einsum("mkc,mkc->mk", closest[:, None] - at, across)  # above each corner's tangent plane
        moved = closest - CURVED * np.einsum("mk,mk,mkc->mc", weights, out, across)
        return Near(moved, unit(np.einsum("mk,mkc->mc", weights, across)), faces, weights)

    def samples(self, longest: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Points (S, 3) on the surface, unit normals (S, 3) and areas (S,) that they stand for.

        They are the vertices, which lie on the shape that was meshed where faces only cut across it; faces that are
        longer than `longest` have random points of their own besides.
        """
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        length = np.sqrt(np.max([((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
        large = (length > longest) & (self.areas > 0)
        number = np.where(large, np.ceil(2 * self.areas / longest**2), 0).astype(np.int64)
        face = np.repeat(np.arange(len(self.faces)), number)
        inner = self._in(face, rng)
        small = np.repeat(np.where(large, 0.0, self.areas / 3), 3)
        corner = np.bincount(self.faces.ravel(), small, len(self.vertices))
        kept = corner > 0
        return (
            np.concatenate([self.vertices[kept], inner]),
            np.concatenate([self.vertex_normals[kept], self.normals[face]]),
            np.concatenate([corner[kept], self.areas[face] / np.maximum(number[face], 1)]),
        )

    def away(self, other: Surface, count: int = 5_000) -> float:
        """The mean distance from here to `other`, over `count` points drawn evenly."""
        points = self.drawn(count, np.random.default_rng(0))
        return float(np.linalg.norm(other.near(points).points - points, axis=1).mean())

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """(count, 3) points drawn evenly."""
        face = rng.choice(len(self.faces), count, p=self.areas / self.areas.sum())
        return self._in(face, rng)

    def _in(self, face: Array, rng: np.random.Generator) -> Array:
        """A random point in each of the given faces."""
        a, b, c = self.vertices[self.faces[face]].transpose(1, 0, 2)
        u, v = np.sort(rng.random((2, len(face))), axis=0)
        return np.asarray(u[:, None] * a + (v - u)[:, None] * b + (1 - v)[:, None] * c)

    @cached_property
    def _tree(self) -> Any:
        import igl

        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    def _weights(self, faces: Array, points: Array) -> Array:
        """(M, 3) barycentric coordinates of `points` in `faces`, none negative."""
        import igl

        a, b, c = (np.ascontiguousarray(self.vertices[self.faces[faces, k]]) for k in range(3))
        weights = igl.barycentric_coordinates(np.ascontiguousarray(points), a, b, c)
        weights = np.where(np.isfinite(weights).all(1, keepdims=True), np.clip(weights, 0, 1), 1 / 3)  # no area: any
        return np.asarray(weights / weights.sum(1, keepdims=True))


def unit(vectors: Array) -> Array:
    """`vectors` (..., 3) at length 1; zero ones stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0))
