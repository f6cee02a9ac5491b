"""A closed surface around polygons that do not hang together."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.intake.edges import Edges, arrays
from lampopt.meshfile import indexed
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

CELLS = 3.0  # along the gap, by default: fewer let the outside slip through what should be closed
MOST = 256  # cells along the longest side
CORNER = 0.4  # parts of the gap: a corner of three open sheets is filled that deep, and is no body
BLOCK = 1 << 18  # points asked for at once


def wrap(mesh: Trimesh, *, gap: float, resolution: int = 0) -> Trimesh:
    """A closed, outward surface of one body around `mesh`: what can be reached from outside through openings.

    The faces are grown by half the `gap`, what the outside cannot reach any more is filled, and the result is shrunk by
    half the gap again: a morphological closing, on exact distances to the faces. Faces may be open, crossing, turned
    anyhow. Openings narrower than `gap` are closed, and so are grooves; edges that point inward are rounded by half of
    it. A sheet without thickness that stands free is lost, and so is whatever is not connected to the largest body.

    Parameters
    ----------
    mesh
        The polygons.
    gap
        The widest opening to close [mesh unit].
    resolution
        Cells along the longest side; 0 takes three along the gap, as few as do.

    Raises
    ------
    InputError
        If the mesh has no faces, an argument does not fit, or no body is left: the outside comes in through openings
        wider than the gap, or nothing is thicker than it.
    """
    from scipy.ndimage import binary_propagation
    from trimesh import Trimesh

    whole = isinstance(mesh, Trimesh) and indexed(mesh)
    if not whole or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise InputError("wrap: expected a mesh with faces and finite vertices")
    vertices, faces = arrays(mesh)  # about the middle, 1 long
    low, high = vertices[faces].min((0, 1)), vertices[faces].max((0, 1))
    used = np.asarray(mesh.vertices, float)[faces]
    longest, middle = float(np.ptp(used, axis=(0, 1)).max()), (used.min((0, 1)) + used.max((0, 1))) / 2
    pitch = 1 / _cells(longest, gap, resolution)
    width = gap / longest
    grown = width / 2
    origin = low - (grown + 3 * pitch)
    count = np.ceil((high + grown + 3 * pitch - origin) / pitch).astype(int) + 1
    grid = _Grid(origin, pitch, tuple(count.tolist()))
    away = grid.distances(np.ones(count, bool), vertices, faces)
    rim = np.zeros(count, bool)
    rim[[0, -1]] = rim[:, [0, -1]] = rim[:, :, [0, -1]] = True
    outside = binary_propagation(rim, mask=away > grown)
    # Where the grown surface was: the level set of the distance, without what lies within.
    shell = _surface(np.where(outside, away, np.minimum(away, grown - 1e-3 * pitch)), grown, origin, pitch)
    # Shrunk by as much as it was grown; only nodes near to where the surface must be are asked.
    wanted = ~outside & (away <= grown + 2 * pitch)
    depth = np.where(wanted, grid.distances(wanted, *shell), np.where(outside, 0.0, width + 4 * pitch))
    if depth[wanted].max(initial=0) < grown + CORNER * width and not (~outside & ~wanted).any():
        raise InputError(
            f"wrap: expected a body thicker than the gap of {gap:g}, got none: the outside comes in through wider "
            "openings, which a larger gap closes, or the shape is that thin, and a smaller one follows it"
        )
    points, around = _largest(*_surface(-depth, -grown, origin, pitch))
    return Trimesh(middle + longest * points, around, process=False)


def _cells(longest: float, gap: float, resolution: int) -> float:
    real = isinstance(gap, (int, float, np.number)) and not isinstance(gap, bool)
    if not (real and np.isfinite(gap) and 0 < gap < longest):
        raise InputError(f"gap: expected a length above 0 and below the mesh's {longest:.4g}, got {gap!r}")
    whole = isinstance(resolution, (int, np.integer)) and not isinstance(resolution, bool)
    least = ceil(2 * longest / gap)
    if not whole or (resolution != 0 and not least <= resolution <= MOST):
        raise InputError(
            f"resolution: expected {least} (two cells along the gap) to {MOST} cells, or 0, got {resolution!r}"
        )
    if resolution == 0:
        resolution = ceil(CELLS * longest / gap)
        if resolution > MOST:
            raise InputError(
                f"gap: expected at least {CELLS * longest / MOST:.4g}, {MOST} cells along the mesh's {longest:.4g}, "
                f"got {gap!r}"
            )
    return float(resolution)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Nodes at `origin` + `pitch` · (i, j, k)."""

    origin: Array
    pitch: float
    count: tuple[int, ...]

    def distances(self, wanted: Array, vertices: Array, faces: Array) -> Array:
        """Distances from the nodes that are `wanted` to a surface; 0 at the others. Part by part, to save memory."""
        import igl

        found = np.zeros(self.count)
        places = np.flatnonzero(wanted)
        for at in range(0, len(places), BLOCK):
            part = places[at : at + BLOCK]
            points = self.origin + self.pitch * np.stack(np.unravel_index(part, self.count), 1)
            found.reshape(-1)[part] = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
        return found


def _surface(field: Array, level: float, origin: Array, pitch: float) -> tuple[Array, Array]:
    """The level set of `field` on the grid: vertices and faces, those that the field falls towards within."""
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(field, level, allow_degenerate=False)
    return origin + pitch * np.asarray(vertices, float), np.ascontiguousarray(faces, np.int64)


def _largest(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """The body that encloses most."""
    count, part = Edges.of(faces).parts()
    a, b, c = (vertices[faces[:, k]] - vertices[0] for k in range(3))
    volumes = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, count)
    kept = faces[part == volumes.argmax()]
    used, renamed = np.unique(kept, return_inverse=True)
    return vertices[used], renamed.reshape(-1, 3)
