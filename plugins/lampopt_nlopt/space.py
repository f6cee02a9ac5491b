"""Where is searched: alpha = start + axes·x, within the sum of 1 and the hard rows at every x."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lampopt.types import Array

from .least import RANK, Lines

MOVES = 1e-8  # what a search along its axes changes less is left as it is


@dataclass(frozen=True, eq=False)
class Space:
    """alpha (N,) = start + axes·x: axes (N, q) leave exact·alpha as it is; exact (e, N) has orthonormal rows."""

    start: Array
    axes: Array
    exact: Array

    @classmethod
    def around(cls, start: Array, equal: Lines, directions: Array | None, step: float) -> Space:
        """All that the targets `equal` leave free from `start`, or of it what `directions` (q, N) span.

        One of x is `step` of a direction's length; where directions cannot be told apart, of their sum of squares.
        Without directions it is `step` of ‖alpha‖.
        """
        start, basis = equal.free(start)
        _, sizes, rows = np.linalg.svd(equal.rows, full_matrices=False)
        exact = rows[sizes > RANK * sizes.max(initial=0.0)]
        if directions is not None:
            _, sizes, rows = np.linalg.svd(directions @ basis, full_matrices=False)
            real = sizes > RANK * np.linalg.norm(directions)
            basis = basis @ (sizes[real, None] * rows[real]).T
        return cls(start, step * basis, exact)

    def alpha(self, x: Array) -> Array:
        """Alpha at x (q,); what rounding moves off the targets is moved back."""
        off = self.axes @ x
        return np.asarray(self.start + (off - self.exact.T @ (self.exact @ off)))

    def at(self, start: Array) -> Space:
        """The same around another start, which has to meet the targets too."""
        return replace(self, start=start)

    def along(self, within: Lines) -> Lines:
        """Of inequalities those that move with x, as a part of their rows' length."""
        moved = np.linalg.norm(within.rows @ self.axes, axis=1)
        return within.taken(moved > MOVES * np.linalg.norm(within.rows, axis=1))
