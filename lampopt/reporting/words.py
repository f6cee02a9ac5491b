"""What a report says of designs and checks, in words and rows; names come from users and are escaped by the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lampopt.goals import Minimise, Reduce
from lampopt.reporting.charts import bars, number
from lampopt.reporting.figures import Shown
from lampopt.reporting.gather import Gathered, Line, predicted
from lampopt.reporting.measuring import is_itself, read_back
from lampopt.solve import columns
from lampopt.study import Study
from lampopt.types import Bank, Check, Result
from lampopt.units import number as read

BARS = 16  # coefficients drawn
LEAST = 5e-4  # smaller ones are not
STATUS = {
    "exact": "every target is met exactly",
    "inexact": "the targets could be met, but other terms held the mix off",
    "infeasible": "no mix meets all targets together; this is the nearest",
    "failed": "the solver found no answer; this is the nearest",
}


def with_unit(value: float, unit: str) -> str:
    """A value as it is read: "1.42 m"."""
    return f"{number(value)} {unit}".rstrip()


def reason(check: Check) -> str:
    """Why a check rejects, in one line."""
    if check.value != check.value:
        return f"{check.name} cannot be told" + (f": {check.note}" if check.note else "")
    least = {"<=": "at most", ">=": "at least", "=": "exactly"}[check.sense]
    told = f"{check.name} is {with_unit(check.value, check.unit)}, {least} {number(check.limit)} is allowed"
    return told.replace("at least", "but at least").replace("is allowed", "is needed") if check.sense != "<=" else told


def check_row(check: Check) -> dict[str, Any]:
    """One row of a table of checks; `share` is how far its gauge goes (two thirds are the limit), or None."""
    share = check.score
    drawn = check.limit is not None and check.sense != "="
    least = {"<=": "≤ ", ">=": "≥ ", "=": "= ", "info": ""}[check.sense]
    return {
        "name": check.name,
        "value": number(check.value),
        "limit": "" if check.limit is None else least + number(check.limit),
        "unit": check.unit,
        "kind": "info" if check.limit is None else "ok" if check.passed else "bad",
        "said": "for information" if check.limit is None else "passed" if check.passed else "failed",
        "share": min(100.0, 66.6 * share) if drawn else None,
        "part": f"{number(share)} of the limit",
        "note": check.note,
    }


def detail(bank: Bank, key: str, title: str, result: Result, shown: Shown, study: Study) -> dict[str, Any]:
    """All that is told of one design."""
    mix = result.design.mix
    pairs = [(name, a) for name, a in zip(bank.names, mix.alpha.tolist(), strict=True) if abs(a) >= LEAST]
    found = sorted(pairs, key=lambda pair: (-abs(pair[1]), pair[0]))
    rows = [(name, a, f"{a:+.3f}".replace("-", "−"), "minus" if a < 0 else "") for name, a in found[:BARS]]
    rest = len(bank) - len(rows)
    said = [STATUS[mix.status], *([mix.message] if mix.message and mix.status != "exact" else [])]
    more = f" {rest} smaller ones are not drawn." if rest > 0 else ""
    size = float(np.linalg.norm(mix.alpha))
    why = shown.why or ("" if shown.shape is not None else no_shape(study))
    return {
        "key": key,
        "title": title,
        "accepted": result.accepted,
        "reasons": [reason(check) for check in result.checks if not check.passed],
        "why": why,
        "checks": [check_row(check) for check in result.checks],
        "values": _values(bank, result, shown),
        "starred": any(not is_itself(bank, name) for name in shown.measured),
        "alpha": bars(rows, "coefficients of the mix by exemplar", width=520),
        "mix": f"The mix is {mix.status}: {'; '.join(said)}. They sum to 1; ‖alpha‖ is {number(size)}.{more}",
        "reference": None if shown.reference is None else bank.names[shown.reference],
        "pictures": shown.pictures,
    }


def no_shape(study: Study) -> str:
    """Why there is no shape at all, if so."""
    return "" if study.level == "mesh" else f"No shape was made: the study judges by {study.level} alone."


def _values(bank: Bank, result: Result, shown: Shown) -> list[dict[str, str]]:
    """Asked, mixed and measured, what was asked first."""
    asked, mixed = result.design.target, predicted(bank, result.design.mix.alpha)
    known = columns(bank)
    parameters = [q.name for q in (*bank.space, *bank.label_space)]
    return [
        {
            "name": name,
            "unit": known[name].unit,
            "asked": number(asked.get(name)),
            "mixed": number(mixed[name]),
            "measured": _told(bank, name, shown.measured, mixed),
            "span": span(bank, name),
        }
        for name in dict.fromkeys([*(n for n in asked if n in known), *parameters])
    ]


def _told(bank: Bank, name: str, measured: Mapping[str, float], mixed: Mapping[str, float]) -> str:
    """What was measured for a parameter, with a star where it was read back from something else."""
    if name not in measured:
        return "–"
    return number(read_back(bank, name, measured[name], mixed)) + ("" if is_itself(bank, name) else " *")


def span(bank: Bank, name: str) -> str:
    """What the exemplars have of `name`: "1.2 to 1.6"."""
    values = columns(bank)[name].values
    known = values[~np.isnan(values)]
    return f"{number(float(known.min()))} to {number(float(known.max()))}" if len(known) else "–"


def asked_rows(study: Study, bank: Bank, gathered: Gathered) -> list[dict[str, str]]:
    """What was asked, name by name."""
    known, rows = columns(bank), []
    for name, values in gathered.asked().items():
        if len(values) == 1:
            what = number(values[0])
        elif len(values) <= 6:
            what = ", ".join(map(number, values))
        else:
            what = f"{number(values[0])} to {number(values[-1])}, {len(values):,} values"
        if isinstance(study.objective, Reduce) and name == study.objective.name:
            change = "less" if study.objective.by >= 0 else "more"
            what += f", {number(abs(100 * study.objective.by))} % {change} than {study.reference}"
        elif name in study.keep:
            what += f", kept as {'in ' + study.reference if study.reference else 'the mean'}"
        if name in study.hard:
            what += ", exactly"
        rows.append(_asked(name, what, bank, known[name].unit if name in known else ""))
    for name, pair in study.ranges.items():
        unit = known[name].unit if name in known else ""
        ends = [read(end, unit, name) if name in known else end for end in pair]
        low, high = (end if isinstance(end, str) else number(end) for end in ends)
        rows.append(_asked(name, f"between {low} and {high}", bank, unit))
    if isinstance(study.objective, Minimise):
        often = "little" if study.objective.sign > 0 else "much"
        rows.append(_asked(study.objective.name, f"as {often} as can be", bank, ""))
    return rows


def _asked(name: str, what: str, bank: Bank, unit: str) -> dict[str, str]:
    return {"name": name, "what": what, "unit": unit, "span": span(bank, name) if name in columns(bank) else "–"}


def facts(study: Study, bank: Bank) -> list[tuple[str, str]]:
    """What answered: bank, decoder, solver and the like."""
    fit = float(bank.fit_error.mean()) / bank.frame.scale
    found = [
        ("bank", f"{len(bank)} exemplars, {len(bank.space)} parameters, lengths in {bank.frame.unit}"),
        ("decoder", _spec(bank.decoder.name, bank.decoder.options)),
        ("fit error", f"{with_unit(fit, bank.frame.unit)} on average, as the decoder states it"),
        (
            "solver",
            _spec(study.solver, {})
            if isinstance(study.solver, str)
            else _spec(study.solver.name, study.solver.options),
        ),
        ("reference", study.reference or "none: the middle of the bank"),
        (
            "judged by",
            {"mesh": "mix, field and shape", "field": "mix and field, no shape", "alpha": "mix alone, no shape"}[
                study.level
            ],
        ),
    ]
    if study.level == "mesh":
        found.append(("resolution", f"{study.resolution} cells along the decoder's box"))
    if study.measures:
        found.append(("also measured", ", ".join(study.measures)))
    if study.limits:
        found.append(("limits set", ", ".join(f"{name} {number(value)}" for name, value in study.limits.items())))
    return found


def _spec(name: str, options: Mapping[str, object]) -> str:
    return name + (f" ({', '.join(f'{k} {v}' for k, v in options.items())})" if options else "")


def headline(gathered: Gathered) -> str:
    """The verdict in one line."""
    if gathered.single:
        return "The design is accepted" if gathered.accepted else "The design is rejected"
    total, good = len(gathered.lines), gathered.accepted
    if good in (0, total):
        return f"All {total:,} designs are {'accepted' if good else 'rejected'}"
    return f"{good:,} of {total:,} designs {'is' if good == 1 else 'are'} accepted"


def lead(gathered: Gathered) -> str:
    """What stands behind the verdict."""
    if gathered.single:
        (line,) = gathered.lines
        if line.accepted:
            return "Every check passed."
        return f"It fails {len(line.failed)} of its checks: {', '.join(line.failed)}."
    bad, often = len(gathered.lines) - gathered.accepted, gathered.rejections()
    if not bad:
        return "Every check of every design passed."
    each = ", ".join(f"{name} ({count:,})" for name, count in often[:3])
    return f"{bad:,} rejected, most often by {each}." if len(often) > 1 else f"{bad:,} rejected, by {each}."


def asked_in_short(line: Line, swept: list[str], bank: Bank) -> str:
    """What was asked of this design that others were not asked."""
    known = columns(bank)
    return ", ".join(
        f"{name} {with_unit(line.target[name], known[name].unit if name in known else '')}"
        for name in swept
        if name in line.target
    )


def worst(line: Line) -> str:
    """The check nearest to its limit, or beyond."""
    if not line.worst or line.score <= 0:
        return ""
    return f"{line.worst}: {times(line.score)}"


def verdict(line: Line) -> str:
    """Whether it is accepted, and if not, by what."""
    return "accepted" if line.accepted else f"rejected by {', '.join(line.failed)}"


def times(share: float) -> str:
    """A score as a part of the limit."""
    if share == float("inf"):
        return "not met"
    return f"{100 * share:.0f} % of its limit" if share < 2 else f"{number(float(f'{share:.2g}'))} times its limit"
