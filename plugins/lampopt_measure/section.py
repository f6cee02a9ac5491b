"""Plane sections as closed loops with their areas and centroids, without ordering a single point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lampopt.errors import MeasureError
from lampopt.types import Array

SLIVER = 1e-6  # share of the largest loop's area below which a loop encloses nothing worth a centroid


@dataclass(frozen=True, eq=False)
class Loops:
    """The n loops in which a plane cuts a mesh."""

    area: Array  # (n,) positive around material, negative around a hole
    centroid: Array  # (n, 2) of what each encloses
    polar: Array  # (n,) second polar moment of that about its centroid, with the sign of the area


def section(vertices: Array, faces: Array, height: float) -> Loops:
    """Cut a mesh with the plane z = `height`.

    Parameters
    ----------
    vertices, faces
        (V, 3) and (F, 3), wound so that faces point outward.
    height
        Of the plane. A vertex on it counts as above, so that no case is degenerate.

    Raises
    ------
    MeasureError
        If the section is not closed there, or a face is listed twice.
    """
    above = vertices[:, 2] >= height
    cut = faces[_crossing(above, faces)]
    if len(cut) == 0:
        return Loops(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    lone_above = above[cut].sum(axis=1) == 1
    lone = (above[cut] == lone_above[:, None]).argmax(axis=1)
    rows = np.arange(len(cut))
    a, b, c = (cut[rows, (lone + k) % 3] for k in range(3))
    # The plane crosses edges ab and ac. Seen from outside a face runs a, b, c counter-clockwise, so that walking from
    # ab to ac keeps the material on the left where `a` is the one above, and the other way round where it is below.
    first, second = np.where(lone_above, b, c), np.where(lone_above, c, b)
    ends = np.stack([np.r_[a, a], np.r_[first, second]], axis=1)
    ends.sort(axis=1)
    keys, node = np.unique(ends[:, 0] * np.int64(len(vertices)) + ends[:, 1], return_inverse=True)
    start, end = node[: len(cut)], node[len(cut) :]
    if (np.bincount(start, minlength=len(keys)) != np.bincount(end, minlength=len(keys))).any():
        raise MeasureError(f"section at z = {height:.6g}: expected closed loops, got open ends; the mesh is not closed")
    if len(np.unique(start * np.int64(len(keys)) + end)) < len(cut):
        raise MeasureError(
            f"section at z = {height:.6g}: expected each face once, got some twice; take one of each away "
            "(mesh.update_faces(mesh.unique_faces()))"
        )
    low, high = vertices[keys // len(vertices)], vertices[keys % len(vertices)]
    share = (height - low[:, 2]) / (high[:, 2] - low[:, 2])
    points = (low + share[:, None] * (high - low))[:, :2]
    count, label = connected_components(
        coo_array((np.ones(len(cut), bool), (start, end)), (len(keys), len(keys))), directed=False
    )
    # Each loop about its own middle: about a common one the moments of a small loop would drown in rounding.
    middle = np.stack([np.bincount(label, points[:, k]) for k in range(2)], axis=1) / np.bincount(label)[:, None]
    loop = label[start]
    p, q = points[start] - middle[loop], points[end] - middle[loop]
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    area = np.bincount(loop, cross, count) / 2
    moments = np.stack([np.bincount(loop, (p[:, k] + q[:, k]) * cross, count) / 6 for k in range(2)], axis=1)
    whole = np.abs(area) > SLIVER * np.abs(area).max()
    second = np.bincount(loop, (p * p + p * q + q * q).sum(axis=1) * cross, count)[whole] / 12
    area, away = area[whole], moments[whole] / area[whole, None]
    return Loops(area, away + middle[whole], second - area * (away**2).sum(axis=1))


def free_along_z(vertices: Array, faces: Array, point: Array) -> bool:
    """Whether the vertical line through `point` (2,) meets no face."""
    return len(over(vertices, faces, point)) == 0


def over(vertices: Array, faces: Array, point: Array) -> Array:
    """The faces (k, 3) that the vertical line through `point` (2,) meets."""
    for axis in range(2):  # narrowing down axis by axis keeps this far cheaper than looking at every face whole
        faces = faces[_crossing(vertices[:, axis] >= point[axis], faces)]
    corners = vertices[:, :2][faces] - point
    following = np.roll(corners, -1, axis=1)
    turn = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    met: Array = faces[(turn >= 0).all(axis=1) | (turn <= 0).all(axis=1)]
    return met


def _crossing(beyond: Array, faces: Array) -> Array:
    """Which faces have corners on both sides, given which vertices lie beyond (V,)."""
    a, b, c = (beyond[faces[:, k]] for k in range(3))
    crossing: Array = (a != b) | (b != c)
    return crossing
