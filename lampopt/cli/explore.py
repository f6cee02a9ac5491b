"""`lampopt explore`: what surrounds the design that a study asks for."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from lampopt.cli.answer import DONE, REJECTED, Answer, Command
from lampopt.cli.show import number, span, table, verdict
from lampopt.explore import Exploration
from lampopt.explore import explore as explored
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.study import Study
from lampopt.types import LEVELS, Array, Bank, Needs

if TYPE_CHECKING:
    from rich.console import RenderableType

MOST = 10  # free directions that people are shown; programs get all
NAMED = 3  # exemplars of each
NOISE = 1e-9  # part of a range, or of the largest coefficient, that is shown as nothing


@click.command(cls=Command)
@click.argument("study_file", metavar="STUDY", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--level",
    type=click.Choice(LEVELS),
    default="field",
    show_default=True,
    help="Up to where neighbours must pass; mesh makes one of each that passes the rest, which takes far longer.",
)
def explore(study_file: Path, level: Needs) -> Answer:
    """Tell what surrounds the design that a study file asks for.

    How far each parameter alone may go with every check passing, what is still free with every target kept, and how
    the mix follows each target. Nothing is recorded. Exits 1 if the design itself is rejected.

    \b
        lampopt explore study.toml --level mesh
    """
    plugins = Plugins.load().report()
    study = Study.read(study_file)
    bank = study.opened()
    with progress_bar(f"exploring {study_file.name}") as progress:
        found = explored(replace(study, bank=bank), level=level, plugins=plugins, progress=progress)
    return Answer(_document(found, bank), _shown(found, bank), DONE if found.design.accepted else REJECTED)


def _document(found: Exploration, bank: Bank) -> dict[str, Any]:
    def by_name(alpha: Array) -> dict[str, float]:
        return dict(zip(bank.names, alpha.tolist(), strict=True))

    return {
        "level": found.level,
        "unit": found.unit,
        "accepted": found.design.accepted,
        "failed": _failed(found),
        "target": dict(found.design.design.target),
        "parameters": [
            {**asdict(one), "low_by": one.low_by or None, "high_by": one.high_by or None} for one in found.intervals
        ],
        "free": [
            {"size": float(size), "alpha": by_name(way)} for size, way in zip(found.sizes, found.free, strict=True)
        ],
        "by_target": [
            {"name": name, "unit": unit, "alpha": by_name(alpha)}
            for name, unit, alpha in zip(found.names, found.units, found.by_target.T, strict=True)
        ],
    }


def _shown(found: Exploration, bank: Bank) -> list[RenderableType]:
    space = {q.name: q for q in bank.space}
    rows = []
    for one in found.intervals:
        q = space[one.name]
        values = (number(v if abs(v) > NOISE * q.spread else 0.0) for v in (one.value, one.low, one.high))
        rows.append((one.name, *values, one.unit, one.low_by, one.high_by, span(q.low, q.high)))
    heads = ("parameter", "value", "from", "to", "unit", "ended below by", "above by", "in the bank")
    shown: list[RenderableType] = [table("each parameter alone", heads, rows, right=heads[1:4])]
    if len(found.free):
        more = f", the first {MOST} of {len(found.free)}" if len(found.free) > MOST else ""
        title, change = f"free, with every target kept{more}", f"change of shape [{found.unit}]"
        ways = [
            (i, f"{size:.3g}", _most(way, bank))
            for i, (size, way) in enumerate(zip(found.sizes[:MOST], found.free[:MOST], strict=True))
        ]
        shown.append(table(title, ("direction", change, "most of all"), ways, right=("direction", change)))
    if found.names:
        follows = [
            (name, f"1 {unit}".rstrip(), _most(alpha, bank))
            for name, unit, alpha in zip(found.names, found.units, found.by_target.T, strict=True)
        ]
        shown.append(table("how the mix follows", ("target", "by", "most of all"), follows))
    judged = f"judged by {found.level}"
    return [*shown, verdict(found.design.accepted, f"accepted, {judged}", f"REJECTED by {_failed(found)}, {judged}")]


def _most(alpha: Array, bank: Bank) -> str:
    """The exemplars that take the largest part in a direction."""
    parts = np.abs(alpha)
    first = [i for i in np.argsort(-parts, kind="stable")[:NAMED] if parts[i] > NOISE * parts.max()]
    return ", ".join(f"{bank.names[i]} {alpha[i]:+.3g}" for i in first)


def _failed(found: Exploration) -> str | None:
    return next((check.name for check in found.design.checks if not check.passed), None)
