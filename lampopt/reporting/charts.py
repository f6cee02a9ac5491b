"""Charts as inline SVG: they follow the page's colours, light and dark, and can be pointed at."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

ORDER = ("bad", "known", "ok")  # the accepted on top
MOST = 1500  # points drawn; figures are over all
DUST = 1e-12  # smaller values are shown as 0
LETTER, VALUE = 7.4, 54  # pixels that a letter, and that a figure beside its bar, may take
CAP = 100.0  # a score beyond it is drawn there


@dataclass(frozen=True)
class Point:
    """A design or exemplar in a chart; `kind` is ok, bad or known, `key` what pointing at it shows, "" for nothing.

    `tint` is how far up the scale of colours it is, 0 to 1; None: its kind tells the colour.
    """

    x: float
    y: float
    kind: str
    key: str
    title: str
    tint: float | None = None


def number(value: float | None, figures: int = 4) -> str:
    """Four figures, whole from 10,000 on; a dash for what is not known; 0 for what rounding left."""
    if value is None or value != value:
        return "–"
    if abs(value) < DUST:
        return "0"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if 1e4 <= abs(value) < 1e7 and figures <= 4:
        return f"{value:,.0f}".replace("-", "−")
    return f"{value:.{figures}g}".replace("e-0", "e-").replace("e+0", "e").replace("-", "−")


def ends(low: float, high: float) -> tuple[str, str]:
    """Both numbers, with as many figures as tell them apart."""
    told = ((number(low, figures), number(high, figures)) for figures in (4, 6, 8, 12, 17))
    return next((pair for pair in told if pair[0] != pair[1] or low == high), (number(low), number(high)))


def shortened(text: str, pixels: float) -> str:
    """`text`, cut where it would be longer than so many pixels."""
    most = max(int(pixels / LETTER + 1e-9), 1)
    return text if len(text) <= most else text[: most - 1] + "…"


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers between `low` and `high`, about `count` of them."""
    if not high > low:
        return [low]
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * 0.999)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def rounded_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if m * power >= value * (1 - 1e-9))


def tag(name: str, text: str = "", /, **attributes: object) -> str:
    """An element with escaped `text`; in attribute names an underscore stands for a hyphen."""
    given = "".join(
        f' {key.strip("_").replace("_", "-")}="{escape(_short(value))}"' for key, value in attributes.items()
    )
    return f"<{name}{given}>{escape(text)}</{name}>"


def drawing(width: float, height: float, title: str, said: str, content: str, kind: str = "", top: float = 0.0) -> str:
    """A whole SVG of `content` below `top`, called `title` and described by what is `said`, if something is."""
    told = tag("title", title) + tag("desc", said) if said else ""
    seen = f"0 {top:g} {width:g} {height - top:g}"
    return f'<svg class="chart{kind}" viewBox="{seen}" role="img" aria-label="{escape(title)}">{told}{content}</svg>'


def _short(value: object) -> str:
    return f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else str(value)


