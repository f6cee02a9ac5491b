"""Which side of its faces a surface has its inside on, told by the winding number."""

from __future__ import annotations

import numpy as np

from lampopt.types import Array

OFF = 1e-4  # distance from a face at which its front is looked at, in parts of the size
LOOKS = 8  # faces looked at in each part, the largest ones
MOST = 4096  # looks in all
SAMPLES = 512  # looks that are even over the area
SEEN = 0.55  # winding number behind a face from which on a field has inside there; behind a flat sheet it is 0.5
TURNED = -0.1  # mean winding number of the two sides below which a part faces inward: right is 0.5, turned is −0.5


def inward(vertices: Array, faces: Array, part: Array) -> Array:
    """(parts,) whether each part of the surface faces inward; `part` (F,) says which one a face belongs to.

    From the back of a face to its front the winding number falls by one: from 1 to 0 where the face is turned outward,
    from 0 to −1 where the whole surface is turned inward. The wall of a cavity has its front in the cavity: it stays.
    """
    areas = _areas(vertices, faces)
    order = np.lexsort((-areas, part))
    first = np.append(0, np.flatnonzero(np.diff(part[order])) + 1)
    rank = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    chosen = order[(rank < LOOKS) & (areas[order] > 0)]
    if len(chosen) > MOST:
        chosen = chosen[np.argsort(-areas[chosen], kind="stable")[:MOST]]
    if not len(chosen):
        return np.zeros(int(part.max()) + 1, bool)
    middle = _fronts(vertices, faces, chosen) + 0.5
    count = int(part.max()) + 1
    weight = np.bincount(part[chosen], areas[chosen], count)
    mean = np.bincount(part[chosen], areas[chosen] * middle, count) / np.where(weight > 0, weight, 1)
    return np.asarray(mean < TURNED)


def unseen(vertices: Array, faces: Array) -> float:
    """The share of the area with outside on both sides, as a field of winding numbers has it: from 0 to 1.

    It is what a decoder of signed distances does not see of the surface. With all of it unseen nothing is enclosed.
    """
    areas = np.cumsum(_areas(vertices, faces))
    if areas[-1] <= 0:
        return 1.0
    chosen = np.searchsorted(areas, (np.arange(SAMPLES) + 0.5) / SAMPLES * areas[-1])
    back = _fronts(vertices, faces, chosen) + 1
    return float((back < SEEN).mean())


def _fronts(vertices: Array, faces: Array, chosen: Array) -> Array:
    """Winding numbers just in front of the middles of `chosen` faces."""
    import igl

    a, b, c = (vertices[faces[chosen, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = (a + b + c) / 3 + OFF * float(np.ptp(vertices[faces], axis=(0, 1)).max()) * normals
    return np.asarray(igl.fast_winding_number(vertices, faces, points))


def _areas(vertices: Array, faces: Array) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
