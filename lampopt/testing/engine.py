"""Run checks and say what came of them. A check is a function of one plugin whose docstring says why it matters."""

from __future__ import annotations

import dataclasses
import inspect
import random
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lampopt import lamp
from lampopt.errors import InputError, LampoptError
from lampopt.plugins import known_options
from lampopt.types import Array

CheckFunction = Callable[[Any], None]


class ConformanceError(AssertionError, LampoptError):
    """A plugin does not do what its protocol promises: the check's name, what was found, why it matters."""


class NotApplicable(Exception):  # noqa: N818  # it is an answer, not an error
    """Raised by a check that has nothing to say about this plugin, with the reason."""


@dataclass(frozen=True)
class Record:
    """One line of a report: the check, whether it passed, what there is to say, and about which plugin."""

    check: str
    passed: bool
    message: str = ""
    plugin: str = ""

    def __str__(self) -> str:
        about = f"{self.plugin}: " if self.plugin else ""
        return f"{'ok    ' if self.passed else 'FAILED'} {about}{self.check}" + (
            f" ({self.message})" if self.message else ""
        )


def expect(condition: object, message: str) -> None:
    """Fail the running check with `message` unless `condition` holds."""
    if not condition:
        raise ConformanceError(message)


def run_check(check: CheckFunction, plugin: object) -> None:
    """Run one check.

    Raises
    ------
    ConformanceError
        With the check's name and the sentence on why it matters; also when the plugin itself raises.
    NotApplicable
        If the check has nothing to say about this plugin.
    """
    why = " ".join((inspect.getdoc(check) or "").split())
    try:
        check(plugin)
    except NotApplicable:
        raise
    except ConformanceError as error:
        raise ConformanceError(f"{check.__name__}: {error}. Why it matters: {why}") from error
    except Exception as error:  # whatever a stranger's plugin raises
        raise ConformanceError(f"{check.__name__}: raised {error!r}. Why it matters: {why}") from error


def run_checks(
    checks: Sequence[CheckFunction], plugin: object, expected_failures: Mapping[str, str], name: str = ""
) -> tuple[Record, ...]:
    """Run all `checks`; those named in `expected_failures` (name → reason) have to fail."""
    excuses_exist(checks, expected_failures)
    return tuple(_record(check, plugin, expected_failures.get(check.__name__), name) for check in checks)


def _record(check: CheckFunction, plugin: object, excuse: str | None, name: str) -> Record:
    try:
        run_check(check, plugin)
    except NotApplicable as reason:
        return Record(check.__name__, True, f"not applicable: {reason}", name)
    except ConformanceError as error:
        return Record(check.__name__, excuse is not None, f"expected failure: {excuse}" if excuse else str(error), name)
    if excuse is not None:
        return Record(check.__name__, False, f"passes although excused ({excuse}): drop the excuse", name)
    return Record(check.__name__, True, "", name)


def excuses_exist(checks: Sequence[CheckFunction], expected_failures: Mapping[str, str]) -> None:
    """Raise InputError if an excuse names no check."""
    names = [check.__name__ for check in checks]
    if unknown := sorted(set(expected_failures) - set(names)):
        raise InputError(f"expected_failures: no check is called {', '.join(unknown)}; known are: {', '.join(names)}")


def must_raise(call: Callable[[], object], kinds: type[Exception] | tuple[type[Exception], ...], what: str) -> str:
    """The message that `call` raises as one of `kinds`; the check fails if it raises nothing or something else."""
    wanted = " or ".join(k.__name__ for k in (kinds if isinstance(kinds, tuple) else (kinds,)))
    try:
        result = call()
    except kinds as error:
        return str(error)
    except Exception as error:  # whatever a stranger's plugin raises
        raise ConformanceError(f"{what}: expected {wanted}, got {error!r}") from error
    raise ConformanceError(f"{what}: expected {wanted}, got {type(result).__name__}")


