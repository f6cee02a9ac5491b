"""`lampopt intake`, `wrap`: a health report of meshes before anything is fitted, and a remedy for the worst."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import click
import numpy as np

from lampopt.cli.answer import DONE, REJECTED, WRONG, Answer, Command
from lampopt.cli.designs import can_be_a_mesh
from lampopt.cli.options import accepted, spec
from lampopt.cli.show import BAD, GOOD, number, table
from lampopt.errors import InputError
from lampopt.exemplars import exemplars
from lampopt.intake import Finding, Health, Intake
from lampopt.intake import intake as look
from lampopt.intake import wrap as wrapped
from lampopt.meshfile import FORMATS, SUFFIXES, load_mesh
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.reading import brief, why
from lampopt.types import Exemplars
from lampopt.units import factor
from lampopt.written import export_mesh

if TYPE_CHECKING:
    from rich.text import Text
    from trimesh import Trimesh

TABLES = (".csv", ".parquet")
CODES = {"usable": DONE, "doubtful": REJECTED, "refused": WRONG}
STYLES = {"usable": GOOD, "note": "dim", "doubtful": "yellow", "refused": BAD}


@click.command(cls=Command)
@click.argument("what", metavar="[TABLE | MESH...]", nargs=-1, type=click.Path(path_type=Path))
@click.option("--meshes", metavar="FOLDER", help="Where the table's meshes are; by default beside it.")
@click.option("--unit", help="Length unit of the meshes.  [default: m]")
@click.option("--source", metavar="NAME", help="Another source of exemplars; see `lampopt sources`.")
@click.option("--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the source; repeatable.")
@click.option(
    "--accept", multiple=True, metavar="NAME", help="An exemplar that is as it should be, or all; repeatable."
)
@click.option("--repair/--no-repair", default=True, show_default=True, help="Make safe repairs before looking.")
def intake(
    what: tuple[Path, ...],
    meshes: str | None,
    unit: str | None,
    source: str | None,
    settings: tuple[str, ...],
    accept: tuple[str, ...],
    repair: bool,
) -> Answer:
    """Look at meshes before they are fitted.

    Each is looked at by itself; those of a table or a source also against their fellows. Exits 0 if all can be used, 1
    if any is in doubt, 2 if any is refused.

    \b
        lampopt intake cars.csv --meshes stl
        lampopt intake car.obj suv.dae more_cars/
        lampopt intake --source plate
    """
    factor("m" if unit is None else unit, "m", "--unit")  # raises where it is no length
    found, family = _exemplars(what, meshes, unit, source, settings)
    with progress_bar("intake") as progress:
        report = look(found, repair=repair, accept=accepted(accept), fellows=family, progress=progress)
    return _described(report)


@click.command(cls=Command)
@click.argument("mesh", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--gap", required=True, type=float, help="The widest opening to close, in the mesh's unit.")
@click.option("--resolution", type=int, default=0, help="Cells along the longest side; by default three along the gap.")
@click.option(
    "--out",
    required=True,
    metavar="FILE",
    type=click.Path(dir_okay=False, path_type=Path),
    help=f"The mesh file, {', '.join(f'.{form}' for form in FORMATS)}.",
)
def wrap(mesh: Path, gap: float, resolution: int, out: Path) -> Answer:
    """Wrap polygons into one closed surface.

    MESH may be open, crossing, turned anyhow. What the outside can reach through openings wider than the gap is
    followed; the rest is filled.

    \b
        lampopt wrap suv.obj --gap 0.05 --out suv_wrapped.ply
    """
    can_be_a_mesh("--out", out)
    same = False
    with suppress(OSError, ValueError):  # a file that is not there is told where it is read
        same = out.samefile(mesh)
    if same:
        raise InputError(f"--out {brief(out)}: is the mesh that is to be wrapped: name another file")
    made = wrapped(load_mesh(mesh), gap=gap, resolution=resolution)
    export_mesh(made, out)
    extents = [float(x) for x in made.extents]
    document = {"mesh": str(out), "faces": len(made.faces), "extents": extents, "volume": float(made.volume)}
    said = f"{out}: closed, {len(made.faces)} faces, {' × '.join(map(number, extents))}"
    return Answer(document, [said])


def _exemplars(
    what: Sequence[Path], meshes: str | None, unit: str | None, source: str | None, settings: tuple[str, ...]
) -> tuple[Exemplars, bool]:
    """What is to be looked at, and whether it is a family."""
    tables = [path for path in what if path.suffix.lower() in TABLES]
    if bool(source) == bool(what) or (tables and len(what) > 1):
        raise InputError("expected one table, or mesh files and folders, or --source NAME")
    if source is not None and (meshes is not None or unit is not None):
        raise InputError("--meshes and --unit go with a table or meshes; options of a source go behind --set")
    unit = "m" if unit is None else unit
    if source is None and not tables:
        if meshes is not None or settings:
            raise InputError("--meshes and --set go with a table, got mesh files")
        return _loose(tuple(_files(what)), unit), False
    plugins = Plugins.load().report()
    if source is not None:
        return exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins), True
    given = (f"table={tables[0]}", f"unit={unit}", *([f"meshes={meshes}"] if meshes else []), *settings)
    return exemplars(spec(plugins, "source", "table", "--set", given), plugins=plugins), True


def _files(what: Sequence[Path]) -> Iterator[str]:
    """Mesh files as they are named, and those in folders."""
    for path in what:
        try:
            folder = path.is_dir()
            inside = sorted(str(f) for f in path.iterdir() if f.suffix.lower() in SUFFIXES) if folder else []
        except OSError as error:  # a name that is too long, a folder that may not be entered
            raise InputError(f"{brief(path)}: cannot be opened: {why(error)}") from error
        if not folder:
            yield str(path)
            continue
        if not inside:
            raise InputError(f"{path}: expected a folder with {', '.join(SUFFIXES)} files, got none of them")
        yield from inside


def _loose(files: tuple[str, ...], unit: str) -> Exemplars:
    """Mesh files of which nothing else is known, named as they are given."""
    names = tuple(dict.fromkeys(files))
    return Exemplars(np.empty((len(names), 0)), (), _Files(Path(), names), names, unit=unit)


@dataclass(frozen=True)
class _Files(Sequence["Trimesh"]):
    """The meshes in `files`, loaded when they are looked at."""

    folder: Path
    files: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.files)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> _Files: ...
    def __getitem__(self, index: int | slice) -> Trimesh | _Files:
        if isinstance(index, slice):
            return _Files(self.folder, self.files[index])
        return load_mesh(self.folder / self.files[index])


def _described(report: Intake) -> Answer:
    names = report.given.names
    problems = set(report.problems)
    health = {one.name: one for one in report.health}
    verdicts = dict.fromkeys(names, "usable")
    for problem in reversed(report.problems):  # the refused ones come first, and so have the last word
        verdicts[problem.exemplar] = problem.severity
    counted = {verdict: sum(v == verdict for v in verdicts.values()) for verdict in CODES}
    worst = next(verdict for verdict in reversed(CODES) if counted[verdict] or verdict == "usable")
    document: dict[str, Any] = {
        "verdict": worst,
        "unit": report.given.unit,
        **counted,
        "exemplars": [
            {"name": name, "verdict": verdicts[name], "health": asdict(health[name]) if name in health else None}
            for name in names
        ],
        "findings": [{**asdict(f), "accepted": f.severity != "note" and f not in problems} for f in report.findings],
    }
    unit = report.given.unit
    columns = (
        "exemplar",
        "verdict",
        "faces",
        "watertight",
        "bodies",
        "genus",
        "openings",
        "crossings",
        f"extents [{unit}]",
    )
    rows = [(name, _coloured(verdicts[name]), *_row(health.get(name))) for name in names]
    shown: list[Any] = [table("meshes", columns, rows, right=("faces", "bodies", "genus", "openings", "crossings"))]
    shown += [_line(finding, finding in problems) for finding in report.findings]
    said = ", ".join(f"{count} {verdict}" for verdict, count in counted.items() if count)
    shown.append(_coloured(worst, f"{len(names)} {'mesh' if len(names) == 1 else 'meshes'}: {said}"))
    return Answer(document, shown, CODES[worst])


def _row(health: Health | None) -> tuple[str, ...]:
    if health is None:
        return ("–",) * 7
    extents = " × ".join(f"{x:.4g}" for x in health.extents)
    genus = "–" if health.genus is None else str(health.genus)
    counts = (health.bodies, genus, health.holes, health.crossings)
    return str(health.faces), "yes" if health.closed else "no", *map(str, counts), extents


def _line(finding: Finding, stands: bool) -> Text:
    from rich.text import Text

    kind = finding.severity if stands or finding.severity == "note" else "accepted"
    whose = f"{finding.exemplar}: " if finding.exemplar else ""
    return Text.assemble((f"{kind:9}", STYLES.get(kind, GOOD)), f"{whose}{finding.message}")


def _coloured(verdict: str, text: str | None = None) -> Text:
    from rich.text import Text

    return Text(text or verdict, STYLES[verdict])
