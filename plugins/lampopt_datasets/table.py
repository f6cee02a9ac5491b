"""A table beside a folder of meshes: the plainest way to bring one's own shapes."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path, PurePosixPath, PureWindowsPath
from reprlib import repr as short

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile import SUFFIXES
from lampopt.types import Array, Exemplars, Parameter
from lampopt.units import factor

from .columns import Column, columns, first, name_and_unit, read
from .example import temporary
from .meshes import MeshFiles, inside

log = logging.getLogger("lampopt")
MESH = "mesh"
NONE = "none"  # of `meshes`: there are no shapes
DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])\s*(\..*)?", re.IGNORECASE | re.DOTALL)  # on Windows


@dataclass(frozen=True)
class Table:
    """One row an exemplar: column `mesh` names its file, every other numeric column is a parameter or a label.

    A header holds a unit in brackets: ``ramp [deg]``. Columns without numbers or without a name are left out (and
    logged). An exemplar is named after its file, without suffix.

    Parameters
    ----------
    table
        CSV (UTF-8, commas, one header line) or Parquet file.
    meshes
        Folder of STL, OBJ, PLY, OFF, GLB, glTF, 3MF or COLLADA files, which no path may leave; by default the table's
        own. `none`: a table of parameters and labels without shapes, for models; a column `mesh` is not looked at.
    labels
        Comma-separated names of columns that are labels; their cells may be empty.
    unit
        Length unit of the meshes.
    parameters
        Comma-separated names of columns that are parameters; by default all numeric ones that are no labels.
    """

    table: str
    meshes: str = ""
    labels: str = ""
    unit: str = "m"
    parameters: str = ""

    @staticmethod
    def example() -> Table:
        """Three boxes in a temporary folder, which is removed when Python ends: for `lampopt.testing.check_plugin`."""
        lengths = {"short.ply": 1.0, "middle.ply": 1.5, "long.ply": 2.0}
        rows = ("mesh,length [m],drag", "short.ply,1.0,0.31", "middle.ply,1.5,", "long.ply,2.0,0.27")
        boxes = {file: (length, 1.0, 0.5) for file, length in lengths.items()}
        return Table(str(temporary("table", boxes, {"boxes.csv": rows}) / "boxes.csv"), labels="drag")

    def __call__(self) -> Exemplars:
        """The exemplars; meshes load on access.

        Raises
        ------
        InputError
            Saying everything that is wrong with the table at once, by row and column.
        """
        for option in ("table", "meshes", "labels", "unit", "parameters"):
            if not isinstance(getattr(self, option), str):
                raise InputError(f"{option}: expected text, got {short(getattr(self, option))}")
        factor(self.unit, "m", "unit")  # raises where it is no length
        path = Path(self.table)
        shapeless = self.meshes == NONE
        folder = Path(self.meshes) if self.meshes and not shapeless else path.parent
        data = read(path)
        found = columns(data, path)
        problems = [] if folder.is_dir() else [f"meshes: no folder {folder}; a relative path starts at {Path.cwd()}"]
        if data.num_rows == 0:
            problems.append("expected at least one row below the header, got none")
        files = ("",) * data.num_rows if shapeless else _files(found, problems)
        parameters, labels = self._chosen(found, problems)
        problems += first(chain.from_iterable(c.problems(gaps=False) for c in parameters))
        problems += first(chain.from_iterable(c.problems(gaps=True) for c in labels))
        problems += [] if shapeless else first(_file_problems(files, folder))
        space, label_space = _space(parameters, problems), _space(labels, problems)
        if problems:
            raise InputError(f"table {path} (rows count from 1 below the header):\n  " + "\n  ".join(problems))
        return Exemplars(
            parameters=_matrix(parameters, data.num_rows),
            space=space,
            meshes=MeshFiles(folder, files),
            names=tuple(f"row_{i}" for i in range(1, data.num_rows + 1)) if shapeless else tuple(map(_stem, files)),
            labels=_matrix(labels, data.num_rows),
            label_space=label_space,
            unit=self.unit,
        )

    def _chosen(self, found: dict[str, Column], problems: list[str]) -> tuple[list[Column], list[Column]]:
        """The columns that are parameters and those that are labels; what cannot be is added to `problems`."""
        others = {name: column for name, column in found.items() if name != MESH}
        wanted = {"parameters": _names(self.parameters), "labels": _names(self.labels)}
        for option, names in wanted.items():
            problems += [
                f"{option}: no column {name!r}; known are {_listed(others)}" for name in names if name not in others
            ]
            problems += [f"{option}: {name!r} is named twice" for name in dict.fromkeys(names) if names.count(name) > 1]
        problems += [
            f"{n!r} is named in parameters and in labels" for n in wanted["parameters"] if n in wanted["labels"]
        ]
        labels = [others[name] for name in wanted["labels"] if name in others]
        if self.parameters:
            return [others[name] for name in wanted["parameters"] if name in others], labels
        left = [column for column in others.values() if column not in labels]
        parameters = [column for column in left if column.numeric]
        if not parameters:
            problems.append(
                f"expected a numeric column beside {MESH!r} and the labels {list(wanted['labels'])}, got none; "
                f"columns are {_listed(found)}"
            )
        if ignored := [column.name for column in left if not column.numeric]:
            log.info("table %s: columns without numbers are left out: %s", self.table, ", ".join(ignored))
        return parameters, labels


def _names(option: str) -> tuple[str, ...]:
    """The column names in a comma-separated option; a unit behind a name is allowed and dropped."""
    return tuple(name_and_unit(part)[0] for part in option.split(",") if part.strip())


def _listed(names: Iterable[str]) -> str:
    """Names for a message: the first few of a table that has very many."""
    known = [short(name) for name in names]
    return ", ".join(known[:40]) + (f" and {len(known) - 40} more" if len(known) > 40 else "")


def _matrix(chosen: Sequence[Column], rows: int) -> Array:
    matrix = np.full((rows, len(chosen)), np.nan)
    for k, column in enumerate(chosen):
        matrix[:, k] = column.values
    return matrix


def _space(chosen: Sequence[Column], problems: list[str]) -> tuple[Parameter, ...]:
    space = []
    for column in chosen:
        try:
            space.append(Parameter(column.name, column.unit))
        except InputError as error:
            problems.append(f"column {column.name!r}: {error}; rename it, or leave it out by naming parameters=")
    return tuple(space)


def _files(found: dict[str, Column], problems: list[str]) -> tuple[str, ...]:
    """The file names of column `mesh`, "" where a cell is empty."""
    if MESH not in found:
        hint = "; cells must be separated by commas" if any(";" in name or "\t" in name for name in found) else ""
        problems.append(
            f"expected a column {MESH!r} with file names, got columns {_listed(found)}{hint}; a table "
            f"without shapes, for models, is read with meshes={NONE!r}"
        )
        return ()
    return tuple("" if cell is None else str(cell).strip() for cell in found[MESH].cells.to_pylist())


def _stem(file: str) -> str:
    """An exemplar's name: the file's path in the folder, without suffix."""
    return PurePosixPath(file).with_suffix("").as_posix()


def _file_problems(files: Sequence[str], folder: Path) -> Iterator[str]:
    rows: dict[str, int] = {}
    for row, file in enumerate(files, 1):
        path = PurePosixPath(file)
        if not file:
            yield f"row {row}, column {MESH!r}: expected a file name, got an empty cell"
        elif path.is_absolute() or PureWindowsPath(file).anchor or ".." in PureWindowsPath(file).parts:
            yield f"row {row}: mesh {short(file)} leads out of the folder {folder}; give a path inside it"
        elif any(DEVICE.fullmatch(part) for part in PureWindowsPath(file).parts):
            yield f"row {row}: mesh {short(file)} is the name of a device on Windows; rename the file"
        elif path.suffix.lower() not in SUFFIXES:
            yield f"row {row}: mesh {short(file)}: expected a file of {', '.join(SUFFIXES)}"
        elif _stem(file) in rows:
            yield f"row {row}: mesh {short(file)}: row {rows[_stem(file)]} has a file of this name already"
        else:
            rows[_stem(file)] = row
            if not os.path.isfile(folder / file):  # unlike Path.is_file, False for a name too long as well
                yield f"row {row}: mesh {short(file)}: no such file in {folder}"
            elif not inside(folder, file):
                yield f"row {row}: mesh {short(file)}: a link that leads out of the folder {folder}; put the file there"
