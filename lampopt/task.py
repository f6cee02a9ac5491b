"""A study with everything it names found and opened: makes one design and judges it, and tells it from others."""

from __future__ import annotations

import hashlib
import json
import pickle
import sys
import uuid
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
from lampopt.closing import Closed, closed, read_checks
from lampopt.decode import decode
from lampopt.errors import EmptyMesh, InputError, PluginError, StudyError
from lampopt.evaluations import Memory
from lampopt.fitted import load_model
from lampopt.goals import Reduce
from lampopt.measured import resolve_address
from lampopt.mix import mixed_weights, predicted
from lampopt.plugins import Plugins
from lampopt.protocols import Checker, Decoder, Measure, Model, Solver, State
from lampopt.quantities import Quantities
from lampopt.safeguards import judged_by
from lampopt.solve import Posed, solve
from lampopt.study import Study
from lampopt.types import LEVELS, Bank, Check, Design, Mix, Result, Scalar, Spec
from lampopt.wishes import Wishes, goal_checks
from lampopt.written import MeshFile

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Designer:
    """Makes designs of a bank; `decoder` is asked for only where a mesh has to be decoded."""

    bank: Bank
    decoder: Callable[[], Decoder]
    resolution: int

    def __call__(
        self,
        target: Mapping[str, float],
        mix: Mix,
        file: MeshFile | None = None,
        provenance: Mapping[str, Scalar] | None = None,
    ) -> Design:
        """The design of one mix, its mesh read from `file` if it is there; `provenance` has the resolution it had."""
        weights = mixed_weights(self.bank, mix.alpha)
        resolution = (provenance or {}).get("resolution", self.resolution)
        if not (isinstance(resolution, int) and 4 <= resolution <= 4096):
            raise InputError(f"resolution: expected a whole number from 4 to 4096, got {resolution!r:.80}")

        def make() -> Trimesh | None:
            found = None if file is None else file.read()
            if found is not None:
                found.units = self.bank.frame.unit
                return found
            try:
                made = decode(self.bank, self.decoder(), weights, resolution=resolution)
            except EmptyMesh:
                return None
            if file is not None:
                file.restore(made)
            return made

        return Design(target, mix, predicted(self.bank, mix.alpha), weights, make)


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
        checkers: dict[str, Checker] = {name: plugins.make("check", name) for name in study.checks}
        for name, made in checkers.items():
            if made.needs not in LEVELS:
                raise PluginError(f"check {name!r}: expected needs as one of {', '.join(LEVELS)}, got {made.needs!r}")
        measures = {name: _measure(name, choice, plugins) for name, choice in study.to_be_measured().items()}
        models = {name: _model(name, choice, plugins) for name, choice in study.models.items()}
        limits = Limits.of(bank, study.limits)
        return cls(study, bank, decoder_of(bank, plugins), solver, limits, checkers, measures, models, plugins)

    def asked(self, change: Mapping[str, Value]) -> dict[str, float]:
        """Every wanted value by name [the bank's units], with `change` among the targets."""
        targets = {**self.study.targets, **change}
        return replace(self.study, targets=targets, sweep={}, experiments=None).asked(self.wishes.quantities)

    @cached_property
    def wishes(self) -> Wishes:
        """What the study asks, with all that it may name."""
        chain = Chain(self.bank, self.decoder, self.study.resolution)
        quantities = Quantities(self.bank, self.models, self.measures, chain, self.plugins)
        return Wishes(self.study, self.bank, self.decoder, self.limits, quantities)

    def posed(self, target: Mapping[str, float], memory: Memory | None = None) -> Posed:
        """The problem that one target poses; `memory` knows what a search for it has evaluated."""
        return self.wishes.posed(target, memory)

    @cached_property
    def designer(self) -> Designer:
        """What makes this task's designs."""
        return Designer(self.bank, lambda: self.decoder, self.study.resolution)

    @property
    def solves_long(self) -> bool:
        """Whether a solve makes meshes or sweeps probes, so that it is worth a worker."""
        asked = [*self.study.names, *self.study.ranges, *([self.study.objective.name] if self.study.objective else [])]
        measured = any(self.wishes.quantities[name].measure is not None for name in asked)
        return bool(self.study.turns or "mismatch" in self.study.safe or measured)

    def solved(self, target: Mapping[str, float], memory: Memory | None = None) -> tuple[Posed, Mix]:
        """The problem of one target, and its mix."""
        posed = self.posed(target, memory)
        return posed, solve(posed, self.solver)

    def made(self, target: Mapping[str, float], posed: Posed, mix: Mix) -> Result:
        """One design: its ask corrected as often as the study says, then judged."""
        if not self.study.turns:
            return self.judge(target, posed, mix)
        found = closed(self.study, self.wishes.quantities, target, self.solved, (posed, mix))
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
                with _unaltered(made.__dict__.get("mesh"), f"check {name!r}"):
                    checks += stranger_checks(self.bank, made, {name: checker}, level)
        found = self.result(made, checks)
        if turned is None:
            return found
        told = {f"asked.{name}": value for name, value in turned.asked.items() if value != target.get(name)}
        return replace(found, provenance={**found.provenance, "turns": turned.turns, **told})

    def result(self, made: Design, checks: Sequence[Check]) -> Result:
        """A design with the evidence about it. Raises PluginError where two checks have one name."""
        return Result(made, tuple(_unique(checks)), dict(self.provenance))

    def key(self, target: Mapping[str, float]) -> str:
        """What tells a design from all others: a hash of everything that it depends on."""
        return _hash({"run": self.identity, "target": dict(target)})

    @cached_property
    def identity(self) -> str:
        """A hash of all but the target that a result depends on."""
        study = self.study
        drift = self.bank.measured_by.values() if study.level == "mesh" else ()

        def offer(kind: str, name: str) -> str:
            return str(self.plugins.get(kind, name))

        return _hash(
            {
                "versions": dict(self.provenance),
                **contents(self.bank),
                "limits": [dict(study.limits), dict(self.bank.limits)],
                "solver": repr(study.solver),
                "reference": study.reference,
                "ranges": study.bounds(self.wishes.quantities),
                "hard": study.hard,
                **self._more,
                "measures": {
                    name: _told(choice, self.measures[name], self.plugins)
                    for name, choice in study.to_be_measured().items()
                },
                "drift": {address: self._drift(address) for address in drift},
                "checks": {name: offer("check", name) for name in study.checks},
                "format": study.format,
                "level": study.level,
                "resolution": study.resolution,
                "seed": study.seed,
            }
        )

    @property
    def _more(self) -> dict[str, object]:
        """What a study may ask besides, where it does: the keys of others stay what they were."""
        study = self.study
        asked: dict[str, object] = {
            "weights": dict(study.weights),
            "objective": None if isinstance(study.objective, Reduce | None) else study.objective.written(),
            "linear": {name: one.written() for name, one in study.linear.items()},
            "alpha": study.alpha,
            "ridge": study.ridge,
            "norm": None if study.norm == 2 else study.norm,
            "safe": study.safe,
            "models": {name: _learned(model) for name, model in self.models.items()},
            "measured": dict(study.measured),
            "turns": study.turns,
        }
        return {name: value for name, value in asked.items() if value}

    def _drift(self, address: str) -> str:
        """What tells the measure behind `address` from others."""
        name, measure, _ = resolve_address(address, self.plugins)
        return _learned(measure) if ":" in address else str(self.plugins.get("measure", name))

    @cached_property
    def provenance(self) -> Mapping[str, Scalar]:
        """Where the results come from: the bank's own, versions, solver and decoder.

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
        }


def contents(bank: Bank) -> dict[str, object]:
    """What in a bank a result depends on, arrays as hashes, whatever file it is in."""
    return {
        "space": [str(q) for q in (*bank.space, *bank.label_space)],
        "names": bank.names,
        "measured_by": dict(bank.measured_by),
        "mesh_facts": dict(bank.mesh_facts),
        "frame": [bank.frame.scale, bank.frame.centre.tolist(), bank.frame.unit],
        "bank": [lamp.digest(getattr(bank, name)) for name in lamp.PLAIN],
        "shared": {name: lamp.digest(array) for name, array in bank.shared.items()},
        "limits": dict(bank.limits),
        "decoder": repr(bank.decoder),
    }


def whole(bank: Bank) -> str:
    """A hash of all that a bank's file holds."""
    found = bank.calibration
    evidence = None if found is None else [lamp.digest(getattr(found, name)) for name in lamp.EVIDENCE]
    return _hash(
        {
            **contents(bank),
            "ranges": [[q.low, q.high] for q in (*bank.space, *bank.label_space)],
            "calibration": None if found is None else [found.tolerance, found.checks, evidence],
            "provenance": dict(bank.provenance),
        }
    )


