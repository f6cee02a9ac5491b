"""The paper's tables 6 and 10: what the shared start and the seeds do for mixing."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType

import numpy as np

import lampopt
from lampopt.errors import PluginError
from lampopt.plugins import known_options

from . import plate
from .body import Body, average
from .common import Bench, Row

VARIANTS: Mapping[str, Mapping[str, bool]] = {
    "same seed": {},
    "a seed per exemplar": {"seed_per_exemplar": True},
    "no shared start": {"shared_start": False},
}
PAPER = {"same seed": 330, "a seed per exemplar": 304, "no shared start": 0}  # safe range [%], 100 cars
STEP, CAP = 10, 1000  # of the sweeps for the safe range [% of the range beyond each end]


def steps(bench: Bench) -> tuple[int, int]:
    return (100, 400) if bench.quick else (STEP, CAP)


def safe_range(bench: Bench, bank: lampopt.Bank) -> float:
    """How far beyond each end of the range the mismatch check still passes [% of the range], a mean over sweeps.

    Each parameter alone goes from the ends of its range up, and down, in steps until the first failure, the others at
    the middle of theirs; a sweep that fails at the end of its range already counts 0, one that never does `CAP`.
    """
    low, high = np.array([q.low for q in bank.space], float), np.array([q.high for q in bank.space], float)
    middle = (low + high) / 2
    step, cap = steps(bench)

    def passes(k: int, sign: int, beyond: float) -> bool:
        at = middle.copy()
        at[k] += sign * (0.5 + beyond / 100) * (high - low)[k]
        target = dict(zip((q.name for q in bank.space), at.tolist(), strict=True))
        result = lampopt.design(bank, target, level="field", plugins=bench.plugins)
        return result.check("mismatch").passed

    reached = []
    for k in range(len(bank.space)):
        for sign in (1, -1):
            tried = range(0, cap + 1, step)
            reached.append(next((max(e - step, 0) for e in tried if not passes(k, sign, e)), cap))
    return float(np.mean(reached))


def _safe(bench: Bench, bank: lampopt.Bank, name: str) -> float:
    with bench.stage(f"{name}: safe range, {bank.decoder}"):
        known = ["safe range", bench.identity(bank), bench.quick]
        return float(bench.scores.get(known, lambda: {"percent": safe_range(bench, bank)})["percent"])


def table(bench: Bench, judge: ModuleType | None, name: str) -> Row:
    """A row a variant: the plate's R², the body's error, both safe ranges."""
    known = known_options(bench.plugins.get("decoder", bench.decoder.name).resolve())
    rows, notes = [], []
    for variant, options in VARIANTS.items():
        if absent := sorted(set(options) - set(known)):
            notes.append(f"{variant}: left out, decoder {bench.decoder.name!r} has no option {', '.join(absent)}")
            continue
        decoder = lampopt.Spec(bench.decoder.name, **{**bench.decoder.options, **options})
        row: Row = {"name": variant, "decoder": repr(decoder), **plate.summary(bench, decoder)}
        row["safe_percent"] = _safe(bench, row.pop("bank"), "plate")
        row["paper_safe_percent"] = PAPER[variant]
        if judge is not None:
            row |= _body(bench, judge, name, decoder)
        rows.append(row | {"target": None, "met": None})
    if not rows:
        raise PluginError(f"ablation: decoder {bench.decoder.name!r} has none of the options that are compared")
    step, cap = steps(bench)
    notes += [
        "mae_of_range: mean |measured − asked| over all designs and parameters, as a share of each range",
        f"safe range: beyond each end of the range, in steps of {step} %, at most {cap} %; 100 % is f = 3",
        "the paper's safe ranges are of 100 DrivAerNet++ cars: for orientation",
    ]
    return {"rows": rows, "notes": notes, "setting": {}}


def _body(bench: Bench, judge: ModuleType, name: str, decoder: lampopt.Spec) -> Row:
    body = Body(bench, judge, name)
    bank = body.bank(body.exemplars(), decoder, [])
    errors = {
        f"body_mean_mm_f{f:g}": average([row["error"] for row in body.designs(bank, f)])["mean_mm"] for f in (1.0, 2.0)
    }
    return {**errors, "body_safe_percent": _safe(bench, bank, "body")}
