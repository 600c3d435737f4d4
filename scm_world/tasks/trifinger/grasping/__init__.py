"""Scripted policies that grasp blocks and bring them to their goals."""

from scm_world.tasks.trifinger.grasping.feedback import Feedback
from scm_world.tasks.trifinger.grasping.policy import Grasp, Pace

__all__ = ["Feedback", "Grasp", "Pace"]
