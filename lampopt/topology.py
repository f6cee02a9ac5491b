"""What holds a surface together: closedness, bodies, genus, parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True)
class Topology:
    """`closed`: every edge has two faces, in opposite directions. `genus` is summed over bodies; None if not closed."""

    closed: bool
    bodies: int
    genus: int | None


def topology(mesh: Trimesh) -> Topology:
    """The topology of `mesh` as its faces connect it (vertices are not merged).

    A body is what faces hold together by their edges: two boxes that touch in a vertex are two, and a cavity is one
    too. The genus follows from the Euler characteristic, ``V - E + F = 2 (bodies - genus)``, where a vertex at which
    several sheets of surface touch counts once a sheet.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    faces = np.asarray(mesh.faces, np.int64)
    count = len(faces)
    if count == 0:
        return Topology(False, 0, None)
    # Half-edge 3 f + k runs from corner k of face f to the next one; sorting brings those of one edge together.
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    order = np.argsort(keys)
    keys = keys[order]
    same = keys[1:] == keys[:-1]
    across = np.arange(len(keys))  # from each half-edge to the next of its edge, from the last to itself
    across[order[:-1][same]] = order[1:][same]
    first = np.arange(0, len(keys) + 1, 3)
    links = csr_array((np.ones(len(keys), bool), across // 3, first), (count, count))
    bodies = int(connected_components(links, directed=True, connection="weak", return_labels=False))
    closed = bool(len(keys) % 2 == 0 and same[::2].all() and not same[1::2].any())
    closed = closed and bool((start[order[::2]] == end[order[1::2]]).all() and (start != end).all())
    if not closed:
        return Topology(False, bodies, None)
    euler = _sheets(order) - count // 2  # F faces have E = 3F/2 edges
    return Topology(True, bodies, bodies - euler // 2)  # even: each body is closed and oriented


def parts(faces: Array) -> Array:
    """(F,) numbers of the parts that faces (F, 3) hold together by the vertices that they share."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = int(faces.max(initial=-1)) + 1
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(ends), bool), tuple(ends.T)), (count, count))
    _, label = connected_components(links, directed=False)
    return np.asarray(np.unique(label[faces[:, 0]], return_inverse=True)[1])


def _sheets(order: Array) -> int:
    """How many fans of faces there are about vertices, given a closed mesh's half-edges (3F,), paired edge by edge.

    Over an edge and on to the next corner is a step about a vertex; such steps go round, once about each sheet.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    count = len(order)
    one, other = order[::2], order[1::2]
    step = np.empty(count, np.int64)
    step[one], step[other] = other - other % 3 + (other + 1) % 3, one - one % 3 + (one + 1) % 3
    rounds = csr_array((np.ones(count, bool), step, np.arange(count + 1)), (count, count))
    return int(connected_components(rounds, directed=True, connection="strong", return_labels=False))
