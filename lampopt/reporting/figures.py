"""Everything of a report that needs meshes: the shapes drawn, measured again, compared with exemplars and packed."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.plugins import Plugins
from lampopt.reporting.charts import rounded_up
from lampopt.reporting.measuring import measured
from lampopt.reporting.render import View, pictures, reach, views
from lampopt.reporting.shapes import Drawn, drawn
from lampopt.types import Array, Bank, Result

if TYPE_CHECKING:
    from trimesh import Trimesh

MANY = 12  # designs beyond which pictures are smaller
FACES = ((1, 24_000), (MANY, 12_000), (10**9, 6_000))  # up to so many designs: faces each, in the file
LARGE, SMALL = (420, 300), (260, 190)  # pictures [pixels]
HELD = 8  # exemplars' meshes held at once
OUTLIER = 2.5  # shapes so many times larger than the median are drawn to a scale of their own
log = logging.getLogger("lampopt")
T = TypeVar("T")


@dataclass(frozen=True)
class Picture:
    """One view of a shape, plain and by distance ("" without a reference), as data URIs."""

    view: str
    axes: str
    plain: str
    heat: str = ""


@dataclass(frozen=True)
class Packed:
    """A mesh for the viewer: base64 of positions, corners, normals with sky, distances; and how to read it."""

    data: str
    vertices: int
    faces: int
    distances: bool
    half: float


@dataclass(frozen=True, eq=False)
class Shown:
    """A design or an exemplar that is shown in full. `why` says what is missing, `reference` what it is compared to."""

    shape: Drawn | None = None
    why: str = ""
    reference: int | None = None
    measured: Mapping[str, float] = field(default_factory=dict)
    pictures: tuple[Picture, ...] = ()
    packed: Packed | None = None
    shrunk: bool = False


@dataclass(frozen=True, eq=False)
class Figures:
    """All that is drawn: designs by number, exemplars by index, the colours' range and the pictures' scale.

    `spread` and `bar` (the scale bar) are in the user's unit, `pixels` is the bar's length in a picture; `spread` is
    None where there is nothing to compare with.
    """

    designs: Mapping[int, Shown]
    exemplars: Mapping[int, Shown]
    spread: float | None
    views: tuple[View, ...]
    bar: float
    pixels: float
    size: tuple[int, int]


def _tried(what: str, make: Callable[[], T]) -> T | None:
    """What `make` makes; None, and a line in the log, where that fails: a finished run is reported all the same."""
    try:
        return make()
    except Exception as error:  # noqa: BLE001  # decoders and drawing libraries raise what they like
        log.warning("report: %s: %r", what, error)
        return None


def figures(
    bank: Bank, resolution: int, results: Mapping[int, Result], reference: str | None, others: int, plugins: Plugins
) -> Figures:
    """Draw `results`, each beside `reference` or the exemplar nearest to it, and `others` more exemplars."""
    faces = next(count for most, count in FACES if len(results) <= most)
    known = _Exemplars(bank, resolution, plugins, faces)
    designs = {number: _seen(bank, result, known, reference, faces, plugins) for number, result in results.items()}
    wanted = {s.reference for s in designs.values() if s.reference is not None and s.shape is not None}
    if any(s.shape is not None for s in designs.values()) and others:
        wanted |= {int(i) for i in np.linspace(0, len(bank) - 1, min(others, len(bank))).round()}
    beside = {i: Shown(known.drawn(i)) for i in sorted(wanted)}
    return _pictured(designs, {i: shown for i, shown in beside.items() if shown.shape is not None})


@dataclass(frozen=True, eq=False)
class _Exemplars:
    """The bank's exemplars as its decoder has them, made when they are wanted."""

    bank: Bank
    resolution: int
    plugins: Plugins
    faces: int
    _drawn: dict[int, Drawn | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mesh", lru_cache(HELD)(self._decoded))

    mesh: Callable[[int], Trimesh | None] = field(init=False)

    def _decoded(self, index: int) -> Trimesh | None:
        def made() -> Trimesh:
            weights = np.array(self.bank.weights[index])
            return decode(self.bank, decoder_of(self.bank, self.plugins), weights, resolution=self.resolution)

        return _tried(f"exemplar {self.bank.names[index]!r} cannot be decoded", made)

    def drawn(self, index: int) -> Drawn | None:
        if index not in self._drawn:
            mesh, what = self.mesh(index), f"exemplar {self.bank.names[index]!r} cannot be drawn"
            self._drawn[index] = None if mesh is None else _tried(what, lambda: drawn(mesh, faces=self.faces))
        return self._drawn[index]

    def nearest(self, parameters: Array) -> int:
        """The exemplar nearest to `parameters` (d,), each counted in parts of its range."""
        spread = np.ptp(self.bank.parameters, axis=0)
        used = spread > 0
        off = (self.bank.parameters - parameters)[:, used] / spread[used]
        return int(np.linalg.norm(off, axis=1).argmin())


def _seen(bank: Bank, result: Result, known: _Exemplars, reference: str | None, faces: int, plugins: Plugins) -> Shown:
    """One design, drawn as far as it can be."""
    beside = bank.names.index(reference) if reference in bank.names else known.nearest(result.design.predicted)
    try:
        made = result.design.__dict__
        mesh = made["mesh"] if "mesh" in made else result.design.make_mesh()  # not kept: a sweep may hold many
        if mesh is None or not len(mesh.faces):
            return Shown(why="no shape: the field has no surface")
        values = measured(bank, mesh, plugins)
        other = known.mesh(beside)
        known.drawn(beside)  # now, while its mesh is held
        return Shown(drawn(mesh, faces=faces, reference=other), "", None if other is None else beside, values)
    except Exception as error:  # noqa: BLE001  # whatever a mesh does to drawing: a finished run is reported
        log.warning("report: a design cannot be drawn: %r", error)
        return Shown(why=f"this shape cannot be drawn: {error}")


def _pictured(designs: Mapping[int, Shown], exemplars: Mapping[int, Shown]) -> Figures:
    """Pictures of all, to one scale and with one range of colours."""
    shapes = [s.shape for s in (*designs.values(), *exemplars.values()) if s.shape is not None]
    drawn_ = [s.shape for s in designs.values() if s.shape is not None]
    long = int(np.median([s.extents[1] > s.extents[0] for s in shapes])) if shapes else 0
    all_views = views(long)
    size = LARGE if len(designs) <= MANY else SMALL
    chosen = all_views if len(designs) == 1 else all_views[:1]  # where there are more, the viewer shows the other sides
    spread = _spread([s.distance for s in drawn_ if s.distance is not None])
    wide = np.array([[reach(s, v) for v in chosen] for s in drawn_ or shapes])
    needed = (wide / (np.array(size) * [0.84, 0.76])).max((1, 2)) if len(wide) else np.ones(1)
    pixel = float(needed[needed <= OUTLIER * np.median(needed)].max()) or 1.0

    def made(shown: Shown, seen: Sequence[View], size: tuple[int, int]) -> Shown:
        shape = shown.shape
        if shape is None:
            return shown
        own = max(float((reach(shape, v) / (np.array(size) * [0.92, 0.88])).max()) for v in seen)
        scale = max(pixel * (LARGE if len(designs) <= MANY else SMALL)[0] / size[0], own)
        try:
            found = tuple(_picture(shape, v, scale, size, spread) for v in seen)
            return replace(shown, pictures=found, packed=packed(shape, spread), shrunk=bool(own > pixel * 1.001))
        except Exception as error:  # noqa: BLE001  # likewise
            log.warning("report: a picture cannot be made: %r", error)
            return replace(shown, why=f"the picture cannot be made: {error}")

    bar = rounded_up(0.16 * size[0] * pixel)
    return Figures(
        {number: made(shown, chosen, size) for number, shown in designs.items()},
        {index: made(shown, all_views[:1], SMALL) for index, shown in exemplars.items()},
        spread,
        all_views,
        bar,
        bar / pixel,
        size,
    )


def _picture(shape: Drawn, view: View, pixel: float, size: tuple[int, int], spread: float | None) -> Picture:
    plain, *heat = pictures(shape, view, pixel=pixel, size=size, spread=spread)
    return Picture(view.name, view.axes, plain, *heat)


def _spread(distances: Sequence[Array]) -> float | None:
    """A round distance that 99 of 100 vertices keep to."""
    if not distances:
        return None
    largest = float(np.percentile(np.abs(np.concatenate(distances)), 99))
    return rounded_up(largest) if np.isfinite(largest) and largest > 0 else None


def packed(shape: Drawn, spread: float | None) -> Packed:
    """`shape` for the viewer, coordinates in 16 bits, normals, sky and distances in 8."""
    count = len(shape.vertices)
    where = np.round((np.clip(shape.vertices, -1, 1) + 1) / 2 * 65535).astype("<u2")
    corners = shape.faces.astype("<u2" if count <= 65536 else "<u4")
    look = np.column_stack([np.round(shape.normals * 127).astype(np.int8), (shape.sky * 127).astype(np.int8)])
    parts = [where.tobytes(), corners.tobytes(), look.astype(np.int8).tobytes()]
    coloured = False
    if shape.distance is not None and spread is not None:
        coloured = True
        parts.append(np.round(np.clip(shape.distance / spread, -1, 1) * 127).astype(np.int8).tobytes())
    data = base64.b64encode(b"".join(parts)).decode()
    return Packed(data, count, len(shape.faces), coloured, shape.half)
