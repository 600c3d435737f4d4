"""A scripted policy that grasps blocks and brings them to their goals, by feedback."""

from scm_world.tasks.trifinger.grasping.feedback import Feedback

__all__ = ["Feedback"]
