"""Mesh files: read whole into memory, coinciding vertices joined."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

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
        If the file cannot be read, has no faces, or a vertex is not finite; the file is named.
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
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh
