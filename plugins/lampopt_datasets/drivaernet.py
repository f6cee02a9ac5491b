"""DrivAerNet and DrivAerNet++: cars with drag from flow solutions, as Harvard Dataverse and GitHub publish them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import brief
from lampopt.types import Array, Exemplars

from .columns import Column
from .download import Download, check_size, few, named_options, space, values
from .example import temporary
from .meshes import MeshFiles

PLACE = (
    "meshes from Harvard Dataverse, dataverse 'DrivAerNet', dataset '3D Meshes' (unpack the archives); tables and "
    "splits from the GitHub repository Mohamedelrefaie/DrivAerNet, folders ParametricModels and train_val_test_splits, "
    "and the drag table that its README links to"
)
PARAMETERS = ("DrivAerNet_ParametricData.csv",)
COEFFICIENTS = (
    "DrivAerNetPlusPlus_Cd_8k_Updated.csv",
    "DrivAerNetPlusPlus_Drag_8k.csv",
    "AeroCoefficients_DrivAerNet_FilteredCorrected.csv",
    "AeroCoefficients_DrivAerNet_FilteredCorrected_no_prefix.csv",
)
SPLITS = ("train", "val", "test", "all")
ID = re.compile(r"(?:DrivAer_)?([EFN]_[A-Z]+_[A-Z]+_[A-Z]+)_0*(\d+)")
LABEL = re.compile(r"(Average|Std) C[dlm](_[fr])?")
UNITS = {  # the table states none: these are plain by name and range of values, what is not has ""
    **dict.fromkeys(("B_Ramp_Angle", "B_Diffusor_Angle", "B_Trunklid_Angle", "C_Side_Mirrors_Rotation"), "deg"),
    **dict.fromkeys(
        (
            "A_Car_Length",
            "A_Car_Width",
            "A_Car_Roof_Height",
            "C_Side_Mirrors_Translate_X",
            "C_Side_Mirrors_Translate_Z",
            "D_Rear_Window_Length",
            "D_Winscreen_Length",
            "E_A_B_C_Pillar_Thickness",
            "E_Fenders_Arch_Offset",
            "F_Door_Handles_Thickness",
            "F_Door_Handles_X_Position",
            "F_Door_Handles_Z_Position",
            "G_Trunklid_Length",
            "H_Front_Bumper_Length",
        ),
        "mm",
    ),
}
SHORTEST, LONGEST = 3.0, 7.0  # m; the cars are about 4.6 m long


@dataclass(frozen=True)
class DrivAerNetPlus:
    """DrivAerNet++ (arXiv 2406.09624): 8,000 cars; estate, fastback and notchback, with their drag coefficients.

    A design's id is its body style and a number (``E_S_WWC_WM_005``). Some published files pad the number and some do
    not, some begin with ``DrivAer_``: ids that differ in that alone are one design. The published table has parameters
    for the seven styles E_S, F_S and N_S, as offsets from a base car; F_D_WM_WW, the first release, has none in it.

    Parameters
    ----------
    folder
        What was downloaded, unpacked: meshes, tables and splits anywhere below it.
    style
        Body style, ``E_S_WW_WM``; the beginning of one is enough, ``N_`` for every notchback. All by default.
    split
        `train`, `val`, `test` or `all`, by the published lists.
    count
        The first so many designs of the table; 0 for all.
    labels
        Comma-separated columns that are labels; by default every `Average C...` and `Std C...`.
    parameters
        True: designs with a row in the table of parameters. False: every design with coefficients, without parameters.
    missing
        Designs without a mesh: `error`, or `leave out`.
    meshes
        Folder inside `folder` that holds the meshes, where not all in it count.
    unit
        Of the meshes: metres as published. The first mesh is held against it.
    """

    folder: str
    style: str = ""
    split: str = "all"
    count: int = 0
    labels: str = ""
    parameters: bool = True
    missing: str = "error"
    meshes: str = ""
    unit: str = "m"

    watertight = False  # windows, wheels and body are shells of their own

    @staticmethod
    def example() -> DrivAerNetPlus:
        """Three boxes laid out as the dataset is, in a temporary folder that is removed when Python ends."""
        return DrivAerNetPlus(_made(("E_S_WW_WM_001", "E_S_WW_WM_002", "N_S_WWS_WM_010")))

    def __call__(self) -> Exemplars:
        """The exemplars; meshes load on access. Raises InputError naming what is missing or cannot be used."""
        return _exemplars("drivaernet++", self)


@dataclass(frozen=True)
class DrivAerNet:
    """DrivAerNet (arXiv 2403.08055): the first release, 4,000 fastbacks F_D_WM_WW, with their drag coefficients.

    No parameters are published for these designs, so by default exemplars have labels and no parameters: enough to
    learn drag from meshes, not for a bank. Options as `DrivAerNetPlus` has them.
    """

    folder: str
    style: str = "F_D_WM_WW"
    split: str = "all"
    count: int = 0
    labels: str = ""
    parameters: bool = False
    missing: str = "error"
    meshes: str = ""
    unit: str = "m"

    watertight = False

    @staticmethod
    def example() -> DrivAerNet:
        """As `DrivAerNetPlus.example`, with parameters."""
        names = ("F_D_WM_WW_0001", "F_D_WM_WW_0002", "F_D_WM_WW_0004")
        return DrivAerNet(_made(names), parameters=True)

    def __call__(self) -> Exemplars:
        """The exemplars; meshes load on access. Raises InputError naming what is missing or cannot be used."""
        return _exemplars("drivaernet", self)


Key = tuple[str, int]


def key(name: str) -> Key | None:
    """The style and number of a design's id, None where `name` is none: ``E_S_WW_WM_007`` → ("E_S_WW_WM", 7)."""
    found = ID.fullmatch(name.strip())
    return (found[1], int(found[2])) if found else None


def _exemplars(title: str, asked: DrivAerNet | DrivAerNetPlus) -> Exemplars:
    download = Download.of(asked.folder, title, PLACE)
    if asked.split not in SPLITS:
        raise InputError(f"{title}: split: expected one of {', '.join(SPLITS)}, got {brief(repr(asked.split))}")
    tables = _tables(download, asked.parameters)
    ids, columns = tables[0]
    chosen = [row for row, design in enumerate(ids) if design[0].startswith(asked.style)]
    if not chosen:
        styles = ", ".join(sorted({design[0] for design in ids}))
        hint = "; parameters=False takes every design with coefficients" if asked.parameters else ""
        raise InputError(f"{title}: no design of style {asked.style!r} in the table; its styles are {styles}{hint}")
    if asked.split != "all":
        wanted = _split(download, asked.split)
        chosen = [row for row in chosen if ids[row] in wanted]
        if not chosen:
            raise InputError(f"{title}: the split {asked.split!r} has none of the designs of style {asked.style!r}")
    names = [_name(ids[row]) for row in chosen]
    files = download.meshes(lambda path: key(path.stem), (".stl", ".obj"), asked.meshes)
    known = set(ids)
    extra = [file for design, file in files.items() if design not in known]
    kept = download.paired(names, [files.get(ids[row]) for row in chosen], extra, asked.missing, asked.count)
    rows = [chosen[i] for i in kept]
    parameters = [c for c in columns.values() if asked.parameters and c.numeric and not LABEL.fullmatch(c.name)]
    label_names, labels = _labels(download, tables, [ids[row] for row in rows], named_options(asked.labels))
    found = tuple(files.get(ids[row], "") for row in rows)
    check_size(MeshFiles(download.folder, found), asked.unit, SHORTEST, LONGEST, title)
    return Exemplars(
        parameters=values(parameters, rows, gaps=False, title=title),
        space=space([c.name for c in parameters], UNITS),
        meshes=MeshFiles(download.folder, found),
        names=tuple(names[i] for i in kept),
        labels=labels,
        label_space=space(label_names, {}),
        unit=asked.unit,
    )


def _name(design: Key) -> str:
    """The id as the splits write it: F_D_WM_WW with four digits, the others with three."""
    style, number = design
    return f"{style}_{number:04d}" if style == "F_D_WM_WW" else f"{style}_{number:03d}"


def _tables(download: Download, parameters: bool) -> list[tuple[list[Key], dict[str, Column]]]:
    """The tables with their designs: the one whose rows are the exemplars first, then those that have more labels."""
    wanted = [PARAMETERS, COEFFICIENTS] if parameters else [COEFFICIENTS, PARAMETERS]
    tables = []
    for place, names in enumerate(wanted):
        if download.named(*names) is None and (place or not parameters):
            continue
        columns = download.table(*names)
        heading = next((name for name in ("Experiment", "Design") if name in columns), None)
        if heading is None:
            raise InputError(
                f"{download.title}: {download.named(*names)}: expected a column Experiment or Design with ids, got "
                f"{', '.join(map(repr, columns))}"
            )
        cells = ["" if cell is None else str(cell) for cell in columns.pop(heading).cells.to_pylist()]
        ids = [key(cell) for cell in cells]
        if wrong := [cell for cell, design in zip(cells, ids, strict=True) if design is None]:
            raise InputError(f"{download.title}: {download.named(*names)}: no id such as E_S_WW_WM_007 in {few(wrong)}")
        known = [design for design in ids if design is not None]
        if len(set(known)) < len(known):
            twice = [_name(design) for design, rows in Counter(known).items() if rows > 1]
            raise InputError(f"{download.title}: {download.named(*names)}: designs with two rows ({few(twice)})")
        tables.append((known, columns))
    if not tables:
        raise download.absent(f"a table {' or '.join((*COEFFICIENTS, *PARAMETERS))}")
    return tables


def _split(download: Download, split: str) -> set[Key]:
    listed = download.lines(f"{split}_design_ids.txt", f"{split}.txt")
    ids = [key(line) for line in listed]
    if wrong := [line for line, design in zip(listed, ids, strict=True) if design is None]:
        raise InputError(f"{download.title}: split {split!r}: no id such as E_S_WW_WM_007 in {few(wrong)}")
    return {design for design in ids if design is not None}


def _labels(
    download: Download,
    tables: Sequence[tuple[list[Key], dict[str, Column]]],
    designs: Sequence[Key],
    asked: Sequence[str],
) -> tuple[list[str], Array]:
    """Names and (N, p) values of the labels, NaN where unknown; one in two tables counts as in the first."""
    found: dict[str, Array] = {}
    for ids, columns in tables:
        row = {design: i for i, design in enumerate(ids)}
        for column in (column for name, column in columns.items() if LABEL.fullmatch(name)):
            known = values([column], range(len(ids)), gaps=True, title=download.title)[:, 0]
            own = np.array([known[row[design]] if design in row else np.nan for design in designs])
            before = found.get(column.name, own)
            found[column.name] = np.where(np.isnan(before), own, before)
    if absent := [name for name in asked if name not in found]:
        raise InputError(
            f"{download.title}: labels: no column {', '.join(map(repr, absent))}; "
            f"known are {', '.join(map(repr, found))}"
        )
    names = list(asked) or [name for name, column in found.items() if not np.isnan(column).all()]
    return names, np.column_stack([found[name] for name in names]) if names else np.empty((len(designs), 0))


def _made(names: Sequence[str]) -> str:
    """A temporary folder laid out as the dataset is, with a box for each car; one a split."""
    lists = {f"train_val_test_splits/{s}_design_ids.txt": (n,) for s, n in zip(SPLITS[:3], names, strict=True)}
    rows = [f"{name},{40 * i},{i - 1},{0.25 + 0.01 * i}" for i, name in enumerate(names)]
    drag = [f"{name},{0.25 + 0.01 * i}" for i, name in enumerate(names)]
    tables = {
        PARAMETERS[0]: ("Experiment,A_Car_Length,B_Ramp_Angle,Average Cd", *rows),
        COEFFICIENTS[0]: ("Design,Average Cd", *drag),
    }
    boxes = {f"3DMeshesSTL/DrivAer_{name}.stl": (4.6 + 0.04 * i, 1.8, 1.4) for i, name in enumerate(names)}
    return str(temporary("drivaernet", boxes, {**tables, **lists}))
