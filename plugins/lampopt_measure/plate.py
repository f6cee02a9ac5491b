"""The six parameters of a plate with a circular through-hole (paper, appendix R), read off any mesh of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .basic import merged, with_faces
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


def _plate(mesh: Trimesh) -> Array:
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    low, high = _sides(vertices, faces)
    holes = [_hole(vertices, faces, low[2] + h * (high[2] - low[2])) for h in HEIGHTS]
    area, x, y = np.mean(holes, axis=0)
    middle = (low + high) / 2
    return np.array([*(high - low), np.sqrt(area / np.pi), x - middle[0], y - middle[1]])


def _sides(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Where the six sides lie: (3,) low and (3,) high."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    size = np.linalg.norm(normals, axis=1)
    low, high = np.zeros(3), np.zeros(3)
    for axis, name in enumerate("xyz"):
        for sign, side in ((-1, low), (1, high)):
            facing = sign * normals[:, axis] > FACING * size
            if not facing.any():
                raise MeasureError(
                    f"plate: expected a side towards {'+' if sign > 0 else '-'}{name}, got no face there"
                )
            # A third of each face's area at each corner, so that two long triangles tell of a slanting side as well.
            weight = np.repeat(size[facing], 3)
            reach = sign * vertices[faces[facing], axis].ravel()
            order = np.argsort(reach)[::-1]
            passed = np.cumsum(weight[order])
            side[axis] = sign * reach[order[np.searchsorted(passed, OVERLOOKED * passed[-1])]]
    if (low >= high).any():
        axis = int((high - low).argmin())
        raise MeasureError(
            f"plate: expected faces towards -{'xyz'[axis]} to lie below those towards +{'xyz'[axis]}, got them above: "
            "either they point inward (turn them round: mesh.invert()), or a side is missing"
        )
    return low, high


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
