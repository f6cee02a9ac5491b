"""Files that someone else wrote: opened only where they are files, and no larger than can be meant."""

from __future__ import annotations

import stat
from collections.abc import Callable
from pathlib import Path

from lampopt.errors import InputError

LARGEST = 2**31  # bytes of a file that is read whole
SHOWN = 200  # characters of a stranger's text in a message


def brief(value: object) -> str:
    """`value` as text for a message: the first of it where it is long, nothing that a terminal would obey."""
    text = "".join(c if c.isprintable() else " " for c in str(value)[: 4 * SHOWN])
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}…"


def path_of(value: object, what: str) -> Path:
    """`value` as a Path. Raises InputError naming `what` where it is none, or no file can be called so."""
    if not isinstance(value, str | Path) or not str(value) or "\0" in str(value):
        raise InputError(f"{what}: expected a path, got {brief(repr(value))}")
    return Path(value)


def plain_file(path: object, *, kind: str = "file", largest: int | None = None) -> Path:
    """`path` as a Path, if a plain file is there that is at most `largest` bytes long.

    A pipe could keep a reader waiting for ever, and a device has no end; neither is opened.

    Raises
    ------
    InputError
        Saying what is there instead; the caller names the file.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"expected the path of a {kind}, got {brief(repr(path))}")
    path = Path(path)
    try:
        found = path.stat()
    except FileNotFoundError as error:
        raise InputError(f"no such file; a relative path starts at {Path.cwd()}") from error
    except (OSError, ValueError) as error:  # a name too long, one with a NUL, a folder that may not be entered
        raise InputError(f"cannot be opened: {why(error)}") from error
    if stat.S_ISDIR(found.st_mode):
        raise InputError(f"expected a {kind}, got a folder")
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"expected a {kind}, got a pipe or a device")
    if largest is not None and found.st_size > largest:
        raise InputError(f"expected at most {largest:,} bytes, got {found.st_size:,}")
    return path


def content(path: object, *, largest: int = LARGEST) -> bytes:
    """All bytes of the plain file at `path`. Raises InputError as `plain_file`, and where it may not be read."""
    path = plain_file(path, largest=largest)
    try:
        return path.read_bytes()
    except (OSError, MemoryError) as error:
        raise InputError(f"cannot be opened: {why(error)}") from error


def why(error: Exception) -> str:
    """What an exception says, in brief; its kind where it says nothing."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return brief(error) or type(error).__name__


def readdressed(address: str, way: Callable[[str], str]) -> str:
    """The address of a measured value, `measure.value` or `file:value`: the file that it may name by another way."""
    file, sign, value = address.rpartition(":")
    return f"{way(file)}{sign}{value}" if file else address


def unplaced(address: str) -> str:
    """The same, wherever the file lies."""
    return readdressed(address, lambda file: "")
