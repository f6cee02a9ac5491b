"""Evaluate a decoder in a fresh process, from nothing but its class, its options and arrays on disk."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lampopt.protocols import Shared
from lampopt.testing.engine import NotApplicable, expect, options
from lampopt.types import Array

CODE = "import sys; from lampopt.testing import fresh; fresh.main(sys.argv[1])"


def evaluate(decoder: Any, shared: Shared, weights: Array, points: Array) -> Array:
    """What an equal decoder says in a fresh process.

    Raises
    ------
    NotApplicable
        If the class cannot be imported there: defined in a function or in the main program.
    """
    cls = type(decoder)
    if "<locals>" in cls.__qualname__ or cls.__module__ == "__main__":
        raise NotApplicable(
            f"{cls.__module__}:{cls.__qualname__} cannot be imported by a fresh process; move it to a module"
        )
    with tempfile.TemporaryDirectory() as folder:
        where: dict[str, Any] = {"module": cls.__module__, "class": cls.__qualname__, "options": options(decoder)}
        where["file"] = getattr(sys.modules.get(cls.__module__), "__file__", None)
        Path(folder, "decoder.json").write_text(json.dumps(where), encoding="utf-8")
        arrays = {f"shared/{name}": array for name, array in shared.items()}
        np.savez(Path(folder, "given.npz"), allow_pickle=False, **arrays, weights=weights, points=points)
        # another hash seed, so that the order of sets cannot be relied on
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path)), PYTHONHASHSEED="12345")
        done = subprocess.run(
            [sys.executable, "-c", CODE, folder], env=environment, capture_output=True, text=True, check=False
        )
        expect(done.returncode == 0, f"the fresh process failed: {done.stderr.strip()[-1000:]}")
        return np.asarray(np.load(Path(folder, "values.npy"), allow_pickle=False))


def main(folder: str) -> None:
    """The fresh process's part: read, evaluate, write."""
    where = json.loads(Path(folder, "decoder.json").read_text(encoding="utf-8"))
    found: Any = _module(where["module"], where["file"])
    for name in where["class"].split("."):
        found = getattr(found, name)
    with np.load(Path(folder, "given.npz"), allow_pickle=False) as given:
        shared = {name.removeprefix("shared/"): given[name] for name in given.files if name.startswith("shared/")}
        values = found(**where["options"]).evaluate(shared, given["weights"], given["points"])
    np.save(Path(folder, "values.npy"), values, allow_pickle=False)


def _module(name: str, file: str | None) -> Any:
    """The module by its name, or from its file where the name leads nowhere (a test's own module)."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        if file is None:
            raise
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(f"{name}: cannot be loaded from {file}")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
