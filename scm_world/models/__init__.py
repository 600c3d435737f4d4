"""A backend-free description of any system: what moves, what can be set, what can be commanded."""

from scm_world.models.model import Model, ModelRow, Parameter, Readout
from scm_world.models.scene import (
    Difference,
    GoalRegion,
    Light,
    ParameterKey,
    Parameters,
    Scene,
    State,
    Structure,
)

__all__ = [
    "Difference",
    "GoalRegion",
    "Light",
    "Model",
    "ModelRow",
    "Parameter",
    "ParameterKey",
    "Parameters",
    "Readout",
    "Scene",
    "State",
    "Structure",
]
