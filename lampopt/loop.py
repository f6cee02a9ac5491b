"""The stages chained: the only module that knows them all.

source ─ exemplars ─► bank ─► solve ─► mix ─► decode ─► check ─► record
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from lampopt import lamp
from lampopt.bank import decoder_of
from lampopt.check import Limits, alpha_checks, field_checks, measure_checks, mesh_checks, stranger_checks
from lampopt.decode import decode
from lampopt.errors import EmptyMesh, InputError, MeasureError, PluginError, StudyError
from lampopt.measured import values_of
from lampopt.meshfile import load_mesh
from lampopt.mix import mixed_weights, predicted
from lampopt.plugins import Plugins
from lampopt.protocols import Checker, Decoder, Measure, Progress, Solver
from lampopt.record import RunFolder
from lampopt.solve import Posed, pose, solve, solve_many
from lampopt.study import Reduce, Study, Value
from lampopt.types import LEVELS, Bank, Check, Design, Mix, Needs, Result, Scalar, Spec

if TYPE_CHECKING:
    from trimesh import Trimesh

Grid = Mapping[str, Sequence[Value]] | Sequence[Mapping[str, Value]]
MOST = 100_000  # combinations of a sweep
BATCH = 256  # targets of a sweep that are solved together
log = logging.getLogger("lampopt")


def measure(name: str | Spec, mesh: Trimesh, *, plugins: Plugins | None = None) -> dict[str, float]:
    """The values of measure `name` on `mesh` [the mesh's unit], by name.

    Raises
    ------
    MeasureError
        If a feature is not there.
    """
    made: Measure = (plugins or Plugins.load().report()).make("measure", name)
    if len(mesh.faces) == 0:
        raise MeasureError(f"measure {Spec.of(name).name!r}: expected a mesh with faces, got none")
    values = values_of(Spec.of(name).name, made, mesh)
    return {value: float(v) for value, v in zip(made.names, values, strict=True)}


def design(
    bank: Bank | Path | str,
    targets: Mapping[str, Value],
    *,
    keep: Sequence[str] = (),
    reference: str | None = None,
    objective: Reduce | None = None,
    solver: str | Spec = "kkt",
    measures: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
    level: Needs = "mesh",
    resolution: int = 128,
    plugins: Plugins | None = None,
) -> Result:
    """One design, the shortest way: ``design(bank, {"roof": 1.42, "ramp": 12.0})``. Arguments as in `Study`."""
    study = Study(
        bank,
        targets=targets,
        keep=keep,  # type: ignore[arg-type]  # as it came: Study says what is wrong with it
        reference=reference,
        objective=objective,
        solver=solver,
        measures=measures,  # type: ignore[arg-type]  # likewise
        limits=limits or {},
        level=level,
        resolution=resolution,
    )
    return run(study, plugins=plugins)


def run(study: Study, folder: str | Path | None = None, *, plugins: Plugins | None = None) -> Result:
    """The design that `study` asks for; with `folder` recorded there, or read back if it is there already."""
    _expect_study(study)
    (result,) = _Run.of(study, plugins).results([{}], folder, None)
    return result


def sweep(
    study: Study,
    grid: Grid | None = None,
    folder: str | Path | None = None,
    *,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Iterator[Result]:
    """One design for each combination of the values in `grid`, yielded as they come; nothing is held.

    They are made in this process, one after the other; executors for many at once come later.

    Parameters
    ----------
    study
        What all designs have in common; `grid` replaces its targets of the same names.
    grid
        Values by name, every combination of which is made, or a list of target tables; default: `study.sweep`.
    folder
        Where results are recorded. Designs that are there already are read back, not computed again.
    progress
        Told how far it is.

    Raises
    ------
    StudyError
        Before anything is computed, if the study asks for what cannot be.
    """
    _expect_study(study)
    if isinstance(grid, Mapping):
        study = replace(study, sweep=grid)
    changes = _combinations(study.sweep) if grid is None or isinstance(grid, Mapping) else [dict(t) for t in grid]
    if not changes:
        raise StudyError("sweep: expected values by name, such as {'roof': [1.30, 1.36]}, got none")
    return _Run.of(study, plugins).results(changes, folder, progress)


def _combinations(grid: Mapping[str, Sequence[Value]]) -> list[dict[str, Value]]:
    if not grid:
        return []
    count = math.prod(len(values) for values in grid.values())
    if count > MOST:
        raise StudyError(
            f"sweep: {count:,} combinations, at most {MOST:,} are made at once: give fewer values, or sweep parts of "
            "them, one after the other, into the same folder"
        )
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def _expect_study(study: object) -> None:
    if not isinstance(study, Study):
        raise StudyError(f"expected a Study, got {study!r}; read one with Study.read(path)")


@dataclass(frozen=True, eq=False)
class _Run:
    """A study with everything it names found and opened."""

    study: Study
    bank: Bank
    decoder: Decoder
    solver: Solver
    limits: Limits
    checkers: Mapping[str, Checker]
    plugins: Plugins

    @classmethod
    def of(cls, study: Study, plugins: Plugins | None) -> _Run:
        plugins = plugins or Plugins.load().report()
        _require(study, plugins)
        bank = study.opened()
        solver: Solver = plugins.make("solver", study.solver)
        checkers: dict[str, Checker] = {name: plugins.make("check", name) for name in study.checks}
        for name, made in checkers.items():
            if made.needs not in LEVELS:
                raise PluginError(f"check {name!r}: expected needs as one of {', '.join(LEVELS)}, got {made.needs!r}")
        for name in study.measures:
            plugins.get("measure", name)
        return cls(study, bank, decoder_of(bank, plugins), solver, Limits.of(bank, study.limits), checkers, plugins)

    def results(
        self, changes: Sequence[Mapping[str, Value]], folder: str | Path | None, progress: Progress | None
    ) -> Iterator[Result]:
        """Check every target first, then yield the results one by one."""
        asked = [self._asked(change) for change in changes]
        for target in {tuple(target): target for target in asked}.values():  # one for each set of names
            self.posed(target)  # raises here, before the first design, what cannot be asked
        return self._yield(asked, folder, progress)

    def _asked(self, change: Mapping[str, Value]) -> dict[str, float]:
        targets = {**self.study.targets, **change}
        return replace(self.study, targets=targets, sweep={}).asked(self.bank)

    def _yield(
        self, asked: Sequence[Mapping[str, float]], folder: str | Path | None, progress: Progress | None
    ) -> Iterator[Result]:
        with RunFolder.open(folder) if folder is not None else nullcontext() as place:
            identity = ""
            if place is not None:
                identity = self._identity()
                place.write_study(self._stored(place.folder).to_toml())
            mixes = _Mixes(self, asked)
            for number, target in enumerate(asked):
                if progress:
                    progress(number / len(asked), f"design {number + 1} of {len(asked)}")
                if place is None:
                    yield self._judge(target, *mixes.at(number))
                    continue
                key = _hash({"run": identity, "target": dict(target)})
                result = place.read(key, self._design)
                if result is None:
                    began = time.perf_counter()
                    result = self._judge(target, *mixes.at(number))
                    seconds = time.perf_counter() - began
                    result = place.write(key, result, self.bank, form=self.study.format, seconds=seconds)
                    self.plugins.recorded(result, result.folder or place.folder)
                yield result
            if progress:
                progress(1.0, f"{len(asked)} designs")

    def _judge(self, target: Mapping[str, float], posed: Posed, mix: Mix) -> Result:
        """One design through mix, decode and check, as far as the study's level."""
        made = self._design(target, mix)
        checks = alpha_checks(posed, mix, self.limits)
        for level in LEVELS[: LEVELS.index(self.study.level) + 1]:
            if level == "field":
                checks += field_checks(self.bank, self.decoder, made, self.limits)
            if level == "mesh":
                checks += mesh_checks(self.bank, self.decoder, made, self.study.resolution, self.limits, self.plugins)
                if made.mesh is None:
                    break  # nothing is left to be measured or judged
                checks += measure_checks(self.bank, made.mesh, self.study.measures, self.plugins)
            checks += stranger_checks(self.bank, made, self.checkers, level)
        return Result(made, tuple(_unique(checks)), dict(self._provenance))

    def posed(self, target: Mapping[str, float]) -> Posed:
        """The problem that one target poses."""
        study = self.study
        return pose(self.bank, target, ranges=study.bounds(self.bank), hard=study.hard, reference=study.reference)

    def _design(self, target: Mapping[str, float], mix: Mix, mesh: Path | None = None) -> Design:
        weights = mixed_weights(self.bank, mix.alpha)

        def make() -> Trimesh | None:
            if mesh is not None and mesh.exists():
                try:
                    found = load_mesh(mesh)
                except InputError as error:
                    log.warning("%s; it is decoded again", error)
                else:
                    found.units = self.bank.frame.unit
                    return found
            try:
                return decode(self.bank, self.decoder, weights, resolution=self.study.resolution)
            except EmptyMesh:
                return None

        return Design(target, mix, predicted(self.bank, mix.alpha), weights, make)

    def _stored(self, folder: Path) -> Study:
        """The study with a bank that TOML can name: one that is in no file is stored in the run folder."""
        if isinstance(self.study.bank, Bank) and self.study.bank.path is None:
            path = folder / "bank.lamp"
            lamp.store_bank(self.bank, path)
            return replace(self.study, bank=path.name)
        path = self.bank.path or Path(str(self.study.bank))
        return replace(self.study, bank=str(path.resolve()))

    def _identity(self) -> str:
        """A hash of all but the target that a result depends on."""
        study = self.study
        drift = self.bank.measured_by.values() if study.level == "mesh" else ()

        def offer(kind: str, name: str) -> str:
            return str(self.plugins.get(kind, name))

        return _hash(
            {
                "versions": dict(self._provenance),
                "space": [str(q) for q in (*self.bank.space, *self.bank.label_space)],
                "names": self.bank.names,
                "measured_by": dict(self.bank.measured_by),
                "mesh_facts": dict(self.bank.mesh_facts),
                "frame": [self.bank.frame.scale, self.bank.frame.centre.tolist(), self.bank.frame.unit],
                "bank": [lamp.digest(getattr(self.bank, name)) for name in lamp.PLAIN],
                "shared": {name: lamp.digest(array) for name, array in self.bank.shared.items()},
                "limits": [dict(study.limits), dict(self.bank.limits)],
                "decoder": repr(self.bank.decoder),
                "solver": repr(study.solver),
                "reference": study.reference,
                "ranges": study.bounds(self.bank),
                "hard": study.hard,
                "measures": {name: offer("measure", name) for name in study.measures},
                "drift": {address: offer("measure", address.partition(".")[0]) for address in drift},
                "checks": {name: offer("check", name) for name in study.checks},
                "format": study.format,
                "level": study.level,
                "resolution": study.resolution,
                "seed": study.seed,
            }
        )

    @cached_property
    def _provenance(self) -> Mapping[str, Scalar]:
        solver = self.plugins.get("solver", Spec.of(self.study.solver).name)
        decoder = self.plugins.get("decoder", self.bank.decoder.name)
        return {
            **{f"bank.{name}": value for name, value in self.bank.provenance.items()},
            "lampopt": version("lampopt"),
            "solver": f"{self.study.solver} ({solver.distribution} {solver.version})",
            "decoder": f"{self.bank.decoder} ({decoder.distribution} {decoder.version})",
            "level": self.study.level,
            "resolution": self.study.resolution,
        }


class _Mixes:
    """The mixes of many targets. A batch is solved when the first of it is wanted, and only one is held.

    Batches are fixed by the order of the targets, so that a sweep that goes on ends with the very same coefficients.
    Where the first of a batch is not met exactly, all of it are solved one by one, each when it is wanted: they would
    have to be asked for their reasons anyway.
    """

    def __init__(self, run: _Run, asked: Sequence[Mapping[str, float]]) -> None:
        self._run, self._asked = run, asked
        self._batch, self._solved = range(0), list[tuple[Posed, Mix]]()

    def at(self, number: int) -> tuple[Posed, Mix]:
        """The problem of one target, and its mix."""
        if number not in self._batch:
            self._batch = next(batch for batch in self._batches() if number in batch)
            self._solved = self._together([self._asked[i] for i in self._batch])
        return self._solved[number - self._batch.start] if self._solved else self._alone(self._asked[number])

    def _batches(self) -> Iterator[range]:
        """Neighbours that ask for the same names, `BATCH` at most."""
        for _, same in itertools.groupby(range(len(self._asked)), key=lambda i: tuple(self._asked[i])):
            found = list(same)
            yield from (range(first, min(first + BATCH, found[-1] + 1)) for first in found[::BATCH])

    def _together(self, targets: Sequence[Mapping[str, float]]) -> list[tuple[Posed, Mix]]:
        """The whole batch, or nothing where that is of no use."""
        if len(targets) == 1:
            return []
        posed, first = self._alone(targets[0])
        return [(posed, mix) for mix in solve_many(posed, targets, self._run.solver)] if first.status == "exact" else []

    def _alone(self, target: Mapping[str, float]) -> tuple[Posed, Mix]:
        posed = self._run.posed(target)
        return posed, solve(posed, self._run.solver)


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
