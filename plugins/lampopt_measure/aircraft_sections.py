"""An aircraft as its half span, and its sections across: the points where they cut the edges of the mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .basic import with_faces

if TYPE_CHECKING:
    from trimesh import Trimesh

MODELS = ("", "half", "whole")
ENDS = np.array([0.05, 0.15, 0.3])  # of the extent across: how far from either end sections are compared
LIKE, UNLIKE = 1.05, 1.5  # ratios of their areas up to which a model may be whole, and from which on it is a half one
ASIDE = 0.05  # of the chord: how far their noses and tails may be apart
TIE = 1e-9  # of the extent across: vertices nearer than this to the outermost one are a tip together
FACING = 0.95  # cosine: faces that close a half model are turned to its plane of symmetry
RIM = 0.01  # of the extent across: and lie nearer than this to its end


@dataclass(frozen=True, eq=False)
class Halves:
    """An aircraft as its half span: from the plane of symmetry to the tip, on one side or on both.

    Parameters
    ----------
    vertices, faces
        (V, 3) [L] and (F, 3).
    low, high
        Vertices (m,) that say where the ends across lie, and their weights (m,), which sum to one.
    sides
        Where the model lies: +1 up the y axis, −1 down it.
    """

    vertices: Array
    faces: Array
    low: tuple[Array, Array]
    high: tuple[Array, Array]
    sides: tuple[int, ...]

    @classmethod
    def of(cls, mesh: Trimesh, model: str = "") -> Halves:
        """`mesh`, x to the rear, y across, z up; without one of `MODELS` a half one is known by its sections' areas.

        A tip lies at its outermost vertices, the plane of symmetry of a half model at the mean of the faces on it.

        Raises
        ------
        EmptyMesh, MeasureError
            If there are no faces, or no extent across.
        """
        vertices, faces = np.asarray(with_faces(mesh).vertices, float), np.asarray(mesh.faces)
        low, high = _outermost(vertices, faces, -1), _outermost(vertices, faces, 1)
        first, last = (float((vertices[rows, 1] * weights).sum()) for rows, weights in (low, high))
        if not last > first:
            raise MeasureError("expected a wing that extends along y, got a flat mesh")
        sections = first + np.array([ENDS, 1 - ENDS, np.full_like(ENDS, 0.5)]) * (last - first)
        areas = _enclosed(vertices, faces, sections.ravel()).reshape(3, -1)
        if model == "whole" or (not model and _is_whole(areas, _chords(vertices, faces, sections))):
            return cls(vertices, faces, low, high, (1, -1))
        if areas[0].sum() >= areas[1].sum():
            return cls(vertices, faces, _cap(vertices, faces, -1) or low, high, (1,))
        return cls(vertices, faces, low, _cap(vertices, faces, 1) or high, (-1,))

    @property
    def span(self) -> float:
        """From the plane of symmetry to the tip [L]."""
        return float((self.across() * self.vertices[:, 1]).sum())

    @property
    def root(self) -> float:
        """y of the plane of symmetry [L]."""
        return float((self.middle() * self.vertices[:, 1]).sum())

    def across(self) -> Array:
        """Weights (V,) of the vertices' y in the half span."""
        return (self._end(self.high) - self._end(self.low)) / len(self.sides)

    def middle(self) -> Array:
        """Weights (V,) of the vertices' y in the place of the plane of symmetry."""
        if len(self.sides) == 2:
            return (self._end(self.low) + self._end(self.high)) / 2
        return self._end(self.low if self.sides[0] > 0 else self.high)

    def _end(self, end: tuple[Array, Array]) -> Array:
        return np.bincount(*end, len(self.vertices))


def _outermost(vertices: Array, faces: Array, side: int) -> tuple[Array, Array]:
    """The vertices farthest out along y on one side, in equal parts."""
    across = side * vertices[:, 1]
    used = np.unique(faces)
    reach = across[used]
    rows = used[reach >= reach.max() - TIE * np.ptp(reach)]
    return rows, np.full(len(rows), 1 / len(rows))


def _cap(vertices: Array, faces: Array, side: int) -> tuple[Array, Array] | None:
    """The corners of the faces that close a half model on one side, by area; None where it is not flat there."""
    reach = side * vertices[:, 1][faces].sum(axis=1) / 3
    near = faces[reach > reach.max() - RIM * np.ptp(reach)]
    a, b, c = (vertices[near[:, k]] for k in range(3))
    twice = side * np.cross(b - a, c - a)
    size = np.linalg.norm(twice, axis=1)
    kept = twice[:, 1] > FACING * size
    if not kept.any():
        return None
    weights = np.bincount(near[kept].ravel(), np.repeat(size[kept], 3), len(vertices))
    rows = np.flatnonzero(weights)
    return rows, weights[rows] / weights.sum()


