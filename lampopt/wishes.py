"""Study + bank → what the solver is given, and what has to be looked at afterwards.

What is linear in alpha becomes rows, ranges and sums; what is not (values of models and measures, safety) becomes
terms. A target on a model's or a measure's value is a squared term, or an equality where it is hard; afterwards it is a
check, `target.NAME`, as a range is `range.NAME`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from lampopt.check import OUTSIDE, Limits
from lampopt.errors import StudyError
from lampopt.evaluations import Memory
from lampopt.goals import Linear, Minimise
from lampopt.mixes import Target
from lampopt.protocols import Decoder
from lampopt.quantities import Quantities, Quantity, inputs_of
from lampopt.safeguards import safeguard
from lampopt.solve import Column, Posed, columns, pose
from lampopt.study import Study
from lampopt.terms import MeasuredValue, Remembered, Row, model_value, shaped
from lampopt.types import ROUNDING, Array, Bank, Check, Needs, Term

SINGLE = 1e-6  # [frame's size] what is less is rounding
POWERS = {"L": 1, "L^2": 2, "L^3": 3}  # of the length unit, in a measure's declared units
SPREAD = 0.2  # range of a measured value that no exemplar tells, in parts of its value at the start


@dataclass(frozen=True, eq=False)
class Goal:
    """A model's or a measure's value that is asked to be within low and high; for a target both are the same.

    `spread` is its range over the exemplars, where a model tells it: what is off is told in half of it.
    """

    name: str
    quantity: Quantity
    low: float
    high: float
    offset: float
    spread: float
    hard: bool = False
    weight: float = 1.0

    @property
    def needs(self) -> Needs:
        """What tells its value."""
        return "mesh" if self.quantity.measure is not None else "alpha"

    def check(self, value: float, limits: Limits, outside: bool = False) -> Check:
        """Whether it is met; nobody knows where a learned measure tells it of a shape `outside` its range."""
        off = max(self.low - value, value - self.high, 0.0) * 2 / self.spread
        unit = self.quantity.unit
        wanted = f"{self.low:.6g}" if self.low == self.high else f"{self.low:.6g} to {self.high:.6g}"
        note = f"{value:.6g} {unit}".rstrip() + f", asked {wanted}"
        limit = limits["hard.search"] if self.hard else limits[self.name.partition(".")[0]]
        off, note = (float("nan"), f"{note}; {OUTSIDE}") if outside else (off if value == value else value, note)
        return Check(self.name, off, "<=", limit, "half range", self.needs, note)


@dataclass(frozen=True, eq=False)
class Wishes:
    """What a study asks of a bank.

    Parameters
    ----------
    study, bank, decoder, limits
        As they are.
    quantities
        What can be asked for.
    """

    study: Study
    bank: Bank
    decoder: Decoder
    limits: Limits
    quantities: Quantities

    def posed(self, target: Target, memory: Memory | None = None, instead: Mapping[str, Array] | None = None) -> Posed:
        """The problem that `target` [the bank's units] poses, and its terms.

        `memory` knows what was evaluated, `instead` (N,) what targets are taken to be over the exemplars.
        """
        study, known = self.study, {name: self.quantities[name] for name in target}
        linear = {name: value for name, value in target.items() if known[name].column is not None}
        bounds = study.bounds(self.quantities)
        ranges = {name: pair for name, pair in bounds.items() if self.quantities[name].column is not None}
        posed = pose(
            self.bank,
            linear,
            ranges=ranges,
            hard=study.hard,
            reference=study.reference,
            weights=study.weights,
            moved=[part for given in study.linear.values() for part in given.of],
            sums=[self._sum(name, given) for name, given in study.linear.items()],
            needed=self._needed(),
            instead=instead,
        )
        n = len(posed.active)
        low, high = (None, None) if study.alpha is None else (np.full(n, end) for end in study.alpha)
        problem = replace(
            posed.problem, ridge=study.ridge, norm=1 if study.norm == 1 else 2, alpha_low=low, alpha_high=high
        )
        return self._with_terms(replace(posed, problem=problem), self.goals(target), memory or Memory())

    def goals(self, target: Target) -> list[Goal]:
        """The targets and ranges that are not linear in alpha."""
        found = []
        for name, pair in self.study.bounds(self.quantities).items():
            if not pair[0] <= pair[1]:
                raise StudyError(f"ranges: {name}: expected low ≤ high, got {pair[0]:g} to {pair[1]:g}")
        for name, value in target.items():
            if (quantity := self.quantities[name]).column is None:
                hard, weight = name in self.study.hard, self.study.weights.get(name, 1.0)
                found.append(
                    Goal(f"target.{name}", quantity, value, value, *self._scale(quantity, value), hard, weight)
                )
        for name, (low, high) in self.study.bounds(self.quantities).items():
            if (quantity := self.quantities[name]).column is None:
                found.append(Goal(f"range.{name}", quantity, low, high, *self._scale(quantity, low, high)))
        return found

    def value(self, goal: Goal, alpha: Array) -> float:
        """What a goal's quantity is for alpha (N,)."""
        return self.quantities.value(goal.quantity, alpha)

    def _needed(self) -> list[str]:
        """Columns of an objective, which exemplars without a label cannot have."""
        goal = self.study.objective
        if not isinstance(goal, Minimise) or self.quantities[goal.name].column is None:
            return []
        return [goal.name]

    def _sum(self, name: str, given: Linear) -> tuple[Column, float, float]:
        if name in columns(self.bank) or name in self.study.ranges:
            raise StudyError(f"linear: {name!r} is the name of something else: call the sum otherwise")
        values = []
        for part, factor in given.of.items():
            quantity = self.quantities[part]
            if quantity.column is None:
                raise StudyError(f"linear: {name}: {part!r} is not linear in the mix; a range can be asked of it alone")
            values.append(factor * quantity.column.values)
        units = {self.quantities[part].unit for part in given.of}
        found = Column(name, units.pop() if len(units) == 1 else "", np.sum(values, 0))
        if found.spread <= ROUNDING * np.nanmax(np.abs(values).sum(0), initial=0.0):
            raise StudyError(f"linear: {name}: all exemplars have {found.low:g}: no mix can change it")
        return found, given.low, given.high

    def _scale(self, quantity: Quantity, *asked: float) -> tuple[float, float]:
        """Lowest value and range of what is not linear: by the value at the start, or if that is 0 by those `asked`."""
        if quantity.model is not None:
            values = self.quantities.over_exemplars(quantity)
            low, spread = float(values.min()), float(np.ptp(values))
            if spread == 0:
                raise StudyError(f"{quantity.name!r}: all exemplars have {low:g} by the model: no mix can change it")
            return low, spread
        value = self.quantities.at(quantity.name, self.study.reference)
        size = self._size(quantity)
        known = [abs(end) for end in (value, *sorted(asked, key=abs)) if SINGLE * size < abs(end) < np.inf]
        spread = SPREAD * known[0] if known else size
        return value - spread / 2, spread

    def _size(self, quantity: Quantity) -> float:
        """The size of the bank's frame, or its square or cube: what a measured length, area, volume may come to."""
        assert quantity.measure is not None
        _, measure, place = quantity.measure
        return float((1 / self.bank.frame.scale) ** POWERS.get(measure.units[place], 0))

    def _with_terms(self, posed: Posed, goals: list[Goal], memory: Memory) -> Posed:
        objectives, constraints, equalities = list[Term](), list[Term](), list[Term]()
        for goal in goals:
            term = self._term(goal.quantity, posed, memory)
            if goal.name.startswith("target."):
                name = goal.quantity.name
                power = 1 if goal.hard else 2
                weight = 1.0 if goal.hard else goal.weight
                made = shaped(
                    name,
                    term,
                    offset=goal.low,
                    factor=2 / goal.spread,
                    power=power,
                    weight=weight,
                    unit=goal.quantity.unit,
                )
                (equalities if goal.hard else objectives).append(made)
                continue
            ends = [(end, sign) for end, sign in ((goal.high, 2), (goal.low, -2)) if np.isfinite(end)]
            for end, sign in ends:
                which = "range" if len(ends) == 1 else "range, high end" if sign > 0 else "range, low end"
                name, unit = f"{goal.quantity.name} ({which})", goal.quantity.unit
                constraints.append(shaped(name, term, offset=end, factor=sign / goal.spread, unit=unit))
        objective = self.study.objective
        if isinstance(objective, Minimise):
            quantity = self.quantities[objective.name]
            offset, spread = self._range(quantity)
            objectives.append(
                shaped(
                    objective.name, self._term(quantity, posed, memory), offset=offset + spread / 2,
                    factor=objective.sign * 2 / spread, weight=objective.weight,
                )
            )  # fmt: skip
        if not (objectives or constraints or equalities or self.study.safe):
            return posed
        whole, active = posed.spread_out, posed.active
        constraints += [
            safeguard(
                name, self.bank, self.decoder, self.limits[name] if name != "jacobian" else 0.0,
                centre=posed.problem.centre, whole=whole, active=active,
            )
            for name in self.study.safe
        ]  # fmt: skip
        problem = replace(
            posed.problem,
            objectives=tuple(objectives),
            constraints=tuple(constraints),
            equalities=tuple(equalities),
        )
        return replace(posed, problem=problem)

    def _range(self, quantity: Quantity) -> tuple[float, float]:
        column = quantity.column
        return self._scale(quantity) if column is None else (column.low, column.spread)

    def _term(self, quantity: Quantity, posed: Posed, memory: Memory) -> Term:
        """The value of a quantity as the solver sees it, in its own unit."""
        if quantity.column is not None:
            return Row(quantity.name, quantity.column.values[posed.active])
        if quantity.model is not None:
            name, model, place = quantity.model
            return model_value(quantity.name, model, place, inputs_of(self.bank, name, model)[posed.active])
        assert quantity.measure is not None
        assert self.quantities.chain is not None
        name, measure, place = quantity.measure
        chain = self.quantities.chain
        value = MeasuredValue(quantity.name, name, measure, place, chain, posed.spread_out, posed.active)
        return cast("Term", Remembered(value, quantity.name, memory.known(quantity.name), memory.tell))


def goal_checks(wishes: Wishes, target: Mapping[str, float], alpha: Array, limits: Limits, needs: Needs) -> list[Check]:
    """Whether what is not linear in alpha is as it was asked; what needs a mesh, on the mesh."""
    goals = [goal for goal in wishes.goals(target) if goal.needs == needs]
    outside = wishes.quantities.outside
    return [goal.check(wishes.value(goal, alpha), limits, outside(goal.quantity, alpha)) for goal in goals]
