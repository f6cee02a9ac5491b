"""A published dataset as it was downloaded and unpacked: what is there, what is missing, which row has which mesh."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path, PurePosixPath

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import brief, content, path_of, plain_file
from lampopt.types import Array, Parameter

from .columns import Column, columns, first, read
from .meshes import MeshFiles

log = logging.getLogger("lampopt")
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".part")
SHOWN = 5  # names of many that a message holds
MISSING = ("error", "leave out", "keep")
LONGEST_LIST = 2**24  # bytes of a list of ids
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}


def few(names: Collection[object]) -> str:
    """How many there are and the first of them, for a message."""
    shown = ", ".join(brief(name) for name, _ in zip(names, range(SHOWN), strict=False))
    return f"{len(names):,}: {shown}" + (", ..." if len(names) > SHOWN else "")


@dataclass(frozen=True)
class Download:
    """The files of a folder that `title` was unpacked into; `place` says where they are got."""

    folder: Path
    title: str
    place: str
    files: tuple[str, ...]  # relative to the folder, with forward slashes, sorted

    @classmethod
    def of(cls, folder: str, title: str, place: str) -> Download:
        """What is in `folder` and below it. Raises InputError if there is no such folder, or nothing in it."""
        path = path_of(folder, f"{title}: folder")
        if not os.path.isdir(path):  # False too for a name that is too long
            raise InputError(
                f"{title}: no folder {brief(path)}; a relative path starts at {Path.cwd()}. The data: {place}"
            )
        found = ((Path(root) / file).relative_to(path).as_posix() for root, _, names in os.walk(path) for file in names)
        files = tuple(sorted(found))
        if not files:
            raise InputError(f"{title}: the folder {brief(path)} is empty. The data: {place}")
        return cls(path, title, place, files)

    def named(self, *names: str) -> str | None:
        """The first file that has one of these names, in the order of the names; None where there is none."""
        for name in names:
            if found := [file for file in self.files if PurePosixPath(file).name == name]:
                if len(found) > 1:
                    raise InputError(f"{self.title}: expected one file {name} in {self.folder}, got {', '.join(found)}")
                return found[0]
        return None

    def absent(self, what: str) -> InputError:
        """The error for a file that is not there; an archive that was not unpacked is named."""
        packed = [file for file in self.files if file.lower().endswith(ARCHIVES) or ".part-" in file]
        hint = f"; archives that may hold it have to be unpacked first ({few(packed)})" if packed else ""
        return InputError(f"{self.title}: expected {what} in {self.folder}, got none{hint}. The data: {self.place}")

    def table(self, *names: str) -> dict[str, Column]:
        """The columns of the table that has one of these names. Raises InputError if none has, or it cannot be read."""
        file = self.named(*names)
        if file is None:
            raise self.absent(f"a table {' or '.join(names)}")
        return columns(read(self.folder / file), self.folder / file)

    def lines(self, *names: str) -> list[str]:
        """The filled lines of a text file that has one of these names."""
        file = self.named(*names)
        if file is None:
            raise self.absent(f"a file {' or '.join(names)}")
        text = content(self.folder / file, largest=LONGEST_LIST).decode("utf-8", errors="replace")
        return [line.strip() for line in text.splitlines() if line.strip()]

    def meshes(
        self, key: Callable[[PurePosixPath], Hashable], suffixes: Sequence[str], below: str = ""
    ) -> dict[Hashable, str]:
        """Mesh files by what `key` makes of their path; None where that names no design.

        Raises
        ------
        InputError
            If two files are of one design, or one is empty or cannot be read.
        """
        found: dict[Hashable, str] = {}
        for file in self.files:
            path = PurePosixPath(file)
            name = key(path) if path.suffix.lower() in suffixes and path.is_relative_to(below) else None
            if name is None:
                continue
            if name in found:
                raise InputError(
                    f"{self.title}: {found[name]} and {file} in {self.folder} are both meshes of one design; name the "
                    "folder that counts with meshes="
                )
            try:
                size = plain_file(self.folder / file).stat().st_size
            except InputError as error:  # a link that leads nowhere, or in a circle
                raise InputError(f"{self.title}: {file} in {self.folder}: {error}") from error
            if size == 0:
                raise InputError(f"{self.title}: {file} in {self.folder} is empty: download it again")
            found[name] = file
        return found

    def paired(
        self, names: Sequence[str], files: Sequence[str | None], extra: Collection[str], missing: str, count: int
    ) -> list[int]:
        """Rows that are to be exemplars: the first `count` (0: all) of `names`.

        Designs without a mesh are an error, left out, or kept without one (`missing`); `extra`, meshes without a row,
        are counted in the log.

        Raises
        ------
        InputError
            If a mesh is missing, or all are.
        """
        if missing not in MISSING:
            raise InputError(f"{self.title}: missing: expected one of {', '.join(MISSING)}, got {brief(repr(missing))}")
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise InputError(f"{self.title}: count: expected a whole number, 0 for all, got {brief(repr(count))}")
        if extra:
            log.warning("%s: meshes without a row in the table are left out (%s)", self.title, few(extra))
        if missing == "keep":
            return list(range(len(names)))[: count or None]
        there = [row for row, file in enumerate(files) if file is not None]
        if not there:
            without = f", beside {len(extra):,} without a row," if extra else ""
            raise self.absent(
                f"meshes of the designs in the table ({few(names)}){without} or missing='keep' for models,"
            )
        if missing == "leave out":
            if lacking := [name for name, file in zip(names, files, strict=True) if file is None]:
                log.warning("%s: designs without a mesh are left out (%s)", self.title, few(lacking))
            return there[:count] if count else there
        rows = list(range(len(names)))[: count or None]
        if lacking := [names[row] for row in rows if files[row] is None]:
            raise InputError(
                f"{self.title}: {len(rows) - len(lacking):,} of {len(rows):,} designs have a mesh in {self.folder}; "
                f"missing are {few(lacking)}. Download them, leave those designs out with missing='leave out', or, for "
                f"models, which need no shape, keep them with missing='keep'. "
                f"The data: {self.place}"
            )
        return rows


def values(chosen: Sequence[Column], rows: Sequence[int], *, gaps: bool, title: str) -> Array:
    """(N, p) what `rows` of the columns hold. Raises InputError naming cells without a number; `gaps` allows empty."""
    bad = first(chain.from_iterable(c.problems(gaps=gaps) for c in chosen))
    if bad:
        raise InputError(f"{title} (rows count from 1 below the header):\n  " + "\n  ".join(bad))
    matrix = np.full((len(rows), len(chosen)), np.nan)
    for k, column in enumerate(chosen):
        matrix[:, k] = np.asarray(column.values)[list(rows)]
    return matrix


def picked(found: Mapping[str, Column], names: Sequence[str], what: str) -> list[Column]:
    """The columns of these names. Raises InputError listing what there is."""
    if absent := [name for name in names if name not in found]:
        raise InputError(f"{what}: no column {', '.join(map(repr, absent))}; known are {', '.join(map(repr, found))}")
    return [found[name] for name in names]


def space(names: Sequence[str], units: Mapping[str, str]) -> tuple[Parameter, ...]:
    """Parameters of these names; "" is the unit of one that the publication gives none for."""
    return tuple(Parameter(name, units.get(name, "")) for name in names)


def named_options(option: str) -> list[str]:
    """The names in a comma-separated option."""
    return [name.strip() for name in option.split(",") if name.strip()]


def check_size(meshes: MeshFiles, unit: str, low: float, high: float, title: str) -> None:
    """Raise InputError where the first mesh, read in `unit`, is no longer than `low` or longer than `high` metres."""
    first_one = next((i for i, file in enumerate(meshes.files) if file), None)
    if first_one is None:
        return
    length = float(np.max(meshes[first_one].extents))
    if unit not in METRES:
        raise InputError(f"{title}: unit: expected one of {', '.join(METRES)}, got {brief(repr(unit))}")
    if low <= length * METRES[unit] <= high:
        return
    fitting = [name for name, metres in METRES.items() if low <= length * metres <= high]
    hint = f"; unit={fitting[0]!r} would fit" if fitting else "; scale the meshes, or look at what was downloaded"
    raise InputError(
        f"{title}: expected meshes between {low:g} and {high:g} m long, got one of {length:.4g} {unit}{hint}"
    )
