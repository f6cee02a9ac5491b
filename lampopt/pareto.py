"""What is best where several things are wanted at once: the designs that no other beats, and the knee among them."""

from __future__ import annotations

import numpy as np

from lampopt.types import Array


def pareto(points: Array) -> Array:
    """(B,) truth values: which of points (B, m) no other beats; less is better in every column.

    One beats another where it is nowhere larger and somewhere less: of equal points all stay.
    """
    points = np.asarray(points, float)
    kept = np.ones(len(points), bool)
    for i, point in enumerate(points):
        kept[i] = not ((points <= point).all(1) & (points < point).any(1)).any()
    return kept


def knee(points: Array) -> int:
    """The number of the point of (B, 2) farthest from the chord of the front, both columns normalised by its ends."""
    points = np.asarray(points, float)
    front = points[pareto(points)]
    low = front.min(0)
    spread = front.max(0) - low
    return int(((points - low) / np.where(spread > 0, spread, 1.0)).sum(1).argmin())