@dataclass
class Axes:
    """A plain frame for points, in pixels; `log` is for the vertical axis, `said` describes it to who cannot see it."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    x_label: str
    y_label: str
    title: str
    width: int = 420
    height: int = 330
    log: bool = False
    bare: bool = False
    said: str = ""
    parts: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.left, self.bottom, self.top, self.right = (12, 12, 12, 12) if self.bare else (58, 46, 12, 14)

    def x(self, value: float) -> float:
        """Pixels from the left."""
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * (self.width - self.left - self.right)

    def y(self, value: float) -> float:
        """Pixels from the top."""
        low, high = (math.log10(v) for v in self.y_range) if self.log else self.y_range
        at = math.log10(value) if self.log else value
        return self.height - self.bottom - (at - low) / (high - low) * (self.height - self.top - self.bottom)

    def band(self, low: float, high: float, title: str) -> None:
        """Shade what lies between two values of x."""
        a, b = (self.x(min(max(v, self.x_range[0]), self.x_range[1])) for v in (low, high))
        box = tag("title", title)
        self.parts.append(
            f'<rect class="band" x="{a:.1f}" y="{self.top}" width="{max(b - a, 0):.1f}" '
            f'height="{self.height - self.top - self.bottom}">{box}</rect>'
        )

    def line(self, one: tuple[float, float], two: tuple[float, float], kind: str) -> None:
        """A straight line between two points."""
        self.parts.append(
            tag("line", _class=kind, x1=self.x(one[0]), y1=self.y(one[1]), x2=self.x(two[0]), y2=self.y(two[1]))
        )

    def note(self, text: str, x: float, y: float, anchor: str = "start") -> None:
        """Words at a place in pixels."""
        self.parts.append(tag("text", text, _class="note", x=x, y=y, text_anchor=anchor))

    def points(self, points: Iterable[Point], radius: float = 3.6) -> None:
        """Marks: a disc for what is accepted, a cross for what is rejected, a ring for an exemplar."""
        for p in sorted(points, key=lambda p: ORDER.index(p.kind)):
            x, y, r = self.x(p.x), self.y(p.y), radius
            shape = (
                f'<path d="M{x - r:.1f} {y - r:.1f}l{2 * r:.1f} {2 * r:.1f}m0 {-2 * r:.1f}l{-2 * r:.1f} {2 * r:.1f}"/>'
                if p.kind == "bad"
                else f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r if p.kind == "ok" else r + 1:.1f}"/>'
            )
            key = f' data-key="{escape(p.key)}"' if p.key else ""
            tint = "" if p.tint is None else f' style="--tint:{100 * p.tint:.0f}%"'
            tinted = " tinted" if tint else ""
            self.parts.append(f'<g class="mark {p.kind}{tinted}"{key}{tint}>{shape}{tag("title", p.title)}</g>')

    def path(self, points: Iterable[tuple[float, float]], kind: str) -> None:
        """A line through many points."""
        way = "L".join(f"{self.x(x):.1f} {self.y(y):.1f}" for x, y in points)
        self.parts.append(tag("path", _class=kind, d=f"M{way}"))

    def svg(self) -> str:
        """The whole chart."""
        frame = "" if self.bare else self._frame()
        return drawing(self.width, self.height, self.title, self.said, frame + "".join(self.parts))

    def _frame(self) -> str:
        low, right, found = self.height - self.bottom, self.width - self.right, []
        for value in ticks(*self.x_range):
            found.append(tag("line", _class="grid", x1=self.x(value), x2=self.x(value), y1=self.top, y2=low))
            found.append(tag("text", number(value), x=self.x(value), y=low + 16, text_anchor="middle"))
        for value in self._rows():
            found.append(tag("line", _class="grid", x1=self.left, x2=right, y1=self.y(value), y2=self.y(value)))
            found.append(tag("text", number(value), x=self.left - 6, y=self.y(value) + 4, text_anchor="end"))
        middle = (self.left + right) / 2
        found.append(tag("text", self.x_label, _class="label", x=middle, y=self.height - 8, text_anchor="middle"))
        turn = f"translate(14 {(self.top + low) / 2:.0f}) rotate(-90)"
        found.append(tag("text", self.y_label, _class="label", transform=turn, text_anchor="middle"))
        return "".join(found)

    def _rows(self) -> list[float]:
        if not self.log:
            return ticks(*self.y_range)
        low, high = (round(math.log10(v)) for v in self.y_range)
        return [10.0**k for k in range(low, high + 1)]


def asked_against_found(
    points: Sequence[Point], label: str, found: str, known: tuple[float, float], title: str
) -> tuple[str, float]:
    """Asked (x) against found (y) with the line where they agree, the exemplars' range shaded; and R² over all."""
    x, y = np.array([p.x for p in points]), np.array([p.y for p in points])
    low, high = min(x.min(), y.min(), known[0]), max(x.max(), y.max(), known[1])
    room = 0.06 * (high - low) or abs(high) * 0.1 or 1.0
    around = (float(low - room), float(high + room))
    chart = Axes(around, around, f"asked: {label}", found, title)
    chart.band(*known, "the exemplars' range")
    chart.line((around[0], around[0]), (around[1], around[1]), "agree")
    chart.points(thinned(points))
    about = float(((x - x.mean()) ** 2).sum())
    r2 = 1 - float(((y - x) ** 2).sum()) / about if about > 0 else float("nan")
    return chart.svg(), r2


