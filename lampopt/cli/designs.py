"""`lampopt make`, `run`, `sweep`: designs from a bank, one from options, one or many from a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lampopt.choices import Value
from lampopt.cli import show
from lampopt.cli.answer import DONE, REJECTED, Answer, Command
from lampopt.cli.options import can_be_written, chosen_measures, crew, numbers, pairs, spec
from lampopt.cli.wishes import fields, wishes
from lampopt.errors import InputError, StudyError
from lampopt.experiments import METHODS, MOST, Experiments
from lampopt.loop import run as run_study
from lampopt.loop import sweep as sweep_study
from lampopt.meshfile import FORMATS
from lampopt.plugins import Plugins
from lampopt.progress import progress_bar
from lampopt.record import passport
from lampopt.solve import columns
from lampopt.study import Study
from lampopt.task import Task
from lampopt.types import LEVELS, Bank, Check, Needs, Result
from lampopt.written import export_mesh

if TYPE_CHECKING:
    from rich.console import RenderableType

RESUMES = "what is finished is kept, and the same command goes on where it stopped"
STUDY = click.argument("study_file", metavar="STUDY", type=click.Path(dir_okay=False, path_type=Path))
FOLDER = click.option(
    "--folder",
    metavar="FOLDER",
    type=click.Path(file_okay=False, path_type=Path),
    help="Where results are recorded; by default runs/NAME beside the study file NAME.toml.",
)
_report = click.option("--report/--no-report", default=True, help="Whether to write report.html when all is done.")


@click.command(cls=Command)
@click.argument("bank", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--target",
    "targets",
    multiple=True,
    metavar="NAME=VALUE",
    help='A wanted value, in the bank\'s unit or with its own: roof=1.42, "ramp=12 deg". Repeatable.',
)
@click.option("--keep", multiple=True, metavar="NAME", help="Hold NAME at the reference's value, or the bank's mean.")
@click.option("--reference", metavar="NAME", help="The exemplar to stay near.")
@wishes
@click.option("--solver", default="kkt", show_default=True, metavar="NAME", help="What chooses the mix.")
@click.option("--solver-set", "solver_settings", multiple=True, metavar="OPTION=VALUE", help="An option of the solver.")
@click.option(
    "--measure",
    "measures",
    multiple=True,
    metavar="NAME[:OPTION=VALUE,...]",
    help="A measure to report, with its options; repeatable.",
)
@click.option("--limit", "limits", multiple=True, metavar="CHECK=NUMBER", help="The limit of a check; repeatable.")
@click.option("--resolution", default=128, show_default=True, help="Cells along the decoder's box.")
@click.option("--level", type=click.Choice(LEVELS), default="mesh", show_default=True, help="Where to stop judging.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="For whatever draws.")
@click.option(
    "--out",
    metavar="FILE",
    type=click.Path(dir_okay=False, path_type=Path),
    help=f"The mesh file, .{', .'.join(FORMATS)}; without it the design is only judged.",
)
def make(
    bank: Path,
    targets: tuple[str, ...],
    keep: tuple[str, ...],
    reference: str | None,
    solver: str,
    solver_settings: tuple[str, ...],
    measures: tuple[str, ...],
    limits: tuple[str, ...],
    resolution: int,
    level: Needs,
    seed: int,
    out: Path | None,
    **wished: Any,
) -> Answer:
    """Make one design from a bank.

    Shows the evidence about it and writes its mesh. The mesh is written even when the design is rejected, which the
    exit code says (1). A design without a surface writes nothing.

    \b
        lampopt make cars.lamp --target roof=1.42 --target "ramp=12 deg" --out car.stl
        lampopt make cars.lamp --solver casadi --reference car_017 --target roof=1.42 --hard roof --range "ramp=:12 deg"
    """
    more = fields(wished)
    if not (targets or keep or reference or more["ranges"] or more["objective"]):
        raise InputError("--target: expected at least one wanted value, such as --target roof=1.42, got none")
    plugins = Plugins.load().report()
    study = Study(
        bank,
        targets=pairs("--target", targets),
        keep=keep,
        reference=reference,
        solver=spec(plugins, "solver", solver, "--solver-set", solver_settings),
        measures=chosen_measures(plugins, measures),
        limits=numbers("--limit", limits),
        level=level,
        resolution=resolution,
        seed=seed,
        **more,
    )
    if out is not None:
        can_be_a_mesh("--out", out)
    opened = study.opened()
    with progress_bar("making the design") as progress:
        result = run_study(replace(study, bank=opened), progress=progress, plugins=plugins)
        mesh = result.design.mesh if out is not None else None
    written = out is not None and mesh is not None
    if out is not None and mesh is not None:
        export_mesh(mesh, out)
    document = {"mesh": str(out) if written else None, **passport(result, opened)}
    if out is None:
        last = "no mesh is written without --out"
    elif not written:
        last = f"{out} is not written: the design has no surface"
    else:
        last = f"{out} is written" + ("" if result.accepted else ", although the design is rejected: use it with care")
    code = DONE if result.accepted and (written or out is None) else REJECTED
    return Answer(document, [*_shown(result, opened), last], code)


@click.command(cls=Command, resumes=RESUMES)
@STUDY
@FOLDER
@_report
def run(study_file: Path, folder: Path | None, report: bool) -> Answer:
    """Make the one design that a study file asks for.

    It is recorded in a folder; a design that is recorded there already is read back, not computed again.
    """
    plugins = Plugins.load().report()
    study, opened, folder = opened_study(study_file, folder)
    with progress_bar(f"running {study_file.name}") as progress:
        result = run_study(study, folder, report=report, progress=progress, plugins=plugins)
    document = {"folder": str(folder), **passport(result, opened)}
    shown = [*_shown(result, opened), f"recorded in {folder}"]
    return Answer(document, shown, DONE if result.accepted else REJECTED)


@click.command(cls=Command, resumes=RESUMES)
@STUDY
@FOLDER
@click.option(
    "--set",
    "grid",
    multiple=True,
    metavar="NAME=VALUE,VALUE,...",
    help="Values of NAME, instead of the study's [sweep] or [experiments]; with several names every combination is "
    "made. With the next three options a low and a high value.",
)
@click.option(
    "--experiments",
    "count",
    type=click.IntRange(1, MOST),
    metavar="COUNT",
    help="So many designs, spread between a low and a high value of each NAME; those of the study's [experiments] "
    "without --set.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    help=f"How they are spread; by default as the study says, or {METHODS[0]}. Corners need no COUNT.",
)
@click.option("--seed", type=click.IntRange(0), help="Of their draws; by default as the study says, or 0.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes that make designs.")
@_report
def sweep(
    study_file: Path,
    folder: Path | None,
    grid: tuple[str, ...],
    count: int | None,
    method: str | None,
    seed: int | None,
    workers: int,
    report: bool,
) -> Answer:
    """Make a design for every combination of values, or for a plan of experiments.

    The values are those of the study file's [sweep] or [experiments], or those behind --set. Results are recorded in a
    folder. Exits 0 if all designs are accepted, 1 if any is rejected. Designs that are recorded already are read back,
    so an interrupted or a grown sweep computes only what is missing.

    \b
        lampopt sweep study.toml --set roof=1.30,1.36,1.42
        lampopt sweep study.toml --experiments 64 --method sobol --set roof=1.30,1.42 --set ramp=8,16
    """
    plugins = Plugins.load().report()
    study, opened, folder = opened_study(study_file, folder)
    given = {name: _listed(name, text) for name, text in pairs("--set", grid).items()}
    if (count, method, seed) != (None, None, None):
        study = replace(study, sweep={}, experiments=_planned(study, given, count, method, seed))
    elif given:
        study = replace(study, sweep=given, experiments=None)
    elif not (study.sweep or study.experiments):
        raise StudyError(
            f"{study_file}: has no [sweep] table, and no [experiments]: add one, or name values as in --set "
            "roof=1.30,1.36"
        )
    designs: list[dict[str, Any]] = []
    rows: list[list[Any]] = []
    with progress_bar(f"sweeping {study_file.name}") as progress, crew(workers) as executor:
        made = sweep_study(study, None, folder, executor=executor, report=report, progress=progress, plugins=plugins)
        try:
            for number, result in enumerate(made, 1):
                failed = next((check for check in result.checks if not check.passed), None)
                designs.append(_summary(result, opened, failed))
                asked = [show.number(value) for value in result.design.target.values()]
                name = "" if result.folder is None else result.folder.name
                rows.append([number, *asked, show.verdict(result.accepted), _why(failed), name])
        except KeyboardInterrupt as stop:
            made.throw(stop)  # it says how much is done, if it has not already
    accepted = sum(design["accepted"] for design in designs)
    rejected = len(designs) - accepted
    document = {"folder": str(folder), "accepted": accepted, "rejected": rejected, "designs": designs}
    columns = (
        "#",
        *(f"{name} {_unit(study, name, plugins)}".rstrip() for name in designs[0]["target"]),
        "accepted",
        "first failing check",
        "design",
    )
    counted = f"{accepted} of {len(designs)} designs are accepted; all are recorded in {folder}"
    shown = show.table(str(study_file), columns, rows, right=columns[:-3])
    return Answer(document, [shown, counted], REJECTED if rejected else DONE)


def can_be_a_mesh(option: str, path: Path) -> None:
    """Raise InputError, before long work, where no mesh file can be put at `path`."""
    if path.suffix.lower().lstrip(".") not in FORMATS or not path.parent.is_dir():
        raise InputError(f"{option} {path}: expected a file ending in .{', .'.join(FORMATS)} in a folder that exists")
    can_be_written(option, path)


def _planned(
    study: Study, given: Mapping[str, Sequence[Value]], count: int | None, method: str | None, seed: int | None
) -> Experiments:
    """The plan that the options ask for, what they leave open taken from the study's own."""
    before = study.experiments
    if not given and before is None:
        raise StudyError(
            "--experiments: expected a low and a high value for each name, as in --set roof=1.30,1.42, or a table "
            "[experiments] in the study"
        )
    method = method or (METHODS[0] if before is None else before.method)
    if count is None and before is not None and method != "corners":
        count = before.count
    if seed is None:
        seed = 0 if before is None else before.seed
    ranges: Any = given or (before and before.ranges)  # as it came: Experiments says what is wrong with it
    return Experiments(ranges, count, method, seed)


