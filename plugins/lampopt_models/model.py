"""A model that was learned: labels by parameters, with intervals, range and evidence; to and from named arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, frozen_array

from .curve import SymbolicCurve, check_arrays, check_indices, check_range
from .given import FARTHEST, LARGEST, texts
from .label import Label, part_of


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well each regression that was tried tells labels of rows that it had not seen.

    Parameters
    ----------
    regressions
        The c names, from the simplest on.
    r2
        (p, c) R² of the rows left out, part by part; NaN of a label that is the same everywhere.
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
        c = len(self.regressions)
        check_indices(self, chosen=(None,))
        check_arrays(self, nan=True, r2=(len(self.chosen), c), error=(len(self.chosen), c))
        check_range("chosen", self.chosen, 0, c - 1)


@dataclass(frozen=True, eq=False)
class LearnedModel:
    """A model that was learned.

    Parameters
    ----------
    names, units
        The p labels.
    inputs
        The d parameters, in order.
    labels
        What was learned of each label.
    evidence
        Why this.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    inputs: tuple[str, ...]
    labels: tuple[Label, ...]
    evidence: Evidence

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.units) == len(self.labels) == len(self.evidence.chosen):
            raise InputError(f"model: expected names, units, labels and evidence of one count, got {self.names!r:.200}")
        for label in self.labels:
            if len(label.scale.centre) != len(self.inputs):
                raise InputError(f"scale: expected {len(self.inputs)} parameters, got {len(label.scale.centre)}")

    def __call__(self, parameters: Array) -> Array:
        """Labels (B, p) at parameters (B, d).

        Raises
        ------
        InputError
            If these are not finite, of another shape, larger than 1e100, or 1e30 deviations off all training rows.
        """
        given = self._given(parameters)
        return np.stack([label(given) for label in self.labels], axis=1)

    def gradient(self, parameters: Array) -> Array:
        """Derivatives (B, p, d) at parameters (B, d), exact; zero by trees, which go in steps. Raises InputError."""
        given = self._given(parameters)
        return np.stack([label.gradient(given) for label in self.labels], axis=1)

    def interval(self, parameters: Array, level: float) -> Array:
        """Low and high (B, p, 2) that hold a new label with probability `level`, within what it was trained on.

        Conformal prediction with the misses of cross-validation (Vovk, 2015), each divided by the curve's own deviation
        there, which a Gaussian process has (Lei et al., 2018, section 5.2). Infinite where there are too few rows to
        tell: `level` needs 1 / (1 − level) of them.

        Raises
        ------
        InputError
            If `level` is not between 0 and 1, or as `__call__`.
        """
        given = self._given(parameters)
        widths = np.stack([label.half_width(given, level) for label in self.labels], axis=1)
        values = self(given)
        return np.stack([values - widths, values + widths], axis=2)

    def outside(self, parameters: Array) -> Array:
        """(B,) whether parameters (B, d) lie beyond what a label was learned from. Raises InputError as `__call__`.

        They do if, for any label and the rows that have it, one of them lies beyond its range by more than three mean
        gaps between rows; if their leverage on a linear model is larger than that of any of these rows on the model of
        all others; or if they are off the flat on which all these rows lie, where they lie on one.
        """
        given = self._given(parameters)
        found: Array = np.any([label.outside(given) for label in self.labels], axis=0)
        return found

    @property
    def cross_validated(self) -> dict[str, dict[str, float]]:
        """`r2` of rows left out, by label: that of the regression that was taken; NaN of a constant label."""
        taken = self.evidence.r2[np.arange(len(self.names)), self.evidence.chosen]
        return {name: {"r2": float(r2)} for name, r2 in zip(self.names, taken, strict=True)}

    def state(self) -> Mapping[str, Array]:
        """Everything it holds, as named arrays; texts as UTF-8 JSON in bytes."""
        told = {
            "names": self.names,
            "units": self.units,
            "inputs": self.inputs,
            "regressions": self.evidence.regressions,
            "curves": [label.curve.kind for label in self.labels],
        }
        state = {"text": np.frombuffer(json.dumps(told, ensure_ascii=False).encode(), np.uint8)}
        state |= {f"evidence.{name}": getattr(self.evidence, name) for name in ("r2", "error", "chosen")}
        for k, label in enumerate(self.labels):
            state |= {f"{k}.{name}": array for name, array in label.state().items()}
        return state

    @classmethod
    def from_state(cls, state: Mapping[str, Array]) -> LearnedModel:
        """The model again; it answers as before, bit for bit.

        Raises
        ------
        InputError
            If an array or a text is missing or superfluous, or is not what a model writes.
        """
        try:
            told = json.loads(frozen_array(state["text"], "text", (None,), state["text"].dtype).tobytes().decode())
            names, units, inputs, regressions = (
                texts(told[what], what, distinct=what != "units")
                for what in ("names", "units", "inputs", "regressions")
            )
            labels = [Label.from_state(kind, part_of(state, str(k))) for k, kind in enumerate(told["curves"])]
            found = assembled(names, units, inputs, labels, Evidence(regressions, **part_of(state, "evidence")))
            if superfluous := sorted(set(state) - set(found.state())):
                raise InputError(f"expected no {', '.join(superfluous)[:200]}")
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
            raise InputError(f"state: expected what a model of lampopt_models writes, got {error!r:.500}") from error
        return found

    def _given(self, parameters: Array) -> Array:
        given = frozen_array(parameters, f"parameters ({', '.join(self.inputs)})", (None, len(self.inputs)))
        if np.abs(given).max(initial=0.0) > LARGEST or any(
            np.abs(label.scale(given)).max(initial=0.0) > FARTHEST for label in self.labels
        ):
            raise InputError(
                f"parameters ({', '.join(self.inputs)}): expected values near those that it was trained on, got up to "
                f"{np.abs(given).max():g}"
            )
        return given


@dataclass(frozen=True, eq=False)
class SymbolicModel(LearnedModel):
    """A model all of whose labels exist as CasADi expressions: no trees among them."""

    def symbolic(self, parameters: Any) -> Any:
        """The labels (p,) as a CasADi expression of `parameters` (d,)."""
        import casadi

        return casadi.vertcat(*(label.symbolic(parameters) for label in self.labels))


def assembled(
    names: tuple[str, ...], units: tuple[str, ...], inputs: tuple[str, ...], labels: Sequence[Label], evidence: Evidence
) -> LearnedModel:
    """A model of these labels, with `symbolic` where all curves have it."""
    cls = SymbolicModel if all(isinstance(label.curve, SymbolicCurve) for label in labels) else LearnedModel
    return cls(names, units, inputs, tuple(labels), evidence)
