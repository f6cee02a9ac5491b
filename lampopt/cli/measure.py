"""`lampopt measure`: named values off a mesh file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lampopt.check import LEVEL, trusted
from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import spec
from lampopt.cli.show import number, table
from lampopt.measured import values_of
from lampopt.meshfile import load_mesh
from lampopt.plugins import Plugins
from lampopt.protocols import Interval
from lampopt.units import factor, filled


@click.command(cls=Command)
@click.argument("name")
@click.argument("mesh", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--set", "settings", multiple=True, metavar="OPTION=VALUE", help="An option of the measure; repeatable.")
@click.option("--unit", default="m", show_default=True, help="Length unit of the mesh file.")
def measure(name: str, mesh: Path, settings: tuple[str, ...], unit: str) -> Answer:
    """Measure a mesh file.

    NAME is a measure; `lampopt plugins` lists them. MESH is a file that lampopt reads: STL, OBJ,
    PLY, OFF, glTF, GLB, 3MF or COLLADA.

    \b
        lampopt measure extents car.stl
    """
    factor(unit, "m", "--unit")  # raises where it is no length
    plugins = Plugins.load().report()
    chosen = spec(plugins, "measure", name, "--set", settings)
    made, found = plugins.make("measure", chosen), load_mesh(mesh)
    values = dict(zip(made.names, values_of(name, made, found).tolist(), strict=True))
    units = [filled(u, unit) for u in made.units]
    document: dict[str, Any] = {
        "measure": name,
        "mesh": str(mesh),
        "values": {n: {"value": v, "unit": u} for (n, v), u in zip(values.items(), units, strict=True)},
    }
    heads = ["name", "value", "unit"]
    rows = [[n, number(v), u] for (n, v), u in zip(values.items(), units, strict=True)]
    said = []
    if isinstance(made, Interval):
        ends, document["outside"] = trusted(name, made, found)
        heads.append(f"{LEVEL:.0%} interval")
        for row, value, (low, high) in zip(rows, values, ends.tolist(), strict=True):
            document["values"][value]["interval"] = [low, high]
            row.append(f"{number(low)} to {number(high)}")
        if document["outside"]:
            said = [f"{mesh} is outside what {name} was made for: neither value nor interval is to be trusted"]
    return Answer(document, [table(f"{name} of {mesh}", heads, rows, right=("value",)), *said])
