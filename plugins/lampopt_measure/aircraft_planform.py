"""A planform of three straight panels, read off noses and tails of sections: two kinks, six lines."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .aircraft_sections import Halves, edges

if TYPE_CHECKING:
    from torch import Tensor

ACROSS = (0.02, 0.97)  # of the half span: where sections are taken; the rim at the middle and the tip may be rounded
FIRST = 64  # sections that the kinks are sought with
CLOSER = 32  # more of them, from just before the first kink to just after the second
CANDIDATES = 48  # places that a kink may lie at, to begin with
DIGITS = 4  # of the half span, that a kink is sought to before lines are fitted
PANEL = 24  # sections that each panel's lines are fitted to
INNER = (0.08, 0.92)  # of a panel: where they lie, clear of kinks that a decoder rounds
FEWEST = 4  # sections that a line is fitted to
STRAY = 6.0  # deviations, by the median, from which a section is left out
EXACT = 1e-6  # of the half span: below, no section is a stray one
STEP = 1e-3  # of the half span: from here on, a section off the bent lines counts less than its square
TURN = 1e-3  # change of slope, of both edges together, below which there is no kink


@dataclass(frozen=True, eq=False)
class Planform:
    """Three panels from the plane of symmetry to the tip: tensors that follow the mesh's vertices."""

    widths: Tensor  # (3,) [L]
    chords: Tensor  # (4,) at the plane of symmetry, the kinks, the tip [L]
    sweeps: Tensor  # (3,) of the leading edge [deg]


def planform(halves: Halves, vertices: Tensor | None = None) -> Planform:
    """The panels of `halves`; they follow `vertices` (V, 3) float64 where given.

    Two kinks, common to leading and trailing edge, are sought with sections all along the span. Lines of least squares
    through sections within each panel then give chords and sweeps; a kink lies where neighbouring lines meet best.

    Raises
    ------
    MeasureError
        Where there are no three panels with kinks between them.
    """
    import torch

    ends = np.array([0.0, *_kinks(halves), 1.0])
    lines = []
    for start, width in zip(ends[:-1], np.diff(ends), strict=True):
        at = start + width * np.linspace(*INNER, PANEL)
        at = _regular(halves, at[at <= ACROSS[1]])
        if len(at) < FEWEST:
            raise MeasureError(
                f"bwb: expected a wing of three panels with round noses and thin tails, got {len(at)} sections of one "
                f"between {start:.1%} and {start + width:.1%} of the half span"
            )
        found = edges(halves, at, vertices)
        lines.append(_line(found.at, torch.stack([found.nose, found.tail], dim=1)))
    kinks = []
    for here, beyond in pairwise(lines):
        apart, turn = beyond - here  # (2,) of nose and tail
        strength = (turn**2).sum()
        if float(strength.detach()) < TURN**2:
            raise MeasureError("bwb: expected leading and trailing edge with two kinks, got straight ones")
        kinks.append(-(apart * turn).sum() / strength)
    places = torch.stack([torch.zeros_like(kinks[0]), *kinks, halves.placed(vertices)[1]])
    widths = places.diff()
    if not bool((widths > 0).all()):
        raise MeasureError(
            "bwb: expected two kinks one after the other between the middle and the tip, got them at "
            f"{float(kinks[0].detach()):.6g} and {float(kinks[1].detach()):.6g} of {halves.span:.6g}"
        )
    inner, outer = (
        torch.stack([line[0] + line[1] * place for line, place in zip(lines, at, strict=True)])
        for at in (places[:-1], places[1:])
    )
    corners = torch.cat([inner[:1], (outer[:-1] + inner[1:]) / 2, outer[-1:]])
    sweeps = torch.rad2deg(torch.atan2(corners[:, 0].diff(), widths))
    return Planform(widths, corners[:, 1] - corners[:, 0], sweeps)


