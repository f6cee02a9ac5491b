"""What a solver is given of models, measures and safety: values of alpha with their gradients, normalised.

Alpha here is that of the exemplars that take part, (n,) of the bank's N.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lampopt.chain import Chain
from lampopt.errors import PluginError
from lampopt.protocols import Measure, Model, Symbolic
from lampopt.types import Array, Expressible, Term, rough

Whole = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Row:
    """row·alpha, of a column that is not asked to have a value."""

    name: str
    row: Array

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient."""
        return float(self.row @ alpha), self.row

    def symbolic(self, alpha: Any) -> Any:
        """As an expression."""
        return _dot(self.row, alpha)


@dataclass(frozen=True, eq=False)
class Distance:
    """‖alpha − centre‖²."""

    name: str
    centre: Array

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient."""
        apart = alpha - self.centre
        return float(apart @ apart), 2 * apart

    def symbolic(self, alpha: Any) -> Any:
        """As an expression."""
        apart = alpha - self.centre
        return _dot(apart, apart)


@dataclass(frozen=True, eq=False)
class ModelValue:
    """One of a model's values at the parameters (n, inputs)ᵀ·alpha, in its own unit."""

    name: str
    model: Model
    place: int
    parameters: Array

    def __call__(self, alpha: Array) -> tuple[float, Array]:
        """Value and gradient."""
        at = (alpha @ self.parameters)[None]
        by = np.asarray(self.model.gradient(at), float)
        if by.shape != (wanted := (1, len(self.model.names), len(self.model.inputs))):
            raise PluginError(f"model {self.name!r}: gradient: expected shape {wanted}, got {by.shape}")
        return float(np.asarray(self.model(at))[0, self.place]), self.parameters @ by[0, self.place]


@dataclass(frozen=True, eq=False)
class SymbolicValue(ModelValue):
    """As `ModelValue`, of a model that exists as an expression."""

    def symbolic(self, alpha: Any) -> Any:
        """As an expression."""
        assert isinstance(self.model, Symbolic)
        return self.model.symbolic(_product(self.parameters.T, alpha))[self.place]


def model_value(name: str, model: Model, place: int, parameters: Array) -> Term:
    """The term of one of a model's values, exact where the model is."""
    cls = SymbolicValue if isinstance(model, Symbolic) else ModelValue
    return cls(name, model, place, parameters)


@dataclass(frozen=True, eq=False)
class MeasuredValue:
    """One of a measure's values on the mesh of alpha, in its own unit; NaN where there is none.

    Parameters
    ----------
    whole
        alpha (n,) → (N,) of all exemplars.
    active
        (n,) the numbers of those that take part.
    """

    name: str
    called: str
    measure: Measure
    place: int
    chain: Chain
    whole: Whole
    active: Array
    rough = True

    def __call__(self, alpha: Array) -> tuple[float, Array | None]:
        """Value and gradient; None where the measure or the decoder has no derivatives."""
        full = self.whole(alpha)
        value = float(self.chain.values(self.called, self.measure, full)[self.place])
        if not self.chain.differentiable(self.measure):
            return value, None
        return value, self.chain.gradient(self.called, self.measure, self.place, full)[self.active]


@dataclass(frozen=True, eq=False)
class Shaped:
    """weight·(factor·(term − offset))^power, with power 1 or 2; people are told `tell` of the term's values [unit]."""

    name: str
    term: Term
    offset: float
    factor: float
    power: int = 1
    weight: float = 1.0
    unit: str = ""
    tell: Callable[[float], float] = float

    def limits(self, amount: float) -> tuple[float, float]:
        """What is told of the limit, and of the one that gives way by `amount`."""
        return self.tell(self.offset), self.tell(self.offset + amount / self.factor)

    @property
    def rough(self) -> bool:
        """As the term's."""
        return rough(self.term)

    @property
    def target(self) -> bool:
        """Whether it is a target that should be 0, squared."""
        return self.power == 2

    def __call__(self, alpha: Array) -> tuple[float, Array | None]:
        """Value and gradient."""
        value, gradient = self.term(alpha)
        off = self.factor * (value - self.offset)
        slope = self.weight * self.factor * (2 * off if self.power == 2 else 1.0)
        return self.weight * off**self.power, None if gradient is None else slope * gradient


@dataclass(frozen=True, eq=False)
class SymbolicShaped(Shaped):
    """As `Shaped`, of a term that exists as an expression."""

    def symbolic(self, alpha: Any) -> Any:
        """As an expression."""
        assert isinstance(self.term, Expressible)
        symbolic = self.term.symbolic
        return self.weight * (self.factor * (symbolic(alpha) - self.offset)) ** self.power


def shaped(
    name: str,
    term: Term,
    *,
    offset: float,
    factor: float,
    power: int = 1,
    weight: float = 1.0,
    unit: str = "",
    tell: Callable[[float], float] = float,
) -> Term:
    """`Shaped`, as an expression too where `term` is one."""
    cls = SymbolicShaped if isinstance(term, Expressible) else Shaped
    return cls(name, term, offset, factor, power, weight, unit, tell)


@dataclass(eq=False)
class Remembered:
    """A term that is asked for the same alpha only once; every evaluation is told to `tell`."""

    term: Term
    name: str
    known: dict[bytes, tuple[float, Array | None]] = field(default_factory=dict)
    tell: Callable[[str, Array, float, Array | None], None] = lambda name, alpha, value, gradient: None

    @property
    def rough(self) -> bool:
        """As the term's."""
        return rough(self.term)

    def __call__(self, alpha: Array) -> tuple[float, Array | None]:
        """Value and gradient."""
        key = np.asarray(alpha, float).tobytes()
        if key not in self.known:
            value, gradient = self.term(alpha)
            self.known[key] = value, gradient
            self.tell(self.name, alpha, value, gradient)
        return self.known[key]


def _dot(one: Any, other: Any) -> Any:
    """The dot product where one of both is a CasADi expression (n, 1), and the other may be an array (n,)."""
    return one.T @ other if not isinstance(one, np.ndarray) else other.T @ one


def _product(matrix: Array, alpha: Any) -> Any:
    """matrix (m, n) times a CasADi expression (n, 1)."""
    return (alpha.T @ matrix.T).T
