"""Plugins as strangers install them: each distribution a folder with an entry point, found by importlib.metadata.

Whatever one does wrong is reported with its name, version and cause, and the others work.
"""

import importlib
import itertools
import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt.errors import InputError, MeasureError, PluginError
from lampopt.plugins import BLOCK, KINDS, Plugins, known_options
from lampopt.types import Spec

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

NUMBER = itertools.count()

GOOD = """
import lampopt, small, toys

@lampopt.hookimpl
def lampopt_decoders():
    return {"good": small.Stretch}

@lampopt.hookimpl
def lampopt_solvers():
    return {"good-solver": "toys:KKT"}
"""
RAISES = "raise OSError('libacme.so: cannot open shared object file')"
MISSPELT = """
import lampopt

@lampopt.hookimpl
def lampopt_solver():
    return {"typo": object}
"""
TWIN = """
import lampopt

@lampopt.hookimpl
def lampopt_solvers():
    return {"twin": "toys:KKT", "only-OWN": "toys:KKT"}
"""


@pytest.fixture(autouse=True)
def without_strangers(monkeypatch):
    """Nothing is blocked, and what else is installed here does not count as a problem."""
    monkeypatch.delenv(BLOCK, raising=False)


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a distribution: its metadata and its module, in a folder of their own on the path."""

    def install(distribution, code, *, version="1.2.3", entry=None, front=True):
        number = next(NUMBER)
        module, folder = f"stranger_{number}", tmp_path / f"site_{number}"
        metadata = folder / f"{distribution.replace('-', '_')}-{version}.dist-info"
        metadata.mkdir(parents=True)
        (folder / f"{module}.py").write_text(code.replace("OWN", distribution), encoding="utf-8")
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
        name = entry or distribution.removeprefix("lampopt-")
        (metadata / "entry_points.txt").write_text(f"[lampopt]\n{name} = {module}\n")
        monkeypatch.syspath_prepend(str(folder))
        if not front:
            monkeypatch.setattr(sys, "path", [*sys.path[1:], str(folder)])
        return module

    yield install
    for name in [name for name in sys.modules if name.startswith("stranger_")]:
        del sys.modules[name]


def problems(plugins):
    return {p.plugin: str(p) for p in plugins.problems}


# the item 6


def test_a_study_runs_while_strangers_fail_and_each_is_named(install, tmp_path, caplog):
    install("lampopt-good", GOOD)
    install("lampopt-acme", RAISES, version="4.5")
    install("lampopt-typo", MISSPELT, version="0.7")
    install("lampopt-twin-a", TWIN, version="2.0")
    install("lampopt-twin-b", TWIN, version="3.0")
    with caplog.at_level(logging.WARNING, "lampopt"):
        bank = lampopt.build_bank(small.boxes(measured={"length": "extents.length"}), "good", probes=8)
    said = {record.getMessage() for record in caplog.records}
    assert said == {
        "plugin 'acme' (lampopt-acme 4.5): cannot be imported: OSError('libacme.so: cannot open shared object file')",
        "plugin 'typo' (lampopt-typo 0.7): unknown hook 'lampopt_solver' in plugin " + said_of("lampopt-typo", said),
        "plugin 'twin-a' (lampopt-twin-a 2.0): solver 'twin' is also given by plugin 'twin-b' (lampopt-twin-b 3.0)",
        "plugin 'twin-b' (lampopt-twin-b 3.0): solver 'twin' is also given by plugin 'twin-a' (lampopt-twin-a 2.0)",
    }

    study = lampopt.Study(bank, targets={"length": 2.9}, solver="good-solver", measures=("volume",))
    result = lampopt.run(study, folder=tmp_path / "run")
    assert result.accepted
    assert result.design.mesh.extents[0] == pytest.approx(2.9)
    assert "lampopt-good 1.2.3" in result.provenance["decoder"]
    # what the twins do not share works too, and so do ours
    for solver in ("only-lampopt-twin-a", "only-lampopt-twin-b", "kkt"):
        assert lampopt.design(bank, {"length": 2.9}, solver=solver).accepted

    with pytest.raises(PluginError) as caught:
        lampopt.run(lampopt.Study(bank, targets={"length": 2.9}, solver="twin"))
    assert str(caught.value) == (
        "solver 'twin' is given by plugin 'twin-a' (lampopt-twin-a 2.0) and by plugin 'twin-b' (lampopt-twin-b 3.0): "
        "block one with LAMPOPT_BLOCK=twin-a or uninstall it"
    )
    with pytest.raises(PluginError, match=r"solver 'typo' is not installed.*not working:.*lampopt-typo 0\.7"):
        lampopt.design(bank, {"length": 2.9}, solver="typo")


def said_of(distribution, said):
    """The module that pluggy names, which has another name at every run."""
    return next(line for line in said if distribution in line).rpartition(" in plugin ")[2]


def test_a_hook_without_the_mark_is_told(install):
    install("lampopt-half", GOOD + "\n\ndef lampopt_sources():\n    return {}\n\nlampopt_models = 3\n")
    plugins = Plugins.load()
    assert problems(plugins) == {
        "half": "plugin 'half' (lampopt-half 1.2.3): lampopt_sources: not marked with @lampopt.hookimpl, so not heard"
    }
    assert plugins.make("solver", "good-solver")


def test_blocking_one_twin_frees_the_name(install, monkeypatch):
    install("lampopt-twin-a", TWIN)
    install("lampopt-twin-b", TWIN)
    assert ("solver", "twin") not in Plugins.load().offers
    monkeypatch.setenv(BLOCK, "twin-a")
    plugins = Plugins.load()
    assert plugins.problems == ()
    assert plugins.get("solver", "twin").distribution == "lampopt-twin-b"


# loading


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        (RAISES, "cannot be imported: OSError('libacme.so"),
        ("import no_such_module", "cannot be imported: ModuleNotFoundError"),
        ("def f(:", "cannot be imported: SyntaxError"),
        ("import sys; sys.exit('no licence')", "cannot be imported: SystemExit('no licence')"),
        (MISSPELT, "unknown hook 'lampopt_solver'"),
        (MISSPELT.replace("solver()", "solvers(plugins)"), "hook 'lampopt_solvers'"),
        ("x = 1", "has no hooks: mark its functions with @lampopt.hookimpl"),
        ("def lampopt_solvers():\n    return {}", "has no hooks"),
        (
            TWIN.replace("return {", "raise RuntimeError('no licence') or {"),
            "hook lampopt_solvers failed: RuntimeError",
        ),
        (TWIN.replace("return {", "return ['x'] or {"), "expected a mapping of names to classes or 'module:Class'"),
        (TWIN.replace("return {", "return None and {"), "expected a mapping"),
        (TWIN.replace("return {", "return {1: 'x:Y'} or {"), "expected a mapping"),
        (TWIN.replace("return {", "return {'x': 5} or {"), "expected a mapping"),
    ],
)
def test_what_is_broken_is_reported_and_costs_only_itself(install, code, cause):
    install("lampopt-good", GOOD)
    install("lampopt-zbad", code, version="0.0.9")
    (problem,) = Plugins.load().problems
    assert (problem.plugin, problem.distribution, problem.version) == ("zbad", "lampopt-zbad", "0.0.9")
    assert cause in problem.cause
    assert isinstance(Plugins.load().make("decoder", "good"), small.Stretch)
    assert not [offer for offer in Plugins.load().offers.values() if offer.plugin == "zbad"]


def test_a_hook_that_raises_costs_only_that_hook(install):
    code = GOOD.replace("return {", "raise RuntimeError('no licence') or {", 1)
    install("lampopt-half", code)
    plugins = Plugins.load()
    assert problems(plugins) == {
        "half": "plugin 'half' (lampopt-half 1.2.3): hook lampopt_decoders failed: RuntimeError('no licence')"
    }
    assert plugins.make("solver", "good-solver")


def test_a_plugin_is_dropped_whole_when_one_hook_is_misspelt(install):
    install("lampopt-half", GOOD + MISSPELT)
    plugins = Plugins.load()
    assert list(problems(plugins)) == ["half"]
    with pytest.raises(PluginError, match="'good' is not installed"):
        plugins.make("decoder", "good")


def test_one_entry_point_name_from_two_distributions_is_refused_naming_both(install):
    install("lampopt-one", GOOD, version="1.0", entry="same")
    install("lampopt-two", TWIN, version="2.0", entry="same")
    plugins = Plugins.load()
    assert {str(p) for p in plugins.problems} == {
        "plugin 'same' (lampopt-one 1.0): one entry-point name from lampopt-one 1.0 and lampopt-two 2.0",
        "plugin 'same' (lampopt-two 2.0): one entry-point name from lampopt-one 1.0 and lampopt-two 2.0",
    }
    assert not {("decoder", "good"), ("solver", "twin")} & set(plugins.offers)
    assert plugins.make("solver", "kkt")


def test_a_stranger_does_not_displace_ours(install):
    install("lampopt-evil", TWIN.replace("twin", "kkt"))
    with pytest.raises(PluginError, match=r"solver 'kkt' is given by plugin 'evil' .* and by plugin 'kkt' \(lampopt "):
        Plugins.load().make("solver", "kkt")
    install("lampopt-evil-2", TWIN, entry="kkt")
    assert "one entry-point name from lampopt " in problems(Plugins.load())["kkt"]


def test_order_of_installation_does_not_matter(install):
    def state():
        plugins = Plugins.load()
        causes = [(p.plugin, p.distribution, p.cause.partition(" in plugin ")[0]) for p in plugins.problems]
        offers = {key: (o.target, o.plugin, o.distribution) for key, o in plugins.offers.items()}
        clashes = {key: [o.plugin for o in rivals] for key, rivals in plugins.clashes.items()}
        return causes, offers, clashes

    everything = [
        ("lampopt-good", GOOD),
        ("lampopt-acme", RAISES),
        ("lampopt-typo", MISSPELT),
        ("lampopt-twin-b", TWIN),
        ("lampopt-twin-a", TWIN),
    ]
    before = list(sys.path)
    for distribution, code in everything:
        install(distribution, code)
    forward = state()
    sys.path[:] = before
    for distribution, code in everything:
        install(distribution, code, front=False)
    assert state() == forward
    assert len(forward[0]) == 4
    assert list(forward[2].values()) == [["twin-a", "twin-b"]]


def test_blocked_plugins_are_not_even_imported(install, monkeypatch):
    module = install("lampopt-acme", "raise AssertionError('imported')")
    monkeypatch.setenv(BLOCK, "kkt, acme ,nobody")
    plugins = Plugins.load()
    assert plugins.problems == ()
    assert module not in sys.modules
    with pytest.raises(PluginError, match="solver 'kkt' is not installed"):
        plugins.get("solver", "kkt")
    assert Plugins.load(block=()).get("solver", "kkt").distribution == "lampopt"
    assert problems(Plugins.load(block=())).keys() == {"acme"}


def test_what_is_given_by_hand_can_be_blocked_and_clashes_like_the_rest():
    assert ("decoder", "stretch") not in Plugins.load([("small", small.Plugin())], block=["small"]).offers
    taken = Plugins.load([("kkt", small.Plugin())])
    assert "already loaded from lampopt" in problems(taken)["kkt"]
    assert ("decoder", "stretch") not in taken.offers
    plugin = small.Plugin()
    again = Plugins.load([("one", plugin), ("two", plugin)])
    assert list(problems(again)) == ["two"]
    assert again.make("decoder", "stretch") == small.Stretch()


# choosing


@dataclass(frozen=True)
class Options:
    """A measure with options of every kind."""

    count: int = 1
    share: float = 0.5
    kind: str = "a"
    fast: bool = False
    hidden: "tuple[int, ...]" = ()
    names = ("x",)
    units = ("L",)

    def __post_init__(self):
        if self.count < 0:
            raise ValueError(f"count: expected at least 0, got {self.count}")

    def __call__(self, mesh):
        return [self.count]


class Offering:
    def __init__(self, **targets):
        self.targets = targets

    @lampopt.hookimpl
    def lampopt_measures(self):
        return self.targets


@pytest.fixture
def chosen():
    targets = {"options": Options, "lazy": "toys:Size", "nowhere": "no_such_module:X", "nothing": "toys:Nobody"}
    return small.plugins(("mine", Offering(**targets, function="toys:_corners", text="toys", loud="broken_import:X")))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere", r"cannot load 'no_such_module:X': ModuleNotFoundError"),
        ("nothing", r"cannot load 'toys:Nobody': AttributeError"),
        ("function", r"expected a class at 'toys:_corners', got <function"),
        ("text", r"cannot load 'toys': AttributeError"),
        ("loud", r"cannot load 'broken_import:X': ZeroDivisionError"),
    ],
)
def test_text_that_leads_to_no_class_is_refused_when_chosen(chosen, tmp_path, monkeypatch, name, message):
    (tmp_path / "broken_import.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert chosen.problems == ()  # listing does not resolve
    with pytest.raises(PluginError, match=rf"measure '{name}' of plugin 'mine' \(not installed -\): {message}"):
        chosen.make("measure", name)
    assert chosen.make("measure", "lazy")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cuont": 3}, "unknown option 'cuont'; known are: count: int, share: float, kind: str, fast: bool, hidden: "),
        ({"a": 1, "b": 2}, "unknown option 'a', 'b'"),
        ({"count": "3"}, "option 'count': expected int, got '3'"),
        ({"count": 3.0}, "option 'count': expected int, got 3.0"),
        ({"count": True}, "option 'count': expected int, got True"),
        ({"share": "half"}, "option 'share': expected float, got 'half'"),
        ({"share": False}, "option 'share': expected float, got False"),
        ({"kind": 1}, "option 'kind': expected str, got 1"),
        ({"fast": 1}, "option 'fast': expected bool, got 1"),
        ({"count": -1}, r"with {'count': -1}: count: expected at least 0, got -1"),
    ],
)
def test_options_are_checked(chosen, options, message):
    with pytest.raises(PluginError, match=rf"measure 'options'.*{message}"):
        chosen.make("measure", Spec("options", **options))


@dataclass(frozen=True)
class Raises(Options):
    error: str = ""

    def __post_init__(self):
        raise {"os": OSError("no licence"), "exit": SystemExit(3), "key": KeyError("x")}[self.error]


@pytest.mark.parametrize(("error", "cause"), [("os", "OSError"), ("exit", "SystemExit"), ("key", "KeyError")])
def test_whatever_making_one_raises_is_told(error, cause):
    plugins = small.plugins(("mine", Offering(raises=Raises)))
    with pytest.raises(PluginError, match=rf"measure 'raises' of plugin 'mine' .*: cannot be made: {cause}"):
        plugins.make("measure", Spec("raises", error=error))


class Hollow:
    """Offers, of each kind, what has nothing of it."""

    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"hollow": object}

    lampopt_solvers = lampopt_measures = lampopt_surrogates = lampopt_models = lampopt_sources = lampopt_decoders
    lampopt_checks = lampopt_decoders


@pytest.mark.parametrize("kind", KINDS)
def test_what_lacks_its_protocol_is_refused_when_it_is_made(kind):
    protocol = "Checker" if kind == "check" else kind.capitalize()
    message = rf"{kind} 'hollow': <object.* of plugin 'hollow' .* lacks what lampopt.protocols.{protocol} asks for"
    with pytest.raises(PluginError, match=message):
        small.plugins(("hollow", Hollow())).make(kind, "hollow")


def test_options_are_the_fields(chosen):
    assert list(known_options(Options)) == ["count", "share", "kind", "fast", "hidden"]
    assert chosen.make("measure", Spec("options", count=2, share=1, fast=True)) == Options(2, 1, "a", True)
    assert known_options(object) == {}
    with pytest.raises(PluginError, match="unknown option 'x'; known are: none"):
        chosen.make("measure", Spec("lazy", x=1))


def test_a_name_that_nobody_gives_is_answered_with_those_there_are(chosen):
    with pytest.raises(PluginError, match="check 'x' is not installed; installed are: none"):
        chosen.get("check", "x")
    with pytest.raises(PluginError, match=r"measure 'X' is not installed; installed are: area, .*options.*, volume"):
        chosen.get("measure", "X")


# observers


class Observer:
    def __init__(self, error=None):
        self.told, self.error = [], error

    @lampopt.hookimpl
    def lampopt_recorded(self, folder, result):  # the order is the plugin's business
        own = (folder / "passport.json").exists()  # else it is the run's
        self.told.append((result, folder, own, rows(folder.parent.parent if own else folder)))
        if self.error:
            raise self.error


def rows(folder):
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(folder / "runs.sqlite")) as database:
        return database.execute("SELECT count(*) FROM designs").fetchone()[0]


@pytest.mark.parametrize("level", ["alpha", "mesh"])
def test_observers_are_told_once_a_result_is_on_disk(tmp_path, level):
    observer = Observer()
    plugins = small.plugins(("watch", observer))
    study = lampopt.Study(small.bank(), level=level)
    results = list(lampopt.sweep(study, {"length": [2.1, 2.2]}, tmp_path, plugins=plugins))
    assert [told for told, *_ in observer.told] == results
    assert [folder for _, folder, *_ in observer.told] == [result.folder for result in results]
    own = level == "mesh"
    assert [(own, count) for *_, own, count in observer.told] == [(own, 1), (own, 2)]
    list(lampopt.sweep(study, {"length": [2.1, 2.2]}, tmp_path, plugins=plugins))
    assert len(observer.told) == 2  # read back is not recorded
    list(lampopt.sweep(study, {"length": [2.1, 2.2]}, plugins=plugins))
    assert len(observer.told) == 2  # nor is what goes to no folder


def test_an_observer_that_raises_is_logged_and_loses_nothing(tmp_path, caplog):
    bad, good = Observer(ZeroDivisionError("logger down")), Observer()
    plugins = small.plugins(("bad", bad), ("good", good))
    study = lampopt.Study(small.bank(), level="alpha")
    results = list(lampopt.sweep(study, {"length": [2.1, 2.2]}, tmp_path, plugins=plugins))
    assert len(results) == len(bad.told) == len(good.told) == 2
    assert rows(tmp_path) == 2
    assert "plugin 'bad' failed in lampopt_recorded" in caplog.text
    assert "logger down" in caplog.text


# a stranger's checks


@dataclass(frozen=True)
class Slim:
    """Checker: a limit on length over width, from the mesh."""

    name: str = "slim"
    needs: str = "mesh"
    most: float = 2.0

    def __call__(self, bank, design):
        length, width, _ = design.mesh.extents
        return [lampopt.Check(self.name, length / width, "<=", self.most, "", self.needs)]


@dataclass(frozen=True)
class Early(Slim):
    needs: str = "alpha"

    def __call__(self, bank, design):
        assert "mesh" not in design.__dict__
        return [lampopt.Check("early", 1.0, "info", None, "", "alpha")]


@dataclass(frozen=True)
class Wrong(Slim):
    needs: str = "geometry"


@dataclass(frozen=True)
class Shadow(Slim):
    name: str = "alpha"


@dataclass(frozen=True)
class Mover(Slim):
    """Says that it looks at alpha, and moves the mesh."""

    def __call__(self, bank, design):
        design.mesh.vertices += [0.1, 0, 0]
        return [lampopt.Check("mover", 1.0, "info", None, "", "alpha")]

    needs: str = "alpha"


@dataclass(frozen=True)
class Lost(Slim):
    """Cannot judge long shapes."""

    error: str = "measure"

    def __call__(self, bank, design):
        if design.mesh.extents[0] > 2.2:
            kinds = {"ZeroDivisionError": ZeroDivisionError("by width"), "InputError": InputError("by width")}
            raise kinds.get(self.error, MeasureError("too long for the gauge"))
        return [lampopt.Check("lost", 1.0, "<=", 2.0, "", "mesh")]


class Checks:
    @lampopt.hookimpl
    def lampopt_checks(self):
        found = {"slim": Slim, "early": Early, "wrong": Wrong, "shadow": Shadow, "none": Options, "solid": object}
        return found | {"mover": Mover, "lost": Lost}


@pytest.fixture(scope="module")
def bank():
    return small.bank()


def judged(bank, *checks, **options):
    study = lampopt.Study(bank, **{"targets": {"length": 2.5, "width": 1.1}, "checks": checks, **options})
    return lampopt.run(study, plugins=small.plugins(("checks", Checks())))


def test_a_strangers_check_joins_the_others(bank):
    result = judged(bank, "slim", "early")
    assert result.check("slim").value == pytest.approx(2.5 / 1.1)
    assert not result.check("slim").passed
    assert not result.accepted
    assert judged(bank).accepted
    assert judged(bank, "slim", targets={"length": 2.1, "width": 1.3}).accepted
    order = [check.needs for check in result.checks]
    assert order == sorted(order, key=("alpha", "field", "mesh").index)


def test_a_strangers_check_waits_for_its_level(bank):
    names = [check.name for check in judged(bank, "slim", "early", level="alpha").checks]
    assert names == ["solved", "target", "alpha", "early"]


def test_a_strangers_check_takes_options(bank):
    assert not judged(bank, "slim").check("slim").passed
    assert judged(bank, Spec("slim", most=2.5)).check("slim").passed
    with pytest.raises(PluginError, match=r"check 'slim': unknown option 'least'; known are: name: str, needs"):
        judged(bank, Spec("slim", least=2.5))


def test_a_check_that_cannot_judge_fails_with_its_reason(bank, tmp_path):
    study = lampopt.Study(bank, {"width": 1.1}, checks=["lost"])
    plugins = small.plugins(("checks", Checks()))
    short, long_ = lampopt.sweep(study, {"length": [2.1, 2.5]}, tmp_path, plugins=plugins)
    assert short.accepted and not long_.accepted
    lost = long_.check("lost")
    assert np.isnan(lost.value) and lost.note == "cannot judge: too long for the gauge"
    for error in ("ZeroDivisionError", "InputError"):
        with pytest.raises(PluginError, match=rf"check 'lost': raised {error}\('by width'\)"):
            judged(bank, Spec("lost", error=error))


def test_what_a_check_does_to_a_mesh_unsaid_is_done_to_one_of_its_own(bank):
    still, moved = judged(bank).design.mesh, judged(bank, "mover").design.mesh
    np.testing.assert_array_equal(still.vertices, moved.vertices)


CODE = """
from dataclasses import dataclass
import lampopt

