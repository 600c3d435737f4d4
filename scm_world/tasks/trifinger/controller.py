"""The joint controller and how finely time is cut, specified once for every engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.models.scene import ControlMode

TIMESTEP = 0.004  # [s] the unit in which ``frame_skip`` counts, whatever the preset


@dataclass(frozen=True)
class ControllerSpec:
    """A proportional-derivative law with a safety filter, evaluated at every physics step.

    In ``joint_positions`` mode, with target q*, position q and velocity v of a joint::

        tau = clip(clip(kp (q* - q) - kd v, ±limit) - safety v, ±limit)

    In ``joint_torques`` mode the inner clip is applied to the commanded torque instead.

    Attributes:
        kp: Position gain of the three joints of a finger [N m/rad].
        kd: Velocity gain [N m s/rad].
        safety: Damping of the safety filter [N m s/rad].
        limit: Largest torque [N m].

    Source:
        CausalWorld 1.2, ``envs/robot/trifinger.py`` (the law in force there).
    """

    kp: tuple[float, float, float] = (10.0, 10.0, 10.0)
    kd: tuple[float, float, float] = (0.1, 0.3, 0.001)
    safety: tuple[float, float, float] = (0.08, 0.08, 0.04)
    limit: float = 0.36

    def torques(
        self, mode: ControlMode, command: Floats, positions: Floats, velocities: Floats
    ) -> Floats:
        """Evaluate the law.

        Args:
            mode: What ``command`` means.
            command: Shape (9,) [rad] or [N m].
            positions: Joint positions, shape (9,) [rad].
            velocities: Joint velocities, shape (9,) [rad/s].

        Returns:
            Joint torques, shape (9,) [N m].
        """
        wanted = command
        if mode is ControlMode.JOINT_POSITIONS:
            gain, damping = np.tile(self.kp, 3), np.tile(self.kd, 3)
            wanted = gain * (command - positions) - damping * velocities
        inner = np.clip(wanted, -self.limit, self.limit)
        damped = inner - np.tile(self.safety, 3) * velocities
        safe: Floats = np.clip(damped, -self.limit, self.limit)
        return safe


@dataclass(frozen=True)
class Preset:
    """Numerical settings that every engine understands in its own way.

    Attributes:
        name: ``"fast"`` or ``"precise"``.
        timestep: Physics step [s].
    """

    name: str
    timestep: float


FAST = Preset("fast", 0.004)
PRECISE = Preset("precise", 0.002)

PRESETS = {preset.name: preset for preset in (FAST, PRECISE)}

PRESET_NAMES = tuple(PRESETS)
"""What the categories of ``timestep_preset`` stand for."""


def preset(name: str) -> Preset:
    """Look a preset up by its name.

    Raises:
        UnknownOption: There is no such preset.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise UnknownOption("preset", name, PRESETS) from None
