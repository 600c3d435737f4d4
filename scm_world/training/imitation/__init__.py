"""Imitation: a network learns to do what a teacher does."""

from scm_world.training.imitation.cloning import Cloned, clone
from scm_world.training.imitation.lessons import Lesson, lesson

__all__ = ["Cloned", "Lesson", "clone", "lesson"]
