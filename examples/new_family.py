"""A custom goal family: a pyramid, with as many levels as a variable says.

Run it with ``python examples/new_family.py [mujoco|bullet|fake]``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Unpack

import numpy as np

from scm_world import World
from scm_world.tasks import Building, Common
from scm_world.tasks.trifinger.building import Piece, blocks_mass
from scm_world.tasks.trifinger.entities.bodies import block_size
from scm_world.variables import Exogenous, Integers

LEVELS, SIZE = "pyramid_levels", "block.size"
GAP = 0.01  # [m] between blocks at the start


def place(levels: np.ndarray, size: np.ndarray, *, level: float, num: float) -> np.ndarray:
    """Compute the center of a goal: each level is half a block narrower at both ends [m]."""
    x = (num - (levels - level - 1) / 2) * size[..., 0]
    return np.stack([x, np.zeros_like(x), (level + 0.5) * size[..., 2]], axis=-1)


def start(size: np.ndarray, orientation: np.ndarray, *, level: float, num: float) -> np.ndarray:
    """Compute where a block begins: in front of the pyramid, upper levels behind it [m]."""
    column, row = num + 2 * (level // 2) - 1, 1 if level else -1
    return np.array([column * (size[0] + GAP), row * (size[1] + GAP), size[2] / 2])


class Pyramid(Building):
    """Blocks of one size, each level with one block less than the level below."""

    name = "pyramid"
    decided_by = (LEVELS,)  # what decides which entities there are …
    goal_causes = (LEVELS,)  # … and what a new goal is drawn for
    piece = Piece(size=SIZE, place=(place, LEVELS, SIZE), start=(start,))  # the size is a copy

    def __init__(self, *, levels: int = 2, **common: Unpack[Common]) -> None:
        super().__init__(**common)  # weights, custom terms, where the robot begins
        number = Exogenous(
            name=LEVELS,
            dtype="integer",
            bounds=Integers(1, 3),
            a=Integers(1, 2),
            b=Integers(3, 3),
            default=levels,
            doc="How many levels the pyramid has.",
        )
        self.roots = (blocks_mass(0.02), block_size(SIZE), number)  # the same for every plan

    def arrange(self, values: dict[str, np.ndarray]) -> int:
        """Turn the values of ``decided_by`` into a plan; all other methods read it."""
        return int(values[LEVELS])

    def parts(self) -> Iterator[tuple[str, dict[str, float]]]:
        """List the parts: a block ``tool_NAME`` each, and its place ``goal_NAME``."""
        for level in range(self.arranged):
            for num in range(self.arranged - level):
                yield f"{level}_{num}", {"level": float(level), "num": float(num)}


def main(backend: str = "mujoco") -> None:
    """Build a pyramid by intervention, make it higher, and draw another one."""
    world = World(Pyramid(), backend=backend)
    world.reset(seed=0)
    world.do({SIZE: [0.05, 0.05, 0.06]})  # blocks, goals and starts follow
    world.do(world.task.solution(world.values()))
    print(f"{len(world.task.tools)} blocks fill {float(world['fractional_success']):.2f}")
    world.step(np.array(world.task.start))
    print(world.do({LEVELS: 3}))  # in mid-episode: three blocks more
    print(f"{len(world.task.tools)} blocks fill {float(world['fractional_success']):.2f}")
    world.reset(seed=1, do=world.task.sample_goal("A"))


if __name__ == "__main__":
    main(*sys.argv[1:2])
