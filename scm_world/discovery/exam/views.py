"""How a task is looked at in an exam: what varies, what is measured, and what follows from what."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, final

import networkx as nx

from scm_world.queries.samples import STEPS
from scm_world.variables import Box, Draw

VIEWS = ("outcome", "step")
SENSED = 0.005  # noise of the sensors, as a fraction of half a range
HALF = 0.045  # [m] half the side of the square in which a block begins


@final
@dataclass(frozen=True)
class TaskView:
    """How a task is looked at.

    Attributes:
        view: ``"outcome"``: one row per episode: what it begins with, and what it ends with.
            ``"step"``: one row per control step.
        causes: Patterns of what varies, as far as it has a space A; the physical parameters if
            None, and in the view of outcomes where the blocks begin.
        outcomes: Names of variables; the states of joints and blocks, and success, if None.
        policy: Who acts, as ``rollout`` takes it; ``"usual"`` is ``"sweep"`` in the view of
            outcomes, and ``"random"`` by step, so that actions follow from nothing.
        steps: Control steps of an episode.
        sensor_noise: Standard deviation, as a fraction of half the range of what is measured.
        options: Of the world: backend, preset.
        arguments: Of the task.
    """

    view: str = "outcome"
    causes: tuple[str, ...] | None = None
    outcomes: tuple[str, ...] | None = None
    policy: str | None = "usual"
    steps: int = STEPS
    sensor_noise: float = SENSED
    options: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)

    @property
    def acts(self) -> str | None:
        """Who acts."""
        usual = {"outcome": "sweep", "step": "random"}
        return usual[self.view] if self.policy == "usual" else self.policy


def projected(graph: nx.DiGraph, kept: Collection[str]) -> list[tuple[str, str]]:
    """Leave out nodes that follow from others without noise: their causes act in their place."""
    found = set()
    for cause in kept:
        ahead = [cause] if cause in graph else []
        while ahead:
            for effect in graph.successors(ahead.pop()):
                if effect in kept:
                    found.add((cause, effect))
                else:
                    ahead.append(effect)
    return sorted(found)


def place(height: Any, number: int, count: int) -> Draw:
    """Draw where one of several blocks begins: near the middle, at least as high as it has to be.

    Args:
        height: Of its center, as its space A says.
        number: Of the block.
        count: Of the blocks.
    """
    far = 0.0 if count == 1 else 0.075
    angle = 2.0 * math.pi * number / count
    x, y = far * math.cos(angle), far * math.sin(angle)
    half = HALF if count == 1 else 0.2 * HALF
    return Draw(Box((x - half, y - half, height), (x + half, y + half, height)))
