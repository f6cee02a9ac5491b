"""How fast exemplars are registered, beside what is at hand elsewhere: ``python -m benchmarks.registration --help``.

Exemplars are the judge's Hybrid, morphed; the template is a mesh of its own. The rivals (extra `bench`) bring the same
template onto the same exemplar: trimesh's non-rigid ICP (Amberg et al. 2007) and pycpd's coherent point drift
(Myronenko and Song 2010; points alone, as many as fit into memory). Every residual is measured alike, as the distance
between the surfaces.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from scipy.spatial.distance import cdist
from trimesh import Trimesh

import lampopt
from lampopt.errors import LampoptError
from lampopt.metrics import surface_distance
from lampopt.plugins import Plugins
from lampopt.types import Exemplars, Parameter

from .body import judge_at
from .common import Row, extra, line
from .document import put, show, stamped

BODY = "Hybrid"
POINTS = 2_000  # of pycpd's clouds: it holds a matrix of points by points
WIDTH = 0.5  # of its kernel [m]
SCHEDULE = [[s, 1.0, 0.5, 10] for s in (0.2, 0.1, 0.05, 0.01, 0.005)]  # nricp: stiffness, landmarks, normals, steps


def exemplars(judge: ModuleType, count: int) -> Exemplars:
    """The body morphed at a Latin hypercube of parameters, all meshes in memory: reading files is not timed."""
    base, parameters = judge.body(BODY), judge.exemplars(count, seed=0)
    space = tuple(Parameter(name, unit) for name, unit in zip(judge.NAMES, judge.UNITS, strict=True))
    meshes = [judge.morph(base, row) for row in parameters]
    return Exemplars(parameters, space, meshes, tuple(f"car_{i:03d}" for i in range(count)), unit="m")


def nricp(template: Trimesh, target: Trimesh) -> Trimesh:
    from trimesh.registration import nricp_amberg

    moved = nricp_amberg(template, target, steps=SCHEDULE, distance_threshold=0.1)
    return Trimesh(moved, template.faces, process=False)


def cpd(template: Trimesh, target: Trimesh) -> Trimesh:
    """Coherent point drift of a part of the vertices; the others follow by its own Gaussian kernel."""
    rng = np.random.default_rng(0)
    source, aim = (np.asarray(m.vertices)[rng.permutation(len(m.vertices))[:POINTS]] for m in (template, target))
    drift = extra("pycpd").DeformableRegistration(X=aim, Y=source, alpha=0.1, beta=WIDTH)
    drift.register()
    points: NDArray[Any] = np.asarray(template.vertices, float)
    kernel = np.exp(-cdist(points, source, "sqeuclidean") / (2 * WIDTH**2))
    return Trimesh(points + kernel @ drift.W, template.faces, process=False)


RIVALS: dict[str, Callable[[Trimesh, Trimesh], Trimesh]] = {"trimesh nricp_amberg": nricp, "pycpd deformable": cpd}


def table(judge: ModuleType, count: int, rivals: Sequence[str], plugins: Plugins, console: Console) -> Row:
    """Seconds for all exemplars, and the ratio of each rival's time for one to ours, with residuals [mm]."""
    source = exemplars(judge, count)
    began = time.perf_counter()
    bank = lampopt.build_bank(source, "mesh-template", batch=count, plugins=plugins)
    whole = time.perf_counter() - began
    decoder = plugins.make("decoder", bank.decoder)
    inside = [bank.frame.to_box(mesh) for mesh in source.meshes]
    began = time.perf_counter()
    decoder.fit(bank.shared, inside, seed=0)
    fitted = time.perf_counter() - began
    console.print(f"{count} exemplars: bank {whole:.1f} s, of that registration {fitted:.1f} s", highlight=False)
    template, last = lampopt.template_of(bank, plugins=plugins), len(source) - 1
    from lampopt.decode import decode

    made = decode(bank, decoder, np.asarray(bank.weights[last]))
    ours = surface_distance(made, source.meshes[last])
    rows = [
        line(f"registration of {count} exemplars [s]", fitted, target="<= 120", faces=len(source.meshes[0].faces)),
        line("the whole bank: intake, template, registration, probes [s]", whole),
        line("residual of the last exemplar [mm]", 1000 * ours),
    ]
    for name in rivals:
        began = time.perf_counter()
        other = RIVALS[name](template, source.meshes[last])
        spent = time.perf_counter() - began
        off = surface_distance(other, source.meshes[last])
        console.print(f"{name}: {spent:.1f} s, {1000 * off:.2f} mm", highlight=False)
        rows += [
            line(f"{name}: time over ours, one exemplar", spent / (fitted / count), target=">= 10"),
            line(f"{name}: residual [mm]", 1000 * off),
        ]
    return {
        "rows": rows,
        "notes": ["time of one of ours: that of all over their number; threads as the machine has cores"],
    }


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.registration", description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="exemplars")
    parser.add_argument("--rival", action="append", choices=list(RIVALS), help="default: all")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    parser.add_argument("--out", type=Path, help="folder for the JSON document")
    parser.add_argument("--judge", help="folder of judge.py (../shared/judge beside the repository)")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    rivals = args.rival or list(RIVALS)
    try:
        judge = judge_at(args.judge)
        if any(RIVALS[name] is cpd for name in rivals):
            extra("pycpd")  # told before anything is timed
        found = table(judge, args.count, rivals, Plugins.load().report(), talk)
    except LampoptError as error:
        talk.print("[bold red]error[/bold red]", escape(str(error)), highlight=False)
        return 2
    if not args.json:
        show(Console(), "registration", found)
    document = stamped("registration", count=args.count) | {"tables": {"registration": found}}
    put(document, args.out and args.out / "registration.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
