"""What a measure and a surrogate have to do."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt import units
from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.protocols import Gradient, Interval, Measure, State, Surrogate
from lampopt.testing import shapes
from lampopt.testing.engine import COMMON, CheckFunction, NotApplicable, expect, kept_and_read, must_raise, require
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

CLOSE = 1e-3  # relative; of measures that sample or slice
ORDER = 1e-6  # relative; what the order of sums may change
SPREAD = 0.05  # of a surrogate's answers: what resampled points may change
LENGTHS = {"L": 1, "L^2": 2, "L^3": 3, "L^4": 4, "L^5": 5, "": 0, "deg": 0, "rad": 0}
WAYS = ("a stretch", "a shift", "a smooth motion")
SLIGHT = 0.05  # of a value: a slope less than that is not told from noise


def example(measure: Any) -> Trimesh:
    """A fresh mesh that the measure takes: its own `example_mesh()`, else the first of the kit's shapes.

    Raises
    ------
    NotApplicable
        If it takes none.
    """
    if hasattr(measure, "example_mesh"):
        mesh: Trimesh = measure.example_mesh()
        return mesh
    for make in (shapes.box, shapes.plate_with_hole, shapes.ellipsoid):
        mesh = make()
        try:
            measure(mesh.copy())
        except MeasureError:
            continue
        return mesh
    raise NotApplicable("it measures none of the kit's shapes")


def _values(measure: Measure, mesh: Trimesh) -> Array:
    return np.asarray(measure(mesh), float)


def _agree(found: Array, wanted: Array, names: tuple[str, ...], what: str, tolerance: float, scale: Array) -> None:
    for name, a, b, size in zip(names, found, wanted, np.broadcast_to(scale, wanted.shape), strict=True):
        expect(abs(a - b) <= tolerance * size, f"{name!r} {what}: expected {b:.9g}, got {a:.9g}")


def _size(measure: Measure, mesh: Trimesh) -> Array:
    """(p,) what an error of 1 means: the value, or the mesh's own size to the unit's power where that is larger."""
    powers = np.array([LENGTHS.get(unit, 0) for unit in measure.units])
    return np.maximum(np.abs(_values(measure, mesh)), float(np.max(mesh.extents)) ** powers * (powers > 0) + 1e-9)


def check_protocol(measure: Any) -> None:
    """Names and units are how a study addresses values and compares them with parameters."""
    require(measure, Measure)
    names, said = measure.names, measure.units
    expect(
        isinstance(names, tuple) and all(isinstance(n, str) and n for n in names), f"names: expected texts, got {names}"
    )
    expect(len(set(names)) == len(names) > 0, f"names: expected distinct ones, at least one, got {names}")
    expect(isinstance(said, tuple) and len(said) == len(names), f"units: expected {len(names)} texts, got {said!r}")


def check_units_can_be_read(measure: Any) -> None:
    """The core fills the mesh's unit in for L and converts; a unit it cannot read is a value nobody can compare."""
    for unit in measure.units:
        expect(_readable(unit), f"unit {unit!r}: expected L, L^2, ... L^5, deg, '' or a unit that pint reads")


@cache
def _readable(unit: str) -> bool:
    if unit in LENGTHS:
        return True
    text = units.filled(unit, "m")
    try:
        units.factor(f"({text})", text, "unit")  # brackets, for equal texts are never looked at
    except InputError:
        return False
    return True


def check_something_is_measured(measure: Any) -> None:
    """What can be measured on no mesh at hand cannot be checked; `example_mesh()` says what it is made for."""
    try:
        values = _values(measure, example(measure))
    except NotApplicable as reason:
        expect(False, f"{reason}; declare a method example_mesh() that returns a mesh it measures")
    expect(values.shape == (len(measure.names),), f"expected values ({len(measure.names)},), got {values.shape}")
    expect(np.isfinite(values).all(), f"expected finite values, got {dict(zip(measure.names, values, strict=True))}")


def _positions(measure: Any) -> tuple[str, ...]:
    """For each value the axis along which it is a place in the mesh's own coordinates, "" for none."""
    said = getattr(measure, "positions", ("",) * len(measure.names))
    right = isinstance(said, tuple) and len(said) == len(measure.names) and set(said) <= {"", "x", "y", "z"}
    expect(right, f"positions: expected {len(measure.names)} of 'x', 'y', 'z' and '', got {said!r}")
    lengths = [unit == "L" for unit, axis in zip(measure.units, said, strict=True) if axis]
    expect(all(lengths), f"positions: expected unit L for values that are places, got {measure.units}")
    return tuple(said)


