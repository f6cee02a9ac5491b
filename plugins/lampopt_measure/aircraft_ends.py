"""Where the sections of a wing begin and end along the wind, and how thick they are, from their thickness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .aircraft_sections import Cuts, Halves, cuts

if TYPE_CHECKING:
    from torch import Tensor

NOSE = (0.18, 0.92)  # of the chord: where the squared thickness is fitted to find the nose
TAIL = (0.30, 0.92)  # of the chord: where the thickness is fitted to find the tail
FAR = 0.15  # of the chord: a nose or tail found farther from the section's own end than this is none
CREST = 0.15  # of the chord: from this far to either side of the cubic's highest point the largest thickness is fitted
NEWTON = 8  # steps to the root of a cubic that is near its start
FEWEST = 8  # points that a section is fitted to


@dataclass(frozen=True, eq=False)
class Edges:
    """Nose, tail and thickness of sections at n shares of the half span, on each of s sides."""

    halves: Halves
    at: Array  # (n,) of the half span
    first: Array  # (n, s) x where the section itself begins [L]
    last: Array  # (n, s) x where it ends [L]
    nose: Array  # (n, s) x of the nose, from the thickness where `fitted` [L]
    tail: Array  # (n, s) x of the tail, likewise [L]
    thickness: Array  # (n, s) the largest along z [L]
    fitted: Array  # (n, s) whether nose and tail come from the thickness; elsewhere they are the section's own ends
    _cuts: Cuts
    _slopes: Mapping[str, Array]  # derivative (m, 3) of each of these by the points of its own section

    def gradient(self, by_span: Array, **by: Array) -> Array:
        """(p, V, 3) of p values, given how they change with the half span (p,) and with values here (p, n, s)."""
        cut, p = self._cuts, len(by_span)
        slopes = np.zeros((p, len(cut.section), 3))
        for name, part in by.items():
            slopes += part.reshape(p, -1)[:, cut.section, None] * self._slopes[name]
        # A point stays in its section: as its edge or the section moves along y, it slides along the edge.
        low, high = (self.halves.vertices[cut.edges[:, k]] for k in range(2))
        run = high - low
        sliding = (slopes * (run / run[:, 1:2])).sum(axis=2)
        slopes[:, :, 1] -= sliding
        rows, count = cut.edges.T.ravel(), len(self.halves.vertices)
        parts = np.concatenate([(1 - cut.share)[:, None] * slopes, cut.share[:, None] * slopes], axis=1)
        found = np.stack(
            [np.stack([np.bincount(rows, of[:, axis], count) for axis in range(3)], axis=1) for of in parts]
        )
        away = np.outer(self.at, self.halves.sides).ravel()[cut.section]
        found[:, :, 1] += np.outer(by_span + (sliding * away).sum(axis=1), self.halves.across())
        found[:, :, 1] += np.outer(sliding.sum(axis=1), self.halves.middle())
        return found


def edges(halves: Halves, at: Array, *, follow: tuple[str, ...] = ()) -> Edges:
    """Nose and tail of the sections at shares `at` (n,) of the half span, on each side that there is.

    Facets cut a round nose short and lose a thin tail; both are found from the thickness where there is some. It is √s
    times a smooth function of s, the way from the nose, ahead of an airfoil's tail (Kulfan's class function). So its
    square is fitted by a cubic, whose root is the nose, and it over √s by a straight line, whose root is the tail. The
    largest thickness is the top of a parabola fitted around that of the cubic. Sums go along the section, weighted by
    the way along x, so that nothing jumps where a section passes a vertex.

    Parameters
    ----------
    follow
        What is to have derivatives, by the names in `Edges`.

    Raises
    ------
    MeasureError
        Where a section is empty, or has no upper side above a lower one.
    """
    import torch

    heights = (halves.root + halves.span * np.outer(at, halves.sides)).ravel()
    cut = cuts(halves.vertices, halves.faces, heights)
    points = torch.from_numpy(cut.points).requires_grad_(bool(follow))
    own, found = _ends(points, cut, len(heights))
    values = {name: value.detach().numpy() for name, value in {**own, **found}.items()}
    known = {
        "nose": (np.abs(values["nose"] - values["first"]), np.abs(values["tail"] - values["last"])),
        "thickness": (np.abs(values["crest"]),),
    }
    reach = FAR * (values["last"] - values["first"])
    fitted = (known["nose"][0] < reach) & (known["nose"][1] < reach)
    crested = fitted & (known["thickness"][0] < CREST)
    chosen = {"nose": (fitted, "first"), "tail": (fitted, "last"), "thickness": (crested, "largest")}
    for name, (which, instead) in chosen.items():
        values[name] = np.where(which, values[name], values[instead])
    slopes = {}
    for name in follow:
        which, instead = chosen.get(name, (np.zeros(len(heights), bool), name))
        slopes[name] = _slope({**own, **found}[instead], points)
        if which.any():
            slopes[name] = np.where(which[cut.section][:, None], _slope(found[name], points), slopes[name])
    shape = len(at), len(halves.sides)
    parts = (values[name].reshape(shape) for name in ("first", "last", "nose", "tail", "thickness"))
    return Edges(halves, at, *parts, fitted.reshape(shape), cut, slopes)


def _slope(values: Tensor, points: Tensor) -> Array:
    """(m, 3) derivative of each section's value by its own points."""
    import torch

    return np.asarray(torch.autograd.grad(values.sum(), points, retain_graph=True)[0].numpy())


