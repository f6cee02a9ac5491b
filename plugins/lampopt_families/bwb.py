"""Blended-wing-body aircraft on BlendedNet's planform parameters (Sung et al., 2025; paper, appendix M)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

from .parametric import Family, whole

if TYPE_CHECKING:
    from trimesh import Trimesh

CENTRE_CHORD = 1000.0  # C1 [mm], the length that all others are relative to
SPACE = {  # low and high end of BlendedNet's ranges
    "B1": (100.0, 200.0, "mm"),
    "B2": (50.0, 200.0, "mm"),
    "B3": (200.0, 700.0, "mm"),
    "C2": (550.0, 850.0, "mm"),
    "C3": (180.0, 280.0, "mm"),
    "C4": (60.0, 90.0, "mm"),
    "S1": (40.0, 60.0, "deg"),
    "S2": (40.0, 60.0, "deg"),
    "S3": (24.0, 40.0, "deg"),
}
NAMES = tuple(SPACE)
LOW = tuple(low for low, _, _ in SPACE.values())
HIGH = tuple(high for _, high, _ in SPACE.values())
THICKNESS = (0.18, 0.17, 0.16, 0.16)  # thickness to chord where the chords are C1 to C4; linear along the span between
CAMBER = 0.015  # of the chord, at its highest
TIP = 0.08  # of C4: over this last part of the span the thickness closes to nothing, half an ellipse
LEAST = 1.0  # mm: a panel or a chord below is none
STEEPEST = 85.0  # deg
SHARES = (0.2, 0.2, 0.5, 0.1)  # of the strips along the span: the three panels, the rounding of the tip
FINEST = 2_000  # strips; beyond lies a slip, or a machine out of memory


@dataclass(frozen=True)
class BwbSource:
    """Blended-wing-body aircraft: x to the rear, y to the right, z up, nose at the origin; lengths in millimetres.

    Parameters
    ----------
    count
        How many exemplars; 0 for 100, and 19 for the design `ends`, which has no other number.
    design
        `ends`: the middle of the range and each parameter's two ends. `lhs`, `sobol`, `random`: `count` draws over
        the range.
    seed
        Of the draws.
    half
        The right half, closed by the symmetry plane: at one resolution a decoder sees it twice as large. False: the
        whole aircraft.
    chordwise, spanwise
        Strips of the mesh along the chord and along the half span.
    labels
        `aerobuildup` or `vlm`: coefficients of lift, drag and pitching moment and lift over drag by that method of
        AeroSandbox, named after it (`cl_vlm`, `cd_vlm`, `cm_vlm`, `ld_vlm`), computed when the source is called.
    mach, altitude, alpha, beta
        Flight condition of the labels: Mach number, altitude [m], angles of attack and sideslip [deg].

    Raises
    ------
    InputError
        For options that make no family.
    """

    count: int = 0
    design: str = "lhs"
    seed: int = 0
    half: bool = True
    chordwise: int = 64
    spanwise: int = 100
    labels: str = ""
    mach: float = 0.3
    altitude: float = 0.0
    alpha: float = 4.0
    beta: float = 0.0

    def __post_init__(self) -> None:
        from .bwb_aero import METHODS, Condition

        family().checked_options(self.count, self.design, self.seed)
        _check_options(self.half, self.chordwise, self.spanwise)
        if self.labels and self.labels not in METHODS:
            raise InputError(f"bwb: labels: expected one of {', '.join(METHODS)} or none, got {self.labels!r:.100}")
        Condition(self.mach, self.altitude, self.alpha, self.beta)

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access. Raises PluginError where labels need what is not installed."""
        made = family(half=self.half, chordwise=self.chordwise, spanwise=self.spanwise)
        exemplars = made.exemplars(self.count, self.design, self.seed)
        if not self.labels:
            return exemplars
        from .bwb_aero import Condition, labels

        condition = Condition(self.mach, self.altitude, self.alpha, self.beta)
        values, space = labels(exemplars.parameters, self.labels, condition)
        return replace(exemplars, labels=values, label_space=space)