@dataclass(frozen=True, eq=False)
class Cuts:
    """The m points where sections cut the edges of a mesh; each face cut has two, m/2 rows apart.

    A point lies `share` of the way from the first vertex of its edge to the second one.
    """

    points: Array  # (m, 3) [L]
    edges: Array  # (m, 2) vertices
    share: Array  # (m,)
    section: Array  # (m,) which section each belongs to
    facing: Array  # (m,) whether the face looks up or down: 1, -1; neither: 0


def cuts(vertices: Array, faces: Array, heights: Array) -> Cuts:
    """The sections at y = `heights` (n,). A vertex on one counts as above, so that no case is degenerate."""
    order = np.argsort(heights, kind="stable")
    across = vertices[:, 1]
    a, b, c = (across[faces[:, k]] for k in range(3))
    first = np.searchsorted(heights[order], np.minimum(np.minimum(a, b), c), "right")
    count = np.searchsorted(heights[order], np.maximum(np.maximum(a, b), c), "right") - first
    met = np.flatnonzero(count > 0)
    count, first = count[met], first[met]
    cut = np.repeat(met, count)
    start = np.repeat(first - np.r_[0, np.cumsum(count)[:-1]], count)
    section = order[start + np.arange(len(cut))]
    corners, height = faces[cut], heights[section]
    above = across[corners] >= height[:, None]
    lone = (above == (above.sum(axis=1) == 1)[:, None]).argmax(axis=1)
    rows = np.arange(len(cut))
    p, q, r = (corners[rows, (lone + k) % 3] for k in range(3))
    (px, py), (qx, qy) = (vertices[q] - vertices[p])[:, :2].T, (vertices[r] - vertices[p])[:, :2].T
    facing = np.sign(px * qy - py * qx)
    edges = np.concatenate([np.stack([p, q], axis=1), np.stack([p, r], axis=1)])
    low, high = vertices[edges[:, 0]], vertices[edges[:, 1]]
    share = (np.r_[height, height] - low[:, 1]) / (high[:, 1] - low[:, 1])
    return Cuts(low + share[:, None] * (high - low), edges, share, np.r_[section, section], np.r_[facing, facing])


def _chords(vertices: Array, faces: Array, heights: Array) -> Array:
    """(..., 2) x of nose and tail of the sections at y = `heights` (...,); NaN where there is none."""
    cut = cuts(vertices, faces, heights.ravel())
    by_section = [cut.points[cut.section == k, 0] for k in range(heights.size)]
    found = [[x.min(), x.max()] if len(x) else [np.nan, np.nan] for x in by_section]
    return np.array(found).reshape(*heights.shape, 2)


def _is_whole(areas: Array, chords: Array) -> bool:
    """Whether sections near either end and in the middle, areas (3, n) and chords (3, n, 2), are those of both halves.

    Those of a whole model are mirror images, but for a model that is not quite straight; then what lies between them
    tells: of a half model it is between theirs in size and place.

    Raises
    ------
    MeasureError
        If an untapered half and a whole that is not straight would look the same.
    """
    one, other, middle = areas
    if (np.maximum(one, other) > UNLIKE * np.minimum(one, other)).any():
        return False
    apart = np.abs(chords[0] - chords[1]) > ASIDE * np.ptp(chords[:2], axis=-1).max(axis=0)[:, None]
    if (np.maximum(one, other) > LIKE * np.minimum(one, other)).any():
        return bool(middle[0] > max(one[0], other[0]))
    if not apart.any():
        return True
    beside = np.abs(chords[2] - chords[:2].mean(axis=0)) < np.abs(chords[0] - chords[1]) / 4
    if beside[apart].all():
        raise MeasureError(
            "expected a model that can be told to be half or whole: this may be an untapered half or a whole one that "
            "is not straight: say model='half' or 'whole'"
        )
    return True


def _enclosed(vertices: Array, faces: Array, heights: Array) -> Array:
    """(n,) the areas that sections at y = `heights` (n,) enclose: upper sides less lower ones."""
    cut = cuts(vertices, faces, heights)
    ends = cut.points.reshape(2, -1, 3)
    facing, section = (part[: ends.shape[1]] for part in (cut.facing, cut.section))
    height = ends[:, :, 2].sum(axis=0) / 2 - vertices[:, 2].mean()
    under = facing * np.abs(ends[1, :, 0] - ends[0, :, 0]) * height
    return np.abs(np.bincount(section, under, len(heights)))
