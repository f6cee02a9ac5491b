"""What a study can wish for besides targets and ranges: less of something, as little as can be, a sum within limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite, isinf
from numbers import Real
from types import MappingProxyType
from typing import Any

from lampopt.errors import StudyError
from lampopt.units import said


@dataclass(frozen=True)
class Reduce:
    """A part of the reference's value: ``Reduce("drag", by=0.10)`` asks for 0.9 of it, of a negative one too."""

    name: str
    by: float

    def __post_init__(self) -> None:
        _expect_name("Reduce", self.name)
        by = _number(self.by)
        if by is None or not -10 < by < 1:
            raise StudyError(
                f"Reduce({self.name!r}): expected `by` as a fraction below 1, such as 0.10, got {said(self.by)}"
            )
        object.__setattr__(self, "by", by)

    @property
    def maximised(self) -> bool:
        """Whether more is better."""
        return self.by < 0

    def of(self, value: float) -> float:
        """What is asked for where the reference has `value`: nearer to 0 by a part of it, from below as from above."""
        return (1 - self.by) * value

    def written(self) -> dict[str, Any]:
        """As it stands in TOML."""
        return {"reduce": self.name, "by": self.by}


@dataclass(frozen=True)
class Minimise:
    """As little as can be of a label, a model's or a measure's value, for so much per half of its range."""

    name: str
    weight: float = 1.0
    verb = "minimise"
    sign = 1.0

    def __post_init__(self) -> None:
        _expect_name(type(self).__name__, self.name)
        weight = _number(self.weight)
        if weight is None or not 0 < weight < inf:
            raise StudyError(
                f"{type(self).__name__}({self.name!r}): expected a positive weight, got {said(self.weight)}"
            )
        object.__setattr__(self, "weight", weight)

    @property
    def maximised(self) -> bool:
        """Whether more is better."""
        return self.sign < 0

    def written(self) -> dict[str, Any]:
        """As it stands in TOML."""
        return {self.verb: self.name, **({} if self.weight == 1 else {"weight": self.weight})}


@dataclass(frozen=True)
class Maximise(Minimise):
    """As much as can be, as `Minimise`."""

    verb = "maximise"
    sign = -1.0


Objective = Reduce | Minimise
VERBS = {"minimise": Minimise, "maximise": Maximise}


def objective_of(table: object) -> Objective:
    """The objective of a TOML table. Raises StudyError where it is none."""
    if isinstance(table, Mapping):
        if set(table) == {"reduce", "by"} and isinstance(table["reduce"], str):
            return Reduce(table["reduce"], table["by"])
        for verb, cls in VERBS.items():
            if verb in table and set(table) <= {verb, "weight"}:
                return cls(table[verb], table.get("weight", 1.0))
    raise StudyError(
        "objective: expected { reduce = NAME, by = FRACTION }, { minimise = NAME } or { maximise = NAME }, got "
        f"{said(table)}"
    )


@dataclass(frozen=True)
class Linear:
    """A weighted sum of values kept within limits: ``Linear({"length": 1, "width": -2}, high=0.5)``.

    Parameters
    ----------
    of
        Factors by name, of the values in the bank's units.
    low, high
        The sum's limits; ±inf for none.
    """

    of: Mapping[str, float]
    low: float = -inf
    high: float = inf

    def __post_init__(self) -> None:
        wanted = "expected factors by name, such as {'length': 1, 'width': -2}"
        if not isinstance(self.of, Mapping) or not self.of:
            raise StudyError(f"linear: {wanted}, got {said(self.of)}")
        factors = {name: _number(value) for name, value in self.of.items()}
        for name, value in factors.items():
            if not isinstance(name, str) or value is None or not isfinite(value):
                raise StudyError(f"linear: {wanted}, got {said(self.of[name])} for {said(name)}")
        low, high = _number(self.low), _number(self.high)
        if low is None or high is None or not low <= high or (isinf(low) and isinf(high)) or low == inf or high == -inf:
            raise StudyError(
                f"linear: expected low ≤ high, one of them a number, got {said(self.low)} and {said(self.high)}"
            )
        object.__setattr__(self, "of", MappingProxyType(factors))
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def written(self) -> dict[str, Any]:
        """As it stands in TOML."""
        ends = {"low": self.low, "high": self.high}
        return {"of": dict(self.of), **{name: value for name, value in ends.items() if isfinite(value)}}


def linear_of(table: object, name: str) -> Linear:
    """The weighted sum of a TOML table. Raises StudyError where it is none."""
    if isinstance(table, Linear):
        return table
    if not isinstance(table, Mapping) or not {"of"} <= set(table) <= {"of", "low", "high"}:
        raise StudyError(f"linear: {name}: expected {{ of = {{ NAME = FACTOR }}, low = , high = }}, got {said(table)}")
    return Linear(table["of"], table.get("low", -inf), table.get("high", inf))


def _expect_name(what: str, name: object) -> None:
    if not isinstance(name, str):
        raise StudyError(f"{what}: expected the name of a label, a model's or a measure's value, got {said(name)}")


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, Real) or value != value:
        return None
    try:
        return float(value)
    except OverflowError:  # a whole number beyond any float
        return None
