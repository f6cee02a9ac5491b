"""BlendedNet: blended-wing-body aircraft, each solved at about nine flight conditions (arXiv 2509.07209)."""

from __future__ import annotations

import configparser
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import brief, content
from lampopt.types import Array, Exemplars

from .download import Download, check_size, few, named_options, space
from .example import temporary
from .meshes import MeshFiles

TITLE = "blendednet"
PLACE = (
    "Harvard Dataverse, doi:10.7910/DVN/VJT9EP, BlendedNet_Dataset_Released.zip: folders train and test, each with "
    "geom_params.ini, case_data.dat and vtk"
)
PLANFORM = ("B1", "B2", "B3", "C2", "C3", "C4", "S1", "S2", "S3")  # C1 is 1000 mm in every geometry
FLIGHT = ("alt_kft", "Re_L", "M_inf", "alpha_deg")
COEFFICIENTS = ("CL", "CD", "CMy")
LENGTHS, SWEEPS = PLANFORM[:6], PLANFORM[6:]
UNITS = {**dict.fromkeys(LENGTHS, "mm"), **dict.fromkeys(SWEEPS, "deg"), "alt_kft": "kft", "alpha_deg": "deg"}
SAME = {"Re": "Re_L", "Cmy": "CMy"}  # what some releases call a column
SPLITS = ("train", "test", "all")
PADDING = re.compile(r"(?<!\d)0+(?=\d)")
GEOMETRY, CASES = "geom_params.ini", "case_data.dat"
LARGEST = 2**26  # bytes of a table
SHORTEST, LONGEST = 0.5, 3.0  # m; the centre chord is 1 m


