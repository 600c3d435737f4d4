"""Which experiments to do, and how few can do."""

from scm_world.discovery.design import bounds
from scm_world.discovery.design.moving import (
    bisect,
    coloring,
    culprit,
    culprits,
    pooled,
    pooled_experiments,
)
from scm_world.discovery.design.plan import Design
from scm_world.discovery.design.search import (
    Answer,
    Search,
    adaptive_search,
    answer_from_dag,
    answer_from_model,
    is_verified_by,
    verifying_set,
)
from scm_world.discovery.design.separating import separates, separating_system

__all__ = [
    "Answer",
    "Design",
    "Search",
    "adaptive_search",
    "answer_from_dag",
    "answer_from_model",
    "bisect",
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
