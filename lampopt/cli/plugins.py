"""`lampopt plugins`, `sources`, `options`, `check-plugin`: what is installed, and does it keep its promises?"""

from __future__ import annotations

import inspect
import os
from dataclasses import asdict
from importlib.metadata import entry_points
from typing import Any

import click

from lampopt.cli.answer import DONE, REJECTED, Answer, Command
from lampopt.cli.show import table, verdict
from lampopt.errors import PluginError
from lampopt.plugins import BLOCK, KINDS, Plugins, default_options, known_options, required_options
from lampopt.progress import progress_bar


@click.command(cls=Command)
def plugins() -> Answer:
    """List the plugins, and what is wrong with them.

    Each with its distribution, its version and what it offers, none of which is loaded. LAMPOPT_BLOCK=a,b in the
    environment switches plugins off.
    """
    found = Plugins.load().report()
    installed = entry_points(group="lampopt")
    owners = {p.name: (p.dist.name, p.dist.version) for p in installed if p.dist}
    entries = []
    for name, _ in sorted(found.manager.list_name_plugin()):
        distribution, version = found.owners[name]
        offers = {
            kind: sorted(n for (k, n), o in found.offers.items() if (k, o.plugin) == (kind, name)) for kind in KINDS
        }
        entries.append(
            {
                "name": name,
                "distribution": distribution,
                "version": version,
                "offers": {kind: names for kind, names in offers.items() if names},
                "observes": any(i.plugin_name == name for i in found.manager.hook.lampopt_recorded.get_hookimpls()),
            }
        )
    blocked = sorted({p.name for p in installed} & {name.strip() for name in os.environ.get(BLOCK, "").split(",")})
    document = {"plugins": entries, "problems": [asdict(p) for p in found.problems], "blocked": blocked}
    rows = [(e["name"], e["distribution"], e["version"], _offered(e)) for e in entries]
    rows += [(name, *owners.get(name, ("", "")), f"switched off by {BLOCK}") for name in blocked]
    return Answer(document, [table("plugins", ("plugin", "distribution", "version", "offers"), rows)])


def _offered(entry: dict[str, Any]) -> str:
    said = [f"{kind} {', '.join(names)}" for kind, names in entry["offers"].items()]
    return "; ".join([*said, *(["observes results"] if entry["observes"] else [])]) or "nothing"


@click.command(cls=Command)
def sources() -> Answer:
    """List the sources of exemplars and their options.

    These are what `lampopt bank build` takes behind --set, with their types and defaults.
    """
    return _offered_as("source", "sources")


@click.command(cls=Command)
@click.argument("kind", type=click.Choice(KINDS))
@click.argument("name", required=False)
def options(kind: str, name: str | None) -> Answer:
    """List what there is of a kind, and its options.

    With types and defaults; with a NAME also what each option is, in its author's words.

        lampopt options decoder sdf-mlp
    """
    return _offered_as(kind, "offers", name)


def _offered_as(kind: str, key: str, name: str | None = None) -> Answer:
    """What is offered of a kind, by default all of it, under `key` of the document."""
    found = Plugins.load().report()
    entries: list[dict[str, Any]] = []
    problems: list[dict[str, Any]] = [asdict(p) for p in found.problems]
    told, chosen = "", [found.get(kind, name)] if name else []
    for offer in chosen or [offer for (k, _), offer in sorted(found.offers.items()) if k == kind]:
        owner = {"plugin": offer.plugin, "distribution": offer.distribution, "version": offer.version}
        try:
            cls = offer.resolve()
        except PluginError as error:  # one that does not load costs only itself
            if name:
                raise
            problems.append({**owner, "cause": str(error)})
            continue
        told = inspect.getdoc(cls) or ""
        entries.append({"name": offer.name, **owner, "about": told.partition("\n")[0], "options": _options(cls)})
    rows = [
        (e["name"] if not i else "", option["name"], option["type"], _default(option), e["about"] if not i else "")
        for e in entries
        for i, option in enumerate(e["options"] or [{"name": "", "type": "", "required": False, "default": ""}])
    ]
    shown = table(f"{kind}s", (kind, "option", "type", "default", "about"), rows)
    broken = [f"not working: {p['cause']}" for p in problems[len(found.problems) :]]
    return Answer({key: entries, "problems": problems}, [shown, *broken, *([told] if name else [])])


def _options(cls: type) -> list[dict[str, Any]]:
    required, defaults = required_options(cls), default_options(cls)
    return [
        {"name": name, "type": kind, "required": name in required, "default": defaults.get(name)}
        for name, kind in known_options(cls).items()
    ]


def _default(option: dict[str, Any]) -> str:
    if option["required"]:
        return "required"
    return "" if option["default"] is None else str(option["default"])


@click.command("check-plugin", cls=Command)
@click.argument("name")
def check_plugin(name: str) -> Answer:
    """Check that a plugin does what it promises.

    NAME is an entry point or a distribution. Everything that it registers is loaded, built and checked: paste the
    outcome into a bug report. Exits 0 if all checks pass, 1 if any fails, 2 if there is no such plugin.
    """
    from lampopt.testing import check_plugin as check

    with progress_bar(f"checking {name}"):
        records = check(Plugins.load().report(), name)
    failed = [r for r in records if not r.passed]
    document = {"name": name, "passed": not failed, "records": [asdict(r) for r in records]}
    rows = [(r.plugin, r.check, verdict(r.passed), r.message) for r in records]
    counted = f"{name}: {len(records)} checks, {len(failed)} failed"
    shown = table("checks", ("plugin", "check", "passed", "message"), rows)
    return Answer(document, [shown, verdict(not failed, counted, counted)], REJECTED if failed else DONE)
