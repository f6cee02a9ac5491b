"""What a mesh file says of itself, held against its size before a parser believes it.

A guard takes the file's bytes and raises InputError where they cannot be what they say, where reading them would take
memory or time out of proportion, or where they lead to other files. It returns how many triangles the file promises,
so that a parser that skips what it does not understand is found out.
"""

from __future__ import annotations

import io
import re
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile.collada import collada
from lampopt.meshfile.gltf import glb, gltf
from lampopt.meshfile.threemf import threemf
from lampopt.reading import brief

PLY_TYPES = {  # names by bytes
    1: ("char", "uchar", "int8", "uint8"),
    2: ("short", "ushort", "int16", "uint16", "float16"),
    4: ("int", "uint", "int32", "uint32", "float", "float32"),
    8: ("int64", "uint64", "double", "float64"),
}
PLY_SIZES = {name: size for size, names in PLY_TYPES.items() for name in names}
NO_SHAPE = re.compile(rb"(?m)^[ \t]*(?:usemtl|mtllib|o|g|s)(?:[ \t][^\n]*)?$")  # OBJ: each group would be a mesh
REMARK = re.compile(rb"(?m)^((?:v|vn|vt|f)[ \t][^#\n]*)#[^\n]*")  # OBJ: trimesh reads on where a line ends in one
INDENT = re.compile(rb"(?m)(?<!\\\n)(?<!\\\r\n)^[ \t\v\f]+")  # OBJ: trimesh skips such lines, silently
PLY_HEADER = 2**20  # bytes: room for long comments
PLY_PROPERTIES = 1000
PLY_ELEMENTS = 64
STL_HEAD, STL_FACET = 84, 50  # bytes
STL_CORNER, STL_END = re.compile(rb"(?im)^[ \t]*vertex[ \t]([^\n]*)$"), re.compile(rb"(?im)^[ \t]*endfacet\b")
STARTS = {  # how files begin → what they are
    b"ply": ".ply",
    b"glTF": ".glb",
    b"OFF": ".off",
    b"COFF": ".off",
    b"solid": ".stl",
    b"PK\x03\x04": "a ZIP archive (.3mf is one)",
    b"<?xml": "an XML file (.dae is one)",
    b"<COLLADA": ".dae",
    b"{": "a JSON file (.gltf is one)",
    b"ISO-10303-21": "a STEP file, which holds surfaces, no mesh: export a mesh from it",
    b"\x1f\x8b": "a gzip file: unpack it",
    b"\x89HDF": "an HDF5 file",
    b"Kaydara FBX": "an FBX file",
    b"version https://git-lfs": "a Git LFS pointer: fetch the file itself with git lfs pull",
}


def binary_stl(data: bytes) -> int | None:
    """How many facets a binary STL file has; None where its size says that it is none."""
    if len(data) < STL_HEAD:
        return None
    count = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little")
    return count if len(data) == STL_HEAD + STL_FACET * count else None


def stl(data: bytes) -> int:
    """Binary, and as long as its facets."""
    count = binary_stl(data)
    if count is None:
        raise InputError(
            f"expected text (solid … facet … endsolid) or {STL_HEAD} bytes and {STL_FACET} more for each facet, got "
            f"{len(data):,} bytes: the file is cut short, or no STL file"
        )
    return count


def text_stl(data: bytes) -> tuple[int, Mapping[str, Any]]:
    """As many facets as it ends, and their corners: trimesh's parser would stop at what is no number, silently."""
    if not re.search(rb"(?i)\bendsolid\b[^\n]*\s*\Z", data):
        raise InputError("expected a line endsolid at the end, got none: the file is cut short")
    corners = array("d")
    for found in STL_CORNER.finditer(data):
        try:
            corners.extend(map(float, found.group(1).split()))
        except ValueError as error:
            got = brief(found.group(1).decode("latin-1"))
            raise InputError(f"vertex: expected three numbers, got {got!r}") from error
    facets = len(STL_END.findall(data))
    if len(corners) != 9 * facets:
        got = f"{len(corners):,} numbers for {facets:,} facets"
        raise InputError(f"expected three corners of three numbers for each facet, got {got}: it is damaged")
    return facets, {"vertices": np.array(corners).reshape(-1, 3), "faces": np.arange(3 * facets).reshape(-1, 3)}


def obj(data: bytes) -> int:
    """Corners count from 1; those that count backwards are read only behind the last vertex."""
    if re.search(rb"(?m)^f[ \t][^\n]*?(?<![\d/.eE+-])[+-]?0+(?=[\s/]|\Z)", data):
        raise InputError("expected corners of faces that count from 1, got 0")
    backwards = re.search(rb"(?m)^f[ \t][^\n]*?[ \t]-", data)
    if backwards and data.rfind(b"\nv ") > backwards.start():
        raise InputError("corners that count backwards before the last vertex are not read: number them from 1")
    return sum(1 for _ in re.finditer(rb"(?m)^f(?:[ \t]+[^\s\\]+){3}", data))


def off(data: bytes) -> int:
    """The counts in the header are there as lines."""
    lines = [line for line in (raw.split(b"#")[0].strip() for raw in data.splitlines()) if line]
    if not lines or not re.match(rb"\w*OFF\b", lines[0]):
        raise InputError("expected OFF in the first line")
    counts = (lines[0].split(b"OFF", 1)[1].split() or (lines[1].split() if len(lines) > 1 else []))[:2]
    if len(counts) < 2 or not all(re.fullmatch(rb"\d{1,12}", count) for count in counts):
        raise InputError(f"expected numbers of vertices and faces in the header, got {brief(counts)}")
    vertices, faces = map(int, counts)
    if vertices + faces > len(lines):
        raise InputError(f"the header promises {vertices:,} vertices and {faces:,} faces, {len(lines):,} lines follow")
    return faces


