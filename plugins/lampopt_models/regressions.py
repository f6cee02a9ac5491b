"""The ways to learn a model, and the choice among them by evidence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .curve import Curve
from .given import Given, Scale, folds_of
from .label import Label
from .model import Evidence, LearnedModel, assembled
from .polynomial import SHARES, Polynomial, constant, polynomial
from .process import MOST_ROWS, Process, process, sample
from .reach import Reach
from .trees import MOST_LEAVES, Trees, boosted

NEGLIGIBLE = 1e-6  # of a label's variance: what differs by less is as good
MOST_TREES = 100_000  # beyond lies a slip
MOST_FOLDS = 10_000


@dataclass(frozen=True)
class _Regression(ABC):
    """What all of them share; a subclass says how the curve of one label is learned."""

    folds: int = 10

    name: ClassVar[str]

    def __post_init__(self) -> None:
        _at_least(self.folds, 2, "folds", MOST_FOLDS)

    def fit(
        self,
        parameters: Array,
        labels: Array,
        *,
        inputs: Sequence[str],
        names: Sequence[str],
        units: Sequence[str],
        seed: int,
    ) -> LearnedModel:
        """A model of labels (n, p), called `names` in `units`, by parameters (n, d), called `inputs`.

        A NaN is a label that is not known: its row does not count for it.

        Raises
        ------
        InputError
            If a shape, name or value is wrong, fewer than three rows have a label, or no parameter of them differs.
        """
        return _learned((self,), Given(parameters, labels, tuple(inputs), tuple(names), tuple(units)), self.folds, seed)

    @abstractmethod
    def learn(self, z: Array, y: Array, seed: int) -> Curve:
        """The curve through values y (n,), which are not all equal, at scaled parameters z (n, d)."""

    def held_out(self, curve: Curve, z: Array, y: Array, part: Array, seed: int) -> tuple[Array, Array]:
        """Values and deviations (n,) of each row by what is learned, all anew, from those of other parts (n,)."""
        values, deviations = np.empty_like(y), np.ones_like(y)
        for k in range(int(part.max()) + 1):
            out = part == k
            if np.ptp(y[~out]) == 0:
                values[out] = y[~out][0]
            else:
                learned = self.learn(z[~out], y[~out], seed)
                values[out], deviations[out] = learned(z[out]), learned.deviation(z[out])
        return values, deviations


@dataclass(frozen=True)
class Linear(_Regression):
    """A plane: ridge regression, its penalty chosen by leaving each row out.

    Parameters
    ----------
    folds
        Parts of the cross-validation that intervals and evidence come from.
    """

    name = "linear"

    def learn(self, z: Array, y: Array, seed: int) -> Polynomial:
        """The plane through y (n,) at z (n, d)."""
        return polynomial(z, y, ())


@dataclass(frozen=True)
class Quadratic(_Regression):
    """All squares and products of up to 40 parameters, of more the squares alone: ridge regression as in `Linear`.

    How much less freely second-order terms move than linear ones is chosen together with the penalty.

    Parameters
    ----------
    folds
        Parts of the cross-validation that intervals and evidence come from.
    """

    name = "quadratic"

    def learn(self, z: Array, y: Array, seed: int) -> Polynomial:
        """The polynomial through y (n,) at z (n, d)."""
        return polynomial(z, y, SHARES)


@dataclass(frozen=True)
class GaussianProcess(_Regression):
    """A plane and, over it, a smooth function with a length of its own along each parameter, under noise.

    Parameters
    ----------
    folds
        Parts of the cross-validation that intervals and evidence come from.
    search
        Rows that lengths and noise are sought with; of more, so many are drawn. Time grows with their cube.
    most
        Rows that the process is given, up to 5,000; of more, so many are drawn.
    anew
        Rows with the label up to which each part of the cross-validation seeks lengths and noise without its rows. Of
        more, all parts have those of all rows, which saves most of the time and flatters a little.
    """

    search: int = 1000
    most: int = 3000
    anew: int = 300

    name = "gaussian-process"

    @classmethod
    def example(cls) -> GaussianProcess:
        """One that is quick to check."""
        return cls(folds=4, search=40)

    def __post_init__(self) -> None:
        super().__post_init__()
        _at_least(self.search, 10, "search", MOST_ROWS)
        _at_least(self.most, 10, "most", MOST_ROWS)
        _at_least(self.anew, 0, "anew")

    def learn(self, z: Array, y: Array, seed: int) -> Process:
        """The process through y (n,) at z (n, d)."""
        return process(z, y, sample(len(y), self.most, seed), self.search, seed)

    def held_out(self, curve: Curve, z: Array, y: Array, part: Array, seed: int) -> tuple[Array, Array]:
        """Values and deviations (n,) of each row by those of other parts (n,)."""
        if len(y) <= self.anew:
            return super().held_out(curve, z, y, part, seed)
        assert isinstance(curve, Process)
        given = sample(len(y), self.most, seed)
        values, deviations = curve(z), curve.deviation(z)
        values[given], deviations[given] = curve.held_out(y[given], part[given])
        return values, deviations


@dataclass(frozen=True)
class BoostedTrees(_Regression):
    """Gradient-boosted regression trees (scikit-learn): steps and thresholds, no smoothness, no slope.

    Parameters
    ----------
    folds
        Parts of the cross-validation that intervals and evidence come from.
    trees
        How many.
    rate
        Share of what is left that each one takes, above 0 and up to 1.
    leaves
        Most of a tree.
    """

    trees: int = 400
    rate: float = 0.05
    leaves: int = 8

    name = "boosted-trees"

    @classmethod
    def example(cls) -> BoostedTrees:
        """One that is quick to check."""
        return cls(folds=3, trees=60, rate=0.2)

    def __post_init__(self) -> None:
        super().__post_init__()
        _at_least(self.trees, 1, "trees", MOST_TREES)
        _at_least(self.leaves, 2, "leaves", MOST_LEAVES)
        if not 0 < self.rate <= 1:
            raise InputError(f"rate: expected a number above 0 and up to 1, got {self.rate!r}")

    def learn(self, z: Array, y: Array, seed: int) -> Trees:
        """The trees through y (n,) at z (n, d)."""
        return boosted(z, y, self.trees, self.rate, self.leaves, seed)


SIMPLEST_FIRST: Mapping[str, type[_Regression]] = {
    cls.name: cls for cls in (Linear, Quadratic, GaussianProcess, BoostedTrees)
}


@dataclass(frozen=True)
class Best:
    """For each label the simplest regression that is as good as the best, in cross-validation.

    As good: what it misses by more than the best, averaged over the parts, is within one standard error of that
    difference (the one-standard-error rule of Breiman et al., 1984, part by part). The evidence stays with the model.

    Parameters
    ----------
    folds
        Parts of the cross-validation.
    among
        Names of the regressions to choose from, with blanks between; without "boosted-trees" the model is sure to
        have a gradient and a CasADi expression.
    """

    folds: int = 10
    among: str = " ".join(SIMPLEST_FIRST)

    def __post_init__(self) -> None:
        _at_least(self.folds, 2, "folds", MOST_FOLDS)
        if not self.among.split() or not set(self.among.split()) <= set(SIMPLEST_FIRST):
            raise InputError(f"among: expected names out of {', '.join(SIMPLEST_FIRST)}, got {self.among!r}")

    @classmethod
    def example(cls) -> Best:
        """One that is quick to check."""
        return cls(folds=4, among="linear quadratic gaussian-process")

    def fit(
        self,
        parameters: Array,
        labels: Array,
        *,
        inputs: Sequence[str],
        names: Sequence[str],
        units: Sequence[str],
        seed: int,
    ) -> LearnedModel:
        """As `Linear.fit`, by the regression chosen for each label."""
        tried = [cls(folds=self.folds) for name, cls in SIMPLEST_FIRST.items() if name in self.among.split()]
        return _learned(tried, Given(parameters, labels, tuple(inputs), tuple(names), tuple(units)), self.folds, seed)


@dataclass(frozen=True, eq=False)
class _Trial:
    """One regression on one label: its curve, by how many deviations it misses rows left out, and its R² by part."""

    curve: Curve
    misses: Array
    r2: Array


def _learned(tried: Sequence[_Regression], given: Given, folds: int, seed: int) -> LearnedModel:
    labels: list[Label] = []
    r2, error = np.full((2, len(given.names), len(tried)), np.nan)
    chosen = np.zeros(len(given.names), np.int64)
    for k, (name, column) in enumerate(zip(given.names, given.labels.T, strict=True)):
        known = ~np.isnan(column)
        parameters, y = given.parameters[known], column[known]
        scale = Scale.of(parameters)
        z = scale(parameters)
        if np.ptp(y) <= 1e-14 * np.abs(y).max():
            curve, misses = constant(float(y[0]), z.shape[1]), np.zeros(len(y))
        else:
            trials = _trials(tried, z, y, folds, seed, name)
            scores = np.array([trial.r2 for trial in trials])
            r2[k], error[k] = scores.mean(axis=1), scores.std(axis=1, ddof=1) / np.sqrt(scores.shape[1])
            chosen[k] = as_good_as_the_best(scores)
            curve, misses = trials[chosen[k]].curve, trials[chosen[k]].misses
        labels.append(Label(scale, curve, misses, Reach.of(parameters, z)))
    evidence = Evidence(tuple(one.name for one in tried), r2, error, chosen)
    return assembled(given.names, given.units, given.inputs, labels, evidence)


def _trials(tried: Sequence[_Regression], z: Array, y: Array, folds: int, seed: int, label: str) -> list[_Trial]:
    part = folds_of(z, folds, seed)
    if part.max() == 0:
        raise InputError(f"label {label!r}: expected rows whose parameters differ, got one set of them {len(y)} times")
    trials = []
    for one in tried:
        curve = one.learn(z, y, seed)
        values, deviations = one.held_out(curve, z, y, part, seed)
        square = (y - values) ** 2 / y.var()
        counts = np.bincount(part)
        by_part = np.bincount(part, square) * (len(counts) / len(y))  # so that their mean is that over all rows
        trials.append(_Trial(curve, np.sort(np.abs(y - values) / deviations), 1 - by_part))
    return trials


def as_good_as_the_best(scores: Array) -> int:
    """Which regression to take by its R² in each part (c, parts), the simplest first."""
    best = scores[scores.mean(axis=1).argmax()]
    behind = best - scores
    doubt = behind.std(axis=1, ddof=1) / np.sqrt(scores.shape[1])
    return int(np.argmax(behind.mean(axis=1) <= np.maximum(doubt, NEGLIGIBLE)))


def _at_least(value: int, least: int, what: str, most: int | None = None) -> None:
    if value < least:
        raise InputError(f"{what}: expected at least {least}, got {value!r}")
    if most is not None and value > most:
        raise InputError(f"{what}: expected at most {most}, got {value!r}")