def family(*, half: bool = True, chordwise: int = 64, spanwise: int = 100) -> Family:
    """The aircraft as a `Family`: its parameters, their ranges, its mesh."""
    return Family(
        "bwb",
        tuple(Parameter(name, unit) for name, (_, _, unit) in SPACE.items()),
        np.array(LOW),
        np.array(HIGH),
        "mm",
        {name: f"bwb.{name}" for name in NAMES},
        partial(bwb_mesh, half=half, chordwise=chordwise, spanwise=spanwise),
    )


@dataclass(frozen=True, eq=False)
class Stations:
    """The four sections that the aircraft is lofted through, from the centre to the tip."""

    y: Array  # (4,) [mm]
    leading_edge: Array  # (4,) x of it [mm]
    chord: Array  # (4,) [mm]
    thickness: Array  # (4,) to chord


def stations(parameters: Array) -> Stations:
    """The sections at parameters (9,) B1, B2, B3, C2, C3, C4 [mm], S1, S2, S3 [deg].

    Raises
    ------
    InputError
        Naming each parameter for which there is no aircraft.
    """
    values = family().parameters(parameters)
    widths, chords, sweeps = values[:3], values[3:6], values[6:]
    least = [LEAST, LEAST, max(LEAST, LEAST + TIP * chords[2]), LEAST, LEAST, LEAST]
    wrong = [
        f"{name}: expected more than {low:.6g} mm, got {value:.6g} mm"
        for name, value, low in zip(NAMES[:6], values[:6], least, strict=True)
        if value <= low
    ]
    wrong += [
        f"{name}: expected a sweep within ±{STEEPEST:g}°, got {value:.6g}°"
        for name, value in zip(NAMES[6:], sweeps, strict=True)
        if abs(value) >= STEEPEST
    ]
    if wrong:
        raise InputError("bwb: " + "; ".join(wrong))
    steps = widths * np.tan(np.radians(sweeps))
    return Stations(
        np.r_[0, np.cumsum(widths)], np.r_[0, np.cumsum(steps)], np.r_[CENTRE_CHORD, chords], np.array(THICKNESS)
    )


def half_thickness(share: Array) -> Array:
    """Half the thickness at `share` of the chord, in thicknesses: round nose, sharp tail, ½ at a third of the chord.

    The class function √ξ (1 − ξ) of Kulfan's airfoils ("Universal parametric geometry representation method", 2008).
    """
    return np.asarray(0.75 * np.sqrt(3) * np.sqrt(share) * (1 - share))


def camber(share: Array) -> Array:
    """Height of the camber line at `share` of the chord, in chords.

    The cubic with a reflexed tail that thin-airfoil theory gives no moment about the quarter chord, as a flying wing
    needs it: ξ (1 − ξ) (7/8 − ξ), scaled to `CAMBER` at its highest.
    """
    highest = (15 - np.sqrt(57)) / 24  # where its slope 3 ξ² − 15/4 ξ + 7/8 is nought
    line, peak = (s * (1 - s) * (7 / 8 - s) for s in (share, highest))
    return np.asarray(CAMBER * line / peak)


