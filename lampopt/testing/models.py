"""What a model and a regression have to do."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from lampopt.protocols import Model, Regression, State, Symbolic, Uncertain
from lampopt.testing.engine import COMMON, CheckFunction, NotApplicable, expect, kept_and_read, require
from lampopt.testing.measures import check_units_can_be_read
from lampopt.types import Array

STEP = 1e-4  # relative, for differences
LEVEL = 0.9  # coverage of intervals, where it does not matter


def parameters(model: Any) -> Array:
    """(B, d) parameters to ask a model about: its own `example_parameters()`, else a few around 1."""
    if hasattr(model, "example_parameters"):
        return np.asarray(model.example_parameters(), float)
    return np.random.default_rng(4).uniform(0.5, 1.5, (5, len(model.inputs)))


def check_model_protocol(model: Any) -> None:
    """Labels and inputs are found by name, and compared by unit."""
    require(model, Model)
    for what in ("names", "inputs"):
        names = getattr(model, what)
        good = isinstance(names, tuple) and all(isinstance(n, str) and n for n in names)
        expect(good and len(set(names)) == len(names) > 0, f"{what}: expected distinct texts, got {names!r}")
    good = isinstance(model.units, tuple) and len(model.units) == len(model.names)
    expect(good, f"units: expected {len(model.names)} texts, got {model.units!r}")


def check_model_shapes(model: Any) -> None:
    """Sweeps ask for many designs at once, or for none: (B, d) in, finite (B, p) and (B, p, d) out."""
    p, d = len(model.names), len(model.inputs)
    for given in (parameters(model), parameters(model)[:0]):
        b = len(given)
        for what, found, wanted in (("labels", model(given), (b, p)), ("gradient", model.gradient(given), (b, p, d))):
            expect(np.shape(found) == wanted, f"{what}: expected shape {wanted}, got {np.shape(found)}")
            expect(np.isfinite(found).all(), f"{what}: expected finite values")


def check_model_rows_are_independent(model: Any) -> None:
    """A design's labels must not depend on which others are asked about with it."""
    given = parameters(model)
    _rows_are_independent(given, labels=model, gradient=model.gradient)


def _rows_are_independent(given: Array, **asked: Callable[[Array], Array]) -> None:
    for what, ask in asked.items():
        together = np.asarray(ask(given), float)
        for i in range(len(given)):
            alone = np.asarray(ask(given[i : i + 1]), float)
            expect(alone.shape == (1, *together.shape[1:]), f"{what} of one row: expected one, got shape {alone.shape}")
            same = np.allclose(alone[0], together[i], rtol=1e-6, atol=1e-9)
            expect(same, f"{what}: rows one by one and together differ")


def check_model_is_deterministic(model: Any) -> None:
    """A prediction that is made again has to be the same prediction."""
    given = parameters(model)
    first = np.array(model(given))
    model(1.01 * given)
    expect(np.array_equal(first, model(given)), "a, b, a gives two answers for a")


def check_model_gradient_agrees_with_differences(model: Any) -> None:
    """A solver follows this gradient to the optimum, or away from it."""
    _slopes_agree(model, parameters(model))


def _differences(model: Any, given: Array) -> Array:
    """(B, p, d) slopes by central differences."""
    slopes = []
    for column in range(given.shape[1]):
        step = np.zeros_like(given)
        step[:, column] = STEP * np.maximum(np.abs(given[:, column]), 1e-3)
        span = (given + step)[:, column] - (given - step)[:, column]
        slopes.append((np.asarray(model(given + step)) - np.asarray(model(given - step))) / span[:, None])
    return np.stack(slopes, -1)


def _slopes_agree(model: Any, given: Array) -> None:
    wanted, found = _differences(model, given), np.asarray(model.gradient(given))
    scale = np.abs(wanted).max(axis=0, keepdims=True)
    apart = np.abs(found - wanted) / np.maximum(scale, 1e-9)
    expect((apart < 0.01).all(), f"gradient is {apart.max():.1%} of the steepest slope from central differences")


def check_model_expression_is_the_model(model: Any) -> None:
    """A solver that has the expression follows it, and nothing else tells whether it is the model's."""
    _expression_agrees(model, parameters(model))


def _expression_agrees(model: Any, given: Array) -> None:
    has_it = isinstance(model, Symbolic)
    if not has_it:
        raise NotApplicable("it has no expression")
    if find_spec("casadi") is None:
        raise NotApplicable("CasADi is not installed")
    import casadi

    at = casadi.SX.sym("parameters", given.shape[1])
    expression = casadi.Function("labels", [at], [casadi.vertcat(model.symbolic(at))])
    found = np.array([np.asarray(expression(row)).ravel() for row in given])
    wanted = np.asarray(model(given))
    expect(found.shape == wanted.shape, f"symbolic: expected {wanted.shape[1]} labels, got shape {found.shape[1:]}")
    same = np.allclose(found, wanted, rtol=1e-6, atol=1e-9)
    expect(same, f"symbolic: gives {found[0]} where the model gives {wanted[0]}")


