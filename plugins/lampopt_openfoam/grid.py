"""The grid: domain, background cells, wake boxes, and where the cells lie relative to the body.

All lengths are body lengths. A placement moves the cells without moving the ground or the plane of symmetry: the
origin is shifted along the wind by up to four of the finest cells, and the cells' width and height are changed by up to
3 %, which shifts the cells at a car's side and roof by a whole fine cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Literal

Level = Literal["coarse", "medium", "fine"]
Ground = Literal["fixed", "moving", "none"]

Entries = dict[str, float | str | list[float]]  # of `system/settings`

CELL: dict[Level, float] = {"coarse": 1 / 4, "medium": 1 / 8, "fine": 1 / 12}  # edge of a background cell
MOST: dict[Level, int] = {"coarse": 200_000, "medium": 1_500_000, "fine": 5_000_000}  # cells; more is a mistake
FINEST = 4  # refinements at the body: cells of 1/64, 1/128, 1/192 of its length
STRETCH = 0.06  # range of the cells' width and height over placements
UPSTREAM, DOWNSTREAM = 3.0, 7.0  # domain before the nose, and behind it
PLASTIC = 1.2207440846057596  # root of x⁴ = x + 1: its powers spread points of three coordinates evenly


def placement(number: int) -> tuple[float, float, float]:
    """Placement `number` (0, 1, ...) as three fractions from 0 to 1: a low-discrepancy sequence, all distinct."""
    x, y, z = ((0.5 + number * PLASTIC**-k) % 1 for k in (1, 2, 3))
    return x, y, z


@dataclass(frozen=True)
class Grid:
    """A grid around a body of length 1, nose at x = 0, middle plane y = 0, lowest point at `clearance`.

    Parameters
    ----------
    level
        How fine.
    number
        Of the placement.
    width, height
        Of the body, in its lengths.
    half
        One half, y > 0, with a plane of symmetry.
    ground, clearance
        How the ground moves; how high above it the lowest point is. "none": the body hangs in the open.
    """

    level: Level
    number: int
    width: float
    height: float
    half: bool
    ground: Ground
    clearance: float

    def settings(self) -> Entries:
        """The entries of `system/settings` that this grid sets."""
        cell = CELL[self.level]
        x, y, z = placement(self.number)
        dy, dz = (cell * (1 + STRETCH * (at - 0.5)) for at in (y, z))
        side, top = self.width / 2, self.height + max(self.clearance, 0.0)
        ny = ceil((1.5 + 2.5 * side) / cell)
        nz = ceil((1 + 3 * top) / cell)
        below = 0 if self.ground != "none" else ceil((1 + 2 * self.height) / cell)
        nx = round((UPSTREAM + DOWNSTREAM) / cell)
        x_min = -UPSTREAM - x * cell / 2 ** (FINEST - 2)
        z_min = -below * dz
        floor = z_min - cell  # boxes reach through the ground, where there is one
        if below:
            floor = -self.height
        boxes = {
            "near": ((-0.1, side + 0.1, top + 0.1), 1.2, 0.5),
            "wake": ((-0.3, 2 * side + 0.1, top + 0.25), 2.2, 1.0),
            "far": ((-0.8, 2 * side + 0.4, 2 * top + 0.35), 4.0, 2.0),
        }
        entries: Entries = {
            "xMin": x_min,
            "xMax": x_min + nx * cell,
            "yMin": 0.0 if self.half else -ny * dy,
            "yMax": ny * dy,
            "zMin": z_min,
            "zMax": nz * dz,
            "nx": nx,
            "ny": ny if self.half else 2 * ny,
            "nz": nz + below,
            "surfaceLevel": FINEST,
            "nearLevel": FINEST - 1,
            "wakeLevel": FINEST - 2,
            "farLevel": FINEST - 3,
            # in the air, upstream and aloft, on no face of any cell
            "inside": [x_min + 0.3141 * cell, (ny - 1 + 0.2718) * dy, (nz - 1 + 0.5772) * dz],
            "maxCells": MOST[self.level],
        }
        for name, ((before, beside, above), behind, depth) in boxes.items():
            entries[f"{name}Min"] = [before, -beside, floor * depth if below else floor]
            entries[f"{name}Max"] = [behind, beside, above]
        return entries
