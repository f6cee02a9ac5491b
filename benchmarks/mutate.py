"""Broken and hostile files, made from good ones: the same number gives the same file.

Some mutators know nothing of formats: they cut, flip, splice and double. Others write a good file again with one thing
in it changed: a number, a shape, a name, a hash that fits the lie.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Rng = np.random.Generator
NUMBERS = (b"0", b"-1", b"1e400", b"nan", b"-inf", b"4294967295", b"9223372036854775808", b"99999999999999999999", b"3")
WORDS = (0, 1, 127, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
ODD: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 3, 255, 10**6, 2**31, 2**40, 2**63, 2**70, 0.5, -0.0, 1e-320, 1e308),
    *(float("nan"), float("inf"), "", "x", "a" * 10_000, "\0", "../..", "[", [], {}, [0] * 1000, [[]], {"": {}}),
)
NESTS = (
    (b"[", b"]"),
    (b'{"a":', b"}"),
    (b"<a>", b"</a>"),
    (b"a.", b"=1"),
    (b"(", b")"),
    (b"solid ", b""),
    (b"f ", b""),
)


def whole(rng: Rng, below: int) -> int:
    """A whole number from 0, below `below`."""
    return int(rng.integers(max(below, 1)))


def choice(rng: Rng, of: Any) -> Any:
    """One of `of`."""
    return of[whole(rng, len(of))]


# what knows nothing of formats


def truncate(data: bytes, rng: Rng) -> bytes:
    return data[: whole(rng, len(data))]


def flip(data: bytes, rng: Rng) -> bytes:
    out = np.frombuffer(data, np.uint8).copy()
    for _ in range(1 + whole(rng, choice(rng, (1, 4, 64)))):
        out[whole(rng, len(out))] ^= 1 << whole(rng, 8)
    return out.tobytes()


def flip_early(data: bytes, rng: Rng) -> bytes:
    cut = min(len(data), 512)
    return flip(data[:cut], rng) + data[cut:]


def splice(data: bytes, rng: Rng) -> bytes:
    start, to, length = whole(rng, len(data)), whole(rng, len(data)), 1 + whole(rng, 256)
    return data[:to] + data[start : start + length] + data[to + length :]


def double(data: bytes, rng: Rng) -> bytes:
    start, length, times = whole(rng, len(data)), 1 + whole(rng, 2000), choice(rng, (1, 3, 200))
    return data[: start + length] + data[start : start + length] * times + data[start + length :]


def drop(data: bytes, rng: Rng) -> bytes:
    start = whole(rng, len(data))
    return data[:start] + data[start + 1 + whole(rng, choice(rng, (4, 64, 4096))) :]


def noise(data: bytes, rng: Rng) -> bytes:
    start = whole(rng, len(data))
    return data[:start] + rng.bytes(1 + whole(rng, 64)) + data[start:]


def zeros(data: bytes, rng: Rng) -> bytes:
    start, length = whole(rng, len(data)), 1 + whole(rng, 4096)
    return data[:start] + bytes(min(length, len(data) - start)) + data[start + length :]


def number(data: bytes, rng: Rng) -> bytes:
    found = list(re.finditer(rb"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?", data[: 2**20]))
    for one in sorted({whole(rng, len(found)) for _ in range(choice(rng, (1, 1, 5)))}, reverse=True) if found else ():
        data = data[: found[one].start()] + choice(rng, NUMBERS) + data[found[one].end() :]
    return data


def word(data: bytes, rng: Rng) -> bytes:
    size, early = choice(rng, (1, 2, 4, 8)), choice(rng, (True, False))
    at = whole(rng, min(len(data), 200) if early else len(data))
    return data[:at] + (choice(rng, WORDS) % 2 ** (8 * size)).to_bytes(size, "little") + data[at + size :]


def nest(data: bytes, rng: Rng) -> bytes:
    opened, closed = choice(rng, NESTS)
    times, at = choice(rng, (100, 3000, 100_000)), choice(rng, (0, whole(rng, len(data))))
    return data[:at] + opened * times + choice(rng, (b"", closed * times)) + data[at:]


def twice(data: bytes, rng: Rng) -> bytes:
    return data + data


BLIND = (truncate, flip, flip_early, splice, double, drop, noise, zeros, number, word, nest, twice)


# what writes the format again


def odd(document: Any, rng: Rng) -> Any:
    """A JSON document with one of its values, keys or items changed."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    walk(document)
    if not places:
        return choice(rng, ODD)
    node, key = choice(rng, places)
    how = whole(rng, 8)
    if how == 0:
        del node[key]
    elif how == 1 and isinstance(node, list):
        node.extend([node[key]] * choice(rng, (1, 10, 5000)))
    elif how == 2 and isinstance(node, dict):
        node[choice(rng, ("x", "", "name", "a" * 5000))] = node[key]
    elif how == 3:
        deep: Any = []
        for _ in range(choice(rng, (50, 900, 5000))):
            deep = [deep]
        node[key] = deep
    elif how == 4 and isinstance(node[key], int | float):
        node[key] = node[key] * choice(rng, (-1, 2, 1000, 2**32, 0.5, 1e300))
    else:
        node[key] = choice(rng, ODD)
    return document


