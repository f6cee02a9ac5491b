"""The search of a run as it was noted: what it sought, step by step, and how far from what its steps had to meet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lampopt.choices import Value
from lampopt.errors import LampoptError
from lampopt.evaluations import evaluations
from lampopt.goals import Minimise
from lampopt.plugins import Plugins
from lampopt.quantities import Quantities
from lampopt.reporting.gather import Evaluation
from lampopt.solve import columns
from lampopt.study import Study
from lampopt.types import Array, Bank, Spec
from lampopt.units import number

HELD = 1e-5  # of its value: what a hard target may be off and still be met


@dataclass(frozen=True)
class Search:
    """The steps of a search, what their values are called, and in which unit."""

    steps: tuple[Evaluation, ...] = ()
    label: str = "objective"
    unit: str = ""


def searched(
    folder: Path, study: Study, bank: Bank, plugins: Plugins, target: Mapping[str, Value] | None = None
) -> Search:
    """The last search of the run in `folder`, for `target` (the study's); without steps where nothing was searched.

    Its values are those of the study's objective, as they were measured or as the mix tells; else how far the measured
    targets are missed; else what was measured. The violation is that of measured ranges and hard targets.
    """
    noted = [*evaluations(folder)]
    steps: dict[bytes, dict[str, float]] = {}
    seconds: dict[bytes, float] = {}
    for one in noted:
        if one.design == noted[-1].design:
            key = one.alpha.tobytes()
            steps.setdefault(key, {})[one.name] = one.value
            seconds[key] = seconds.get(key, 0.0) + one.seconds
    if not noted:
        return Search()
    asked = _Asked(study, bank, plugins, study.targets if target is None else target)
    label, unit, sought = asked.sought({name for values in steps.values() for name in values}, len(noted[-1].alpha))
    return Search(
        tuple(
            Evaluation(n, sought(values, np.frombuffer(key)), asked.violated(values), seconds[key])
            for n, (key, values) in enumerate(steps.items(), 1)
        ),
        label,
        unit,
    )


class _Asked:
    """What a study asks of measured values, in their units; what cannot be told without its plugin is left out."""

    def __init__(self, study: Study, bank: Bank, plugins: Plugins, target: Mapping[str, Value]) -> None:
        self._study, self._bank = study, bank
        measures = {}
        for name, choice in study.to_be_measured().items():
            with suppress(LampoptError):
                measures[name] = plugins.make("measure", choice) if isinstance(choice, Spec) else choice
        self._quantities = Quantities(bank, {}, measures, None, plugins)
        self._targets = self._known({name: (value, value) for name, value in target.items()})
        self._ranges = self._known(study.ranges)
        self._hard = {address for name in study.hard for address in self._known({name: (0.0, 0.0)})}

    def sought(self, noted: set[str], count: int) -> tuple[str, str, Callable[[Mapping[str, float], Array], float]]:
        """What the values of a search by `count` exemplars that noted these are called, their unit, what tells them."""
        goal = self._study.objective
        if isinstance(goal, Minimise):
            sign, label = (-1.0, f"−{goal.name}") if goal.maximised else (1.0, goal.name)
            known = self._known({goal.name: (0.0, 0.0)})
            if measured := next((address for address in known if address in noted), None):
                return label, known[measured][0], lambda values, alpha: sign * values.get(measured, float("nan"))
            column = columns(self._bank).get(goal.name)
            if column is not None and count == len(column.values) and np.isfinite(column.values).all():
                return label, column.unit, lambda values, alpha: sign * float(alpha @ column.values)
        if missed := {address: want for address, want in self._targets.items() if address in noted}:
            unit = next(iter(missed.values()))[0] if len(missed) == 1 else ""
            label = "|" + next(iter(missed)) + " − asked|" if len(missed) == 1 else "largest |measured − asked|"
            return label, unit, lambda values, alpha: max(_off(values, *one) for one in missed.items())
        first = min(noted)
        unit = self._known({first: (0.0, 0.0)}).get(first, ("", 0.0, 0.0))[0]
        return first, unit, lambda values, alpha: values.get(first, float("nan"))

    def violated(self, values: Mapping[str, float]) -> float:
        """How far the worst measured range or hard target is from being met; 0 where all are."""
        off = [_off(values, *one) for one in self._ranges.items()]
        for address in self._hard & {*self._targets}:
            unit, low, high = self._targets[address]
            room = HELD * (abs(low) or 1.0)
            off.append(_off(values, address, (unit, low - room, high + room)))
        return max([0.0, *(one for one in off if one == one)])

    def _known(self, wanted: Mapping[str, tuple[Value, Value]]) -> dict[str, tuple[str, float, float]]:
        """Unit, lowest and highest value by the address that values are noted under."""
        found = {}
        for name, ends in wanted.items():
            with suppress(LampoptError):
                quantity = self._quantities[name]
                low, high = (end if isinstance(end, float) else number(end, quantity.unit, name) for end in ends)
                found[quantity.name] = quantity.unit, low, high
        return found


def _off(values: Mapping[str, float], address: str, wanted: tuple[str, float, float]) -> float:
    """How far a value is from what is wanted; NaN where it was not evaluated."""
    _, low, high = wanted
    found = values.get(address, float("nan"))
    return max(low - found, found - high, 0.0) if found == found else found