def check_place_does_not_matter(measure: Any) -> None:
    """Designs come back in the user's frame, exemplars from anywhere; only a place moves along, and says so."""
    mesh = example(measure)
    moved, move = mesh.copy(), np.max(mesh.extents) * np.array([0.3, -0.7, 0.2])
    moved.apply_translation(move)
    along = np.array([move["xyz".index(axis)] if axis else 0.0 for axis in _positions(measure)])
    args = _values(measure, moved), _values(measure, mesh) + along, measure.names, "on a moved mesh"
    _agree(*args, CLOSE, _size(measure, mesh))


def check_scale_follows_the_unit(measure: Any) -> None:
    """A value with unit L^2 is four times as large on a mesh twice as long, or its unit is wrong."""
    mesh, factor = example(measure), 2.0
    known = [unit in LENGTHS for unit in measure.units]
    if not any(known):
        raise NotApplicable("no unit says how its value scales")
    larger = mesh.copy()
    larger.apply_transform(np.diag([factor, factor, factor, 1]))
    growth = factor ** np.array([LENGTHS.get(unit, 0) for unit in measure.units])
    found, wanted, scale = _values(measure, larger), growth * _values(measure, mesh), growth * _size(measure, mesh)
    names = tuple(f"{n} [{u}]" for n, u in zip(measure.names, measure.units, strict=True))
    kept = np.flatnonzero(known)
    _agree(found[kept], wanted[kept], tuple(names[i] for i in kept), "on a mesh twice as large", CLOSE, scale[kept])


def check_measuring_is_deterministic(measure: Any) -> None:
    """Two measurements of one design have to agree, whatever was measured in between."""
    mesh = example(measure)
    first = _values(measure, mesh.copy())
    _values(measure, _larger(mesh))
    expect(np.array_equal(first, _values(measure, mesh.copy())), "a, b, a gives two answers for a")


def _larger(mesh: Trimesh) -> Trimesh:
    copy = mesh.copy()
    copy.apply_transform(np.diag([1.1, 1.1, 1.1, 1]))
    return copy


def _shuffled(mesh: Trimesh) -> Trimesh:
    from trimesh import Trimesh

    draw = np.random.default_rng(5)
    order = draw.permutation(len(mesh.vertices))
    place = np.argsort(order)
    faces = place[np.asarray(mesh.faces)][draw.permutation(len(mesh.faces))]
    return Trimesh(np.asarray(mesh.vertices)[order], faces, process=False)


def check_vertex_order_does_not_matter(measure: Any) -> None:
    """Decoders number vertices as they please; a shape is the same shape however its vertices are listed."""
    mesh = example(measure)
    args = _values(measure, _shuffled(mesh)), _values(measure, mesh), measure.names, "with vertices in another order"
    _agree(*args, ORDER, _size(measure, mesh))


def check_mesh_is_left(measure: Any) -> None:
    """Every check of a design sees the same mesh, and the user's file is written from it."""
    mesh = example(measure)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    measure(mesh)
    if isinstance(measure, Interval):
        measure.interval(mesh, 0.9)
        measure.outside(mesh)
    same = np.array_equal(vertices, mesh.vertices) and np.array_equal(faces, mesh.faces)
    expect(same, "measuring changed the mesh's vertices or faces")


def check_empty_mesh_is_refused(measure: Any) -> None:
    """NaN in place of an error would be compared with limits and stored."""
    from trimesh import Trimesh

    empty = Trimesh(np.empty((0, 3)), np.empty((0, 3), int))
    must_raise(lambda: measure(empty), (MeasureError, EmptyMesh), "measuring a mesh without faces")


