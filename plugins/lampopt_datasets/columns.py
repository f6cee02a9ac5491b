"""CSV and Parquet files as named columns of numbers with units."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from reprlib import repr as short
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import brief, content
from lampopt.types import Array

from . import parquet

if TYPE_CHECKING:
    import pyarrow as pa

SHOWN = 20  # problems told in one message; a table can have a million
HEADER = re.compile(r"(?P<name>.*?)(?:\[(?P<unit>[^\[\]]*)\])?", re.DOTALL)
NUMBER = r"^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?$"
WRITTEN = re.compile(  # thousands apart, a decimal comma, a share or unit, Fortran's exponent, a typographic minus
    r"[+\u2212-]?[0-9]{1,3}([,'\u2019 \u00a0\u202f][0-9]{3})+(\.[0-9]+)?"
    r"|[+-]?[0-9]*,[0-9]+([eE][+-]?[0-9]+)?"
    r"|[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)( ?(%|\u00b0|mm|cm|m|km|in|ft|deg|rad|kg|N)|[dD][+-]?[0-9]+)"
    r"|\u2212([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?"
)
LARGEST = 2**28  # bytes of a table
ROWS, COLUMNS = 1_000_000, 10_000
CELLS = 2_000_000  # of any table; a larger file may have one a byte
EMPTY = ("", "nan", "na", "n/a", "null", "none", "-")


def name_and_unit(header: str) -> tuple[str, str]:
    """The parts of a header: ``"ramp [deg]"`` is ``("ramp", "deg")``; without brackets the unit is ""."""
    found = HEADER.fullmatch(header.strip())
    if found is None:  # the pattern takes any text; this is for the type checker
        return header.strip(), ""
    return found["name"].strip(), (found["unit"] or "").strip()


@dataclass(frozen=True, eq=False)
class Column:
    """One column: what its header says and what its cells hold."""

    name: str
    unit: str
    cells: pa.ChunkedArray
    values: Array | None  # (N,) NaN where empty or not a number; None where the type has no numbers (dates, lists)
    empty: Array  # (N,) which cells are empty

    @property
    def numeric(self) -> bool:
        """Whether this is a column of numbers: by its unit, or half of its filled cells, or its empty ones, say so.

        Not all of them: a slip in one cell is to be reported, not to drop the column in silence; nor is a column whose
        every number is missing.
        """
        if self.values is None:
            return False
        numbers, filled = int((~np.isnan(self.values)).sum()) + self._written(), int((~self.empty).sum())
        if filled == 0:
            return bool(self.unit) or self._missing()
        return bool(self.unit) or (numbers > 0 and 2 * numbers >= filled)

    def _written(self) -> int:
        """How many cells are numbers to people: 1,200 or one with a typographic minus; such a one is to be reported."""
        assert self.values is not None
        cells = (self.cells[int(row)].as_py() for row in np.flatnonzero(np.isnan(self.values) & ~self.empty))
        return sum(isinstance(cell, str) and WRITTEN.fullmatch(cell.strip()) is not None for cell in cells)

    def _missing(self) -> bool:
        """Whether the cells of an empty column are numbers that are missing: by their type, or by words such as nan."""
        import pyarrow as pa

        kind = self.cells.type
        if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
            return not pa.types.is_null(kind) and not pa.types.is_dictionary(kind)
        return any(str(cell).strip() for cell in self.cells.unique().to_pylist() if cell is not None)

    def problems(self, *, gaps: bool) -> Iterator[str]:
        """What is wrong with the cells, row by row (counted from 1 below the header); `gaps` allows empty ones."""
        if self.values is None:
            yield f"column {self.name!r}: expected numbers, got {self.cells.type}"
            return
        bad = ~np.isfinite(self.values) & ~(self.empty & gaps)
        for row in np.flatnonzero(bad):
            empty = "an empty cell; those of labels may be (labels=)"
            got = empty if self.empty[row] else short(self.cells[int(row)].as_py())
            yield f"row {row + 1}, column {self.name!r}: expected a number, got {got}"


def read(path: Path) -> pa.Table:
    """The table in a CSV or Parquet file; CSV cells as text, since a type guessed from the first rows may not last.

    Raises
    ------
    InputError
        If the file is missing, of another kind, cannot be read, or comes to more than a table of exemplars can.
    """
    import pyarrow as pa

    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise InputError(f"table {brief(path)}: expected a .csv or .parquet file, got suffix {brief(suffix)!r}")
    try:
        data = content(path, largest=LARGEST)
    except InputError as error:
        raise InputError(f"table {brief(path)}: {error}") from error
    try:
        return _csv(data) if suffix == ".csv" else parquet.read(data, ROWS, max(CELLS, len(data)), COLUMNS)
    except (pa.ArrowException, ValueError, OSError, MemoryError) as error:
        hint = " (CSV: UTF-8 text, commas, one header line)" if suffix == ".csv" else ""
        raise InputError(f"table {brief(path)}: cannot be read{hint}: {brief(error)}") from error


def _csv(data: bytes) -> pa.Table:
    import pyarrow as pa
    from pyarrow import csv

    if data.split(b"\n", 1)[0].count(b",") >= COLUMNS:
        raise InputError(f"expected at most {COLUMNS:,} columns, got more in the first line")
    if data.count(b"\n") > ROWS + 1:
        raise InputError(f"expected at most {ROWS:,} rows, got more")
    with csv.open_csv(pa.BufferReader(data)) as reader:
        headers = reader.schema.names
    text = csv.ConvertOptions(column_types=dict.fromkeys(headers, pa.string()))
    return csv.read_csv(pa.BufferReader(data), csv.ReadOptions(use_threads=False), convert_options=text)


def columns(table: pa.Table, path: Path) -> dict[str, Column]:
    """The columns by name; those without one (a data frame's index) are left out.

    Raises
    ------
    InputError
        If two columns have one name, or one cannot be read.
    """
    import pyarrow as pa

    found: dict[str, Column] = {}
    for header, cells in zip(table.column_names, table.columns, strict=True):
        name, unit = name_and_unit(header)
        if not name or name.startswith("__index_level_"):
            continue
        if name in found:
            raise InputError(f"table {path}: expected distinct column names, got {name!r} twice")
        try:
            found[name] = Column(name, unit, cells, *_values(cells))
        except pa.ArrowException as error:
            raise InputError(f"table {brief(path)}: column {brief(name)!r} cannot be read: {brief(error)}") from error
    return found


def _values(cells: pa.ChunkedArray) -> tuple[Array | None, Array]:
    """The cells as numbers (None where the type has none), and which are empty."""
    import pyarrow as pa
    from pyarrow import compute

    kind = cells.type
    if pa.types.is_dictionary(kind):
        cells, kind = cells.cast(kind.value_type), kind.value_type
    if pa.types.is_null(kind):
        return np.full(len(cells), np.nan), np.ones(len(cells), bool)
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        values = np.array(compute.fill_null(cells.cast(pa.float64(), safe=False), np.nan).to_numpy())
        return values, np.isnan(values)
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        return None, np.array(cells.is_null().to_numpy())
    text = compute.utf8_trim_whitespace(cells.cast(pa.large_string()))
    empty = compute.fill_null(compute.is_in(compute.utf8_lower(text), pa.array(EMPTY, pa.large_string())), True)
    empty = compute.or_(empty, text.is_null())
    number = compute.fill_null(compute.match_substring_regex(text, NUMBER), False)
    numbers = compute.if_else(number, text, pa.scalar(None, pa.large_string())).cast(pa.float64())
    return np.array(compute.fill_null(numbers, np.nan).to_numpy()), np.array(empty.to_numpy())


def first(problems: Iterator[str]) -> list[str]:
    """The problems that one message can hold, and a note that there are more."""
    shown = list(islice(problems, SHOWN + 1))
    return [*shown[:SHOWN], "and more"] if len(shown) > SHOWN else shown
