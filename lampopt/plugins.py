"""Find plugins, load them loudly, look them up by name.

Nothing happens at import: `Plugins.load()` reads the entry points of group `lampopt`, ours like anybody's. A plugin
that fails is reported with its distribution, version and cause, and the others work.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib.metadata import EntryPoint, entry_points
from inspect import isroutine
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import pluggy

from lampopt import hookspecs, protocols
from lampopt.code import definition_of, source_of
from lampopt.errors import PluginError
from lampopt.types import Array, Result, Scalar, Spec, frozen_array

PROTOCOLS: Mapping[str, tuple[type, ...]] = MappingProxyType(  # any one of them will do
    {
        "decoder": (protocols.Decoder,),
        "solver": (protocols.Solver,),
        "measure": (protocols.Measure,),
        "surrogate": (protocols.Surrogate,),
        "model": (protocols.Model, protocols.Regression),
        "source": (protocols.Source,),
        "check": (protocols.Checker,),
    }
)
KINDS = tuple(PROTOCOLS)
BLOCK = "LAMPOPT_BLOCK"
log = logging.getLogger("lampopt")


@dataclass(frozen=True)
class Offer:
    """One class a plugin offers: `kind`, `name`, what to load, and who offers it."""

    kind: str
    name: str
    target: type | str
    plugin: str
    distribution: str
    version: str

    def resolve(self) -> type:
        """The class, imported now.

        Raises
        ------
        PluginError
            Naming the plugin and the cause.
        """
        if isinstance(self.target, type):
            return self._remembered(self.target)
        try:
            module, _, attribute = self.target.partition(":")
            found = getattr(importlib.import_module(module), attribute)
        except Exception as error:  # whatever a stranger's module raises on import
            raise PluginError(f"{self.kind} {self.name!r} of {self}: cannot load {self.target!r}: {error!r}") from error
        if not isinstance(found, type):
            raise PluginError(
                f"{self.kind} {self.name!r} of {self}: expected a class at {self.target!r}, got {found!r}"
            )
        return self._remembered(found)

    @staticmethod
    def _remembered(found: type) -> type:
        source_of(found)  # now that it was read: the file may be edited while this process goes on
        return found

    def __str__(self) -> str:
        return f"plugin {self.plugin!r} ({self.distribution} {self.version})"

    @property
    def exactly(self) -> list[str]:
        """Who offers it, and what defines it: its version stays while a plugin is written."""
        return [str(self), definition_of(self.resolve())]


@dataclass(frozen=True)
class Fault:
    """A plugin that does not work, and why."""

    plugin: str
    distribution: str
    version: str
    cause: str

    def __str__(self) -> str:
        return f"plugin {self.plugin!r} ({self.distribution} {self.version}): {self.cause}"


@dataclass(frozen=True)
class Plugins:
    """What is installed: the offers by kind and name, the problems met on the way, each plugin's distribution."""

    offers: Mapping[tuple[str, str], Offer]
    problems: tuple[Fault, ...]
    clashes: Mapping[tuple[str, str], tuple[Offer, ...]] = field(default_factory=dict)
    owners: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    manager: pluggy.PluginManager = field(default_factory=lambda: _manager(), repr=False)

    @classmethod
    def load(cls, extra: Iterable[tuple[str, object]] = (), *, block: Iterable[str] | None = None) -> Plugins:
        """Load every entry point of group `lampopt`, then `extra` (name, module or object) pairs.

        Parameters
        ----------
        extra
            Plugins that are not installed, for tests and notebooks.
        block
            Entry-point names to leave out; by default those in the environment variable LAMPOPT_BLOCK.
        """
        blocked = {name.strip() for name in os.environ.get(BLOCK, "").split(",")} if block is None else set(block)
        manager = _manager()
        problems: list[Fault] = []
        owners: dict[str, tuple[str, str]] = {}
        points = sorted(entry_points(group="lampopt"), key=lambda p: (p.name, _owner(p)))
        names = [point.name for point in points]
        for point in points:
            if point.name in blocked:
                continue
            owner = _owner(point)
            if names.count(point.name) > 1:
                rivals = sorted({" ".join(_owner(p)) for p in points if p.name == point.name})
                problems.append(Fault(point.name, *owner, f"one entry-point name from {' and '.join(rivals)}"))
                continue
            try:
                plugin = point.load()
            except (Exception, SystemExit) as error:  # noqa: BLE001  # whatever a stranger's module raises on import
                problems.append(Fault(point.name, *owner, f"cannot be imported: {error!r}"))
                continue
            _register(manager, point.name, plugin, owner, owners, problems)
        for name, plugin in extra:
            if name not in blocked:
                _register(manager, name, plugin, ("not installed", "-"), owners, problems)
        offers, clashes = _offers(manager, owners, problems)
        return cls(offers, tuple(problems), clashes, owners, manager)

    def report(self) -> Plugins:
        """Log every problem as a warning; returns itself."""
        for problem in self.problems:
            log.warning("%s", problem)
        return self

    def get(self, kind: str, name: str) -> Offer:
        """The offer of `kind` called `name`.

        Raises
        ------
        PluginError
            If two plugins give that name (both are named), or none does (what there is is listed).
        """
        if clash := self.clashes.get((kind, name)):
            raise PluginError(
                f"{kind} {name!r} is given by {' and by '.join(map(str, clash))}: "
                f"block one with {BLOCK}={clash[0].plugin} or uninstall it"
            )
        if (kind, name) not in self.offers:
            known = ", ".join(sorted(n for k, n in self.offers if k == kind)) or "none"
            broken = f"; not working: {'; '.join(map(str, self.problems))}" if self.problems else ""
            own = f"; a {kind} of your own is registered by a hook (docs: hooks)" if ":" in name else ""
            raise PluginError(f"{kind} {name!r} is not installed; installed are: {known}{own}{broken}")
        return self.offers[kind, name]

    def make(self, kind: str, choice: str | Spec) -> Any:
        """The plugin object that `choice` describes.

        Raises
        ------
        PluginError
            If it is missing, or an option is unknown or refused: the known options are listed. If making it raises,
            or what comes lacks a member of its protocol.
        """
        spec = Spec.of(choice)
        offer = self.get(kind, spec.name)
        cls = offer.resolve()
        known = known_options(cls)
        unknown = sorted(set(spec.options) - set(known))
        if unknown:
            raise PluginError(
                f"{kind} {spec.name!r}: unknown option {', '.join(map(repr, unknown))}; "
                f"known are: {', '.join(f'{n}: {t}' for n, t in known.items()) or 'none'}"
            )
        if missing := [option for option in required_options(cls) if option not in spec.options]:
            raise PluginError(
                f"{kind} {spec.name!r}: expected the option {', '.join(map(repr, missing))}, which has no default; "
                f"known are: {', '.join(f'{n}: {t}' for n, t in known.items())}"
            )
        for option, value in spec.options.items():
            _check_type(f"{kind} {spec.name!r}: option {option!r}", value, known[option])
        try:
            made = cls(**spec.options)
        except (TypeError, ValueError) as error:
            raise PluginError(f"{kind} {spec.name!r} with {dict(spec.options)}: {error}") from error
        except (Exception, SystemExit) as error:  # whatever a stranger's __init__ raises
            raise PluginError(f"{kind} {spec.name!r} of {offer}: cannot be made: {error!r}") from error
        if not isinstance(made, PROTOCOLS[kind]):
            wanted = " asks for, or what ".join(f"lampopt.protocols.{p.__name__}" for p in PROTOCOLS[kind])
            raise PluginError(f"{kind} {spec.name!r}: {made!r} of {offer} lacks what {wanted} asks for")
        return made

    def complete(self, kind: str, choice: str | Spec) -> Spec:
        """`choice` with the defaults of the day named too, for files that outlive them."""
        spec = Spec.of(choice)
        return Spec(spec.name, **{**default_options(self.get(kind, spec.name).resolve()), **spec.options})

    def recorded(self, result: Result, folder: Path) -> None:
        """Tell every observer about a result on disk; what one raises is logged and loses nothing."""
        for implementation in self.manager.hook.lampopt_recorded.get_hookimpls():
            arguments = {"result": result, "folder": folder}
            try:
                implementation.function(*(arguments[name] for name in implementation.argnames))
            except Exception:  # an observer only observes
                log.exception("plugin %r failed in lampopt_recorded for %s", implementation.plugin_name, folder)


