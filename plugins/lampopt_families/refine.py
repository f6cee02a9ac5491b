"""Triangles split until no edge is long, without gaps: a face bends at its corners only."""

from __future__ import annotations

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

MOST = 4_000_000  # faces


def refined(vertices: Array, faces: Array, longest: float) -> tuple[Array, Array]:
    """The same surface with edges no longer than `longest`: (V, 3) and (F, 3), the given vertices first.

    Every long edge is halved, in both of its faces, until none is left; a closed mesh stays closed.

    Raises
    ------
    InputError
        If that takes more than four million faces.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2) / longest
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    least = area / (np.sqrt(3) / 4)  # if all came out equilateral
    while least <= MOST and len(faces) <= MOST:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        unique, which = np.unique(edges, axis=0, return_inverse=True)
        long = np.linalg.norm(np.diff(vertices[unique], axis=1)[:, 0], axis=1) > longest
        if not long.any():
            return vertices, faces
        middles = np.full(len(unique), -1)
        middles[long] = len(vertices) + np.arange(np.count_nonzero(long))
        vertices = np.concatenate([vertices, vertices[unique[long]].mean(axis=1)])
        faces = _split(faces, middles[which.reshape(-1, 3)])
    raise InputError(f"edge: {longest:g} makes more than {MOST:,} faces of this mesh: expected a larger one")


def _split(faces: Array, middles: Array) -> Array:
    """Faces (F, 3) divided at the middles of their edges ab, bc, ca (F, 3), -1 where an edge stays whole."""
    count = (middles >= 0).sum(axis=1)
    # Turned so that a lone middle is on ab, a lone whole edge is ca.
    turn = np.where(
        count == 1, (middles >= 0).argmax(axis=1), np.where(count == 2, (middles < 0).argmax(axis=1) + 1, 0)
    )
    order = (turn[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middles, order, axis=1).T
    parts = [
        (count == 0, [(a, b, c)]),
        (count == 1, [(a, ab, c), (ab, b, c)]),
        (count == 2, [(ab, b, bc), (a, ab, bc), (a, bc, c)]),
        (count == 3, [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]),
    ]
    return np.concatenate([np.stack(face, axis=1)[chosen] for chosen, divided in parts for face in divided])