def check_gradient_agrees_with_differences(measure: Any) -> None:
    """A solver follows this gradient to the optimum, or away from it."""
    has_it = isinstance(measure, Gradient)
    if not has_it:
        raise NotApplicable("it has no gradient")
    mesh = example(measure)
    before = np.array(mesh.vertices), np.array(mesh.faces)
    gradient = np.asarray(measure.gradient(mesh))
    kept = np.array_equal(before[0], mesh.vertices) and np.array_equal(before[1], mesh.faces)
    expect(kept, "gradient: altered the mesh that it was given: others are to look at it too")
    wanted = (len(measure.names), len(mesh.vertices), 3)
    expect(gradient.shape == wanted, f"gradient: expected {wanted}, got {gradient.shape}")
    uneven = mesh.copy()  # where no two corners are the outermost, and steps may be small
    uneven.vertices += 1e-3 * np.ptp(before[0], axis=0).max() * np.random.default_rng(0).uniform(-1, 1, before[0].shape)
    attempts = (mesh, gradient, 1e-4), (uneven, None, 1e-6)
    off = np.minimum(*(_off_differences(measure, *attempt) for attempt in attempts))
    for way, errors in zip(WAYS, off, strict=True):
        for name, error in zip(measure.names, errors, strict=True):
            expect(error <= 0.02, f"{name!r} along {way}: its gradient is off by {error:.2g} of the slope")


def _off_differences(measure: Any, mesh: Trimesh, gradient: Array | None, step: float) -> Array:
    """(3, p) how far the slopes along `WAYS` are from those by differences; inf where the mesh cannot be measured."""
    vertices = np.asarray(mesh.vertices)
    size = float(np.ptp(vertices, axis=0).max())
    waves = np.sin(vertices / size @ np.array([[2.1, 0.4, -0.6], [-0.5, 1.7, 0.3], [0.8, -0.2, 2.4]]) + [0.3, 1.1, 2.0])
    stretch = vertices @ np.array([[0.9, 0.2, -0.1], [0.1, 1.1, 0.3], [-0.2, 0.1, 0.8]])
    shift = np.broadcast_to(size * np.array([0.7, -0.4, 0.5]), vertices.shape)
    found = []
    try:
        sizes, middle = _size(measure, mesh), _values(measure, mesh)
        gradient = np.asarray(measure.gradient(mesh)) if gradient is None else gradient
        for way in (stretch, shift, size * waves):
            slopes = []
            for sign in (-1, 1):
                moved = mesh.copy()
                moved.vertices = vertices + sign * step * way
                slopes.append(sign * (_values(measure, moved) - middle) / step)
            said = (gradient * way).sum((1, 2))
            wanted = np.clip(said, *np.sort(slopes, axis=0))  # at a kink both of its sides are right
            found.append(np.abs(said - wanted) / np.maximum(np.abs(wanted), SLIGHT * sizes))
    except MeasureError:
        return np.full((len(WAYS), len(measure.names)), np.inf)
    return np.array(found)


def check_interval_holds_the_value(measure: Any) -> None:
    """An interval tells how far to trust the value, so it has to surround it and grow with the coverage."""
    has_it = isinstance(measure, Interval)
    if not has_it:
        raise NotApplicable("it states no interval")
    mesh = example(measure)
    values, narrow, wide = _values(measure, mesh), measure.interval(mesh, 0.5), measure.interval(mesh, 0.95)
    expect(np.shape(narrow) == (len(values), 2), f"interval: expected ({len(values)}, 2), got {np.shape(narrow)}")
    nested = (wide[:, 0] <= narrow[:, 0]) & (narrow[:, 0] <= values) & (values <= narrow[:, 1])
    expect((nested & (narrow[:, 1] <= wide[:, 1])).all(), f"interval: {values} at 0.5 in {narrow}, at 0.95 in {wide}")
    expect(isinstance(measure.outside(mesh), bool | np.bool_), "outside: expected True or False")


def check_state_gives_it_again(measure: Any) -> None:
    """What was learned is kept as named arrays; read back it has to give the same values."""
    has_it = isinstance(measure, State)
    if not has_it:
        raise NotApplicable("it has no state")
    mesh = example(measure)
    again = kept_and_read(measure)
    expect((again.names, again.units) == (measure.names, measure.units), "from_state: names or units differ")
    found, wanted = _values(again, mesh), _values(measure, mesh)
    _agree(found, wanted, measure.names, "made from its state", ORDER, _size(measure, mesh))
    if isinstance(measure, Interval):
        expect(isinstance(again, Interval), "made from its state it states no interval")
        found, wanted = (np.asarray(one.interval(mesh, 0.9), float) for one in (again, measure))
        same = np.allclose(found, wanted, rtol=1e-6, atol=1e-9)
        expect(same, "made from its state it states another interval")


