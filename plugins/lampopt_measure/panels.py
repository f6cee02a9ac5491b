"""Angles of a body's panels, from lines fitted to the straight runs of its sections."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError

from .axes import check_axes
from .example import simple_car
from .facets import Facets, section
from .fits import Line, line, slope
from .pieces import measure
from .profile import NOISE, TRIM, Run, check_gaps, outline, runs
from .quantity import Number, Quantity, atan2, mean
from .vehicle import ADVICE, Vehicle

if TYPE_CHECKING:
    from trimesh import Trimesh

GLASS = 0.6  # of the height: middles of windscreen and rear window lie above
DECK = 0.4  # of the height: bonnet and trunk lid lie above
FLAT = 8.0  # [deg] a roof is no steeper
APART = 5.0  # [deg] by which a bonnet or trunk lid is flatter than the window beside it
SHORT = 0.04  # of the length: what is shorter is no panel
ENDS = 0.15  # of the length: where ramp and diffuser have their middles, from either end
SMOOTH = 1e-5  # of the length: what is off a line by less is on it
LEVEL = 3.0  # [deg] a floor is no steeper


@measure(simple_car, check_axes, angle="deg")
def windscreen(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the windscreen to the horizontal, in the middle."""
    body, centre, top = _top(mesh, forward, up)
    return {"angle": _slope(centre, _glass(body, top, 1), body)}


