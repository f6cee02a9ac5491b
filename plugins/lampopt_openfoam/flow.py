"""One flow: a cleaned surface on one placement of the grid, from the case's files to its coefficients."""

from __future__ import annotations

import re
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import numpy as np

from lampopt.types import Array

from . import case as files
from .grid import MOST, Entries, Grid
from .installed import Installed
from .kept import Placed
from .outcomes import ROOM, FlowError
from .running import Runner, end_left_over
from .settled import EVERY, first_settled
from .surface import Surface

ITERATIONS = 1500
TOLERANCE = 0.005  # relative standard error of the settled drag
UNSOLVED = 0.05  # initial residual that a flow does not end with
SKEW, ORTHOGONAL = 8.0, 75.0  # worst skewness [-] and non-orthogonality [deg] of a good grid
FEWEST = 1000  # cells
HOLLOW = 0.5  # share of the body's volume that has to be missing from the grid
JUDGED = (ITERATIONS, TOLERANCE, UNSOLVED, SKEW, ORTHOGONAL, FEWEST, HOLLOW)  # by which a flow is one
BYTES = 6_000  # of disk a cell, with logs
FIELDS = ("U", "p", "k", "omega", "nut", "phi")


@dataclass(frozen=True)
class Checked:
    """What checkMesh says of a grid."""

    cells: int
    skewness: float
    non_orthogonality: float


def solved(
    surface: Surface,
    grid: Grid,
    place: Path,
    foam: Installed,
    *,
    reynolds: float,
    timeout_s: float,
    kept: bool,
    stop: Event,
) -> tuple[Placed, Array, Array]:
    """Solve it in the folder `place`, going on where an earlier run was broken off; also points and pressure.

    Once `stop` is set it is ended.

    Raises
    ------
    FlowError
        Naming the outcome.
    """
    began = time.monotonic()
    end_left_over(place)
    runner = Runner(place, foam, began + timeout_s, kept, stop)
    entries = grid.settings() | files.settings(
        reynolds=reynolds,
        ground=grid.ground,
        half=grid.half,
        frontal_area=surface.frontal_area,
        iterations=ITERATIONS,
    )
    again = _has_grid(place)
    try:
        if not again:
            _make_grid(surface, grid, entries, runner)
        checked = _checked(runner.case, grid, surface, entries)
        return _coefficients(runner, grid, checked, began)
    except FlowError as error:
        if not (again and error.outcome in ("failed", "diverged")):  # of fields that were lost half-written, perhaps
            raise
    shutil.rmtree(place)  # what was left of an earlier run cannot be gone on with
    _make_grid(surface, grid, entries, runner)
    return _coefficients(runner, grid, _checked(runner.case, grid, surface, entries), began)


def _has_grid(place: Path) -> bool:
    log = place / "log.checkMesh"
    if not (place / "constant" / "polyMesh").is_dir():
        return False
    with suppress(OSError):
        return log.read_text(encoding="utf-8", errors="replace").rstrip().endswith("End")
    return False


