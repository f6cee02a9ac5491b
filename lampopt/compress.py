"""A bank with weights stored by few directions: smaller in the file and in memory, faster to mix, its error stated.

The directions are the principal ones of the exemplars' weights; how many it takes is judged by what decoders say, not
by weights. Networks need nearly as many as there are exemplars; moved templates of a family a few more than the family
has parameters.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lampopt.bank import decoder_of, hashed, uncalibrated
from lampopt.errors import InputError
from lampopt.plugins import Plugins, returned
from lampopt.progress import silent
from lampopt.protocols import Decoder, Progress
from lampopt.types import Array, Bank, LowRank, expect_bank
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
    directions (`low_rank.rank`). What exemplars say at the probes stays what was fitted, so that the check `mismatch`
    sees what was left out; `fit_error` and what was measured stay so, too. Limits that were calibrated are dropped:
    calibrate it anew.

    Parameters
    ----------
    error
        In the bank's unit, or with its own: "0.1 mm".

    Raises
    ------
    InputError
        If the error is no positive length, if no number of directions keeps it and takes less room than the weights
        themselves, or if the bank is compressed already.
    PluginError
        If the decoder answers with something else than when the bank was built.
    """
    expect_own_weights(bank, "compress")
    wanted = number(error, bank.frame.unit, "error")
    if not wanted > 0:
        raise InputError(f"error: expected a positive length, got {error!r}")
    decoder, tell = decoder_of(bank, plugins or Plugins.load()), progress or silent
    vectors, spread = _principal(bank)
    step = max(1, len(bank.probes) // LOOK)
    few, said = bank.probes[::step], bank.probe_values[:, ::step]
    low, high = 0, len(spread)  # the least number of directions that is enough lies in between
    while low < high:
        rank = (low + high) // 2
        off = float(_off(_values(bank, decoder, vectors[:, :rank], few), said).mean()) / bank.frame.scale
        tell(1 - (high - low) / len(spread), f"{rank} directions: {off:.3g} {bank.frame.unit} off")
        log.info("%d directions: %.4g %s off", rank, off, bank.frame.unit)
        low, high = (low, rank) if off <= wanted else (rank + 1, high)
    apart = _off(_values(bank, decoder, vectors[:, :low], bank.probes), bank.probe_values) / bank.frame.scale
    while apart.mean() > wanted and low < len(spread):  # the few probes told too little
        low += 1
        apart = _off(_values(bank, decoder, vectors[:, :low], bank.probes), bank.probe_values) / bank.frame.scale
    weights = _along(bank, vectors[:, :low], spread[:low])
    if apart.mean() > wanted or weights.nbytes >= bank.weights.nbytes:
        raise InputError(
            f"error: {low} directions of {len(bank)} exemplars are {apart.mean():.3g} {bank.frame.unit} off and take "
            f"{weights.nbytes / bank.weights.nbytes:.0%} of the weights' room: nothing is gained; allow more than "
            f"{error!r}, or leave the bank as it is"
        )
    stated = {"rank": low, "error": float(apart.mean()), "worst": float(apart.max())}
    made = uncalibrated(bank)
    about = {**made.provenance, "plan": hashed([made.provenance.get("plan"), "compress", low])}
    return replace(
        made,
        weights=weights,
        path=None,
        provenance={**about, **{f"low_rank.{name}": value for name, value in stated.items()}},
    )


def expect_own_weights(bank: Bank, who: str) -> None:
    """Raise InputError where `who` is given a compressed bank, or none at all."""
    expect_bank(bank, who)
    if isinstance(bank.weights, LowRank):
        raise InputError(f"{who}: expected a bank with its own weights, got a compressed one: take what it was made of")


def _principal(bank: Bank) -> tuple[Array, Array]:
    """How exemplars lie along the principal directions of their weights (N, r), the widest first; and how wide (r,)."""
    n, size = bank.weights.shape
    gram = np.zeros((n, n))
    for first in range(0, size, BLOCK):  # no second copy of the bank
        block = np.asarray(bank.weights[:, first : first + BLOCK], float)
        block -= block.mean(0)
        gram += block @ block.T
    squares, vectors = np.linalg.eigh(gram)
    order = np.argsort(-squares)[: n - 1]
    order = order[squares[order] > 1e-12 * squares.max(initial=0)]
    return vectors[:, order], np.sqrt(squares[order])


def _values(bank: Bank, decoder: Decoder, vectors: Array, points: Array) -> Array:
    """(N, M, C) what decoders say of the exemplars along these directions alone: mixes of the bank's own rows."""
    shares = vectors @ vectors.T
    shares += (1 - shares.sum(1, keepdims=True)) / len(bank)
    who, shape = f"decoder {bank.decoder.name!r}: evaluate", (len(points), bank.probe_values.shape[2])
    rows = (share @ bank.weights for share in shares.astype(np.float32))
    return np.stack([returned(who, decoder.evaluate(bank.shared, row, points), shape, np.float32) for row in rows])


def _along(bank: Bank, vectors: Array, spread: Array) -> LowRank:
    size = bank.weights.shape[1]
    middle, directions = np.empty(size, np.float32), np.empty((len(spread), size), np.float32)
    for first in range(0, size, BLOCK):
        part = slice(first, first + BLOCK)
        block = np.asarray(bank.weights[:, part], float)
        middle[part] = block.mean(0)
        directions[:, part] = (vectors / spread).T @ (block - block.mean(0))
    return LowRank(middle, (vectors * spread).astype(np.float32), directions)


def _off(values: Array, wanted: Array) -> Array:
    return np.asarray(np.linalg.norm(np.asarray(values, float) - wanted, axis=-1))
