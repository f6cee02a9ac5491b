"""Tables for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from lampopt.types import Bank, Check, Parameter, Result

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

GOOD, BAD = "green", "bold red"
ROUNDING = 1e-12  # of a parameter's largest value: what is less of it is shown as 0


def plain(value: object) -> Text:
    """`value` as text, its styles kept, without what a terminal would obey: names of files may hold anything."""
    from rich.text import Text

    text = value.copy() if isinstance(value, Text) else Text(str(value))
    text.plain = "".join(c if c.isprintable() or c == "\n" else " " for c in text.plain)
    return text


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: Sequence[str] = ()) -> Table:
    """A table of texts as they stand (brackets are units, no markup); the columns in `right` hold numbers."""
    from rich import box
    from rich.table import Table

    shape = box.SIMPLE_HEAD
    made = Table(title=plain(title), title_justify="left", box=shape, pad_edge=False, show_header=any(columns))
    for column in columns:
        made.add_column(plain(column), justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        made.add_row(*(plain(cell) for cell in row))
    return made


def number(value: float | None) -> str:
    """Six figures; a dash for what is not known."""
    return "–" if value is None or value != value else f"{value:.6g}"


def verdict(passed: bool, good: str = "yes", bad: str = "NO") -> Text:
    """`good` or `bad`, in its colour."""
    from rich.text import Text

    return Text(good if passed else bad, style=GOOD if passed else BAD)


def limit(check: Check) -> str:
    """What a check asks for: "<= 0.01 box"."""
    return "" if check.limit is None else f"{check.sense} {number(check.limit)} {check.unit}".rstrip()


def checks(result: Result) -> Table:
    """The evidence about a design."""
    rows = [
        (
            c.name,
            number(c.value),
            c.sense,
            number(c.limit),
            c.unit,
            "" if c.limit is None else verdict(c.passed),
            c.note,
        )
        for c in result.checks
    ]
    columns = ("check", "value", "sense", "limit", "unit", "passed", "note")
    return table("checks", columns, rows, right=("value", "limit"))


def predicted(result: Result, bank: Bank) -> Table:
    """What the design's parameters and the labels asked should be, beside what was asked and what the bank spans."""
    asked, alpha = result.design.target, result.design.mix.alpha
    rows = [
        (q.name, number(asked.get(q.name)), number(_unrounded(float(value), q)), q.unit, span(q.low, q.high))
        for q, value in zip(bank.space, result.design.predicted, strict=True)
    ]
    for q, values in zip(bank.label_space, bank.labels.T, strict=True):
        if q.name in asked:
            mixed = float(alpha[alpha != 0] @ values[alpha != 0])
            rows.append(
                (f"{q.name} (as labels mix)", number(asked[q.name]), number(mixed), q.unit, span(q.low, q.high))
            )
    columns = ("parameter", "asked", "predicted", "unit", "in the bank")
    return table("parameters", columns, rows, right=("asked", "predicted"))


def _unrounded(value: float, parameter: Parameter) -> float:
    """0 where a value is what rounding leaves of it."""
    size = max(abs(end) for end in (parameter.low or 0.0, parameter.high or 0.0))
    return 0.0 if abs(value) <= ROUNDING * size else value


def span(low: float | None, high: float | None) -> str:
    """A range, "1.2 to 1.6"."""
    return f"{number(low)} to {number(high)}"
