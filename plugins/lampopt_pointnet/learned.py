"""The measure that was learned: a mesh's values with intervals, its range, its gradient; kept as named arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.metrics import conformal_quantile
from lampopt.types import Array

from .cloud import Cut
from .conformal import Region
from .pooled import PointNet, Waves
from .regression import Kernel, Linear
from .state import OWN, kept, read, sound_words

if TYPE_CHECKING:
    from trimesh import Trimesh

SMALLEST, LARGEST = 1e-100, 1e100  # sizes of values whose squares are numbers
WIDER = 0.15  # of the values' range at each of its ends: what is told beyond is extrapolated


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
    reach
        (2, p) least and greatest value that is not told by extrapolation [its unit].
    errors
        (n, p) found by cross-validation [spread], NaN where unlabelled.
    regions
        What was learned from: one for each set of rows that are all the labels of some value.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    scale: Array
    pooled: PointNet | Waves
    features: Array
    regression: Linear | Kernel
    values: Array
    reach: Array
    errors: Array
    regions: tuple[Region, ...]

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
        return np.asarray(self.values[1] * [conformal_quantile(c[np.isfinite(c)], level) for c in self.errors.T])

    def outside(self, mesh: Trimesh) -> bool:
        """Whether `mesh` is unlike those that any of the values was learned from, or a value is extrapolated.

        Unlike: farther in its features than 97 % of them from the others; where they are fewer than 33, than all of
        them. Extrapolated: told beyond the range learned from, by more than 15 % of its length and more than half the
        90 % interval's width.
        """
        return self.beyond(self.pooled(self._cut(mesh).cloud()))

    def beyond(self, features: Array) -> bool:
        """As `outside`, of a mesh whose pooled features (F,) are known."""
        seen, (low, high), values = self._standardised(features), self.reach, self.at(features)
        return any(r.outside(seen) for r in self.regions) or bool(((values < low) | (values > high)).any())

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
        """By name: `r2`, the share of the variance explained, and `mean_absolute_error` [unit of the value].

        Found by cross-validation on the meshes learned from.
        """
        found = {}
        for name, spread, column in zip(self.names, self.values[1], self.errors.T, strict=True):
            known = column[np.isfinite(column)]
            off = float(spread * np.abs(known).mean())
            found[name] = {"r2": 1 - float((known**2).mean()), "mean_absolute_error": off}
        return found

    def state(self) -> dict[str, Array]:
        """The arrays that `from_state` makes it of again, its words as the bytes of a JSON text."""
        regions = {f"region{k}": region for k, region in enumerate(self.regions)}
        parts = {"pooled": self.pooled, "regression": self.regression} | regions
        return kept(self.names, self.units, {name: getattr(self, name) for name in OWN}, parts)

    @classmethod
    def from_state(cls, state: Mapping[str, Array]) -> Learned:
        """The measure again, with the same answers to the bit.

        Raises
        ------
        InputError
            If an array is missing or none that `state` makes.
        """
        found = read(state)
        regions, patterns = len(found["regions"]), len(list(labelled(found["errors"])))
        if regions != patterns:
            raise InputError(
                f"learned measure: expected {patterns} regions by its errors, got {regions}; learn it anew"
            )
        return cls(**found)

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


def standardised(rows: Array, least: float = 0.0) -> tuple[Array, Array]:
    """Rows (n, q) with mean 0 and variance 1, and (2, q) what mean and spread were; NaN is left out.

    A column with no more spread than `least` is 0, and so is its spread.
    """
    mean, spread = np.nanmean(rows, axis=0), np.nanstd(rows, axis=0)
    spread = np.where(spread > least, spread, 0.0)
    return np.divide(rows - mean, spread, out=np.zeros_like(rows), where=spread > 0), np.stack([mean, spread])


def reach(values: Array, errors: Array) -> Array:
    """(2, p) ends of the range of values (n, p), each farther out by a share WIDER of it.

    Or by 90 % of the `errors` (n, p) found by cross-validation, where that is more.
    """
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    off = [conformal_quantile(column[np.isfinite(column)], 0.9) for column in errors.T]
    farther = np.maximum(WIDER * (high - low), off)
    return np.stack([low - farther, high + farther])


def checked(values: Array, count: int, names: Sequence[str], units: Sequence[str], least: int) -> Array:
    """Values (n, p) as numbers, NaN where unlabelled.

    Raises
    ------
    InputError
        If shapes disagree, a word is not printable, a value is no number or of no size that can be reckoned with, or a
        column has fewer than `least` labels or always the same.
    """
    sound_words(tuple(names), tuple(units))
    try:
        given = np.asarray(values)
    except ValueError as error:
        raise InputError(f"values: expected a table of numbers, got rows that differ in length: {error}") from error
    if given.dtype.kind not in "iuf":
        raise InputError(f"values: expected real numbers, NaN where there is none, got {given.dtype}")
    if given.shape != (count, len(names)):
        raise InputError(f"expected values ({count}, {len(names)}) of so many meshes and names, got {given.shape}")
    given = given.astype(float)
    for name, column in zip(names, given.T, strict=True):
        known = column[~np.isnan(column)]
        sizes = np.abs(known[known != 0])
        if not np.isfinite(known).all():
            raise InputError(f"{name}: expected finite values, or NaN where there is none, got an infinite one")
        if ((sizes < SMALLEST) | (sizes > LARGEST)).any():
            raise InputError(f"{name}: expected values of size {SMALLEST:g} to {LARGEST:g}, or 0; take another unit")
        if len(known) < least:
            raise InputError(f"{name}: expected values for at least {least} meshes, got {len(known)}")
        if np.ptp(known) <= 1e-9 * np.abs(known).max():
            raise InputError(f"{name}: expected values that differ, got {known[0]:.6g} throughout; leave it out")
    return given


def differing(features: Array, values: Array, names: Sequence[str], least: int) -> list[tuple[Array, Array]]:
    """Columns and rows that are `labelled`, where standardised `features` (n, F) tell at least `least` meshes apart.

    Raises InputError naming the values otherwise.
    """
    found = list(labelled(values))
    for columns, rows in found:
        count = len(np.unique(features[rows].round(6), axis=0))
        if count < least:
            raise InputError(
                f"{', '.join(names[k] for k in columns)}: the meshes do not differ enough: expected at least {least} "
                f"shapes, got {count}"
            )
    return found
