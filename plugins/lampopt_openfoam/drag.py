"""The measure: drag and lift coefficients of any closed mesh, by a flow on several placements of a grid."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, get_args

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Scalar

from . import kept, settled
from .case import GROUND, TEMPLATES, settings
from .flow import ITERATIONS, JUDGED, solved
from .grid import CELL, Grid, Ground, Level
from .installed import Installed, installed, words
from .kept import Placed
from .outcomes import LASTING, ROOM, FlowError
from .placements import on_placements
from .running import by
from .surface import Half, Surface, axes, cleaned

if TYPE_CHECKING:
    from trimesh import Trimesh

    from .pairs import Paired
    from .refinement import Refined

SCATTER: dict[Level, float] = {"coarse": 0.035, "medium": 0.03, "fine": 0.03}  # of drag, from placement to placement
LIFT_SCATTER = 0.05
PATIENCE_S = 1.0  # between two looks at whether anybody still waits
OPERATIONAL = ("folder", "command", "timeout_s", "workers")  # options that no value depends on
LARGEST, SMALLEST, WIDEST = 1.0, 0.005, 2.5  # frontal area [length²] and width [length] that the domain is made for
STRANGE = "the domain is not made for such proportions: the walls around it may tell in the drag"
log = logging.getLogger("lampopt.openfoam")


@dataclass(frozen=True, eq=False)
class Flow:
    """What was solved.

    Parameters
    ----------
    drag, lift
        Coefficients, means over the placements.
    drag_error, lift_error
        Their standard errors: from placement to placement and of each settled mean.
    frontal_area
        What they are referred to [mesh unit²].
    length
        Of the mesh along the wind [mesh unit].
    placed
        Each placement.
    level, half, openfoam
        How it was solved, and by which version.
    notes
        What was done to the mesh.
    points, pressure
        (n, 3) on the body, nose at x = 0, lowest point at z = 0 [length], and the pressure coefficient there (n,), of
        the first placement.
    """

    drag: float
    lift: float
    drag_error: float
    lift_error: float
    frontal_area: float
    length: float
    placed: tuple[Placed, ...]
    level: str
    half: bool
    openfoam: str
    notes: tuple[str, ...]
    points: Array = field(repr=False)
    pressure: Array = field(repr=False)

    @property
    def cells(self) -> int:
        """Of the grids, on average."""
        return round(float(np.mean([one.cells for one in self.placed])))


@dataclass(frozen=True)
class OpenFoamDrag:
    """Drag and lift coefficients by OpenFOAM, referred to the measured frontal area, with their standard errors.

    Steady flow (k-omega SST, wall functions) around the body on `placements` grids that differ by where their cells
    lie. A flow that is not solved is a `FlowError` that names its outcome, never a number.

    Parameters
    ----------
    level
        "coarse" (some 16,000 cells a half car), "medium" (110,000) or "fine" (350,000).
    placements, first
        How many grids, and the number of the first: another `first` gives fresh ones. For one without a good grid the
        next serves, up to twice as far.
    reynolds
        On the body's length.
    wind, up
        Where the wind blows to, and where the roof is.
    half
        Solve one half: "auto" where left and right are alike, "yes", "no".
    ground
        "moving" with the wind as a road does, "fixed" as in a wind tunnel, "none" for a body in the open.
    clearance
        Of the lowest point above the ground [body lengths]; a little below it, tyres stand flat.
    folder
        Where results are kept; without one nothing is.
    command
        Words before each tool, of a container or a remote host that sees the same folder; `{case}` in them stands for
        the case's.
    timeout_s
        For each placement.
    workers
        Placements that are solved at a time, each by one core.
    """

    level: str = "coarse"
    placements: int = 3
    first: int = 0
    reynolds: float = 4e6
    wind: str = "x"
    up: str = "z"
    half: str = "auto"
    ground: str = "moving"
    clearance: float = -0.002
    folder: str = ""
    command: str = ""
    timeout_s: float = 3600.0
    workers: int = 1

    names = ("drag", "lift", "drag_error", "lift_error", "frontal_area", "cells")
    units = ("", "", "", "", "L^2", "")

    def __post_init__(self) -> None:
        for option, known in (("level", CELL), ("ground", GROUND), ("half", get_args(Half))):
            if getattr(self, option) not in [*known]:
                raise InputError(f"{option}: expected one of {', '.join(known)}, got {getattr(self, option)!r:.80}")
        axes(self.wind, self.up)
        for option, least in (("placements", 1), ("first", 0), ("workers", 1)):
            value = getattr(self, option)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise InputError(f"{option}: expected a whole number, {least} or more, got {value!r:.80}")
        for option, low, high in (("reynolds", 1e3, 1e9), ("timeout_s", 1.0, 1e7), ("clearance", -0.01, 10.0)):
            value = getattr(self, option)
            plain = isinstance(value, int | float) and not isinstance(value, bool)
            if not plain or not low <= value <= high:
                raise InputError(f"{option}: expected a number from {low:g} to {high:g}, got {value!r:.80}")
        if not isinstance(self.folder, str | PathLike):
            raise InputError(f"folder: expected a path, or nothing, got {self.folder!r:.80}")
        words(self.command)

    def __call__(self, mesh: Trimesh) -> Array:
        """The values (6,). Raises EmptyMesh, and FlowError naming the outcome."""
        flow = self.solve(mesh)
        return np.array([flow.drag, flow.lift, flow.drag_error, flow.lift_error, flow.frontal_area, flow.cells])

    def kept_in(self, folder: Path) -> OpenFoamDrag:
        """The same, its flows kept in `folder` where none is named."""
        return self if self.folder else replace(self, folder=str(folder))

    def depends_on(self) -> dict[str, Scalar]:
        """All options but those of where and how fast it is solved."""
        return {name: value for name, value in asdict(self).items() if name not in OPERATIONAL}

    def program(self) -> str:
        """Which OpenFOAM. Raises FlowError "absent" where there is none."""
        with _folder(self.folder) as folder:
            return str(installed(self.command, folder))

    def solve(self, mesh: Trimesh) -> Flow:
        """All that is known of the flow around `mesh`. Raises as a call does."""
        (flow,) = self._flows(self._surface(mesh))
        return flow

    def _flows(self, *surfaces: Surface) -> list[Flow]:
        solve = _solved if self.folder else _remembered
        each, foam, notes = solve(self, surfaces)
        return [self._flow(surface, done, foam, notes) for surface, done in zip(surfaces, each, strict=True)]

    def _flow(self, surface: Surface, done: Sequence[One], foam: Installed, notes: tuple[str, ...]) -> Flow:
        placed = tuple(one for one, _, _ in done)
        _, points, pressure = done[0]
        unseen = SCATTER[self._level] * abs(placed[0].drag)
        drag, drag_error = _mean([p.drag for p in placed], [p.drag_error for p in placed], unseen)
        lift, lift_error = _mean([p.lift for p in placed], [p.lift_error for p in placed], LIFT_SCATTER)
        return Flow(
            drag=drag,
            lift=lift,
            drag_error=drag_error,
            lift_error=lift_error,
            frontal_area=surface.frontal_area * surface.length**2,
            length=surface.length,
            placed=placed,
            level=self.level,
            half=surface.half,
            openfoam=str(foam),
            notes=(*surface.notes, *notes, *(() if _made_for(surface) else (STRANGE,))),
            points=points,
            pressure=pressure,
        )

    def compared(self, mesh: Trimesh, reference: Trimesh) -> Paired:
        """`mesh` held against `reference` on the same placements, halves both or whole. Raises as a call does.

        For a placement on which either has no good grid the next serves for both.
        """
        from .pairs import paired

        if self.placements < 2:
            raise InputError(f"placements: expected two or more for a comparison, got {self.placements}")
        both = [self._surface(mesh), self._surface(reference)]
        if both[0].half == both[1].half:
            return paired(*self._flows(*both))
        whole = replace(self, half="no")
        return paired(*whole._flows(whole._surface(mesh), whole._surface(reference)))

    def refined(self, mesh: Trimesh, levels: Sequence[str] = tuple(CELL)) -> Refined:
        """A grid study of `mesh`; a level that is not solved says why, and stops nothing.

        Raises as a call does, where no level is solved.
        """
        from .refinement import refined

        if not levels:
            raise InputError("levels: expected one or more, got none")
        last = None
        flows: dict[Level, Flow] = {}
        failures: dict[Level, str] = {}
        for drag in [replace(self, level=level) for level in levels]:
            try:
                flows[drag._level] = drag.solve(mesh)
            except FlowError as error:
                if error.outcome in ("absent", "refused-mesh", "disk-full"):
                    raise
                failures[drag._level], last = str(error), error
        if last is not None and not flows:
            raise last
        return refined(flows, failures)

    def interval(self, mesh: Trimesh, level: float) -> Array:
        """(6, 2) low and high at coverage `level`: Student's t over the placements. Raises as a call does."""
        from scipy.stats import norm, t

        values = self(mesh)
        tail = 0.5 + level / 2
        wide = float(t.ppf(tail, self.placements - 1) if self.placements > 1 else norm.ppf(tail))
        off = np.zeros(len(values))
        off[:2] = wide * values[2:4]
        return np.stack([values - off, values + off], axis=1)

    def outside(self, mesh: Trimesh) -> bool:
        """Whether `mesh` has proportions that the domain is not made for. Raises as a call does, without solving."""
        return not _made_for(self._surface(mesh))

    def example_mesh(self) -> Trimesh:
        """A box with the proportions of a car."""
        from trimesh.creation import box

        made: Trimesh = box((4.0, 1.6, 1.2))
        return made

    def _surface(self, mesh: Trimesh) -> Surface:
        half: Half = "yes" if self.half == "yes" else "no" if self.half == "no" else "auto"
        return cleaned(mesh, wind=self.wind, up=self.up, half=half)

    @property
    def _level(self) -> Level:
        return next(known for known in CELL if known == self.level)

    def _grid(self, surface: Surface, number: int) -> Grid:
        ground: Ground = next(known for known in GROUND if known == self.ground)
        return Grid(self._level, number, surface.width, surface.height, surface.half, ground, self.clearance)


