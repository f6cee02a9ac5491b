"""Polygons that are not convex: a fan of triangles leaves them and comes back, so that area is there twice."""

from __future__ import annotations

import re

import numpy as np

from lampopt.types import Array

CORNERS = re.compile(rb"^[ \t]*f(?:[ \t]+[^ \t\r\n\\]+){4}", re.MULTILINE)  # of an OBJ file's face: four or more
BACK = -1 + 1e-9  # cosine of the normals of two faces of which one lies on the other


def may_have(data: bytes, suffix: str) -> bool:
    """Whether a file of these bytes may have other faces than triangles."""
    return CORNERS.search(data) is not None if suffix == ".obj" else suffix in (".ply", ".off", ".dae")


def folded_back(vertices: Array, faces: Array) -> int:
    """How many faces (F, 3) lie back on a neighbour of theirs: no surface of a body does."""
    corners = np.asarray(vertices, float)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(size > 0, size, 1.0)[:, None]
    ways = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.sort(ways, axis=1)
    order = np.lexsort(edges.T)
    same = (np.diff(edges[order], axis=0) == 0).all(axis=1)
    one, other = order[:-1][same], order[1:][same]
    against = ways[one, 0] != ways[other, 0]  # else one of them is turned over, and lies where it should
    one, other = one[against] // 3, other[against] // 3
    back = np.einsum("ij,ij->i", normals[one], normals[other]) < BACK
    return len(np.unique(np.concatenate([one[back], other[back]])))
