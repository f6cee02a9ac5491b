"""Where the mass of a solid of even density lies: centroid and principal moments of inertia, exact for a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.types import Array

from .basic import by_vertices, corners_of, enclosed_volume, solid

if TYPE_CHECKING:
    from trimesh import Trimesh

ALIKE = 1e-6  # share of the largest moment within which two are one, as in a body of revolution


@dataclass(frozen=True)
class Centroid:
    """Centre of the enclosed volume, by the divergence theorem over the faces."""

    names = ("x", "y", "z")
    units = ("L", "L", "L")
    positions = ("x", "y", "z")

    def __call__(self, mesh: Trimesh) -> Array:
        """Position (3,). Raises EmptyMesh; MeasureError where the mesh is open or faces do not point outward."""
        closed = solid(mesh, "centroid")
        origin = _origin(closed)
        volume, first, _ = _moments(corners_of(closed) - origin)
        return np.asarray(first / volume + origin)

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (3, V, 3). Raises as a call does."""
        centroid = self(mesh)
        corners = corners_of(mesh) - centroid
        halfway = _halfway(corners)
        by_corners = np.stack([_moved(corners, corners[..., k], halfway[..., k]) for k in range(3)])
        return by_vertices(by_corners / enclosed_volume(solid(mesh, "centroid")), mesh)


@dataclass(frozen=True)
class Inertia:
    """Principal moments of inertia about the centroid, least first, at a density of 1."""

    names = ("least", "middle", "largest")
    units = ("L^5", "L^5", "L^5")

    def __call__(self, mesh: Trimesh) -> Array:
        """Moments (3,). Raises EmptyMesh; MeasureError where the mesh is open or its faces do not all point outward."""
        closed = solid(mesh, "inertia")
        _, tensor = _about_centroid(corners_of(closed) - _origin(closed))
        return np.asarray(np.linalg.eigvalsh(tensor))

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (3, V, 3). Raises as a call does.

        Where two moments are one, their order changes there: each is given the mean of their derivatives.
        """
        closed = solid(mesh, "inertia")
        origin = _origin(closed)
        centroid, tensor = _about_centroid(corners_of(closed) - origin)
        moments, axes = np.linalg.eigh(tensor)
        # About the centroid the first moments vanish: to first order its own move changes nothing.
        corners = corners_of(mesh) - origin - centroid
        squared = [
            ((points**2).sum(axis=-1)[..., None] - (points @ axes) ** 2) for points in (corners, _halfway(corners))
        ]
        turned = [_moved(corners, *(part[..., k] for part in squared)) for k in range(3)]
        by_corners = np.stack([np.mean([turned[j] for j in _alike(moments, i)], axis=0) for i in range(3)])
        return by_vertices(by_corners, mesh)


def _origin(mesh: Trimesh) -> Array:
    """A point amid the mesh: far from the origin of coordinates the moments would drown in rounding."""
    return np.asarray(np.mean(mesh.bounds, axis=0))


def _moments(corners: Array) -> tuple[float, Array, Array]:
    """Volume, first moments (3,) and second moments (3, 3) of the solid within triangles (F, 3, 3).

    Each face and the origin make a tetrahedron; the integrals of 1, x and x xᵀ over it are exact.
    """
    six = np.einsum("fc,fc->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = corners.sum(axis=1)
    products = np.einsum("f,fki,fkj->ij", six, corners, corners) + np.einsum("f,fi,fj->ij", six, total, total)
    return float(six.sum() / 6), six @ total / 24, products / 120


def _halfway(corners: Array) -> Array:
    """(F, 3, 3) the middle of the side opposite each corner."""
    middles: Array = (corners.sum(axis=1, keepdims=True) - corners) / 2
    return middles


def _moved(corners: Array, at_corners: Array, halfway: Array) -> Array:
    """(F, 3, 3) derivative by each corner of the integral of a quadratic function over the solid.

    A corner that moves sweeps out volume where its hat function is not zero: the derivative is the face's normal times
    the integral of function times hat over the face, exact from the function's values at the corners (F, 3) and halfway
    between them, opposite each corner (F, 3).
    """
    hats = at_corners / 20 - at_corners.sum(axis=1, keepdims=True) / 60
    hats = hats + 2 * halfway.sum(axis=1, keepdims=True) / 15 - halfway / 15
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    return np.asarray(hats[..., None] * normals[:, None])


def _about_centroid(corners: Array) -> tuple[Array, Array]:
    """Centroid (3,), and the inertia tensor (3, 3) about it."""
    volume, first, second = _moments(corners)
    centroid = first / volume
    second = second - volume * np.outer(centroid, centroid)
    return centroid, np.trace(second) * np.eye(3) - second


def _alike(moments: Array, i: int) -> Array:
    return np.flatnonzero(np.abs(moments - moments[i]) <= ALIKE * moments[-1])
