"""Fixed random functions of an oriented point, pooled over a cloud: what a surface looks like to a regression."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lampopt.types import Array

from .cloud import Cloud

HIDDEN = 64  # neurons of the PointNet's first layer
LONGEST, SHORTEST = 1.0, 12.0  # wave numbers [rad/scale]: from the whole shape down to a few cells of the cloud
ByCloud = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class PointNet:
    """Two layers of rectified neurons shared by all points, then maximum and mean (Qi et al. 2017), never trained.

    Parameters
    ----------
    first, first_bias, second, second_bias
        (6, H), (H,), (H, K), (K,): from a point and its normal to K neurons.
    """

    first: Array
    first_bias: Array
    second: Array
    second_bias: Array

    @classmethod
    def drawn(cls, neurons: int, seed: int) -> PointNet:
        """With K = `neurons`, weights by He's rule (2015)."""
        rng = np.random.default_rng(seed)
        first = rng.normal(0, np.sqrt(2 / 6), (6, HIDDEN))
        second = rng.normal(0, np.sqrt(2 / HIDDEN), (HIDDEN, neurons))
        return cls(first, rng.normal(0, 0.5, HIDDEN), second, rng.normal(0, 0.5, neurons))

    def _layers(self, cloud: Cloud) -> tuple[Array, Array]:
        hidden = np.maximum(np.column_stack([cloud.points, cloud.normals]) @ self.first + self.first_bias, 0)
        return hidden, np.maximum(hidden @ self.second + self.second_bias, 0)

    def __call__(self, cloud: Cloud) -> Array:
        """(2 K,) largest and mean activation of each neuron, the mean by area."""
        _, active = self._layers(cloud)
        return np.concatenate([active.max(axis=0), cloud.areas @ active / cloud.areas.sum()])

    def pullback(self, cloud: Cloud, gradient: Array) -> Iterator[ByCloud]:
        """For each row of `gradient` (p, 2 K): gradients by points (M, 3), normals (M, 3) and areas (M,).

        Where two points share the largest activation, the first of them has the gradient.
        """
        hidden, active = self._layers(cloud)
        largest, whole = active.argmax(axis=0), cloud.areas.sum()
        mean = cloud.areas @ active / whole
        for by_max, by_mean in zip(*np.split(gradient, 2, axis=1), strict=True):
            by_active = cloud.areas[:, None] / whole * by_mean
            by_active[largest, np.arange(len(largest))] += by_max
            by_hidden = (by_active * (active > 0)) @ self.second.T
            by_point = (by_hidden * (hidden > 0)) @ self.first.T
            yield by_point[:, :3], by_point[:, 3:], (active - mean) @ by_mean / whole


@dataclass(frozen=True, eq=False)
class Waves:
    """The surface's Fourier transform, over places and normals, at K random waves: sums of area · cos(k·x + m·n + b).

    Random Fourier features (Rahimi and Recht 2007) of a varifold, the measure that a surface is over places and
    directions: what differs between two surfaces differs here.

    Parameters
    ----------
    vectors
        (6, K) wave vectors k [rad/scale] over m [rad].
    phases
        (K,) b [rad].
    """

    vectors: Array
    phases: Array

    @classmethod
    def drawn(cls, count: int, seed: int) -> Waves:
        """K = `count` waves, even in direction and in the logarithm of the wave number."""
        rng = np.random.default_rng(seed)
        ways = rng.normal(size=(3, count))
        numbers = np.exp(rng.uniform(np.log(LONGEST), np.log(SHORTEST), count))
        vectors = np.concatenate([ways / np.linalg.norm(ways, axis=0) * numbers, rng.normal(size=(3, count))])
        return cls(vectors, rng.uniform(0, 2 * np.pi, count))

    def _angles(self, cloud: Cloud) -> Array:
        angles: Array = np.column_stack([cloud.points, cloud.normals]) @ self.vectors + self.phases
        return angles

    def __call__(self, cloud: Cloud) -> Array:
        """(K,) the sums [scale²]."""
        sums: Array = cloud.areas @ np.cos(self._angles(cloud))
        return sums

    def pullback(self, cloud: Cloud, gradient: Array) -> Iterator[ByCloud]:
        """For each row of `gradient` (p, K): gradients by points (M, 3), normals (M, 3) and areas (M,)."""
        angles = self._angles(cloud)
        cosines, sines = np.cos(angles), np.sin(angles)
        for row in gradient:
            by_point = -cloud.areas[:, None] * (sines @ (row * self.vectors).T)
            yield by_point[:, :3], by_point[:, 3:], cosines @ row
