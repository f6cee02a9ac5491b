"""The six parameters of a plate with a circular through-hole (paper, appendix R), read off any mesh of one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .basic import TIE, merged, with_faces
from .facets import section as cut
from .holes import area_and_centre, ring
from .quantity import Quantity, mean, sqrt
from .section import free_along_z, section

if TYPE_CHECKING:
    from trimesh import Trimesh

OVERLOOKED = 0.05  # share of a side's area that may stick out beyond the side's position
FACING = 0.7  # cosine: a side is made of the faces within 45° of its direction
HEIGHTS = (0.3, 0.5, 0.7)  # where the hole is cut, in thicknesses: clear of rims that a decoder rounds


@dataclass(frozen=True)
class Plate:
    """Length (x), width (y), thickness (z), hole radius, hole centre relative to the plate's middle.

    A side lies where all but 5 % of its area is passed: on a clean plate that is the bounding box, exactly. Why not the
    bounding box itself: one bump or stray triangle would speak for the whole plate. Why not a mean or a middle section:
    they overlook ends that flare, and rounded edges draw them inward. What flares over more than a twentieth of a side
    is seen; the measure `extents` is there for who wants the last triangle. The hole is cut at three heights; its area,
    taken as a circle's, gives the radius. A recess or a bubble is no through-hole: the vertical line through the
    hole's centre must be free.
    """

    names = ("length", "width", "thickness", "hole_radius", "hole_x", "hole_y")
    units = ("L",) * 6

    def __call__(self, mesh: Trimesh) -> Array:
        """The six values (6,) [unit of `mesh`].

        Raises
        ------
        EmptyMesh
            If there are no faces.
        MeasureError
            If a side is missing, faces point inward, or there is not exactly one through-hole.
        """
        with_faces(mesh)
        try:
            return _plate(mesh)
        except MeasureError:  # perhaps only loose triangles; joining them always would cost more than measuring
            return _plate(merged(mesh))

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (6, V, 3); corners that tie for a side's position share it.

        Raises as a call does, and MeasureError where faces do not share vertices.
        """
        with_faces(mesh)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        low, high = _moving_sides(vertices, faces)
        holes = []
        for h in HEIGHTS:
            height = low[2] + h * (high[2] - low[2])
            area, x, y = _hole(vertices, faces, float(height))
            holes.append(area_and_centre(ring(cut(mesh, "z", height), 2, (x, y), float(np.sqrt(area / np.pi))), 2))
        whole, *centre = (mean(part) for part in zip(*holes, strict=True))
        places = [place - (low[k] + high[k]) / 2 for k, place in enumerate(centre)]
        values = [*(b - a for a, b in zip(low, high, strict=True)), sqrt(whole / np.pi), *places]
        return np.stack([value.gradient(len(vertices)) for value in values])


def _plate(mesh: Trimesh) -> Array:
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    low, high = _sides(vertices, faces)
    holes = [_hole(vertices, faces, low[2] + h * (high[2] - low[2])) for h in HEIGHTS]
    area, x, y = np.mean(holes, axis=0)
    middle = (low + high) / 2
    return np.array([*(high - low), np.sqrt(area / np.pi), x - middle[0], y - middle[1]])


def _sides(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Where the six sides lie: (3,) low and (3,) high."""
    low, high = np.zeros(3), np.zeros(3)
    for axis, sign, corners, weight in _facing(vertices, faces):
        reach = sign * vertices[corners, axis]
        order = np.argsort(reach)[::-1]
        passed = np.cumsum(weight[order])
        side = high if sign > 0 else low
        side[axis] = sign * reach[order[np.searchsorted(passed, OVERLOOKED * passed[-1])]]
    if (low >= high).any():
        axis = int((high - low).argmin())
        raise MeasureError(
            f"plate: expected faces towards -{'xyz'[axis]} to lie below those towards +{'xyz'[axis]}, got them above: "
            "either they point inward (turn them round: mesh.invert()), or a side is missing"
        )
    return low, high


def _facing(vertices: Array, faces: Array) -> Iterator[tuple[int, int, Array, Array]]:
    """Axis and sign of each side, the vertices at the corners of its faces, and the weight that each has there."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    size = np.linalg.norm(normals, axis=1)
    for axis, name in enumerate("xyz"):
        for sign in (-1, 1):
            facing = (sign * normals[:, axis] > FACING * size) & (size > 0)
            if not facing.any():
                raise MeasureError(
                    f"plate: expected a side towards {'+' if sign > 0 else '-'}{name}, got no face there"
                )
            # A third of each face's area at each corner, so that two long triangles tell of a slanting side as well.
            yield axis, sign, faces[facing].ravel(), np.repeat(size[facing], 3)


def _moving_sides(vertices: Array, faces: Array) -> tuple[list[Quantity], list[Quantity]]:
    """The six sides as `_sides` finds them, each moving with the vertices that lie there."""
    low, high = _sides(vertices, faces)
    sides: dict[int, list[Quantity]] = {-1: [], 1: []}
    for axis, sign, corners, weight in _facing(vertices, faces):
        at = (high if sign > 0 else low)[axis]
        tied = np.abs(vertices[corners, axis] - at) <= TIE * (high[axis] - low[axis])
        slopes = np.zeros((int(tied.sum()), 3))
        slopes[:, axis] = weight[tied] / weight[tied].sum()
        sides[sign].append(Quantity(float(at), corners[tied], slopes))
    return sides[-1], sides[1]


def _hole(vertices: Array, faces: Array, height: float) -> tuple[float, float, float]:
    """Area and centre x, y of the one through-hole, cut at z = `height`."""
    loops = section(vertices, faces, height)
    inner = np.flatnonzero(loops.area < 0)
    through = [i for i in inner if free_along_z(vertices, faces, loops.centroid[i])]
    if len(through) != 1:
        blind = f" ({len(inner)} recesses or cavities)" if len(inner) and not through else ""
        found = f"{len(through)} holes" if through else f"no through-hole{blind}"
        places = "".join(f"; at ({x:.6g}, {y:.6g})" for x, y in loops.centroid[through])
        raise MeasureError(f"plate: expected one through-hole at z = {height:.6g}, got {found}{places}")
    x, y = loops.centroid[through[0]]
    return -float(loops.area[through[0]]), float(x), float(y)
