"""A custom goal family: a pyramid, with as many levels as a variable says.

Run it with ``python examples/new_family.py [mujoco|bullet|fake]``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import ClassVar, Unpack

import numpy as np

from scm_world import World
from scm_world.tasks import Common, TriFingerTask
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.blocks import ToolBlock, block_mass, block_size
from scm_world.tasks.trifinger.entities.goals import GoalBlock, goal_orientation, goal_position
from scm_world.variables import Exogenous, Function, Integers, Variable

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


class Pyramid(TriFingerTask):
    """Blocks of one size, each level with one block less than the level below."""

    name = "pyramid"
    default_weights: ClassVar = {"fractional_success": 1.0}
    decided_by = (LEVELS,)  # what decides which entities there are …
    goal_causes = (LEVELS,)  # … and what a new goal is drawn for
    rest = hardware.RAISED  # the fingers begin out of the way

    def __init__(self, *, levels: int = 2, **common: Unpack[Common]) -> None:
        super().__init__(**common)  # weights, custom terms, where the robot begins
        self._levels = levels

    def arrange(self, values: dict[str, np.ndarray]) -> int:
        """Turn the values of ``decided_by`` into a plan; all other methods read it."""
        return int(values[LEVELS])

    def parts(self) -> Iterator[tuple[str, dict[str, float]]]:
        """List the parts: a block ``tool_NAME`` each, and its place ``goal_NAME``."""
        plan = self.plan or self._levels  # the task alone, without a world, has no plan yet
        for level in range(plan):
            for num in range(plan - level):
                yield f"{level}_{num}", {"level": float(level), "num": float(num)}

    def shared(self) -> Iterable[Variable]:
        """Declare what several entities have in common, for every plan."""
        yield block_size(SIZE)
        yield Exogenous(
            name=LEVELS,
            dtype="integer",
            bounds=Integers(1, 3),
            a=Integers(1, 2),
            b=Integers(3, 3),
            default=self._levels,
            doc="How many levels the pyramid has.",
        )

    def entities(self) -> Iterable[Entity]:
        """List blocks and goals."""
        for brick, which in self.parts():
            name = f"tool_{brick}"
            yield ToolBlock(
                name,
                size=block_size(f"{name}.size", SIZE, spaces=False),
                mass=block_mass(f"{name}.mass"),
                spawn=Function(start, constants=which),
                spawn_again=True,  # another size puts the blocks there again
            )
        for brick, which in self.parts():
            name = f"goal_{brick}"
            where = Function(place, constants=which)
            position = goal_position(name, parents=(LEVELS, SIZE), mechanism=where)
            size = block_size(f"{name}.size", SIZE, spaces=False)
            yield GoalBlock(name, size=size, pose=(position, goal_orientation(name)), yaw=False)


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
