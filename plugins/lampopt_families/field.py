"""The displacement field of a deformation and its derivatives, at any points; twice continuously differentiable."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .body import Body
from .deformation import AXES, DIRECTIONS, Deformation

FACING = math.sqrt(0.5)  # cosine: a tilt's surface is what faces its direction within 45°
CORE = 0.5  # of a tilt's slope: what takes less of it is not its surface
LEAST = 1e-5  # share of the body's area that a tilt's surface must have
STEEPEST = 80.0  # [deg] a slope that a tilt may make
Gradient = dict[int, Array]  # (M,) by body axis; those that are 0 left out


def step(x: Array, width: float) -> tuple[Array, Array]:
    """0 up to x = 0, 1 from `width` on, between them the quintic with no slope or curvature at its ends; and d/dx."""
    u = np.clip(x / width, 0, 1)
    square = u * u
    return square * u * (10 + u * (6 * u - 15)), 30 / width * square * (1 - u) ** 2


def ramp(x: Array, width: float) -> Array:
    """The integral of `step`: 0 up to x = 0, x − width/2 from `width` on."""
    if width == 0:
        return np.maximum(x, 0)
    u = np.clip(x / width, 0, 1)
    square = u * u
    return width * square * square * (2.5 + u * (u - 3)) + np.maximum(x - width, 0)


@dataclass(frozen=True, eq=False)
class Places:
    """Points of a body: fractions (3, M), and whether each is on the right (1) or the left (−1) of the middle (M,)."""

    fractions: Array
    side: Array

    @classmethod
    def of(cls, body: Body, points: Array) -> Places:
        """Those of `points` (M, 3) [unit]."""
        fractions = np.ascontiguousarray(body.fractions(points).T)
        return cls(fractions, np.where(fractions[1] < 0, -1.0, 1.0))

    def mirrored(self, symmetric: bool) -> Array:
        """The fractions (3, M), those on the left mirrored to the right where the deformation is `symmetric`."""
        along, across, up = self.fractions
        return np.stack([along, np.abs(across), up]) if symmetric else self.fractions


@dataclass(frozen=True, eq=False)
class Field:
    """A deformation of one body.

    Parameters
    ----------
    deformation
        What it is.
    size
        (3,) length, half width, height of the body [unit].
    slope
        Of a tilt: tan of the lean that its surface has on the body as it is.
    """

    deformation: Deformation
    size: Array
    slope: float = 0.0

    @classmethod
    def of(cls, deformation: Deformation, body: Body) -> Field:
        """The field on `body`; a tilt finds out how its surface leans there.

        The mean slope of a surface is that of its faces' summed area vectors, each by how much of the tilt it takes.

        Raises
        ------
        InputError
            If a tilt's region has no surface that faces its direction.
        """
        field = cls(deformation, body.size)
        if deformation.kind != "tilt":
            return field
        places = Places.of(body, body.centroids)
        fractions, areas = places.mirrored(deformation.symmetric), body.areas
        if deformation.symmetric:
            areas[:, 1] *= places.side
        axis, sense = DIRECTIONS[deformation.over]
        towards, size = areas @ deformation.vector, np.linalg.norm(areas, axis=1)
        share = field._weight(fractions, without=axis)[0] * field._hinged(fractions)[1]
        # Faces of either sense count, so that the inner side of a sheet, or a mesh turned inside out, is no harm.
        share = np.where((share >= CORE) & (np.abs(towards) > FACING * size), share * np.sign(towards), 0)
        total = float(share @ towards)
        if total < LEAST * size.sum():
            raise InputError(
                f"{deformation}: no surface in its region faces {deformation.direction!r}, so nothing to tilt: change "
                "the region, or leave it out (deformations=...)"
            )
        return cls(deformation, body.size, -float(share @ areas[:, axis]) * sense / total)

    def add(self, value: float, places: Places, moved: Array, jacobian: Array) -> None:
        """Add what `value` does to `moved` (3, M) [unit], and its derivatives to `jacobian` (3, 3, M), by body axes.

        Raises
        ------
        InputError
            If a tilt would make its surface steeper than 80 degrees.
        """
        d = self.deformation
        fractions = places.mirrored(d.symmetric)
        near = self._near(fractions)
        fractions = fractions[:, near]
        # What is given for the right is mirrored to the left: components across and derivatives by it change sign.
        mirror = (1.0, places.side[near] if d.symmetric else 1.0, 1.0)
        if d.kind == "turn":
            components = self._turned(value, fractions)
        else:
            amount, gradient = self._amount(value, fractions)
            components = {
                axis: (part * amount, {k: part * slope for k, slope in gradient.items()})
                for axis, part in enumerate(d.vector.tolist())
                if part
            }
        for axis, (component, gradient) in components.items():
            moved[axis, near] += mirror[axis] * component
            for k, slope in gradient.items():
                jacobian[axis, k, near] += slope if k == axis else mirror[axis] * mirror[k] * slope

    def _near(self, fractions: Array) -> Array | slice:
        """Which points the field moves, as an index: those in its region and falloff."""
        d, inside = self.deformation, None
        for axis, ((low, high), width) in enumerate(zip(d.region, d.falloff, strict=True)):
            ends_low, ends_high = d.ends(axis)
            if d.kind == "stretch" and axis == DIRECTIONS[str(d.direction)][0]:
                continue  # what lies beyond it is moved too
            for ends, within in (
                (ends_low, fractions[axis] > low - width),
                (ends_high, fractions[axis] < high + width),
            ):
                if ends:
                    inside = within if inside is None else inside & within
        return slice(None) if inside is None else np.flatnonzero(inside)

    def _amount(self, value: float, fractions: Array) -> tuple[Array, Gradient]:
        """How far along the vector (M,), and by how much more along each axis."""
        d = self.deformation
        if d.kind == "move":
            weight, gradient = self._weight(fractions)
            return value * weight, {k: value * slope for k, slope in gradient.items()}
        if d.kind == "tilt":
            axis, sense = DIRECTIONS[d.over]
            factor, (profile, slope) = self._factor(value), self._hinged(fractions)
            slope = sense * slope
        else:
            axis, sense = DIRECTIONS[str(d.direction)]
            factor, (profile, slope) = sense * value, self._stretched(fractions[axis], axis)
        weight, gradient = self._weight(fractions, without=axis)
        slopes = {k: factor * profile * across for k, across in gradient.items()}
        return factor * weight * profile, {axis: factor * weight * slope, **slopes}

    def _factor(self, value: float) -> float:
        """A tilt's shear: from the slope that is there to one `value` degrees more."""
        angle = math.degrees(math.atan(self.slope)) + value
        if abs(angle) > STEEPEST:
            raise InputError(
                f"{self.deformation.name} = {value:g}: on a surface that leans {angle - value:.1f} deg already leads "
                f"beyond {STEEPEST:g} deg: expected a value nearer to 0"
            )
        return math.tan(math.radians(angle)) - self.slope

    def _hinged(self, fractions: Array) -> tuple[Array, Array]:
        """A tilt's lever [unit] and its slope along `over`: 0 up to the hinge, 1 from one falloff past it."""
        d = self.deformation
        axis, sense = DIRECTIONS[d.over]
        first, last = d.region[axis][::sense]
        size, width = self.size[axis], d.falloff[axis] * self.size[axis]
        way = sense * (fractions[axis] - first) * size
        lever, slope = ramp(way, width), step(way, width)[0]
        if d.ends(axis)[::sense][1]:  # beyond its far end it comes to an end as any other
            past, steepness = step(sense * (fractions[axis] - last) * size, width)
            lever, slope = lever * (1 - past), slope * (1 - past) - lever * steepness
        return lever, slope

    def _stretched(self, fraction: Array, axis: int) -> tuple[Array, Array]:
        """How much of a stretch has been passed, 0 to 1, less the part that is fixed; and its slope [1/unit]."""
        d = self.deformation
        (low, high), (ends_low, ends_high) = d.region[axis], d.ends(axis)
        below, above = (d.falloff[axis] if ends else 0.0 for ends in (ends_low, ends_high))
        total = high - low + (below + above) / 2
        passed = (ramp(fraction - low + below, below) - ramp(fraction - high, above)) / total
        rising = step(fraction - low + below, below)[0] if ends_low else np.ones_like(fraction)
        falling = step(fraction - high, above)[0] if ends_high else 0.0
        slope = (rising - falling) / (total * self.size[axis])
        if axis == 1 and d.symmetric:  # from the middle outward, half of it on either side
            return passed / 2, slope / 2
        return passed - d.fixed, slope

    def _weight(self, fractions: Array, without: int | None = None) -> tuple[Array, Gradient]:
        """1 in the region, smoothly 0 one falloff beyond it, not ended along axis `without`; its gradient [1/unit]."""
        d, factors, count = self.deformation, dict[int, tuple[Array, Array]](), fractions.shape[1]
        for axis in range(len(AXES)):
            (low, high), (ends_low, ends_high), width = d.region[axis], d.ends(axis), d.falloff[axis]
            if axis == without or not (ends_low or ends_high):
                continue
            value, slope = np.ones(count), np.zeros(count)
            if ends_low:
                value, slope = step(fractions[axis] - low + width, width)
            if ends_high:
                past, steepness = step(fractions[axis] - high, width)
                value, slope = value - past, slope - steepness
            factors[axis] = value, slope / self.size[axis]
        weight = math.prod((value for value, _ in factors.values()), start=np.ones(count))
        gradient = {
            axis: math.prod((value for k, (value, _) in factors.items() if k != axis), start=slope)
            for axis, (_, slope) in factors.items()
        }
        return weight, gradient

    def _turned(self, value: float, fractions: Array) -> dict[int, tuple[Array, Gradient]]:
        """A turn's components, each with its gradient, by body axis."""
        d = self.deformation
        x, y, z = d.vector
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = math.radians(value)
        change = math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross  # Rodrigues, less the identity
        moved = change @ ((fractions - np.array(d.about)[:, None]) * self.size[:, None])
        weight, gradient = self._weight(fractions)
        nothing = np.zeros_like(weight)
        return {
            i: (weight * moved[i], {k: weight * change[i, k] + moved[i] * gradient.get(k, nothing) for k in range(3)})
            for i in range(3)
        }
