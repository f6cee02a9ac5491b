"""Loose specks: bodies too small to be meant, such as what a coarse re-meshing pinches off a thin part."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from trimesh import Trimesh

SPECK = 1e-3  # of the area, below which a body is none
log = logging.getLogger("lampopt")


def without_specks(mesh: Trimesh) -> Trimesh:
    """`mesh` without its bodies of less than SPECK of the area; itself where there are none."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    pairs = np.asarray(mesh.face_adjacency)
    links = csr_array((np.ones(len(pairs), bool), pairs.T), (len(mesh.faces),) * 2)
    body = connected_components(links, directed=False)[1]
    areas = np.bincount(body, mesh.area_faces)
    small = areas < SPECK * areas.sum()
    if not small.any():
        return mesh
    log.warning("%s: %d loose specks are left out", mesh.metadata.get("name", "a mesh"), small.sum())
    kept = mesh.copy()
    kept.update_faces(~small[body])
    kept.remove_unreferenced_vertices()
    return kept
