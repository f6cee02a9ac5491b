"""A bank with weights stored by few directions: smaller in the file and in memory, faster to mix, its error stated.

The directions are the principal ones of the exemplars' weights; how many it takes is judged by what decoders say, not
by weights. Networks need nearly as many as there are exemplars; moved templates of a family a few more than the family
has parameters.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import cast

import numpy as np

from lampopt.bank import decoder_of, uncalibrated
from lampopt.errors import InputError
from lampopt.plugins import Plugins
from lampopt.protocols import Decoder, Progress
from lampopt.types import Array, Bank
from lampopt.types.lowrank import LowRank
from lampopt.units import number

BLOCK = 1 << 16  # weights that are looked at together
LOOK = 2000  # probes that the number of directions is sought on
log = logging.getLogger("lampopt")


def compress(
    bank: Bank, error: float | str, *, plugins: Plugins | None = None, progress: Progress | None = None
) -> Bank:
    """`bank` with as few directions as keep what its exemplars' decoders say within `error` on average.

    That is the mean over exemplars and probes of how far values change: distances, or places of a moved template
    [user's unit]. `provenance` states it (`low_rank.error`), the largest (`low_rank.worst`) and the number of
    directions (`low_rank.rank`). Limits that were calibrated are dropped: calibrate it anew.

    Parameters
    ----------
    error
        In the bank's unit, or with its own: "0.1 mm".

    Raises
    ------
    InputError
        If the error is no positive length.
    """
    wanted = number(error, bank.frame.unit, "error")
    if not wanted > 0:
        raise InputError(f"error: expected a positive length, got {error!r}")
    decoder, tell = decoder_of(bank, plugins or Plugins.load()), progress or (lambda done, message="", /: None)
    whole = _principal(bank)
    few = bank.probes[:: max(1, len(bank.probes) // LOOK)]
    said = _values(bank, decoder, bank.weights, few)
    low, high = 0, len(whole.directions)  # the least number of directions that is enough lies in between
    while low < high:
        rank = (low + high) // 2
        off = float(_off(_values(bank, decoder, _first(whole, rank), few), said).mean()) / bank.frame.scale
        tell(1 - (high - low) / len(whole.directions), f"{rank} directions: {off:.3g} {bank.frame.unit} off")
        log.info("%d directions: %.4g %s off", rank, off, bank.frame.unit)
        low, high = (low, rank) if off <= wanted else (rank + 1, high)
    while True:
        weights = _first(whole, low)
        values = _values(bank, decoder, weights, bank.probes)
        apart = _off(values, bank.probe_values) / bank.frame.scale
        if apart.mean() <= wanted or low == len(whole.directions):
            break
        low += 1  # the few probes told too little
    stated: dict[str, float] = {"rank": low, "error": float(apart.mean()), "worst": float(apart.max())}
    made = uncalibrated(bank)
    return replace(
        made,
        weights=cast("Array", weights),  # it behaves as one
        probe_values=values,
        path=None,
        provenance={**made.provenance, **{f"low_rank.{name}": value for name, value in stated.items()}},
    )


def _principal(bank: Bank) -> LowRank:
    """All principal directions of the weights, the widest first; no second copy of the bank on the way."""
    n, size = bank.weights.shape
    gram = np.zeros((n, n))
    middle = np.empty(size, np.float32)
    parts = [slice(first, first + BLOCK) for first in range(0, size, BLOCK)]
    for part in parts:
        block = np.asarray(bank.weights[:, part], float)
        middle[part] = block.mean(0)
        block -= block.mean(0)
        gram += block @ block.T
    squares, vectors = np.linalg.eigh(gram)
    order = np.argsort(-squares)[: max(n - 1, 0)]
    order = order[squares[order] > 1e-12 * squares.max(initial=0)]
    spread, vectors = np.sqrt(squares[order]), vectors[:, order]
    directions = np.empty((len(order), size), np.float32)
    for part in parts:
        directions[:, part] = (vectors / spread).T @ (np.asarray(bank.weights[:, part], float) - middle[part])
    return LowRank(middle, (vectors * spread).astype(np.float32), directions)


def _first(whole: LowRank, rank: int) -> LowRank:
    return LowRank(whole.middle, whole.coefficients[:, :rank], whole.directions[:rank])


def _values(bank: Bank, decoder: Decoder, weights: Array | LowRank, points: Array) -> Array:
    return np.stack([np.asarray(decoder.evaluate(bank.shared, row, points), np.float32) for row in weights])


def _off(values: Array, wanted: Array) -> Array:
    return np.asarray(np.linalg.norm(np.asarray(values, float) - wanted, axis=-1))
