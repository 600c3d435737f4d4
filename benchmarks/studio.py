"""How fast the page of ``scm-world studio`` is, in Chromium with software rendering.

Writes ``studio.json``. It needs the extra ``studio``, playwright, and a Chromium on the path.

Measured, for each system: the time until the page shows the world; pictures of the world in a
second, while it is drawn as often as the browser allows; control steps and pictures in a second
while it plays; the time from a ``do`` until the first picture of the changed world is drawn; and
that of one redraw of the whole graph, opened.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

SYSTEMS = {"pushing": "tool_block.color", "towers": "tool_level_0_col_0_row_0.color"}
ARGUMENTS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--disable-gpu-rasterization",
    "--disable-accelerated-2d-canvas",
)
"""Only WebGL is drawn by SwiftShader, which is slow for all else."""
READY = "Boolean(window.studio?.news && studio.view.drawn)"
DRAW = """async seconds => {
  const first = studio.view.drawn, begun = performance.now();
  await new Promise(end => { (function more() {
    studio.view.redraw();
    performance.now() - begun < 1000 * seconds ? requestAnimationFrame(more) : end(); })(); });
  return 1000 * (studio.view.drawn - first) / (performance.now() - begun); }"""
DO = """async ([name, value]) => {
  const begun = performance.now(), scene = studio.view.lanes[0].number;
  const drawn = new Promise(end => { studio.view.onDraw = () => {
    if (studio.view.lanes[0].number !== scene) { studio.view.onDraw = null; end(); } }; });
  const reply = await studio.ask("do", {name, act: {value}});
  if (reply.error) throw Error(reply.error);
  const replied = performance.now() - begun;
  await drawn;
  return [replied, performance.now() - begun]; }"""
GRAPH = """async () => {
  const cy = studio.graph.cy, begun = performance.now();
  for (let i = 0; i < 10; i++) {
    cy.panBy({x: i % 2 ? 3 : -3, y: 0});
    await new Promise(end => cy.one("render", end)); }
  return (performance.now() - begun) / 10; }"""


def measured(browser: Any, system: str, name: str, seconds: float) -> dict[str, Any]:
    """Measure the page of one system."""
    command = [sys.executable, "-m", "scm_world", "studio", system, "--port", "0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 # our own
    assert server.stdout is not None  # noqa: S101
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    try:
        page, begun = context.new_page(), time.perf_counter()
        page.goto(next(line for line in server.stdout if line.startswith("http")).strip())
        while not page.evaluate(READY):
            page.wait_for_timeout(20)
        found: dict[str, Any] = {"seconds until shown": time.perf_counter() - begun}
        page.wait_for_timeout(500)
        found["pictures per second"] = page.evaluate(DRAW, seconds)
        times = [page.evaluate(DO, [name, [0.1 + 0.03 * i, 0.5, 0.5]]) for i in range(20)]
        for what, column in zip(("reply", "picture"), zip(*times, strict=True), strict=True):
            found[f"ms from do to {what}, median"] = statistics.median(column)
            found[f"ms from do to {what}, largest"] = max(column)
        page.evaluate("studio.ask('policy', {name: 'random'})")
        page.evaluate("studio.ask('play', {speed: 1})")
        page.wait_for_timeout(300)
        now = "[studio.view.drawn, studio.news.steps, performance.now()]"
        first = page.evaluate(now)
        page.wait_for_timeout(1000 * seconds)
        last = page.evaluate(now)
        page.evaluate("studio.ask('pause')")
        took = (last[2] - first[2]) / 1000
        found["pictures per second while it plays"] = (last[0] - first[0]) / took
        found["control steps per second while it plays"] = (last[1] - first[1]) / took
        page.evaluate("studio.graph.all(true)")
        found["ms to redraw the open graph"] = page.evaluate(GRAPH)
        found["edges"] = page.evaluate("studio.graph.edges.cause.length")
        return {key: round(value, 1) for key, value in found.items()}
    finally:
        context.close()
        server.terminate()
        server.wait()


def main() -> None:
    """Measure all systems, print and write the results."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("studio.json"))
    given = parser.parse_args()
    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        load = os.getloadavg()[0]
        found: dict[str, Any] = {"browser": browser.version, "cores": os.cpu_count(), "load": load}
        for system, name in SYSTEMS.items():
            found[system] = measured(browser, system, name, given.seconds)
            print(system, json.dumps(found[system], indent=1))
        browser.close()
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
