"""A mesh seen as a body with a nose: positions as fractions of its box, along it, across it and up it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

MESH_AXES: Mapping[str, tuple[int, int]] = MappingProxyType(
    {f"{sign}{name}": (k, -1 if sign else 1) for k, name in enumerate("xyz") for sign in ("", "-")}
)
ALIKE = 0.9  # horizontal sides nearer than this to each other do not tell which way a body points


@dataclass(frozen=True, eq=False)
class Body:
    """A base mesh and its body axes: to the rear, to the right, up; a right-handed set along the mesh's own axes.

    Parameters
    ----------
    vertices, faces
        (V, 3) [unit] and (F, 3), read-only.
    index, sign
        Body axis k is `sign[k]` times the mesh's axis `index[k]`.
    """

    vertices: Array
    faces: Array
    index: tuple[int, int, int]
    sign: tuple[int, int, int]

    @classmethod
    def of(cls, mesh: Trimesh, *, forward: str = "", up: str = "z") -> Body:
        """The body of `mesh`, whose nose points `forward`: "x", "-x", "y", ...

        Without `forward` the body lies along its longer horizontal side, its nose at the low end.

        Raises
        ------
        InputError
            If an axis is none, both are one, the horizontal sides are too alike to tell, or the mesh is flat or empty.
        """
        for name, axis in (("up", up), ("forward", forward)):
            if axis not in MESH_AXES and (axis or name == "up"):
                raise InputError(f"{name}: expected one of {', '.join(MESH_AXES)}, got {axis!r}")
        vertices, faces = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
        if not len(faces):
            raise InputError("expected a body with faces, got a mesh without")
        for array in (vertices, faces):
            array.flags.writeable = False
        size = np.ptp(vertices[faces], axis=(0, 1))
        if not (size > 1e-6 * size.max()).all():
            raise InputError(f"expected a body with a length, a width and a height, got extents {size.tolist()}")
        top = _unit(*MESH_AXES[up])
        rear = -_unit(*MESH_AXES[forward]) if forward else _longer(size, top)
        if rear @ top:
            raise InputError(f"forward: expected an axis across up = {up!r}, got {forward!r}")
        axes = np.stack([rear, np.cross(top, rear), top])
        first, second, third = (int(np.abs(axis).argmax()) for axis in axes)
        a, b, c = (int(axis.sum()) for axis in axes)
        return cls(vertices, faces, (first, second, third), (a, b, c))

    @property
    def ends(self) -> tuple[Array, Array]:
        """(3,) and (3,) lowest and highest of what faces have, in the mesh's own axes, by body axis [unit]."""
        corners = self.vertices[self.faces][..., list(self.index)]
        return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

    @cached_property
    def size(self) -> Array:
        """(3,) length, half the width, height [unit]: what fractions are multiplied with."""
        low, high = self.ends
        size: Array = high - low
        size[1] /= 2
        return size

    @cached_property
    def start(self) -> Array:
        """(3,) where each fraction is 0, in the mesh's own axes, by body axis: nose, middle plane, ground [unit]."""
        low, high = self.ends
        start: Array = np.where(np.array(self.sign) > 0, low, high)
        start[1] = (low[1] + high[1]) / 2
        return start

    def fractions(self, points: Array) -> Array:
        """`points` (M, 3) [unit] as fractions: 0 at the nose to 1 at the tail, −1 to 1 across, 0 to 1 up."""
        fractions: Array = points[:, list(self.index)] - self.start
        fractions /= self.size * self.sign
        return fractions

    def vectors(self, vectors: Array) -> Array:
        """`vectors` (M, 3) of the mesh's axes in the body's axes."""
        turned: Array = vectors[:, list(self.index)]
        turned *= self.sign
        return turned

    def moved(self, displacement: Array) -> Array:
        """The vertices (V, 3), each moved by its `displacement` (V, 3) [unit, body axes]."""
        vertices = self.vertices.copy()
        vertices[:, list(self.index)] += displacement * self.sign
        return vertices

    @property
    def centroids(self) -> Array:
        """(F, 3) the middles of the faces [unit]."""
        return np.asarray(self.vertices[self.faces].mean(axis=1))

    @property
    def areas(self) -> Array:
        """(F, 3) the faces' area vectors, normal times area, in body axes [largest size²]."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2) / self.size.max()  # its square may be beyond any float
        return self.vectors(np.cross(b - a, c - a) / 2)


def _unit(index: int, sign: int) -> Array:
    unit: Array = np.zeros(3, int)
    unit[index] = sign
    return unit


def _longer(size: Array, top: Array) -> Array:
    """The way to the rear: up the longer horizontal side."""
    short, long = sorted((k for k in range(3) if not top[k]), key=lambda k: float(size[k]))
    if size[short] > ALIKE * size[long]:
        raise InputError(
            f"forward: cannot tell which way the body points: it measures {size[short]:.6g} along "
            f"{'xyz'[short]} and {size[long]:.6g} along {'xyz'[long]}; say it, as in forward='-{'xyz'[long]}'"
        )
    return _unit(long, 1)
