"""What is typed behind options: NAME=VALUE pairs, their types told by the plugin that they are for."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TypeVar

from lampopt.errors import InputError
from lampopt.intake import ALL
from lampopt.plugins import Plugins, known_options
from lampopt.pool import processes
from lampopt.reading import brief, why
from lampopt.types import Scalar, Spec

T = TypeVar("T")
TRUTH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    """NAME=VALUE texts by name.

    Raises
    ------
    InputError
        If one has another form, or a name comes twice.
    """
    found: dict[str, str] = {}
    for text in given:
        name, equals, value = text.partition("=")
        name, value = name.strip(), value.strip()
        if not (name and equals and value):
            raise InputError(f"{option}: expected NAME=VALUE, got {text!r}")
        if name in found:
            raise InputError(f"{option}: {name} is given twice, as {found[name]} and as {value}: leave one out")
        found[name] = value
    return found


def numbers(option: str, given: Sequence[str]) -> dict[str, float]:
    """NAME=NUMBER texts by name. Raises InputError as `pairs`, and where a value is no number."""
    return {name: number(f"{option} {name}", text) for name, text in pairs(option, given).items()}


def number(what: str, text: str) -> float:
    """`text` as a number. Raises InputError naming `what` where it is none."""
    return _read(float, "a number", what, text)


def spec(plugins: Plugins, kind: str, name: str, option: str, given: Sequence[str]) -> Spec:
    """The Spec of plugin `name` with NAME=VALUE options, each as its declared type has it.

    An option that the plugin does not know is left to `Plugins.make`, which lists those that it knows.

    Raises
    ------
    PluginError
        If there is no such plugin.
    InputError
        If a value cannot be read as the declared type.
    """
    declared = known_options(plugins.get(kind, name).resolve())
    texts = pairs(option, given)
    return Spec(name, **{key: _typed(f"{option} {key}", text, declared.get(key, "str")) for key, text in texts.items()})


def chosen_measures(plugins: Plugins, given: Sequence[str]) -> dict[str, Spec]:
    """Measures by name, from NAME or NAME:OPTION=VALUE,... texts.

    Raises
    ------
    PluginError, InputError
        As `spec`, and where a name comes twice.
    """
    found: dict[str, Spec] = {}
    for text in given:
        made = with_options(plugins, "measure", "--measure", text)
        if made.name in found:
            raise InputError(f"--measure: {made.name} is given twice: leave one out")
        found[made.name] = made
    return found


def with_options(plugins: Plugins, kind: str, option: str, text: str) -> Spec:
    """The Spec behind one NAME or NAME:OPTION=VALUE,... text. Raises PluginError and InputError as `spec`."""
    name, _, options = text.partition(":")
    parts = list[str]()
    for part in options.split(",") if options else ():
        if parts and part and "=" not in part:
            parts[-1] += f",{part}"  # a value that is a list
        else:
            parts.append(part)
    return spec(plugins, kind, name, option, parts)


def accepted(names: tuple[str, ...]) -> Iterable[str]:
    """The names behind --accept; `all` among them stands for everybody."""
    return ALL if ALL in names else names


def can_be_written(option: str, path: Path) -> None:
    """Make the folder of `path`; raise InputError, before long work, where no file can be put there."""
    folder = path.parent
    try:
        folder = next(place for place in path.absolute().parents if place.exists())
        with tempfile.TemporaryFile(dir=folder):
            pass
        path.exists()  # a name that is too long is told here
        path.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{option} {brief(path)}: no file can be written in {brief(folder)}: {why(error)}") from error


def _typed(what: str, text: str, declared: str) -> Scalar:
    wanted = {part.strip() for part in declared.split("|")}
    if "str" in wanted:
        return text
    if "bool" in wanted:
        return _read(lambda t: TRUTH[t.lower()], "true or false", what, text)
    if "int" in wanted and "float" not in wanted:
        return _read(int, "a whole number", what, text)
    return _read(float, "a number", what, text) if "float" in wanted else text


def _read(to: Callable[[str], T], expected: str, what: str, text: str) -> T:
    try:
        return to(text)
    except (ValueError, KeyError) as error:
        raise InputError(f"{what}: expected {expected}, got {brief(repr(text))}") from error


def crew(count: int) -> AbstractContextManager[Executor | None]:
    """So many processes; none but this one where one is enough."""
    return nullcontext() if count == 1 else processes(count)