CHECKS: tuple[CheckFunction, ...] = (
    check_protocol,
    *COMMON,
    check_units_can_be_read,
    check_something_is_measured,
    check_place_does_not_matter,
    check_scale_follows_the_unit,
    check_measuring_is_deterministic,
    check_vertex_order_does_not_matter,
    check_mesh_is_left,
    check_empty_mesh_is_refused,
    check_gradient_agrees_with_differences,
    check_interval_holds_the_value,
    check_state_gives_it_again,
)


def _boxes(count: int, seed: int) -> Iterator[tuple[float, Trimesh]]:
    draw = np.random.default_rng(seed)
    for _ in range(count):
        extents = draw.uniform([0.6, 0.3, 0.3], [1.4, 0.6, 0.5])
        yield float(extents[0]), shapes.box(extents)


_LATEST: list[tuple[Any, Measure]] = []  # fitting is dear and the checks of one surrogate run in a row


def _learned(surrogate: Any) -> Measure:
    if not _LATEST or _LATEST[0][0] is not surrogate:
        _LATEST[:] = [(surrogate, _learn(surrogate))]
    return _LATEST[0][1]


def _learn(surrogate: Any) -> Measure:
    lengths, meshes = zip(*_boxes(32, 1), strict=True)
    learned: Measure = surrogate.fit(list(meshes), np.array(lengths)[:, None], ("length",), ("L",), seed=2)
    return learned


def _held_out(surrogate: Any, learned: Measure | None = None) -> tuple[Array, Array]:
    truth, meshes = zip(*_boxes(10, 9), strict=True)
    measure = learned or _learned(surrogate)
    return np.array(truth), np.array([_values(measure, mesh)[0] for mesh in meshes])


def check_fit_gives_a_measure(surrogate: Any) -> None:
    """The check stage knows measures only, by the names and units that were asked for."""
    require(surrogate, Surrogate)
    learned = _learned(surrogate)
    require(learned, Measure)
    said = tuple(learned.names), tuple(learned.units)
    expect(said == (("length",), ("L",)), f"fit: expected names ('length',) and units ('L',), got {said}")


def check_fit_is_deterministic(surrogate: Any) -> None:
    """Hidden randomness makes a result that nobody can repeat."""
    same = np.array_equal(_held_out(surrogate)[1], _held_out(surrogate, _learn(surrogate))[1])
    expect(same, "two fits with one seed answer differently")


def check_learned_measure_ignores_vertex_order(surrogate: Any) -> None:
    """Decoders number vertices as they please; a shape is the same shape however its vertices are listed."""
    learned, answers = _learned(surrogate), _held_out(surrogate)[1]
    shuffled = np.array([_values(learned, _shuffled(mesh))[0] for _, mesh in _boxes(10, 9)])
    apart = np.abs(shuffled - answers).max() / max(float(np.ptp(answers)), 1e-9)
    expect(apart <= SPREAD, f"another vertex order moves the answer by {apart:.1%} of its spread")


def check_length_is_learned(surrogate: Any) -> None:
    """What cannot learn the length of a box will not learn drag."""
    truth, answers = _held_out(surrogate)
    score = 1 - ((truth - answers) ** 2).sum() / ((truth - truth.mean()) ** 2).sum()
    expect(score > 0.5, f"R² {score:.2f} on held-out boxes, expected > 0.5")


def check_learned_measure_is_kept(surrogate: Any) -> None:
    """What was learned is stored beside the bank; read back it has to give the same values."""
    learned = _learned(surrogate)
    if not isinstance(learned, State):
        raise NotApplicable("what it learns has no state")
    again = kept_and_read(learned)
    answers = _held_out(surrogate)[1]
    apart = np.abs(_held_out(surrogate, again)[1] - answers).max() / max(float(np.ptp(answers)), 1e-9)
    expect(apart <= ORDER, f"made from its state it answers {apart:.1e} of the spread apart")


SURROGATE_CHECKS: tuple[CheckFunction, ...] = (
    *COMMON,
    check_fit_gives_a_measure,
    check_fit_is_deterministic,
    check_learned_measure_ignores_vertex_order,
    check_length_is_learned,
    check_learned_measure_is_kept,
)
