"""Four tasks of Gymnasium as tasks of this package: the same file, observation, reward, frame skip.

Source:
    Gymnasium 1.x, ``envs/mujoco``: ``HalfCheetah-v5``, ``Reacher-v5``, ``Pusher-v5``, ``Ant-v5``.
    What they observe of bodies is one physics step old (``mj_step`` does not compute positions
    anew after the last one); here it is of the present. Quaternions are (x, y, z, w) here. Ant is
    compared without its contact forces, which are no function of the state (see ``ANT``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numba import njit

from scm_world import Measured, ModelTask
from scm_world.variables import Parent

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


class Pair(NamedTuple):
    """A task of Gymnasium, and the same task here.

    Attributes:
        id: Of Gymnasium's.
        options: Of it.
        make: Gives ours.
    """

    id: str
    options: Mapping[str, Any]
    make: Callable[[], ModelTask]


def measured(name: str, function: Any, *parents: str, shape: tuple[int, ...] = ()) -> Measured:
    """Declare something that is computed."""
    return Measured(name=name, shape=shape, parents=parents, mechanism=function)


def positions(*joints: str) -> list[str]:
    """Name the positions of joints."""
    return [f"{joint}.position" for joint in joints]


def velocities(*joints: str) -> list[str]:
    """Name their velocities."""
    return [f"{joint}.velocity" for joint in joints]


def controls(*actuators: str) -> list[str]:
    """Name what actuators are told."""
    return [f"{actuator}.control" for actuator in actuators]


# --- half-cheetah --------------------------------------------------------------------------------

ROOT, LEGS = ("rootx", "rootz", "rooty"), ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")


@njit(cache=True)
def ran(before: float, now: float, a: float, b: float, c: float, d: float, e: float, f: float):  # type: ignore[no-untyped-def] # a kernel
    """Give the velocity [m/s] less the cost of control."""
    return (now - before) / 0.05 - 0.1 * (a * a + b * b + c * c + d * d + e * e + f * f)


def half_cheetah() -> ModelTask:
    """Run."""
    joints = (*ROOT, *LEGS)
    return ModelTask(
        str(ASSETS / "half_cheetah.xml"),
        frame_skip=5,
        seconds=50.0,
        observe=[*positions(*joints[1:]), *velocities(*joints)],
        reward=(ran, Parent("rootx.position", 1), "rootx.position", *controls(*LEGS)),
    )


# --- reacher -------------------------------------------------------------------------------------


@njit(cache=True)
def directions(one: float, other: float) -> Any:
    """Give cosines, then sines."""
    return np.array([math.cos(one), math.cos(other), math.sin(one), math.sin(other)])


@njit(cache=True)
def away(tip: Any, target: Any) -> Any:
    """Give where the tip is, seen from the target, in the plane."""
    return tip[:2] - target[:2]


@njit(cache=True)
def reached(tip: Any, target: Any, a: float, b: float) -> float:
    """Give minus the distance, and minus the cost of control."""
    x, y, z = tip[0] - target[0], tip[1] - target[1], tip[2] - target[2]
    return -math.sqrt(x * x + y * y + z * z) - (a * a + b * b)


def reacher() -> ModelTask:
    """Reach."""
    tip, target = "body:fingertip.position", "body:target.position"
    return ModelTask(
        str(ASSETS / "reacher.xml"),
        frame_skip=2,
        seconds=1.0,
        outcomes=[
            tip,
            target,
            measured("directions", directions, *positions("joint0", "joint1"), shape=(4,)),
            measured("away", away, tip, target, shape=(2,)),
        ],
        observe=[
            "directions",
            *positions("target_x", "target_y"),
            *velocities("joint0", "joint1"),
            "away",
        ],
        reward=(reached, tip, target, *controls("joint0", "joint1")),
    )


# --- pusher --------------------------------------------------------------------------------------

ARM = (
    *("r_shoulder_pan_joint", "r_shoulder_lift_joint", "r_upper_arm_roll_joint"),
    *("r_elbow_flex_joint", "r_forearm_roll_joint", "r_wrist_flex_joint", "r_wrist_roll_joint"),
)


@njit(cache=True)
def distance(one: Any, other: Any) -> float:
    """Give the distance of two places."""
    x, y, z = one[0] - other[0], one[1] - other[1], one[2] - other[2]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True)
def pushed(  # type: ignore[no-untyped-def] # a kernel
    tips: Any, thing: Any, goal: Any, a: float, b: float, c: float, d: float, e: float, f: float,
    g: float,
):  # fmt: skip
    """Give minus what the object is off, half of what the hand is, and the cost of control."""
    cost = a * a + b * b + c * c + d * d + e * e + f * f + g * g
    return -distance(thing, goal) - 0.5 * distance(thing, tips) - 0.1 * cost


def pusher() -> ModelTask:
    """Push."""
    places = ["tips_arm.position", "object.position", "goal.position"]
    return ModelTask(
        str(ASSETS / "pusher_v5.xml"),
        frame_skip=5,
        seconds=5.0,
        outcomes=places,
        observe=[*positions(*ARM), *velocities(*ARM), *places],
        reward=(pushed, *places, *controls(*ARM)),
    )


# --- ant -----------------------------------------------------------------------------------------

ANT = {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}
"""Forces are what solved the last physics step, and no function of states and parameters."""

HIPS = tuple(f"{part}_{leg}" for leg in range(1, 5) for part in ("hip", "ankle"))


@njit(cache=True)
def height(place: Any) -> float:
    """Give the height [m]."""
    return place[2]


@njit(cache=True)
def fell(place: Any) -> bool:
    """Tell whether the torso is too low or too high."""
    return not 0.2 <= place[2] <= 1.0


@njit(cache=True)
def walked(  # type: ignore[no-untyped-def] # a kernel
    before: Any, now: Any, a: float, b: float, c: float, d: float, e: float, f: float, g: float,
    h: float,
):  # fmt: skip
    """Give the velocity [m/s], one for being healthy, and minus the cost of control."""
    cost = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h
    return (now[0] - before[0]) / 0.05 + (1.0 if 0.2 <= now[2] <= 1.0 else 0.0) - 0.5 * cost


def ant() -> ModelTask:
    """Walk."""
    place = "torso.cartesian_position"
    return ModelTask(
        str(ASSETS / "ant.xml"),
        frame_skip=5,
        seconds=50.0,
        outcomes=[measured("height", height, place)],
        observe=[
            "height",
            "torso.orientation",
            *positions(*HIPS),
            "torso.linear_velocity",
            "torso.angular_velocity",
            *velocities(*HIPS),
        ],
        reward=(walked, Parent(place, 1), place, *controls(*HIPS)),
        terminated=(fell, place),
    )


PAIRS = {
    "half_cheetah": Pair("HalfCheetah-v5", {}, half_cheetah),
    "reacher": Pair("Reacher-v5", {}, reacher),
    "pusher": Pair("Pusher-v5", {}, pusher),
    "ant": Pair("Ant-v5", ANT, ant),
}
"""What is compared."""
