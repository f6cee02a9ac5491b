"""Bike frames on the parameters of FRAMED's table (Regenwetter, Weaver and Ahmed, 2022)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

from .frame_tubes import ACROSS, DENSITY, PAIRS, Sizes, Tube, tubes, upward, volume
from .parametric import Family, check_edge, whole

if TYPE_CHECKING:
    from trimesh import Trimesh

# name, unit, low, high: the 10th and 90th percentile of FRAMED's 4,047 frames, rounded; where folding and children's
# bikes make long tails (reach, seat and head tube length), and for the head tube's diameter, narrower
PARAMETERS = (
    ("chain_stay_length", "mm", 378.0, 445.0),
    ("bottom_bracket_drop", "mm", 7.0, 72.0),
    ("stack", "mm", 551.0, 577.0),
    ("reach", "mm", 376.0, 440.0),
    ("seat_tube_angle", "deg", 71.5, 75.5),
    ("seat_tube_length", "mm", 475.0, 575.0),
    ("head_tube_angle", "deg", 69.0, 74.5),
    ("head_tube_length", "mm", 128.0, 176.0),
    ("dropout_spacing", "mm", 120.0, 135.0),
    ("top_tube_diameter", "mm", 28.0, 34.0),
    ("down_tube_diameter", "mm", 36.0, 43.0),
    ("head_tube_diameter", "mm", 40.0, 50.0),
    ("seat_tube_diameter", "mm", 28.5, 35.0),
    ("chain_stay_diameter", "mm", 20.0, 27.5),
    ("seat_stay_diameter", "mm", 13.0, 18.0),
)
NAMES = tuple(name for name, *_ in PARAMETERS)
LOW = tuple(low for _, _, low, _ in PARAMETERS)
HIGH = tuple(high for *_, high in PARAMETERS)
FIXED = {  # [mm] FRAMED's medians, rounded
    "bottom_bracket_diameter": 40.0,
    "bottom_bracket_length": 68.0,
    "chain_stay_inset": 15.0,
    "seat_stay_offset": 9.0,
    "seat_stay_junction": 45.0,
    "seat_tube_extension": 47.0,
    "head_tube_upper_extension": 31.0,
    "head_tube_lower_extension": 47.0,
}
WALLS = {  # [mm] BikeCAD's, which nearly all of the designs behind FRAMED kept; FRAMED itself draws walls at random
    "bottom_bracket": 2.0,
    "seat_tube": 0.9,
    "head_tube": 1.1,
    "down_tube": 0.9,
    "top_tube": 0.9,
    "chain_stay": 1.2,
    "seat_stay": 1.0,
}
LARGEST = 2000.0  # [mm] beyond lies a slip
ANGLES = (45.0, 90.0)  # [deg] of seat and head tube, least and most
EDGES = (3.0, 200.0)  # [mm] finest and coarsest mesh
PAST = {  # [mm] by which a tube of the mesh goes beyond the axis of the one that it is welded to, inside that one
    ("top_tube", "start"): 1.0,
    ("top_tube", "end"): 1.0,
    ("down_tube", "end"): 2.0,
    ("seat_stay", "start"): 2.0,
}
FINEST = 256  # segments; beyond lies a slip, or a machine out of memory


@dataclass(frozen=True)
class FrameSource:
    """Bike frames: x to the rear, y to the right, z up, bottom bracket's middle at the origin; millimetres.

    Parameters
    ----------
    count
        How many exemplars; 31 for the design `ends`.
    design
        `ends`: the middle of the range and each parameter's two ends. `lhs`, `sobol`, `random`: `count` draws over
        the range by Latin hypercube, scrambled Sobol sequence, or independently.
    seed
        Of the draws.
    segments
        Corners around each tube, which lie on its circle: a multiple of four.
    edge
        Length of the mesh's edges along the tubes [mm].
    labels
        `mass`: what the frame weighs [kg] in `material` with the walls `WALLS`.
    material
        `steel`, `aluminum` or `titanium`.

    Raises
    ------
    InputError
        For options that make no family.
    """

    count: int = 100
    design: str = "lhs"
    seed: int = 0
    segments: int = 32
    edge: float = 12.0
    labels: str = ""
    material: str = "steel"

    def __post_init__(self) -> None:
        FAMILY.checked_options(self.count, self.design, self.seed)
        _check_options(self.segments, self.edge)
        if self.labels not in ("", "mass"):
            raise InputError(f"frame: labels: expected mass or none, got {self.labels!r:.100}")
        if self.material not in DENSITY:
            raise InputError(f"frame: material: expected one of {', '.join(DENSITY)}, got {self.material!r:.100}")

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access."""
        family = replace(FAMILY, mesh=partial(frame_mesh, segments=self.segments, edge=self.edge))
        exemplars = family.exemplars(self.count, self.design, self.seed)
        if not self.labels:
            return exemplars
        values = np.array([[mass(row, material=self.material)] for row in exemplars.parameters])
        return replace(exemplars, labels=values, label_space=(Parameter("mass", "kg"),))


