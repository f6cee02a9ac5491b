"""A blended wing body with 3 % more lift over drag, span and planform area held: seconds a design, no flow grid.

    python examples/aircraft_study.py [FOLDER]

AeroSandbox's AeroBuildup labels the exemplars and closes the loop, each time on the sections of the mesh that was made.
The answer is then judged by the other model, a vortex lattice, which knows the induced drag alone. Span makes nearly
all of lift over drag here: at 10 % every other parameter would be far out of its range. Needs the extra `aero`.
"""

import sys
from pathlib import Path

import numpy as np

import lampopt

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/aircraft")
folder.mkdir(parents=True, exist_ok=True)

aircraft = lampopt.exemplars("bwb", count=24, chordwise=32, spanwise=50)
decoder = lampopt.Spec("mesh-template", faces=4000, tolerance=0.0)
bank = lampopt.build_bank(aircraft, decoder=decoder, store=folder / "aircraft.lamp")
bank = lampopt.label(bank, "aerosandbox", {"glide": "ld"}, store=folder / "aircraft-ld.lamp")
bank = lampopt.label(bank, "wing", {"span": "span", "area": "planform_area"}, store=folder / "aircraft-labelled.lamp")

reference = bank.names[int(np.argsort(bank.labels[:, 0])[len(bank) // 2])]  # the middle one
wish = lampopt.Study(
    bank,
    reference=reference,
    keep=("span", "area"),
    objective=lampopt.Reduce("glide", by=-0.03),  # more of it
    measures=("aerosandbox", "wing"),
    measured={"glide": "aerosandbox.ld", "span": "wing.span", "area": "wing.planform_area"},
    turns=4,
)
result = lampopt.run(wish, folder / "run")
before = lampopt.run(lampopt.Study(bank, reference=reference)).design.mesh
after = result.design.mesh
other = lampopt.Spec("aerosandbox", method="vlm", stations=24)
for name, measure, value in (
    ("lift over drag, AeroBuildup", "aerosandbox", "ld"),
    ("lift over drag, vortex lattice", other, "ld"),
    ("span", "wing", "span"),
    ("planform area", "wing", "planform_area"),
):
    first, last = (lampopt.measure(measure, mesh)[value] for mesh in (before, after))
    print(f"{name:32}{first:12.5g}{last:12.5g}{100 * (last / first - 1):+8.2f} %")
print("accepted" if result.accepted else "rejected", folder / "run" / "report.html")
for check in result.checks:
    if not check.passed:
        print(f"{check.name}: {check.value:.3g}, expected {check.sense} {check.limit:.3g} {check.unit}")
