"""Learners of causal graphs."""

from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.discovery.learners.registry import (
    Learner,
    baselines,
    learn,
    learner,
    learners,
    register,
)

__all__ = ["EstimatedGraph", "Learner", "baselines", "learn", "learner", "learners", "register"]
