"""Where the parameters of the joint controller live.

The first nine actuators are servos, the other nine the dampers of the safety filter. What a servo
does depends on the control mode, so its gains rest in numbers that MuJoCo does not use, and
``steer`` copies them from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.slots import Slot
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.tasks.trifinger.hardware import FINGERS, N_JOINTS

_POSITION, _VELOCITY = 1, 2  # where gains rest among the parameters of a gain that is fixed


@final
@dataclass(frozen=True)
class _Gains(Slot):
    """A number for each joint of a finger, shape (3,); all fingers have the same."""

    places: Floats
    factor: float = 1.0

    def write(self, value: Floats) -> None:
        self.places[:] = np.tile(self.factor * value, len(FINGERS))

    def read(self) -> Floats:
        return self.factor * self.places[: N_JOINTS // len(FINGERS)]


@final
@dataclass(frozen=True)
class _Limit(Slot):
    """Largest torque [N m], of each servo and of the sum."""

    ranges: tuple[Floats, ...]

    def write(self, value: Floats) -> None:
        for range_ in self.ranges:
            range_[:, 0], range_[:, 1] = -value, value

    def read(self) -> Floats:
        return np.array(self.ranges[0][0, 1])


def controller_slots(model: mujoco.MjModel) -> dict[ParameterKey, Slot]:
    """Find the places of the controller's parameters."""
    rest = model.actuator_gainprm[:N_JOINTS]
    damping = model.actuator_biasprm[N_JOINTS:, 2]
    ranges = model.actuator_forcerange[:N_JOINTS], model.jnt_actfrcrange[:N_JOINTS]
    return {
        ("controller", "position_gains"): _Gains(rest[:, _POSITION]),
        ("controller", "velocity_gains"): _Gains(rest[:, _VELOCITY]),
        ("controller", "safety_damping"): _Gains(damping, factor=-1.0),
        ("controller", "torque_limit"): _Limit(ranges),
    }


def steer(gains: Floats, biases: Floats, mode: ControlMode) -> None:
    """Make the nine servos follow positions, or pass torques on.

    Args:
        gains: ``actuator_gainprm``, shape (18, 10).
        biases: ``actuator_biasprm``, shape (18, 10).
        mode: What the command means.
    """
    gain, bias = gains[:N_JOINTS], biases[:N_JOINTS]
    if mode is ControlMode.JOINT_POSITIONS:
        gain[:, 0] = gain[:, _POSITION]
        np.negative(gain[:, _POSITION : _VELOCITY + 1], out=bias[:, 1:3])
    else:
        gain[:, 0], bias[:, 1:3] = 1.0, 0.0