def check_model_parameters_are_left(model: Any) -> None:
    """The caller goes on with the parameters it gave."""
    _parameters_are_left(model, parameters(model))


def _parameters_are_left(model: Any, given: Array) -> None:
    kept = given.copy()
    model(given)
    model.gradient(given)
    if isinstance(model, Uncertain):
        model.interval(given, LEVEL)
        model.outside(given)
    expect(np.array_equal(given, kept), "the model changed the parameters it was given")


def check_model_interval_holds_the_value(model: Any) -> None:
    """An interval tells how far to trust the label, so it has to surround it and grow with the coverage."""
    _interval_holds(model, parameters(model))


def _interval_holds(model: Any, given: Array) -> None:
    has_it = isinstance(model, Uncertain)
    if not has_it:
        raise NotApplicable("it states no interval")
    values, (narrow, wide) = np.asarray(model(given)), (np.asarray(model.interval(given, one)) for one in (0.5, 0.95))
    wanted = (*values.shape, 2)
    for found in (narrow, wide):
        expect(found.shape == wanted, f"interval: expected shape {wanted}, got {found.shape}")
    slack = 1e-9 * np.abs(values)
    held = (narrow[..., 0] <= values + slack) & (values - slack <= narrow[..., 1])
    nested = (wide[..., 0] <= narrow[..., 0]) & (narrow[..., 1] <= wide[..., 1])
    expect(held.all(), "interval: at coverage 0.5 it does not hold the predicted label")
    expect(nested.all(), "interval: at coverage 0.95 it is narrower than at 0.5")
    outside = np.asarray(model.outside(given))
    good = outside.shape == (len(given),) and outside.dtype == bool
    expect(good, f"outside: expected {len(given)} truth values, got {outside!r:.80}")
    _rows_are_independent(given, interval=lambda rows: model.interval(rows, LEVEL), outside=model.outside)


CHECKS: tuple[CheckFunction, ...] = (
    check_model_protocol,
    *COMMON,
    check_units_can_be_read,
    check_model_shapes,
    check_model_rows_are_independent,
    check_model_is_deterministic,
    check_model_gradient_agrees_with_differences,
    check_model_interval_holds_the_value,
    check_model_expression_is_the_model,
    check_model_parameters_are_left,
)


INPUTS, NAMES, UNITS = ("height", "angle", "kind"), ("drag", "lift"), ("N", "")
LEARNT = 0.5  # R² on rows that were not seen


def _rows(count: int, seed: int) -> tuple[Array, Array]:
    """Three parameters (n, 3) of unlike scale, the last without spread; two labels (n, 2): plane and curved."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    given = np.column_stack([1.4 + 0.2 * x, 20 + 5 * y, np.full(count, 3.0)])
    return given, np.column_stack([300 + 40 * x + 10 * y, 0.1 + 0.05 * x**2 + 0.1 * y])


_LATEST: list[tuple[Any, Model]] = []  # fitting is dear and the checks of one regression run in a row


def _learned(regression: Any) -> Model:
    if not _LATEST or _LATEST[0][0] is not regression:
        _LATEST[:] = [(regression, _learn(regression))]
    return _LATEST[0][1]


def _learn(regression: Any, *given: Array) -> Model:
    parameters, labels = given or _rows(60, 1)
    fitted: Model = regression.fit(parameters, labels, inputs=INPUTS, names=NAMES, units=UNITS, seed=2)
    return fitted


def check_fit_gives_a_model(regression: Any) -> None:
    """A study knows models only, by the labels, units and inputs that were asked for."""
    require(regression, Regression)
    fitted = _learned(regression)
    require(fitted, Model)
    said = tuple(fitted.names), tuple(fitted.units), tuple(fitted.inputs)
    expect(said == (NAMES, UNITS, INPUTS), f"fit: expected {(NAMES, UNITS, INPUTS)}, got {said}")
    check_model_shapes(fitted)


def check_model_fit_is_deterministic(regression: Any) -> None:
    """Hidden randomness makes a result that nobody can repeat."""
    given, _ = _rows(10, 9)
    same = np.array_equal(_learned(regression)(given), _learn(regression)(given))
    expect(same, "two fits with one seed answer differently")


def check_plane_is_learned(regression: Any) -> None:
    """Two parameters that act one by one are the least that there is to learn, where a third never changed."""
    given, truth = _rows(200, 9)
    missed = ((_learned(regression)(given) - truth) ** 2).sum(axis=0) / ((truth - truth.mean(axis=0)) ** 2).sum(axis=0)
    for name, score in zip(NAMES, 1 - missed, strict=True):
        expect(score > LEARNT, f"R² {score:.2f} of {name!r} on rows that were not seen, expected > {LEARNT}")


def check_unlabelled_rows_do_not_count(regression: Any) -> None:
    """Exemplars come from many hands; one that lacks a label still has others, and no say in the one it lacks."""
    given, labels = _rows(60, 1)
    gaps, near = labels.copy(), given[:, 1] < 20  # the label grows with this parameter: no filling-in hides
    gaps[~near, 1] = np.nan
    fitted, without = _learn(regression, given, gaps), _learn(regression, given[near], labels[near])
    answers = fitted(given)
    expect(np.isfinite(answers).all(), "fitted on labels with gaps: expected finite labels")
    apart = np.abs(answers - without(given))[:, 1].max() / np.ptp(labels[:, 1])
    expect(apart < 0.1, f"rows without the label move it by {apart:.1%} of its spread")
    apart = np.abs(answers - _learned(regression)(given))[:, 0].max() / np.ptp(labels[:, 0])
    expect(apart < 0.1, f"rows that lack another label are lost to the one they have: {apart:.1%} of its spread")


def check_learned_rows_are_independent(regression: Any) -> None:
    """A design's labels must not depend on which others are asked about with it."""
    fitted, (given, _) = _learned(regression), _rows(5, 9)
    _rows_are_independent(given, labels=fitted, gradient=fitted.gradient)