def _line(at: Tensor, values: Tensor) -> Tensor:
    """Value at 0 and slope (2, k) of the lines of least squares through values (n, k) at (n,)."""
    import torch

    away, middle = (at - at.mean())[:, None], values.mean(dim=0)
    slope = (away * (values - middle)).sum(dim=0) / (away**2).sum()
    return torch.stack([middle - at.mean() * slope, slope])


def _kinks(halves: Halves) -> tuple[float, float]:
    """Where the two kinks lie about, in half spans, rounded: the search may differ in the last bits."""
    at = np.linspace(*ACROSS, FIRST)
    step = at[1] - at[0]
    ends = _ends(halves, at)
    first, second = _fitted_kinks(at, ends)
    closer = np.linspace(max(first - 2 * step, ACROSS[0]), min(second + 2 * step, ACROSS[1]), CLOSER)
    order = np.argsort(np.r_[at, closer], kind="stable")
    kinks = _fitted_kinks(np.r_[at, closer][order], np.concatenate([ends, _ends(halves, closer)])[order])
    return round(kinks[0], DIGITS), round(kinks[1], DIGITS)


def _ends(halves: Halves, at: Array) -> Array:
    """Nose and tail (n, 2) at shares (n,) of the half span, the mean of both sides, in half spans."""
    found = edges(halves, at)
    both = np.stack([found.nose.numpy(), found.tail.numpy()], axis=1)
    return np.asarray(both.reshape(len(at), -1, 2).mean(axis=1) / halves.span)


def _fitted_kinks(at: Array, ends: Array) -> tuple[float, float]:
    """The two kinks of the bent lines that lie nearest to nose and tail (n, 2) at (n,); all in half spans."""
    from scipy.optimize import least_squares

    middles = (at[1:] + at[:-1]) / 2
    places = np.unique(middles[np.linspace(1, len(middles) - 2, CANDIDATES).astype(int)])
    pairs = np.stack(np.triu_indices(len(places), 1), axis=1)
    bends = np.stack([_bent(at, places[pair]) for pair in pairs])
    square = np.einsum("pni,pnj->pij", bends, bends) + EXACT**2 * np.eye(4)
    right = np.einsum("pni,nk->pik", bends, ends)
    left = (ends**2).sum() - (np.linalg.solve(square, right) * right).sum(axis=(1, 2))
    start = places[pairs[left.argmin()]]

    def residuals(kinks: Array) -> Array:
        bend = _bent(at, np.sort(kinks))
        apart: Array = bend @ np.linalg.lstsq(bend, ends)[0] - ends
        return apart.ravel()

    kinks = np.sort(least_squares(residuals, start, x_scale=1 / FIRST, loss="soft_l1", f_scale=STEP).x)
    return float(kinks[0]), float(kinks[1])


def _bent(at: Array, kinks: Array) -> Array:
    """(n, 4) shares of the values at the middle, the kinks and the tip in a bent line at (n,) of the half span."""
    corners = np.array([0.0, *kinks, 1.0])
    return np.stack([np.interp(at, corners, own) for own in np.eye(4)], axis=1)


def _regular(halves: Halves, at: Array) -> Array:
    """Those whose sections have a round nose and a thin tail on every side, on the lines that most of them lie on."""
    if len(at) < FEWEST:
        return at
    found = edges(halves, at)
    kept = found.fitted.copy()
    ends = np.stack([found.nose.numpy(), found.tail.numpy()], axis=1) / halves.span
    powers = np.vander(found.at.numpy() / halves.span, 2, increasing=True)
    for _ in range(2):
        if kept.sum() < FEWEST:
            break
        apart = np.abs(powers @ np.linalg.lstsq(powers[kept], ends[kept])[0] - ends)
        kept = found.fitted & (apart <= STRAY * np.median(apart[kept], axis=0) + EXACT).all(axis=1)
    return np.asarray(at[kept.reshape(len(at), -1).all(axis=1)])
