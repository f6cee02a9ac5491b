"""Mesh files: read whole into memory, coinciding vertices joined."""

from __future__ import annotations

from math import ceil, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb")  # that are read
FORMATS = ("stl", "obj", "ply", "glb")  # that are written


def load_mesh(path: str | Path) -> Trimesh:
    """The mesh in a file, coinciding vertices joined; a scene becomes one mesh, its transforms applied.

    Coordinates are taken as they stand, whatever unit or upward axis the format has by convention.

    Raises
    ------
    InputError
        If the file cannot be read, has no faces, a vertex is not finite, a face has a corner that is no vertex, or the
        size is beyond 1e-100 to 1e100; the file is named.
    """
    import trimesh

    path = Path(path)
    mesh: Trimesh
    try:
        # An open file instead of its path: what a mesh file names beside itself (materials, textures) is not followed.
        with path.open("rb") as file:
            mesh = trimesh.load_scene(file, file_type=path.suffix[1:].lower(), process=False).to_mesh()
    except Exception as error:  # whatever a stranger's file does to a reader
        raise InputError(f"mesh {path}: cannot be read: {error}") from error
    if len(mesh.faces) == 0:
        raise InputError(f"mesh {path}: expected faces, got none; points or lines alone make no exemplar")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"mesh {path}: expected finite vertices, got some that are not")
    if not indexed(mesh):
        raise InputError(
            f"mesh {path}: expected faces whose corners are 0 to {len(mesh.vertices) - 1}, got {mesh.faces.min()} to "
            f"{mesh.faces.max()}: the file is damaged"
        )
    try:
        join(mesh)
    except InputError as error:
        raise InputError(f"mesh {path}: {error}") from error
    return mesh


def indexed(mesh: Trimesh) -> bool:
    """Whether every corner of every face is one of the vertices."""
    corners = np.asarray(mesh.faces)
    return corners.size == 0 or bool(corners.min() >= 0 and corners.max() < len(mesh.vertices))


def join(mesh: Trimesh) -> None:
    """Join the vertices of `mesh` that coincide to nine digits of its size, as far as its coordinates hold so many.

    Raises
    ------
    InputError
        If the largest coordinate is beyond 1e-100 to 1e100.
    """
    reach = float(np.abs(mesh.vertices).max())
    if not 1e-100 <= reach <= 1e100:
        raise InputError(f"expected a largest coordinate from 1e-100 to 1e100, got {reach:.3g}")
    # A float, since trimesh takes a power of it: that of a negative or a large whole number fails.
    size = float(np.ptp(mesh.vertices, axis=0).max()) or reach
    digits: Any = float(min(9 - ceil(log10(size)), 15 - ceil(log10(reach))))
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=digits)
