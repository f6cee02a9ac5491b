"""Labels from parameters, on published tables: ``python -m benchmarks.models --help`` (docs/models.md).

DrivAerML: drag of 484 cars, each regression fitted from scratch without each of ten parts. DrivAerNet: drag by body
style, fitted to the published training designs, judged on the published test designs. Noise: small tables without
meaning, of which nothing may be claimed.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from lampopt import Spec
from lampopt.errors import InputError
from lampopt.plugins import Plugins
from lampopt.protocols import Regression
from lampopt.types import Array

from .common import ROOT, Row, line
from .document import put, show, stamped

SINGLE = ("linear", "quadratic", "gaussian-process", "boosted-trees")
STYLES = {"E": "estateback", "F": "fastback", "N": "notchback"}
DRAWN = 2000  # resamples of the test designs, for the doubt about a difference


@dataclass(frozen=True, eq=False)
class Table:
    """n designs: parameters (n, d), the label (n,), its published deviation (n,) or NaN, names (n)."""

    parameters: Array
    label: Array
    noise: Array
    names: tuple[str, ...]
    inputs: tuple[str, ...]

    def rows(self, at: Array) -> Table:
        names = tuple(np.array(self.names)[at].tolist())
        return Table(self.parameters[at], self.label[at], self.noise[at], names, self.inputs)

    def columns(self, at: Array) -> Table:
        inputs = tuple(np.array(self.inputs)[at].tolist())
        return Table(self.parameters[:, at], self.label, self.noise, self.names, inputs)


def table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of a CSV file, without blanks around them."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        head, *rows = ([cell.strip() for cell in row] for row in csv.reader(file) if row)
    return head, rows


def drivaerml(folder: Path) -> Table:
    """The designs whose drag was computed, by their morph parameters."""
    head, rows = table(folder / "geo_parameters_all.csv")
    morphs = {row[0]: [float(cell) for cell in row[1:]] for row in rows}
    _, forces = table(folder / "force_mom_constref_all.csv")
    names = tuple(row[0] for row in forces)
    drag = np.array([float(row[1]) for row in forces])
    return Table(np.array([morphs[name] for name in names]), drag, np.full(len(drag), np.nan), names, tuple(head[1:]))


def drivaernet(folder: Path) -> Table:
    """All designs, by their morph parameters; and by wheels, which the design's name tells, as columns of 0 and 1."""
    head, rows = table(folder / "DrivAerNet_ParametricData.csv")
    names = tuple(row[0] for row in rows)
    first, drag, noise = (head.index(what) for what in ("Average Cd", "Average Cd", "Std Cd"))
    morphs = np.array([[float(cell) for cell in row[1:first]] for row in rows])
    kinds = [re.fullmatch(r"[EFN]_S_(WW|WWC|WWS)_WM_\d+", name) for name in names]
    wheels = np.array([[kind is not None and kind[1] == which for which in ("WWC", "WWS")] for kind in kinds], float)
    label, deviation = (np.array([float(row[k]) for row in rows]) for k in (drag, noise))
    inputs = (*head[1:first], "wheels WWC", "wheels WWS")
    return Table(np.hstack([morphs, wheels]), label, deviation, names, inputs)


def splits(folder: Path) -> dict[str, set[str]]:
    return {which: set((folder / "splits" / f"{which}.txt").read_text().split()) for which in ("train", "val", "test")}


def r2(truth: Array, told: Array) -> float:
    return float(1 - ((truth - told) ** 2).sum() / ((truth - truth.mean()) ** 2).sum())


def fitted(regression: Regression, data: Table, seed: int) -> Any:
    """A model of the drag."""
    return regression.fit(
        data.parameters, data.label[:, None], inputs=data.inputs, names=("cd",), units=("",), seed=seed
    )


def choice(model: Any) -> dict[str, Any]:
    """What cross-validation on the training designs said."""
    found = model.evidence
    return {
        "inner_r2": dict(zip(found.regressions, found.r2[0].round(4).tolist(), strict=True)),
        "inner_error": dict(zip(found.regressions, found.error[0].round(4).tolist(), strict=True)),
        "chosen": found.regressions[int(found.chosen[0])],
    }


def covered(model: Any, data: Table, level: float = 0.9) -> float:
    low, high = model.interval(data.parameters, level)[:, 0].T
    return float(((low <= data.label) & (data.label <= high)).mean())


def by_parts(name: str, regression: Regression, data: Table, seed: int, parts: int = 10) -> Row:
    """R² of rows left out, over `parts` fits from scratch: no fit knows anything of the part that judges it."""
    part = np.random.default_rng(seed).permutation(len(data.label)) % parts
    told, scores, inside, began = np.empty_like(data.label), [], [], time.perf_counter()
    for k in range(parts):
        model, out = fitted(regression, data.rows(part != k), seed), data.rows(part == k)
        told[part == k] = model(out.parameters)[:, 0]
        scores.append(r2(out.label, told[part == k]))
        inside.append(covered(model, out))
    return line(
        name,
        r2(data.label, told),
        of=len(told),
        error=float(np.std(scores, ddof=1) / parts**0.5),
        covered_90=float(np.mean(inside)),
        seconds_a_fit=round((time.perf_counter() - began) / parts, 2),
        target=">= 0.95",
    )


