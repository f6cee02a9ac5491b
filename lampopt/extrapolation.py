"""How much of a widened parameter space a bank reaches safely (paper, appendix Q), judged without a mesh."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, log10, sqrt

import numpy as np

from lampopt.angles import deviations
from lampopt.bank import decoder_of
from lampopt.check import Limits, alpha_checks, linearity_checks, mismatches
from lampopt.errors import InputError
from lampopt.mix import mixed_weights
from lampopt.plugins import Plugins
from lampopt.protocols import Progress, Solver
from lampopt.solve import column, pose, solve_many
from lampopt.types import Array, Bank, Spec
from lampopt.units import number, whole

BATCH = 256  # targets that are solved together
VALUES = 4_000_000  # of decoders at probes that are held at once
MOST_FACTOR, MOST_COUNT = 1e3, 1_000_000
PAPER = 0.01  # the paper's epsilon for the mismatch [box]


@dataclass(frozen=True)
class Volume:
    """What became of `count` targets drawn evenly from the range of `parameters` widened by `factor`.

    `share` of them pass every check of alpha and field; it lies in `interval` with 95 % confidence (Wilson's).
    `ratio` = factor^d · share is the volume reached safely, in volumes of the bank's own range. `by_mismatch` is the
    share by the paper's criterion alone, a mismatch of at most 0.01. `rejected` counts designs by check that failed.
    """

    factor: float
    parameters: tuple[str, ...]
    count: int
    share: float
    interval: tuple[float, float]
    by_mismatch: float
    rejected: Mapping[str, int]

    @property
    def ratio(self) -> float:
        """factor^d · share, infinite where no number holds it."""
        known = len(self.parameters) * log10(self.factor) < 300
        return self.factor ** len(self.parameters) * self.share if known else inf * self.share


def extrapolation_volume(
    bank: Bank,
    f: float,
    count: int = 10_000,
    *,
    parameters: Sequence[str] | None = None,
    limits: Mapping[str, float] | None = None,
    solver: str | Spec = "kkt",
    seed: int = 0,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Volume:
    """The share of a widened parameter space that the checks of alpha and field let through.

    Parameters
    ----------
    f
        Range factor: all parameters are drawn at once from the bank's range widened by it about its middle. The paper's
        factor is f − 1.
    count
        Draws.
    parameters
        Those that are asked for; the others are left free. By default all that differ over the bank.
    limits
        Limits that replace the bank's and the defaults.
    seed
        Of the draws.

    Raises
    ------
    InputError
        If `f` or `count` is no positive number, or a parameter cannot be asked for.
    """
    if not isinstance(bank, Bank):
        raise InputError(f"bank: expected a Bank, got {bank!r:.80}; load one with load_bank(path)")
    f, count, seed = number(f, "", "f"), whole(count, "count", 1, MOST_COUNT), whole(seed, "seed", 0)
    if not 0 < f <= MOST_FACTOR:
        raise InputError(f"f: expected a range factor above 0 and at most {MOST_FACTOR:g}, such as 2, got {f:g}")
    plugins = plugins or Plugins.load().report()
    if isinstance(parameters, str):
        raise InputError(f"parameters: expected a list of names, got {parameters!r}")
    names = tuple(parameters) if parameters is not None else tuple(q.name for q in bank.space if q.spread > 0)
    if not names or len(set(names)) < len(names):
        raise InputError(f"parameters: expected at least one that differs over the bank, each once, got {list(names)}")
    asked = [column(bank, name) for name in names]
    middle = np.array([c.low + c.spread / 2 for c in asked])
    half = np.array([c.spread / 2 for c in asked])
    draws = middle + f * half * np.random.default_rng(seed).uniform(-1, 1, (count, len(names)))
    rejected, valid, linear = Counter[str](), 0, 0
    judged = _judged(bank, names, draws, Limits.of(bank, limits or {}), solver, plugins)
    for done, (failed, mismatch) in enumerate(judged, 1):
        rejected.update(failed)
        valid += not failed
        linear += mismatch <= PAPER
        if progress and done % BATCH == 0:
            progress(done / count, f"{done:,} of {count:,} designs")
    if progress:
        progress(1.0, f"{count:,} designs")
    return Volume(f, names, count, valid / count, _wilson(valid, count), linear / count, dict(rejected))


def _judged(
    bank: Bank, names: Sequence[str], draws: Array, limits: Limits, solver: str | Spec, plugins: Plugins
) -> Iterator[tuple[list[str], float]]:
    """For each draw the checks that failed, and the mismatch."""
    decoder = decoder_of(bank, plugins)
    solving: Solver = plugins.make("solver", solver)
    held = max(1, VALUES // bank.probe_values[0].size)
    for first in range(0, len(draws), BATCH):
        targets = [dict(zip(names, row.tolist(), strict=True)) for row in draws[first : first + BATCH]]
        posed = pose(bank, targets[0])
        mixes = solve_many(posed, targets, solving)
        alpha = np.array([mix.alpha for mix in mixes])
        found = [
            (*mismatches(bank, decoder, part, mixed_weights(bank, part)), deviations(bank, decoder, part))
            for part in np.array_split(alpha, -(-len(alpha) // held))
        ]
        fields = np.stack([np.concatenate(parts) for parts in zip(*found, strict=True)], 1)
        for mix, field in zip(mixes, fields.tolist(), strict=True):
            checks = [*alpha_checks(posed, mix, limits), *linearity_checks(field, limits)]
            yield [check.name for check in checks if not check.passed], field[0]


def _wilson(passed: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson 1927)."""
    z = 1.959963984540054
    share, weight = passed / count, 1 / (1 + z * z / count)
    middle = weight * (share + z * z / (2 * count))
    reach = weight * z * sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return (0.0 if passed == 0 else middle - reach), (1.0 if passed == count else middle + reach)
