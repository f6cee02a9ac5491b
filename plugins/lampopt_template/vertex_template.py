"""Decoder `vertex-template`: exemplars that share one connectivity, mixed vertex by vertex.

Where one mesh was deformed into all exemplars, or one program has made them, vertices correspond already: nothing is
fitted and nothing lost. Blanz and Vetter 1999 call it a morphable model.
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
from lampopt_template.health import FLIPPED, crossings, least_quality, qualities, surface_checks
from lampopt_template.surface import Surface
from lampopt_template.template import FADE, called, dying

if TYPE_CHECKING:
    from trimesh import Trimesh

ARRAYS = ("vertices", "faces", "sound", "quality", "crossing")
TOLD = 5  # meshes that are named in one message
SOUND = 1e-3  # quality of a triangle below which it has no shape to be judged by: at poles, at sharp edges
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

    def prepare(self, meshes: Sequence[Trimesh], *, mean: Trimesh, seed: int) -> Shared:
        """The mean's `vertices` (V, 3) and `faces` (F, 3), and what exemplars are themselves.

        `sound` (F,) says which triangles have a shape on all of them, `quality` how well formed these are at least,
        `crossing` how many pairs of faces pass through each other at most.

        Raises
        ------
        FitError
            Where the mean is open, or exemplars have other triangles than it, naming them.
        """
        if topology(mean).genus is None:
            raise FitError(
                f"{called(mean)}: expected a closed mesh as the template's, got one that is open: close it, or merge "
                "vertices that coincide"
            )
        template = Surface.of(mean, every=True)
        _refuse(template, meshes, f"{called(mean)}, the mean exemplar")
        vertices = [template.vertices, *(np.asarray(mesh.vertices, float) for mesh in meshes)]
        sound = np.min([qualities(at, template.faces) for at in vertices], axis=0) > SOUND
        if not sound.any():
            raise FitError(f"{called(mean)}: expected triangles with an area on every exemplar, got none")
        return {
            "vertices": template.vertices,
            "faces": template.faces.astype(np.int32),
            "sound": sound,
            "quality": np.array([min(least_quality(at, template.faces[sound]) for at in vertices)]),
            "crossing": np.array([max(crossings(Surface(at, template.faces)) for at in vertices)]),
        }

    def corresponds(self, shared: Shared, mesh: Trimesh) -> bool:
        """Whether a mesh has the template's vertices and triangles, in whatever order triangles are listed."""
        return _corresponds(_of(shared), mesh)

    def fit(
        self, shared: Shared, meshes: Sequence[Trimesh], *, seed: int, progress: Progress | None = None
    ) -> tuple[Array, Array]:
        """Weights (n, 3 V), and the mean distances (n,) [box] by which rounding moves vertices.

        Raises
        ------
        FitError
            Where meshes have other triangles than the template, naming them.
        """
        template = _of(shared)
        _refuse(template, meshes, "the template")
        moved = np.array([np.asarray(mesh.vertices) for mesh in meshes]) - template.vertices
        weights = moved.astype(np.float32)
        if progress:
            progress(1.0, "fitted")
        return weights.reshape(len(moved), -1), np.linalg.norm(weights - moved, axis=-1).mean(1)

    def evaluate(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Where points (M, 3) of the template go to (..., M, 3) by weights (..., 3 V)."""
        template, points = _of(shared), _checked(points)
        moved, near = _displacements(template, weights), template.near(points)
        corners = moved[..., template.faces[near.faces], :]
        return np.asarray(points + np.einsum("mk,...mkc->...mc", near.weights, corners))

    def decode(self, shared: Shared, weights: Array, *, resolution: int) -> Trimesh:
        """The moved template [box]. It has the exemplars' triangles, whatever the `resolution`."""
        from trimesh import Trimesh

        template = _of(shared)
        vertices = template.vertices + _displacements(template, weights, single=True)
        if not np.isfinite(vertices).all():
            raise EmptyMesh("the weights move vertices to where there are no numbers; mix nearer to the exemplars")
        return Trimesh(vertices, template.faces, process=False)

    def probes(self, shared: Shared, count: int, seed: int) -> Array:
        """(count, 3) points drawn evenly on the template."""
        return _of(shared).drawn(count, np.random.default_rng(seed))

    def pullback(self, shared: Shared, weights: Array, mesh: Trimesh, gradient: Array) -> Array:
        """(3 V,) derivatives by the weights of what has `gradient` (V, 3) by the vertices: the same numbers."""
        template, gradient = _of(shared), np.asarray(gradient, float)
        _displacements(template, weights, single=True)
        if gradient.shape != template.vertices.shape:
            raise InputError(f"gradient: expected shape {template.vertices.shape}, got {gradient.shape}")
        return gradient.ravel()

    def displace(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Points (M, 3) of the space around the template moved along; far from it they stay.

        Means of all vertices' displacements by their areas and inverse distances (Luke, Collins and Blades 2012, "A
        fast mesh deformation method using explicit interpolation"), brought to the surface's own displacement on it.
        """
        template, moved = _of(shared), _checked(points).copy()
        displacements, size = _displacements(template, weights, single=True), float(np.ptp(template.vertices, 0).max())
        near = template.near(moved)
        own = np.einsum("mk,mkc->mc", near.weights, displacements[template.faces[near.faces]])
        away = np.linalg.norm(moved - near.points, axis=1) / size
        for place in _blocks(np.flatnonzero(away < FADE), len(template.vertices)):
            motion = _means(template, displacements, moved[place], size)
            close = away[place] < STEEP
            at = place[close]
            gap = own[at] - _means(template, displacements, near.points[at], size)
            motion[close] += dying(away[at] / STEEP)[:, None] * gap
            moved[place] += dying(away[place] / FADE)[:, None] * motion
        return moved

    def design_checks(self, shared: Shared, weights: Array, mesh: Trimesh) -> Sequence[Check]:
        """Whether the moved template is a sound surface."""
        template, moved = _of(shared), Surface(mesh.vertices, mesh.faces)
        over = (template.normals * moved.normals).sum(1) < 0
        flipped = float(moved.areas[over].sum() / max(moved.areas.sum(), 1e-300))
        note = f"share of the area ({over.sum()} faces) against the template's"
        return [
            Check("flipped", flipped, "<=", FLIPPED, "", "mesh", note),
            *surface_checks(moved, float(shared["quality"][0]), shared["sound"], int(shared["crossing"][0])),
        ]


def _refuse(template: Surface, meshes: Sequence[Trimesh], expected: str) -> None:
    """FitError naming all `meshes` that have other triangles than the template, which is called `expected`."""
    others = [mesh for mesh in meshes if not _corresponds(template, mesh)]
    if others:
        told = ", ".join(f"{called(m)} {len(m.vertices)} in {len(m.faces)} of its own" for m in others[:TOLD])
        raise FitError(
            f"vertices do not correspond to those of {expected}: expected {len(template.vertices)} in the same "
            f"{len(template.faces)} triangles, got {told}{', …' if len(others) > TOLD else ''}: the file format or a "
            "repair may have joined or renumbered some; take decoder 'mesh-template'"
        )


def _corresponds(template: Surface, mesh: Trimesh) -> bool:
    faces = Surface.of(mesh, every=True).faces
    if len(mesh.vertices) != len(template.vertices) or faces.shape != template.faces.shape:
        return False
    return np.array_equal(faces, template.faces) or np.array_equal(_listed(faces), _listed(template.faces))


def _listed(faces: Array) -> Array:
    """The same triangles (F, 3) in one order, each from its lowest vertex on."""
    faces = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    return np.asarray(faces[np.lexsort(faces.T)])


def _of(shared: Shared) -> Surface:
    if missing := [name for name in ARRAYS if name not in shared]:
        raise InputError(f"shared: expected {', '.join(ARRAYS)}, got none of {', '.join(missing)}")
    return Surface(shared["vertices"], shared["faces"])


def _checked(points: Array) -> Array:
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: expected shape (M, 3), got {points.shape}")
    if not np.isfinite(points).all():
        raise InputError("points: expected finite numbers, got others")
    return points


def _displacements(template: Surface, weights: Array, *, single: bool = False) -> Array:
    """(..., V, 3) from weights (..., 3 V), or from a `single` row of them."""
    weights, count = np.asarray(weights, float), template.vertices.size
    if weights.shape[-1:] != (count,) or (single and weights.ndim != 1):
        raise InputError(f"weights: expected {count} for this template, got shape {weights.shape}")
    return weights.reshape(*weights.shape[:-1], -1, 3)


def _blocks(places: Array, vertices: int) -> list[Array]:
    return np.array_split(places, max(1, -(-len(places) * vertices // PAIRS)))


def _means(template: Surface, displacements: Array, points: Array, size: float) -> Array:
    """(M, 3) means of displacements (V, 3) at points (M, 3), weighted by areas over distances r³ and r⁵."""
    from scipy.spatial.distance import cdist

    nearness = 1 / np.maximum(cdist(points, template.vertices, "sqeuclidean") / size**2, NEXT_TO**2)
    pull = template.vertex_areas * nearness * np.sqrt(nearness) * (1 + STEEP**5 * nearness)
    return np.asarray(pull @ displacements / pull.sum(1, keepdims=True))
