"""What a study asks of a bank, in plain values: who measures and models what is asked, not who judges or reports."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from lampopt.check import Limits
from lampopt.closing import told_without_turns
from lampopt.goals import Reduce
from lampopt.identity import contents, given, learned, offered, told
from lampopt.measured import resolve_address
from lampopt.plugins import Plugins
from lampopt.protocols import Measure, State
from lampopt.quantities import Quantities
from lampopt.reading import unplaced
from lampopt.study import Study


@dataclass(frozen=True, eq=False)
class Question:
    """A study of a bank with all that it names found: `quantities` has bank, models and measures."""

    study: Study
    quantities: Quantities
    limits: Limits
    plugins: Plugins

    @property
    def named(self) -> list[str]:
        """What the study itself names to be asked, kept within a range, or sought."""
        objective = [self.study.objective.name] if self.study.objective is not None else []
        return [*self.study.names, *self.study.ranges, *objective]

    def plain(self) -> dict[str, object]:
        """All that the way to the answer depends on but the target."""
        study = self.study
        return {
            **contents(self.quantities.bank),
            "solver": offered("solver", study.solver, self.plugins),
            "reference": study.reference,
            "ranges": study.bounds(self.quantities),
            "hard": study.hard,
            "seed": study.seed,
            **{name: value for name, value in self._more().items() if value},
        }

    def _more(self) -> dict[str, object]:
        """What a study may ask besides: where it does not, the keys of others stay what they were."""
        study, models = self.study, self.quantities.models
        measured = self.read_off()
        return {
            "weights": dict(study.weights),
            "objective": None if isinstance(study.objective, Reduce | None) else study.objective.written(),
            "linear": {name: one.written() for name, one in study.linear.items()},
            "alpha": study.alpha,
            "ridge": None if study.ridge is None else repr(float(study.ridge)),
            "norm": None if study.norm == 2 else study.norm,
            "safe": {name: self.limits[name] for name in study.safe},
            "models": {name: learned(one) if isinstance(one, State) else given(one) for name, one in models.items()},
            "measured": {name: [unplaced(address), self.who(address)] for name, address in study.measured.items()},
            "measuring": {name: self.who(name) for name in self.named if self.quantities[name].measure is not None},
            "resolution of meshes": study.resolution if measured else None,
            "turns": study.turns,
            "told": [] if study.turns else sorted(n for n in study.measured if told_without_turns(study, n)),
        }

    def read_off(self, target: Iterable[str] = ()) -> dict[str, Measure]:
        """The measures of whose values something is asked, by the study or as a `target`."""
        asked = [self.quantities[name] for name in {*self.named, *target}]
        asked += [self.quantities.measured(address) for address in self.study.measured.values()]
        return {q.measure[0]: q.measure[1] for q in asked if q.measure is not None}

    def who(self, name: str) -> list[str]:
        """What tells the measure behind a measured value from others."""
        known, declared = self.quantities, self.quantities.bank.measured_by.values()
        found = known.measured(name) if ":" in name or name in declared else known[name]
        if found.measure is None:
            return ["the bank"]
        key, measure, _ = found.measure
        if key in known.measures:
            return told(self.study.to_be_measured()[key], measure, self.plugins)
        return [learned(measure)] if ":" in name else offered("measure", key, self.plugins)

    def drift(self, address: str) -> list[str]:
        """What tells the measure behind `address`, by which the bank measures, from others."""
        name, measure, _ = resolve_address(address, self.plugins)
        return [learned(measure)] if ":" in address else offered("measure", name, self.plugins)
