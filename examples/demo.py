"""Thirteen plates with a hole teach a decoder; then it makes one with a wider hole than any of them.

Run by `make demo`. Writes into a folder (default: demo) the bank, the new plate, its checks and a picture.
"""

import json
import sys
from pathlib import Path

from picture import picture
from rich.console import Console
from rich.table import Table

import lampopt
from lampopt.progress import progress_bar
from lampopt.record import passport
from lampopt.written import export_mesh

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")
folder.mkdir(parents=True, exist_ok=True)
console = Console()
target = {"hole_radius": 0.30}

plates = lampopt.exemplars("plate")
with progress_bar("fitting 13 plates") as progress:
    bank = lampopt.build_bank(plates, decoder="mesh-template", seed=0, store=folder / "plate.lamp", progress=progress)

result = lampopt.design(bank, target)

table = Table()
for heading in ("check", "value", "", "limit", "unit", "verdict"):
    table.add_column(heading, justify="right" if heading in ("value", "limit") else "left")
for check in result.checks:
    limit = "" if check.limit is None else f"{check.limit:.4g}"
    verdict = "" if check.limit is None else "[green]passed[/]" if check.passed else "[red]failed[/]"
    sense = {"<=": "≤", ">=": "≥"}.get(check.sense, check.sense)
    table.add_row(check.name, f"{check.value:.4g}", sense, limit, check.unit, verdict)
console.print(table)

asked = ", ".join(f"{name} {value:g} m" for name, value in target.items()).replace("_", " ")
known = ", ".join(f"{q.name} {q.low:g} to {q.high:g} m" for q in bank.space if q.name in target).replace("_", " ")
console.print(f"asked for  {asked}\ntrained on {known}\n[bold]{'accepted' if result.accepted else 'rejected'}[/]\n")

written = {"checks.json": "asked, made, measured, checked", "plate.lamp": "the bank; a second run starts from it"}
(folder / "checks.json").write_text(json.dumps(passport(result, bank), indent=2), encoding="utf-8")
if result.design.mesh is not None:
    export_mesh(result.design.mesh, folder / "plate.stl")
    middle = {"one of 13 exemplars: length 2.5 m, hole radius 0.2 m": plates.meshes[0]}
    picture({**middle, f"made: {asked}": result.design.mesh}, folder / "plate.png")
    written |= {"plate.stl": "the new plate", "plate.png": "an exemplar and the new plate"}
for name, what in written.items():
    console.print(f"{folder / name}  {what}")
