"""Meshes as they are drawn: light, with sharp edges kept sharp, shaded by how much sky each vertex sees.

Rays are cast by Embree (in libigl's wheel), so that no graphics card or display is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

CREASE = np.cos(np.radians(38))  # faces that meet at less than this angle are shaded as one smooth surface
CROWDED = 64  # corners at one vertex beyond which each face keeps its own normal
FINE = 3000  # faces up to which a coarse mesh is divided, for its colours
SKY = 32  # directions that light comes from
FAR = 8.0  # where rays start [half the shape's largest extent]
SKIN = 0.02  # how deep below the surface counts as on it [half the shape's largest extent]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A mesh ready to be drawn: V vertices, doubled along sharp edges so that each has one normal.

    Parameters
    ----------
    vertices
        (V, 3) [half the largest extent, about the middle of the box around the mesh].
    faces
        (F, 3).
    normals
        (V, 3), outward, of length 1.
    sky
        (V,) from 0, in a crevice, to 1, in the open.
    centre, half
        The middle of the box around the mesh (3,) and half its largest extent [user's unit].
    extents
        (3,) of the mesh [user's unit].
    distance
        (V,) signed distance to the reference, positive outside it [user's unit]; None without a reference.
    """

    vertices: Array
    faces: Array
    normals: Array
    sky: Array
    centre: Array
    half: float
    extents: Array
    distance: Array | None = field(default=None)

    @property
    def points(self) -> Array:
        """(V, 3) vertices [user's unit]."""
        return self.vertices * self.half + self.centre


def drawn(mesh: Trimesh, *, faces: int, reference: Trimesh | None = None) -> Drawn:
    """`mesh` [user's unit] with `faces` faces at most, and its distance to `reference` [user's unit] if given.

    Raises
    ------
    InputError
        If it has no faces, or a vertex is not finite.
    """
    corners, triangles = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    if not (len(triangles) and np.isfinite(corners).all()):
        raise InputError(f"a mesh to be drawn: expected faces and finite vertices, got {len(triangles)} faces")
    low, high = corners[triangles.ravel()].min(0), corners[triangles.ravel()].max(0)
    centre, half = (low + high) / 2, float((high - low).max()) / 2 or 1.0
    light, triangles = _simplified((corners - centre) / half, triangles, faces)
    index, normals, split = _creased(light, triangles)
    distance = None if reference is None else signed_distance(light * half + centre, reference)[index]
    sky = sky_seen(light, triangles, light, _vertex_normals(light, triangles))[index]
    return Drawn(light[index], split, normals, sky, centre, half, high - low, distance)


def signed_distance(points: Array, surface: Trimesh) -> Array:
    """Signed distance (M,) of `points` (M, 3) to `surface`, negative inside; right near holes of the surface too."""
    import igl

    corners, triangles = np.asarray(surface.vertices, float), np.asarray(surface.faces, np.int64)
    middle = corners.mean(0)
    scale = float(np.abs(corners - middle).max()) or 1.0
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    asked = np.ascontiguousarray((points - middle) / scale)
    solid = np.ascontiguousarray((corners - middle) / scale)
    rough, _, near, _ = igl.signed_distance(asked, solid, np.ascontiguousarray(triangles), sign_type=kind)
    return (
        np.asarray(np.copysign(np.linalg.norm(asked - near, axis=1), rough)) * scale
    )  # the size of `rough` is not exact


