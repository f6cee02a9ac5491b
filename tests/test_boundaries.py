"""Who may import whom, how long a module may be, what `import lampopt` may cost: read from the source."""

import ast
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from lampopt import hookspecs

ROOT = Path(__file__).parent.parent
TUTORIAL = ROOT / "examples" / "third_party_decoder"
CORE = sorted((ROOT / "lampopt").rglob("*.py"))
PLUGINS = sorted((ROOT / "plugins").rglob("*.py"))
LONGEST = 400  # lines

# A module of the core imports from its own layer and those before it.
LAYERS = (
    {"errors"},
    {"types"},
    {
        "code",
        "units",
        "topology",
        "metrics",
        "pareto",
        "intersections",
        "meshfile",
        "reading",
        "threads",
        "protocols",
        "hookspecs",
    },
    {"plugins", "lamp", "progress"},
    {"partial"},
    {"fitted"},
    {"measured"},
    {"exemplars", "measured"},
    {"intake"},
    {"fitting"},
    {"bank"},
    {"compress", "preview"},
    {"members"},
    {"solve"},
    {"mix"},
    {"lattice"},
    {"levelset"},
    {"decode"},
    {"angles"},
    {"check"},
    {"goals", "chain", "replay"},
    {"quantities", "terms", "plane"},
    {"safeguards"},
    {"holdout", "recommend"},
    {"calibrate", "compare", "extrapolation", "residuals"},
    {"database", "rows", "evaluations"},
    {"written"},
    {"record", "designer"},
    {"mixes"},
    {"choices"},
    {"experiments"},
    {"study"},
    {"identity", "wishes", "closing"},
    {"question"},
    {"task"},
    {"crew", "pool"},
    {"label"},
    {"workers"},
    {"reporting"},
    {"compromise"},
    {"asktell", "explore", "front", "motion"},
    {"response"},
    {"loop"},
    {"active"},
    {"joining"},
    {"enrich"},
    {"lampopt", "cli", "testing"},
)
PUBLIC = {  # what a plugin may import
    "lampopt",
    "lampopt.decode",
    "lampopt.errors",
    "lampopt.intake",
    "lampopt.intersections",
    "lampopt.measured",
    "lampopt.meshfile",
    "lampopt.metrics",
    "lampopt.pareto",
    "lampopt.plugins",
    "lampopt.protocols",
    "lampopt.reading",
    "lampopt.testing",
    "lampopt.topology",
    "lampopt.threads",
    "lampopt.types",
    "lampopt.units",
}
HEAVY = {"torch", "casadi", "nlopt", "trimesh", "skimage", "sklearn", "scipy", "igl", "pint", "pyarrow", "rich", "dask"}


def dotted(path):
    """``plugins/lampopt_kkt/kkt.py`` → ``lampopt_kkt.kkt``; a package goes by its own name."""
    base = next(folder for folder in (ROOT / "plugins", TUTORIAL, ROOT) if path.is_relative_to(folder))
    parts = path.relative_to(base).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


OURS = {dotted(path) for path in (*CORE, *PLUGINS)}
files = pytest.mark.parametrize("path", [*CORE, *PLUGINS], ids=dotted)


def imported(path):
    """Every module that `path` imports, anywhere in it, in full."""
    package = dotted(path).split(".")[: None if path.name == "__init__.py" else -1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *filter(None, [node.module])])
            for alias in node.names:
                inner = f"{module}.{alias.name}"
                yield inner if inner in OURS else module


def layer(module):
    part = [*module.split("."), "lampopt"][1]
    places = [i for i, layer in enumerate(LAYERS) if part in layer]
    assert places, f"{module}: a new part of the core needs a place in LAYERS"
    return places[0]


@pytest.mark.parametrize("path", CORE, ids=dotted)
def test_core_imports_no_plugin_and_no_later_stage(path):
    for module in imported(path):
        assert not module.startswith("lampopt_"), f"{dotted(path)} imports the plugin {module}"
        if module.split(".")[0] == "lampopt":
            assert layer(module) <= layer(dotted(path)), f"{dotted(path)} imports {module}, which comes later"


@pytest.mark.parametrize("path", [*PLUGINS, *TUTORIAL.glob("*.py")], ids=dotted)
def test_plugin_imports_public_names_and_no_other_plugin(path):
    own = dotted(path).split(".")[0]
    for module in imported(path):
        top = module.split(".")[0]
        assert top != "lampopt" or module in PUBLIC, f"{dotted(path)} imports {module}, which is not public"
        assert not top.startswith("lampopt_") or top == own, f"{dotted(path)} imports another plugin: {module}"


def test_the_reading_of_imports_itself():
    found = set(imported(ROOT / "lampopt" / "bank.py"))
    assert {"lampopt.lamp", "lampopt.errors", "hashlib", "importlib.metadata", "lampopt.intake"} <= found
    assert "lampopt" not in found
    assert "lampopt_datasets.columns" in set(imported(ROOT / "plugins" / "lampopt_datasets" / "table.py"))
    assert layer("lampopt.types.bank") < layer("lampopt.solve") < layer("lampopt.loop") < layer("lampopt")


@files
def test_modules_are_short(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST, f"{dotted(path)} has {lines} lines: divide it"


@files
def test_nothing_prints(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        printing = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
        assert not printing, f"{dotted(path)}:{node.lineno} prints"


def test_import_is_light():
    code = "import sys, lampopt; print(*{m.partition('.')[0] for m in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "lampopt" in loaded
    assert not HEAVY & set(loaded)


def test_listing_plugins_is_light():
    code = "import sys, lampopt.plugins as p; p.Plugins.load(); print(*{m.partition('.')[0] for m in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "lampopt_kkt" in loaded
    assert not HEAVY & set(loaded)


@pytest.mark.parametrize("hook", [name for name in vars(hookspecs) if name.startswith("lampopt_")])
def test_every_hook_is_tested(hook):
    tests = [path for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__)]
    assert any(f"def {hook}(" in path.read_text(encoding="utf-8") for path in tests), f"no test implements {hook}"


def test_what_is_pinned_takes_every_python_3_11():
    """Debian 12 has 3.11.2: a version that wants a later one leaves its users without any."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {canonicalize_name(line.partition("==")[0]) for line in lines if "==" in line}
    found = {canonicalize_name(d.name): d.metadata for d in distributions()}
    wanted = {n: d["Requires-Python"] for n, d in found.items() if n in pinned and "Requires-Python" in d}
    assert len(wanted) > 50
    assert not [name for name, python in wanted.items() if not SpecifierSet(python).contains("3.11.0")]