def dumps(document: Any) -> bytes:
    """JSON as it comes, however deep."""
    try:
        return json.dumps(document).encode()
    except (RecursionError, ValueError):
        return b"[" * 5000 + b"]" * 5000


def opened(data: bytes) -> tuple[dict[str, Any], Any, bytes]:
    """The layout of a bank's arrays, its record and its body."""
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    return header, json.loads(header.pop("__metadata__")["lampopt"]), data[8 + length :]


def sealed(layout: Mapping[str, Any], record: Any, body: bytes) -> bytes:
    """A bank's file; what its record says of hashes is made to fit as far as anything can."""
    from lampopt.lamp import DTYPES, _seal, digest

    if isinstance(record, dict):
        for name, entry in layout.items() if isinstance(record.get("hashes"), dict) else ():
            try:
                first, last = entry["data_offsets"]
                array = np.frombuffer(body[first:last], DTYPES[entry["dtype"]]).reshape(entry["shape"])
                record["hashes"][name] = digest(array)
            except (KeyError, TypeError, ValueError, OverflowError):
                continue  # a lie that no hash fits
        record.pop("hash", None)
        try:
            record["hash"] = _seal(record)
        except (RecursionError, ValueError):
            record["hash"] = ""
    text = dumps({"__metadata__": {"lampopt": dumps(record).decode()}, **layout})
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + body


def lamp_header(data: bytes, rng: Rng) -> bytes:
    """A bank whose record or layout lies, its seals and hashes made to fit."""
    layout, record, body = opened(data)
    if whole(rng, 3):
        record = odd(record, rng)
    else:
        layout = odd(layout, rng)
    out = sealed(layout, record, body)
    return out if whole(rng, 10) else struct.pack("<Q", choice(rng, WORDS)) + out[8:]


def lamp_body(data: bytes, rng: Rng) -> bytes:
    """A bank with other numbers in its arrays (NaN, huge), hashes made to fit."""
    layout, record, body = opened(data)
    numbers = np.frombuffer(body, np.uint8).copy()
    for _ in range(1 + whole(rng, 3)):
        entry = layout[choice(rng, sorted(layout))]
        array = numbers[slice(*entry["data_offsets"])].view({"F32": "f4", "F64": "f8"}.get(entry["dtype"], "u1"))
        if array.size and array.dtype.kind == "f":
            with np.errstate(all="ignore"):
                array[whole(rng, array.size)] = choice(rng, (np.nan, np.inf, 1e308, -1e308, 5e-324, 0.0, 1e38))
    return sealed(layout, record, numbers.tobytes())


def gltf_json(data: bytes, rng: Rng) -> bytes:
    return dumps(odd(json.loads(data), rng))


def glb_json(data: bytes, rng: Rng) -> bytes:
    (length,) = struct.unpack("<I", data[12:16])
    text = dumps(odd(json.loads(data[20 : 20 + length]), rng))
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


XML = (
    b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>',
    b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
)


