"""A rectangular plate with a circular through-hole (paper, appendix R)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

if TYPE_CHECKING:
    from trimesh import Trimesh

NAMES = ("length", "width", "thickness", "hole_radius", "hole_x", "hole_y")
LOW = (2.0, 1.4, 0.2, 0.15, -0.10, -0.08)  # [m]
HIGH = (3.0, 2.0, 0.3, 0.25, 0.10, 0.08)  # [m]
DESIGNS = ("ends", "lhs", "sobol", "random")
MOST = {"count": 100_000, "seed": 2**63 - 1, "segments": 100_000}  # beyond lies a slip, or a machine out of memory


@dataclass(frozen=True)
class PlateSource:
    """Plates in x-y, thickness along z, middle at the origin; all lengths in metres.

    Parameters
    ----------
    count
        How many exemplars; 13 for the design `ends`.
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

    count: int = 13
    design: str = "ends"
    seed: int = 0
    segments: int = 128

    def __post_init__(self) -> None:
        for name, most in MOST.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value > most:
                raise InputError(f"plate: {name}: expected a whole number up to {most:,}, got {value!r:.100}")
        if self.design not in DESIGNS:
            raise InputError(f"plate: design: expected one of {', '.join(DESIGNS)}, got {self.design!r}")
        if self.design == "ends" and self.count != 2 * len(NAMES) + 1:
            raise InputError(
                f"plate: design 'ends' has {2 * len(NAMES) + 1} exemplars, got count={self.count}; "
                "for another count choose lhs, sobol or random"
            )
        if self.count < 1:
            raise InputError(f"plate: count: expected at least 1, got {self.count}")
        if self.seed < 0:
            raise InputError(f"plate: seed: expected 0 or more, got {self.seed}")
        if self.segments < 8:
            raise InputError(f"plate: segments: expected at least 8, got {self.segments}")

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access. Names say the end, or count the draws."""
        if self.design == "ends":
            names, parameters = _ends()
        else:
            width = len(str(self.count - 1))
            names = tuple(f"plate_{i:0{width}d}" for i in range(self.count))
            parameters = _draws(self.design, self.count, self.seed)
        return Exemplars(
            parameters=parameters,
            space=tuple(Parameter(name, "m") for name in NAMES),
            meshes=Plates(parameters, self.segments),
            names=names,
            unit="m",
            measured={name: f"plate.{name}" for name in NAMES},
            mesh_at=partial(plate_mesh, segments=self.segments),
        )


@dataclass(frozen=True, eq=False)
class Plates(Sequence["Trimesh"]):
    """The meshes at `parameters` (N, 6), made on access."""

    parameters: Array
    segments: int

    def __len__(self) -> int:
        return len(self.parameters)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> Plates: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return Plates(self.parameters[index], self.segments)
        return plate_mesh(self.parameters[index], segments=self.segments)


def _ends() -> tuple[tuple[str, ...], Array]:
    middle = (np.array(LOW) + np.array(HIGH)) / 2
    rows, names = [middle], ["middle"]
    for k, name in enumerate(NAMES):
        for end, values in (("low", LOW), ("high", HIGH)):
            rows.append(np.where(np.arange(len(NAMES)) == k, values[k], middle))
            names.append(f"{name}_{end}")
    return tuple(names), np.array(rows)


def _draws(design: str, count: int, seed: int) -> Array:
    from scipy.stats import qmc

    d = len(NAMES)
    if design == "lhs":
        unit = qmc.LatinHypercube(d, rng=seed).random(count)
    elif design == "sobol":  # whole powers of two keep the sequence balanced; its first `count` points are taken
        unit = qmc.Sobol(d, rng=seed).random_base2((count - 1).bit_length())[:count]
    else:
        unit = np.random.default_rng(seed).random((count, d))
    return np.asarray(qmc.scale(unit, LOW, HIGH), float)


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
    values = np.asarray(parameters, float)
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