@measure(simple_car, check_axes, angle="deg")
def rear_window(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the rear window to the horizontal, in the middle; positive where it falls towards the tail."""
    body, centre, top = _top(mesh, forward, up)
    return {"angle": -_slope(centre, _glass(body, top, -1), body)}


@measure(simple_car, check_axes, angle="deg")
def hood(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the bonnet to the horizontal, in the middle; positive where it rises towards the windscreen."""
    body, centre, top = _top(mesh, forward, up)
    glass = _glass(body, top, 1)
    return {"angle": _slope(centre, _deck(body, top[: top.index(glass)], glass, 1, "a bonnet"), body)}


@measure(simple_car, check_axes, angle="deg")
def trunk_lid(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the trunk lid to the horizontal, in the middle; positive where it falls towards the tail."""
    body, centre, top = _top(mesh, forward, up)
    glass = _glass(body, top, -1)
    return {"angle": -_slope(centre, _deck(body, top[top.index(glass) + 1 :], glass, -1, "a trunk lid"), body)}


@measure(simple_car, check_axes, angle="deg")
def ramp(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the front underbody to the horizontal, in the middle; positive where it rises towards the nose."""
    body, centre, bottom = _bottom(mesh, forward, up)
    floor = bottom.index(_floor(body, bottom))
    return {"angle": -_slope(centre, _under(body, bottom[:floor], -1, "a front underbody"), body)}


@measure(simple_car, check_axes, angle="deg")
def diffuser(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the rear underbody to the horizontal, in the middle; positive where it rises towards the tail."""
    body, centre, bottom = _bottom(mesh, forward, up)
    floor = bottom.index(_floor(body, bottom))
    return {"angle": _slope(centre, _under(body, bottom[floor + 1 :], 1, "a rear underbody"), body)}


@measure(simple_car, check_axes, angle="deg")
def greenhouse(mesh: Trimesh, *, forward: str = "", up: str = "z") -> dict[str, Number]:
    """Angle of the side windows to the vertical, half-way along the roof; positive where they lean inwards.

    Half-way to a hundredth of the length: the station moves with nose and tail, not with where a window is seen to end.
    """
    body, _, top = _top(mesh, forward, up)
    front, rear = _glass(body, top, 1), _glass(body, top, -1)
    share = ((front.end[0] + rear.start[0]) / 2 - float(body.nose)) / float(body.length)
    cut = section(body.shape, "x", body.station(round(share, 2)))
    length = float(body.length)
    angles: list[Quantity] = []
    for side, name in ((-1, "left"), (1, "right")):
        half = cut.where(side * (cut.middles[:, 1] - float(body.middle)) > 0)
        half = half.between(z=(body.ground + DECK * body.height, body.top)).required(f"a {name} side above the belt")
        upright = [r for r in runs(outline(half, over=2, up=1, side=side), length) if abs(r.angle) < 60]
        upright = [r for r in upright if r.middle[0] > float(body.ground + GLASS * body.height)]
        if not upright:
            raise MeasureError(f"greenhouse: expected a flat {name} side window, got none")
        window = max(upright, key=lambda r: r.length)
        fitted = _flat(_near(half, window, length, over=2, up=1), length)
        rise, out = fitted.direction[2], fitted.direction[1] * -side
        angles.append(atan2(out, rise) if float(rise) > 0 else atan2(-out, -rise))
    return {"angle": mean(angles)}


def _outlined(mesh: Trimesh, forward: str, up: str, side: float) -> tuple[Vehicle, Facets, list[Run]]:
    body = Vehicle.of(mesh, forward, up)
    centre = body.centre.required("a section along the middle", ADVICE)
    check_gaps(centre)
    return body, centre, runs(outline(centre, side=side), float(body.length))


def _top(mesh: Trimesh, forward: str, up: str) -> tuple[Vehicle, Facets, list[Run]]:
    return _outlined(mesh, forward, up, 1.0)


def _bottom(mesh: Trimesh, forward: str, up: str) -> tuple[Vehicle, Facets, list[Run]]:
    return _outlined(mesh, forward, up, -1.0)


def _share_up(body: Vehicle, run: Run) -> float:
    return (run.middle[1] - float(body.ground)) / float(body.height)


def _glass(body: Vehicle, top: list[Run], rising: int) -> Run:
    """The windscreen (rising) or the rear window (falling): what gains most height beside the roof."""
    roof = max(range(len(top)), key=lambda i: top[i].middle[1] if abs(top[i].angle) < FLAT else -np.inf)
    beside = top[:roof] if rising > 0 else top[roof + 1 :]
    panes = [r for r in beside if FLAT < rising * r.angle < 85 and _share_up(body, r) > GLASS]
    panes = [r for r in panes if r.length > SHORT * float(body.length)]
    if not panes:
        name = "a windscreen rising to" if rising > 0 else "a rear window falling from"
        raise MeasureError(f"expected {name} the roof in the middle section, got no straight run there; {ADVICE}")
    return max(panes, key=lambda r: abs(r.end[1] - r.start[1]))


def _deck(body: Vehicle, beyond: list[Run], glass: Run, rising: int, what: str) -> Run:
    """The longest straight run between a window and the end of the body, flatter than the window."""
    steepest = min(30.0, rising * glass.angle - APART)
    decks = [r for r in beyond if -10 < rising * r.angle < steepest and _share_up(body, r) > DECK]
    return _longest(body, decks, what, "the middle section beside the window")


def _floor(body: Vehicle, bottom: list[Run]) -> Run:
    half = float(body.station(0.5))
    level = [r for r in bottom if abs(r.angle) < LEVEL and _share_up(body, r) < DECK]
    if not level:
        raise MeasureError(f"expected a level underbody between the axles, got none in the middle section; {ADVICE}")
    return max(level, key=lambda r: r.length - 2 * max(r.start[0] - half, half - r.end[0], 0))


def _under(body: Vehicle, beyond: list[Run], rising: int, what: str) -> Run:
    def near_end(run: Run) -> bool:
        share = (run.middle[0] - float(body.nose)) / float(body.length)
        return (share if rising < 0 else 1 - share) < ENDS

    under = [r for r in beyond if -5 < rising * r.angle < 40 and _share_up(body, r) < DECK and near_end(r)]
    return _longest(body, under, what, "the middle section between the floor and the end of the body")


def _longest(body: Vehicle, found: list[Run], what: str, where: str) -> Run:
    length = float(body.length)
    kept = [r for r in found if r.length > SHORT * length]
    if not kept:
        longest = f"none longer than {max(r.length for r in found) / length:.1%} of the length" if found else "none"
        raise MeasureError(f"expected {what}, straight in {where}, got {longest}")
    return max(kept, key=lambda r: r.length)


def _slope(centre: Facets, run: Run, body: Vehicle) -> Quantity:
    return slope(_flat(_near(centre, run, float(body.length)), float(body.length)))


def _flat(panel: Facets, length: float) -> Line:
    """The line that most of a panel lies on, as near as the panel is straight: rounded ends drop out."""
    return line(panel, within=max(line(panel).rms, SMOOTH * length))


def _near(cut: Facets, run: Run, length: float, *, over: int = 0, up: int = 2) -> Facets:
    """The segments along a run, its ends left out."""
    start, end = np.array(run.start), np.array(run.end)
    way = (end - start) / run.length
    away, left = cut.middles[:, [over, up]] - start, np.array([-way[1], way[0]])
    along, off = away @ way, away @ left
    inner = (along > TRIM * run.length) & (along < (1 - TRIM) * run.length)
    near = inner & (np.abs(off) < 4 * NOISE * length)
    looks = cut.normals[:, [over, up]] @ left > 0  # of a sheet, the skin that the run is on, whichever way it faces
    skins = [skin for skin in (near & looks, near & ~looks) if skin.any()]
    chosen = min(skins, key=lambda skin: float(np.average(np.abs(off[skin]), weights=cut.size[skin])), default=near)
    return cut.where(chosen).required("segments along the panel")
