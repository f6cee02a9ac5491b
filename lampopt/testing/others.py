"""What a model, a regression and a source have to do."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from lampopt.protocols import Model, Regression, Source, State, Uncertain
from lampopt.testing.engine import COMMON, CheckFunction, NotApplicable, expect, read_only, require
from lampopt.testing.measures import check_units_can_be_read
from lampopt.types import Array, Exemplars

FEW = 4  # exemplars whose meshes are loaded
STEP = 1e-4  # relative, for differences
FITS = 0.02  # of a mesh's diagonal


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
    alone = np.concatenate([model(row[None]) for row in given])
    together = np.asarray(model(given))
    expect(np.allclose(alone, together, rtol=1e-6, atol=1e-9), "rows one by one and together differ")


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


def check_model_parameters_are_left(model: Any) -> None:
    """The caller goes on with the parameters it gave."""
    given = parameters(model)
    kept = given.copy()
    model(given)
    model.gradient(given)
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


MODEL_CHECKS: tuple[CheckFunction, ...] = (
    check_model_protocol,
    *COMMON,
    check_units_can_be_read,
    check_model_shapes,
    check_model_rows_are_independent,
    check_model_is_deterministic,
    check_model_gradient_agrees_with_differences,
    check_model_interval_holds_the_value,
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


def check_learned_rows_are_independent(regression: Any) -> None:
    """A design's labels must not depend on which others are asked about with it."""
    fitted, (given, _) = _learned(regression), _rows(5, 9)
    alone = np.concatenate([fitted(row[None]) for row in given])
    expect(np.allclose(alone, fitted(given), rtol=1e-6, atol=1e-9), "rows one by one and together differ")


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
    far = given[:1] + 20 * np.ptp(given, axis=0)
    expect(np.all(fitted.outside(far)), "outside: False at 20 times the spread of the rows away from them")
    inside = 1 - np.mean(fitted.outside(given))
    expect(inside > LEARNT, f"outside: True of {1 - inside:.0%} of the rows that it was fitted on")


def check_learned_model_is_kept(regression: Any) -> None:
    """What was learned is stored beside the bank; read back it has to give the same values."""
    fitted, (given, _) = _learned(regression), _rows(10, 9)
    if not isinstance(fitted, State):
        raise NotApplicable("what it learns has no state")
    again = type(fitted).from_state({name: read_only(array) for name, array in fitted.state().items()})
    said = tuple(again.names), tuple(again.units), tuple(again.inputs)
    expect(said == (NAMES, UNITS, INPUTS), f"made from its state it says {said}")
    expect(np.array_equal(again(given), fitted(given)), "made from its state it answers differently")


def check_rows_given_are_left(regression: Any) -> None:
    """The same exemplars go to other regressions, and into the bank."""
    given, labels = _rows(60, 1)
    kept = given.copy(), labels.copy()
    fitted = _learn(regression, given, labels)
    fitted(given)
    fitted.gradient(given)
    left = np.array_equal(given, kept[0]) and np.array_equal(labels, kept[1])
    expect(left, "learning or asking changed the parameters or labels that were given")


REGRESSION_CHECKS: tuple[CheckFunction, ...] = (
    *COMMON,
    check_fit_gives_a_model,
    check_model_fit_is_deterministic,
    check_plane_is_learned,
    check_unlabelled_rows_do_not_count,
    check_learned_rows_are_independent,
    check_learned_gradient_follows_the_values,
    check_learned_interval_holds_the_value,
    check_far_from_the_rows_is_outside,
    check_learned_model_is_kept,
    check_rows_given_are_left,
)


def _few(exemplars: Exemplars) -> list[int]:
    return sorted({round(i) for i in np.linspace(0, len(exemplars) - 1, FEW)})


def _same(a: Any, b: Any) -> bool:
    return np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)


def check_source_protocol(source: Any) -> None:
    """A bank is built from exemplars, wherever they come from."""
    require(source, Source)
    found = source()
    expect(isinstance(found, Exemplars), f"expected Exemplars, got {type(found).__name__}")


