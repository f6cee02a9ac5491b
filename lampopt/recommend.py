"""What a comparison of decoders found, and which of them it speaks for: figures first, then words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Spec
from lampopt.types.arrays import assign, frozen_array

NOTHING = "nothing"  # the row of the nearest exemplar as it is
APART = 0.05  # of the larger error, which a difference has to exceed: nobody would choose for less
LITTLE = 1e-3  # of what the nearest exemplar is off, the same: two that are exact differ in their rounding
LEVEL = 0.95  # of the interval of the mean difference
DRAWS = 10_000  # of the bootstrap
DEARER = 2.0  # times as long is more than what else a machine may have had to do


@dataclass(frozen=True, eq=False)
class Compared:
    """One decoder, and how far it is off.

    Parameters
    ----------
    name
        The decoder with its options; `nothing` for the nearest exemplar as it is.
    decoder
        Its Spec; None for `nothing`.
    errors
        (n,) mean distance of the made surface to the true one, of each held-out exemplar [the exemplars' unit]; NaN
        where there was no surface.
    fit_errors
        (m,) the same of the inner exemplars, each decoded from its own weights.
    mean, worst
        Of `errors`; where there was no surface, the largest error that any row has there counts.
    accepted
        The share of held-out exemplars whose design passes every check.
    build_seconds, design_seconds
        What fitting the bank took; the median of what a mix and its mesh took. NaN where it is not known.
    weights
        Of each exemplar (D).
    refusal
        Why these exemplars cannot be fitted by it; then there are no figures.
    bank
        The file of its bank, if it was kept.
    """

    name: str
    decoder: Spec | None
    errors: Array
    fit_errors: Array
    mean: float = float("nan")
    worst: float = float("nan")
    accepted: float = float("nan")
    build_seconds: float = float("nan")
    design_seconds: float = float("nan")
    weights: int = 0
    refusal: str | None = None
    bank: Path | None = None

    def __post_init__(self) -> None:
        for name in ("errors", "fit_errors"):
            assign(self, **{name: frozen_array(getattr(self, name), f"comparison: {name}", (None,), nan=True)})

    @property
    def fit_mean(self) -> float:
        """Mean of the `fit_errors` that are known."""
        known = self.fit_errors[~np.isnan(self.fit_errors)]
        return float(known.mean()) if len(known) else float("nan")

    @property
    def fit_worst(self) -> float:
        """The largest of the `fit_errors` that are known."""
        known = self.fit_errors[~np.isnan(self.fit_errors)]
        return float(known.max()) if len(known) else float("nan")

    @property
    def lost(self) -> int:
        """How many of the held-out exemplars came without a surface."""
        return 0 if self.refusal is not None else int(np.isnan(self.errors).sum())


@dataclass(frozen=True, eq=False)
class Comparison:
    """What decoders make of exemplars that they were not shown (`lampopt.compare`).

    Parameters
    ----------
    unit
        Of all errors: the exemplars' length unit.
    inner, held_out
        Names of the exemplars that were fitted, and of those that were asked for.
    rows
        One for each decoder in the order given, then `nothing`.
    best
        The name of the row that is recommended; None where none is closer than the nearest exemplar as it is.
    reason
        Why, in words.
    """

    unit: str
    inner: tuple[str, ...]
    held_out: tuple[str, ...]
    rows: tuple[Compared, ...]
    best: str | None
    reason: str

    def row(self, name: str) -> Compared:
        """The row called `name`; InputError if there is none."""
        for row in self.rows:
            if row.name == name:
                return row
        raise InputError(f"row {name!r}: not compared; there are {', '.join(row.name for row in self.rows)}")


def counted(rows: Sequence[Compared]) -> tuple[Compared, ...]:
    """`rows` with mean and worst error, over all held-out exemplars."""
    worst = np.max([np.nan_to_num(row.errors, nan=0.0) for row in rows], axis=0)

    def figures(row: Compared) -> Compared:
        if row.refusal is not None:
            return row
        errors = np.where(np.isnan(row.errors), worst, row.errors)
        return replace(row, mean=float(errors.mean()), worst=float(errors.max()))

    return tuple(figures(row) for row in rows)


def recommended(rows: Sequence[Compared], unit: str, seed: int) -> tuple[str | None, str]:
    """The name of the row that is recommended, and why."""
    words = _Words(rows, unit, seed)
    nothing = next(row for row in rows if row.decoder is None)
    fitted = [row for row in rows if row.refusal is None and row is not nothing]
    useful = [row for row in fitted if row.mean < nothing.mean]
    if not useful:
        said = [words.off(row) for row in fitted]
        none = f"none is closer than the nearest exemplar as it is, {words.length(nothing.mean)}"
        more = "more exemplars would help, or a better fit" if fitted else "mend the exemplars, or try another decoder"
        return None, "; ".join([*said, none, *words.notes(fitted), *words.refusals(), more])
    first = min(useful, key=lambda row: row.mean)
    alike = [row for row in useful if row is not first and not words.apart(first, row)]
    best = reduce(_cheaper, alike, first)
    others = sorted((row for row in fitted if row is not best), key=lambda row: row.mean)
    equals = [row for row in others if row is first or row in alike]
    beaten = [words.against(best, row) for row in others if row not in equals]
    said = [", ".join([words.off(best), *beaten]), *(words.alike(best, row) for row in equals)]
    said += [words.beyond(best, nothing), words.checked(best), *words.notes(fitted), *words.refusals()]
    return best.name, "; ".join(said)


def _cheaper(one: Compared, other: Compared) -> Compared:
    """The one that takes less time, or where that does not tell fewer weights, or `one`."""
    if _slower(one, other):
        return other
    return one if _slower(other, one) or one.weights <= other.weights else other


def _slower(one: Compared, other: Compared) -> bool:
    return _seconds(one) > DEARER * _seconds(other)


def _seconds(row: Compared) -> float:
    return row.build_seconds + len(row.errors) * row.design_seconds


class _Words:
    """Sentences about `rows`."""

    def __init__(self, rows: Sequence[Compared], unit: str, seed: int) -> None:
        self._rows, self._unit, self._seed = rows, unit, seed
        self._worst = np.max([np.nan_to_num(row.errors, nan=0.0) for row in rows], axis=0)
        self._count = len(self._worst)
        self._little = LITTLE * next(row.mean for row in rows if row.decoder is None)

    def length(self, value: float) -> str:
        return f"{value:.3g} {self._unit}".rstrip()

    def gaps(self, best: Compared, row: Compared) -> Array:
        """By how much `row` is farther off than `best`, exemplar by exemplar."""
        one, other = (np.where(np.isnan(r.errors), self._worst, r.errors) for r in (best, row))
        return np.asarray(other - one)

    def interval(self, best: Compared, row: Compared) -> tuple[float, float]:
        """Where the mean difference lies, by the bootstrap over held-out exemplars."""
        gaps = self.gaps(best, row)
        draws = np.random.default_rng(self._seed).integers(self._count, size=(DRAWS, self._count))
        low, high = np.quantile(gaps[draws].mean(1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return float(low), float(high)

    def apart(self, best: Compared, row: Compared) -> bool:
        """Whether `best` is closer by more than noise."""
        least = max(APART * row.mean, self._little)
        return row.mean - best.mean > least and self.interval(best, row)[0] > 0

    def off(self, row: Compared) -> str:
        many = f"{self._count} held-out exemplars" if self._count > 1 else "1 held-out exemplar"
        return f"{row.name}: {self.length(row.mean)} off on {many}"

    def against(self, best: Compared, row: Compared) -> str:
        closer = int((self.gaps(best, row) > 0).sum())
        return f"against {self.length(row.mean)} of {row.name}, closer on {closer} of {self._count}"

    def alike(self, best: Compared, row: Compared) -> str:
        low, high = self.interval(best, row)
        noise = (
            f"{row.name} is alike with {self.length(row.mean)} (the difference is {low:.2g} to {high:.2g} {self._unit}"
        )
        return f"{noise.rstrip()}, {LEVEL:.0%} interval), {self._price(best, row)}"

    def _price(self, best: Compared, row: Compared) -> str:
        if _slower(row, best):
            return f"and dearer: {_seconds(row):.3g} s against {_seconds(best):.3g} s"
        if row.weights > best.weights:
            return f"and dearer: {row.weights} weights an exemplar against {best.weights}"
        return "and no cheaper"

    def beyond(self, best: Compared, nothing: Compared) -> str:
        said = f"the nearest exemplar as it is would be {self.length(nothing.mean)} off"
        return said if self.apart(best, nothing) else f"{said}, which the held-out exemplars do not tell apart"

    def checked(self, best: Compared) -> str:
        return f"{round(best.accepted * self._count)} of {self._count} designs pass every check"

    def notes(self, rows: Sequence[Compared]) -> list[str]:
        """What limits them: fits that are as far off as designs are, surfaces that are lost."""
        said = []
        for row in rows:
            if row.fit_mean > row.mean / 2:
                often = f"{row.name} is {self.length(row.fit_mean)} off on exemplars that it was fitted to"
                said.append(f"{often}: a better fit may change this")
            if row.lost:
                said.append(f"{row.name} has no surface for {row.lost} of {self._count}, counted as the worst there")
        return said

    def refusals(self) -> list[str]:
        return [f"{row.name} refuses: {row.refusal}" for row in self._rows if row.refusal is not None]
