"""`lampopt bank calibrate`, `bank volume`: limits from a bank's own exemplars, and how far they reach."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click
import numpy as np

from lampopt.calibrate import calibrate as calibrated
from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import can_be_written, numbers, spec
from lampopt.cli.show import number, table
from lampopt.errors import InputError
from lampopt.exemplars import exemplars
from lampopt.extrapolation import extrapolation_volume
from lampopt.lamp import load_bank
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.types import Bank

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command(cls=Command, resumes="the bank is as it was; the same command begins again")
@click.argument("file", metavar="BANK", type=FILE)
@click.option(
    "--tolerance", required=True, metavar="LENGTH", help='Largest mean surface error of a good design: "5 mm".'
)
@click.option("--source", metavar="NAME", help="Where the bank's exemplars came from: their meshes are the truth.")
@click.option("--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the source; repeatable.")
@click.option("--resolution", type=click.IntRange(4, 4096), default=128, show_default=True, help="Cells along the box.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the choice of others.")
@click.option("--out", metavar="FILE", type=FILE, help="The .lamp file to write; by default the bank's own.")
def calibrate(
    file: Path,
    tolerance: str,
    source: str | None,
    settings: tuple[str, ...],
    resolution: int,
    seed: int,
    out: Path | None,
) -> Answer:
    """Set a bank's limits by its own exemplars.

    The outermost third is held out, made from the others and compared with what it is; each check's limit is put where
    the surface's error passes the tolerance. Without --source the truth is what the bank decodes for its exemplars.

    \b
        lampopt bank calibrate cars.lamp --tolerance "5 mm" --source table --set table=cars.csv --set meshes=stl
    """
    if settings and not source:
        raise InputError("--set: belongs to --source, which is missing: name the source whose options these are")
    if out is not None and (out.suffix != ".lamp" or (out.exists() and not (file.exists() and out.samefile(file)))):
        raise InputError(f"--out {out}: expected the name of a new .lamp file, or BANK's own")
    can_be_written("--out", out or file)
    plugins = Plugins.load().report()
    bank = load_bank(file)
    truth = exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins) if source else None
    with progress_bar(f"calibrating {file}") as progress:
        made = calibrated(
            bank,
            tolerance,
            exemplars=truth,
            resolution=resolution,
            seed=seed,
            store=out or file,
            progress=progress,
            plugins=plugins,
        )
    return _shown(made)


def _shown(bank: Bank) -> Answer:
    evidence = bank.calibration
    assert evidence is not None
    unit, good = bank.frame.unit, evidence.good
    known = evidence.errors[~np.isnan(evidence.errors)]
    rows = []
    for k, name in enumerate(evidence.checks):
        values = evidence.values[:, k]
        spans = [_span(values[chosen]) for chosen in (good, ~good)]
        rows.append((name, number(bank.limits.get(name)), *spans))
    document = {
        "bank": str(bank.path),
        "tolerance": evidence.tolerance,
        "unit": unit,
        "designs": len(good),
        "good": int(good.sum()),
        "limits": dict(bank.limits),
        "evidence": {
            "errors": evidence.errors.tolist(),
            "exemplars": [bank.names[i] for i in evidence.exemplars],
            "values": {name: evidence.values[:, k].tolist() for k, name in enumerate(evidence.checks)},
        },
        "against": bank.provenance["calibrated"],
    }
    said = (
        f"{len(good)} designs, {int(good.sum())} of them within {number(evidence.tolerance)} {unit}; their errors are "
        f"{number(float(known.min()))} to {number(float(known.max()))} {unit}"
    )
    heads = ("check", "limit", "on good designs", "on bad ones")
    return Answer(document, [table(str(bank.path), heads, rows, right=("limit",)), said])


def _span(values: np.ndarray) -> str:
    known = values[~np.isnan(values)]
    return f"{number(float(known.min()))} to {number(float(known.max()))}" if len(known) else "–"


@click.command(cls=Command)
@click.argument("file", metavar="BANK", type=FILE)
@click.option("--factor", type=float, default=2.0, show_default=True, help="How far the range is widened.")
@click.option("--count", type=click.IntRange(1), default=10_000, show_default=True, help="Designs that are drawn.")
@click.option("--parameter", "parameters", multiple=True, metavar="NAME", help="One that is asked for; default: all.")
@click.option("--limit", "limits", multiple=True, metavar="CHECK=VALUE", help="A limit of one's own; repeatable.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the draws.")
def volume(
    file: Path, factor: float, count: int, parameters: tuple[str, ...], limits: tuple[str, ...], seed: int
) -> Answer:
    """Tell how much of a widened parameter space a bank reaches safely.

    Designs are drawn from all over it and judged by alpha and by field, without a mesh (the paper's appendix Q).

    \b
        lampopt bank volume cars.lamp --factor 1.5
    """
    plugins = Plugins.load().report()
    with progress_bar(f"drawing from {file}") as progress:
        found = extrapolation_volume(
            load_bank(file),
            factor,
            count,
            parameters=parameters or None,
            limits=numbers("--limit", limits),
            seed=seed,
            progress=progress,
            plugins=plugins,
        )
    rows = [
        ("range factor", number(found.factor)),
        ("parameters", ", ".join(found.parameters)),
        ("designs drawn", f"{found.count:,}"),
        ("pass every check", f"{found.share:.2%} ({found.interval[0]:.2%} to {found.interval[1]:.2%})"),
        ("pass the mismatch alone", f"{found.by_mismatch:.2%}"),
        ("volume reached safely", f"{number(found.ratio)} of the bank's own range"),
        ("rejected by", ", ".join(f"{name} {n:,}" for name, n in found.rejected.items()) or "none"),
    ]
    return Answer({**asdict(found), "ratio": found.ratio}, [table(str(file), ("", ""), rows)])
