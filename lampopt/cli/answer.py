"""What every command has in common: one answer, shown to people or printed as JSON, and the exit codes."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from lampopt.cli.show import plain
from lampopt.errors import LampoptError
from lampopt.progress import console

if TYPE_CHECKING:
    from rich.console import RenderableType

DONE, REJECTED, WRONG, CRASHED, INTERRUPTED = 0, 1, 2, 70, 130
log = logging.getLogger("lampopt")


@dataclass(frozen=True)
class Answer:
    """What a command found: as a JSON document, as `shown` to people, and the exit code."""

    document: Mapping[str, Any]
    shown: Sequence[RenderableType] = ()
    code: int = DONE


class Command(click.Command):
    """A command whose function returns an `Answer`; it takes --json and --verbose.

    Parameters
    ----------
    resumes
        What to tell somebody who interrupts it.
    """

    def __init__(
        self,
        name: str | None,
        *,
        resumes: str = "nothing was written",
        params: list[click.Parameter] | None = None,
        **attributes: Any,
    ) -> None:
        super().__init__(name, params=[*(params or []), JSON, VERBOSE], **attributes)
        self.resumes = resumes

    def invoke(self, ctx: click.Context) -> int:
        """Run the function, print its answer, return the exit code."""
        as_json: bool = ctx.params.pop("as_json")
        try:
            with _standard_output_aside() if as_json else nullcontext():
                answer: Answer = super().invoke(ctx)
        except LampoptError as error:
            return refuse(type(error).__name__, str(error), WRONG, as_json=as_json)
        except KeyboardInterrupt:
            return refuse("Interrupted", f"interrupted: {self.resumes}", INTERRUPTED, as_json=as_json)
        if as_json:
            _print_json(answer.document)
        else:
            for item in answer.shown:
                whole = hasattr(item, "columns")  # text goes on one line, tables fold
                console().print(item if whole else plain(item), soft_wrap=not whole)
        return answer.code


@contextmanager
def _standard_output_aside() -> Iterator[None]:
    """What is printed goes to standard error, by processes that are begun here too: it must not spoil the document."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


class Group(click.Group):
    """A group of such commands."""

    command_class = Command
    group_class = type


def refuse(kind: str, message: str, code: int, *, as_json: bool) -> int:
    """Say what is wrong, to people or as JSON; returns `code`."""
    if as_json:
        _print_json({"error": {"type": kind, "message": message}})
    else:
        from rich.text import Text

        said = Text.assemble(("error: " if code == WRONG else "", "bold red"), message)
        console().print(plain(said), soft_wrap=True)
    return code


@contextmanager
def logged_to_stderr() -> Iterator[None]:
    """Show lampopt's warnings, and with --verbose its progress, on standard error while the block runs."""
    handler, before = _ToConsole(), log.level
    handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)


class _ToConsole(logging.Handler):
    """Through the console, so that a line does not tear a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        console().print(plain(self.format(record)), soft_wrap=True)


def _verbose(_: click.Context, __: click.Parameter, on: bool) -> None:
    if on:
        log.setLevel(logging.INFO)


JSON = click.Option(["--json", "as_json"], is_flag=True, help="Print one JSON document on standard output.")
VERBOSE = click.Option(
    ["-v", "--verbose"],
    is_flag=True,
    expose_value=False,
    callback=_verbose,
    help="Say what is going on, on standard error.",
)


def _print_json(document: Mapping[str, Any]) -> None:
    click.echo(json.dumps(_plain(document), indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    """`value` for JSON, which knows neither NaN nor infinity: both become null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and (value != value or abs(value) == float("inf")):
        return None
    return value
