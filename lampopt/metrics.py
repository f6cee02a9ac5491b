"""How generated shapes are scored: as the paper's appendix G defines it, and by a length. No design is judged here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

FEW = 8  # columns in which a tree is quicker than looking at all pairs
DEVIATIONS = 6  # of a random mixture: farther apart are no two rows within one of each other


def sample_surface(mesh: Trimesh, count: int, seed: int = 0) -> Array:
    """(count, 3) points drawn evenly over the surface [mesh unit]."""
    import trimesh

    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0], float)


def _cloud(points: Array, name: str) -> Array:
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"{name}: expected points of shape (n, 3), n ≥ 1, got {points.shape}")
    return points


def chamfer_distance(x: Array, y: Array) -> float:
    """Mean squared distance from each point of `x` (n, 3) to the nearest of `y` (m, 3), plus the reverse [unit²]."""
    from scipy.spatial import KDTree

    x, y = _cloud(x, "x"), _cloud(y, "y")
    there, back = KDTree(y).query(x)[0], KDTree(x).query(y)[0]
    return float((there**2).mean() + (back**2).mean())


def surface_distance(a: Trimesh, b: Trimesh, samples: int = 20_000, seed: int = 0) -> float:
    """How far two surfaces are apart [mesh unit]: the larger of the two mean distances from one to the other.

    Unlike `chamfer_distance` it is a length, and does not depend on how densely the surfaces are sampled.

    Raises
    ------
    InputError
        If one has no faces.
    """
    import igl

    if not (len(a.faces) and len(b.faces)):
        raise InputError(f"surface distance: expected meshes with faces, got {len(a.faces)} and {len(b.faces)}")

    def directed(start: Trimesh, end: Trimesh) -> float:
        points = sample_surface(start, samples, seed)
        corners = np.asarray(end.vertices, float), np.asarray(end.faces, np.int64)
        return float(np.sqrt(igl.point_mesh_squared_distance(points, *corners)[0]).mean())

    return max(directed(a, b), directed(b, a))


def iou(a: Trimesh, b: Trimesh, resolution: int = 64) -> float:
    """|A ∩ B| / |A ∪ B| of the solids on `resolution` voxels along the longest side of their common box.

    Inside is told by the winding number, so surfaces with small holes are judged too.

    Raises
    ------
    InputError
        If one has no faces, or holds no voxel.
    """
    import igl

    if not (len(a.faces) and len(b.faces)):
        raise InputError(f"iou: expected meshes with faces, got {len(a.faces)} and {len(b.faces)}")
    low = np.minimum(a.bounds[0], b.bounds[0])
    size = np.maximum(a.bounds[1], b.bounds[1]) - low
    pitch = float(size.max()) / resolution
    axes = [l + pitch * (np.arange(max(int(np.ceil(s / pitch)), 1)) + 0.5) for l, s in zip(low, size, strict=True)]  # noqa: E741
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    middle, scale = low + size / 2, float(size.max())  # digits go to the shapes, not to their place
    queries = (centres - middle) / scale
    inside = [
        igl.fast_winding_number(
            (np.asarray(m.vertices, float) - middle) / scale, np.asarray(m.faces, np.int64), queries
        )
        > 0.5
        for m in (a, b)
    ]
    if empty := [called for called, one in zip(("first", "second"), inside, strict=True) if not one.any()]:
        raise InputError(
            f"iou: no voxel of {pitch:g} lies inside the {' or the '.join(empty)} mesh; are they closed and outward, "
            "and as large as that?"
        )
    union = int((inside[0] | inside[1]).sum())
    return float((inside[0] & inside[1]).sum() / union)


def minimum_matching_distance(
    generated: Sequence[Array], reference: Sequence[Array], distance: Callable[[Array, Array], float] = chamfer_distance
) -> float:
    """Mean over `generated` clouds of the least `distance` to any of `reference` (MMD)."""
    if not generated or not reference:
        raise InputError(f"MMD: expected clouds on both sides, got {len(generated)} and {len(reference)}")
    return float(np.mean([min(distance(x, y) for y in reference) for x in generated]))


def mean_absolute_error(wanted: Array, found: Array) -> float:
    """Mean |found − wanted| (MAE)."""
    wanted, found = _pair(wanted, found)
    return float(np.abs(found - wanted).mean())


def r_squared(wanted: Array, found: Array) -> float:
    """1 − Σ(found − wanted)² / Σ(wanted − mean wanted)²: how well `found` follows `wanted` along the line y = x.

    Raises
    ------
    InputError
        If all wanted values are equal.
    """
    wanted, found = _pair(wanted, found)
    total = float(((wanted - wanted.mean()) ** 2).sum())
    if total == 0:
        raise InputError("R²: expected wanted values that differ, got equal ones")
    return 1 - float(((found - wanted) ** 2).sum()) / total


def conformal_quantile(errors: Array, level: float) -> float:
    """The least size that a new error stays within with probability `level`, if it is drawn as `errors` (n,) were.

    The ⌈level (n + 1)⌉-th smallest of |errors|, infinite where n is too small to promise that (Vovk et al.,
    "Algorithmic learning in a random world", 2005).

    Raises
    ------
    InputError
        If `level` is not between 0 and 1, or an error is not finite.
    """
    sizes = np.sort(np.abs(np.asarray(errors, float)).ravel())
    if not 0 < level < 1:
        raise InputError(f"level: expected a coverage between 0 and 1, such as 0.9, got {level!r}")
    if not np.isfinite(sizes).all():
        raise InputError("errors: expected finite numbers")
    place = int(np.ceil(level * (len(sizes) + 1) - 1e-9))  # 0.9 × 10 is a little more than 9 to a computer
    return float(sizes[place - 1]) if place <= len(sizes) else float("inf")


def twins(rows: Array, apart: float) -> Array:
    """(n,) the number of the group of each row (n, d): rows within `apart` of each other in every column share one.

    What was learned from one of them tells the other: no row may be judged by its twin.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if not rows.shape[1]:
        return np.zeros(len(rows), int)
    different, place = np.unique(rows, axis=0, return_inverse=True)
    seen, reach = different, apart
    if seen.shape[1] > FEW:  # of hundreds of columns a few mixtures tell which pairs there are to be looked at
        seen = seen @ np.random.default_rng(0).normal(size=(seen.shape[1], FEW)) / np.sqrt(seen.shape[1])
        reach = DEVIATIONS * apart
    pairs = KDTree(seen).query_pairs(reach, p=np.inf, output_type="ndarray")
    pairs = pairs[(np.abs(different[pairs[:, 0]] - different[pairs[:, 1]]) <= apart).all(axis=1)]
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(different),) * 2)
    group: Array = connected_components(links, directed=False)[1]
    return group[place.ravel()]


def _pair(wanted: Array, found: Array) -> tuple[Array, Array]:
    wanted, found = np.asarray(wanted, float), np.asarray(found, float)
    if wanted.shape != found.shape or wanted.size == 0:
        raise InputError(f"expected two arrays of one shape, not empty, got {wanted.shape} and {found.shape}")
    return wanted, found
