"""The first stage: a source, chosen by name, yields exemplars."""

from __future__ import annotations

from lampopt.errors import PluginError
from lampopt.plugins import Plugins
from lampopt.protocols import Source
from lampopt.types import Exemplars, Scalar, Spec


def exemplars(source: str | Spec, /, *, plugins: Plugins | None = None, **options: Scalar) -> Exemplars:
    """The exemplars of the source called `source`, with its options.

    >>> plates = exemplars("plate", count=13)

    Raises
    ------
    PluginError
        If there is no such source, or an option is unknown: the known ones are listed.
    InputError
        If what the source finds cannot be used.
    """
    spec = Spec.of(source)
    made = (plugins or Plugins.load().report()).make("source", Spec(spec.name, **{**spec.options, **options}))
    if not isinstance(made, Source):
        raise PluginError(f"source {spec.name!r}: expected an object that is called without arguments, got {made!r}")
    found = made()
    if not isinstance(found, Exemplars):
        raise PluginError(f"source {spec.name!r}: expected Exemplars, got {type(found).__name__}")
    return found
