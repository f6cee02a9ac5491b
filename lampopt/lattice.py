"""What a field looks like from afar: its values on a coarse lattice, how steep it is, where its sign changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt

import numpy as np

from lampopt.errors import EmptyMesh, InputError
from lampopt.types import Array

Field = Callable[[Array], Array]

COARSE = 32  # cells along the box of the lattice that estimates slopes and verifies that no part is lost
SLOPE_MARGIN = 1.25  # over the steepest slope seen
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Cells about a box, and coarse ones, of which each is 2^shift of them wide.

    Parameters
    ----------
    bounds
        (2, 3) low and high corner of the box.
    pitch
        Width of a cell [box].
    depth
        Of the octree: its root is 2^depth cells wide.
    """

    bounds: Array
    pitch: float
    depth: int

    @classmethod
    def of(cls, bounds: Array, resolution: int) -> Lattice:
        """`resolution` cells along the longest side of the box. Raises InputError."""
        bounds = np.asarray(bounds, float)
        if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
            raise InputError(f"bounds: expected (2, 3), finite, low below high, got {bounds.tolist()}")
        if not 4 <= resolution <= 4096:
            raise InputError(f"resolution: expected 4 to 4096 cells along the box, got {resolution}")
        return cls(bounds, float((bounds[1] - bounds[0]).max()) / resolution, int(np.ceil(np.log2(resolution))))

    @property
    def root(self) -> float:
        """Width of the octree's root [box]."""
        return self.pitch * float(1 << self.depth)

    @property
    def shift(self) -> int:
        """How often a coarse cell is halved."""
        return max(self.depth - int(np.log2(COARSE)), 0)

    @property
    def step(self) -> float:
        """Width of a coarse cell [box]."""
        return self.pitch * (1 << self.shift)

    @property
    def coarse(self) -> Array:
        """(3,) coarse nodes along each axis."""
        return np.asarray(np.ceil((self.bounds[1] - self.bounds[0]) / self.step - 1e-9), int) + 1

    def keys(self, cells: Array) -> Array:
        """One integer for each cell or node (n, 3), in the order of x, y, z."""
        wide = (1 << self.depth) + 3
        cells = cells.astype(np.int64) + 1
        return np.asarray((cells[:, 0] * wide + cells[:, 1]) * wide + cells[:, 2])


@dataclass(frozen=True, eq=False)
class Look:
    """A field, and what is seen of it on the coarse lattice.

    Parameters
    ----------
    field
        Checked, and going on beyond the box.
    clipped
        The same within the box less half a cell, so that whatever reaches the box is closed there.
    values
        The field itself at the coarse nodes.
    slope
        The steepest that was seen, and a margin.
    crossed
        Coarse cells between whose corners the sign changes.
    """

    lattice: Lattice
    field: Field
    clipped: Field
    values: Array
    slope: float
    crossed: Array

    @classmethod
    def of(cls, field: Field, lattice: Lattice) -> Look:
        """Evaluate the coarse nodes, and slopes at those nearest to the surface."""
        bounds, pitch, step, count = lattice.bounds, lattice.pitch, lattice.step, lattice.coarse
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1)
        points = bounds[0] + step * nodes.reshape(-1, 3)
        values = field(points)
        slopes = [steepest(values.reshape(count), step)]
        near = points[np.argsort(np.abs(values), kind="stable")[:2048]]
        at_near = field(near)
        ahead = np.stack([field(near + pitch * np.eye(3)[k]) for k in range(3)], 1)
        slopes.append(np.linalg.norm((ahead - at_near[:, None]) / pitch, axis=1).max())
        inside = _corners((np.maximum(values, walls(points, bounds, pitch)) < 0).reshape(count))
        crossed = np.asarray(inside.any(0) & ~inside.all(0))
        slope = max(SLOPE_MARGIN * float(max(slopes)), 1.0)
        # Walls are as steep as the field: gentler ones would bend it deep inside, and move its surface.
        steep = max(slope / SLOPE_MARGIN, 1.0)

        def clipped(points: Array) -> Array:
            return np.maximum(field(points), steep * walls(points, bounds, pitch))

        return cls(lattice, field, clipped, values.reshape(count), slope, crossed)

    def found(self, cells: Array) -> bool:
        """Whether cells (n, 3) lie in every coarse cell that the sign changes in."""
        active = np.zeros(np.add(self.crossed.shape, 1), bool)  # one more on each axis, for cells beside the box
        active[tuple(np.minimum(cells >> self.lattice.shift, self.crossed.shape).T)] = True
        return bool(active[:-1, :-1, :-1][self.crossed].all())

    def apart(self, other: Look, width: float) -> Array | None:
        """How far the two fields may be apart, for each coarse cell, seen from its corners and its centre.

        None where they may be more than `width` apart in a cell that this one's surface is near to: no farther than
        they are apart.
        """
        change = other.values - self.values  # a point is no more than half a cell along each axis from a corner
        between = SLOPE_MARGIN / 2 * sum(np.abs(np.diff(change, axis=k)).max() for k in range(3))
        apart = np.asarray(_corners(np.abs(change)).max(0) + between)
        near = _corners(np.abs(self.values)).min(0) - self.slope * sqrt(3) / 2 * self.lattice.step <= apart
        centres = self.lattice.bounds[0] + self.lattice.step * (np.argwhere(near) + 0.5)
        at_centres = other.field(centres) - self.field(centres)
        apart[near] = np.maximum(apart[near], np.abs(at_centres) + between)
        return apart if (apart[near] <= width).all() else None


def no_surface(bounds: Array) -> EmptyMesh:
    """What is raised where there is no surface."""
    return EmptyMesh(f"the field does not change sign in {bounds.tolist()}: there is no surface to extract")


def chunks(points: Array, size: int = 1 << 18) -> list[Array]:
    """`points` in parts, so that their values need not all be worked out at once."""
    return [points[i : i + size] for i in range(0, len(points), size)]


def guarded(field: Field, bounds: Array) -> Field:
    """`field`, checked; beyond the box it goes on as it is at the box and is never asked about points outside."""

    def steady(points: Array) -> Array:
        values = np.asarray(field(np.clip(points, *bounds)), float).reshape(-1)
        if len(values) != len(points):
            raise InputError(f"field: expected one value for each of {len(points)} points, got {len(values)}")
        if not np.isfinite(values).all():
            raise EmptyMesh("the field is not finite: the mix lies too far out, there is no surface to extract")
        return values

    return steady


def walls(points: Array, bounds: Array, pitch: float) -> Array:
    """Signed distances (M,) to the box less half a cell."""
    centre, half = bounds.mean(0), (bounds[1] - bounds[0]) / 2 - pitch / 2
    return np.asarray((np.abs(points - centre) - half).max(1))


def steepest(grid: Array, step: float) -> float:
    """The largest slope between neighbouring nodes of `grid`."""
    return float(max(np.abs(np.diff(grid, axis=k)).max() / step for k in range(3) if grid.shape[k] > 1))


def _corners(grid: Array) -> Array:
    """(8, a, b, c) what stands at the corners of each cell of a grid of (a + 1, b + 1, c + 1) nodes."""
    parts = [tuple(slice(c, n - 1 + c) for c, n in zip(corner, grid.shape, strict=True)) for corner in CORNERS]
    return np.stack([grid[part] for part in parts])
