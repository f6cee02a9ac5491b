"""`.lamp` files: safetensors with a JSON header. No pickle anywhere, so a hostile file runs no code.

Every array and the header carry a hash that is checked when they are read; arrays stay mapped from the file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.errors import BankError, InputError
from lampopt.reading import brief, path_of, plain_file, readdressed, why
from lampopt.types import Array, Bank, Calibration, Frame, LowRank, Parameter, Spec

FORMAT = "lampopt bank"
HEADER = 2**22  # bytes of a header: read as JSON, it may take thirty times as much memory
ARRAYS = 10_000
SCHEMA = 3
MIGRATIONS: Mapping[int, Any] = {  # schema → function that turns its record into the next schema's
    1: lambda record: {**record, "calibration": None},
    2: lambda record: record,  # weights by few directions came later
}
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
EVIDENCE = ("values", "errors", "exemplars")  # of a calibration
FEW = ("middle", "coefficients", "directions")  # of weights by few directions
PLAIN = ("parameters", "labels", "weights", "probes", "probe_values", "fit_error", "measured")
KINDS = {
    "weights": "F32",
    **{f"weights.{name}": "F32" for name in FEW},
    "probe_values": "F32",
    "calibration.exemplars": "I64",
}  # of arrays; F64 where not named


def digest(array: Array | LowRank) -> str:
    """A hash of an array's dtype, shape and bytes; of a `LowRank` one of its parts'."""
    if isinstance(array, LowRank):
        parts = "".join(digest(getattr(array, name)) for name in FEW)
        return hashlib.blake2b(parts.encode(), digest_size=16).hexdigest()
    found = hashlib.blake2b(f"{array.dtype.str}{array.shape}".encode(), digest_size=16)
    if array.size:
        found.update(np.ascontiguousarray(array).data.cast("B"))
    return found.hexdigest()


def write(path: Path, arrays: Mapping[str, Array], record: Mapping[str, Any]) -> None:
    """Write `arrays` and `record` to `path` in one step: it is there whole, or not at all.

    Raises
    ------
    BankError
        If an array is of a kind that the format does not know, the header is too long, or the place cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    arrays = {name: _plain(array, name) for name, array in arrays.items()}
    head = json.loads(json.dumps({**record, "hashes": {name: digest(array) for name, array in arrays.items()}}))
    text = json.dumps({**head, "hash": _seal(head)}, sort_keys=True)
    if len(arrays) > ARRAYS or len(json.dumps(text)) + 200 * len(arrays) > HEADER:
        raise BankError(
            f"{path}: expected at most {ARRAYS:,} arrays, and {HEADER:,} bytes of names and facts, got "
            f"{len(arrays):,} and {len(text):,}: shorten them"
        )
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


