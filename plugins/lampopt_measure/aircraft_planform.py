"""A planform of three straight panels, read off noses and tails of sections: two kinks, six lines."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .aircraft_ends import edges
from .aircraft_sections import Halves

if TYPE_CHECKING:
    from torch import Tensor

ACROSS = (0.02, 0.97)  # of the half span: where sections are taken; the rim at the middle and the tip may be rounded
FIRST = 64  # sections that the kinks are sought with
CLOSER = 32  # more of them, from just before the first kink to just after the second
CANDIDATES = 48  # places that a kink may lie at, to begin with
TRIES = 5  # pairs of kinks that the search is started from
UNLIKE = 0.06  # of the half span, that one of both lies from those of other tries
DIGITS = 4  # of the half span, that a kink is sought to before lines are fitted
PANEL = 48  # sections that each panel's lines are fitted to, at least; at most twice as many
OFF = 0.382  # of the pitch of the grids they lie on, so that none lies on rows of vertices spaced evenly
INNER = 0.06  # of a panel, from either end: clear of kinks that a decoder rounds
RAMP = 0.1  # of a panel: over which a section comes to count in full from there on
FEWEST = 4  # sections that a line is fitted to
STRAY = 6.0  # deviations, by the median, from which a section is left out
SMALL = 1e-3  # of the half span: nearer to the line no section is a stray one, and a kink is sought by least squares
NARROW = 0.01  # of the half span: the least width of a panel
TINY = 1e-6  # of the half span: what keeps the equations of a hopeless pair of kinks solvable
SETTLED = 1e-14  # of the half span: change of the kinks at which they are found
ROUNDS = 100  # of finding lines between the kinks, and kinks where lines meet
TURN = 1e-3  # change of slope, of both edges together, below which there is no kink


def planform(halves: Halves, *, derivative: bool = False) -> tuple[Array, Array]:
    """Widths (3,) and chords (4,) [L], sweeps (3,) [deg] of the panels, in one array (10,), and how they change.

    Two kinks, common to leading and trailing edge, are sought with sections all along the span. From there on sections
    lie at fixed shares of the half span. Lines of least squares through those between the kinks meet at the kinks: that
    is one system of equations, solved until nothing moves, so that the values are smooth in the sections, and their
    derivative is that of its solution.

    Returns
    -------
    values, gradient
        (10,) and, if `derivative`, their derivative by the vertices (10, V, 3).

    Raises
    ------
    MeasureError
        Where there are no three panels with kinks between them.
    """
    import torch

    kinks = _kinks(halves)
    at = _stations(kinks)
    found = edges(halves, at, follow=("nose", "tail") if derivative else ())
    ends = torch.from_numpy(np.stack([found.nose.mean(axis=1), found.tail.mean(axis=1)], axis=1))
    kept = _regular(at, ends.numpy() / halves.span, np.asarray(found.fitted.all(axis=1)), kinks)
    at, chosen = at[kept], ends[kept].requires_grad_(derivative)
    span = torch.tensor(halves.span, dtype=torch.float64, requires_grad=derivative)
    values = _panels(torch.from_numpy(at), chosen, span, torch.tensor(kinks, dtype=torch.float64))
    plain = np.array([float(value.detach()) for value in values])
    if (narrowest := plain[:3].min()) < NARROW * halves.span:
        raise MeasureError(
            f"bwb: expected panels of at least {NARROW:.0%} of the half span, {NARROW * halves.span:.6g}, got one of "
            f"{narrowest:.6g}: narrower ones cannot be told from a single kink"
        )
    if not derivative:
        return plain, np.zeros((0, 0, 3))
    by = [torch.autograd.grad(value, (chosen, span), retain_graph=True, allow_unused=True) for value in values]
    by_span = np.array([0.0 if one is None else float(one) for _, one in by])
    by_ends = np.zeros((len(values), *found.nose.shape, 2))
    by_ends[:, kept] = np.stack([one.numpy() for one, _ in by])[:, :, None] / found.nose.shape[1]
    return plain, found.gradient(by_span, nose=by_ends[..., 0], tail=by_ends[..., 1])


def _panels(at: Tensor, ends: Tensor, span: Tensor, kinks: Tensor) -> list[Tensor]:
    """The ten values, of noses and tails (n, 2) at shares (n,) of the half span, the kinks known roughly."""
    import torch

    with torch.no_grad():
        for _ in range(ROUNDS):
            before, kinks = kinks, _meeting(_lines(at, ends, kinks), span)
            if float((kinks - before).abs().max()) <= SETTLED:
                break
    if ends.requires_grad:  # kinks = f(kinks, ends): the derivative of the solution is (1 - f')⁻¹ that of f
        start = kinks.clone().requires_grad_()
        after = _meeting(_lines(at, ends, start), span)
        (a, b), (c, d) = (torch.autograd.grad(one, start, retain_graph=True)[0].tolist() for one in after)
        inverse = torch.tensor([[1 - d, b], [c, 1 - a]], dtype=torch.float64) / ((1 - a) * (1 - d) - b * c)
        kinks = kinks + (inverse * (after - after.detach())).sum(dim=1)
    lines = _lines(at, ends, kinks)
    places = _bounds(kinks)
    inner, outer = (
        torch.stack([line[0] + line[1] * place for line, place in zip(lines, where, strict=True)])
        for where in (places[:-1], places[1:])
    )
    corners = torch.cat([inner[:1], (outer[:-1] + inner[1:]) / 2, outer[-1:]])
    widths = places.diff() * span
    sweeps = torch.rad2deg(torch.atan2(corners[:, 0].diff(), widths))
    return [*widths, *(corners[:, 1] - corners[:, 0]), *sweeps]


def _bounds(kinks: Tensor) -> Tensor:
    """Where the panels begin and end (4,), in half spans."""
    import torch

    return torch.cat([torch.zeros(1, dtype=torch.float64), kinks, torch.ones(1, dtype=torch.float64)])


def _lines(at: Tensor, ends: Tensor, kinks: Tensor) -> list[Tensor]:
    """Per panel, value at 0 and slope (2, 2) of the lines of least squares through nose and tail (n, 2) at (n,)."""
    import torch

    lines = []
    for weight in _weights(at, kinks):
        if int((weight > 0).sum()) < FEWEST:
            raise MeasureError(
                f"bwb: expected a wing of three panels with round noses and thin tails, got {int((weight > 0).sum())} "
                f"sections of one between kinks at {', '.join(f'{float(k):.1%}' for k in kinks)} of the half span"
            )
        share = (weight / weight.sum())[:, None]
        centre, middle = (share[:, 0] * at).sum(), (share * ends).sum(dim=0)
        away = (at - centre)[:, None]
        slope = (share * away * (ends - middle)).sum(dim=0) / (share * away**2).sum()
        lines.append(torch.stack([middle - centre * slope, slope]))
    return lines


def _weights(at: Tensor, kinks: Tensor) -> list[Tensor]:
    """(n,) per panel, how much sections at (n,) count in its lines: smooth, nothing near its ends."""
    weights = []
    for start, end in pairwise(_bounds(kinks)):
        width = end - start
        low = (start + INNER * width).clamp(min=ACROSS[0])
        high = (end - INNER * width).clamp(max=ACROSS[1])
        rise, fall = (((way / (RAMP * width)).clamp(0, 1)) for way in (at - low, high - at))
        weights.append(rise**2 * (3 - 2 * rise) * fall**2 * (3 - 2 * fall))
    return weights


def _meeting(lines: list[Tensor], span: Tensor) -> Tensor:
    """The kinks (2,), each where neighbouring lines of both edges meet best."""
    import torch

    kinks = []
    for here, beyond in pairwise(lines):
        apart, turn = beyond - here  # (2,) of nose and tail
        strength = (turn**2).sum()
        if not float(strength.detach()) >= (TURN * float(span.detach())) ** 2:
            raise MeasureError("bwb: expected leading and trailing edge with two kinks, got straight ones")
        kinks.append(-(apart * turn).sum() / strength)
    first, second = (float(kink.detach()) for kink in kinks)
    if not 0 < first < second < 1:
        raise MeasureError(
            "bwb: expected two kinks one after the other between the middle and the tip, got them at "
            f"{first:.2%} and {second:.2%} of the half span"
        )
    return torch.stack(kinks)


def _stations(kinks: Array) -> Array:
    """Shares of the half span where sections are taken, on grids whose pitch follows a panel's width by powers of 2."""
    parts = []
    for start, end in pairwise([0.0, *kinks, 1.0]):
        pitch = 2.0 ** np.floor(np.log2(max(end - start, TINY) / PANEL))
        parts.append(pitch * (np.arange(np.floor(start / pitch), np.ceil(end / pitch)) + OFF))
    at = np.unique(np.concatenate(parts))
    return at[(at >= ACROSS[0]) & (at <= ACROSS[1])]


