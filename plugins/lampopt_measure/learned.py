"""A measure that was learned and kept in a file, by the same door as any other."""

from __future__ import annotations

from dataclasses import dataclass

from lampopt import load_measure
from lampopt.errors import InputError
from lampopt.protocols import Measure


@dataclass(frozen=True)
class Learned:
    """What `lampopt.fit_surrogate` stored: making a `Learned` gives the measure that `file` holds, with its abilities.

    Parameters
    ----------
    file
        Written by `fit_surrogate(..., store=file)`.

    Raises
    ------
    InputError, PluginError
        As `lampopt.load_measure`.
    """

    file: str = ""

    def __new__(cls, file: str = "") -> Measure:  # type: ignore[misc]  # so that what it cannot do is not offered
        """The measure in `file`."""
        if not file:
            raise InputError("learned: expected the option `file`, what `lampopt surrogate fit --out` wrote")
        return load_measure(file)

    @staticmethod
    def example() -> Measure:
        """A length learned from boxes, for `lampopt.testing.check_plugin`."""
        import atexit
        from pathlib import Path
        from shutil import rmtree
        from tempfile import mkdtemp

        import numpy as np
        from trimesh.creation import box

        from lampopt import Exemplars, Parameter, Spec, fit_surrogate

        folder = Path(mkdtemp(prefix="lampopt-learned-"))
        atexit.register(rmtree, folder, ignore_errors=True)
        lengths = np.linspace(0.8, 1.6, 9)
        boxes = Exemplars(
            parameters=lengths[:, None],
            space=(Parameter("length", "m"),),
            meshes=[box((length, 0.5, 0.4)) for length in lengths],
            names=tuple(f"box_{i}" for i in range(len(lengths))),
            unit="m",
        )
        fit_surrogate(boxes, Spec("calibrated", by="extents.length"), store=folder / "length.measure")
        return load_measure(folder / "length.measure")
