"""Wheels: slices at the height of the tyres, and circles fitted in their planes (paper, appendix H)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError

from .axes import check_axes
from .example import simple_car
from .facets import Facets, extent, middle, section
from .fits import Circle, circle, line
from .pieces import measure
from .quantity import Number, Quantity, maximum, mean, sqrt
from .vehicle import ADVICE, Vehicle, clearance

if TYPE_CHECKING:
    from trimesh import Trimesh

HEIGHTS = (
    0.35,
    0.43,
    0.5,
    0.57,
    0.65,
)  # where tyres are sliced, in ground clearances: between ground and underbody
TREAD, OUTER = (
    0.22,
    (0.13, 0.37),
)  # where circles are sought, in widths of the tyre outward of its middle
COVERED = 0.3  # of the band between, by faces that lie in it: enough to fit to
LAYER = 1e-3  # of the width: how deep a tyre's flank is
FLAT = 3e-4  # of the length: what belongs to the flat of a tread
LONGEST, WIDEST = 0.2, 0.3  # of the vehicle's length and width: more in one slice is no tyre
SMALLEST, LARGEST = 0.04, 0.14  # of the vehicle's length: expected radii
PATCH = 0.1  # of the radius: how far up a tyre may be pressed flat by the ground
RINGS = (0.1, 0.05, 0.02, 0.01)  # of the radius: what is near a circle, from the first guess to the last fit
MEET = 0.2  # of the ground clearance: how far above and below the underbody its corner with a tyre may be rounded
ROUND = 0.25  # of the full circle that has to be seen to fit one; less tells less than the chords do
UPRIGHT = 0.7  # of the radius: the least height of an axle
CORNERS = (("front", "left"), ("front", "right"), ("rear", "left"), ("rear", "right"))


@dataclass(frozen=True, eq=False)
class Wheel:
    """One wheel: where its axle is along the vehicle, its middle plane, its radius."""

    x: Quantity
    y: Quantity
    radius: Quantity


@measure(simple_car, check_axes, wheelbase="L", track_front="L", track_rear="L", radius_front="L", radius_rear="L")
def wheels(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Distance of the axles along the vehicle and of the wheels across it, and radii; means of left and right.

    Below the body tyres stand free. There level slices show them one by one: how wide each is and where its middle
    plane lies, and from the chords where its axle is and how large it is. Where a quarter of the tyre or more is to be
    seen in a plane towards its outer face, a circle is fitted there, its flattened contact with the ground left out.
    """
    found = all_wheels(Vehicle.of(mesh, forward, up))
    front_left, front_right, rear_left, rear_right = (found[corner] for corner in CORNERS)
    return {
        "wheelbase": mean([rear_left.x, rear_right.x]) - mean([front_left.x, front_right.x]),
        "track_front": front_right.y - front_left.y,
        "track_rear": rear_right.y - rear_left.y,
        "radius_front": mean([front_left.radius, front_right.radius]),
        "radius_rear": mean([rear_left.radius, rear_right.radius]),
    }


def all_wheels(body: Vehicle) -> dict[tuple[str, str], Wheel]:
    """The four wheels. Raises MeasureError naming the one that is not there."""
    free = clearance(body, body.centre)
    slices = [(share, section(body.shape, "z", body.ground + share * free)) for share in HEIGHTS]
    return {corner: _wheel(body, free, slices, *corner) for corner in CORNERS}


def _wheel(body: Vehicle, free: Quantity, slices: list[tuple[float, Facets]], end: str, side: str) -> Wheel:
    name = f"{end} {side} wheel"
    half, across = float(body.station(0.5)), float(body.middle)
    far = math.inf
    x = (-far, half) if end == "front" else (half, far)
    y = (-far, across) if side == "left" else (across, far)
    prints = [(share * free, cut.between(x=x, y=y)) for share, cut in slices]
    length, width = float(body.length), float(np.ptp(body.whole.corners[..., 1]))
    if any(len(cut) == 0 for _, cut in prints):
        raise MeasureError(f"wheels: expected a {name} below the body, got nothing there; {ADVICE}")
    fore, aft = ([_tread(cut, towards, FLAT * length, name) for _, cut in prints] for towards in ("-x", "x"))
    chords = [back - front for front, back in zip(fore, aft, strict=True)]
    breadths = [float(extent(cut, "y")) for _, cut in prints]
    longest, widest = max(map(float, chords)), max(breadths)
    if longest > LONGEST * length or widest > WIDEST * width:
        raise MeasureError(
            f"wheels: expected a {name} that stands free below the body, got {longest:.6g} by {widest:.6g} there"
        )
    plane = mean([middle(cut, "y", LAYER * width) for _, cut in prints])
    x_axle = mean([*fore, *aft])
    axle, radius = _by_chords([h for h, _ in prints], [chord / 2 for chord in chords])
    if not float(axle) > UPRIGHT * float(radius):
        raise MeasureError(f"wheels: expected a round {name}, got something {longest:.6g} long with upright sides")
    _expected(float(radius), length, name)
    tyre = float(np.median(breadths)) * (-1 if side == "left" else 1)
    place = (float(x_axle), float(body.ground + axle))
    rim = _by_circle(body, plane, tyre, place, float(radius), float(free))
    found = Wheel(x_axle, plane, radius) if rim is None else Wheel(rim.centre[0], plane, rim.radius)
    _expected(float(found.radius), length, name)
    return found


