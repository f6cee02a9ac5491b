"""Measure cars: directly, by a measure of one's own, and by what is learned where geometry does not give it away."""

import sys
from pathlib import Path

import numpy as np

import lampopt
from lampopt_measure.pieces import extent, highest, lowest, measure, middle, section, surface

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo/measure-and-learn")
folder.mkdir(parents=True, exist_ok=True)
cars = lampopt.exemplars("car", count=40, edge=60.0)  # coarse meshes, 16 known parameters [mm, deg]
car = cars.mesh_at(cars.parameters.mean(0))
print("wheels", {name: round(value, 1) for name, value in lampopt.measure("wheels", car).items()})
print("windscreen", {name: round(value, 2) for name, value in lampopt.measure("windscreen", car).items()})


@measure(shoulder_height="L", waist="")
def shape(mesh):
    """How high the roof is half-way out to the side, and how much narrower the car is half-way up."""
    whole = surface(mesh)
    beside = section(mesh, "y", middle(whole, "y") + extent(whole, "y") / 4)
    level = section(mesh, "z", lowest(whole) + 0.8 * extent(whole, "z"))
    return {"shoulder_height": highest(beside) - lowest(whole), "waist": extent(level, "y") / extent(whole, "y")}


own = shape()
print("own", {name: round(value, 3) for name, value in lampopt.measure(own, car).items()})
up = np.zeros_like(car.vertices)
up[car.vertices[:, 2] > 1300, 2] = 1.0  # every vertex of the roof 1 mm up
print("roof up", (own.gradient(car) * up).sum((1, 2)).round(3) + 0.0)

# "A car 100 mm longer than the base": a label of some data set, told from the wheelbase. The error is of cars left out.
length = lampopt.fit_surrogate(cars, lampopt.Spec("calibrated", by="wheels.wheelbase,vehicle.length"), ["length"])
print("calibrated", length.cross_validated)

roof, windscreen = (cars.parameters[:, [k]] for k in (2, 12))
drag = 0.24 + 1e-4 * (roof - 1435) + 2e-3 * (windscreen - 32) ** 2  # measured in nobody's tunnel
known = lampopt.Exemplars(
    cars.parameters, cars.space, cars.meshes, cars.names, drag, (lampopt.Parameter("drag"),), unit="mm"
)
surrogate = lampopt.fit_surrogate(known, "fourier-ridge", ["drag"], store=folder / "drag.measure")
print("learned", surrogate(car).round(3), surrogate.interval(car, 0.9).round(3), surrogate.outside(car))
model = lampopt.fit_model(known, "quadratic", ["drag"], store=folder / "drag.model")
print("model", model(cars.parameters[:1]).round(3), "true", drag[:1].round(3))
