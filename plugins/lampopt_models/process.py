"""Gaussian process regression: a smooth surface through noisy labels that knows where it is less certain."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lampopt.types import Array

from .curve import check_arrays

FLAT = 1e-7  # relative: likelihoods that differ by less are as good
STEPS = 100
LEAST, MOST = 1e-5, 1e2  # noise and size, of a label's variance: beyond, large terms cancel until rounding shows


@dataclass(frozen=True, eq=False)
class Process:
    """The mean of a Gaussian process, given m rows (Rasmussen & Williams, 2006, algorithm 2.1).

    Its covariance is size · exp(−½ Σ ((zᵢ − z′ᵢ) / lengthᵢ)²) + tilt · (1 + z·z′), and noise on each row: a plane and,
    over it, a smooth function with a length of its own along each parameter.

    Parameters
    ----------
    points
        (m, d) rows that it knows.
    weights
        (m,) inverse of their covariance, times their labels.
    lengths
        (d,) along each parameter.
    settings
        (5,) size, tilt, noise; and the labels' mean and deviation [label].
    """

    points: Array
    weights: Array
    lengths: Array
    settings: Array

    kind: ClassVar[str] = "process"

    def __post_init__(self) -> None:
        m, d = np.shape(self.points)
        check_arrays(self, points=(m, d), weights=(m,), lengths=(d,), settings=(5,))

    def __call__(self, z: Array) -> Array:
        """Values (B,) at (B, d)."""
        tilt, mean, scale = self.settings[[1, 3, 4]]
        near = self._bell(z) @ self.weights
        values: Array = mean + scale * (near + tilt * (self.weights.sum() + z @ (self.points.T @ self.weights)))
        return values

    def gradient(self, z: Array) -> Array:
        """Derivatives (B, d) at (B, d)."""
        tilt, scale = self.settings[[1, 4]]
        pull = self._bell(z) * self.weights
        near = (pull @ self.points - pull.sum(axis=1, keepdims=True) * z) / self.lengths**2
        slopes: Array = scale * (near + tilt * (self.points.T @ self.weights))
        return slopes

    def deviation(self, z: Array) -> Array:
        """(B,) standard deviation of a new label, noise included [label]."""
        from scipy.linalg import solve_triangular

        size, tilt, noise, _, scale = self.settings
        known = solve_triangular(self._factor, self._covariance(z).T, lower=True)
        left = size + tilt * (1 + (z**2).sum(axis=1)) - (known**2).sum(axis=0)
        spread: Array = scale * np.sqrt(np.maximum(left, 0.0) + noise)
        return spread

    def symbolic(self, z: Any) -> Any:
        """The value as a CasADi expression of z (d,)."""
        import casadi

        size, tilt, _, mean, scale = (float(s) for s in self.settings)
        m = len(self.points)
        apart = (casadi.DM(self.points) - casadi.repmat(casadi.reshape(z, 1, -1), m, 1)) @ casadi.diag(1 / self.lengths)
        bell = size * casadi.exp(-casadi.sum2(apart**2) / 2)
        near = casadi.dot(casadi.DM(self.weights), bell)
        slope = casadi.DM(self.points.T @ self.weights)
        return mean + scale * (near + tilt * (float(self.weights.sum()) + casadi.dot(slope, casadi.vec(z))))

    def state(self) -> Mapping[str, Array]:
        """Its arrays."""
        return {"points": self.points, "weights": self.weights, "lengths": self.lengths, "settings": self.settings}

    def held_out(self, y: Array, part: Array) -> tuple[Array, Array]:
        """Values and deviations (m,) of its own rows, labelled y (m,), each without those of the same part (m,).

        In closed form, from blocks of the inverse covariance (as Rasmussen & Williams, 2006, section 5.4.2, for single
        rows): lengths, size, tilt and noise stay as they are.
        """
        mean, scale = self.settings[3:]
        inverse = _inverse(self._factor)
        values, deviations = np.empty_like(y), np.empty_like(y)
        pulled = inverse @ ((y - mean) / scale)
        for k in range(int(part.max()) + 1):
            out = np.flatnonzero(part == k)
            block = np.linalg.inv(inverse[np.ix_(out, out)])
            values[out] = y[out] - scale * (block @ pulled[out])
            deviations[out] = scale * np.sqrt(np.maximum(np.diag(block), 0.0))
        return values, deviations

    def _bell(self, z: Array) -> Array:
        """(B, m) covariance of the smooth part, its bell about each row."""
        a, b = z / self.lengths, self.points / self.lengths
        apart = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
        bell: Array = self.settings[0] * np.exp(-np.maximum(apart, 0.0) / 2)
        return bell

    def _covariance(self, z: Array) -> Array:
        covariance: Array = self._bell(z) + self.settings[1] * (1 + z @ self.points.T)
        return covariance

    @cached_property
    def _factor(self) -> Array:
        factor: Array = np.linalg.cholesky(self._covariance(self.points) + self.settings[2] * np.eye(len(self.points)))
        return factor


def process(z: Array, y: Array, rows: Array, search: int, seed: int) -> Process:
    """The process given `rows` of z (n, d) and y (n,), fitted by scikit-learn.

    Its lengths, size, tilt and noise are the most likely ones of `search` rows drawn from them.
    """
    from scipy.optimize import minimize
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

    points, known = np.ascontiguousarray(z[rows]), y[rows]
    mean, scale = known.mean(), known.std()
    target = (known - mean) / scale
    drawn = sample(len(known), search, seed)

    def descend(_: object, start: Array, bounds: Array) -> tuple[Array, float]:
        by = {"ftol": FLAT, "maxiter": STEPS}
        told = (points[drawn], target[drawn])
        found = minimize(unlikelihood, start, told, method="L-BFGS-B", jac=True, bounds=bounds, options=by)
        return found.x, float(found.fun)

    bell = ConstantKernel(1.0, (1e-4, MOST)) * RBF(np.full(z.shape[1], 2 * np.sqrt(z.shape[1])), (0.05, 1e3))
    plane = ConstantKernel(0.1, (1e-6, 1e4)) * DotProduct(1.0, "fixed")
    kernel = bell + plane + WhiteKernel(0.1, (LEAST, 1e1))
    with warnings.catch_warnings():  # a length at its bound is a parameter that does not matter
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted = GaussianProcessRegressor(kernel, alpha=1e-12, optimizer=descend).fit(points, target)
    size, lengths, tilt, noise = _divided(fitted.kernel_.theta)
    return Process(points, fitted.alpha_.ravel(), lengths, np.array([size, tilt, noise, mean, scale]))


def unlikelihood(theta: Array, points: Array, target: Array) -> tuple[float, Array]:
    """−log marginal likelihood of rows (m, d) with targets (m,), and its derivatives by theta (d + 3,).

    `theta` is the logarithm of size, lengths, tilt and noise. It is what scikit-learn computes (Rasmussen & Williams,
    2006, equation 5.9) without its array (m, m, d), which takes most of the time where there are many parameters.
    """
    size, lengths, tilt, noise = _divided(theta)
    blank = Process(points, np.zeros(len(points)), lengths, np.array([size, tilt, noise, 0.0, 1.0]))
    bell, plane = blank._bell(points), tilt * (1 + points @ points.T)
    factor = np.linalg.cholesky(bell + plane + noise * np.eye(len(points)))
    inverse = _inverse(factor)
    weights = inverse @ target
    value = target @ weights / 2 + np.log(np.diag(factor)).sum() + len(target) / 2 * np.log(2 * np.pi)
    pull = np.outer(weights, weights) - inverse
    near = pull * bell
    along = (near.sum(axis=1) @ points**2 - (points * (near @ points)).sum(axis=0)) / lengths**2
    slopes = np.concatenate([[near.sum() / 2], along, [(pull * plane).sum() / 2, noise * np.trace(pull) / 2]])
    return float(value), -slopes


def _divided(theta: Array) -> tuple[float, Array, float, float]:
    size, *lengths, tilt, noise = np.exp(theta)
    return size, np.array(lengths), tilt, noise


def sample(n: int, most: int, seed: int) -> Array:
    """All of n rows in order, or `most` of them drawn at random."""
    if n <= most:
        return np.arange(n)
    return np.sort(np.random.default_rng(seed).choice(n, most, replace=False))


def _inverse(factor: Array) -> Array:
    from scipy.linalg import cho_solve

    inverse: Array = cho_solve((factor, True), np.eye(len(factor)))
    return inverse
