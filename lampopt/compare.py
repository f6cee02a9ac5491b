"""Which decoder serves a family, and why: each is fitted to the inner exemplars and asked for those it was not shown.

The outermost third is held out, as in `lampopt.calibrate`, but from the fit too: neither `prepare` nor `fit` sees it.
Each of its exemplars is asked for by its parameters, mixed, decoded and compared with its true surface. What a decoder
has to beat is nothing at all: the inner exemplar nearest in parameters, handed over as it is.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from lampopt.bank import build_bank, decoder_of, hashed
from lampopt.check import Limits
from lampopt.errors import FitError, InputError
from lampopt.fitting import share_of
from lampopt.holdout import asked, chosen, decoded, designed, evidence, normalised, off, parted
from lampopt.intake import intake
from lampopt.measured import FOLLOWS, follows, measure_each
from lampopt.partial import Partial
from lampopt.plugins import Plugins
from lampopt.progress import silent
from lampopt.protocols import Progress, Solver
from lampopt.reading import path_of
from lampopt.recommend import NOTHING, Compared, Comparison, counted, recommended
from lampopt.types import Array, Bank, Exemplars, Spec
from lampopt.units import said, whole

DECODERS = ("mesh-template", "sdf-mlp")
BUILDING = 0.8  # of the time that a decoder takes, as progress tells it
log = logging.getLogger("lampopt")


def compare(
    exemplars: Exemplars,
    decoders: Sequence[str | Spec] = DECODERS,
    *,
    seed: int = 0,
    solver: str | Spec = "kkt",
    resolution: int = 128,
    measured: Mapping[str, str] | None = None,
    accept: Iterable[str] = (),
    folder: str | Path | None = None,
    progress: Progress | None = None,
    plugins: Plugins | None = None,
) -> Comparison:
    """Fit `exemplars` with each of `decoders`, hold what they make of others against what is true, and recommend one.

    Parameters
    ----------
    exemplars
        N meshes with parameters, of which a third or so is held out.
    decoders
        Names, or Specs with options; one decoder with different options is compared with itself.
    seed
        For the decoders, for the points where surfaces are compared, for what is told to be noise.
    solver, resolution
        As in a `Study`.
    measured, accept
        As in `build_bank`. A declared measurement that does not follow its parameter over the inner exemplars alone is
        left out, which is said.
    folder
        Where the banks of the comparison are kept. An interrupted comparison of the same inputs goes on there: what is
        fitted is not fitted again.
    progress
        Told how far it is.

    Returns
    -------
    Comparison
        A row for each decoder, also for one that cannot fit these exemplars: why is in its `refusal`.

    Raises
    ------
    InputError
        If the exemplars are too few for any to be held out, intake refuses or doubts one of them, or an argument cannot
        be used.
    BankError
        If `folder` holds banks of other exemplars, or another process is building them.
    PluginError
        If a plugin is missing, or does not do what it should.
    """
    if not isinstance(exemplars, Exemplars):
        raise InputError(f"exemplars: expected lampopt.types.Exemplars, got {exemplars!r:.80}")
    seed, resolution = whole(seed, "seed", 0), whole(resolution, "resolution", 4, 4096)
    plugins = plugins or Plugins.load().report()
    specs = _specs(decoders)
    for spec in specs:
        plugins.make("decoder", spec)  # what is missing is told before anything is fitted
    solving: Solver = plugins.make("solver", solver)
    place = None if folder is None else path_of(folder, "folder")
    inner, held = _parted(exemplars.parameters)
    tell = progress or silent
    report = intake(exemplars, accept=accept, progress=lambda _, message="": tell(0.0, message))
    report.refuse()
    truth = chosen(report.exemplars, held)
    shown = _measurable(chosen(report.exemplars, inner), measured, plugins)
    trial = _Trial(shown, truth, solving, resolution, seed, place, plugins)
    rows = []
    for k, spec in enumerate(specs):
        rows.append(trial(spec, share_of(tell, k / len(specs), 1 / len(specs), called(spec))))
    rows.append(_nothing(shown, truth, exemplars.parameters, inner, held, seed))
    tell(1.0, f"{len(specs)} decoders")
    found = counted(rows)
    best, reason = recommended(found, exemplars.unit, seed)
    return Comparison(exemplars.unit, shown.names, truth.names, found, best, reason)


def called(spec: Spec) -> str:
    """What a decoder goes by where one may come with several options: `sdf-mlp width=64`."""
    return " ".join([spec.name, *(f"{name}={value}" for name, value in spec.options.items())])


def _specs(decoders: object) -> list[Spec]:
    wanted = "decoders: expected a list of names or Specs, such as ['mesh-template', 'sdf-mlp']"
    if isinstance(decoders, str | Spec) or not isinstance(decoders, Sequence) or not decoders:
        raise InputError(f"{wanted}, got {said(decoders):.80}")
    if wrong := [choice for choice in decoders if not isinstance(choice, str | Spec)]:
        raise InputError(f"{wanted}, got a list with {said(wrong[0]):.80}")
    specs = [Spec.of(choice) for choice in decoders]
    names = [called(spec) for spec in specs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"decoders: {twice!r} is given twice: leave one out, or give it other options")
    if NOTHING in names:
        raise InputError(f"decoders: {NOTHING!r} is what a comparison calls no decoder at all: name others")
    return specs


def _parted(parameters: Array) -> tuple[Array, Array]:
    """The inner exemplars and those held out. Raises InputError where none can be."""
    rank = int(np.linalg.matrix_rank(normalised(parameters) - normalised(parameters).mean(0)))
    if not rank:
        raise InputError(
            "exemplars: expected some that differ in a parameter, so that others can be asked for, got none"
        )
    inner, held = parted(parameters)
    if not len(held):
        raise InputError(
            f"exemplars: expected at least {rank + 2}, better three times as many: a mix that moves {rank} parameters "
            f"takes {rank + 1}, and others are held out; got {len(parameters)}: add exemplars"
        )
    return inner, held


def _measurable(inner: Exemplars, measured: Mapping[str, str] | None, plugins: Plugins) -> Exemplars:
    """`inner` with those declared measurements that they bear out: a third fewer may not."""
    if measured is not None and not isinstance(measured, Mapping):
        raise InputError(f"measured: expected a mapping such as {{'length': 'extents.length'}}, got {measured!r:.80}")
    inner = replace(inner, measured={**inner.measured, **(measured or {})})
    values = measure_each(inner, inner.measured, plugins)
    place = {q.name: i for i, q in enumerate(inner.space)}
    kept = dict(inner.measured)
    for (parameter, address), column in zip(inner.measured.items(), values.T, strict=True):
        r2 = follows(inner.parameters, place[parameter], column)
        if r2 < FOLLOWS:
            about = "measured: %r does not follow parameter %r over the %d exemplars that are not held out (R² %.2f)"
            log.warning(f"{about}: no check is made of it", address, parameter, len(inner), r2)
            del kept[parameter]
    return replace(inner, measured=kept)


@dataclass(frozen=True, eq=False)
class _Trial:
    """What every decoder is put through."""

    shown: Exemplars
    truth: Exemplars
    solver: Solver
    resolution: int
    seed: int
    folder: Path | None
    plugins: Plugins

    def __call__(self, spec: Spec, tell: Progress) -> Compared:
        """The row of one decoder; the figures that depend on other rows are not yet there."""
        store = None if self.folder is None else self.folder / _file(spec)
        empty = np.full(len(self.truth), np.nan), np.full(len(self.shown), np.nan)
        try:
            with _timed(store) as seconds:
                bank = build_bank(
                    self.shown,
                    spec,
                    seed=self.seed,
                    store=store,
                    accept=self.shown.names,  # among all of them, they have been looked at
                    progress=share_of(tell, 0.0, BUILDING, "building"),
                    plugins=self.plugins,
                )
        except FitError as refusal:
            log.info("%s refuses: %s", called(spec), refusal)
            return Compared(called(spec), spec, *empty, refusal=str(refusal) or type(refusal).__name__)
        return self._judged(spec, bank, seconds[0], share_of(tell, BUILDING, 1 - BUILDING, "held out"))

    def _judged(self, spec: Spec, bank: Bank, seconds: float, tell: Progress) -> Compared:
        decoder, limits = decoder_of(bank, self.plugins), Limits.of(bank, {})
        steps = len(bank) + len(self.truth)
        fits = []
        for i, name in enumerate(bank.names):
            tell(i / steps, name)
            mesh = decoded(bank, decoder, np.asarray(bank.weights[i]), self.resolution)
            fits.append(off(mesh, self.shown.meshes[i], self.seed))
        errors, accepted, times = [], [], []
        for i, name in enumerate(self.truth.names):
            tell((len(bank) + i) / steps, name)
            began = perf_counter()
            targets = asked(bank, self.truth.parameters[i])
            posed, design = designed(bank, decoder, self.solver, targets, self.resolution)
            times.append(perf_counter() - began)
            checks = evidence(bank, decoder, posed, design, self.resolution, limits, self.plugins)
            accepted.append(all(check.passed for check in checks))
            errors.append(off(design.mesh, self.truth.meshes[i], self.seed))
        return Compared(
            called(spec),
            spec,
            np.array(errors),
            np.array(fits),
            accepted=float(np.mean(accepted)),
            build_seconds=seconds,
            design_seconds=float(np.median(times)),  # the first may load a library
            weights=bank.weights.shape[1],
            bank=bank.path,
        )


def _nothing(shown: Exemplars, truth: Exemplars, parameters: Array, inner: Array, held: Array, seed: int) -> Compared:
    """The row of the nearest exemplar as it is: distances in parameters, each over its range."""
    at = normalised(parameters)
    nearest = [int(((at[inner] - at[i]) ** 2).sum(1).argmin()) for i in held]
    errors = [off(shown.meshes[near], truth.meshes[i], seed) for i, near in enumerate(nearest)]
    return Compared(NOTHING, None, np.array(errors), np.zeros(len(shown)), build_seconds=0.0, design_seconds=0.0)


def _file(spec: Spec) -> str:
    """A file for each choice: a name may hold what no file system takes, and options make another bank."""
    return f"{re.sub(r'[^A-Za-z0-9_-]', '_', spec.name)}-{hashed(repr(spec))[:8]}.lamp"


@contextmanager
def _timed(store: Path | None) -> Iterator[list[float]]:
    """How many seconds the build of `store` took, over interruptions; NaN where nobody counted.

    They are noted beside it, so that a bank that is only read again is not taken for one that was built in no time.
    What a build did before it was killed outright is not counted.
    """
    note = None if store is None else store.with_suffix(".seconds")
    finished = store is not None and store.exists()
    begun = store is not None and (finished or Partial.beside(store, "").folder.exists())
    before = _noted(note) if begun else 0.0
    seconds = [np.nan]
    began = perf_counter()
    try:
        yield seconds
    finally:
        seconds[0] = before if finished else before + perf_counter() - began
        if note is not None and not finished and note.parent.is_dir():
            with suppress(OSError):  # the time is not worth a bank
                aside = note.with_name(f"{note.name}.writing")
                aside.write_text(json.dumps(seconds[0]))
                os.replace(aside, note)


def _noted(note: Path | None) -> float:
    try:
        found = json.loads(note.read_text()) if note is not None else None
    except (OSError, ValueError):
        found = None
    return float(found) if isinstance(found, float) and found >= 0 else float("nan")
