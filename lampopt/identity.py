"""What tells banks, measures and models apart: short hashes of all that a result depends on."""

from __future__ import annotations

import hashlib
import json
import pickle
import uuid

import numpy as np

from lampopt import lamp
from lampopt.choices import absolute
from lampopt.code import source_of
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
    return [*plugins.get(kind, spec.name).exactly, repr(absolute(spec))]


def told(choice: Spec | Measure, measure: Measure, plugins: Plugins) -> list[str]:
    """What tells a measure from others: as `offered`; what it has learned, wherever the file of that lies.

    Of an `External` one, whose values are its program's and dear, who offers it, and the options that they depend on.
    """
    if not isinstance(choice, Spec):
        return given(choice)
    if isinstance(measure, External):
        return [str(plugins.get("measure", choice.name)), repr(Spec(choice.name, **measure.depends_on()))]
    if not isinstance(measure, State):
        return offered("measure", choice, plugins)
    choice = Spec(choice.name, **{name: value for name, value in choice.options.items() if name != "file"})
    return [*offered("measure", choice, plugins), learned(measure)]


def learned(measure: Measure | Model) -> str:
    """A hash of all that a learned measure holds; of one that cannot tell, no other is ever taken for it."""
    if not isinstance(measure, State):
        return uuid.uuid4().hex
    return hashed([[name, lamp.digest(np.asarray(array))] for name, array in sorted(measure.state().items())])


def given(measure: Measure | Model) -> list[str]:
    """A measure given as an object: its class, the file that defines it, its options.

    Of an `External` one those that its values depend on, whatever file. What cannot be pickled may be anything: no
    recorded result is taken for its own.
    """
    cls = type(measure)
    who = [cls.__module__, cls.__qualname__]
    if isinstance(measure, External):
        return [*who, hashed(sorted(measure.depends_on().items()))]
    if isinstance(measure, State):
        return [*who, source_of(cls), learned(measure)]
    try:
        options = measure.__reduce_ex__(4)[2]  # each by itself: a pickle of all says which of them are one object
        by_name = options if isinstance(options, dict) else {"": measure}
        pickled = {str(name): hashlib.blake2b(pickle.dumps(value)).hexdigest() for name, value in by_name.items()}
    except Exception:  # noqa: BLE001  # whatever a stranger's __reduce__ raises
        return [*who, uuid.uuid4().hex]
    return [*who, source_of(cls), hashed(pickled)]


def hashed(value: object) -> str:
    """A short hash of plain values."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=12).hexdigest()
