"""`lampopt label`: exemplars of a bank labelled by a measure, drag by a flow solver perhaps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import can_be_written, crew, pairs, spec
from lampopt.cli.show import number, table
from lampopt.label import label as labelled
from lampopt.lamp import load_bank
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command(cls=Command, resumes="the same command goes on where it stopped")
@click.argument("file", metavar="BANK", type=FILE)
@click.argument("measure", metavar="MEASURE")
@click.option("--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the measure; repeatable.")
@click.option(
    "--value",
    "values",
    multiple=True,
    metavar="LABEL=VALUE",
    help="A value of the measure, and what the label is called; repeatable. Default: all, by their names.",
)
@click.option("--resolution", type=click.IntRange(4, 4096), default=128, show_default=True, help="Of the meshes.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes that measure.")
@click.option("--out", required=True, metavar="FILE", type=FILE, help="The .lamp file to write.")
def label(
    file: Path,
    measure: str,
    settings: tuple[str, ...],
    values: tuple[str, ...],
    resolution: int,
    workers: int,
    out: Path,
) -> Answer:
    """Label the exemplars of a bank by a measure.

    Each is measured as the bank makes it, which is what designs are compared with. One that cannot be measured has no
    label, which is told. The bank is written to a new file; what a measure keeps (flow solutions) lies beside it.

    \b
        lampopt label cars.lamp openfoam-drag --value drag=drag --workers 2 --out labelled.lamp
    """
    can_be_written("--out", out)
    plugins = Plugins.load().report()
    chosen = spec(plugins, "measure", measure, "--set", settings)
    with progress_bar(f"labelling {out}") as progress, crew(workers) as executor:
        made = labelled(
            load_bank(file),
            chosen,
            pairs("--value", values),
            store=out,
            resolution=resolution,
            executor=executor,
            progress=progress,
            plugins=plugins,
        )
    rows: list[list[Any]] = [
        [q.name, q.unit, number(q.low), number(q.high), f"{int(np.isfinite(column).sum())} of {len(made)}"]
        for q, column in zip(made.label_space, made.labels.T, strict=True)
    ]
    document = {
        "bank": str(out),
        "by": measure,
        "labels": {
            q.name: {
                name: None if np.isnan(value) else float(value) for name, value in zip(made.names, column, strict=True)
            }
            for q, column in zip(made.label_space, made.labels.T, strict=True)
        },
        "provenance": {name: value for name, value in made.provenance.items() if name.startswith("labelled.")},
    }
    return Answer(document, [table(f"labels of {out}", ("label", "unit", "low", "high", "known of"), rows)])
