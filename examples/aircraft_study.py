"""A blended wing body with 10 % more lift over drag, span and planform area held: seconds a design, no flow grid.

    python examples/aircraft_study.py [FOLDER]

AeroSandbox's AeroBuildup labels the exemplars and closes the loop, each time on the sections of the mesh that was made.
The answer is then judged by the other model, a vortex lattice, which knows the induced drag alone; so both are asked at
8° incidence, where that is most of the drag. All aircraft are of one connectivity: decoder `vertex-template` mixes
them exactly, since chords and setbacks are parameters in which shapes are linear, and sweeps are not. Needs the extra
`aero`.
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
rows[:, :3] = WIDTHS
rows[0, 6:] = 40, 40, 24  # deg: the reference is swept as little as any
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

reference = bank.names[0]
wish = lampopt.Study(
    bank,
    reference=reference,
    keep=("area",),
    objective=lampopt.Reduce("glide", by=-0.10),  # more of it
    measures={"flow": flow, "wing": lampopt.Spec("wing")},
    measured={"glide": "flow.ld", "area": "wing.planform_area"},
    turns=4,
)
result = lampopt.run(wish, folder / "run")
before = lampopt.run(lampopt.Study(bank, reference=reference)).design.mesh
after = result.design.mesh
other = lampopt.Spec("aerosandbox", method="vlm", stations=24, alpha=8.0)
for name, measure, value in (
    ("lift over drag, AeroBuildup", flow, "ld"),
    ("lift over drag, vortex lattice", other, "ld"),
    ("lift, AeroBuildup", flow, "cl"),
    ("lift, vortex lattice", other, "cl"),
    ("span", "wing", "span"),
    ("planform area", "wing", "planform_area"),
):
    first, last = (lampopt.measure(measure, mesh)[value] for mesh in (before, after))
    print(f"{name:32}{first:12.5g}{last:12.5g}{100 * (last / first - 1):+8.2f} %")
print("accepted" if result.accepted else "rejected", folder / "run" / "report.html")
for check in result.checks:
    if not check.passed:
        print(f"{check.name}: {check.value:.3g}, expected {check.sense} {check.limit:.3g} {check.unit}")