def xml(data: bytes, rng: Rng) -> bytes:
    """An attribute or element of an XML document changed, doubled or taken from another."""
    how = whole(rng, 6)
    if how == 0:
        at = data.find(b"?>") + 2 if b"?>" in data else 0
        return data[:at] + choice(rng, XML) + data[at:]
    found = list(re.finditer(rb'"[^"<>]*"', data))
    one, other = choice(rng, found), choice(rng, found)
    if how == 1:
        return data[: one.start()] + b'"' + choice(rng, NUMBERS) + b'"' + data[one.end() :]
    if how == 2:
        return data[: one.start()] + other.group() + data[one.end() :]
    elements = list(re.finditer(rb"<(\w+)[^<>]*>(?:[^<>]*</\1>)?", data))
    part = choice(rng, elements)
    if how == 3:
        return data[: part.start()] + part.group() * choice(rng, (2, 50, 2000)) + data[part.end() :]
    if how == 4:
        return data[: part.start()] + data[part.end() :]
    target = choice(rng, elements)
    return data[: target.end()] + part.group() + data[target.end() :]


def threemf_model(data: bytes, rng: Rng) -> bytes:
    """A 3MF archive with another model in it; or one that unpacks to far more than it should."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            if name.lower().endswith(".model"):
                content = choice(rng, (xml, xml, number, splice, double, truncate))(content, rng)
                if whole(rng, 12) == 0:
                    content = content.replace(b"<vertices>", b"<vertices>" + b" " * 18_000_000, 1)
            new.writestr(choice(rng, (name, name, name, name, "../" + name, "x" * 300 + name)), content)
            if whole(rng, 20) == 0:
                new.writestr(f"Metadata/{len(content)}.png", bytes(4_000_000))
    return out.getvalue()


def obj_lines(data: bytes, rng: Rng) -> bytes:
    lines = data.splitlines()
    start = choice(
        rng, (b"f 1 2 ", b"v ", b"usemtl ", b"o ", b"mtllib /etc/", b"f 1/1/1 ", b"g ", b"vt ", b"vn ", b"f -1 ")
    )
    lines.insert(whole(rng, len(lines)), start + choice(rng, (b"1", b"1 2 3 4", b"0", b"9" * 30, b"1 " * 20_000)))
    return b"\n".join(lines)


PATHS = (b"../a.ply", b"/etc/passwd", b"C:\\a.ply", b"a.ply/../../a.ply", b"nul.ply", b"\xe2\x80\xae.ply")
CELLS = (b"1e308", b"-1e308", b"5e-324", b"", b'"', b"\0", b"\xff", b"9" * 400, b"a" * 100_000, b"," * 20_000)
TOML = (b"1979-05-27", b"07:32:00", b"nan", b"-inf", b"true", b"[]", b"{}", b'""', b"9" * 5000, b"[[[]]]", b"{a=1}")


def csv_cells(data: bytes, rng: Rng) -> bytes:
    one = choice(rng, list(re.finditer(rb"[^,\n]+", data)))
    return data[: one.start()] + choice(rng, PATHS + CELLS) + data[one.end() :]


def toml_values(data: bytes, rng: Rng) -> bytes:
    lines = data.splitlines()
    at = choice(rng, [i for i, line in enumerate(lines) if b"=" in line])
    lines[at] = lines[at].split(b"=")[0] + b"= " + choice(rng, TOML)
    return b"\n".join(lines)


KNOWING: Mapping[str, tuple[Callable[[bytes, Rng], bytes], ...]] = {
    ".lamp": (lamp_header, lamp_body),
    ".gltf": (gltf_json,),
    ".glb": (glb_json,),
    ".dae": (xml,),
    ".3mf": (threemf_model,),
    ".obj": (obj_lines,),
    ".csv": (csv_cells,),
    ".toml": (toml_values,),
}


def mutated(data: bytes, suffix: str, rng: Rng) -> tuple[bytes, str]:
    """Another file made of `data`, and what was done to it."""
    knowing = KNOWING.get(suffix, ())
    steps = []
    for _ in range(choice(rng, (1, 1, 1, 2))):
        use = choice(rng, knowing) if knowing and not steps and whole(rng, 2) else choice(rng, BLIND)
        data = use(data, rng) if data else data
        steps.append(use.__name__)
    return data, "+".join(steps)
