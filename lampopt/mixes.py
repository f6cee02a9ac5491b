"""The mixes of a sweep's many targets, solved a batch at a time."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence

from lampopt.protocols import Solver
from lampopt.solve import Posed, solve, solve_many
from lampopt.types import Mix

BATCH = 256  # targets of a sweep that are solved together
Target = Mapping[str, float]


class Mixes:
    """The mixes of many targets. A batch is solved when the first of it is wanted, and only one is held.

    Batches are fixed by the order of the targets, so that a sweep that goes on ends with the very same coefficients.
    Where the first of a batch is not met exactly, all of it are solved one by one, each when it is wanted: they would
    have to be asked for their reasons anyway.

    Parameters
    ----------
    posed
        The problem that one target poses.
    solver
        What solves it.
    asked
        The targets, in order.
    """

    def __init__(self, posed: Callable[[Target], Posed], solver: Solver, asked: Sequence[Target]) -> None:
        self._posed, self._solver, self._asked = posed, solver, asked
        self._batches = list(_batches(asked))
        self._batch, self._solved = range(0), list[tuple[Posed, Mix]]()

    def at(self, number: int) -> tuple[Posed, Mix]:
        """The problem of one target, and its mix."""
        if number not in self._batch:
            self._batch = self._batches[bisect_right(self._batches, number, key=lambda batch: batch.start) - 1]
            self._solved = self._together([self._asked[i] for i in self._batch])
        return self._solved[number - self._batch.start] if self._solved else self._alone(self._asked[number])

    def _together(self, targets: Sequence[Target]) -> list[tuple[Posed, Mix]]:
        """The whole batch, or nothing where that is of no use."""
        if len(targets) == 1:
            return []
        posed, first = self._alone(targets[0])
        if posed.nonlinear:
            return []  # each has terms of its own
        return [(posed, mix) for mix in solve_many(posed, targets, self._solver)] if first.status == "exact" else []

    def _alone(self, target: Target) -> tuple[Posed, Mix]:
        posed = self._posed(target)
        return posed, solve(posed, self._solver)


def _batches(asked: Sequence[Target]) -> Iterator[range]:
    """Neighbours that ask for the same names, `BATCH` at most."""
    for _, same in itertools.groupby(range(len(asked)), key=lambda i: tuple(asked[i])):
        found = list(same)
        yield from (range(first, min(first + BATCH, found[-1] + 1)) for first in found[::BATCH])