def _make_grid(surface: Surface, grid: Grid, entries: Entries, runner: Runner) -> None:
    try:
        shutil.rmtree(runner.case, ignore_errors=True)
        runner.case.mkdir(parents=True)
        _check_room(runner.case, MOST[grid.level] // 20)
        files.write(runner.case, entries, surface.stl(grid.clearance))
    except OSError as error:
        raise FlowError(f"{runner.case} cannot be written: {error}; {ROOM}", "disk-full") from error
    runner.run("blockMesh")  # of plain numbers: what it fails of is no fault of the grid
    runner.run("snappyHexMesh", "-overwrite", fails="bad-grid")
    runner.run("checkMesh", fails="bad-grid")


def _check_room(place: Path, cells: int) -> None:
    free = shutil.disk_usage(place).free
    if free < BYTES * cells:
        raise FlowError(
            f"expected {BYTES * cells / 1e6:.0f} MB of free disk in {place.parent}, got {free / 1e6:.0f}; {ROOM}",
            "disk-full",
        )


def _checked(case: Path, grid: Grid, surface: Surface, entries: Entries) -> Checked:
    """The grid, if it is a good one. Raises FlowError "bad-grid", saying what is not."""
    text = (case / "log.checkMesh").read_text(encoding="utf-8", errors="replace")

    def number(pattern: str) -> float:
        found = re.search(pattern + r"\s*([-+.\deE]+)", text)
        return float(found.group(1).rstrip(".")) if found else float("nan")

    cells, regions = number(r"(?m)^\s+cells:"), number(r"Number of regions:")
    skewness, angle = number(r"Max skewness ="), number(r"non-orthogonality Max:")
    body = number(r"(?m)^\s*body\s")
    block = float(np.prod([_span(entries, axis) for axis in "xyz"]))
    missing = (block - number(r"Total volume =")) / (_volume(surface) * (0.5 if grid.half else 1.0))
    faults = [line.strip(" *") for line in text.splitlines() if line.lstrip().startswith("***")]
    faults = [line for line in faults if not line.startswith("Max skewness")]  # judged by its size
    wrong = [
        (not cells >= FEWEST, f"{cells:.0f} cells, expected {FEWEST} or more"),
        (cells >= 0.99 * MOST[grid.level], f"{cells:.0f} cells, expected fewer than {MOST[grid.level]}"),
        (not body > 0, "no face on the body"),
        (regions != 1, f"{regions:.0f} regions, expected one: a part of the air is cut off"),
        (not missing > HOLLOW, f"{missing:.0%} of the body's volume left free: the air has got into it"),
        (not skewness <= SKEW, f"skewness up to {skewness:.3g}, expected {SKEW:g} or less"),
        (not angle <= ORTHOGONAL, f"non-orthogonality up to {angle:.3g} deg, expected {ORTHOGONAL:g} or less"),
        (bool(faults), "; ".join(faults)),
    ]
    if said := [what for is_wrong, what in wrong if is_wrong]:
        raise FlowError(
            f"the grid on placement {grid.number} is no good: {'; '.join(said)}; try a finer level=, or another first=",
            "bad-grid",
        )
    return Checked(int(cells), skewness, angle)


def _span(entries: Entries, axis: str) -> float:
    low, high = entries[f"{axis}Min"], entries[f"{axis}Max"]
    assert isinstance(low, int | float) and isinstance(high, int | float)
    return float(high - low)


def _volume(surface: Surface) -> float:
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _coefficients(runner: Runner, grid: Grid, checked: Checked, began: float) -> tuple[Placed, Array, Array]:
    case = runner.case
    _check_room(case, checked.cells // 2)
    if not _goes_on(case):
        shutil.copytree(files.TEMPLATES / "0", case / "0", dirs_exist_ok=True)
        shutil.rmtree(case / "postProcessing", ignore_errors=True)
        runner.run("potentialFoam", "-initialiseUBCs", "-writePhi", fails="diverged")
        runner.run("postProcess", "-func", "gradPhi", "-time", "0")
        files.start_from_potential(case)
    files.go_on(case)
    state = _Watch(case)
    log = runner.run("simpleFoam", fails="diverged", watch=state.look)
    series = files.coefficients(case)
    told = first_settled(series, TOLERANCE)
    where = f"its log is {case / 'log.simpleFoam'}" if runner.kept else "name a folder= to keep its log"
    if told.state == "diverged":
        raise FlowError(
            f"on placement {grid.number} the solver came to {told.message}; {where}; try a finer level=, or "
            "another first=",
            "diverged",
        )
    residual = files.residuals(log)
    if told.state != "settled" or not residual <= UNSOLVED:
        raise FlowError(
            f"on placement {grid.number} the mean had not settled after {len(series)} iterations: {told.message}, "
            f"residual {residual:.2g}, asked for {UNSOLVED:g}; {where}; the flow may be unsteady: try another "
            "level=",
            "not-settled",
        )
    points, pressure = files.pressure(case)
    placed = Placed(
        number=grid.number,
        drag=told.mean[0],
        lift=told.mean[1],
        drag_error=told.error[0],
        lift_error=told.error[1],
        cells=checked.cells,
        iterations=told.end,
        seconds=round(time.monotonic() - began, 2),
        skewness=checked.skewness,
        non_orthogonality=checked.non_orthogonality,
        residual=residual,
    )
    return placed, points - [0, 0, grid.clearance], pressure


def _goes_on(case: Path) -> bool:
    """Whether there is a time to go on from; what was not written to its end is taken away."""
    times = [path for path in case.iterdir() if path.is_dir() and re.fullmatch(r"[1-9]\d*", path.name)]
    for time_folder in sorted(times, key=lambda path: -int(path.name)):
        if all((time_folder / name).exists() for name in FIELDS):
            return True
        shutil.rmtree(time_folder)
    return False


class _Watch:
    """Looks at the coefficients of a running solver: stops it when they have settled, ends it when they run away."""

    def __init__(self, case: Path) -> None:
        self.case, self.seen, self.asked = case, 0, False

    def look(self) -> bool:
        """True where nothing is to be waited for."""
        series = files.coefficients(self.case)
        if len(series) < self.seen + EVERY:
            return False
        self.seen = len(series)
        state = first_settled(series, TOLERANCE).state
        if state == "settled" and not self.asked:
            files.stop(self.case)
            self.asked = True
        return state == "diverged"
