"""Learners of causal graphs."""

from scm_world.discovery.learners.found import Found
from scm_world.discovery.learners.registry import Learner, learn, learner, learners, register

__all__ = ["Found", "Learner", "learn", "learner", "learners", "register"]
