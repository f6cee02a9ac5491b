"""alpha → weights → vertices → a measure's values, and the derivatives back by the chain rule.

Where the measure has derivatives by vertices (`Gradient`) and the decoder carries these back to weights (`Pullback`),
d value / d alpha = W · pullback(d value / d vertices): one pass, however many exemplars there are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lampopt.decode import decoding
from lampopt.errors import EmptyMesh, MeasureError, may_pass
from lampopt.measured import values_of
from lampopt.mix import mixed_weights
from lampopt.plugins import returned
from lampopt.protocols import Decoder, Gradient, Measure, Pullback
from lampopt.types import Array, Bank

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class _Kept:
    """The mesh of one alpha, and what measures said of it."""

    key: bytes
    mesh: Trimesh | None
    values: dict[tuple[str, int], Array] = field(default_factory=dict)
    reasons: dict[tuple[str, int], str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Chain:
    """What leads from mixing coefficients (N,) to a mesh and back.

    Parameters
    ----------
    bank, decoder, resolution
        Of the meshes.
    """

    bank: Bank
    decoder: Decoder
    resolution: int
    _last: list[_Kept] = field(default_factory=lambda: [_Kept(b"", None)], repr=False)

    @cached_property
    def _decoded(self) -> Callable[[Array], Trimesh]:
        return decoding(self.bank, self.decoder, resolution=self.resolution)

    def mesh(self, alpha: Array) -> Trimesh | None:
        """The mesh [user's unit] of alpha (N,); None where it has no surface. The last one is kept."""
        return self._made(alpha).mesh

    def _made(self, alpha: Array) -> _Kept:
        key = np.asarray(alpha, float).tobytes()
        kept = self._last[0]  # looked at once: threads may share a chain
        if kept.key != key:
            weights = mixed_weights(self.bank, alpha)
            try:
                kept = _Kept(key, self._decoded(weights))
            except EmptyMesh:
                kept = _Kept(key, None)
            self._last[0] = kept
        return kept

    def back(self, alpha: Array, by_vertices: Array) -> Array:
        """(N,) from a gradient (V, 3) by the vertices of `mesh(alpha)` [1/user's unit].

        Raises
        ------
        PluginError
            If the decoder, which has to be a `Pullback`, returns something else than a gradient.
        """
        mesh = self.mesh(alpha)
        assert mesh is not None
        assert isinstance(self.decoder, Pullback)
        weights = mixed_weights(self.bank, alpha)
        by_box = np.asarray(by_vertices, float) / self.bank.frame.scale
        found = self.decoder.pullback(self.bank.shared, weights, self.bank.frame.to_box(mesh), by_box)
        by_weights = returned(f"decoder {self.bank.decoder.name!r}: pullback", found, (self.bank.weights.shape[1],))
        return np.asarray(self.bank.weights @ by_weights.astype(np.float32), float)

    def values(self, name: str, measure: Measure, alpha: Array) -> Array:
        """What `measure` says (p,) of the mesh of alpha; NaN where it has no surface, or lacks what is measured.

        Raises
        ------
        MeasureError
            If it could not be measured for a reason that may pass: no search may take that for the shape's own.
        """
        kept = self._made(alpha)
        key = name, id(measure)
        if key not in kept.values:
            try:
                none = np.full(len(measure.names), np.nan)
                kept.values[key] = none if kept.mesh is None else values_of(name, measure, kept.mesh)
            except (MeasureError, EmptyMesh) as error:
                if may_pass(error):
                    raise
                kept.values[key], kept.reasons[key] = none, str(error)
        return kept.values[key]

    def why_not(self, name: str, measure: Measure, alpha: Array) -> str:
        """What `measure` said where it has no values; nothing where it was not asked, or there is no surface."""
        return self._made(alpha).reasons.get((name, id(measure)), "")

    def differentiable(self, measure: Measure) -> bool:
        """Whether there are derivatives all the way."""
        return isinstance(measure, Gradient) and isinstance(self.decoder, Pullback)

    def gradient(self, name: str, measure: Measure, place: int, alpha: Array) -> Array:
        """(N,) d value / d alpha, of one of the measure's values; NaN where there is no value.

        Raises
        ------
        PluginError
            If measure or decoder return something else than gradients.
        MeasureError
            As `values` does.
        """
        mesh = self.mesh(alpha)
        assert isinstance(measure, Gradient)
        if mesh is None:
            return np.full(len(self.bank), np.nan)
        try:
            found = measure.gradient(mesh)
        except (MeasureError, EmptyMesh) as error:
            if may_pass(error):
                raise
            return np.full(len(self.bank), np.nan)
        by = returned(f"measure {name!r}: gradient", found, (None, len(mesh.vertices), 3))
        return self.back(alpha, by[place])
