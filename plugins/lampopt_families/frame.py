"""Bike frames on the parameters of FRAMED's table (Regenwetter, Weaver and Ahmed, 2022)."""

from __future__ import annotations

from collections.abc import Iterator
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
LEAST, LARGEST = 1.0, 2000.0  # [mm] beyond lies a slip
FLATTEST = 1e-6  # sine of the angle that tubes meet at, below which they run along one another
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
        How many exemplars; 0 for 100, and 31 for the design `ends`, which has no other number.
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

    count: int = 0
    design: str = "lhs"
    seed: int = 0
    segments: int = 32
    edge: float = 12.0
    labels: str = ""
    material: str = "steel"

    def __post_init__(self) -> None:
        FAMILY.checked_options(self.count, self.design, self.seed)
        _check_options(self.segments, self.edge)
        if not isinstance(self.labels, str) or self.labels not in ("", "mass"):
            raise InputError(f"frame: labels: expected mass or none, got {self.labels!r:.100}")
        _density(self.material)

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
    """What a frame weighs [kg] with the walls `WALLS`, dropouts solid.

    Raises InputError where the parameters make no frame, or a tube that is narrower than its two walls.
    """
    density, s = _density(material), checked(parameters)
    for name, wall in WALLS.items():
        if (diameter := float(getattr(s, f"{name}_diameter"))) <= 2 * wall:
            raise InputError(
                f"frame: {name}_diameter: expected more than two walls of {wall:g} mm, got {diameter:.6g} mm"
            )
    walls = {name: np.asarray(wall) for name, wall in WALLS.items()}
    return float(density * 1e-9 * volume(s, walls))


def checked(parameters: Array) -> Sizes:
    """All sizes of a frame. Raises InputError where the parameters make none, naming those at fault."""
    values = FAMILY.parameters(parameters).tolist()
    sizes: dict[str, Any] = {**dict(zip(NAMES, values, strict=True)), **FIXED}
    s = Sizes(**sizes)
    wrong = []
    for q, value in zip(FAMILY.space, values, strict=True):
        low, high = ANGLES if q.unit == "deg" else (LEAST, LARGEST)
        low = -LARGEST if q.name == "bottom_bracket_drop" else low
        if not low <= value <= high:
            wrong.append(f"{q.name}: expected {low:g} to {high:g} {q.unit}, got {value:.6g} {q.unit}")
    wrong = wrong or [
        f"{what}: needs more than {least:.6g} mm, has {value:.6g} mm"
        for what, value, least in _rooms(s)
        if value <= least
    ]
    if wrong:
        raise InputError("frame: " + "; ".join(wrong))
    return s


def _density(material: str) -> float:
    """[kg/m³]."""
    if not isinstance(material, str) or material not in DENSITY:
        raise InputError(f"frame: material: expected one of {', '.join(DENSITY)}, got {material!r:.100}")
    return DENSITY[material]


def _rooms(s: Any) -> list[tuple[str, float, float]]:
    """What has to have more room than what [mm], and what to call it."""
    found = tubes(s)
    extensions = s.head_tube_upper_extension + s.head_tube_lower_extension
    rooms = [
        ("head_tube_length, for the joints of top and down tube", s.head_tube_length, extensions),
        (
            "chain_stay_length, for this bottom_bracket_drop,",
            s.chain_stay_length,
            abs(s.bottom_bracket_drop) / 0.75,
        ),
        (
            "chain_stay_length, level, for the axle to clear seat tube and bottom bracket,",
            found["chain_stay"].end[0],
            (s.bottom_bracket_diameter + s.seat_tube_diameter) / 2 + s.chain_stay_diameter,
        ),
        (
            "seat_tube_length, for the seat stays to join it above the axle, at a height that",
            found["seat_stay"].start[2],
            max(0, s.bottom_bracket_drop) + s.bottom_bracket_diameter + s.chain_stay_diameter,
        ),
        (
            "stack, for the down tube to join the head tube above the bottom bracket, at a height that",
            found["down_tube"].end[2],
            s.bottom_bracket_diameter + s.down_tube_diameter / 2,
        ),
        (
            "reach, for the top tube to run forward from seat to head tube, by what",
            -found["top_tube"].run[0],
            (s.seat_tube_diameter + s.head_tube_diameter) / 2,
        ),
        ("dropout_spacing, for the dropouts,", s.dropout_spacing, s.chain_stay_diameter),
        ("seat_tube_diameter, for the seat stays to meet it,", s.seat_tube_diameter, 2 * s.seat_stay_offset),
    ]
    welded = (
        ("down_tube", s.head_tube_angle, "head_tube", s.head_tube_lower_extension),
        ("top_tube", s.head_tube_angle, "head_tube", s.head_tube_upper_extension),
        ("top_tube", s.seat_tube_angle, "seat_tube", s.seat_tube_extension),
        ("seat_stay", s.seat_tube_angle, "seat_tube", s.seat_stay_junction),
    )
    for name, angle, other, room in welded:
        tube = found[name]
        sine = np.sqrt(max(1 - float(tube.run @ upward(angle) / tube.length) ** 2, FLATTEST**2))
        text = f"{name}_diameter: where it meets the {other.replace('_', ' ')}, that"
        rooms.append((text, float(room), float(tube.diameter / 2 / sine)))
    return rooms


