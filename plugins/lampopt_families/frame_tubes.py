"""The tubes of a bike frame: where they run, how long they are, what they weigh; and any frame of FRAMED's table.

FRAMED: Regenwetter, Weaver and Ahmed, "FRAMED: An AutoML approach for structural performance prediction of bicycle
frames", 2022. Everything here takes single frames or arrays of them (N,).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lampopt.types import Array

DENSITY = {"steel": 7850.0, "aluminum": 2700.0, "titanium": 4428.78}  # [kg/m³] 4130, 6061-T6, Ti-6Al-4V in the CAD
DROPOUT = 1.125  # diameter of a dropout, in that of the chain stay; it is as long as the chain stay is wide
PAIRS = ("chain_stay", "seat_stay")  # tubes of which there are two
TURN = np.linspace(0, 2 * np.pi, 64, endpoint=False)  # around a tube, to average over
ACROSS = np.array([0.0, 1.0, 0.0])


class Sizes(NamedTuple):
    """What shapes the outside of a frame [mm, deg], each a number or (N,). Axes of tubes meet where it says joint."""

    chain_stay_length: Array  # from the bottom bracket's axis to the rear axle, in the side view
    bottom_bracket_drop: Array  # of the bottom bracket's axis below the rear axle
    stack: Array  # of the head tube's upper end above the bottom bracket's axis
    reach: Array  # of the head tube's upper end before the bottom bracket's axis
    seat_tube_angle: Array  # to the horizontal
    seat_tube_length: Array  # from the bottom bracket's axis to the joint of the top tube
    head_tube_angle: Array  # to the horizontal
    head_tube_length: Array  # from end to end
    dropout_spacing: Array  # between the dropouts' middles
    top_tube_diameter: Array
    down_tube_diameter: Array
    head_tube_diameter: Array
    seat_tube_diameter: Array
    chain_stay_diameter: Array
    seat_stay_diameter: Array
    bottom_bracket_diameter: Array
    bottom_bracket_length: Array
    chain_stay_inset: Array  # of the chain stay's axis from the end of the bottom bracket
    seat_stay_offset: Array  # of the seat stay's axis from the middle plane, at the seat tube
    seat_stay_junction: Array  # from the seat tube's upper end to the joint of the seat stays
    seat_tube_extension: Array  # from the joint of the top tube to the seat tube's upper end
    head_tube_upper_extension: Array  # from the joint of the top tube to the head tube's upper end
    head_tube_lower_extension: Array  # from the joint of the down tube to the head tube's lower end


class Tube(NamedTuple):
    """A round tube's axis, from start to end (..., 3) [mm], and its diameter; of a pair the right one, y > 0."""

    start: Array
    end: Array
    diameter: Array

    @property
    def run(self) -> Array:
        """From start to end (..., 3) [mm]."""
        return np.asarray(self.end - self.start)

    @property
    def length(self) -> Array:
        """Of the axis [mm]."""
        return np.asarray(np.linalg.norm(self.run, axis=-1))


def tubes(s: Sizes) -> dict[str, Tube]:
    """The tubes by name: x to the rear, y to the right, z up, the middle of the bottom bracket at the origin."""
    seat, head = upward(s.seat_tube_angle), upward(s.head_tube_angle)
    top = _point(-s.reach, 0, s.stack)
    bottom = top - _times(s.head_tube_length, head)
    seat_top = s.seat_tube_length + s.seat_tube_extension
    aside = _point(0, s.seat_stay_offset, 0)
    base = _point(0, s.bottom_bracket_length / 2, 0)
    drop = s.bottom_bracket_drop
    axle = _point(np.sqrt(np.maximum(s.chain_stay_length**2 - drop**2, 0)), s.dropout_spacing / 2, drop)
    middle = _point(0 * s.stack, 0, 0)
    long = _point(0, s.chain_stay_diameter / 2, 0)
    return {
        "bottom_bracket": Tube(-base, base, s.bottom_bracket_diameter),
        "seat_tube": Tube(middle, _times(seat_top, seat), s.seat_tube_diameter),
        "head_tube": Tube(bottom, top, s.head_tube_diameter),
        "down_tube": Tube(middle, bottom + _times(s.head_tube_lower_extension, head), s.down_tube_diameter),
        "top_tube": Tube(
            _times(s.seat_tube_length, seat),
            top - _times(s.head_tube_upper_extension, head),
            s.top_tube_diameter,
        ),
        "chain_stay": Tube(base - _point(0, s.chain_stay_inset, 0), axle, s.chain_stay_diameter),
        "seat_stay": Tube(_times(seat_top - s.seat_stay_junction, seat) + aside, axle, s.seat_stay_diameter),
        "dropout": Tube(axle - long, axle + long, DROPOUT * s.chain_stay_diameter),
    }


