"""The Gymnasium face: environments, and wrappers for them."""

import gymnasium

from scm_world.env.batched import ScmWorldVectorEnv
from scm_world.env.environment import ScmWorldEnv
from scm_world.env.observer import CONTEXTS, MODES, Observation
from scm_world.env.wrappers import DeltaAction, MovingAverageAction, ObjectSelector

IDS = {
    name: str(spec.kwargs["task"])
    for name, spec in gymnasium.registry.items()
    if spec.namespace == "scm_world"
}
"""The registered environments, each with its task."""

__all__ = [
    "CONTEXTS",
    "IDS",
    "MODES",
    "DeltaAction",
    "MovingAverageAction",
    "ObjectSelector",
    "Observation",
    "ScmWorldEnv",
    "ScmWorldVectorEnv",
]
