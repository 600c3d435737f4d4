"""How fast the page of ``scm-world studio`` is, in Chromium with software rendering.

Run it with ``python -m benchmarks.studio [SYSTEM…]``; systems are tasks or model files. It writes
``studio.json``, and needs the extra ``studio``, playwright, and a Chromium on the path.

Measured, for each system: the time from the command until the page shows the world and its graph
can be clicked, and the processor's of all processes until then; the longest block of the page's
main thread; pictures of the world in a second, while it is drawn as often as the browser allows;
control steps and pictures in a second while it plays with random actions; the time from a ``do``
until the first picture of the changed world is drawn; and that of one redraw of the whole graph,
opened.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

SYSTEMS = ("pushing", "towers")
PATIENCE = 90.0  # [s] until a page has to show its world
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
READY = "Boolean(window.studio?.news && studio.view.drawn && studio.graph.shown)"
FAILED = "document.body.dataset.connection === 'refused'"
SAID = "document.getElementById('connection').textContent"
BLOCKS = """window.blocks = [0]; new PerformanceObserver(list => blocks.push(
  ...list.getEntries().map(entry => entry.duration))).observe({entryTypes: ["longtask"]});"""
DRAW = """async seconds => {
  const first = studio.view.drawn, begun = performance.now();
  await new Promise(end => { (function more() {
    studio.view.redraw();
    performance.now() - begun < 1000 * seconds ? requestAnimationFrame(more) : end(); })(); });
  return 1000 * (studio.view.drawn - first) / (performance.now() - begun); }"""
CHANGED = """() => studio.graph.hello.variables.filter(v => v.settable && v.role === "state" &&
  !v.name.endsWith("orientation")).map(v => v.name)"""
DO = """async name => {
  const begun = performance.now(), frames = studio.view.frames;
  const drawn = new Promise(end => { studio.view.onDraw = () => {
    if (studio.view.frames > frames) { studio.view.onDraw = null; end(); } }; });
  const reply = await studio.ask("do", {name, act: {kind: "shift", value: 1e-4}});
  if (reply.error) return null;
  const replied = performance.now() - begun;
  await drawn;
  return [replied, performance.now() - begun]; }"""
GRAPH = """async () => {
  const cy = studio.graph.cy, begun = performance.now();
  for (let i = 0; i < 10; i++) {
    cy.panBy({x: i % 2 ? 3 : -3, y: 0});
    await new Promise(end => cy.one("render", end)); }
  return (performance.now() - begun) / 10; }"""


def family(number: int) -> Iterator[int]:
    """List a process and all that it has started."""
    yield number
    with suppress(OSError):
        for task in Path(f"/proc/{number}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from family(int(child))


def cpu(number: int) -> float:
    """Return the processor's time of a process and all that it has started [s]."""
    ticks = 0
    for one in family(number):
        with suppress(OSError):
            fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def first_of_all() -> None:
    """Let all threads of the measurement run before other work of the machine, again and again."""
    while True:
        for one in family(os.getpid()):
            with suppress(OSError):
                for task in Path(f"/proc/{one}/task").iterdir():
                    os.setpriority(os.PRIO_PROCESS, int(task.name), -20)
        time.sleep(0.25)


@contextmanager
def chromium() -> Iterator[Any]:
    """Open a Chromium without a screen."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield browser
        browser.close()


def measured(
    browser: Any, system: str, seconds: float, *, brief: bool = False, picture: str = ""
) -> dict[str, Any]:
    """Measure the page of one system; without ``do`` and the open graph if brief.

    Raises:
        RuntimeError: The page shows no world; the message is what it or the command says.
    """
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    page, before, begun = context.new_page(), cpu(os.getpid()), time.perf_counter()
    page.add_init_script(BLOCKS)
    command = [sys.executable, "-m", "scm_world", "studio", system, "--port", "0"]
    out = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    server = subprocess.Popen(command, text=True, **out)  # type: ignore[call-overload] # noqa: S603
    said = ""
    try:
        while not (said := server.stdout.readline() or "ended").startswith(
            ("http", "error", "ended")
        ):
            pass
        if not said.startswith("http"):
            raise RuntimeError(said.strip())
        page.goto(said.strip())
        while not page.evaluate(READY):
            page.wait_for_timeout(20)
            if time.perf_counter() - begun > PATIENCE or page.evaluate(FAILED):
                raise RuntimeError(page.evaluate(SAID))
        found: dict[str, Any] = {"seconds until shown": time.perf_counter() - begun}
        found["of the processor"] = cpu(os.getpid()) - before
        page.wait_for_timeout(1000)
        found["longest block, ms"] = page.evaluate("Math.max(...blocks)")
        if picture:
            page.screenshot(path=picture)
        if not brief:
            found["pictures per second"] = page.evaluate(DRAW, seconds)
            for name in page.evaluate(CHANGED):
                if page.evaluate(DO, name):
                    times = [page.evaluate(DO, name) for _ in range(20)]
                    for what, column in zip(
                        ("reply", "picture"), zip(*times, strict=True), strict=True
                    ):
                        found[f"ms from do to {what}, median"] = statistics.median(column)
                        found[f"ms from do to {what}, largest"] = max(column)
                    break
        page.evaluate("studio.ask('policy', {name: 'random'})")
        page.evaluate("studio.ask('play', {speed: 1})")
        page.wait_for_timeout(1000)
        now = "[studio.view.drawn, studio.news.steps, performance.now()]"
        used, first = cpu(os.getpid()), page.evaluate(now)
        page.wait_for_timeout(1000 * seconds)
        last, used = page.evaluate(now), cpu(os.getpid()) - used
        page.evaluate("studio.ask('pause')")
        took = (last[2] - first[2]) / 1000
        found["pictures per second while it plays"] = (last[0] - first[0]) / took
        found["ms of the processor for each"] = 1000 * used / max(1, last[0] - first[0])
        found["control steps per second while it plays"] = (last[1] - first[1]) / took
        if picture:
            page.screenshot(path=picture.replace(".png", "-playing.png"))
        if not brief:
            page.evaluate("studio.graph.all(true)")
            found["ms to redraw the open graph"] = page.evaluate(GRAPH)
        found["variables"] = page.evaluate("studio.graph.hello.variables.length")
        found["edges"] = page.evaluate("studio.graph.edges.cause.length")
        return {key: round(value, 1) for key, value in found.items()}
    finally:
        context.close()
        server.terminate()
        server.wait()


def main() -> None:
    """Measure all systems, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", default=SYSTEMS)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    parser.add_argument("--first", action="store_true", help="run before other work; as root")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("studio.json"))
    given = parser.parse_args()
    if given.first:
        threading.Thread(target=first_of_all, daemon=True).start()
    with chromium() as browser:
        found: dict[str, Any] = {"browser": browser.version, "cores": os.cpu_count()}
        for system in given.systems:
            load = {"load of the machine": round(os.getloadavg()[0], 1)}
            name = "/".join(Path(system).parts[-3:])
            found[name] = load | measured(browser, system, given.seconds)
            print(name, json.dumps(found[name], indent=1), flush=True)
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
