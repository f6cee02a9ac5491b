"""Sizes and topology of any mesh: extents, volume, area, bodies and genus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.meshfile import join
from lampopt.topology import parts, topology
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh


FLAT = 1e-9  # share of all volume below which a part has none
CAVITY = 0.98  # share of a part's faces within another from which on it is a cavity there; what sticks out is none
TIE = 1e-9  # share of a size within which two vertices are equally far out
SMALLEST, LARGEST = 1e-50, 1e50  # sizes whose fifth powers, as moments of inertia are, still are numbers


def with_faces(mesh: Trimesh) -> Trimesh:
    """`mesh` itself, if it has faces between finite vertices.

    Raises
    ------
    EmptyMesh
        If it has no faces.
    MeasureError
        If a vertex is not finite, a face names one that is not there, or the mesh is too large or too small to reckon.
    """
    if len(mesh.faces) == 0:
        raise EmptyMesh("expected a mesh with faces, got one without")
    if not np.isfinite(mesh.vertices).all():
        count = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise MeasureError(f"expected finite vertices, got {count} that are not")
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise MeasureError(f"expected faces between the {len(vertices)} vertices, got one with vertex {wrong}")
    reach = float(np.abs(vertices).max())
    if not SMALLEST < reach < LARGEST and reach:
        raise MeasureError(
            f"expected a largest coordinate from {SMALLEST:g} to {LARGEST:g}, got {reach:.3g}; scale the mesh"
        )
    return mesh


def merged(mesh: Trimesh) -> Trimesh:
    """A copy of `mesh` with coinciding vertices joined, as a file of loose triangles (STL) needs it.

    Raises MeasureError where its size is beyond what can be joined.
    """
    copy = mesh.copy()
    copy.remove_unreferenced_vertices()  # one far away would make the others coincide
    try:
        join(copy)
    except InputError as error:
        raise MeasureError(str(error)) from error
    corners = copy.faces
    copy.update_faces(
        (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    )
    return copy


def watertight(mesh: Trimesh) -> Trimesh:
    """`mesh`, its coinciding vertices joined if need be, when every edge belongs to exactly two faces.

    A mesh that is closed as it stands is not merged: two bodies that touch in a point stay two.

    Raises
    ------
    EmptyMesh, MeasureError
        If it has no faces, or is open.
    """
    if with_faces(mesh).is_watertight:
        return mesh
    closed = merged(mesh)
    if not closed.is_watertight:
        edges, faces = np.unique(closed.edges_sorted, axis=0, return_counts=True)
        loose = int((faces != 2).sum())
        raise MeasureError(
            f"expected a closed mesh, got {loose} of {len(edges)} edges that do not belong to exactly two faces; "
            "repair the mesh first"
        )
    return closed


def solid(mesh: Trimesh, what: str) -> Trimesh:
    """`mesh` as `watertight` gives it, when its faces point outward.

    Raises
    ------
    EmptyMesh, MeasureError
        If it has no faces, is open, or encloses no positive volume; `what` begins the message.
    """
    closed = watertight(mesh)
    if not closed.is_winding_consistent:
        raise MeasureError(f"{what}: expected neighbouring faces to be wound alike, got some that are not")
    if (volume := enclosed_volume(closed)) <= 0:
        raise MeasureError(
            f"{what}: expected faces that point outward, got an enclosed volume of {volume:.6g}; "
            "turn the faces round (mesh.invert())"
        )
    if len(inward := _inward(closed)):
        raise MeasureError(
            f"{what}: expected faces that point outward, got {len(inward)} of its parts inside out, which are no "
            "cavities: turn them round (lampopt intake does)"
        )
    return closed


def _inward(mesh: Trimesh) -> Array:
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    return inside_out(vertices, faces, *shells(vertices, faces))


def shells(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """(F,) the part that each face belongs to, and (parts,) what closed parts enclose; negative if inside out."""
    part = parts(faces)
    corners = vertices[faces]
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    return part, np.bincount(part, (a * np.cross(b, c)).sum(axis=1)) / 6


def inside_out(vertices: Array, faces: Array, part: Array, volume: Array) -> Array:
    """Numbers of the parts, as `shells` has them, that face inward and lie in no other: a cavity lies in one."""
    import igl

    hollow = volume < -FLAT * np.abs(volume).sum()  # a flat flap's sign is rounding
    if not hollow.any():
        return np.empty(0, np.int64)
    solids = np.ascontiguousarray(faces[np.isin(part, np.flatnonzero(volume > 0))])
    suspect = hollow[part]
    within = igl.fast_winding_number(vertices, solids, vertices[faces[suspect]].mean(axis=1)) > 0.5
    inside, every = (np.bincount(part[suspect], each, len(volume)) for each in (within, np.ones(suspect.sum())))
    return np.flatnonzero(hollow & (inside < CAVITY * every))


def enclosed_volume(mesh: Trimesh) -> float:
    """The volume within the faces of a closed mesh, by the divergence theorem about the middle of its box."""
    corners = corners_of(mesh)
    corners = corners - (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
    return float(np.einsum("fc,fc->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


@dataclass(frozen=True)
class Extents:
    """Sizes of the axis-aligned bounding box of the faces: length along x, width along y, height along z."""

    names = ("length", "width", "height")
    units = ("L", "L", "L")

    def __call__(self, mesh: Trimesh) -> Array:
        """Length, width, height (3,). Raises EmptyMesh, and MeasureError where a vertex is not finite."""
        return np.array(with_faces(mesh).extents, float)

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (3, V, 3): those that lie farthest out share it. Raises as a call does."""
        with_faces(mesh)
        vertices = np.asarray(mesh.vertices, float)
        used = np.zeros(len(vertices), bool)
        used[np.asarray(mesh.faces)] = True
        gradient = np.zeros((3, len(vertices), 3))
        for axis, size in enumerate(np.ptp(vertices[used], axis=0)):
            along = vertices[:, axis]
            for sign, end in ((1, along[used].max()), (-1, along[used].min())):
                ends = used & (np.abs(along - end) <= TIE * size)
                gradient[axis, ends, axis] += sign / ends.sum()
        return gradient


