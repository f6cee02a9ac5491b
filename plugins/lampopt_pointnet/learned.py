"""The measure that was learned: a mesh's values with intervals, its range, its gradient; kept as named arrays."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .cloud import Cut
from .conformal import Region, quantile
from .pooled import PointNet, Waves
from .regression import Kernel, Linear

if TYPE_CHECKING:
    from trimesh import Trimesh

KINDS: Mapping[str, Any] = {kind.__name__: kind for kind in (PointNet, Waves, Linear, Kernel, Region)}
PARTS = ("pooled", "regression", "region")


@dataclass(frozen=True, eq=False)
class Learned:
    """A measure learned from n meshes with p values, through F pooled features.

    Parameters
    ----------
    names, units
        Of the p values.
    scale
        () the length that is 1 in a cloud [unit of the meshes].
    pooled
        From a cloud to features.
    features
        (2, F) mean and spread of each feature over the meshes learned from; spread 0 where a feature never differs.
    regression
        From standardised features to standardised values.
    values
        (2, p) mean and spread of each value [its unit].
    errors
        (n, p) found by cross-validation [spread], NaN where unlabelled.
    region
        What was learned from.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    scale: Array
    pooled: PointNet | Waves
    features: Array
    regression: Linear | Kernel
    values: Array
    errors: Array
    region: Region

    def __call__(self, mesh: Trimesh) -> Array:
        """Values (p,). Raises EmptyMesh where no face has an area, MeasureError where a vertex is not finite."""
        return self.at(self.pooled(self._cut(mesh).cloud()))

    def at(self, features: Array) -> Array:
        """Values (p,) of a mesh whose pooled features (F,) are known."""
        mean, spread = self.values
        values: Array = mean + spread * self.regression(self._standardised(features))
        return values

    def interval(self, mesh: Trimesh, level: float) -> Array:
        """(p, 2) low and high, made to hold the truth of shapes such as those learned from with probability `level`.

        The value, give or take the `level` quantile of the errors found by cross-validation; infinite where there are
        fewer labels than ``level / (1 - level)``. Of a shape that is `outside` nothing is promised.

        Raises
        ------
        EmptyMesh, MeasureError
            As for the values.
        InputError
            If `level` is not between 0 and 1.
        """
        half = self.half_widths(level)
        values = self(mesh)
        return np.column_stack([values - half, values + half])

    def half_widths(self, level: float) -> Array:
        """(p,) half of each interval's width [unit of the value]."""
        return np.asarray(self.values[1] * [quantile(np.abs(column), level) for column in self.errors.T])

    def outside(self, mesh: Trimesh) -> bool:
        """Whether `mesh` is unlike those learned from: farther in its features than 97 % of them from the others."""
        return self.beyond(self.pooled(self._cut(mesh).cloud()))

    def beyond(self, features: Array) -> bool:
        """As `outside`, of a mesh whose pooled features (F,) are known."""
        return self.region.outside(self._standardised(features))

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives (p, V, 3) by vertices. Raises as the values do."""
        cut = self._cut(mesh)
        cloud = cut.cloud()
        spread = self.features[1]
        inverse = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > 0)
        seen = self._standardised(self.pooled(cloud))
        by_features = self.values[1][:, None] * self.regression.jacobian(seen) * inverse
        return np.stack([cut.pullback(*by) for by in self.pooled.pullback(cloud, by_features)])

    @property
    def cross_validated(self) -> dict[str, dict[str, float]]:
        """By name: `r2`, the share of the variance explained, and `mae`, the mean absolute error [unit of the value].

        Found by cross-validation on the meshes learned from.
        """
        found = {}
        for name, spread, column in zip(self.names, self.values[1], self.errors.T, strict=True):
            known = column[np.isfinite(column)]
            found[name] = {"r2": 1 - float((known**2).mean()), "mae": float(spread * np.abs(known).mean())}
        return found

    def state(self) -> dict[str, Array]:
        """The arrays that `from_state` makes it of again, its words as the bytes of a JSON text."""
        words: dict[str, Any] = {"names": self.names, "units": self.units}
        arrays: dict[str, Array] = {name: getattr(self, name) for name in ("scale", "features", "values", "errors")}
        for part in PARTS:
            held = getattr(self, part)
            words[part] = type(held).__name__
            arrays |= {f"{part}.{field.name}": getattr(held, field.name) for field in fields(held)}
        return arrays | {"words": np.frombuffer(json.dumps(words).encode(), np.uint8)}

    @classmethod
    def from_state(cls, state: Mapping[str, Array]) -> Learned:
        """The measure again, with the same answers to the bit.

        Raises
        ------
        InputError
            If an array is missing or the words are none of `state`'s.
        """
        try:
            words = json.loads(np.asarray(state["words"], np.uint8).tobytes())
            parts: dict[str, Any] = {}
            for part in PARTS:
                kind = KINDS[words[part]]
                parts[part] = kind(**{field.name: state[f"{part}.{field.name}"] for field in fields(kind)})
            arrays: dict[str, Any] = {name: state[name] for name in ("scale", "features", "values", "errors")}
            names, units = (tuple(map(str, words[name])) for name in ("names", "units"))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"learned measure: expected the arrays of its state(), got {error!r}; learn it anew"
            ) from error
        return cls(names, units, **arrays, **parts)

    def _cut(self, mesh: Trimesh) -> Cut:
        return Cut.of(mesh, float(self.scale))

    def _standardised(self, features: Array) -> Array:
        """(F,) with mean 0 and variance 1 over the meshes learned from; those that never differed are 0."""
        mean, spread = self.features
        return np.asarray(np.divide(features - mean, spread, out=np.zeros_like(mean), where=spread > 0))


def labelled(values: Array) -> Iterator[tuple[Array, Array]]:
    """Columns of `values` (n, p) that are known on the same rows, and those rows."""
    known = np.isfinite(values)
    patterns, which = np.unique(known, axis=1, return_inverse=True)
    for k in range(patterns.shape[1]):
        yield np.flatnonzero(which.ravel() == k), np.flatnonzero(patterns[:, k])


def standardised(rows: Array) -> tuple[Array, Array]:
    """Rows (n, q) with mean 0 and variance 1, and (2, q) what mean and spread were; NaN is left out."""
    mean, spread = np.nanmean(rows, axis=0), np.nanstd(rows, axis=0)
    spread = np.where(spread > 1e-9 * np.abs(rows).max(initial=0.0, where=np.isfinite(rows)), spread, 0.0)
    return np.divide(rows - mean, spread, out=np.zeros_like(rows), where=spread > 0), np.stack([mean, spread])


def checked(values: Array, count: int, names: Sequence[str], units: Sequence[str], least: int) -> Array:
    """Values (n, p) as numbers, NaN where unlabelled.

    Raises
    ------
    InputError
        If shapes disagree, a value is infinite, or a column has fewer than `least` labels or always the same.
    """
    given = np.asarray(values, float)
    if given.shape != (count, len(names)) or len(units) != len(names) or not names:
        raise InputError(
            f"expected values ({count}, p) with p names and units, got {given.shape}, {len(names)} and {len(units)}"
        )
    if len(set(names)) < len(names):
        raise InputError(f"names: expected distinct ones, got {', '.join(names)}")
    for name, column in zip(names, given.T, strict=True):
        known = column[~np.isnan(column)]
        if not np.isfinite(known).all():
            raise InputError(f"{name}: expected finite values, or NaN where there is none, got an infinite one")
        if len(known) < least:
            raise InputError(f"{name}: expected values for at least {least} meshes, got {len(known)}")
        if np.ptp(known) <= 1e-12 * np.abs(known).max():
            raise InputError(f"{name}: expected values that differ, got {known[0]:.6g} throughout; leave it out")
    return given