def bwb_mesh(parameters: Array, *, half: bool = True, chordwise: int = 64, spanwise: int = 100) -> Trimesh:
    """The true aircraft: one watertight body, genus 0, faces outward; one connectivity for all parameters.

    Two height fields, upper and lower side, over one triangulation of the planform, which share its outline: where
    the planform is one, nothing can cross. Leading and trailing edge are straight between the stations, whose corners
    are vertices; the tip's chord is C4, its rounding is in the thickness.

    Parameters
    ----------
    parameters
        (9,) B1, B2, B3, C2, C3, C4 [mm], S1, S2, S3 [deg]; also far outside the family's range.
    half
        The right half, closed by the plane y = 0; otherwise the whole aircraft.
    chordwise, spanwise
        Strips of the mesh along the chord, closer at the nose, and along the half span.

    Raises
    ------
    InputError
        Naming each parameter for which there is no aircraft; for options that make no mesh.
    """
    from trimesh import Trimesh

    _check_options(half, chordwise, spanwise)
    at = stations(parameters)
    y, closing = _span(at, spanwise)
    share = 1 - np.cos(np.pi / 2 * np.arange(chordwise + 1) / chordwise)
    share[-1] = 1.0
    leading, chord, thickness = (np.interp(y, at.y, v)[:, None] for v in (at.leading_edge, at.chord, at.thickness))
    middle = chord * camber(share)
    bulge = chord * thickness * closing[:, None] * half_thickness(share)
    grid = np.arange(middle.size).reshape(middle.shape)
    inner = np.zeros(middle.shape, bool)
    inner[:-1, 1:-1] = True
    below = grid.copy()  # the lower side has vertices of its own but for the outline
    below[inner] = grid.size + np.arange(inner.sum())
    plan = np.stack([leading + chord * share, np.broadcast_to(y[:, None], middle.shape)], axis=-1)
    upper = np.concatenate([plan, (middle + np.where(inner, bulge, 0))[..., None]], axis=-1)
    lower = np.concatenate([plan, (middle - bulge)[..., None]], axis=-1)
    vertices = np.concatenate([upper.reshape(-1, 3), lower[inner]])
    sides = np.concatenate([_quads(grid), _quads(below)[:, ::-1]])
    root = _quads(np.stack([below[0], grid[0]]))
    if half:
        faces = np.concatenate([sides, root])
    else:
        vertices, faces = _mirrored(vertices, sides)
    a, b, c = faces.T
    return Trimesh(vertices, faces[(a != b) & (b != c) & (c != a)], process=False)


def _check_options(half: bool, chordwise: int, spanwise: int) -> None:
    if not isinstance(half, bool):
        raise InputError(f"bwb: half: expected true or false, got {half!r:.100}")
    for option, value, least in (("chordwise", chordwise, 4), ("spanwise", spanwise, 10)):
        if not whole(value) or not least <= value <= FINEST:
            raise InputError(f"bwb: {option}: expected a whole number from {least} to {FINEST:,}, got {value!r:.100}")


def _span(at: Stations, strips: int) -> tuple[Array, Array]:
    """(m,) where along the span the mesh has vertices [mm], and how much of the thickness is left there."""
    rounding = TIP * at.chord[-1]
    ends = np.r_[at.y[:3], at.y[3] - rounding, at.y[3]]
    counts = [max(1, round(share * strips)) for share in SHARES]
    panels = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(ends[:3], ends[1:4], counts[:3], strict=True)]
    turn = np.pi / 2 * np.arange(counts[3] + 1) / counts[3]
    tip = ends[3] + rounding * np.sin(turn)
    tip[-1] = ends[4]
    y = np.concatenate([*panels, tip])
    return y, np.concatenate([np.ones(sum(counts[:3])), np.cos(turn)])


def _quads(grid: Array) -> Array:
    """Two triangles for each cell of a grid of vertices (m, n), seen from above with rows to the right, columns up.

    The diagonal turns half-way along the columns, so that no triangle at a corner of the tip has all three on the
    outline: it would be upper and lower side at once.
    """
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    front = np.broadcast_to(np.arange(a.shape[1]) < a.shape[1] // 2, a.shape)
    triangles = (a, b, np.where(front, d, c)), (np.where(front, b, a), c, d)
    return np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in triangles])


def _mirrored(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """The whole of a right half that is open at y = 0, where the two halves share their vertices."""
    off = vertices[:, 1] > 0
    twin = np.where(off, len(vertices) + np.cumsum(off) - 1, np.arange(len(vertices)))
    return np.concatenate([vertices, vertices[off] * (1, -1, 1)]), np.concatenate([faces, twin[faces[:, ::-1]]])
