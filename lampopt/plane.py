"""How a measured label goes with the parameters: what exemplars tell of it, and what each measured design teaches.

With more exemplars than parameters, what parameters do not explain of a label (noise, part of its curvature) can be
mixed at will, and the least mix does so: the label falls and the shape does not. A plane through what was measured asks
for the part that shapes follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lampopt.errors import InputError
from lampopt.fitted import fit_model
from lampopt.plugins import Plugins
from lampopt.protocols import CrossValidated
from lampopt.types import Array, Bank

TOLD = 0.0  # R² of a label by the parameters, each exemplar left out in turn, above which they tell more than its mean
MODEL = "quadratic"
PRIOR = 0.3  # what the slope from the exemplars weighs beside a measured design one range away
NEAR = 0.05  # [ranges] nearer designs than this do not weigh more
Slope = Callable[[Array], Array]  # (d,) at (d,), both in parts of the ranges
Told = tuple[float, Slope]
NOTHING: Told = -np.inf, np.zeros_like


@dataclass(frozen=True, eq=False)
class Plane:
    """A label near one of several measured designs.

    Parameters
    ----------
    parameters
        (N, d) of the exemplars, in parts of their ranges.
    prior
        The label's slope (d,) at parameters (d,), before anything was measured.
    seen
        Parameters (d,) and measured value of each design.
    wanted
        The value that is sought: the plane goes through the design nearest to it, the later of equals. None: the last.
    """

    parameters: Array
    prior: Slope
    seen: tuple[tuple[Array, float], ...]
    wanted: float | None = None

    @property
    def at(self) -> Array:
        """(d,) the design that it goes through."""
        return self.seen[self._foot][0]

    @property
    def value(self) -> float:
        """What was measured there."""
        return self.seen[self._foot][1]

    @cached_property
    def _foot(self) -> int:
        wanted, last = self.wanted, len(self.seen) - 1
        return last if wanted is None else min(range(last, -1, -1), key=lambda k: abs(self.seen[k][1] - wanted))

    def through(self, alpha: Array, value: float) -> Plane:
        """The plane that another design was measured for, too."""
        return replace(self, seen=(*self.seen, (alpha @ self.parameters, value)))

    @cached_property
    def slope(self) -> Array:
        """(d,) least squares over the other designs, nearer ones weighing more, and the prior."""
        others = [one for k, one in enumerate(self.seen) if k != self._foot]
        steps = np.array([at - self.at for at, _ in others]).reshape(-1, len(self.at))
        gains = np.array([value - self.value for _, value in others])
        weight = 1 / (np.linalg.norm(steps, axis=1) + NEAR)
        rows = np.vstack([steps * weight[:, None], PRIOR * np.eye(len(self.at))])
        told = np.append(gains * weight, PRIOR * self.prior(self.at))
        return np.asarray(np.linalg.lstsq(rows, told, rcond=None)[0])

    @property
    def values(self) -> Array:
        """(N,) what it says of the exemplars."""
        return np.asarray(self.value + (self.parameters - self.at) @ self.slope)


def in_ranges(bank: Bank) -> Array:
    """(N, d) the exemplars' parameters, in parts of their ranges."""
    return np.asarray(bank.parameters / _ranges(bank))


def explained(bank: Bank, label: str, start: Array, value: float, plugins: Plugins | None) -> Plane | None:
    """The plane of a label through `value`, measured at the mix `start` (N,); None if parameters tell nothing of it.

    Its slopes are those of a quadratic model or of one plane over the exemplars, whichever tells more of those left
    out.
    """
    r2, prior = max((_by_model(bank, label, plugins), _by_plane(bank, label)), key=lambda told: told[0])
    if not r2 > TOLD:
        return None
    parameters = in_ranges(bank)
    return Plane(parameters, prior, ((start @ parameters, value),))


def _ranges(bank: Bank) -> Array:
    spread = np.ptp(bank.parameters, axis=0)
    return np.where(spread > 0, spread, 1.0)


def _by_model(bank: Bank, label: str, plugins: Plugins | None) -> Told:
    """How much a quadratic model tells, and its slope."""
    if plugins is None or ("model", MODEL) not in plugins.offers:
        return NOTHING
    try:
        model = fit_model(bank, MODEL, [label], plugins=plugins)
    except InputError:  # too few exemplars with this label
        return NOTHING
    r2 = model.cross_validated[label]["r2"] if isinstance(model, CrossValidated) else np.nan
    ranges, names = _ranges(bank), [q.name for q in bank.space]
    places = [names.index(name) for name in model.inputs]

    def slope(at: Array) -> Array:
        found = np.zeros(len(names))
        found[places] = np.asarray(model.gradient((at * ranges)[None, places]))[0, 0]
        return found * ranges

    return (r2, slope) if np.isfinite(r2) else NOTHING


def _by_plane(bank: Bank, label: str) -> Told:
    """How much a plane over the exemplars tells, and its slope."""
    values = bank.labels[:, [q.name for q in bank.label_space].index(label)]
    known = np.isfinite(values)
    rows, off = in_ranges(bank)[known], values[known]
    if len(rows) < 3:
        return NOTHING
    rows, off = rows - rows.mean(0), off - off.mean()
    inverse = np.linalg.pinv(rows, rcond=1e-8)
    share = 1 / len(rows) + np.einsum("nd,dn->n", rows, inverse)  # of its own value in what it is told
    if not (share < 1 - 1e-9).all() or not off.any():
        return NOTHING  # no fewer parameters than exemplars, or nothing to tell
    missed = (off - rows @ inverse @ off) / (1 - share)
    slope = inverse @ off
    return 1 - float(missed @ missed) / float(off @ off), lambda _: slope
