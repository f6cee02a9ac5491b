"""Placements of the grid, several at a time; for one without a good grid the next serves."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from itertools import islice
from threading import Event
from typing import TypeVar

from .outcomes import FlowError

T = TypeVar("T")
log = logging.getLogger("lampopt.openfoam")


def on_placements(
    solve: Callable[[int, Event], T], first: int, count: int, workers: int
) -> tuple[list[T], list[FlowError]]:
    """What `solve` gives on `count` placements from the one numbered `first`, and why others gave nothing.

    How cells happen to lie says nothing of the flow: for a placement without a good grid the next serves, up to twice
    as far. The results do not depend on `workers`.

    Parameters
    ----------
    solve
        Takes the number, and what is set when nobody waits for it any more: threads only watch OpenFOAM's processes.

    Raises
    ------
    FlowError
        Whatever else `solve` raises, and the last bad grid where too many are bad. What is under way is ended.
    """
    done, bad, stop = list[T](), list[FlowError](), Event()
    numbers = iter(range(first, first + 2 * count))
    with ThreadPoolExecutor(workers) as pool:
        try:
            while len(done) < count:
                batch = [pool.submit(solve, number, stop) for number in islice(numbers, count - len(done))]
                for future in as_completed(batch):  # what ends all is told as soon as it comes
                    if not _bad(future):
                        future.result()
                done += [future.result() for future in batch if not _bad(future)]
                for error in filter(None, map(_bad, batch)):
                    if len(bad) == count:
                        raise error
                    bad.append(error)
                    log.warning("%s; the next placement serves", error)
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
    return done, bad


def _bad(future: Future[T]) -> FlowError | None:
    """That a placement has no good grid, where it has none."""
    error = future.exception()
    return error if isinstance(error, FlowError) and error.outcome == "bad-grid" else None
