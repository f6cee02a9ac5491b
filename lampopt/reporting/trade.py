"""What is traded for what: two quantities, the accepted designs that none beats in both, and the knee among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lampopt.pareto import knee, pareto
from lampopt.reporting.charts import LETTER, MOST, Axes, Point, ends, number, thinned
from lampopt.reporting.gather import Gathered, Line
from lampopt.reporting.quantities import Quantity, judged, measured, objective
from lampopt.reporting.words import verdict, with_unit
from lampopt.study import Study
from lampopt.types import Array, Bank, Result

FRONT = 300  # designs of the front that are drawn, evenly spread over it, its ends and knee among them
MANY = 400  # marks that are drawn smaller
ROOM = 3.0  # times what the accepted take of an axis that is drawn for the rejected too


@dataclass(frozen=True, eq=False)
class Traded:
    """Two quantities of all designs, a third for colour, and which designs (B,) are where.

    `usable` have both, `front` are those accepted that no other accepted one beats in both, `bend` is the design at
    the front's knee, None where it does not bend.
    """

    x: Quantity
    y: Quantity
    tint: Quantity | None
    accepted: Array
    usable: Array
    front: Array
    bend: int | None

    @classmethod
    def of(cls, x: Quantity, y: Quantity, tint: Quantity | None, accepted: Array) -> Traded:
        """Find the front of the `accepted` (B,), and its knee."""
        costs = np.column_stack([-q.values if q.more else q.values for q in (x, y)])
        usable = x.known & y.known
        front = pareto(np.where((usable & accepted)[:, None], costs, np.nan))
        bend = None
        if front.any():
            at = knee(np.where(front[:, None], costs, np.nan))
            inner = (costs[at] > costs[front].min(0)) & (costs[at] < costs[front].max(0))
            bend = at if inner.all() else None
        return cls(x, y, tint, accepted, usable, front, bend)

    def along(self) -> list[int]:
        """The front's designs from its left end to its right one; of very many some, the knee among them."""
        found = np.flatnonzero(self.front)
        found = found[np.lexsort((self.y.values[found], self.x.values[found]))]
        some = np.linspace(0, len(found) - 1, min(FRONT, len(found))).round().astype(int)
        kept = {*found[some].tolist(), *([] if self.bend is None else [self.bend])}
        return [i for i in found.tolist() if i in kept]

    def ranges(self) -> list[tuple[float, float]]:
        """What is drawn of both axes: all; or, where the rejected lie far out, the accepted and what is around them."""
        return [_range(q.values[self.usable], q.values[self.usable & self.accepted]) for q in (self.x, self.y)]

    def inside(self) -> Array:
        """Which designs (B,) lie in these ranges."""
        found = self.usable.copy()
        for quantity, (low, high) in zip((self.x, self.y), self.ranges(), strict=True):
            found &= (quantity.values >= low) & (quantity.values <= high)
        return np.asarray(found)

    def scale(self) -> tuple[float, float]:
        """Least and largest value of the third quantity among the accepted, which alone are coloured by it."""
        values = np.zeros(0) if self.tint is None else self.tint.values[self.inside() & self.accepted & self.tint.known]
        return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)


def picture(found: Traded, points: Mapping[int, Point], numbers: Sequence[int], said: str) -> str:
    """The chart of the `points`, by the place of their design among all; `numbers` are what designs are called."""
    x_range, y_range = found.ranges()
    title = f"{found.x.name} against {found.y.name}, and the front of the accepted designs"
    chart = Axes(x_range, y_range, found.x.label, found.y.label, title, width=860, height=420, said=said)
    if found.x.limit is not None and x_range[0] < found.x.limit < x_range[1]:
        chart.line((found.x.limit, y_range[0]), (found.x.limit, y_range[1]), "limit")
    if found.y.limit is not None and y_range[0] < found.y.limit < y_range[1]:
        chart.line((x_range[0], found.y.limit), (x_range[1], found.y.limit), "limit")
    along = [points[i] for i in found.along()]
    if len(along) > 1:
        if found.bend is not None:
            chart.line((along[0].x, along[0].y), (along[-1].x, along[-1].y), "agree")
        chart.path([(p.x, p.y) for p in along], "front")
    others = thinned([p for i, p in points.items() if not found.front[i]])
    chart.points(others, 3.6 if len(others) < MANY else 2.4)
    chart.points(along, 5.0)
    if found.bend is not None:
        _pointed_out(chart, points[found.bend], f"knee: design {numbers[found.bend]}", found.y.more)
    return chart.svg()


def _pointed_out(chart: Axes, knee: Point, words: str, above: bool) -> None:
    """A ring around the knee and its name: on the side where no design is better, else on the opposite one."""
    x, y, long = chart.x(knee.x), chart.y(knee.y), len(words) * LETTER
    better = x - 16 - long > chart.left and (y - 26 > chart.top if above else y + 26 < chart.height - chart.bottom)
    chart.parts.append(f'<circle class="knee" cx="{x:.1f}" cy="{y:.1f}" r="10"/>')
    chart.note(words, x - 12 if better else x + 12, y - 15 if above == better else y + 24, "end" if better else "start")


