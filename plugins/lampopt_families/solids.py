"""Solids as fields, negative inside: how they are cut, joined and rounded, with gradients."""

from __future__ import annotations

from typing import Any

import numpy as np

from lampopt.types import Array

Gradient = tuple[Any, Any, Any]  # along x, y, z: arrays that can be broadcast to the value, or numbers
Field = tuple[Array, Gradient]


def common(radius: float, *fields: Field) -> Field:
    """What is in all of `fields`, edges between them rounded.

    Where planes meet at right angles, the edge is a quarter of a circle of `radius`. A plane stays as it is from
    ``radius / sin(angle between the normals)`` behind the edge.
    """
    most, gradient = fields[0]
    over = np.maximum(most + radius, 0)
    square = over**2
    sums = [over * g for g in gradient]
    for value, slopes in fields[1:]:
        beyond = value > most
        most = np.where(beyond, value, most)
        gradient = tuple(np.where(beyond, g, h) for g, h in zip(slopes, gradient, strict=True))
        over = np.maximum(value + radius, 0)
        square = square + over**2
        sums = [a + over * g for a, g in zip(sums, slopes, strict=True)]
    reach = np.sqrt(square)
    near = reach > 0
    inverse = 1 / np.where(near, reach, 1)
    value = np.where(near, reach - radius, most)
    gx, gy, gz = (np.where(near, a * inverse, g) for a, g in zip(sums, gradient, strict=True))
    return value, (gx, gy, gz)


def joined(first: Field, second: Field) -> Field:
    """What is in either, the crease between them sharp."""
    (a, slopes), (b, others) = first, second
    gx, gy, gz = (np.where(a < b, g, h) for g, h in zip(slopes, others, strict=True))
    return np.minimum(a, b), (gx, gy, gz)


def outside(field: Field) -> Field:
    """All that is not in `field`."""
    value, (gx, gy, gz) = field
    return -value, (-gx, -gy, -gz)
