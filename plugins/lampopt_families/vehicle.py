"""The eight deformations of a vehicle body that `morph` knows by name."""

from __future__ import annotations

from .body import Body
from .deformation import Deformation

NAMES = ("length", "width", "roof", "greenhouse", "ramp", "diffuser", "trunk", "hood")


def vehicle(body: Body) -> tuple[Deformation, ...]:
    """The eight, with ranges in the unit of `body` and in degrees; those of lengths go with its size, two digits."""
    length, half_width, height = (float(size) for size in body.size)

    def share(fraction: float, size: float) -> float:
        return float(f"{fraction * size:.2g}")

    return (
        Deformation("length", "stretch", "rear", share(-0.07, length), share(0.07, length)),
        Deformation("width", "stretch", "out", share(-0.16, half_width), share(0.16, half_width)),
        Deformation(
            "roof", "move", "up", share(-0.07, height), share(0.10, height),
            along=(0.42, 0.72), up=(0.95, 1.0), falloff=(0.28, 0.0, 0.50),
        ),
        Deformation(
            "greenhouse", "tilt", "in", -5.0, 5.0, over="up",
            along=(0.28, 0.90), across=(0.60, 1.0), up=(0.50, 1.0), falloff=(0.15, 0.60, 0.12),
        ),
        Deformation(
            "ramp", "tilt", "up", -3.0, 6.0, over="front",
            along=(0.0, 0.16), up=(0.0, 0.15), falloff=(0.06, 0.0, 0.35),
        ),
        Deformation(
            "diffuser", "tilt", "up", -3.0, 6.0, over="rear",
            along=(0.80, 1.0), up=(0.0, 0.20), falloff=(0.07, 0.0, 0.40),
        ),
        Deformation(
            "trunk", "tilt", "down", -5.0, 5.0, over="rear",
            along=(0.78, 1.0), up=(0.60, 1.0), falloff=(0.08, 0.0, 0.40),
        ),
        Deformation(
            "hood", "tilt", "down", -4.0, 4.0, over="front",
            along=(0.0, 0.25), up=(0.50, 1.0), falloff=(0.08, 0.0, 0.35),
        ),
    )  # fmt: skip
