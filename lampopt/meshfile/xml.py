"""XML read once through, element by element: nothing of it is kept, no entity is expanded, nothing else is opened."""

from __future__ import annotations

from collections.abc import Callable
from typing import IO, Any
from xml.parsers import expat

from lampopt.errors import InputError
from lampopt.reading import brief

DEEPEST = 128  # elements within elements

Start = Callable[[str, dict[str, str]], None]
End = Callable[[str, str], None]


def walk(file: IO[bytes], start: Start, end: End, *, texts: frozenset[str] = frozenset()) -> None:
    """Tell `start` (name, attributes) and `end` (name, text) of every element, names without namespaces.

    The text is that of elements named in `texts`; of others it is "".

    Raises
    ------
    InputError
        If it is no XML, nests too deep, or declares a document type, which is where entities come from.
    """
    names: list[str] = []
    pieces: list[str] = []

    def started(name: str, attributes: dict[str, str]) -> None:
        names.append(name.rpartition(":")[2])
        pieces.clear()
        if len(names) > DEEPEST:
            raise InputError(f"expected at most {DEEPEST} elements within elements, got more")
        start(names[-1], attributes)

    def ended(_: str) -> None:
        name = names.pop()
        end(name, "".join(pieces) if name in texts else "")
        pieces.clear()

    def text(piece: str) -> None:
        if names and names[-1] in texts:
            pieces.append(piece)

    def doctype(*_: Any) -> None:
        raise InputError("expected no document type and no entities (<!DOCTYPE>), got one: remove it")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = started, ended
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text, doctype
    try:
        parser.ParseFile(file)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"expected XML, got something else: {brief(error)}") from error
