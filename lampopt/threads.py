"""How many threads linear algebra may use, where the default loses by it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[Any]:
    """One BLAS thread within: matrices of a solver's size lose orders of magnitude to more."""
    limit: AbstractContextManager[Any] = _libraries().limit(limits=1, user_api="blas")
    return limit


@cache
def _libraries() -> ThreadpoolController:
    """The thread pools of this process, looked for once: that takes ten times as long as a solve."""
    return ThreadpoolController()
