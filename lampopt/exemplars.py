"""The first stage: a source, chosen by name, yields exemplars."""

from __future__ import annotations

import os
from collections.abc import Sequence

from lampopt.errors import InputError, PluginError
from lampopt.plugins import Plugins
from lampopt.protocols import Source
from lampopt.types import Exemplars, Scalar, Spec


def exemplars(
    source: str | Spec,
    /,
    *,
    plugins: Plugins | None = None,
    **options: Scalar | os.PathLike[str] | Sequence[str],
) -> Exemplars:
    """The exemplars of the source called `source`, with its options.

    A path may be a `Path`, and names may be a list, where the source takes text separated by commas.

    >>> plates = exemplars("plate", count=13)
    >>> cars = exemplars("table", table=Path("cars.csv"), labels=["drag", "lift"])  # doctest: +SKIP

    Raises
    ------
    PluginError
        If there is no such source, or an option is unknown: the known ones are listed.
    InputError
        If an option cannot be used, or what the source finds.
    """
    spec = Spec.of(source)
    given = {name: _plain(name, value) for name, value in options.items()}
    made: Source = (plugins or Plugins.load().report()).make("source", Spec(spec.name, **{**spec.options, **given}))
    found = made()
    if not isinstance(found, Exemplars):
        raise PluginError(f"source {spec.name!r}: expected Exemplars, got {type(found).__name__}")
    return found


def _plain(name: str, value: Scalar | os.PathLike[str] | Sequence[str]) -> Scalar:
    """A path as text, several texts as one with commas between; anything else as it is."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if not isinstance(value, list | tuple):
        return value  # type: ignore[return-value]  # Spec says what else cannot be
    if wrong := [part for part in value if not isinstance(part, str) or "," in part]:
        raise InputError(f"option {name!r}: expected texts without commas, got {wrong[0]!r}")
    return ",".join(value)
