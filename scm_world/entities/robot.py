"""The robot, as variables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, final

import numpy as np
from numba import njit

from scm_world._types import Floats, Value, Values
from scm_world.entities.base import Commands, Entity, State
from scm_world.entities.blocks import color
from scm_world.geometry.scalars import scalar
from scm_world.graph import Moment
from scm_world.scene import ControllerSpec, ParameterKey, trifinger
from scm_world.scene.kinematics import forward_kernel, inverse_kernel
from scm_world.scene.trifinger import N_JOINTS
from scm_world.variables import Action, Box, Exogenous, Measured, Normal, Variable
from scm_world.variables import catalogue as numbers

END_EFFECTORS = Box((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3)  # [m] what an action may ask for

ACTIONS = {
    "joint_positions": ("rad", Box(trifinger.JOINT_LOW, trifinger.JOINT_HIGH)),
    "joint_torques": ("N m", Box(-0.36, 0.36)),
    "end_effector_positions": ("m", END_EFFECTORS),
}
"""Unit and range of each way to command the robot."""


_SPEC = ControllerSpec()

CONTROLLER = (
    (
        "position_gains",
        "N m/rad",
        numbers.POSITION_GAIN_BOUNDS,
        (numbers.POSITION_GAINS_A, numbers.POSITION_GAINS_B),
        _SPEC.kp,
        "Proportional gain of the three joints of a finger.",
    ),
    (
        "velocity_gains",
        "N m s/rad",
        numbers.DAMPING_BOUNDS,
        (numbers.VELOCITY_GAINS_A, numbers.VELOCITY_GAINS_B),
        _SPEC.kd,
        "Derivative gain of the three joints of a finger.",
    ),
    (
        "safety_damping",
        "N m s/rad",
        numbers.DAMPING_BOUNDS,
        (numbers.SAFETY_DAMPING_A, numbers.SAFETY_DAMPING_B),
        _SPEC.safety,
        "Damping of the safety filter, for the three joints of a finger.",
    ),
    (
        "torque_limit",
        "N m",
        numbers.TORQUE_BOUNDS,
        (numbers.TORQUE_A, numbers.TORQUE_B),
        _SPEC.limit,
        "Largest torque of a joint. Torques that are commanded end at 0.36 N m whatever it is.",
    ),
)
"""The joint controller: name, unit, bounds, spaces A and B, default, sentence."""

ACTUATOR_NOISE = "actuator_noise"


@njit(cache=True)
def tips_into(joint_positions: Floats, robot_height: Value, out: Floats) -> None:
    """Write the three fingertips, shape (9,) [m]."""
    forward_kernel(joint_positions, scalar(robot_height), out)


@njit(cache=True)
def tips(joint_positions: Floats, robot_height: Value) -> Floats:
    """Compute the three fingertips from the joints, shape (9,) [m]."""
    found = np.empty(9)
    tips_into(joint_positions, robot_height, found)
    return found


_tips: Any = tips
_tips.into = tips_into  # a loop that keeps the array calls this instead


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

    def told(self, action: Floats, values: Values, vector: Floats, moment: Moment) -> Floats:
        """Add the noise, then find the joint positions of fingertips, shape (9,)."""
        noise = float(values[ACTUATOR_NOISE])
        if noise > 0.0:
            drawn = moment.draw(Normal(), STREAM, (N_JOINTS,), {})
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
    """

    name = "robot"

    def __init__(self, action_mode: str, start: tuple[float, ...] = trifinger.REST) -> None:
        self.action_mode = action_mode
        self._start = start

    def variables(self) -> Iterable[Variable]:
        """Declare the action, the height, the links and the fingertips."""
        unit, bounds = ACTIONS[self.action_mode]
        yield Action(
            name="action",
            unit=unit,
            shape=(9,),
            bounds=bounds,
            doc=f"What the policy commands: {self.action_mode}.",
        )
        yield Exogenous(
            name="robot_height",
            unit="m",
            bounds=numbers.ROBOT_HEIGHT_BOUNDS,
            a=numbers.ROBOT_HEIGHT_A,
            b=numbers.ROBOT_HEIGHT_B,
            default=trifinger.NOMINAL_HEIGHT,
            doc="Height of the robot's base above a plane 0.011 m below the table top.",
        )
        for finger in trifinger.FINGERS:
            yield from self._links(finger)
        yield from self._hidden()
        yield Measured(
            name="end_effector_positions",
            unit="m",
            shape=(9,),
            bounds=Box(-1.0, 1.0),
            parents=("joint_positions", "robot_height"),
            mechanism=tips,
            doc="The three fingertips.",
        )

    def _links(self, finger: str) -> Iterable[Variable]:
        for index, mass in enumerate(trifinger.LINK_MASS):
            link = trifinger.link_name(finger, index)
            still = " It is fixed to the base, so nothing depends on it." if index == 0 else ""
            yield Exogenous(
                name=f"{link}.mass",
                unit="kg",
                bounds=numbers.LINK_MASS_BOUNDS,
                a=numbers.MASS_A,
                b=numbers.MASS_B,
                default=mass,
                doc=f"Mass of the link; its inertia scales with it.{still}",
            )
            yield color(f"{link}.color", trifinger.LINK_COLORS[finger])

    def _hidden(self) -> Iterable[Variable]:
        """Declare what the predecessor keeps to itself: friction, damping, control and noise."""
        yield Exogenous(
            name="finger_friction",
            bounds=numbers.FRICTION_BOUNDS,
            a=numbers.FRICTION_A,
            b=numbers.FRICTION_B,
            default=numbers.FINGER_FRICTION,
            doc="Friction of all links; a contact has the product of two frictions.",
        )
        yield Exogenous(
            name="joint_damping",
            unit="N m s/rad",
            bounds=numbers.DAMPING_BOUNDS,
            a=numbers.JOINT_DAMPING_A,
            b=numbers.JOINT_DAMPING_B,
            default=0.0,
            doc="Passive damping of every joint.",
        )
        for name, unit, bounds, (a, b), default, doc in CONTROLLER:
            shape = (3,) if isinstance(default, tuple) else ()
            yield Exogenous(
                name=name,
                unit=unit,
                shape=shape,
                bounds=bounds,
                a=a,
                b=b,
                default=default,
                doc=doc,
            )
        yield Exogenous(
            name=ACTUATOR_NOISE,
            bounds=numbers.NOISE_BOUNDS,
            a=numbers.NOISE_A,
            b=numbers.NOISE_B,
            default=0.0,
            doc="Standard deviation of a command, as a fraction of half the range of an action.",
        )

    def states(self) -> Iterable[State]:
        """Declare joint positions, velocities and the torques the engine reports."""
        moving = (n for n in self.inputs() if n not in ("robot_height", "finger_friction"))
        always = (*moving, "gravity", numbers.PRESET)
        yield State(
            "joint_positions",
            "rad",
            (9,),
            numbers.JOINT_BOUNDS,
            self._start,
            "Angles of the joints, finger by finger.",
            always=always,
            a=numbers.JOINTS_A,
            b=numbers.JOINTS_B,
        )
        yield State(
            "joint_velocities",
            "rad/s",
            (9,),
            numbers.JOINT_VELOCITY_BOUNDS,
            (0.0,) * 9,
            "Angular velocities of the joints.",
            always=always,
        )
        yield State(
            "joint_torques",
            "N m",
            (9,),
            Box(-1.0, 1.0),
            (0.0,) * 9,
            "Torques of the last physics step.",
            always=always,
            settable=False,
        )

    def inputs(self) -> Iterable[str]:
        """Everything but colors, the fixed finger bases and what is only read out."""
        yield from ("joint_positions", "joint_velocities", "action", "robot_height")
        yield from ("finger_friction", "joint_damping", "safety_damping", "torque_limit")
        if self.action_mode != "joint_torques":
            yield from ("position_gains", "velocity_gains")
        yield ACTUATOR_NOISE
        for finger in trifinger.FINGERS:
            yield from (f"{trifinger.link_name(finger, index)}.mass" for index in (1, 2, 3))

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        links = {
            f"{link}.{quantity}": (link, quantity)
            for link in trifinger.LINK_NAMES
            for quantity in ("mass", "color")
        }
        control = {name: ("controller", name) for name, *_ in CONTROLLER}
        own = {
            "robot_height": ("robot", "height"),
            "finger_friction": ("robot", "friction"),
            "joint_damping": ("robot", "joint_damping"),
        }
        return {**own, **control, **links}

    def commands(self) -> Commands:
        """Give what turns actions into joint positions or torques."""
        return RobotCommands(self.action_mode)

    def slices(self, block: int) -> Mapping[str, slice]:
        """Say where its states stand in the state vector."""
        return {
            "joint_positions": slice(0, 9),
            "joint_velocities": slice(9, 18),
            "joint_torques": slice(18, 27),
        }
