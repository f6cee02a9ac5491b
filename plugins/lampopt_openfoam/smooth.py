"""Roughness: how uneven a surface is from vertex to vertex, and a smoothing that keeps its size."""

from __future__ import annotations

from typing import Any

import numpy as np

from lampopt.types import Array

ROUGH = 3e-4  # of the length: 1.3 mm on a car; from there on drag at the coarse level notices
LOCAL = 6e-4  # of the length: in places, where a few creases may fill a patch
PATCHES = 16  # of equal area
SMOOTH = 1e-4  # of the length: what smoothing goes on to; less costs more shape than it takes off roughness
TOO_ROUGH = 4e-3  # of the length: 18 mm on a car; nothing tells roughness from shape any more
FINE = 0.05  # of the length: vertices with longer edges draw the shape, and are no roughness
SHARE = 0.94  # of a random displacement's standard deviation is the median of what is measured
SHRINK, GROW = 0.5, 0.53  # Taubin's pair: what both do together leaves long waves as they are
ROUNDS = 20


def roughness(vertices: Array, faces: Array, around: Any = None) -> tuple[float, float]:
    """Standard deviation of the vertices from a surface smooth over two rings of neighbours, in the vertices' unit.

    The median over the area: edges and creases, which are few, do not count, nor do vertices with long edges; and the
    largest of the medians over `PATCHES` parts of the area. Of closed meshes without loose vertices; `around` (V, V),
    the mean of neighbours, if it is at hand.
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
    counted = np.flatnonzero(area)
    if len(counted) < 2 or area.sum() < 0.2 * np.linalg.norm(normal, axis=1).sum():
        return 0.0, 0.0
    parts = (counted, *_patches(counted, vertices, area))
    medians = [height[_halves(part, height, area)[1][0]] / SHARE for part in parts if len(part) > 1]
    return float(medians[0]), float(max(medians))


def _patches(rows: Array, vertices: Array, area: Array, count: int = PATCHES) -> list[Array]:
    """`rows` in `count` parts of equal area, each cut across where it is longest."""
    if count == 1 or len(rows) < 2:
        return [rows]
    longest = int(np.ptp(vertices[rows], axis=0).argmax())
    halves = _halves(rows, vertices[:, longest], area)
    return [part for half in halves for part in _patches(half, vertices, area, count // 2)]


def _halves(rows: Array, by: Array, area: Array) -> tuple[Array, Array]:
    """`rows` up to the median of `by` over the area, and from it on, neither empty."""
    order = rows[np.argsort(by[rows])]
    total = np.cumsum(area[order])
    at = int(np.clip(np.searchsorted(total, total[-1] / 2), 1, len(order) - 1))
    return order[:at], order[at:]


def smoothed(vertices: Array, faces: Array) -> Array:
    """The vertices (V, 3) after as many rounds of Taubin's smoothing as it takes to be smooth, or all of them."""
    from trimesh import Trimesh
    from trimesh.smoothing import filter_taubin

    mesh, around = Trimesh(vertices, faces, process=False), _around(vertices, faces)
    for _ in range(ROUNDS):
        filter_taubin(mesh, lamb=SHRINK, nu=GROW, iterations=2, laplacian_operator=around)
        rough, local = roughness(mesh.vertices, faces, around)
        if rough <= SMOOTH and local <= ROUGH:
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
