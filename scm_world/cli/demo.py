"""The demonstration: one cause is changed, and everything else is the same."""

from __future__ import annotations

import time
import webbrowser
from base64 import b64encode
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.live import Live
from rich.text import Text

import scm_world as sw
from scm_world.cli import console

LINES = """\
import scm_world as sw
episode = sw.World("picking").rollout("feedback", seed=0, steps=90)
twin = episode.counterfactual({"tool_block.mass": 0.3})"""
SECONDS = 4.0  # how long the picture moves on a terminal
PAGE = """<!doctype html><meta charset="utf-8"><title>scm_world: a world and its twin</title>
<body style="font: 16px sans-serif; max-width: 720px; margin: 2em auto">
<p>{said}</p><img width="720" alt="Left the world, right its twin"><pre>{lines}</pre><script>
const frames = {frames}, image = document.querySelector("img"); let i = 0;
setInterval(() => image.src = "data:image/png;base64," + frames[i++ % frames.length], 120);
</script>
"""


def demo(*, page: bool = False) -> None:
    """Show a world beside its twin: equal noise and actions, and a block that is heavier.

    The picture moves for four seconds; without a terminal, heights of the block are printed.
    Example: scm-world demo --page

    Args:
        page: Write a page with moving pictures, and open it in the usual browser.
    """
    from scm_world.backends import renderer

    episode = sw.World("picking").rollout("feedback", seed=0, steps=90)
    twin = episode.counterfactual({"tool_block.mass": 0.3})
    z = "tool_block.cartesian_position"
    rises = [np.round(100.0 * (one[z] - one[z][0])[:, 2], 1) + 0.0 for one in (episode, twin)]
    grams = [1000.0 * float(one["tool_block.mass"][0]) for one in (episode, twin)]
    said = "Three fingers lift a block of {:.0f} g; in the twin it has {:.0f} g.".format(*grams)
    near: dict[str, Any] = {"eye": (0.17, -0.42, 0.38), "target": (0, 0, 0.08), "field_of_view": 36}
    camera = replace(renderer.scene_camera(episode.scene(0)[0]), **near)

    def pixels(step: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        scenes = (one.scene(step)[0] for one in (episode, twin))
        return np.hstack([renderer.picture(scene, camera, size, samples=2) for scene in scenes])

    screen = console.terminal()
    console.say(said)
    if page:
        images = (renderer.png(pixels(step, (240, 240))) for step in range(0, 91, 3))
        frames, folder = [b64encode(one).decode() for one in images], Path("scm-world-results")
        console.write(folder, {"demo.html": PAGE.format(said=said, lines=LINES, frames=frames)})
        webbrowser.open((folder / "demo.html").absolute().as_uri())
    elif screen.is_terminal and screen.color_system:
        side = max(8, min(44, screen.width // 2, 2 * (screen.height - 8)))
        end = time.monotonic() + SECONDS
        with Live(console=screen, auto_refresh=False) as live:
            while (left := (end - time.monotonic()) / SECONDS) > 0.0:
                step = int(91 * (1.0 - left))
                live.update(_drawn(pixels(step, (side - side % 2, side))), refresh=True)
    else:
        rows = {"step": range(0, 91, 15), "rises [cm]": rises[0][::15], "twin [cm]": rises[1][::15]}
        console.frame(rows)
    ends = [rise[-1] for rise in rises]
    console.say(f"It rises by {ends[0]} cm, in the twin by {ends[1]} cm. In Python:", "", LINES)


def _drawn(rgb: NDArray[np.uint8]) -> Text:
    """Return a picture in characters, two pixels in each."""
    found = Text()
    for upper, lower in zip(rgb[::2].tolist(), rgb[1::2].tolist(), strict=True):
        for a, b in zip(upper, lower, strict=True):
            found.append("▀", "rgb({},{},{}) on rgb({},{},{})".format(*a, *b))
        found.append("\n")
    return found
