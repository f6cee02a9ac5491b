"""A front as one SVG file: error over distance, and beside it what lowering a label costs."""

from __future__ import annotations

from html import escape

import numpy as np

from lampopt.reporting.charts import MOST, Axes, number, tag
from lampopt.types import Array

WIDTH, HEIGHT, ROOM = 460, 360, 1.06
STYLE = """text{font:12px system-ui,sans-serif;fill:#5d6b7a}.label{fill:#1d2733}.grid{stroke:#d9dfe5}
.agree{stroke:#5d6b7a;stroke-dasharray:5 4}.front{fill:none;stroke:#2c6da8;stroke-width:2.2}.knee{fill:#c4500a}
.other{fill:#9fb0c0;fill-opacity:.35}.efficient{fill:#2c6da8}"""


def picture(
    distance: Array,
    error: Array,
    knee: int | None,
    beside: tuple[Array, Array, Array, Array] | None = None,
    label: str = "",
) -> str:
    """A front of distance and error (B,), and its knee if it has one.

    `beside` are distance, value, error and efficiency where a label is lowered.

    What is not known is left out.
    """
    known = np.isfinite(error)
    at = None if knee is None else (float(distance[knee]), float(error[knee]))
    charts = [_front(distance[known], error[known], at)]
    if beside is not None:
        told = np.isfinite(beside[1]) & np.isfinite(beside[2])
        far, value, missed, efficient = (column[told] for column in beside)
        charts.append(_lowered(far, value, missed, efficient, label))
    wide = WIDTH * len(charts)
    inner = "".join(
        chart.replace("<svg ", f'<svg x="{WIDTH * i}" width="{WIDTH}" height="{HEIGHT}" ', 1)
        for i, chart in enumerate(charts)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{HEIGHT}" viewBox="0 0 {wide} {HEIGHT}">'
        f'<style>{STYLE}</style><rect width="{wide}" height="{HEIGHT}" fill="#fff"/>{inner}</svg>\n'
    )


def _axes(distance: Array, low: float, high: float, label: str, title: str) -> Axes:
    far = ROOM * float(distance.max(initial=0.0)) or 1.0
    return Axes((0.0, far), (low, high), "‖alpha − centre‖", label, title, width=WIDTH, height=HEIGHT)


def _front(distance: Array, error: Array, knee: tuple[float, float] | None) -> str:
    high = ROOM * float(error.max(initial=0.0)) or 1.0
    chart = _axes(distance, 0.0, high, "error [half ranges]", "accuracy against reliability")
    if not len(distance):
        return chart.svg()
    ends = [(float(distance[i]), float(error[i])) for i in (0, -1)]
    chart.line(ends[0], ends[1], "agree")
    line = " ".join(f"{chart.x(float(x)):.1f},{chart.y(float(y)):.1f}" for x, y in zip(distance, error, strict=True))
    chart.parts.append(f'<polyline class="front" points="{line}"/>')
    if knee is not None:
        said = f"knee: distance {number(knee[0])}, error {number(knee[1])}"
        chart.parts.append(_disc(chart, *knee, 5.0, "knee", said))
        chart.note("knee", chart.x(knee[0]) + 9, chart.y(knee[1]) - 7)
    return chart.svg()


def _lowered(distance: Array, value: Array, error: Array, efficient: Array, label: str) -> str:
    """The larger a disc, the less of all else is missed; what others beat is pale."""
    low, high = (float(value.min()), float(value.max())) if len(value) else (0.0, 1.0)
    room = (ROOM - 1) * (high - low) or abs(high) * 0.1 or 1.0
    chart = _axes(distance, low - room, high + room, label, f"{label} against distance")
    size = 1.5 + 3 * (1 - error / (float(error.max(initial=0.0)) or 1.0))
    drawn = np.argsort(efficient, kind="stable")[np.linspace(0, len(value) - 1, min(MOST, len(value))).astype(int)]
    for i in drawn.tolist():
        said = (
            f"distance {number(float(distance[i]))}, {label} {number(float(value[i]))}, error {number(float(error[i]))}"
        )
        kind = "efficient" if efficient[i] else "other"
        chart.parts.append(_disc(chart, float(distance[i]), float(value[i]), float(size[i]), kind, said))
    chart.note("larger: less of all else is missed", WIDTH - 14, 24, "end")
    return chart.svg()


def _disc(chart: Axes, x: float, y: float, radius: float, kind: str, title: str) -> str:
    place = f'cx="{chart.x(x):.1f}" cy="{chart.y(y):.1f}" r="{radius:.1f}"'
    return f'<circle class="{escape(kind)}" {place}>{tag("title", title)}</circle>'