@dataclass(frozen=True)
class Volume:
    """Enclosed volume, by the divergence theorem over the faces."""

    names = ("volume",)
    units = ("L^3",)

    def __call__(self, mesh: Trimesh) -> Array:
        """Volume (1,). Raises EmptyMesh; MeasureError where the mesh is open or its faces do not all point outward."""
        return np.array([enclosed_volume(solid(mesh, "volume"))])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (1, V, 3): a third of the faces' area vectors around. Raises as a call does."""
        solid(mesh, "volume")
        corners = corners_of(mesh)
        sixth = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 6
        return by_vertices(np.repeat(sixth[None, :, None], 3, axis=2), mesh)


@dataclass(frozen=True)
class Area:
    """Area of all faces, of open meshes too."""

    names = ("area",)
    units = ("L^2",)

    def __call__(self, mesh: Trimesh) -> Array:
        """Area (1,). Raises EmptyMesh, and MeasureError where a vertex is not finite."""
        return np.array([float(with_faces(mesh).area)])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (1, V, 3); a face of no area has none. Raises as a call does."""
        corners = corners_of(with_faces(mesh))
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, size, out=np.zeros_like(normals), where=size > 0)
        opposite = np.stack([corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)], axis=1)
        return by_vertices(np.cross(normals[:, None], opposite)[None] / 2, mesh)


@dataclass(frozen=True)
class Genus:
    """How many closed surfaces a mesh has, and how many handles (through-holes) on all of them together.

    A cavity is a closed surface too and counts as a body. Counted by `lampopt.topology`, as the checks of a design are.
    """

    names = ("bodies", "genus")
    units = ("", "")

    def __call__(self, mesh: Trimesh) -> Array:
        """Bodies and genus (2,). Raises EmptyMesh, and MeasureError where the mesh is open or not wound alike."""
        found = topology(watertight(mesh))
        if found.genus is None:
            raise MeasureError(
                "genus: expected neighbouring faces to be wound alike, got some that are not; "
                "turn them (mesh.fix_normals())"
            )
        return np.array([found.bodies, found.genus], float)


def by_vertices(by_corners: Array, mesh: Trimesh) -> Array:
    """(p, V, 3) from derivatives by each face's corners (p, F, 3, 3)."""
    faces, count = np.asarray(mesh.faces).ravel(), len(mesh.vertices)
    flat = by_corners.reshape(len(by_corners), -1, 3)
    return np.stack([np.column_stack([np.bincount(faces, part[:, c], count) for c in range(3)]) for part in flat])


def corners_of(mesh: Trimesh) -> Array:
    """(F, 3, 3) the corners of each face."""
    corners: Array = np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)]
    return corners
