"""Which experiments to do, and how few can do."""

from scm_world.discovery.design import bounds
from scm_world.discovery.design.plans import (
    AdaptiveSearch,
    ExperimentPlan,
    adaptive_search,
    answer_from_dag,
    coloring,
    culprit,
    culprits,
    is_verified_by,
    pooled,
    pooled_experiments,
    separates,
    separating_system,
    verifying_set,
)

__all__ = [
    "AdaptiveSearch",
    "ExperimentPlan",
    "adaptive_search",
    "answer_from_dag",
    "bounds",
    "coloring",
    "culprit",
    "culprits",
    "is_verified_by",
    "pooled",
    "pooled_experiments",
    "separates",
    "separating_system",
    "verifying_set",
]
