"""A fitted model: labels by parameters, with intervals, range and evidence; to and from named arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, frozen_array

from .curve import Curve, SymbolicCurve, check_arrays
from .given import Scale, texts
from .polynomial import Polynomial
from .process import Process
from .reach import Reach
from .trees import Trees

CURVES: Mapping[str, type] = {cls.kind: cls for cls in (Polynomial, Process, Trees)}


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well each regression that was tried tells labels of rows that it had not seen.

    Parameters
    ----------
    regressions
        The c names, from the simplest on.
    r2
        (p, c) R² of the rows left out, part by part.
    error
        (p, c) its standard error over the parts.
    chosen
        (p,) which one was taken.
    """

    regressions: tuple[str, ...]
    r2: Array
    error: Array
    chosen: Array

    def __post_init__(self) -> None:
        p, c = len(self.chosen), len(self.regressions)
        check_arrays(self, r2=(p, c), error=(p, c), chosen=(p,))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model that was learned.

    Parameters
    ----------
    names, units
        The p labels.
    inputs
        The d parameters, in order.
    scale
        What brings them to one scale.
    curves
        One a label, of scaled parameters.
    misses
        One (n,) a label: by how many deviations rows left out are missed, the least first.
    reach
        Where the rows lie that it was trained on.
    evidence
        Why these curves.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    inputs: tuple[str, ...]
    scale: Scale
    curves: tuple[Curve, ...]
    misses: tuple[Array, ...]
    reach: Reach
    evidence: Evidence

    def __call__(self, parameters: Array) -> Array:
        """Labels (B, p) at parameters (B, d). Raises InputError where these are not finite, or of another shape."""
        z = self.scale(self._given(parameters))
        return np.stack([curve(z) for curve in self.curves], axis=1)

    def gradient(self, parameters: Array) -> Array:
        """Derivatives (B, p, d) at parameters (B, d), exact; zero by trees, which go in steps. Raises InputError."""
        z = self.scale(self._given(parameters))
        return np.stack([curve.gradient(z) for curve in self.curves], axis=1) * self.scale.rate

    def interval(self, parameters: Array, level: float) -> Array:
        """Low and high (B, p, 2) that hold a new label with probability `level`, within what it was trained on.

        Split conformal prediction with the misses of cross-validation (Vovk, 2015), each divided by the curve's own
        deviation there, which a Gaussian process has (Lei et al., 2018, section 5.2). Infinite where there are too few
        rows to tell: `level` needs 1 / (1 − level) of them.

        Raises
        ------
        InputError
            If `level` is not between 0 and 1, or as `__call__`.
        """
        if not 0 < level < 1:
            raise InputError(f"level: expected a number between 0 and 1, got {level!r}")
        z = self.scale(self._given(parameters))
        values = self(parameters)
        out = np.empty((*values.shape, 2))
        for k, (curve, missed) in enumerate(zip(self.curves, self.misses, strict=True)):
            rank = int(np.ceil((len(missed) + 1) * level))
            reach = (missed[rank - 1] if rank <= len(missed) else np.inf) * curve.deviation(z)
            out[:, k] = values[:, k, None] + np.outer(reach, (-1.0, 1.0))
        return out

    def outside(self, parameters: Array) -> Array:
        """(B,) whether parameters (B, d) lie beyond what it was trained on. Raises InputError as `__call__`.

        They do where one of them lies beyond its range by more than three mean gaps between rows; where their leverage
        on a linear model is larger than that of any training row on the model of all others; or off the flat on which
        all training rows lie, if they lie on one.
        """
        given = self._given(parameters)
        return self.reach.outside(given, self.scale(given))

    @property
    def cross_validated(self) -> dict[str, dict[str, float]]:
        """`r2` of rows left out, by label: that of the regression that was taken."""
        taken = self.evidence.r2[np.arange(len(self.names)), self.evidence.chosen]
        return {name: {"r2": float(r2)} for name, r2 in zip(self.names, taken, strict=True)}

    def state(self) -> Mapping[str, Array]:
        """Everything it holds, as named arrays; texts as UTF-8 JSON in bytes."""
        told = {
            "names": self.names,
            "units": self.units,
            "inputs": self.inputs,
            "regressions": self.evidence.regressions,
            "curves": [curve.kind for curve in self.curves],
        }
        text = np.frombuffer(json.dumps(told, ensure_ascii=False).encode(), np.uint8)
        state = {"text": text, "centre": self.scale.centre, "rate": self.scale.rate}
        state |= {f"reach.{name}": array for name, array in self.reach.state().items()}
        state |= {f"evidence.{name}": getattr(self.evidence, name) for name in ("r2", "error", "chosen")}
        for k, (curve, missed) in enumerate(zip(self.curves, self.misses, strict=True)):
            state |= {f"{k}.misses": missed, **{f"{k}.{name}": array for name, array in curve.state().items()}}
        return state

    @classmethod
    def from_state(cls, state: Mapping[str, Array]) -> Fitted:
        """The model again; it answers as before, bit for bit.

        Raises
        ------
        InputError
            If an array or a text is missing, or is not what a model writes.
        """
        try:
            told = json.loads(np.asarray(state["text"], np.uint8).tobytes().decode())
            names, units, inputs, regressions = (
                texts(told[what], what, distinct=what != "units")
                for what in ("names", "units", "inputs", "regressions")
            )
            found = assembled(
                names,
                units,
                inputs,
                Scale(state["centre"], state["rate"]),
                [CURVES[kind](**_part(state, f"{k}.", without="misses")) for k, kind in enumerate(told["curves"])],
                [state[f"{k}.misses"] for k in range(len(names))],
                Reach(**_part(state, "reach.")),
                Evidence(regressions, **_part(state, "evidence.")),
            )
            middle = found.scale.centre[None]
            if found.interval(middle, 0.5).shape != (1, len(names), 2) or found.outside(middle).shape != (1,):
                raise ValueError("its arrays do not belong together")
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"state: expected what a model of lampopt_models writes, got {error!r}") from error
        return found

    def _given(self, parameters: Array) -> Array:
        return frozen_array(parameters, f"parameters ({', '.join(self.inputs)})", (None, len(self.inputs)))


@dataclass(frozen=True, eq=False)
class SymbolicFitted(Fitted):
    """A model all of whose curves exist as CasADi expressions: no trees among them."""

    def symbolic(self, parameters: Any) -> Any:
        """The labels (p,) as a CasADi expression of `parameters` (d,)."""
        import casadi

        z = (casadi.vec(parameters) - casadi.DM(self.scale.centre)) * casadi.DM(self.scale.rate)
        return casadi.vertcat(*(curve.symbolic(z) for curve in self.curves if isinstance(curve, SymbolicCurve)))


def assembled(
    names: tuple[str, ...],
    units: tuple[str, ...],
    inputs: tuple[str, ...],
    scale: Scale,
    curves: Sequence[Curve],
    misses: Sequence[Array],
    reach: Reach,
    evidence: Evidence,
) -> Fitted:
    """A model of these parts, with `symbolic` where all curves have it."""
    cls = SymbolicFitted if all(isinstance(curve, SymbolicCurve) for curve in curves) else Fitted
    return cls(names, units, inputs, scale, tuple(curves), tuple(misses), reach, evidence)


def _part(state: Mapping[str, Array], prefix: str, without: str = "") -> dict[str, Array]:
    return {
        name.removeprefix(prefix): array
        for name, array in state.items()
        if name.startswith(prefix) and name != f"{prefix}{without}"
    }
