"""How faithful mixed shapes are: ``python -m benchmarks.fidelity --help`` (docs/performance.md)."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from threadpoolctl import threadpool_limits

TABLES = ("plate", "body", "ablation")
WIDE = ("name", "value", "grid", "nothing", "target", "met")  # of the rows' entries, those that fit a screen


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fidelity", description=__doc__)
    parser.add_argument("--table", choices=(*TABLES, "all"), default="all")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    parser.add_argument(
        "--quick", action="store_true", help="few targets, coarse: does it run at all; no figures to quote"
    )
    parser.add_argument("--body", default="Hybrid", help="of the judge's bodies")
    parser.add_argument("--decoder", default="sdf-mlp")
    parser.add_argument(
        "--decoder-set", action="append", default=[], type=pair, metavar="K=V", help="an option of the decoder"
    )
    parser.add_argument("--resolution", type=int, help="cells along the decoder's box (192; 48 with --quick)")
    parser.add_argument("--seed", type=int, default=0, help="of the fits")
    parser.add_argument("--cache", type=Path, default=Path("runs/benchmarks"), help="where banks and scores are kept")
    parser.add_argument("--out", type=Path, help="folder for the JSON document, one a table")
    parser.add_argument("--judge", help="folder of judge.py (../shared/judge beside the repository)")
    parser.add_argument("--threads", type=int, default=1, help="of BLAS and libigl; torch's are the decoder's business")
    return parser.parse_args(given)


def pair(text: str) -> tuple[str, str | int | float | bool]:
    """An option and its value."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    return name, scalar(value)


def scalar(text: str) -> str | int | float | bool:
    """`text` as the truth value or number that it spells."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def plain(value: Any) -> Any:
    """`value` as strict JSON can hold it: null for what is no number."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show(console: Console, title: str, table: dict[str, Any]) -> None:
    """One table for people."""
    rows, caption = table["rows"], "\n".join(table["notes"])
    if "value" in rows[0]:
        heads = [h for h in WIDE if any(row.get(h) is not None for row in rows)]
        out = Table(*heads, "of; by", title=escape(title), caption=escape(caption), caption_justify="left")
        for row in rows:
            more = [str(row["of"])] if "of" in row else []
            more += [", ".join(f"{k} {n}" for k, n in row["by"].items())] if row.get("by") else []
            more += [f"no mesh: {row['empty']}"] if row.get("empty") else []
            out.add_row(*(cell(row.get(head)) for head in heads), escape("; ".join(more)))
    else:  # few rows with much in each: one column a row
        out = Table("", *(row["name"] for row in rows), title=escape(title), caption=escape(caption))
        for head in [h for h in rows[0] if h not in ("name", "decoder", "target", "met")]:
            out.add_row(head, *(cell(row.get(head)) for row in rows))
    console.print(out)
    for name in ("setting", "failed", "unmeasured", "unmeasured_on_grid"):
        if table.get(name):
            console.print(f"{name}: {table[name]}", highlight=False, markup=False)


def cell(value: object) -> str:
    """`value` as text; brackets are no markup."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "[bold red]no[/bold red]"
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))


def state() -> str:
    """The commit that is measured, with a + where the tree differs from it."""
    folder = Path(__file__).resolve().parent

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def main(given: Sequence[str] | None = None) -> int:
    args = arguments(given)
    os.environ["IGL_NUM_THREADS"] = str(args.threads)  # read by libigl on its first parallel loop
    from lampopt import Spec
    from lampopt.errors import LampoptError

    from . import ablation, body, plate
    from .common import Bench

    talk = Console(stderr=True)
    try:
        bench = Bench(
            args.cache / "quick" if args.quick else args.cache,
            Spec(args.decoder, **dict(args.decoder_set)),
            args.resolution or (48 if args.quick else 192),
            args.quick,
            args.seed,
            console=talk,
        )
        judge = body.find_judge(args.judge)
        if judge is not None and args.body not in judge.LENGTH:
            raise LampoptError(f"--body: expected one of {', '.join(judge.LENGTH)}, got {args.body!r}")
        make: dict[str, Callable[[], dict[str, Any]]] = {
            "plate": lambda: plate.table(bench),
            "ablation": lambda: ablation.table(bench, judge, args.body),
        }
        notes = []
        if judge is not None:
            make["body"] = lambda: body.table(bench, judge, args.body)
        elif args.table != "plate":
            notes.append("no judge.py with its car bodies was found: real bodies are left out (--judge FOLDER)")
            talk.print(f"[bold]{notes[0]}[/bold]")
        asked = [name for name in TABLES if args.table in (name, "all") and name in make]
        tables = {}
        with threadpool_limits(args.threads, user_api="blas"):
            for name in asked:
                tables[name] = make[name]()
                if not args.json:
                    show(Console(), f"{name}: {bench.decoder}{' (quick)' if args.quick else ''}", tables[name])
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    document = {
        "benchmark": "fidelity",
        "decoder": {"name": bench.decoder.name, "options": dict(bench.decoder.options)},
        "quick": args.quick,
        "seed": args.seed,
        "resolution": bench.resolution,
        "threads": args.threads,
        "lampopt": version("lampopt"),
        "commit": state(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "notes": notes,
        "tables": tables,
        "seconds": bench.seconds,
    }
    text = json.dumps(plain(document), indent=1, allow_nan=False, ensure_ascii=False)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        name = "-".join([args.table, bench.decoder.name, *(["quick"] if args.quick else [])])
        (args.out / f"fidelity-{name}.json").write_text(text + "\n", encoding="utf-8")
    if args.json:
        sys.stdout.write(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
