"""Parquet files, their promises weighed before Arrow unpacks them: a few bytes of one can stand for gigabytes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from lampopt.errors import InputError

from .thrift import Record, record, records, whole

if TYPE_CHECKING:
    import pyarrow as pa

ALWAYS, TIMES = 32 * 2**20, 30  # bytes unpacked: of any file, and as a multiple of a larger one
FOOTER = 2**22  # bytes
PAGES = 100_000
LONGEST = 4096  # bytes of a text; a dictionary could repeat one a million times
MAGIC = b"PAR1"


def read(data: bytes, most_rows: int, most_cells: int, most_columns: int) -> pa.Table:
    """The table in a Parquet file; columns of lists, records and other types without numbers or text hold nothing.

    Raises
    ------
    InputError
        If it promises more than can be meant, or its pages are not what it says.
    """
    import pyarrow as pa
    from pyarrow import parquet

    most = max(ALWAYS, TIMES * len(data))
    rows = _weighed(data, most, most_rows, most_cells, most_columns)
    limits: dict[str, Any] = {"thrift_string_size_limit": 2**24, "thrift_container_size_limit": 2**18}
    file = parquet.ParquetFile(pa.BufferReader(data), pre_buffer=False, **limits)
    schema = file.schema_arrow
    flat = [field.name for field in schema if _flat(field.type)]
    if len(set(schema.names)) < len(schema.names):
        raise InputError("expected distinct column names, got one twice")
    text = [name for name in flat if not _number(schema.field(name).type)]
    file = parquet.ParquetFile(pa.BufferReader(data), pre_buffer=False, read_dictionary=text, **limits)
    table = file.read(columns=flat, use_threads=False)
    table.validate(full=True)  # texts are UTF-8, indices lie within dictionaries
    if table.num_rows != rows:
        raise InputError(f"it promises {rows:,} rows, {table.num_rows:,} could be read: it is damaged")
    kept = {name: _short(table[name], most) for name in flat}
    arrays = [kept.get(f.name, pa.chunked_array([pa.nulls(rows, f.type)], f.type)) for f in schema]
    return pa.Table.from_arrays(arrays, names=schema.names)


def _weighed(data: bytes, most: int, most_rows: int, most_cells: int, most_columns: int) -> int:
    """The number of rows, once all that a Parquet file's records promise is known to be no more than can be meant."""
    if len(data) < 12 or data[:4] != MAGIC or data[-4:] != MAGIC:
        raise InputError("expected a Parquet file, got something else or one cut short")
    length = int.from_bytes(data[-8:-4], "little")
    if length > min(FOOTER, len(data) - 12):
        raise InputError(f"its footer promises {length:,} bytes")
    footer, _ = record(data[-8 - length : -8], 0)
    rows, groups = whole(footer, 3, "its rows"), records(footer, 4)
    columns = max((len(records(group, 1)) for group in groups), default=0)
    if rows > most_rows or columns > most_columns or rows * columns > most_cells:
        raise InputError(
            f"expected at most {most_rows:,} rows, {most_columns:,} columns and {most_cells:,} cells, got {rows:,} "
            f"rows of {columns:,}"
        )
    if sum(whole(group, 3, "the rows of a group") for group in groups) != rows:
        raise InputError("its groups have other rows than the table: it is damaged")
    chunks = [chunk.get(3) for group in groups for chunk in records(group, 1)]
    total = pages = 0
    for chunk in chunks:
        if not isinstance(chunk, dict) or whole(chunk, 5, "the values of a column") > most_cells:
            raise InputError("a column promises more values than the table has cells")
        for size in _pages(data, chunk):
            total, pages = total + size, pages + 1
            if total > most or pages > PAGES:
                raise InputError(f"expected at most {most:,} bytes and {PAGES:,} pages when unpacked, got more")
    return rows


def _pages(data: bytes, chunk: Record) -> Iterator[int]:
    """What each page of a column chunk says that it is long, unpacked."""
    at = whole(chunk, 9, "where a column starts")
    if chunk.get(11):
        at = min(at, whole(chunk, 11, "where a dictionary starts"))
    end = at + whole(chunk, 7, "the bytes of a column")
    if end > len(data):
        raise InputError("a column lies outside the file")
    while at < end:
        page, at = record(data, at)
        yield whole(page, 2, "the size of a page")
        at += whole(page, 3, "the bytes of a page")
        if at > end:
            raise InputError("a page lies outside its column")


def _number(kind: pa.DataType) -> bool:
    import pyarrow as pa

    types = pa.types
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind) or types.is_boolean(kind))


def _flat(kind: pa.DataType) -> bool:
    import pyarrow as pa

    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return _number(kind) or bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _short(cells: pa.ChunkedArray, most: int) -> pa.ChunkedArray:
    """`cells` as they are, once no text of a dictionary is too long to be repeated as often as there are rows."""
    import pyarrow as pa
    from pyarrow import compute

    for chunk in cells.chunks:
        if not pa.types.is_dictionary(chunk.type) or len(chunk.dictionary) == 0:
            continue
        if _number(chunk.dictionary.type):
            continue
        longest = compute.max(compute.binary_length(chunk.dictionary)).as_py() or 0
        if longest > LONGEST or longest * len(cells) > most:
            raise InputError(f"expected texts of at most {LONGEST} bytes, {most:,} in a column, got one of {longest:,}")
    return cells
