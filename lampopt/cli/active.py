"""`lampopt active`: a dear measure brought to its target with few evaluations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lampopt.active import Pursuit
from lampopt.active import active as pursued
from lampopt.cli import show
from lampopt.cli.answer import DONE, REJECTED, Answer, Command
from lampopt.cli.designs import FOLDER, RESUMES, STUDY, can_be_a_mesh, opened_study
from lampopt.meshfile import FORMATS
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.record import passport
from lampopt.types import Bank
from lampopt.written import export_mesh

if TYPE_CHECKING:
    from rich.console import RenderableType


@click.command(cls=Command, resumes=RESUMES)
@STUDY
@FOLDER
@click.option(
    "--budget",
    type=click.IntRange(1),
    default=16,
    show_default=True,
    help="Evaluations of the measure at most; one may be several solver runs (placements).",
)
@click.option(
    "--first",
    type=click.IntRange(2),
    help="How many of them are exemplars, the reference included; by default half as many as there are parameters, "
    "and two more.",
)
@click.option(
    "--tolerance",
    type=float,
    default=0.005,
    show_default=True,
    help="Of the reference's value, within which the target is met.",
)
@click.option(
    "--out",
    metavar="FILE",
    type=click.Path(dir_okay=False, path_type=Path),
    help=f"The design's mesh file, .{', .'.join(FORMATS)}.",
)
def active(
    study_file: Path, folder: Path | None, budget: int, first: int | None, tolerance: float, out: Path | None
) -> Answer:
    """Bring what a dear measure tells to its target with few evaluations.

    The objective of the study file names a value of one of its measures. The reference and a few exemplars are
    measured, then designs, each proposed from all before it and recorded in a folder. Exits 0 if an accepted design
    meets the target, 1 if none does within the budget.

    \b
        lampopt active study.toml --budget 12 --out design.stl
        lampopt flow design.stl --against reference.stl --set first=100
    """
    if out is not None:
        can_be_a_mesh("--out", out)
    plugins = Plugins.load().report()
    study, bank, folder = opened_study(study_file, folder)
    with progress_bar(f"active learning for {study_file.name}") as progress:
        found = pursued(
            study, budget=budget, first=first, tolerance=tolerance, folder=folder, progress=progress, plugins=plugins
        )
        mesh = found.result.design.mesh if out is not None else None
    if out is not None and mesh is not None:
        export_mesh(mesh, out)
    written = None if mesh is None else str(out)
    last = f"recorded in {folder}" + ("" if written is None else f"; {written} is written")
    document = {"folder": str(folder), "mesh": written, **_document(found, bank)}
    return Answer(document, [*_shown(found), last], DONE if found.met else REJECTED)


def _document(found: Pursuit, bank: Bank) -> dict[str, Any]:
    names = [q.name for q in bank.space]
    return {
        "met": found.met,
        "wanted": found.wanted,
        "value": found.value,
        "evaluations": found.evaluations,
        "trials": [
            {
                "name": trial.name,
                "parameters": dict(zip(names, trial.parameters.tolist(), strict=True)),
                "predicted": trial.predicted,
                "value": trial.value,
            }
            for trial in found.trials
        ],
        "design": passport(found.result, bank),
    }


def _shown(found: Pursuit) -> list[RenderableType]:
    start = found.trials[0].value
    rows = [
        (trial.name, show.number(trial.predicted), show.number(trial.value), _change(trial.value / start - 1))
        for trial in found.trials
    ]
    heads = ("evaluation of", "predicted", "measured", "against the reference")
    said = f"{show.number(found.value)}, wanted {show.number(found.wanted)}"
    failed = ", ".join(check.name for check in found.result.checks if not check.passed)
    missed = f"NOT MET: {said}" + (f"; REJECTED by {failed}" if failed else "")
    return [
        show.table(f"{found.evaluations} evaluations", heads, rows, right=heads[1:]),
        show.checks(found.result),
        show.verdict(found.met, f"met by an accepted design: {said}", missed),
    ]


def _change(part: float) -> str:
    return "–" if part != part else f"{part:+.2%}"
