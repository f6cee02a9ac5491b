"""A family from one mesh: free-form deformations of a car body, then a design with another roof and ramp.

Here the body is made first, of planes; yours is any STL, OBJ, PLY or GLB. Its nose points along -x, its roof along z.
"""

import sys
from pathlib import Path

import numpy as np

import lampopt
from lampopt.metrics import surface_distance
from lampopt.testing import shapes

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/morph")
folder.mkdir(parents=True, exist_ok=True)

body = shapes.box((1, 1, 1), divisions=5)  # along, across, up: -0.5 to 0.5 each
along, across, up = np.array(body.vertices).T + 0.5
roof = np.interp(along, (0, 0.25, 0.45, 0.72, 0.80, 1), (0.80, 0.98, 1.40, 1.40, 1.08, 0.98))
floor = np.interp(along, (0, 0.16, 0.80, 1), (0.20, 0.14, 0.14, 0.24))
height = floor + up * (roof - floor)
body.vertices = np.column_stack([4.2 * along, (2 * across - 1) * np.interp(height, (0.75, 1.4), (0.9, 0.6)), height])
body.export(folder / "car.stl")

cars = lampopt.exemplars(
    "morph",
    mesh=folder / "car.stl",
    unit="m",
    deformations=["length", "roof", "ramp", "hood"],
    ranges=["length=-0.3:0.3", "roof=-0.1:0.15"],  # offsets from the body as it is; the others keep their own
    design="ends",  # the body itself, then each deformation alone at both of its ends
)
for name, mesh in zip(cars.names, cars.meshes, strict=True):
    print(f"{name:12} {mesh.extents[0]:.3f} m long, {mesh.extents[2]:.3f} m high")

decoder = lampopt.Spec("gridsdf", size=49)  # coarse and quick; "mesh-template" is the one to use
bank = lampopt.build_bank(cars, decoder=decoder, store=folder / "car.lamp")
result = lampopt.design(bank, {"roof": "80 mm", "ramp": "3 deg"}, keep=["length", "hood"], reference="base")
for check in result.checks:
    print(f"{check.name:14} {check.value:10.4g} {check.unit:10} {'passed' if check.passed else 'FAILED'}  {check.note}")

if result.design.mesh is not None:
    true = cars.mesh_at(result.design.predicted)  # a family knows what should have come
    print(f"from the true mesh: {1000 * surface_distance(result.design.mesh, true):.1f} mm")
    result.design.mesh.export(folder / "new.stl")
