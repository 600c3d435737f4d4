"""What a variable means physically: robot, stage, blocks, obstacles and goals."""

from scm_world.entities.base import PRESET_NAMES, BlockWorld, Commands, Composition, Entity, State
from scm_world.entities.blocks import ToolBlock, block_mass, block_size
from scm_world.entities.goals import GoalBlock, GoalSphere, goal_orientation, goal_position
from scm_world.entities.looks import Looks
from scm_world.entities.obstacles import Obstacle
from scm_world.entities.robot import ACTIONS, ACTUATOR_NOISE, RESOLUTIONS, Robot
from scm_world.entities.stage import CONTROL_INDEX, SENSOR_NOISE, Clock, Stage

__all__ = [
    "ACTIONS",
    "ACTUATOR_NOISE",
    "CONTROL_INDEX",
    "PRESET_NAMES",
    "RESOLUTIONS",
    "SENSOR_NOISE",
    "BlockWorld",
    "Clock",
    "Commands",
    "Composition",
    "Entity",
    "GoalBlock",
    "GoalSphere",
    "Looks",
    "Obstacle",
    "Robot",
    "Stage",
    "State",
    "ToolBlock",
    "block_mass",
    "block_size",
    "goal_orientation",
    "goal_position",
]
