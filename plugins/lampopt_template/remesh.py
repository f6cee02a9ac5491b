"""The same surface in even triangles of a chosen size, its sharp edges kept (Botsch and Kobbelt 2004).

Edges that are too long are split, those that are too short collapsed, those with opposite angles of more than 180
degrees together flipped; vertices slide towards the middle of their neighbours, on the surface that was given. Each
kind of change is made to many edges at once: to those that are the best among all that they could disturb.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lampopt.types import Array
from lampopt_template.surface import CREASE, Surface, unit

LONG, SHORT = 4 / 3, 4 / 5  # of the length wanted: where halves, or a collapsed edge's neighbours, come nearer to it
ROUNDS = 8
SPLITS = 60  # rounds of splits: each halves the longest
TURN = 0.5  # cosine up to which a face may turn when an edge of it is collapsed or flipped


def edge_of(area: float, faces: int) -> float:
    """The edge at which equilateral triangles cover `area` with `faces` of them."""
    return float(np.sqrt(4 * area / (np.sqrt(3) * faces)))


def remeshed(vertices: Array, faces: Array, edge: float) -> tuple[Array, Array]:
    """A closed surface, faces outward, in triangles whose edges are about `edge` long: (V, 3) and (F, 3).

    Its topology stays. Edges sharper than 40 degrees stay where they are.
    """
    given = Surface(vertices, faces)
    vertices, faces = given.vertices, given.faces
    for _ in range(ROUNDS):
        vertices, faces = _split(vertices, faces, LONG * edge)
        vertices, faces = _collapse(vertices, faces, edge)
        faces = _flip(vertices, faces)
        vertices = _relax(vertices, faces, given)
    return vertices, faces


@dataclass(frozen=True, eq=False)
class _Edges:
    """The E edges of a closed mesh: `ends` (E, 2) as the first of its `beside` (E, 2) faces runs along it, and the
    corners `across` (E, 2) from it in these."""

    vertices: Array
    faces: Array
    ends: Array
    beside: Array
    across: Array

    @classmethod
    def of(cls, vertices: Array, faces: Array) -> _Edges:
        start, end, third = faces.ravel(), np.roll(faces, -1, 1).ravel(), np.roll(faces, -2, 1).ravel()
        order = np.argsort(np.minimum(start, end) * len(vertices) + np.maximum(start, end), kind="stable").reshape(
            -1, 2
        )
        return cls(vertices, faces, np.stack([start[order[:, 0]], end[order[:, 0]]], 1), order // 3, third[order])

    @cached_property
    def length(self) -> Array:
        a, b = self.vertices[self.ends].transpose(1, 0, 2)
        return np.asarray(np.linalg.norm(b - a, axis=1))

    @cached_property
    def sharp(self) -> Array:
        """(E,) whether its faces meet at an edge that is to be kept."""
        normals = Surface(self.vertices, self.faces).normals[self.beside]
        return np.asarray((normals[:, 0] * normals[:, 1]).sum(1) < CREASE)

    @cached_property
    def fixed(self) -> Array:
        """(V,) 0 for a vertex that may go anywhere on the surface, 1 along a sharp edge, 2 nowhere."""
        count = np.bincount(self.ends[self.sharp].ravel(), minlength=len(self.vertices))
        return np.where(count == 0, 0, np.where(count == 2, 1, 2))

    def best(self, rank: Array) -> Array:
        """Which edges (E,) rank lowest in both of their faces; those of infinite rank do not."""
        rank = _distinct(rank)
        lowest = _least(rank, self.beside, len(self.faces))
        return np.asarray(np.isfinite(rank) & (lowest[self.beside] == rank[:, None]).all(1))


def _distinct(rank: Array) -> Array:
    """The place of each rank in their order, equal ones in no order at all; infinite ones stay infinite."""
    known = np.flatnonzero(np.isfinite(rank))
    place = np.full(len(rank), np.inf)
    mixed = np.random.default_rng(0).permutation(len(known))
    place[known[np.lexsort((mixed, rank[known]))]] = np.arange(len(known))
    return place


def _least(rank: Array, of: Array, count: int) -> Array:
    """(count,) the lowest of the ranks (E,) of the edges whose places (E, 2) `of` tells."""
    known = np.flatnonzero(np.isfinite(rank))
    falling = known[np.argsort(-rank[known], kind="stable")]
    least = np.full(count, np.inf)
    for places in of.T:  # of values written to one place the last stays: the lowest
        one = np.full(count, np.inf)
        one[places[falling]] = rank[falling]
        least = np.minimum(least, one)
    return least


def _coarse(length: Array) -> Array:
    """Lengths of about the same size made equal: then many of them can be the best of those around them."""
    return np.asarray(np.floor(2 * np.log2(np.maximum(length, 1e-300))))


def _split(vertices: Array, faces: Array, longest: float) -> tuple[Array, Array]:
    """No edge longer than `longest`, by new vertices in the middle."""
    for _ in range(SPLITS):
        edges = _Edges.of(vertices, faces)
        chosen = edges.best(np.where(edges.length > longest, -_coarse(edges.length), np.inf))
        if not chosen.any():
            break
        (a, b), (f, g), (c, d) = edges.ends[chosen].T, edges.beside[chosen].T, edges.across[chosen].T
        middle = len(vertices) + np.arange(len(a))
        vertices = np.concatenate([vertices, vertices[edges.ends[chosen]].mean(1)])
        faces = faces.copy()
        faces[f], faces[g] = np.stack([a, middle, c], 1), np.stack([b, middle, d], 1)
        faces = np.concatenate([faces, np.stack([middle, b, c], 1), np.stack([middle, a, d], 1)])
    return vertices, faces


def _collapse(vertices: Array, faces: Array, edge: float) -> tuple[Array, Array]:
    """Short edges shrunk to a point, as long as topology and shape allow it."""
    refused = np.empty((0, 2), np.int64)
    for _ in range(SPLITS):
        edges = _Edges.of(vertices, faces)
        short = (edges.length < SHORT * edge) & _may_collapse(edges) & ~_among(edges.ends, refused, len(vertices))
        chosen = _apart(edges, np.where(short, _coarse(edges.length), np.inf))
        if not chosen.any():
            break
        keep, gone = _kept(edges, chosen)
        at = np.where(
            (edges.fixed[keep] + edges.fixed[gone] == 0)[:, None], (vertices[keep] + vertices[gone]) / 2, vertices[keep]
        )
        good = _harmless(edges, keep, gone, at, LONG * edge)
        refused = np.concatenate([refused, np.stack([keep, gone], 1)[~good]])
        keep, gone, at = keep[good], gone[good], at[good]
        if not len(keep):
            continue
        vertices = vertices.copy()
        vertices[keep] = at
        new = np.arange(len(vertices))
        new[gone] = keep
        faces = new[faces]
        faces = faces[(faces != np.roll(faces, 1, 1)).all(1)]
        used = np.zeros(len(vertices), bool)
        used[faces] = True
        place = np.cumsum(used) - 1
        stays = used[refused].all(1)
        vertices, faces, refused = vertices[used], place[faces], place[refused[stays]]
    return vertices, faces


def _may_collapse(edges: _Edges) -> Array:
    """(E,) those whose ends have no neighbours in common but the two across, and of which one end may go."""
    a, b = edges.ends.T
    fixed = edges.fixed
    free = (np.minimum(fixed[a], fixed[b]) == 0) | (edges.sharp & (np.minimum(fixed[a], fixed[b]) == 1))
    links = _links(edges)
    common = np.asarray((links[a].multiply(links[b])).sum(1)).ravel()
    return np.asarray(free & (common == 2))


def _links(edges: _Edges) -> Any:
    from scipy.sparse import csr_array

    a, b = edges.ends.T
    ones = np.ones(2 * len(a), np.int32)
    return csr_array((ones, (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(len(edges.vertices),) * 2)


def _apart(edges: _Edges, rank: Array) -> Array:
    """(E,) edges of finite rank, each the lowest of all that have an end beside one of its own."""
    rank = _distinct(rank)
    least = _least(rank, edges.ends, len(edges.vertices))
    about = np.minimum(least, _least(least[edges.ends].min(1), edges.ends, len(least)))
    return np.asarray(np.isfinite(rank) & (about[edges.ends] == rank[:, None]).all(1))


def _kept(edges: _Edges, chosen: Array) -> tuple[Array, Array]:
    """Of the ends of chosen edges that which stays, being the more fixed one, and that which goes."""
    a, b = edges.ends[chosen].T
    swap = edges.fixed[b] > edges.fixed[a]
    return np.where(swap, b, a), np.where(swap, a, b)


def _harmless(edges: _Edges, keep: Array, gone: Array, at: Array, longest: float) -> Array:
    """Which collapses turn no face over and make no edge too long."""
    count = len(edges.vertices)
    whose = np.full(count, -1)
    whose[keep] = whose[gone] = np.arange(len(keep))
    moved = edges.vertices.copy()
    moved[keep] = moved[gone] = at
    owner = whose[edges.faces]
    touched = np.flatnonzero((owner >= 0).any(1))
    owners = owner[touched].max(1)  # all of a face's are of one edge, chosen ones being apart
    shrunk = (owner[touched] >= 0).sum(1) == 2
    before, after = Surface(edges.vertices, edges.faces[touched]), Surface(moved, edges.faces[touched])
    cosine = (unit(before.crosses) * unit(after.crosses)).sum(1)
    sides = moved[edges.faces[touched]]
    length = np.sqrt(((sides - np.roll(sides, 1, 1)) ** 2).sum(2)).max(1)
    tiny = before.areas < 1e-3 * longest**2  # whose normals say little
    bad = ~shrunk & (((cosine < TURN) & ~tiny) | (length > longest))
    return np.asarray(np.bincount(owners[bad], minlength=len(keep)) == 0)


def _flip(vertices: Array, faces: Array) -> Array:
    """Edges turned where the angles across from them are together more than 180 degrees."""
    for _ in range(SPLITS // 4):
        edges = _Edges.of(vertices, faces)
        over = _opposite(edges) - np.pi
        (a, b), (c, d) = edges.ends.T, edges.across.T
        now = unit(Surface(vertices, faces).crosses)[edges.beside].sum(1)
        one, other = (
            np.cross(vertices[y] - vertices[x], vertices[z] - vertices[x]) for x, y, z in ((c, a, d), (d, b, c))
        )
        right = [(unit(cross) * unit(now)).sum(1) > TURN for cross in (one, other)]
        valence = np.bincount(edges.ends.ravel(), minlength=len(vertices))
        able = ~edges.sharp & right[0] & right[1] & (valence[edges.ends] > 3).all(1)
        able &= ~_among(edges.across, edges.ends, len(vertices)) & (over > 1e-3)
        chosen = np.flatnonzero(edges.best(np.where(able, -np.floor(8 * over), np.inf)))
        _, first = np.unique(_pairs(edges.across[chosen], len(vertices)), return_index=True)
        chosen = chosen[first]
        if not len(chosen):
            break
        faces = faces.copy()
        faces[edges.beside[chosen, 0]] = np.stack([c, a, d], 1)[chosen]
        faces[edges.beside[chosen, 1]] = np.stack([d, b, c], 1)[chosen]
    return faces


def _opposite(edges: _Edges) -> Array:
    """(E,) the sum of the two angles across from each edge."""
    total = np.zeros(len(edges.ends))
    for k in range(2):
        one, other = (edges.vertices[edges.ends[:, j]] - edges.vertices[edges.across[:, k]] for j in range(2))
        total += np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(1))
    return total


def _relax(vertices: Array, faces: Array, given: Surface) -> Array:
    """Vertices that lie on no sharp edge, moved to the middle of their neighbours and back onto the given surface."""
    edges = _Edges.of(vertices, faces)
    links = _links(edges)
    middle = (links @ vertices) / np.asarray(links.sum(1)).reshape(-1, 1)
    normals = Surface(vertices, faces).vertex_normals
    step = middle - vertices
    step -= (step * normals).sum(1, keepdims=True) * normals
    free = edges.fixed == 0
    moved = vertices.copy()
    moved[free] = given.near(vertices[free] + step[free], curved=True).points
    return moved


def _pairs(ends: Array, count: int) -> Array:
    """One number for each pair of vertices (E, 2), either way round."""
    return np.asarray(ends.min(1) * count + ends.max(1))


def _among(ends: Array, others: Array, count: int) -> Array:
    return np.isin(_pairs(ends, count), _pairs(others, count)) if len(others) else np.zeros(len(ends), bool)
