"""The plain alternative: the same alpha applied to the exemplars' true signed distances at the nodes of a grid."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from trimesh import Trimesh

import lampopt
from lampopt.types import Array

from .common import key

CHUNK = 1 << 18
SNAP = 1e-3  # as lampopt.decode: values nearer to zero than this part of a cell make no sliver triangles


def signed_distance(points: Array, mesh: Trimesh) -> Array:
    """Distances (M,), negative inside.

    libigl's own value is off by up to a percent: it is the distance times 1 − 2 · (fast, approximate) winding number.
    So its sign is taken, and the distance from the closest point that it found.
    """
    import igl

    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    scaled, _, closest, _ = igl.signed_distance(points, vertices, faces, kind)
    return np.copysign(np.linalg.norm(points - closest, axis=1), scaled)


@dataclass(frozen=True, eq=False)
class Grid:
    """`count` (3,) nodes, `pitch` apart, from `origin` (3,) on."""

    origin: Array
    pitch: float
    count: Array

    @classmethod
    def around(cls, boxes: Iterable[Array], pitch: float, margin: float, anchor: Array | None = None) -> Grid:
        """The grid that holds all `boxes` (2, 3) and `margin` around; nodes fall on `anchor` where it is given."""
        found = np.array(list(boxes))
        low, high = found[:, 0].min(0) - margin, found[:, 1].max(0) + margin
        if anchor is not None:
            low = anchor + np.floor((low - anchor) / pitch) * pitch
        return cls(low, pitch, np.ceil((high - low) / pitch).astype(int) + 1)

    def nodes(self, start: int, stop: int) -> Array:
        """Nodes `start` to `stop` (in C order) as points."""
        at = np.unravel_index(np.arange(start, min(stop, self.size)), tuple(self.count))
        return self.origin + self.pitch * np.stack(at, -1)

    @property
    def size(self) -> int:
        return int(np.prod(self.count))

    def mesh(self, values: Array) -> Trimesh | None:
        """The surface where `values` (size,) are zero, closed at the grid's rim; None if there is none.

        Marching cubes (scikit-image, Lewiner) on the node values themselves: trilinear interpolation evaluated at the
        nodes of its own grid is just that.
        """
        from skimage.measure import marching_cubes

        near = np.abs(values) < SNAP * self.pitch
        values = np.where(near, np.where(values < 0, -1, 1) * SNAP * self.pitch, values)
        field = np.pad(values.reshape(self.count), 1, constant_values=self.pitch)
        if field.min() > 0:
            return None
        vertices, faces, _, _ = marching_cubes(field, 0.0, allow_degenerate=False)
        return Trimesh(self.origin + self.pitch * (vertices - 1), faces, process=False)


@dataclass(frozen=True, eq=False)
class GridMix:
    """The exemplars' distances (N, size) float32 on one grid, mapped from a file."""

    grid: Grid
    distances: Array
    name: str

    @classmethod
    def of(
        cls, exemplars: lampopt.Exemplars, grid: Grid, folder: Path, name: str, tell: Callable[..., None]
    ) -> GridMix:
        """Read from `folder`, or computed into it exemplar by exemplar; an interrupted run goes on."""
        from lampopt.lamp import digest

        shapes = [digest(np.asarray(mesh.vertices)) + digest(np.asarray(mesh.faces)) for mesh in exemplars.meshes]
        how = inspect.getsource(signed_distance)
        name = f"{name}-{key([how, shapes, grid.origin.tolist(), grid.pitch, grid.count.tolist()])}"
        path, partial = folder / f"{name}.npy", folder / f"{name}.partial.npy"
        if not path.exists():
            shape = (len(exemplars), grid.size)
            if partial.exists():
                rows = np.lib.format.open_memmap(partial, "r+")
            else:
                rows = np.lib.format.open_memmap(partial, "w+", np.float32, shape)
                rows[:, -1] = np.nan
            for i, mesh in enumerate(exemplars.meshes):
                if not np.isnan(rows[i, -1]):
                    continue
                for start in range(0, grid.size, CHUNK):
                    found = signed_distance(grid.nodes(start, start + CHUNK), mesh)
                    rows[i, start : start + CHUNK] = found
                    tell((i + start / grid.size) / len(exemplars), f"exemplar {i + 1} of {len(exemplars)}")
                rows.flush()
            del rows
            partial.replace(path)
        return cls(grid, np.load(path, mmap_mode="r"), name)

    def mesh(self, alpha: Array) -> Trimesh | None:
        """The surface of the mix."""
        return self.grid.mesh(np.asarray(alpha, np.float32) @ self.distances)
