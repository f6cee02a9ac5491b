"""The surface where a field is zero, as a mesh of even triangles that is its own mirror image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

CLEAR = 0.05  # of a cell: no grid point counts as nearer to the surface, which would make triangles without area
ROUNDS = 3  # of evening out
STEPS = 3  # of Newton's method onto the surface, from at most a cell away


def contour(values: Array, axes: Sequence[Array], field: Callable[[Array], tuple[Array, Array]]) -> Trimesh:
    """A watertight mesh of the surface ``field == 0``, faces outward, vertices on it.

    Marching cubes gives the triangles; their corners are then drawn to the middle of their neighbours and back onto the
    surface by Newton's method, a few times over.

    Parameters
    ----------
    values
        (I, J, K) of the field on a grid, negative inside.
    axes
        (I,), (J,), (K,) the grid's coordinates, which rise; the second begins with the middle plane, 0.
    field
        Points (M, 3) → values (M,) and gradients (M, 3); symmetric about the plane y = 0.
    """
    from scipy.sparse import coo_array
    from skimage.measure import marching_cubes
    from trimesh import Trimesh

    clear = CLEAR * min(float(np.diff(axis).min()) for axis in axes)
    values = np.where(np.abs(values) < clear, np.where(values < 0, -clear, clear), values)
    points, faces, _, _ = marching_cubes(values, 0)
    middle = points[:, 1] == 0
    points = np.stack([np.interp(points[:, k], np.arange(len(axis)), axis) for k, axis in enumerate(axes)], axis=1)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    near = coo_array((np.ones(len(ends)), tuple(ends.T)), (len(points), len(points))).tocsr()
    near.data[:] = 1
    count = near.sum(axis=1)[:, None]
    for _ in range(ROUNDS):
        points = (near @ points / count + points) / 2
        for _ in range(STEPS):
            value, gradient = field(points)
            points = points - value[:, None] * gradient / (gradient**2).sum(axis=1, keepdims=True)
            points[middle, 1] = 0
    mirrored = np.arange(len(points))
    mirrored[~middle] = len(points) + np.arange(np.count_nonzero(~middle))
    vertices = np.concatenate([points, points[~middle] * (1, -1, 1)])
    return Trimesh(vertices, np.concatenate([faces, mirrored[faces][:, ::-1]]), process=False)
