"""What a model is learned from: checked, named, and brought to one scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lampopt.errors import InputError
from lampopt.metrics import twins
from lampopt.types import Array, frozen_array

from .curve import check_arrays, check_range

FEWEST = 3  # rows with a label: fewer leave nothing to check a model by
LARGEST = 1e100  # a value whose square is a number
TWINS = 1e-6  # deviations: what tables and single precision lose of a parameter
FARTHEST = 1e30  # deviations: no use beyond, and squares and products of so many are numbers


@dataclass(frozen=True, eq=False)
class Given:
    """Exemplars as a regression sees them.

    Parameters
    ----------
    parameters
        (n, d), finite.
    labels
        (n, p); NaN = not labelled.
    inputs
        The d parameters' names.
    names, units
        The p labels' names and units.

    Raises
    ------
    InputError
        If a shape, a name or a value is wrong, or a label is known for fewer than three rows.
    """

    parameters: Array
    labels: Array
    inputs: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]

    def __post_init__(self) -> None:
        for what in ("inputs", "names", "units"):
            object.__setattr__(self, what, texts(getattr(self, what), what, distinct=what != "units"))
        if len(self.units) != len(self.names):
            raise InputError(f"units: expected one for each of {', '.join(self.names)}, got {self.units!r}")
        parameters = frozen_array(self.parameters, "parameters", (None, len(self.inputs)))
        labels = frozen_array(self.labels, "labels", (len(parameters), len(self.names)), nan=True)
        for what, names, values in (("parameter", self.inputs, parameters), ("label", self.names, labels)):
            for name, column in zip(names, values.T, strict=True):
                largest = np.nanmax(np.abs(column), initial=0.0)
                if largest > LARGEST or 0 < largest < 1 / LARGEST:
                    raise InputError(
                        f"{what} {name!r}: expected the largest value from {1 / LARGEST:g} to {LARGEST:g}, got "
                        f"{largest:g}: choose another unit"
                    )
        for name, count in zip(self.names, (~np.isnan(labels)).sum(axis=0), strict=True):
            if count < FEWEST:
                raise InputError(f"label {name!r}: expected at least {FEWEST} rows that have it, got {count}")
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "labels", labels)


def texts(value: Sequence[str], what: str, *, distinct: bool) -> tuple[str, ...]:
    """`value` as a tuple of texts. Raises InputError if it is none, or one that has to be distinct comes twice."""
    if isinstance(value, str) or not all(isinstance(text, str) and text.isprintable() for text in value):
        raise InputError(f"{what}: expected a sequence of printable texts, got {value!r:.200}")
    if distinct and (not value or not all(value) or len(set(value)) < len(value)):
        raise InputError(f"{what}: expected distinct names, at least one, got {tuple(value)!r:.200}")
    return tuple(value)


@dataclass(frozen=True, eq=False)
class Scale:
    """Brings parameters to mean 0 and deviation 1; one that has no spread to 0, wherever it is asked for.

    Parameters
    ----------
    centre
        (d,) means.
    rate
        (d,) 1 / deviation; 0 where there is no spread, so that no model can depend on it.
    """

    centre: Array
    rate: Array

    def __post_init__(self) -> None:
        check_arrays(self, centre=(None,))
        check_arrays(self, rate=(len(self.centre),))
        check_range("centre", self.centre, -LARGEST, LARGEST)
        check_range("rate", self.rate, 0.0, np.inf)

    @classmethod
    def of(cls, parameters: Array) -> Scale:
        """The scale of parameters (n, d)."""
        centre, deviation = parameters.mean(axis=0), parameters.std(axis=0)
        spread = np.ptp(parameters, axis=0) > 1e-12 * np.abs(parameters).max(axis=0)
        rate = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=spread & (deviation > 0))
        return cls(centre, rate)

    def __call__(self, parameters: Array) -> Array:
        """Parameters (B, d), scaled."""
        scaled: Array = (parameters - self.centre) * self.rate
        return scaled


def folds_of(parameters: Array, folds: int, seed: int) -> Array:
    """Which of `folds` parts each row (n,) belongs to; twins share one, so that none tells of the other.

    Parameters (n, d) come scaled: twins differ by no more than tables round. Fewer parts than `folds` where there are
    not as many different rows.
    """
    group = twins(parameters, TWINS)
    count = int(group.max()) + 1
    order = np.random.default_rng(seed).permutation(count)
    parts: Array = (order % min(folds, count))[group]
    return parts
