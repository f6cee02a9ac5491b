"""A run's results, read one at a time: a short line about each, and an even choice of those to be shown in full."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from lampopt.solve import Column, columns
from lampopt.types import Array, Bank, Check, Result

T = TypeVar("T")
COMPARED = ("target", "alpha", "mismatch")  # checks whose values tell designs apart
FEW = 10  # of the accepted and of the rejected are shown, if there are so many


@dataclass(frozen=True)
class Line:
    """What is kept of every design.

    `worst` is the check nearest to its limit or farthest beyond, `score` how much of the limit it takes: above 1 the
    design is rejected. `predicted` is what the mix should have of all that can be asked;
    `values` are those, with their units, that checks report and do not judge: measures under their address, and others.
    `judged` has those checks by name that designs are compared by.
    """

    number: int
    target: Mapping[str, float]
    predicted: Mapping[str, float]
    accepted: bool
    failed: tuple[str, ...]
    worst: str
    score: float
    values: Mapping[str, tuple[float, str]]
    judged: Mapping[str, Check] = field(default_factory=dict)


@dataclass(frozen=True)
class Evaluation:
    """One step of a search: design `number` of it has this `value` of the objective, the least of which is sought.

    `violation` is how far the worst constraint is from being met, at most 0 where all are; `seconds` is what it took.
    """

    number: int
    value: float
    violation: float
    seconds: float

    @property
    def feasible(self) -> bool:
        """Whether every constraint is met; NaN does not tell that."""
        return self.violation <= 0


@dataclass(frozen=True)
class Gathered:
    """All lines, and the results that are shown in full, by their number."""

    lines: tuple[Line, ...]
    shown: Mapping[int, Result]

    @property
    def accepted(self) -> int:
        """How many designs are accepted."""
        return sum(line.accepted for line in self.lines)

    @property
    def single(self) -> bool:
        """Whether there is one design only."""
        return len(self.lines) == 1

    def rejections(self) -> list[tuple[str, int]]:
        """How many designs each check rejects, the most frequent first."""
        return Counter(name for line in self.lines for name in line.failed).most_common()

    def asked(self) -> dict[str, tuple[float, ...]]:
        """The distinct values asked of each name, ascending."""
        found: dict[str, set[float]] = {}
        for line in self.lines:
            for name, value in line.target.items():
                found.setdefault(name, set()).add(value)
        return {name: tuple(sorted(values)) for name, values in found.items()}


class Spread(Generic[T]):
    """Keeps between `most` and twice as many of what it is given, evenly spread, however much that comes to be."""

    def __init__(self, most: int) -> None:
        self._most, self._step, self._seen = most, 1, 0
        self._kept: list[T] = []

    def add(self, item: T) -> None:
        """One more."""
        if self._seen % self._step == 0:
            self._kept.append(item)
            if len(self._kept) > 2 * self._most:
                self._kept, self._step = self._kept[::2], 2 * self._step
        self._seen += 1

    def take(self, count: int) -> list[T]:
        """`count` of them at most, evenly spread, first and last among them."""
        return even(self._kept, count)


def even(items: Sequence[T], count: int) -> list[T]:
    """`count` of `items` at most, evenly spread."""
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)] if count else []


def gather(results: Iterable[Result], bank: Bank, most: int) -> Gathered:
    """Read `results` once; `most` of them are kept to be shown, accepted and rejected in the run's proportion."""
    known = columns(bank)
    lines: list[Line] = []
    kept = {True: Spread[tuple[int, Result]](most), False: Spread[tuple[int, Result]](most)}
    for number, result in enumerate(results, 1):
        line = _line(number, result, bank, known)
        lines.append(line)
        kept[line.accepted].add((number, result))
    good = sum(line.accepted for line in lines)
    bad = len(lines) - good
    room = round(most * good / len(lines)) if lines else 0
    room = min(max(room, min(good, FEW), most - bad), good, most - min(bad, FEW))
    return Gathered(tuple(lines), dict(sorted([*kept[True].take(room), *kept[False].take(most - room)])))


def predicted(bank: Bank, alpha: Array) -> dict[str, float]:
    """What a mix should have, by everything that can be asked for; NaN where an exemplar in the mix has no value."""
    return {name: _mixed(found, alpha) for name, found in columns(bank).items()}


def _mixed(found: Column, alpha: Array) -> float:
    used = np.abs(alpha) > 1e-9
    return float(alpha[used] @ found.values[used])


def _line(number: int, result: Result, bank: Bank, known: Mapping[str, Column]) -> Line:
    asked, alpha = dict(result.design.target), result.design.mix.alpha
    mixed = {name: _mixed(column, alpha) for name, column in known.items()}
    worst = max(result.checks, key=lambda check: check.score, default=None)
    failed = tuple(check.name for check in result.checks if not check.passed)
    values = {c.name: (c.value, c.unit) for c in result.checks if c.sense == "info"}
    judged = {c.name: c for c in result.checks if c.name in COMPARED}
    name = "" if worst is None else worst.name
    return Line(number, asked, mixed, result.accepted, failed, name, result.score, values, judged)
