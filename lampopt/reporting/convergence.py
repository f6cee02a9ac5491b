"""How a search converged: the objective of every evaluation in its turn, and the best feasible one so far."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from lampopt.reporting.charts import LETTER, Axes, Point, number, thinned
from lampopt.reporting.gather import Evaluation
from lampopt.reporting.quantities import BEYOND
from lampopt.reporting.words import with_unit

DECADES = 100.0  # times its least value: an objective that spans more has a logarithmic axis
LEAST = 1e-300  # that a logarithm is drawn of: below it decades cannot be told
STEPS = 800  # of the line that are drawn


def bests(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    """Those that were better than all before them, of those that are feasible and finite."""
    found: list[Evaluation] = []
    for one in evaluations:
        if one.feasible and _finite(one) and (not found or one.value < found[-1].value):
            found.append(one)
    return found


def convergence(evaluations: Sequence[Evaluation], label: str, title: str, said: str, unit: str = "") -> str:
    """The chart; what has no finite value is left out. "" if that leaves nothing."""
    known = [one for one in evaluations if _finite(one)]
    if not known:
        return ""
    values, numbers = [one.value for one in known], [one.number for one in known]
    low, high = min(values), max(values)
    log = LEAST <= low <= high / DECADES
    around = 0.06 * (high - low) or abs(high) * 0.1 or 1.0
    y_range = (low - 2.5 * around, high + around)  # below there is room for words
    if log:
        y_range = (10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)))
    first, last = min(numbers), max(numbers)
    side = max(0.02 * (last - first), 0.5)
    name = f"{label} [{unit}]" if unit else label
    chart = Axes(
        (first - side, last + side), y_range, "evaluation", name, title, width=860, height=320, log=log, said=said
    )
    chart.points(thinned([_point(one, unit) for one in known]), 3.0)
    if best := bests(evaluations):
        chart.path(_stairs(best, last), "best")
        _pointed_out(chart, best[-1], unit)
    return chart.svg()


def _finite(one: Evaluation) -> bool:
    return abs(one.value) < BEYOND


def _point(one: Evaluation, unit: str) -> Point:
    said = "feasible" if one.feasible else f"infeasible by {number(one.violation)}"
    title = f"evaluation {one.number}: {with_unit(one.value, unit)}, {said}, {number(one.seconds)} s"
    return Point(one.number, one.value, "ok" if one.feasible else "bad", "", title)


def _stairs(best: Sequence[Evaluation], last: int) -> list[tuple[float, float]]:
    """Corners of the best so far, which holds until there is a better one: where they crowd, the best of each crowd."""
    apart = (last - best[0].number) / STEPS
    kept: list[Evaluation] = []
    for one in best:
        if len(kept) > 1 and one.number - kept[-2].number < apart:
            kept[-1] = one
        else:
            kept.append(one)
    corners: list[tuple[float, float]] = []
    for one in kept:
        corners += [(one.number, corners[-1][1])] if corners else []
        corners.append((one.number, one.value))
    return [*corners, (last, kept[-1].value)]


def _pointed_out(chart: Axes, best: Evaluation, unit: str) -> None:
    """A ring around the best, and its value."""
    words = f"best: {with_unit(best.value, unit)}, evaluation {best.number:,}"
    x, y = chart.x(best.number), chart.y(best.value)
    left = x + 14 + len(words) * LETTER > chart.width - chart.right
    chart.parts.append(f'<circle class="knee" cx="{x:.1f}" cy="{y:.1f}" r="8"/>')
    up = y + 26 > chart.height - chart.bottom
    chart.note(words, x - 12 if left else x + 12, y - 13 if up else y + 22, "end" if left else "start")


def converged(evaluations: Sequence[Evaluation], label: str, unit: str = "") -> dict[str, Any] | None:
    """The chart of a search and what is said of it; None where nothing was searched."""
    from markupsafe import Markup

    if not evaluations:
        return None
    title = f"{label} by evaluation, and the best so far"
    said = _said(evaluations, label, unit)
    return {"svg": Markup(convergence(evaluations, label, title, said, unit)), "said": said}


def _said(evaluations: Sequence[Evaluation], label: str, unit: str) -> str:
    feasible, unknown = sum(one.feasible for one in evaluations), sum(not _finite(one) for one in evaluations)
    count, best = len(evaluations), bests(evaluations)
    took = math.fsum(one.seconds for one in evaluations if math.isfinite(one.seconds))
    told = [f"{count:,} evaluations in {number(took)} s, {feasible:,} of them feasible (discs; crosses are not)."]
    if best:
        told.append(
            f"The line is the best feasible {label} so far: from {with_unit(best[0].value, unit)} to "
            f"{with_unit(best[-1].value, unit)}, at evaluation {best[-1].number:,}."
        )
    else:
        told.append("None is feasible and finite, so there is no best.")
    if unknown:
        told.append(f"{unknown:,} without a finite value {'is' if unknown == 1 else 'are'} left out.")
    return " ".join(told)
