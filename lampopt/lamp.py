"""`.lamp` files: safetensors with a JSON header. No pickle anywhere, so a hostile file runs no code.

Every array and the header carry a hash that is checked when they are read; arrays stay mapped from the file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.errors import BankError, InputError
from lampopt.types import Array, Bank, Frame, Parameter, Spec

FORMAT = "lampopt bank"
SCHEMA = 1
MIGRATIONS: Mapping[int, Any] = {}  # schema → function that turns its record into the next schema's
DTYPES = {
    "F64": np.float64,
    "F32": np.float32,
    "F16": np.float16,
    "I64": np.int64,
    "I32": np.int32,
    "I16": np.int16,
    "I8": np.int8,
    "U64": np.uint64,
    "U32": np.uint32,
    "U16": np.uint16,
    "U8": np.uint8,
    "BOOL": np.bool_,
}
PLAIN = ("parameters", "labels", "weights", "probes", "probe_values", "fit_error", "measured")


def digest(array: Array) -> str:
    """A hash of an array's dtype, shape and bytes."""
    found = hashlib.blake2b(f"{array.dtype.str}{array.shape}".encode(), digest_size=16)
    if array.size:
        found.update(np.ascontiguousarray(array).data.cast("B"))
    return found.hexdigest()


def write(path: Path, arrays: Mapping[str, Array], record: Mapping[str, Any]) -> None:
    """Write `arrays` and `record` to `path` in one step: it is there whole, or not at all.

    Raises
    ------
    BankError
        If an array is of a kind that the format does not know, or the place cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    arrays = {name: _plain(array, name) for name, array in arrays.items()}
    head = json.loads(json.dumps({**record, "hashes": {name: digest(array) for name, array in arrays.items()}}))
    text = json.dumps({**head, "hash": _seal(head)}, sort_keys=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.writing")  # another process may write here too
    try:
        temporary.touch()
        mode = temporary.stat().st_mode  # the user's: safetensors lets nobody else read
        save_file(arrays, temporary, metadata={"lampopt": text})
        temporary.chmod(mode)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, SafetensorError) as error:
        raise BankError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _plain(array: Array, name: str) -> Array:
    """`array` as the format holds it: in one piece, little-endian, numbers or truth values."""
    array = np.asarray(array, order="C")
    if array.dtype.newbyteorder("=") not in [np.dtype(known) for known in DTYPES.values()]:
        raise BankError(f"array {name!r}: a file holds numbers and truth values, got dtype {array.dtype}")
    return array.astype(array.dtype.newbyteorder("<"), copy=False)


def _seal(head: Mapping[str, Any]) -> str:
    """A hash of a header as JSON gives it back."""
    return hashlib.blake2b(json.dumps(head, sort_keys=True).encode(), digest_size=16).hexdigest()


def read(path: Path) -> tuple[dict[str, Array], dict[str, Any]]:
    """The arrays of a file written by `write`, mapped, their hashes checked; and its record.

    Raises
    ------
    BankError
        If the file is missing, cut short, altered or of another kind.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:  # checks the layout: sizes, overlaps, dtypes
            record = json.loads((file.metadata() or {})["lampopt"])
        with open(path, "rb") as raw:
            (length,) = struct.unpack("<Q", raw.read(8))
            header = json.loads(raw.read(length))
    except FileNotFoundError as error:
        raise BankError(f"{path}: no such file") from error
    except (SafetensorError, KeyError, ValueError, RecursionError, OSError, struct.error) as error:
        raise BankError(f"{path}: expected a .lamp file, got something else or a damaged one: {error}") from error
    header.pop("__metadata__")
    if not isinstance(record, dict) or record.pop("hash", None) != _seal(record):
        raise BankError(f"{path}: its header is not what was written; the file is damaged")
    hashes = record.get("hashes")
    if not isinstance(hashes, dict) or set(hashes) != set(header):
        raise BankError(f"{path}: its arrays are not those that its header lists; the file is damaged")
    arrays = {}
    for name, entry in header.items():
        if entry["dtype"] not in DTYPES:
            raise BankError(f"{path}: array {name!r} has dtype {entry['dtype']}, expected one of {sorted(DTYPES)}")
        dtype, shape = np.dtype(DTYPES[entry["dtype"]]), tuple(entry["shape"])
        start = 8 + length + entry["data_offsets"][0]
        try:
            mapped = np.memmap(path, dtype, "r", start, shape) if math.prod(shape) else np.zeros(shape, dtype)
        except (ValueError, OverflowError, OSError) as error:
            raise BankError(f"{path}: array {name!r} of shape {shape} cannot be mapped: {error}") from error
        arrays[name] = np.asarray(mapped)
        if digest(arrays[name]) != hashes[name]:
            raise BankError(f"{path}: array {name!r} is not what was written; the file is damaged")
    return arrays, record


def store_bank(bank: Bank, path: str | Path) -> Bank:
    """Write `bank` to a `.lamp` file and return it as read from there."""
    path = Path(path)
    arrays = {name: getattr(bank, name) for name in PLAIN} | {f"shared.{k}": v for k, v in bank.shared.items()}
    record = {
        "format": FORMAT,
        "schema": SCHEMA,
        "space": [[q.name, q.unit, q.low, q.high] for q in bank.space],
        "label_space": [[q.name, q.unit, q.low, q.high] for q in bank.label_space],
        "names": list(bank.names),
        "frame": {"scale": bank.frame.scale, "centre": bank.frame.centre.tolist(), "unit": bank.frame.unit},
        "decoder": {"name": bank.decoder.name, "options": dict(bank.decoder.options)},
        "measured_by": [list(pair) for pair in bank.measured_by.items()],  # in the order of `measured`
        "mesh_facts": dict(bank.mesh_facts),
        "limits": dict(bank.limits),
        "provenance": dict(bank.provenance),
    }
    write(path, arrays, record)
    return load_bank(path)


def load_bank(path: str | Path) -> Bank:
    """Read a bank from a `.lamp` file; its weights stay mapped from it.

    Raises
    ------
    BankError
        If the file is missing, damaged, no bank, or of a newer lampopt.
    """
    path = Path(path)
    arrays, record = read(path)
    if record.get("format") != FORMAT:
        raise BankError(f"{path}: expected a bank, got {record.get('format')!r}")
    schema = record.get("schema")
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise BankError(f"{path}: expected a schema from 1 to {SCHEMA}, got {schema!r}")
    if schema > SCHEMA:
        raise BankError(f"{path}: schema {schema} is newer than this lampopt reads ({SCHEMA}): update lampopt")
    for step in range(schema, SCHEMA):
        record = MIGRATIONS[step](record)
    try:
        return Bank(
            space=tuple(Parameter(*q) for q in record["space"]),
            label_space=tuple(Parameter(*q) for q in record["label_space"]),
            names=tuple(record["names"]),
            shared={k.removeprefix("shared."): v for k, v in arrays.items() if k.startswith("shared.")},
            frame=Frame(**record["frame"]),
            decoder=Spec(record["decoder"]["name"], **record["decoder"]["options"]),
            measured_by=dict(record["measured_by"]),
            mesh_facts=record["mesh_facts"],
            limits=record["limits"],
            provenance=record["provenance"],
            path=path,
            **{name: arrays[name] for name in PLAIN},
        )
    except (KeyError, TypeError, AttributeError, ValueError, InputError) as error:
        raise BankError(f"{path}: its header does not describe a bank: {error!r}") from error
