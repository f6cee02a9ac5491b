"""Parts of a mesh to measure on: the segments of a plane section, or triangles, that follow the mesh's vertices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .basic import with_faces
from .quantity import Number, Quantity, combined

if TYPE_CHECKING:
    from trimesh import Trimesh

Direction = str | tuple[float, float, float] | Array
AXES: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {f"{sign}{name}": tuple(np.eye(3)[k] * (-1 if sign else 1)) for k, name in enumerate("xyz") for sign in ("", "-")}
)
TIE = 1e-9  # shares of a part's size within which two points are equally far out


def direction(towards: Direction) -> Array:
    """A unit vector (3,) from "x", "-z", … or three numbers. Raises InputError."""
    if isinstance(towards, str):
        if towards not in AXES:
            raise InputError(f"direction: expected one of {', '.join(AXES)} or three numbers, got {towards!r}")
        return np.array(AXES[towards])
    vector = np.asarray(towards, float)
    size = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not (np.isfinite(size) and size > 0):
        raise InputError(f"direction: expected three numbers, not all zero, got {towards!r}")
    return vector / size


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh seen along axes of one's own.

    Parameters
    ----------
    vertices, faces
        (V, 3) along those axes, and (F, 3).
    turn
        (3, 3) the axes as rows: `vertices` = the mesh's own ones @ turnᵀ.
    """

    vertices: Array
    faces: Array
    turn: Array

    @classmethod
    def of(cls, mesh: Trimesh | Shape, turn: Array | None = None) -> Shape:
        """`mesh` along the rows of `turn`; its own axes without. Raises EmptyMesh, MeasureError."""
        if isinstance(mesh, Shape):
            return mesh
        turn = np.eye(3) if turn is None else turn
        return cls(np.asarray(with_faces(mesh).vertices, float) @ turn.T, np.asarray(mesh.faces), turn)


@dataclass(frozen=True, eq=False)
class Facets:
    """S segments or triangles whose corners follow the vertices of a mesh, to first order.

    Parameters
    ----------
    corners
        (S, 2, 3) of segments, (S, 3, 3) of triangles.
    rows
        (S, m, k) the vertices that each corner depends on.
    follow
        (S, m, k, 3, 3) how: derivative of the corner by each.
    normals
        (S, 3) unit, outward; of segments, in the plane of the section.
    plane
        (3,) the normal of the plane that was cut with; None for triangles.
    shifts
        (S, m, 3) derivative of the corners by a quantity, and the quantity: a plane that moves takes its section along.
    """

    corners: Array
    rows: Array
    follow: Array
    normals: Array
    plane: Array | None = None
    shifts: tuple[tuple[Array, Quantity], ...] = ()

    def __len__(self) -> int:
        return len(self.corners)

    @cached_property
    def size(self) -> Array:
        """(S,) lengths or areas."""
        a, b = self.corners[:, 0], self.corners[:, 1]
        if self.corners.shape[1] == 2:
            return np.asarray(np.linalg.norm(b - a, axis=1))
        return np.asarray(np.linalg.norm(np.cross(b - a, self.corners[:, 2] - a), axis=1) / 2)

    @cached_property
    def middles(self) -> Array:
        """(S, 3)."""
        return np.asarray(self.corners.mean(axis=1))

    def where(self, chosen: Array) -> Facets:
        """Those chosen by a mask (S,) or by indices."""
        shifts = tuple((by[chosen], quantity) for by, quantity in self.shifts)
        parts = (self.corners[chosen], self.rows[chosen], self.follow[chosen], self.normals[chosen])
        return Facets(*parts, self.plane, shifts)

    def facing(self, towards: Direction, within: float = 45.0) -> Facets:
        """Those whose outward normal is within `within` degrees of a direction. Raises InputError."""
        if not 0 < within <= 180:
            raise InputError(f"facing: within: expected an angle above 0 to 180 [deg], got {within!r:.100}")
        return self.where(self.normals @ direction(towards) > np.cos(np.radians(within)))

    def between(
        self,
        x: tuple[Number, Number] | None = None,
        y: tuple[Number, Number] | None = None,
        z: tuple[Number, Number] | None = None,
    ) -> Facets:
        """Those whose middles lie in the ranges. Which ones is taken as constant in derivatives."""
        kept = np.ones(len(self), bool)
        for axis, span in enumerate((x, y, z)):
            if span is not None:
                kept &= (self.middles[:, axis] >= float(span[0])) & (self.middles[:, axis] <= float(span[1]))
        return self.where(kept)

    def required(self, what: str, advice: str = "") -> Facets:
        """Itself. Raises MeasureError naming `what` is missing where nothing is left, with `advice` what to do."""
        if not len(self):
            raise MeasureError(f"expected {what}, got nothing there" + (f"; {advice}" if advice else ""))
        return self

    def quantity(self, value: float, by_corners: Array, by_size: Array | None = None) -> Quantity:
        """`value` as a quantity, given its derivative by the corners (S, m, 3) and by the sizes (S,)."""
        if by_size is not None:
            by_corners = by_corners + by_size[:, None, None] * self._size_by_corners
        slopes = np.einsum("smi,smkij->smkj", by_corners, np.broadcast_to(self.follow, (*self.rows.shape, 3, 3)))
        own = Quantity(float(value), self.rows.reshape(-1), slopes.reshape(-1, 3))
        moved = [(quantity, float((by * by_corners).sum())) for by, quantity in self.shifts]
        return combined(float(value), (own, 1.0), *moved)

    @cached_property
    def _size_by_corners(self) -> Array:
        a, b = self.corners[:, 0], self.corners[:, 1]
        if self.corners.shape[1] == 2:
            along = (b - a) / np.maximum(self.size, np.finfo(float).tiny)[:, None]
            return np.stack([-along, along], axis=1)
        c = self.corners[:, 2]
        normals = np.cross(b - a, c - a) / np.maximum(2 * self.size, np.finfo(float).tiny)[:, None]
        return np.stack([np.cross(normals, edge) / 2 for edge in (c - b, a - c, b - a)], axis=1)


