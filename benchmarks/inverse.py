"""The judge's eight parameters of any mesh: those whose true shape explains it best.

A morph is the base body plus eight fields, one a parameter, each times the parameter or the tangent of its angle. Least
squares of the distances across the surface, from the middles of all faces to the true shape, solve for the factors:
exact on true shapes of any triangulation, without what sections confuse (benchmarks/sections.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import igl
import numpy as np
from trimesh import Trimesh

from lampopt.types import Array

STEPS = 12
CLOSE = 1e-7  # change of the factors at which it ends


@dataclass(frozen=True, eq=False)
class Inverse:
    """Parameters of a mesh by the family that it is meant to be of.

    Parameters
    ----------
    names, units
        Of the eight parameters.
    vertices, faces
        The base body, (V, 3) and (F, 3).
    fields
        (8, V, 3) how it moves by one unit of each factor.
    angles
        (8,) which factors are tangents of degrees.
    middle
        (8,) factors to start from.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    vertices: Array
    faces: Array
    fields: Array
    angles: Array
    middle: Array

    @classmethod
    def of(cls, judge: ModuleType, body: str) -> Inverse:
        base = judge.body(body)
        angles = np.array([unit == "deg" for unit in judge.UNITS])
        corners = np.asarray(base.vertices, float)
        unit = np.where(angles, 45.0, 1.0)
        fields = np.stack([np.asarray(judge.morph(base, row).vertices) - corners for row in np.diag(unit)])
        middle = (judge.LOW + judge.HIGH) / 2
        start = np.where(angles, np.tan(np.radians(middle)), middle)
        return cls(
            tuple(judge.NAMES), tuple(judge.UNITS), corners, np.asarray(base.faces, np.int64), fields, angles, start
        )

    def __call__(self, mesh: Trimesh) -> Array:
        """(8,) parameters [m, deg]."""
        points, weights = np.asarray(mesh.triangles_center), np.sqrt(np.asarray(mesh.area_faces))
        factors = self.middle.copy()
        for _ in range(STEPS):
            shape = self.vertices + np.tensordot(factors, self.fields, 1)
            _, face, closest = igl.point_mesh_squared_distance(points, shape, self.faces)
            corners = shape[self.faces[face]]
            part = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(corners[:, k]) for k in range(3)))
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
            motion = np.einsum("pk,qpki->pqi", part, self.fields[:, self.faces[face]])
            rows = weights[:, None] * np.einsum("pqi,pi->pq", motion, normals)
            off = weights * ((points - closest) * normals).sum(1)
            step = np.linalg.lstsq(rows, off, rcond=None)[0]
            factors = factors + step
            if np.abs(step).max() < CLOSE:
                break
        return np.where(self.angles, np.degrees(np.arctan(factors)), factors)
