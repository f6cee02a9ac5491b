"""Overall sizes of a vehicle: length, width of the body, heights above the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .axes import check_axes, oriented
from .example import simple_car
from .facets import Facets, Shape, extent, highest, lowest, middle, section, surface
from .fits import line
from .pieces import measure
from .quantity import Number, Quantity, mean

if TYPE_CHECKING:
    from trimesh import Trimesh

LAYER = 2e-5  # of the length: how deep an end is looked at
SIDE = 3e-4  # of the width: how deep a flank is
STATIONS = tuple(np.linspace(0.4031, 0.6173, 12))  # of the length, clear of the wheels
ALIKE = 0.01  # stations whose width is farther than this from the median one show a mirror or a handle
UNDER = 0.5  # of the height: where an underbody is sought
ROUGH = 1e-3  # of the length: what belongs to one level of the underbody
CENTRE = 1e-3  # of the width: how far beside the middle plane, along which meshes like to have edges, the centre is cut


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
        layer = LAYER * float(np.ptp(whole.corners[..., 0]))
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

    @property
    def centre(self) -> Facets:
        """The section along the middle."""
        across = float(np.ptp(self.whole.corners[..., 1]))
        return section(self.shape, "y", self.middle + CENTRE * across)


@measure(simple_car, check_axes, length="L", width="L", height="L", roof_height="L", ground_clearance="L")
def vehicle(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Overall length; width of the body without mirrors; height; roof and underbody above the ground.

    `length` and `height` are those of the box. `width` is that of cross-sections between the axles, averaged over those
    within 1 % of the median one. `roof_height` is the highest point of the centre section, `ground_clearance` the
    height that most of the underbody has there between the axles; both from the lowest point, where the tyres stand.
    """
    body = Vehicle.of(mesh, forward, up)
    centre = body.centre
    layer = LAYER * float(body.length)
    return {
        "length": body.length,
        "width": _width(body),
        "height": body.height,
        "roof_height": highest(centre, "z", layer) - body.ground,
        "ground_clearance": clearance(body, centre),
    }


def clearance(body: Vehicle, centre: Facets) -> Quantity:
    """How high the underbody lies above the ground: the height that most of it has in the middle, between the axles."""
    span = (body.station(STATIONS[0]), body.station(STATIONS[-1]))
    low = (body.ground, body.ground + UNDER * body.height)
    floor = centre.facing("-z").between(x=span, z=low).required("an underbody between the axles")
    return line(floor, within=ROUGH * float(body.length)).point[2] - body.ground


def _width(body: Vehicle) -> Quantity:
    cuts = [section(body.shape, "x", body.station(share)) for share in STATIONS]
    layer = SIDE * float(np.ptp(body.whole.corners[..., 1]))
    widths = [extent(cut, "y", layer) for cut in cuts if len(cut)]
    typical = float(np.median([float(width) for width in widths]))
    return mean([width for width in widths if abs(float(width) - typical) <= ALIKE * typical])
