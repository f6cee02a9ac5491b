"""Weights → mesh; and the helper that every implicit decoder shares.

`field_to_mesh` evaluates a field only where its surface can be: an octree keeps a cell while |f| at its centre is
within reach of the cell's corners at the field's steepest slope, then marching cubes runs on the cells that are left
(libigl's `lipschitz_octree` and sparse `marching_cubes`). `field_to_mesh_dense` is the reference that it is tested
against.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import EmptyMesh, InputError, PluginError
from lampopt.meshfile import indexed
from lampopt.protocols import Decoder
from lampopt.types import Array, Bank

if TYPE_CHECKING:
    from trimesh import Trimesh

Field = Callable[[Array], Array]
log = logging.getLogger("lampopt")

COARSE = 32  # cells along the box of the lattice that estimates slopes and verifies that no part is lost
SLOPE_MARGIN = 1.25  # over the steepest slope seen
YXZ = [1, 0, 2]  # the order of libigl's cell subscripts
SNAP = 1e-3  # values nearer to zero than this part of a cell are moved off it: no sliver triangles
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)


def decode(bank: Bank, decoder: Decoder, weights: Array, *, resolution: int = 128) -> Trimesh:
    """The mesh of `weights` (D,) in the bank's unit and frame (paper, section 3: Decode).

    Raises
    ------
    EmptyMesh
        If the field has no surface.
    InputError
        If `weights` does not fit the bank.
    PluginError
        If the decoder returns something else than a mesh.
    """
    from trimesh import Trimesh

    if weights.shape != bank.weights.shape[1:]:
        raise InputError(f"weights: expected shape {bank.weights.shape[1:]}, got {weights.shape}")
    mesh: object = decoder.decode(bank.shared, weights, resolution=resolution)
    who = f"decoder {bank.decoder.name!r}: decode"
    if not isinstance(mesh, Trimesh):
        raise PluginError(f"{who}: expected a trimesh.Trimesh, got {mesh!r:.80}")
    if not indexed(mesh):
        raise PluginError(
            f"{who}: expected faces whose corners are 0 to {len(mesh.vertices) - 1}, got {mesh.faces.min()} to "
            f"{mesh.faces.max()}"
        )
    return bank.frame.to_user(mesh)


def field_to_mesh(field: Field, bounds: Array, resolution: int) -> Trimesh:
    """The closed zero level set of `field` inside `bounds`, faces outward.

    Parameters
    ----------
    field
        Points (M, 3) → values (M,), negative inside; distances, or something with bounded slope. A body that is
        smaller than a 32nd of the box and in which alone the field is several times steeper may be passed over.
    bounds
        (2, 3) low and high corner of the box. A surface that reaches it is closed there.
    resolution
        Cells along the box's longest side.

    Raises
    ------
    EmptyMesh
        If the field does not change sign in the box, or is not finite there.
    InputError
        If an argument does not fit.
    """
    import igl
    from trimesh import Trimesh

    bounds, pitch = _lattice(bounds, resolution)
    steady = _steady(field, bounds)
    origin, depth = bounds[0], int(np.ceil(np.log2(resolution)))
    root = pitch * 2**depth
    slope, crossed, shift = _survey(steady, bounds, pitch, depth)
    clipped = _clip(steady, bounds, pitch, max(slope / SLOPE_MARGIN, 1.0))
    while True:
        cells = igl.lipschitz_octree(origin, root, depth, lambda p, slope=slope: np.abs(clipped(p)) / slope)
        if cells.size:  # without cells libigl forgets the columns too
            cells = cells[:, YXZ]
            active = np.unique(_key(cells >> shift, 1 << depth))
            if np.isin(crossed, active, assume_unique=True).all():
                break
        if not len(crossed):
            raise EmptyMesh(f"the field does not change sign in {bounds.tolist()}: there is no surface to extract")
        slope *= 2
        log.info("the field is steeper than was seen at first: slope bound raised to %.3g", slope)
    cells, corners, values, points = _complete(clipped, cells, origin, root, depth)
    vertices, faces, _ = igl.marching_cubes(_snap(values, pitch), points, corners, 0.0)
    if len(faces) == 0:
        raise EmptyMesh(f"the field does not change sign in {bounds.tolist()}: there is no surface to extract")
    return Trimesh(vertices, faces, process=False)


def field_to_mesh_dense(field: Field, bounds: Array, resolution: int) -> Trimesh:
    """As `field_to_mesh`, by evaluating every node of the grid (scikit-image's Lewiner marching cubes)."""
    from skimage.measure import marching_cubes
    from trimesh import Trimesh

    bounds, pitch = _lattice(bounds, resolution)
    count = np.ceil((bounds[1] - bounds[0]) / pitch - 1e-9).astype(int) + 1
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1).reshape(-1, 3)
    steady = _steady(field, bounds)
    values = np.concatenate([steady(bounds[0] + pitch * part) for part in _chunks(nodes)])
    steep = max(_steepest(values.reshape(count), pitch), 1.0)
    values = _snap(np.maximum(values, steep * _walls(bounds[0] + pitch * nodes, bounds, pitch)), pitch)
    if values.min() > 0 or values.max() < 0:
        raise EmptyMesh(f"the field does not change sign in {bounds.tolist()}: there is no surface to extract")
    vertices, faces, _, _ = marching_cubes(values.reshape(count), 0.0, allow_degenerate=False)
    return Trimesh(bounds[0] + pitch * vertices, faces, process=False)


def _chunks(points: Array, size: int = 1 << 18) -> list[Array]:
    return [points[i : i + size] for i in range(0, len(points), size)]