def _made_for(surface: Surface) -> bool:
    return SMALLEST <= surface.frontal_area <= LARGEST and surface.width <= WIDEST


def _mean(values: list[float], errors: list[float], scatter: float) -> tuple[float, float]:
    """Mean over the placements, and its standard error; of one placement `scatter` stands for what is not seen."""
    n = len(values)
    own = float(np.mean(np.square(errors)))
    spread = max(float(np.var(values, ddof=1)), own) if n > 1 else scatter**2 + own  # what is seen has both in it
    return float(np.mean(values)), float(np.sqrt(spread / n))


One = tuple[Placed, Array, Array]  # with points and pressure
Solved = tuple[tuple[tuple[One, ...], ...], Installed, tuple[str, ...]]  # of each surface all placements; notes


def _solved(drag: OpenFoamDrag, surfaces: tuple[Surface, ...]) -> Solved:
    """All surfaces on the same placements."""
    with _folder(drag.folder) as folder:
        foam = installed(drag.command, folder)

        def on_one(number: int, stop: Event) -> list[One]:
            return [_placed(drag, surface, number, folder, foam, stop) for surface in surfaces]

        done, bad = on_placements(on_one, drag.first, drag.placements, drag.workers)
    notes = tuple(f"another placement serves for one without a grid: {error.args[0]}" for error in bad)
    return tuple(zip(*done, strict=True)), foam, notes


