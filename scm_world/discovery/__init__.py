"""Finding causal graphs from interventional experiments, and scoring what was found."""

from scm_world.discovery.report import DiscoveryReport
from scm_world.discovery.run import discover
from scm_world.discovery.scores import Score, score

__all__ = ["DiscoveryReport", "Score", "discover", "score"]
