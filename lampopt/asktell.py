"""Ask and tell: a search for the least value of what nobody can call from here, a wind tunnel or a colleague's solver.

There is no search that waits: each `ask` runs the solver from the start, answers what was told, and stops it at the
first alpha that was not. A solver is deterministic, so it goes the same way; what was told is all of the state.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, StudyError
from lampopt.goals import Minimise
from lampopt.plugins import Plugins
from lampopt.protocols import Pullback, Solver
from lampopt.reading import brief, content, path_of, why
from lampopt.replay import Astray, Replay, Told, Unknown, apart, merit, numbers, read
from lampopt.solve import solve
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import Array, Design, Mix, Result, Spec
from lampopt.types.arrays import assign, frozen_array
from lampopt.units import said
from lampopt.written import replace_text

if TYPE_CHECKING:
    from trimesh import Trimesh

SOLVER = "nlopt"
SCHEMA = 1
HELD = 1e-6  # what is met to this is met


@dataclass(frozen=True, eq=False)
class Candidate:
    """A design to be evaluated elsewhere.

    Parameters
    ----------
    number
        Which of the search, from 0.
    alpha
        (N,) its coefficients.
    design
        The design; not judged.
    value
        What was told of it: NaN where it had none, None where nothing was told yet.
    """

    number: int
    alpha: Array
    design: Design = field(repr=False)
    value: float | None = None

    def __post_init__(self) -> None:
        assign(self, alpha=frozen_array(self.alpha, "alpha", (None,)))

    @property
    def mesh(self) -> Trimesh | None:
        """Its mesh [user's unit], made on first access; None where it has no surface: tell NaN."""
        return self.design.mesh


class AskTell:
    """A search by solver `nlopt` for the design of least value, where the value comes from outside.

    ::

        search = lampopt.AskTell(study)
        while (candidate := search.ask()) is not None:
            search.tell(candidate, tunnel(candidate.mesh))
            search.save("search.json")
        search.result()

    Parameters
    ----------
    study
        What has to be kept meanwhile: its targets, keeps, ranges, sums and bounds. Targets that are linear in the mix
        are met exactly, except those that have a weight: these give way to the value, as those on measured values do
        that are not hard. Its solver is `nlopt`, with options as they are.
    scale
        Of the value: so much of it weighs as much as a target missed by half of its range.
    plugins
        What to choose from, if not all that is installed.

    Raises
    ------
    StudyError
        If the study minimises or maximises something of its own, has turns, another solver or an end by the clock.
    """

    def __init__(self, study: Study, *, scale: float = 1.0, plugins: Plugins | None = None) -> None:
        if not isinstance(study, Study):
            raise StudyError(f"study: expected a Study, got {said(study):.80}; read one with Study.read(path)")
        if (factor := _number(scale)) is None or not 0 < factor < inf:
            raise StudyError(f"scale: expected a positive number, got {said(scale)}")
        if isinstance(study.objective, Minimise):
            raise StudyError(f"objective: the value that is told is to be least, got {study.objective} too: leave it")
        if study.turns:
            raise StudyError("turns: a search corrects nothing: leave them out")
        spec = Spec.of(study.solver)
        if spec.name == "kkt":  # the default of a study, which takes no terms
            spec = Spec(SOLVER)
        if spec.name != SOLVER:
            raise StudyError(f"solver: expected {SOLVER!r}, got {said(spec.name)}")
        if "seconds" in spec.options:
            raise StudyError("solver: seconds: a search that is replayed has no clock: take evaluations")
        plugins = plugins or Plugins.load().report()
        task = Task.of(replace(study, solver=spec, sweep={}, experiments=None), plugins)
        self._target = task.asked({})
        known = task.wishes.quantities
        hard = {name for name in self._target if known[name].column is not None and name not in study.weights}
        self._task = replace(task, study=replace(task.study, hard=(*dict.fromkeys([*study.hard, *sorted(hard)]),)))
        posed = self._task.posed(self._target)  # once: its terms remember what they were asked
        ridge = float(spec.options.get("ridge", 0.0)) if posed.problem.ridge is None else posed.problem.ridge
        self._posed = replace(posed, problem=replace(posed.problem, ridge=ridge))
        self._solver: Solver = self._task.solver
        self._scale = factor
        self._known = list[Told]()
        self._asked: Candidate | None = None
        self._mix: Mix | None = None

    @property
    def told(self) -> tuple[Candidate, ...]:
        """All that were told of, in order."""
        return tuple(self._candidate(i) for i in range(len(self._known)))

    def ask(self) -> Candidate | None:
        """The next design to be evaluated, the same until it is told of; None where the search is at its end.

        Raises
        ------
        InputError
            If the search goes another way than what was loaded: by another version, say.
        """
        if self._asked is None and self._mix is None:
            term = Replay(self._known, self._posed.active, self._posed.size, self._scale)
            problem = replace(self._posed.problem, objectives=(term, *self._posed.problem.objectives))
            try:
                self._mix = solve(replace(self._posed, problem=problem), self._solver)
            except Unknown as unknown:
                self._asked = Candidate(len(self._known), unknown.alpha, self._design(unknown.alpha))
            except Astray as astray:
                raise InputError(
                    f"search: goes another way than it did, from candidate {astray.number} on: versions differ, or a "
                    "measure in the study; begin anew"
                ) from astray
        return self._asked

    def tell(
        self, candidate: Candidate | int, value: float, gradient: Array | Mapping[str, float] | None = None
    ) -> None:
        """The value of the design that was asked for last.

        Parameters
        ----------
        candidate
            It, or its number.
        value
            The less the better; NaN where there is none, because the evaluation failed: the search keeps off.
        gradient
            Its derivatives, for all candidates or for none: (N,) by alpha, (V, 3) by the vertices of the candidate's
            mesh [1 by the user's unit], where the decoder is a `Pullback`, or by name of parameter [1 by its unit].

        Raises
        ------
        InputError
            If the candidate is not the one that was asked for, or value and gradient cannot be used.
        """
        asked = self.ask()
        number = candidate.number if isinstance(candidate, Candidate) else candidate
        if isinstance(number, bool) or not isinstance(number, int | np.integer):
            raise InputError(f"candidate: expected what ask() returned, or its number, got {said(candidate):.80}")
        if 0 <= number < len(self._known):
            raise InputError(f"candidate {number}: was told of already: {self._known[number].value:g}")
        if asked is None:
            raise InputError(f"candidate {number}: the search is at its end, nothing is asked")
        if number != asked.number or (isinstance(candidate, Candidate) and apart(candidate.alpha, asked.alpha)):
            raise InputError(f"candidate {number}: is not what this search asks, which is number {asked.number}")
        if (found := _number(value)) is None:
            raise InputError(f"value: expected a number, NaN where there is none, got {said(value)}")
        found = found if isfinite(found) else np.nan
        slope = None if gradient is None or not isfinite(found) else self._by_alpha(asked, gradient)
        told = next((known for known in self._known if isfinite(known.value)), None)
        if isfinite(found) and told is not None and (slope is None) != (told.gradient is None):
            has = "none" if told.gradient is None else "one"
            raise InputError(f"gradient: expected {has}, as was told before: tell it for all candidates or for none")
        self._known.append(Told(asked.alpha, found, slope))
        self._asked = None

    def best(self) -> Candidate | None:
        """The best of all that were told of: what is met comes first, then value and what soft targets cost."""
        told = [
            (*merit(self._posed.problem, known.alpha[self._posed.active]), known.value / self._scale, i)
            for i, known in enumerate(self._known)
            if isfinite(known.value)
        ]
        least = min((off for off, *_ in told), default=0.0)  # above 0 where what must be contradicts itself
        near = [(cost + value, i) for off, cost, value, i in told if off <= least + HELD]
        return self._candidate(min(near)[1]) if near else None

    def result(self) -> Result:
        """The best design, judged; where nothing is known yet, the one to begin with.

        At the end of the search its mix says how that went.
        """
        self.ask()
        if (mix := self._mix) is None:
            best = self.best() or self._asked
            assert best is not None  # a search has an end or a candidate
            problem = self._posed.problem
            alpha = best.alpha[self._posed.active]
            residual = problem.matrix @ alpha - problem.target
            met = max(np.abs(residual).max(initial=0.0), merit(problem, alpha)[0]) <= HELD
            words = f"the best of {len(self._known)} evaluations of a search that goes on"
            mix = Mix(best.alpha, residual, "exact" if met else "inexact", words)
        return self._task.judge(self._target, self._posed, mix)

    def save(self, path: str | Path) -> Path:
        """Write what was told to a JSON file, in one step; `load` goes on from there.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        path = path_of(path, "path")
        told = [
            {
                "alpha": known.alpha.tolist(),
                "value": known.value if isfinite(known.value) else None,
                **({} if known.gradient is None else {"gradient": known.gradient.tolist()}),
            }
            for known in self._known
        ]
        document = {"schema": SCHEMA, "search": self._identity, "told": told}
        try:
            replace_text(path, json.dumps(document))
        except OSError as error:
            raise InputError(f"{brief(path)}: cannot be written: {why(error)}") from error
        return path

    @classmethod
    def load(cls, path: str | Path, study: Study, *, scale: float = 1.0, plugins: Plugins | None = None) -> AskTell:
        """The search that was saved; study and scale as they were.

        Raises
        ------
        InputError
            If the file cannot be read, or belongs to another bank, study or scale.
        """
        search = cls(study, scale=scale, plugins=plugins)
        try:
            document = json.loads(content(path))
            schema, identity = document["schema"], document["search"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:  # InputError too
            raise InputError(f"{brief(path)}: cannot be read as a search: {why(error)}") from error
        if schema != SCHEMA:
            raise InputError(f"{brief(path)}: expected schema {SCHEMA}, got {said(schema)}: take a newer lampopt")
        if identity != search._identity:
            raise InputError(f"{brief(path)}: is the search of another bank, study or scale: load it with its own")
        n = search._posed.size
        try:
            search._known = [read(told, n) for told in document["told"]]
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise InputError(f"{brief(path)}: cannot be read as a search: {why(error)}") from error
        search.ask()
        return search

    def _design(self, alpha: Array) -> Design:
        problem = self._posed.problem
        residual = problem.matrix @ alpha[self._posed.active] - problem.target
        return self._task.designer(self._target, Mix(alpha, residual, "inexact", "a candidate, not judged"))

    def _candidate(self, number: int) -> Candidate:
        known = self._known[number]
        return Candidate(number, known.alpha, self._design(known.alpha), known.value)

    def _by_alpha(self, candidate: Candidate, gradient: Array | Mapping[str, float]) -> Array:
        """(N,) derivatives by alpha."""
        bank, chain = self._task.bank, self._task.wishes.quantities.chain
        if isinstance(gradient, Mapping):
            names = [q.name for q in bank.space]
            if unknown := [name for name in gradient if name not in names]:
                raise InputError(f"gradient: {brief(unknown)} are no parameters; known are {', '.join(names)}")
            by = numbers([gradient.get(name, 0.0) for name in names])
            return np.asarray(bank.parameters @ by)
        given = numbers(gradient)
        if given.shape == (len(bank),):
            return given
        mesh = candidate.mesh
        shape = None if mesh is None else mesh.vertices.shape
        if chain is None or given.shape != shape or not isinstance(self._task.decoder, Pullback):
            raise InputError(
                f"gradient: expected ({len(bank)},) by alpha, numbers by name of parameter, or where the decoder is "
                f"able to pull them back {shape or '(V, 3)'} by vertices; got shape {given.shape}"
            )
        return chain.back(candidate.alpha, given)

    @property
    def _identity(self) -> str:
        """A hash of what the way of a search depends on."""
        asked = {"question": self._task.question.plain(), "target": self._target, "scale": self._scale}
        return hashlib.blake2b(json.dumps(asked, sort_keys=True).encode(), digest_size=12).hexdigest()


def _number(value: object) -> float | None:
    try:
        return None if isinstance(value, bool) or not isinstance(value, Real) else float(value)
    except OverflowError:  # a whole number beyond any float
        return None
