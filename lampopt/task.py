"""A study with everything it names found and opened: makes one design and judges it, and tells it from others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt import lamp
from lampopt.bank import decoder_of
from lampopt.chain import Chain
from lampopt.check import Limits, alpha_checks, field_checks, measure_checks, mesh_checks, stranger_checks
from lampopt.choices import GIVEN, Value
from lampopt.closing import Closed, closed, read_checks, told_without_turns
from lampopt.designer import Designer
from lampopt.errors import MeasureError, PluginError, StudyError
from lampopt.evaluations import Memory
from lampopt.fitted import load_model
from lampopt.goals import Minimise
from lampopt.identity import hashed, offered, told
from lampopt.measured import keeping
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Checker, Decoder, External, Measure, Model, Solver
from lampopt.quantities import Quantities
from lampopt.question import Question
from lampopt.reading import unplaced
from lampopt.safeguards import judged_by
from lampopt.solve import Posed, solve
from lampopt.study import Study
from lampopt.types import LEVELS, Array, Bank, Check, Design, Mix, Result, Scalar, Spec
from lampopt.wishes import Wishes, goal_checks

if TYPE_CHECKING:
    from trimesh import Trimesh

PROGRAM = "program."  # before a measure's name in the provenance


@dataclass(frozen=True, eq=False)
class Task:
    """A study, its bank and every plugin it names."""

    study: Study
    bank: Bank
    decoder: Decoder
    solver: Solver
    limits: Limits
    checkers: Mapping[str, Checker]
    measures: Mapping[str, Measure]
    models: Mapping[str, Model]
    plugins: Plugins
    kept_in: Path | None = None

    @classmethod
    def of(cls, study: Study, plugins: Plugins | None) -> Task:
        """What `study` needs, found and opened.

        Raises
        ------
        StudyError, BankError, PluginError
            If something is missing or cannot be used.
        """
        plugins = plugins or Plugins.load().report()
        _require(study, plugins)
        bank = study.opened()
        solver: Solver = plugins.make("solver", study.solver)
        checkers = {Spec.of(choice).name: _checker(choice, plugins) for choice in study.checks}
        measures = {name: _measure(name, choice, plugins) for name, choice in study.to_be_measured().items()}
        models = {name: _model(name, choice, plugins) for name, choice in study.models.items()}
        limits = Limits.of(bank, study.limits, study.measured)
        return cls(study, bank, decoder_of(bank, plugins), solver, limits, checkers, measures, models, plugins)

    def keeping(self, folder: Path) -> Task:
        """The same, its measures keeping what they work out in folders of their names there, where they can."""
        kept = {name: keeping(made, folder / name) for name, made in self.measures.items()}
        return replace(self, measures=kept, kept_in=folder)

    def asked(self, change: Mapping[str, Value]) -> dict[str, float]:
        """Every wanted value by name [the bank's units], with `change` among the targets."""
        targets = {**self.study.targets, **change}
        return replace(self.study, targets=targets, sweep={}, experiments=None).asked(self.wishes.quantities)

    @cached_property
    def wishes(self) -> Wishes:
        """What the study asks, with all that it may name."""
        chain = Chain(self.bank, self.decoder, self.study.resolution)
        quantities = Quantities(self.bank, self.models, self.measures, chain, self.plugins, self.kept_in)
        return Wishes(self.study, self.bank, self.decoder, self.limits, quantities)

    @cached_property
    def question(self) -> Question:
        """What the study asks, in plain values."""
        return Question(self.study, self.wishes.quantities, self.limits, self.plugins)

    def posed(
        self, target: Mapping[str, float], memory: Memory | None = None, instead: Mapping[str, Array] | None = None
    ) -> Posed:
        """The problem that one target poses; `memory` and `instead` as in `Wishes.posed`."""
        return self.wishes.posed(target, memory, instead)

    @cached_property
    def designer(self) -> Designer:
        """What makes this task's designs."""
        return Designer(self.bank, lambda: self.decoder, self.study.resolution)

    def solves_long(self, target: Mapping[str, float]) -> bool:
        """Whether a solve for `target` makes meshes or sweeps probes, so that it is worth a worker."""
        measured = any(self.wishes.quantities[name].measure is not None for name in {*self.question.named, *target})
        return bool(self.study.turns or "mismatch" in self.study.safe or measured)

    def refuse_corrections(self, who: str) -> None:
        """Raise StudyError where `who`, which looks at what is asked only, is given corrections."""
        if self.study.turns or self.study.measured:
            raise StudyError(f"{who}: looks at what is asked, not at what is measured: leave turns and measured out")

    def refuse_terms(self, who: str, target: Mapping[str, float]) -> None:
        """Raise StudyError where `who`, which knows linear targets only, is given others."""
        bent = [name for name in {*self.question.named, *target} if self.wishes.quantities[name].column is None]
        if bent or isinstance(self.study.objective, Minimise):
            what = ", ".join(sorted(bent)) or f"an objective that is {self.study.objective}"
            raise StudyError(f"{who}: expected what is linear in the mix (parameters, labels), got {what}")

    def solved(self, target: Mapping[str, float], memory: Memory | None = None) -> tuple[Posed, Mix]:
        """The problem of one target, and its mix."""
        posed = self.posed(target, memory)
        return posed, solve(posed, self.solver)

    def made(
        self,
        target: Mapping[str, float],
        posed: Posed,
        mix: Mix,
        tell: Callable[[str], None] = silent,
    ) -> Result:
        """One design: its ask corrected as often as the study says, then judged; `tell` is told of each correction."""
        measured = self.study.level == "mesh" and any(told_without_turns(self.study, name) for name in target)
        if not (self.study.turns or measured):
            return self.judge(target, posed, mix)

        def again(ask: Mapping[str, float], instead: Mapping[str, Array]) -> tuple[Posed, Mix]:
            posed = self.posed(ask, instead=instead)
            return posed, solve(posed, self.solver)

        found = closed(self.study, self.wishes.quantities, target, again, (posed, mix), tell)
        return self.judge(target, found.posed, found.mix, found)

    def judge(self, target: Mapping[str, float], posed: Posed, mix: Mix, turned: Closed | None = None) -> Result:
        """One design through mix, decode and check, as far as the study's level; `turned` tells how it came about."""
        made = self.designer(target, mix)
        checks = alpha_checks(posed, mix, self.limits)
        for level in LEVELS[: LEVELS.index(self.study.level) + 1]:
            if level == "alpha":
                checks += goal_checks(self.wishes, target, mix.alpha, self.limits, level)
            if level == "field":
                judged = judged_by(self.bank, self.study.safe)
                checks += field_checks(self.bank, self.decoder, made, self.limits, judged)
            if level == "mesh":
                measured = ", ".join(self.bank.measured_by.values()) or "no measure"
                with _unaltered(made.mesh, f"one of {measured}, or the decoder,"):
                    resolution = self.study.resolution
                    wanted = {} if turned is None else turned.expected
                    checks += mesh_checks(self.bank, self.decoder, made, resolution, self.limits, self.plugins, wanted)
                if made.mesh is None:
                    break  # nothing is left to be measured or judged
                checks += goal_checks(self.wishes, target, mix.alpha, self.limits, level)
                if turned is not None:
                    checks += read_checks(self.study, self.wishes.quantities, turned, self.limits)
                for name, measure in self.measures.items():
                    with _unaltered(made.mesh, f"measure {name!r}"):
                        checks += measure_checks(self.bank, made.mesh, {name: measure})
            for name, checker in self.checkers.items():
                seen = made if level == "mesh" else replace(made)  # what looks at a mesh unsaid spoils one of its own
                with _unaltered(vars(seen).get("mesh"), f"check {name!r}"):
                    checks += stranger_checks(self.bank, seen, {name: checker}, level)
        if turned is not None and self.study.level != "mesh":  # though nothing else there looks at a mesh
            checks += read_checks(self.study, self.wishes.quantities, turned, self.limits)
        found = self.result(made, checks)
        if turned is None:
            return found
        changed = {f"asked.{name}": value for name, value in turned.asked.items() if value != target.get(name)}
        if not self.study.turns:
            return found
        return replace(found, provenance={**found.provenance, "turns": turned.turns, **changed})

    def result(self, made: Design, checks: Sequence[Check]) -> Result:
        """A design with the evidence about it. Raises PluginError where two checks have one name."""
        return Result(made, tuple(_unique(checks)), dict(self.provenance))

    def key(self, target: Mapping[str, float]) -> str:
        """What tells a design from all others: a hash of everything that it depends on."""
        known = {"run": self.identity, "target": dict(target)}
        swept = [
            name
            for name in target
            if name not in self.question.named and self.wishes.quantities[name].measure is not None
        ]
        return hashed(known | ({"measuring": {name: self.question.who(name) for name in swept}} if swept else {}))

    @cached_property
    def identity(self) -> str:
        """A hash of all but the target that a result depends on."""
        study = self.study
        drift = self.bank.measured_by.values() if study.level == "mesh" else ()
        return hashed(
            {
                **self.question.plain(),
                "versions": {name: said for name, said in self.provenance.items() if not name.startswith(PROGRAM)},
                "limits": [dict(study.limits), dict(self.bank.limits)],
                "decoder": offered("decoder", self.bank.decoder, self.plugins),
                "measures": {
                    name: told(choice, self.measures[name], self.plugins)
                    for name, choice in study.to_be_measured().items()
                },
                "drift": {unplaced(address): self.question.drift(address) for address in drift},
                "checks": [offered("check", choice, self.plugins) for choice in study.checks],
                "format": study.format,
                "level": study.level,
                "resolution": study.resolution,
            }
        )

    @cached_property
    def provenance(self) -> Mapping[str, Scalar]:
        """Where the results come from: the bank's own, versions, solver, decoder, and what measures from outside.

        What the bank was told beside its own (names with a dot) stays there: its `plan` stands for it.
        """
        solver = self.plugins.get("solver", Spec.of(self.study.solver).name)
        decoder = self.plugins.get("decoder", self.bank.decoder.name)
        return {
            **{f"bank.{name}": value for name, value in self.bank.provenance.items() if "." not in name},
            "lampopt": version("lampopt"),
            "solver": f"{self.study.solver} ({solver.distribution} {solver.version})",
            "decoder": f"{self.bank.decoder} ({decoder.distribution} {decoder.version})",
            "level": self.study.level,
            "resolution": self.study.resolution,
            **{f"{PROGRAM}{name}": what for name, made in self._measuring.items() if (what := _program(made))},
        }

    def search(self, key: str, target: Mapping[str, float]) -> str:
        """Under what the search for the design `key` notes its evaluations: by other programs they are others."""
        asked = {PROGRAM + name for name in self.question.read_off(target)}
        programs = {name: what for name, what in self.provenance.items() if name in asked}
        return hashed([key, programs]) if programs else key

    def outdated(self, result: Result) -> str:
        """Why a recorded result is not this task's any more: another version of a program; "" where it is.

        A program that is not there now is needed for what is not recorded only.
        """
        now = {name: what for name, what in self.provenance.items() if name.startswith(PROGRAM)}
        other = [name for name, what in now.items() if result.provenance.get(name, what) != what]
        return "; ".join(f"{name}: was {result.provenance[name]}, is {now[name]}" for name in other)

    @property
    def _measuring(self) -> dict[str, Measure]:
        """Every measure that the results depend on."""
        return {**self.measures, **self.question.read_off()}


@contextmanager
def _unaltered(mesh: Trimesh | None, who: str) -> Iterator[None]:
    """Refuse a plugin that alters the design it is to judge: the others would judge, and the user get, another one."""
    before = None if mesh is None else _shape(mesh)
    yield
    if mesh is not None and _shape(mesh) != before:
        raise PluginError(f"{who} altered the mesh that it was given: a plugin has to work on a copy of its own")


def _program(measure: Measure) -> str:
    """Name and version of the program that it asks; none where that is not there: then nothing is recorded."""
    try:
        return measure.program() if isinstance(measure, External) else ""
    except MeasureError:
        return ""


def _checker(choice: str | Spec, plugins: Plugins) -> Checker:
    made: Checker = plugins.make("check", choice)
    name = Spec.of(choice).name
    if made.needs not in LEVELS:
        raise PluginError(f"check {name!r}: expected needs as one of {', '.join(LEVELS)}, got {made.needs!r}")
    return made


def _measure(name: str, choice: Spec | Measure, plugins: Plugins) -> Measure:
    if not isinstance(choice, Spec):
        return choice
    if choice.name == GIVEN:
        raise StudyError(
            f"measures: {name}: was given as a Python object, {choice.options.get('of')}, which a file cannot hold: "
            "give it again, or register it as a plugin"
        )
    made: Measure = plugins.make("measure", choice)
    return made


def _model(name: str, choice: str | Path | Model, plugins: Plugins) -> Model:
    if not isinstance(choice, str | Path):
        return choice
    if str(choice).startswith("<"):
        raise StudyError(
            f"models: {name}: was given as a Python object, {choice}, which a file cannot hold: give it again, or "
            "store it with lampopt.fit_model(..., store=FILE)"
        )
    return load_model(choice, plugins=plugins)


def _shape(mesh: Trimesh) -> tuple[str, str]:
    return lamp.digest(mesh.vertices.view(np.ndarray)), lamp.digest(mesh.faces.view(np.ndarray))


def _require(study: Study, plugins: Plugins) -> None:
    present = {*plugins.owners, *(distribution for distribution, _ in plugins.owners.values())}
    if missing := [name for name in study.requires if name not in present]:
        raise PluginError(
            f"study requires {', '.join(missing)}, not installed; installed are {', '.join(sorted(present))}"
        )


def _unique(checks: Sequence[Check]) -> list[Check]:
    """The checks, refusing a plugin's that takes the name of another: evidence must not be shadowed."""
    names = [check.name for check in checks]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise PluginError(f"checks: {', '.join(twice)} come twice; a plugin's checks need names of their own")
    return list(checks)
