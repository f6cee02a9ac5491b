"""`lampopt surrogate fit`, `model fit`, `model predict`: what is learned from exemplars, and what a model says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from lampopt.check import LEVEL
from lampopt.cli.answer import Answer, Group
from lampopt.cli.options import can_be_written, numbers, spec
from lampopt.cli.show import number, table
from lampopt.errors import InputError
from lampopt.exemplars import exemplars
from lampopt.fitted import fit_model, fit_surrogate, load_model
from lampopt.lamp import load_bank
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.protocols import CrossValidated, Measure, Model, Uncertain
from lampopt.types import Bank, Exemplars

FILE = click.Path(dir_okay=False, path_type=Path)
_settings = click.option(
    "--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the source; repeatable."
)
_options = click.option("--option", "options", multiple=True, metavar="OPTION=VALUE", help="One of NAME; repeatable.")
_seed = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Same seed, same answers.")
_out = click.option("--out", required=True, metavar="FILE", type=FILE, help="The file to write.")


@click.group(cls=Group)
def surrogate() -> None:
    """Learn a measure from shapes whose values are known."""


@surrogate.command("fit")
@click.argument("name")
@click.option("--source", required=True, metavar="SOURCE", help="Where exemplars come from; see `lampopt sources`.")
@_settings
@_options
@click.option("--for", "names", multiple=True, metavar="NAME", help="Parameter or label to be told; default: all.")
@_seed
@_out
def fit_measure(
    name: str,
    source: str,
    settings: tuple[str, ...],
    options: tuple[str, ...],
    names: tuple[str, ...],
    seed: int,
    out: Path,
) -> Answer:
    """Learn a measure from the exemplars of a source.

    NAME is a surrogate; `lampopt plugins` lists them. The file is measured with as `lampopt measure learned`.

    \b
        lampopt surrogate fit pointnet-lasso --source car --set count=200 --for length --out length.measure
        lampopt measure learned car.stl --set file=length.measure
    """
    can_be_written("--out", out)
    plugins = Plugins.load().report()
    chosen = spec(plugins, "surrogate", name, "--option", options)
    plugins.make("surrogate", chosen)  # a wrong option is told before the meshes are read
    found = exemplars(spec(plugins, "source", source, "--set", settings), plugins=plugins)
    with progress_bar(f"learning {out}") as progress:
        made = fit_surrogate(found, chosen, names, seed=seed, store=out, progress=progress, plugins=plugins)
    return _told(made, name, out, len(found))


@click.group(cls=Group)
def model() -> None:
    """Learn labels from parameters, and ask for them."""


@model.command("fit")
@click.argument("name", default="best")
@click.option("--bank", "bank", metavar="BANK", type=FILE, help="A bank that has parameters and labels; or")
@click.option("--source", metavar="SOURCE", help="where exemplars come from; see `lampopt sources`.")
@_settings
@_options
@click.option("--label", "labels", multiple=True, metavar="LABEL", help="One to be told; default: all.")
@click.option("--input", "inputs", multiple=True, metavar="PARAMETER", help="One it may use; default: all that vary.")
@_seed
@_out
def fit_labels(
    name: str,
    bank: Path | None,
    source: str | None,
    settings: tuple[str, ...],
    options: tuple[str, ...],
    labels: tuple[str, ...],
    inputs: tuple[str, ...],
    seed: int,
    out: Path,
) -> Answer:
    """Learn labels such as drag from parameters.

    NAME is a model; `lampopt plugins` lists them. `best` is the one that tells held-out exemplars best.

    \b
        lampopt model fit best --bank cars.lamp --label drag --out drag.model
        lampopt model predict drag.model --at roof=1.4 --at ramp=12
    """
    if (bank is None) == (source is None):
        raise InputError("expected --bank or --source, one of them")
    if settings and not source:
        raise InputError("--set: belongs to --source, which is missing: name the source whose options these are")
    can_be_written("--out", out)
    plugins = Plugins.load().report()
    chosen = spec(plugins, "model", name, "--option", options)
    known: Bank | Exemplars
    if bank is not None:
        known = load_bank(bank)
    else:
        known = exemplars(spec(plugins, "source", str(source), "--set", settings), plugins=plugins)
    made = fit_model(known, chosen, labels, inputs=inputs, seed=seed, store=out, plugins=plugins)
    return _told(made, name, out, len(known.names))


@model.command("predict")
@click.argument("file", type=FILE)
@click.option("--at", "values", multiple=True, metavar="PARAMETER=VALUE", help="In the unit it was learned in.")
def predict(file: Path, values: tuple[str, ...]) -> Answer:
    """Tell what a fitted model says at some parameters.

    \b
        lampopt model predict drag.model --at roof=1.4 --at ramp=12
    """
    found, given = load_model(file), numbers("--at", values)
    missing, unknown = sorted(set(found.inputs) - set(given)), sorted(set(given) - set(found.inputs))
    if missing or unknown:
        wrong = [
            f"{what} are {', '.join(names)}" for what, names in (("missing", missing), ("unknown", unknown)) if names
        ]
        raise InputError(f"--at: expected {', '.join(found.inputs)}; {'; '.join(wrong)}")
    at = np.array([[given[name] for name in found.inputs]])
    told = dict(zip(found.names, np.asarray(found(at))[0].tolist(), strict=True))
    units = dict(zip(found.names, found.units, strict=True))
    document: dict[str, Any] = {
        "model": str(file),
        "at": given,
        "values": {name: {"value": value, "unit": units[name]} for name, value in told.items()},
    }
    heads, warned = ["label", "value", "unit"], []
    rows = [[name, number(value), units[name]] for name, value in told.items()]
    if isinstance(found, Uncertain):
        document["outside"] = bool(found.outside(at)[0])
        heads.append(f"{LEVEL:.0%} interval")
        for row, name, (low, high) in zip(rows, told, found.interval(at, LEVEL)[0].tolist(), strict=True):
            document["values"][name]["interval"] = [low, high]
            row.append(f"{number(low)} to {number(high)}")
        if document["outside"]:
            warned = ["outside what the model was fitted to: neither value nor interval is to be trusted"]
    return Answer(document, [table(str(file), heads, rows, right=("value",)), *warned])


def _told(made: Measure | Model, name: str, out: Path, count: int) -> Answer:
    evidence = made.cross_validated if isinstance(made, CrossValidated) else {}
    known: dict[str, dict[str, Any]] = {
        value: {"unit": unit, **evidence.get(value, {})} for value, unit in zip(made.names, made.units, strict=True)
    }
    rows = [(v, number(k.get("r2")), number(k.get("mean_absolute_error")), k["unit"]) for v, k in known.items()]
    heads = ("told", "R², held out", "mean error, held out", "unit")
    shown = table(f"{out}: {name} on {count} exemplars", heads, rows, right=heads[1:3])
    return Answer({"file": str(out), "by": name, "exemplars": count, "told": known}, [shown])
