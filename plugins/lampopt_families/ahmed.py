"""The Ahmed body, a car's simplest stand-in (Ahmed, Ramm and Faltin, SAE 840300, 1984), its sizes free."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

from .parametric import Family, check_edge

if TYPE_CHECKING:
    from trimesh import Trimesh

# name, unit, low, high; the middle is the body as published, with its 25° slant
PARAMETERS = (
    ("length", "mm", 1000.0, 1088.0),
    ("width", "mm", 370.0, 408.0),
    ("height", "mm", 274.0, 302.0),
    ("slant_angle", "deg", 18.0, 32.0),
    ("slant_length", "mm", 205.0, 239.0),
    ("front_radius", "mm", 94.0, 106.0),
    ("ground_clearance", "mm", 45.0, 55.0),
)
NAMES = tuple(name for name, *_ in PARAMETERS)
LOW = tuple(low for _, _, low, _ in PARAMETERS)
HIGH = tuple(high for *_, high in PARAMETERS)
STILT = 15.0  # radius of the four stilts [mm]
STILTS = (202.0, 672.0)  # their distance from the nose [mm]
INSET = 31.0  # of the stilts from the sides [mm]
CORNERS = 24  # of a stilt's circle, which lie on it
LARGEST = 10_000  # [mm] beyond lies a slip, or a mesh beyond the machine
EDGES = (3.0, 100.0)  # [mm] finest and coarsest mesh


class Sizes(NamedTuple):
    """The parameters by name [mm, deg]."""

    length: float
    width: float
    height: float
    slant_angle: float
    slant_length: float
    front_radius: float
    ground_clearance: float


@dataclass(frozen=True)
class AhmedSource:
    """Ahmed bodies, nose at x = 0, ground at z = 0, symmetric about y = 0; lengths in millimetres.

    Parameters
    ----------
    count
        How many exemplars; 0 for 100, and 15 for the design `ends`, which has no other number.
    design
        `ends`: the middle of the range, which is the body as published, and each parameter's two ends. `lhs`, `sobol`,
        `random`: `count` draws over the range by Latin hypercube, scrambled Sobol sequence, or independently.
    seed
        Of the draws.
    stilts
        Whether it stands on its four stilts; else it floats above the ground, as in many a computation.
    edge
        Length of the mesh's edges [mm], half that around the nose: 26,944 faces at 12 for the body as published.

    Raises
    ------
    InputError
        For options that make no family.
    """

    count: int = 0
    design: str = "ends"
    seed: int = 0
    stilts: bool = True
    edge: float = 12.0

    def __post_init__(self) -> None:
        FAMILY.checked_options(self.count, self.design, self.seed)
        _check_options(self.stilts, self.edge)

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access."""
        upright = {"ground_clearance": "vehicle.ground_clearance"} if self.stilts else {"height": "extents.height"}
        mesh = partial(ahmed_mesh, stilts=self.stilts, edge=self.edge)
        family = replace(FAMILY, mesh=mesh, measured={**FAMILY.measured, **upright})
        return family.exemplars(self.count, self.design, self.seed)


def ahmed_mesh(parameters: Array, *, stilts: bool = True, edge: float = 12.0) -> Trimesh:
    """The true body: watertight, genus 0, faces outward, its edges and panels exact.

    The four edges around the nose are quarter circles, which meet in mitres; corners of the mesh lie on them.

    Parameters
    ----------
    parameters
        (7,) in the order of `NAMES` [mm, deg]; also outside the family's range.
    stilts, edge
        As of `AhmedSource`.

    Raises
    ------
    InputError
        Where the parameters make no such body, naming those at fault; for options that make none.
    """
    from trimesh import Trimesh

    _check_options(stilts, edge)
    s = checked(parameters)
    vertices, faces = _divided_block(*_stations(s, edge), width=s.width, edge=edge)
    if stilts:
        vertices, faces = _on_stilts(vertices, faces, s)
    return Trimesh(vertices, faces, process=False)


def _check_options(stilts: bool, edge: float) -> None:
    if not isinstance(stilts, bool):
        raise InputError(f"ahmed: stilts: expected true or false, got {stilts!r:.100}")
    check_edge("ahmed", edge, *EDGES)


def checked(parameters: Array) -> Sizes:
    """The parameters by name. Raises InputError where they make no body, naming those at fault."""
    s = Sizes(*FAMILY.parameters(parameters).tolist())
    slant = np.radians(s.slant_angle)
    wrong = [
        f"{q.name}: expected more than 0 and up to {LARGEST:,} mm, got {value:.6g} mm"
        for q, value in zip(FAMILY.space, s, strict=True)
        if q.unit == "mm" and not 0 < value <= LARGEST
    ]
    if not 0 <= s.slant_angle < 90:
        wrong.append(f"slant_angle: expected 0 to less than 90 deg, got {s.slant_angle:.6g} deg")
    if not wrong:
        run, drop = s.slant_length * np.cos(slant), s.slant_length * np.sin(slant)
        wrong = [
            f"{what}, got {value:.6g} mm and {most:.6g} mm"
            for what, value, most in (
                ("front_radius: expected less than half the height", s.front_radius, s.height / 2),
                ("front_radius: expected less than half the width", s.front_radius, s.width / 2),
                ("front_radius: expected to end before the stilts", s.front_radius, STILTS[0] - STILT),
                ("slant_length: expected to begin behind the nose", s.front_radius, s.length - run),
                ("slant_length: expected to end above the underside", drop, s.height),
                ("length: expected to reach beyond the stilts", STILTS[1] + STILT, s.length),
                ("width: expected to leave room between the stilts", INSET + STILT, s.width / 2),
            )
            if value >= most
        ]
    if wrong:
        raise InputError("ahmed: " + "; ".join(wrong))
    return s