def derived(parameters: Array) -> dict[str, float]:
    """True values that are no parameters, in closed form [mm, deg, mm²].

    `down_tube_length`, `top_tube_length`, `seat_stay_length`: of the axes, from joint to joint; the stay's in space.
    `effective_top_tube_length`: level, from the head tube's upper end to the seat tube's axis. `rear_centre`: level,
    from bottom bracket to rear axle. `down_tube_angle`, `top_tube_angle`: to the horizontal; the top tube's is positive
    where it rises to the head tube. `front_triangle_area`: between the axes of the four tubes. `length`, `width`,
    `height`: of the whole frame; `head_height`: of the head tube's highest point above the bottom bracket's axis.
    """
    s: Any = checked(parameters)
    found = tubes(s)
    down, top = found["down_tube"], found["top_tube"]
    x, _, z = np.array([down.start, top.start, top.end, down.end]).T
    area = abs((x * np.roll(z, -1) - z * np.roll(x, -1)).sum()) / 2
    lean = np.radians(s.head_tube_angle)
    values = {
        "down_tube_length": down.length,
        "top_tube_length": top.length,
        "seat_stay_length": found["seat_stay"].length,
        "effective_top_tube_length": s.reach + s.stack / np.tan(np.radians(s.seat_tube_angle)),
        "rear_centre": found["dropout"].end[0],
        "down_tube_angle": np.degrees(np.arctan2(down.run[2], -down.run[0])),
        "top_tube_angle": np.degrees(np.arctan2(top.run[2], -top.run[0])),
        "front_triangle_area": area,
        "length": _reach(s, 1, 0, 0) + _reach(s, -1, 0, 0),
        "width": 2 * _reach(s, 0, 1, 0),
        "height": _reach(s, 0, 0, 1) + _reach(s, 0, 0, -1),
        "head_height": s.stack + s.head_tube_diameter / 2 * np.cos(lean),
    }
    return {name: float(value) for name, value in values.items()}


def outside(s: Sizes, *, segments: int = 32, edge: float = 12.0) -> Trimesh:
    """The outside of one frame, FRAMED's too: its tubes united, the left ones mirror images of the right.

    Tubes that run into one another where they are not welded are united there too, and the frame has fewer windows.

    Raises
    ------
    InputError
        For sizes that are not single finite numbers, above 0 all but the drop; for options that make no mesh.
    """
    from manifold3d import Error, Manifold, Mesh64, OpType
    from trimesh import Trimesh

    _check_options(segments, edge)
    for name, size in s._asdict().items():
        if np.ndim(size) or not np.isfinite(float(size)) or not (size > 0 or name == "bottom_bracket_drop"):
            raise InputError(f"frame: {name}: expected one size above 0, got {size!r:.100}")
    parts = []
    for name, tube, normals in _solids(s):
        points, faces = _closed(tube, normals, segments, edge)
        parts.append(Manifold(Mesh64(points, faces.astype(np.uint64))))
        if name in (*PAIRS, "dropout"):
            parts.append(Manifold(Mesh64(points * (1, -1, 1), faces[:, ::-1].astype(np.uint64))))
    united = Manifold.batch_boolean(parts, OpType.Add)
    if united.status() != Error.NoError:
        raise InputError(f"frame: expected tubes that can be united, got {united.status()}")
    mesh = united.to_mesh64()
    return Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64), process=False)


def _solids(s: Sizes) -> Iterator[tuple[str, Tube, tuple[Array, Array]]]:
    """The tubes as solids, with the normals of their ends.

    A tube ends in a plane along the axis of the one it is welded to, so that it never comes out on the far side; a
    little beyond it, so that a top tube and stays wider than the seat tube overlap there and do not merely touch.
    """
    seat, head = (np.cross(ACROSS, upward(angle)) for angle in (s.seat_tube_angle, s.head_tube_angle))
    planes = {"down_tube": (None, head), "top_tube": (seat, head), "seat_stay": (seat, None)}
    for name, tube in tubes(s).items():
        before, beyond = (PAST.get((name, end), 0.0) for end in ("start", "end"))
        way = tube.run / tube.length
        first, last = planes.get(name, (None, None))
        longer = Tube(tube.start - before * way, tube.end + beyond * way, tube.diameter)
        yield name, longer, (way if first is None else first, way if last is None else last)


def _reach(s: Sizes, *towards: float) -> float:
    """How far the frame extends from the origin along a unit vector [mm]: one of its tubes' ends is the outermost."""
    found, out = [], np.array(towards)
    for _, tube, normals in _solids(s):
        way = tube.run / tube.length
        for centre, normal in zip((tube.start, tube.end), normals, strict=True):
            rim = out - normal * (way @ out) / (way @ normal)
            found.append(centre @ out + tube.diameter / 2 * np.linalg.norm(rim))
    return float(max(found))


def _closed(tube: Tube, normals: tuple[Array, Array], segments: int, edge: float) -> tuple[Array, Array]:
    """A solid tube's vertices and faces, faces outward, given the normals of its ends."""
    along = tube.run / tube.length
    first = ACROSS if abs(along[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    first = first - first @ along * along
    first /= np.linalg.norm(first)
    turn = 2 * np.pi * np.arange(segments) / segments
    circle = tube.diameter / 2 * (np.outer(np.cos(turn), first) + np.outer(np.sin(turn), np.cross(along, first)))
    ends = []
    for centre, normal in zip((tube.start, tube.end), normals, strict=True):
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