def _manager() -> pluggy.PluginManager:
    manager = pluggy.PluginManager("lampopt")
    manager.add_hookspecs(hookspecs)
    return manager


def _owner(point: EntryPoint) -> tuple[str, str]:
    return (point.dist.name, point.dist.version) if point.dist else ("unknown", "-")


def _register(
    manager: pluggy.PluginManager,
    name: str,
    plugin: object,
    owner: tuple[str, str],
    owners: dict[str, tuple[str, str]],
    problems: list[Fault],
) -> None:
    """Register one plugin; drop it again, with the reason, if a hook of it is misspelt or misshapen."""
    if name in owners:
        problems.append(Fault(name, *owner, f"a plugin of this name is already loaded from {owners[name][0]}"))
        return
    try:
        if manager.register(plugin, name) is None:
            raise PluginError("the same object is registered twice")
        manager.check_pending()
    except (pluggy.PluginValidationError, PluginError, ValueError) as error:
        if manager.has_plugin(name):
            manager.unregister(name=name)
        problems.append(Fault(name, *owner, str(error)))
        return
    if not manager.get_hookcallers(plugin):
        manager.unregister(name=name)
        problems.append(Fault(name, *owner, "has no hooks: mark its functions with @lampopt.hookimpl"))
        return
    owners[name] = owner
    if unmarked := [hook for hook in vars(manager.hook) if _is_unmarked(getattr(plugin, hook, None))]:
        problems.append(Fault(name, *owner, f"{', '.join(unmarked)}: not marked with @lampopt.hookimpl, so not heard"))


