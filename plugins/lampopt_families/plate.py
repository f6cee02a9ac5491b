"""A rectangular plate with a circular through-hole (paper, appendix R)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

from .parametric import Family, real

if TYPE_CHECKING:
    from trimesh import Trimesh

NAMES = ("length", "width", "thickness", "hole_radius", "hole_x", "hole_y")
LOW = (2.0, 1.4, 0.2, 0.15, -0.10, -0.08)  # [m]
HIGH = (3.0, 2.0, 0.3, 0.25, 0.10, 0.08)  # [m]
FINEST = 100_000  # segments; beyond lies a slip, or a machine out of memory


@dataclass(frozen=True)
class PlateSource:
    """Plates in x-y, thickness along z, middle at the origin; all lengths in metres.

    Parameters
    ----------
    count
        How many exemplars; 0 for 100, and 13 for the design `ends`, which has no other number.
    design
        `ends`: the middle of the range and each parameter's two ends, the paper's 13. `lhs`, `sobol`, `random`:
        `count` draws over the range by Latin hypercube, scrambled Sobol sequence, or independently.
    seed
        Of the draws.
    segments
        Corners of the hole's circle, which lie on it exactly: the hole's area falls short of the circle's by
        ``2 / 3 (pi / segments)^2``, 4e-4 at 128.

    Raises
    ------
    InputError
        For options that make no family.
    """

    count: int = 0
    design: str = "ends"
    seed: int = 0
    segments: int = 128

    def __post_init__(self) -> None:
        family(segments=self.segments).checked_options(self.count, self.design, self.seed)
        if isinstance(self.segments, bool) or not isinstance(self.segments, int) or not 8 <= self.segments <= FINEST:
            raise InputError(
                f"plate: segments: expected a whole number from 8 to {FINEST:,}, got {self.segments!r:.100}"
            )

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access. Names say the end, or count the draws."""
        return family(segments=self.segments).exemplars(self.count, self.design, self.seed)


def family(*, segments: int = 128) -> Family:
    """The plate as a `Family`: its parameters, their ranges, its mesh."""
    return Family(
        "plate",
        tuple(Parameter(name, "m") for name in NAMES),
        np.array(LOW),
        np.array(HIGH),
        "m",
        {name: f"plate.{name}" for name in NAMES},
        partial(plate_mesh, segments=segments),
    )


def plate_mesh(parameters: Array, *, segments: int = 128) -> Trimesh:
    """The true plate: watertight, genus 1, faces outward, corners exact.

    Parameters
    ----------
    parameters
        (6,) length, width, thickness, hole radius, hole centre x, y [m]; also far outside the family's range.
    segments
        Corners of the circle.

    Raises
    ------
    InputError
        If a size is not positive or the hole reaches the plate's edge, naming parameter and value.
    """
    from trimesh import Trimesh

    length, width, thickness, radius, x, y = _checked(parameters)
    n = segments
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length / 2, width / 2)
    angles = 2 * np.pi * np.arange(n) / n
    circle = np.column_stack([np.cos(angles), np.sin(angles)]) * radius + (x, y)
    # The ring between circle and rectangle: every chord of the circle is joined to the corner farthest along its
    # outward direction, which always sees it; where that corner changes, one more triangle takes the edge between.
    # Chord i runs from circle point i to i + 1; corners come in the same sense of rotation.
    middles = angles + np.pi / n
    corner = (np.column_stack([np.cos(middles), np.sin(middles)]) @ corners.T).argmax(axis=1)
    i, following = np.arange(n), (np.arange(n) + 1) % n
    ring = [np.column_stack([following, i, n + corner])]
    turn = corner != corner[following]
    ring.append(np.column_stack([following, n + corner, n + corner[following]])[turn])
    top = np.concatenate(ring)
    outline = np.concatenate([circle, corners])
    total = n + 4
    edge, next_edge = n + np.arange(4), n + (np.arange(4) + 1) % 4
    # Going up from the bottom edge start-end with the material on the left, these two triangles face outward.
    starts, ends = np.concatenate([edge, following]), np.concatenate([next_edge, i])
    walls = np.concatenate(
        [np.column_stack([starts, ends, ends + total]), np.column_stack([starts, ends + total, starts + total])]
    )
    vertices = np.concatenate([np.column_stack([outline, np.full(total, h)]) for h in (-thickness / 2, thickness / 2)])
    return Trimesh(vertices, np.concatenate([top + total, top[:, ::-1], walls]), process=False)


def _checked(parameters: Array) -> tuple[float, ...]:
    values = real("plate", parameters)
    if values.shape != (len(NAMES),):
        raise InputError(f"plate: expected parameters ({len(NAMES)},) {', '.join(NAMES)}, got shape {values.shape}")
    wrong = [
        f"{name}: expected {'a positive size' if k < 4 else 'a finite place'}, got {value:.6g} m"
        for k, (name, value) in enumerate(zip(NAMES, values, strict=True))
        if not np.isfinite(value) or (k < 4 and value <= 0)
    ]
    if not wrong:
        radius = values[3]
        wrong = [
            f"{NAMES[k]}: the hole of radius {radius:.6g} m at {values[k]:.6g} m reaches the edge at "
            f"{np.copysign(size / 2, values[k]):.6g} m"
            for k, size in ((4, values[0]), (5, values[1]))
            if abs(values[k]) + radius >= size / 2
        ]
    if wrong:
        raise InputError("plate: " + "; ".join(wrong))
    return tuple(values.tolist())
