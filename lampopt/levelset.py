"""Fields → meshes: the zero level set of what tells signed distances, evaluated only where the surface can be.

An octree keeps a cell while |f| at its centre is within reach of the cell's corners at the field's steepest slope, then
marching cubes runs on the cells that the surface crosses (libigl's `lipschitz_octree` and sparse `marching_cubes`).
`NarrowBand` does it for one field after another: of one near the last only that is evaluated which the surface can have
come to. `field_to_mesh_dense` is the reference that both are tested against.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from dataclasses import field as attribute
from typing import TYPE_CHECKING

import numpy as np

from lampopt.lattice import Field, Lattice, Look, chunks, guarded, no_surface, steepest, walls
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

log = logging.getLogger("lampopt")

SLACK = 0.75  # cells on either side of those that an octree keeps, in a band that is laid for more than one field
YXZ = [1, 0, 2]  # the order of libigl's cell subscripts
SNAP = 1e-3  # values nearer to zero than this part of a cell are moved off it: no sliver triangles
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


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
    return NarrowBand(bounds, resolution).mesh(field)


@dataclass(eq=False)
class NarrowBand:
    """Meshes of one field after another, each as `field_to_mesh` makes it, sooner where it is near the one before.

    Parameters
    ----------
    bounds, resolution
        As of `field_to_mesh`.

    Raises
    ------
    InputError
        If one of them does not fit.

    Notes
    -----
    A band of cells is laid around a surface, with the values at their corners (Adalsteinsson and Sethian, 1995). How
    far another field differs is estimated on the coarse lattice, with a margin, as slopes are; where that is less than
    the band is wide, a node whose value was larger keeps its sign, and only the cells that are left are evaluated. What
    comes up between the corners and the centre of a coarse cell, a 32nd of the box wide, without either noticing, is
    passed over.
    """

    bounds: Array
    resolution: int
    _seen: _Seen | None = attribute(default=None, repr=False, init=False)

    def __post_init__(self) -> None:
        self._lattice = Lattice.of(self.bounds, self.resolution)

    def mesh(self, field: Field) -> Trimesh:
        """The closed zero level set of `field`. Raises as `field_to_mesh`."""
        lattice, seen = self._lattice, self._seen  # looked at once: threads may share a band
        look = Look.of(guarded(field, lattice.bounds), lattice)
        band = seen.band if seen else None
        cells = band.reached(look) if band else None
        if cells is not None:
            surface = _closed(look.clipped, cells, lattice)
        else:
            slack = SLACK * lattice.pitch
            if seen is None or seen.look.apart(look, slack * look.slope) is None:
                slack = 0.0  # the next is likely to be as far off
            cells, slope = _search(look, slack)
            surface, look = _closed(look.clipped, cells, lattice), replace(look, slope=slope)
            sure = len(surface.cells) == len(cells)  # the slope that was seen has left nothing out
            band = _Band.of(look, surface, slope * slack) if slack and sure else None
        self._seen = _Seen(look, band)
        return surface.mesh()


def field_to_mesh_dense(field: Field, bounds: Array, resolution: int) -> Trimesh:
    """As `field_to_mesh`, by evaluating every node of the grid (scikit-image's Lewiner marching cubes)."""
    from skimage.measure import marching_cubes
    from trimesh import Trimesh

    lattice = Lattice.of(bounds, resolution)
    bounds, pitch = lattice.bounds, lattice.pitch
    count = np.ceil((bounds[1] - bounds[0]) / pitch - 1e-9).astype(int) + 1
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1).reshape(-1, 3)
    steady = guarded(field, bounds)
    values = np.concatenate([steady(bounds[0] + pitch * part) for part in chunks(nodes)])
    steep = max(steepest(values.reshape(count), pitch), 1.0)
    values = _snap(np.maximum(values, steep * walls(bounds[0] + pitch * nodes, bounds, pitch)), pitch)
    if values.min() > 0 or values.max() < 0:
        raise no_surface(bounds)
    vertices, faces, _, _ = marching_cubes(values.reshape(count), 0.0, allow_degenerate=False)
    return Trimesh(bounds[0] + pitch * vertices, faces, process=False)


@dataclass(frozen=True, eq=False)
class _Band:
    """Cells (n, 3) about the surface of `look`, and the least and greatest value at their corners.

    Beyond them the field is at least `width` from zero.
    """

    look: Look
    width: float
    cells: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, look: Look, surface: _Surface, width: float) -> _Band:
        values = surface.values[surface.corners]
        return cls(look, width, surface.cells, values.min(1), values.max(1))

    def reached(self, look: Look) -> Array | None:
        """The cells that the surface of another field can cross; None where it can have left the band."""
        if (apart := self.look.apart(look, self.width)) is None:
            return None
        at = np.minimum(self.cells >> look.lattice.shift, np.array(apart.shape) - 1)
        by = apart[tuple(at.T)]
        cells = self.cells[(self.low <= by) & (self.high >= -by)]
        return cells if len(cells) and look.found(cells) else None


