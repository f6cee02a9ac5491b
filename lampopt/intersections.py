"""Where a surface passes through itself: pairs of faces that cross.

Two faces cross when they have a piece of line in common along which each passes through the other. Candidates come from
a tree of bounding boxes over the faces in Morton order, walked against itself level by level, all pairs of a level at
once; the test itself is that of intervals on the line in which two planes meet (Möller 1997).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

ON = 1e-9  # of the mesh's size: what is nearer to a plane lies on it; meshes are joined to as many digits
ALIKE = 1e-6  # sine of two planes' angle below which rounding decides how they lie: they are taken for one
AT_ONCE = 1 << 18  # pairs looked at in one go: bounds the memory
NEXT = np.array([1, 2, 0])


def self_intersections(mesh: Trimesh, *, most: int | None = None) -> Array:
    """Pairs of faces of `mesh` that cross.

    Surfaces that merely touch do not cross, and neither do ones that overlap in a plane, to a millionth of a radian.
    Faces that share an edge are taken not to cross; those that share a vertex do where they meet in more than that.
    Where a surface crosses another exactly along an edge, the faces on both sides of the edge cross. Faces without area
    are left out.

    Parameters
    ----------
    mesh
        Any triangles, closed or not, of finite size.
    most
        Stop once so many pairs are found; by default all are.

    Returns
    -------
    Array
        (k, 2) face indices, the smaller first, in ascending order.
    """
    faces = np.asarray(mesh.faces, np.int64)
    corners: Array = np.asarray(mesh.vertices, float)
    if len(faces) < 2:
        return np.empty((0, 2), np.int64)
    corners = corners - corners[faces].mean((0, 1))  # digits go to the shape, not to its place
    size = float(np.ptp(corners[faces], axis=(0, 1)).max())
    corners = corners / (size or 1.0)
    triangles = corners[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    twice = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(triangles - triangles[:, NEXT], axis=2).max(1)
    flat = np.flatnonzero(twice > ON * longest)  # those with a height, and so a plane
    normals[flat] /= twice[flat, None]
    surface = _Surface(corners, faces, triangles, normals, _across(faces))
    found, count = [np.empty((0, 2), np.int64)], 0
    for pairs in _candidates(triangles[flat].min(1), triangles[flat].max(1)):
        crossing = surface.crossing(flat[pairs])
        found.append(np.sort(crossing, axis=1))
        count += len(crossing)
        if most is not None and count >= most:
            break
    every = np.concatenate(found)
    return every[np.lexsort(every.T[::-1])][:most]


class _Surface:
    """Faces ready to be tested two by two, the mesh's size being 1."""

    def __init__(self, vertices: Array, faces: Array, triangles: Array, normals: Array, across: Array) -> None:
        self.vertices, self.faces, self.triangles, self.normals = vertices, faces, triangles, normals
        self.across = across  # (F, 3) the vertex opposite to each edge k → k + 1 on its other side, −1 without

    def crossing(self, pairs: Array) -> Array:
        """Those of `pairs` (m, 2) that cross."""
        one, other = self.faces[pairs[:, 0]], self.faces[pairs[:, 1]]
        shared = (one[:, :, None] == other[:, None, :]).sum((1, 2))
        pairs = pairs[shared < 2]
        heights: list[Array] = []
        for side in (0, 1):  # each against the other's plane; most pairs end here
            height = self._heights(pairs[:, 1 - side], self.triangles[pairs[:, side]])
            apart = (height > 0).all(1) | (height < 0).all(1) | (height == 0).all(1)
            pairs, heights = pairs[~apart], [h[~apart] for h in (*heights, height)]
        ends, through, edged = [], [], []
        line = np.cross(self.normals[pairs[:, 0]], self.normals[pairs[:, 1]])
        for side in (0, 1):
            face, height = pairs[:, side], heights[side]
            passes = (height > 0).any(1) & (height < 0).any(1)
            opposite = self._opposite(face, height)
            beyond = self._heights(pairs[:, 1 - side], self.vertices[opposite][:, None])[:, 0]
            on_edge = (opposite >= 0) & (beyond * height.sum(1) < 0)
            ends.append(_interval(self.triangles[face], height, line))
            through.append(passes | on_edge)
            edged.append(np.where(on_edge & ~passes, opposite, -1))
        overlap = np.minimum(ends[0][1], ends[1][1]) - np.maximum(ends[0][0], ends[1][0])
        # Overlaps count by the sine of the planes' angle, and are known to ON over it: planes nearly one tell little.
        good = through[0] & through[1] & (overlap > ON) & (np.linalg.norm(line, axis=1) > ALIKE)
        both = np.flatnonzero(good & (edged[0] >= 0) & (edged[1] >= 0))
        good[both] = self._interleaved(pairs[both], heights, edged, line[both], both)
        return np.asarray(pairs[good])

    def _heights(self, plane: Array, points: Array) -> Array:
        """Heights (m, n) of points (m, n, 3) over the planes of faces `plane` (m,), 0 where they lie on it."""
        over = np.einsum("mnk,mk->mn", points - self.triangles[plane][:, :1], self.normals[plane])
        return np.asarray(np.where(np.abs(over) <= ON, 0.0, over))

    def _opposite(self, face: Array, height: Array) -> Array:
        """(m,) for a face with exactly one edge on the plane: the vertex beyond that edge; −1 elsewhere."""
        on = height == 0
        edge = on & on[:, NEXT]
        return np.asarray(np.where(edge.sum(1) == 1, self.across[face, edge.argmax(1)], -1))

    def _interleaved(self, pairs: Array, heights: list[Array], edged: list[Array], line: Array, rows: Array) -> Array:
        """Whether two surfaces that meet along an edge of both pass through each other there, or only touch."""
        line = line / np.linalg.norm(line, axis=1, keepdims=True)
        across = np.cross(line, self.normals[pairs[:, 0]])
        angles = []
        for side in (0, 1):
            face, height = pairs[:, side], heights[side][rows]
            third = np.abs(height).argmax(1)
            foot = self.triangles[face, NEXT[third]]
            for tip in (self.triangles[face, third], self.vertices[edged[side][rows]]):
                away = tip - foot
                x, y = ((away * axis).sum(1) for axis in (across, self.normals[pairs[:, 0]]))
                angles.append(np.arctan2(y, x))
        second, third, fourth = ((angle - angles[0]) % (2 * np.pi) for angle in angles[1:])
        return np.asarray((third < second) != (fourth < second))


