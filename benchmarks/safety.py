"""Can the verdict be trusted: ``python -m benchmarks.safety --help`` (docs/safety.md, docs/performance.md).

Designs far out of range, of which the truth is known, are scored by the checks that need no direct measure; the score
(worst value over limit, limits calibrated on the bank) has to tell those apart that are off by more than a tolerance.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
from rich.console import Console
from sklearn.metrics import average_precision_score, roc_auc_score
from trimesh import Trimesh

import lampopt
from lampopt.check import Limits
from lampopt.errors import InputError, LampoptError, MeasureError
from lampopt.topology import topology
from lampopt.types import Array

from . import plate
from .body import Body, find_judge
from .common import Bench, Row, counts, key, line, options, threads
from .document import put, show, stamped

TOLERANCE = 0.005  # of the surface [m]
MISS = 0.05  # of a parameter, where it can be measured [range]
FACTORS = (2.0, 8.0)  # how far out designs are drawn
USUAL = (1.0, 1.5, 2.0, 3.0)  # range factors of what users ask for
VOLUMES = (1.5, 2.0)
FAMILIES = ("plate", "Hybrid")


@dataclass(frozen=True, eq=False)
class Family:
    """A bank whose truth is known everywhere: exemplars, and the true mesh at any parameters (d,)."""

    name: str
    exemplars: lampopt.Exemplars
    bank: lampopt.Bank
    mesh_at: Callable[[Array], Trimesh]

    def draws(self, count: int, most: int, seed: int) -> Iterator[tuple[float, Array]]:
        """Range factors and parameters (d,): one to `most` of them at random to ± f, the others at the middle."""
        rng = np.random.default_rng(seed)
        low, high = np.array([(q.low, q.high) for q in self.bank.space], float).T
        made = 0
        while made < count:
            f = float(np.exp(rng.uniform(*np.log(FACTORS))))
            out = rng.permutation(len(low))[: rng.integers(1, min(most, len(low)) + 1)]
            at = np.zeros(len(low))
            at[out] = rng.uniform(-f, f, len(out))
            at[out[0]] = f * rng.choice([-1, 1])  # so that f is reached
            parameters = (low + high) / 2 + at * (high - low) / 2
            try:
                self.mesh_at(parameters)
            except InputError:  # no such shape: a hole beyond the edge, a negative thickness
                continue
            made += 1
            yield f, parameters


def families(bench: Bench, judge: ModuleType | None, wanted: Sequence[str]) -> Iterator[Family]:
    if FAMILIES[0] in wanted:
        source = plate.exemplars(bench)
        assert source.mesh_at is not None
        yield Family("plate", source, bench.bank("plate", source, bench.decoder), source.mesh_at)
    if judge is not None and FAMILIES[1] in wanted:
        body = Body(bench, judge, "Hybrid")
        cars = body.exemplars()
        base = body.base()
        yield Family("Hybrid", cars, body.bank(cars, bench.decoder, []), lambda p: judge.morph(base, p))


def auc(bench: Bench, judge: ModuleType, family: Family, count: int, most: int) -> Row:
    """ROC and PR AUC of the score, of the paper's mismatch alone, and what is accepted."""
    unmeasured = replace(family.bank, measured_by={}, measured=np.empty((len(family.bank), 0)), limits={})
    with bench.stage(f"{family.name}: calibration") as tell:
        calibrated = lampopt.calibrate(
            unmeasured, TOLERANCE, exemplars=family.exemplars, progress=tell, plugins=bench.plugins
        )
    assert calibrated.calibration is not None
    rows = []
    with bench.stage(f"{family.name}: {count} designs") as tell:
        for i, (f, parameters) in enumerate(family.draws(count, most, bench.seed)):
            tell(i / count)
            known = ["safety", family.name, bench.identity(calibrated), parameters.tolist(), key(_code(judge))]
            made = lambda f=f, p=parameters: _judged(bench, judge, family, calibrated, f, p)  # noqa: E731
            rows.append(bench.scores.get(known, made))
    away = np.array([row["error"] is None or row["error"] > TOLERANCE for row in rows])
    off = away | ~np.array([row["whole"] for row in rows])
    scores = {
        name: np.array([1e9 if row[name] is None else row[name] for row in rows])
        for name in ("score", "default", "mismatch")
    }
    found = [line(f"{family.name}: share of bad designs", float(off.mean()), of=count, target=">= 0.2")]
    found.append(line(f"{family.name}: share of good designs", float(1 - off.mean()), of=count, target=">= 0.2"))
    for name, said in (
        ("score", "score, calibrated"),
        ("default", "score, default limits"),
        ("mismatch", "mismatch alone"),
    ):
        target = ">= 0.95" if name == "score" else None
        found.append(line(f"{family.name}: ROC AUC, {said}", float(roc_auc_score(off, scores[name])), target=target))
        pr = float(average_precision_score(off, scores[name]))
        found.append(line(f"{family.name}: PR AUC, {said}", pr, target=target))
    for name, limit in (("score", 1.0), ("default", 1.0), ("mismatch", 0.01)):
        taken = scores[name] <= limit
        said = {"score": "calibrated", "default": "default limits", "mismatch": "mismatch ≤ 0.01"}[name]
        found.append(line(f"{family.name}: good among accepted, {said}", _part(~off, taken), of=int(taken.sum())))
        found.append(line(f"{family.name}: accepted among good, {said}", _part(taken, ~off), of=int((~off).sum())))
        worst = max((row["error"] or np.inf for row, t in zip(rows, taken, strict=True) if t), default=np.nan)
        found.append(line(f"{family.name}: worst surface among accepted [mm], {said}", 1000 * float(worst)))
    found.append(line(f"{family.name}: share of bad designs by the surface alone", float(away.mean()), of=count))
    for name in ("score", "mismatch"):
        value = float(roc_auc_score(away, scores[name]))
        found.append(line(f"{family.name}: ROC AUC of {name} for the surface alone", value))
    missed = [row["miss"] for row in rows if "miss" in row]
    wrong = np.array([m is None or m > MISS for m in missed], bool)
    if wrong.any() and not wrong.all():
        found.append(line(f"{family.name}: share with a parameter off by > 5 %", float(wrong.mean()), of=count))
        for name in ("score", "mismatch"):
            value = float(roc_auc_score(wrong, scores[name]))
            found.append(line(f"{family.name}: ROC AUC of {name} for a parameter off by > 5 %", value))
    evidence = calibrated.calibration
    return {
        "rows": found,
        "setting": {
            "limits": dict(calibrated.limits),
            "held-out designs": len(evidence.errors),
            "good among them": float(evidence.good.mean()),
            "tolerance [m]": TOLERANCE,
            "failed": counts([row for row in rows if row["score"] is None or row["score"] > 1]),
        },
        "designs": [{name: row[name] for name in ("f", "error", "score", "default", "mismatch")} for row in rows],
        "notes": [
            "bad: surfaces more than the tolerance apart (mean, the judge's), no surface, or not the true topology",
            f"1 to {most} parameters drawn to ± f, f from {FACTORS[0]:g} to {FACTORS[1]:g}; direct measures off",
            "PR AUC is that of finding the bad ones",
        ],
    }


