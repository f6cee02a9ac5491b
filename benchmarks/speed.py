"""How fast each stage is beside what people use today: ``python -m benchmarks.speed --help`` (docs/performance.md).

lampopt and its rival in turn in one run, the same work at the same quality; medians of both, and the median of the
ratios of neighbouring runs. Banks are built once, and their rivals' time is reckoned from the steps that one shape
takes and the time of a step. Rivals are benchmarks/rivals.py. BLAS and torch on `--threads`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from rich.console import Console
from trimesh import Trimesh

import lampopt
from lampopt.check import mismatches
from lampopt.decode import decode, decoding, field_to_mesh, field_to_mesh_dense
from lampopt.errors import LampoptError
from lampopt.mix import mixed_weights
from lampopt.types import Array, Bank, Frame, Parameter, Problem, Spec
from lampopt_sdf.network import Network
from lampopt_sdf.sdf_mlp import SdfMlp

from . import rivals
from .body import Body, judge_at
from .common import Bench, Row, options, threads
from .document import put, show, stamped
from .optimizers import ADAM

T = TypeVar("T")
ERROR_MM = 3.0  # mean surface error that banks are fitted to
RIVAL_SHAPES = 1  # of the 24, on which a rival's steps are counted
MOST_STEPS = 500  # of a rival, as inr2vec takes: one that is not there by then would take longer still
BY_ADAM = {**ADAM, "precision": "float32"}
FINE = 256  # cells along the box of a mesh
APART = 1e-4  # between the surfaces of both ways [box]
STEP = 0.01  # of alpha, from one design of a search to the next
MANY, PARAMETERS, PROBES, TARGETS = 100, 26, 10_000, 10_000
LARGE = (1000, 400_000)  # exemplars and weights of a large bank
ANONYMOUS_MB = 300
IMPORT_S = 0.3  # above numpy's
LONG_S = 0.1  # that a timed run takes at least
QUIET_S = 0.3  # before each: threads of BLAS that the other's run left spinning have gone to sleep by then


@dataclass(frozen=True, eq=False)
class Race:
    """Seconds of both in turn, (pairs,) each."""

    ours: Array
    theirs: Array

    @classmethod
    def of(cls, ours: Callable[[], object], theirs: Callable[[], object], pairs: int) -> Race:
        """Each once to warm up, then `pairs` times in turn; what is short is repeated, as it is in use."""
        often = [max(1, min(50, int(LONG_S / clock(work)))) for work in (ours, theirs)]
        seconds = np.empty((pairs, 2))
        for pair in seconds:
            for k, (work, repeats) in enumerate(zip((ours, theirs), often, strict=True)):
                time.sleep(QUIET_S)
                pair[k] = clock(work, repeats)
        return cls(*seconds.T)

    @property
    def ratio(self) -> float:
        """How many times longer theirs takes."""
        return float(np.median(self.theirs / self.ours))


def clock(work: Callable[[], object], repeats: int = 1) -> float:
    """Seconds of one call, the mean of some in a row."""
    began = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - began) / repeats


def row(name: str, race: Race, target: float | None, **more: object) -> Row:
    """One line: by what factor the rival is slower, against at least `target`."""
    return {
        "name": name,
        "ratio": race.ratio,
        "target": None if target is None else f">= {target:g}",
        "met": None if target is None else bool(race.ratio >= target),
        "ours [s]": float(np.median(race.ours)),
        "theirs [s]": float(np.median(race.theirs)),
        "note": "; ".join(f"{key} {value}" for key, value in more.items()),
    }


def limit(name: str, value: float, target: float, unit: str, **more: object) -> Row:
    """One line of what has no rival: a value of at most `target`; the ratio is of both."""
    note = "; ".join([f"{value:.4g} {unit}", *(f"{key} {value}" for key, value in more.items())])
    ratio, met = value / target, bool(value <= target)
    return {"name": name, "ratio": ratio, "target": "<= 1", "met": met, "ours [s]": None, "theirs [s]": None,
            "note": f"{note}; at most {target:g}"}  # fmt: skip


def car(bench: Bench, args: argparse.Namespace) -> Body:
    """The judge's Hybrid; a body of which few meshes are enough where no figures are wanted."""
    return Body(bench, judge_at(args.judge), "hatchback" if bench.quick else "Hybrid")