def check_one_label_is_learned_alike(regression: Any) -> None:
    """Most banks have one label, and whether another is learned beside it must not matter to its shape."""
    given, labels = _rows(60, 1)
    fitted = regression.fit(given, labels[:, :1], inputs=INPUTS, names=NAMES[:1], units=UNITS[:1], seed=2)
    check_model_shapes(fitted)


def check_learned_gradient_follows_the_values(regression: Any) -> None:
    """A solver follows this gradient to the optimum, or away from it; only a model that goes in steps has none."""
    fitted, (given, _) = _learned(regression), _rows(20, 9)
    if not np.any(fitted.gradient(given)):
        moved = np.mean(_differences(fitted, given) != 0)
        expect(moved < 0.5, f"gradient: zero everywhere, and {moved:.0%} of the values move with their parameters")
        raise NotApplicable("what it learns goes in steps: its gradient is zero almost everywhere")
    _slopes_agree(fitted, given)


def check_learned_interval_holds_the_value(regression: Any) -> None:
    """An interval tells how far to trust the label, so it has to surround it and grow with the coverage."""
    _interval_holds(_learned(regression), _rows(20, 9)[0])


def check_far_from_the_rows_is_outside(regression: Any) -> None:
    """A study may only trust what was learned where there was something to learn from."""
    fitted, (given, _) = _learned(regression), _rows(60, 1)
    if not isinstance(fitted, Uncertain):
        raise NotApplicable("it knows no outside")
    centre, spread = given.mean(axis=0), np.ptp(given, axis=0)
    for number, way in ((i, way) for i in np.flatnonzero(spread) for way in (-20, 20)):
        far = centre + way * spread * np.eye(len(spread))[number]
        said = bool(np.all(fitted.outside(far[None])))
        expect(said, f"outside: False where {INPUTS[number]!r} is {way} times the rows' spread from their middle")
    inside = 1 - np.mean(fitted.outside(given))
    expect(inside > LEARNT, f"outside: True of {1 - inside:.0%} of the rows that it was fitted on")


def check_learned_expression_is_the_model(regression: Any) -> None:
    """A solver that has the expression follows it, and nothing else tells whether it is the model's."""
    _expression_agrees(_learned(regression), _rows(20, 9)[0])


def check_learned_model_is_kept(regression: Any) -> None:
    """What was learned is stored beside the bank; read back it has to give the same values."""
    fitted, (given, _) = _learned(regression), _rows(10, 9)
    if not isinstance(fitted, State):
        raise NotApplicable("what it learns has no state")
    again = kept_and_read(fitted)
    said = tuple(again.names), tuple(again.units), tuple(again.inputs)
    expect(said == (NAMES, UNITS, INPUTS), f"made from its state it says {said}")
    expect(np.array_equal(again(given), fitted(given)), "made from its state it answers differently")
    if isinstance(fitted, Uncertain):
        far = np.concatenate([given, 10 * given])
        expect(isinstance(again, Uncertain), "made from its state it states no interval")
        same = np.array_equal(again.interval(far, LEVEL), fitted.interval(far, LEVEL))
        expect(same, "made from its state it states other intervals")
        expect(np.array_equal(again.outside(far), fitted.outside(far)), "made from its state it has another outside")


def check_rows_given_are_left(regression: Any) -> None:
    """The same exemplars go to other regressions, and into the bank."""
    given, labels = _rows(60, 1)
    kept = given.copy(), labels.copy()
    fitted = _learn(regression, given, labels)
    _parameters_are_left(fitted, given)
    left = np.array_equal(given, kept[0]) and np.array_equal(labels, kept[1])
    expect(left, "learning or asking changed the parameters or labels that were given")


REGRESSION_CHECKS: tuple[CheckFunction, ...] = (
    *COMMON,
    check_fit_gives_a_model,
    check_model_fit_is_deterministic,
    check_plane_is_learned,
    check_unlabelled_rows_do_not_count,
    check_one_label_is_learned_alike,
    check_learned_rows_are_independent,
    check_learned_gradient_follows_the_values,
    check_learned_interval_holds_the_value,
    check_far_from_the_rows_is_outside,
    check_learned_expression_is_the_model,
    check_learned_model_is_kept,
    check_rows_given_are_left,
)
