"""A sedan of smooth solids, every angle a true one (parameters after DrivAerNet++)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

from .car_solid import BELT, EDGE, GAP, PANELS, PATCH, SHOULDER, TYRE, Sizes, Solid, grid, side_view
from .contour import contour
from .parametric import Family, check_edge

if TYPE_CHECKING:
    from trimesh import Trimesh

# name, unit, low, high, measure
PARAMETERS = (
    ("length", "mm", 4580.0, 4720.0, "vehicle.length"),
    ("width", "mm", 1790.0, 1850.0, "vehicle.width"),
    ("roof_height", "mm", 1410.0, 1460.0, "vehicle.roof_height"),
    ("wheelbase", "mm", 2680.0, 2760.0, "wheels.wheelbase"),
    ("track", "mm", 1492.0, 1528.0, "wheels.track_front"),
    ("wheel_radius", "mm", 315.0, 335.0, "wheels.radius_front"),
    ("ground_clearance", "mm", 138.0, 162.0, "vehicle.ground_clearance"),
    ("front_overhang", "mm", 860.0, 900.0, ""),
    ("trunk_lid_length", "mm", 535.0, 585.0, ""),
    ("ramp_angle", "deg", 8.0, 12.0, "ramp.angle"),
    ("diffuser_angle", "deg", 8.0, 12.0, "diffuser.angle"),
    ("hood_angle", "deg", 6.5, 9.5, "hood.angle"),
    ("windscreen_angle", "deg", 30.0, 34.0, "windscreen.angle"),
    ("rear_window_angle", "deg", 30.0, 34.0, "rear-window.angle"),
    ("trunk_lid_angle", "deg", 4.5, 7.5, "trunk-lid.angle"),
    ("greenhouse_angle", "deg", 22.0, 26.0, "greenhouse.angle"),
)
NAMES = tuple(name for name, *_ in PARAMETERS)
LOW = tuple(low for _, _, low, _, _ in PARAMETERS)
HIGH = tuple(high for _, _, _, high, _ in PARAMETERS)

SOUND = {  # what is refused outright: beyond lies a slip, or a mesh beyond the machine
    "length": (2500, 10_000),
    "width": (1000, 3000),
    "roof_height": (1100, 3000),
    "wheelbase": (1000, 8000),
    "track": (500, 3000),
    "wheel_radius": (150, 600),
    "ground_clearance": (20, 500),
    "front_overhang": (200, 3000),
    "trunk_lid_length": (150, 2000),
    "windscreen_angle": (15, 85),
    "rear_window_angle": (15, 85),
    "deg": (-25, 50),
}
EDGES = (15.0, 120.0)  # [mm] of the finest mesh and of the coarsest, which blurs the arches


@dataclass(frozen=True)
class CarSource:
    """Sedans, nose at x = 0, tyres on z = 0, symmetric about y = 0; lengths in millimetres, angles in degrees.

    Parameters
    ----------
    count
        How many exemplars; 0 for 100, and 33 for the design `ends`, which has no other number.
    design
        `ends`: the middle of the range and each parameter's two ends. `lhs`, `sobol`, `random`: `count` draws over the
        range by Latin hypercube, scrambled Sobol sequence, or independently.
    seed
        Of the draws.
    edge
        Length of the mesh's edges around the wheels [mm], 1.45 times that elsewhere: about 35,000 faces at 36.

    Raises
    ------
    InputError
        For options that make no family.
    """

    count: int = 0
    design: str = "lhs"
    seed: int = 0
    edge: float = 36.0

    def __post_init__(self) -> None:
        FAMILY.checked_options(self.count, self.design, self.seed)
        check_edge("car", self.edge, *EDGES)

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access."""
        family = replace(FAMILY, mesh=partial(car_mesh, edge=self.edge))
        return family.exemplars(self.count, self.design, self.seed)


