"""What tells banks, measures and models apart: short hashes of all that a result depends on."""

from __future__ import annotations

import hashlib
import json
import pickle
import sys
import uuid
from functools import cache
from pathlib import Path

import numpy as np

from lampopt import lamp
from lampopt.plugins import Plugins
from lampopt.protocols import External, Measure, Model, State
from lampopt.types import Bank, Spec


def contents(bank: Bank) -> dict[str, object]:
    """What in a bank a result depends on, arrays as hashes, whatever file it is in."""
    return {
        "space": [str(q) for q in (*bank.space, *bank.label_space)],
        "names": bank.names,
        "measured_by": dict(bank.measured_by),
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
    return [str(offer), source(offer.resolve()), repr(spec)]


def told(choice: Spec | Measure, measure: Measure, plugins: Plugins) -> list[str]:
    """What tells a measure from others: as `offered`, and what it has learned.

    Of an `External` one the options that its values depend on.
    """
    if not isinstance(choice, Spec):
        return given(choice)
    if isinstance(measure, External):
        choice = Spec(choice.name, **measure.depends_on())
    return [*offered("measure", choice, plugins), *([learned(measure)] if isinstance(measure, State) else [])]


def learned(measure: Measure | Model) -> str:
    """A hash of all that a learned measure holds; of one that cannot tell, no other is ever taken for it."""
    if not isinstance(measure, State):
        return uuid.uuid4().hex
    return hashed([[name, lamp.digest(np.asarray(array))] for name, array in sorted(measure.state().items())])


def given(measure: Measure | Model) -> list[str]:
    """A measure given as an object: its class, the file that defines it, its options.

    Of an `External` one those that its values depend on. What cannot be pickled may be anything: no recorded result is
    taken for its own.
    """
    cls = type(measure)
    try:
        if isinstance(measure, External):
            options = repr(sorted(measure.depends_on().items())).encode()
        else:
            options = learned(measure).encode() if isinstance(measure, State) else pickle.dumps(measure)
    except Exception:  # noqa: BLE001  # whatever a stranger's __reduce__ raises
        options = uuid.uuid4().bytes
    return [cls.__module__, cls.__qualname__, source(cls), hashlib.blake2b(options).hexdigest()]


@cache
def source(cls: type) -> str:
    """A hash of the file that defines a class, with all that it may call there: versions stay while it is written.

    What cannot be read (typed at a prompt) may be anything: no recorded result is taken for its own.
    """
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    try:
        content = Path(file).read_bytes() if file else uuid.uuid4().bytes
    except OSError:
        content = uuid.uuid4().bytes
    return hashlib.blake2b(content).hexdigest()


def hashed(value: object) -> str:
    """A short hash of plain values."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=12).hexdigest()
