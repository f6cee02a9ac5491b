"""`lampopt …`: the system from a shell.

Every command takes `--json` and then prints one JSON document on standard output and nothing else there; people get
tables and progress on standard error. Exit codes: 0 done and accepted, 1 done and rejected, 2 wrong input (a mesh that
`intake` refuses, too), 130 interrupted, 70 a bug (with its traceback), so that a crash is never taken for a rejected
design.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence

import click

from lampopt.cli.active import active
from lampopt.cli.answer import CRASHED, INTERRUPTED, VERBOSE, WRONG, Group, logged_to_stderr, refuse
from lampopt.cli.bank import bank
from lampopt.cli.compare import compare
from lampopt.cli.designs import make, run, sweep
from lampopt.cli.explore import explore
from lampopt.cli.flow import flow, flow_study
from lampopt.cli.front import front
from lampopt.cli.intake import intake, wrap
from lampopt.cli.label import label
from lampopt.cli.learn import model, surrogate
from lampopt.cli.measure import measure
from lampopt.cli.moved import residuals, sensitivities
from lampopt.cli.plugins import check_plugin, options, plugins, sources
from lampopt.cli.report import report
from lampopt.cli.trust import calibrate, volume

__all__ = ["cli", "main"]

EPILOG = """Exit codes: 0 done and accepted, 1 done and rejected, 2 wrong input, 130 interrupted, 70 a bug in lampopt
or a plugin. Every command takes --json: one JSON document on standard output, nothing else there."""


@click.group(cls=Group, params=[VERBOSE], context_settings={"help_option_names": ["-h", "--help"]}, epilog=EPILOG)
@click.version_option(package_name="lampopt")
def cli() -> None:
    """Parameter-controlled shapes from a few dozen exemplars: build a bank, ask it for designs, see the evidence."""


for command in (
    plugins,
    sources,
    options,
    bank,
    intake,
    wrap,
    measure,
    label,
    flow,
    flow_study,
    surrogate,
    model,
    make,
    run,
    sweep,
    explore,
    front,
    active,
    report,
    sensitivities,
    check_plugin,
):
    cli.add_command(command)

for command in (calibrate, compare, residuals, volume):
    bank.add_command(command)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args`, by default that of this process; returns the exit code."""
    args = list(sys.argv[1:] if args is None else args)
    as_json = "--json" in args  # told by eye: where the options themselves are wrong nobody has read them
    with logged_to_stderr():
        try:
            code: int = cli.main(args, prog_name="lampopt", standalone_mode=False)
        except click.ClickException as error:
            if as_json:
                return refuse(type(error).__name__, error.format_message(), WRONG, as_json=True)
            error.show()
            return WRONG
        except click.Abort:  # outside of any command, which says more itself
            return refuse("Interrupted", "interrupted", INTERRUPTED, as_json=as_json)
        except (Exception, SystemExit) as error:  # a bug: it keeps its traceback, and an exit code of its own
            if isinstance(error, SystemExit) and error.code == 1 and "PacifyFlush" in type(sys.stdout).__name__:
                raise  # click's own way to end where nobody reads on
            traceback.print_exc()
            if as_json:
                refuse(type(error).__name__, str(error), CRASHED, as_json=True)
            return CRASHED
    return code
