"""Does a plugin do what its protocol promises? One list of checks a kind, three ways to run it.

- `check_decoder(plugin)` and the like raise `ConformanceError` at the first failure; `report(kind, plugin)` runs
  everything and tells.
- `@decoder_checks(plugin)` and the like make a pytest test of every check.
- `check_plugin(plugins, name)` is what ``lampopt check-plugin NAME`` runs.

Pass an instance with cheap options: checks fit three small meshes a handful of times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from lampopt.errors import InputError, LampoptError, PluginError
from lampopt.plugins import Offer, Plugins
from lampopt.protocols import Regression
from lampopt.testing import checkers, decoders, measures, models, shapes, solvers, sources
from lampopt.testing.engine import (
    CheckFunction,
    ConformanceError,
    NotApplicable,
    Record,
    excuses_exist,
    run_check,
    run_checks,
)

__all__ = [
    "CHECKS",
    "ConformanceError",
    "NotApplicable",
    "Record",
    "check_checker",
    "check_decoder",
    "check_measure",
    "check_model",
    "check_plugin",
    "check_regression",
    "check_solver",
    "check_source",
    "check_surrogate",
    "checker_checks",
    "decoder_checks",
    "measure_checks",
    "model_checks",
    "regression_checks",
    "report",
    "shapes",
    "solver_checks",
    "source_checks",
    "surrogate_checks",
]

CHECKS: Mapping[str, tuple[CheckFunction, ...]] = MappingProxyType(
    {
        "decoder": decoders.CHECKS,
        "solver": solvers.CHECKS,
        "measure": measures.CHECKS,
        "surrogate": measures.SURROGATE_CHECKS,
        "model": models.CHECKS,
        "regression": models.REGRESSION_CHECKS,
        "source": sources.CHECKS,
        "check": checkers.CHECKS,
    }
)
Excuses = Mapping[str, str]
Decorator = Callable[[Callable[..., None]], Any]
NONE: Excuses = MappingProxyType({})


def report(kind: str, plugin: object, expected_failures: Excuses = NONE, *, name: str = "") -> tuple[Record, ...]:
    """Run every check of `kind` on `plugin`.

    Parameters
    ----------
    kind
        decoder, solver, measure, surrogate, model, regression, source or check.
    plugin
        An instance, with cheap options.
    expected_failures
        Check name → reason. Strict: an excused check that passes is a failure.
    name
        What the records call the plugin.

    Raises
    ------
    InputError
        If there is no such kind, or an excuse names no check.
    """
    if kind not in CHECKS:
        raise InputError(f"kind: expected one of {', '.join(CHECKS)}, got {kind!r}")
    return run_checks(CHECKS[kind], plugin, expected_failures, name)


def _check(kind: str, plugin: object, expected_failures: Excuses) -> None:
    excuses_exist(CHECKS[kind], expected_failures)
    for check in CHECKS[kind]:
        record = run_checks((check,), plugin, {k: v for k, v in expected_failures.items() if k == check.__name__})[0]
        if not record.passed:
            raise ConformanceError(record.message)


def check_decoder(plugin: object, expected_failures: Excuses = NONE) -> None:
    """Run the decoder checks. Raises ConformanceError at the first failure, naming the check and why it matters."""
    _check("decoder", plugin, expected_failures)


def check_solver(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a solver."""
    _check("solver", plugin, expected_failures)


