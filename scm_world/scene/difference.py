"""The smallest set of changes that turns one scene into another."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from scm_world.scene.scene import Parameters, Scene, Structure
from scm_world.scene.state import PhysicalState


@final
@dataclass(frozen=True)
class Difference:
    """What an engine has to change.

    Attributes:
        structure: The new structure, or None where it stays.
        parameters: Only the parameters that change.
        state: The complete new state, or None where nothing is moved.
    """

    structure: Structure | None = None
    parameters: Parameters = field(default_factory=dict)
    state: PhysicalState | None = None

    def __bool__(self) -> bool:
        return self.structure is not None or bool(self.parameters) or self.state is not None


def diff(now: Scene, then: Scene) -> Difference:
    """Compare two scenes.

    Goals are not compared: no engine knows them. Joint torques are not compared: they cannot be
    set.

    Example:
        >>> from scm_world.scene import Structure, default_scene, diff
        >>> scene = default_scene(Structure(blocks=("tool_block",)))
        >>> heavy = {**scene.parameters, ("tool_block", "mass"): np.array(0.05)}
        >>> diff(scene, scene.with_(parameters=heavy)).parameters
        {('tool_block', 'mass'): array(0.05)}
        >>> bool(diff(scene, scene))
        False
    """
    if now.structure != then.structure:
        return Difference(then.structure, dict(then.parameters), then.state)
    changed = {
        key: value
        for key, value in then.parameters.items()
        if value is not now.parameters[key] and not np.array_equal(value, now.parameters[key])
    }
    same = np.array_equal(now.state.settable(), then.state.settable())
    return Difference(None, changed, None if same else then.state)
