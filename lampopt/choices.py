"""What a study chooses: values, plugins by name, as a Spec or as an object; the same as TOML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lampopt.errors import InputError, StudyError
from lampopt.protocols import Measure, Model
from lampopt.reading import readdressed
from lampopt.types import Scalar, Spec
from lampopt.units import said

Value = float | str  # in the bank's unit, or with its own
CHECKS = "checks: expected a list of names, or of Spec(name, ...) with options"
GIVEN = "given-in-python"  # stands in TOML for a measure that was given as an object


def names_of(value: object, what: str) -> tuple[str, ...]:
    """`value` as names, each once. Raises StudyError naming `what`."""
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(v, str) for v in value):
        raise StudyError(f"{what}: expected a list of names, got {said(value)}")
    if twice := sorted(v for v, times in Counter(value).items() if times > 1):
        raise StudyError(f"{what}: {', '.join(twice)} twice; name each once")
    return tuple(value)


def table_of(value: object, what: str) -> Mapping[str, Any]:
    """`value` as a table by name. Raises StudyError naming `what`."""
    if not isinstance(value, Mapping) or not all(isinstance(k, str) for k in value):
        raise StudyError(f"{what}: expected a table of names and values, got {said(value)}")
    return MappingProxyType(dict(value))


def spec_of(table: Mapping[str, Scalar], what: str) -> Spec:
    """The Spec that a TOML table with an entry `name` describes. Raises StudyError naming `what`."""
    options = dict(table)
    name = options.pop("name", None)
    if not isinstance(name, str):
        raise StudyError(f"{what}: expected a name, or a table with an entry `name`, got {said(dict(table))}")
    try:
        return Spec(name, **options)
    except InputError as error:
        raise StudyError(f"{what}: {error}") from error


def checks_of(given: object) -> tuple[str | Spec, ...]:
    """Checks of plugins by name, or as a Spec where they have options; each once. Raises StudyError."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise StudyError(f"{CHECKS}, got {said(given)}")
    found: list[str | Spec] = []
    for choice in given:
        if not isinstance(choice, str | Spec | Mapping):
            raise StudyError(f"{CHECKS}, got {said(given)}")
        found.append(spec_of(choice, "checks") if isinstance(choice, Mapping) else choice)
    names_of([Spec.of(choice).name for choice in found], "checks")
    return tuple(found)


def written_checks(checks: Sequence[str | Spec]) -> list[str | dict[str, Any]]:
    """For TOML: a name alone where it says it all."""
    return [choice if isinstance(choice, str) else _written(choice, "checks") for choice in checks]


def _written(choice: Spec, what: str) -> dict[str, Any]:
    """A Spec as a TOML table. Raises StudyError naming `what` where TOML could not tell its name from an option."""
    if "name" in choice.options:
        raise StudyError(f"{what}: {choice} has an option `name`, which TOML could not tell from its own")
    return {"name": choice.name, **absolute(choice).options}


def table_beside(choice: Any, what: str, folder: Path | None) -> Any:
    """What TOML has for a plugin: of a table its Spec, with the option `file` taken from `folder`; else as it is."""
    return beside(spec_of(choice, what), folder) if isinstance(choice, dict) else choice


def measures_of(given: object) -> Mapping[str, Spec | Measure]:
    """What is to be measured, by the name under which its values are reported."""
    if isinstance(given, Measure) or (
        isinstance(given, Sequence) and any(isinstance(choice, Spec | Measure) for choice in given)
    ):
        raise StudyError(
            "measures: a measure that is given as an object or a Spec needs a name, under which its values are "
            f"reported: expected a table such as {{'roof': ...}}, got {said(given)}"
        )
    if not isinstance(given, Mapping):
        return MappingProxyType({name: Spec(name) for name in names_of(given, "measures")})
    found: dict[str, Spec | Measure] = {}
    for name, choice in table_of(given, "measures").items():
        if "." in name or not name:
            raise StudyError(f"measures: expected a name without dots, for values are called name.value, got {name!r}")
        if isinstance(choice, str):
            choice = Spec(choice)
        elif isinstance(choice, type) or not isinstance(choice, Spec | Measure):
            raise StudyError(
                f"measures: {name}: expected the name of a measure, a Spec or a measure, got {said(choice)}"
            )
        found[name] = choice
    return MappingProxyType(found)


