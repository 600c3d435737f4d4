"""The scenes that are timed: what people use, and one kind of scene over numbers of blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.timing import Settings
from scm_world.env import ScmWorldEnv

ENGINES = ("mujoco", "bullet")
SEED = 0
EDGE = 0.035  # [m] of a block of a tower, as in the predecessor


@dataclass(frozen=True)
class Case:
    """A scene that is timed.

    Attributes:
        name: In tables.
        blocks: How many of them.
        task: Name of the task.
        options: Its arguments.
        sized: Index of the block whose size is changed.
    """

    name: str
    blocks: int
    task: str
    options: Mapping[str, Any] = field(default_factory=dict)
    sized: int = 0

    def env(self, backend: str, **how: Any) -> ScmWorldEnv:
        """Make the environment, and begin."""
        env = ScmWorldEnv(self.task, task_options=self.options, backend=backend, **how)
        env.reset(seed=SEED)
        return env

    def steps(self, most: int) -> int:
        """Give the length of a run: shorter with very many blocks."""
        return most if self.blocks <= 10 else max(5, most // 10)


def tower(*number: int) -> Case:
    """Give a tower of some blocks along x, y and z; they begin beside one another."""
    dims = tuple(EDGE * count for count in number)
    options = {"number_of_blocks_in_tower": number, "tower_dims": dims}
    blocks = int(np.prod(number))
    return Case(f"towers, {blocks}", blocks, "towers", options)


PUSHING = Case("pushing", 1, "pushing")
GENERAL = Case("general", 5, "general")
TOWER = tower(1, 1, 5)
WALL = Case("stacked_blocks, 35", 35, "stacked_blocks", sized=-1)
GROWING = (tower(1, 1, 1), tower(1, 1, 2), TOWER, tower(1, 2, 5), WALL)
"""Cubes of 3.5 cm that begin on the floor; a tower cannot have 35 of them, a wall can."""
CASES = (PUSHING, GENERAL, *GROWING)


def cases(settings: Settings) -> tuple[Case, ...]:
    """Give the scenes to time."""
    return (PUSHING, GROWING[1]) if settings.quick else CASES


def actions(steps: int, worlds: int | None = None) -> NDArray[np.float32]:
    """Draw actions over their full range, shape (steps, [worlds,] 9)."""
    shape = (steps, 9) if worlds is None else (steps, worlds, 9)
    return np.random.default_rng(SEED).uniform(-1.0, 1.0, shape).astype(np.float32)


def bare(env: ScmWorldEnv) -> Callable[[NDArray[np.float64]], None]:
    """Give the engine's own step of the scene of an environment: a command, and nothing else."""
    world = env.world
    substeps, engine = world.substeps, world.backend
    return lambda command: engine.step(command, substeps)


def commands(env: ScmWorldEnv, given: NDArray[np.float32]) -> list[NDArray[np.float64]]:
    """Turn actions into what the engine takes, each shape (9,)."""
    return [np.array(env.actions.command(action)) for action in given]