@dataclass(frozen=True)
class Judge:
    needs = "alpha"

    def __call__(self, bank, design):
        return [lampopt.Check("judge", 1.0, "<=", LIMIT, "", "alpha")]
"""


def test_a_check_that_was_edited_judges_anew(bank, tmp_path, monkeypatch):
    """Versions stay while a plugin is written."""
    monkeypatch.syspath_prepend(tmp_path)
    study = lampopt.Study(bank, {"length": 2.5}, checks=["judge"], level="alpha")

    def passed(limit):
        (tmp_path / "a_judge.py").write_text(CODE.replace("LIMIT", limit), encoding="utf-8")
        sys.modules.pop("a_judge", None)
        importlib.invalidate_caches()

        class Mine:
            @lampopt.hookimpl
            def lampopt_checks(self):
                return {"judge": "a_judge:Judge"}

        made = lampopt.run(study, tmp_path / "run", report=False, plugins=small.plugins(("mine", Mine())))
        return made.check("judge").passed

    assert passed("2.000")
    assert not passed("0.5")
    assert passed("2.000")
    assert rows(tmp_path / "run") == 2


def test_another_measure_under_the_same_name_measures_anew(bank, tmp_path):
    def values(choice):
        study = lampopt.Study(bank, {"length": 2.5}, measures={"it": choice})
        made = lampopt.run(study, tmp_path, report=False, plugins=small.plugins())
        return [check.name for check in made.checks if check.name.startswith("it.")]

    assert values("volume") == ["it.volume"]
    assert values("area") == ["it.area"]


def test_a_check_that_needs_a_mesh_is_not_asked_where_there_is_none(bank):
    result = judged(bank, "slim", targets={"length": -9.0, "width": -5.0})
    assert result.design.mesh is None
    assert not result.check("mesh").passed
    assert "slim" not in [check.name for check in result.checks]


def test_a_check_may_not_take_the_name_of_another(bank):
    with pytest.raises(PluginError, match="checks: alpha come twice; a plugin's checks need names of their own"):
        judged(bank, "shadow")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong", "check 'wrong': expected needs as one of alpha, field, mesh, got 'geometry'"),
        ("none", "check 'none': .* lacks what lampopt.protocols.Checker asks for"),
        ("solid", "check 'solid': .* lacks what lampopt.protocols.Checker asks for"),
        ("nobody", "check 'nobody' is not installed; installed are: early"),
    ],
)
def test_what_is_no_checker_is_refused_at_the_start(bank, name, message):
    with pytest.raises(PluginError, match=message):
        judged(bank, name)


# what a study requires


def test_a_study_says_what_it_requires(bank):
    assert judged(bank, requires=("checks", "lampopt", "small"), level="alpha").accepted
    with pytest.raises(PluginError, match=r"study requires lampopt-acme, not installed; installed are checks, kkt,"):
        judged(bank, requires=("lampopt", "lampopt-acme"))


def test_a_required_plugin_may_be_one_that_only_observes(bank):
    study = lampopt.Study(bank, level="alpha", requires=("watch",))
    assert lampopt.run(study, plugins=small.plugins(("watch", Observer()))).accepted


@dataclass(frozen=True)
class Needy:
    """A measure with an option that has no default."""

    where: str
    how: int = 3
    names = ("size",)
    units = ("L",)

    def __call__(self, mesh):
        return mesh.extents[:1]


class Needing:
    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"needy": Needy}


def test_an_option_without_a_default_is_asked_for():
    plugins = Plugins.load(extra=[("needing", Needing())])
    with pytest.raises(PluginError, match=r"expected the option .where., which has no default; known are"):
        plugins.make("measure", Spec("needy", how=2))
    assert plugins.make("measure", Spec("needy", where="here")) == Needy("here")