def surface(mesh: Trimesh | Shape) -> Facets:
    """The faces of `mesh`; those of no area are left out. Raises EmptyMesh, MeasureError."""
    shape = Shape.of(mesh)
    corners = shape.vertices[shape.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1)
    kept = size > 0
    follow = np.broadcast_to(shape.turn, (int(kept.sum()), 3, 1, 3, 3))
    return Facets(corners[kept], shape.faces[kept][..., None], follow, normals[kept] / size[kept, None])


def section(mesh: Trimesh | Shape, normal: Direction, at: Number) -> Facets:
    """The segments in which the plane with `normal` at position `at` along it cuts a mesh, of open meshes too.

    Segments run with the material on their left, seen against `normal`. A vertex on the plane counts as above it, so
    that no case is degenerate. A plane whose position is a quantity moves with it.

    Raises EmptyMesh, MeasureError, and InputError for a direction that is none or a position that is no finite number.
    """
    if not (isinstance(at, Quantity | Real) and math.isfinite(float(at))):
        raise InputError(f"section: at: expected a finite number or a quantity, got {at!r:.100}")
    shape, axis = Shape.of(mesh), direction(normal)
    height = shape.vertices @ axis - float(at)
    above = height >= 0
    first, second, third = (above[shape.faces[:, k]] for k in range(3))
    cut = shape.faces[(first != second) | (second != third)]
    lone_above = above[cut].sum(axis=1) == 1
    lone = (above[cut] == lone_above[:, None]).argmax(axis=1)
    a, b, c = (np.take_along_axis(cut, ((lone + k) % 3)[:, None], axis=1)[:, 0] for k in range(3))
    # A face runs a, b, c counter-clockwise seen from outside: walking from ab to ac keeps the material on the left
    # where `a` is the one above, and the other way round where it is below.
    ends = np.stack([np.where(lone_above, b, c), np.where(lone_above, c, b)], axis=1)
    rows = np.stack([np.broadcast_to(a[:, None], ends.shape), ends], axis=-1)  # (S, 2, 2)
    rows.sort(axis=-1)  # an edge is cut at one point, bit for bit, whichever face asks
    low, high = shape.vertices[rows[..., 0]], shape.vertices[rows[..., 1]]
    share = (-height[rows[..., 0]] / (height[rows[..., 1]] - height[rows[..., 0]]))[..., None]
    corners = low + share * (high - low)
    along = (high - low) / ((high - low) @ axis)[..., None]
    kept = (corners[:, 0] != corners[:, 1]).any(axis=1)
    slide = (np.eye(3) - along[..., None] * axis) @ shape.turn  # what is left of a vertex's move within the plane
    follow = np.stack([(1 - share)[..., None] * slide, share[..., None] * slide], axis=2)
    outward = np.cross(corners[kept, 1] - corners[kept, 0], axis)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), np.finfo(float).tiny)
    shifts = ((along[kept], at),) if isinstance(at, Quantity) else ()
    return Facets(corners[kept], rows[kept], follow[kept], outward, axis, shifts)


