"""Bank + what is asked → Problem → solver → Mix (paper, equation (1)).

Every name that can be asked for is a column over the exemplars: a parameter, a label, a declared measured value. Each
is normalised to [-1, 1] over the bank, so that rows weigh alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from lampopt.errors import InputError, PluginError, StudyError
from lampopt.protocols import Solver
from lampopt.reading import brief
from lampopt.types import BOUNDS, Array, Bank, Conflict, Mix, MixBatch, Problem, called, gave

MET = "every target is met"
ALIKE = 1e-3  # of what gives alone and of what all give: not told twice
FARTHEST = 1e9  # half ranges, beyond which no mix can be told from others in double precision
GIVES = 1e-6  # what gives less [normalised] is not told to give


@dataclass(frozen=True, eq=False)
class Column:
    """One name that can be asked for: its `values` (N,) over the exemplars (NaN = unknown) and its `unit`."""

    name: str
    unit: str
    values: Array

    @property
    def low(self) -> float:
        """Least known value."""
        return float(np.nanmin(self.values))

    @property
    def spread(self) -> float:
        """Range of the known values."""
        return float(np.nanmax(self.values)) - self.low

    def normalised(self, value: Array | float) -> Array:
        """`value` on [-1, 1] over the bank."""
        return np.asarray(2 * (np.asarray(value) - self.low) / self.spread - 1)


def columns(bank: Bank) -> dict[str, Column]:
    """Everything that can be asked of `bank`, by name: parameters, labels, then declared measured values."""
    found = {q.name: Column(q.name, q.unit, v) for q, v in zip(bank.space, bank.parameters.T, strict=True)}
    found |= {q.name: Column(q.name, q.unit, v) for q, v in zip(bank.label_space, bank.labels.T, strict=True)}
    for (parameter, address), values in zip(bank.measured_by.items(), bank.measured.T, strict=True):
        same = found[parameter].spread == 0  # then what differs is rounding, of files in single precision
        found[address] = Column(address, found[parameter].unit, np.full_like(values, values.mean()) if same else values)
    return found


def column(bank: Bank, name: str) -> Column:
    """The column called `name`.

    Raises
    ------
    StudyError
        If there is none, or all exemplars agree in it, so that no mix can move it.
    """
    return _movable(columns(bank), name)


def _movable(known: Mapping[str, Column], name: str) -> Column:
    if name not in known:
        raise StudyError(f"{name!r}: neither a parameter, a label nor a measured value; known are {', '.join(known)}")
    found = known[name]
    if np.isnan(found.values).all():
        raise StudyError(f"{name!r}: no exemplar of this bank has a value for it")
    if found.spread == 0:
        value = f"{found.low:g} {found.unit}".rstrip()
        raise StudyError(f"{name!r}: all exemplars have {value}: no mix can change it")
    return found


@dataclass(frozen=True, eq=False)
class Posed:
    """A problem over the exemplars that can take part (`active`), and the way back to the user's terms."""

    problem: Problem
    active: Array
    rows: tuple[Column, ...]
    size: int
    limits: tuple[Column, ...] = ()

    @property
    def nonlinear(self) -> bool:
        """Whether the problem has terms."""
        return bool(self.problem.objectives or self.problem.constraints or self.problem.equalities)

    def normalised(self, targets: Array) -> Array:
        """Targets (B, k) in the user's units → normalised rows."""
        rows = [row.normalised(targets[:, i]) for i, row in enumerate(self.rows)]
        return np.array(rows, float).reshape(len(self.rows), len(targets)).T

    def spread_out(self, alpha: Array) -> Array:
        """Coefficients (..., active) → (..., N), 0 for exemplars that take no part."""
        full = np.zeros((*alpha.shape[:-1], self.size))
        full[..., self.active] = alpha
        return full

    def centre(self) -> Array:
        """The centre (N,)."""
        return self.spread_out(self.problem.centre)


