"""Mesh files: held against their own words, read whole into memory, coinciding vertices joined.

trimesh's parsers read them, except 3MF. What a file could do to a parser (memory, time, other files) is refused
before, by a guard for each format; of what a parser returns, vertices, faces and places are taken and nothing else.
"""

from __future__ import annotations

import logging
from math import ceil, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile.polygons import folded_back, may_have
from lampopt.reading import brief, content, why

if TYPE_CHECKING:
    from trimesh import Trimesh

    from lampopt.types import Array

SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf", ".dae")  # that are read
FORMATS = ("stl", "obj", "ply", "glb")  # that are written
log = logging.getLogger("lampopt")


def load_mesh(path: str | Path) -> Trimesh:
    """The mesh in a file, coinciding vertices joined; a scene becomes one mesh, its transforms applied.

    Coordinates are taken as they stand, whatever unit or upward axis the format has by convention. Materials, textures
    and buffers in other files are not opened.

    Raises
    ------
    InputError
        If the file cannot be read, is cut short or damaged, would come to far more than it is large, has no faces, a
        vertex is not finite, a face has a corner that is no vertex, or the size is beyond 1e-100 to 1e100; the file is
        named.
    """
    from trimesh import Trimesh

    try:
        data = content(path)
    except InputError as error:
        raise InputError(f"mesh {brief(path)}: cannot be read: {error}") from error
    what, suffix = f"mesh {brief(path)}", Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{what}: cannot be read: expected one of {', '.join(SUFFIXES)}, got suffix {brief(suffix)!r}")
    try:
        vertices, faces = _read(data, suffix)
    except Exception as error:  # whatever a stranger's file does to a reader
        from lampopt.meshfile.guards import recognised

        raise InputError(f"{what}: cannot be read: {why(error)}{recognised(data, suffix)}") from error
    if len(faces) == 0:
        raise InputError(f"{what}: expected faces, got none; points or lines alone make no exemplar")
    if not np.isfinite(vertices).all():
        raise InputError(f"{what}: expected finite vertices, got some that are not")
    mesh = Trimesh(vertices, faces, process=False)
    try:
        join(mesh)
    except InputError as error:
        raise InputError(f"{what}: {error}") from error
    if may_have(data, suffix) and (folded := folded_back(mesh.vertices, mesh.faces)):
        log.warning(
            "%s: %d triangles lie back on their neighbours, as where a polygon that is not convex is cut into a fan: "
            "areas and distances are false there; triangulate it before",
            *(what, folded),
        )
    return mesh


def _read(data: bytes, suffix: str) -> tuple[Array, Array]:
    """Vertices (V, 3) and faces (F, 3) of a file's bytes; raises anything."""
    from lampopt.meshfile.guards import parsed
    from lampopt.meshfile.placing import placed

    with np.errstate(all="ignore"):  # what is not finite is refused by name
        promised, found = parsed(data, suffix)
        vertices, faces = placed(found)
    if len(faces) < promised:
        raise InputError(f"it promises {promised:,} triangles or more, {len(faces):,} could be read: it is damaged")
    return vertices, faces


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
