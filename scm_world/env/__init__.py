"""The Gymnasium face: one environment, or many."""

import gymnasium

from scm_world._types import Observation
from scm_world.backends.checkable import Checkable
from scm_world.env.batch import ScmWorldVectorEnv
from scm_world.env.checks import Check, check
from scm_world.env.environment import ENV_OPTIONS, ScmWorldEnv
from scm_world.env.models import MODEL_ID, make_env, vector_env
from scm_world.env.observer import MODES
from scm_world.policies.cards import CONTEXTS

IDS = {
    name: str(spec.kwargs["task"])
    for name, spec in gymnasium.registry.items()
    if spec.namespace == "scm_world" and spec.kwargs.get("task")
}
"""The registered environments of tasks, each with its task."""

__all__ = [
    "CONTEXTS",
    "ENV_OPTIONS",
    "IDS",
    "MODEL_ID",
    "MODES",
    "Check",
    "Checkable",
    "Observation",
    "ScmWorldEnv",
    "ScmWorldVectorEnv",
    "check",
    "make_env",
    "vector_env",
]
