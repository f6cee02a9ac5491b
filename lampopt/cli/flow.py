"""`lampopt flow`, `flow-study`: the flow around a mesh file, held against another's, and on finer and finer grids."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import spec
from lampopt.cli.show import number, table
from lampopt.errors import InputError, PluginError
from lampopt.meshfile import load_mesh
from lampopt.plugins import Plugins
from lampopt.units import factor, filled

MEASURE = "openfoam-drag"
LEVELS = "coarse,medium,fine"
KEPT = "what is solved is kept where --folder names one: the same command goes on"
SETTING = click.option(
    "--set", "settings", multiple=True, metavar="OPTION=VALUE", help=f"An option of {MEASURE}; repeatable."
)
FOLDER = click.option("--folder", default="", help="Where results are kept; an interrupted run goes on from there.")
MESH = click.argument("mesh", type=click.Path(dir_okay=False, path_type=Path))


@click.command(cls=Command, resumes=KEPT)
@MESH
@click.option("--against", type=click.Path(dir_okay=False, path_type=Path), help="A reference, on the same placements.")
@click.option("--unit", default="m", show_default=True, help="Length unit of the mesh file.")
@FOLDER
@SETTING
def flow(mesh: Path, against: Path | None, unit: str, folder: str, settings: tuple[str, ...]) -> Answer:
    """Solve the flow around a mesh file: drag and lift, with their uncertainty.

    MESH is a closed body, the wind along x, up along z (options `wind` and `up` of the measure say
    otherwise). With --against, a reference is solved on the same placements of the grid and the change
    of drag is told with its standard error.

    \b
        lampopt flow car.stl --set level=coarse --folder flows
        lampopt flow design.stl --against car.stl --set placements=5 --folder flows
    """
    factor(unit, "m", "--unit")  # raises where it is no length
    made = _made(settings, folder)
    if against is None:
        solved = made.solve(load_mesh(mesh))
        return Answer({"mesh": str(mesh), **_told(solved, unit)}, [_shown(mesh, solved, unit), *_notes(solved)])
    pair = made.compared(load_mesh(mesh), load_mesh(against))
    changes = {"drag": pair.drag, "drag_area": pair.drag_area}
    document = {
        "mesh": str(mesh),
        "reference": str(against),
        "change": {name: asdict(change) for name, change in changes.items()},
        "design": _told(pair.design, unit),
        "against": _told(pair.reference, unit),
    }
    rows = [
        [
            name.replace("_", " × "),
            f"{change.value:+.2%}",
            f"{change.error:.2%}",
            f"{change.low:+.2%} to {change.high:+.2%}",
            f"{change.p:.2g}",
            change.verdict,
        ]
        for name, change in changes.items()
    ]
    heads = ["change", "value", "standard error", "95% interval", "p", "verdict"]
    shown = [
        _shown(mesh, pair.design, unit),
        _shown(against, pair.reference, unit),
        table(f"{mesh} against {against}, {len(pair.drag.by_placement)} placements", heads, rows, right=("value",)),
    ]
    return Answer(document, [*shown, *_notes(pair.design), *_notes(pair.reference)])


@click.command("flow-study", cls=Command, resumes=KEPT)
@MESH
@click.option("--levels", default=LEVELS, show_default=True, help="Which, by name, separated by commas.")
@click.option("--unit", default="m", show_default=True, help="Length unit of the mesh file.")
@FOLDER
@SETTING
def flow_study(mesh: Path, levels: str, unit: str, folder: str, settings: tuple[str, ...]) -> Answer:
    """Solve the flow on finer and finer grids, and extrapolate.

    With three levels, drag is extrapolated to a grid without error (Richardson). A level that is not
    solved says why and stops nothing, but where OpenFOAM, the mesh or the disk is at fault, or none is.

    \b
        lampopt flow-study car.stl --folder flows
    """
    factor(unit, "m", "--unit")  # raises where it is no length
    wanted = [level.strip() for level in levels.split(",")]
    if unknown := sorted(set(wanted) - set(LEVELS.split(","))):
        raise InputError(f"--levels: expected some of {LEVELS}, got {', '.join(unknown)}")
    study = _made(settings, folder).refined(load_mesh(mesh), wanted)
    document: dict[str, Any] = {
        "mesh": str(mesh),
        "levels": {level: _told(solved, unit) for level, solved in study.flows.items()},
        "failures": dict(study.failures),
        "extrapolated": None if study.drag is None else asdict(study.drag),
    }
    rows = [_row(level, solved) for level, solved in study.flows.items()]
    rows += [[level, *["–"] * 5, message] for level, message in study.failures.items()]
    heads = ["level", "cells", "drag", "±", "lift", "±", "seconds, or why not"]
    shown: list[Any] = [table(f"{MEASURE} of {mesh}", heads, rows, right=("cells", "drag", "lift"))]
    if study.drag is not None:
        e = study.drag
        shown.append(
            f"without grid error: drag {e.value:.4f} ± {e.error:.4f} by the grids, ± {e.noise:.4f} by the placements' "
            f"noise; {e.message}"
        )
    notes = next((_notes(solved) for solved in study.flows.values()), [])
    return Answer(document, [*shown, *notes])


def _made(settings: tuple[str, ...], folder: str) -> Any:
    """The measure, with what it can besides measuring."""
    plugins = Plugins.load().report()
    try:
        given = (*settings, *([f"folder={folder}"] if folder else []))
        made = plugins.make("measure", spec(plugins, "measure", MEASURE, "--set", given))
    except PluginError as error:
        raise PluginError(f"the measure {MEASURE} is not there: {error}") from error
    if not all(hasattr(made, able) for able in ("solve", "compared", "refined")):
        raise PluginError(f"the measure {MEASURE} is another plugin's, which tells no more than its values")
    return made


def _told(solved: Any, unit: str) -> dict[str, Any]:
    """A flow as a document."""
    return {
        "drag": {"value": solved.drag, "error": solved.drag_error, "unit": ""},
        "lift": {"value": solved.lift, "error": solved.lift_error, "unit": ""},
        "frontal_area": {"value": solved.frontal_area, "unit": filled("L^2", unit)},
        "length": {"value": solved.length, "unit": unit},
        "level": solved.level,
        "cells": solved.cells,
        "half": solved.half,
        "openfoam": solved.openfoam,
        "notes": list(solved.notes),
        "placements": [asdict(one) for one in solved.placed],
    }


def _shown(mesh: Path, solved: Any, unit: str) -> Any:
    rows = [
        ["drag", number(solved.drag), number(solved.drag_error), ""],
        ["lift", number(solved.lift), number(solved.lift_error), ""],
        ["frontal area", number(solved.frontal_area), "", filled("L^2", unit)],
    ]
    what = (
        f"{solved.level}, {'half' if solved.half else 'whole'}, {solved.cells} cells, {len(solved.placed)} placements"
    )
    title = f"{MEASURE} of {mesh} ({what}, {solved.openfoam})"
    return table(title, ["name", "value", "standard error", "unit"], rows, right=("value", "standard error"))


def _row(level: str, solved: Any) -> list[str]:
    seconds = sum(one.seconds for one in solved.placed)
    numbers = (solved.drag, solved.drag_error, solved.lift, solved.lift_error)
    return [level, str(solved.cells), *(f"{value:.4f}" for value in numbers), f"{seconds:.0f}"]


def _notes(solved: Any) -> list[str]:
    return [f"note: {note}" for note in solved.notes]
