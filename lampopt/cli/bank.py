"""`lampopt bank build`, `add`, `enrich`, `remove`, `compress`, `info`: exemplars in and out, and what is in a bank."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from lampopt.bank import build_bank
from lampopt.cli.answer import Answer, Group
from lampopt.cli.options import accepted, can_be_written, pairs, spec
from lampopt.cli.show import number, span, table
from lampopt.compress import compress as compressed
from lampopt.enrich import enrich as enriched
from lampopt.errors import InputError
from lampopt.exemplars import exemplars
from lampopt.lamp import load_bank, store_bank
from lampopt.members import add_exemplars, remove_exemplars
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.types import Bank

_file = click.argument("file", metavar="BANK", type=click.Path(dir_okay=False, path_type=Path))
_source = click.option(
    "--source", required=True, metavar="NAME", help="Where exemplars come from; see `lampopt sources`."
)
_settings = click.option(
    "--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the source; repeatable."
)
_accept = click.option(
    "--accept", multiple=True, metavar="NAME", help="An exemplar that is meant as it is, or all; repeatable."
)
_out = click.option(
    "--out", required=True, metavar="FILE", type=click.Path(dir_okay=False, path_type=Path), help="The .lamp file."
)


@click.group(cls=Group)
def bank() -> None:
    """Build a bank from exemplars, change it, or see what is in one."""


@bank.command(resumes="the same command goes on where it stopped")
@_source
@_settings
@click.option(
    "--decoder",
    default="mesh-template",
    show_default=True,
    metavar="NAME",
    help="What fits them; see `lampopt options decoder`.",
)
@click.option(
    "--decoder-set", "decoder_settings", multiple=True, metavar="OPTION=VALUE", help="An option of the decoder."
)
@click.option(
    "--measured",
    multiple=True,
    metavar="PARAMETER=MEASURE.VALUE",
    help="Which parameter can be measured on a mesh, and how: length=extents.length. Repeatable.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Same seed, same bank.")
@click.option("--batch", type=click.IntRange(1), default=8, show_default=True, help="Exemplars fitted together.")
@_accept
@_out
def build(
    source: str,
    settings: tuple[str, ...],
    decoder: str,
    decoder_settings: tuple[str, ...],
    measured: tuple[str, ...],
    seed: int,
    batch: int,
    accept: tuple[str, ...],
    out: Path,
) -> Answer:
    """Build a bank from the exemplars of a source.

    They are fitted by one decoder from one shared start.

    An interrupted build of the same inputs goes on where it stopped; a finished one is only read.

    \b
        lampopt bank build --source table --set table=cars.csv --set meshes=stl --out cars.lamp
    """
    can_be_written("--out", out)
    plugins = Plugins.load().report()
    chosen = spec(plugins, "decoder", decoder, "--decoder-set", decoder_settings)
    plugins.make("decoder", chosen)  # a wrong option is told before the meshes are read
    found = exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins)
    with progress_bar(f"building {out}") as progress:
        made = build_bank(
            found,
            chosen,
            seed=seed,
            store=out,
            measured=pairs("--measured", measured),
            batch=batch,
            accept=accepted(accept),
            progress=progress,
            plugins=plugins,
        )
    return _described(made)


@bank.command(resumes="the same command goes on where it stopped")
@_file
@_source
@_settings
@_accept
@_out
def add(file: Path, source: str, settings: tuple[str, ...], accept: tuple[str, ...], out: Path) -> Answer:
    """Add the exemplars of a source to a bank.

    Only they are fitted, from the bank's own start; those that are there keep their weights. The bank is written to a
    new file.

    \b
        lampopt bank add cars.lamp --source table --set table=more.csv --set meshes=stl --out more.lamp
    """
    can_be_written("--out", out)
    plugins = Plugins.load().report()
    before = load_bank(file)
    found = exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins)
    with progress_bar(f"building {out}") as progress:
        made = add_exemplars(before, found, store=out, accept=accepted(accept), progress=progress, plugins=plugins)
    return _described(made)


@bank.command(resumes="the same command goes on where it stopped")
@_file
@click.argument("folder", metavar="FOLDER", type=click.Path(file_okay=False, path_type=Path))
@click.argument("names", metavar="[DESIGN]...", nargs=-1)
@click.option(
    "--leave-out",
    multiple=True,
    metavar="DESIGN",
    help="One that does not join, or rejected: all that were; repeatable.",
)
@click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="NAME=MEASURE.VALUE",
    help="A label of theirs, by what is measured; repeatable. Others are not known.",
)
@_accept
@_out
def enrich(
    file: Path,
    folder: Path,
    names: tuple[str, ...],
    leave_out: tuple[str, ...],
    labels: tuple[str, ...],
    accept: tuple[str, ...],
    out: Path,
) -> Answer:
    """Add accepted designs of a run folder to a bank.

    Each DESIGN is a folder's name in FOLDER/designs; without any, all of the last study join. Only they are fitted;
    parameters are as measured where the bank tells how, else as predicted. Where they come from is kept in the bank,
    which is written to a new file.

    \b
        lampopt bank enrich cars.lamp runs/roof --leave-out rejected --out richer.lamp
    """
    can_be_written("--out", out)
    plugins = Plugins.load().report()
    with progress_bar(f"building {out}") as progress:
        made = enriched(
            load_bank(file),
            folder,
            store=out,
            only=names,
            leave_out=leave_out,
            labels=pairs("--label", labels),
            accept=accepted(accept),
            progress=progress,
            plugins=plugins,
        )
    return _described(made)


@bank.command()
@_file
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@_out
def remove(file: Path, names: tuple[str, ...], out: Path) -> Answer:
    """Take exemplars from a bank.

    Nothing is fitted; those that stay keep their weights. The bank is written to a new file.

    \b
        lampopt bank remove cars.lamp car_007 car_012 --out fewer.lamp
    """
    can_be_written("--out", out)
    return _described(remove_exemplars(load_bank(file), names, store=out))


@bank.command()
@_file
@click.option(
    "--error", required=True, metavar="LENGTH", help='How far decoders\' values may change on average: "0.1 mm".'
)
@_out
def compress(file: Path, error: str, out: Path) -> Answer:
    """Store a bank's weights by few directions.

    As few as keep what the exemplars' decoders say within --error; the bank says how far off they are. The file is
    smaller, mixes take less time. Limits that were calibrated are dropped. Networks gain little, moved templates much.

    \b
        lampopt bank compress cars.lamp --error "0.2 mm" --out small.lamp
    """
    can_be_written("--out", out)
    if out.exists():
        raise InputError(f"--out {out}: is there already, and is not replaced: name another file")
    out.parent.mkdir(parents=True, exist_ok=True)
    plugins = Plugins.load().report()
    before = load_bank(file)
    with progress_bar(f"compressing {file}") as progress:
        made = store_bank(compressed(before, error, plugins=plugins, progress=progress), out)
    answer = _described(made)
    facts = {name: made.provenance[f"low_rank.{name}"] for name in ("rank", "error", "worst")}
    said = (
        f"{facts['rank']} directions of {len(made)} exemplars: {number(float(facts['error']))} {made.frame.unit} off "
        f"on average, {number(float(facts['worst']))} at most; "
        f"{before.weights.nbytes:,} → {made.weights.nbytes:,} bytes"
    )
    return replace(answer, shown=[*answer.shown, said])


@bank.command()
@_file
def info(file: Path) -> Answer:
    """Show what is in a bank.

    Parameters with their ranges and units, labels, the decoder, fit errors in the bank's unit, where it comes from.
    """
    return _described(load_bank(file))


def _described(bank: Bank) -> Answer:
    errors = bank.fit_error / bank.frame.scale  # [box] → the user's unit
    worst = int(errors.argmax())
    parameters: list[dict[str, Any]] = [
        {"name": q.name, "unit": q.unit, "low": q.low, "high": q.high, "measured_by": bank.measured_by.get(q.name)}
        for q in bank.space
    ]
    labels: list[dict[str, Any]] = [
        {"name": q.name, "unit": q.unit, "low": q.low, "high": q.high, "known": int((~np.isnan(column)).sum())}
        for q, column in zip(bank.label_space, bank.labels.T, strict=True)
    ]
    document: dict[str, Any] = {
        "bank": str(bank.path),
        "exemplars": len(bank),
        "weights": bank.weights.shape[1],
        "unit": bank.frame.unit,
        "decoder": {"name": bank.decoder.name, "options": dict(bank.decoder.options)},
        "parameters": parameters,
        "labels": labels,
        "fit_error": {
            "unit": bank.frame.unit,
            "mean": float(errors.mean()),
            "worst": float(errors[worst]),
            "worst_exemplar": bank.names[worst],
            "by_exemplar": {name: float(e) for name, e in zip(bank.names, errors, strict=True)},
        },
        "probes": len(bank.probes),
        "measured_by": dict(bank.measured_by),
        "mesh_facts": dict(bank.mesh_facts),
        "limits": dict(bank.limits),
        "provenance": dict(bank.provenance),
    }
    unit = bank.frame.unit
    facts = [
        ("exemplars", len(bank)),
        ("weights each", bank.weights.shape[1]),
        ("decoder", _listed({"": bank.decoder.name, **bank.decoder.options})),
        (
            "fit error",
            f"mean {number(errors.mean())} {unit}, worst {number(errors[worst])} {unit} ({bank.names[worst]})",
        ),
        ("probes", len(bank.probes)),
        ("every mesh has", _listed(bank.mesh_facts) or "nothing in common"),
        ("own limits", _listed(bank.limits) or "none"),
    ]
    shown = [
        table(str(bank.path), ("", ""), facts),
        table("comes from", ("", ""), bank.provenance.items()),
        table(
            "parameters",
            ("parameter", "unit", "range", "measured by"),
            [(p["name"], p["unit"], span(p["low"], p["high"]), p["measured_by"] or "") for p in parameters],
        ),
    ]
    if labels:
        rows = [(q["name"], q["unit"], span(q["low"], q["high"]), f"{q['known']} of {len(bank)}") for q in labels]
        shown.append(table("labels", ("label", "unit", "range", "known of"), rows))
    return Answer(document, shown)


def _listed(values: Any) -> str:
    return ", ".join(f"{name}={value}" if name else str(value) for name, value in values.items())
