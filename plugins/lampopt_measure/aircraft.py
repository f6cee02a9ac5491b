"""Aircraft: span and planform, sweep and thickness by station, the planform parameters of a blended wing body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .aircraft_ends import Edges, edges
from .aircraft_planform import planform
from .aircraft_sections import MODELS, Halves
from .silhouette import FrontalArea

if TYPE_CHECKING:
    from trimesh import Trimesh

OFFSETS = np.linspace(-0.027, 0.027, 12)  # of the half span: sections about a station, many to even out rough meshes
INNER = slice(4, 8)  # of these: where thickness and chord are taken
OUTER = (0.035, 0.95)  # of the half span: where stations may lie
ALONG = np.linspace(0.02, 0.97, 98)[1:-1]  # of the half span: where lost tails are looked for
FROM_ABOVE = FrontalArea(forward="z", up="x")


def example_wing() -> Trimesh:
    """The right half of an aircraft of three panels, closed: 1000 long in the middle, 700 from there to the tip."""
    from trimesh import Trimesh

    corners, nose, chord = (0, 150, 270, 700), (0, 180, 320, 560), (1000, 680, 230, 70)
    across = np.unique(np.r_[np.linspace(0, 700, 57), corners])
    there = 1 - np.cos(np.linspace(0, np.pi / 2, 25))
    share, side = np.r_[there, there[-2:0:-1]], np.r_[np.ones(25), -np.ones(23)]  # round each section, once
    start, length = (np.interp(across, corners, values)[:, None] for values in (nose, chord))
    x, z = start + length * share, 0.2 * length * side * np.sqrt(share) * (1 - share)
    count = len(share)
    ring = np.arange(x.size).reshape(x.shape)
    a, b = ring, np.roll(ring, -1, axis=1)
    skin = [[a[:-1], b[:-1], b[1:]], [a[:-1], b[1:], a[1:]]]
    upper, lower = np.arange(count // 2 + 1), -np.arange(count // 2 + 1)
    cap = [[upper[:-1], lower[1:], upper[1:]], [upper[:-1], lower[:-1], lower[1:]]]
    root = [[ring[0][corner] for corner in triangle] for triangle in cap]
    tip = [[ring[-1][corner] for corner in triangle[::-1]] for triangle in cap]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in (*skin, *root, *tip)])
    p, q, r = faces.T
    vertices = np.stack([x, np.broadcast_to(across[:, None], x.shape), z], axis=-1).reshape(-1, 3)
    return Trimesh(vertices, faces[(p != q) & (q != r) & (r != p)], process=False)


@dataclass(frozen=True)
class Wing:
    """Span from tip to tip, planform area, aspect ratio span² / area, mean chord area / span.

    The area is what the aircraft covers seen from above, its body included, and what it lacks of its sharp trailing
    edge, of which marching cubes lose some: sections along the span are continued to the tail that `stations` and `bwb`
    find from their thickness, where that lies behind their own end and they do not end in a wall or a rounding. A true
    mesh covers its tail. Of a half model span and area are doubled.

    Parameters
    ----------
    model
        "half" or "whole"; without it a model is a half one whose sections are unlike near both ends across.
    """

    model: str = ""

    names = ("span", "planform_area", "aspect_ratio", "mean_chord")
    units = ("L", "L^2", "", "L")

    def __post_init__(self) -> None:
        _checked_model(self.model)

    def __call__(self, mesh: Trimesh) -> Array:
        """The four values (4,). Raises EmptyMesh, MeasureError."""
        span, area, _ = self._measured(mesh)
        return np.array([span, area, span**2 / area, area / span])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (4, V, 3). Raises EmptyMesh, MeasureError.

        Vertices that tie for a tip share its derivative, those of a flat root by area: moved as a whole either end has
        a derivative, of a tilt of a flat tip it has none.
        """
        span, area, found = self._measured(mesh, follow=("tail", "last"))
        halves, lost = found.halves, self._lost(found)
        by_span = np.zeros((len(halves.vertices), 3))
        by_span[:, 1] = 2 * halves.across()
        share = (2 * halves.span / lost.size * (lost > 0))[None]
        by_area = 2.0 / len(halves.sides) * FROM_ABOVE.gradient(mesh)[0]
        by_area += found.gradient(np.zeros(1), tail=share, last=-share)[0] + lost.mean() * by_span
        ratio = 2 * span / area * by_span - (span / area) ** 2 * by_area
        return np.array([by_span, by_area, ratio, by_area / span - area / span**2 * by_span])

    def _measured(self, mesh: Trimesh, *, follow: tuple[str, ...] = ()) -> tuple[float, float, Edges]:
        found = edges(Halves.of(mesh, self.model), ALONG, follow=follow)
        covered = 2.0 / len(found.halves.sides) * float(FROM_ABOVE(mesh)[0])
        span = 2 * found.halves.span
        return span, covered + span * float(self._lost(found).mean()), found

    def _lost(self, found: Edges) -> Array:
        """(n, s) how much of the tail each section lacks [L]."""
        return np.where(found.fitted & ~found.blunt, np.maximum(found.tail - found.last, 0), 0)

    def example_mesh(self) -> Trimesh:
        """A small half aircraft."""
        return example_wing()