def frame_mesh(parameters: Array, *, segments: int = 32, edge: float = 12.0) -> Trimesh:
    """The true frame, its outside: watertight, one body, faces outward.

    Parameters
    ----------
    parameters
        (15,) in the order of `NAMES` [mm, deg]; also outside the family's range.
    segments, edge
        As of `FrameSource`.

    Raises
    ------
    InputError
        Where the parameters make no frame, naming those at fault; for options that make none.
    """
    _check_options(segments, edge)
    return outside(checked(parameters), segments=segments, edge=edge)


def mass(parameters: Array, *, material: str = "steel") -> float:
    """What a frame weighs [kg] with the walls `WALLS`, dropouts solid."""
    if material not in DENSITY:
        raise InputError(f"frame: material: expected one of {', '.join(DENSITY)}, got {material!r:.100}")
    walls = {name: np.asarray(wall) for name, wall in WALLS.items()}
    return float(DENSITY[material] * 1e-9 * volume(checked(parameters), walls))


def checked(parameters: Array) -> Sizes:
    """All sizes of a frame. Raises InputError where the parameters make none, naming those at fault."""
    values = FAMILY.parameters(parameters).tolist()
    sizes: dict[str, Any] = {**dict(zip(NAMES, values, strict=True)), **FIXED}
    s = Sizes(**sizes)
    wrong = [
        f"{q.name}: expected more than 0 and up to {LARGEST:,g} mm, got {value:.6g} mm"
        for q, value in zip(FAMILY.space, values, strict=True)
        if q.unit == "mm" and q.name != "bottom_bracket_drop" and not 0 < value <= LARGEST
    ]
    wrong += [
        f"{q.name}: expected {ANGLES[0]:g} to {ANGLES[1]:g} deg, got {value:.6g} deg"
        for q, value in zip(FAMILY.space, values, strict=True)
        if q.unit == "deg" and not ANGLES[0] <= value <= ANGLES[1]
    ]
    wrong = wrong or [
        f"{what}, got {value:.6g} mm and {least:.6g} mm" for what, value, least in _rooms(s) if value <= least
    ]
    if wrong:
        raise InputError("frame: " + "; ".join(wrong))
    return s


def _rooms(s: Any) -> list[tuple[str, float, float]]:
    """What has to be longer than what [mm], and how to say so."""
    found = tubes(s)
    extensions = s.head_tube_upper_extension + s.head_tube_lower_extension
    rooms = [
        ("head_tube_length: expected more than between its ends and the joints", s.head_tube_length, extensions),
        (
            "bottom_bracket_drop: expected less than three quarters of the chain stay",
            0.75 * s.chain_stay_length,
            abs(s.bottom_bracket_drop),
        ),
        (
            "chain_stay_length: expected the axle to clear seat tube and bottom bracket",
            found["chain_stay"].end[0],
            (s.bottom_bracket_diameter + s.seat_tube_diameter) / 2 + s.chain_stay_diameter,
        ),
        (
            "seat_tube_length: expected the seat stays to join it above the axle and the bottom bracket",
            found["seat_stay"].start[2],
            max(0, s.bottom_bracket_drop) + s.bottom_bracket_diameter + s.chain_stay_diameter,
        ),
        (
            "stack: expected the down tube to join the head tube above the bottom bracket",
            found["down_tube"].end[2],
            s.bottom_bracket_diameter + s.down_tube_diameter / 2,
        ),
        (
            "reach: expected the top tube to run forward from seat to head tube",
            -found["top_tube"].run[0],
            (s.seat_tube_diameter + s.head_tube_diameter) / 2,
        ),
        ("dropout_spacing: expected room between the dropouts", s.dropout_spacing, s.chain_stay_diameter),
        ("seat_tube_diameter: expected the seat stays to meet it", s.seat_tube_diameter / 2, s.seat_stay_offset),
    ]
    welded = (
        ("down_tube", s.head_tube_angle, "head_tube", s.head_tube_lower_extension),
        ("top_tube", s.head_tube_angle, "head_tube", s.head_tube_upper_extension),
        ("top_tube", s.seat_tube_angle, "seat_tube", s.seat_tube_extension),
        ("seat_stay", s.seat_tube_angle, "seat_tube", s.seat_stay_junction),
    )
    for name, angle, other, room in welded:
        tube = found[name]
        sine = np.sqrt(1 - (tube.run @ upward(angle) / tube.length) ** 2)
        text = f"{name}_diameter: expected it to meet the {other.replace('_', ' ')} within its end"
        rooms.append((text, float(room), float(tube.diameter / 2 / sine)))
    return rooms


