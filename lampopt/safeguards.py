"""Safety inside the solve: checks as constraints on alpha, with gradients.

The search sees every `SHARE`-th of the bank's probes; the verdict on a design that such a search has found comes from
the others (`judged_by`). The mismatch needs no second look at the exemplars: what they say at the probes is stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import numpy as np

from lampopt.errors import StudyError
from lampopt.mix import mixed_weights
from lampopt.protocols import Adjoint, Corresponding, Decoder, Displace
from lampopt.terms import Distance, shaped
from lampopt.types import Array, Bank, Term

WITHIN = 2e-6  # a search may end by a millionth beyond a limit, and what is beyond it is rejected
SHARE = 4  # the search sees one probe in so many
NAMES = ("alpha", "mismatch", "jacobian")  # what can be kept within its limit
STEP = 1e-3  # of alpha, for differences where the decoder has no adjoint: weights have single precision
REACH = 1e-3  # of a template's size, for the derivatives of its motion
POINTS = 2048  # of a template, where its motion is looked at
SHARP = 200.0  # of the smooth least value: it is below the least one by at most log(POINTS) / SHARP
LEAST = 0.05  # volume that a place keeps at least, in parts of what it was, as the decoders' own check has it


def seen(count: int) -> Array:
    """(count,) whether a search with safeguards sees the probe."""
    return np.asarray(np.arange(count) % SHARE == 0)


@dataclass(frozen=True, eq=False)
class Mismatch:
    """The linearity mismatch of alpha (n,) over the probes that the search sees [box], with its gradient.

    Parameters
    ----------
    whole, active
        From coefficients (n,) of the exemplars that take part to all (N,), and the numbers of those.
    """

    name: str
    bank: Bank
    decoder: Decoder
    whole: Callable[[Array], Array]
    active: Array
    rough = True

    @cached_property
    def _probes(self) -> Array:
        return np.asarray(self.bank.probes[seen(len(self.bank.probes))])

    @cached_property
    def _values(self) -> Array:
        """(n, M, C) what the exemplars say at the probes."""
        return np.asarray(self.bank.probe_values[self.active][:, seen(len(self.bank.probes))], float)

    def _gap(self, alpha: Array) -> Array:
        weights = mixed_weights(self.bank, self.whole(alpha))
        mixed = np.asarray(self.decoder.evaluate(self.bank.shared, weights, self._probes), float)
        return np.asarray(mixed - np.tensordot(alpha, self._values, 1))

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient: by the decoder's adjoint, else by differences."""
        gap = self._gap(alpha)
        size = np.linalg.norm(gap, axis=-1)
        value = float(size.mean())
        if not isinstance(self.decoder, Adjoint):
            moved = [np.linalg.norm(self._gap(alpha + step), axis=-1).mean() for step in STEP * np.eye(len(alpha))]
            return value, (np.array(moved) - value) / STEP
        by = gap / np.where(size > 0, size, 1.0)[:, None] / len(gap)
        weights = mixed_weights(self.bank, self.whole(alpha))
        pulled = np.asarray(self.decoder.adjoint(self.bank.shared, weights, self._probes, by), np.float32)
        own = np.asarray(self.bank.weights @ pulled, float)[self.active]
        return value, own - np.einsum("nmc,mc->n", self._values, by)


@dataclass(frozen=True, eq=False)
class LeastJacobian:
    """The least ratio of volumes by which a moved template changes space, smoothed from below, with its gradient.

    It is for decoders whose motion is linear in their weights, so that one look at each exemplar tells all.
    """

    name: str
    bank: Bank
    decoder: Decoder
    active: Array

    @cached_property
    def _slopes(self) -> Array:
        """(n, M, 3, 3) ∂x_i/∂X_j of each exemplar that takes part."""
        chosen = self.bank.probes[seen(len(self.bank.probes))]
        points = np.asarray(chosen[:: max(1, len(chosen) // POINTS)], float)
        step = REACH * float(np.ptp(points, axis=0).max())
        sides = np.concatenate([points + side for axis in np.eye(3) * step for side in (axis, -axis)])
        rows = []
        for i in self.active:
            at = np.asarray(self.decoder.evaluate(self.bank.shared, self.bank.weights[i], sides), float)
            both = at.reshape(3, 2, len(points), 3)
            rows.append(np.moveaxis((both[:, 0] - both[:, 1]) / (2 * step), 0, -1))
        return np.stack(rows)

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient."""
        motion = np.tensordot(alpha, self._slopes, 1)
        volume = np.linalg.det(motion)
        least = float(volume.min())
        share = np.exp(-SHARP * (volume - least))
        total = share.sum()
        a, b, c = motion.transpose(1, 0, 2)
        by = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1) * (share / total)[:, None, None]
        return least - float(np.log(total)) / SHARP, np.einsum("nmij,mij->n", self._slopes, by)


def safeguard(
    name: str,
    bank: Bank,
    decoder: Decoder,
    limit: float,
    *,
    centre: Array,
    whole: Callable[[Array], Array],
    active: Array,
) -> Term:
    """The check `name` as a constraint: at most 0 where it keeps to its limit.

    Raises
    ------
    StudyError
        If it cannot be one, or means nothing for this decoder.
    """
    if name == "alpha":
        inner = limit * (1 - WITHIN)
        return shaped(
            f"safe {name}", Distance(name, centre), offset=inner**2, factor=1 / max(limit, 1e-9) ** 2, tell=_distance
        )
    if name == "mismatch":
        term = Mismatch(name, bank, decoder, whole, active)
        return shaped(f"safe {name}", term, offset=limit, factor=1 / max(limit, 1e-9))
    if name == "jacobian":
        if not isinstance(decoder, Displace) or isinstance(decoder, Corresponding):
            raise StudyError(
                f"safe: 'jacobian' is of decoders that move space and a template in it, and {bank.decoder.name!r} does "
                "not"
            )
        return shaped(f"safe {name}", LeastJacobian(name, bank, decoder, active), offset=LEAST, factor=-1.0)
    raise StudyError(f"safe: expected one of {', '.join(NAMES)}, got {name!r}")


def _distance(squared: float) -> float:
    """The limit of the check that a constraint stands for."""
    return sqrt(squared) / (1 - WITHIN)


def judged_by(bank: Bank, safe: Sequence[str]) -> Array:
    """(M,) which probes the verdict comes from: those that no search has seen."""
    count = len(bank.probes)
    return ~seen(count) if "mismatch" in safe and count > SHARE else np.ones(count, bool)
