"""A study as an OpenMDAO component: targets in, measured values out, with exact partials where there are derivatives.

Below OpenMDAO looks for the widest hole that leaves 1.06 m³ of a plate of at most 2.6 m. Needs the extra `openmdao`.
"""

import sys
from pathlib import Path

import numpy as np
import openmdao.api as om

import lampopt


class LampoptComponent(om.ExplicitComponent):
    """Targets of `study` → `values`, such as "volume.volume"; "volume_volume" in OpenMDAO, which wants no dots."""

    def initialize(self):
        self.options.declare("study", types=lampopt.Study)
        self.options.declare("values", types=(list, tuple))

    def setup(self):
        self.response = lampopt.Response(self.options["study"], self.options["values"])
        for name, value in self.response.targets.items():
            self.add_input(name, value, units=self.response.input_units[name] or None)
        for name, unit in self.response.units.items():
            self.add_output(name.replace(".", "_"), units=unit.replace("^", "**") or None)
        self.declare_partials("*", "*")

    def compute(self, inputs, outputs):
        for name, value in self.response({target: inputs[target].item() for target in inputs}).items():
            if not np.isfinite(value):
                raise om.AnalysisError(f"{name}: this design has none")
            outputs[name.replace(".", "_")] = value

    def compute_partials(self, inputs, partials):
        for (name, target), slope in self.response.slopes({t: inputs[t].item() for t in inputs}).items():
            partials[name.replace(".", "_"), target] = slope


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/openmdao")
    folder.mkdir(parents=True, exist_ok=True)
    decoder = lampopt.Spec("mesh-template", faces=1500, cell=0.15, tolerance=0.0)  # coarse and quick
    bank = lampopt.build_bank(lampopt.exemplars("plate"), decoder=decoder, store=folder / "plate.lamp")
    study = lampopt.Study(bank, targets={"length": 2.5, "hole_radius": 0.2}, keep=("width", "thickness"))
    problem = om.Problem(reports=False)
    values = ["plate.hole_radius", "volume.volume"]
    problem.model.add_subsystem("plate", LampoptComponent(study=study, values=values), promotes=["*"])
    problem.model.add_design_var("length", lower=2.1, upper=2.6)
    problem.model.add_design_var("hole_radius", lower=0.1, upper=0.3)
    problem.model.add_constraint("volume_volume", lower=1.06)
    problem.model.add_objective("plate_hole_radius", scaler=-1)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", disp=False)
    problem.setup()
    problem.run_driver()
    for name in ("length", "plate_hole_radius", "volume_volume"):
        print(f"{name:18} {problem.get_val(name).item():.4f}")
