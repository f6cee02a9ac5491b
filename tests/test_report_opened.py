"""The report as a reader meets it: opened in headless Chromium, every design clicked."""

import importlib
import re
import sys
from pathlib import Path

import pytest

import lampopt

HERE = Path(__file__).resolve().parent
sys.path[:0] = [p for p in (str(HERE.parent), str(HERE)) if p not in sys.path]
bench = importlib.import_module("benchmarks.report")
small = importlib.import_module("small")
BROWSER = bench.chromium()
pytestmark = pytest.mark.skipif(BROWSER is None, reason=f"no Chromium: expected one of {', '.join(bench.NAMES)}")


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """The report of five boxes, two of them asked for beyond the exemplars' range."""
    folder = tmp_path_factory.mktemp("boxes")
    study = lampopt.Study(small.bank(), sweep={"length": [1.5, 2.2, 2.6, 3.0, 3.5]}, reference="box_3", resolution=16)
    for _ in lampopt.sweep(study, folder=folder, plugins=small.plugins()):
        pass
    return folder / "report.html"


def test_a_sweep_can_be_looked_at(boxes):
    found = bench.opened(boxes, BROWSER)
    assert bench.faults(found) == []
    assert found["cards"] == found["images"] == 5
    assert found["mapped"] > 0  # pictures on the map of shapes
    assert found["strands"] == 5  # parallel coordinates
    for what in ("shape", "heat", "reference"):
        assert found[what] > 1000, what  # pixels that show it, the distances in red and blue


def test_a_single_design_can_be_looked_at(tmp_path):
    study = lampopt.Study(small.bank(), targets={"length": 2.9}, reference="box_0", resolution=16)
    lampopt.run(study, folder=tmp_path, plugins=small.plugins())
    found = bench.opened(tmp_path / "report.html", BROWSER)
    assert bench.faults(found) == []
    assert found["images"] == 8  # four views, plain and by distance
    assert found["heat"] > 1000


def test_without_shapes_there_is_still_a_page(tmp_path):
    study = lampopt.Study(small.bank(), sweep={"length": [2.2, 2.6]}, level="alpha")
    for _ in lampopt.sweep(study, folder=tmp_path, plugins=small.plugins()):
        pass
    found = bench.opened(tmp_path / "report.html", BROWSER)
    assert found["console"] == found["loaded"] == []
    assert (found["strands"], found["alone"], found["crowded"]) == (2, 0, 0)
    assert (found["canvases"], found["images"], found["opened"]) == (0, 0, 2)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("<script>boom()</script>", "console"),
        ('<img src="http://127.0.0.1:9/x.png">', "it asked for"),
        ('<img src="data:image/webp;base64,AAAA">', "broken"),
        ("<style>#viewer { display: none }</style>", "shape: none"),
        ("<style>.bars text { font-size: 30px }</style>", "crowded"),
        ("<style>.parallel text { font-size: 40px }</style>", "crowded"),
        ("<style>.card { padding-top: 0 } .card:last-child { padding-top: 9px }</style>", "uneven"),
    ],
    ids=["script", "outside", "picture", "viewer", "words", "axes", "gallery"],
)
def test_what_is_broken_is_seen(boxes, tmp_path, broken, said):
    """The looking itself: a fault that is put in is found. The page's own policy stops what comes from outside."""
    page = tmp_path / "broken.html"
    page.write_text(boxes.read_text(encoding="utf-8").replace("</header>", f"{broken}</header>"), encoding="utf-8")
    assert any(fault.startswith(said) for fault in bench.faults(bench.opened(page, BROWSER)))


def test_what_is_put_into_the_page_does_not_run(boxes, tmp_path):
    """The policy is what stops it: without it, all of it runs."""
    assert bench.strangers(boxes, BROWSER) == []
    bare = tmp_path / "bare.html"
    policy = re.compile(r"<meta http-equiv=[^>]*>")
    text, removed = policy.subn("", boxes.read_text(encoding="utf-8"))
    assert removed == 1
    bare.write_text(text, encoding="utf-8")
    assert bench.strangers(bare, BROWSER) == list(bench.STRANGERS)


@pytest.mark.slow
def test_a_hundred_designs_can_be_looked_at(tmp_path):
    page = bench.swept(tmp_path, lampopt.Spec("gridsdf", size=25), resolution=32)
    found = bench.opened(page, BROWSER)
    assert bench.faults(found) == []
    assert found["cards"] == found["images"] == found["opened"] == 100
    assert page.stat().st_size < 15e6