def derived(parameters: Array) -> dict[str, float]:
    """True values that are no parameters, in closed form [mm, deg, mm²].

    `down_tube_length`, `top_tube_length`, `seat_stay_length`: of the axes, from joint to joint; the stay's in space.
    `effective_top_tube_length`: level, from the head tube's upper end to the seat tube's axis. `rear_centre`: level,
    from bottom bracket to rear axle. `down_tube_angle`, `top_tube_angle`: to the horizontal; the top tube's is positive
    where it rises to the head tube. `front_triangle_area`: between the axes of the four tubes. `length`, `width`: of
    the whole frame; `head_height`: of the head tube's highest point above the bottom bracket's axis.
    """
    s: Any = checked(parameters)
    found = tubes(s)
    down, top = found["down_tube"], found["top_tube"]
    x, _, z = np.array([down.start, top.start, top.end, down.end]).T
    area = abs((x * np.roll(z, -1) - z * np.roll(x, -1)).sum()) / 2
    lean = np.radians(s.head_tube_angle)
    front = found["head_tube"].start[0] - s.head_tube_diameter / 2 * np.sin(lean)
    dropout = found["dropout"]
    values = {
        "down_tube_length": down.length,
        "top_tube_length": top.length,
        "seat_stay_length": found["seat_stay"].length,
        "effective_top_tube_length": s.reach + s.stack / np.tan(np.radians(s.seat_tube_angle)),
        "rear_centre": dropout.end[0],
        "down_tube_angle": np.degrees(np.arctan2(down.run[2], -down.run[0])),
        "top_tube_angle": np.degrees(np.arctan2(top.run[2], -top.run[0])),
        "front_triangle_area": area,
        "length": dropout.end[0] + dropout.diameter / 2 - front,
        "width": 2 * dropout.end[1],
        "head_height": s.stack + s.head_tube_diameter / 2 * np.cos(lean),
    }
    return {name: float(value) for name, value in values.items()}


def outside(s: Sizes, *, segments: int = 32, edge: float = 12.0) -> Trimesh:
    """The outside of any frame, FRAMED's too: its tubes united, the left ones mirror images of the right."""
    from manifold3d import Manifold, Mesh64, OpType
    from trimesh import Trimesh

    _check_options(segments, edge)
    seat, head = upward(s.seat_tube_angle), upward(s.head_tube_angle)
    # A tube ends in a plane along the axis of the one it is welded to, so that it never comes out on the far side; a
    # little beyond it, so that a top tube and stays wider than the seat tube overlap there and do not merely touch.
    planes = {"down_tube": (None, head), "top_tube": (seat, head), "seat_stay": (seat, None)}
    parts = []
    for name, tube in tubes(s).items():
        before, beyond = (PAST.get((name, end), 0.0) for end in ("start", "end"))
        way = tube.run / tube.length
        longer = Tube(tube.start - before * way, tube.end + beyond * way, tube.diameter)
        points, faces = _closed(longer, planes.get(name, (None, None)), segments, edge)
        parts.append(Manifold(Mesh64(points, faces.astype(np.uint64))))
        if name in (*PAIRS, "dropout"):
            parts.append(Manifold(Mesh64(points * (1, -1, 1), faces[:, ::-1].astype(np.uint64))))
    united = Manifold.batch_boolean(parts, OpType.Add).to_mesh64()
    return Trimesh(
        np.asarray(united.vert_properties)[:, :3], np.asarray(united.tri_verts).astype(np.int64), process=False
    )


def _closed(tube: Tube, planes: tuple[Array | None, Array | None], segments: int, edge: float) -> tuple[Array, Array]:
    """A solid tube's vertices and faces, faces outward; an end lies square or in the plane of y and a direction."""
    along = tube.run / tube.length
    first = ACROSS if abs(along[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    first = first - first @ along * along
    first /= np.linalg.norm(first)
    turn = 2 * np.pi * np.arange(segments) / segments
    circle = tube.diameter / 2 * (np.outer(np.cos(turn), first) + np.outer(np.sin(turn), np.cross(along, first)))
    ends = []
    for centre, plane in ((tube.start, planes[0]), (tube.end, planes[1])):
        normal = along if plane is None else np.cross(ACROSS, plane)
        ends.append(centre + circle - np.outer(circle @ normal / (along @ normal), along))
    rings = max(1, round(float(tube.length) / edge)) + 1
    share = np.linspace(0, 1, rings)[:, None, None]
    points = ((1 - share) * ends[0] + share * ends[1]).reshape(-1, 3)
    i = np.arange(rings * segments).reshape(rings, segments)
    a, b = i[:-1], i[1:]
    a_next, b_next = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    low, high = len(points), len(points) + 1
    quads = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, a_next, b_next), (a, b_next, b))]
    caps = [
        np.column_stack([np.full(segments, low), np.roll(i[0], -1), i[0]]),
        np.column_stack([np.full(segments, high), i[-1], np.roll(i[-1], -1)]),
    ]
    return np.concatenate([points, [tube.start, tube.end]]), np.concatenate([*quads, *caps])


def _check_options(segments: int, edge: float) -> None:
    if not whole(segments) or segments % 4 or not 8 <= segments <= FINEST:
        raise InputError(f"frame: segments: expected a multiple of 4 from 8 to {FINEST}, got {segments!r:.100}")
    check_edge("frame", edge, *EDGES)


FAMILY = Family(
    "frame",
    tuple(Parameter(name, unit) for name, unit, *_ in PARAMETERS),
    np.array(LOW),
    np.array(HIGH),
    "mm",
    {},
    frame_mesh,
)