def check_source_repeats_itself(source: Any) -> None:
    """A build that is resumed asks again and has to meet the same exemplars."""
    first, second = source(), source()
    for what in ("names", "space", "label_space", "unit"):
        a, b = getattr(first, what), getattr(second, what)
        expect(a == b, f"two calls give {what} {a} and {b}")
    expect(np.array_equal(first.parameters, second.parameters), "two calls give other parameters")
    expect(np.array_equal(first.labels, second.labels, equal_nan=True), "two calls give other labels")
    for i in _few(first):
        expect(_same(first.meshes[i], second.meshes[i]), f"two calls give other meshes of {first.names[i]!r}")


def check_source_meshes_load(source: Any) -> None:
    """A mesh that cannot be used is cheaper to meet here than after an hour of fitting."""
    found = source()
    for i in _few(found):
        mesh, name = found.meshes[i], found.names[i]
        expect(len(mesh.faces) > 0, f"mesh of {name!r}: expected faces, got none")
        expect(np.isfinite(mesh.vertices).all(), f"mesh of {name!r}: expected finite vertices")


def check_source_meshes_are_closed(source: Any) -> None:
    """Inside and outside are certain on closed meshes only; a source of open ones says so with `watertight = False`."""
    if not getattr(source, "watertight", True):
        raise NotApplicable("the source says that its meshes are open")
    found = source()
    for i in _few(found):
        expect(found.meshes[i].is_watertight, f"mesh of {found.names[i]!r} is open and the source does not say so")


def check_source_meshes_can_be_read_twice(source: Any) -> None:
    """Fitting, measuring and hashing each read an exemplar, in any order, and have to see one mesh."""
    found = source()
    few = _few(found)
    first = [(np.array(found.meshes[i].vertices), np.array(found.meshes[i].faces)) for i in few]
    for (vertices, faces), i in zip(reversed(first), reversed(few), strict=True):
        mesh = found.meshes[i]
        same = np.array_equal(vertices, mesh.vertices) and np.array_equal(faces, mesh.faces)
        expect(same, f"mesh of {found.names[i]!r} differs when it is read again")


def check_source_meshes_end(source: Any) -> None:
    """Iterating over a sequence stops at IndexError; without it a loop never ends or ends in a crash."""
    found = source()
    try:
        found.meshes[len(found)]
    except IndexError:
        return
    expect(False, f"meshes[{len(found)}] of {len(found)}: expected IndexError, got a mesh")


def check_source_parameters_differ(source: Any) -> None:
    """Two exemplars with the same parameters and other shapes make the mix between them meaningless."""
    found = source()
    order = np.lexsort(found.parameters.T) if found.parameters.shape[1] else np.arange(len(found))
    for a, b in pairwise(order):
        if np.array_equal(found.parameters[a], found.parameters[b]):
            same = _same(found.meshes[a], found.meshes[b])
            expect(same, f"{found.names[a]!r} and {found.names[b]!r} differ in shape and not in parameters")


def check_source_mesh_at_is_the_exemplar(source: Any) -> None:
    """Produced shapes are judged against this truth, so it has to be the truth where an exemplar shows it."""
    found = source()
    if found.mesh_at is None:
        raise NotApplicable("the source knows no true meshes")
    for i in _few(found):
        given, true = found.meshes[i], found.mesh_at(np.array(found.parameters[i]))
        apart = np.abs(np.asarray(true.bounds) - np.asarray(given.bounds)).max() / given.scale
        expect(apart <= FITS, f"mesh_at the parameters of {found.names[i]!r} is {apart:.1%} of its size off")


SOURCE_CHECKS: tuple[CheckFunction, ...] = (
    check_source_protocol,
    *COMMON,
    check_source_repeats_itself,
    check_source_meshes_load,
    check_source_meshes_are_closed,
    check_source_meshes_can_be_read_twice,
    check_source_meshes_end,
    check_source_parameters_differ,
    check_source_mesh_at_is_the_exemplar,
)
