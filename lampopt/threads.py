"""How many threads linear algebra may use, where the default loses by it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from threading import Lock, get_ident
from typing import Any

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[Any]:
    """One BLAS thread within: matrices of a solver's size lose orders of magnitude to more."""
    return _one_thread()


class _OneThread(AbstractContextManager[None]):
    """Of a whole process: of threads that are in it side by side the first limits, and restores when it leaves.

    Each for itself would restore what another one has limited, and the last one leave that for good.
    """

    def __init__(self) -> None:
        self._libraries = ThreadpoolController()  # looked for once: that takes ten times as long as a solve
        self._lock, self._within = Lock(), 0
        self._holder: int | None = None
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if self._holder is None:
                self._holder, self._limit = get_ident(), self._libraries.limit(limits=1, user_api="blas")
                self._limit.__enter__()
            self._within += self._holder == get_ident()

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._within -= self._holder == get_ident()
            if self._holder == get_ident() and not self._within:
                self._limit.__exit__(None, None, None)
                self._holder = None


@cache
def _one_thread() -> _OneThread:
    return _OneThread()
