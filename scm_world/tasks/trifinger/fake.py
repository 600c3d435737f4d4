"""What moves without physics: joints jump to their commands, and blocks keep their velocity."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scm_world._types import Floats
from scm_world.models import Parameters
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.state import PhysicalState

if TYPE_CHECKING:
    from scm_world.tasks.trifinger.system import TriFinger


def move(structure: TriFinger, state: PhysicalState, command: Floats, seconds: float) -> None:
    """Let blocks drift; let joints jump, or stay where torques are commanded."""
    if not structure.torques:
        state.joint_positions[:] = command
        state.joint_torques[:] = 0.0
    else:
        state.joint_torques[:] = command
    state.positions[:] += seconds * state.linear_velocities


def settle(state: PhysicalState) -> None:
    """Turn quaternions so that w is not negative."""
    state.orientations[state.orientations[:, 3] < 0.0] *= -1.0


def inertia(structure: TriFinger, parameters: Parameters, body: str) -> Floats:
    """Compute the principal moments of inertia of a block or a link, shape (3,) [kg m²]."""
    mass = parameters[body, "mass"]
    if body in hardware.LINK_NAMES:
        index = hardware.LINK_NAMES.index(body) % hardware.LINKS_PER_FINGER
        return np.asarray(mass * np.array(hardware.INERTIAL[index].per_mass))
    hull = dict(structure.hulls).get(body)
    if hull is not None:
        return np.asarray(mass * np.array(hull.moments))
    squares = parameters[body, "size"] ** 2
    return np.asarray(mass / 12.0 * (squares.sum() - squares))
