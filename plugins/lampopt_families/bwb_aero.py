"""Lift, drag and pitching moment of the blended wing body, by AeroSandbox (the extra `aero`)."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from lampopt.errors import InputError, PluginError
from lampopt.types import Array, Parameter

from .bwb import Stations, camber, half_thickness, stations

METHODS = {"aerobuildup": "AeroBuildup", "vlm": "VortexLatticeMethod"}
COEFFICIENTS = ("cl", "cd", "cm", "ld")
CHORDWISE, SPANWISE = 8, 8  # vortices between two sections
POINTS = 60  # of an airfoil, on each side
METRE = 1e-3  # of a millimetre
LIMITS = {"mach": (0.0, 0.9), "altitude": (-1000.0, 20_000.0), "alpha": (-30.0, 30.0), "beta": (-30.0, 30.0)}
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Condition:
    """A flight condition.

    Parameters
    ----------
    mach
        Number of the free stream.
    altitude
        [m] in the standard atmosphere.
    alpha, beta
        Angles of attack and of sideslip [deg].

    Raises
    ------
    InputError
        For what the methods are not made for.
    """

    mach: float = 0.3
    altitude: float = 0.0
    alpha: float = 4.0
    beta: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            plain = isinstance(value, int | float) and not isinstance(value, bool)
            if not plain or not low <= value <= high or (name == "mach" and value == 0):
                least = "more than 0" if name == "mach" else f"from {low:g}"
                raise InputError(f"aerosandbox: {name}: expected a number {least} to {high:g}, got {value!r:.100}")


@dataclass(frozen=True)
class Coefficients:
    """What a method says of an aircraft, relative to its planform area and mean aerodynamic chord.

    Parameters
    ----------
    cl, cd, cm
        Lift, drag, pitching moment, nose up positive. By the vortex lattice the drag is the induced one alone.
    method
        `aerobuildup` or `vlm`.
    area, chord
        Of reference: planform area [m²], mean aerodynamic chord [m].
    about
        x that the moment is about: the quarter of the mean aerodynamic chord [m] behind the nose.
    """

    cl: float
    cd: float
    cm: float
    method: str
    area: float
    chord: float
    about: float

    @property
    def ld(self) -> float:
        """Lift over drag."""
        return self.cl / self.cd


def coefficients(parameters: Array, method: str, condition: Condition | None = None) -> Coefficients:
    """Coefficients of the whole aircraft at parameters (9,) [mm, deg], its centre chord being one metre.

    Parameters
    ----------
    method
        `aerobuildup`: sections by NeuralFoil, corrected for the planform; `vlm`: vortex lattice, inviscid.
    condition
        Of flight; sea level, Mach 0.3, 4° angle of attack without.

    Raises
    ------
    InputError
        For an unknown method, or parameters for which there is no aircraft.
    PluginError
        Without AeroSandbox.
    """
    at = stations(parameters)
    area, chord, about = reference(at)
    found = evaluated(airplane(at), method, condition or Condition())
    return Coefficients(*found, method, area, chord, about)


def reference(at: Stations) -> tuple[float, float, float]:
    """Planform area [m²], mean aerodynamic chord [m] and x of its quarter point [m]: trapezoids between stations."""
    inner, outer = at.chord[:-1] * METRE, at.chord[1:] * METRE
    width, nose = np.diff(at.y) * METRE, at.leading_edge * METRE
    area = float(((inner + outer) * width).sum())  # both sides
    chord = 2 / area * float((width * (inner**2 + inner * outer + outer**2)).sum()) / 3
    # ∫ c x dy over a trapezoid, chord and leading edge being linear
    moment = width / 6 * (nose[:-1] * (2 * inner + outer) + nose[1:] * (inner + 2 * outer))
    return area, chord, 2 / area * float(moment.sum()) + chord / 4


def airplane(at: Stations) -> Any:
    """The aircraft as an AeroSandbox `Airplane` [m], both sides, lofted through the same four sections."""
    area, chord, about = reference(at)
    asb = aerosandbox()
    sections = [
        asb.WingXSec(
            xyz_le=[x * METRE, y * METRE, 0.0],
            chord=c * METRE,
            airfoil=asb.Airfoil(name=f"bwb {100 * thickness:.0f} %", coordinates=outline(thickness)),
        )
        for x, y, c, thickness in zip(at.leading_edge, at.y, at.chord, at.thickness, strict=True)
    ]
    wing = asb.Wing(name="body and wing", xsecs=sections, symmetric=True)
    span = 2 * float(at.y[-1]) * METRE
    return asb.Airplane(name="bwb", wings=[wing], xyz_ref=[about, 0.0, 0.0], s_ref=area, c_ref=chord, b_ref=span)


def outline(thickness: float) -> Array:
    """An airfoil (2 · `POINTS` − 1, 2) of chord 1, from the tail over the upper side to the nose and back below."""
    share = (1 - np.cos(np.linspace(0, np.pi, POINTS))) / 2
    middle, bulge = camber(share), thickness * half_thickness(share)
    upper, lower = (np.column_stack([share, middle + sign * bulge]) for sign in (1, -1))
    return np.concatenate([upper[::-1], lower[1:]])


def evaluated(airplane: Any, method: str, condition: Condition, spanwise: int = SPANWISE) -> tuple[float, float, float]:
    """Lift, drag and pitching moment coefficient of an AeroSandbox `Airplane`, by its own reference.

    A vortex lattice has so many vortices `spanwise` between two sections.

    Raises InputError for an unknown method, PluginError without AeroSandbox.
    """
    if method not in METHODS:
        raise InputError(f"bwb: method: expected one of {', '.join(METHODS)}, got {method!r:.100}")
    asb = aerosandbox()
    air = asb.Atmosphere(altitude=condition.altitude)
    point = asb.OperatingPoint(
        air, velocity=condition.mach * air.speed_of_sound(), alpha=condition.alpha, beta=condition.beta
    )
    options = {"spanwise_resolution": spanwise, "chordwise_resolution": CHORDWISE} if method == "vlm" else {}
    found = getattr(asb, METHODS[method])(airplane=airplane, op_point=point, **options).run()
    cl, cd, cm = (float(np.squeeze(found[name])) for name in ("CL", "CD", "Cm"))
    return cl, cd, cm


def labels(parameters: Array, method: str, condition: Condition) -> tuple[Array, tuple[Parameter, ...]]:
    """Labels (N, 4) at parameters (N, 9) and their names, which say the method: `cl_vlm`, `cd_vlm`, ..."""
    rows = []
    for i, row in enumerate(parameters):
        found = coefficients(row, method, condition)
        rows.append([getattr(found, name) for name in COEFFICIENTS])
        log.info("bwb: coefficients by %s: %d of %d", METHODS[method], i + 1, len(parameters))
    return np.array(rows), tuple(Parameter(f"{name}_{method}", "") for name in COEFFICIENTS)


def aerosandbox() -> Any:
    """AeroSandbox. Raises PluginError without it."""
    try:
        import aerosandbox
    except ImportError as error:
        raise PluginError(
            "bwb: aerodynamic coefficients need AeroSandbox, which is not installed: pip install 'lampopt[aero]'"
        ) from error
    return aerosandbox
