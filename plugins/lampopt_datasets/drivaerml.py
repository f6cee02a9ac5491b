"""DrivAerML: 500 morphs of a notchback with forces from scale-resolving flow solutions (arXiv 2408.11969)."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Exemplars

from .columns import Column
from .download import Download, check_size, few, named_options, picked, space, values
from .example import temporary
from .meshes import MeshFiles

TITLE = "drivaerml"
PLACE = (
    "Hugging Face dataset neashton/drivaerml: geo_parameters_all.csv, force_mom_constref_all.csv, run_N/drivaer_N.stl"
)
GEOMETRY = "geo_parameters_all.csv"
FORCES = {"constant": "force_mom_constref_all.csv", "own": "force_mom_all.csv"}
STEM = re.compile(r"drivaer_0*(\d+)")
SHORTEST, LONGEST = 3.0, 7.0  # m


@dataclass(frozen=True)
class DrivAerML:
    """DrivAerML (arXiv 2408.11969): runs 1 to 500, 16 parameters, cd, cl, clf, clr, cs where the flow was solved.

    Parameters are displacements [mm] from the base car, those called angles too, and the pitch in degrees (the paper's
    table of parameters). A run without forces has NaN as its labels.

    Parameters
    ----------
    folder
        What was downloaded: the two tables, and ``drivaer_N.stl`` anywhere below it.
    reference
        Area that the coefficients refer to: `constant` for all runs, or each run's `own`.
    count
        The first so many runs; 0 for all.
    labels
        Comma-separated coefficients; by default all.
    missing
        Runs without a mesh: `error`, or `leave out`.
    meshes
        Folder inside `folder` that holds the meshes, where not all in it count.
    unit
        Of the meshes: metres as published. The first mesh is held against it.
    """

    folder: str
    reference: str = "constant"
    count: int = 0
    labels: str = ""
    missing: str = "error"
    meshes: str = ""
    unit: str = "m"

    watertight = False  # wheels, mirrors and body are shells of their own

    @staticmethod
    def example() -> DrivAerML:
        """Three boxes laid out as the dataset is, in a temporary folder that is removed when Python ends."""
        forces = ("run,cd,cl,clf,clr,cs", "1,0.29,0.05,0,0.05,0", "2,0.30,0.05,0,0.05,0")
        geometry = ("Run, Vehicle_Length, Vehicle_Pitch", "1,100,0.1", "2,200,0.2", "3,300,0.3")
        boxes = {f"run_{run}/drivaer_{run}.stl": (4.6 + 0.1 * run, 1.8, 1.4) for run in (1, 2, 3)}
        return DrivAerML(str(temporary(TITLE, boxes, {GEOMETRY: geometry, FORCES["constant"]: forces})))

    def __call__(self) -> Exemplars:
        """The exemplars; meshes load on access. Raises InputError naming what is missing or cannot be used."""
        if self.reference not in FORCES:
            raise InputError(f"{TITLE}: reference: expected one of {', '.join(FORCES)}, got {self.reference!r:.100}")
        download = Download.of(self.folder, TITLE, PLACE)
        geometry, forces = download.table(GEOMETRY), download.table(FORCES[self.reference])
        runs, solved = _runs(geometry, "Run", GEOMETRY), _runs(forces, "run", FORCES[self.reference])
        names = [f"run_{run}" for run in runs]
        files = download.meshes(lambda path: _run(path.stem), (".stl", ".obj"), self.meshes)
        known_runs = set(runs)
        extra = [file for run, file in files.items() if run not in known_runs]
        rows = download.paired(names, [files.get(run) for run in runs], extra, self.missing, self.count)
        parameters = [column for column in geometry.values() if column.numeric]
        labels = picked(forces, named_options(self.labels) or list(forces), f"{TITLE}: labels")
        known = values(labels, range(len(solved)), gaps=True, title=FORCES[self.reference])
        place = {run: row for row, run in enumerate(solved)}
        unsolved = np.full(len(labels), np.nan)
        found = tuple(files.get(runs[row], "") for row in rows)
        check_size(MeshFiles(download.folder, found), self.unit, SHORTEST, LONGEST, TITLE)
        titles = [column.name for column in parameters]
        return Exemplars(
            parameters=values(parameters, rows, gaps=False, title=GEOMETRY),
            space=space(titles, {name: "deg" if name == "Vehicle_Pitch" else "mm" for name in titles}),
            meshes=MeshFiles(download.folder, found),
            names=tuple(names[row] for row in rows),
            labels=np.array([known[place[runs[row]]] if runs[row] in place else unsolved for row in rows]),
            label_space=space([column.name for column in labels], {}),
            unit=self.unit,
        )


def _run(stem: str) -> int | None:
    found = STEM.fullmatch(stem)
    return int(found[1]) if found else None


def _runs(table: dict[str, Column], heading: str, file: str) -> list[int]:
    """The run numbers, taken out of `table`."""
    if heading not in table:
        raise InputError(f"{TITLE}: {file}: expected a column {heading!r}, got {', '.join(map(repr, table))}")
    column = table.pop(heading)
    numbers = values([column], range(len(column.cells)), gaps=False, title=f"{TITLE}: {file}")[:, 0]
    runs: list[int] = numbers.astype(int).tolist()
    if (numbers != runs).any() or len(set(runs)) < len(runs):
        raise InputError(f"{TITLE}: {file}: expected a run of its own in each row, got {few(numbers.tolist())}")
    return runs
