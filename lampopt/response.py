"""What is measured on a study's designs as a function of its targets, with derivatives: for programs that optimise.

d value / d target = d value / d alpha · d alpha / d target: the first by model, measure and decoder, the second by the
solver. Where one of them has no derivatives, differences along d alpha / d target stand in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import StudyError
from lampopt.explore import slopes_by_target
from lampopt.plugins import Plugins
from lampopt.quantities import Quantity, inputs_of
from lampopt.solve import solve
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import Array
from lampopt.units import said

if TYPE_CHECKING:
    from lampopt.choices import Value
    from lampopt.solve import Posed

STEP = 1e-2  # of half the range of a target, to either side: weights are in single precision, less would be noise


class Response:
    """Values by targets, and their derivatives.

    Parameters
    ----------
    study
        What has to hold meanwhile: its keeps, ranges, solver. Its targets are the inputs, as it has them at first.
    values
        Names of the outputs: what is measured on the mesh, such as "volume.volume", models' values, parameters, labels.
    plugins
        What to choose from, if not all that is installed.

    Attributes
    ----------
    targets
        The inputs by name, as the study has them [their units].
    input_units, units
        Units of inputs and outputs, by name.

    Raises
    ------
    StudyError
        If the study has no targets, turns, a target that is not linear in the mix, or a name is unknown.
    """

    targets: Mapping[str, float]
    input_units: Mapping[str, str]
    units: Mapping[str, str]

    def __init__(self, study: Study, values: Sequence[str], *, plugins: Plugins | None = None) -> None:
        if not isinstance(study, Study):
            raise StudyError(f"study: expected a Study, got {said(study):.80}; read one with Study.read(path)")
        if isinstance(values, str) or not values:
            raise StudyError(f"values: expected a list of names, such as ['volume.volume'], got {said(values):.80}")
        if not study.targets:
            raise StudyError("targets: expected some, which are the inputs, got none")
        if study.turns:
            raise StudyError("turns: derivatives do not go through corrections: leave them out")
        self._task = Task.of(study, plugins)
        known = self._task.wishes.quantities
        if curved := [name for name in study.targets if known[name].column is None]:
            raise StudyError(f"targets: {curved[0]!r} is not linear in the mix, so that it cannot be an input")
        told = self._task.bank.measured_by.values()  # of the exemplars, which a mix need not follow
        self._values = {name: known.measured(name) if name in told else known[name] for name in values}
        asked = self._task.asked({})
        self.targets = MappingProxyType({name: asked[name] for name in study.targets})
        self.input_units = MappingProxyType({name: known[name].unit for name in study.targets})
        self.units = MappingProxyType({name: quantity.unit for name, quantity in self._values.items()})
        self._last: tuple[dict[str, float], Posed, Array] | None = None

    def __call__(self, targets: Mapping[str, Value]) -> dict[str, float]:
        """The values by name at `targets`; those not named are as in the study. NaN where there is none."""
        _, _, alpha = self._solved(targets)
        return {name: self._value(quantity, alpha) for name, quantity in self._values.items()}

    def slopes(self, targets: Mapping[str, Value]) -> dict[tuple[str, str], float]:
        """d value / d target by (value, target) [their units], at `targets`."""
        asked, posed, alpha = self._solved(targets)
        by_target = slopes_by_target(posed, asked, self._task.solver)
        chosen = [posed.problem.names.index(name) for name in self.targets]
        halves = np.array([posed.rows[i].spread / 2 for i in chosen])
        along = by_target[:, chosen]
        return {
            (name, target): float(slope)
            for name, quantity in self._values.items()
            for target, slope in zip(self.targets, self._slopes(quantity, alpha, along, halves), strict=True)
        }

    def _value(self, quantity: Quantity, alpha: Array) -> float:
        if quantity.column is None:
            return self._task.wishes.quantities.value(quantity, alpha)
        taken = alpha != 0  # the others may lack a label
        return float(quantity.column.values[taken] @ alpha[taken])

    def _slopes(self, quantity: Quantity, alpha: Array, along: Array, halves: Array) -> Array:
        """(k,) derivatives of a quantity along the columns of `along` (N, k)."""
        bank, known = self._task.bank, self._task.wishes.quantities
        if quantity.column is not None:
            taken = along.any(axis=1) | (alpha != 0)
            return np.asarray(quantity.column.values[taken] @ along[taken])
        if quantity.model is not None:
            name, model, place = quantity.model
            inputs = inputs_of(bank, name, model)
            by = np.asarray(model.gradient((alpha @ inputs)[None]), float)[0, place]
            return np.asarray(by @ (inputs.T @ along))
        assert quantity.measure is not None
        assert known.chain is not None
        name, measure, place = quantity.measure
        if known.chain.differentiable(measure):
            by_alpha = known.chain.gradient(name, measure, place, alpha)
            if np.isfinite(by_alpha).all():  # a measure may have none on this very mesh
                return np.asarray(by_alpha @ along)
        found = []
        for way, half in zip(along.T, halves, strict=True):
            ahead, behind = (known.value(quantity, alpha + sign * STEP * half * way) for sign in (1, -1))
            found.append((ahead - behind) / (2 * STEP * half))
        return np.array(found)

    def _solved(self, targets: Mapping[str, Value]) -> tuple[dict[str, float], Posed, Array]:
        if unknown := [name for name in targets if name not in self.targets]:
            raise StudyError(f"targets: {unknown[0]!r}: expected some of {', '.join(self.targets)}")
        asked = self._task.asked(targets)
        if self._last is None or self._last[0] != asked:
            posed = self._task.posed(asked)
            self._last = asked, posed, solve(posed, self._task.solver).alpha
        return self._last