def scores(points: Sequence[Point], title: str) -> str:
    """Every design's worst share of a limit, in the run's order, with the line above which it is rejected."""
    shares = [min(max(p.y, 0.01), CAP) for p in points]
    high = 10.0 ** math.ceil(math.log10(max([*shares, 1.0])) + 0.02)
    low = 10.0 ** math.floor(math.log10(min(shares)) - 0.02)
    chart = Axes(
        (0.0, len(points) + 1.0), (low, high), "design", "worst value / limit", title, width=860, height=260, log=True
    )
    chart.line((0, 1), (len(points) + 1, 1), "limit")
    moved = [Point(p.x, y, p.kind, p.key, p.title) for p, y in zip(points, shares, strict=True)]
    chart.points(thinned(moved))
    return chart.svg()


def bars(rows: Sequence[tuple[str, float, str, str]], title: str, *, width: int = 420) -> str:
    """Horizontal bars: name, value, what is written at its end, kind. Negative values go to the left of zero."""
    names = min(max((len(name) for name, *_ in rows), default=0) * LETTER + 14, width * 0.42)
    low, high = min([0.0, *(v for _, v, *_ in rows)]), max([0.0, *(v for _, v, *_ in rows)])
    room = width - names - (VALUE + 8 if low < 0 else 0) - VALUE - 8
    scale = room / ((high - low) or 1.0)
    zero = names + (VALUE if low < 0 else 0) - low * scale
    found, height = [], 22 * len(rows) + 8
    for i, (name, value, text, kind) in enumerate(rows):
        y, long = 4 + 22 * i, abs(value) * scale
        x = zero if value >= 0 else zero - long
        cut = shortened(name, names - 14)
        found.append(f"<g>{tag('title', name)}{tag('text', cut, x=names - 8, y=y + 15, text_anchor='end')}</g>")
        found.append(
            f'<rect class="bar {kind}" x="{x:.1f}" y="{y + 3}" width="{max(long, 1):.1f}" height="16" rx="2"/>'
        )
        at, anchor = (zero + long + 5, "start") if value >= 0 else (x - 5, "end")
        found.append(tag("text", text, _class="value", x=at, y=y + 15, text_anchor=anchor))
    found.append(f'<line class="zero" x1="{zero:.1f}" x2="{zero:.1f}" y1="2" y2="{height - 2}"/>')
    return (
        f'<svg class="chart bars" viewBox="0 0 {width} {height}" style="max-width:{width}px" role="img" '
        f'aria-label="{escape(title)}">{"".join(found)}</svg>'
    )


def map_of_shapes(points: Sequence[Point], pictures: Sequence[str], title: str, unit: str) -> str:
    """Shapes as points; those that have room around them bear their picture (put there by page.js, from its key)."""
    x, y = np.array([p.x for p in points]), np.array([p.y for p in points])
    width, height = 860, 560
    reach = [(float(v.min()), float(v.max())) for v in (x, y)]
    room = [0.10 * (b - a) or 1.0 for a, b in reach]
    spans = [b - a + 2 * r for (a, b), r in zip(reach, room, strict=True)]
    per = max(spans[0] / (width - 24), spans[1] / (height - 24))  # one scale both ways
    height = max(260, int(spans[1] / per) + 24)
    ranges = [
        ((a + b) / 2 - per * (size - 24) / 2, (a + b) / 2 + per * (size - 24) / 2)
        for (a, b), size in zip(reach, (width, height), strict=True)
    ]
    chart = Axes(ranges[0], ranges[1], "", "", title, width=width, height=height, bare=True)
    taken: list[tuple[float, float]] = []
    for p, picture in zip(points, pictures, strict=True):
        px, py = chart.x(p.x), chart.y(p.y)
        if picture and all(abs(px - u) > 88 or abs(py - v) > 62 for u, v in taken):
            taken.append((px, py))
            chart.parts.append(
                f'<image data-from="{escape(picture)}" x="{px - 44:.1f}" y="{py - 62:.1f}" width="88" height="62"/>'
            )
    chart.points(points, 4.2)
    step = rounded_up(per * 90)
    chart.parts.append(f'<path class="scale" d="M20 {height - 22}v5h{step / per:.1f}v-5"/>')
    chart.note(f"{number(step)} {unit}", 20 + step / per / 2, height - 26, "middle")
    return chart.svg()


def thinned(points: Sequence[Point]) -> Sequence[Point]:
    """So many of `points` as are drawn, evenly spread."""
    return [points[i] for i in np.linspace(0, len(points) - 1, min(MOST, len(points))).round().astype(int)]
