"""Sections of a wing across its span, and where each one begins and ends along the wind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .basic import with_faces
from .facets import enclosed_area, section, surface

if TYPE_CHECKING:
    from torch import Tensor
    from trimesh import Trimesh

MODELS = ("", "half", "whole")
ENDS = 0.05  # of the extent across: how far from either end sections are compared to tell half models
UNLIKE = 1.5  # ratio of their areas from which on a model is a half one
TIE = 1e-9  # of the extent across: vertices nearer than this to the outermost one are a tip together
FACING = 0.95  # cosine: faces that close a half model are turned to its plane of symmetry
RIM = 0.01  # of the extent across: and lie nearer than this to its end
NOSE = (0.18, 0.92)  # of the chord: where the squared thickness is fitted to find the nose
TAIL = (0.30, 0.92)  # of the chord: where the thickness is fitted to find the tail
FAR = 0.15  # of the chord: a nose or tail found farther from the section's own end than this is none
NEWTON = 8  # steps to the root of a cubic that is near its start
FEWEST = 8  # points that a section is fitted to


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
        first, last = (float(vertices[end[0], 1] @ end[1]) for end in (low, high))
        if not last > first:
            raise MeasureError("expected a wing that extends along y, got a flat mesh")
        areas = [abs(float(enclosed_area(section(mesh, "y", first + s * (last - first))))) for s in (ENDS, 1 - ENDS)]
        if model == "whole" or (not model and max(areas) <= UNLIKE * min(areas)):
            return cls(vertices, faces, low, high, (1, -1))
        if areas[0] >= areas[1]:
            return cls(vertices, faces, _cap(mesh, -1) or low, high, (1,))
        return cls(vertices, faces, low, _cap(mesh, 1) or high, (-1,))

    @property
    def span(self) -> float:
        """From the plane of symmetry to the tip [L]."""
        return float(self.placed()[1])

    def placed(self, vertices: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """y of the plane of symmetry, and the half span, of `vertices` (V, 3) in place of the mesh's own ones."""
        import torch

        corners = torch.from_numpy(self.vertices) if vertices is None else vertices
        low, high = ((corners[rows, 1] * torch.from_numpy(weights)).sum() for rows, weights in (self.low, self.high))
        if len(self.sides) == 2:
            return (low + high) / 2, (high - low) / 2
        return (low if self.sides[0] > 0 else high), high - low


def _outermost(vertices: Array, faces: Array, side: int) -> tuple[Array, Array]:
    """The vertices farthest out along y on one side, in equal parts."""
    across = side * vertices[:, 1]
    used = np.unique(faces)
    reach = across[used]
    rows = used[reach >= reach.max() - TIE * np.ptp(reach)]
    return rows, np.full(len(rows), 1 / len(rows))


def _cap(mesh: Trimesh, side: int) -> tuple[Array, Array] | None:
    """The corners of the faces that close a half model on one side, by area; None where it is not flat there."""
    facets = surface(mesh)
    reach = side * facets.corners[:, :, 1]
    kept = (side * facets.normals[:, 1] > FACING) & (reach.mean(axis=1) > reach.max() - RIM * np.ptp(reach))
    if not kept.any():
        return None
    weights = np.bincount(facets.rows[kept, :, 0].ravel(), np.repeat(facets.size[kept], 3), len(mesh.vertices))
    rows = np.flatnonzero(weights)
    return rows, weights[rows] / weights.sum()


@dataclass(frozen=True, eq=False)
class Edges:
    """Where n sections begin and end along x, and how thick they are: float64 tensors that may follow the vertices."""

    at: Tensor  # (n,) distance from the plane of symmetry [L]
    nose: Tensor  # (n,) x [L]
    tail: Tensor  # (n,) x [L]
    thickness: Tensor  # (n,) the largest extent along z [L]
    fitted: Array  # (n,) whether nose and tail come from the thickness; elsewhere they are the section's own ends


