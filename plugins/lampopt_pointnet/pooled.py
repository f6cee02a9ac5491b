"""Fixed random functions of an oriented point, integrated over a surface: what it looks like to a regression."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lampopt.types import Array

from .cloud import Cloud

HIDDEN = 128  # neurons of the PointNet's first layer
COARSE, FINE = 0.5, 4.0  # scales of its weights for places
ROUND = 0.1  # ε of a rectified neuron, whose activations are about 1
LONGEST, SHORTEST = 1.0, 12.0  # wave numbers [rad/scale]: a piece of a cloud is no longer than 1.2 rad of the shortest
BLOCK = 64  # triangles looked at together: what is worked on then stays in the processor's cache
ByCloud = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class PointNet:
    """Two layers of rectified neurons shared by all points, then their mean (Qi et al. 2017), never trained.

    Rectified without a corner, by (x + √(x² + ε²)) / 2: what is pooled is smooth in the vertices. The mean, not the
    maximum of the published PointNet: that hangs on single points, so on how a surface is cut into faces.

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
        """With K = `neurons`, weights by He's rule (2015), the first layer's for places over COARSE to FINE.

        Its biases are in proportion: neurons of every scale switch anywhere in the shape.
        """
        rng = np.random.default_rng(seed)
        first = rng.normal(0, np.sqrt(2 / 6), (6, HIDDEN))
        first[:3] *= np.exp(rng.uniform(np.log(COARSE), np.log(FINE), HIDDEN))
        first_bias = rng.normal(0, 0.35, HIDDEN) * np.linalg.norm(first, axis=0)
        second = rng.normal(0, np.sqrt(2 / HIDDEN), (HIDDEN, neurons))
        return cls(first, first_bias, second, rng.normal(0, 0.5, neurons))

    def _layers(self, cloud: Cloud, rows: slice) -> tuple[Array, Array, Array, Array]:
        """Activations of both layers, each followed by its slopes."""
        points = np.column_stack([cloud.corners[rows].mean(axis=1), cloud.normals[rows]])
        hidden, by_hidden = _rectified(points @ self.first + self.first_bias)
        return hidden, by_hidden, *_rectified(hidden @ self.second + self.second_bias)

    def __call__(self, cloud: Cloud) -> Array:
        """(K,) mean activation of each neuron by area, a triangle standing in its centroid."""
        sums = np.zeros(len(self.second_bias))
        for rows in _blocks(cloud):
            sums += cloud.areas[rows] @ self._layers(cloud, rows)[2]
        mean: Array = sums / cloud.areas.sum()
        return mean

    def pullback(self, cloud: Cloud, gradient: Array) -> list[ByCloud]:
        """For each row of `gradient` (p, K): gradients by corners (P, 3, 3), normals (P, 3) and areas (P,)."""
        whole, by_cloud = cloud.areas.sum(), _empty(cloud, len(gradient))
        level = gradient @ self(cloud)
        for rows in _blocks(cloud):
            _, hidden_slopes, active, slopes = self._layers(cloud, rows)
            for row, (by_corners, by_normals, by_areas), mean in zip(gradient, by_cloud, level, strict=True):
                by_active = cloud.areas[rows, None] / whole * row * slopes
                by_point = ((by_active @ self.second.T) * hidden_slopes) @ self.first.T
                by_corners[rows] = by_point[:, None, :3] / 3
                by_normals[rows] = by_point[:, 3:]
                by_areas[rows] = (active @ row - mean) / whole
        return by_cloud


@dataclass(frozen=True, eq=False)
class Waves:
    """The surface's Fourier transform, over places and normals, at K random waves: ∫ cos(k·x + m·n + b) over the area.

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

    def _waves(self, cloud: Cloud, rows: slice) -> tuple[Array, Array, Array, Array]:
        """Of triangles: phases about the centroid at two corners a, b, then damping and phase of the mean wave.

        The third corner's is −a − b. With p = a² + ab + b² and q = −ab (a + b) the moments of the phase over a triangle
        are p/6, q/10, p²/15; its cumulants damp the wave at the centroid and delay it by q/60.
        """
        corners, normals = cloud.corners[rows], cloud.normals[rows]
        middle = corners.mean(axis=1)
        a, b = ((corners[:, i] - middle) @ self.vectors[:3] for i in (0, 1))
        both = a + b
        product = a * b
        p = both * both
        p -= product
        phase = np.column_stack([middle, normals]) @ self.vectors
        phase += self.phases
        product *= both
        product /= 60
        phase += product
        damping = p / 360
        damping -= 1 / 12
        damping *= p
        damping += 1
        return a, b, damping, phase

    def __call__(self, cloud: Cloud) -> Array:
        """(K,) the integrals [scale²]."""
        sums = np.zeros(len(self.phases))
        for rows in _blocks(cloud):
            _, _, damping, phase = self._waves(cloud, rows)
            cosine, _ = _circle(phase)
            cosine *= damping
            sums += cloud.areas[rows] @ cosine
        return sums

    def pullback(self, cloud: Cloud, gradient: Array) -> list[ByCloud]:
        """For each row of `gradient` (p, K): gradients by corners (P, 3, 3), normals (P, 3) and areas (P,)."""
        by_cloud = _empty(cloud, len(gradient))
        for rows in _blocks(cloud):
            a, b, damping, phase = self._waves(cloud, rows)
            cosine, sine = _circle(phase)
            sine *= -damping
            corners = [a, b, -a - b]
            p = (a * a + b * b + corners[2] ** 2) / 2
            bend = (p / 180 - 1 / 12) * cosine  # of the damping by p, whose slope by a corner's phase is that phase
            slopes = [c * bend + sine * (1 / 3 - (c * c - 2 / 3 * p) / 60) for c in corners]
            area = cloud.areas[rows, None]
            for row, (by_corners, by_normals, by_areas) in zip(gradient, by_cloud, strict=True):
                ways = (row * self.vectors).T
                by_corners[rows] = np.stack([area * (slope @ ways[:, :3]) for slope in slopes], axis=1)
                by_normals[rows] = area * (sine @ ways[:, 3:])
                by_areas[rows] = (damping * cosine) @ row
        return by_cloud


def _rectified(entering: Array) -> tuple[Array, Array]:
    """Smoothly rectified activations and their slopes."""
    root = np.sqrt(entering * entering + ROUND**2)
    active = (entering + root) / 2
    return active, active / root


def _circle(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine by the tangent of half the angle, which numpy has vectorised where it has not them."""
    tangent = np.tan(angle / 2)
    share = tangent * tangent
    share += 1
    np.divide(2, share, out=share)
    tangent *= share
    share -= 1
    return share, tangent


def _blocks(cloud: Cloud) -> Iterator[slice]:
    return (slice(start, start + BLOCK) for start in range(0, len(cloud.areas), BLOCK))


def _empty(cloud: Cloud, count: int) -> list[ByCloud]:
    arrays = cloud.corners, cloud.normals, cloud.areas
    return [(np.empty_like(arrays[0]), np.empty_like(arrays[1]), np.empty_like(arrays[2])) for _ in range(count)]
