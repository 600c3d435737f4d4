"""A scripted policy that grasps blocks and brings them to their goals."""

from scm_world.queries.grasping.policy import Grasp, Pace

__all__ = ["Grasp", "Pace"]
