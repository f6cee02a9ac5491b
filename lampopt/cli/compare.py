"""`lampopt bank compare`: which decoder serves a family, and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from lampopt.cli.answer import DONE, REJECTED, Answer, Command
from lampopt.cli.options import accepted, can_be_written, pairs, spec, with_options
from lampopt.cli.show import number, table
from lampopt.compare import DECODERS
from lampopt.compare import compare as compared
from lampopt.exemplars import exemplars
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.recommend import Compared, Comparison


@click.command(cls=Command, resumes="with --folder the same command goes on where it stopped")
@click.option("--source", required=True, metavar="NAME", help="Where exemplars come from; see `lampopt sources`.")
@click.option("--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the source; repeatable.")
@click.option(
    "--decoder",
    "decoders",
    multiple=True,
    default=DECODERS,
    show_default=True,
    metavar="NAME[:OPTION=VALUE,...]",
    help="One to compare, with its options; repeatable.",
)
@click.option("--solver", default="kkt", show_default=True, metavar="NAME", help="What chooses the mix.")
@click.option(
    "--measured",
    multiple=True,
    metavar="PARAMETER=MEASURE.VALUE",
    help="Which parameter can be measured on a mesh, and how; repeatable.",
)
@click.option("--resolution", type=click.IntRange(4, 4096), default=128, show_default=True, help="Cells along the box.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Same seed, same errors.")
@click.option("--accept", multiple=True, metavar="NAME", help="An exemplar that is meant as it is, or all; repeatable.")
@click.option(
    "--folder",
    metavar="FOLDER",
    type=click.Path(file_okay=False, path_type=Path),
    help="Where the banks are kept, so that the same command goes on there.",
)
def compare(
    source: str,
    settings: tuple[str, ...],
    decoders: tuple[str, ...],
    solver: str,
    measured: tuple[str, ...],
    resolution: int,
    seed: int,
    accept: tuple[str, ...],
    folder: Path | None,
) -> Answer:
    """Tell which decoder serves the exemplars of a source, and why.

    Each is fitted to the inner exemplars, then asked for the outermost third, which it was not shown. What they have to
    beat is the nearest exemplar as it is. Exits 0 if one is recommended, 1 if none is closer than that.

    \b
        lampopt bank compare --source table --set table=cars.csv --set meshes=stl \\
            --decoder mesh-template --decoder sdf-mlp:steps=1000 --folder compared
    """
    if folder is not None:
        can_be_written("--folder", folder / "a.lamp")
    plugins = Plugins.load().report()
    choices = [with_options(plugins, "decoder", "--decoder", text) for text in decoders]
    for choice in choices:
        plugins.make("decoder", choice)  # a wrong option is told before the meshes are read
    found = exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins)
    with progress_bar("comparing decoders") as progress:
        made = compared(
            found,
            choices,
            seed=seed,
            solver=solver,
            resolution=resolution,
            measured=pairs("--measured", measured),
            accept=accepted(accept),
            folder=folder,
            progress=progress,
            plugins=plugins,
        )
    return _shown(made)


def _shown(found: Comparison) -> Answer:
    document = {
        "best": found.best,
        "reason": found.reason,
        "unit": found.unit,
        "inner": list(found.inner),
        "held_out": list(found.held_out),
        "rows": [_row(row, found) for row in found.rows],
    }
    unit = f" [{found.unit}]" if found.unit else ""
    heads = (
        *("decoder", f"held out{unit}", "worst", f"fit error{unit}", "worst fit", "accepted"),
        *("build [s]", "a design [s]", "weights each"),
    )
    title = f"{len(found.held_out)} exemplars held out of {len(found.held_out) + len(found.inner)}"
    shown = table(title, heads, [_cells(row) for row in found.rows], right=heads[1:])
    advice = f"recommended: {found.best}" if found.best else "recommended: none"
    return Answer(document, [shown, advice, found.reason], REJECTED if found.best is None else DONE)


def _row(row: Compared, found: Comparison) -> dict[str, Any]:
    refused = row.refusal is not None
    chosen = None if row.decoder is None else {"name": row.decoder.name, "options": dict(row.decoder.options)}
    return {
        "name": row.name,
        "decoder": chosen,
        "refusal": row.refusal,
        "mean": row.mean,
        "worst": row.worst,
        "errors": None if refused else dict(zip(found.held_out, row.errors.tolist(), strict=True)),
        "fit_error": {
            "mean": row.fit_mean,
            "worst": row.fit_worst,
            "by_exemplar": None if refused else dict(zip(found.inner, row.fit_errors.tolist(), strict=True)),
        },
        "without_surface": row.lost,
        "accepted": row.accepted,
        "build_seconds": row.build_seconds,
        "design_seconds": row.design_seconds,
        "weights": None if refused else row.weights,
        "bank": None if row.bank is None else str(row.bank),
    }


def _cells(row: Compared) -> tuple[str, ...]:
    if row.refusal is not None:
        return (row.name, "refuses", *("–" for _ in range(7)))
    share = "–" if np.isnan(row.accepted) else f"{row.accepted:.0%}"
    errors = [_figures(value) for value in (row.mean, row.worst, row.fit_mean, row.fit_worst)]
    times = [_figures(value) for value in (row.build_seconds, row.design_seconds)]
    return (row.name, *errors, share, *times, number(row.weights))


def _figures(value: float) -> str:
    """Three of them: more would be noise."""
    return "–" if np.isnan(value) else f"{value:.3g}"
