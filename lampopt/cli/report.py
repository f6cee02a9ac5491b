"""`lampopt report`: the pictures, checks and curves of a recorded run as one HTML file."""

from __future__ import annotations

from pathlib import Path

import click

from lampopt.cli.answer import Answer, Command
from lampopt.cli.options import can_be_written
from lampopt.errors import InputError
from lampopt.loop import results
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.reporting import write_report
from lampopt.study import Study


@click.command(cls=Command)
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@click.option(
    "--out",
    metavar="FILE",
    type=click.Path(dir_okay=False, path_type=Path),
    help="The file to write; by default report.html in FOLDER.",
)
def report(folder: Path, out: Path | None) -> Answer:
    """Write the report of a run folder: one HTML file that opens anywhere, offline.

    It shows what was asked, what came, each check with its limit, the shapes in pictures and to be turned, how far they
    are from the exemplars, and for sweeps a gallery, curves, parallel coordinates, what is traded for what, and a map
    of likeness. `run` and `sweep` write it by themselves; this writes it again, or elsewhere.

    \b
        lampopt report runs/roof --out roof.html
    """
    if out is not None:
        if not out.parent.is_dir():
            raise InputError(f"--out {out}: expected a file in a folder that exists")
        can_be_written("--out", out)
    plugins = Plugins.load().report()
    study = Study.read(folder / "study.toml")
    with progress_bar("writing the report"):
        path = write_report(folder, study, study.opened(), results(folder, plugins=plugins), out=out, plugins=plugins)
    return Answer({"report": str(path), "bytes": path.stat().st_size}, [f"{path} is written: open it in a browser"])
