"""Less drag, the rest as it is: the paper's performance-driven optimization, 10 % down from a reference, closed loop.

    python examples/drag_reduction.py [FOLDER [JUDGE]]

A real car body in 20 morphs, each labelled with a stand-in for its drag (../shared/judge beside the repository, or the
folder JUDGE): no flow solver. Length and width are measured; no measure here tells the greenhouse's angle, held too.
On a bank as small and coarse as this, references 0, 3, 5 and 7 end at -10.0, -8.9, -10.1, -10.2 %; benchmarks/drag.py
counts all cases of a finer one.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import lampopt

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/drag")
place = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).resolve().parents[2] / "shared" / "judge"
if not (place / "judge.py").exists():
    print(f"{place / 'judge.py'} is not there: give its folder as the second argument", file=sys.stderr)
    sys.exit(2)
sys.path.insert(0, str(place))
import judge  # noqa: E402


class Drag:
    """Measure: what stands in for a drag coefficient."""

    names, units = ("drag",), ("",)

    def __call__(self, mesh):
        return np.array([judge.drag(mesh)])


table = judge.write_table(folder / "table", judge.body("Hybrid"), judge.exemplars(20, seed=0), pitch=0.08)
cars = lampopt.exemplars("table", table=str(table), meshes=str(table.parent / "stl"), labels="drag", unit="m")
cars = replace(cars, labels=[[judge.drag(mesh)] for mesh in cars.meshes])  # of the coarse meshes that are mixed
decoder = lampopt.Spec("mesh-template", faces=6000, cell=0.12, tolerance=0.0, symmetry="y")  # coarse
bank = lampopt.build_bank(cars, decoder=decoder, store=folder / "cars.lamp")

reference, less, held = bank.names[0], lampopt.Reduce("drag", by=0.10), ("length", "width", "greenhouse")
asked = {"keep": held, "reference": reference, "objective": less}
open_loop = lampopt.Study(bank, **asked)
closed = lampopt.Study(bank, **asked, measures={"judge": Drag()}, measured={"drag": "judge.drag"}, turns=5)
before = lampopt.run(lampopt.Study(bank, reference=reference)).design.mesh  # as the bank makes it
print(f"asked        drag {-100 * less.by:+6.2f} %, held {', '.join(held)}")
for name, study, kept in (("open loop", open_loop, None), ("closed loop", closed, folder / "run")):
    result = lampopt.run(study, kept)
    mesh = result.design.mesh
    change, moved = judge.drag(mesh) / judge.drag(before) - 1, 1000 * (mesh.extents - before.extents)
    print(f"{name:12} drag {100 * change:+6.2f} %, length {moved[0]:+.1f} mm, width {moved[1]:+.1f} mm", end=", ")
    print("accepted" if result.accepted else "rejected")
print(*sorted((folder / "run").glob("designs/*/*")), folder / "run" / "report.html", sep="\n")
