"""The robot, as variables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.geometry.numbers import njit, scalar
from scm_world.graph import NoiseKey
from scm_world.tasks.composition import Commands, Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import (
    FINGERS,
    N_JOINTS,
    QUANTITIES,
    RESOLUTIONS,
    JointGroup,
    joints_of,
)
from scm_world.tasks.trifinger.kinematics import forward_kernel, inverse_kernel, tip_kernel
from scm_world.variables import Action, Box, Function, Measured, Normal, Variable, bundle
from scm_world.variables.mechanisms import Stacked
from scm_world.variables.reserved import ACTUATOR_NOISE

ACTIONS = {
    "joint_positions": ("rad", Box(hardware.JOINT_LOW, hardware.JOINT_HIGH)),
    "joint_torques": ("N m", Box(-0.36, 0.36)),
    "end_effector_positions": ("m", Box((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3)),
}
"""Unit and range of each way to command the robot."""

HIDDEN = (
    numbers.FRICTION.root(
        "finger_friction",
        numbers.SURFACE_FRICTION,
        "Friction of all links; a contact has the product of two frictions.",
    ),
    numbers.JOINT_DAMPING.root("joint_damping", 0.0, "Passive damping of every joint."),
    numbers.POSITION_GAINS.root("position_gains", hardware.POSITION_GAINS),
    numbers.VELOCITY_GAINS.root("velocity_gains", hardware.VELOCITY_GAINS),
    numbers.SAFETY_DAMPING.root("safety_damping", hardware.SAFETY_DAMPING),
    numbers.TORQUE.root("torque_limit", hardware.TORQUE_LIMIT),
    numbers.NOISE.root(
        ACTUATOR_NOISE,
        0.0,
        "Standard deviation of a command, as a fraction of half the range of an action.",
    ),
)
"""What the predecessor keeps to itself: friction, damping, the joint controller, and noise."""

MOVES = (
    (numbers.JOINTS, "Angles of the joints of {}."),
    (numbers.Range(Box(-50.0, 50.0), unit="rad/s"), "Angular velocities of the joints."),
    (numbers.Range(Box(-1.0, 1.0), unit="N m"), "Torques of the last physics step."),
)
"""Kind and sentence of each of ``QUANTITIES``; the engine only reports the last one."""


@njit(cache=True)
def tips(joint_positions: Floats, robot_height: Value) -> Floats:
    """Compute the three fingertips from the joints, shape (9,) [m]."""
    return forward_kernel(joint_positions, scalar(robot_height))


@Stacked
@njit(cache=True)
def finger_tip(numbers: Floats, finger: float) -> Floats:
    """Compute the tip of a finger, shape (3,) [m], from its three joints and the robot's height."""
    return np.array(tip_kernel(int(finger), numbers[:3], numbers[3]))


STREAM = "actuators"
"""The stream of the noise; draws of the variable that scales it have another one."""


@final
class RobotCommands(Commands):
    """Joint positions for fingertips, and the noise of the actuators.

    Args:
        action_mode: One of ``ACTIONS``.
    """

    noisy: Mapping[str, slice] = {f"actuator {i}": slice(i, i + 1) for i in range(N_JOINTS)}

    def __init__(self, action_mode: str) -> None:
        self._by_tips = action_mode == "end_effector_positions"
        low, high = ACTIONS[action_mode][1].bounds((N_JOINTS,), {})
        self._half = (high - low) / 2.0
        if not self._by_tips:
            self.added = ACTUATOR_NOISE, STREAM, self._half

    def applies(self, values: Values) -> Any:
        """Return whether fingertips are commanded, or the actuators have noise."""
        return self._by_tips or values[ACTUATOR_NOISE] > 0.0

    def command(
        self, action: Floats, values: Values, vector: Floats, key: NoiseKey, substeps: int
    ) -> Floats:
        """Add the noise, then find the joint positions of fingertips, shape (9,)."""
        noise = float(values[ACTUATOR_NOISE])
        if noise > 0.0:
            drawn = key.draw(Normal(), STREAM, (N_JOINTS,), {})
            action = action + noise * self._half * drawn
        if self._by_tips:
            height = float(values["robot_height"])
            action, _ = inverse_kernel(action, height, vector[:N_JOINTS])
        return action