def opened_study(study_file: Path, folder: Path | None) -> tuple[Study, Bank, Path]:
    """The study with its bank opened once, and where its results go: beside it, as its bank's path is meant too."""
    study = Study.read(study_file)
    opened = study.opened()
    return replace(study, bank=opened), opened, folder or study_file.parent / "runs" / study_file.stem


def _listed(name: str, text: str) -> list[str]:
    values = [value.strip() for value in text.split(",")]
    if not all(values):
        raise InputError(f"--set {name}: expected values between commas, such as 1.30,1.36, got {text!r}")
    return values


def _shown(result: Result, bank: Bank) -> Sequence[RenderableType]:
    status = f"{result.design.mix.status} mix" + (f": {m}" if (m := result.design.mix.message) else "")
    told = {check.name.partition(".")[2] for check in result.checks if check.name.startswith("measured.")}
    mixed = [q.name for q in bank.label_space if q.name in result.design.target and q.name not in told]
    doubt = "mixed from the exemplars' labels, which shapes need not follow: declare what measures it, or confirm it"
    return [
        show.checks(result),
        show.predicted(result, bank),
        *([f"{', '.join(mixed)}: {doubt}"] if mixed else []),
        status,
        show.verdict(result.accepted, "accepted: every check passed", f"REJECTED: {_failures(result)}"),
    ]


def _failures(result: Result) -> str:
    return "; ".join(_why(check) for check in result.checks if not check.passed)


def _why(check: Check | None) -> str:
    if check is None:
        return ""
    if check.value != check.value:
        return f"{check.name} is not known: {check.note}"
    return f"{check.name} {show.number(check.value)}, expected {show.limit(check)}"


def _summary(result: Result, bank: Bank, failed: Check | None) -> dict[str, Any]:
    """A design in a sweep's document: its passport without the long lists, and the first check that it fails."""
    full = passport(result, bank)
    kept = {key: full[key] for key in ("target", "accepted", "status", "message", "predicted")}
    name = None if result.folder is None else result.folder.name
    return {
        **kept,
        "design": name,
        "failed": next((c for c in full["checks"] if failed and c["name"] == failed.name), None),
    }


def _unit(study: Study, name: str, plugins: Plugins) -> str:
    """The unit of what is asked for; a model or a measure is opened for it only where it tells the value."""
    found = columns(study.opened()).get(name)
    unit = Task.of(study, plugins).wishes.quantities[name].unit if found is None else found.unit
    return f"[{unit}]" if unit else ""
