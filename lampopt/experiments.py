"""Designs of experiments: which targets a sweep asks for when all of them are to say as much as they can together."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.choices import Value, native, table_of, value_pair
from lampopt.errors import StudyError
from lampopt.lamp import load_bank
from lampopt.solve import Column, column
from lampopt.types import Array, Bank
from lampopt.types.arrays import Table, assign
from lampopt.units import number, said

METHODS = ("latin-hypercube", "sobol", "halton", "random", "corners")
MOST = 100_000  # designs of a sweep


@dataclass(frozen=True)
class Experiments:
    """A plan of targets between a low and a high value each: ``Experiments({"roof": (1.30, 1.42)}, 64)``.

    Parameters
    ----------
    ranges
        Low and high value by name: numbers in the bank's unit, or text with a unit ("1420 mm"). The order in which they
        are written does not matter.
    count
        How many targets; None for `corners`, which are all of them.
    method
        `latin-hypercube`: each range is cut into `count` equal parts, and every part of every range holds one target.
        `sobol`, `halton`: the first of a scrambled sequence that fills the ranges evenly; a Sobol sequence does so best
        where `count` is a power of two. `random`: independent. `corners`: every low with every high value, 2^d targets
        for d ranges, in the order of a sweep.
    seed
        Of the draws: the same seed, the same plan. A larger `count` continues a plan of `sobol`, `halton` or `random`,
        whose targets are its first; a Latin hypercube of another count is another one.
    """

    ranges: Mapping[str, tuple[Value, Value]] = field(hash=False)
    count: int | None = None
    method: str = "latin-hypercube"
    seed: int = 0

    def __post_init__(self) -> None:
        table = table_of(self.ranges, "experiments: ranges")
        ranges = {name: value_pair(pair, f"experiments: ranges: {name}") for name, pair in table.items()}
        assign(self, ranges=Table(ranges), count=native(self.count), seed=native(self.seed))
        if not ranges:
            raise StudyError("experiments: ranges: expected a low and a high value by name, got none")
        if self.method not in METHODS:
            raise StudyError(f"experiments: method: expected one of {', '.join(METHODS)}, got {said(self.method)}")
        if self.method == "corners":
            if self.count is not None:
                raise StudyError(f"experiments: count: expected none, for corners are all 2^d, got {said(self.count)}")
            if 2 ** len(ranges) > MOST:
                raise StudyError(
                    f"experiments: {len(ranges)} ranges have more than {MOST:,} corners: name fewer, or take another "
                    "method"
                )
        elif not _is_whole(self.count, 1, MOST):
            raise StudyError(
                f"experiments: count: expected a whole number from 1 to {MOST:,} for {self.method}, got "
                f"{said(self.count)}"
            )
        if not _is_whole(self.seed, 0, 2**63 - 1):
            raise StudyError(
                f"experiments: seed: expected a whole number of at least 0 and below 2**63, got {said(self.seed)}"
            )

    def tables(self, bank: Bank) -> list[dict[str, float]]:
        """The targets, each as a table of values by name [the bank's units], in the order of `ranges`.

        Raises
        ------
        StudyError
            If `bank` has no such name, no mix can change it, or low is not below high.
        InputError
            If a value is neither a number nor text with a unit that can become the bank's.
        """
        ends = {name: _ends(column(bank, name), pair) for name, pair in self.ranges.items()}
        if self.method == "corners":
            return [dict(zip(ends, corner, strict=True)) for corner in itertools.product(*ends.values())]
        names = sorted(ends)  # so that a plan does not depend on the order in which they are written
        low, high = np.array([ends[name] for name in names]).T
        share = self._shares(len(names))
        values = np.clip(low * (1 - share) + high * share, low, high)
        rows = (dict(zip(names, row, strict=True)) for row in values.tolist())
        return [{name: row[name] for name in ends} for row in rows]

    def _shares(self, d: int) -> Array:
        """`count` points (count, d) in the unit cube."""
        from scipy.stats import qmc

        count, rng = int(self.count or 0), np.random.default_rng(self.seed)
        if self.method == "random":
            return rng.random((count, d))
        if self.method == "sobol":  # drawn up to a power of two, where SciPy does not warn, and cut
            return np.asarray(qmc.Sobol(d, rng=rng).random_base2((count - 1).bit_length())[:count])
        sequence = qmc.Halton(d, rng=rng) if self.method == "halton" else qmc.LatinHypercube(d, rng=rng)
        return np.asarray(sequence.random(count))

    def written(self) -> dict[str, Any]:
        """The plan as a TOML table; `read` gives it back."""
        count = {} if self.count is None else {"count": self.count}
        ranges = {name: list(pair) for name, pair in self.ranges.items()}
        return {"method": self.method, **count, "seed": self.seed, "ranges": ranges}

    @classmethod
    def read(cls, table: object) -> Experiments:
        """The plan that a TOML table describes. Raises StudyError where it is none."""
        known = ("ranges", "count", "method", "seed")
        if not isinstance(table, Mapping) or not {"ranges"} <= set(table) <= set(known):
            raise StudyError(
                f"experiments: expected a table with ranges, and count, method and seed where wanted, got {said(table)}"
            )
        return cls(**table)


def experiments(
    bank: Bank | Path | str,
    ranges: Mapping[str, tuple[Value, Value]],
    count: int | None = None,
    *,
    method: str = "latin-hypercube",
    seed: int = 0,
) -> list[dict[str, float]]:
    """Targets for a sweep, spread over `ranges`: ``lampopt.sweep(study, experiments(bank, ranges, 64), folder)``.

    Parameters
    ----------
    bank
        The bank, or the path of its `.lamp` file.
    ranges, count, method, seed
        As in `Experiments`, which a study can hold instead: then the plan is in its file too.

    Returns
    -------
    list of dict
        `count` tables of values by name [the bank's units].

    Raises
    ------
    StudyError
        If the bank does not know a name, no mix can change it, or a range, count, method or seed cannot be used.
    """
    if not isinstance(bank, Bank | Path | str):
        raise StudyError(f"bank: expected a Bank or the path of a .lamp file, got {said(bank)}")
    plan = Experiments(ranges, count, method, seed)
    return plan.tables(bank if isinstance(bank, Bank) else load_bank(bank))


def _is_whole(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _ends(column: Column, pair: tuple[Value, Value]) -> tuple[float, float]:
    """A range in the bank's unit."""
    low, high = (number(value, column.unit, f"experiments: {column.name}") for value in pair)
    if not low < high:
        got = f"{low:g} and {high:g} {column.unit}".rstrip()
        raise StudyError(
            f"experiments: {column.name}: expected a low value below a high one, got {got}: what is held belongs among "
            "the study's targets or keep"
        )
    return low, high
