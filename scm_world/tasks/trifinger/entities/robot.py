"""The robot, as variables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, final

import numpy as np
from numba import njit

from scm_world._types import Floats, Value, Values
from scm_world.geometry.scalars import scalar
from scm_world.graph import NoiseKey
from scm_world.models import ParameterKey
from scm_world.tasks.composition import Commands, Entity, StateDeclaration
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.blocks import color
from scm_world.tasks.trifinger.hardware import (
    FINGERS,
    N_JOINTS,
    QUANTITIES,
    RESOLUTIONS,
    ControllerSpec,
    JointGroup,
    joints_of,
)
from scm_world.tasks.trifinger.kinematics import forward_kernel, inverse_kernel, tip_kernel
from scm_world.variables import (
    Action,
    Box,
    Function,
    Measured,
    Normal,
    Variable,
    bundle,
)
from scm_world.variables.reserved import ACTUATOR_NOISE

END_EFFECTORS = Box((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3)  # [m] what an action may ask for

ACTIONS = {
    "joint_positions": ("rad", Box(hardware.JOINT_LOW, hardware.JOINT_HIGH)),
    "joint_torques": ("N m", Box(-0.36, 0.36)),
    "end_effector_positions": ("m", END_EFFECTORS),
}
"""Unit and range of each way to command the robot."""


_SPEC = ControllerSpec()

CONTROLLER = (
    numbers.POSITION_GAINS.root(
        "position_gains", _SPEC.kp, "Proportional gain of the three joints of a finger."
    ),
    numbers.VELOCITY_GAINS.root(
        "velocity_gains", _SPEC.kd, "Derivative gain of the three joints of a finger."
    ),
    numbers.SAFETY_DAMPING.root(
        "safety_damping",
        _SPEC.safety,
        "Damping of the safety filter, for the three joints of a finger.",
    ),
    numbers.TORQUE.root(
        "torque_limit",
        _SPEC.limit,
        "Largest torque of a joint. Torques that are commanded end at 0.36 N m for any value.",
    ),
)
"""The joint controller."""
SERVO = ("position_gains", "velocity_gains")
"""Those of it that have no effect where torques are commanded."""


@njit(cache=True)
def tips(joint_positions: Floats, robot_height: Value) -> Floats:
    """Compute the three fingertips from the joints, shape (9,) [m]."""
    found = np.empty(9)
    forward_kernel(joint_positions, scalar(robot_height), found)
    return found


@njit(cache=True)
def finger_tip(joint_positions: Floats, robot_height: Value, finger: float) -> Floats:
    """Compute the tip of one finger from its three joints, shape (3,) [m]."""
    found = np.empty(3)
    q0, q1, q2 = joint_positions[0], joint_positions[1], joint_positions[2]
    tip_kernel(int(finger), q0, q1, q2, scalar(robot_height), found, 0)
    return found


@njit(cache=True)
def joints_tip(q0: Value, q1: Value, q2: Value, robot_height: Value, finger: float) -> Floats:
    """Compute the tip of one finger from the angle of each joint, shape (3,) [m]."""
    found = np.empty(3)
    height = scalar(robot_height)
    tip_kernel(int(finger), scalar(q0), scalar(q1), scalar(q2), height, found, 0)
    return found


STREAM = "actuators"
"""The stream of the noise; draws of the variable that scales it have another one."""


@final
class RobotCommands(Commands):
    """Joint positions for fingertips, and the noise of the actuators.

    Args:
        action_mode: One of ``ACTIONS``.
    """

    def __init__(self, action_mode: str) -> None:
        self._by_tips = action_mode == "end_effector_positions"
        low, high = ACTIONS[action_mode][1].bounds((N_JOINTS,), {})
        self._half = (high - low) / 2.0
        self._joints, self._reached = np.empty(N_JOINTS), np.empty(3, dtype=np.bool_)

    def applies(self, values: Values) -> bool:
        """Tell whether fingertips are commanded, or the actuators have noise."""
        return self._by_tips or bool(values[ACTUATOR_NOISE] > 0.0)

    def command(self, action: Floats, values: Values, vector: Floats, key: NoiseKey) -> Floats:
        """Add the noise, then find the joint positions of fingertips, shape (9,)."""
        noise = float(values[ACTUATOR_NOISE])
        if noise > 0.0:
            drawn = key.draw(Normal(), STREAM, (N_JOINTS,), {})
            action = action + noise * self._half * drawn
        if self._by_tips:
            height = float(values["robot_height"])
            inverse_kernel(action, height, vector[:N_JOINTS], self._joints, self._reached)
            action = self._joints
        return action


@final
class Robot(Entity):
    """Three fingers with three joints each.

    Args:
        action_mode: One of ``ACTIONS``.
        start: Joint positions at the start, shape (9,) [rad].
        resolution: One of ``RESOLUTIONS``. What is finer than ``"vector"`` is put together again
            in bundles under the names of the whole robot.
    """

    name = "robot"

    def __init__(
        self,
        action_mode: str,
        start: tuple[float, ...] = hardware.REST,
        resolution: str = RESOLUTIONS[0],
    ) -> None:
        self.action_mode = action_mode
        self._start = start
        self._by_tips = action_mode == "end_effector_positions"
        self._joints = joints_of(resolution)
        by_joint = resolution == "joint"
        # A tip is a point: its three coordinates are those of no single joint.
        self._acting = joints_of("finger") if by_joint and self._by_tips else self._joints

    def variables(self) -> Iterable[Variable]:
        """Declare the action, the height, the links and the fingertips."""
        yield from self._actions()
        yield numbers.ROBOT_HEIGHT.root(
            "robot_height",
            hardware.NOMINAL_HEIGHT,
            "Height of the robot's base above a plane 0.011 m below the table top.",
        )
        for finger in FINGERS:
            yield from self._links(finger)
        yield from self._hidden()
        yield from self._tips()
        if len(self._joints) > 1:
            yield from self._bundles()

    def _actions(self) -> Iterable[Variable]:
        unit, bounds = ACTIONS[self.action_mode]
        actions = [
            Action(
                name=joints.action,
                unit=unit,
                shape=joints.shape,
                bounds=joints.cut(bounds),
                doc=f"What the policy commands of {joints.of}: {self.action_mode}.",
            )
            for joints in self._acting
        ]
        yield from actions
        if len(actions) > 1:
            yield bundle("action", actions, bounds=bounds, doc="What the policy commands.")

    def _bundles(self) -> Iterable[Variable]:
        """Put together what moves, under the names of the whole robot."""
        parts = [list(self._quantities(joints)) for joints in self._joints]
        for index, whole in enumerate(Robot(self.action_mode, self._start).states()):
            states = [quantities[index].declare((), {}) for quantities in parts]
            fields = {"bounds": whole.bounds, "a": whole.a, "b": whole.b, "doc": whole.doc}
            yield bundle(whole.name, states, **fields)

    def _tips(self) -> Iterable[Variable]:
        """Declare the fingertips, and the three of them together."""
        name, doc = "end_effector_positions", "The three fingertips."
        fields: dict[str, Any] = {"unit": "m", "bounds": Box(-1.0, 1.0)}
        if len(self._joints) == 1:
            parents = ("joint_positions", "robot_height")
            yield Measured(
                name=name, shape=(9,), parents=parents, mechanism=tips, doc=doc, **fields
            )
            return
        found = []
        for index, finger in enumerate(FINGERS):
            angles = [joints.names[0] for joints in self._joints if finger in joints.fingers]
            function = finger_tip if len(angles) == 1 else joints_tip
            found.append(
                Measured(
                    name=f"finger_{finger}.end_effector_position",
                    shape=(3,),
                    parents=(*angles, "robot_height"),
                    mechanism=Function(function, constants={"finger": float(index)}),
                    doc=f"The tip of finger {finger}.",
                    **fields,
                )
            )
        yield from found
        yield bundle(name, found, doc=doc, **fields)

    def _links(self, finger: str) -> Iterable[Variable]:
        for index, mass in enumerate(hardware.LINK_MASS):
            link = hardware.link_name(finger, index)
            still = " It is fixed to the base, so nothing depends on it." if index == 0 else ""
            yield numbers.LINK_MASSES.root(
                f"{link}.mass", mass, f"Mass of the link; its inertia scales with it.{still}"
            )
            yield color(f"{link}.color", hardware.LINK_COLORS[finger])

    def _hidden(self) -> Iterable[Variable]:
        """Declare what the predecessor keeps to itself: friction, damping, control and noise."""
        yield numbers.FRICTION.root(
            "finger_friction",
            numbers.FINGER_FRICTION,
            "Friction of all links; a contact has the product of two frictions.",
        )
        yield numbers.JOINT_DAMPING.root("joint_damping", 0.0, "Passive damping of every joint.")
        yield from CONTROLLER
        yield numbers.NOISE.root(
            ACTUATOR_NOISE,
            0.0,
            "Standard deviation of a command, as a fraction of half the range of an action.",
        )

    def states(self) -> Iterable[StateDeclaration]:
        """Declare joint positions, velocities and the torques the engine reports."""
        of_each = [list(self._quantities(joints)) for joints in self._joints]
        yield from (states[index] for index in range(len(QUANTITIES)) for states in of_each)

    def _quantities(self, joints: JointGroup) -> Iterable[StateDeclaration]:
        """Declare what moves of some joints: position, velocity and torque."""
        start = self._start[joints.where]
        still = (0.0,) * len(start)
        position, velocity, torque = joints.names
        yield StateDeclaration(
            position,
            "rad",
            joints.shape,
            joints.cut(numbers.JOINT_BOUNDS),
            start if joints.shape else start[0],
            f"Angles of the joints of {joints.of}." if joints.shape else f"Angle of {joints.of}.",
            a=joints.cut(numbers.JOINTS_A),
            b=joints.cut(numbers.JOINTS_B),
        )
        yield StateDeclaration(
            velocity,
            "rad/s",
            joints.shape,
            numbers.JOINT_VELOCITY_BOUNDS,
            still if joints.shape else 0.0,
            "Angular velocities of the joints.",
        )
        yield StateDeclaration(
            torque,
            "N m",
            joints.shape,
            Box(-1.0, 1.0),
            still if joints.shape else 0.0,
            "Torques of the last physics step.",
            settable=False,
        )

    def actions(self) -> Mapping[str, tuple[str, ...]]:
        """Map actions to the joints of their fingers, and the rest of ``RobotCommands`` to all."""
        every = [name for joints in self._joints for name in joints.names]
        found = {
            joints.action: tuple(
                name
                for other in self._joints
                if not set(other.fingers).isdisjoint(joints.fingers)
                for name in other.names
            )
            for joints in self._acting
        }
        others = ("robot_height", ACTUATOR_NOISE) if self._by_tips else (ACTUATOR_NOISE,)
        return found | dict.fromkeys(others, tuple(every))

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        links = {
            f"{link}.{quantity}": (link, quantity)
            for link in hardware.LINK_NAMES
            for quantity in ("mass", "color")
        }
        control = {
            variable.name: ("controller", variable.name)
            for variable in CONTROLLER
            if self.action_mode != "joint_torques" or variable.name not in SERVO
        }
        own = {
            "robot_height": ("robot", "height"),
            "finger_friction": ("robot", "friction"),
            "joint_damping": ("robot", "joint_damping"),
        }
        return {**own, **control, **links}

    def commands(self) -> Commands:
        """Give what turns actions into joint positions or torques."""
        return RobotCommands(self.action_mode)