def pose(
    bank: Bank,
    targets: Mapping[str, float],
    *,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    hard: Sequence[str] = (),
    reference: str | None = None,
    among: Sequence[int] | Array | None = None,
    weights: Mapping[str, float] | None = None,
    sums: Sequence[tuple[Column, float, float]] = (),
    needed: Sequence[str] = (),
    moved: Sequence[str] = (),
    instead: Mapping[str, Array] | None = None,
) -> Posed:
    """The problem that asks `targets` of `bank`.

    Parameters
    ----------
    targets
        Wanted values by name, in the units of `columns`.
    ranges
        Names to be kept between two values.
    hard
        Targets that must be met exactly.
    reference
        The exemplar to stay near; None: the mean of all that take part.
    among
        The exemplars, by number, that may take part; None: all.
    weights
        What a missed target weighs; 1 by default.
    sums
        More columns to be kept between two values.
    needed
        Names that exemplars have to have a value for besides.
    moved
        Names that may have to move for what is asked, besides those that are.
    instead
        (N,) what targets are taken to be over the exemplars, by name, in place of the bank's values.

    Raises
    ------
    StudyError
        If a name is unknown or cannot be moved, the reference is unknown or lacks a label that is asked for.
    """
    ranges = dict(ranges or {})
    names = columns(bank)
    others = {name: replace(_movable(names, name), values=values) for name, values in (instead or {}).items()}
    rows = tuple(_movable(names | others, name) for name in targets)
    limits = (*(_movable(names, name) for name in ranges), *(column for column, _, _ in sums))
    ends = [*ranges.values(), *((low, high) for _, low, high in sums)]
    asked_for = [_movable(names, c.name) for c in rows]  # without a label an exemplar takes no part
    known = [~np.isnan(c.values) for c in (*asked_for, *limits, *(_movable(names, name) for name in needed))]
    active = np.flatnonzero(np.all(known, axis=0) if known else np.ones(len(bank), bool))
    if among is not None:
        active = np.intersect1d(active, np.asarray(among, int))
    if not len(active):
        raise StudyError(f"no exemplar has all of {', '.join(c.name for c in (*rows, *limits))}")
    for low, high in ends:
        if not low <= high:
            raise StudyError(f"ranges: expected low ≤ high, got {low:g} to {high:g}")
        if low == inf or high == -inf:
            raise StudyError(f"ranges: expected a range with numbers in it, got {low:g} to {high:g}")
    for c in rows:
        _expect_near(c, targets[c.name])
    for c, (low, high) in zip(limits, ends, strict=True):
        _expect_near(c, low)
        _expect_near(c, high)
    asked = {c.name for c in (*rows, *limits)} | {*moved}
    asked |= {parameter for parameter, address in bank.measured_by.items() if address in asked}
    parameters = [names[q.name] for q in bank.space if names[q.name].spread > 0]
    # "This car, roof lower": nothing but the roof moves. A label cannot move if no parameter does.
    alone = reference is not None and not (asked | {*needed}) & {q.name for q in bank.label_space}
    problem = Problem(
        names=tuple(c.name for c in rows),
        matrix=_matrix(rows, active),
        target=np.array([float(c.normalised(targets[c.name])) for c in rows]),
        weight=np.array([(weights or {}).get(c.name, 1.0) for c in rows]),
        hard=np.array([c.name in hard for c in rows], bool),
        range_names=tuple(f"{c.name} (range)" for c in limits),
        range_matrix=_matrix(limits, active),
        range_low=np.array([float(c.normalised(low)) for c, (low, _) in zip(limits, ends, strict=True)]),
        range_high=np.array([float(c.normalised(high)) for c, (_, high) in zip(limits, ends, strict=True)]),
        centre=_centre(bank, active, reference),
        still=_matrix([c for c in parameters if c.name not in asked] if alone else [], active),
        directions=_directions(_matrix(parameters, active)),
    )
    return Posed(problem, active, rows, len(bank), limits)


def _expect_near(asked: Column, value: float) -> None:
    far = abs(float(asked.normalised(value)))
    if FARTHEST < far < inf:
        high = asked.low + asked.spread
        raise StudyError(
            f"{asked.name}: expected a value within {FARTHEST:g} half ranges of the bank's, which go from "
            f"{asked.low:g} to {high:g}, got {value:g} {asked.unit}".rstrip()
            + ": is the unit right? An open range ends at inf"
        )


def _matrix(rows: Sequence[Column], active: Array) -> Array:
    return np.array([c.normalised(c.values[active]) for c in rows]).reshape(len(rows), len(active))


def _directions(matrix: Array) -> Array:
    """(d, N) the least changes of alpha that move one parameter each by half of its range; from matrix (d, N)."""
    return np.asarray(np.linalg.pinv(matrix - matrix.mean(1, keepdims=True), rcond=1e-10).T)


def _centre(bank: Bank, active: Array, reference: str | None) -> Array:
    if reference is None:
        return np.full(len(active), 1 / len(active))
    if reference not in bank.names:
        raise StudyError(f"reference {reference!r}: no exemplar of this bank; there are {', '.join(bank.names)}")
    centre = (active == bank.names.index(reference)).astype(float)
    if not centre.any():
        raise StudyError(f"reference {reference!r}: lacks a label that the study asks for; choose another")
    return np.asarray(centre)


def solve(posed: Posed, solver: Solver) -> Mix:
    """The mix over all N exemplars, its message and conflicts in the user's units.

    The residual is what its alpha leaves, whatever the solver says of it: it is evidence.

    Raises
    ------
    PluginError
        If the solver returns no mix of the exemplars that take part.
    """
    problem = posed.problem
    try:
        mix: object = solver.solve(problem)
    except InputError as error:  # from Mix: not finite, no sum of 1, a status that there is not
        raise PluginError(f"solver {type(solver).__name__}: returned no mix that can be used: {error}") from error
    if not isinstance(mix, Mix) or mix.alpha.shape != problem.centre.shape:
        raise _no_mix(solver, Mix, problem.centre.shape, mix)
    mix = replace(mix, residual=problem.matrix @ mix.alpha - problem.target)
    return Mix(posed.spread_out(mix.alpha), mix.residual, mix.status, explain(posed, mix), mix.conflicts)