def robot(
    action_mode: str,
    start: tuple[float, ...] = hardware.REST,
    resolution: str = RESOLUTIONS[0],
) -> Entity:
    """Describe three fingers with three joints each.

    Args:
        action_mode: One of ``ACTIONS``.
        start: Joint positions at the start, shape (9,) [rad].
        resolution: One of ``RESOLUTIONS``. Variables finer than ``"vector"`` are put together again
            in bundles under the names of the whole robot.
    """
    (unit, range_), groups = ACTIONS[action_mode], joints_of(resolution)
    actions = [
        Action(
            name=joints.action,
            unit=unit,
            shape=joints.shape,
            bounds=joints.cut(range_),
            doc=f"What the policy commands of {joints.of}: {action_mode}.",
        )
        for joints in _acting(action_mode, resolution)
    ]
    states = [_moving(quantity, joints, start) for quantity in range(3) for joints in groups]
    variables: list[Variable] = list(actions)
    if len(actions) > 1:
        whole = bundle("action", actions, bounds=range_, doc="What the policy commands.")
        variables.append(whole)
    variables.append(numbers.ROBOT_HEIGHT.root("robot_height", hardware.NOMINAL_HEIGHT))
    for finger, (index, mass) in product(FINGERS, enumerate(hardware.LINK_MASS)):
        link = hardware.link_name(finger, index)
        still = " It is fixed to the base, so nothing depends on it." if index == 0 else ""
        doc = f"Mass of the link; its inertia scales with it.{still}"
        variables.append(numbers.LINK_MASSES.root(f"{link}.mass", mass, doc))
        variables.append(numbers.COLOR.root(f"{link}.color", hardware.LINK_COLORS[finger]))
    variables += [*HIDDEN, *_tips(groups)]
    if len(groups) > 1:
        for index, (name, (kind, doc)) in enumerate(zip(QUANTITIES, MOVES, strict=True)):
            parts = states[index * len(groups) : (index + 1) * len(groups)]
            spaces = {"bounds": kind.bounds, "a": kind.a, "b": kind.b}
            variables.append(bundle(name, parts, doc=doc.format("all fingers"), **spaces))
    return Entity("robot", (*variables, *states))


def acted_on(action_mode: str, resolution: str) -> dict[str, tuple[str, ...]]:
    """Map what acts through commands to the states of the joints that it acts on in every step."""
    groups, by_tips = joints_of(resolution), action_mode == "end_effector_positions"
    found = {
        joints.action: tuple(
            name
            for other in groups
            if not set(other.fingers).isdisjoint(joints.fingers)
            for name in other.names
        )
        for joints in _acting(action_mode, resolution)
    }
    others = ("robot_height", ACTUATOR_NOISE) if by_tips else (ACTUATOR_NOISE,)
    return found | dict.fromkeys(others, tuple(name for joints in groups for name in joints.names))


def _acting(action_mode: str, resolution: str) -> tuple[JointGroup, ...]:
    """List the joints of each action. A tip is a point: its coordinates are of no single joint."""
    whole = action_mode == "end_effector_positions" and resolution == "joint"
    return joints_of("finger" if whole else resolution)


def _moving(quantity: int, joints: JointGroup, start: tuple[float, ...]) -> Measured:
    """Declare position, velocity or torque of some joints."""
    kind, doc = MOVES[quantity]
    if quantity == 0 and not joints.shape:
        doc = "Angle of {}."
    default = start[joints.where] if quantity == 0 else (0.0,) * len(start[joints.where])
    cut: dict[str, Any] = {}
    if quantity == 0:
        cut = {space: joints.cut(getattr(kind, space)) for space in ("bounds", "a", "b")}
    return replace(kind, shape=joints.shape).state(
        joints.names[quantity],
        default if joints.shape else default[0],
        doc.format(joints.of),
        settable_state=quantity < 2,
        **cut,
    )


def _tips(groups: tuple[JointGroup, ...]) -> Iterable[Variable]:
    """Declare the fingertips, and the three of them together."""
    name, doc = "end_effector_positions", "The three fingertips."
    fields: dict[str, Any] = {"unit": "m", "bounds": Box(-1.0, 1.0)}
    if len(groups) == 1:
        parents = ("joint_positions", "robot_height")
        yield Measured(name=name, shape=(9,), parents=parents, mechanism=tips, doc=doc, **fields)
        return
    found = [
        Measured(
            name=f"finger_{finger}.end_effector_position",
            shape=(3,),
            parents=(*(j.names[0] for j in groups if finger in j.fingers), "robot_height"),
            mechanism=Function(finger_tip, constants={"finger": float(index)}),
            doc=f"The tip of finger {finger}.",
            **fields,
        )
        for index, finger in enumerate(FINGERS)
    ]
    yield from found
    yield bundle(name, found, doc=doc, **fields)
