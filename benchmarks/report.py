"""The report of a 100-design sweep, made and opened in Chromium: ``python -m benchmarks.report --help``."""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import lampopt
from lampopt.plugins import Plugins

from .common import installed_and_example

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--enable-logging=stderr",
    "--no-first-run",
    "--disable-background-networking",
    "--host-resolver-rules=MAP * ~NOTFOUND",  # offline, and whatever it asks for all the same is refused
)
CONSOLE = re.compile(r'CONSOLE[:(]\d+\)?\] "(.*?)", source: ', re.DOTALL)
READING = (
    "GPU stall due to ReadPixels"  # the driver, of our probe, and of Chromium itself where it has no graphics card
)
# Goes through the page as a reader would, and writes down what it finds.
PROBE = """
(() => {
  const all = (what) => [...document.querySelectorAll(what)];
  const pixels = (wanted) => {  // how many of the viewer's pixels are as `wanted`
    const from = document.querySelector("#viewer"), to = document.createElement("canvas");
    if (!from) return 0;
    [to.width, to.height] = [from.width, from.height];
    const plane = to.getContext("2d");
    plane.drawImage(from, 0, 0);
    const data = plane.getImageData(0, 0, to.width, to.height).data;
    let count = 0;
    for (let i = 0; i < data.length; i += 4) if (data[i + 3] && wanted(data[i], data[i + 2])) count++;
    return count;
  };
  const filled = () => pixels(() => true);
  const coloured = () => pixels((red, blue) => Math.abs(red - blue) > 40);
  const crowded = () => all("svg.bars, svg.parallel").flatMap((chart) => {  // words in a chart that are cut or overlap
    const boxes = [...chart.querySelectorAll("text")].map((text) => text.getBBox());
    const apart = (a, b) => a.x + a.width < b.x || b.x + b.width < a.x || a.y + a.height < b.y || b.y + b.height < a.y;
    const inside = (a) => a.x >= 0 && a.x + a.width <= chart.viewBox.baseVal.width;
    return boxes.filter((a, i) => !inside(a) || boxes.slice(0, i).some((b) => !apart(a, b)));
  }).length;
  const click = (what) => { const found = document.querySelector(what); if (found) found.click(); return !!found; };
  window.addEventListener("load", () => setTimeout(() => {
    const found = { images: all("img").length };
    found.broken = all("img").filter((image) => !image.complete || !image.naturalWidth).length;
    found.mapped = all("image[href^='data:']").length;
    found.crowded = crowded();
    found.canvases = all("canvas").length;
    found.shape = filled();
    if (all(".card").length) all(".card").pop().click();  // the farthest out, where distances show
    found.heat = click("[data-mode=heat]") ? coloured() : 0;
    found.reference = click("[data-mode=reference]") ? filled() : 0;
    click("[data-mode=plain]");
    const titles = new Set();
    found.empty = 0;
    found.uneven = all(".card").filter((c, i, list) => i && Math.abs(
      c.firstElementChild.offsetTop - list[0].firstElementChild.offsetTop) > 1).length;
    for (const card of all(".card")) {
      card.click();
      titles.add(document.querySelector("#detail h3").textContent);
      if (card.querySelector("img") && !filled()) found.empty++;
      found.crowded += crowded();
    }
    found.strands = all(".strand[data-key]").length;
    found.alone = all(".strand[data-key]").filter((strand) => {  // lines that point at nothing else when pointed at
      strand.dispatchEvent(new PointerEvent("pointerenter"));
      const near = all(".near"), told = document.querySelector("#tip").textContent;
      strand.dispatchEvent(new PointerEvent("pointerleave"));
      return near.length < 2 || !near.includes(strand) || all(".near").length || !told.startsWith("design ");
    }).length;
    found.cards = all(".card").length;
    found.opened = titles.size;
    click("[data-filter=ok]");
    found.filtered = all(".card").filter((c) => !c.hidden).length;
    click("[data-filter=all]");
    found.loaded = performance.getEntriesByType("resource").map((e) => e.name).filter((n) => !n.startsWith("data:"));
    const note = document.createElement("pre");
    note.id = "probe";
    note.textContent = JSON.stringify(found);
    document.body.append(note);
  }, 300));
})();
"""

# What the page's policy has to stop, and does where <html> bears no mark of it.
STRANGERS = {
    "script": "<script>document.documentElement.dataset.script = 1</script>",
    "handler": '<img src="data:," onerror="document.documentElement.dataset.handler = 1">',
    "source": '<script src="data:text/javascript,document.documentElement.dataset.source = 1"></script>',
}


