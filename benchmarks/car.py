"""The family `car`, all sixteen parameters drawn at once: angles that are true rotations, wheels that stay round."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from trimesh import Trimesh

import lampopt
from lampopt.errors import InputError
from lampopt.types import Array

from .body import RATIOS, Body
from .common import source

DRAWS = 10_000  # at most, for targets that make a car


@dataclass(frozen=True, eq=False)
class Car(Body):
    """Exemplars as the family meshes them, the truth at any parameters by its own construction."""

    @property
    def ratios(self) -> Mapping[float, float]:
        return RATIOS

    @property
    def metre(self) -> float:
        return 1000.0

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(q.name for q in self._family.space)

    @property
    def middle(self) -> Array:
        return np.asarray(self._ends.mean(0))

    @cached_property
    def _family(self) -> lampopt.Exemplars:
        options = {"count": self.size[0], "edge": 72.0 if self.bench.quick else 36.0}
        return lampopt.exemplars("car", plugins=self.bench.plugins, **options)

    @property
    def _ends(self) -> Array:
        """(2, 16) the range that exemplars are drawn from."""
        from lampopt_families.car import HIGH, LOW

        return np.array([LOW, HIGH])

    def exemplars(self) -> lampopt.Exemplars:
        return self._family

    def truth(self, target: Array) -> Trimesh:
        assert self._family.mesh_at is not None
        return self._family.mesh_at(target)

    def where(self, target: Array) -> list[object]:
        from lampopt_families.car import CarSource

        return [*super().where(target), source(CarSource)]

    def targets(self, f: float) -> Array:
        """Drawn evenly from the range widened by `f`; what makes no car is drawn again."""
        from lampopt_families.car import checked

        rng = np.random.default_rng([0, round(100 * f)])
        found = list[Array]()
        for _ in range(DRAWS):
            target = self.middle + f * np.ptp(self._ends, axis=0) / 2 * rng.uniform(-1, 1, len(self.names))
            try:
                checked(target)
            except InputError:
                continue
            found.append(target)
            if len(found) == self.size[1]:
                return np.array(found)
        raise InputError(f"car: at f={f:g} only {len(found)} of {DRAWS} draws make one")

    def bank(self, source: lampopt.Exemplars, decoder: lampopt.Spec, notes: list[str]) -> lampopt.Bank:
        return self.bench.bank("car", source, decoder)