def highest(facets: Facets, towards: Direction = "z", layer: float = 0.0) -> Quantity:
    """The farthest position along a direction; points that tie share the derivative.

    With `layer` [L] it is the mean of the corners no more than that behind the farthest: as exact on a flat end, and
    moved less by noise and by a mesh's last vertex. Raises MeasureError, InputError.
    """
    if not (isinstance(layer, float | int | np.number) and 0 <= layer < math.inf):
        raise InputError(f"layer: expected a length of at least 0, got {layer!r:.100}")
    axis = direction(towards)
    reach = facets.required(f"something to look for its end along {towards}").corners @ axis
    size = max(float(np.ptp(facets.corners[..., k])) for k in range(3))  # numpy is slow at all three at once
    far = reach >= reach.max() - layer - TIE * size
    ends = np.unique(np.flatnonzero(far) // far.shape[1])
    share = far[ends] / far.sum()
    return facets.where(ends).quantity(float(reach[far].mean()), share[..., None] * axis).collected()


def lowest(facets: Facets, towards: Direction = "z", layer: float = 0.0) -> Quantity:
    """The least position along a direction; `layer` as for `highest`. Raises MeasureError."""
    return -highest(facets, -direction(towards), layer)


def extent(facets: Facets, along: Direction, layer: float = 0.0) -> Quantity:
    """From the least to the farthest position along a direction. Raises MeasureError."""
    return highest(facets, along, layer) - lowest(facets, along, layer)


def middle(facets: Facets, along: Direction, layer: float = 0.0) -> Quantity:
    """Half-way between both ends along a direction. Raises MeasureError."""
    return (highest(facets, along, layer) + lowest(facets, along, layer)) / 2


def total(facets: Facets) -> Quantity:
    """The length of the segments, or the area of the triangles."""
    return facets.quantity(float(facets.size.sum()), np.zeros_like(facets.corners), np.ones(len(facets)))


def enclosed_area(cut: Facets) -> Quantity:
    """What a section encloses: positive around material, holes taken off.

    Raises MeasureError where the section is empty or not closed.
    """
    if cut.plane is None:
        raise MeasureError("enclosed area: expected a section, got triangles; cut first")
    cut.required("a section to enclose an area")
    shut = cut.size @ np.cross(cut.normals, cut.plane)  # the sum of all segments as vectors
    if float(np.abs(shut).max()) > 1e-6 * float(cut.size.sum()):
        raise MeasureError("enclosed area: expected a closed section, got open ends; the mesh is not closed")
    p, q = (cut.corners[:, k] - cut.middles.mean(axis=0) for k in (0, 1))
    value = float((np.cross(p, q) @ cut.plane).sum() / 2)
    by = np.stack([np.cross(q, cut.plane), np.cross(cut.plane, p)], axis=1) / 2
    return cut.quantity(value, by)
