"""What defines a class: a hash of its file, so that a plugin that is being written is not taken for what it was."""

from __future__ import annotations

import hashlib
import inspect
import io
import sys
import tokenize
import uuid
from contextlib import suppress
from functools import cache
from pathlib import Path


@cache
def source_of(cls: type) -> str:
    """A hash of the file that defines a class, with all that it may call there, but for comments and empty lines.

    Of the file as it is when it is first asked for. Of what cannot be read a hash that is nobody else's.
    """
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    try:
        content = Path(file).read_bytes() if file else inspect.getsource(cls).encode()
    except (OSError, TypeError):
        return uuid.uuid4().hex
    with suppress(SyntaxError, UnicodeDecodeError, tokenize.TokenError):  # it is no Python
        content = _uncommented(content.decode()).encode()
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def _uncommented(text: str) -> str:
    lines = text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            line, column = token.start
            lines[line - 1] = lines[line - 1][:column]
    return "\n".join(filter(None, map(str.rstrip, lines)))
