"""`lampopt front`: accuracy against reliability for what a study asks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import can_be_written
from lampopt.cli.show import number, table, verdict
from lampopt.errors import InputError
from lampopt.front import Front, Reduction
from lampopt.front import front as found_front
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.study import Study
from lampopt.types import LEVELS, Array, Bank, Needs, Result

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.text import Text

ALONG = 9  # mixes that are shown and judged, beside the knee
MANY = 6  # targets that are shown
NOISE = 1e-9  # errors and distances that are shown as nothing


@click.command(cls=Command)
@click.argument("study_file", metavar="STUDY", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--ridges", type=click.IntRange(2), default=200, show_default=True, help="How many mixes.")
@click.option("--reduce", "fractions", metavar="FRACTION,...", help="Lower the objective's label by each of these too.")
@click.option(
    "--level", type=click.Choice(LEVELS), default="field", show_default=True, help="Up to where those shown are judged."
)
@click.option("--out", metavar="FILE", type=click.Path(dir_okay=False, path_type=Path), help="An SVG picture to write.")
def front(study_file: Path, ridges: int, fractions: str | None, level: Needs, out: Path | None) -> Answer:
    """Tell what nearness to the centre costs of what a study file asks for.

    Every compromise between meeting the targets and staying near the reference, or the mean: error against ‖alpha −
    centre‖, and the knee between them. Some along the way are judged. Nothing is recorded.

    \b
        lampopt front study.toml --out front.svg
        lampopt front study.toml --reduce 0,0.05,0.1,0.15,0.2
    """
    if out is not None:
        can_be_written("--out", out)
    given = [] if fractions is None else _read(fractions)
    plugins = Plugins.load().report()
    study = Study.read(study_file)
    bank = study.opened()
    with progress_bar(f"front of {study_file.name}") as progress:
        found = found_front(replace(study, bank=bank), ridges=ridges, reduce=given, plugins=plugins, progress=progress)
        judged = {i: found.result(i, level) for i in _along(found)}
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(found.svg(), encoding="utf-8")
    return Answer(_document(found, judged, level, bank, out), _shown(found, judged, level))


def _read(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"--reduce: expected fractions such as 0,0.05,0.1, got {text!r:.80}") from error


def _along(found: Front) -> list[int]:
    """Mixes evenly along the front, ends and knee among them."""
    points = np.nan_to_num(np.column_stack([found.distance, found.error]))
    steps = np.diff(points / np.maximum(points.max(0), 1e-300), axis=0)
    length = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
    places = np.searchsorted(length, np.linspace(0, length[-1], ALONG) * (1 - 1e-12))
    return sorted({0, len(found) - 1, found.knee, *(int(i) for i in places)})


def _document(found: Front, judged: dict[int, Result], level: Needs, bank: Bank, out: Path | None) -> dict[str, Any]:
    def table_of(names: tuple[str, ...], values: Array) -> dict[str, float]:
        return dict(zip(names, values.tolist(), strict=True))

    space = tuple(q.name for q in bank.space)
    points = [
        {
            "ridge": float(found.ridge[i]),
            "error": float(found.error[i]),
            "worst": float(found.worst[i]),
            "distance": float(found.distance[i]),
            "status": found.status[i],
            "reached": table_of(tuple(found.target), found.reached[i]),
            "predicted": table_of(space, found.predicted[i]),
            "alpha": table_of(bank.names, found.alpha[i]),
        }
        for i in range(len(found))
    ]
    more = found.reduction
    return {
        "target": dict(found.target),
        "knee": found.knee,
        "bends": found.bends,
        "points": points,
        "level": level,
        "judged": [
            {
                "number": i,
                "accepted": result.accepted,
                "failed": _failed(result),
                "besides_target": _failed(result, but="target"),
            }
            for i, result in judged.items()
        ],
        "reduction": None if more is None else _lowered(more),
        "picture": None if out is None else str(out),
    }


def _lowered(more: Reduction) -> dict[str, Any]:
    columns = {name: getattr(more, name).tolist() for name in ("by", "ridge", "error", "distance", "value")}
    points = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    kept = zip(points, more.status, more.efficient.tolist(), strict=True)
    return {
        "name": more.name,
        "unit": more.unit,
        "before": more.before,
        "points": [{**point, "status": status, "efficient": best} for point, status, best in kept],
    }


def _shown(found: Front, judged: dict[int, Result], level: Needs) -> list[RenderableType]:
    names = list(found.target)[:MANY]
    units = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, found.units, strict=False)]
    heads = ("mix", "ridge", "error", "worst", "distance", *units, f"judged by {level}", "")
    rows = []
    for i, result in judged.items():
        sizes = (found.error[i], found.worst[i], found.distance[i])
        rows.append(
            (
                i,
                number(float(found.ridge[i])),
                *(_size(v) for v in sizes),
                *(f"{v:.5g}" for v in found.reached[i, : len(names)]),
                _verdict(result),
                "knee" if found.bends and i == found.knee else "",
            )
        )
    title = f"accuracy against reliability, {len(rows)} of {len(found)} mixes; errors in half ranges of the bank"
    shown: list[RenderableType] = [table(title, heads, rows, right=heads[:-2])]
    return shown if found.reduction is None else [*shown, _costs(found.reduction, float(found.ridge[found.knee]))]


def _costs(more: Reduction, ridge: float) -> RenderableType:
    """Each fraction without a ridge, and with that of the knee."""
    value = f"{more.name} [{more.unit}]" if more.unit else more.name
    heads = ("by", "ridge", value, "lowered by", "error of all else", "distance")
    chosen = [i for i in range(len(more.by)) if more.ridge[i] in (more.ridge.min(), ridge)]
    rows = [
        (
            f"{more.by[i]:.4g}",
            number(float(more.ridge[i])),
            f"{more.value[i]:.5g}",
            f"{1 - more.value[i] / more.before:.4f}",
            *(_size(v) for v in (more.error[i], more.distance[i])),
        )
        for i in chosen
    ]
    return table(f"what lowering {more.name} costs, {number(more.before)} at the reference", heads, rows, right=heads)


def _size(value: float) -> str:
    return "–" if value != value else f"{value if value > NOISE else 0.0:.3g}"


def _verdict(result: Result) -> Text:
    """That targets are missed is what a front is about: it is told only where nothing else is wrong."""
    other = _failed(result, but="target")
    return verdict(result.accepted, "accepted", "misses targets" if other is None else f"rejected by {other}")


def _failed(result: Result, but: str = "") -> str | None:
    return next((check.name for check in result.checks if not check.passed and check.name != but), None)
