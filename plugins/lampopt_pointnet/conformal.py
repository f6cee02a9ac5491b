"""How far to trust what was learned: where learning ended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lampopt.metrics import conformal_quantile, twins
from lampopt.types import Array

ALARMS = 0.03  # share of shapes such as those learned from that may be taken for outside
MOST = 50  # principal directions that distance is taken in
FOLDS = 5
TWINS = 1e-5  # standard deviations that features of one shape differ by at most
TINY = 1e-12  # least singular value, where a fold leaves meshes that hardly differ


def same_shapes(features: Array) -> Array:
    """(n,) the number of the shape of each row of standardised features (n, F): a mesh may be given more than once."""
    return twins(features, TWINS)


def folds(group: Array, number: int, seed: int) -> Array:
    """(n,) the fold of each row, all of nearly one size; rows of one group share one: none tells of the other."""
    count = int(group.max()) + 1
    parts: Array = (np.random.default_rng(seed).permutation(count) % min(number, count))[group]
    return parts


@dataclass(frozen=True, eq=False)
class Region:
    """The region that was learned from: a distance along its principal directions, and one off them.

    Parameters
    ----------
    middle, directions
        (F,) and (F, k): mean features, and principal directions scaled so that coordinates have variance 1.
    off
        Root mean square distance from the space of the directions.
    limit
        Distance beyond which a shape is outside.
    """

    middle: Array
    directions: Array
    off: Array
    limit: Array

    @classmethod
    def of(cls, features: Array, seed: int) -> Region:
        """The region of standardised features (n, F), its limit from distances found by cross-validation."""
        fold = folds(same_shapes(features), FOLDS, seed)
        # as many directions in every fold as in the end: distances of one kind
        most = min(MOST, max(1, (len(features) - int(np.bincount(fold).max())) // 8))
        distances = np.zeros(len(features))
        for k in np.unique(fold):
            distances[fold == k] = cls._about(features[fold != k], most).distance(features[fold == k])
        about = cls._about(features, most)
        limit = min(conformal_quantile(distances, 1 - ALARMS), float(distances.max()))  # infinite where n < 33
        return cls(about.middle, about.directions, about.off, np.array(limit))

    @classmethod
    def _about(cls, features: Array, most: int) -> Region:
        middle = features.mean(axis=0)
        _, size, ways = np.linalg.svd(features - middle, full_matrices=False)
        size = np.maximum(size, TINY)
        kept = min(most, int((size > 1e-9 * size[0]).sum()))
        rest = np.sqrt((size[kept:] ** 2).sum() / len(features))
        directions = ways[:kept].T / size[:kept] * np.sqrt(len(features))
        return cls(middle, directions, np.array(max(float(rest), 1e-9 * size[0])), np.array(np.inf))

    def distance(self, features: Array) -> Array:
        """(n,) of features (n, F): Mahalanobis, what lies off the directions counted as one more of them."""
        apart = features - self.middle
        along = apart @ self.directions
        size = 1 / (self.directions**2).sum(axis=0)  # variances, for the directions are orthogonal
        squared = (apart**2).sum(axis=1) - (along**2 * size).sum(axis=1)
        found: Array = np.sqrt((along**2).sum(axis=1) + np.maximum(squared, 0) / self.off**2)
        return found

    def outside(self, features: Array) -> bool:
        """Whether features (F,) lie beyond the limit."""
        return bool(self.distance(features[None])[0] > self.limit)
