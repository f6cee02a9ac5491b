"""Plane outlines of straight edges and tangent arcs, with signed distance and its gradient in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lampopt.types import Array

STRAIGHT = 1e-9  # [rad] a turn below which two edges are one


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed curve of n straight edges, counter-clockwise, each followed by an arc that is tangent to its neighbours.

    Parameters
    ----------
    start, way, length
        (n, 2), (n, 2), (n,): where a straight edge starts, its unit direction, how long it is. A negative length says
        that the arcs at its ends leave it no room.
    centre, radius
        (n, 2) and (n,) of the arc; the radius is positive where the outline is convex, negative where it is hollow, and
        0 where there is no arc.
    """

    start: Array
    way: Array
    length: Array
    centre: Array
    radius: Array

    @classmethod
    def of(cls, corners: Sequence[tuple[float, float]], tangents: Sequence[float]) -> Outline:
        """The polygon of `corners` (n, 2), counter-clockwise; an arc begins and ends `tangents[k]` from corner k."""
        corner, tangent = np.array(corners, float), np.array(tangents, float)
        way = np.roll(corner, -1, axis=0) - corner
        length = np.linalg.norm(way, axis=1)
        way /= length[:, None]
        before = np.roll(way, 1, axis=0)
        turn = np.arctan2(_cross(before, way), (before * way).sum(axis=1))
        bent = np.abs(turn) > STRAIGHT
        tangent = np.where(bent, tangent, 0)
        radius = tangent / np.tan(np.where(bent, turn, 1) / 2)
        start = corner + tangent[:, None] * way
        centre = start + radius[:, None] * _left(way)
        length = length - tangent - np.roll(tangent, -1)
        return cls(start, way, length, np.roll(centre, -1, axis=0), np.roll(radius, -1))

    @property
    def area(self) -> float:
        """Of what the outline encloses."""
        end = self.start + self.length[:, None] * self.way
        following = np.roll(self.start, -1, axis=0)
        chords = (_cross(self.start, end) + _cross(end, following)).sum() / 2
        turn = self._turn
        return float(chords + (self.radius * np.abs(self.radius) * (np.abs(turn) - np.sin(np.abs(turn)))).sum() / 2)

    @property
    def perimeter(self) -> float:
        """Length of the whole curve."""
        return float(self.length.sum() + (self.radius * self._turn).sum())

    @property
    def _turn(self) -> Array:
        """(n,) by how much the arcs turn, positive to the left [rad]."""
        following = np.roll(self.way, -1, axis=0)
        turn: Array = np.arctan2(_cross(self.way, following), (self.way * following).sum(axis=1))
        return turn

    def distance(self, u: Array, v: Array) -> tuple[Array, tuple[Array, Array]]:
        """Signed distance, negative inside, and its two slopes, at the points that `u` and `v` are broadcast to.

        Where every corner is rounded the curve has no kink, and its nearest part alone tells inside from outside.
        """
        u, v = np.broadcast_arrays(u, v)
        shape, (u, v) = u.shape, (u.ravel(), v.ravel())
        value, slope_u, slope_v = np.full(u.shape, np.inf), np.zeros(u.shape), np.zeros(u.shape)
        for k, length in enumerate(self.length):
            (a, b), (way_u, way_v) = self.start[k], self.way[k]
            along = (u - a) * way_u + (v - b) * way_v
            side = (u - a) * way_v - (v - b) * way_u
            apart = np.copysign(np.hypot(along - np.clip(along, 0, length), side), side)
            nearer = np.abs(apart) < np.abs(value)
            value[nearer], slope_u[nearer], slope_v[nearer] = apart[nearer], way_v, -way_u
            if not self.radius[k]:
                continue
            sense = np.sign(self.radius[k])
            first = self.start[k] + length * self.way[k] - self.centre[k]
            last = self.start[(k + 1) % len(self.start)] - self.centre[k]
            c, d = u - self.centre[k, 0], v - self.centre[k, 1]
            reach = np.hypot(c, d)
            apart = sense * reach - self.radius[k]
            within = (sense * (first[0] * d - first[1] * c) >= 0) & (sense * (c * last[1] - d * last[0]) >= 0)
            nearer = within & (np.abs(apart) < np.abs(value))
            reach = sense * np.maximum(reach[nearer], np.finfo(float).tiny)
            value[nearer], slope_u[nearer], slope_v[nearer] = apart[nearer], c[nearer] / reach, d[nearer] / reach
        return value.reshape(shape), (slope_u.reshape(shape), slope_v.reshape(shape))


def _left(way: Array) -> Array:
    return np.stack([-way[..., 1], way[..., 0]], axis=-1)


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