def check_measure(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a measure, also a learned one; its `example_mesh()` says what it is made for."""
    _check("measure", plugin, expected_failures)


def check_surrogate(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a surrogate."""
    _check("surrogate", plugin, expected_failures)


def check_model(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a model; its `example_parameters()` (B, d) say where it is valid."""
    _check("model", plugin, expected_failures)


def check_regression(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a regression: what a model is learned by, offered by the same hook as a ready model."""
    _check("regression", plugin, expected_failures)


def check_source(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a source; one of open meshes says so with `watertight = False`."""
    _check("source", plugin, expected_failures)


def check_checker(plugin: object, expected_failures: Excuses = NONE) -> None:
    """As `check_decoder`, for a checker (hook `lampopt_checks`)."""
    _check("check", plugin, expected_failures)


def _decorator(kind: str, plugins: tuple[object, ...], expected_failures: Excuses) -> Decorator:
    excuses_exist(CHECKS[kind], expected_failures)

    def decorate(function: Callable[..., None]) -> Any:
        import pytest

        def case(plugin: object, check: CheckFunction) -> Any:
            def run() -> None:
                try:
                    run_check(check, plugin)
                except NotApplicable as reason:
                    pytest.skip(str(reason))

            excuse = expected_failures.get(check.__name__)
            marks = [pytest.mark.xfail(reason=excuse, raises=ConformanceError, strict=True)] if excuse else []
            return pytest.param(run, id=f"{type(plugin).__name__}-{check.__name__}", marks=marks)

        cases = [case(plugin, check) for plugin in plugins for check in CHECKS[kind]]
        return pytest.mark.parametrize("check", cases)(function)

    return decorate


def decoder_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """Decorate ``def test_it(check): check()``: pytest then runs every check of every decoder as a test of its own.

    `expected_failures` (check name → reason) become strict xfails.
    """
    return _decorator("decoder", plugins, expected_failures)


def solver_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for solvers."""
    return _decorator("solver", plugins, expected_failures)


def measure_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for measures."""
    return _decorator("measure", plugins, expected_failures)


def surrogate_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for surrogates."""
    return _decorator("surrogate", plugins, expected_failures)


def model_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for models."""
    return _decorator("model", plugins, expected_failures)


def regression_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for regressions."""
    return _decorator("regression", plugins, expected_failures)


def source_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for sources."""
    return _decorator("source", plugins, expected_failures)


def checker_checks(*plugins: object, expected_failures: Excuses = NONE) -> Decorator:
    """As `decoder_checks`, for checkers."""
    return _decorator("check", plugins, expected_failures)


def check_plugin(plugins: Plugins, name: str) -> list[Record]:
    """Build and check everything that a distribution or an entry point registers.

    A class with a static or class method `example()` is built by it, so that checks stay cheap; any other with its
    default options.

    Parameters
    ----------
    plugins
        What is installed.
    name
        A distribution (``lampopt-gridsdf``) or an entry point (``gridsdf``).

    Returns
    -------
    list of Record
        Problems met on loading first, then one record a check.

    Raises
    ------
    PluginError
        If nothing of that name is installed.
    """
    wanted = _canonical(name)
    rivals = [offer for clash in plugins.clashes.values() for offer in clash]
    offers = [o for o in (*plugins.offers.values(), *rivals) if wanted in map(_canonical, (o.distribution, o.plugin))]
    problems = [p for p in plugins.problems if wanted in map(_canonical, (p.distribution, p.plugin))]
    if not offers and not problems:
        known = sorted({o.plugin for o in plugins.offers.values()} | {o.distribution for o in plugins.offers.values()})
        raise PluginError(f"plugin {name!r}: not installed, or it registers nothing; known are: {', '.join(known)}")
    records = [Record("loads", False, problem.cause, problem.plugin) for problem in problems]
    for offer in sorted(offers, key=lambda o: (o.kind, o.name)):
        records += _check_offer(offer)
    return records


def _check_offer(offer: Offer) -> tuple[Record, ...]:
    about = f"{offer.kind} {offer.name}"
    try:
        cls: Any = offer.resolve()
        plugin = cls.example() if hasattr(cls, "example") else cls()
    except Exception as error:  # noqa: BLE001  # whatever a stranger's class raises
        cause = str(error) if isinstance(error, LampoptError) else repr(error)
        advice = "expected `example()` or default options to build it"
        return (Record("builds", False, f"{cause}; {advice}", about),)
    kind = "regression" if offer.kind == "model" and isinstance(plugin, Regression) else offer.kind
    return (Record("builds", True, "", about), *report(kind, plugin, name=about))


def _canonical(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")