def chromium() -> str | None:
    """The path of a Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def swept(
    folder: Path, decoder: lampopt.Spec, *, count: int = 100, resolution: int = 48, plugins: Plugins | None = None
) -> Path:
    """The report of a sweep of `count` plates, recorded in `folder`: hole and length, in and out of their range."""
    plugins = plugins or installed_and_example()
    bank = lampopt.build_bank(
        lampopt.exemplars("plate", plugins=plugins), decoder, store=folder / "plates.lamp", plugins=plugins
    )
    along = {q.name: np.array([q.low, q.high], float) for q in bank.space}
    sides = max(1, round(count**0.5))

    def values(name: str, number: int) -> list[float]:
        low, high = along[name]
        return np.linspace(low - 0.25 * (high - low), high + 0.25 * (high - low), number).tolist()

    grid = {"hole_radius": values("hole_radius", sides), "length": values("length", -(-count // sides))}
    study = lampopt.Study(bank, sweep=grid, reference="middle", keep=("width",), resolution=resolution)
    for _ in lampopt.sweep(study, folder=folder / "plates", plugins=plugins):
        pass
    return folder / "plates" / "report.html"


def opened(report: Path, browser: str, *, screenshot: Path | None = None, height: int = 1500) -> dict[str, Any]:
    """What a reader of `report` meets: messages on the console, pictures, what the viewer shows.

    The page is opened as it is, then with a probe that is admitted by its hash; its policy stays in force.
    """
    text = report.read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(PROBE.encode()).digest()).decode()
    text = text.replace("script-src '", f"script-src 'sha256-{digest}' '", 1)
    text = text.replace("</body>", f"<script>{PROBE}</script></body>")
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "report.html"
        copy.write_text(text, encoding="utf-8")
        target = f"--screenshot={(screenshot or Path(place) / 'page.png').absolute()}"
        size = f"--window-size=1400,{height}"
        plain = _run(browser, Path(place), "--virtual-time-budget=8000", size, target, report.absolute().as_uri())
        shown = _run(browser, Path(place), "--virtual-time-budget=20000", "--dump-dom", copy.as_uri())
    messages = [message for run in (plain, shown) for message in CONSOLE.findall(run.stderr) if READING not in message]
    found = re.search(r'<pre id="probe">(.*?)</pre>', shown.stdout, re.DOTALL)
    return {"console": messages, **(json.loads(found[1].replace("&amp;", "&")) if found else {"probe": "did not run"})}


def strangers(report: Path, browser: str) -> list[str]:
    """Which of the scripts that are put into a copy of `report`, as by a hostile name, do run there."""
    text = report.read_text(encoding="utf-8").replace("</header>", f"{''.join(STRANGERS.values())}</header>", 1)
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "report.html"
        copy.write_text(text, encoding="utf-8")
        shown = _run(browser, Path(place), "--virtual-time-budget=8000", "--dump-dom", copy.as_uri()).stdout
    marks = re.search(r"<html[^>]*>", shown)
    return [name for name in STRANGERS if marks is None or f"data-{name}=" in marks[0]]


def faults(found: dict[str, Any]) -> list[str]:
    """What is wrong with what `opened` found."""
    wrong = [f"console: {message}" for message in found["console"]]
    if "probe" in found:
        return [*wrong, "the page did not come to its end"]
    if found["loaded"]:
        wrong.append(f"it asked for {found['loaded']}")
    wrong += [f"{name}: {found[name]}" for name in ("broken", "empty", "crowded", "uneven", "alone") if found[name]]
    wrong += [f"{name}: none" for name in ("images", "canvases", "shape") if not found[name]]
    if found["opened"] != found["cards"]:
        wrong.append(f"{found['opened']} of {found['cards']} designs open")
    return wrong


def _run(browser: str, place: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    command = [browser, *FLAGS, f"--user-data-dir={place / 'profile'}", *flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.report", description=__doc__)
    parser.add_argument("--decoder", default="gridsdf", help="gridsdf is quick, sdf-mlp is good")
    parser.add_argument("--count", type=int, default=100, help="of designs")
    parser.add_argument("--resolution", type=int, default=48, help="cells along the decoder's box")
    parser.add_argument("--folder", type=Path, default=Path("runs/report"), help="where bank and run are kept")
    parser.add_argument("--screenshot", type=Path, help="a PNG file of the page's upper part")
    options = parser.parse_args(given)
    browser = chromium()
    if browser is None:
        sys.stderr.write(f"no Chromium: expected one of {', '.join(NAMES)} on the path\n")
        return 2
    folder = options.folder / options.decoder
    folder.mkdir(parents=True, exist_ok=True)
    report = swept(folder, lampopt.Spec(options.decoder), count=options.count, resolution=options.resolution)
    found = opened(report, browser, screenshot=options.screenshot)
    wrong = [*faults(found), *(f"the policy lets it run: {name}" for name in strangers(report, browser))]
    document = {"report": str(report), "bytes": report.stat().st_size, **found, "wrong": wrong}
    sys.stdout.write(json.dumps(document, indent=2) + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