@dataclass(frozen=True)
class Stations:
    """Leading-edge sweep and thickness-to-chord of a wing at stations of its half span.

    The sweep is that of a line through the noses of twelve sections about the station, within 2.7 % of the half span,
    positive to the rear. The thickness is the largest extent along z over the chord, the mean of the four nearest ones.

    Parameters
    ----------
    stations
        Shares of the half span, as in "0.25,0.5,0.75". Their values are named sweep_25, thickness_25, ...
    model
        "half" or "whole"; without it a model is a half one whose sections are unlike near both ends across.
    """

    stations: str = "0.25,0.5,0.75"
    model: str = ""

    def __post_init__(self) -> None:
        _checked_model(self.model)
        places = self._places
        if not places or len(set(places)) < len(places) or not all(OUTER[0] <= s <= OUTER[1] for s in places):
            raise InputError(
                f"stations: expected distinct shares of the half span from {OUTER[0]} to {OUTER[1]}, "
                f"as in '0.25,0.5,0.75', got {self.stations!r:.100}"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The values' names: the station in percent, its decimal point as an underscore."""
        percents = [f"{100 * place:.6g}".replace(".", "_") for place in self._places]
        return tuple(f"{what}_{percent}" for percent in percents for what in ("sweep", "thickness"))

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return ("deg", "") * len(self._places)

    @property
    def _places(self) -> tuple[float, ...]:
        try:
            return tuple(float(part) for part in self.stations.split(","))
        except ValueError:
            return ()

    def __call__(self, mesh: Trimesh) -> Array:
        """Sweep [deg] and thickness for each station (2n,). Raises EmptyMesh, MeasureError."""
        return self._values(self._edges(mesh))[0]

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (2n, V, 3). Raises EmptyMesh, MeasureError."""
        found = self._edges(mesh, follow=("nose", "tail", "thickness"))
        _, by_span, by = self._values(found)
        return found.gradient(by_span, **by)

    def _edges(self, mesh: Trimesh, *, follow: tuple[str, ...] = ()) -> Edges:
        at = np.array(self._places)[:, None] + OFFSETS
        found = edges(Halves.of(mesh, self.model), at.ravel(), follow=follow)
        found.expect_one_part()
        return found

    def _values(self, found: Edges) -> tuple[Array, Array, dict[str, Array]]:
        """The values (2n,), and how they change with the half span (2n,), noses, tails, thicknesses (2n, 12n, s)."""
        count, sides = len(self._places), found.nose.shape[1]
        parts = (found.nose, found.tail, found.thickness)
        nose, tail, thickness = (part.reshape(count, len(OFFSETS), sides) for part in parts)
        fit = np.broadcast_to((OFFSETS / (OFFSETS**2).sum() / found.halves.span / sides)[:, None], nose.shape[1:])
        slope = (fit * nose).sum(axis=(1, 2))
        chord = (tail - nose)[:, INNER]
        relative = thickness[:, INNER] / chord
        values = np.stack([np.degrees(np.arctan(slope)), relative.mean(axis=(1, 2))], axis=1)
        by_slope, share = np.degrees(1 / (1 + slope**2)), 1 / relative[0].size
        by_span = np.stack([-by_slope * slope / found.halves.span, np.zeros(count)], axis=1)
        by = {name: np.zeros((count, 2, *nose.shape)) for name in ("nose", "tail", "thickness")}
        own = np.arange(count)
        by["nose"][own, 0, own] = by_slope[:, None, None] * fit
        by["nose"][own, 1, own, INNER] = share * relative / chord
        by["tail"][own, 1, own, INNER] = -share * relative / chord
        by["thickness"][own, 1, own, INNER] = share / chord
        return values.ravel(), by_span.ravel(), {name: part.reshape(2 * count, -1, sides) for name, part in by.items()}

    def example_mesh(self) -> Trimesh:
        """A small half aircraft."""
        return example_wing()


@dataclass(frozen=True)
class Bwb:
    """The planform of a blended wing body (BlendedNet, Sung et al., 2025): three panels with straight edges.

    Widths B1, B2, B3 of the panels from the plane of symmetry, chords C1 to C4 at their ends, sweeps S1, S2, S3 of the
    leading edge. Sections have to have round noses and thin tails: both are found from the thickness, so that marching
    cubes may cut the last millimetres off. A panel narrower than 1 % of the half span is refused.

    Parameters
    ----------
    model
        "half" or "whole"; without it a model is a half one whose sections are unlike near both ends across.
    """

    model: str = ""

    names = ("B1", "B2", "B3", "C1", "C2", "C3", "C4", "S1", "S2", "S3")
    units = ("L",) * 7 + ("deg",) * 3

    def __post_init__(self) -> None:
        _checked_model(self.model)

    def __call__(self, mesh: Trimesh) -> Array:
        """The ten values (10,). Raises EmptyMesh; MeasureError where there are no three panels."""
        return planform(Halves.of(mesh, self.model))[0]

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (10, V, 3). Raises as a call does.

        Which sections count is taken as constant. Vertices that tie for a tip share its derivative, those of a flat
        root by area: moved as a whole either end has a derivative, of a tilt of a flat tip it has none.
        """
        gradient = planform(Halves.of(mesh, self.model), derivative=True)[1]
        if not np.isfinite(gradient).all():
            raise MeasureError("bwb: expected a smooth wing, got one whose values have no derivative by the vertices")
        return gradient

    def example_mesh(self) -> Trimesh:
        """A small half aircraft."""
        return example_wing()


def _checked_model(model: str) -> None:
    if model not in MODELS:
        raise InputError(f"model: expected 'half', 'whole' or '' to see for itself, got {model!r:.100}")
