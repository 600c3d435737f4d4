"""Draw the moving pictures of ``docs/gallery.md``: twins that differ in one cause.

::

    python -m benchmarks.gallery               # all of them, into docs/images/gallery
    python -m benchmarks.gallery pushing       # one of them

Both worlds of a twin have the same seed, the same noise and the same policy; ``do`` sets one cause
in the second one. The package's own renderer draws them, so no screen is needed.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont

from scm_world import Box, ModelTask
from scm_world.backends.renderer import picture
from scm_world.env import ScmWorldEnv
from scm_world.evaluation.episodes import Hook, play
from scm_world.models.camera import Camera
from scm_world.policies import as_agent
from scm_world.runs.canvas import INK, PALETTE

IMAGES = Path(__file__).parent.parent / "docs" / "images" / "gallery"
SIZE, BAR, GAP = (240, 320), 26, 4  # height and width of a world, of its caption, between [pixels]
MILLISECONDS, QUALITY = 80, 55  # of a frame; of WebP
ROBOT = Camera("robot", (0.36, -0.36, 0.3), (0.0, 0.0, 0.05), field_of_view=34.0)
SIDE = Camera("side", (0.0, -4.6, 0.9), (0.0, 0.0, 0.35), field_of_view=40.0)
PLAIN = {"normalize_observations": False, "normalize_actions": False}

CART = """<mujoco model="cart"><option timestep="0.01"/><worldbody>
  <geom type="box" size="1.6 .02 .02" pos="0 .15 0" rgba=".6 .6 .6 1"/>
  <body name="cart"><joint name="slider" type="slide" axis="1 0 0" range="-1.6 1.6"/>
  <geom size=".2 .1 .1" type="box" mass="1" rgba="0 .45 .7 1"/>
  <body name="pole"><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 1" size=".045" mass=".1" rgba=".84 .37 0 1"/></body></body>
  </worldbody><actuator><motor name="motor" joint="slider" gear="10" ctrlrange="-1 1"/></actuator>
  </mujoco>"""


def balancing() -> ModelTask:
    """Return a cart that balances a pole."""
    start = {"hinge.position": Box(0.15, 0.15)}
    reward = (upright, "hinge.position")
    seen = ("slider.position", "hinge.position", "slider.velocity", "hinge.velocity")
    return ModelTask(CART, name="cart", seconds=5.0, control_dt=0.02, start=start, reward=reward,
                     observe=seen)  # fmt: skip


def upright(angle: float) -> float:
    """Return minus the angle of the pole."""
    return -abs(angle)


def balance(seen: Any) -> Any:
    """Push the cart under the pole: position, angle, and their velocities."""
    return np.clip(seen @ np.array([[0.1], [4.0], [0.25], [1.0]]), -1.0, 1.0)


@dataclass(frozen=True)
class Twin:
    """Two worlds that differ in one cause.

    Attributes:
        cause: Name of the variable, or a pattern.
        values: What ``do`` sets it to, in the first and in the second world.
        unit: Unit of the values.
        policy: Who acts in both worlds; that of the zoo with the name of the task if None.
        steps: Control steps that are shown.
        every: Control steps from frame to frame.
    """

    cause: str
    values: tuple[float, float]
    unit: str = ""
    policy: Any = None
    steps: int = 160
    every: int = 2


TWINS = {
    "pushing": Twin("tool_block.mass", (0.02, 0.4), "kg", steps=120),
    "picking": Twin("tool_block.mass", (0.02, 0.3), "kg", steps=130),
    "pick_and_place": Twin("tool_block.friction", (1.0, 0.1), steps=240, every=3),
    "reaching": Twin("torque_limit", (0.36, 0.05), "N m", steps=60, every=1),
    "stacking2": Twin("tool_block_*.friction", (1.0, 0.3), steps=400, every=5),
    "cart": Twin("motor.gear", (10.0, 1.5), "N", policy=balance, steps=200, every=4),
}


class Film(Hook):
    """Takes a picture every few control steps, and ends the episode after the last one."""

    def __init__(self, twin: Twin, camera: Camera) -> None:
        self._twin, self._camera, self.frames = twin, camera, list[Any]()

    def begin(self, env: ScmWorldEnv, observation: Any) -> None:
        """Begin with the world before the first action."""
        self._env = env
        self._take()

    def after(self, observation: Any, reward: float, info: Any) -> bool:
        """Take a picture if it is time."""
        if self._env.world.index % self._twin.every == 0:
            self._take()
        return self._env.world.index >= self._twin.steps

    def _take(self) -> None:
        self.frames.append(picture(self._env.world.scene(), self._camera, SIZE, samples=2))


def filmed(name: str, twin: Twin) -> Iterator[list[Any]]:
    """Yield the pictures of each of the two worlds."""
    zoo = twin.policy is None
    agent = as_agent(f"zoo:{name}") if zoo else as_agent(twin.policy, env=PLAIN)
    form: Any = {} if agent.card is None else agent.card.env
    with closing(ScmWorldEnv(name if zoo else balancing(), **form)) as env:
        for value in twin.values:
            film = Film(twin, ROBOT if zoo else SIDE)
            play(env, agent, {twin.cause: value}, (film,), seed=0)
            yield film.frames


def moving(name: str) -> bytes:
    """Return a twin as WebP: side by side, with the cause in the captions."""
    twin = TWINS[name]
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans-Bold.ttf", 13)
    (height, width), pictures = SIZE, []
    sides = list(filmed(name, twin))
    for frames in zip(*sides, strict=True):
        sheet = Image.new("RGB", (2 * width + GAP, height + BAR), "white")
        pen = ImageDraw.Draw(sheet)
        for side, frame in enumerate(frames):
            left = side * (width + GAP)
            sheet.paste(Image.fromarray(frame), (left, BAR))
            text = f"{twin.cause} = {twin.values[side]:g} {twin.unit}".strip()
            text = text if side == 0 else f"do({text})"
            pen.text((left + 4, 5), text, fill=PALETTE[side] if side else INK, font=font)
        pictures.append(sheet)
    pictures += 8 * [pictures[-1]]  # the end is seen for a while
    made = io.BytesIO()
    pictures[0].save(made, "WEBP", save_all=True, append_images=pictures[1:], loop=0,
                     duration=MILLISECONDS, quality=QUALITY, method=4)  # fmt: skip
    return made.getvalue()


def main() -> None:
    """Draw the chosen twins."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", nargs="*", choices=[*TWINS, []], help="all of them if none is named"
    )
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names or TWINS:
        path = given.out / f"{name}.webp"
        path.write_bytes(moving(name))
        print(path, f"{path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