def on_noise(name: str, regression: Regression, target: str | None, tables: int = 40) -> Row:
    """The largest R² that is claimed of `tables` tables of noise, 40 rows of 8 parameters; and how often 90 % hold."""
    claimed, true, inside = [], [], []
    for seed in range(tables):
        rng = np.random.default_rng(seed)
        rows = [(rng.normal(size=(n, 8)), rng.normal(size=n)) for n in (40, 500)]
        known, new = (
            Table(x, y, np.full(len(y), np.nan), ("",) * len(y), tuple(f"x{k}" for k in range(8))) for x, y in rows
        )
        model = fitted(regression, known, seed)
        claimed.append(model.cross_validated["cd"]["r2"])
        true.append(r2(new.label, model(new.parameters)[:, 0]))
        inside.append(covered(model, new))
    most = int(np.argmax(claimed))
    return line(
        name,
        float(claimed[most]),
        of=tables,
        true=true[most],
        covered_90=float(np.mean(inside)),
        covered_90_least=min(inside),
        mean=float(np.mean(claimed)),
        mean_true=float(np.mean(true)),
        target=target,
    )


def by_style(
    style: str, data: Table, split: dict[str, set[str]], plugins: Plugins, seed: int, talk: Console
) -> list[Row]:
    """R² on the test designs of one style, for every regression and for the choice among them."""
    mine = data.rows(np.array([name.startswith(f"{style}_") for name in data.names]))
    mine = mine.columns(np.ptp(mine.parameters, axis=0) > 0)
    within = {which: np.array([name in names for name in mine.names]) for which, names in split.items()}
    train, test = mine.rows(within["train"]), mine.rows(within["test"])
    ceiling = float(1 - (test.noise**2).mean() / test.label.var())
    rows, told = [], {}
    for name in (*SINGLE, "best"):
        began = time.perf_counter()
        model = fitted(plugins.make("model", name), train, seed)
        told[name] = model(test.parameters)[:, 0]
        rows.append(
            line(
                f"{STYLES[style]}: {name}",
                r2(test.label, told[name]),
                of=len(test.label),
                val=r2(mine.label[within["val"]], model(mine.parameters[within["val"]])[:, 0]),
                covered_90=covered(model, test),
                seconds=round(time.perf_counter() - began, 2),
                **choice(model),
            )
        )
        talk.print(f"{rows[-1]['name']}: R² {rows[-1]['value']:.4f}", highlight=False)
    for name in ("linear", "gaussian-process"):
        morphs = np.array([not each.startswith("wheels") for each in mine.inputs])
        model = fitted(plugins.make("model", name), train.columns(morphs), seed)
        score = r2(test.label, model(test.columns(morphs).parameters)[:, 0])
        rows.append(line(f"{STYLES[style]}: {name}, wheels unknown", score, of=len(test.label)))
    low, middle, high = gained(test.label, told["linear"], told["best"], seed)
    rows.append(line(f"{STYLES[style]}: best over linear", middle, low=low, high=high, target="> 0"))
    rows.append(line(f"{STYLES[style]}: if all of Std Cd were noise", ceiling, of=len(test.label)))
    rows[-2]["met"] = low > 0
    return rows


def gained(truth: Array, first: Array, second: Array, seed: int) -> tuple[float, float, float]:
    """By how much the second R² is larger: the value, between the ends of 95 % of bootstrap resamples."""
    at = np.random.default_rng(seed).integers(len(truth), size=(DRAWN, len(truth)))
    more = [r2(truth[i], second[i]) - r2(truth[i], first[i]) for i in at]
    low, high = np.percentile(more, (2.5, 97.5))
    return float(low), r2(truth, second) - r2(truth, first), float(high)


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.models", description=__doc__)
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="holds drivaerml, drivaernet"
    )
    parser.add_argument("--only", choices=("noise", "drivaerml", "drivaernet"), help="one of the three")
    parser.add_argument("--styles", default="EFN", help="of DrivAerNet")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "models.json")
    options = parser.parse_args(given)
    talk, plugins, tables = Console(stderr=True), Plugins.load().report(), {}
    try:
        with threadpool_limits(options.threads):
            if options.only in (None, "noise"):
                rows = [
                    on_noise(name, plugins.make("model", spec), target)
                    for name, spec, target in (
                        ("gaussian-process", Spec("gaussian-process"), "<= 0.1"),
                        ("gaussian-process, lengths and noise of all rows", Spec("gaussian-process", anew=0), None),
                        ("best without trees", Spec("best", among=" ".join(SINGLE[:3])), "<= 0.1"),
                    )
                ]
                tables["noise"] = {
                    "rows": rows,
                    "notes": ["largest R² claimed of 40 tables of noise, 40 rows of 8 parameters"],
                }
            if options.only in (None, "drivaerml"):
                data = drivaerml(options.data / "drivaerml")
                rows = []
                for name in (*SINGLE, "best"):
                    rows.append(by_parts(f"cd: {name}", plugins.make("model", name), data, options.seed))
                    talk.print(f"{rows[-1]['name']}: R² {rows[-1]['value']:.4f}", highlight=False)
                tables["drivaerml"] = {"rows": rows, "notes": [f"R² over ten parts left out; {len(data.label)} runs"]}
            if options.only in (None, "drivaernet"):
                data, split = drivaernet(options.data / "drivaernet"), splits(options.data / "drivaernet")
                for style in options.styles:
                    rows = by_style(style, data, split, plugins, options.seed, talk)
                    tables[f"drivaernet {STYLES[style]}"] = {"rows": rows, "notes": ["R² of Cd on the test designs"]}
    except (OSError, InputError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    for title, found in tables.items():
        show(talk, title, found)
    settings = {"seed": options.seed, "threads": options.threads, "scikit-learn": version("scikit-learn")}
    put(stamped("models", **settings) | {"tables": tables}, options.out, out=True)
    return 0 if all(row["met"] is not False for found in tables.values() for row in found["rows"]) else 1


if __name__ == "__main__":
    sys.exit(main())
