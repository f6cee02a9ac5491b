"""What a learned measure is kept as: named arrays, each looked at before anything is measured with it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .conformal import Region
from .pooled import PointNet, Waves
from .regression import Kernel, Linear

# Sides of each array: a letter stands for one number throughout. n meshes, p values, F features, H hidden neurons;
# k directions are each region's own.
SHAPES: Mapping[Any, Mapping[str, str]] = {
    PointNet: {"first": "6H", "first_bias": "H", "second": "HF", "second_bias": "F"},
    Waves: {"vectors": "6F", "phases": "F"},
    Linear: {"weights": "Fp", "intercept": "p"},
    Kernel: {"centres": "nF", "sharpness": "p", "weights": "np"},
    Region: {"middle": "F", "directions": "Fk", "off": "", "limit": ""},
}
OWN = {"scale": "", "features": "2F", "values": "2p", "reach": "2p", "errors": "np"}
PARTS = {"pooled": (PointNet, Waves), "regression": (Linear, Kernel)}
ABOVE_ZERO = {"scale", "sharpness", "off", "limit"}


def kept(
    names: Sequence[str], units: Sequence[str], own: Mapping[str, Array], parts: Mapping[str, Any]
) -> dict[str, Array]:
    """Arrays by name: `own`, those of `parts` under the part's name, and the words as the bytes of a JSON text."""
    words: dict[str, Any] = {"names": names, "units": units, "meshes": len(own["errors"])}
    arrays = dict(own)
    for part, held in parts.items():
        if part in PARTS:
            words[part] = type(held).__name__
        arrays |= {f"{part}.{field.name}": getattr(held, field.name) for field in fields(held)}
    return arrays | {"words": np.frombuffer(json.dumps(words).encode(), np.uint8)}


def read(state: Mapping[str, Array]) -> dict[str, Any]:
    """`names`, `units`, the arrays and parts that `kept` made `state` of, and `regions`, one after another.

    Raises
    ------
    InputError
        If an array is missing or not of its shape, a number is not finite or not above zero where it must be, or the
        words are none.
    """
    words = _words(state.get("words"))
    names, units = (words.get(name, ()) for name in ("names", "units"))
    sound_words(names, units)
    if type(words.get("meshes")) is not int:
        raise _wrong("meshes: expected their number")
    sides = {"2": 2, "6": 6, "p": len(names), "n": words["meshes"]}
    found: dict[str, Any] = {"names": tuple(names), "units": tuple(units)}
    found |= {name: _array(state, name, shape, sides) for name, shape in OWN.items()}
    for part, kinds in PARTS.items():
        kind = next((kind for kind in kinds if kind.__name__ == words.get(part)), None)
        if kind is None:
            raise _wrong(
                f"{part}: expected {' or '.join(k.__name__ for k in kinds)}, got {str(words.get(part))[:50]!r}"
            )
        found[part] = _part(state, part, kind, sides)
    regions: list[Region] = []
    while f"region{len(regions)}.middle" in state:
        regions.append(_part(state, f"region{len(regions)}", Region, sides))
    if (found["values"][1] <= 0).any() or (found["features"][1] < 0).any() or not found["features"][1].any():
        raise _wrong("values, features: expected spreads above 0")
    if (found["reach"][0] >= found["reach"][1]).any() or not np.isfinite(found["errors"]).any(axis=0).all():
        raise _wrong("reach, errors: expected a range and an error for each value")
    return found | {"regions": tuple(regions)}


def sound_words(names: Any, units: Any) -> None:
    """Raise InputError unless there is a unit for each name, all are texts, printable, and no name comes twice."""
    for words in (names, units):
        if not isinstance(words, list | tuple) or not all(isinstance(w, str) and w.isprintable() for w in words):
            raise InputError(f"names and units: expected printable texts, got {ascii(words)[:100]}")
    if not names or len(units) != len(names) or not all(names):
        raise InputError(f"expected a name and a unit for each value, got {len(names)} names and {len(units)} units")
    if len(set(names)) < len(names):
        raise InputError(f"names: expected distinct ones, got {', '.join(names)}")


def _part(state: Mapping[str, Array], part: str, kind: Any, sides: dict[str, int]) -> Any:
    sides.pop("k", None)
    return kind(**{name: _array(state, f"{part}.{name}", shape, sides) for name, shape in SHAPES[kind].items()})


def _array(state: Mapping[str, Array], name: str, shape: str, sides: dict[str, int]) -> Array:
    """The array `name`, new letters of its `shape` entered in `sides`."""
    array, last = state.get(name), name.rpartition(".")[2]
    if not isinstance(array, np.ndarray) or array.dtype != np.float64:
        raise _wrong(f"{name}: expected an array of 64-bit floats, got {getattr(array, 'dtype', 'none')}")
    if array.ndim == len(shape):
        for letter, side in zip(shape, array.shape, strict=True):
            sides.setdefault(letter, side)
    expected = tuple(sides.get(letter, 0) for letter in shape)
    if array.shape != expected or 0 in expected:
        raise _wrong(f"{name}: expected the shape {expected}, got {array.shape}")
    if not np.isfinite(array).all() and not (name == "errors" and not np.isinf(array).any()):
        raise _wrong(f"{name}: expected finite numbers")
    if last in ABOVE_ZERO and (array <= 0).any():
        raise _wrong(f"{name}: expected numbers above 0")
    if last == "directions" and not array.any(axis=0).all():
        raise _wrong(f"{name}: expected directions, got one of no length")
    return array


def _words(array: Any) -> dict[str, Any]:
    if not isinstance(array, np.ndarray) or array.dtype != np.uint8 or array.ndim != 1:
        raise _wrong("words: expected the bytes of a text")
    try:
        words = json.loads(array.tobytes())
    except (ValueError, RecursionError) as error:
        raise _wrong(f"words: {str(error)[:100]}") from error
    if not isinstance(words, dict):
        raise _wrong("words: expected names and units")
    return words


def _wrong(what: str) -> InputError:
    return InputError(f"learned measure: expected the arrays of its state(): {what}; learn it anew")
