"""A shape as marching cubes give it back: signed distances on a grid along its bounding box, cut at zero."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes
from trimesh import Trimesh

from lampopt import Frame
from lampopt.decode import field_to_mesh

MARGIN = 2.37  # cells around the shape: no plane of it may meet a plane of nodes, where nothing is cut
BAND = 2.5  # cells from a node beside the surface to both ends of any edge that the surface cuts near it


def recut(mesh: Trimesh, cells: int = 128) -> Trimesh:
    """A closed `mesh` from `cells` cells along each side of its bounding box, margin included; closed, faces outward.

    Distances are exact near the surface. Farther nodes get what cannot be cut: inside or outside, told from one node of
    each connected part.
    """
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    low, high = vertices.min(0), vertices.max(0)
    pitch = (high - low) / (cells - 2 * MARGIN)
    origin = low - MARGIN * pitch
    shape = (cells + 1,) * 3
    near = _near(mesh, origin, pitch, shape)
    values = np.empty(shape)
    values[near] = _distances(origin + np.argwhere(near) * pitch, vertices, faces)
    parts, count = ndimage.label(~near)
    first = np.array([np.unravel_index(i, shape) for i in _firsts(parts, count)])
    signs = np.sign(_distances(origin + first * pitch, vertices, faces))
    values[~near] = (10 * pitch.max() * signs)[parts[~near] - 1]
    points, triangles, _, _ = marching_cubes(values, 0.0, spacing=tuple(pitch))
    return Trimesh(points + origin, triangles, process=False)


def recut_in_box(mesh: Trimesh, frame: Frame, resolution: int) -> Trimesh:
    """A closed `mesh` as a perfect decoder of distances gives it: on `resolution` cells along a bank's box."""
    boxed = frame.to_box(mesh)
    vertices, faces = np.asarray(boxed.vertices, float), np.asarray(boxed.faces, np.int64)
    box = np.array([[-1.0] * 3, [1.0] * 3])
    return frame.to_user(field_to_mesh(lambda points: _distances(points, vertices, faces), box, resolution))


def _near(
    mesh: Trimesh, origin: NDArray[np.float64], pitch: NDArray[np.float64], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Which nodes lie within about BAND cells of the surface: those around points spread densely over it."""
    near = np.zeros(shape, bool)
    pieces = ((np.asarray(mesh.vertices) - origin) / pitch)[mesh.faces]
    while len(pieces):  # halve what is longer than a cell, mark the corners of the rest
        lengths = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2)
        long = lengths.max(1) > 1
        near[tuple(np.rint(pieces[~long].reshape(-1, 3)).astype(int).T)] = True
        rows, first = np.arange(long.sum())[:, None], lengths[long].argmax(1)[:, None]
        a, b, c = (pieces[long][rows, (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        pieces = np.concatenate([np.concatenate([a, middle, c], 1), np.concatenate([middle, b, c], 1)])
    reach = int(np.ceil(BAND))
    ball = np.linalg.norm(np.mgrid[(slice(-reach, reach + 1),) * 3], axis=0) <= BAND
    grown: NDArray[np.bool_] = ndimage.binary_dilation(near, ball)
    return grown


def _distances(
    points: NDArray[np.float64], vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> NDArray[np.float64]:
    kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL  # exact on closed meshes that do not cut themselves, as these are
    distances: NDArray[np.float64] = igl.signed_distance(points, vertices, faces, kind)[0]
    return distances


def _firsts(parts: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """The flat index of one node of each part 1 … count."""
    found, where = np.unique(parts.ravel(), return_index=True)
    return np.asarray(where[np.searchsorted(found, np.arange(1, count + 1))])