def derived(parameters: Array, *, stilts: bool = True) -> dict[str, float]:
    """True values to hold measures against, in closed form: `volume`, `area` of the surface, `frontal_area`.

    [mm³, mm², mm²], of the smooth body; a mesh has chords for its circles.
    """
    s = checked(parameters)
    slant, r = np.radians(s.slant_angle), s.front_radius
    drop, run = s.slant_length * np.sin(slant), s.slant_length * np.cos(slant)
    # The nose is inset by i = r (1 - sin t) on all sides at x = r (1 - cos t): the integrals of i and i² along x.
    once, twice = r**2 * (1 - np.pi / 4), r**3 * (5 / 3 - np.pi / 2)
    volume = s.length * s.width * s.height - 2 * (s.width + s.height) * once + 4 * twice - drop * run / 2 * s.width
    nose = (s.width - 2 * r) * (s.height - 2 * r) + 2 * r * ((s.width + s.height - 4 * r) * np.pi / 2 + 4 * r)
    top_and_slant = s.width * (s.length - r - run + s.slant_length)
    sides = 2 * (s.height * (s.length - r) - drop * run / 2)
    area = nose + top_and_slant + sides + s.width * (s.length - r) + s.width * (s.height - drop)
    frontal = s.width * s.height
    if stilts:
        volume += 4 * np.pi * STILT**2 * s.ground_clearance
        area += 4 * 2 * np.pi * STILT * s.ground_clearance
        frontal += 2 * 2 * STILT * s.ground_clearance
    return {"volume": float(volume), "area": float(area), "frontal_area": float(frontal)}


def _stations(s: Sizes, edge: float) -> tuple[Array, Array, Array, Array]:
    """x (n,) of the rings of vertices, their inset from the sides, and their lower and upper ends."""
    run = s.slant_length * np.cos(np.radians(s.slant_angle))
    turn = np.linspace(0, np.pi / 2, max(2, round(np.pi * s.front_radius / edge)) + 1)
    hinge = s.length - run
    x = np.concatenate(
        [
            s.front_radius * (1 - np.cos(turn)),
            _between(s.front_radius, hinge, edge)[1:],
            _between(hinge, s.length, edge)[1:],
        ]
    )
    inset = np.zeros(len(x))
    inset[: len(turn)] = s.front_radius * (1 - np.sin(turn))
    fall = np.maximum(x - hinge, 0) * np.tan(np.radians(s.slant_angle))
    return x, inset, s.ground_clearance + inset, s.ground_clearance + s.height - inset - fall


def _between(first: float, last: float, edge: float) -> Array:
    return np.linspace(first, last, max(1, round((last - first) / edge)) + 1)


def _divided_block(
    x: Array, inset: Array, low: Array, high: Array, *, width: float, edge: float
) -> tuple[Array, Array]:
    """A block whose faces are grids, its rings at `x` (n,) drawn in to their own rectangles; faces outward."""
    counts = (len(x), len(_between(0, width, edge)), len(_between(0, float(np.ptp([low, high])), edge)))
    on_surface = np.zeros(counts, bool)
    for axis in range(3):
        np.moveaxis(on_surface, axis, 0)[[0, -1]] = True
    i, j, k = np.nonzero(on_surface)
    across, up = np.linspace(-1, 1, counts[1])[j], np.linspace(0, 1, counts[2])[k]
    vertices = np.column_stack([x[i], (width / 2 - inset[i]) * across, low[i] * (1 - up) + high[i] * up])
    number = np.full(counts, -1)
    number[i, j, k] = np.arange(len(i))
    sides = (number[0].T, number[-1], number[:, 0], number[:, -1].T, number[:, :, 0].T, number[:, :, -1])
    return vertices, np.concatenate([_triangles(side) for side in sides])


def _triangles(grid: Array) -> Array:
    """Two a cell of `grid` (m, n) of vertex numbers, turned from its rows to its columns."""
    a, b, c, d = (corner.ravel() for corner in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _on_stilts(vertices: Array, faces: Array, s: Sizes) -> tuple[Array, Array]:
    """The body united with its four stilts, which stand on the ground."""
    from manifold3d import Manifold, Mesh64

    body = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    stilt = Manifold.cylinder(s.ground_clearance + STILT, STILT, STILT, CORNERS)
    for x in STILTS:
        for y in (-s.width / 2 + INSET, s.width / 2 - INSET):
            body += stilt.translate((x, y, 0))
    whole = body.to_mesh64()
    return np.asarray(whole.vert_properties)[:, :3], np.asarray(whole.tri_verts).astype(np.int64)


FAMILY = Family(
    "ahmed",
    tuple(Parameter(name, unit) for name, unit, *_ in PARAMETERS),
    np.array(LOW),
    np.array(HIGH),
    "mm",
    {"length": "extents.length", "width": "extents.width", "slant_angle": "rear-window.angle"},
    ahmed_mesh,
)
