"""Ways to learn a measure from meshes: `pointnet-lasso`, after the paper, and `fourier-ridge`, which learns more."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError, LampoptError
from lampopt.types import Array

from .cloud import Cloud, Cut, size
from .conformal import Region
from .learned import Learned, checked, differing, reach, standardised
from .pooled import PointNet, Waves
from .regression import Kernel, Linear, kernel_ridge, lasso

if TYPE_CHECKING:
    from trimesh import Trimesh

LEAST = 10  # labels of a value: fewer say nothing by cross-validation
NOISE = 1e-9  # of the largest feature: one that varies less does not differ
APART = 1e3  # sizes of meshes that are learned from together, the largest to the smallest
Patterns = list[tuple[Array, Array]]


class _Surrogate(ABC):
    """What both have in common: from meshes to features, and from those to a measure."""

    def fit(
        self, meshes: Sequence[Trimesh], values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Learned:
        """A measure learned from values (n, p), NaN where a mesh has none.

        Raises
        ------
        EmptyMesh, MeasureError
            If a mesh has no surface or a vertex is not finite; the mesh is named by its number.
        InputError
            If arrays' shapes disagree, a value is infinite, hardly ever known or always the same, the meshes do not
            differ, or one is of another size by far.
        """
        given = checked(values, len(meshes), names, units, LEAST)
        scale, clouds = surfaces(meshes)
        features = np.stack([*map(self.pooled(seed), clouds)])
        return self.fit_features(scale, features, given, names, units, seed=seed)

    def fit_features(
        self, scale: float, features: Array, values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Learned:
        """As `fit`, from features (n, F) by `pooled(seed)` of clouds in units of `scale`."""
        values = checked(values, len(features), names, units, LEAST)
        features, about = standardised(features, NOISE * float(np.abs(features).max()))
        patterns = differing(features, values, names, LEAST)
        wanted, spread = standardised(values)
        regression, errors = self.regressed(features, wanted, patterns, seed)
        return Learned(
            names=tuple(names),
            units=tuple(units),
            scale=np.array(scale),
            pooled=self.pooled(seed),
            features=about,
            regression=regression,
            values=spread,
            reach=reach(values, spread[1] * errors),
            errors=errors,
            regions=tuple(Region.of(features[rows], seed) for _, rows in patterns),
        )

    @abstractmethod
    def pooled(self, seed: int) -> PointNet | Waves:
        """What a cloud's features are made by."""

    @abstractmethod
    def regressed(self, features: Array, values: Array, patterns: Patterns, seed: int) -> tuple[Linear | Kernel, Array]:
        """From standardised features (n, F) to standardised values (n, p), and errors (n, p) by cross-validation.

        `patterns` are the columns that are known on the same rows, and those rows.
        """


@dataclass(frozen=True)
class PointNetLasso(_Surrogate):
    """LASSO on the embedding of a fixed, randomly initialised PointNet (paper, section 4 and appendix H).

    Parameters
    ----------
    neurons
        Of the PointNet's second layer; each gives a feature, its mean over the surface.
    folds
        Of the cross-validation that chooses each value's penalty.

    Raises
    ------
    InputError
        For options that make no surrogate.
    """

    neurons: int = 512
    folds: int = 10

    def __post_init__(self) -> None:
        _sound("pointnet-lasso", neurons=self.neurons, folds=self.folds)

    @staticmethod
    def example() -> PointNetLasso:
        """One that learns in a second, for the conformance kit."""
        return PointNetLasso(neurons=64, folds=5)

    def pooled(self, seed: int) -> PointNet:
        """What a cloud's features are made by."""
        return PointNet.drawn(self.neurons, seed)

    def regressed(self, features: Array, values: Array, patterns: Patterns, seed: int) -> tuple[Linear, Array]:
        """By LASSO, a penalty for each value."""
        weights, intercept = np.zeros((features.shape[1], values.shape[1])), np.zeros(values.shape[1])
        errors = np.full(values.shape, np.nan)
        for columns, rows in patterns:
            found = lasso(features[rows], values[np.ix_(rows, columns)], self.folds, seed)
            weights[:, columns], intercept[columns], errors[np.ix_(rows, columns)] = found
        return Linear(weights, intercept), errors


@dataclass(frozen=True)
class FourierRidge(_Surrogate):
    """Kernel ridge regression on the surface's Fourier transform over places and normals, at random waves.

    Parameters
    ----------
    waves
        How many.

    Raises
    ------
    InputError
        For options that make no surrogate.
    """

    waves: int = 512

    def __post_init__(self) -> None:
        _sound("fourier-ridge", waves=self.waves)

    @staticmethod
    def example() -> FourierRidge:
        """One that learns in a second, for the conformance kit."""
        return FourierRidge(waves=128)

    def pooled(self, seed: int) -> Waves:
        """What a cloud's features are made by."""
        return Waves.drawn(self.waves, seed)

    def regressed(self, features: Array, values: Array, patterns: Patterns, seed: int) -> tuple[Kernel, Array]:
        """By kernel ridge regression, a width and a ridge for each value."""
        sharpness, weights = np.ones(values.shape[1]), np.zeros(values.shape)
        errors = np.full(values.shape, np.nan)
        for columns, rows in patterns:
            at = np.ix_(rows, columns)
            sharpness[columns], weights[at], errors[at] = kernel_ridge(features[rows], values[at])
        return Kernel(features, sharpness, weights), errors


def surfaces(meshes: Sequence[Trimesh]) -> tuple[float, list[Cloud]]:
    """Half the first mesh's longest side [unit], and all clouds in that length, each mesh looked at once.

    One length for all: a scale for each mesh would hide its size.

    Raises
    ------
    EmptyMesh, MeasureError
        Naming the mesh by its number.
    InputError
        If one is of another size by far, as in a wrong unit.
    """
    sizes = np.array([_of(i, size, mesh) for i, mesh in enumerate(meshes)])
    off = np.abs(np.log(sizes / np.median(sizes)))
    if np.ptp(np.log(sizes)) > np.log(APART):
        odd = int(off.argmax())
        raise InputError(
            f"mesh {odd}: expected a size such as the others', {np.median(sizes):.3g} by their median, "
            f"got {sizes[odd]:.3g}; bring all in one unit"
        )
    scale = float(sizes[0]) / 2
    return scale, [_of(i, lambda m: Cut.of(m, scale).cloud(), mesh) for i, mesh in enumerate(meshes)]


def _of(number: int, what: Callable[[Trimesh], Any], mesh: Trimesh) -> Any:
    """`what` of a mesh, named by its number where it is refused."""
    try:
        return what(mesh)
    except LampoptError as error:
        raise type(error)(f"mesh {number}: {error}") from error


def _sound(name: str, **counts: int) -> None:
    """Raise InputError for options that make no surrogate."""
    for option, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or not 2 <= count <= 10_000:
            raise InputError(f"{name}: {option}: expected a whole number from 2 to 10,000, got {count!r:.100}")