def _range(values: Array, accepted: Array) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if len(accepted):
        least, most = float(accepted.min()), float(accepted.max())
        room = (ROOM - 1) * (most - least) or (high - low)
        low, high = max(low, least - room), min(high, most + room)
    around = 0.05 * (high - low) or abs(high) * 0.1 or 1.0
    return low - around, high + around


def traded(study: Study, bank: Bank, lines: Sequence[Line]) -> Traded | None:
    """The first two quantities that tell the designs of a run apart, and a third for colour; None if there are no two.

    They are sought in this order: with an objective the distance from the centre, the objective, and the error against
    what was asked; else error and distance; then values that the study measures, then the mismatch.
    """
    error, distance, mismatch = (judged(lines, name) for name in ("target", "alpha", "mismatch"))
    goal = objective(study, bank, lines)
    first = [error, distance] if goal is None or not goal.tells else [distance, goal, error]
    values = [q for q in measured(lines) if "." in q.name]  # others are counts
    found = [q for q in (*first, *values, mismatch) if q.tells]
    if len(found) < 2 or (found[0].known & found[1].known).sum() < 2:
        return None
    tint = found[2] if len(found) > 2 else None
    return Traded.of(found[0], found[1], tint, np.array([line.accepted for line in lines]))


def trade(study: Study, bank: Bank, gathered: Gathered, shown: Mapping[int, Result]) -> dict[str, Any] | None:
    """The picture of a run and what is said of it; None where there is nothing to be traded."""
    from markupsafe import Markup

    found = None if gathered.single else traded(study, bank, gathered.lines)
    if found is None:
        return None
    low, high = found.scale()
    points = {int(i): _point(found, int(i), gathered.lines, shown, low, high) for i in np.flatnonzero(found.inside())}
    numbers = [line.number for line in gathered.lines]
    desc = f"{len(points):,} of {len(numbers):,} designs. {_front(found, numbers)}"
    scale = None
    if found.tint is not None and high > low:
        least, most = (f"{text} {found.tint.unit}".rstrip() for text in ends(low, high))
        scale = {"name": found.tint.name, "low": least, "high": most}
    svg = picture(found, points, numbers, desc)
    return {"svg": Markup(svg), "said": _said(found, len(points), numbers), "scale": scale}


def _point(found: Traded, i: int, lines: Sequence[Line], shown: Mapping[int, Result], low: float, high: float) -> Point:
    line, tint = lines[i], None
    told = [(q, float(q.values[i])) for q in (found.x, found.y, found.tint) if q is not None]
    if line.accepted and high > low and not np.isnan(value := told[-1][1]):
        tint = (value - low) / (high - low)
    words = "; ".join(f"{q.name} {with_unit(v, q.unit)}" for q, v in told)
    key, kind = f"d{line.number}" if line.number in shown else "", "ok" if line.accepted else "bad"
    return Point(told[0][1], told[1][1], kind, key, f"design {line.number}: {words}; {verdict(line)}", tint)


def _front(found: Traded, numbers: Sequence[int]) -> str:
    """The front in words."""
    count, accepted = int(found.front.sum()), int((found.usable & found.accepted).sum())
    if not count:
        return "No accepted design has both values, so there is no front."
    if count == 1:
        return f"Design {numbers[found.along()[0]]} is better than any other accepted one in both."
    along = found.along()
    some = f" ({len(along):,} of which are drawn)" if len(along) < count else ""
    told = (
        f"The line joins the {count:,} of {accepted:,} accepted designs that no other accepted one beats in both{some}"
        f", from design {numbers[along[0]]} to design {numbers[along[-1]]}"
    )
    if found.bend is None:
        return f"{told}; it has no knee."
    return f"{told}. Its knee, farthest from the chord between these, is design {numbers[found.bend]}."


def _said(found: Traded, drawn: int, numbers: Sequence[int]) -> str:
    """What the picture shows, and what it leaves out."""
    better = "less is taken as better in both"
    if found.y.more:
        better = f"less of the former is better, and more of {found.y.name}"
    told = [f"Each design's {found.x.name} against its {found.y.name}; {better}. {_front(found, numbers)}"]
    told.append("Discs are accepted, crosses rejected.")
    if found.y.group == "mixed":
        told.append(f"{found.y.name} is as the mix should have it.")
    ranges = zip((found.x, found.y), found.ranges(), strict=True)
    if any(q.limit is not None and low < q.limit < high for q, (low, high) in ranges):
        told.append("Lines across are limits.")
    if (others := drawn - int(found.front.sum())) > MOST:
        told.append(f"{MOST:,} of the {others:,} designs beside the front are drawn, evenly spread over the run.")
    if outside := int(found.usable.sum()) - drawn:
        told.append(f"{_count(outside)} outside of the picture, far from all accepted ones.")
    if unknown := int((~found.usable).sum()):
        told.append(f"{_count(unknown)} left out, having no finite value of one of both.")
    return " ".join(told)


def _count(count: int) -> str:
    return "1 design is" if count == 1 else f"{number(count)} designs are"
