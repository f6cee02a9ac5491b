"""Parallel coordinates: a line a design, over upright axes from what was asked to how it was judged."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any

import numpy as np

from lampopt.reporting.charts import LETTER, drawing, ends, shortened, tag
from lampopt.reporting.gather import Gathered, Line, even
from lampopt.reporting.quantities import Quantity, asked, judged, measured, scored
from lampopt.reporting.words import verdict, with_unit
from lampopt.study import Study
from lampopt.types import Bank, Result

MOST = 400  # lines
AXES, LISTED = 10, 12  # at most; names of others that are told
DENSE = 60  # lines beyond which they are drawn thin
DECADES = 100.0  # times its least value: a judged quantity that spans more has a logarithmic axis
WIDE, TALL = 860, 334  # the chart
SIDE, TOP, LOW = 70, 64, 270  # where the first axis is, and an axis' ends
SMALLER = 6.5  # pixels of a letter at an axis' end
LEVEL = 18  # of names


@dataclass(frozen=True)
class Axis:
    """An upright axis from `low` to `high` [unit]. A design beyond the `limit`, if there is one, is rejected."""

    name: str
    group: str
    low: float
    high: float
    unit: str = ""
    limit: float | None = None
    log: bool = False

    @classmethod
    def of(cls, quantity: Quantity) -> Axis:
        """The axis that all values of `quantity` lie on."""
        low, high = quantity.low, quantity.high
        log = quantity.group == "judged" and 0 < low <= high / DECADES
        return cls(quantity.name, quantity.group, low, high, quantity.unit, quantity.limit, log)

    def y(self, value: float) -> float:
        """Pixels from the top; NaN where the value is."""
        low, high, at = (math.log10(v) if self.log else v for v in (self.low, self.high, value))
        return LOW - (LOW - TOP) * ((at - low) / (high - low) if high > low else 0.5 + 0 * at)


@dataclass(frozen=True)
class Strand:
    """A design in the chart: its values, one an axis, NaN for none; `kind` (ok or bad), `key`, `title` as a mark's."""

    values: tuple[float, ...]
    kind: str
    key: str
    title: str


def parallel_coordinates(axes: Sequence[Axis], strands: Sequence[Strand], title: str, said: str) -> str:
    """The chart of `strands` over `axes`, one at least; a value that is not known leaves a gap."""
    step = (WIDE - 2 * SIDE) / max(len(axes) - 1, 1)
    places = [SIDE + step * i for i in range(len(axes))]
    turns = len(axes) > 1 and max(len(axis.name) for axis in axes) * LETTER > step - 8
    dense = " dense" if len(strands) > DENSE else ""
    lines = "".join(_strand(axes, places, s) for s in sorted(strands, key=lambda s: s.kind))  # the accepted on top
    parts = [
        *(tag("line", _class="axis", x1=x, x2=x, y1=TOP, y2=LOW) for x in places),
        f'<g class="strands{dense}">{lines}</g>',
        *_names(axes, places, step, turns),
        *(_ends(axis, x, step) for axis, x in zip(axes, places, strict=True)),
        *_groups(axes, places),
    ]
    return drawing(WIDE, TALL, title, said, "".join(parts), " parallel", 0.0 if turns else LEVEL)


def _strand(axes: Sequence[Axis], places: Sequence[float], strand: Strand) -> str:
    """The line, in pieces where something is not known, and at its end a disc or a cross."""
    heights = [axis.y(v) if v == v else v for axis, v in zip(axes, strand.values, strict=True)]
    points = list(zip(places, heights, strict=True))
    pieces = [[f"{x:.1f} {y:.1f}" for x, y in piece] for told, piece in groupby(points, lambda p: p[1] == p[1]) if told]
    way = "".join(f"M{'L'.join(piece)}" + ("h0" if len(piece) == 1 else "") for piece in pieces)
    if not way:
        return ""
    x, y = next(point for point in reversed(points) if point[1] == point[1])
    last = (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3"/>'
        if strand.kind == "ok"
        else f'<path d="M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6"/>'
    )
    key = f' data-key="{escape(strand.key)}"' if strand.key else ""
    way = tag("path", _class="way", d=way)
    return f'<g class="mark strand {strand.kind}"{key}>{way}{last}{tag("title", strand.title)}</g>'


def _names(axes: Sequence[Axis], places: Sequence[float], step: float, turns: bool) -> list[str]:
    """Every axis' name above it; on two levels by turns where they would not fit beside each other."""
    room = min((2 if turns else 1) * step - 8, 2 * SIDE - 4) if len(axes) > 1 else 2 * SIDE - 4
    found = []
    for i, (axis, x) in enumerate(zip(axes, places, strict=True)):
        y, log = LEVEL + LEVEL * (i % 2 if turns else 1), " (log)" if axis.log else ""
        text = shortened(axis.name, room - len(log) * LETTER) + log
        name = tag("text", text, _class="label", x=x, y=y, text_anchor="middle")
        found.append(f"<g>{tag('title', f'{axis.name} [{axis.unit}]' if axis.unit else axis.name)}{name}</g>")
    return found