def accepted(bench: Bench, judge: ModuleType, family: Family, count: int) -> Row:
    """What users get: all parameters drawn at once, every check on, by default limits and by calibrated ones."""
    with bench.stage(f"{family.name}: calibration, measures on") as tell:
        calibrated = lampopt.calibrate(
            family.bank, TOLERANCE, exemplars=family.exemplars, progress=tell, plugins=bench.plugins
        )
    low, high = np.array([(q.low, q.high) for q in family.bank.space], float).T
    found = []
    for f in USUAL:
        rng = np.random.default_rng([bench.seed, round(100 * f)])
        rows: list[Row] = []
        with bench.stage(f"{family.name}: accepted, f={f:g}") as tell:
            while len(rows) < count:
                tell(len(rows) / count)
                parameters = (low + high) / 2 + f * (high - low) / 2 * rng.uniform(-1, 1, len(low))
                try:
                    family.mesh_at(parameters)
                except InputError:  # no such shape
                    continue
                known = ["accepted", family.name, bench.identity(calibrated), parameters.tolist(), key(_code(judge))]
                made = lambda f=f, p=parameters: _judged(bench, judge, family, calibrated, f, p)  # noqa: E731
                rows.append(bench.scores.get(known, made))
        good = np.array([row["error"] is not None and row["error"] <= TOLERANCE and row["whole"] for row in rows])
        found.append(line(f"{family.name}, f={f:g}: good designs", float(good.mean()), of=count, f=f))
        for name, said in (("default", "default limits"), ("score", "calibrated")):
            taken = np.array([row[name] is not None and row[name] <= 1 for row in rows])
            by = {"by": counts(rows)} if name == "score" else {}
            found.append(line(f"{family.name}, f={f:g}: accepted, {said}", float(taken.mean()), of=count, f=f, **by))
            found.append(
                line(
                    f"{family.name}, f={f:g}: good among accepted, {said}", _part(good, taken), of=int(taken.sum()), f=f
                )
            )
    return {
        "rows": found,
        "setting": {"limits": dict(calibrated.limits), "measured": dict(family.bank.measured_by)},
        "notes": ["all parameters drawn at once from the range widened by f; every check on"],
    }


def _code(judge: ModuleType) -> str:
    return Path(judge.__file__ or "").read_text(encoding="utf-8")


def _part(these: Array, of: Array) -> float:
    return float(these[of].mean()) if of.any() else float("nan")


