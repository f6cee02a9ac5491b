"""Lift, drag and pitching moment of a wing or a flying wing: its sections across become an AeroSandbox aircraft."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .bwb_aero import COEFFICIENTS, METHODS, POINTS, Condition, aerosandbox, evaluated

if TYPE_CHECKING:
    from trimesh import Trimesh

STATIONS = (6, 60)  # sections: too few lose the planform, many more tell nothing
FIRST, LAST = 0.003, 0.985  # of the half span: where the innermost and the outermost section are cut
MODELS = ("", "half", "whole")
ENDS, CENTRE = 0.05, 0.5015  # of the extent across: where chords tell half models from whole ones
UNLIKE, LIKE = 1.5, 1.05  # ratios of these chords: from here on unlike, up to here alike
FACING, RIM, CUT = 0.97, 0.01, 0.6  # a flat end: cosine to y, part of the extent across, part of a section's area
SECOND = 0.1  # of the chord: a longer second outline in a section is a tail or a pod, a shorter one the mesh's


@dataclass(frozen=True)
class WingFlow:
    """Coefficients of an aircraft, by AeroSandbox (the extra `aero`), of the sections of its mesh.

    x to the rear, y across, z up; a half model or a whole one, of which the right half counts. Each section is cut
    from the mesh and becomes an airfoil with its chord, twist and height. Of reference are the planform area and the
    mean aerodynamic chord of the sections; the moment is about its quarter, at the noses' mean height.

    It is for one wing or a flying wing: where a section has a second outline (a tail, a pod, a cavity) there is no
    value. What lies between two sections is not seen.

    Parameters
    ----------
    method
        `aerobuildup`: sections by NeuralFoil, corrected for the planform; `vlm`: vortex lattice, inviscid: its drag is
        the induced one alone, and depends by up to 15 % on how the lattice lies on a planform with kinks: compare
        designs by one number of stations.
    mach, altitude, alpha, beta
        Flight condition: Mach number, altitude [m], angles of attack and sideslip [deg].
    stations
        Sections of the half span.
    chord_m
        How long the longest section is in flight [m], which tells Reynolds' number whatever the mesh's unit.
    model
        "half" or "whole"; without it a model is whole where its middle is longest, half where one end is, and an
        untapered one by which of its ends are cut flat. One that both may be has no value.

    Raises
    ------
    InputError
        For options that make no flow.
    """

    method: str = "aerobuildup"
    mach: float = 0.3
    altitude: float = 0.0
    alpha: float = 4.0
    beta: float = 0.0
    stations: int = 16
    chord_m: float = 1.0
    model: str = ""

    names = COEFFICIENTS
    units = ("",) * len(COEFFICIENTS)

    def __post_init__(self) -> None:
        if self.method not in [*METHODS]:
            raise InputError(f"aerosandbox: method: expected one of {', '.join(METHODS)}, got {self.method!r:.100}")
        if not isinstance(self.stations, int) or not STATIONS[0] <= self.stations <= STATIONS[1]:
            raise InputError(
                f"aerosandbox: stations: expected a whole number from {STATIONS[0]} to {STATIONS[1]}, got "
                f"{self.stations!r:.100}"
            )
        length = self.chord_m
        if not isinstance(length, int | float) or isinstance(length, bool) or not 0 < length < 1e6:
            raise InputError(f"aerosandbox: chord_m: expected a length in metres, got {length!r:.100}")
        if self.model not in MODELS:
            raise InputError(
                f"aerosandbox: model: expected 'half', 'whole' or '' to see for itself, got {self.model!r:.100}"
            )
        _ = self._condition

    def __call__(self, mesh: Trimesh) -> Array:
        """Coefficients of lift, drag and pitching moment, and lift over drag (4,), which is NaN where there is no drag.

        Raises
        ------
        MeasureError
            If it is no wing: nothing extends along y, a section is open, has no length or several outlines, vertices
            are not finite. If it may be a half model as well as a whole one.
        PluginError
            Without AeroSandbox.
        """
        made = airplane(mesh, self.stations, self.chord_m, self.model)
        cl, cd, cm = evaluated(made, self.method, self._condition, spanwise=1)
        return np.array([cl, cd, cm, cl / cd if cd > 0 else np.nan])  # a lattice has none where sections jump

    @property
    def _condition(self) -> Condition:
        return Condition(self.mach, self.altitude, self.alpha, self.beta)

    def example_mesh(self) -> Trimesh:
        """A small half aircraft."""
        from .bwb import HIGH, LOW, bwb_mesh

        return bwb_mesh((np.array(LOW) + HIGH) / 2, chordwise=16, spanwise=24)


@dataclass(frozen=True, eq=False)
class Section:
    """A section across, at `y` from the plane of symmetry: nose (x, z), chord, twist [deg, nose up], airfoil (p, 2)."""

    y: float
    nose: Array
    chord: float
    twist: float
    outline: Array

    @property
    def area(self) -> float:
        """What it encloses."""
        x, z = self.outline.T
        return self.chord**2 * abs(float(x @ (np.roll(z, -1) - np.roll(z, 1)))) / 2


def airplane(mesh: Trimesh, stations: int, longest: float, model: str = "") -> Any:
    """The aircraft of a mesh, its longest chord `longest` metres, as an AeroSandbox `Airplane`."""
    asb = aerosandbox()
    found = sections(mesh, stations, model)
    metre = longest / max(section.chord for section in found)
    y = metre * np.array([section.y for section in found])
    chord = metre * np.array([section.chord for section in found])
    nose = metre * np.array([section.nose for section in found])
    width = np.diff(y)
    area = float((chord[:-1] + chord[1:]) @ width)  # both sides
    mean = 2 / area * float(width @ (chord[:-1] ** 2 + chord[:-1] * chord[1:] + chord[1:] ** 2)) / 3
    quarter = nose[:, 0] + chord / 4
    about, height = (float(np.trapezoid(at * chord, y) * 2 / area) for at in (quarter, nose[:, 1]))
    wing = asb.Wing(
        name="wing",
        symmetric=True,
        xsecs=[
            asb.WingXSec(
                xyz_le=[x, at, z],
                chord=length,
                twist=section.twist,
                airfoil=asb.Airfoil(name=f"section {k}", coordinates=section.outline),
            )
            for k, (section, (x, z), at, length) in enumerate(zip(found, nose, y, chord, strict=True))
        ],
    )
    return asb.Airplane(
        name="mesh", wings=[wing], xyz_ref=[about, 0.0, height], s_ref=area, c_ref=mean, b_ref=2 * float(y[-1])
    )


def sections(mesh: Trimesh, stations: int, model: str = "") -> list[Section]:
    """Sections of the half span from the plane of symmetry to the tip, the outer ones nearer to one another."""
    if not np.isfinite(mesh.vertices).all():
        raise MeasureError("aerosandbox: expected finite vertices, got some that are not")
    if len(mesh.faces) == 0 or not np.ptp(mesh.bounds[:, 1]) > 0:
        raise MeasureError("aerosandbox: expected a wing that extends along y, got a mesh without extent across")
    middle, tip = _half_span(mesh, model)
    share = np.linspace(0, 1, stations)
    share = share + 0.15 * np.sin(np.pi * share) / np.pi
    cuts = np.clip(share, FIRST, LAST)
    return [
        _section(mesh, middle + at * (tip - middle), y * abs(tip - middle)) for at, y in zip(cuts, share, strict=True)
    ]


def _half_span(mesh: Trimesh, model: str) -> tuple[float, float]:
    """y of the plane of symmetry and of the tip."""
    low, high = mesh.bounds[:, 1].tolist()
    whole, right, left = ((low + high) / 2, high), (low, high), (high, low)
    if model == "whole":
        return whole
    first, centre, last = (_section(mesh, low + at * (high - low), 0.0) for at in (ENDS, CENTRE, 1 - ENDS))
    shorter, longer = sorted((first.chord, last.chord))
    if not model and centre.chord > UNLIKE * longer:
        return whole
    longer_at_root = left if last.chord > LIKE * first.chord else right
    if longer > UNLIKE * shorter:
        return longer_at_root
    at_low, at_high = _is_cut(mesh, low, first.area), _is_cut(mesh, high, last.area)
    if at_low != at_high:
        return right if at_low else left
    alike = longer <= LIKE * shorter
    if model or (at_low and not alike):
        return longer_at_root
    if alike and not at_low:
        return whole
    raise MeasureError(
        f"aerosandbox: may be a half model or a whole one: {'both ends are' if at_low else 'neither end is'} cut flat, "
        f"their chords are {first.chord:.4g} and {last.chord:.4g}: say model='half' or model='whole'"
    )


def _is_cut(mesh: Trimesh, end: float, area: float) -> bool:
    """Whether the mesh ends at y = `end` in a plane, about as large as the section near it, or in an opening."""
    from trimesh.grouping import group_rows

    near = np.abs(mesh.vertices[:, 1] - end) < RIM * np.ptp(mesh.bounds[:, 1])
    if near[mesh.edges[group_rows(mesh.edges_sorted, require_count=1)]].all(axis=1).any():
        return True
    facing = np.abs(mesh.face_normals[:, 1])
    flat = near[mesh.faces].all(axis=1) & (facing > FACING)
    return bool((facing * mesh.area_faces)[flat].sum() > CUT * area)


def _section(mesh: Trimesh, at: float, y: float) -> Section:
    cut = mesh.section(plane_origin=[0, at, 0], plane_normal=[0, 1, 0])
    curves = [] if cut is None else [np.asarray(curve)[:, [0, 2]] for curve in cut.discrete]
    curves.sort(key=lambda points: float(np.ptp(points[:, 0])))
    if not curves or len(curves[-1]) <= 3 or not np.allclose(curves[-1][0], curves[-1][-1]):
        raise MeasureError(f"aerosandbox: the section across at y = {at:.4g} is open or empty: expected a closed wing")
    *others, loop = curves
    if others and np.ptp(others[-1][:, 0]) > SECOND * np.ptp(loop[:, 0]):
        raise MeasureError(
            f"aerosandbox: the section across at y = {at:.4g} has a second outline, {np.ptp(others[-1][:, 0]):.4g} "
            f"long beside one of {np.ptp(loop[:, 0]):.4g}: expected one wing, without tail, pod or cavity"
        )
    loop = loop[:-1]
    nose, tail = _end(loop, np.argmin), _end(loop, np.argmax)
    along = tail - nose
    chord = float(np.hypot(*along))
    if not chord > 0:
        raise MeasureError(f"aerosandbox: the section across at y = {at:.4g} has no length")
    turn = np.array([[along[0], along[1]], [-along[1], along[0]]]) / chord**2
    return Section(y, nose, chord, float(np.degrees(np.arctan2(-along[1], along[0]))), _airfoil((loop - nose) @ turn.T))


def _end(loop: Array, which: Any) -> Array:
    """The foremost or rearmost place of a section; of a blunt one the middle of its edge."""
    x = loop[:, 0]
    edge = np.abs(x - x[which(x)]) <= 1e-6 * np.ptp(x)
    return np.asarray((loop[edge].min(0) + loop[edge].max(0)) / 2)


def _airfoil(loop: Array) -> Array:
    """A section of chord 1 from the tail over the upper side to the nose and back below."""
    share = (1 - np.cos(np.linspace(0, np.pi, POINTS))) / 2
    first, last = int(loop[:, 0].argmin()), int(loop[:, 0].argmax())
    there = np.roll(loop, -first, axis=0)
    cut = (last - first) % len(loop)
    sides = there[: cut + 1], np.concatenate([there[cut:], there[:1]])[::-1]
    heights = [np.interp(share, *_rising(side)) for side in sides]
    upper, lower = sorted(heights, key=np.mean, reverse=True)
    return np.concatenate([np.column_stack([share, upper])[::-1], np.column_stack([share, lower])[1:]])


def _rising(side: Array) -> tuple[Array, Array]:
    """Its points from nose to tail, those that turn back left out."""
    x = np.maximum.accumulate(side[:, 0])
    return x, side[:, 1]
