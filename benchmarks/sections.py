"""The judge's eight parameters read off a mesh: heights and widths of sections, a straight line from exemplars.

The panel measures of lampopt look for straight panels, which a free-form deformation bends. Here the body is looked at
where the deformation acts: heights from above and from below at fixed parts of the length, widths at fixed parts of the
height, slopes through some of them. What leads from these ten readings to the parameters is linear, fitted on the
exemplars' meshes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from trimesh import Trimesh

from lampopt.reporting.shapes import first_hits
from lampopt.types import Array

TOP = (0.08, 0.14, 0.20, 0.26, 0.55, 0.84, 0.88, 0.92, 0.96)  # parts of the length, looked at from above
BOTTOM = (0.03, 0.06, 0.09, 0.12, 0.86, 0.89, 0.92, 0.95, 0.98)  # from below
ASIDE = 0.12  # of the width, to either side of the middle
LEVELS = (0.30, 0.45, 0.62, 0.88)  # parts of the height where widths are taken, at
WHERE = 0.55  # of the length


def readings(mesh: Trimesh) -> Array:
    """(10,) length, two widths, height, roof, and the slopes of greenhouse, ramp, diffuser, trunk and hood [m, deg].

    NaN where a ray meets nothing.
    """
    low, high = np.asarray(mesh.bounds)
    size, middle = high - low, (low[1] + high[1]) / 2
    points, ways = list[tuple[float, float, float]](), list[tuple[float, float, float]]()
    for side in (-ASIDE, ASIDE):
        for part, start, way in [(x, high[2] + 1, -1.0) for x in TOP] + [(x, low[2] - 1, 1.0) for x in BOTTOM]:
            points.append((low[0] + part * size[0], middle + side * size[1], start))
            ways.append((0.0, 0.0, way))
    for sense in (-1.0, 1.0):
        for level in LEVELS:
            points.append((low[0] + WHERE * size[0], middle + sense * (size[1] + 1), low[2] + level * size[2]))
            ways.append((0.0, -sense, 0.0))
    met = _met(mesh, np.array(points), np.array(ways))
    count = len(TOP) + len(BOTTOM)
    heights = (met[:count, 2] + met[count : 2 * count, 2]) / 2
    top, bottom = np.split(heights, [len(TOP)])
    left, right = np.split(met[2 * count :, 1], 2)
    wide = np.abs(right - left)
    lean = np.degrees(np.arctan((wide[2] - wide[3]) / 2 / ((LEVELS[3] - LEVELS[2]) * size[2])))
    slopes = [
        _slope(np.array(at) * size[0], up)
        for at, up in ((BOTTOM[:4], bottom[:4]), (BOTTOM[4:], bottom[4:]), (TOP[5:], top[5:]), (TOP[:4], top[:4]))
    ]
    return np.array([size[0], wide[0], wide[1], size[2], top[4] - low[2], lean, *slopes])


def _met(mesh: Trimesh, points: Array, ways: Array) -> Array:
    """(M, 3) where rays meet the mesh first."""
    corners, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    face, weights = first_hits(corners, faces, points, ways)
    at = np.einsum("mk,mkc->mc", weights, corners[faces[np.maximum(face, 0)]])
    at[face < 0] = np.nan
    return np.asarray(at)


def _slope(along: Array, up: Array) -> float:
    """Of the straight line through some heights [deg]."""
    return float(np.degrees(np.arctan(np.polyfit(along, up, 1)[0]))) if np.isfinite(up).all() else float("nan")


@dataclass(frozen=True, eq=False)
class Reading:
    """From ten readings to eight parameters: `lines` (11, 8)."""

    lines: Array

    @classmethod
    def of(cls, meshes: Iterable[Trimesh], parameters: Array) -> Reading:
        """Least squares over exemplars."""
        read = np.array([readings(mesh) for mesh in meshes])
        known = np.isfinite(read).all(1)
        return cls(
            np.linalg.lstsq(np.column_stack([read, np.ones(len(read))])[known], parameters[known], rcond=None)[0]
        )

    def __call__(self, mesh: Trimesh) -> Array:
        """(8,) parameters; NaN where something cannot be read."""
        return np.asarray(np.append(readings(mesh), 1.0) @ self.lines)
