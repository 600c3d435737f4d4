"""What a variable means physically: robot, stage, blocks and goals."""

from scm_world.entities.base import Composition, Entity, State
from scm_world.entities.blocks import ToolBlock
from scm_world.entities.goals import GoalBlock, GoalSphere
from scm_world.entities.robot import ACTIONS, Robot
from scm_world.entities.stage import CONTROL_INDEX, Clock, Stage

__all__ = [
    "ACTIONS",
    "CONTROL_INDEX",
    "Clock",
    "Composition",
    "Entity",
    "GoalBlock",
    "GoalSphere",
    "Robot",
    "Stage",
    "State",
    "ToolBlock",
]