def solve_many(posed: Posed, targets: Sequence[Mapping[str, float]], solver: Solver) -> list[Mix]:
    """As `solve`, for many targets of the posed problem's names, in one call to the solver.

    A batch tells no reasons, so those that are not met exactly are solved again, one by one.

    Raises
    ------
    PluginError
        If the solver returns no mixes of the exemplars that take part, one a target.
    """
    rows = np.array([[target[name] for name in posed.problem.names] for target in targets], float)
    normalised = posed.normalised(rows)
    batch = solve_path(posed, normalised, None, solver)
    return [
        Mix(mix, residual, status, MET)
        if status == "exact"
        else solve(replace(posed, problem=replace(posed.problem, target=row)), solver)
        for mix, residual, status, row in zip(batch.alpha, batch.residual, batch.status, normalised, strict=True)
    ]


def solve_path(posed: Posed, targets: Array, ridges: Array | None, solver: Solver) -> MixBatch:
    """The mixes over all N exemplars for normalised targets (B, k), in one call to the solver; one ridge (B,) each.

    Residuals are what alpha leaves, as in `solve`.

    Raises
    ------
    PluginError
        If the solver returns no mixes of the exemplars that take part, one a target.
    """
    try:
        batch: object = solver.solve_many(posed.problem, targets, ridges)
    except InputError as error:
        raise PluginError(f"solver {type(solver).__name__}: returned no mixes that can be used: {error}") from error
    shape = (len(targets), *posed.problem.centre.shape)
    if not isinstance(batch, MixBatch) or batch.alpha.shape != shape:
        raise _no_mix(solver, MixBatch, shape, batch)
    off = np.abs(batch.alpha.sum(1) - 1) > 1e-6 * np.maximum(1, np.abs(batch.alpha).sum(1))
    if bad := np.flatnonzero(off).tolist():
        raise PluginError(f"solver {type(solver).__name__}: expected mixes that sum to 1, got others for {brief(bad)}")
    residual = batch.alpha @ posed.problem.matrix.T - targets
    return MixBatch(posed.spread_out(batch.alpha), residual, batch.status)


def _no_mix(solver: Solver, wanted: type, shape: tuple[int, ...], found: object) -> PluginError:
    alpha = getattr(found, "alpha", None)
    got = type(found).__name__ + (f" with alpha {np.shape(alpha)}" if alpha is not None else "")
    return PluginError(f"solver {type(solver).__name__}: expected a {wanted.__name__} with alpha {shape}, got {got}")


def explain(posed: Posed, mix: Mix) -> str:
    """The status in plain words: for a conflict, what would agree, and what has to give least alone."""
    if not mix.conflicts:
        return mix.message
    told = [(conflict.names, text) for conflict in mix.conflicts if (text := _nearest(posed, conflict))]
    if len(told) == 1:
        return f"{mix.message}; {told[0][1]}"
    return "; ".join([mix.message, *(f"({i}) {' + '.join(n)}: {text}" for i, (n, text) in enumerate(told, 1))])


def _nearest(posed: Posed, conflict: Conflict) -> str:
    parts = [(n, a) for n, a in zip(conflict.names, conflict.amounts, strict=True) if abs(a) > GIVES]
    said = [f"{', '.join(_moved(posed, name, amount) for name, amount in parts)} would agree"] if parts else []
    if (culprit := conflict.culprit) is not None and (len(conflict.names) > 1 or not parts):
        alone = float(conflict.alone[conflict.names.index(culprit)])
        if [name for name, _ in parts] == [culprit] and np.isclose(parts[0][1], alone, rtol=ALIKE):
            return f"{_moved(posed, culprit, alone)} would be enough"
        said.append(f"{_moved(posed, culprit, alone)} alone would be enough")
    return "; ".join(said)


def _moved(posed: Posed, name: str, amount: float) -> str:
    """One requirement before and after it gave way by `amount` [normalised], in the user's unit."""
    p = posed.problem
    if name in p.names:
        i = p.names.index(name)
        return _change(posed.rows[i], name, p.target[i], amount)
    if name in p.range_names and amount:
        i = p.range_names.index(name)
        end, limit = ("down to", p.range_low[i]) if amount < 0 else ("up to", p.range_high[i])
        return _change(posed.limits[i], f"{name} {end}", limit, amount)
    if name == BOUNDS and amount:
        return f"{name} wider by {amount:.3g}"
    told = [gave(term, amount) for term in (*p.constraints, *p.equalities) if called(term, "") == name]
    if amount and told and told[0]:
        return f"{name} {told[0]}"
    return f"{name} by {abs(amount):.3g} half ranges" if amount and name not in p.range_names else name


def _change(column: Column, name: str, asked: float, amount: float) -> str:
    at, step = (asked + 1) / 2 * column.spread + column.low, amount / 2 * column.spread
    return f"{name} {at:.6g} → {at + step:.6g} {column.unit}".rstrip()
