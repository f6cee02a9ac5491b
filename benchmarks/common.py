"""What the benchmarks share: banks and scores kept from run to run, wall seconds by stage."""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib.util
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits

import lampopt
from lampopt.errors import PluginError
from lampopt.plugins import Plugins

ROOT = Path(__file__).resolve().parents[1]
# What a judged design depends on.
CORE = (
    "angles",
    "chain",
    "check",
    "closing",
    "decode",
    "loop",
    "measured",
    "metrics",
    "mix",
    "mixes",
    "quantities",
    "safeguards",
    "plane",
    "solve",
    "task",
    "terms",
    "topology",
    "units",
    "wishes",
)
ROWS = 1  # raise it when kept rows come to hold something else
Row = dict[str, Any]


def module_at(path: Path) -> ModuleType:
    """The Python file at `path`, imported unchanged under its own name."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def options(parser: argparse.ArgumentParser, *, decoder: str) -> None:
    """What every benchmark of banks can be told: the decoder, how finely it is decoded, where things are kept."""
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    parser.add_argument("--decoder", default=decoder)
    parser.add_argument("--resolution", type=int, default=128, help="cells along the decoder's box, where it has them")
    parser.add_argument("--seed", type=int, default=0, help="of fits and draws")
    parser.add_argument("--cache", type=Path, default=Path("runs/benchmarks"), help="where banks and scores are kept")
    parser.add_argument("--out", type=Path, help="folder for the JSON document")
    parser.add_argument("--judge", help="folder of judge.py (../shared/judge beside the repository)")
    parser.add_argument("--threads", type=int, default=1, help="of BLAS and libigl")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """BLAS and libigl on so many threads; libigl reads its number on its first parallel loop."""
    os.environ["IGL_NUM_THREADS"] = str(count)
    with threadpool_limits(count, user_api="blas"):
        yield


def extra(name: str) -> ModuleType:
    """A package of the extra `bench`. Raises PluginError where it is not installed, saying how it is."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise PluginError(f"{name} is not installed: pip install -c constraints.txt -e '.[bench]'") from error


def installed_and_example() -> Plugins:
    """Everything installed, and the example decoder `gridsdf` from its folder where it is not."""
    plugins = Plugins.load()
    example = ROOT / "examples" / "third_party_decoder" / "lampopt_gridsdf.py"
    if ("decoder", "gridsdf") not in plugins.offers and example.exists():
        plugins = Plugins.load(extra=[("gridsdf", module_at(example))])
    return plugins.report()


def key(value: object) -> str:
    """A short hash of plain values."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=8).hexdigest()


def source(of: type | ModuleType) -> str:
    """A hash of the code behind a class or module: its file, and those beside it that this one needs."""
    module = of if isinstance(of, ModuleType) else sys.modules[of.__module__]
    waiting, found = [Path(module.__file__ or "")], {}
    while waiting:
        if (path := waiting.pop()) not in found:
            found[path] = parsed(path)
            beside = [path.parent / f"{name}.py" for name in _imported(path)]
            waiting += [other for other in beside if other.exists()]
    return key([found[path] for path in sorted(found)])


def core(*names: str) -> list[str]:
    """What modules of lampopt itself do."""
    return [parsed(Path(lampopt.__file__).parent / f"{name}.py") for name in names]


def _imported(path: Path) -> list[str]:
    """What may be modules beside a file that it imports from: `.module`, `package.module`, here or in a function."""
    nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    names = [alias.name for node in nodes if isinstance(node, ast.Import | ast.ImportFrom) for alias in node.names]
    return [name.rpartition(".")[2] for name in [*names, *(node.module or "" for node in froms)]]


def parsed(path: Path) -> str:
    """What a Python file does: its syntax tree, so that a comment, a docstring or a line break alters nothing."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False):
            node.body = node.body[1:]
    return ast.dump(tree)


