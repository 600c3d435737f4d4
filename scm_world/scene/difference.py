"""The smallest set of changes that turns one scene into another."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from scm_world.scene.scene import Parameters, Scene, Structure, default_scene
from scm_world.scene.state import ROBOT_SIZE, PhysicalState


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
    same = now.state.coincides(then.state)
    return Difference(None, changed, None if same else then.state)


def complete(now: Scene, structure: Structure, difference: Difference) -> Difference:
    """Fill in what a change of structure leaves unsaid.

    Bodies that stay keep their parameters and their state, new ones get the defaults.

    Args:
        now: The scene before.
        structure: The structure after.
        difference: A change to that structure, with only some parameters, or without a state.

    Returns:
        The same change with all parameters and a state.
    """
    default = default_scene(structure)
    stays = {key: value for key, value in now.parameters.items() if key in default.parameters}
    state = difference.state
    if state is None:
        state = default.state
        state.vector[:ROBOT_SIZE] = now.state.vector[:ROBOT_SIZE]
        for index, name in enumerate(structure.blocks):
            if name in now.structure.blocks:
                state.blocks[index] = now.state.blocks[now.structure.blocks.index(name)]
    return Difference(structure, {**default.parameters, **stays, **difference.parameters}, state)
