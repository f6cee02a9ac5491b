"""Decoder `vertex-template`: exemplars that share one connectivity, mixed vertex by vertex.

Where one mesh was deformed into all exemplars, or one program has made them, vertices correspond already: nothing is
fitted, nothing lost, and a bank takes as long as it takes to write it. Blanz and Vetter 1999 call it a morphable model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import EmptyMesh, FitError, InputError
from lampopt.protocols import Progress, Shared
from lampopt.topology import topology
from lampopt.types import Array, Check
from lampopt_template.health import FLIPPED, least_quality, surface_checks
from lampopt_template.surface import Surface
from lampopt_template.template import FADE, dying

if TYPE_CHECKING:
    from trimesh import Trimesh

PAIRS = 2_000_000  # of points and vertices that are looked at in one go: bounds the memory
STEEP = 0.1  # of the template's size, within which the nearest vertices alone count (Luke et al.: 0.1 to 0.25)
NEXT_TO = 1e-6  # of its size: a point nearer to a vertex goes where it goes


@dataclass(frozen=True)
class VertexTemplate:
    """The mean exemplar's mesh; weights are the displacements of its vertices, exact to single precision."""

    @property
    def bounds(self) -> Array:
        """(2, 3): the box [-1, 1]³."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    @property
    def corresponding(self) -> bool:
        """Exemplars have to share one connectivity."""
        return True

    def prepare(self, meshes: Sequence[Trimesh], *, mean: Trimesh, seed: int) -> Shared:
        """The mean's `vertices` (V, 3) and `faces` (F, 3), and the least `quality` of triangles on exemplars.

        Raises
        ------
        FitError
            Where the mean is open, or an exemplar has other triangles than it, naming it.
        """
        if topology(mean).genus is None:
            raise FitError(f"{_called(mean)}: expected a closed mesh as the template's, got one that is open: close it")
        template = Surface(mean.vertices, _outward(mean))
        quality = min(least_quality(self._vertices(template, mesh), template.faces) for mesh in (mean, *meshes))
        return {
            "vertices": template.vertices,
            "faces": template.faces.astype(np.int32),
            "quality": np.array([quality]),
        }

    def fit(
        self, shared: Shared, meshes: Sequence[Trimesh], *, seed: int, progress: Progress | None = None
    ) -> tuple[Array, Array]:
        """Weights (n, 3 V), and the mean distances (n,) [box] by which rounding moves vertices.

        Raises
        ------
        FitError
            Where a mesh has other triangles than the template, naming it.
        """
        template = _of(shared)
        moved = np.array([self._vertices(template, mesh) for mesh in meshes]) - template.vertices
        weights = moved.astype(np.float32)
        if progress:
            progress(1.0, "fitted")
        return weights.reshape(len(moved), -1), np.linalg.norm(weights - moved, axis=-1).mean(1)

    def evaluate(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Where points (M, 3) of the template go to (..., M, 3) by weights (..., 3 V)."""
        points = np.asarray(points, float)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points: expected shape (M, 3), got {points.shape}")
        template = _of(shared)
        moved, near = _displacements(template, weights), template.near(points)
        corners = moved[..., template.faces[near.faces], :]
        return np.asarray(points + np.einsum("mk,...mkc->...mc", near.weights, corners))

    def decode(self, shared: Shared, weights: Array, *, resolution: int) -> Trimesh:
        """The moved template [box]. It has the exemplars' triangles, whatever the `resolution`."""
        from trimesh import Trimesh

        template = _of(shared)
        vertices = template.vertices + _displacements(template, weights)
        if not np.isfinite(vertices).all():
            raise EmptyMesh("the weights move vertices to where there are no numbers; mix nearer to the exemplars")
        return Trimesh(vertices, template.faces, process=False)

    def probes(self, shared: Shared, count: int, seed: int) -> Array:
        """(count, 3) points drawn evenly on the template."""
        return _of(shared).drawn(count, np.random.default_rng(seed))

    def pullback(self, shared: Shared, weights: Array, mesh: Trimesh, gradient: Array) -> Array:
        """(3 V,) derivatives by the weights of what has `gradient` (V, 3) by the vertices: the same numbers."""
        gradient = np.asarray(gradient, float)
        if gradient.shape != (wanted := _of(shared).vertices.shape):
            raise InputError(f"gradient: expected shape {wanted}, got {gradient.shape}")
        return gradient.ravel()

    def displace(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Points (M, 3) of the space around the template moved along; far from it they stay.

        Means of all vertices' displacements by their areas and inverse distances (Luke, Collins and Blades 2012, "A
        fast mesh deformation method using explicit interpolation"), which are the surface's own on it.
        """
        template, moved = _of(shared), np.array(points, float)
        displacements, size = _displacements(template, weights), float(np.ptp(template.vertices, axis=0).max())
        step = max(1, PAIRS // len(template.vertices))
        for first in range(0, len(moved), step):
            block = moved[first : first + step]
            away = np.maximum(np.linalg.norm(block[:, None] - template.vertices, axis=-1) / size, NEXT_TO)
            pull = template.vertex_areas * (away**-3 + (STEEP / away) ** 5)
            near = dying(away.min(1) / FADE)[:, None]
            block += near * (pull @ displacements) / pull.sum(1, keepdims=True)
        return moved

    def design_checks(self, shared: Shared, weights: Array, mesh: Trimesh) -> Sequence[Check]:
        """Whether the moved template is a sound surface."""
        template, moved = _of(shared), Surface(mesh.vertices, mesh.faces)
        over = (template.normals * moved.normals).sum(1) < 0
        flipped = float(moved.areas[over].sum() / max(moved.areas.sum(), 1e-300))
        note = f"share of the area ({over.sum()} faces) against the template's"
        return [
            Check("flipped", flipped, "<=", FLIPPED, "", "mesh", note),
            *surface_checks(moved, float(shared["quality"][0])),
        ]

    def _vertices(self, template: Surface, mesh: Trimesh) -> Array:
        """(V, 3) those of a mesh of the template's connectivity."""
        faces = _outward(mesh)
        if len(mesh.vertices) != len(template.vertices) or not np.array_equal(faces, template.faces):
            raise FitError(
                f"{_called(mesh)}: expected the mean exemplar's {len(template.vertices)} vertices in its "
                f"{len(template.faces)} triangles, got {len(mesh.vertices)} in {len(faces)}"
                f"{' others' if len(faces) == len(template.faces) else ''}: vertices do not correspond; take decoder "
                "'mesh-template'"
            )
        return np.asarray(mesh.vertices, float)


def _of(shared: Shared) -> Surface:
    if missing := [name for name in ("vertices", "faces", "quality") if name not in shared]:
        raise InputError(f"shared: expected vertices, faces and quality, got none of {', '.join(missing)}")
    return Surface(shared["vertices"], shared["faces"])


def _displacements(template: Surface, weights: Array) -> Array:
    """(..., V, 3) from weights (..., 3 V)."""
    weights, count = np.asarray(weights, float), template.vertices.size
    if weights.shape[-1:] != (count,):
        raise InputError(f"weights: expected {count} for this template, got shape {weights.shape}")
    return weights.reshape(*weights.shape[:-1], -1, 3)


def _outward(mesh: Trimesh) -> Array:
    """(F, 3) the faces, turned where a closed mesh is inside out."""
    return Surface.of(mesh).faces


def _called(mesh: Trimesh) -> str:
    return str(mesh.metadata.get("name", "a mesh"))
