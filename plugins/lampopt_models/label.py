"""One label that was learned: its curve, how sure it is, and where the rows lie that it was learned from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.metrics import conformal_quantile
from lampopt.types import Array

from .curve import Curve, SymbolicCurve, check_arrays, check_range
from .given import Scale
from .polynomial import Polynomial
from .process import Process
from .reach import Reach
from .trees import Trees

CURVES: Mapping[str, type] = {cls.kind: cls for cls in (Polynomial, Process, Trees)}


@dataclass(frozen=True, eq=False)
class Label:
    """What was learned of one label, from the rows that have it.

    Parameters
    ----------
    scale
        What brings their d parameters to one scale.
    curve
        The label by scaled parameters.
    misses
        (n,) by how many of the curve's deviations each row is missed when it is left out.
    reach
        Where they lie.

    Raises
    ------
    InputError
        If these do not belong together.
    """

    scale: Scale
    curve: Curve
    misses: Array
    reach: Reach

    def __post_init__(self) -> None:
        check_arrays(self, misses=(None,))
        check_range("misses", self.misses, 0.0, np.inf)
        self.curve.check_inputs(len(self.scale.centre))
        if len(self.reach.low) != len(self.scale.centre):
            raise InputError(f"reach: expected {len(self.scale.centre)} parameters, got {len(self.reach.low)}")

    def __call__(self, parameters: Array) -> Array:
        """Values (B,) at parameters (B, d)."""
        return self.curve(self.scale(parameters))

    def gradient(self, parameters: Array) -> Array:
        """Derivatives (B, d) at parameters (B, d)."""
        slopes: Array = self.curve.gradient(self.scale(parameters)) * self.scale.rate
        return slopes

    def half_width(self, parameters: Array, level: float) -> Array:
        """(B,) by how much a new value differs at most, with probability `level`; infinite where rows are too few."""
        quantile = conformal_quantile(self.misses, level)
        if np.isinf(quantile):
            return np.full(len(parameters), np.inf)
        width: Array = quantile * self.curve.deviation(self.scale(parameters))
        return width

    def outside(self, parameters: Array) -> Array:
        """(B,) whether parameters (B, d) lie beyond the rows that it was learned from."""
        return self.reach.outside(parameters, self.scale(parameters))

    def symbolic(self, parameters: Any) -> Any:
        """The value as a CasADi expression of `parameters` (d,). Raises TypeError where there is none."""
        import casadi

        if not isinstance(self.curve, SymbolicCurve):
            raise TypeError(f"{self.curve.kind}: has no CasADi expression")
        return self.curve.symbolic((casadi.vec(parameters) - casadi.DM(self.scale.centre)) * casadi.DM(self.scale.rate))

    def state(self) -> dict[str, Array]:
        """Its arrays, by names with a dot."""
        return {
            "scale.centre": self.scale.centre,
            "scale.rate": self.scale.rate,
            "misses": self.misses,
            **{f"curve.{name}": array for name, array in self.curve.state().items()},
            **{f"reach.{name}": array for name, array in self.reach.state().items()},
        }

    @classmethod
    def from_state(cls, kind: str, state: Mapping[str, Array]) -> Label:
        """The label again, whose curve is of this `kind`. Raises KeyError, TypeError or InputError if it is none."""
        scale, curve, reach = (part_of(state, what) for what in ("scale", "curve", "reach"))
        return cls(Scale(**scale), CURVES[kind](**curve), state["misses"], Reach(**reach))


def part_of(state: Mapping[str, Array], what: str) -> dict[str, Array]:
    """The arrays whose names begin with `what` and a dot, by the rest of their names."""
    return {name.removeprefix(f"{what}."): array for name, array in state.items() if name.startswith(f"{what}.")}
