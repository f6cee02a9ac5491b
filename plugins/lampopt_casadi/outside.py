"""Terms as CasADi expressions: their own where they have one, else by value and gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np

from lampopt.errors import SolveError
from lampopt.types import Array, Expressible, Term, rough


class Outside:
    """The terms of one program that are no expressions; CasADi needs somebody to hold what stands for them."""

    def __init__(self) -> None:
        self._evaluations, self._held = list[Evaluations](), list[Any]()
        self.rough = False  # whether any of them is

    def expression(self, term: Term, alpha: Any, name: str) -> Any:
        """The value of `term` at `alpha` (N,) as an expression."""
        if isinstance(term, Expressible):
            return term.symbolic(alpha)
        self.rough |= rough(term)
        self._evaluations.append(Evaluations(term, name))
        self._held.append(_Outside(self._evaluations[-1], alpha.numel()))
        return self._held[-1](alpha)

    def check(self) -> None:
        """Raise what a term raised meanwhile."""
        for found in self._evaluations:
            if found.error is not None:
                raise found.error


class Evaluations:
    """Value and gradient of a term by alpha; the last is kept, for they are asked for one after the other.

    What a term raises cannot pass through CasADi: it is held as `error`, and the search gets NaN, which ends it.
    """

    def __init__(self, term: Term, name: str) -> None:
        self._term, self._name = term, name
        self._at, self._last = b"", (0.0, np.zeros(0))
        self.error: BaseException | None = None

    def __call__(self, alpha: Any) -> tuple[float, Array]:
        """At alpha, of any shape; NaN after an error."""
        at = np.asarray(alpha, float).ravel()
        if self.error is not None:
            return np.nan, np.full(len(at), np.nan)
        if at.tobytes() != self._at:
            try:
                value, gradient = self._term(at)
                if gradient is None:
                    raise SolveError(
                        f"{self._name}: has no gradient by alpha, which solver 'casadi' needs: the measure has none, "
                        "or the bank's decoder carries none from vertices to weights; choose solver 'nlopt', which "
                        "does without"
                    )
                self._at, self._last = at.tobytes(), (float(value), np.array(gradient, float).reshape(len(at)))
            except BaseException as error:  # noqa: BLE001  # Ctrl-C too: raised again by the search
                self.error = error
                return self(alpha)
        return self._last


class _Outside(casadi.Callback):
    """alpha (N, 1) → value, with its Jacobian."""

    def __init__(self, evaluations: Evaluations, size: int) -> None:
        casadi.Callback.__init__(self)
        self._evaluations, self._size, self._jacobians = evaluations, size, list[Any]()
        self.construct("term", {})

    def get_sparsity_in(self, _: int) -> Any:
        return casadi.Sparsity.dense(self._size, 1)

    def eval(self, given: Sequence[Any]) -> list[float]:
        return [self._evaluations(given[0])[0]]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, _inames: Sequence[str], _onames: Sequence[str], options: Any) -> Any:
        self._jacobians.append(_Slope(self._evaluations, self._size, name, options))
        return self._jacobians[-1]


class _Slope(casadi.Callback):
    """alpha (N, 1), value → gradient (1, N)."""

    def __init__(self, evaluations: Evaluations, size: int, name: str, options: Any) -> None:
        casadi.Callback.__init__(self)
        self._evaluations, self._size = evaluations, size
        self.construct(name, options)

    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> Any:
        return casadi.Sparsity.dense(1 if i else self._size, 1)

    def get_sparsity_out(self, _: int) -> Any:
        return casadi.Sparsity.dense(1, self._size)

    def eval(self, given: Sequence[Any]) -> list[Any]:
        return [casadi.DM(self._evaluations(given[0])[1]).T]
