"""Planning: a policy that tries actions out in copies of the world before it acts."""

from scm_world.policies.planning.model import PlanningModel, Score, nearness
from scm_world.policies.planning.policy import CrossEntropy, Search, action_range

__all__ = ["CrossEntropy", "PlanningModel", "Score", "Search", "action_range", "nearness"]
