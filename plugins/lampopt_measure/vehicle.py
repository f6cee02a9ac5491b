"""Overall sizes of a vehicle: length, width of the body, heights above the ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError

from .axes import check_axes, check_whole, oriented
from .example import simple_car
from .facets import Facets, Shape, extent, highest, lowest, middle, section, surface
from .fits import line
from .pieces import measure
from .quantity import Number, Quantity, mean, minimum

if TYPE_CHECKING:
    from trimesh import Trimesh

LAYER = 2e-5  # of the length: how deep an end is looked at
SIDE = 3e-4  # of the width: how deep a flank is
STATIONS = tuple(np.linspace(0.4031, 0.6173, 12))  # of the length, clear of the wheels
ALIKE = 0.01  # stations whose width is farther than this from the median one show a mirror or a handle
MOST = 0.25  # of the stations have to be as wide
UNDER = 0.5  # of the height: where an underbody is sought
LOWEST = 0.01  # of the height: an underbody no higher than that lies on the ground
WHEELS = 0.03  # of the height: what stands out farther than that above the middle of a body, fore and aft, is no roof
FLAT = 1e-6  # of the largest side: a body that is thinner is none
ROUGH = 1e-3  # of the length: what belongs to one level of the underbody
CENTRE = 1e-3  # of the width: how far beside the middle plane, along which meshes like to have edges, the centre is cut
ADVICE = "see that up and forward say where roof and nose point, and that faces point outward (else mesh.invert())"


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A vehicle seen along its own axes: x to the rear, y to the right, z up; where its box ends."""

    shape: Shape
    whole: Facets
    nose: Quantity
    tail: Quantity
    ground: Quantity
    top: Quantity
    middle: Quantity

    @classmethod
    def of(cls, mesh: Trimesh, forward: str, up: str) -> Vehicle:
        """Raises EmptyMesh, MeasureError, InputError."""
        shape = oriented(mesh, forward, up)
        whole = surface(shape).required("faces with an area")
        size = [float(np.ptp(whole.corners[..., axis])) for axis in range(3)]
        if min(size) <= FLAT * max(size):
            raise MeasureError("expected a body, got one of {:.6g} by {:.6g} by {:.6g}".format(*size))
        if size[2] > size[0]:
            raise MeasureError(
                f"expected a body that is longer than high, got {size[0]:.6g} along and {size[2]:.6g} up; say "
                "where its roof points by up="
            )
        check_whole(shape)
        layer = LAYER * size[0]
        ends = (lowest(whole, "x", layer), highest(whole, "x", layer), lowest(whole, "z", layer))
        return cls(shape, whole, *ends, highest(whole, "z", layer), middle(whole, "y", layer))

    @property
    def length(self) -> Quantity:
        """From nose to tail."""
        return self.tail - self.nose

    @property
    def height(self) -> Quantity:
        """From the ground to the highest point."""
        return self.top - self.ground

    def station(self, share: float) -> Quantity:
        """x at a share of the length from the nose."""
        return self.nose + share * self.length

    @cached_property
    def centre(self) -> Facets:
        """The section along the middle. Raises MeasureError where the body lies on its roof."""
        across = float(np.ptp(self.whole.corners[..., 1]))
        cut = section(self.shape, "y", self.middle + CENTRE * across)
        x, z = np.moveaxis(self.whole.corners[..., [0, 2]], -1, 0)
        fore, aft = (float(self.station(share)) for share in (STATIONS[0], STATIONS[-1]))
        amid = cut.between(x=(fore, aft)).corners[..., 2]
        if amid.size and amid.min() - float(self.ground) < LOWEST * float(self.height):
            out = [z[beyond].max(initial=-np.inf) - amid.max() for beyond in (x < fore, x > aft)]
            if min(out) > WHEELS * float(self.height):
                raise MeasureError(
                    "expected wheels below the body, got a body that lies on its middle, with parts that stand out "
                    "above it fore and aft, as one upside down has wheels; say where its roof points by up="
                )
        return cut


@measure(simple_car, check_axes, length="L", width="L", height="L", roof_height="L", ground_clearance="L")
def vehicle(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Overall length; width of the body without mirrors; height; roof and underbody above the ground.

    `length` and `height` are those of the box. `width` is that of cross-sections between the axles, averaged over those
    within 1 % of the median one. `roof_height` is the highest point of the centre section, `ground_clearance` the
    height that most of the underbody has there between the axles; both from the lowest point, where the tyres stand.
    A body that lies on its underbody, or whose width varies there, is no vehicle: `extents` has the sizes of its box.
    """
    body = Vehicle.of(mesh, forward, up)
    centre = body.centre.required("a section along the middle", ADVICE)
    layer = LAYER * float(body.length)
    return {
        "length": body.length,
        "width": _width(body),
        "height": body.height,
        "roof_height": minimum(highest(centre, "z", layer), body.top) - body.ground,
        "ground_clearance": clearance(body, centre),
    }


def clearance(body: Vehicle, centre: Facets) -> Quantity:
    """How high the underbody lies above the ground: the height that most of it has in the middle, between the axles.

    Raises MeasureError where there is none, or it lies on the ground.
    """
    span = (body.station(STATIONS[0]), body.station(STATIONS[-1]))
    low = (body.ground, body.ground + UNDER * body.height)
    floor = centre.facing("-z").between(x=span, z=low)
    floor = floor.required("an underbody that looks down between the axles", ADVICE)
    free = line(floor, within=ROUGH * float(body.length)).point[2] - body.ground
    if not float(free) > LOWEST * float(body.height):
        raise MeasureError(
            "expected an underbody above the ground, got one that lies on it: wheels or stilts are missing, or up= "
            "does not say where the roof points; the measure extents has length, width and height of any body"
        )
    return free


def _width(body: Vehicle) -> Quantity:
    cuts = [section(body.shape, "x", body.station(share)) for share in STATIONS]
    layer = SIDE * float(np.ptp(body.whole.corners[..., 1]))
    widths = [extent(cut, "y", layer) for cut in cuts if len(cut)]
    found = np.array([float(width) for width in widths])
    if len(found) < len(cuts):
        raise MeasureError(f"width: expected a body all along, got {len(found)} of {len(cuts)} cross-sections")
    alike = np.abs(found - np.median(found)) <= ALIKE * np.median(found)
    if alike.mean() < MOST:
        raise MeasureError(
            f"width: expected a body of one width at some stations from {STATIONS[0]:.0%} to {STATIONS[-1]:.0%} of its "
            f"length, got {found.min():.6g} to {found.max():.6g}; {ADVICE}"
        )
    return mean([width for width, kept in zip(widths, alike, strict=True) if kept])