def first_hits(vertices: Array, faces: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Which face each ray meets first (M,), -1 for none, and where: barycentric coordinates (M, 3).

    Rays must start outside of the mesh with nothing behind them: Embree is asked both ways.
    """
    from igl.embree import line_mesh_intersection

    found = line_mesh_intersection(*(np.ascontiguousarray(a) for a in (origins, directions, vertices, faces)))
    return found[:, 0].astype(int), np.column_stack([1 - found[:, 1] - found[:, 2], found[:, 1:]])


def sky_seen(
    vertices: Array, faces: Array, points: Array, normals: Array, *, count: int = SKY, steep: float = 0.05
) -> Array:
    """How much of the half space above each of `points` (M, 3) the mesh leaves open, weighted by slant: (M,) in 0..1.

    Asked from outside, so that a point on the mesh does not stand in its own light. `count` directions are asked all
    around, of which those less `steep` than that are left out.
    """
    directions = _even(count)
    slant = np.clip(normals @ directions.T, 0, None)  # (M, count)
    slant[slant <= steep] = 0
    which, along = np.nonzero(slant)
    towards = directions[along]
    face, weight = first_hits(vertices, faces, points[which] + FAR * towards, -towards)
    hit = np.einsum("mk,mkc->mc", weight, vertices[faces[np.maximum(face, 0)]])
    above = np.einsum("mc,mc->m", hit - points[which], towards)
    free = (face < 0) | (above < SKIN)
    total = np.bincount(which, slant[which, along], len(points))
    open_ = np.bincount(which, slant[which, along] * free, len(points))
    return np.asarray(np.divide(open_, total, out=np.ones(len(points)), where=total > 0))


def spread_over(shape: Drawn, count: int) -> Array:
    """`count` points [user's unit] spread over the surface by area, the same ones each time: (count, 3)."""
    corners = shape.points[shape.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    upto = np.cumsum(area)
    chosen = np.searchsorted(upto, (np.arange(count) + 0.5) / count * upto[-1])
    return np.asarray(corners[np.minimum(chosen, len(corners) - 1)].mean(1))


def as_mesh(shape: Drawn) -> Trimesh:
    """The drawn surface as a mesh [user's unit]."""
    from trimesh import Trimesh

    return Trimesh(shape.points, shape.faces, process=False)


def _simplified(vertices: Array, faces: Array, most: int) -> tuple[Array, Array]:
    """At most `most` faces; where there are few, each divided into four, since colours live at the vertices."""
    if len(faces) <= most:
        from igl import upsample

        while len(faces) * 4 <= min(most, FINE):
            vertices, faces = upsample(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
        return vertices, np.asarray(faces, np.int64)
    from fast_simplification import simplify

    light, fewer = simplify(vertices, faces, target_count=most)
    return np.asarray(light, float), np.asarray(fewer, np.int64)


def _even(count: int) -> Array:
    """`count` directions spread evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])


def _face_normals(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Unit normals (F, 3) and areas times two (F,)."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(size, 1e-30)[:, None], size


def _vertex_normals(vertices: Array, faces: Array) -> Array:
    normals, area = _face_normals(vertices, faces)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], normals * area[:, None])
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30))


def _creased(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Vertices doubled along creases: which old vertex each new one is (V,), their normals (V, 3), the new faces.

    A corner's normal is the mean, by area, of those faces around its vertex that meet its own at a small angle.
    """
    normals, area = _face_normals(vertices, faces)
    vertex = faces.ravel()
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(vertices))
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    mates = np.where(count[vertex] <= CROWDED, count[vertex], 0)
    one = np.repeat(np.arange(len(vertex)), mates)
    step = np.arange(len(one)) - np.repeat(np.cumsum(mates) - mates, mates)
    other = order[start[vertex[one]] + step] // 3
    smooth = np.einsum("mc,mc->m", normals[one // 3], normals[other]) > CREASE
    one, other = one[smooth], other[smooth]
    weight = (normals * area[:, None])[other]
    total = np.stack([np.bincount(one, weight[:, k], len(vertex)) for k in range(3)], 1)
    size = np.linalg.norm(total, axis=1)
    flat = size < 1e-30
    total[flat] = np.repeat(normals, 3, 0)[flat]
    total = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    rows = np.column_stack([vertex, np.round(total * 64).astype(np.int64)])
    _, first, split = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return vertex[first], total[first], split.reshape(-1, 3)
