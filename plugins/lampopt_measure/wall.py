"""Wall thickness: how far it is from each place of a surface through the material to the other side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .basic import corners_of, solid

if TYPE_CHECKING:
    from trimesh import Trimesh

RAYS = 4000  # at least about as many, spread over the area; one a face where there are more faces
OVERLOOKED = 0.01  # share of the area that may be thinner than the least thickness
OPPOSED = 0.5  # cosine: two sides of a wall face apart, to 60°
NEAR = 1e-5  # of the mesh's size: a ray does not meet the face that it starts from


@dataclass(frozen=True)
class Wall:
    """Least and median thickness by rays inward along the normal, weighted by the area that each stands for.

    A ray counts where it leaves the material through a face that looks away from its start within 60°: in a corner it
    tells of no wall. All but 1 % of the area is at least as thick as `least`, so that a stray triangle does not speak
    for the whole part; a wall of less area than that is overlooked.
    """

    names = ("least", "median")
    units = ("L", "L")

    def __call__(self, mesh: Trimesh) -> Array:
        """Least and median (2,).

        Raises
        ------
        EmptyMesh, MeasureError
            If the mesh is open, its faces do not all point outward, or it has no two sides that face apart.
        """
        closed = solid(mesh, "wall")
        corners = corners_of(closed)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normals, axis=1) / 2
        kept = area > 0
        corners, normals, area = corners[kept], normals[kept] / (2 * area[kept, None]), area[kept]
        start, face, weight = _spread(corners, area)
        thickness = _through(corners, normals, start, face)
        met = np.isfinite(thickness)
        if not met.any():
            raise MeasureError("wall: expected two sides that face apart, got none")
        return np.array([_quantile(thickness[met], weight[met], share) for share in (OVERLOOKED, 0.5)])


def _spread(corners: Array, area: Array) -> tuple[Array, Array, Array]:
    """Starts (M, 3), the faces they lie on (M,) and the area that each stands for (M,).

    A face of more than its share is cut into n² alike; the middles of those are symmetric in its corners, so that how
    faces and corners are listed changes nothing.
    """
    cuts = np.ceil(np.sqrt(area * (RAYS / area.sum()))).astype(int)
    start, face, weight = [], [], []
    for n in np.unique(cuts):
        same = np.flatnonzero(cuts == n)
        i, j = np.divmod(np.arange(n * n), n)
        up = i + j < n
        share = np.column_stack([np.where(up, i + 1 / 3, n - i - 1 / 3), np.where(up, j + 1 / 3, n - j - 1 / 3)]) / n
        share = np.column_stack([1 - share.sum(axis=1), share])
        start.append(np.einsum("mk,fkc->fmc", share, corners[same]).reshape(-1, 3))
        face.append(np.repeat(same, n * n))
        weight.append(np.repeat(area[same] / (n * n), n * n))
    return np.concatenate(start), np.concatenate(face), np.concatenate(weight)


def _through(corners: Array, normals: Array, start: Array, face: Array) -> Array:
    """(M,) how far the rays go, NaN where they meet no opposite side."""
    from igl.embree import EmbreeIntersector

    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = float((high - low).max())
    soup = ((corners.reshape(-1, 3) - (low + high) / 2) / size).astype(np.float32)  # Embree's precision is single
    tracer = EmbreeIntersector()
    tracer.init(np.asfortranarray(soup), np.asfortranarray(np.arange(len(soup), dtype=np.int32).reshape(-1, 3)))
    origins = ((start - (low + high) / 2) / size).astype(np.float32)
    inward = -normals[face]
    towards = inward.astype(np.float32)
    hit = np.array([tracer.intersectRay_first(o, d, NEAR)[0] for o, d in zip(origins, towards, strict=True)], int)
    across = np.einsum("mc,mc->m", inward, normals[hit])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.einsum("mc,mc->m", corners[hit, 0] - start, normals[hit]) / across  # exact, from the plane that is met
    return np.where((hit >= 0) & (across > OPPOSED) & (far > 0), far, np.nan)


def _quantile(values: Array, weight: Array, share: float) -> float:
    order = np.argsort(values, kind="stable")
    passed = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(passed, share * passed[-1])]])
