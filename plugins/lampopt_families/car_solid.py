"""The car's solid: side view, plan view and side windows in common, arches cut out of it, tyres put in."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lampopt.types import Array

from .outline import Outline
from .solids import Field, common, joined, outside

# What no parameter moves [mm]: x from the nose, z from the ground.
COWL = (1250.0, 950.0)  # where the planes of hood and windscreen meet
DECK = 1040.0  # height where the planes of rear window and trunk lid meet
BELT = 900.0  # height where the planes of side windows and body sides meet
RAMP = 800.0  # from the nose to the hinge of the front underbody
DIFFUSER = 900.0  # from the hinge of the rear underbody to the tail
BUMPERS = (600.0, 650.0)  # height up to which nose and tail are vertical
NOSE, TAIL = 62.0, 78.0  # [deg] slope above that
TYRE = 215.0  # its width
PATCH = 6.0  # how far the tyres are pressed flat by the ground
SHOULDER = 25.0  # radius of the tyres' edges and of the arches' lips
GAP, DEPTH = 80.0, 90.0  # between tyre and arch: around it, and from its outer face inward
EDGE = 60.0  # radius of the edges between the views
FINER, COARSER = 0.65, 1.45  # steps of the grid across the tyres, and away from the wheels, in those around them


# The panels of the side view, which run counter-clockwise with the nose on the left: name, the way they go along x and
# z, and the parameters that leave them room.
PANELS = (
    ("ramp", (1, 0), ("ramp_angle",)),
    ("underbody", (1, 0), ("length",)),
    ("diffuser", (1, 0), ("diffuser_angle",)),
    ("upright tail", (0, 1), ("diffuser_angle", "ground_clearance")),
    ("slope of the tail", (0, 1), ("trunk_lid_angle", "trunk_lid_length")),
    ("trunk lid", (-1, 0), ("trunk_lid_length", "trunk_lid_angle")),
    ("rear window", (0, 1), ("rear_window_angle", "trunk_lid_angle", "roof_height")),
    ("roof", (-1, 0), ("length", "windscreen_angle", "rear_window_angle", "roof_height", "trunk_lid_length")),
    ("windscreen", (0, -1), ("windscreen_angle", "hood_angle", "roof_height")),
    ("hood", (-1, 0), ("hood_angle",)),
    ("slope of the nose", (0, -1), ("hood_angle",)),
    ("upright nose", (0, -1), ("ramp_angle", "ground_clearance")),
)


class Sizes(NamedTuple):
    """The parameters by name [mm, deg]."""

    length: float
    width: float
    roof_height: float
    wheelbase: float
    track: float
    wheel_radius: float
    ground_clearance: float
    front_overhang: float
    trunk_lid_length: float
    ramp_angle: float
    diffuser_angle: float
    hood_angle: float
    windscreen_angle: float
    rear_window_angle: float
    trunk_lid_angle: float
    greenhouse_angle: float


def side_view(s: Sizes) -> Outline:
    """Outline of x, z: the twelve `PANELS`."""
    ramp, diffuser, hood, windscreen, window, lid = np.tan(
        np.radians([
            s.ramp_angle, s.diffuser_angle, s.hood_angle, s.windscreen_angle, s.rear_window_angle, s.trunk_lid_angle
        ])
    )  # fmt: skip
    nose, tail = np.tan(np.radians((NOSE, TAIL)))
    deck = s.length - s.trunk_lid_length
    grille = (COWL[1] - COWL[0] * hood - BUMPERS[0]) / (nose - hood)  # from the nose to the edge of the hood
    hatch = (DECK - s.trunk_lid_length * lid - BUMPERS[1]) / (tail - lid)  # from the edge of the trunk lid to the tail
    corners = (  # where each panel begins, and how far from there the rounding reaches
        (0, s.ground_clearance + RAMP * ramp, 60),
        (RAMP, s.ground_clearance, 60),
        (s.length - DIFFUSER, s.ground_clearance, 60),
        (s.length, s.ground_clearance + DIFFUSER * diffuser, 60),
        (s.length, BUMPERS[1], 40),
        (s.length - hatch, BUMPERS[1] + hatch * tail, 40),
        (deck, DECK, 80),
        (deck - (s.roof_height - DECK) / window, s.roof_height, 150),
        (COWL[0] + (s.roof_height - COWL[1]) / windscreen, s.roof_height, 150),
        (*COWL, 80),
        (grille, BUMPERS[0] + grille * nose, 40),
        (0, BUMPERS[0], 40),
    )
    return Outline.of([(x, z) for x, z, _ in corners], [tangent for *_, tangent in corners])


def plan_view(s: Sizes) -> Outline:
    """Outline of x, y: straight sides that draw in towards nose and tail, far beyond which they meet.

    Nose and tail themselves belong to the side view: a plane in two views would be rounded away.
    """
    half = s.width / 2
    right = []
    for first, second, slope in ((700.0, 200.0, 8.0), (600.0, 160.0, 6.0)):
        drawn = half - (first - second) * np.tan(np.radians(slope))
        right.append(((second - drawn, 0.0, 0), (second, drawn, 90), (first, half, 150)))
    front, rear = right
    upper = [*front, *((s.length - x, y, t) for x, y, t in reversed(rear))]  # from the nose to the tail
    lower = [(x, -y, t) for x, y, t in upper[1:-1]]
    outline = [upper[0], *lower, upper[-1], *reversed(upper[1:-1])]
    return Outline.of([(x, y) for x, y, _ in outline], [t for *_, t in outline])


@dataclass(frozen=True, eq=False)
class Solid:
    """The car as a field: negative inside, zero on its surface, the distance to each view's planes near them."""

    sizes: Sizes
    side: Outline  # of x, z
    plan: Outline  # of x, y

    @classmethod
    def of(cls, sizes: Sizes) -> Solid:
        """The solid of these sizes."""
        return cls(sizes, side_view(sizes), plan_view(sizes))

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Values (M,) and gradients (M, 3) at `points` (M, 3)."""
        value, gradient = self.at(*points.T)
        return value, np.stack(np.broadcast_arrays(*gradient), axis=-1)

    def at(self, x: Array, y: Array, z: Array) -> Field:
        """Values and gradients, of the shape that `x`, `y`, `z` are broadcast to: points, or a grid by open axes."""
        s = self.sizes
        sense, y = np.sign(y), np.abs(y)
        lean = np.radians(s.greenhouse_angle)
        inward, up = np.cos(lean), np.sin(lean)
        side, (side_x, side_z) = self.side.distance(x, z)
        plan, (plan_x, plan_y) = self.plan.distance(x, y)
        body = common(
            EDGE,
            (side, (side_x, 0.0, side_z)),
            (plan, (plan_x, plan_y, 0.0)),
            ((y - s.width / 2) * inward + (z - BELT) * up, (0.0, inward, up)),
        )
        axle = np.where(x < s.front_overhang + s.wheelbase / 2, s.front_overhang, s.front_overhang + s.wheelbase)
        ahead, above = x - axle, z - (s.wheel_radius - PATCH)
        reach = np.maximum(np.hypot(ahead, above), np.finfo(float).tiny)
        radial = (ahead / reach, 0.0, above / reach)
        inner, outer = (s.track - TYRE) / 2, (s.track + TYRE) / 2
        tyre = common(
            SHOULDER,
            (reach - s.wheel_radius, radial),
            (inner - y, (0.0, -1.0, 0.0)),
            (y - outer, (0.0, 1.0, 0.0)),
        )
        tyre = common(0.0, tyre, (-z, (0.0, 0.0, -1.0)))
        arch = common(
            SHOULDER,
            (reach - s.wheel_radius - GAP, radial),
            (outer - DEPTH - y, (0.0, -1.0, 0.0)),
        )
        value, (gx, gy, gz) = joined(common(SHOULDER, body, outside(arch)), tyre)
        return value, (gx, gy * sense, gz)


def grid(s: Sizes, edge: float) -> tuple[Array, Array, Array]:
    """Axes of the half with y ≥ 0: steps of `edge` about the wheels, `COARSER` times that elsewhere."""
    wide = COARSER * edge
    reach = s.wheel_radius + GAP + SHOULDER
    outer = (s.track + TYRE) / 2
    return (
        _steps(
            (-wide, wide),
            (s.front_overhang - reach, edge),
            (s.front_overhang + reach, wide),
            (s.front_overhang + s.wheelbase - reach, edge),
            (s.front_overhang + s.wheelbase + reach, wide),
            (s.length + wide, 0),
        ),
        _steps((0, wide), (outer - DEPTH - SHOULDER, FINER * edge), (max(s.width / 2, outer) + wide, 0)),
        _steps((-wide, edge), (s.wheel_radius - PATCH + reach, wide), (s.roof_height + wide, 0)),
    )


def _steps(*starts: tuple[float, float]) -> Array:
    """A rising axis from the first start to the last: between two, equal steps of about the size beside the first."""
    parts = []
    for (first, size), (last, _) in pairwise(starts):
        count = max(1, round((last - first) / size))
        parts.append(np.linspace(first, last, count, endpoint=False))
    return np.concatenate([*parts, [starts[-1][0]]])
