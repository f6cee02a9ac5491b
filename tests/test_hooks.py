"""One plugin with every hook there is: what it offers is found, used and told about."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

import lampopt
from lampopt import hookspecs
from lampopt.errors import PluginError
from lampopt.plugins import KINDS, Plugins
from lampopt.types import Check

sys.path[:0] = [p for p in (str(Path(__file__).parent),) if p not in sys.path]
import toys  # noqa: E402


@dataclass(frozen=True)
class Few:
    """Checker: no coefficient beyond a limit."""

    limit: float = 0.9
    needs = "alpha"

    def __call__(self, bank, design):
        return [Check("few", float(abs(design.mix.alpha).max()), "<=", self.limit, "", "alpha")]


class Everything:
    """The plugin; it keeps what it is told."""

    def __init__(self):
        self.told = []

    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"own": toys.Radial}

    @lampopt.hookimpl
    def lampopt_solvers(self):
        return {"own": toys.KKT}

    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"own": toys.Size}

    @lampopt.hookimpl
    def lampopt_surrogates(self):
        return {"own": toys.Linear}

    @lampopt.hookimpl
    def lampopt_models(self):
        return {"own": toys.Drag}

    @lampopt.hookimpl
    def lampopt_sources(self):
        return {"own": toys.Boxes}

    @lampopt.hookimpl
    def lampopt_checks(self):
        return {"own": Few}

    @lampopt.hookimpl
    def lampopt_recorded(self, result, folder):
        self.told.append((result, folder, (folder / "passport.json").exists()))


def load(*plugins):
    return Plugins.load([(f"plugin{i}", plugin) for i, plugin in enumerate(plugins)], block=["gridsdf"])


def test_the_plugin_has_every_hook():
    hooks = {name for name in vars(hookspecs) if name.startswith("lampopt_")}
    assert hooks == {name for name in vars(Everything) if name.startswith("lampopt_")}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_offered_is_found_and_made(kind):
    plugins = load(Everything())
    assert plugins.problems == ()
    assert type(plugins.make(kind, "own")) is plugins.get(kind, "own").resolve()


def test_everything_works_together(tmp_path):
    plugin = Everything()
    plugins = load(plugin)
    exemplars = lampopt.exemplars("own", plugins=plugins)
    bank = lampopt.build_bank(exemplars, "own", probes=256, plugins=plugins)
    name = exemplars.space[0].name
    middle = float(exemplars.parameters[:, 0].mean())
    study = lampopt.Study(bank, targets={name: middle}, solver="own", measures=("own",), checks=("own",), resolution=32)
    result = lampopt.run(study, folder=tmp_path, plugins=plugins)
    assert result.check("few").passed
    assert result.check("own.length").unit == bank.frame.unit
    ((told, folder, on_disk),) = plugin.told
    assert told is result
    assert folder.parent == tmp_path / "designs"
    assert on_disk
    lampopt.run(study, folder=tmp_path, plugins=plugins)  # read back: nothing new to tell
    assert len(plugin.told) == 1


class Breaks:
    @lampopt.hookimpl
    def lampopt_recorded(self, result, folder):
        raise RuntimeError("disk full")


def test_an_observer_that_fails_loses_nothing(tmp_path, caplog):
    plugin = Everything()
    plugins = load(Breaks(), plugin)
    bank = lampopt.build_bank(lampopt.exemplars("own", plugins=plugins), "own", probes=256, plugins=plugins)
    study = lampopt.Study(bank, solver="own", level="alpha")
    with caplog.at_level(logging.ERROR, "lampopt"):
        lampopt.run(study, folder=tmp_path, plugins=plugins)
    assert "plugin0" in caplog.text
    assert len(plugin.told) == 1


class Misspelt:
    @lampopt.hookimpl
    def lampopt_decoder(self):
        return {}


class Raises:
    @lampopt.hookimpl
    def lampopt_models(self):
        raise RuntimeError("no licence")


class Bare:
    """Has no hooks."""


@pytest.mark.parametrize(
    ("plugin", "cause"), [(Misspelt, "lampopt_decoder"), (Raises, "no licence"), (Bare, "no hooks")]
)
def test_a_broken_plugin_is_reported_and_the_others_work(plugin, cause):
    plugins = load(plugin(), Everything())
    (problem,) = plugins.problems
    assert problem.plugin == "plugin0"
    assert cause in problem.cause
    assert type(plugins.make("solver", "own")) is toys.KKT


def test_one_name_from_two_plugins_is_refused_and_both_are_named():
    plugins = load(Everything(), Everything())
    with pytest.raises(PluginError, match=r"plugin0.*plugin1"):
        plugins.get("decoder", "own")
    assert type(load(Everything()).make("decoder", "own")) is toys.Radial


def test_a_blocked_plugin_is_not_there(monkeypatch):
    monkeypatch.setenv("LAMPOPT_BLOCK", "kkt,plate")
    with pytest.raises(PluginError, match="'kkt' is not installed"):
        Plugins.load().get("solver", "kkt")
