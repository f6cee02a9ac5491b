"""glTF: JSON that describes buffers, and scenes that place meshes."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lampopt.errors import InputError
from lampopt.meshfile.placing import PLACES, Parts, Size
from lampopt.reading import brief

JSON, BIN = 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # bytes by componentType
SHAPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
READ = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")  # required extensions that move no vertex
ALWAYS, TIMES = 32 * 2**20, 4  # bytes that views may come to: in any file, and as a multiple of a larger one
Json = Mapping[str, Any]


def glb(data: bytes) -> int:
    """The container's lengths are its own; then as `gltf`."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise InputError("expected a GLB header, got another: no GLB file, or one cut short")
    version, length, chunk, kind = struct.unpack("<IIII", data[4:20])
    if version != 2:
        raise InputError(f"expected glTF 2, got version {version}")
    if length != len(data):
        raise InputError(f"its header promises {length:,} bytes, the file has {len(data):,}")
    if kind != JSON or chunk > length - 20:
        raise InputError(f"expected a JSON chunk within the file first, got one of {chunk:,} bytes")
    binary = [body for kind, body in _chunks(data, 20 + chunk) if kind == BIN]
    return _scene(_parsed(data[20 : 20 + chunk]), len(data), binary)


def gltf(data: bytes) -> int:
    """Everything is in the file; accessors lie within buffers; the scene is a tree. The number of triangles."""
    return _scene(_parsed(data), len(data), [])


def _chunks(data: bytes, start: int) -> Iterator[tuple[int, bytes]]:
    while start + 8 <= len(data):
        length, kind = struct.unpack("<II", data[start : start + 8])
        if length > len(data) - start - 8:
            raise InputError(f"a chunk promises {length:,} bytes, {len(data) - start - 8:,} follow")
        yield kind, data[start + 8 : start + 8 + length]
        start += 8 + length


def _parsed(text: bytes) -> Json:
    try:
        document = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected JSON, got something else: {brief(error) or 'nested too deep'}") from error
    if not isinstance(document, dict):
        raise InputError(f"expected a JSON object, got {brief(document)}")
    return document


def _scene(document: Json, size: int, binary: Sequence[bytes]) -> int:
    required = _list(document, "extensionsRequired", str)
    if unread := [name for name in required if not name.startswith(READ)]:
        raise InputError(f"it needs glTF extensions that are not read: {brief(', '.join(unread))}; export without")
    buffers = [_buffer(buffer) for buffer in _list(document, "buffers", dict)]
    if buffers.count(None) > len(binary):
        raise InputError("expected buffers in the file, got one that is in none of its chunks")
    views = _list(document, "bufferViews", dict)
    lengths = [_whole(view, "byteLength") for view in views]
    accessors = _list(document, "accessors", dict)
    most = max(ALWAYS, TIMES * size)
    if sum(lengths) > most or sum(_bytes(accessor, lengths) for accessor in accessors) > most:
        raise InputError(f"its buffer views come to more than {most:,} bytes, the file has {size:,}")
    counts = [accessor["count"] for accessor in accessors]
    parts = Parts()
    for i, mesh in enumerate(_list(document, "meshes", dict)):
        for primitive in _list(mesh, "primitives", dict):
            parts.add(("mesh", i), _size(primitive, counts))
    if sum(size.places for size in parts.own.values()) > PLACES:
        raise InputError(
            f"its meshes have more than {PLACES:,} primitives: more than can be meant; export it as one mesh"
        )
    return _placed(document, parts)


def _buffer(buffer: Json) -> str | None:
    uri = buffer.get("uri")
    if uri is None:
        return None
    if not isinstance(uri, str) or not uri.startswith("data:") or ";base64," not in uri[:200]:
        raise InputError(
            f"it keeps its vertices in another file, {brief(uri)!r}, which is not opened: export it as .glb, or with "
            "its buffers embedded"
        )
    return uri


def _bytes(accessor: Json, views: Sequence[int]) -> int:
    """How long an accessor's data are, once they are known to lie within its view."""
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InputError("sparse and compressed accessors are not read: export it plain")
    kind, shape = accessor.get("componentType"), accessor.get("type")
    if not isinstance(kind, int) or not isinstance(shape, str) or kind not in COMPONENTS or shape not in SHAPES:
        raise InputError(f"accessor: expected a known componentType and type, got {brief(kind)} and {brief(shape)}")
    item = COMPONENTS[kind] * SHAPES[shape]
    length = _whole(accessor, "count") * item
    view = views[_index(accessor["bufferView"], views, "bufferView")]
    if _whole(accessor, "byteOffset", 0) > view or (accessor["count"] - 1) + item > view:
        raise InputError(f"an accessor promises {accessor['count']:,} items, its view has {view:,} bytes")
    return length


def _size(primitive: Json, counts: Sequence[int]) -> Size:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        return Size()
    vertices = counts[_index(attributes["POSITION"], counts, "POSITION")]
    corners = counts[_index(primitive["indices"], counts, "indices")] if "indices" in primitive else vertices
    mode = primitive.get("mode", 4)
    triangles = corners // 3 if mode == 4 else max(corners - 2, 0) if mode in (5, 6) else 0
    return Size(1, triangles, vertices)


def _placed(document: Json, parts: Parts) -> int:
    nodes = _list(document, "nodes", dict)
    within: dict[int, int] = {}
    for i, node in enumerate(nodes):
        if "mesh" in node:
            parts.put(i, ("mesh", _index(node["mesh"], _list(document, "meshes", dict), "mesh")))
        for child in _list(node, "children", int):
            _index(child, nodes, "node")
            if child in within:
                raise InputError(f"expected a tree of nodes, got node {child} within {within[child]} and {i}")
            within[child] = i
            parts.put(i, child)
    scenes = _list(document, "scenes", dict)
    chosen = scenes[_index(document.get("scene", 0), scenes, "scene")] if scenes else {}
    roots = _list(chosen, "nodes", int)
    for root in roots:
        _index(root, nodes, "node")
    return parts.spread(roots)


def _list(of: Json, key: str, kind: type) -> list[Any]:
    found = of.get(key, [])
    if not isinstance(found, list) or not all(isinstance(item, kind) for item in found):
        raise InputError(f"{key}: expected a list, each {kind.__name__}, got {brief(found)}")
    return found


def _whole(of: Json, key: str, default: int | None = None) -> int:
    found = of.get(key, default)
    if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found < 2**53:
        raise InputError(f"{key}: expected a whole number of at least 0, got {brief(found)}")
    return found


def _index(found: object, of: Sequence[object], what: str) -> int:
    if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found < len(of):
        raise InputError(f"{what}: expected one of the {len(of)} there are, got {brief(found)}")
    return found