@dataclass(frozen=True, eq=False)
class _Seen:
    """The last field, and the band laid around it or one before it."""

    look: Look
    band: _Band | None


@dataclass(frozen=True, eq=False)
class _Surface:
    """Cells (n, 3), the nodes (n, 8) at their corners, nodes' subscripts and points (m, 3) and values (m,).

    `crossed` (k,) are the cells that the surface runs through.
    """

    lattice: Lattice
    cells: Array
    corners: Array
    nodes: Array
    points: Array
    values: Array
    crossed: Array

    def mesh(self) -> Trimesh:
        """Marching cubes on the cells that are crossed, in an order that tells nothing of how they were found."""
        import igl
        from trimesh import Trimesh

        if not len(self.crossed):
            raise no_surface(self.lattice.bounds)
        crossed = self.crossed[np.argsort(self.lattice.keys(self.cells[self.crossed]))]
        used = np.zeros(len(self.values), bool)
        used[self.corners[crossed]] = True
        kept = np.flatnonzero(used)
        kept = kept[np.argsort(self.lattice.keys(self.nodes[kept]))]
        number = np.empty(len(used), self.corners.dtype)
        number[kept] = np.arange(len(kept))
        corners = np.ascontiguousarray(number[self.corners[crossed]])
        vertices, faces, _ = igl.marching_cubes(
            _snap(self.values[kept], self.lattice.pitch), self.points[kept], corners, 0.0
        )
        return Trimesh(vertices, faces, process=False)


def _search(look: Look, slack: float) -> tuple[Array, float]:
    """Cells (n, 3) that the surface can cross, and those within `slack` of them; the slope that they were found by."""
    import igl

    lattice, slope = look.lattice, look.slope
    while True:

        def distance(points: Array, slope: float = slope) -> Array:
            return np.maximum(np.abs(look.clipped(points)) / slope - slack, 0.0)

        cells = igl.lipschitz_octree(lattice.bounds[0], lattice.root, lattice.depth, distance)
        if cells.size:  # without cells libigl forgets the columns too
            cells = cells[:, YXZ]
            if look.found(cells):
                return cells, slope
        if not look.crossed.any():
            raise no_surface(lattice.bounds)
        slope *= 2
        log.info("the field is steeper than was seen at first: slope bound raised to %.3g", slope)


def _closed(field: Field, cells: Array, lattice: Lattice) -> _Surface:
    """`cells`, with the neighbours that the surface runs on into added until it is closed."""
    import igl

    size = 1 << lattice.depth
    known, known_values = np.empty(0, np.int64), np.empty(0)
    while True:
        nodes, corners, points = igl.unique_sparse_voxel_corners(
            lattice.bounds[0], lattice.root, lattice.depth, cells[:, YXZ]
        )
        nodes = nodes[:, YXZ]
        keys = lattice.keys(nodes)
        fresh = np.ones(len(nodes), bool)
        values = np.empty(len(nodes))
        if len(known):
            at = _places(keys, known)
            fresh = at < 0
            values[~fresh] = known_values[at[~fresh]]
        values[fresh] = np.concatenate([field(part) for part in chunks(points[fresh])] or [np.empty(0)])
        inside = (values < 0)[corners]
        crossed = np.flatnonzero(inside.any(1) & ~inside.all(1))
        present = np.sort(lattice.keys(cells))
        sides = nodes[corners[0]] - cells[0]  # which corner stands where
        added = [np.empty((0, 3), cells.dtype)]
        for face in FACES:
            side = sides[:, np.abs(face).argmax()] == int(face.sum() > 0)
            signs = inside[crossed][:, side]
            neighbours = cells[crossed[signs.any(1) & ~signs.all(1)]] + face
            neighbours = neighbours[((neighbours >= 0) & (neighbours < size)).all(1)]
            added.append(neighbours[_places(lattice.keys(neighbours), present) < 0])
        more = np.unique(np.concatenate(added), axis=0)
        if not len(more):
            return _Surface(lattice, cells, corners, nodes, points, values, crossed)
        order = np.argsort(keys)
        known, known_values = keys[order], values[order]
        cells = np.concatenate([cells, more])


def _places(keys: Array, among: Array) -> Array:
    """(n,) where `keys` stand in the sorted `among`; -1 where they do not."""
    at = np.minimum(np.searchsorted(among, keys), len(among) - 1)
    return np.where(among[at] == keys, at, -1)


def _snap(values: Array, pitch: float) -> Array:
    near = np.abs(values) < SNAP * pitch
    return np.where(near, np.where(values < 0, -SNAP * pitch, SNAP * pitch), values)
