"""What defines a class: a hash of its file, so that a plugin that is being written is not taken for what it was."""

from __future__ import annotations

import hashlib
import io
import sys
import tokenize
import uuid
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path


@cache
def source_of(cls: type) -> str:
    """A hash of the file that defines a class, with all that it may call there, but for comments and empty lines.

    Of the file as it is when it is first asked for: a process goes on with what it has imported. "" of a class that has
    no file, as it was typed at a prompt.
    """
    module = sys.modules.get(cls.__module__)
    file, loader = getattr(module, "__file__", None), getattr(module, "__loader__", None)
    if file is None:
        return ""
    read: Callable[[str], bytes] = getattr(loader, "get_data", lambda path: Path(path).read_bytes())  # an archive's too
    try:
        content = read(file)
    except OSError:
        return ""
    with suppress(SyntaxError, UnicodeDecodeError, tokenize.TokenError):  # it is no Python
        content = _uncommented(content.decode()).encode()
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def definition_of(cls: type) -> str:
    """As `source_of`; of what has no file it is nobody else's, so that no recorded result is taken for its own."""
    return source_of(cls) or _nobody_elses(cls)


@cache
def _nobody_elses(cls: type) -> str:
    return uuid.uuid4().hex


def _uncommented(text: str) -> str:
    """Its tokens, one a line; a line within a text is part of it."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return "\n".join(repr(token.string) for token in tokens if token.type not in (tokenize.COMMENT, tokenize.NL))
