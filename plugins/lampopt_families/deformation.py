"""One free-form deformation of a body: where it acts, what it does there, how softly it ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Parameter

AXES = ("along", "across", "up")
BOX = ((0.0, 1.0), (-1.0, 1.0), (0.0, 1.0))  # the body's own, in fractions
KINDS = ("move", "stretch", "tilt", "turn")
DIRECTIONS: Mapping[str, tuple[int, int]] = MappingProxyType(  # body axis and sense
    {
        "rear": (0, 1), "front": (0, -1), "right": (1, 1), "left": (1, -1),
        "out": (1, 1), "in": (1, -1), "up": (2, 1), "down": (2, -1),
    }
)  # fmt: skip
LARGEST = 1e100  # as of a mesh's coordinates
Vector = tuple[float, float, float]
Region = tuple[float, float]


@dataclass(frozen=True)
class Deformation:
    """A named deformation, in fractions of the body's box: along 0 (nose) to 1 (tail), across −1 to 1, up 0 to 1.

    Parameters
    ----------
    name
        The parameter's name.
    kind
        `move`: by the value in `direction`. `stretch`: the region grows by the value along the axis of `direction`,
        what lies beyond it goes with its ends. `tilt`: surfaces lean to `direction` by as many degrees more, going
        `over` the region. `turn`: rotated by as many degrees, right-handed, about a line in `direction` through
        `about`.
    direction
        rear, front, up, down, and in or out (to and from the middle plane) with `symmetric`, left or right without
        and for the axis of a `turn`; for `move` and `turn` a vector (rear, right, up) as well.
    low, high
        Range; 0 is the body as it is. Lengths in the body's unit, angles in degrees.
    along, across, up
        The region: all of the effect from the first to the second fraction. With `symmetric`, `across` counts from the
        middle (0) to either side (1).
    falloff
        How far beyond the region the effect ends, by axis, in fractions; nothing ends at the body's own box.
    over
        Of a tilt: a direction. It hinges at the end of the region that is met first, and has all of its slope one
        falloff past it.
    about
        Of a turn: fractions of a point of its axis.
    fixed
        Of a stretch: the fraction of the region that stays in place. With `symmetric`, the middle does.
    symmetric
        The same on the left as on the right: given for the right, mirrored.

    Raises
    ------
    InputError
        If it describes no smooth field.
    """

    name: str
    kind: str
    direction: str | Vector
    low: float
    high: float
    along: Region = (0.0, 1.0)
    across: Region = (-1.0, 1.0)
    up: Region = (0.0, 1.0)
    falloff: Vector = (0.15, 0.15, 0.15)
    over: str = ""
    about: Vector = (0.5, 0.0, 0.5)
    fixed: float = 0.5
    symmetric: bool = True

    def __post_init__(self) -> None:
        Parameter(self.name)
        if any(c in self.name for c in ",:"):
            raise InputError(f"{self}: expected a name without ',' and ':'")
        if self.kind not in KINDS:
            raise InputError(f"{self}: kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        self._check_numbers()
        self._check_directions()
        self._check_ends()

    def __str__(self) -> str:
        return f"deformation {self.name!r}"

    @property
    def angle(self) -> bool:
        """Whether its value is an angle [deg]; else it is a length."""
        return self.kind in ("tilt", "turn")

    @property
    def region(self) -> tuple[Region, Region, Region]:
        """Along, across (of the right half with `symmetric`), up."""
        low, high = self.across
        if self.symmetric and low < 0:
            low, high = (0.0, max(-low, high)) if high > 0 else (-high, -low)
        return self.along, (low, high), self.up

    @property
    def vector(self) -> Array:
        """(3,) unit vector of `direction` in body axes, on the right half."""
        if isinstance(self.direction, str):
            axis, sense = DIRECTIONS[self.direction]
            unit: Array = np.eye(3)[axis]
            unit *= sense
            return unit
        unit = np.array(self.direction, float)
        unit /= np.linalg.norm(unit)
        return unit

    def ends(self, axis: int) -> tuple[bool, bool]:
        """Whether the region ends inside the body: at its low, at its high end."""
        (low, high), (first, last) = self.region[axis], BOX[axis]
        return low > (0.0 if axis == 1 and self.symmetric else first), high < last

    def _check_numbers(self) -> None:
        groups = {
            "low": (self.low,), "high": (self.high,), "fixed": (self.fixed,), "falloff": self.falloff,
            "about": self.about, "along": self.along, "across": self.across, "up": self.up,
        }  # fmt: skip
        for what, values in groups.items():
            count = 3 if what in ("falloff", "about") else 2 if what in AXES else 1
            if len(values) != count or not all(finite(value) for value in values):
                raise InputError(f"{self}: {what}: expected {count} finite numbers, got {values!r}")
        if not self.low <= 0 <= self.high or self.low == self.high:
            raise InputError(
                f"{self}: expected a range that holds 0, the body as it is, got {self.low:g} to {self.high:g}"
            )
        if not 0 <= self.fixed <= 1:
            raise InputError(f"{self}: fixed: expected 0 to 1, got {self.fixed:g}")
        for name, (low, high), (first, last), falloff in zip(AXES, self.region, BOX, self.falloff, strict=True):
            if not (low < high and low < last and high > first):
                raise InputError(
                    f"{self}: {name}: expected low < high, partly within {first:g} to {last:g}, got {low:g} to {high:g}"
                )
            if falloff < 0:
                raise InputError(f"{self}: falloff {name}: expected at least 0, got {falloff:g}")

    def _check_directions(self) -> None:
        named = isinstance(self.direction, str)
        if named and self.direction not in DIRECTIONS:
            raise InputError(f"{self}: direction: expected one of {', '.join(DIRECTIONS)}, got {self.direction!r}")
        if not named and not (len(self.direction) == 3 and all(map(finite, self.direction)) and any(self.direction)):
            raise InputError(f"{self}: direction: expected three numbers, not all 0, got {self.direction!r}")
        if not named and self.kind in ("stretch", "tilt"):
            raise InputError(f"{self}: direction: a {self.kind} takes one of {', '.join(DIRECTIONS)}, no vector")
        if self.kind == "tilt":
            if self.over not in DIRECTIONS or DIRECTIONS[self.over][0] == int(np.abs(self.vector).argmax()):
                raise InputError(f"{self}: over: expected a direction across {self.direction!r}, got {self.over!r}")
        elif self.over:
            raise InputError(f"{self}: over: belongs to a tilt, this is a {self.kind}")
        mirrored = self.symmetric and self.kind != "turn"  # an axis is named as it is on the right
        taken = {"left", "right"} if mirrored else {"in", "out"}
        if wrong := sorted(taken & {self.over, *([self.direction] if named else [])}):
            other = "in and out" if mirrored else "left and right"
            because = "with symmetric = true" if mirrored else "of a turn" if self.symmetric else "without symmetric"
            raise InputError(f"{self}: {wrong[0]!r}: the sides {because} are called {other}")

    def _check_ends(self) -> None:
        for axis, name in enumerate(AXES):
            hinged = self.kind == "tilt" and DIRECTIONS[self.over][0] == axis
            if (hinged or any(self.ends(axis))) and self.falloff[axis] == 0:
                raise InputError(f"{self}: falloff {name}: expected more than 0 where a region ends inside the body")
        if not self.symmetric:
            return
        (low, _), falloff = self.region[1], self.falloff[1]
        if 0 < low < falloff:
            raise InputError(
                f"{self}: falloff across: {falloff:g} reaches past the middle, {low:g} away: lower it, or begin at 0"
            )
        sideways = abs(self.vector[1]) < 1 if self.kind == "turn" else self.vector[1] != 0
        if sideways and self.kind != "stretch" and low == 0:
            raise InputError(
                f"{self}: would tear the halves apart at the middle: begin the region beyond it, as in "
                "across = [0.5, 1] with a falloff across of at most 0.5"
            )


def finite(value: object) -> bool:
    """Whether `value` is a number within `LARGEST`."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST
