"""How far can one go? A sweep from the middle of the trained range to far beyond it, kept in a run folder.

Stop it at any moment and start it again: designs that are in the folder are read back, not computed again.
"""

import sys
from pathlib import Path

import numpy as np

import lampopt

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/sweep")
folder.mkdir(parents=True, exist_ok=True)

decoder = lampopt.Spec("gridsdf", size=49)  # coarse and quick; "mesh-template" is the one to use
bank = lampopt.build_bank(lampopt.exemplars("plate"), decoder=decoder, store=folder / "plate.lamp")
study = lampopt.Study(
    bank,
    targets={"hole_radius": 0.2},
    keep=("width", "thickness", "hole_x", "hole_y"),
    measures=("volume",),
    resolution=64,
)
trained = next(q for q in bank.space if q.name == "length")
print(f"trained on lengths from {trained.low:g} to {trained.high:g} {trained.unit}")
for result in lampopt.sweep(study, {"length": np.linspace(2.5, 4.0, 7)}, folder=folder / "run"):
    length, volume = result.design.target["length"], result.check("volume.volume")
    failed = ", ".join(check.name for check in result.checks if not check.passed)
    print(f"length {length:.2f} m, volume {volume.value:.3f} {volume.unit}: {failed or 'accepted'}")
print(f"one row a design in {folder / 'run' / 'runs.sqlite'}, meshes and passports in {folder / 'run' / 'designs'}")