@dataclass
class Bench:
    """One run of the benchmarks: where things are kept, what is measured with."""

    cache: Path
    decoder: lampopt.Spec
    resolution: int = 192
    quick: bool = False
    seed: int = 0
    plugins: Plugins = field(default_factory=installed_and_example)
    console: Console = field(default_factory=lambda: Console(stderr=True))
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.cache.mkdir(parents=True, exist_ok=True)
        self.scores = Scores(self.cache / f"scores-{ROWS}.jsonl")
        used = [self.plugins.get(*which).resolve() for which in (("solver", "kkt"), ("measure", "plate"))]
        self.code = key([core(*CORE), *map(source, used)])

    @classmethod
    def of(cls, args: argparse.Namespace, console: Console) -> Bench:
        """As `options` and `--quick` say."""
        cache = args.cache / "quick" if args.quick else args.cache
        return cls(cache, lampopt.Spec(args.decoder), args.resolution, args.quick, args.seed, console=console)

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[..., None]]:
        """Time a stage; yields what tells how far it is, from 0 to 1."""
        began = time.perf_counter()
        bar = Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=self.console)
        bar.live.transient, bar.disable = True, not self.console.is_terminal
        with bar:
            task = bar.add_task(name, total=1.0)

            def tell(done: float, message: str = "", /) -> None:
                bar.update(task, completed=done, description=f"{name}: {message}" if message else name)

            yield tell
        spent = time.perf_counter() - began
        self.seconds[name] = round(self.seconds.get(name, 0.0) + spent, 2)
        self.console.print(f"[dim]{name}: {spent:.1f} s[/dim]", highlight=False)

    def bank(
        self, name: str, exemplars: lampopt.Exemplars, decoder: lampopt.Spec, measured: Mapping[str, str] | None = None
    ) -> lampopt.Bank:
        """The bank of `exemplars` by `decoder`, built once for each state of the decoder's code; builds resume."""
        code = source(self.plugins.get("decoder", decoder.name).resolve())
        known = [repr(decoder), self.seed, code, exemplars.names, exemplars.parameters.tolist(), dict(measured or {})]
        store = self.cache / f"{name}-{decoder.name}-{key(known)}.lamp"
        with self.stage(f"{name}: bank {decoder}") as tell:
            return lampopt.build_bank(
                exemplars,
                decoder,
                seed=self.seed,
                store=store,
                measured=measured,
                progress=tell,
                plugins=self.plugins,
            )

    def identity(self, bank: lampopt.Bank) -> list[object]:
        """What a design of `bank` depends on besides its target."""
        from lampopt.lamp import digest

        shared = {name: digest(np.asarray(array)) for name, array in bank.shared.items()}
        facts = [bank.frame.scale, bank.frame.centre.tolist(), dict(bank.measured_by), dict(bank.limits)]
        code = source(self.plugins.get("decoder", bank.decoder.name).resolve())
        return [repr(bank.decoder), digest(np.asarray(bank.weights)), shared, facts, self.resolution, self.code, code]


class Scores:
    """Plain rows by key in a file of JSON lines, so that a killed run goes on where it stopped."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, {}
        if path.exists():
            text = path.read_text(encoding="utf-8")
            for line in text.splitlines():
                try:
                    row = json.loads(line)
                except json.JSONDecodeError:  # cut short when the run was killed
                    continue
                self.rows[row["key"]] = row["row"]
            if text and not text.endswith("\n"):
                with path.open("a", encoding="utf-8") as file:
                    file.write("\n")

    def get(self, known: object, make: Callable[[], Row]) -> Row:
        """The row of what `known` describes, made now if it is not there."""
        at = key(known)
        if at not in self.rows:
            self.rows[at] = make()
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": at, "row": self.rows[at]}) + "\n")
        return self.rows[at]


def judged(result: lampopt.Result) -> Row:
    """What is kept of a result: its verdict, its checks, its coefficients."""
    return {
        "accepted": result.accepted,
        "failed": [check.name for check in result.checks if not check.passed],
        "checks": {check.name: check.value for check in result.checks},
        "alpha": result.design.mix.alpha.tolist(),
        "empty": result.design.mesh is None,
    }


def counts(rows: Sequence[Row], *, without: str = "\0") -> dict[str, int]:
    """How often each check failed, the most frequent first; those that start with `without` are left out."""
    return dict(Counter(name for row in rows for name in row["failed"] if not name.startswith(without)).most_common())


def share(part: Sequence[object], of: Sequence[object]) -> float:
    """The share of `of` that `part` makes up; NaN where there is nothing to share."""
    return len(part) / len(of) if of else float("nan")


def line(name: str, value: float, *, grid: float | None = None, target: str | None = None, **more: object) -> Row:
    """One row of a table. `target` compares with a number or with `grid`: ">= 0.98", "<= grid"."""
    met: bool | None = None
    if target is not None:
        sense, limit = target.split()
        held = float("nan") if grid is None and limit == "grid" else grid if limit == "grid" else float(limit)
        met = bool(value >= held if sense == ">=" else value <= held)
    return {"name": name, "value": value, "grid": grid, **more, "target": target, "met": met}