def _ends(axis: Axis, x: float, step: float) -> str:
    """Numbers and unit at both ends, and the limit where it is on the axis."""
    low, high = ends(axis.low, axis.high)
    found = tag("text", _fitted(high, axis.unit, step), _class="end", x=x, y=TOP - 7, text_anchor="middle")
    if axis.low < axis.high:
        found += tag("text", _fitted(low, axis.unit, step), _class="end", x=x, y=LOW + 16, text_anchor="middle")
    if axis.limit is not None and axis.low <= axis.limit <= axis.high and axis.low < axis.high:
        at = axis.y(axis.limit)
        words = tag("title", f"{axis.name}: the limit is {with_unit(axis.limit, axis.unit)}")
        found += f"<g>{tag('line', _class='crossbar', x1=x - 9, x2=x + 9, y1=at, y2=at)}{words}</g>"
    return found


def _fitted(text: str, unit: str, step: float) -> str:
    """A number with its unit where there is room for both; else the axis' name tells it, when it is pointed at."""
    room = min(step - 4, 2 * SIDE - 4) / SMALLER
    whole = f"{text} {unit}".rstrip()
    return whole if len(whole) <= room else text


def _groups(axes: Sequence[Axis], places: Sequence[float]) -> list[str]:
    """What neighbouring axes have in common, in a bracket below them."""
    found = []
    for group, members in groupby(range(len(axes)), lambda i: axes[i].group):
        first, *_, last = [*members] * 2
        a, b, y = places[first] - 26, places[last] + 26, LOW + 28
        found.append(tag("path", _class="bracket", d=f"M{a:.1f} {y - 4}v4H{b:.1f}v-4"))
        found.append(tag("text", group, x=(a + b) / 2, y=y + 16, text_anchor="middle"))
    return found


def parallel(study: Study, bank: Bank, gathered: Gathered, shown: Mapping[int, Result]) -> dict[str, Any] | None:
    """The chart of a run and what is said of it; None where fewer than two quantities tell its designs apart."""
    from markupsafe import Markup

    lines = gathered.lines
    last = judged(lines, "mismatch")
    offered = [*asked(bank, gathered), *measured(lines), judged(lines, "alpha"), last if last.tells else scored(lines)]
    told = [quantity for quantity in offered if quantity.tells]
    if len(lines) < 2 or len(told) < 2:
        return None
    judging = [quantity for quantity in told if quantity.group == "judged"]
    others = [quantity for quantity in told if quantity.group != "judged"]
    kept = [*others[: AXES - len(judging)], *judging]
    strands = [_told(line, kept, line.number in shown) for line in _chosen(lines, shown)]
    title = "designs as lines over what was asked, measured and judged"
    drawn = f"{len(strands):,} of {len(lines):,}" if len(strands) < len(lines) else f"all {len(lines):,}"
    names = ", ".join(f"{q.label} from {' to '.join(ends(q.low, q.high))}" for q in kept)
    desc = f"{drawn} designs, {gathered.accepted:,} accepted, over {len(kept)} axes: {names}."
    svg = parallel_coordinates([Axis.of(quantity) for quantity in kept], strands, title, desc)
    return {"svg": Markup(svg), "said": _said(gathered, offered, kept, drawn, len(strands) < len(lines))}


def _chosen(lines: Sequence[Line], shown: Mapping[int, Result]) -> list[Line]:
    """Those that are shown in full, then others evenly spread over the run."""
    kept = {line.number: line for line in lines if line.number in shown}
    rest = even([line for line in lines if line.number not in shown], max(0, MOST - len(kept)))
    return sorted([*kept.values(), *rest], key=lambda line: line.number)


def _told(line: Line, kept: Sequence[Quantity], full: bool) -> Strand:
    values = tuple(float(quantity.values[line.number - 1]) for quantity in kept)
    pairs = zip(kept, values, strict=True)
    all_of_it = "; ".join(f"{q.name} {with_unit(v, q.unit)}" for q, v in pairs if v == v) + "; " if full else ""
    key, kind = f"d{line.number}" if full else "", "ok" if line.accepted else "bad"
    return Strand(values, kind, key, f"design {line.number}: {all_of_it}{verdict(line)}")


def _said(gathered: Gathered, offered: Sequence[Quantity], kept: Sequence[Quantity], drawn: str, fewer: bool) -> str:
    """What the chart shows, and what it leaves out."""
    found = [
        "Each line is a design, from what was asked on the left to how it was judged on the right. Solid lines that "
        "end in a disc are accepted, dashed ones that end in a cross are rejected; point at one to see it alone, "
        "click it to open it. An axis goes from the least to the largest value of all designs",
    ]
    on = any(q.limit is not None and q.low <= q.limit <= q.high for q in kept)
    found[0] += "; a bar across it is a limit." if on else "."
    which = ": those of the gallery, then others evenly spread over the run" if fewer else ""
    found.append(f"{drawn[0].upper()}{drawn[1:]} designs are drawn{which}.")
    if gaps := int((~np.all([quantity.known for quantity in kept], axis=0)).sum()):
        has = "1 design has" if gaps == 1 else f"{gaps:,} designs have"
        found.append(f"{has} no finite value on some axis, and a gap there.")
    if same := [f"{q.name} {with_unit(q.low, q.unit)}" for q in offered if q.common and not q.tells]:
        found.append(f"Without an axis, because it is the same for all: {_listed(same)}.")
    if rare := [q.name for q in offered if not q.common]:
        found.append(f"Without an axis, because most designs have no value of it: {_listed(rare)}.")
    if more := [q.name for q in offered if q.tells and q not in kept]:
        found.append(f"Without an axis, for want of room: {_listed(more)}.")
    return " ".join(found)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - LISTED:,} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more
