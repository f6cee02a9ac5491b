"""Exemplars fitted by one decoder: from which start, in which batches, and what is kept of a build that is stopped."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, overload

import numpy as np

from lampopt.errors import FitError, PluginError
from lampopt.partial import Partial
from lampopt.plugins import returned
from lampopt.progress import silent
from lampopt.protocols import Decoder, Progress, Shared
from lampopt.types import Array, Exemplars, Frame, Parameter
from lampopt.types.arrays import frozen_arrays

if TYPE_CHECKING:
    from trimesh import Trimesh

log = logging.getLogger("lampopt")


class InBox(Sequence["Trimesh"]):
    """The exemplars' meshes in the decoder's box, moved there on access; `metadata["name"]` says whose."""

    def __init__(self, meshes: Sequence[Trimesh], names: Sequence[str], frame: Frame) -> None:
        self._meshes, self.names, self.frame = meshes, tuple(names), frame

    def __len__(self) -> int:
        return len(self._meshes)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> InBox: ...
    def __getitem__(self, index: int | slice) -> Trimesh | InBox:
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            return InBox([self._meshes[i] for i in chosen], [self.names[i] for i in chosen], self.frame)
        mesh = self.frame.to_box(self._meshes[index])
        mesh.metadata["name"] = self.names[index]
        return mesh


def _mean_mesh(exemplars: Exemplars, meshes: InBox) -> Trimesh:
    """The mesh at the mean design where the source knows it, else the exemplar nearest to the mean."""
    mean = exemplars.parameters.mean(0)
    if exemplars.mesh_at is not None:
        mesh = meshes.frame.to_box(exemplars.mesh_at(mean))
        mesh.metadata["name"] = "mean design"
        return mesh
    spread = np.ptp(exemplars.parameters, axis=0)
    away = (exemplars.parameters - mean) / np.where(spread > 0, spread, 1.0)
    return meshes[int((away**2).sum(1).argmin())]


@dataclass(frozen=True)
class Fitting:
    """A decoder at work; what `partial` holds already is taken from it.

    Parameters
    ----------
    decoder
        What fits.
    called
        Its name.
    seed
        For whatever it draws.
    partial
        Where finished parts are kept, if anywhere.
    tell
        Told how far it is.
    """

    decoder: Decoder
    called: str
    seed: int
    partial: Partial | None = None
    tell: Progress = silent

    def start(self, exemplars: Exemplars, meshes: InBox) -> Shared:
        """What all share, from the mean design."""
        begun: Shared | None = self.partial.read("shared") if self.partial else None
        if begun is None:
            self.tell(0.0, "shared start")
            if self.partial:
                self.partial.clear()  # batches from a start that is lost
            mean = _mean_mesh(exemplars, meshes)
            begun = _prepared(self.called, self.decoder.prepare(meshes, mean=mean, seed=self.seed))
            if self.partial:
                self.partial.write("shared", begun)
        return frozen_arrays(begun, "shared")  # what one batch did to it, the next would start from

    def fit(self, shared: Shared, meshes: InBox, batch: int) -> tuple[Array, Array]:
        """Weights (N, D) and errors (N,) of all `meshes`, `batch` fitted together.

        Raises
        ------
        FitError
            Naming the exemplar that cannot be fitted, and why.
        PluginError
            If the decoder returns something else than weights and errors.
        """
        starts = range(0, len(meshes), batch)
        weights, errors = list[Array](), list[Array]()
        for number, first in enumerate(starts):
            part = f"batch_{number:04d}"
            done = self.partial.read(part) if self.partial else None
            if done is None:
                chosen = meshes[first : first + batch]
                what = f"exemplars {first + 1} to {first + len(chosen)} of {len(meshes)}"
                log.info("fitting %s", what)
                tell = share_of(self.tell, (1 + number) / (1 + len(starts)), 1 / (1 + len(starts)), what)
                with self._said_when_stopped(first, len(meshes)):
                    answer = self._answer(shared, chosen, tell)
                    done = _fitted(self.called, answer, len(chosen), weights[0].shape[1] if weights else None)
                    if self.partial:
                        self.partial.write(part, done)
            weights.append(done["weights"])
            errors.append(done["error"])
        self.tell(1.0, "done")
        return np.concatenate(weights), np.concatenate(errors)

    def _answer(self, shared: Shared, chosen: InBox, tell: Progress) -> object:
        try:
            return self.decoder.fit(shared, chosen, seed=self.seed, progress=tell)
        except FitError as failure:
            if any(name in str(failure) for name in chosen.names):
                raise
            raise FitError(f"among the exemplars {', '.join(chosen.names)}: {failure}") from failure

    @contextmanager
    def _said_when_stopped(self, done: int, count: int) -> Iterator[None]:
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:
            if self.partial:
                stopped = "interrupted" if isinstance(error, KeyboardInterrupt) else "stopped"
                kept = f"{done} of {count} exemplars are fitted and kept in {self.partial.folder}"
                log.warning("%s: %s; the same build goes on with the rest", stopped, kept)
            raise


def _prepared(called: str, answer: object) -> Shared:
    try:
        if not isinstance(answer, Mapping) or not all(isinstance(name, str) for name in answer):
            raise TypeError(f"{answer!r:.80}")
        return frozen_arrays(answer, "shared")
    except (TypeError, ValueError) as error:
        raise PluginError(f"decoder {called!r}: prepare: expected names with arrays, got {error}") from error


def _fitted(called: str, answer: object, count: int, wide: int | None) -> dict[str, Array]:
    what = f"decoder {called!r}: fit"
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        raise PluginError(f"{what}: expected a pair of weights and errors, got {answer!r:.80}")
    weights = returned(f"{what}: weights", answer[0], (count, wide), np.float32)
    return {"weights": weights, "error": returned(f"{what}: error", answer[1], (count,))}


def probe_values(decoder: Decoder, called: str, shared: Shared, weights: Array, points: Array) -> Array:
    """What the decoder says of each exemplar's weights (N, D) at `points` (M, 3): (N, M, C)."""
    values: list[Array] = []
    for w in weights:
        shape = (len(points), values[0].shape[1] if values else None)
        values.append(returned(f"decoder {called!r}: evaluate", decoder.evaluate(shared, w, points), shape))
    return np.stack(values)


def share_of(tell: Progress, start: float, share: float, what: str) -> Callable[..., None]:
    """What `tell` is told of a part of the work, `what`, that takes `share` of it from `start` on."""

    def progress(done: float, message: str = "", /) -> None:
        tell(start + share * done, f"{what}: {message}" if message else what)

    return progress


def ranged(space: Sequence[Parameter], values: Array) -> tuple[Parameter, ...]:
    """`space` with the range that `values` (N, d) span; a label nobody has spans none."""

    def each() -> Iterator[Parameter]:
        for q, column in zip(space, values.T, strict=True):
            known = column[~np.isnan(column)]
            yield (
                replace(q, low=float(known.min()), high=float(known.max()))
                if len(known)
                else replace(q, low=None, high=None)
            )

    return tuple(each())
