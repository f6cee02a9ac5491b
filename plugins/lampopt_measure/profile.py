"""The outline of a section seen from above or below, and the straight runs that it is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .facets import Facets

NEAR = 1e-4  # of a section's size: ends of segments that are no farther apart meet
GAPS = 0.2  # of the ends of a section's segments may meet no other: a few borders of an open mesh
COLUMNS = 600  # places along the body where the outline is looked up
SAMPLES = 240  # points, evenly spaced along the outline, that runs are made of
NOISE = 0.0008  # of the body's length: what a straight panel may be off straight (a decoder's ripple, a slight crown)
RUN = 12.0  # what one more run has to be worth, in samples that are off by the noise
TRIM = 0.15  # of a run, at both ends: where an edge is rounded into the next panel


@dataclass(frozen=True)
class Run:
    """A straight part of an outline, from one end to the other, nose to tail."""

    start: tuple[float, float]  # x, z
    end: tuple[float, float]
    angle: float  # how far it rises towards the tail [deg]
    length: float

    @property
    def middle(self) -> tuple[float, float]:
        """Half-way along it."""
        return ((self.start[0] + self.end[0]) / 2, (self.start[1] + self.end[1]) / 2)


def outline(cut: Facets, *, over: int = 0, up: int = 2, side: float = 1.0) -> Array:
    """The outermost points of a section, (SAMPLES, 2), evenly spaced along the way.

    Parameters
    ----------
    cut
        Segments; they need be neither ordered nor closed.
    over, up
        The axes to walk along, and to look along.
    side
        1 from above, −1 from below.
    """
    ends = np.sort(cut.corners[..., over], axis=1)
    low, high = float(ends.min()), float(ends.max())
    at = low + (high - low) * (np.arange(COLUMNS) + 0.5) / COLUMNS
    first, last = np.searchsorted(at, ends[:, 0]), np.searchsorted(at, ends[:, 1], side="right")
    count = last - first
    segment = np.repeat(np.arange(len(cut)), count)
    column = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    a, b = cut.corners[segment, 0], cut.corners[segment, 1]
    run = b[:, over] - a[:, over]
    share = np.where(run == 0, 0.5, (at[column] - a[:, over]) / np.where(run == 0, 1, run))
    height = side * (a[:, up] + share * (b[:, up] - a[:, up]))
    top = np.full(COLUMNS, -np.inf)
    np.maximum.at(top, column, height)
    seen = np.isfinite(top)
    if seen.sum() < COLUMNS / 2:
        raise MeasureError(f"outline: expected a section all along the body, got one over {seen.mean():.0%} of it")
    return evenly(np.column_stack([at[seen], side * top[seen]]))


def check_gaps(cut: Facets) -> None:
    """Raise MeasureError where a section is more gaps than outline: what lies behind would be taken for its edge."""
    from scipy.spatial import cKDTree

    ends = cut.corners.reshape(-1, 3)
    near = NEAR * float(np.ptp(ends, axis=0).max())
    lone = float((cKDTree(ends).query(ends, k=2, distance_upper_bound=near)[0][:, 1] > near).mean())
    if lone > GAPS:
        raise MeasureError(
            f"expected a section along the middle that hangs together, got one with {lone:.0%} of its pieces' ends "
            "loose; faces are missing: wrap or repair the mesh first"
        )


def evenly(points: Array) -> Array:
    """SAMPLES points (SAMPLES, 2) evenly spaced along the polyline through `points` (M, 2)."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0, way[-1], SAMPLES)
    return np.column_stack([np.interp(at, way, points[:, k]) for k in range(2)])


def runs(points: Array, length: float) -> list[Run]:
    """The straight runs of an outline (n, 2) of a body of `length`, nose to tail: the partition of least cost.

    The cost is the squared distance from each run's line of least squares, in units of the noise, plus a price for each
    run: the optimum over all partitions, by dynamic programming.
    """
    count = len(points)
    away = (points - points.mean(axis=0)) / (NOISE * length)
    x, z = away.T
    sums = np.concatenate([np.zeros((1, 5)), np.cumsum(np.column_stack([x, z, x * x, z * z, x * z]), axis=0)])
    first, last = np.arange(count + 1)[:, None], np.arange(count + 1)[None]
    n = np.maximum(last - first, 1)
    sx, sz, sxx, szz, sxz = np.moveaxis(sums[None] - sums[:, None], -1, 0)
    xx, zz, xz = sxx - sx * sx / n, szz - sz * sz / n, sxz - sx * sz / n
    off = (xx + zz) / 2 - np.sqrt(((xx - zz) / 2) ** 2 + xz**2)
    cost = np.where(last - first >= 2, np.maximum(off, 0.0) + RUN, np.inf)
    best, came = np.full(count + 1, np.inf), np.zeros(count + 1, np.int64)
    best[0] = 0
    for end in range(2, count + 1):
        sofar = best[:end] + cost[:end, end]
        came[end] = sofar.argmin()
        best[end] = sofar[came[end]]
    found: list[Run] = []
    end = count
    while end:
        start = int(came[end])
        found.append(_run(points[start:end]))
        end = start
    return found[::-1]


def _run(points: Array) -> Run:
    middle = points.mean(axis=0)
    _, _, ways = np.linalg.svd(points - middle, full_matrices=False)
    way = ways[0] * (1 if ways[0] @ (points[-1] - points[0]) >= 0 else -1)
    first, last = middle + way * ((points[[0, -1]] - middle) @ way)[:, None]
    angle = float(np.degrees(np.arctan2(way[1], way[0])))
    return Run(
        (float(first[0]), float(first[1])), (float(last[0]), float(last[1])), angle, float(np.hypot(*(last - first)))
    )
