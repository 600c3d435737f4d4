"""Stacked blocks: build a wall."""

from __future__ import annotations

from typing import final

from scm_world.tasks.trifinger.walls import Walls


@final
class StackedBlocks(Walls):
    """A wall, regular or random; each block has its place in it.

    The arguments, and all variables, are those of ``Walls``. Draw ``wall_noise`` for another
    random wall.

    Reward terms:
        fractional_success: How much of the wall the blocks fill.
    """

    name = "stacked_blocks"
