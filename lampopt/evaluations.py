"""What a search has evaluated, line by line in a file of the run folder, so that one that was stopped goes on.

A search that starts again asks for the same coefficients in the same order; what stands here is answered from here. A
line that a kill has cut short is left out, and what it said evaluated again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.errors import InputError, SweepError
from lampopt.progress import silent
from lampopt.types import Array

FILE = "evaluations.jsonl"
Known = dict[bytes, tuple[float, Array | None]]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One value, called `name`, at alpha (n,) of a search for `design`; `seconds` since the one before."""

    design: str
    name: str
    alpha: Array
    value: float
    gradient: Array | None
    seconds: float


@dataclass(eq=False)
class Memory:
    """What the search for one design knows, where it notes what it learns (`file`, if any), and its `listener`."""

    design: str = ""
    file: Path | None = None
    listener: Callable[[str], None] = silent
    _count: int = 0
    _known: dict[str, Known] = field(default_factory=dict)
    _since: float = field(default_factory=time.perf_counter)

    @classmethod
    def at(cls, folder: Path, design: str, listener: Callable[[str], None] = silent) -> Memory:
        """That of a search in a run folder."""
        found = cls(design, folder / FILE, listener)
        for one in evaluations(folder):
            if one.design == design:
                found.known(one.name)[one.alpha.tobytes()] = one.value, one.gradient
        return found

    def known(self, name: str) -> Known:
        """Value and gradient by alpha of what is called `name`."""
        return self._known.setdefault(name, {})

    def tell(self, name: str, alpha: Array, value: float, gradient: Array | None) -> None:
        """Note one evaluation.

        Raises
        ------
        SweepError
            If it cannot be written.
        """
        now = time.perf_counter()
        seconds, self._since = now - self._since, now
        self._count += 1
        self._note(name, alpha, value, gradient, seconds)
        self.listener(f"evaluation {self._count}: {name} {value:.6g}")

    def _note(self, name: str, alpha: Array, value: float, gradient: Array | None, seconds: float) -> None:
        if self.file is None:
            return
        row = [self.design, name, _text(alpha), value, None if gradient is None else _text(gradient), seconds]
        try:
            with self.file.open("a+b") as file:
                if file.tell() and not _ends_well(self.file):
                    file.write(b"\n")  # a kill cut the last line short
                file.write(json.dumps(row).encode() + b"\n")
        except OSError as error:
            raise SweepError(f"{self.file}: cannot be written: {error}; what is recorded there is kept") from error


def evaluations(folder: Path) -> Iterator[Evaluation]:
    """All that stands in a run folder, in its order; lines that are none are left out."""
    try:
        lines = (folder / FILE).read_bytes().split(b"\n")
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{folder / FILE}: cannot be read: {error}") from error
    for line in lines:
        try:
            yield _read(json.loads(line))
        except (ValueError, TypeError, OverflowError, RecursionError):
            continue


def _read(row: Any) -> Evaluation:
    design, name, alpha, value, gradient, seconds = row
    if not (isinstance(design, str) and isinstance(name, str)):
        raise TypeError("expected names")
    by = None if gradient is None else np.frombuffer(bytes.fromhex(gradient))
    at = np.frombuffer(bytes.fromhex(alpha))
    if by is not None and by.shape != at.shape:
        raise ValueError("expected a gradient of the coefficients' length")
    return Evaluation(design, name, at, float(value), by, float(seconds))


def _text(values: Array) -> str:
    return np.asarray(values, float).tobytes().hex()


def _ends_well(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, 2)
        return file.read(1) == b"\n"