_remembered = lru_cache(maxsize=16)(_solved)  # without a folder: value and interval of one mesh are one flow


@contextmanager
def _folder(name: str) -> Iterator[Path]:
    if not name:
        with tempfile.TemporaryDirectory(prefix="lampopt-foam-", ignore_cleanup_errors=True) as made:
            yield Path(made).resolve()
        return
    folder = Path(name).expanduser().absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"folder: {folder} cannot be made: {error}") from error
    yield folder.resolve()


def _placed(drag: OpenFoamDrag, surface: Surface, number: int, folder: Path, foam: Installed, stop: Event) -> One:
    """One placement, as it is kept or solved now."""
    grid = drag._grid(surface, number)
    entries = grid.settings() | settings(
        reynolds=drag.reynolds, ground=grid.ground, half=grid.half, frontal_area=1.0, iterations=ITERATIONS
    )  # its frontal area goes with the surface
    where = folder / kept.key(
        surface=surface.digest,
        grid=asdict(grid),
        openfoam=str(foam),
        templates=kept.hash_of(TEMPLATES),
        entries=entries,
        judged=[*JUDGED, *settled.JUDGED],
    )
    try:
        with _locked(where.with_suffix(".lock"), stop):
            return _one(drag, surface, grid, where, foam, stop)
    except OSError as error:
        raise FlowError(f"{where} cannot be written: {error}; {ROOM}", by(error)) from error


def _one(drag: OpenFoamDrag, surface: Surface, grid: Grid, where: Path, foam: Installed, stop: Event) -> One:
    record, picture = where.with_suffix(".json"), where.with_suffix(".npz")
    found, seen = kept.read(record), kept.read_pressure(picture)
    if isinstance(found, FlowError):
        raise found
    if found is not None and seen is not None:
        return found, *seen
    log.info("openfoam-drag: %s, placement %d, %s", drag.level, grid.number, foam)
    options = {"reynolds": drag.reynolds, "timeout_s": drag.timeout_s}
    try:
        placed, points, pressure = solved(surface, grid, where, foam, **options, kept=bool(drag.folder), stop=stop)
    except FlowError as error:
        kept.write(record, error)
        if error.outcome in LASTING:
            _tidy(where)
        raise
    kept.write_pressure(picture, points, pressure)
    kept.write(record, placed)
    _tidy(where)
    return placed, points, pressure


@contextmanager
def _locked(file: Path, stop: Event) -> Iterator[None]:
    """Alone with a placement, while another process may be solving it."""
    from filelock import FileLock, Timeout

    lock = FileLock(file)
    while True:
        try:
            lock.acquire(timeout=PATIENCE_S)
            break
        except Timeout:
            if stop.is_set():
                said = f"{file.stem} is being solved by another process, and nobody waits for it here any more"
                raise FlowError(said, "killed") from None
    try:
        yield
    finally:
        lock.release()


def _tidy(case: Path) -> None:
    """Of a case that is done with only the logs and the coefficients stay."""
    with suppress(OSError):
        for path in case.iterdir():
            if path.is_dir() and path.name not in ("postProcessing", "system"):
                shutil.rmtree(path, ignore_errors=True)
