"""What `lampopt make` may ask for besides targets: options, and the fields of a Study that they stand for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from math import inf
from typing import Any, TypeVar

import click

from lampopt.choices import Value
from lampopt.cli.options import number, numbers, pairs
from lampopt.errors import InputError
from lampopt.goals import Maximise, Minimise, Objective, Reduce
from lampopt.safeguards import NAMES as SAFE

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS = (
    click.option("--hard", multiple=True, metavar="NAME", help="A target that has to be met exactly; repeatable."),
    click.option(
        "--weight",
        "weights",
        multiple=True,
        metavar="NAME=NUMBER",
        help="What a missed target weighs beside the others, 1 by default; repeatable.",
    ),
    click.option(
        "--range",
        "ranges",
        multiple=True,
        metavar="NAME=LOW:HIGH",
        help='Keep NAME between two values, each in the bank\'s unit or with its own: ramp=8:16, "roof=:1420 mm" for '
        "no low end. Repeatable.",
    ),
    click.option(
        "--reduce", metavar="NAME=FRACTION", help="Ask for less of NAME than the reference has: drag=0.1 for 0.9 of it."
    ),
    click.option("--minimise", metavar="NAME", help="As little as can be of a label, a model's or a measure's value."),
    click.option("--maximise", metavar="NAME", help="As much as can be."),
    click.option(
        "--model",
        "models",
        multiple=True,
        metavar="NAME=FILE",
        help="A model whose values can be asked for as NAME.VALUE; repeatable.",
    ),
    click.option(
        "--measured",
        multiple=True,
        metavar="NAME=MEASURE.VALUE",
        help="Which measured value tells an asked one, besides what the bank declares; repeatable.",
    ),
    click.option(
        "--safe",
        multiple=True,
        type=click.Choice(SAFE),
        help="A check that the solver has to keep within its limit; repeatable.",
    ),
    click.option("--alpha", metavar="LOW:HIGH", help="Lowest and highest coefficient: 0:1 stays between exemplars."),
    click.option(
        "--ridge",
        type=float,
        metavar="NUMBER",
        help="Weight of the distance from the reference; by default the solver's.",
    ),
    click.option(
        "--norm",
        type=click.IntRange(1, 2),
        default=2,
        show_default=True,
        help="In which it is taken; 1 for few exemplars that change.",
    ),
    click.option(
        "--turns",
        type=click.IntRange(0, 100),
        default=0,
        show_default=True,
        help="How often what was made is measured and the ask corrected.",
    ),
)


def wishes(command: F) -> F:
    """Give `command` these options."""
    return reduce(lambda made, option: option(made), reversed(OPTIONS), command)


def fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """The study's fields that the options ask for.

    Raises
    ------
    InputError
        Naming the option, if one has another form, or two ask for different objectives.
    """
    alpha = None if given["alpha"] is None else _ends("--alpha", "alpha", given["alpha"])
    return {
        "hard": given["hard"],
        "weights": numbers("--weight", given["weights"]),
        "ranges": {name: _ends("--range", name, text) for name, text in pairs("--range", given["ranges"]).items()},
        "objective": _objective(given),
        "models": pairs("--model", given["models"]),
        "measured": pairs("--measured", given["measured"]),
        "safe": given["safe"],
        "alpha": None if alpha is None else tuple(_end("--alpha", end) for end in alpha),
        "ridge": given["ridge"],
        "norm": given["norm"],
        "turns": given["turns"],
    }


def _objective(given: Mapping[str, Any]) -> Objective | None:
    named = [name for name in ("reduce", "minimise", "maximise") if given[name] is not None]
    if len(named) > 1:
        raise InputError(f"--{named[0]}: expected one objective, got --{named[1]} too: leave one out")
    if given["reduce"] is not None:
        ((name, by),) = numbers("--reduce", [given["reduce"]]).items()
        return Reduce(name, by)
    if given["minimise"] is not None:
        return Minimise(given["minimise"])
    return None if given["maximise"] is None else Maximise(given["maximise"])


def _ends(option: str, name: str, text: str) -> tuple[Value, Value]:
    """LOW:HIGH as two values; ±inf where one is left out."""
    ends: Sequence[str] = [end.strip() for end in text.split(":")]
    if len(ends) != 2 or not any(ends):
        wanted = "LOW:HIGH" if name == "alpha" else f"{name}=LOW:HIGH"
        raise InputError(f"{option}: expected {wanted}, one of the two perhaps left out, got {text!r}")
    return ends[0] or -inf, ends[1] or inf


def _end(option: str, value: Value) -> float:
    return value if isinstance(value, float) else number(option, str(value))
