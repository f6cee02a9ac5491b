"""Which of many points are not dominated, and where their front bends most; less is better in every column."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lampopt.errors import InputError
from lampopt.types import Array

BENT = 1e-6  # what is less below the chord may be what a solver's rounding leaves of a straight front
STRAIGHT = 1e-12  # a front that keeps so near to its chord [its length is √2] does not bend


def pareto(points: npt.ArrayLike) -> Array:
    """Which of `points` (B, m) are not dominated (B,): no other is at most as large everywhere, and smaller somewhere.

    Equal points do not dominate each other. A row with NaN is no point: it is never on the front, and dominates
    nothing. Infinite values are compared as they are. Where more is better, give the column negated.

    Raises
    ------
    InputError
        If it is no table of numbers with a column at least.
    """
    rows = _table(points)
    known = np.flatnonzero(~np.isnan(rows).any(1))
    order = known[np.lexsort(rows[known].T[::-1])]  # by the first column, then the next: who dominates comes before
    sorted_ = rows[order]
    fresh = np.ones(len(order), bool)
    fresh[1:] = np.any(sorted_[1:] != sorted_[:-1], axis=1)
    twin = np.cumsum(fresh) - 1  # equal rows share their fate
    kept = _undominated(sorted_[fresh])
    mask = np.zeros(len(rows), bool)
    mask[order] = kept[twin]
    return mask


def knee(points: npt.ArrayLike) -> int:
    """The row of `points` (B, 2) at which their front bends most: the compromise where either more costs much.

    The front's ends are scaled to (0, 1) and (1, 0); the knee lies farthest below the chord between them. Where no
    point of the front lies below it (it is straight, or bulges the other way, or has one or two points), that is the
    end that is least in the first column. Of equals it is the first. Rows that are not finite are left out.

    Raises
    ------
    InputError
        If it is no table of two columns, or no row is finite.
    """
    return _bend(points)[0]


def bends(points: npt.ArrayLike) -> bool:
    """Whether the front of `points` (B, 2) has a knee that more than rounding makes.

    Raises
    ------
    InputError
        As `knee`.
    """
    return _bend(points)[1] > BENT


def _bend(points: npt.ArrayLike) -> tuple[int, float]:
    """The knee, and how far below the chord it lies in the first column, both axes scaled to the front's ends."""
    rows = _table(points)
    if rows.shape[1] != 2:
        raise InputError(f"knee: expected points (B, 2), got shape {rows.shape}")
    usable: Array = np.all(np.isfinite(rows), axis=1)
    if not usable.any():
        raise InputError(f"knee: expected a finite point at least, got {len(rows)} rows, none of them finite")
    front = np.flatnonzero(pareto(np.where(usable[:, None], rows, np.nan)))
    front = front[np.lexsort(rows[front].T[::-1])]
    ends = rows[front]
    ends = ends / np.maximum(np.abs(ends).max(0), np.finfo(float).tiny)  # no difference overflows
    reach = np.ptp(ends, axis=0)
    if not reach.all():
        return int(front[0]), 0.0
    x, y = ((ends - ends.min(0)) / reach).T
    below = 1 - x - y
    if below.max() <= STRAIGHT:
        return int(front[0]), 0.0
    return int(front[int((below > below.max() - STRAIGHT).argmax())]), float(below.max())


def _table(points: npt.ArrayLike) -> Array:
    try:
        rows = np.asarray(points, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"points: expected a table of numbers (B, m), got {error}") from error
    if rows.ndim != 2 or rows.shape[1] < 1:
        raise InputError(f"points: expected shape (B, m) with m of at least 1, got {rows.shape}")
    return rows


def _undominated(rows: Array) -> Array:
    """The same of distinct `rows` in ascending order."""
    count, wide = rows.shape
    mask = np.zeros(count, bool)
    if wide <= 2:
        if count:
            least = np.minimum.accumulate(rows[:, -1])
            mask[0] = True
            mask[1:] = (rows[1:, -1] < least[:-1]) if wide == 2 else False
        return mask
    left = np.arange(count)
    columns = [np.ascontiguousarray(column) for column in rows.T[1:]]  # the first is ascending: it always agrees
    while len(left):
        mask[left[0]] = True  # none of those before it that remained dominates it, and none after it can
        beaten = columns[0] >= columns[0][0]
        for column in columns[1:]:
            beaten &= column >= column[0]
        columns = [column[~beaten] for column in columns]
        left = left[~beaten]
    return mask
