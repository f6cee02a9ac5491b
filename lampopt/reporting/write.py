"""The one door: a run's results → `report.html` in its folder."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path

from lampopt.errors import InputError
from lampopt.plugins import Plugins
from lampopt.reading import path_of, why
from lampopt.reporting.figures import figures
from lampopt.reporting.gather import gather
from lampopt.reporting.page import page
from lampopt.reporting.searched import searched
from lampopt.study import Study
from lampopt.types import Bank, Result

MOST = 100  # designs shown in full
BESIDE = 24  # exemplars on the map of shapes; no more than designs, since each has to be decoded
log = logging.getLogger("lampopt")


def write_report(
    folder: str | Path,
    study: Study,
    bank: Bank,
    results: Iterable[Result],
    *,
    out: str | Path | None = None,
    plugins: Plugins | None = None,
) -> Path:
    """Write the report of `results` as one HTML file that needs nothing else; returns its path.

    Results are read one at a time, in their order; at most 100 of them are drawn, evenly spread over the run. A shape
    that cannot be drawn is reported without its picture.

    Parameters
    ----------
    folder
        The run folder: the report is `report.html` in it, and is called by its name.
    study, bank
        What was asked, and of what.
    results
        What came.
    out
        The file, if it is another.
    plugins
        Where decoder and measures come from; by default all that are installed.

    Raises
    ------
    InputError
        If there is no result, or the file cannot be written.
    """
    folder = path_of(folder, "folder")
    path = folder / "report.html" if out is None else Path(out)
    gathered = gather(results, bank, MOST)
    if not gathered.lines:
        raise InputError(f"report: expected at least one result in {folder}, got none: run the study first")
    plugins = plugins or Plugins.load().report()
    drawn = figures(
        bank,
        study.resolution,
        gathered.shown if study.level == "mesh" else {},
        study.reference,
        0 if gathered.single else min(BESIDE, len(gathered.shown)),
        plugins,
    )
    search = searched(folder, study, bank, plugins, gathered.lines[-1].target)  # the last that was searched for
    text = page(folder.absolute().name, study, bank, gathered, drawn, search)
    aside = path.with_name(path.name + ".writing")
    try:
        aside.write_bytes(text.encode(errors="replace"))  # a folder's name may have bytes in it that are no text
        os.replace(aside, path)
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"{path}: cannot be written: {why(error)}") from error
    return path
