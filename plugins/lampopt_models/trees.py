"""Boosted regression trees as plain arrays, walked by numpy: what scikit-learn fitted, to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .curve import check_arrays, check_indices, check_range

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingRegressor

AT_ONCE = 2**21  # nodes visited together
MOST_LEAVES = 4096  # of a tree
_ALONE = Lock()  # scikit-learn changes the filters of warnings for a moment, which all threads share


@dataclass(frozen=True, eq=False)
class Trees:
    """T trees of up to m nodes; the value at z is `start` plus that of one leaf of each.

    Parameters
    ----------
    start
        (1,) value before any tree [label].
    column
        (T, m) parameter that a node asks about; −1 at a leaf.
    limit
        (T, m) values up to it go left [scaled parameter].
    left, right
        (T, m) the next nodes.
    leaf
        (T, m) values of the leaves [label].
    """

    start: Array
    column: Array
    limit: Array
    left: Array
    right: Array
    leaf: Array

    kind: ClassVar[str] = "trees"

    def __post_init__(self) -> None:
        check_arrays(self, start=(1,), leaf=(None, None))
        shape = self.leaf.shape
        if not 1 <= shape[1] < 2 * MOST_LEAVES:
            raise InputError(f"trees: expected 1 to {2 * MOST_LEAVES - 1} nodes, got {shape[1]}")
        check_arrays(self, limit=shape)
        check_indices(self, column=shape, left=shape, right=shape)
        check_range("column", self.column, -1, np.inf)
        onward = np.minimum(self.left, self.right) > np.arange(shape[1])
        if not (onward & (np.maximum(self.left, self.right) < shape[1]))[self.column >= 0].all():
            raise InputError("trees: expected nodes that lead on to later ones, got some that lead back or nowhere")

    def check_inputs(self, d: int) -> None:
        """Raise InputError if it asks about more than d parameters."""
        if self.column.max(initial=-1) >= d:
            raise InputError(f"column: expected {d} parameters, got number {self.column.max()}, counted from 0")

    def __call__(self, z: Array) -> Array:
        """Values (B,) at (B, d)."""
        chunk = max(1, AT_ONCE // max(len(self.leaf), 1))
        parts = [self._walked(z[first : first + chunk]) for first in range(0, len(z), chunk)]
        return np.concatenate([*parts, np.empty(0)])

    def gradient(self, z: Array) -> Array:
        """Zeros (B, d): its value goes in steps, so this is exact but on the steps themselves."""
        return np.zeros_like(z)

    def deviation(self, z: Array) -> Array:
        """(B,) ones: it knows of no place that is less certain."""
        return np.ones(len(z))

    def state(self) -> Mapping[str, Array]:
        """Its arrays."""
        return {name: getattr(self, name) for name in ("start", "column", "limit", "left", "right", "leaf")}

    def _walked(self, z: Array) -> Array:
        rows, trees = np.arange(len(z))[:, None], np.arange(len(self.leaf))
        node = np.zeros((len(z), len(trees)), np.intp)
        while (inner := (asked := self.column[trees, node]) >= 0).any():
            onward = np.where(
                z[rows, asked] <= self.limit[trees, node], self.left[trees, node], self.right[trees, node]
            )
            node = np.where(inner, onward, node)
        total = np.full(len(z), self.start[0])
        for values in self.leaf[trees, node].T:  # in order, as scikit-learn adds them
            total += values
        return total


def exported(model: HistGradientBoostingRegressor, unit: float = 1.0) -> Trees:
    """The trees of a fitted model without categories or missing values, whose labels are told in this `unit`."""
    tables = [tree.nodes for (tree,) in model._predictors]  # scikit-learn offers them no other way
    most = max((len(table) for table in tables), default=1)

    def padded(name: str, dtype: Any, unless: float) -> Array:
        out: Array = np.full((len(tables), most), unless, dtype)
        for row, table in zip(out, tables, strict=True):
            row[: len(table)] = np.where(table["is_leaf"], unless, table[name]) if name != "value" else table[name]
        return out

    return Trees(
        unit * np.array(model._baseline_prediction, float).reshape(1),
        padded("feature_idx", np.int32, -1),
        padded("num_threshold", float, 0.0),
        padded("left", np.int32, 0),
        padded("right", np.int32, 0),
        unit * padded("value", float, 0.0),
    )


def boosted(z: Array, y: Array, trees: int, rate: float, leaves: int, seed: int) -> Trees:
    """Trees fitted to y (n,), not all equal, at z (n, d) one after the other, each to what is left (Friedman, 2001)."""
    from sklearn.ensemble import HistGradientBoostingRegressor
    from threadpoolctl import threadpool_limits

    unit = float(np.exp2(np.round(np.log2(y.std()))))  # it reckons in single precision; powers of two change no digit
    model = HistGradientBoostingRegressor(
        learning_rate=rate,
        max_iter=trees,
        max_leaf_nodes=leaves,
        min_samples_leaf=int(np.clip(len(y) // 20, 1, 20)),
        l2_regularization=1.0,
        early_stopping=False,
        random_state=seed,
    )
    with _ALONE, threadpool_limits(1, user_api="openmp"):  # tables are small: threads would wait for each other
        return exported(model.fit(z, y / unit), unit)