def _tread(cut: Facets, towards: str, within: float, name: str) -> Quantity:
    """Where along the vehicle a tyre ends in a slice: the flat of its tread, not the far one's inner side."""
    amid = float(middle(cut, "x"))
    half = cut.between(x=(-math.inf, amid) if towards == "-x" else (amid, math.inf))
    return line(half.facing(towards, 25).required(f"a {name} with a tread", ADVICE), within).point[0]


def _by_chords(heights: list[Quantity], halves: list[Quantity]) -> tuple[Quantity, Quantity]:
    """Height of the axle and radius, from half the chords that level slices show, by least squares.

    A half chord c at height h obeys c² + h² = radius² − axle² + 2 axle h, also where the ground presses the tyre flat.
    """
    squares = [c * c + h * h for c, h in zip(halves, heights, strict=True)]
    level, square = mean(heights), mean(squares)
    along = mean([(h - level) * (s - square) for h, s in zip(heights, squares, strict=True)])
    axle = along / mean([(h - level) * (h - level) for h in heights]) / 2
    return axle, sqrt(maximum(square - 2 * axle * level + axle * axle, 0.0))


def _expected(radius: float, length: float, name: str) -> None:
    if not SMALLEST * length < radius < LARGEST * length:
        raise MeasureError(
            f"wheels: expected a {name} of radius {SMALLEST * length:.6g} to {LARGEST * length:.6g}, got {radius:.6g}"
        )


def _by_circle(
    body: Vehicle, plane: Quantity, tyre: float, place: tuple[float, float], radius: float, free: float
) -> Circle | None:
    """The tyre's circle, if enough of it is seen: in a section, and at the tread's own vertices where faces are small.

    Vertices lie on the surface; where a section crosses edges between them it runs inside a round one.
    """
    x, _ = place
    outer = sorted(float(plane) + share * tyre for share in OUTER)
    span = (x - 1.5 * radius, x + 1.5 * radius)
    cut = section(body.shape, "y", plane + TREAD * tyre).between(x=span)
    try:
        rough = _rim(_outward(body, cut, place, radius, free), place, radius)
    except MeasureError:
        return None
    seen = float(rough.facets.size.sum()) / (2 * math.pi * float(rough.radius))
    if seen < ROUND:
        return None
    place, radius = (float(rough.centre[0]), float(rough.centre[2])), float(rough.radius)
    y = body.whole.corners[..., 1]
    inside = np.asarray((y > outer[0]) & (y < outer[1])).all(axis=1)
    band = body.whole.where(np.asarray(inside)).between(x=span)
    tread = _outward(body, band, place, radius, free)
    covered = float(tread.size.sum()) / (seen * 2 * math.pi * radius * (outer[1] - outer[0]))
    return _rim(tread, place, radius) if covered > COVERED else rough


def _rim(tread: Facets, place: tuple[float, float], radius: float) -> Circle:
    """The circle of a tyre near `place` (x, z): fitted to what is near the last one, nearer each time."""
    for near in RINGS:
        off = np.linalg.norm(tread.middles[:, [0, 2]] - np.array(place), axis=1) - radius
        found = circle(tread.where(np.abs(off) < near * radius), axis="y")
        place, radius = (float(found.centre[0]), float(found.centre[2])), float(found.radius)
    return found


def _outward(body: Vehicle, facets: Facets, place: tuple[float, float], radius: float, free: float) -> Facets:
    """What may be a tyre's tread: facing away from the axle, neither at the ground nor in a corner with the body."""
    from_axle = facets.middles[:, [0, 2]] - np.array(place)
    up = facets.middles[:, 2] - float(body.ground)
    away = (from_axle * facets.normals[:, [0, 2]]).sum(axis=1) > 0.7 * np.linalg.norm(from_axle, axis=1)
    return facets.where(away & (up > PATCH * radius) & (np.abs(up - free) > MEET * free))