@dataclass(frozen=True)
class BlendedNet:
    """BlendedNet (arXiv 2509.07209): 999 planforms, each at about nine flight conditions.

    Nine planform parameters at a centre chord of 1 m: half-widths B1, B2, B3 and chords C2, C3, C4 [mm], sweeps S1, S2,
    S3 [deg]. Every case has its own altitude, Reynolds number, Mach number and angle of attack, and CL, CD, CMy.

    Parameters
    ----------
    folder
        What was downloaded, unpacked.
    split
        `train`, `test` or `all`, by the folders that the tables lie in.
    each
        What an exemplar is. `geometry`: one a planform, its labels the flight condition and coefficients of one of its
        cases. `case`: one a case; the flight condition is four more parameters, the coefficients are labels. The mesh
        is that of the planform, so a bank wants `geometry` and a model `case`.
    case
        With `geometry`: which of a planform's cases, counted from 1 in the published order. Labels are NaN where a
        planform has fewer.
    count
        The first so many exemplars; 0 for all.
    labels
        Comma-separated ones of those above; by default all.
    missing
        Exemplars without a mesh: `error`, or `leave out`.
    unit
        Of the meshes. The publication names none: the first mesh is held against a centre chord of 1 m.
    """

    folder: str
    split: str = "all"
    each: str = "geometry"
    case: int = 1
    count: int = 0
    labels: str = ""
    missing: str = "error"
    unit: str = "m"

    watertight = False  # surfaces of a flow solution: half a body, open at its plane of symmetry, is usual

    @staticmethod
    def example() -> BlendedNet:
        """Three boxes laid out as the dataset is, in a temporary folder that is removed when Python ends."""
        values = dict(zip(PLANFORM, (150, 100, 400, 700, 200, 75, 50, 50, 30), strict=True))
        sections, lines = [], [f"#case_name geom_name {' '.join(FLIGHT)} beta_deg {' '.join(COEFFICIENTS)}"]
        for i in range(3):
            sections += [f"[geom_{i}]", *(f"{name} = {value}" for name, value in {**values, "B1": 150 + i}.items())]
            lines += [f"case_{2 * i + k:04d} geom_{i} 10 1e7 0.3 {4 * k} 0 {0.1 + 0.3 * k} 0.01 -0.02" for k in (0, 1)]
        boxes = {f"train/vtk/case_{2 * i:04d}.stl": (1.0 + 0.1 * i, 0.8, 0.1) for i in range(3)}
        return BlendedNet(str(temporary(TITLE, boxes, {f"train/{GEOMETRY}": sections, f"train/{CASES}": lines})))

    def __call__(self) -> Exemplars:
        """The exemplars; meshes load on access. Raises InputError naming what is missing or cannot be used."""
        for option, known in (("split", SPLITS), ("each", ("geometry", "case"))):
            if getattr(self, option) not in known:
                got = brief(repr(getattr(self, option)))
                raise InputError(f"{TITLE}: {option}: expected one of {', '.join(known)}, got {got}")
        if isinstance(self.case, bool) or not isinstance(self.case, int) or self.case < 1:
            raise InputError(f"{TITLE}: case: expected a whole number from 1, got {brief(repr(self.case))}")
        download = Download.of(self.folder, TITLE, PLACE)
        cases = [case for split in SPLITS[:2] if self.split in (split, "all") for case in _cases(download, split)]
        if not cases:
            raise download.absent("geom_params.ini and case_data.dat, below a folder train or test,")
        by_geometry: dict[Hashable, list[Case]] = {}
        for case in cases:
            by_geometry.setdefault((case.split, case.geometry), []).append(case)
        rows = cases if self.each == "case" else [own[0] for own in by_geometry.values()]
        kept, files = self._kept(download, cases, rows)
        check_size(MeshFiles(download.folder, files), self.unit, SHORTEST, LONGEST, TITLE)
        titles = (*PLANFORM, *FLIGHT) if self.each == "case" else PLANFORM
        label_titles = COEFFICIENTS if self.each == "case" else (*FLIGHT, *COEFFICIENTS)
        chosen = named_options(self.labels) or list(label_titles)
        if absent := [name for name in chosen if name not in label_titles]:
            raise InputError(f"{TITLE}: labels: no {', '.join(absent)}; known are {', '.join(label_titles)}")
        return Exemplars(
            parameters=_matrix([case.values for case in kept], titles, gaps=False),
            space=space(titles, UNITS),
            meshes=MeshFiles(download.folder, files),
            names=tuple(map(self._name, kept)),
            labels=_matrix([self._labelled(case, by_geometry) for case in kept], chosen, gaps=True),
            label_space=space(chosen, UNITS),
            unit=self.unit,
        )

    def _kept(
        self, download: Download, cases: Sequence[Case], rows: Sequence[Case]
    ) -> tuple[list[Case], tuple[str, ...]]:
        """The exemplars, and the mesh of each, "" without one: the case's own, the geometry's, another case's of it."""
        files = download.meshes(_key, (".vtk", ".stl", ".obj"))
        by_geometry: dict[Hashable, str] = {}
        for case in reversed(cases):
            own = files.get((case.split, _plain(case.name)), files.get((case.split, _plain(case.geometry))))
            if own is not None:
                by_geometry[case.split, case.geometry] = own
        found = [
            files.get((case.split, _plain(case.name)), by_geometry.get((case.split, case.geometry))) for case in rows
        ]
        known = {(case.split, _plain(name)) for case in cases for name in (case.name, case.geometry)}
        extra = [file for stem, file in files.items() if stem not in known]
        names = [self._name(case) for case in rows]
        kept = download.paired(names, found, extra, self.missing, self.count)
        return [rows[row] for row in kept], tuple(found[row] or "" for row in kept)

    def _name(self, case: Case) -> str:
        """Both splits count their cases from 0, so the split begins the name."""
        return f"{case.split}_{case.name if self.each == 'case' else case.geometry}"

    def _labelled(self, case: Case, cases: Mapping[Hashable, Sequence[Case]]) -> Mapping[str, float]:
        """What the labels of an exemplar are taken from: the case itself, or the asked one of its geometry."""
        if self.each == "case":
            return case.values
        own = cases[case.split, case.geometry]
        return own[self.case - 1].values if self.case <= len(own) else {}


@dataclass(frozen=True, eq=False)
class Case:
    """One flow solution: its split, name and geometry, and every number known of it."""

    split: str
    name: str
    geometry: str
    values: Mapping[str, float]