def _is_unmarked(function: object) -> bool:
    return isroutine(function) and not hasattr(function, "lampopt_impl")


def _offers(
    manager: pluggy.PluginManager, owners: Mapping[str, tuple[str, str]], problems: list[Fault]
) -> tuple[dict[tuple[str, str], Offer], dict[tuple[str, str], tuple[Offer, ...]]]:
    """Call each plugin's registry hooks on their own, so that one that raises costs only itself."""
    found: dict[tuple[str, str], list[Offer]] = {}
    for kind in KINDS:
        hook = getattr(manager.hook, f"lampopt_{kind}s")
        for implementation in sorted(hook.get_hookimpls(), key=lambda i: i.plugin_name):
            plugin = implementation.plugin_name
            owner = owners[plugin]
            try:
                mapping = implementation.function()
                if not isinstance(mapping, Mapping) or not all(
                    isinstance(n, str) and isinstance(t, type | str) for n, t in mapping.items()
                ):
                    raise TypeError(f"expected a mapping of names to classes or 'module:Class', got {mapping!r}")
            except Exception as error:  # noqa: BLE001  # whatever a stranger's hook raises
                problems.append(Fault(plugin, *owner, f"hook lampopt_{kind}s failed: {error!r}"))
                continue
            for name, target in mapping.items():
                found.setdefault((kind, name), []).append(Offer(kind, name, target, plugin, *owner))
    offers = {key: rivals[0] for key, rivals in found.items() if len(rivals) == 1}
    clashes = {key: tuple(rivals) for key, rivals in found.items() if len(rivals) > 1}
    for (kind, name), rivals in clashes.items():
        for rival in rivals:
            others = " and ".join(str(r) for r in rivals if r is not rival)
            problems.append(
                Fault(rival.plugin, rival.distribution, rival.version, f"{kind} {name!r} is also given by {others}")
            )
    return offers, clashes


def returned(what: str, value: Any, shape: tuple[int | None, ...], dtype: npt.DTypeLike = float) -> Array:
    """What a plugin returned, as a finite read-only array of `shape` (None: any length).

    Raises
    ------
    PluginError
        If it is none: `what` begins the message and names the plugin.
    """
    try:
        with np.errstate(over="ignore"):  # what is too large for `dtype` is refused as not finite
            return frozen_array(value, what, shape, dtype)
    except (TypeError, ValueError) as error:
        raise PluginError(str(error)) from error


def known_options(cls: type) -> dict[str, str]:
    """The option names of a plugin class (its dataclass fields) with their declared types, as text."""
    declared = fields(cls) if is_dataclass(cls) else ()
    return {f.name: getattr(f.type, "__name__", str(f.type)) for f in declared if f.init}


def required_options(cls: type) -> list[str]:
    """The options of a plugin class that have no default."""
    declared = fields(cls) if is_dataclass(cls) else ()
    return [f.name for f in declared if f.init and f.default is MISSING and f.default_factory is MISSING]


def default_options(cls: type) -> dict[str, Scalar]:
    """The options of a plugin class that have a default of their declared type which a file can hold, with it."""
    declared = fields(cls) if is_dataclass(cls) else ()
    defaults = {f.name: f.default for f in declared if f.init and isinstance(f.default, str | int | float | bool)}
    kinds = known_options(cls)
    return {name: default for name, default in defaults.items() if _fits(default, kinds[name])}


_CHECKED: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "str": (str,), "bool": (bool,)}


def _check_type(what: str, value: Scalar, declared: str) -> None:
    """Refuse a scalar of another type than a plainly declared one; other annotations are the class's business."""
    if not _fits(value, declared):
        raise PluginError(f"{what}: expected {declared}, got {value!r}")


def _fits(value: Scalar, declared: str) -> bool:
    wanted = _CHECKED.get(declared)
    return not wanted or (isinstance(value, wanted) and (declared == "bool" or not isinstance(value, bool)))
