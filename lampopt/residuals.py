"""How well a bank's decoder reproduces its exemplars: both ways, what is turned over, where it is worst."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.errors import InputError
from lampopt.holdout import own
from lampopt.metrics import sample_surface
from lampopt.plugins import Plugins
from lampopt.protocols import Progress
from lampopt.types import Array, Bank, Exemplars
from lampopt.units import whole

if TYPE_CHECKING:
    from trimesh import Trimesh

SAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class Residual:
    """One exemplar's decoded shape against its mesh [bank's length unit].

    Parameters
    ----------
    name
        The exemplar's.
    there, back
        Mean distance from the decoded shape to the mesh, and from the mesh to the decoded shape.
    p99, worst
        99th percentile and largest of all distances, both ways.
    where
        (3,) the place of the worst, on either surface.
    flipped
        Triangles of the decoded shape that face against the mesh where it is nearest.
    """

    name: str
    there: float
    back: float
    p99: float
    worst: float
    where: Array
    flipped: int


def residuals(
    bank: Bank,
    exemplars: Exemplars,
    *,
    resolution: int = 128,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> tuple[Residual, ...]:
    """How far each exemplar's decoded shape is from its mesh, in the bank's order.

    Parameters
    ----------
    exemplars
        What the bank was built from, mended as they were then; or finer or altered meshes of the same.
    resolution
        Cells along the box, for decoders that have to extract a surface.

    Raises
    ------
    InputError
        If an exemplar of the bank is not among `exemplars`, they are others in unit or parameters, or no meshes.
    EmptyMesh
        If an exemplar's weights have no surface.
    """
    if not isinstance(exemplars, Exemplars):
        raise InputError(f"exemplars: expected Exemplars, got {exemplars!r:.80}")
    resolution = whole(resolution, "resolution", 4, 4096)
    exemplars = own(bank, exemplars, altered=True)
    decoder = decoder_of(bank, plugins or Plugins.load().report())
    found = []
    for number, name in enumerate(bank.names):
        if progress:
            progress(number / len(bank), name)
        made = decode(bank, decoder, np.asarray(bank.weights[number]), resolution=resolution)
        found.append(_residual(name, made, exemplars.meshes[number]))
    if progress:
        progress(1.0, f"{len(bank)} exemplars")
    return tuple(found)


def _residual(name: str, made: Trimesh, given: Trimesh) -> Residual:
    there, here, _ = _away(sample_surface(made, SAMPLES), given)
    back, points, _ = _away(sample_surface(given, SAMPLES), made)
    both, places = np.concatenate([there, back]), np.concatenate([here, points])
    _, _, nearest = _away(np.asarray(made.triangles_center), given)
    against = (np.asarray(made.face_normals) * np.asarray(given.face_normals)[nearest]).sum(1)
    worst = int(both.argmax())
    return Residual(
        name,
        float(there.mean()),
        float(back.mean()),
        float(np.percentile(both, 99)),
        float(both[worst]),
        places[worst],
        int((against < 0).sum()),
    )


def _away(points: Array, mesh: Trimesh) -> tuple[Array, Array, Array]:
    """Distances (M,) of points (M, 3) to `mesh`, the points, and the faces (M,) that they are nearest to."""
    import igl

    squared, faces, _ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, float), np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    )
    return np.sqrt(squared), points, np.asarray(faces)
