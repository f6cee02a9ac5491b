"""What holds a surface together: closedness, bodies, genus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True)
class Topology:
    """`closed`: every edge has two faces, in opposite directions. `genus` is summed over bodies; None if not closed."""

    closed: bool
    bodies: int
    genus: int | None


def topology(mesh: Trimesh) -> Topology:
    """The topology of `mesh` as its faces connect it (vertices are not merged)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = np.asarray(mesh.faces, np.int64)
    if len(faces) == 0:
        return Topology(False, 0, None)
    count = len(mesh.vertices)
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    keys = np.sort(directed[:, 0] * count + directed[:, 1])
    back = np.sort(directed[:, 1] * count + directed[:, 0])
    closed = bool((np.diff(keys) > 0).all() and (keys == back).all())
    used = np.unique(faces)
    graph = coo_array((np.ones(len(directed), bool), directed.T), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    bodies = len(np.unique(labels[used]))
    euler = len(used) - len(keys) // 2 + len(faces)
    return Topology(closed, bodies, bodies - euler // 2 if closed else None)