def _kinks(halves: Halves) -> Array:
    """Where the two kinks lie about (2,), in half spans, rounded: the search may differ in the last bits."""
    at = np.linspace(*ACROSS, FIRST)
    step = at[1] - at[0]
    ends = _ends(halves, at)
    first, second = _fitted_kinks(at, ends)
    closer = np.linspace(max(first - 2 * step, ACROSS[0]), min(second + 2 * step, ACROSS[1]), CLOSER)
    order = np.argsort(np.r_[at, closer], kind="stable")
    return _fitted_kinks(np.r_[at, closer][order], np.concatenate([ends, _ends(halves, closer)])[order]).round(DIGITS)


def _ends(halves: Halves, at: Array) -> Array:
    """Nose and tail (n, 2) at shares (n,) of the half span, the mean of both sides, in half spans."""
    found = edges(halves, at)
    return np.stack([found.nose.mean(axis=1), found.tail.mean(axis=1)], axis=1) / halves.span


def _fitted_kinks(at: Array, ends: Array) -> Array:
    """The two kinks (2,) of the bent lines that lie nearest to nose and tail (n, 2) at (n,); all in half spans."""
    from scipy.optimize import least_squares

    middles = (at[1:] + at[:-1]) / 2
    places = np.unique(middles[np.linspace(1, len(middles) - 2, CANDIDATES).astype(int)])
    pairs = places[np.stack(np.triu_indices(len(places), 1), axis=1)]
    bends = _bent(at, pairs)
    square = bends.swapaxes(1, 2) @ bends + TINY**2 * np.eye(4)
    right = bends.swapaxes(1, 2) @ ends
    left = (ends**2).sum() - (np.linalg.solve(square, right) * right).sum(axis=(1, 2))

    def residuals(kinks: Array) -> Array:
        bend = _bent(at, np.sort(kinks))
        apart: Array = bend @ np.linalg.lstsq(bend, ends)[0] - ends
        return apart.ravel()

    tries = [
        least_squares(residuals, start, x_scale=1 / FIRST, loss="soft_l1", f_scale=SMALL)
        for start in _apart(pairs[np.argsort(left, kind="stable")])
    ]
    return np.sort(min(tries, key=lambda found: found.cost).x)


