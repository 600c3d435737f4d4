"""What the goal families have in common whose blocks follow from a few numbers."""

from __future__ import annotations

from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.blocks import ToolBlock, block_mass
from scm_world.tasks.trifinger.entities.goals import GoalBlock, goal_orientation, goal_position
from scm_world.tasks.trifinger.shapes import block_spaces
from scm_world.variables import Derived, Exogenous, Function

MASS = "blocks_mass"

MOST_PARTS = 512
"""Of how many parts block and goal are kept for when they come again: they are immutable, and most
structures of a family have them."""

Mechanism = tuple[tuple[str, ...], Function]
"""Parents, and the function of them."""


def blocks_mass(default: float) -> Exogenous:
    """Declare the mass that all blocks share.

    Args:
        default: Without an intervention [kg].
    """
    return Exogenous(
        name=MASS,
        unit="kg",
        bounds=numbers.BLOCK_MASS_BOUNDS,
        a=numbers.BLOCKS_MASS_A,
        b=numbers.BLOCKS_MASS_B,
        default=default,
        doc="Mass of every block, unless a block is given another one.",
    )


def part_size(name: str, size: Mechanism) -> Derived:
    """Declare the edge lengths of a block that is a part of something [m].

    Args:
        name: Of the block or goal.
        size: Where they come from.
    """
    parents, function = size
    return Derived(
        name=f"{name}.size",
        unit="m",
        shape=(3,),
        bounds=numbers.PART_SIZE_BOUNDS,
        parents=parents,
        mechanism=function,
        doc="Full edge lengths.",
    )


def part_tool(name: str, *, size: Mechanism, spawn: Mechanism, airborne: bool) -> ToolBlock:
    """Describe a block that is a part of something.

    Args:
        name: Of the block.
        size: Where its edge lengths come from.
        spawn: Where it begins: further causes than its size and orientation, and the function of
            all of them. When one of them changes, the block is put there again.
        airborne: Whether its spaces reach into the air, as in the predecessor.
    """
    causes, start = spawn
    a, b = block_spaces(f"{name}.size", airborne=airborne)
    return ToolBlock(
        name,
        size=part_size(name, size),
        mass=block_mass(f"{name}.mass", MASS),
        spawn=start,
        spawn_from=causes,
        spawn_again=True,
        a=a,
        b=b,
    )


def part_goal(
    name: str, *, size: Mechanism, position: Mechanism, orientation: Mechanism | None = None
) -> GoalBlock:
    """Describe the goal of a block that is a part of something. It has no spaces of its own.

    Args:
        name: Of the goal.
        size: Where its edge lengths come from.
        position: Where its center comes from.
        orientation: Where its quaternion comes from; it is upright if None.
    """
    turned = orientation or ((), None)
    pose = (
        goal_position(name, parents=position[0], mechanism=position[1]),
        goal_orientation(name, parents=turned[0], mechanism=turned[1]),
    )
    return GoalBlock(name, size=part_size(name, size), pose=pose, yaw=False)
