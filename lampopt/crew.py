"""What an executor tells of those who work for it: how many they are, and whether all of them are lost.

`concurrent.futures` has no word for it. The standard library's executors, and those made after them, know their
`_max_workers`; Dask's `Client.get_executor()` knows its client, and that the cluster. Dask is imported only where it is
there already.
"""

from __future__ import annotations

import logging
import math
import os
import time
from concurrent.futures import BrokenExecutor, CancelledError, Executor
from traceback import walk_tb
from typing import Any

from lampopt.reading import why

LOOK = 1.0  # s between two looks at a cluster
PATIENCE = 300.0  # s for another worker to come where all are lost
log = logging.getLogger("lampopt")


class Crew:
    """Those who work for `executor`; a cluster's are counted once a second at most."""

    def __init__(self, executor: Executor) -> None:
        client, workers = getattr(executor, "_client", None), getattr(executor, "_max_workers", None)
        self._client: Any = client if clusters(client) else None
        self._count = workers if isinstance(workers, int) else None
        self._had, self._looked, self._none_since = False, -math.inf, math.inf

    @property
    def ahead(self) -> int:
        """How many designs may be under way or done and not taken, so that nobody waits: two a worker, or a core."""
        self._look()
        return 2 * max(os.cpu_count() or 1, self._count or 0)

    def expect(self) -> None:
        """Go on waiting: for a cluster's first worker as long as it takes, where all are lost some minutes.

        Raises
        ------
        BrokenExecutor
            If no other has come then.
        """
        self._look()
        if self._had and time.monotonic() - self._none_since > (patience := _patience()):
            raise BrokenExecutor(f"all that the cluster had, and in {patience:g} s no other has come")

    def _look(self) -> None:
        now = time.monotonic()
        if self._client is None or now - self._looked < LOOK:
            return
        self._looked, before, self._count = now, self._count, self._counted()
        if self._count > 0:
            self._had, self._none_since = True, math.inf
        elif before != 0:
            self._none_since = now
            log.warning("no worker of the cluster is there: designs wait for one")

    def _counted(self) -> int:
        try:  # a client that looks for its scheduler would keep us waiting
            return sum(self._client.nthreads().values()) if self._client.status == "running" else 0
        except Exception as error:  # noqa: BLE001  # whatever a stranger's cluster raises
            log.info("the cluster does not say how many work for it: %s", why(error))
            return 0


def _patience() -> float:
    """Dask's own limit where it is set: what no worker takes fails then anyway."""
    from dask.config import get
    from dask.utils import parse_timedelta

    limit = get("distributed.scheduler.no-workers-timeout", None)
    return PATIENCE if limit is None else float(parse_timedelta(limit))


def lost(error: Exception) -> bool:
    """Whether `error` says that workers are lost, not that a design failed: it is the executor's own."""
    return isinstance(error, BrokenExecutor | CancelledError) or clusters(error)


def clusters(thing: object) -> bool:
    """Whether a client or an error is Dask's; an error then says what became of a design, not what is wrong with it."""
    if _own(thing):
        return True
    # Its executor stumbles over a result that is lost between being there and being fetched.
    frames = [frame for frame, _ in walk_tb(thing.__traceback__)] if isinstance(thing, Exception) else []
    if not frames or frames[-1].f_globals.get("__name__") != "distributed.cfexecutor":
        return False
    return bool(frames[-1].f_locals.get("status", "error") != "error")


def given_up(error: Exception) -> str:
    """Why a cluster has given a design up."""
    return why(error) if _own(error) else "what it gave was lost before it was fetched"


def _own(thing: object) -> bool:
    return any(cls.__module__.partition(".")[0] == "distributed" for cls in type(thing).__mro__)