def edges(halves: Halves, at: Array, vertices: Tensor | None = None) -> Edges:
    """Nose and tail of the sections at shares `at` (n,) of the half span, on each side that there is.

    Facets cut a round nose short and lose a thin tail; both are found from the thickness where there is some. It is √s
    times a smooth function of s, the way from the nose, ahead of an airfoil's tail (Kulfan's class function). So its
    square is fitted by a cubic, whose root is the nose, and it over √s by a straight line, whose root is the tail.

    Parameters
    ----------
    vertices
        (V, 3) float64, in place of the mesh's own ones: what is returned then follows them.
    """
    import torch

    corners = torch.from_numpy(halves.vertices) if vertices is None else vertices
    root, span = halves.placed(corners)
    away = torch.from_numpy(np.repeat(at, len(halves.sides))) * span
    heights = root + away * torch.tensor(halves.sides * len(at), dtype=torch.float64)
    parts = [_cut(halves, height) for height in heights.tolist()]
    rows = np.concatenate([rows for rows, _ in parts])
    facing = np.concatenate([facing for _, facing in parts])
    which = np.repeat(np.arange(len(parts)), [len(rows) for rows, _ in parts])
    a, b = corners[rows[:, 0]], corners[rows[:, 1]]
    points = a + ((heights[which] - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None] * (b - a)
    return _edges(points, which, facing, away)


def _cut(halves: Halves, height: float) -> tuple[Array, Array]:
    """Edges (m, 2) that a section crosses, and whether their face looks up or down (m,): 1, −1; neither: 0."""
    above = halves.vertices[:, 1] >= height
    first, second, third = (above[halves.faces[:, k]] for k in range(3))
    cut = halves.faces[(first != second) | (second != third)]
    lone = (above[cut] == (above[cut].sum(axis=1) == 1)[:, None]).argmax(axis=1)
    a, b, c = (np.take_along_axis(cut, ((lone + k) % 3)[:, None], axis=1)[:, 0] for k in range(3))
    p, q, r = (halves.vertices[corner] for corner in (a, b, c))
    (px, py), (qx, qy) = (q - p)[:, :2].T, (r - p)[:, :2].T
    facing = np.sign(px * qy - py * qx)
    return np.concatenate([np.stack([a, b], axis=1), np.stack([a, c], axis=1)]), np.r_[facing, facing]


def _edges(points: Tensor, which: Array, facing: Array, at: Tensor) -> Edges:
    """Nose, tail and thickness of the n sections that the points (m, 3) belong to, as `which` (m,) says."""
    import torch

    x, count, index = points[:, 0], len(at), torch.from_numpy(which)
    nothing = torch.full((count,), torch.inf, dtype=torch.float64)
    first, last = nothing.scatter_reduce(0, index, x, "amin"), (-nothing).scatter_reduce(0, index, x, "amax")
    start, chord = first, last - first
    if not bool((chord > 0).all()):
        raise MeasureError("expected a wing all along its span, got nothing in places")
    share = (x - start[index]) / chord[index]
    own, thickness = _thicknesses(share, points[:, 2], which, facing)
    share, which, index = share[own], which[own], index[own]
    most = (-nothing).scatter_reduce(0, index, thickness, "amax")
    if not bool((most > 0).all()):
        raise MeasureError(
            "expected a wing's upper side above its lower side; turn the faces round if they point inward"
        )
    nose, tail = _ends(share, thickness / most[index], which, count)
    fitted = (nose.detach().abs() < FAR) & ((tail.detach() - 1).abs() < FAR)
    nose, tail = torch.where(fitted, start + nose * chord, first), torch.where(fitted, start + tail * chord, last)
    return Edges(at, nose, tail, most, fitted.numpy())


def _thicknesses(share: Tensor, z: Tensor, which: Array, facing: Array) -> tuple[Array, Tensor]:
    """Thickness where the m points lie that have the other side under or over them, and which points these are."""
    import torch

    place = share.detach().numpy()
    order = np.lexsort((place, which))
    key = which + np.clip(place, 0, 1) * 0.5  # sections one after the other, each along its chord
    own, parts = [], []
    for sign in (1.0, -1.0):
        mine, other = (order[facing[order] == side] for side in (sign, -sign))
        after = np.searchsorted(key[other], key[mine])
        fits = (after > 0) & (after < len(other))
        mine, after = mine[fits], after[fits]
        left, right = other[after - 1], other[after]
        fits = (which[left] == which[mine]) & (which[right] == which[mine]) & (place[right] > place[left])
        mine, left, right = mine[fits], left[fits], right[fits]
        between = (share[mine] - share[left]) / (share[right] - share[left])
        parts.append(sign * (z[mine] - z[left] - between * (z[right] - z[left])))
        own.append(mine)
    return np.concatenate(own), torch.cat(parts)


def _ends(share: Tensor, thickness: Tensor, which: Array, count: int) -> tuple[Tensor, Tensor]:
    """Nose and tail (count,) in chords from the section's first point; NaN where the thickness does not tell."""
    import torch

    place = share.detach().numpy()
    inside = (place > NOSE[0]) & (place < NOSE[1])
    there = share[inside]
    weight = _taper(there, NOSE) / (torch.sqrt(there) * (1 - there))  # makes errors of the squared thickness alike
    cubic = _fitted(there, thickness[inside] ** 2, weight, which[inside], 3, count)
    root = torch.zeros(count, dtype=torch.float64)
    for _ in range(NEWTON):
        root = root.detach()
        value = ((cubic[:, 3] * root + cubic[:, 2]) * root + cubic[:, 1]) * root + cubic[:, 0]
        rise = (3 * cubic[:, 3] * root + 2 * cubic[:, 2]) * root + cubic[:, 1]
        root = root - value / rise.detach()  # the last of these steps carries the derivative
    root = torch.where(root.detach().abs() < FAR, root, torch.nan)
    behind = (place > TAIL[0]) & (place < TAIL[1])
    there = share[behind]
    way = torch.sqrt(there - root[which[behind]])
    line = _fitted(there, thickness[behind] / way, _taper(there, TAIL), which[behind], 1, count)
    return root, -line[:, 0] / line[:, 1]


def _taper(share: Tensor, window: tuple[float, float]) -> Tensor:
    """Weights that fall to nothing at both ends of a window, so that no point enters or leaves with a jump."""
    return (share - window[0]) * (window[1] - share)


def _fitted(share: Tensor, values: Tensor, weight: Tensor, which: Array, degree: int, count: int) -> Tensor:
    """Coefficients (count, degree + 1) of the polynomials of least squares through each section's values.

    A section with too few points has NaN.
    """
    import torch

    powers = share[:, None] ** torch.arange(degree + 1)
    index = torch.from_numpy(which)
    matrix = torch.zeros((count, degree + 1, degree + 1), dtype=torch.float64)
    matrix = matrix.index_add(0, index, weight[:, None, None] * powers[:, :, None] * powers[:, None, :])
    right = torch.zeros((count, degree + 1), dtype=torch.float64)
    right = right.index_add(0, index, (weight * values)[:, None] * powers)
    enough = torch.bincount(index, minlength=count) >= FEWEST
    safe = torch.where(enough[:, None, None], matrix, torch.eye(degree + 1, dtype=torch.float64))
    solved = torch.linalg.solve(safe, right)
    return torch.where(enough[:, None], solved, torch.nan)