def written_measures(measures: Mapping[str, Spec | Measure]) -> list[str] | dict[str, Any]:
    """For TOML: names alone where they say it all; an object by its class, which cannot be made again from it."""
    if all(isinstance(choice, Spec) and choice == Spec(name) for name, choice in measures.items()):
        return list(measures)
    found = {}
    for name, choice in measures.items():
        given = {"name": GIVEN, "of": _class(choice)}
        found[name] = _written(choice, f"measures: {name}") if isinstance(choice, Spec) else given
    return found


def models_of(given: object) -> Mapping[str, str | Model]:
    """Models by the name under which their values can be asked for: files, or objects."""
    found: dict[str, str | Model] = {}
    for name, choice in table_of(given, "models").items():
        if "." in name or not name:
            raise StudyError(f"models: expected a name without dots, for values are called name.value, got {name!r}")
        if isinstance(choice, str | Path):
            found[name] = str(choice)
        elif isinstance(choice, Model) and not isinstance(choice, type):
            found[name] = choice
        else:
            raise StudyError(f"models: {name}: expected the file of a model, or a model, got {said(choice)}")
    return MappingProxyType(found)


def written_models(models: Mapping[str, str | Model]) -> dict[str, str]:
    """For TOML: files from the current folder; an object by its class, which cannot be made again from it."""
    return {
        name: str(Path.cwd() / choice) if isinstance(choice, str) else f"<{_class(choice)}>"
        for name, choice in models.items()
    }


def beside(choice: Spec, folder: Path | None) -> Spec:
    """`choice` with its option `file`, where it has one, taken from `folder`: as the bank's path is."""
    file = choice.options.get("file")
    if folder is None or not isinstance(file, str) or not file:
        return choice
    return Spec(choice.name, **{**choice.options, "file": str(folder / file)})


def beside_address(address: Any, folder: Path | None) -> Any:
    """`address` of a measured value with the file that it may name, as in `ramp.measure:ramp`, taken from `folder`."""
    if folder is None or not isinstance(address, str):
        return address
    return readdressed(address, lambda file: str(folder / file))


def absolute(choice: Spec) -> Spec:
    """`choice` with its option `file` from the current folder: what is written may be read from another."""
    return beside(choice, Path.cwd())


def _class(value: object) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"


def value_list(value: object, what: str) -> tuple[Value, ...]:
    """`value` as numbers and texts such as "1420 mm", at least one. Raises StudyError naming `what`."""
    if not isinstance(value, Iterable) or isinstance(value, str | Mapping):
        raise StudyError(f"{what}: expected a list of values, got {said(value)}")
    found = tuple(v if isinstance(v, str) else native(v) for v in value)
    if not found:
        raise StudyError(f"{what}: expected a list of values, got none")
    if wrong := [v for v in found if not is_value(v)]:
        raise StudyError(f"{what}: expected numbers or text such as '1420 mm', got {said(wrong[0])}")
    return found


def value_pair(value: object, what: str) -> tuple[Value, Value]:
    """`value` as a low and a high value, in whatever units. Raises StudyError naming `what`."""
    pair = value_list(value, what)
    if len(pair) != 2:
        raise StudyError(f"{what}: expected a low and a high value, got {len(pair)} values")
    return pair[0], pair[1]


def is_value(value: object) -> bool:
    """Whether `value` is a number or a text."""
    return isinstance(value, str | int | float) and not isinstance(value, bool)


def native(value: object) -> Any:
    """Numpy's numbers as Python's; everything else as it is."""
    if isinstance(value, bool | int | float):
        return value
    if isinstance(value, Integral):
        return int(value)
    return float(value) if isinstance(value, Real) else value
