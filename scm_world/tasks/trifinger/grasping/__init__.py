"""A scripted policy that grasps blocks and brings them to their goals."""

from scm_world.tasks.trifinger.grasping.policy import Grasp, Pace

__all__ = ["Grasp", "Pace"]
