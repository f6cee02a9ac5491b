"""What a benchmark leaves behind: a table for people, a JSON document for benchmarks/results/."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

FOLDERS = re.compile(r"(?<![\w/.:…])/(?:[\w.+@-]+/)+")  # of absolute paths, which error messages name
WIDE = (
    "name",
    "value",
    "ratio",
    "grid",
    "nothing",
    "target",
    "met",
    "ours [s]",
    "theirs [s]",
    "note",
)  # of the rows' entries, those that fit a screen


def stamped(benchmark: str, **settings: object) -> dict[str, Any]:
    """The head of a document: what was run with which settings, and on what."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    return {"benchmark": benchmark, **settings, "lampopt": version("lampopt"), "commit": state(), "machine": machine}


def put(document: dict[str, Any], path: Path | None, *, out: bool = False) -> None:
    """Write a document to `path`, if there is one, and with `out` to standard output."""
    text = json.dumps(plain(document), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    if out:
        sys.stdout.write(text)


def plain(value: Any) -> Any:
    """`value` as strict JSON can hold it, and as any machine may: null for what is no number, no folder of this one."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, str):
        return FOLDERS.sub("…/", value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show(console: Console, title: str, table: dict[str, Any]) -> None:
    """One table for people."""
    rows, caption = table["rows"], "\n".join(table["notes"])
    if "value" in rows[0] or "ratio" in rows[0]:
        heads = [h for h in WIDE if any(row.get(h) is not None for row in rows)]
        out = Table(*heads, "of; by", title=escape(title), caption=escape(caption), caption_justify="left")
        for row in rows:
            last = [str(row["of"])] if "of" in row else []
            last += [", ".join(f"{k} {n}" for k, n in row["by"].items())] if row.get("by") else []
            last += [f"no mesh: {row['empty']}"] if row.get("empty") else []
            out.add_row(*(cell(row.get(head)) for head in heads), escape("; ".join(last)))
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
