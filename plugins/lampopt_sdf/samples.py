"""Points about a surface with their signed distances, drawn once and kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import FitError
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

SPREADS = ((0.40, 0.005), (0.25, 0.02), (0.20, 0.08))  # share of the points and their distance [box]; the rest anywhere


def draw(mesh: Trimesh, count: int, seed: np.random.SeedSequence) -> tuple[Array, Array, Array]:
    """Points (count, 3), signed distances (count,) and points on the surface (count / 4, 3) of a mesh in the box.

    Signs come from the fast winding number (Barill et al. 2018), so open and self-intersecting meshes are told
    inside from outside too.

    Raises
    ------
    FitError
        Naming a mesh without faces, or one that encloses nothing.
    """
    import igl

    name = mesh.metadata.get("name", "mesh")
    if len(mesh.faces) == 0:
        raise FitError(f"{name}: expected a mesh with faces, got none; remove it from the exemplars")
    rng = np.random.default_rng(seed)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    parts = [
        on_surface(vertices, faces, n := int(share * count), rng) + rng.normal(0, spread, (n, 3))
        for share, spread in SPREADS
    ]
    parts.append(rng.uniform(-1, 1, (count - sum(map(len, parts)), 3)))
    points = np.concatenate(parts)
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    # with this kind libigl scales the distance by the approximate winding number: take its sign alone
    scaled, _, closest, _ = igl.signed_distance(points, vertices, faces, kind)
    distances = np.copysign(np.linalg.norm(points - closest, axis=1), scaled)
    if not (distances < 0).any():
        raise FitError(f"{name}: encloses nothing; close the surface or turn its faces outward")
    return points.astype(np.float32), distances.astype(np.float32), on_surface(vertices, faces, count // 4, rng)


def on_surface(vertices: Array, faces: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points, even over the area.

    Stratified: the k-th point lies in the k-th part of the cumulated area, so that exemplars that share their faces
    get points that correspond.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    cumulated = np.cumsum(areas)
    at = np.searchsorted(cumulated, (np.arange(count) + rng.random(count)) / count * cumulated[-1], side="right")
    at = np.minimum(at, len(faces) - 1)
    root, other = np.sqrt(rng.random((2, count, 1)))[0], rng.random((count, 1))
    return np.asarray((1 - root) * a[at] + root * (1 - other) * b[at] + root * other * c[at])