def require(plugin: object, protocol: type) -> None:
    """Fail the running check unless `plugin` has all members of `protocol`, naming those it lacks."""
    members = sorted(n for n in vars(protocol) if n == "__call__" or not n.startswith("_"))
    missing = [name for name in members if not hasattr(plugin, name)]
    expect(not missing, f"expected the members of {protocol.__name__}, lacking are {missing}")


def random_state() -> dict[str, bytes]:
    """Fingerprints of the global random generators; torch's only where torch is loaded already."""
    legacy: Any = np.random.get_state()  # noqa: NPY002  # the global state is what is watched
    state = {"numpy": bytes(legacy[1]) + repr(legacy[2:]).encode(), "random": repr(random.getstate()).encode()}
    if "torch" in sys.modules:
        state["torch"] = bytes(sys.modules["torch"].get_rng_state().numpy())
    return state


def changed_states(before: Mapping[str, bytes], after: Mapping[str, bytes]) -> list[str]:
    """Which global generators moved in between."""
    return [name for name in before if after[name] != before[name]]


def read_only(array: Array) -> Array:
    """A read-only copy, as a bank holds it."""
    copy = np.array(array)
    copy.flags.writeable = False
    return copy


def kept_and_read(fitted: Any) -> Any:
    """What is made of the state of `fitted` after it was written to a file, as `lampopt.fit_model(store=)` does."""
    cls = type(fitted)
    module = sys.modules.get(cls.__module__)
    found = getattr(module, cls.__qualname__, None) is cls
    expect(found, f"expected {cls.__qualname__} to be a class of its module's own: a file names it by that")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "fitted"
        lamp.write(path, fitted.state(), {})
        arrays = {name: read_only(array) for name, array in lamp.read(path)[0].items()}
    return cls.from_state(arrays)


def options(plugin: object) -> dict[str, Any]:
    """The options that `plugin` was made with."""
    return {name: getattr(plugin, name) for name in known_options(type(plugin))}


def _made_from_options(plugin: object) -> type:
    if hasattr(plugin, "from_state"):
        raise NotApplicable("it was learned: it is made from its state, not from options")
    return type(plugin)


def check_options_rebuild_an_equal_object(plugin: object) -> None:
    """A bank stores the name and options of what made it, so these alone have to give the plugin again."""
    cls = _made_from_options(plugin)
    expect(
        dataclasses.is_dataclass(plugin),
        f"expected {cls.__name__} to be a frozen dataclass whose fields are its options",
    )
    for name, value in options(plugin).items():
        expect(
            isinstance(value, str | int | float | bool),
            f"option {name!r}: expected text, a number or a truth value, got {value!r}",
        )
    expect(cls(**options(plugin)) == plugin, f"{cls.__name__}(**{options(plugin)}) differs from {plugin!r}")


def check_repr_round_trips(plugin: object) -> None:
    """What a report prints about a plugin should be what one types to get it."""
    cls = _made_from_options(plugin)
    text = repr(plugin).replace(cls.__qualname__, cls.__name__, 1)
    try:
        again = eval(text, {cls.__name__: cls, "inf": np.inf, "nan": np.nan})  # a repr of the caller's own object
    except Exception as error:  # a repr may be any text
        raise ConformanceError(f"repr {text!r} cannot be evaluated: {error!r}") from error
    expect(again == plugin, f"evaluating the repr {text!r} gives {again!r}")


def check_plugin_is_frozen(plugin: object) -> None:
    """An object that threads share and banks describe by its options must not change after it is made."""
    for name in [*options(plugin), "lampopt_frozen"]:
        try:
            setattr(plugin, name, getattr(plugin, name, None))
        except (AttributeError, TypeError):
            continue
        raise ConformanceError(f"attribute {name!r} can be set: expected a frozen dataclass")


COMMON: tuple[CheckFunction, ...] = (
    check_options_rebuild_an_equal_object,
    check_repr_round_trips,
    check_plugin_is_frozen,
)
