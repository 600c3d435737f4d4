"""A custom task for training: bring the block to the middle of the floor.

Run it with ``python examples/own_task.py [N]``; a recipe takes its name, too.
"""

import sys
from typing import Any, ClassVar, Unpack

import gymnasium
import numpy as np

from scm_world.evaluation import Protocol, evaluate
from scm_world.tasks import register, term
from scm_world.tasks.trifinger.entities.bodies import position
from scm_world.tasks.trifinger.single import GOAL, TOOL, BlockOptions, OneBlock
from scm_world.variables import Parent, Variable


def middle(size: np.ndarray) -> np.ndarray:
    """Compute where the goal stands [m]."""
    return size * np.array([0.0, 0.0, 0.5])


def nearer(now: np.ndarray, before: np.ndarray) -> float:
    """Compute by how much the block came nearer to the middle of the floor [m]."""
    return float(np.hypot(before[0], before[1]) - np.hypot(now[0], now[1]))


@register  # at the top level, so that other processes know it, too
class Centering(OneBlock):
    """One block, and a goal in the middle of the floor."""

    name = "centering"
    default_weights: ClassVar = {"reward.nearer": 100.0, "fractional_success": 1.0}

    def __init__(self, **options: Unpack[BlockOptions]) -> None:
        super().__init__((0.0, 0.1), **options)

    def entities(self) -> tuple[Any, ...]:
        """List block and goal."""
        where = position(GOAL, (middle, f"{GOAL}.size"))
        return self.tool_block(), self.goal_block(where)

    def dense(self) -> tuple[Variable, ...]:
        """Declare the reward in addition to filling the goal."""
        at = f"{TOOL}.cartesian_position"
        return (term("reward.nearer", nearer, (at, Parent(at, 1)), "How much nearer it is."),)


def main(n: str = "5") -> None:
    """Give it an id, and see how far a scripted policy gets with heavy blocks."""
    gymnasium.register("Centering-v0", "scm_world.env:ScmWorldEnv", kwargs={"task": "centering"})
    print(f"observations {gymnasium.make('Centering-v0').observation_space.shape}")
    found = evaluate("feedback", Protocol("heavy", f"{TOOL}.mass", "B"), task="centering", n=int(n))
    print(f"fractional success with heavy blocks: {found.score('heavy')}")


if __name__ == "__main__":
    main(*sys.argv[1:])
