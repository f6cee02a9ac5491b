"""What was learned from exemplars, a measure or a model: fitted by a plugin, kept in a file, read back from there.

A file holds named arrays and a header, as a bank's does: no pickle, so that a hostile one runs no code. What makes the
object again is a class of the plugin that fitted it, which has to be installed.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lampopt import lamp
from lampopt.errors import BankError, InputError, PluginError
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Measure, Model, Progress, Regression, State, Surrogate
from lampopt.reading import brief, path_of
from lampopt.types import Array, Bank, Exemplars, Parameter, Spec
from lampopt.units import whole

FORMAT = "lampopt fitted"
SCHEMA = 1
FITS: Mapping[str, type] = {"surrogate": Measure, "model": Model}  # what a plugin of this kind fits


def fit_surrogate(
    exemplars: Exemplars,
    surrogate: str | Spec,
    names: Sequence[str] = (),
    *,
    seed: int = 0,
    store: str | Path | None = None,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Measure:
    """Learn a measure from the exemplars' meshes: what their parameters or labels are, told from the shape alone.

    Parameters
    ----------
    exemplars
        N of them, with their meshes.
    surrogate
        What learns it, by name or as a Spec.
    names
        Of the parameters and labels to be told; by default all parameters that vary, and all labels.
    seed
        For whatever draws.
    store
        A file for it; `load_measure` reads it back, and so does the measure `learned`.
    progress
        Told how many meshes were looked at.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    InputError
        If a name is none of theirs, or it cannot be stored.
    PluginError
        If the surrogate is not installed, or does not return a measure of these names.
    """
    if not isinstance(exemplars, Exemplars):
        raise InputError(
            f"fit_surrogate: expected Exemplars, which have the meshes to learn from, got {type(exemplars).__name__}"
        )
    plugins = plugins or Plugins.load().report()
    seed = whole(seed, "seed", 0, 2**63 - 1)
    spec = Spec.of(surrogate)
    learner: Surrogate = plugins.make("surrogate", spec)
    if store is not None:
        store = path_of(store, "store")
    space, values = _columns(exemplars, names)
    told = progress or silent
    learned = learner.fit(
        _Told(exemplars, told), values, tuple(q.name for q in space), tuple(q.unit for q in space), seed=seed
    )
    _expect(learned, "surrogate", spec, space)
    if store is not None:
        store_fitted(learned, store, "surrogate", spec, plugins)
    return learned


def fit_model(
    known: Exemplars | Bank,
    model: str | Spec = "best",
    names: Sequence[str] = (),
    *,
    inputs: Sequence[str] = (),
    seed: int = 0,
    store: str | Path | None = None,
    plugins: Plugins | None = None,
) -> Model:
    """Learn labels from parameters, no mesh needed.

    Parameters
    ----------
    known
        Exemplars, or a bank of them; one without a label does not count for it.
    model
        What learns it, by name or as a Spec.
    names
        Of the labels; by default all.
    inputs
        Of the parameters it may use; by default all that vary.
    seed
        For whatever draws.
    store
        A file for it; `load_model` reads it back.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    InputError
        If there is no such label or parameter, or it cannot be stored.
    PluginError
        If there is no such model, it is one that is not fitted, or it returns something else.
    """
    if not isinstance(known, Exemplars | Bank):
        raise InputError(f"fit_model: expected Exemplars or a Bank, got {type(known).__name__}")
    plugins = plugins or Plugins.load().report()
    seed = whole(seed, "seed", 0, 2**63 - 1)
    spec = Spec.of(model)
    learner = plugins.make("model", spec)
    if not isinstance(learner, Regression):
        raise PluginError(f"model {spec.name!r}: is a formula, there is nothing to be fitted")
    labels = _chosen(known.label_space, names, "labels")
    used = _chosen(known.space, inputs, "parameters") if inputs else _varying(known)
    if not labels:
        raise InputError(f"model {spec.name!r}: nothing to be told: these exemplars have no labels such as drag")
    if not used:
        raise InputError(f"model {spec.name!r}: nothing to tell it from: no parameter varies over the exemplars")
    if store is not None:
        store = path_of(store, "store")
    fitted = learner.fit(
        np.asarray(known.parameters)[:, [known.space.index(q) for q in used]],
        np.asarray(known.labels)[:, [known.label_space.index(q) for q in labels]],
        inputs=tuple(q.name for q in used),
        names=tuple(q.name for q in labels),
        units=tuple(q.unit for q in labels),
        seed=seed,
    )
    _expect(fitted, "model", spec, labels)
    if store is not None:
        store_fitted(fitted, store, "model", spec, plugins)
    return fitted


def store_fitted(
    fitted: Measure | Model, path: str | Path, kind: str, by: str | Spec, plugins: Plugins | None = None
) -> None:
    """Write what the plugin `by` of `kind` ("surrogate" or "model") has fitted to a file.

    Raises
    ------
    PluginError
        If it has no state, or its class is not of that plugin's package: it could not be read back.
    InputError
        If it cannot be written.
    """
    spec, cls = Spec.of(by), type(fitted)
    if not isinstance(fitted, State):
        raise PluginError(f"{kind} {spec.name!r}: what it fits has no state(), so that it cannot be kept in a file")
    offer = (plugins or Plugins.load().report()).get(kind, spec.name)
    where = f"{cls.__module__}:{cls.__qualname__}"
    if "." in cls.__qualname__:
        raise PluginError(f"{kind} {spec.name!r} of {offer}: fits a {where}, expected a class of its module's own")
    if _package(cls.__module__) != _package(offer.resolve().__module__):
        raise PluginError(f"{kind} {spec.name!r} of {offer}: fits a {where}, expected a class of its own package")
    record = {
        "format": FORMAT,
        "schema": SCHEMA,
        "kind": kind,
        "by": {"name": spec.name, "options": dict(spec.options)},
        "class": where,
        "distribution": offer.distribution,
        "version": offer.version,
    }
    _expect_no_other(path)
    try:
        lamp.write(path_of(path, "store"), fitted.state(), record)
    except BankError as error:
        raise InputError(str(error)) from error


def _expect_no_other(path: Path | str) -> None:
    """Raise InputError where a file is there that is nothing fitted, and would be lost."""
    if not (path := path_of(path, "store")).exists():
        return
    try:
        kind = lamp.read(path)[1].get("format")
    except BankError:
        kind = None
    if kind != FORMAT:
        raise InputError(
            f"{path}: is there, and is {kind or 'nothing that was fitted'}: name another file, or delete it"
        )


def load_measure(path: str | Path, *, plugins: Plugins | None = None) -> Measure:
    """The measure in a file that `fit_surrogate` stored.

    Raises
    ------
    InputError
        If the file is missing, damaged, holds something else, or is of a newer lampopt.
    PluginError
        If the plugin that fitted it is not installed, or cannot read it.
    """
    found: Measure = _load(path, "surrogate", plugins)
    return found


def load_model(path: str | Path, *, plugins: Plugins | None = None) -> Model:
    """The model in a file that `fit_model` stored. Raises as `load_measure`."""
    found: Model = _load(path, "model", plugins)
    return found


def _load(path: str | Path, kind: str, plugins: Plugins | None) -> Any:
    try:
        arrays, record = lamp.read(path)
    except BankError as error:
        raise InputError(str(error)) from error
    if record.get("format") != FORMAT or record.get("kind") != kind:
        what = record.get("kind") if record.get("format") == FORMAT else record.get("format")
        raise InputError(
            f"{brief(path)}: expected a fitted {FITS[kind].__name__.lower()}, got a file of {brief(what)!r}"
        )
    schema = record.get("schema")
    if schema != SCHEMA:
        raise InputError(f"{brief(path)}: schema {brief(schema)}, this lampopt reads {SCHEMA}: update lampopt")
    try:
        spec, where = Spec(record["by"]["name"], **record["by"]["options"]), record["class"].partition(":")
    except (KeyError, TypeError, AttributeError, InputError) as error:
        raise InputError(f"{brief(path)}: its header does not say what fitted it: {brief(repr(error))}") from error
    offer = (plugins or Plugins.load().report()).get(kind, spec.name)
    if _package(where[0]) != _package(offer.resolve().__module__):
        raise InputError(f"{brief(path)}: says {brief(where[0])!r}, which is not of {offer} that it says fitted it")
    try:
        cls = getattr(importlib.import_module(where[0]), where[2])
        found = cls.from_state(arrays)
    except Exception as error:  # whatever a stranger's class raises of arrays that are not its own
        raise PluginError(
            f"{brief(path)}: {offer} cannot read it (it was written by {brief(record.get('distribution'))} "
            f"{brief(record.get('version'))}): {brief(repr(error))}"
        ) from error
    if not isinstance(found, FITS[kind]):
        raise PluginError(f"{brief(path)}: {offer} made {brief(repr(found))} of it, expected a {FITS[kind].__name__}")
    return found


def _package(module: str) -> str:
    return module.partition(".")[0]


def _expect(fitted: object, kind: str, spec: Spec, space: Sequence[Parameter]) -> None:
    wanted = tuple(q.name for q in space), tuple(q.unit for q in space)
    said = tuple(getattr(fitted, "names", ())), tuple(getattr(fitted, "units", ()))
    if said != wanted:
        raise PluginError(f"{kind} {spec.name!r}: expected what tells {wanted[0]} in {wanted[1]}, got {fitted!r:.200}")


def _columns(exemplars: Exemplars, names: Sequence[str]) -> tuple[tuple[Parameter, ...], Array]:
    """What is to be told of the exemplars, and its values (N, p); NaN where a label is not known."""
    everything = (*exemplars.space, *exemplars.label_space)
    values = np.concatenate([exemplars.parameters, exemplars.labels], axis=1)
    if names:
        chosen = _chosen(everything, names, "parameters and labels")
    else:
        chosen = (*_varying(exemplars), *exemplars.label_space)
    return chosen, values[:, [everything.index(q) for q in chosen]]


def _chosen(space: Sequence[Parameter], names: Sequence[str], what: str) -> tuple[Parameter, ...]:
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise InputError(f"names: expected a list of names, got {names!r:.80}")
    by_name = {q.name: q for q in space}
    if unknown := sorted(set(names) - set(by_name)):
        there = f"which are {brief(', '.join(by_name))}" if by_name else "of which there are none"
        raise InputError(f"{brief(', '.join(unknown))}: not among the {what}, {there}")
    if len(set(names)) < len(names):
        raise InputError(f"names: expected each once, got {', '.join(names)}")
    return tuple(by_name[name] for name in names) if names else tuple(space)


def _varying(known: Exemplars | Bank) -> tuple[Parameter, ...]:
    spread = np.ptp(np.asarray(known.parameters), axis=0)
    return tuple(q for q, width in zip(known.space, spread, strict=True) if width > 0)


class _Told(Sequence[Any]):
    """The exemplars' meshes; tells `progress` the farthest one that was looked at."""

    def __init__(self, exemplars: Exemplars, progress: Progress) -> None:
        self._exemplars, self._progress, self._farthest = exemplars, progress, 0

    def __len__(self) -> int:
        return len(self._exemplars)

    def __getitem__(self, index: Any) -> Any:
        found = self._exemplars.meshes[index]
        if isinstance(index, int) and index >= self._farthest:
            self._farthest = index + 1
            self._progress(self._farthest / len(self), f"mesh {self._farthest} of {len(self)}")
        return found
