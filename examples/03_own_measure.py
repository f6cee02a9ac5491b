"""A measure of one's own: a class and a hook. This file is the plugin; an entry point would install it for good."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import lampopt
from lampopt.errors import EmptyMesh
from lampopt.plugins import Plugins
from lampopt.testing import check_measure


@dataclass(frozen=True)
class Stance:
    """How long a part is for its width, and how much of its bounding box it fills."""

    names = ("aspect", "fill")
    units = ("", "")  # pure numbers; "L", "L^2", "L^3" are lengths, areas, volumes in the mesh's own unit

    def __call__(self, mesh):
        if len(mesh.faces) == 0:
            raise EmptyMesh("stance: expected a mesh with faces")
        length, width, height = mesh.extents
        return np.array([length / width, mesh.volume / (length * width * height)])


@lampopt.hookimpl
def lampopt_measures():
    return {"stance": Stance}


check_measure(Stance())  # what a measure has to promise: place, scale, vertex order do not matter, ...

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/measure")
folder.mkdir(parents=True, exist_ok=True)
plugins = Plugins.load(extra=[("own", sys.modules[__name__])])
bank = lampopt.build_bank(
    lampopt.exemplars("plate"),
    decoder=lampopt.Spec("gridsdf", size=33),  # coarse and quick; "mesh-template" is the one to use
    store=folder / "plate.lamp",
    plugins=plugins,
)
result = lampopt.design(bank, {"length": 2.8}, measures=["stance"], plugins=plugins)
for name in ("stance.aspect", "stance.fill"):
    print(f"{name:14} {result.check(name).value:.3f}")
