"""Shapes laid out on a plane so that near shapes lie near each other: classical multidimensional scaling.

How far two shapes are from each other is told by their signed distances at common points, taken from the surfaces of
all of them: the root of the mean squared difference. That needs meshes only, so it compares shapes of any decoder, is
zero for equal shapes whatever their triangles, and costs one query a shape instead of one a pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lampopt.reporting.shapes import Drawn, as_mesh, signed_distance, spread_over
from lampopt.types import Array

POINTS = 1500  # where shapes are compared


@dataclass(frozen=True, eq=False)
class Layout:
    """Places (n, 2) [user's unit], and Kruskal's stress: how far distances on the plane are off, 0 for not at all."""

    places: Array
    stress: float


def laid_out(shapes: Sequence[Drawn]) -> Layout:
    """Two coordinates for each of `shapes`, at least two."""
    each = max(8, POINTS // len(shapes))
    points = np.concatenate([spread_over(shape, each) for shape in shapes])
    return scaled(np.stack([signed_distance(points, as_mesh(shape)) for shape in shapes]) / np.sqrt(len(points)))


def scaled(features: Array) -> Layout:
    """Classical scaling of `features` (n, M), between which distances are Euclidean; signs are fixed."""
    given = _distances(features - features.mean(0))
    n = len(given)
    centring = np.eye(n) - 1 / n
    values, vectors = np.linalg.eigh(-0.5 * centring @ given**2 @ centring)
    places = vectors[:, ::-1][:, :2] * np.sqrt(np.clip(values[::-1][:2], 0, None))
    signs = np.sign(places[np.abs(places).argmax(0), np.arange(places.shape[1])])
    places = places * np.where(signs == 0, 1, signs)
    kept = _distances(places)
    total = float((given**2).sum())
    return Layout(places, float(np.sqrt(((given - kept) ** 2).sum() / total)) if total > 0 else 0.0)


def _distances(rows: Array) -> Array:
    square = (rows**2).sum(1)
    return np.asarray(np.sqrt(np.clip(square[:, None] + square - 2 * rows @ rows.T, 0, None)))
