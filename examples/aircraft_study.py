"""A blended wing body with 10 % more lift over drag, span and planform area held: seconds a design, no flow grid.

    python examples/aircraft_study.py [FOLDER]

AeroSandbox's AeroBuildup labels the exemplars and closes the loop, each time on the sections of the mesh that was made.
The answer is then judged by the other model, a vortex lattice, which knows the induced drag alone; so both are asked at
8° incidence, where that is most of the drag. The aircraft are of one connectivity, and linear in chords and setbacks
(not in sweeps), so that decoder `vertex-template` mixes them exactly. Needs the extra `aero`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import lampopt
from lampopt.types import Parameter

WIDTHS = np.array([200.0, 200.0, 700.0])  # of the panels [mm]: so the span is held
folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/aircraft")
folder.mkdir(parents=True, exist_ok=True)

drawn = lampopt.exemplars("bwb", count=24, chordwise=48, spanwise=80)
rows = np.array(drawn.parameters)  # B1, B2, B3, C2, C3, C4 [mm], S1, S2, S3 [deg]
rows[:, :3], rows[0, 6:] = WIDTHS, (40, 40, 24)  # the reference is swept as little as any
aircraft = replace(
    drawn,
    parameters=np.column_stack([rows[:, 3:6], WIDTHS * np.tan(np.radians(rows[:, 6:]))]),
    space=(*drawn.space[3:6], *(Parameter(f"setback {k}", "mm") for k in (1, 2, 3))),  # of each panel's outer end
    meshes=[drawn.mesh_at(row) for row in rows],
    measured={name: f"bwb.{name}" for name in ("C2", "C3", "C4")},
    mesh_at=None,
)
flow = lampopt.Spec("aerosandbox", alpha=8.0)
bank = lampopt.build_bank(aircraft, decoder="vertex-template", store=folder / "aircraft.lamp")
bank = lampopt.label(bank, "wing", {"area": "planform_area"}, store=folder / "aircraft-area.lamp")
bank = lampopt.label(bank, flow, {"glide": "ld"}, store=folder / "aircraft-labelled.lamp")

wish = lampopt.Study(
    bank,
    reference=bank.names[0],
    keep=("area",),
    objective=lampopt.Reduce("glide", by=-0.10),  # more of it
    measures={"flow": flow, "wing": lampopt.Spec("wing")},
    measured={"glide": "flow.ld", "area": "wing.planform_area"},
    turns=4,
)
result = lampopt.run(wish, folder / "run")
meshes = [lampopt.run(lampopt.Study(bank, reference=bank.names[0])).design.mesh, result.design.mesh]
models = {"AeroBuildup": flow, "vortex lattice": lampopt.Spec("aerosandbox", method="vlm", stations=24, alpha=8.0)}
told = [(f"lift over drag, {name}", model, "ld") for name, model in models.items()]
told += [(f"lift, {name}", model, "cl") for name, model in models.items()]
for name, measure, value in (*told, ("span", "wing", "span"), ("planform area", "wing", "planform_area")):
    first, last = (lampopt.measure(measure, mesh)[value] for mesh in meshes)
    print(f"{name:32}{first:12.5g}{last:12.5g}{100 * (last / first - 1):+8.2f} %")
failed = [f"{check.name} {check.value:.3g} {check.unit}" for check in result.checks if not check.passed]
print("accepted" if result.accepted else "rejected", folder / "run" / "report.html", *failed)
