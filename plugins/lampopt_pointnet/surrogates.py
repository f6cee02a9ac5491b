"""Ways to learn a measure from meshes: `pointnet-lasso`, after the paper, and `fourier-ridge`, which learns more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, LampoptError
from lampopt.types import Array

from .cloud import Cloud, Cut
from .conformal import Region
from .learned import Learned, checked, labelled, standardised
from .pooled import PointNet, Waves
from .regression import Kernel, Linear, kernel_ridge, lasso

if TYPE_CHECKING:
    from trimesh import Trimesh

LEAST = 10  # labels of a value: fewer say nothing by cross-validation


@dataclass(frozen=True)
class PointNetLasso:
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

    def fit(
        self, meshes: Sequence[Trimesh], values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Learned:
        """A measure learned from values (n, p), NaN where a mesh has none.

        Raises
        ------
        EmptyMesh, MeasureError
            If a mesh has no surface or a vertex is not finite; the mesh is named by its number.
        InputError
            If shapes disagree, or a value is infinite, hardly ever known or always the same.
        """
        given = checked(values, len(meshes), names, units, LEAST)
        scale, clouds = surfaces(meshes)
        features = np.stack([*map(self.pooled(seed), clouds)])
        return self.fit_features(scale, features, given, names, units, seed=seed)

    def pooled(self, seed: int) -> PointNet:
        """What a cloud's features are made by."""
        return PointNet.drawn(self.neurons, seed)

    def fit_features(
        self, scale: float, features: Array, values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Learned:
        """As `fit`, from features (n, F) by `pooled(seed)` of clouds in units of `scale`."""
        values = checked(values, len(features), names, units, LEAST)
        features, about = standardised(features)
        wanted, spread = standardised(values)
        weights = np.zeros((features.shape[1], len(names)))
        intercept, errors = np.zeros(len(names)), np.full(values.shape, np.nan)
        for columns, rows in labelled(values):
            found = lasso(features[rows], wanted[np.ix_(rows, columns)], self.folds, seed)
            weights[:, columns], intercept[columns], errors[np.ix_(rows, columns)] = found
        return Learned(
            names=tuple(names),
            units=tuple(units),
            scale=np.array(scale),
            pooled=self.pooled(seed),
            features=about,
            regression=Linear(weights, intercept),
            values=spread,
            errors=errors,
            region=Region.of(features, seed),
        )


@dataclass(frozen=True)
class FourierRidge:
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

    def fit(
        self, meshes: Sequence[Trimesh], values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Learned:
        """As `PointNetLasso.fit`."""
        given = checked(values, len(meshes), names, units, LEAST)
        scale, clouds = surfaces(meshes)
        features = np.stack([*map(self.pooled(seed), clouds)])
        return self.fit_features(scale, features, given, names, units, seed=seed)

    def pooled(self, seed: int) -> Waves:
        """What a cloud's features are made by."""
        return Waves.drawn(self.waves, seed)

    def fit_features(
        self, scale: float, features: Array, values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Learned:
        """As `fit`, from features (n, F) by `pooled(seed)` of clouds in units of `scale`."""
        values = checked(values, len(features), names, units, LEAST)
        features, about = standardised(features)
        wanted, spread = standardised(values)
        sharpness, weights = np.ones(len(names)), np.zeros(values.shape)
        errors = np.full(values.shape, np.nan)
        for columns, rows in labelled(values):
            at = np.ix_(rows, columns)
            sharpness[columns], weights[at], errors[at] = kernel_ridge(features[rows], wanted[at])
        return Learned(
            names=tuple(names),
            units=tuple(units),
            scale=np.array(scale),
            pooled=self.pooled(seed),
            features=about,
            regression=Kernel(features, sharpness, weights),
            values=spread,
            errors=errors,
            region=Region.of(features, seed),
        )


def surfaces(meshes: Sequence[Trimesh]) -> tuple[float, list[Cloud]]:
    """Half the first mesh's longest side [unit], and all clouds in that length, each mesh looked at once.

    One length for all: a scale for each mesh would hide its size.

    Raises
    ------
    EmptyMesh, MeasureError
        Naming the mesh by its number.
    """
    clouds: list[Cloud] = []
    scale = 0.0
    for i, mesh in enumerate(meshes):
        try:
            if not clouds:
                corners = np.asarray(mesh.vertices, float)[np.asarray(mesh.faces, np.int64)].reshape(-1, 3)
                scale = float(np.ptp(corners, axis=0).max(initial=0.0)) / 2 or 1.0
            clouds.append(Cut.of(mesh, scale).cloud())
        except LampoptError as error:
            raise type(error)(f"mesh {i}: {error}") from error
    return scale, clouds


def _sound(name: str, **counts: int) -> None:
    """Raise InputError for options that make no surrogate."""
    for option, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or not 2 <= count <= 10_000:
            raise InputError(f"{name}: {option}: expected a whole number from 2 to 10,000, got {count!r:.100}")