def volume(s: Sizes, walls: Mapping[str, Array]) -> Array:
    """Of the material [mm³], the tubes having `walls` [mm] by name; dropouts are solid, and there are no bridges.

    Head tube and bottom bracket are whole; every other tube ends at the outside of those it is welded to. How much
    shorter that makes it is averaged over the middle of its wall. What a down tube shares with the seat tube just above
    the bottom bracket counts twice: 0.1 % of a frame.
    """
    found = tubes(s)
    axis = {name: tube.run / tube.length[..., None] for name, tube in found.items()}
    radius = {name: tube.diameter / 2 for name, tube in found.items()}

    def lost(name: str, other: str, aside: Array | float = 0.0) -> Array:
        """Length of `name` inside `other`, whose axis it meets or passes at `aside`."""
        wall = radius[name] - walls[name] / 2
        off = np.asarray(aside)[..., None] + np.asarray(wall)[..., None] * np.sin(TURN)
        half = np.sqrt(np.maximum(np.asarray(radius[other])[..., None] ** 2 - off**2, 0)).mean(axis=-1)
        return np.asarray(half / np.sqrt(1 - (axis[name] * axis[other]).sum(axis=-1) ** 2))

    net = {name: tube.length for name, tube in found.items()}
    net["seat_tube"] = net["seat_tube"] - lost("seat_tube", "bottom_bracket")
    net["down_tube"] = net["down_tube"] - lost("down_tube", "bottom_bracket") - lost("down_tube", "head_tube")
    net["top_tube"] = net["top_tube"] - lost("top_tube", "seat_tube") - lost("top_tube", "head_tube")
    net["chain_stay"] = net["chain_stay"] - lost("chain_stay", "bottom_bracket") - lost("chain_stay", "dropout")
    net["seat_stay"] = net["seat_stay"] - lost("seat_stay", "seat_tube", s.seat_stay_offset)
    net["seat_stay"] = net["seat_stay"] - lost("seat_stay", "dropout")
    total = 2 * net["dropout"] * np.pi * radius["dropout"] ** 2
    for name, wall in walls.items():
        section = np.pi * (found[name].diameter - wall) * wall
        total = total + (2 if name in PAIRS else 1) * section * net[name]
    return np.asarray(total)


def framed(row: Mapping[str, Array]) -> tuple[Sizes, dict[str, Array]]:
    """Sizes and walls [mm, deg] of frames in FRAMED's table, whose columns [m, deg] are `row`.

    The table has the length of the down tube in place of the reach, which is NaN where it is too short to reach its
    joint. For 1,787 rows (see docs/sources.md) the seat tube's wall is not that of the model that was weighed.
    """
    length = {name: 1000 * np.asarray(row[column], float) for name, column in COLUMNS.items()}
    walls = {name: 1000 * np.asarray(row[f"{short} Thickness"], float) for name, short in SHORT.items()}
    angle = np.asarray(row["HT Angle"], float)
    turn, above = np.radians(angle), length["head_tube_length"] - length["head_tube_lower_extension"]
    height = length["stack"] - above * np.sin(turn)
    squared = (1000 * np.asarray(row["DT Length"], float)) ** 2 - height**2
    reach = np.sqrt(np.where(squared >= 0, squared, np.nan)) - above * np.cos(turn)
    angles = {"seat_tube_angle": np.asarray(row["ST Angle"], float), "head_tube_angle": angle}
    return Sizes(reach=reach, **angles, **length), walls


SHORT = {
    "bottom_bracket": "BB",
    "seat_tube": "ST",
    "head_tube": "HT",
    "down_tube": "DT",
    "top_tube": "TT",
    "chain_stay": "CS",
    "seat_stay": "SS",
}
COLUMNS = {
    "chain_stay_length": "CS Length",
    "bottom_bracket_drop": "BB Drop",
    "stack": "Stack",
    "seat_tube_length": "ST Length",
    "head_tube_length": "HT Length",
    "dropout_spacing": "Dropout Offset",
    "bottom_bracket_length": "BB Length",
    "chain_stay_inset": "CS F",
    "seat_stay_offset": "SS Z",
    "seat_stay_junction": "SS E",
    "seat_tube_extension": "ST UX",
    "head_tube_upper_extension": "HT UX",
    "head_tube_lower_extension": "HT LX",
    **{f"{name}_diameter": f"{short} OD" for name, short in SHORT.items()},
}


def upward(angle: Array) -> Array:
    """(..., 3) the way up along a tube that leans back at `angle` [deg] to the horizontal."""
    turn = np.radians(angle)
    return _point(np.cos(turn), 0, np.sin(turn))


def _point(x: Array | float, y: Array | float, z: Array | float) -> Array:
    return np.stack(np.broadcast_arrays(*(np.asarray(v, float) for v in (x, y, z))), axis=-1)


def _times(length: Array, direction: Array) -> Array:
    return np.asarray(np.asarray(length)[..., None] * direction)