def _ends(points: Tensor, cut: Cuts, count: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Of each of `count` sections its own ends and largest thickness, and those fitted, NaN where nothing can be."""
    import torch

    x, index = points[:, 0], torch.from_numpy(cut.section)
    nothing = torch.full((count,), torch.inf, dtype=torch.float64)
    first, last = nothing.scatter_reduce(0, index, x, "amin"), (-nothing).scatter_reduce(0, index, x, "amax")
    chord = last - first
    if not bool((chord > 0).all()):
        raise MeasureError("expected a wing all along its span, got nothing in places")
    share = (x - first[index]) / chord[index]
    way = (share - share.roll(len(share) // 2)).abs()
    own, thickness = _thicknesses(share, points[:, 2], cut)
    share, way, index = share[own], way[own], index[own]
    largest = (-nothing).scatter_reduce(0, index, thickness, "amax")
    if not bool((largest > 0).all()):
        raise MeasureError(
            "expected a wing's upper side above its lower side; turn the faces round if they point inward"
        )
    size = largest.detach()
    fit = _Fit(share, thickness / size[index], way, index, count)
    nose, tail, crest, top = fit.found()
    fitted = {"nose": first + nose * chord, "tail": first + tail * chord, "crest": crest, "thickness": top * size}
    return {"first": first, "last": last, "largest": largest}, fitted


def _thicknesses(share: Tensor, z: Tensor, cut: Cuts) -> tuple[Array, Tensor]:
    """Thickness where the m points lie that have the other side under or over them, and which points these are."""
    import torch

    place, section = share.detach().numpy(), cut.section
    key = section + np.clip(place, 0, 1) * 0.5  # sections one after the other, each along its chord
    order = np.argsort(key, kind="stable")
    own, parts = [], []
    for sign in (1.0, -1.0):
        mine, other = (order[cut.facing[order] == side] for side in (sign, -sign))
        after = np.searchsorted(key[other], key[mine])
        fits = (after > 0) & (after < len(other))
        mine, after = mine[fits], after[fits]
        left, right = other[after - 1], other[after]
        fits = (section[left] == section[mine]) & (section[right] == section[mine]) & (place[right] > place[left])
        mine, left, right = mine[fits], left[fits], right[fits]
        between = (share[mine] - share[left]) / (share[right] - share[left])
        parts.append(sign * (z[mine] - z[left] - between * (z[right] - z[left])))
        own.append(mine)
    return np.concatenate(own), torch.cat(parts)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Thickness (m,), in largest ones, at shares (m,) of the chord, of the sections that `index` (m,) says."""

    share: Tensor
    thickness: Tensor
    way: Tensor  # (m,) along the chord, that each point stands for
    index: Tensor
    count: int

    def found(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Nose, tail, how far the crest is from the cubic's, and thickness there (count,); NaN if it cannot be told."""
        import torch

        share, middle = self.share, sum(NOSE) / 2
        inside = (share > NOSE[0]) & (share < NOSE[1])
        there = share[inside]
        alike = torch.sqrt(there) * (1 - there)  # makes errors of the squared thickness alike
        cubic = self._fitted(inside, there - middle, self.thickness[inside] ** 2, _taper(there, NOSE) / alike, 3)
        root = torch.full((self.count,), -middle, dtype=torch.float64)
        for _ in range(NEWTON):
            root = root.detach()
            value = ((cubic[3] * root + cubic[2]) * root + cubic[1]) * root + cubic[0]
            rise = (3 * cubic[3] * root + 2 * cubic[2]) * root + cubic[1]
            root = root - value / rise.detach()  # the last of these steps carries the derivative
        nose = root + middle
        nose = torch.where(nose.detach().abs() < FAR, nose, torch.nan)
        behind = (share > TAIL[0]) & (share < TAIL[1])
        there = share[behind]
        way = torch.sqrt(there - nose[self.index[behind]])
        line = self._fitted(behind, there, self.thickness[behind] / way, _taper(there, TAIL), 1)
        crest = middle + cubic[1] / (torch.sqrt(cubic[2] ** 2 - 3 * cubic[3] * cubic[1]) - cubic[2])
        away = (share - crest[self.index]) / CREST
        near = away.abs() < 1
        there = away[near]
        top = self._fitted(near, there, self.thickness[near], (1 - there**2) ** 2, 2)
        return nose, -line[0] / line[1], -top[1] / (2 * top[2]) * CREST, top[0] - top[1] ** 2 / (4 * top[2])

    def _fitted(self, chosen: Tensor, at: Tensor, values: Tensor, weight: Tensor, degree: int) -> list[Tensor]:
        """Coefficients (count,) of the polynomials of least squares; NaN where there are too few points."""
        import torch

        index, nothing = self.index[chosen], torch.zeros(self.count, dtype=torch.float64)
        enough = torch.bincount(index, minlength=self.count) >= FEWEST
        power = weight * self.way[chosen]
        sums, right = [], []
        for k in range(2 * degree + 1):
            sums.append(torch.where(enough, nothing.index_add(0, index, power), torch.nan))
            if k <= degree:
                right.append(nothing.index_add(0, index, power * values))
            power = power * at
        return _solved([[sums[i + j] for j in range(degree + 1)] for i in range(degree + 1)], right)


def _solved(matrix: list[list[Tensor]], right: list[Tensor]) -> list[Tensor]:
    """Solutions of symmetric positive definite systems, entry by entry: in the same order on every machine."""
    size = len(right)
    matrix, right = [list(row) for row in matrix], list(right)
    for k in range(size):
        for i in range(k + 1, size):
            share = matrix[i][k] / matrix[k][k]
            for j in range(k, size):
                matrix[i][j] = matrix[i][j] - share * matrix[k][j]
            right[i] = right[i] - share * right[k]
    found: list[Tensor] = []
    for k in reversed(range(size)):
        known = sum((matrix[k][k + 1 + j] * value for j, value in enumerate(found)), 0 * right[k])
        found.insert(0, (right[k] - known) / matrix[k][k])
    return found


def _taper(share: Tensor, window: tuple[float, float]) -> Tensor:
    """Weights that fall to nothing at both ends of a window, so that no point enters or leaves with a jump."""
    return (share - window[0]) * (window[1] - share)
