"""Roughness: how uneven a surface is from vertex to vertex, and a smoothing that keeps its size."""

from __future__ import annotations

from typing import Any

import numpy as np

from lampopt.types import Array

ROUGH = 3e-4  # of the length: 1.3 mm on a car; from there on drag at the coarse level notices
SMOOTH = 1e-4  # of the length: what smoothing goes on to; less costs more shape than it takes off roughness
TOO_ROUGH = 4e-3  # of the length: 18 mm on a car; nothing tells roughness from shape any more
FINE = 0.05  # of the length: vertices with longer edges draw the shape, and are no roughness
SHARE = 0.94  # of a random displacement's standard deviation is the median of what is measured
SHRINK, GROW = 0.5, 0.53  # Taubin's pair: what both do together leaves long waves as they are
ROUNDS = 20


def roughness(vertices: Array, faces: Array, around: Any = None) -> float:
    """Standard deviation of the vertices from a surface smooth over two rings of neighbours, in the vertices' unit.

    The median over the area: edges and creases, which are few, do not count, nor do vertices with long edges. Of closed
    meshes without loose vertices; `around` (V, V), the mean of neighbours, if it is at hand.
    """
    if around is None:
        around = _around(vertices, faces)
    away = vertices - around @ vertices
    away -= around @ away  # what is left of a curved surface's own bend is of fourth order
    normal = _normals(vertices, faces)
    area = np.linalg.norm(normal, axis=1)
    height = np.abs((away * normal).sum(axis=1)) / np.maximum(area, 1e-300)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    longest = np.zeros(len(vertices))
    np.maximum.at(longest, ends, np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)[:, None])
    area = np.where(longest <= FINE, area, 0)
    if area.sum() < 0.2 * np.linalg.norm(normal, axis=1).sum():
        return 0.0
    order = np.argsort(height)
    total = np.cumsum(area[order])
    return float(height[order][np.searchsorted(total, total[-1] / 2)]) / SHARE


def smoothed(vertices: Array, faces: Array) -> Array:
    """The vertices (V, 3) after as many rounds of Taubin's smoothing as it takes to be smooth, or all of them."""
    from trimesh import Trimesh
    from trimesh.smoothing import filter_taubin

    mesh, around = Trimesh(vertices, faces, process=False), _around(vertices, faces)
    for _ in range(ROUNDS):
        filter_taubin(mesh, lamb=SHRINK, nu=GROW, iterations=2, laplacian_operator=around)
        if roughness(mesh.vertices, faces, around) <= SMOOTH:
            break
    return np.array(mesh.vertices)


def _around(vertices: Array, faces: Array) -> Any:
    """(V, V) sparse: the mean of each vertex's neighbours."""
    from trimesh import Trimesh
    from trimesh.smoothing import laplacian_calculation

    return laplacian_calculation(Trimesh(vertices, faces, process=False))


def _normals(vertices: Array, faces: Array) -> Array:
    """(V, 3) the area vectors of the faces around each vertex, summed."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.column_stack([np.bincount(faces.ravel(), np.repeat(normal[:, k], 3), len(vertices)) for k in range(3)])
