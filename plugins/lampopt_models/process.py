"""Gaussian process regression: a smooth surface through noisy labels that knows where it is less certain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .curve import check_arrays, check_range
from .given import LARGEST

FLAT = 1e-7  # relative: likelihoods that differ by less are as good
STEPS = 100
HOPELESS = 1e25
SIZES, LENGTHS, TILTS, NOISES = (1e-4, 1e2), (0.05, 1e3), (1e-6, 1e4), (1e-5, 1e1)  # where they are sought:
# with a larger size or less noise, of a label's variance, large terms cancel until rounding shows
MOST_ROWS = 5000  # its covariance takes 200 MB then
FARTHEST_ROW = 1e4  # deviations: √n at most
AT_ONCE = 2**22  # covariances in memory


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
        check_arrays(self, points=(None, None), settings=(5,))
        m, d = self.points.shape
        if not 1 <= m <= MOST_ROWS:
            raise InputError(f"process: expected 1 to {MOST_ROWS} rows, got {m}")
        check_arrays(self, weights=(m,), lengths=(d,))
        size, tilt, noise, mean, scale = self.settings[:, None]
        for name, array, (low, high) in (
            ("points", self.points, (-FARTHEST_ROW, FARTHEST_ROW)),
            ("weights", self.weights, (-FARTHEST_ROW / NOISES[0], FARTHEST_ROW / NOISES[0])),
            ("lengths", self.lengths, LENGTHS),
            ("size", size, SIZES),
            ("tilt", tilt, TILTS),
            ("noise", noise, NOISES),
            ("mean", mean, (-LARGEST, LARGEST)),
            ("scale", scale, (0.0, LARGEST)),
        ):
            check_range(name, array, low - 1e-9 * abs(low), high + 1e-9 * abs(high))

    def check_inputs(self, d: int) -> None:
        """Raise InputError if it is not of d parameters."""
        if len(self.lengths) != d:
            raise InputError(f"lengths: expected {d} parameters, got {len(self.lengths)}")

    def __call__(self, z: Array) -> Array:
        """Values (B,) at (B, d)."""
        tilt, mean, scale = self.settings[[1, 3, 4]]
        near = self._by_pieces(z, lambda part: self._bell(part) @ self.weights)
        values: Array = mean + scale * (near + tilt * (self.weights.sum() + z @ (self.points.T @ self.weights)))
        return values

    def gradient(self, z: Array) -> Array:
        """Derivatives (B, d) at (B, d)."""
        tilt, scale = self.settings[[1, 4]]

        def near(part: Array) -> Array:
            pull = self._bell(part) * self.weights
            slopes: Array = (pull @ self.points - pull.sum(axis=1, keepdims=True) * part) / self.lengths**2
            return slopes

        slopes: Array = scale * (self._by_pieces(z, near) + tilt * (self.points.T @ self.weights))
        return slopes

    def deviation(self, z: Array) -> Array:
        """(B,) standard deviation of a new label, noise included [label]."""
        from scipy.linalg import solve_triangular

        size, tilt, noise, _, scale = self.settings

        def known(part: Array) -> Array:
            sure: Array = (solve_triangular(self._factor, self._covariance(part).T, lower=True) ** 2).sum(axis=0)
            return sure

        left = size + tilt * (1 + (z**2).sum(axis=1)) - self._by_pieces(z, known)
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
        return _bell(z, self.points, float(self.settings[0]), self.lengths)

    def _covariance(self, z: Array) -> Array:
        covariance: Array = self._bell(z) + self.settings[1] * (1 + z @ self.points.T)
        return covariance

    def _by_pieces(self, z: Array, function: Callable[[Array], Array]) -> Array:
        """`function` of z (B, d), so many rows at once as memory allows."""
        step = max(1, AT_ONCE // len(self.points))
        return np.concatenate([function(z[first : first + step]) for first in range(0, max(len(z), 1), step)])

    @cached_property
    def _factor(self) -> Array:
        covariance = self._covariance(self.points) + self.settings[2] * np.eye(len(self.points))
        try:
            factor: Array = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError as error:
            raise InputError("process: expected rows whose covariance is positive definite, got others") from error
        return factor


def process(z: Array, y: Array, rows: Array, search: int, seed: int) -> Process:
    """The process given `rows` of z (n, d) and y (n,).

    Its lengths, size, tilt and noise are the most likely ones of `search` rows drawn from them.
    """
    from scipy.linalg import cho_solve
    from scipy.optimize import minimize

    points, known = np.ascontiguousarray(z[rows]), y[rows]
    mean, scale = known.mean(), known.std()
    target, d = (known - mean) / scale, z.shape[1]
    drawn = sample(len(known), search, seed)
    start = np.log([1.0, *np.full(d, 2 * np.sqrt(d)), 0.1, 0.1])
    bounds = np.log([SIZES, *[LENGTHS] * d, TILTS, NOISES])
    by = {"ftol": FLAT, "maxiter": STEPS}
    told = (points[drawn], target[drawn])
    found = minimize(unlikelihood, start, told, method="L-BFGS-B", jac=True, bounds=bounds, options=by)
    size, lengths, tilt, noise = _divided(found.x)
    blank = Process(points, np.zeros(len(points)), lengths, np.array([size, tilt, noise, mean, scale]))
    return replace(blank, weights=cho_solve((blank._factor, True), target))


def unlikelihood(theta: Array, points: Array, target: Array) -> tuple[float, Array]:
    """−log marginal likelihood of rows (m, d) with targets (m,), and its derivatives by theta (d + 3,).

    `theta` is the logarithm of size, lengths, tilt and noise. It is what scikit-learn computes (Rasmussen & Williams,
    2006, equation 5.9) without its array (m, m, d), which takes most of the time where there are many parameters.
    """
    size, lengths, tilt, noise = _divided(theta)
    bell, plane = _bell(points, points, size, lengths), tilt * (1 + points @ points.T)
    try:
        factor = np.linalg.cholesky(bell + plane + noise * np.eye(len(points)))
    except np.linalg.LinAlgError:  # to rounding: as unlikely as can be
        return HOPELESS, np.zeros_like(theta)
    inverse = _inverse(factor)
    weights = inverse @ target
    value = target @ weights / 2 + np.log(np.diag(factor)).sum() + len(target) / 2 * np.log(2 * np.pi)
    pull = np.outer(weights, weights) - inverse
    near = pull * bell
    along = (near.sum(axis=1) @ points**2 - (points * (near @ points)).sum(axis=0)) / lengths**2
    slopes = np.concatenate([[near.sum() / 2], along, [(pull * plane).sum() / 2, noise * np.trace(pull) / 2]])
    return float(value), -slopes


def _bell(z: Array, points: Array, size: float, lengths: Array) -> Array:
    """(B, m) covariance of the smooth part between z (B, d) and points (m, d)."""
    a, b = z / lengths, points / lengths
    apart = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    bell: Array = size * np.exp(-np.maximum(apart, 0.0) / 2)
    return bell


def _divided(theta: Array) -> tuple[float, Array, float, float]:
    size, *lengths, tilt, noise = np.exp(theta)
    return size, np.array(lengths), tilt, noise


def sample(n: int, most: int, seed: int) -> Array:
    """All of n rows in order, or `most` of them drawn at random."""
    if n <= most:
        return np.arange(n)
    return np.sort(np.random.default_rng(seed).choice(n, most, replace=False))


def _inverse(factor: Array) -> Array:
    """The inverse of a matrix by its lower Cholesky factor."""
    from scipy.linalg.lapack import dpotri

    half = np.tril(dpotri(factor, lower=1)[0])
    inverse: Array = half + np.tril(half, -1).T
    return inverse