def read(path: str | Path) -> tuple[dict[str, Array], dict[str, Any]]:
    """The arrays of a file written by `write`, mapped, their hashes checked; and its record.

    Raises
    ------
    BankError
        If the file is missing, may not be opened, is cut short, altered or of another kind.
    """
    from safetensors import SafetensorError, safe_open

    try:
        path = plain_file(path, kind=".lamp file")
        size = path.stat().st_size
        with open(path, "rb") as raw:
            length = int.from_bytes(raw.read(8), "little")
            if not 2 <= length <= min(HEADER, size - 8):
                raise _DamagedError(f"its header promises {length:,} bytes")
            header = _json(raw.read(length))
        with safe_open(path, framework="numpy"):  # checks the layout: sizes, overlaps, dtypes
            pass
        record = _json(header.pop("__metadata__")["lampopt"])
        seal = record.pop("hash")
    except InputError as error:
        raise BankError(f"{brief(path)}: {error}") from error
    except OSError as error:
        raise BankError(f"{path}: cannot be opened: {why(error)}") from error
    except (SafetensorError, KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        what = f"expected a .lamp file, got something else or a damaged one: {brief(error)}"
        raise BankError(f"{path}: {what}") from error
    hashes = record.get("hashes")
    try:
        if seal != _seal(record):
            raise _DamagedError("its header is not what was written")
        if len(header) > ARRAYS:
            raise _DamagedError(f"it has {len(header):,} arrays, expected at most {ARRAYS:,}")
        if not isinstance(hashes, dict) or set(hashes) != set(header):
            raise _DamagedError("its arrays are not those that its header lists")
        arrays = {name: _mapped(path, size, 8 + length, name, entry) for name, entry in header.items()}
        for name, array in arrays.items():
            if digest(array) != hashes[name]:
                raise _DamagedError(f"array {brief(name)!r} is not what was written")
    except (_DamagedError, OSError, RecursionError) as error:
        raise BankError(f"{path}: {brief(error)}; the file is damaged") from error
    return arrays, record


class _DamagedError(ValueError):
    """What a file says of itself is not so."""


def _json(text: str | bytes) -> dict[str, Any]:
    """A JSON object, no name twice in it: readers differ in which they take."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise _DamagedError("its header has a name twice")
        return found

    found = json.loads(text, object_pairs_hook=once)
    if not isinstance(found, dict):
        raise _DamagedError("its header is not what was written")
    return found


def _mapped(path: Path, size: int, body: int, name: str, entry: Mapping[str, Any]) -> Array:
    """One array of a file of `size` bytes whose arrays start at `body`, mapped as its `entry` says."""
    if entry["dtype"] not in DTYPES:
        raise BankError(f"{path}: array {brief(name)!r} has dtype {entry['dtype']}, expected one of {sorted(DTYPES)}")
    dtype, shape, (first, last) = np.dtype(DTYPES[entry["dtype"]]), tuple(entry["shape"]), entry["data_offsets"]
    if not 0 <= first <= last <= size - body or last - first != math.prod(shape) * dtype.itemsize:
        raise _DamagedError(f"array {brief(name)!r} lies outside the file")
    try:
        return np.asarray(np.memmap(path, dtype, "r", body + first, shape) if first < last else np.zeros(shape, dtype))
    except (ValueError, OverflowError) as error:
        raise _DamagedError(
            f"array {brief(name)!r} of shape {brief(shape)} cannot be mapped: {brief(error)}"
        ) from error


def _from_here(file: str, folder: Path) -> str:
    """The way from `folder` to a file in it or below, so that they may move together; else its whole path."""
    whole, folder = Path(file).resolve(), folder.resolve()
    return str(whole.relative_to(folder) if whole.is_relative_to(folder) else whole)


def store_bank(bank: Bank, path: str | Path) -> Bank:
    """Write `bank` to a `.lamp` file and return it as read from there."""
    path = path_of(path, "store")
    arrays = {name: getattr(bank, name) for name in PLAIN} | {f"shared.{k}": v for k, v in bank.shared.items()}
    weights = bank.weights
    if isinstance(weights, LowRank):
        del arrays["weights"]
        arrays |= {f"weights.{name}": getattr(weights, name) for name in FEW}
    found = bank.calibration
    if found is not None:
        arrays |= {f"calibration.{name}": getattr(found, name) for name in EVIDENCE}
    record = {
        "format": FORMAT,
        "schema": SCHEMA,
        "space": [[q.name, q.unit, q.low, q.high] for q in bank.space],
        "label_space": [[q.name, q.unit, q.low, q.high] for q in bank.label_space],
        "names": list(bank.names),
        "frame": {"scale": bank.frame.scale, "centre": bank.frame.centre.tolist(), "unit": bank.frame.unit},
        "decoder": {"name": bank.decoder.name, "options": dict(bank.decoder.options)},
        "measured_by": [  # in the order of `measured`
            [name, readdressed(address, lambda file: _from_here(file, path.parent))]
            for name, address in bank.measured_by.items()
        ],
        "mesh_facts": dict(bank.mesh_facts),
        "limits": dict(bank.limits),
        "calibration": None if found is None else {"tolerance": found.tolerance, "checks": list(found.checks)},
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
    arrays, record = read(path)
    path = Path(path)
    if record.get("format") != FORMAT:
        raise BankError(f"{path}: expected a bank, got {brief(record.get('format'))!r}")
    schema = record.get("schema")
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise BankError(f"{path}: expected a schema from 1 to {SCHEMA}, got {brief(schema)}")
    if schema > SCHEMA:
        raise BankError(f"{path}: schema {schema} is newer than this lampopt reads ({SCHEMA}): update lampopt")
    for step in range(schema, SCHEMA):
        record = MIGRATIONS[step](record)
    try:
        return Bank(
            space=_space(record["space"]),
            label_space=_space(record["label_space"]),
            names=tuple(_listed(record["names"])),
            shared={k.removeprefix("shared."): v for k, v in arrays.items() if k.startswith("shared.")},
            frame=Frame(**record["frame"]),
            decoder=Spec(record["decoder"]["name"], **record["decoder"]["options"]),
            measured_by={
                name: readdressed(address, lambda file: str(path.parent.absolute() / file))
                for name, address in dict(record["measured_by"]).items()
            },
            mesh_facts=record["mesh_facts"],
            limits=record["limits"],
            calibration=_calibration(record["calibration"], arrays),
            provenance=record["provenance"],
            path=path,
            **{name: _kept(arrays, name) for name in PLAIN if name != "weights"},
            weights=_weights(arrays),
        )
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise BankError(f"{path}: its header does not describe a bank: {brief(repr(error))}") from error


def _listed(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"expected a list, got {brief(value)}")
    return value


def _space(entries: object) -> tuple[Parameter, ...]:
    return tuple(Parameter(*_listed(entry)) for entry in _listed(entries))


def _weights(arrays: Mapping[str, Array]) -> Any:
    """As they were stored: an array, or by few directions."""
    if "weights" in arrays:
        return _kept(arrays, "weights")
    return LowRank(*(_kept(arrays, f"weights.{name}") for name in FEW))


def _kept(arrays: Mapping[str, Array], name: str) -> Array:
    """An array of the kind that it was written as: another would be converted, to eight times its size."""
    wanted = np.dtype(DTYPES[KINDS.get(name, "F64")])
    if arrays[name].dtype != wanted:
        raise TypeError(f"array {name!r}: expected {wanted}, got {arrays[name].dtype}")
    return arrays[name]


def _calibration(record: Mapping[str, Any] | None, arrays: Mapping[str, Array]) -> Calibration | None:
    if record is None:
        return None
    evidence = {name: _kept(arrays, f"calibration.{name}") for name in EVIDENCE}
    return Calibration(tolerance=record["tolerance"], checks=tuple(_listed(record["checks"])), **evidence)
