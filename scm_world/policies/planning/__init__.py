"""Planning: a policy that tries actions out in copies of the world before it acts."""

from scm_world.policies.planning.model import Model
from scm_world.policies.planning.policy import CrossEntropy
from scm_world.policies.planning.scores import Score, nearness
from scm_world.policies.planning.search import Search

__all__ = ["CrossEntropy", "Model", "Score", "Search", "nearness"]