def _judged(
    bench: Bench,
    judge: ModuleType,
    family: Family,
    calibrated: lampopt.Bank,
    f: float,
    parameters: Array,
) -> Row:
    """One design: its scores by both sets of limits, its mismatch, how far its surface is off the true one."""
    asked = {q.name: float(p) for q, p in zip(family.bank.space, parameters, strict=True)}
    result = lampopt.design(calibrated, asked, resolution=bench.resolution, plugins=bench.plugins)
    mesh = result.design.mesh
    plain_limits, own = Limits.of(replace(calibrated, limits={}), {}), Limits.of(calibrated, {})
    by_default = [
        replace(c, limit=c.limit / own[c.name] * plain_limits[c.name]) if c.name in calibrated.limits and c.limit else c
        for c in result.checks
    ]
    true = family.mesh_at(parameters)
    shapes = [] if mesh is None else [(t.closed, t.bodies, t.genus) for t in map(topology, (true, mesh))]
    row: Row = {
        "f": f,
        "whole": len(set(shapes)) == 1,
        "score": _finite(result.score),
        "default": _finite(max(check.score for check in by_default)),
        "mismatch": _finite(result.check("mismatch").value),
        "failed": [check.name for check in result.checks if not check.passed],
        "error": None if mesh is None else judge.surface_error(mesh, true)["mean"],
    }
    if family.name == "plate":
        try:
            values = {} if mesh is None else lampopt.measure("plate", mesh, plugins=bench.plugins)
        except MeasureError:
            values = {}
        missed = [abs(values[q.name] - asked[q.name]) / q.spread for q in family.bank.space] if values else []
        row["miss"] = max(missed) if missed else None
    return row


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def volume(bench: Bench, family: Family, count: int) -> Row:
    """The paper's appendix Q: the share of draws that alpha and field let through, by range factor, and the time."""
    rows = []
    for f in VOLUMES:
        with bench.stage(f"{family.name}: volume, f={f:g}") as tell:
            began = time.perf_counter()
            found = lampopt.extrapolation_volume(
                family.bank, f, count, seed=bench.seed, progress=tell, plugins=bench.plugins
            )
            seconds = time.perf_counter() - began
        name = f"{family.name}, {len(found.parameters)} parameters, f={f:g}"
        rows += [
            line(f"{name}: valid share", found.share, of=count, by=dict(found.rejected), f=f),
            line(f"{name}: volume ratio", found.ratio, f=f),
            line(f"{name}: mismatch alone, share", found.by_mismatch, f=f),
            line(f"{name}: milliseconds a design", 1000 * seconds / count, f=f),
        ]
    return {"rows": rows, "notes": ["valid: every check of alpha and field passes, default limits; no mesh is made"]}


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.safety", description=__doc__)
    parser.add_argument("--table", choices=("auc", "accepted", "volume", "all"), default="all")
    parser.add_argument("--family", choices=FAMILIES, action="append", help="repeatable; default: all")
    parser.add_argument("--designs", type=int, default=200, help="a family, for the AUC")
    parser.add_argument("--most", type=int, default=2, help="parameters drawn at once, at most, for the AUC")
    parser.add_argument("--draws", type=int, default=10_000, help="a range factor, for the volume")
    options(parser, decoder="sdf-mlp")
    args = parser.parse_args(given)
    talk = Console(stderr=True)
    judge = find_judge(args.judge)
    if args.most < 1:
        parser.error(f"--most: expected at least 1, got {args.most}")
    notes = []
    if judge is None:
        notes.append("no judge.py was found: without it there is no truth to compare with (--judge FOLDER)")
        talk.print(f"[bold]{notes[0]}[/bold]")
    tables = {}
    try:
        bench = Bench(args.cache, lampopt.Spec(args.decoder), args.resolution, seed=args.seed, console=talk)
        with threads(args.threads):
            for family in families(bench, judge, args.family or FAMILIES):
                if args.table in ("auc", "all") and judge is not None:
                    tables[f"auc {family.name}"] = auc(bench, judge, family, args.designs, args.most)
                if args.table in ("accepted", "all") and judge is not None:
                    tables[f"accepted {family.name}"] = accepted(bench, judge, family, max(args.designs // 5, 1))
                if args.table in ("volume", "all"):
                    tables[f"volume {family.name}"] = volume(bench, family, args.draws)
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    if not args.json:
        for name, table in tables.items():
            show(Console(), name, table)
    settings = {"decoder": args.decoder, "most": args.most, "designs": args.designs, "draws": args.draws}
    settings |= {"seed": args.seed, "resolution": args.resolution, "threads": args.threads}
    document = stamped("safety", **settings) | {"notes": notes, "tables": tables, "seconds": bench.seconds}
    name = "-".join(["safety", args.table, *(args.family or []), args.decoder])
    put(document, args.out and args.out / f"{name}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
