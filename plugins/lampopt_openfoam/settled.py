"""When a coefficient's running mean has settled, and how well it is known: read from the series alone.

Steady solvers seldom stand still around a blunt body: the coefficients go round in cycles of a hundred iterations and
more. So the mean is judged, never the iteration count: what came before the flow was there is dropped, and of the rest
the mean's standard error is reckoned from the means of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lampopt.types import Array

WARM = 100  # iterations dropped at least
WINDOW = 100  # iterations averaged at least
EVERY = 20  # iterations between two judgements
WILD = 30  # iterations within which a start may be wild
BOUND = 100.0  # a coefficient beyond it is no flow any more
PARTS = (4, 5, 6)  # into which what is left is divided
LIFT = 0.02  # a lift's standard error that is good enough: it may be zero, so no share of it will do
JUDGED = (WARM, WINDOW, EVERY, WILD, BOUND, *PARTS, LIFT)


@dataclass(frozen=True)
class Settled:
    """What a series says.

    Parameters
    ----------
    state
        "settling": go on; "settled"; "diverged".
    mean, error
        (c,) of each coefficient, and its standard error; NaN where nothing can be said yet.
    start, end
        Iterations dropped; iterations read.
    message
        Why.
    """

    state: Literal["settling", "settled", "diverged"]
    mean: tuple[float, ...]
    error: tuple[float, ...]
    start: int
    end: int
    message: str


def judged(series: Array, tolerance: float) -> Settled:
    """Whether the first coefficient's mean is known to `tolerance` (a share of it), the others' not wildly off.

    Parameters
    ----------
    series
        (n, c) coefficients by iteration, drag first, lift second.
    tolerance
        Relative standard error of the drag that is good enough.
    """
    series = np.atleast_2d(np.asarray(series, float))
    unknown = (float("nan"),) * series.shape[1]
    late = series[WILD:]
    if not np.isfinite(series).all() or (np.abs(late) > BOUND).any():
        with np.errstate(invalid="ignore"):
            worst = np.nanmax(np.abs(series)) if np.isfinite(series).any() else float("nan")
        return Settled(
            "diverged", unknown, unknown, 0, len(series), f"coefficients up to {worst:.3g} in {len(series)} iterations"
        )
    if len(series) < WARM + WINDOW:
        return Settled(
            "settling", unknown, unknown, 0, len(series), f"{len(series)} of at least {WARM + WINDOW} iterations"
        )
    start = _start(series[:, 0])
    kept = series[start:]
    mean, error = kept.mean(axis=0), np.array([standard_error(column) for column in kept.T])
    wanted = np.full(len(mean), LIFT)
    wanted[0] = tolerance * abs(mean[0])
    said = f"drag {mean[0]:.4f} ± {error[0]:.4f} over {len(kept)} iterations, asked for ± {wanted[0]:.4f}"
    said += "".join(f"; lift ± {by:.4f}, asked for ± {LIFT:g}" for by in error[1:2])
    state: Literal["settling", "settled"] = "settled" if (error <= wanted).all() else "settling"
    return Settled(state, tuple(mean.tolist()), tuple(error.tolist()), start, len(series), said)


def first_settled(series: Array, tolerance: float) -> Settled:
    """What `judged` says of the first `EVERY`, 2 `EVERY`, ... rows that are settled or diverged; else of all rows.

    So a result does not depend on how far a solver ran on before it noticed that it was to stop.
    """
    for n in range(WARM + WINDOW, len(series) + 1, EVERY):
        told = judged(series[:n], tolerance)
        if told.state != "settling":
            return told
    return judged(series, tolerance)


def standard_error(series: Array) -> float:
    """Of the mean of a correlated series (n,): from the means of its 4, 5 and 6 consecutive parts, the largest.

    A cycle shorter than a part averages out; a longer one, and a drift, make the parts differ.
    """
    errors = []
    for parts in PARTS:
        means = np.array([part.mean() for part in np.array_split(series, parts)])
        errors.append(float(means.std(ddof=1) / np.sqrt(parts)))
    return max(errors)


def _start(drag: Array) -> int:
    """How many iterations to drop: what makes the rest's standard error least, up to half of them (White's rule)."""
    n = len(drag)
    candidates = np.unique(np.linspace(WARM, max(WARM, n // 2), 9).astype(int))
    candidates = candidates[n - candidates >= WINDOW]
    scores = [drag[c:].var() / (n - c) for c in candidates]
    return int(candidates[int(np.argmin(scores))])
