"""Arrays that records can rely on: right shape, finite, read-only."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lampopt.errors import InputError

Array = npt.NDArray[Any]
V = TypeVar("V")
ROUNDING = 1e-12  # of the largest of some values: what differs by less differs by rounding


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
        If it is no array of numbers, the shape differs, or a value is not finite.
    """
    try:
        if np.iscomplexobj(value) or np.ma.is_masked(value):
            raise TypeError("complex or masked values")
        array = np.asarray(value, dtype)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"values of kind {array.dtype}")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array of numbers, got {error}") from error
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=False)):
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        raise InputError(f"{name}: expected shape {wanted}, got {array.shape}")
    step = max(1, array.shape[0] // 64) if array.ndim else 1
    for first in range(0, array.shape[0] if array.ndim else 1, step):  # part by part: it may be mapped from a file
        part = array[first : first + step] if array.ndim else array[None]
        bad = np.isinf(part) if nan else ~np.isfinite(part)
        if bad.any():
            row, *rest = (int(i) for i in np.argwhere(bad)[0])
            where = (first + row, *rest)[: array.ndim]
            raise InputError(f"{name}: expected finite values, got {array[where]} at index {where}")
    view = array.view()
    if isinstance(value, np.ndarray) and value.flags.writeable and np.may_share_memory(array, value):
        view = array.copy()  # the caller could still change it behind our back
    view.flags.writeable = False
    return view


def frozen_arrays(arrays: Mapping[str, npt.ArrayLike], what: str) -> Mapping[str, Array]:
    """Named arrays of any shape, each read-only, keeping its kind of number."""
    return Table(
        {
            name: frozen_array(a, f"{what} {name!r}", (None,) * np.ndim(a), np.asarray(a).dtype)
            for name, a in arrays.items()
        }
    )


class Table(Mapping[str, V]):
    """A read-only mapping that keeps its order and can be pickled."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[str, V] | Iterable[tuple[str, V]] = ()) -> None:
        self._items = dict(items)

    def __getitem__(self, key: str) -> V:
        return self._items[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return repr(self._items)


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


def tuple_of(kind: type[V], value: object, what: str) -> tuple[V, ...]:
    """`value` as a tuple, if it is a sequence of `kind`. Raises InputError otherwise."""
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(v, kind) for v in value):
        raise InputError(f"{what}: expected a sequence of {kind.__name__}, got {value!r:.200}")
    return tuple(value)


def normalisable(values: Array, names: Sequence[str], what: str) -> Array:
    """Columns (N, k) that can be normalised by their range, as they are before any solve.

    Where values differ by rounding only, one stands for all: what is left of them is no range to go to either end of.

    Raises
    ------
    InputError
        Naming the first column beyond 1e-100 to 1e100, where the range's square is no number any more.
    """
    found = values
    for place, (name, column) in enumerate(zip(names, values.T, strict=True)):
        known = column[~np.isnan(column)]
        if known.size == 0:
            continue
        largest, spread = float(np.abs(known).max()), float(known.max() - known.min())
        if 0 < spread <= ROUNDING * largest:
            found = np.array(found)
            found[~np.isnan(column), place], spread = known.min(), 0.0
            found.flags.writeable = False
        if largest > 1e100 or 0 < spread < 1e-100:
            raise InputError(
                f"{what} {name!r}: expected values up to 1e100 that differ by 1e-100 or more, or not at all, got "
                f"values up to {largest:.3g} that differ by {spread:.3g}: choose another unit"
            )
    return found


def whole(text: str, what: str) -> None:
    """Raise InputError where `text` cannot be written to a file: it holds half of a character."""
    if any("\ud800" <= c <= "\udfff" for c in text):
        raise InputError(f"{what}: expected text, got {text!r}, half of a character in it")


def unique(names: Sequence[str], what: str) -> None:
    """Raise InputError naming the first of `names` that occurs twice, or cannot be written to a file."""
    seen: set[str] = set()
    for name in names:
        whole(name, f"{what} names")
        if name in seen:
            raise InputError(f"{what} names: expected distinct ones, got {name!r} twice")
        seen.add(name)