def _across(faces: Array) -> Array:
    """(F, 3) of edge k → k + 1 of each face the vertex opposite to it in the one other face; −1 where not just one."""
    low, high = np.minimum(faces, faces[:, NEXT]).ravel(), np.maximum(faces, faces[:, NEXT]).ravel()
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    before, after = np.append(False, same), np.append(same, False)
    first = np.flatnonzero(after & ~before & ~np.append(after[1:], False))  # of edges with exactly two faces
    tips = faces[:, NEXT[NEXT]].ravel()
    across = np.full(faces.size, -1)
    across[order[first]], across[order[first + 1]] = tips[order[first + 1]], tips[order[first]]
    return across.reshape(-1, 3)


def _interval(triangles: Array, height: Array, line: Array) -> tuple[Array, Array]:
    """Where triangles (m, 3, 3) meet planes that they have `height` (m, 3) over: from, to along `line` (m, 3)."""
    at = np.einsum("mnk,mk->mn", triangles, line)
    after, beyond = height[:, NEXT], at[:, NEXT]
    cut = height * after < 0
    part = height / np.where(cut, height - after, 1.0)
    places = np.concatenate([np.where(height == 0, at, np.nan), np.where(cut, at + part * (beyond - at), np.nan)], 1)
    return np.fmin.reduce(places, axis=1), np.fmax.reduce(places, axis=1)


def _candidates(low: Array, high: Array) -> Iterator[Array]:
    """Pairs (m, 2) of boxes `low` to `high` (n, 3) that overlap, each once, a part at a time."""
    depth = max(len(low) - 1, 0).bit_length()
    order = np.argsort(_morton((low + high) / 2), kind="stable")
    lows = [np.full((1 << depth, 3), np.inf)]
    highs = [np.full((1 << depth, 3), -np.inf)]  # boxes that fill the tree up overlap nothing
    lows[0][: len(order)], highs[0][: len(order)] = low[order], high[order]
    for _ in range(depth):
        lows.insert(0, lows[0].reshape(-1, 2, 3).min(1))
        highs.insert(0, highs[0].reshape(-1, 2, 3).max(1))
    waiting = [(0, np.zeros((1, 2), np.int64))]
    while waiting:
        level, pairs = waiting.pop()
        if level == depth:
            yield order[pairs[pairs[:, 0] != pairs[:, 1]]]
            continue
        if len(pairs) > AT_ONCE:
            middle = len(pairs) // 2
            waiting += [(level, pairs[:middle]), (level, pairs[middle:])]
            continue
        left, right = pairs.T * 2
        same = left == right
        children = [np.stack([left + i, right + j], 1)[~same | (i <= j)] for i in (0, 1) for j in (0, 1)]
        below = np.concatenate(children)
        a, b = below.T
        level += 1
        meet = np.ones(len(below), bool)
        for k in range(3):
            meet &= (lows[level][a, k] <= highs[level][b, k]) & (lows[level][b, k] <= highs[level][a, k])
        waiting.append((level, below[meet]))


def _morton(points: Array) -> Array:
    """(n,) places of points (n, 3) along a curve that fills space: near ones come near each other."""
    if not len(points):
        return np.empty(0, np.int64)
    span = np.ptp(points, axis=0).max() or 1.0
    cells = np.minimum((points - points.min(0)) / span * 1024, 1023).astype(np.int64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | cells << shift) & mask
    return np.asarray(cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2)
