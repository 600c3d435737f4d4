"""What a scene and a world of the robot have, where only the general types are known."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from scm_world.models.scene import Scene
    from scm_world.tasks.base import Simulation
    from scm_world.tasks.trifinger.entities.block_world import BlockWorld
    from scm_world.tasks.trifinger.system import PhysicalState, TriFinger


def of_robot(scene: Scene) -> tuple[TriFinger, PhysicalState]:
    """Return the structure and the state of a scene with the robot."""
    return cast("TriFinger", scene.structure), cast("PhysicalState", scene.state)


def parts_of(world: Simulation) -> BlockWorld:
    """Return the composition of a world with the robot: it lists blocks and obstacles."""
    return cast("BlockWorld", world.composition)
