"""The page: what was gathered and drawn, put into the template."""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files
from math import isfinite
from typing import Any

import numpy as np

from lampopt.errors import LampoptError
from lampopt.reporting import charts
from lampopt.reporting.charts import Point, number
from lampopt.reporting.convergence import converged
from lampopt.reporting.figures import Figures, Packed, Shown
from lampopt.reporting.gather import Gathered, Line
from lampopt.reporting.layout import laid_out
from lampopt.reporting.measuring import is_itself, read_back
from lampopt.reporting.parallel import parallel
from lampopt.reporting.render import ABOVE, BELOW, LEVEL, STEEL
from lampopt.reporting.searched import Search
from lampopt.reporting.trade import trade
from lampopt.reporting.words import (
    asked_in_short,
    asked_rows,
    detail,
    facts,
    headline,
    lead,
    no_shape,
    times,
    verdict,
    worst,
)
from lampopt.solve import column, columns
from lampopt.study import Study
from lampopt.types import Array, Bank
from lampopt.units import factor

ROWS = 1000  # of the table of all designs
CURVES = 12  # at most
log = logging.getLogger("lampopt")


def page(run: str, study: Study, bank: Bank, gathered: Gathered, drawn: Figures, search: Search) -> str:
    """The whole report as HTML, the same for the same run; with the steps of its `search`, if it had one."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    style, script, template = (_text(f"page.{form}") for form in ("css", "js", "html"))
    empty = Shown()
    seen = {number: drawn.designs.get(number, empty) for number in gathered.shown}
    lines = {line.number: line for line in gathered.lines}
    swept = [name for name, values in gathered.asked().items() if len(values) > 1]
    first = next((n for n in seen if lines[n].accepted), next(iter(seen)))
    details = {
        n: _marked(detail(bank, f"d{n}", _title(n, gathered), r, seen[n], study)) for n, r in gathered.shown.items()
    }
    curves, any_measured = _curves(study, bank, gathered, seen, swept)
    drawn_names = {curve["name"] for curve in curves}
    meshes = [
        *((f"d{n}", s.packed) for n, s in seen.items()),
        *((f"e{i}", s.packed) for i, s in drawn.exemplars.items()),
    ]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    context: dict[str, Any] = {
        "title": f"{headline(gathered)} – {run}",
        "run": run,
        "headline": headline(gathered),
        "lead": lead(gathered),
        "tally": None if gathered.single else (gathered.accepted, len(gathered.lines) - gathered.accepted),
        "asked": asked_rows(study, bank, gathered),
        "facts": facts(study, bank),
        "single": gathered.single,
        "shapes_note": _shapes_note(study, gathered),
        "cards": [_card(bank, lines[n], seen[n], swept, study) for n in seen],
        "shown_ok": sum(lines[n].accepted for n in seen),
        "first": details[first],
        "details": list(details.values()),
        "beside": [
            {"key": f"e{i}", "name": bank.names[i], "picture": s.pictures[0].plain if s.pictures else ""}
            for i, s in drawn.exemplars.items()
        ],
        "meshes": [{"key": key, "packed": packed} for key, packed in meshes if packed is not None],
        "heat": number(drawn.spread) if drawn.spread is not None else "",
        "gradient": f"linear-gradient(90deg, {', '.join(_css(colour) for colour in (BELOW, LEVEL, ABOVE))})",
        "unit": bank.frame.unit,
        "bar": number(drawn.bar),
        "pixels": drawn.pixels,
        "size": drawn.size,
        "views": drawn.views,
        "curves": curves,
        "any_measured": any_measured,
        "curves_note": _curves_note(swept, [name for name in swept if name not in drawn_names]),
        "parallel": parallel(study, bank, gathered, gathered.shown),
        "trade": trade(study, bank, gathered, gathered.shown),
        "convergence": converged(search.steps, search.label, search.unit),
        "rejections": Markup(_rejections(gathered)),
        "scores": Markup(_scores(gathered, seen)),
        "map": _map(bank, lines, seen, drawn.exemplars),
        **_table(bank, gathered, seen),
        "provenance": [(name, str(value)) for name, value in next(iter(gathered.shown.values())).provenance.items()],
        "version": version("lampopt"),
        "style": Markup(style),
        "script": Markup(script),
        "script_hash": f"sha256-{digest}",
        "config": _config(bank, seen, drawn, first, gathered),
    }
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(context)


def _text(name: str) -> str:
    return files("lampopt.reporting").joinpath(name).read_text(encoding="utf-8")


def _marked(told: dict[str, Any]) -> dict[str, Any]:
    from markupsafe import Markup

    return {**told, "alpha": Markup(told["alpha"])}  # made by charts, which escapes names itself


def _css(colour: Array) -> str:
    return "rgb({} {} {})".format(*(255 * colour).round().astype(int))


def _title(n: int, gathered: Gathered) -> str:
    return "The design" if gathered.single else f"Design {n}"


def _shapes_note(study: Study, gathered: Gathered) -> str:
    if none := no_shape(study):
        return none
    total, shown = len(gathered.lines), len(gathered.shown)
    return f"{shown:,} of {total:,} designs shown, evenly spread over the run." if shown < total else ""


def _card(bank: Bank, line: Line, shown: Shown, swept: list[str], study: Study) -> dict[str, Any]:
    return {
        "key": f"d{line.number}",
        "title": f"Design {line.number}",
        "accepted": line.accepted,
        "picture": shown.pictures[0] if shown.pictures else None,
        "why": shown.why or no_shape(study),
        "shrunk": shown.shrunk,
        "asked": asked_in_short(line, swept, bank),
        "worst": worst(line),
    }


def _point(line: Line, seen: Mapping[int, Shown], x: float, y: float, said: str) -> Point:
    key = f"d{line.number}" if line.number in seen else ""
    kind = "ok" if line.accepted else "bad"
    return Point(x, y, kind, key, f"design {line.number}: {said}; {verdict(line)}")


def _curves(
    study: Study, bank: Bank, gathered: Gathered, seen: Mapping[int, Shown], swept: list[str]
) -> tuple[list[dict[str, Any]], bool]:
    """A chart for each of the first names asked for in several values: measured where it can be, else as mixed."""
    from markupsafe import Markup

    found, any_measured = [], False
    for name in [n for n in swept if n in columns(bank)][:CURVES]:
        values = {line.number: _measured(study, bank, name, line, seen) for line in gathered.lines}
        known = [line for line in gathered.lines if isfinite(values[line.number])]
        measured = bool(known)
        if not known:
            known = [
                line for line in gathered.lines if line.predicted.get(name, float("nan")) == line.predicted.get(name)
            ]
            values = {line.number: line.predicted[name] for line in known}
        known = [line for line in known if name in line.target]
        if not known:
            continue
        any_measured |= measured
        unit, what = columns(bank)[name].unit, "measured" if measured else "mixed"
        points = [
            _point(
                line,
                seen,
                line.target[name],
                values[line.number],
                f"{name} asked {number(line.target[name])}, {what} {number(values[line.number])} {unit}".rstrip(),
            )
            for line in known
        ]
        label = f"{name} [{unit}]" if unit else name
        found_column = column(bank, name)
        span = (found_column.low, found_column.low + found_column.spread)
        svg, r2 = charts.asked_against_found(points, label, what, span, f"{name}: asked against {what}")
        found.append(
            {"svg": Markup(svg), "name": name, "said": _said(study, bank, name, measured, points, gathered, r2)}
        )
    return found, any_measured


def _curves_note(swept: Sequence[str], left: Sequence[str]) -> str:
    """Which names are not drawn, if any."""
    if not left:
        return ""
    return (
        f"{len(swept) - len(left)} of {len(swept)} names asked for in several values are drawn; not: {', '.join(left)}."
    )


def _said(
    study: Study, bank: Bank, name: str, measured: bool, points: list[Point], gathered: Gathered, r2: float
) -> str:
    fit = f"R² {r2:.4f}" if r2 == r2 else "R² needs several values"
    if not measured:
        declared = "what it is declared to be measured by is no measure of the study"
        why = declared if name in study.measured else "the bank declares no measure for it"
        why = why if study.level == "mesh" else "no shape was made"
        return f"is not measured ({why}): what the mix should have. {fit} over {len(points):,} designs."
    short = "" if len(points) == len(gathered.lines) else f" of {len(gathered.lines):,}"
    more = ", those that are drawn and can be measured" if short else ""
    own = name in study.measured or is_itself(bank, name)
    how = "" if own else f" (read back from {bank.measured_by[name]}, which follows it)"
    return f"measured{how} on {len(points):,}{short} designs{more}. {fit} against the line."


def _measured(study: Study, bank: Bank, name: str, line: Line, seen: Mapping[int, Shown]) -> float:
    """What a design has of `name` as its checks report it, else as it was measured for the report, else NaN."""
    shown, own = seen.get(line.number), study.measured.get(name)  # what the study itself declares comes first
    if shown is not None and name in shown.measured and own is None:
        return read_back(bank, name, shown.measured[name], line.predicted)
    address = own or bank.measured_by.get(name, name)
    if "." not in address or address not in line.values:
        return float("nan")
    value, unit = line.values[address]
    try:
        value *= factor(unit, columns(bank)[name].unit, address)
        return value if own else read_back(bank, name, value, line.predicted)
    except LampoptError:  # another unit than the parameter's is nothing to be compared
        return float("nan")


def _rejections(gathered: Gathered) -> str:
    rows = [(name, float(count), f"{count:,}", "bad") for name, count in gathered.rejections()[:16]]
    return charts.bars(rows, "how many designs each check rejects") if rows else ""


def _scores(gathered: Gathered, seen: Mapping[int, Shown]) -> str:
    points = [_point(line, seen, line.number, line.score, worst(line)) for line in gathered.lines]
    return charts.scores(points, "each design's worst check as a part of its limit")


def _map(
    bank: Bank, lines: Mapping[int, Line], seen: Mapping[int, Shown], exemplars: Mapping[int, Shown]
) -> dict[str, Any] | None:
    """Designs and exemplars by how alike their shapes are; None where there is nothing to compare."""
    from markupsafe import Markup

    known = [(n, s) for n, s in exemplars.items() if s.shape is not None]
    made = [(n, s) for n, s in seen.items() if s.shape is not None]
    if len(made) < 2 or len(made) + len(known) < 4:
        return None
    try:
        layout = laid_out([s.shape for _, s in (*known, *made) if s.shape is not None])
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:  # shapes beyond comparison
        log.warning("report: shapes cannot be laid out: %r", error)
        return None
    places = layout.places.tolist()
    points = [
        Point(x, y, "known", f"e{i}", f"exemplar {bank.names[i]}")
        for (i, _), (x, y) in zip(known, places, strict=False)
    ]
    points += [
        _point(lines[n], seen, x, y, worst(lines[n])) for (n, _), (x, y) in zip(made, places[len(known) :], strict=True)
    ]
    svg = charts.map_of_shapes(points, [p.key for p in points], "designs and exemplars by likeness", bank.frame.unit)
    kept = "the plane keeps the distances well" if layout.stress < 0.1 else "a plane cannot keep all the distances"
    said = (
        f"{len(made)} designs (discs accepted, crosses rejected) and {len(known)} of {len(bank)} exemplars (rings). "
        "Near each other are shapes that are alike, by the root mean square difference of their distances at points on "
        f"all of them; laid out by multidimensional scaling. Stress {layout.stress:.2f}: {kept}."
    )
    return {"svg": Markup(svg), "said": said}


def _table(bank: Bank, gathered: Gathered, seen: Mapping[int, Shown]) -> dict[str, Any]:
    """The table of all designs: the first of them where there are very many."""
    known, names = columns(bank), list(gathered.asked())
    labels = [f"{name} [{known[name].unit}]" if name in known and known[name].unit else name for name in names]
    total = len(gathered.lines)
    return {
        "row_names": labels,
        "rows_note": f"The first {ROWS:,} of {total:,}; all are in runs.sqlite." if total > ROWS else "",
        "rows": [
            {
                "key": f"d{line.number}" if line.number in seen else "",
                "number": line.number,
                "asked": [number(line.target.get(name)) for name in names],
                "accepted": line.accepted,
                "worst": line.worst if line.score > 0 else "",
                "score": times(line.score) if line.score > 0 else "",
            }
            for line in gathered.lines[:ROWS]
        ],
    }


def _config(bank: Bank, seen: Mapping[int, Shown], drawn: Figures, first: int, gathered: Gathered) -> dict[str, Any]:
    """What the script needs to know."""
    packed: list[Packed] = [s.packed for s in (*seen.values(), *drawn.exemplars.values()) if s.packed is not None]
    halves = sorted(p.half for p in packed)
    rgb = [(255 * colour).round().astype(int).tolist() for colour in (STEEL, BELOW, LEVEL, ABOVE)]
    return {
        "first": f"d{first}",
        "unit": bank.frame.unit,
        "half": halves[-1]
        if halves and halves[-1] < 2.5 * halves[len(halves) // 2]
        else (halves or [1.0])[len(halves) // 2],
        "plain": rgb[0],
        "colours": rgb[1:],
        "views": [{"name": view.name, "frame": view.frame.tolist()} for view in drawn.views],
        "designs": {
            f"d{n}": {
                "title": _title(n, gathered),
                "reference": None if s.reference is None else f"e{s.reference}",
                "beside": "" if s.reference is None else bank.names[s.reference],
            }
            for n, s in seen.items()
        },
    }
