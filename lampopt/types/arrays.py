"""Arrays that records can rely on: right shape, finite, read-only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lampopt.errors import InputError

Array = npt.NDArray[Any]


def frozen_array(
    value: npt.ArrayLike,
    name: str,
    shape: tuple[int | None, ...],
    dtype: npt.DTypeLike = np.float64,
    *,
    nan: bool = False,
) -> Array:
    """`value` as a read-only array of `shape` (None: any length), all finite unless `nan` allows gaps.

    Arrays that already fit (a memory map, say) are kept, not copied.

    Raises
    ------
    InputError
        If the shape differs or a value is not finite.
    """
    array = np.asarray(value, dtype)
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=False)):
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        raise InputError(f"{name}: expected shape {wanted}, got {array.shape}")
    bad = np.isinf(array) if nan else ~np.isfinite(array)
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InputError(f"{name}: expected finite values, got {array[where]} at index {where}")
    view = array.view()
    if array is value and array.flags.writeable:  # the caller could still change it behind our back
        view = array.copy()
    view.flags.writeable = False
    return view


def assign(record: object, **values: object) -> None:
    """Assign fields of a frozen dataclass while it is being made."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def bounds(value: npt.ArrayLike | None, name: str, length: int, default: float) -> Array:
    """Read-only (length,) bounds; infinite ones are allowed, NaN is not."""
    array = np.array(np.full(length, default) if value is None else value, float)
    if array.shape != (length,) or np.isnan(array).any():
        raise InputError(f"{name}: expected {length} numbers (±inf for none), got {value!r}")
    array.flags.writeable = False
    return array


def unique(names: Sequence[str], what: str) -> None:
    """Raise InputError naming the first of `names` that occurs twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{what} names: expected distinct ones, got {name!r} twice")
        seen.add(name)
