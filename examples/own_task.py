"""A task of one's own that one can train on: bring the block to the middle of the arena.

``new_family.py`` shows families of many blocks; this is a small one with a reward term of its
own and an id for ``gymnasium.make``. Run it with ``python examples/own_task.py [EPISODES]``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any, ClassVar

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.entities import (
    Entity,
    GoalBlock,
    ToolBlock,
    block_mass,
    block_size,
    goal_orientation,
    goal_position,
)
from scm_world.evaluation import Protocol, evaluate
from scm_world.tasks import Building, term
from scm_world.variables import Box, Function, Parent, Variable

BLOCK, GOAL, SIZE = "tool_block", "goal_block", "block.size"
ID = "own/Centering-v0"
PLACE = f"{BLOCK}.cartesian_position"


def middle(size: np.ndarray) -> np.ndarray:
    """Compute where the goal stands [m]."""
    return np.stack([0.0 * size[..., 0], 0.0 * size[..., 1], size[..., 2] / 2], axis=-1)


def nearer(now: np.ndarray, before: np.ndarray) -> float:
    """Compute by how much the block came nearer to the middle of the floor [m]."""
    return float(np.hypot(before[0], before[1]) - np.hypot(now[0], now[1]))


class Centering(Building):
    """One block, and a goal in the middle."""

    name = "centering"
    default_weights: ClassVar = {"reward.nearer": 100.0, "fractional_success": 1.0}

    def tools(self) -> tuple[str, ...]:
        """Name the block."""
        return (BLOCK,)

    def targets(self) -> dict[str, str]:
        """Name the goal, with the block that belongs there."""
        return {GOAL: BLOCK}

    def shared(self) -> Iterable[Variable]:
        """Declare the size that block and goal have in common."""
        yield block_size(SIZE)

    def entities(self) -> Iterable[Entity]:
        """List block and goal."""
        sizes = [block_size(f"{name}.size", SIZE, spaces=False) for name in (BLOCK, GOAL)]
        where = goal_position(GOAL, parents=(f"{GOAL}.size",), mechanism=Function(middle))
        start = (0.0, 0.1, 0.0325)  # [m]
        yield ToolBlock(BLOCK, size=sizes[0], mass=block_mass(f"{BLOCK}.mass"), place=start)
        yield GoalBlock(GOAL, size=sizes[1], pose=(where, goal_orientation(GOAL)))

    def dense(self) -> Iterable[Variable]:
        """Declare what is rewarded besides filling the goal."""
        yield term("reward.nearer", nearer, (PLACE, Parent(PLACE, 1)), "How much nearer it came.")


if ID not in gymnasium.registry:  # at the top level, so that other processes know it, too
    gymnasium.register(
        ID,
        entry_point="scm_world.env:ScmWorldEnv",
        vector_entry_point="scm_world.env.batched:ScmWorldVectorEnv",
        kwargs={"task": Centering()},
    )


def main(episodes: str = "5") -> None:
    """Take random steps in many worlds, and see how far a scripted policy gets."""
    envs: Any = gymnasium.make_vec(ID, 4, start={f"{BLOCK}.mass": "A"})
    envs.reset(seed=0)
    envs.action_space.seed(0)
    total = sum(envs.step(envs.action_space.sample())[1] for _ in range(25))
    print(f"observations {envs.observation_space.shape}, returns at random {np.round(total, 2)}")
    envs.close()
    anywhere = Box((-0.1, -0.1, 0.0325), (0.1, 0.1, 0.0325))  # [m]
    mine = [Protocol("anywhere", PLACE, anywhere), Protocol("heavy", f"{BLOCK}.mass", "B")]
    found = evaluate({"sweep": "sweep", "still": "still"}, mine, task=Centering(), n=int(episodes))
    for protocol in found.protocols:
        print(f"{protocol}:", *(f"{a} {found.score(protocol, agent=a)}" for a in found.agents))


if __name__ == "__main__":
    main(*sys.argv[1:])
