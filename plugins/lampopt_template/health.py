"""Whether a moved template is still a sound surface: what folds, flips, crosses itself, or is stretched to slivers."""

from __future__ import annotations

import numpy as np

from lampopt.intersections import self_intersections
from lampopt.types import Array, Check
from lampopt_template.surface import Surface
from lampopt_template.template import Template

MANY = 1000
WORST = 1.0  # percent of triangles that are looked at when their shape is judged
LEAST = 0.05  # volume that a place keeps at least, in parts of what it was: near 0 space folds
FLIPPED = 1e-4  # share of the area that may be turned over: a sliver or two, where the surface is creased
FORMED = 0.4  # quality of triangles that is left at least, in parts of the exemplars'


def least_quality(vertices: Array, faces: Array) -> float:
    """How well formed the worst hundredth of the triangles is at best: 1 equilateral, 0 without area."""
    return float(np.percentile(qualities(vertices, faces), WORST))


def qualities(vertices: Array, faces: Array) -> Array:
    """(F,) how well formed triangles are: 4 √3 area / Σ edge² (Bank and Smith 1997)."""
    corners = vertices[faces]
    squares = ((corners - np.roll(corners, 1, 1)) ** 2).sum((1, 2))
    return np.asarray(4 * np.sqrt(3) * Surface(vertices, faces).areas / np.where(squares > 0, squares, 1.0))


def gradients(template: Template, weights: Array, points: Array) -> Array:
    """(M, 3, 3) derivatives ∂x_i/∂X_j of where the lattice moves `points` (M, 3) to."""
    coefficients, _ = template.parts(weights)
    parts = [template.space.rows(points, derivative=axis) @ coefficients for axis in range(3)]
    return np.asarray(np.eye(3) + np.stack(parts, -1))


def health_checks(template: Template, weights: Array, vertices: Array) -> list[Check]:
    """The evidence about a design's `vertices` (V, 3) [box]."""
    faces = template.surface.faces
    centres = template.surface.vertices[faces].mean(1)
    motion = gradients(template, weights, centres)
    volume = np.linalg.det(motion)
    # Under a motion of space a normal n turns to det(F) F⁻ᵀ n, the cofactors of F applied to it.
    turned = np.einsum("fij,fj->fi", _cofactors(motion), template.surface.normals)
    moved = Surface(vertices, faces)
    over = (turned * moved.normals).sum(1) <= 0
    flipped = float(moved.areas[over].sum() / max(moved.areas.sum(), 1e-300))
    worst = vertices[faces[int(volume.argmin())]].mean(0)
    least = "least volume ratio of the motion, at " + ", ".join(f"{x:.3f}" for x in worst) + " [box]"
    against = f"share of the area ({over.sum()} faces) against the motion"
    return [
        Check("jacobian", float(volume.min()), ">=", LEAST, "", "mesh", least),
        Check("flipped", flipped, "<=", FLIPPED, "", "mesh", against),
        *surface_checks(moved, template.quality),
    ]


def surface_checks(
    surface: Surface, quality: float, sound: Array | slice = slice(None), crossing: int = 0
) -> list[Check]:
    """Whether `surface` passes through itself, and how well formed its triangles are, beside exemplars' own values.

    Parameters
    ----------
    surface
        A design's.
    quality
        `least_quality` of exemplars, over the `sound` faces.
    sound
        (F,) which faces count.
    crossing
        How many pairs of faces pass through each other on exemplars.
    """
    formed = least_quality(surface.vertices, surface.faces[sound]) / max(quality, 1e-12)
    note = "faces that pass through each other"
    return [
        Check("crossing", float(crossings(surface)), "<=", float(crossing), "pairs", "mesh", note),
        Check("quality", formed, ">=", FORMED, "", "mesh", "of the worst hundredth of triangles, by the exemplars'"),
    ]


def crossings(surface: Surface) -> int:
    """Pairs of faces that pass through each other, counted up to `MANY`."""
    from trimesh import Trimesh

    return len(self_intersections(Trimesh(surface.vertices, surface.faces, process=False), most=MANY))


def _cofactors(matrices: Array) -> Array:
    """(M, 3, 3) the cofactors of (M, 3, 3)."""
    a, b, c = matrices.transpose(1, 0, 2)
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)
