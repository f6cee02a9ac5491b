"""The case: OpenFOAM's own files (templates/), all that differs from case to case set in `system/settings`."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import numpy as np

from lampopt.types import Array

from .grid import Entries, Ground

TEMPLATES = Path(__file__).parent / "templates"
INTENSITY, STICKIER = 0.01, 10.0  # of the wind's turbulence; its eddy viscosity over the molecular one
GROUND: dict[Ground, dict[str, str]] = {
    "fixed": {"groundType": "wall", "groundFlow": "noSlip"},
    "moving": {"groundType": "wall", "groundFlow": "fixedValue"},
    "none": {
        "groundType": "patch",
        "groundFlow": "slip",
        "groundK": "slip",
        "groundOmega": "slip",
        "groundNut": "slip",
    },
}


def settings(*, reynolds: float, ground: Ground, half: bool, frontal_area: float, iterations: int) -> Entries:
    """The entries of `system/settings` besides the grid's: a wind of speed 1 around a body of length 1."""
    k = 1.5 * INTENSITY**2
    return {
        "viscosity": 1 / reynolds,
        "kInflow": k,
        "omegaInflow": k * reynolds / STICKIER,
        "middleType": "symmetryPlane" if half else "patch",
        "middleFlow": "symmetryPlane" if half else "slip",
        **GROUND[ground],
        "frontalArea": frontal_area / 2 if half else frontal_area,
        "iterations": iterations,
    }


def write(case: Path, entries: Entries, surface: bytes) -> None:
    """A case at `case`, with `surface` (an STL file) as its body."""
    from foamlib import FoamFile

    shutil.copytree(TEMPLATES, case, dirs_exist_ok=True)
    with FoamFile(case / "system" / "settings") as file:
        for name, value in entries.items():  # one by one: each stays in its place, beside its comment
            file[name] = value
    for folder in ("triSurface", "geometry"):  # openfoam.org looks in the second from 11 on
        (case / "constant" / folder).mkdir(exist_ok=True)
        (case / "constant" / folder / "body.stl").write_bytes(surface)


def start_from_potential(case: Path) -> None:
    """The velocity at the start: minus the potential's gradient.

    potentialFoam itself puts the velocity together from the fluxes through cells' faces. In cells that have few of them
    left beside the body that gives speeds a thousand times the wind's (1912), from which no solver recovers.
    """
    from foamlib import FoamCase

    at_rest = FoamCase(case)[0]
    gradient = np.asarray(at_rest["grad(Phi)"].internal_field, float)
    start = at_rest["U"]
    start.internal_field = -gradient
    for name in ("Phi", "grad(Phi)", "phi"):
        (case / "0" / name).unlink(missing_ok=True)


def stop(case: Path) -> None:
    """Tell the running solver to write what it has and end."""
    _stop_at(case, "writeNow")


def go_on(case: Path) -> None:
    """Take `stop` back, and date that an hour ago: of two changes within ten seconds OpenFOAM misses the second."""
    _stop_at(case, "endTime")
    before = time.time() - 3600
    os.utime(case / "system" / "controlDict", (before, before))


def _stop_at(case: Path, when: str) -> None:
    """In one step: a solver that reads it meanwhile finds it whole."""
    from foamlib import FoamFile

    file = case / "system" / "controlDict"
    other = file.with_name("controlDict.next")
    shutil.copyfile(file, other)
    FoamFile(other)["stopAt"] = when
    os.replace(other, file)


def coefficients(case: Path) -> Array:
    """(n, 2) drag and lift by iteration, as far as the solver has come; parts before and after a break joined."""
    rows: dict[float, tuple[float, float]] = {}
    parts = [*case.glob("postProcessing/forceCoeffs/*/*.dat")]
    for part in sorted(parts, key=lambda path: float(path.parent.name)):
        columns = None
        for line in part.read_text(encoding="ascii", errors="replace").splitlines():
            words = line.lstrip("#").split()
            if line.startswith("#"):
                if "Cd" in words and "Cl" in words:
                    columns = words.index("Cd"), words.index("Cl")
                continue
            if columns is None or len(words) <= max(columns):
                continue  # a line that is being written
            try:
                rows[float(words[0])] = float(words[columns[0]]), float(words[columns[1]])
            except ValueError:
                continue
    return np.array([rows[at] for at in sorted(rows)], float).reshape(-1, 2)


def residuals(log: str, last: int = 50) -> float:
    """The largest initial residual of pressure and velocity, each as the mean of its `last` ones; NaN if none."""
    found: dict[str, list[float]] = {}
    for line in log.splitlines():
        name, equals, rest = line.partition(", Initial residual = ")
        if equals and (name := name.rpartition(" ")[2]) in ("p", "Ux"):
            found.setdefault(name, []).append(float(rest.partition(",")[0]))
    return max((float(np.mean(values[-last:])) for values in found.values()), default=float("nan"))


def pressure(case: Path) -> tuple[Array, Array]:
    """Points (n, 3) on the body [its length] and the pressure coefficient there (n,); empty where none was written."""
    files = [
        *case.glob("postProcessing/bodyPressure/*/*body.raw"),
        *case.glob("postProcessing/bodyPressure/*/body.xy"),
    ]
    if not files:
        return np.empty((0, 3)), np.empty(0)
    rows = np.loadtxt(max(files, key=lambda path: float(path.parent.name)), ndmin=2)
    return rows[:, :3], 2 * rows[:, 3]  # of a wind of speed 1
