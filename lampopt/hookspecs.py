"""The hooks. A plugin is a module with functions of these names under `@lampopt.hookimpl`.

Each registry hook returns a mapping of name to class, or to a `"module:Class"` string that is resolved when chosen,
so that listing plugins loads nothing heavy. Options are the class's fields. Hooks take no defaults.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pluggy

from lampopt.types import Result

hookspec = pluggy.HookspecMarker("lampopt")
hookimpl = pluggy.HookimplMarker("lampopt")

Registry = Mapping[str, type | str]


@hookspec
def lampopt_decoders() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Decoders by name."""


@hookspec
def lampopt_solvers() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Solvers by name."""


@hookspec
def lampopt_measures() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Measures by name."""


@hookspec
def lampopt_surrogates() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Surrogates by name."""


@hookspec
def lampopt_models() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Models by name."""


@hookspec
def lampopt_sources() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Sources by name."""


@hookspec
def lampopt_checks() -> Registry:  # type: ignore[empty-body]  # a specification has no body
    """Checkers by name."""


@hookspec
def lampopt_recorded(result: Result, folder: Path) -> None:
    """Observe a result that is safely on disk in `folder`; what this raises is reported and loses nothing."""
