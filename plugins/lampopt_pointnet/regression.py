"""From features to values: LASSO, and kernel ridge regression; both with errors found by cross-validation.

Features come in standardised (n, F), values (n, q) with mean 0 and variance 1.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from threading import Lock

import numpy as np

from lampopt.types import Array

from .conformal import folds, same_shapes

PENALTIES = np.geomspace(1, 1e-4, 40)  # of the one that leaves no feature in
KNOTS = 8  # steps of a path for each feature, at most; a path takes about half as many as there are features
ROUNDING = 1e-12  # of the largest weight: what interpolation leaves of a feature that went
OPTIMAL = 1e-8  # of the penalty, by which a feature may pull more
SWEEPS = 2000  # of coordinate descent
WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0)  # of the kernel, in median distances
_ALONE = Lock()  # the filters of warnings are shared by all threads
RIDGES = 10.0 ** np.arange(-8, 1)


@dataclass(frozen=True, eq=False)
class Linear:
    """Values as weighted sums of features.

    Parameters
    ----------
    weights, intercept
        (F, p) and (p,).
    """

    weights: Array
    intercept: Array

    def __call__(self, features: Array) -> Array:
        """(p,) at features (F,), standardised."""
        values: Array = features @ self.weights + self.intercept
        return values

    def jacobian(self, features: Array) -> Array:
        """(p, F)."""
        return self.weights.T


@dataclass(frozen=True, eq=False)
class Kernel:
    """Values as sums of Gaussian bells about the features that were learned from.

    Parameters
    ----------
    centres
        (n, F).
    sharpness
        (p,) γ in exp(−γ d²) of each value.
    weights
        (n, p).
    """

    centres: Array
    sharpness: Array
    weights: Array

    def _bells(self, features: Array) -> Array:
        squared = ((self.centres - features) ** 2).sum(axis=1)
        bells: Array = np.exp(-squared[:, None] * self.sharpness) * self.weights
        return bells

    def __call__(self, features: Array) -> Array:
        """(p,) at features (F,), standardised."""
        values: Array = self._bells(features).sum(axis=0)
        return values

    def jacobian(self, features: Array) -> Array:
        """(p, F)."""
        jacobian: Array = 2 * self.sharpness[:, None] * (self._bells(features).T @ (self.centres - features))
        return jacobian


def lasso(features: Array, values: Array, number: int, seed: int) -> tuple[Array, Array, Array]:
    """Weights (F, q), intercepts (q,) and cross-validated errors (n, q) of LASSO for values (n, q).

    The penalty of each value is the best of a path by cross-validation in `number` folds, whose errors these are.
    """
    fold, middle = folds(same_shapes(features), number, seed), features.mean(axis=0)
    found = []
    for column in values.T:
        penalties = PENALTIES * np.abs((features - middle).T @ column).max() / len(column)
        errors = np.zeros((len(column), len(penalties)))
        for k in np.unique(fold):
            out = fold == k
            path, intercepts = lasso_path(features[~out], column[~out], penalties)
            errors[out] = column[out, None] - features[out] @ path - intercepts
        best = int((errors**2).mean(axis=0).argmin())
        path, intercepts = lasso_path(features, column, penalties[: best + 1])
        found.append((path[:, -1], intercepts[-1], errors[:, best]))
    weights, intercept, errors = (np.stack(parts, axis=-1) for parts in zip(*found, strict=True))
    return weights, intercept, errors


def lasso_path(features: Array, values: Array, penalties: Array) -> tuple[Array, Array]:
    """Weights (F, r) and intercepts (r,) at falling penalties (r,).

    By least angle regression (Efron et al. 2004): the path is a straight line between the penalties at which a feature
    comes or goes, found one after the other. Coordinate descent needs thousands of sweeps on features as alike as
    these; from where a path is near (of twins rounding may take the wrong one, by the processor) it needs few.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import enet_path, lars_path_gram

    middle, mean = features.mean(axis=0), values.mean()
    centred = features - middle
    with _ALONE, warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a path that ends early goes on as it ends
        reached, gram = centred.T @ (values - mean), centred.T @ centred
        knots, _, weights = lars_path_gram(
            reached,
            gram,
            n_samples=len(values),
            method="lasso",
            alpha_min=penalties[-1],
            max_iter=KNOTS * len(middle),
        )
        path = np.array([np.interp(penalties, knots[::-1], row[::-1]) for row in weights])
        path[np.abs(path) <= ROUNDING * np.abs(path).max(initial=0.0)] = 0.0
        for k, penalty in enumerate(penalties):
            pull = (reached - gram @ path[:, k]) / len(values)
            if np.abs(pull).max() > penalty * (1 + OPTIMAL):
                _, found, _ = enet_path(
                    centred, values - mean, l1_ratio=1.0, alphas=[penalty], precompute=gram, Xy=reached,
                    coef_init=path[:, k], tol=1e-14, max_iter=SWEEPS,
                )  # fmt: skip
                path[:, k] = found[:, 0]
    return path, mean - middle @ path


def kernel_ridge(features: Array, values: Array) -> tuple[Array, Array, Array]:
    """Sharpness (q,), weights (n, q) and leave-one-out errors (n, q) of kernel ridge regression for values (n, q).

    Width and ridge of each value are those with the least errors. Leaving out row i leaves an error of w_i / H_ii with
    H = (K + λ)⁻¹, without a fit of its own; leaving out all rows I of one shape, H_II⁻¹ w_I.
    """
    from sklearn.kernel_ridge import KernelRidge
    from sklearn.metrics.pairwise import euclidean_distances, rbf_kernel

    squared = euclidean_distances(features, squared=True)
    apart = squared[np.triu_indices(len(values), 1)]
    typical = float(np.median(apart[apart > 1e-9 * apart.max()]))  # the same mesh may be there more than once
    together = [rows for rows in _groups(same_shapes(features)) if len(rows) > 1]
    least, sharpness, ridge = np.full(values.shape[1], np.inf), *np.ones((2, values.shape[1]))
    errors = np.zeros(values.shape)
    for width in WIDTHS:
        gamma = 1 / (2 * width**2 * typical)
        sizes, ways = np.linalg.eigh(rbf_kernel(features, gamma=gamma))
        turned = ways.T @ values
        for penalty in RIDGES:
            inverse = 1 / (np.maximum(sizes, 0) + penalty)
            told = ways @ (inverse[:, None] * turned)
            left = told / (ways**2 @ inverse)[:, None]
            for rows in together:
                left[rows] = np.linalg.solve((ways[rows] * inverse) @ ways[rows].T, told[rows])
            score = (left**2).mean(axis=0)
            better = score < least
            least[better], sharpness[better], ridge[better] = score[better], gamma, penalty
            errors[:, better] = left[:, better]
    models = [KernelRidge(alpha=r, kernel="rbf", gamma=g) for g, r in zip(sharpness, ridge, strict=True)]
    fitted = [model.fit(features, column).dual_coef_ for model, column in zip(models, values.T, strict=True)]
    return sharpness, np.stack(fitted, axis=-1), errors


def _groups(number: Array) -> list[Array]:
    """The rows of each group, by the numbers (n,) of their groups."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