def _plain(name: str) -> str:
    """A name without the padding of its number, since splits pad differently: case_0007 and case_007 are case_7."""
    return PADDING.sub("", name)


def _key(path: PurePosixPath) -> tuple[str, str] | None:
    """The split that a mesh's file lies in, and its stem."""
    splits = [part for part in path.parts[:-1] if part in SPLITS[:2]]
    return (splits[-1], _plain(path.stem)) if splits else None


def _cases(download: Download, split: str) -> list[Case]:
    """The cases of a split, none where it was not downloaded; those whose geometry is unknown are an error."""
    here = [file for file in download.files if split in PurePosixPath(file).parts[:-1]]
    tables = {name: [file for file in here if PurePosixPath(file).name == name] for name in (GEOMETRY, CASES)}
    if not any(tables.values()):
        return []
    for name, found in tables.items():
        if len(found) != 1:
            raise InputError(
                f"{TITLE}: expected one file {name} below {split} in {download.folder}, "
                f"got {', '.join(found) or 'none'}. The data: {PLACE}"
            )
    geometries = _geometries(download.folder / tables[GEOMETRY][0])
    cases, unknown = [], []
    for row in _rows(download.folder / tables[CASES][0]):
        name, geometry = row.pop("case_name"), row.pop("geom_name")
        if geometry not in geometries:
            unknown.append(geometry)
            continue
        cases.append(Case(split, name, geometry, {**geometries[geometry], **_numbers(row, f"{CASES}, {name}")}))
    if unknown:
        raise InputError(f"{TITLE}: {split}: {CASES} names geometries that {GEOMETRY} lacks ({few(unknown)})")
    return cases


def _geometries(path: Path) -> dict[str, dict[str, float]]:
    """Each section of an INI file: a geometry's planform parameters."""
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]  # B1, not b1
    try:
        parser.read_string(_text(path))
    except configparser.Error as error:
        raise InputError(f"{TITLE}: {brief(path)}: cannot be read: {brief(error)}") from error
    return {name: _numbers(dict(parser.items(name)), f"{GEOMETRY}, {name}") for name in parser.sections()}


def _rows(path: Path) -> list[dict[str, str]]:
    """The lines of a table of columns separated by blanks, the first being their names."""
    lines = [line.split() for line in _text(path).splitlines() if line.strip()]
    heading = [SAME.get(name, name) for name in lines[0] if name != "#"] if lines else []
    heading = [name.lstrip("#") for name in heading]
    if absent := [name for name in ("case_name", "geom_name") if name not in heading]:
        raise InputError(f"{TITLE}: {brief(path)}: no column {', '.join(absent)}; known are {', '.join(heading)}")
    if uneven := [number for number, line in enumerate(lines[1:], 1) if len(line) != len(heading)]:
        raise InputError(
            f"{TITLE}: {brief(path)}: expected {len(heading)} cells in each row, not so in rows {few(uneven)}"
        )
    return [dict(zip(heading, line, strict=True)) for line in lines[1:]]


def _text(path: Path) -> str:
    return content(path, largest=LARGEST).decode("utf-8", errors="replace")


def _numbers(cells: Mapping[str, str], where: str) -> dict[str, float]:
    """The cells that are wanted, as numbers."""
    try:
        return {name: float(cells[name]) for name in (*PLANFORM, *FLIGHT, *COEFFICIENTS) if name in cells}
    except ValueError as error:
        raise InputError(f"{TITLE}: {where}: expected numbers, {brief(error)}") from error


def _matrix(rows: Sequence[Mapping[str, float]], names: Sequence[str], *, gaps: bool) -> Array:
    """(N, p) the values by name, NaN where a row has none and `gaps` allows it."""
    matrix = np.array([[row.get(name, np.nan) for name in names] for row in rows]).reshape(len(rows), len(names))
    lacking = [name for name, column in zip(names, matrix.T, strict=True) if not np.isfinite(column).all()]
    if lacking and not gaps:
        raise InputError(f"{TITLE}: expected a number of {', '.join(lacking)} in every row, got some without")
    return matrix
