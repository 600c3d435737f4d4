"""An engine-free description of the world: what stands in it, where, and what it is made of."""

from scm_world.models.scene import (
    ControlMode,
    Difference,
    Goal,
    Light,
    ParameterKey,
    Parameters,
    Scene,
    diff,
)
from scm_world.scene.controller import TIMESTEP, ControllerSpec
from scm_world.scene.presets import FAST, PRECISE, PRESETS, Preset, preset
from scm_world.scene.scene import (
    Structure,
    controller_spec,
    default_parameters,
    default_scene,
    parameter_keys,
)
from scm_world.scene.state import PhysicalState

__all__ = [
    "FAST",
    "PRECISE",
    "PRESETS",
    "TIMESTEP",
    "ControlMode",
    "ControllerSpec",
    "Difference",
    "Goal",
    "Light",
    "ParameterKey",
    "Parameters",
    "PhysicalState",
    "Preset",
    "Scene",
    "Structure",
    "controller_spec",
    "default_parameters",
    "default_scene",
    "diff",
    "parameter_keys",
    "preset",
]
