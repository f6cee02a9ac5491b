"""The answer: a design, the evidence about it, both together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, nextafter
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from lampopt.errors import InputError
from lampopt.types.arrays import Array, Table, assign, frozen_array
from lampopt.types.bank import Scalar
from lampopt.types.problem import Mix

if TYPE_CHECKING:
    from trimesh import Trimesh

Sense = Literal["<=", ">=", "=", "info"]
Needs = Literal["alpha", "field", "mesh"]
LEVELS: tuple[Needs, ...] = ("alpha", "field", "mesh")


@dataclass(frozen=True, eq=False)
class Design:
    """The answer, unchecked.

    Parameters
    ----------
    target
        What was asked, by name [the parameter's unit].
    mix
        The coefficients.
    predicted
        (d,) = Pᵀalpha [units of the bank's space].
    weights
        (D,) mixed weights.
    make_mesh
        Decodes [user's unit]; returns None where the field has no surface.
    """

    target: Mapping[str, float]
    mix: Mix
    predicted: Array
    weights: Array
    make_mesh: Callable[[], Trimesh | None] = field(repr=False)

    def __post_init__(self) -> None:
        assign(
            self,
            target=Table(self.target),
            predicted=frozen_array(self.predicted, "predicted", (None,)),
            weights=frozen_array(self.weights, "weights", (None,), np.float32),
        )

    @cached_property
    def mesh(self) -> Trimesh | None:
        """The mesh [user's unit], made on first access; None if the field is empty."""
        return self.make_mesh()


@dataclass(frozen=True)
class Check:
    """One line of evidence about a design.

    `passed` says whether `value` keeps to `limit` in the `sense` given; a NaN never passes. `needs` is what had to
    be there to judge: alpha, field or mesh. `retry` says that it could not be told for a reason that may pass (a solver
    that was killed): a design with such a check is not recorded, so that the same study asks again.
    """

    name: str
    value: float
    sense: Sense
    limit: float | None
    unit: str
    needs: Needs
    note: str = ""
    retry: bool = False

    def __post_init__(self) -> None:
        for text in ("name", "unit", "note"):
            if not isinstance(found := getattr(self, text), str):
                raise InputError(f"check {self.name!r:.80}: expected text as {text}, got {found!r:.80}")
        if self.needs not in LEVELS:
            raise InputError(
                f"check {self.name!r}: expected needs as one of {', '.join(LEVELS)}, got {self.needs!r:.80}"
            )
        assign(self, value=_number(self.value, self.name, "value"))
        if self.limit is not None:
            assign(self, limit=_number(self.limit, self.name, "limit"))
        if self.sense not in ("<=", ">=", "=", "info"):
            raise InputError(f"check {self.name!r}: expected sense <=, >=, = or info, got {self.sense!r}")
        if (self.limit is None) != (self.sense == "info"):
            raise InputError(f"check {self.name!r}: a limit belongs to every sense but info, got {self.limit}")

    @property
    def passed(self) -> bool:
        """Whether the evidence speaks for the design."""
        if self.limit is None:
            return True
        if self.sense == "<=":
            return self.value <= self.limit
        return self.value >= self.limit if self.sense == ">=" else self.value == self.limit

    @property
    def score(self) -> float:
        """Value over limit, so that at most 1 passes and more is worse: 0 where nothing is judged, infinite past help.

        For ``>=`` it is limit over value. A limit that no ratio can be taken of (``=``, or not positive) gives 0 or ∞.
        """
        if self.limit is None:
            return 0.0
        if self.sense == "=" or self.limit <= 0 or not 0 < self.value < inf:
            return 0.0 if self.passed else inf
        ratio = self.value / self.limit if self.sense == "<=" else self.limit / self.value
        return min(ratio, 1.0) if self.passed else max(ratio, nextafter(1.0, 2.0))


def _number(value: object, name: str, what: str) -> float:
    """`value`, one of numpy's perhaps, as a plain float."""
    if not isinstance(value, (Real, np.bool_)):
        raise InputError(f"check {name!r}: expected a number as {what}, got {value!r:.80}")
    try:
        return float(value)
    except OverflowError as error:  # a whole number beyond any float
        raise InputError(f"check {name!r}: expected a number as {what}, got one beyond any float") from error


@dataclass(frozen=True, eq=False)
class Result:
    """The answer, checked. Rejected designs are results too. `folder` is where it was recorded, if it was."""

    design: Design
    checks: tuple[Check, ...]
    provenance: Mapping[str, Scalar] = field(default_factory=dict)
    folder: Path | None = None

    @property
    def accepted(self) -> bool:
        """True when every check passed."""
        return all(check.passed for check in self.checks)

    @property
    def score(self) -> float:
        """The worst check's value over its limit: at most 1 where accepted, and the larger the less to be trusted."""
        return max((check.score for check in self.checks), default=0.0)

    def check(self, name: str) -> Check:
        """The check called `name`; InputError if there is none."""
        for check in self.checks:
            if check.name == name:
                return check
        raise InputError(f"check {name!r}: not made; there are {[c.name for c in self.checks]}")