@contextmanager
def _unaltered(mesh: Trimesh | None, who: str) -> Iterator[None]:
    """Refuse a plugin that alters the design it is to judge: the others would judge, and the user get, another one."""
    before = None if mesh is None else _shape(mesh)
    yield
    if mesh is not None and _shape(mesh) != before:
        raise PluginError(f"{who} altered the mesh that it was given: a plugin has to work on a copy of its own")


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


def _told(choice: Spec | Measure, measure: Measure, plugins: Plugins) -> str | list[str]:
    """What tells a measure from others: who offers it, with which options, and what it has learned."""
    if not isinstance(choice, Spec):
        return _given(choice)
    who = str(plugins.get("measure", choice.name))
    more = [*([repr(choice)] if choice.options else []), *([_learned(measure)] if isinstance(measure, State) else [])]
    return [who, *more] if more else who


def _model(name: str, choice: str | Path | Model, plugins: Plugins) -> Model:
    if not isinstance(choice, str | Path):
        return choice
    if str(choice).startswith("<"):
        raise StudyError(
            f"models: {name}: was given as a Python object, {choice}, which a file cannot hold: give it again, or "
            "store it with lampopt.fit_model(..., store=FILE)"
        )
    return load_model(choice, plugins=plugins)


def _learned(measure: Measure | Model) -> str:
    """A hash of all that a learned measure holds; of one that cannot tell, no other is ever taken for it."""
    if not isinstance(measure, State):
        return uuid.uuid4().hex
    return _hash([[name, lamp.digest(np.asarray(array))] for name, array in sorted(measure.state().items())])


def _given(measure: Measure) -> list[str]:
    """A measure given as an object: its class, the file that defines it, with all that it may call there, its options.

    What cannot be read (typed at a prompt) or pickled may be anything: no recorded result is taken for its own.
    """
    cls = type(measure)
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    try:
        source = Path(file).read_bytes() if file else uuid.uuid4().bytes
        options = _learned(measure).encode() if isinstance(measure, State) else pickle.dumps(measure)
    except Exception:  # noqa: BLE001  # whatever a stranger's __reduce__ raises
        source = options = uuid.uuid4().bytes
    return [cls.__module__, cls.__qualname__, *(hashlib.blake2b(part).hexdigest() for part in (source, options))]


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


def _hash(value: object) -> str:
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=12).hexdigest()
