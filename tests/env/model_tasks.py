"""A cart-pole for tests of environments, curricula, evaluations and trainings of models."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from scm_world import Action, Box, Exogenous, Measured, ModelTask, Parent, StepTask

CARTPOLE = """<mujoco model="cartpole"><option timestep="0.01"/><worldbody>
  <camera name="side" pos="0 -4 1" zaxis="0 -1 0.1"/><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" range="-1.8 1.8"/>
  <geom size=".2 .1 .1" type="box" mass="1"/><body name="pole">
  <joint name="hinge" axis="0 1 0" damping="2e-6"/>
  <geom type="capsule" fromto="0 0 .2 0 0 1" size=".045" mass=".1"/><site name="tip" pos="0 0 1"/>
  </body></body></worldbody><actuator>
  <motor name="motor" joint="slider" gear="10" ctrlrange="-2 1"/></actuator></mujoco>"""

ANGLE, PLACE = "hinge.position", "slider.position"


def upright(angle: Any, place: Any) -> float:
    """Give 1 where the pole stands in the middle: in Python."""
    return float(0.5 + 0.5 * math.cos(angle) - 0.1 * place * place)


@njit
def upright_compiled(angle: float, place: float) -> float:
    """Give the same: compiled."""
    return 0.5 + 0.5 * math.cos(angle) - 0.1 * place * place


@njit
def left(place: float) -> bool:
    """Tell whether the cart is near the end of its rail."""
    return abs(place) > 0.5


@njit
def stands(tip: Any) -> bool:
    """Tell whether the tip is high."""
    return tip[2] > 0.9


class Balance(ModelTask):
    """It begins near upright; in B the pole is heavier."""

    model, seconds, control_dt, start = CARTPOLE, 0.6, 0.02, {ANGLE: Box(-0.1, 0.1)}
    expose = ("pole.mass", "motor.gear")
    spaces = {  # noqa: RUF012
        "pole.mass": {"a": Box(0.05, 0.2), "b": Box(0.2, 0.4)},
        "motor.gear": {"a": Box(8.0, 12.0)},
    }
    outcomes, reward = ("tip.position",), (upright_compiled, ANGLE, PLACE)
    success = (stands, "tip.position")


class Falling(Balance):
    """Its reward is a function of Python, and episodes end where the cart is far off."""

    reward, terminated, success = (upright, ANGLE, PLACE), (left, PLACE), None
    observe = ("tip.position", "slider.velocity")


class Scored(Balance):
    """It says to which part it is solved, too."""

    outcomes = (
        "tip.position",
        Measured(name="fractional_success", parents=(ANGLE,), mechanism=math.cos),
    )


def decay(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let something decay, and add to it."""
    return {"level": state["level"] * (1.0 - parameters["rate"]) + 0.1 * action["inflow"][..., 0]}


class Decay(StepTask):
    """A function instead of an engine; its action has no bounds."""

    parameters = (Exogenous(name="rate", default=0.1, bounds=Box(0.0, 1.0), b=Box(0.5, 0.9)),)
    states = (Measured(name="level", default=1.0),)
    actions = (Action(name="inflow", shape=(2,)),)
    reward = (np.abs, "level")
    step = staticmethod(decay)


def filling(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let a tank run full; its color does nothing."""
    return {"level": state["level"] + parameters["rate"]}


@njit
def not_full(level: float) -> bool:
    """Tell whether a tank of one unit has room."""
    return level < 1.0


class Filling(StepTask):
    """In each episode nature draws how fast a tank fills, how full it is, and its color."""

    parameters = (
        Exogenous(name="rate", default=0.05, distribution=Box(0.0, 0.2), bounds=Box(0.0, 0.2)),
        Exogenous(name="color", default=0.5, distribution=Box(0.0, 1.0), a=Box(0.0, 0.1)),
    )
    states = (Measured(name="level", default=0.0, parents=("rate", "level")),)
    actions = (Action(name="valve", bounds=Box(-1.0, 1.0)),)
    start, observe = {"level": Box(0.0, 0.01)}, ("level", "color")
    seconds, step, success = 1.0, staticmethod(filling), (not_full, "level")
    reward = (not_full, "level")


def fragile(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Do the same, and fail as a whole where anything is full."""
    if np.any(state["level"] > parameters["size"]):
        raise OverflowError("full")
    return {"level": state["level"] + action["inflow"]}


def risen(level: Any, before: Any) -> Any:
    """Give how much there is, and how much more it is than before."""
    return level + 10.0 * (level - before)


class Fragile(StepTask):
    """A function that fails in some worlds."""

    parameters = (Exogenous(name="size", default=1e6, bounds=Box(0.0, 1e6)),)
    states = (Measured(name="level", default=1.0),)
    actions = (Action(name="inflow", bounds=Box(-1.0, 1.0)),)
    reward = (risen, "level", Parent("level", lag=1))
    step = staticmethod(fragile)


class FragileTogether(Fragile):
    """The same, called once for all worlds."""

    vectorized = True