def _lattice(bounds: Array, resolution: int) -> tuple[Array, float]:
    bounds = np.asarray(bounds, float)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise InputError(f"bounds: expected (2, 3), finite, low below high, got {bounds.tolist()}")
    if not 4 <= resolution <= 4096:
        raise InputError(f"resolution: expected 4 to 4096 cells along the box, got {resolution}")
    return bounds, float((bounds[1] - bounds[0]).max()) / resolution


def _steady(field: Field, bounds: Array) -> Field:
    """`field`, checked; beyond the box it goes on as it is at the box and is never asked about points outside."""

    def steady(points: Array) -> Array:
        values = np.asarray(field(np.clip(points, *bounds)), float).reshape(-1)
        if len(values) != len(points):
            raise InputError(f"field: expected one value for each of {len(points)} points, got {len(values)}")
        if not np.isfinite(values).all():
            raise EmptyMesh("the field is not finite: the mix lies too far out, there is no surface to extract")
        return values

    return steady


def _walls(points: Array, bounds: Array, pitch: float) -> Array:
    """Signed distances (M,) to the box less half a cell."""
    centre, half = bounds.mean(0), (bounds[1] - bounds[0]) / 2 - pitch / 2
    return np.asarray((np.abs(points - centre) - half).max(1))


def _clip(field: Field, bounds: Array, pitch: float, slope: float) -> Field:
    """`field` within the box less half a cell, so that whatever reaches the box is closed there.

    The walls are as steep as the field: gentler ones would bend it deep inside, and move its surface.
    """
    return lambda points: np.maximum(field(points), slope * _walls(points, bounds, pitch))


def _survey(field: Field, bounds: Array, pitch: float, depth: int) -> tuple[float, Array, int]:
    """A coarse look: the steepest slope, the coarse cells that a sign change crosses, their size in cells [log2]."""
    shift = max(depth - int(np.log2(COARSE)), 0)
    step = pitch * (1 << shift)
    count = np.ceil((bounds[1] - bounds[0]) / step - 1e-9).astype(int) + 1
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1)
    points = bounds[0] + step * nodes.reshape(-1, 3)
    values = field(points)
    slopes = [_steepest(values.reshape(count), step)]
    near = points[np.argsort(np.abs(values), kind="stable")[:2048]]
    at_near = field(near)
    ahead = np.stack([field(near + pitch * np.eye(3)[k]) for k in range(3)], 1)
    slopes.append(np.linalg.norm((ahead - at_near[:, None]) / pitch, axis=1).max())
    inside = (np.maximum(values, _walls(points, bounds, pitch)) < 0).reshape(count)
    blocks = [inside[tuple(slice(c, n - 1 + c) for c, n in zip(corner, count, strict=True))] for corner in CORNERS]
    mixed = np.any(blocks, axis=0) & ~np.all(blocks, axis=0)
    return max(SLOPE_MARGIN * float(max(slopes)), 1.0), np.sort(_key(np.argwhere(mixed), 1 << depth)), shift


def _steepest(grid: Array, step: float) -> float:
    """The largest slope between neighbouring nodes of `grid`."""
    return float(max(np.abs(np.diff(grid, axis=k)).max() / step for k in range(3) if grid.shape[k] > 1))


def _key(cells: Array, size: int) -> Array:
    """One integer for each cell (n, 3) of a grid at most `size` + 1 wide."""
    wide = size + 2
    cells = cells.astype(np.int64) + 1
    return np.asarray((cells[:, 0] * wide + cells[:, 1]) * wide + cells[:, 2])


def _complete(field: Field, cells: Array, origin: Array, root: float, depth: int) -> tuple[Array, Array, Array, Array]:
    """Add the neighbours that the surface runs on into, until it is closed.

    Returns cells (n, 3), their corners (n, 8) as indices, and the corners' values (m,) and points (m, 3).
    """
    import igl

    known_keys, known_values = np.empty(0, np.int64), np.empty(0)
    size = 1 << depth
    while True:
        nodes, corners, points = igl.unique_sparse_voxel_corners(origin, root, depth, cells[:, YXZ])
        keys = _key(nodes[:, YXZ], size)
        values = np.empty(len(keys))
        found = np.isin(keys, known_keys)
        if found.any():
            values[found] = known_values[np.searchsorted(known_keys, keys[found])]
        values[~found] = np.concatenate([field(part) for part in _chunks(points[~found])] or [np.empty(0)])
        order = np.argsort(keys)
        known_keys, known_values = keys[order], values[order]
        inside = known_values < 0
        present = np.sort(_key(cells, size))
        fresh: list[Array] = []
        for face in FACES:
            neighbours = cells + face
            within = ((neighbours >= 0) & (neighbours < size)).all(1)
            missing = within.copy()
            missing[within] = ~np.isin(_key(neighbours[within], size), present)
            side = CORNERS[CORNERS[:, np.abs(face).argmax()] == int(face.sum() > 0)]
            at = np.stack([_key(cells[missing] + corner, size) for corner in side], 1)
            signs = inside[np.searchsorted(known_keys, at)]
            fresh.append(neighbours[missing][signs.any(1) & ~signs.all(1)])
        added = np.unique(np.concatenate(fresh), axis=0)
        if not len(added):
            return cells, corners, values, points
        cells = np.concatenate([cells, added])


def _snap(values: Array, pitch: float) -> Array:
    near = np.abs(values) < SNAP * pitch
    return np.where(near, np.where(values < 0, -SNAP * pitch, SNAP * pitch), values)
