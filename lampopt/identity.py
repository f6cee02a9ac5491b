"""What tells banks, measures and models apart: short hashes of all that a result depends on."""

from __future__ import annotations

import hashlib
import json
import pickle
import uuid
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from lampopt import lamp
from lampopt.choices import absolute
from lampopt.code import definition_of
from lampopt.plugins import Plugins
from lampopt.protocols import External, Measure, Model, State
from lampopt.reading import unplaced
from lampopt.types import Bank, Spec


def contents(bank: Bank) -> dict[str, object]:
    """What in a bank a result depends on, arrays as hashes, whatever file it is in."""
    return {
        "space": [str(q) for q in (*bank.space, *bank.label_space)],
        "names": bank.names,
        "measured_by": {name: unplaced(address) for name, address in bank.measured_by.items()},
        "mesh_facts": dict(bank.mesh_facts),
        "frame": [bank.frame.scale, bank.frame.centre.tolist(), bank.frame.unit],
        "bank": [lamp.digest(getattr(bank, name)) for name in lamp.PLAIN],
        "shared": {name: lamp.digest(array) for name, array in bank.shared.items()},
        "limits": dict(bank.limits),
        "decoder": repr(bank.decoder),
    }


def whole(bank: Bank) -> str:
    """A hash of all that a bank's file holds."""
    found = bank.calibration
    evidence = None if found is None else [lamp.digest(getattr(found, name)) for name in lamp.EVIDENCE]
    return hashed(
        {
            **contents(bank),
            "ranges": [[q.low, q.high] for q in (*bank.space, *bank.label_space)],
            "calibration": None if found is None else [found.tolerance, found.checks, evidence],
            "provenance": dict(bank.provenance),
        }
    )


def offered(kind: str, choice: str | Spec, plugins: Plugins) -> list[str]:
    """What tells a plugin's object from others: who offers it, the file that defines it, with which options."""
    spec = Spec.of(choice)
    offer = plugins.get(kind, spec.name)
    return [str(offer), definition_of(offer.resolve()), repr(absolute(spec))]


def told(choice: Spec | Measure, measure: Measure, plugins: Plugins) -> list[str]:
    """What tells a measure from others: as `offered`; what it has learned, wherever the file of that lies.

    Of an `External` one the options that its values depend on.
    """
    if not isinstance(choice, Spec):
        return given(choice)
    if isinstance(measure, External):
        return offered("measure", Spec(choice.name, **measure.depends_on()), plugins)
    if not isinstance(measure, State):
        return offered("measure", choice, plugins)
    choice = Spec(choice.name, **{name: value for name, value in choice.options.items() if name != "file"})
    return [*offered("measure", choice, plugins), learned(measure)]


def learned(measure: Measure | Model) -> str:
    """A hash of all that a learned measure holds; of one that cannot tell, no other is ever taken for it."""
    if not isinstance(measure, State):
        return uuid.uuid4().hex
    return hashed([[name, lamp.digest(np.asarray(array))] for name, array in sorted(measure.state().items())])


def asked_program(choice: Spec | Measure, measure: External, plugins: Plugins) -> list[str]:
    """What tells an `External` measure from others where its values are too dear to be lost to an edit of its code."""
    who = str(plugins.get("measure", choice.name)) if isinstance(choice, Spec) else type(choice).__qualname__
    return [who, hashed(sorted(measure.depends_on().items()))]


def given(measure: Measure | Model) -> list[str]:
    """A measure given as an object: its class, the file that defines it, its state.

    Of an `External` one the options that its values depend on. What cannot be pickled may be anything: no recorded
    result is taken for its own.
    """
    cls = type(measure)
    who = [cls.__module__, cls.__qualname__, definition_of(cls)]
    if isinstance(measure, External):
        return [*who, hashed(sorted(measure.depends_on().items()))]
    if isinstance(measure, State):
        return [*who, learned(measure)]
    try:
        return [*who, _state_of(measure)]
    except Exception:  # noqa: BLE001  # whatever a stranger's __reduce__ raises
        return [*who, uuid.uuid4().hex]


def _state_of(given: object) -> str:
    """A hash of what an object holds, part by part where it can be: a pickle of all also says which parts are one."""
    if _parts(given) is not None:
        return _held(given)
    made: Any = given.__reduce_ex__(4)
    apart = isinstance(made, tuple) and len(made) > 2 and isinstance(made[2], dict) and not any(made[3:])
    parts = {"how it is made": made[:2], **made[2]} if apart else {"all of it": given}
    return hashed({str(name): _held(value) for name, value in parts.items()})


def _held(value: object) -> str:
    """A hash of one part."""
    if isinstance(value, set | frozenset):  # whose order is another in each process
        return hashed(sorted(map(_held, value)))
    if (parts := _parts(value)) is not None:
        return hashed({name: _held(part) for name, part in parts.items()})
    return hashlib.blake2b(pickle.dumps(value)).hexdigest()


def _parts(value: object) -> dict[str, object] | None:
    """A dataclass' fields, a mesh's vertices and faces: what either keeps of its own work is no part of it."""
    cls = type(value)
    if is_dataclass(cls):
        return {"class": [cls.__module__, cls.__qualname__], **{f.name: getattr(value, f.name) for f in fields(cls)}}
    if cls.__module__.startswith("trimesh.") and hasattr(value, "faces"):
        return {name: np.asarray(getattr(value, name)) for name in ("vertices", "faces")}
    return None


def hashed(value: object) -> str:
    """A short hash of plain values."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=12).hexdigest()
