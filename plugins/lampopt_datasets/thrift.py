"""Records in Thrift's compact protocol, which Parquet files describe themselves in: read with every length checked.

pyarrow gives the same facts, but a damaged record ends the whole process there: it raises where nothing can catch.
"""

from __future__ import annotations

from typing import Any

from lampopt.errors import InputError

TRUE, FALSE, BYTE, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = 1, 2, 3, 7, 8, 9, 10, 11, 12
DEEPEST = 16  # records within records: Parquet's have six
Record = dict[int, Any]


def record(data: bytes, at: int, depth: int = 0) -> tuple[Record, int]:
    """The record at `at`, its fields by number, and where it ends.

    Raises
    ------
    InputError
        If it is none, is cut short or nests too deep.
    """
    if depth > DEEPEST:
        raise InputError("its records nest too deep")
    fields: Record = {}
    number = 0
    while head := _byte(data, at):
        at += 1
        if head >> 4:
            number += head >> 4
        else:
            number, at = _signed(data, at)
        kind = head & 15
        fields[number], at = (kind == TRUE, at) if kind in (TRUE, FALSE) else _value(data, at, kind, depth)
    return fields, at + 1


def whole(fields: Record, number: int, what: str) -> int:
    """Field `number` of a record, if it is a whole number of at least 0. Raises InputError otherwise."""
    value = fields.get(number)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"expected {what} as a number of at least 0")
    return value


def records(fields: Record, number: int) -> list[Record]:
    """Field `number` of a record, if it is a list of records; none where it is missing. Raises InputError otherwise."""
    value = fields.get(number, [])
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise InputError("expected a list of records")
    return value


def _value(data: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (TRUE, FALSE, BYTE):  # in a list, a truth value takes a byte
        return _byte(data, at), at + 1
    if BYTE < kind < DOUBLE:
        return _signed(data, at)
    if kind == DOUBLE:
        return None, _within(data, at, 8)
    if kind == BINARY:
        length, at = _varint(data, at)
        return None, _within(data, at, length)
    if kind == STRUCT:
        return record(data, at, depth + 1)
    if kind in (LIST, SET):
        head, at = _byte(data, at), at + 1
        count, at = (head >> 4, at) if head >> 4 < 15 else _varint(data, at)
        return _items(data, at, count, (head & 15,), depth)
    if kind == MAP:
        count, at = _varint(data, at)
        if count == 0:
            return [], at
        kinds, at = _byte(data, at), at + 1
        return _items(data, at, count, (kinds >> 4, kinds & 15), depth)
    raise InputError("its records hold what none can")


def _items(data: bytes, at: int, count: int, kinds: tuple[int, ...], depth: int) -> tuple[list[Any], int]:
    _within(data, at, count)  # an item takes a byte or more
    if depth > DEEPEST:
        raise InputError("its records nest too deep")
    found = []
    for _ in range(count):
        for kind in kinds:
            item, at = _value(data, at, kind, depth + 1)
            found.append(item)
    return found, at


def _within(data: bytes, at: int, length: int) -> int:
    if length > len(data) - at:
        raise InputError("its records are cut short")
    return at + length


def _byte(data: bytes, at: int) -> int:
    if not 0 <= at < len(data):
        raise InputError("its records are cut short")
    return data[at]


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = _byte(data, at)
        value |= (byte & 127) << shift
        at += 1
        if byte < 128:
            return value, at
    raise InputError("its records hold a number without end")


def _signed(data: bytes, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at
