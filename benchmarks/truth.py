"""What is true of a family's designs, by its parameters: closed forms; of a car's volume and area, its mesh's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from trimesh import Trimesh

from lampopt_families import ahmed, bwb, car, plate
from lampopt_families.parametric import Family

Values = dict[str, float]
NARROWEST = 25.0  # mm: a bwb with a narrower panel, 2.5 % of its centre chord, has no planform to be read off its edges


@dataclass(frozen=True)
class Known:
    """A family and what is true of its designs: address → value, from parameters and the true mesh.

    `own` are addresses whose truth is the true mesh's own value: what is measured on that mesh says nothing of them.
    `shown` says of parameters whether the shape shows them; where it does not, only `more` is true of it.
    """

    family: Family
    more: Callable[[Values, Trimesh], Values]
    own: frozenset[str] = frozenset()
    shown: Callable[[Values], bool] = lambda _: True

    def at(self, parameters: NDArray[np.float64], mesh: Trimesh) -> Values:
        given = dict(zip(self.family.names, parameters.tolist(), strict=True))
        found = {address: given[name] for name, address in self.family.measured.items()} if self.shown(given) else {}
        return found | self.more(given, mesh)


def of_plate(p: Values, mesh: Trimesh) -> Values:
    """A plate is a slab less a cylinder; its moments follow from Steiner's theorem."""
    length, width, thickness, radius, x, y = p.values()
    slab, bore = length * width * thickness, np.pi * radius**2 * thickness
    volume = slab - bore
    centre = -bore / volume * np.array([x, y, 0.0])
    square = thickness**2 / 12
    tensor = slab * np.diag([width**2 / 12 + square, length**2 / 12 + square, (length**2 + width**2) / 12])
    tensor -= bore * np.diag([radius**2 / 4 + square, radius**2 / 4 + square, radius**2 / 2])
    for mass, at in ((slab, centre), (-bore, np.array([x, y, 0.0]) - centre)):
        tensor += mass * (at @ at * np.eye(3) - np.outer(at, at))
    moments = np.linalg.eigvalsh(tensor)
    sides = 2 * (length * width + length * thickness + width * thickness)
    bridge = min(length / 2 - abs(x), width / 2 - abs(y)) - radius  # between the hole and the nearest edge
    least = {"wall.least": thickness} if bridge > thickness else {}  # a narrow one is a matter of how much of it counts
    return least | {
        "extents.length": length,
        "extents.width": width,
        "extents.height": thickness,
        "volume.volume": volume,
        "area.area": sides - 2 * np.pi * radius**2 + 2 * np.pi * radius * thickness,
        "genus.genus": 1.0,
        "genus.bodies": 1.0,
        "hole.radius": radius,
        "hole.x": x,
        "hole.y": y,
        "hole.z": 0.0,
        "holes.count": 1.0,
        "wall.median": thickness,
        "centroid.x": float(centre[0]),
        "centroid.y": float(centre[1]),
        **{f"inertia.{name}": float(m) for name, m in zip(("least", "middle", "largest"), moments, strict=True)},
    }


def shadow(mesh: Trimesh, along: int) -> float:
    """Area of a closed mesh's silhouette along an axis: the faces that look that way, united by another library."""
    flat = np.delete(np.asarray(mesh.vertices), along, axis=1)[mesh.faces]
    p, q = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    seen = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] > 0
    return float(shapely.union_all(shapely.polygons(flat[seen]), grid_size=1e-3).area)


def of_car(p: Values, mesh: Trimesh) -> Values:
    """No closed form knows volume and area; a mesh of edges of 15 mm has 0.05 % more volume and 0.5 % more area."""
    return {
        "vehicle.height": p["roof_height"],
        "wheels.track_rear": p["track"],
        "wheels.radius_rear": p["wheel_radius"],
        "frontal-area.frontal_area": shadow(mesh, 0),
        "wetted-area.wetted_area": float(mesh.area),
        "volume.volume": float(mesh.volume),
    }


def of_ahmed(p: Values, mesh: Trimesh) -> Values:
    """On its stilts, of the smooth body: chords are no part of it."""
    known = ahmed.derived(np.array(list(p.values())))
    return {
        "frontal-area.frontal_area": known["frontal_area"],
        "wetted-area.wetted_area": known["area"],
        "volume.volume": known["volume"],
    }


def half_volume(at: bwb.Stations) -> float:
    """Volume of the right half [mm³]: sections of 2√3/5 t c², t and c linear between stations; half an ellipse ends it.

    Over a panel it is a cubic in the share u of its width, whose moments are ∫ u^k du, at the tip ∫ u^k √(1 − u²) du.
    """
    ends = np.r_[at.y[:3], at.y[3] - bwb.TIP * at.chord[3], at.y[3]]
    chord, thickness = (np.interp(ends, at.y, values) for values in (at.chord, at.thickness))
    panel, tip = (1, 1 / 2, 1 / 3, 1 / 4), (np.pi / 4, 1 / 3, np.pi / 16, 2 / 15)
    total = 0.0
    for k, moments in enumerate((panel, panel, panel, tip)):
        c, t = ((values[k], values[k + 1] - values[k]) for values in (chord, thickness))
        total += (ends[k + 1] - ends[k]) * float(np.convolve(t, np.convolve(c, c)) @ moments)
    return 2 * np.sqrt(3) / 5 * total


def wide(p: Values) -> bool:
    """Whether all three panels of a bwb are wide enough to be told from a single kink."""
    return min(p["B1"], p["B2"], p["B3"]) >= NARROWEST


def of_bwb(p: Values, mesh: Trimesh) -> Values:
    at = bwb.stations(np.array(list(p.values())))
    span = 2 * float(at.y[-1])
    area = float((np.diff(at.y) * (at.chord[1:] + at.chord[:-1])).sum())
    found = {
        "wing.span": span,
        "wing.planform_area": area,
        "wing.aspect_ratio": span**2 / area,
        "wing.mean_chord": area / span,
        "volume.volume": half_volume(at),
    }
    for percent in (25, 50, 75):
        y = percent / 100 * at.y[-1]
        panel = int(np.searchsorted(at.y, y)) - 1
        if np.abs(at.y - y).min() > 0.03 * at.y[-1]:  # on a kink there is no one sweep
            slope = (at.leading_edge[panel + 1] - at.leading_edge[panel]) / (at.y[panel + 1] - at.y[panel])
            found[f"stations.sweep_{percent}"] = float(np.degrees(np.arctan(slope)))
        found[f"stations.thickness_{percent}"] = float(np.interp(y, at.y, at.thickness))
    return found


def families() -> Mapping[str, Known]:
    """Everything that is measured, and what is true of it."""
    return {
        "plate": Known(plate.family(), of_plate),
        "car": Known(car.FAMILY, of_car, frozenset({"wetted-area.wetted_area", "volume.volume"})),
        "ahmed": Known(ahmed.FAMILY, of_ahmed),
        "bwb": Known(bwb.family(), of_bwb, shown=wide),
    }