def _apart(pairs: Array) -> list[Array]:
    """The first of `pairs` (m, 2), and the next ones that are unlike those before.

    Where no place lies on a strong kink, two beside it fit better than one there and one at a weak kink.
    """
    chosen: list[Array] = []
    for pair in pairs:
        if all(np.abs(pair - other).max() > UNLIKE for other in chosen):
            chosen.append(pair)
            if len(chosen) == TRIES:
                break
    return chosen


def _bent(at: Array, kinks: Array) -> Array:
    """(..., n, 4) shares of the values at the middle, the kinks (..., 2) and the tip in a bent line at (n,)."""
    ends = np.broadcast_to([0.0, 1.0], kinks.shape)
    corners = np.concatenate([ends[..., :1], kinks, ends[..., 1:]], axis=-1)[..., None]
    along = np.clip((at - corners[..., :-1, :]) / np.maximum(np.diff(corners, axis=-2), TINY), 0, 1)  # of each panel
    rise, fall = along, 1 - along
    return np.stack([fall[..., 0, :], *(rise[..., k, :] - rise[..., k + 1, :] for k in (0, 1)), rise[..., 2, :]], -1)


def _regular(at: Array, ends: Array, fitted: Array, kinks: Array) -> Array:
    """Which sections (n,) have a round nose and a thin tail, and lie on the lines that most of their panel lie on."""
    kept = fitted.copy()
    for start, end in pairwise([0.0, *kinks, 1.0]):
        there = fitted & (at > start + INNER * (end - start)) & (at < end - INNER * (end - start))
        powers, own = np.vander(at[there], 2, increasing=True), np.ones(there.sum(), bool)
        for _ in range(2):
            if own.sum() < FEWEST:
                break
            apart = np.abs(powers @ np.linalg.lstsq(powers[own], ends[there][own])[0] - ends[there])
            own = (apart <= STRAY * np.median(apart[own], axis=0) + SMALL).all(axis=1)
        kept[there] = own
    return kept
