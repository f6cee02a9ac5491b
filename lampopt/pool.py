"""Processes of this machine that work for this one: they end with it, and Ctrl-C stops what they are at."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

OURS = threading.Event()  # set in the processes that `processes` starts, and nowhere else


def processes(count: int) -> Executor:
    """So many processes of this machine; they end with this one, also if it is killed, and silently at Ctrl-C."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    # Spawned, since a fork of a process with threads may hang.
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _serve)


def _serve() -> None:
    from multiprocessing import parent_process

    OURS.set()
    signal.signal(signal.SIGINT, _noted)

    def follow() -> None:
        if (parent := parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _noted(*_: object) -> None:
    """Ctrl-C between two designs: from now on it is ignored, which says that no other is to be begun."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raised(*_: object) -> None:
    """Ctrl-C in a design."""
    _noted()
    raise KeyboardInterrupt


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C, which reaches workers too, stop a design; one stopped while it answers would leave us waiting.

    A worker that it has reached begins no other design, though some wait in its queue, from where none is called back.
    """
    if not OURS.is_set():  # what Ctrl-C does in somebody's own process is theirs to say
        yield
        return
    if signal.signal(signal.SIGINT, _raised) is signal.SIG_IGN:
        _raised()
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is _raised:
            signal.signal(signal.SIGINT, _noted)
