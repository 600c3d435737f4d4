"""A server in a process of its own, and a browser that opens its page."""

from __future__ import annotations

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.studio import ARGUMENTS

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE = 60.0  # [s]

PUSHER = """
<mujoco model="pusher">
  <option timestep="0.005"/>
  <asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1" rgba=".7 .7 .7 1"/>
    <geom name="sign" type="mesh" mesh="wedge" pos="0 .4 0" contype="0" conaffinity="0"/>
    <body name="cube" pos="0 0 .051">
      <freejoint name="cube"/>
      <geom name="cube" type="box" size=".05 .05 .05" mass=".2" rgba=".8 .2 .2 1"/>
    </body>
    <body name="hand" pos="-.2 0 .05">
      <joint name="slider" type="slide" axis="1 0 0" damping="1" range="-.1 .6"/>
      <geom name="hand" type="sphere" size=".03" mass=".3" rgba=".2 .2 .8 1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="slider" gear="3" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Server:
    """``scm-world studio`` on a free port, or on the one that it had before."""

    def __init__(self, system: str, *options: str, folder: Path, port: int = 0) -> None:
        self._command = [sys.executable, "-m", "scm_world", "studio", system, *options]
        self._folder = folder
        self.port = port
        self.start()

    def start(self) -> None:
        """Start it and wait for its address."""
        self._process = subprocess.Popen(  # noqa: S603 # our own command
            [*self._command, "--port", str(self.port)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=self._folder,
            env={**os.environ, "COLUMNS": "200"},
            start_new_session=True,  # of which a terminal interrupts every process
        )
        assert self._process.stdout is not None
        said = line = self._process.stdout.readline()
        while line and not line.startswith("http://"):  # notes come first
            line = self._process.stdout.readline()
            said += line
        if not line:
            self.stop()
            raise AssertionError(said)
        self.address = line.strip()
        self.port = int(self.address.split("/")[2].rpartition(":")[2])

    def stop(self, how: int = signal.SIGINT, *, times: int = 1) -> tuple[int, str]:
        """End it as Ctrl-C in a terminal does; return its exit code, and what it printed since."""
        for _ in range(times):
            if self._process.poll() is None:
                os.killpg(self._process.pid, how)
        said, _ = self._process.communicate(timeout=PATIENCE)
        return self._process.returncode, said


def unpacked(message: bytes) -> dict[str, Any]:
    """Read a packed message as the page does."""
    size = struct.unpack("<2I", message[:8])[1]
    arrays = message[8 + size :]

    def array(found: dict[str, Any]) -> Any:
        if "array" not in found:
            return found
        return np.frombuffer(arrays, found["array"], found["n"], found["at"])

    return dict(json.loads(message[8 : 8 + size], object_hook=array))


@contextmanager
def browser() -> Iterator[Any]:
    """Open a Chromium without a screen; skip where there is none."""
    driver = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"there is no browser: none of {', '.join(BROWSERS)} is installed")
    with driver.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield opened
        opened.close()


def until(page: Any, code: str, patience: float = PATIENCE) -> Any:
    """Wait until JavaScript gives something true; return it."""
    end = time.monotonic() + patience
    while not (found := page.evaluate(code)):
        assert time.monotonic() < end, f"{code} is not true; the page says: " + str(
            page.inner_text("body")[-1500:]
        )
        page.wait_for_timeout(30)
    return found


def opened(context: Any, address: str) -> Any:
    """Open the page, and wait until it shows the world; errors of the page are errors."""
    context.set_default_timeout(1000 * PATIENCE)
    page = context.new_page()
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.goto(address)
    until(page, "Boolean(window.studio?.news && studio.view.drawn && studio.graph.shown)")
    return page


def ask(page: Any, op: str, **given: Any) -> Any:
    """Send a message to the world, and return the reply."""
    return page.evaluate("([op, given]) => studio.ask(op, given)", [op, given])
