"""Your own shapes: a folder of meshes and a table of what is known about them.

Here the folder and the table are written first, from the built-in plates; then only they are used.
"""

import csv
import sys
from pathlib import Path

import lampopt

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/table")
meshes = folder / "stl"
meshes.mkdir(parents=True, exist_ok=True)

plates = lampopt.exemplars("plate", count=12, design="lhs")
with open(folder / "plates.csv", "w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["mesh", *(f"{q.name} [{q.unit}]" for q in plates.space)])
    for name, mesh, row in zip(plates.names, plates.meshes, plates.parameters, strict=True):
        mesh.export(meshes / f"{name}.stl")
        table.writerow([f"{name}.stl", *row])

exemplars = lampopt.exemplars("table", table=str(folder / "plates.csv"), meshes=str(meshes), unit="m")
bank = lampopt.build_bank(
    exemplars,
    decoder=lampopt.Spec("gridsdf", size=33),  # coarse and quick; "mesh-template" is the one to use
    store=folder / "plates.lamp",
    measured={"length": "extents.length", "width": "extents.width"},  # so that these are checked on every new mesh
)
result = lampopt.design(bank, {"length": "2700 mm", "width": 1.8})
for check in result.checks:
    print(f"{check.name:14} {check.value:10.4g} {check.unit:10} {'passed' if check.passed else 'FAILED'}  {check.note}")
result.design.mesh.export(folder / "new.stl")
print(f"{'accepted' if result.accepted else 'rejected'}: {folder / 'new.stl'}")