def networks(bench: Bench, args: argparse.Namespace) -> Bank:
    """The bank of its morphs by signed distance networks, fitted once."""
    quick = {"start_steps": 200, "steps": 50, "samples": 10_000} if bench.quick else {}
    return car(bench, args).bank(car(bench, args).exemplars(), Spec("sdf-mlp", **quick), [])


# Banks


def banks(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """24 morphs of a car to one mean surface error; the rivals' sampling is not counted, ours is."""
    from lampopt_sdf.samples import draw

    body = car(bench, args)
    exemplars = body.exemplars()
    count = len(exemplars.meshes)
    made = dict[str, tuple[float, Bank]]()
    scale = error = 0.0  # the frame's, which is the same for all decoders
    for name, spec in (
        ("mesh-template", Spec("mesh-template")),
        ("sdf-mlp", Spec("sdf-mlp")),
        ("sdf-mlp as Adam fits it", Spec("sdf-mlp", **BY_ADAM)),
    ):
        with bench.stage(f"bank by {name}"):
            spec = Spec(spec.name, **spec.options, tolerance=error) if made else spec
            began = time.perf_counter()
            bank = lampopt.build_bank(exemplars, spec, seed=bench.seed, batch=count, plugins=bench.plugins)
            made[name] = time.perf_counter() - began, bank
            scale = bank.frame.scale
            error = ERROR_MM * 1e-3 * body.metre * scale
    drawn = [draw(made["sdf-mlp"][1].frame.to_box(mesh), 100_000, np.random.SeedSequence(k))
             for k, mesh in enumerate(exemplars.meshes[:RIVAL_SHAPES])]  # fmt: skip
    samples = tuple(torch.as_tensor(np.stack(part).astype(np.float32)) for part in zip(*drawn, strict=True))
    points, true, surface = samples[0], samples[1], samples[2][:, ::12]
    most = 20 if bench.quick else MOST_STEPS
    with bench.stage(f"SIREN 256×3 on {RIVAL_SHAPES}, one by one"):
        alone = [
            rivals.fitted(
                rivals.siren(1, 256, 3, k), (points[k : k + 1], true[k : k + 1], surface[k : k + 1]),
                rivals.of_distances, lambda f: f, points=rivals.SIREN_POINTS, error=error, most=most,
            )
            for k in range(RIVAL_SHAPES)
        ]  # fmt: skip
    siren_s = count * float(np.mean([one.steps * one.step_s for one in alone]))
    with bench.stage(f"inr2vec on {RIVAL_SHAPES}"):
        few = rivals.fitted(
            rivals.siren(RIVAL_SHAPES, 512, 4, 0), (points, true, surface), rivals.of_labels, rivals.distances,
            points=rivals.INR2VEC_POINTS, error=error, most=most,
        )  # fmt: skip
    with bench.stage(f"inr2vec's batch of {rivals.INR2VEC_BATCH}, a few steps"):
        many = [part[np.arange(rivals.INR2VEC_BATCH) % RIVAL_SHAPES] for part in (points, true, surface)]
        batch = rivals.fitted(
            rivals.siren(rivals.INR2VEC_BATCH, 512, 4, 0), (many[0], many[1], many[2]), rivals.of_labels,
            rivals.distances, points=rivals.INR2VEC_POINTS, error=0.0, most=3, look=3,
        )  # fmt: skip
    inr2vec_s = few.steps * batch.step_s * count / rivals.INR2VEC_BATCH

    def mm(error: float) -> str:
        return f"{error / scale / body.metre * 1e3:.2f} mm"

    def reached(one: rivals.Fitted) -> str:
        said = f"{mm(one.error)} after {one.steps} steps"
        return said if one.error <= error else f"{said}, not there yet: it takes longer"

    rows = []
    for name in ("mesh-template", "sdf-mlp"):
        seconds, bank = made[name]
        off = mm(float(bank.fit_error.mean()))
        for rival, theirs, least, how in (
            ("SIREN 256×3 one by one", siren_s, 5.0, reached(alone[0])),
            ("inr2vec's batch", inr2vec_s, 2.0, reached(few)),
        ):
            race = Race(np.array([seconds]), np.array([theirs]))
            target = least if name == "sdf-mlp" else None
            rows.append(row(f"bank of {count} by {name}, {rival}", race, target, ours=off, theirs=how))
    (ours, bank), (theirs, other) = (made[name] for name in ("sdf-mlp", "sdf-mlp as Adam fits it"))
    race = Race(np.array([ours]), np.array([theirs]))
    reached_by = {"ours": mm(float(bank.fit_error.mean())), "theirs": mm(float(other.fit_error.mean()))}
    return [*rows, row(f"bank of {count} by sdf-mlp, Adam's steps in float32", race, None, **reached_by)]


# Meshes


def mixed_of(bank: Bank) -> tuple[Array, Array]:
    """Coefficients (N,) some way off the mean of `bank`, and their weights (D,)."""
    off = np.random.default_rng(0).normal(size=len(bank))
    alpha = 1 / len(bank) + 0.7 * (off - off.mean()) / np.linalg.norm(off)
    return alpha, mixed_weights(bank, alpha)


def two_bodies(points: Array) -> Array:
    """A ball and a small one beside it, and a plate a thousandth of the box thick."""
    big = np.linalg.norm(points - [-0.4, 0.0, 0.0], axis=1) - 0.35
    small = np.linalg.norm(points - [0.5, 0.3, 0.2], axis=1) - 0.05
    plate = np.abs(points - [0.45, -0.3, 0.0]) - [0.3, 0.3, 0.004]
    outside = np.linalg.norm(np.maximum(plate, 0), axis=1) + np.minimum(plate.max(1), 0)
    return np.asarray(np.minimum(np.minimum(big, small), outside))


def meshes(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """A mixed network at 256³, and a field whose parts are easily lost: against every node of the grid."""
    bank = networks(bench, args)
    decoder = bench.plugins.make("decoder", bank.decoder)
    weights = mixed_of(bank)[1]
    fine = 64 if bench.quick else FINE
    rows = []
    for name, field in (
        ("a mixed network", lambda points: decoder.evaluate(bank.shared, weights, points)[..., 0]),
        ("a thin plate, two bodies", two_bodies),
    ):
        with bench.stage(f"{name} at {fine}³"):
            sparse, dense = (way(field, decoder.bounds, fine) for way in (field_to_mesh, field_to_mesh_dense))
            race = Race.of(
                lambda field=field: field_to_mesh(field, decoder.bounds, fine),
                lambda field=field: field_to_mesh_dense(field, decoder.bounds, fine),
                1 if bench.quick else args.pairs,
            )
        far, parts = apart(sparse, dense), (sparse.body_count, dense.body_count)
        mesh = row(f"mesh at {fine}³ of {name}, dense", race, 15.0 if name == "a mixed network" else None)
        rows += [mesh, limit(f"surfaces of {name} apart", far, APART, "box", parts=f"{parts[0]}, dense {parts[1]}")]
        rows[-1]["met"] = rows[-1]["met"] and parts[0] == parts[1]
    return rows


def neighbours(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """Designs of a search, each a few mm from the last, meshed one after another: against each alone."""
    bank = networks(bench, args)
    decoder = bench.plugins.make("decoder", bank.decoder)
    fine = 64 if bench.quick else FINE
    alpha = mixed_of(bank)[0]
    steps = np.cumsum(np.random.default_rng(1).normal(size=(12, len(bank))), 0)
    steps *= STEP / np.linalg.norm(np.diff(steps, axis=0), axis=1).mean()
    way = [mixed_weights(bank, alpha + step - step.mean()) for step in steps]
    made = decoding(bank, decoder, resolution=fine)
    pairs = [(made(weights), decode(bank, decoder, weights, resolution=fine)) for weights in way]
    off = max(apart(one, other) for one, other in pairs) * bank.frame.scale
    far = max(apart(one, other) for (_, one), (_, other) in pairwise(pairs)) / car(bench, args).metre
    ours, theirs = cycle([*way, *way[-2:0:-1]]), cycle(way)
    with bench.stage(f"neighbours at {fine}³"):
        race = Race.of(
            lambda: made(next(ours)),
            lambda: decode(bank, decoder, next(theirs), resolution=fine),
            1 if bench.quick else 4 * args.pairs,
        )
    near = row(f"mesh at {fine}³ near the last one, made alone", race, None, moved=f"up to {1e3 * far:.2g} mm a step")
    return [near, limit("surfaces of neighbours apart from those made alone", off, APART, "box")]


def apart(one: Trimesh, other: Trimesh) -> float:
    """The greatest distance from a vertex of either to the other's surface [box]."""
    import igl

    def farthest(points: Array, mesh: Trimesh) -> float:
        squared, _, _ = igl.point_mesh_squared_distance(points, np.asarray(mesh.vertices), np.asarray(mesh.faces))
        return float(np.sqrt(squared.max()))

    return max(farthest(np.asarray(one.vertices), other), farthest(np.asarray(other.vertices), one))


# Safety and mixes


def linearity(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """The mismatch of one mix at N = 100 and M = 10,000."""
    decoder = bench.plugins.make("decoder", "sdf-mlp")
    bank = random_bank(decoder, MANY, bench.seed)
    alpha, weights = mixed_of(bank)

    def evaluate(weights: Array, points: Array) -> Array:
        return np.asarray(decoder.evaluate(bank.shared, weights, points), float)

    ours, theirs = float(mismatches(bank, decoder, alpha, weights)[0]), rivals.mismatch(bank, evaluate, alpha)
    with bench.stage(f"mismatch at N = {MANY}, M = {PROBES:,}"):
        race = Race.of(
            lambda: mismatches(bank, decoder, alpha, weights),
            lambda: rivals.mismatch(bank, evaluate, alpha),
            args.pairs,
        )
    found = row(f"mismatch at N = {MANY}, M = {PROBES:,}, N + 1 networks", race, 50.0)
    return [found, limit("both mismatches apart", abs(ours - theirs), 1e-6, "box", of=f"{ours:.6g}")]


def previews(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """A 64³ preview at N = 100, mixes of a car's 24 networks: against decoding at 64³."""
    made = networks(bench, args)
    decoder = bench.plugins.make("decoder", made.decoder)
    rng = np.random.default_rng(bench.seed)
    shares = rng.dirichlet(np.ones(len(made)), 8 if bench.quick else MANY)
    bank = replace(
        made, names=tuple(f"e{k}" for k in range(len(shares))), parameters=shares @ made.parameters,
        labels=np.empty((len(shares), 0)), label_space=(), measured=np.empty((len(shares), 0)), measured_by={},
        weights=mixed_weights(made, shares), probe_values=np.zeros((len(shares), *made.probe_values.shape[1:])),
        fit_error=np.zeros(len(shares)), calibration=None, path=None,
    )  # fmt: skip
    with bench.stage(f"{len(shares)} networks on a grid"):
        look = lampopt.Preview.of(bank, plugins=bench.plugins)
    alpha, weights = mixed_of(bank)
    with bench.stage("previews"):
        race = Race.of(lambda: look.mesh(alpha), lambda: decode(bank, decoder, weights, resolution=64), 4 * args.pairs)
    far = apart(look.mesh(alpha), decode(bank, decoder, weights, resolution=64)) * bank.frame.scale
    return [row(f"preview at N = {len(shares)}, decoding at 64³", race, 10.0, apart=f"{far:.2g} of the box at most")]


def random_bank(decoder: SdfMlp, count: int, seed: int) -> Bank:
    """Networks around a random one, with their values at the probes: as large as a fitted bank, and no slower."""
    rng = np.random.default_rng(seed)
    network = Network(decoder.width, decoder.depth, decoder.octaves, decoder.activation)
    start = network.initial(rng)
    weights = (start + 0.02 * rng.normal(size=(count, len(start)))).astype(np.float32)
    probes = rng.uniform(-1, 1, (PROBES, 3))
    return Bank(
        space=tuple(Parameter(f"p{k}") for k in range(PARAMETERS)),
        label_space=(),
        labels=np.empty((count, 0)),
        names=tuple(f"e{k}" for k in range(count)),
        parameters=rng.uniform(-1, 1, (count, PARAMETERS)),
        decoder=Spec("sdf-mlp"),
        shared={"start": start},
        weights=weights,
        probes=probes,
        probe_values=decoder.evaluate({"start": start}, weights, probes),
        fit_error=np.zeros(count),
        frame=Frame(1.0, np.zeros(3), "m"),
    )


def mixes(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """10,000 targets at N = 100 and d = 26."""
    rng = np.random.default_rng(bench.seed)
    parameters = rng.uniform(-1, 1, (MANY, PARAMETERS))
    targets = rng.uniform(-1, 1, (TARGETS, PARAMETERS))
    names = tuple(f"p{k}" for k in range(PARAMETERS))
    solver = bench.plugins.make("solver", "kkt")
    problem = Problem(names, parameters.T, targets[0])
    few = [Problem(names, parameters.T, target) for target in targets[: 3 if bench.quick else 10]]
    with bench.stage(f"{TARGETS:,} mixes"):
        race = Race.of(
            lambda: solver.solve_many(problem, targets), lambda: [rivals.slsqp(one) for one in few], args.pairs
        )
    each = Race(race.ours / TARGETS, race.theirs / len(few))
    ours = solver.solve_many(problem, targets[: len(few)]).alpha
    off = float(np.abs(ours - [rivals.slsqp(one) for one in few]).max())
    found = row(f"a mix of {TARGETS:,} at N = {MANY}, d = {PARAMETERS}, SLSQP", each, 1000.0)
    return [found, limit("both mixes apart", off, 1e-8, "of alpha")]


# Size


MIXED = """
import sys, time, numpy as np, lampopt
def anonymous():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("RssAnon")) / 1024
began = time.perf_counter()
bank = lampopt.load_bank(sys.argv[1])
opened = time.perf_counter() - began
from lampopt.mix import mixed_weights
alpha = np.full(len(bank), 1 / len(bank))
mixed_weights(bank, alpha)
began = time.perf_counter()
mixed = mixed_weights(bank, alpha)
print(anonymous(), opened, time.perf_counter() - began, float(np.abs(mixed).max()))
"""


def memory(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """1,000 exemplars of 400,000 weights: opened and mixed in a process of its own."""
    count, size = (50, 10_000) if bench.quick else LARGE
    rng = np.random.default_rng(bench.seed)
    with tempfile.TemporaryDirectory(dir=bench.cache) as folder, bench.stage(f"{count:,} × {size:,}"):
        file = Path(folder) / "large.lamp"
        weights = np.lib.format.open_memmap(Path(folder) / "w.npy", "w+", np.float32, (count, size))
        for k in range(count):
            weights[k] = rng.normal(size=size)
        lampopt.store_bank(
            Bank(
                space=(Parameter("p"),),
                label_space=(),
                labels=np.empty((count, 0)),
                names=tuple(f"e{k}" for k in range(count)),
                parameters=rng.uniform(size=(count, 1)),
                decoder=Spec("sdf-mlp"),
                shared={},
                weights=weights,
                probes=np.zeros((1, 3)),
                probe_values=np.zeros((count, 1, 1)),
                fit_error=np.zeros(count),
                frame=Frame(1.0, np.zeros(3), "m"),
            ),
            file,
        )
        said = subprocess.run([sys.executable, "-c", MIXED, file], capture_output=True, text=True, check=True).stdout
    anonymous, opened, mixed, _ = map(float, said.split())
    more = {"opened in": f"{opened:.2f} s", "a mix": f"{1e3 * mixed:.0f} ms"}
    return [limit(f"anonymous memory, bank of {count:,} × {size:,}", anonymous, ANONYMOUS_MB, "MB", **more)]


def imports(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """What importing lampopt costs above numpy, in processes of their own; and who imports torch."""

    def seconds(what: str) -> float:
        return clock(lambda: subprocess.run([sys.executable, "-c", f"import {what}"], check=True))

    with bench.stage("imports"):
        seconds("lampopt")
        pairs = np.array([(seconds("lampopt"), seconds("numpy")) for _ in range(max(5, args.pairs))])
        code = (
            "import sys\nfrom lampopt.cli import main\ntry: main(['plugins'])\nexcept SystemExit: pass\n"
            "sys.exit('torch' in sys.modules)"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    above = float(np.median(pairs[:, 0] - pairs[:, 1]))
    return [
        limit("import lampopt, above numpy", above, IMPORT_S, "s"),
        limit("torch imported by `lampopt plugins`", float(done.returncode), 0.5, "times"),
    ]


GROWN = """
import json, sys, time
import numpy as np, torch
import lampopt
from benchmarks.speed import mixed_of, random_bank
from lampopt.check import mismatches
from lampopt.plugins import Plugins
what, size, threads, file = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
torch.set_num_threads(threads)
plugins = Plugins.load()
bank = lampopt.load_bank(file)
decoder = plugins.make("decoder", bank.decoder)
if what == "decode":
    weights = mixed_of(bank)[1]
    work = lambda: decoder.decode(bank.shared, weights, resolution=size)
elif what == "fit":
    from lampopt_sdf.sdf_mlp import SdfMlp
    from lampopt.testing import shapes
    small = SdfMlp(start_steps=1, steps=30, tolerance=0.0)
    balls = [shapes.ellipsoid([0.5 + 0.3 * k / size] * 3) for k in range(size)]
    shared = {"start": bank.shared["start"]}
    work = lambda: small.fit(shared, balls, seed=0)
else:
    grown = random_bank(decoder, size, 0)
    alpha, weights = mixed_of(grown)
    solver = plugins.make("solver", "kkt")
    problem = lampopt.Problem(tuple(q.name for q in grown.space), grown.parameters.T, np.zeros(26))
    work = (lambda: mismatches(grown, decoder, alpha, weights)) if what == "mismatch" else lambda: solver.solve(problem)
def peak():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) / 1024
open("/proc/self/clear_refs", "w").write("5")
before = peak()
if what != "fit":
    work()
seconds = []
for _ in range(1 if what == "fit" else 5):
    began = time.perf_counter()
    work()
    seconds.append(time.perf_counter() - began)
print(json.dumps([float(np.median(seconds)), peak() - before]))
"""


def growth(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """How time and memory grow with exemplars and resolution: exponents fitted to the last three sizes."""
    bank = networks(bench, args)
    numbers, resolutions = (2, 4, 8), (16, 32, 64)
    if not bench.quick:
        numbers, resolutions = (8, 32, 128), (64, 128, 256, 512)
    rows = []
    for what, sizes in (("decode", resolutions), ("fit", numbers), ("mismatch", numbers), ("solve", numbers)):
        found = []
        with bench.stage(f"growth of {what}"):
            for size in sizes:
                command = [sys.executable, "-c", GROWN, what, str(size), str(args.threads), str(bank.path)]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                found.append(json.loads(done.stdout))
        seconds, memory = np.array(found).T
        by = "resolution" if what == "decode" else "N"
        told = [("time", seconds, "s"), ("memory", memory, "MB")]  # of the others memory is the bank's, which is there
        for name, values, unit in told if what in ("decode", "fit") else told[:1]:
            note = ", ".join(f"{size}: {value:.3g} {unit}" for size, value in zip(sizes, values, strict=True))
            slope = float(np.polyfit(np.log(sizes[-3:]), np.log(np.maximum(values[-3:], 1e-9)), 1)[0])
            rows.append(
                {
                    "name": f"{name} of {what}, exponent in {by}",
                    "ratio": slope,
                    "target": None,
                    "met": None,
                    "note": note,
                }
            )
    return rows


def floors(bench: Bench, args: argparse.Namespace) -> list[Row]:
    """How far stages are from their arithmetic at the peak of a large product, or their bytes at that of a copy."""
    size = 512 if bench.quick else 2048
    one, big = np.ones((size, size), np.float32), np.ones(size * size * 8, np.float32)
    peak = 2 * size**3 / min(clock(lambda: one @ one) for _ in range(5))
    band = 2 * big.nbytes / min(clock(lambda: big.copy()) for _ in range(5))
    bank = networks(bench, args)
    decoder = bench.plugins.make("decoder", bank.decoder)
    flop, fine = 2 * bank.weights.shape[1], 64 if bench.quick else FINE
    weights, count = mixed_of(bank)[1], [0]

    def field(points: Array) -> Array:
        count[0] += len(points)
        return np.asarray(decoder.evaluate(bank.shared, weights, points)[..., 0])

    field_to_mesh(field, decoder.bounds, fine)
    many, rng = random_bank(decoder, MANY, bench.seed), np.random.default_rng(bench.seed)
    alpha, mixed = mixed_of(many)
    targets = rng.uniform(-1, 1, (TARGETS, PARAMETERS))
    solver = bench.plugins.make("solver", "kkt")
    problem = Problem(tuple(q.name for q in many.space), many.parameters.T, targets[0])
    look = lampopt.Preview.of(bank, plugins=bench.plugins)
    reached = look._reached(look._centres @ mixed_of(bank)[0].astype(np.float32))
    near = float(look._values[0].nbytes * reached.sum())
    stages = [
        (f"mesh at {fine}³, {count[0]:,} points", lambda: decoder.decode(bank.shared, weights, resolution=fine),
         count[0] * flop, 0.0),
        (f"mismatch at N = {MANY}, M = {PROBES:,}", lambda: mismatches(many, decoder, alpha, mixed),
         PROBES * flop, many.probe_values.nbytes),
        (f"{TARGETS:,} mixes at N = {MANY}", lambda: solver.solve_many(problem, targets),
         2.0 * TARGETS * MANY * PARAMETERS, 8.0 * TARGETS * (MANY + 2 * PARAMETERS)),
        (f"preview at N = {len(bank)}", lambda: look.mesh(mixed_of(bank)[0]), 0.0, near),
        (f"weights of a mix at N = {MANY}", lambda: mixed_weights(many, alpha), 0.0, many.weights.nbytes),
    ]  # fmt: skip
    rows = []
    with bench.stage("floors"):
        for name, work, arithmetic, moved in stages:
            work()
            seconds = float(np.median([clock(work) for _ in range(args.pairs)]))
            floor = max(arithmetic / peak, moved / band)
            note = (
                f"{1e3 * seconds:.3g} ms, floor {1e3 * floor:.3g} ms at {peak / 1e9:.0f} GFLOP/s, {band / 1e9:.1f} GB/s"
            )
            rows.append({"name": f"{name}: times its floor", "ratio": seconds / floor, "target": None, "met": None,
                         "note": note})  # fmt: skip
    return rows


RACES: dict[str, Callable[[Bench, argparse.Namespace], list[Row]]] = {
    "bank": banks, "mesh": meshes, "neighbours": neighbours, "mismatch": linearity, "preview": previews, "mix": mixes,
    "memory": memory, "import": imports, "growth": growth, "floor": floors,
}  # fmt: skip


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--race", action="append", choices=RACES, help="repeatable; default: all")
    parser.add_argument("--pairs", type=int, default=5, help="of runs in turn")
    options(parser, decoder="sdf-mlp")
    parser.set_defaults(threads=os.cpu_count())
    parser.add_argument("--quick", action="store_true", help="does it run at all; no figures to quote")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    rows = list[Row]()
    torch.set_num_threads(args.threads)
    try:
        bench = Bench.of(args, talk)
        with threads(args.threads):
            for name in args.race or RACES:
                rows += RACES[name](bench, args)
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    if not args.json:
        show(Console(), "speed", {"rows": rows, "notes": [f"{args.threads} threads; ratio: theirs over ours"]})
    document = stamped("speed", threads=args.threads, pairs=args.pairs, seed=args.seed) | {"rows": rows}
    put(document | {"seconds": bench.seconds}, args.out and args.out / "speed.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
