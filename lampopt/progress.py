"""How far long work has come, for people: on standard error, so that standard output stays free for results."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

from lampopt.protocols import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import Task

EVERY = 30.0  # s between lines where there is no terminal
WINDOW = 300.0  # s of past speed that the time left is told from
WIDE = 140  # columns where there is no terminal to tell


def silent(told: object, message: str = "", /) -> None:
    """Tells nobody: a `Progress`, and what takes a message alone, where none is given."""


@cache
def console() -> Console:
    """The one console of this process, on standard error."""
    from rich.console import Console

    wide = None if sys.stderr.isatty() else WIDE
    return Console(stderr=True, width=wide, markup=False, highlight=False, emoji=False)


@contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """Show how far the work in the block has come.

    On a terminal a bar with the time elapsed and left, gone when the block ends; a pulsing one until something is
    reported. Elsewhere (a log, a pipe) a line every half minute, so that short work says nothing.

    >>> with progress_bar("fitting") as progress:
    ...     bank = build_bank(exemplars, progress=progress)

    Parameters
    ----------
    title
        What is going on.

    Yields
    ------
    Progress
        To be called with the part done, from 0 to 1, and a message.
    """
    if not console().is_terminal:
        yield _Lines(title)
        return
    with _bar() as bar:
        task = bar.add_task(title, total=None, message="")

        def progress(done: float, message: str = "", /) -> None:
            bar.update(task, total=1.0, completed=done, message=message)

        yield progress


def _bar() -> Bar:
    from rich.progress import (
        BarColumn,
        ProgressColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar
    from rich.table import Column
    from rich.text import Text

    class Message(ProgressColumn):
        """What gives way on a narrow terminal, in one line."""

        def render(self, task: Task) -> Text:
            return Text(task.fields["message"], no_wrap=True, overflow="ellipsis")

    whole = Column(no_wrap=True)
    return Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(20, table_column=whole),
        TaskProgressColumn(table_column=whole),
        TimeElapsedColumn(table_column=whole),
        TextColumn("left"),
        TimeRemainingColumn(table_column=whole),
        Message(),
        console=console(),
        transient=True,
        speed_estimate_period=WINDOW,
    )


class _Lines:
    """A plain line now and then."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._began = self._said = time.monotonic()
        self._first: tuple[float, float] | None = None

    def __call__(self, done: float, message: str = "", /) -> None:
        now = time.monotonic()
        if self._first is None:  # resumed work starts above 0: what was done before tells nothing of its speed
            self._first = (now, done)
        if now - self._said < EVERY:
            return
        self._said = now
        since, before = self._first
        left = f", {_clock((now - since) * (1 - done) / (done - before))} left" if done > before else ""
        about = f" ({message})" if message else ""
        console().print(f"{self._title}: {done:.0%}, {_clock(now - self._began)} elapsed{left}{about}", soft_wrap=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
