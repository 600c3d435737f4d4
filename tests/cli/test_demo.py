"""The demonstration of a twin."""

from __future__ import annotations

import re
import webbrowser
from base64 import b64decode
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from typer.testing import CliRunner

from scm_world.backends import renderer
from scm_world.cli import console, demo
from scm_world.cli.app import app


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace pictures by planes of one colour; return the scenes that were drawn."""
    drawn: list[Any] = []

    def picture(scene: Any, camera: Any, size: tuple[int, int], **_: Any) -> Any:
        drawn.append(scene)
        return np.full((*size, 3), (len(drawn) % 2) * 200, np.uint8)

    monkeypatch.setattr(renderer, "picture", picture)
    return drawn


def _program() -> tuple[Any, Any]:
    """Run the three lines, and return what they make."""
    found: dict[str, Any] = {}
    assert len(demo.LINES.splitlines()) == 3
    exec(demo.LINES, found)  # noqa: S102 # our own text
    return found["episode"], found["twin"]


def test_it_prints_what_its_three_lines_find() -> None:
    """Heights are those of the program that is shown; only the mass differs before they do."""
    done = CliRunner().invoke(app, ["demo"])
    assert done.exit_code == 0, done.output
    assert done.stdout.endswith(demo.LINES + "\n")
    episode, twin = _program()
    name = "tool_block.cartesian_position"
    ends = [round(100 * float(one[name][-1, 2] - one[name][0, 2]), 1) for one in (episode, twin)]
    assert ends[0] > 5.0 > 1.0 > abs(ends[1])
    assert f"It rises by {ends[0]} cm, in the twin by {abs(ends[1])} cm" in done.stdout
    np.testing.assert_array_equal(episode["action"], twin["action"])
    masses = [1000 * float(one["tool_block.mass"][0]) for one in (episode, twin)]
    assert f"a block of {masses[0]:.0f} g; in the twin it has {masses[1]:.0f} g" in done.stdout


def test_the_page_has_the_frames(flat: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """It is one file, which is opened; each frame has the world on the left and its twin."""
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    done = CliRunner().invoke(app, ["demo", "--page"])
    assert done.exit_code == 0, done.output
    page = Path("scm-world-results/demo.html")
    assert opened == [page.absolute().as_uri()]
    frames = re.findall(r"'([\w+/=]{99,})'", page.read_text())
    assert (len(frames), len(flat)) == (31, 62)
    pixels = imread(BytesIO(b64decode(frames[7])))
    assert pixels.shape[:2] == (240, 480)
    assert (pixels[:, :240, 0] > 0.5).all()
    assert not pixels[:, 240:, 0].any()


@pytest.mark.usefixtures("flat")
def test_it_moves_on_a_terminal_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Characters have two pixels each, in the colours of the picture."""
    out = StringIO()
    screen = Console(
        file=out, force_terminal=True, color_system="truecolor", width=60, height=30, _environ={}
    )
    monkeypatch.setattr(console, "terminal", lambda **_: screen)
    monkeypatch.setattr(demo, "SECONDS", 0.05)
    done = CliRunner().invoke(app, ["demo"])
    assert done.exit_code == 0, done.output
    pixel = "\x1b[38;2;{0};{0};{0};48;2;{0};{0};{0}m▀"
    line = pixel.format(200) + "\x1b[0m"
    assert line * 30 in out.getvalue()
    assert demo.LINES in done.stdout
    assert out.getvalue().endswith("\x1b[?25h")  # the cursor is shown again
