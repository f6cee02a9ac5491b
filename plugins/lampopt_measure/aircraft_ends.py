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
TIE = 1e-9  # of the chord: points of either side nearer than this lie over one another
NEWTON = 8  # steps to the root of a cubic that is near its start
STEEP = 2.0  # height over length from which on the rearmost piece of a section is a wall
FEWEST = 8  # points that a section is fitted to
GAP = 0.05  # of what a section spans: two parts farther apart are a wing and a tail, say


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
    blunt: Array  # (n, s) whether the section ends in a wall or a rounding
    _cuts: Cuts
    _slopes: Mapping[str, Array]  # derivative (m, 3) of each of these by the points of its own section

    def gradient(self, by_span: Array, **by: Array) -> Array:
        """(p, V, 3) of p values, given how they change with the half span (p,) and with values here (p, n, s)."""
        from scipy.sparse import coo_array

        cut, halves = self._cuts, self.halves
        low, high = (halves.vertices[cut.edges[:, k]] for k in range(2))
        along = (high - low) / (high - low)[:, 1:2]
        count, sections = len(halves.vertices), self.nose.size
        rows = (3 * cut.edges.T[:, :, None] + np.arange(3)).ravel()
        columns = np.broadcast_to(cut.section[:, None], (2, len(cut.section), 3)).ravel()
        found, by_root, by_span = np.zeros((len(by_span), count, 3)), np.zeros(len(by_span)), by_span.copy()
        for name, part in by.items():
            weights, slopes = part.reshape(len(part), -1), self._slopes[name]
            # A point stays in its section: as its edge or the section moves along y, it slides along the edge.
            sliding = (slopes * along).sum(axis=1)
            slopes = slopes - sliding[:, None] * [0, 1, 0]
            shares = np.stack([(1 - cut.share)[:, None] * slopes, cut.share[:, None] * slopes])
            follow = coo_array((shares.ravel(), (rows, columns)), (3 * count, sections))
            found += (follow @ weights.T).T.reshape(found.shape)
            moved = weights * np.bincount(cut.section, sliding, sections)
            by_root += moved.sum(axis=1)
            by_span += (moved * np.outer(self.at, halves.sides).ravel()).sum(axis=1)
        found[:, :, 1] += np.outer(by_root, halves.middle()) + np.outer(by_span, halves.across())
        return found

    def expect_one_part(self) -> None:
        """Raise MeasureError where a section has two parts, one behind the other, such as a wing and a tail."""
        x = self._cuts.points.reshape(2, -1, 3)[..., 0]
        low, high, section = x.min(0), x.max(0), self._cuts.section[: x.shape[1]]
        for number in np.unique(section):
            own = np.flatnonzero(section == number)
            own = own[np.argsort(low[own])]
            ends = np.maximum.accumulate(high[own])
            gap = float((low[own][1:] - ends[:-1]).max(initial=0.0))
            if gap > GAP * (ends[-1] - low[own[0]]):
                raise MeasureError(
                    f"expected one wing in each section across, got two parts, {gap:.4g} apart; measure the wing alone"
                )


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
    reach = FAR * (values["last"] - values["first"])
    fitted = np.abs(values["nose"] - values["first"]) < reach
    fitted &= np.abs(values["tail"] - values["last"]) < reach
    crested = fitted & (np.abs(values["crest"]) < CREST)
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
    first, last, nose, tail, thickness = (
        values[name].reshape(shape) for name in ("first", "last", "nose", "tail", "thickness")
    )
    blunt = _blunt(cut, values["last"], reach).reshape(shape)
    return Edges(halves, at, first, last, nose, tail, thickness, fitted.reshape(shape), blunt, cut, slopes)


def _blunt(cut: Cuts, last: Array, reach: Array) -> Array:
    """Whether the rearmost piece of each section stands, given where they end (n,)."""
    ahead, behind = cut.points.reshape(2, -1, 3)
    rearmost = np.maximum(ahead[:, 0], behind[:, 0]) >= (last - TIE * reach)[cut.section[: len(ahead)]]
    standing = np.abs(behind[:, 2] - ahead[:, 2]) > STEEP * np.abs(behind[:, 0] - ahead[:, 0])
    found: Array = np.bincount(cut.section[: len(ahead)][rearmost & standing], minlength=len(last)) > 0
    return found


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
        # Where points lie over one another, the thickness bends: half of each slope is what differences see.
        after = np.stack([np.searchsorted(key[other], key[mine] + shift) for shift in (-TIE, TIE)])
        fits = ((after > 0) & (after < len(other))).all(axis=0)
        mine, after = mine[fits], after[:, fits]
        left, right = other[after - 1], other[after]
        fits = (section[left] == section[mine]) & (section[right] == section[mine]) & (place[right] > place[left])
        mine, left, right = mine[fits.all(axis=0)], left[:, fits.all(axis=0)], right[:, fits.all(axis=0)]
        between = (share[mine] - share[left]) / (share[right] - share[left])
        parts.append(sign * (z[mine] - (z[left] + between * (z[right] - z[left])).mean(dim=0)))
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
