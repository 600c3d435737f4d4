"""One system of each kind: equations, a step function, an MJCF model, and the TriFinger."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from scm_world import (
    SCM,
    Action,
    Box,
    Derived,
    Exogenous,
    Linear,
    Measured,
    Parent,
    StepTask,
    World,
)
from scm_world.variables import Normal

CART_POLE = """
<mujoco model="cart-pole">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -.4"/>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" range="-1 1" limited="true" damping=".1"/>
      <geom type="box" size=".1 .05 .05" mass="1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 .5" size=".02" mass=".1"/>
        <site name="tip" pos="0 0 .5"/>
      </body>
    </body>
    <body name="ball" pos=".6 0 -.2"><freejoint/>
      <geom name="ball" type="sphere" size=".1" mass=".2"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slider" gear="10" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


WIDE = Box(-9.0, 9.0)
RATE = Exogenous(name="rate", default=1.0, bounds=Box(0.0, 2.0), a=Box(0.5, 1.0), b=Box(1.0, 1.5))


def upright(angle: Any) -> Any:
    """Return how upright the pole is."""
    return np.cos(angle)


def carried(rate: Any, speed: Any, push: Any, noise: Any) -> Any:
    """Return the next speed of a body with friction."""
    return (1.0 - 0.1 * rate) * speed + 0.2 * push + 0.01 * noise


def bent(place: Any) -> Any:
    """Return a height above the ground."""
    return 1.0 + 0.5 * np.sin(place)


def equations() -> SCM:
    """Return a body with friction on a bent track, as equations."""
    return SCM(
        [
            Exogenous(
                name="rate", default=1.0, bounds=Box(0.0, 2.0), a=Box(0.5, 1.0), b=Box(1.0, 1.5)
            ),
            Exogenous(name="drift", distribution=Normal(), per="step"),
            Exogenous(name="gain", distribution=Box(0.5, 1.5), bounds=Box(0.0, 2.0)),
            Action(name="push", bounds=Box(-1.0, 1.0)),
            Derived(
                name="speed",
                parents=(Parent("rate", 1), Parent("speed", 1), Parent("push", 1)),
                mechanism=carried,
                noise=Normal(),
                start=0.3,
            ),
            Derived(
                name="place",
                parents=(Parent("place", 1), Parent("speed", 1)),
                mechanism=Linear(weights=(1.0, 0.1)),
            ),
            Derived(name="height", parents=("place",), mechanism=bent),
            Derived(name="echo", parents=("gain", "drift"), mechanism=Linear(weights=(1.0, 0.1))),
        ]
    )


def stepped(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Return the next state of the same body."""
    speed = carried(parameters["rate"], state["speed"], action["push"], noise["wind"])
    echo = parameters["gain"] + 0.1 * noise["drift"]
    return {"speed": speed, "place": state["place"] + 0.1 * state["speed"], "echo": echo}


def function() -> World:
    """Return the same body as a world of a step function."""
    return World(
        StepTask(
            stepped,
            parameters=[
                RATE,
                Exogenous(name="gain", distribution=Box(0.5, 1.5), bounds=Box(0.0, 2.0)),
            ],
            states=[
                Measured(
                    name="speed",
                    default=0.3,
                    bounds=Box(-9.0, 9.0),
                    parents=("speed", "rate", "push"),
                ),
                Measured(name="place", bounds=Box(-9.0, 9.0), parents=("place", "speed")),
                Measured(name="echo", bounds=Box(-9.0, 9.0), parents=("gain",)),
            ],
            actions=[Action(name="push", bounds=Box(-1.0, 1.0))],
            outcomes=[Derived(name="height", parents=("place",), mechanism=bent)],
            noise={"wind": Normal(), "drift": Normal()},
            control_dt=0.1,
        )
    )


def model() -> World:
    """Return a cart with a pole and a ball, on MuJoCo."""
    return World(
        CART_POLE,
        reward=(upright, "hinge.position"),
        outcomes=["tip.position"],
        spaces={"pole.mass": {"a": (0.05, 0.1), "b": (0.1, 0.3)}},
        start={"hinge.position": Box(-0.2, 0.2)},
        seconds=2.0,
    )


def robot() -> World:
    """Return the TriFinger with a block to push, on MuJoCo."""
    return World("pushing", backend="mujoco")


@dataclass(frozen=True)
class Kind:
    """A kind of system, and names of its variables.

    Attributes:
        make: Builds the system that is asked.
        parameter: Has spaces A and B, and acts on ``moved`` one step later.
        values: Two values of it.
        moved: A state, or what stands for one in equations.
        readout: What can be computed of the present only, with a cause of lag 0 ``of``.
        of: Its cause.
        beside: What ``parameter`` does not act on, though it varies.
        settable: What can be intervened on at any instant.
        action: Low and high.
    """

    make: Any
    parameter: str
    values: tuple[Any, Any]
    moved: str
    readout: str
    of: str
    beside: str
    settable: tuple[str, ...]

    @property
    def asked(self) -> Any:
        """The system that is asked; tests share it, since questions leave it as it is."""
        return _made(self.make)

    def system(self) -> Any:
        """Return a system of its own to reset, step and intervene on."""
        made = self.make()
        return World(made) if isinstance(made, SCM) else made


@cache
def _made(make: Any) -> Any:
    return make()


KINDS = {
    "equations": Kind(
        equations, "rate", (0.4, 1.7), "speed", "height", "place", "echo",
        ("rate", "gain", "speed", "place", "push"),
    ),
    "function": Kind(
        function, "rate", (0.4, 1.7), "speed", "height", "place", "echo",
        ("rate", "gain", "speed", "place", "push"),
    ),
    "model": Kind(
        model, "pole.mass", (0.06, 0.25), "hinge.velocity", "tip.position", "hinge.position",
        "ball.cartesian_position",
        ("pole.mass", "slider.damping", "gravity", "hinge.position", "slider.velocity", "ball.mass",
         "rod.size", "push.control"),
    ),
    "robot": Kind(
        robot, "tool_block.mass", (0.03, 0.08), "tool_block.linear_velocity", "reward",
        "tool_block.cartesian_position", "time_left_for_task",
        ("tool_block.mass", "floor_friction", "gravity", "tool_block.linear_velocity", "block.size",
         "joint_damping", "goal_block.cylindrical_position", "joint_velocities"),
    ),
}  # fmt: skip


def same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two sets of values are equal, bit for bit."""
    return one.keys() == other.keys() and all(
        np.asarray(one[name]).tobytes() == np.asarray(other[name]).tobytes() for name in one
    )
