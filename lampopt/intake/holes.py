"""Small holes closed: flat, of few edges, tiny beside the mesh. Anything larger may be meant and stays open."""

from __future__ import annotations

import numpy as np

from lampopt.intake.edges import Edges
from lampopt.types import Array

MOST = 24  # edges of a hole that is closed
WIDE = 0.03  # of the mesh's diagonal: the widest hole that is closed
LEAST = 3.0  # times as large as the hole must be what it is in: the rim of a small loose patch is no hole
BENT = 0.2  # of its width: how far a hole that is closed may be from flat


def fill(vertices: Array, faces: Array, wide: float = WIDE, most: int = MOST) -> tuple[Array, list[str]]:
    """`faces` and new ones that close the small holes, by least area, and what was done, in words.

    Small is what has at most `most` edges and is no wider than `wide` of the mesh's diagonal.
    """
    edges = Edges.of(faces)
    if not len(edges.lone):
        return faces, []
    size = float(np.linalg.norm(np.ptp(vertices[faces], axis=(0, 1))))
    _, part = edges.parts()
    small = [
        hole
        for hole in loops(edges, most)
        if _small(vertices, faces[part == part[hole[0] // 3]], edges.start[hole], wide * size)
    ]
    known = _pairs(faces) if small else set()
    added: list[Array] = []
    for hole in small:
        rim = edges.start[hole][::-1]
        patch = rim[_least_area(vertices[rim])]
        inner = _pairs(patch) - _pairs(rim[None])
        if inner & known:  # a third face would hang on an edge
            continue
        known |= inner
        added.append(patch)
    if not added:
        return faces, []
    rims = max(len(patch) + 2 for patch in added)
    words = "closed a small hole" if len(added) == 1 else f"closed {len(added)} small holes"
    return np.concatenate([faces, *added]), [f"{words} of {'' if len(added) == 1 else 'up to '}{rims} edges"]


def loops(edges: Edges, most: int = MOST) -> list[Array]:
    """Half-edges around each hole with at most `most` edges, in order; holes that meet in a vertex are left out."""
    after: dict[int, int] = {}
    shared: set[int] = set()
    for half, start in zip(edges.lone.tolist(), edges.start[edges.lone].tolist(), strict=True):
        if start in after:
            shared.add(start)
        after[start] = half
    found, seen = [], set[int]()
    for begin in sorted(after):
        if begin in seen:
            continue
        loop, at = list[int](), begin
        while at in after and at not in seen:
            seen.add(at)
            loop.append(after[at])
            at = int(edges.end[after[at]])
        whole = at == begin and 3 <= len(loop) <= most
        if whole and not shared & {int(edges.start[half]) for half in loop}:
            found.append(np.array(loop))
    return found


def _small(vertices: Array, around: Array, rim: Array, widest: float) -> bool:
    """Whether a hole with vertices `rim` in the faces `around` is flat, tiny, and not the rim of a loose patch."""
    points = vertices[rim]
    width = float(np.linalg.norm(points[:, None] - points, axis=2).max())
    if width > widest or _bend(points) > BENT * width:
        return False
    return float(np.linalg.norm(np.ptp(vertices[around], axis=(0, 1)))) >= LEAST * width


def _pairs(polygons: Array) -> set[tuple[int, int]]:
    """The edges of polygons (n, k), as pairs of vertices in ascending order."""
    ends = np.sort(np.stack([polygons, np.roll(polygons, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    return set(map(tuple, ends.tolist()))


def _bend(points: Array) -> float:
    """How far points (n, 3) reach out of their plane."""
    away = points - points.mean(0)
    return float(np.ptp(away @ np.linalg.svd(away, full_matrices=False)[2][2]))


def _least_area(points: Array) -> Array:
    """Triangles (n − 2, 3) over a polygon (n, 3), of the least area in all (Barequet and Sharir 1995)."""
    n = len(points)
    cost, best = np.zeros((n, n)), np.zeros((n, n), np.int64)
    for width in range(2, n):
        for i in range(n - width):
            k = i + width
            between = np.arange(i + 1, k)
            areas = np.linalg.norm(np.cross(points[between] - points[i], points[k] - points[i]), axis=1)
            total = cost[i, between] + cost[between, k] + areas
            cost[i, k], best[i, k] = total.min(), between[total.argmin()]
    triangles, open_spans = [], [(0, n - 1)]
    while open_spans:
        i, k = open_spans.pop()
        if k - i < 2:
            continue
        j = int(best[i, k])
        triangles.append((i, j, k))
        open_spans += [(i, j), (j, k)]
    return np.array(triangles)