def car_mesh(parameters: Array, *, edge: float = 36.0) -> Trimesh:
    """The true car: watertight, one body, genus 0, faces outward, every vertex on its surface.

    Parameters
    ----------
    parameters
        (16,) in the order of `NAMES` [mm, deg]; also outside the family's range.
    edge
        As of `CarSource` [mm].

    Raises
    ------
    InputError
        Where the parameters make no car, naming those that leave a panel or a wheel no room; for an `edge` that makes
        no mesh.
    """
    check_edge("car", edge, *EDGES)
    sizes = checked(parameters)
    solid = Solid.of(sizes)
    axes = grid(sizes, edge)
    values, _ = solid.at(*np.ix_(*axes))
    return contour(values, axes, solid)


def checked(parameters: Array) -> Sizes:
    """The parameters by name. Raises InputError where they make no car, naming those at fault."""
    s = Sizes(*FAMILY.parameters(parameters).tolist())
    wrong = [
        f"{q.name}: expected {low:g} to {high:g} {q.unit}, got {value:.6g} {q.unit}"
        for q, value in zip(FAMILY.space, s, strict=True)
        for low, high in [SOUND[q.name] if q.name in SOUND else SOUND[q.unit]]
        if not low <= value <= high
    ]
    if not wrong:
        wrong = [
            f"{' and '.join(names) if len(names) < 3 else ', '.join(names)}: {what}"
            for names, what, room in _rooms(s)
            if room < 0
        ]
    if wrong:
        raise InputError("car: " + "; ".join(wrong))
    return s


def derived(parameters: Array) -> dict[str, float]:
    """What else is known of the car in closed form [mm, mm²]: true values to hold measures against.

    `rear_overhang` from the rear wheels' middle to the tail, `axle_height`, `overall_width` with the tyres,
    `centre_section` the area cut by the middle plane and `centre_outline` the length of its boundary, and of each panel
    of the side view its flat part, from arc to arc, as in `roof_flat`.
    """
    s = checked(parameters)
    side = side_view(s)
    found = {
        "rear_overhang": s.length - s.front_overhang - s.wheelbase,
        "axle_height": s.wheel_radius - PATCH,
        "overall_width": max(s.width, s.track + TYRE),
        "centre_section": side.area,
        "centre_outline": side.perimeter,
    }
    lengths = zip(PANELS, side.length.tolist(), strict=True)
    return found | {f"{name.replace(' ', '_')}_flat": length for (name, *_), length in lengths}


def _rooms(s: Sizes) -> Iterator[tuple[tuple[str, ...], str, float]]:
    """Parameters, what is wrong, and the room that they leave [mm], negative where it is wrong."""
    side = side_view(s)
    for (panel, way, names), length, found in zip(PANELS, side.length, side.way, strict=True):
        yield names, f"no room for the {panel}", length if found @ way > 0 else -1.0
    nose, tail = side.start[0, 1], side.start[3, 1]
    yield ("ramp_angle", "ground_clearance"), "the ramp reaches into the ground", nose
    yield ("diffuser_angle", "ground_clearance"), "the diffuser reaches into the ground", tail
    roof = s.width / 2 - (s.roof_height - BELT) * np.tan(np.radians(s.greenhouse_angle))
    yield ("greenhouse_angle", "width", "roof_height"), "no room for the roof across", roof - 2 * EDGE
    front, rear = s.front_overhang, s.length - s.front_overhang - s.wheelbase
    yield ("front_overhang", "wheel_radius"), "the front tyres stand out beyond the nose", front - s.wheel_radius
    yield ("wheelbase", "length", "wheel_radius"), "the rear tyres stand out beyond the tail", rear - s.wheel_radius
    apart = s.wheelbase / 2 - s.wheel_radius - GAP - SHOULDER
    yield ("wheelbase", "wheel_radius"), "front and rear arches meet", apart
    free = s.wheel_radius - PATCH - s.ground_clearance
    yield ("wheel_radius", "ground_clearance"), "the tyres hang below the body", free
    inner = (s.track - TYRE) / 2
    yield ("track", "width"), "the tyres stand beside the body", s.width / 2 - inner - 2 * EDGE
    yield ("track",), "the tyres meet in the middle", inner - 2 * EDGE


FAMILY = Family(
    "car",
    tuple(Parameter(name, unit) for name, unit, *_ in PARAMETERS),
    np.array(LOW),
    np.array(HIGH),
    "mm",
    {name: measure for name, _, _, _, measure in PARAMETERS if measure},
    car_mesh,
)
