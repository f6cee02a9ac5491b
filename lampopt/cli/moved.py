"""`lampopt bank residuals`, `lampopt sensitivities`: how well exemplars are met, and what each parameter moves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np

from lampopt.choices import Value
from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import can_be_written, pairs, spec
from lampopt.cli.show import number, table
from lampopt.errors import InputError
from lampopt.exemplars import exemplars
from lampopt.lamp import load_bank
from lampopt.loop import design
from lampopt.motion import sensitivities as moved_by
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.residuals import residuals as found_by
from lampopt.types import Bank

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command(cls=Command)
@click.argument("file", metavar="BANK", type=FILE)
@click.option("--source", required=True, metavar="NAME", help="Where the bank's exemplars came from.")
@click.option("--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the source; repeatable.")
@click.option("--resolution", type=click.IntRange(4, 4096), default=128, show_default=True, help="Cells along the box.")
def residuals(file: Path, source: str, settings: tuple[str, ...], resolution: int) -> Answer:
    """Tell how far each exemplar's decoded shape is from its mesh, both ways, and where it is worst.

    \b
        lampopt bank residuals cars.lamp --source table --set table=cars.csv --set meshes=stl
    """
    plugins = Plugins.load().report()
    bank = load_bank(file)
    given = exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins)
    with progress_bar("comparing exemplars") as progress:
        found = found_by(bank, given, resolution=resolution, progress=progress, plugins=plugins)
    unit = bank.frame.unit
    document = {
        "bank": str(file),
        "unit": unit,
        "exemplars": [
            {
                "name": one.name,
                "there": one.there,
                "back": one.back,
                "p99": one.p99,
                "worst": one.worst,
                "where": one.where.tolist(),
                "flipped": one.flipped,
            }
            for one in found
        ],
    }
    heads = ("exemplar", f"there [{unit}]", "back", "p99", "worst", "at", "flipped")
    rows = [
        (
            *(one.name, *(f"{x:.3g}" for x in (one.there, one.back, one.p99, one.worst))),
            *(", ".join(f"{x:.3g}" for x in one.where), str(one.flipped)),
        )
        for one in found
    ]
    return Answer(document, [table(f"{len(found)} exemplars", heads, rows, right=heads[1:])])


@click.command(cls=Command)
@click.argument("file", metavar="BANK", type=FILE)
@click.option("--target", "targets", multiple=True, metavar="NAME=VALUE", help="Of the design; repeatable.")
@click.option("--reference", metavar="EXEMPLAR", help="Stay near this exemplar; without --target, it is the design.")
@click.option("--solver", default="kkt", show_default=True, metavar="NAME", help="What chooses the mix.")
@click.option(
    "--out",
    metavar="FOLDER",
    type=click.Path(file_okay=False, path_type=Path),
    help="Where motion.npz and a picture of each parameter are written.",
)
def sensitivities(file: Path, targets: tuple[str, ...], reference: str | None, solver: str, out: Path | None) -> Answer:
    """Tell how the vertices of a design move by each parameter, the others held.

    Needs a decoder that keeps one connectivity, such as mesh-template. Pictures are red where the shape grows.

    \b
        lampopt sensitivities cars.lamp --target roof=1.42 --out moved
    """
    if not targets and reference is None:
        raise InputError("expected --target NAME=VALUE or --reference EXEMPLAR: which design is it about?")
    if out is not None:
        can_be_written("--out", out / "motion.npz")
    plugins = Plugins.load().report()
    bank = load_bank(file)
    wanted: Mapping[str, Value] = pairs("--target", targets) or _itself(bank, str(reference))
    made = design(bank, wanted, reference=reference, solver=solver, level="alpha", plugins=plugins).design
    found = moved_by(bank, made, solver=solver, plugins=plugins)
    lengths = np.linalg.norm(found.motion, axis=2)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        arrays = {f"motion_{i}": motion for i, motion in enumerate(found.motion)}
        np.savez(out / "motion.npz", names=np.array(found.names), vertices=np.asarray(found.mesh.vertices), **arrays)
        for name in found.names:
            found.picture(name, out / f"{name.replace('/', '%2F')}.png")
    unit = bank.frame.unit
    document = {
        "bank": str(file),
        "unit": unit,
        "parameters": [
            {"name": name, "unit": of, "mean": float(each.mean()), "largest": float(each.max())}
            for name, of, each in zip(found.names, found.units, lengths, strict=True)
        ],
        "folder": None if out is None else str(out),
    }
    heads = ("parameter", "by", f"mean motion [{unit}]", "largest")
    rows = [
        (name, f"1 {of}".strip(), number(float(each.mean())), number(float(each.max())))
        for name, of, each in zip(found.names, found.units, lengths, strict=True)
    ]
    return Answer(document, [table("motion of the vertices", heads, rows, right=heads[2:])])


def _itself(bank: Bank, name: str) -> dict[str, float]:
    if name not in bank.names:
        raise InputError(f"--reference {name}: expected one of {', '.join(bank.names[:8])}…")
    row = bank.parameters[bank.names.index(name)]
    return {q.name: float(v) for q, v in zip(bank.space, row, strict=True) if q.spread > 0}