def _fanned(data: bytes) -> bytes:
    """OFF of triangles in place of polygons, which trimesh takes all to have the same number of corners."""
    lines = [line for line in (raw.split(b"#")[0].strip() for raw in data.splitlines()) if line]
    if not re.match(rb"C?OFF\b", lines[0]):
        return data
    own = lines[0].split(b"OFF", 1)[1].split()
    first = 1 if own else 2  # of the vertices
    counts = own or lines[1].split()
    start = first + int(counts[0])
    corners = [line.split() for line in lines[start : start + int(counts[1])]]
    if {face[0] for face in corners} <= {b"3"}:
        return data
    fans = [b"3 " + b" ".join((face[1], face[k], face[k + 1])) for face in corners for k in range(2, int(face[0]))]
    head = [b"OFF", b"%d %d 0" % (start - first, len(fans))]
    return b"\n".join([*head, *(b" ".join(line.split()[:3]) for line in lines[first:start]), *fans, b""])


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    least: int  # bytes of one at the least
    lists: int


def ply(data: bytes) -> int:
    """Every element in the header fits into what follows it."""
    head, end, _ = data[:PLY_HEADER].partition(b"end_header")
    if not end:
        raise InputError("expected a header that ends with end_header, got none")
    first, *lines = head.decode("utf-8", "replace").splitlines()
    if first.strip() != "ply":
        raise InputError(f"expected ply in the first line, got {brief(first)!r}")
    elements: list[_Element] = []
    properties: list[str] = []
    text = None
    for line in lines:
        words = line.split()
        if words[:1] == ["format"] and len(words) == 3:
            text = words[1] == "ascii"
        elif words[:1] == ["element"]:
            if len(elements) >= PLY_ELEMENTS:
                raise InputError(f"expected at most {PLY_ELEMENTS} elements, got more")
            if len(words) != 3 or not re.fullmatch(r"\d{1,12}", words[2]) or words[1] in {e.name for e in elements}:
                raise InputError(f"expected `element NAME COUNT`, each name once, got {brief(line)!r}")
            elements.append(_Element(words[1], int(words[2]), 0, 0))
            properties = []
        elif words[:1] == ["property"]:
            if not elements or len(words) not in (3, 5) or (len(words) == 5 and words[1] != "list"):
                raise InputError(f"expected `property TYPE NAME` of an element, got {brief(line)!r}")
            if words[-1] in properties or len(properties) >= PLY_PROPERTIES:
                raise InputError(f"expected each property once and at most {PLY_PROPERTIES}, got {brief(words[-1])!r}")
            properties.append(words[-1])
            size = _ply_size(words[2] if len(words) == 5 else words[1])
            e = elements[-1]
            elements[-1] = _Element(e.name, e.count, e.least + size, e.lists + (len(words) == 5))
        elif words and words[0] not in ("comment", "obj_info"):
            raise InputError(f"expected element, property or comment, got {brief(line)!r}")
    if text is None:
        raise InputError("expected a line `format …` in the header, got none")
    rest = len(data) - len(head) - len(end)
    least = sum(e.count * (2 * bool(e.least) if text else e.least) for e in elements)
    if least > rest:
        promised = ", ".join(f"{e.count:,} {brief(e.name)}" for e in elements)
        raise InputError(f"the header promises {promised}: at least {least:,} bytes; {rest:,} follow")
    if any(e.count and not e.least for e in elements):
        raise InputError("expected elements with properties, got one without")
    return next((e.count for e in elements if e.name == "face"), 0)


def _ply_size(kind: str) -> int:
    if kind not in PLY_SIZES:
        raise InputError(f"expected a type such as float or uchar, got {brief(kind)!r}")
    return PLY_SIZES[kind]


GUARDS: dict[str, Callable[[bytes], int]] = {
    ".stl": stl,
    ".obj": obj,
    ".ply": ply,
    ".off": off,
    ".glb": glb,
    ".gltf": gltf,
    ".dae": collada,
}


def parsed(data: bytes, suffix: str) -> tuple[int, Mapping[str, Any]]:
    """How many triangles a file promises, and what a parser of trimesh returns of it; raises anything."""
    if suffix == ".3mf":
        return threemf(data)
    if suffix == ".stl" and binary_stl(data) is None and re.match(rb"(?i)\s*solid\b", data):
        return text_stl(data)
    from trimesh.exchange.load import mesh_loaders

    if suffix == ".obj":
        data = REMARK.sub(rb"\1", NO_SHAPE.sub(b"", INDENT.sub(b"", data))).replace(b"\t", b" ")
    promised = GUARDS[suffix](data)
    if suffix == ".off":
        data = _fanned(data)
    load: Any = mesh_loaders[suffix[1:]]
    # Bytes instead of the file: a parser that knew where it lies could open what it names beside itself.
    return promised, load(io.BytesIO(data), file_type=suffix[1:], resolver=None, skip_materials=True)


def recognised(data: bytes, suffix: str) -> str:
    """What a file that could not be read looks like, where that is something else than its suffix says; or ""."""
    start = data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")
    kind = next((kind for begin, kind in STARTS.items() if start.startswith(begin)), "")
    if not kind and binary_stl(data):
        kind = ".stl"
    if not kind or kind == suffix or f"({suffix} " in kind:
        return ""
    return f"; it looks like {kind}" if not kind.startswith(".") else f"; it looks like a {kind} file: rename it"
