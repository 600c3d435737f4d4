"""A task that hides an offset, and agents that know it, learn it, or do nothing about it."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world import Box, ModelTask, StepTask
from scm_world.evaluation import Adaptive
from scm_world.policies import as_agent
from scm_world.variables import Action, Exogenous, Measured, Normal

FORM = {"normalize_observations": False, "normalize_actions": False}
STEPS = 4


def moved(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Move by the action minus the offset; something else is noise."""
    return {"x": action["push"] - parameters["offset"], "y": noise["wind"]}


def near(x: float) -> float:
    """Return minus the distance from zero."""
    return -abs(x)


class Aim(StepTask):
    """The reward is minus how far the action is from the offset; the color does nothing."""

    parameters = (
        Exogenous(name="offset", default=0.0, bounds=Box(-1.0, 1.0), a=Box(-1.0, 1.0)),
        Exogenous(name="color", default=0.5, distribution=Box(0.0, 1.0)),
    )
    states = (Measured(name="x", default=0.0), Measured(name="y", default=0.0))
    actions = (Action(name="push", bounds=Box(-2.0, 2.0)),)
    noise = {"wind": Normal()}  # noqa: RUF012 # read only
    start, observe, reward = {"x": Box(-1.0, 1.0)}, ("x",), (near, "x")
    control_dt, seconds, step = 0.1, 0.1 * STEPS, staticmethod(moved)


def nothing(observation: Any) -> Any:
    """Do nothing."""
    return np.zeros(1)


def told(observation: Any) -> Any:
    """Push by the offset, which it is shown after x and the other parameters before it."""
    return observation[1:2]


class Learner:
    """Learns the offset in the first control step of a draw, and keeps it until it forgets."""

    def __init__(self) -> None:
        self.known: Any = None

    def forget(self) -> None:
        """Know nothing."""
        self.known = None

    def reset(self) -> None:
        """Begin an episode."""
        self.steps = 0

    def __call__(self, observation: Any) -> Any:
        """Push by the offset, once it is known."""
        if self.known is None and self.steps:
            self.known = -observation[:1]
        self.steps += 1
        return np.zeros(1) if self.known is None else self.known


AGENTS = {
    "told": as_agent(told, env={**FORM, "context": "observation"}),
    "learner": as_agent(Learner, env=FORM),
    "nothing": as_agent(nothing, env=FORM),
}


CART = """<mujoco><option timestep="0.01"/><worldbody><body name='cart'>
<joint name='slider' type='slide' axis='1 0 0' damping='0.5'/><geom type='box' size='.1 .1 .1'
mass='1'/><body name='pole'><joint name='hinge' axis='0 1 0' damping='0.05'/>
<geom type='capsule' size='0.02' fromto='0 0 0 0 0 -0.6' mass='0.1'/></body></body></worldbody>
<actuator><motor name='motor' joint='slider' ctrlrange='-3 3' ctrllimited='true'/></actuator>
</mujoco>"""
MEASURES = {"slider.position": 1e-3, "hinge.position": 1e-3}
MASS = "pole.mass"


class Cart(ModelTask):
    """A pole hangs from a cart; how heavy it is varies."""

    name, model, seconds, control_dt = "cart", CART, 0.8, 0.02
    reward = (np.cos, "hinge.position")
    observe = ("slider.position", "slider.velocity", "hinge.position", "hinge.velocity")
    start = {"hinge.position": Box(0.2, 0.4)}  # noqa: RUF012 # read only
    spaces = {MASS: {"a": Box(0.15, 0.4), "bounds": Box(0.02, 1.0)}}  # noqa: RUF012


class Shaking:
    """Shakes the cart as strongly as the pole is heavy, as far as it is told."""

    def reset(self) -> None:
        """Begin an episode."""
        self.steps = 0

    def __call__(self, observation: Any) -> Any:
        """Push to one side, then to the other one."""
        self.steps += 1
        return np.array([3.0 * observation[4] * (-1.0) ** (self.steps // 5)])


TOLD = as_agent(Shaking, env={**FORM, "include": [MASS]})
adaptive = Adaptive(TOLD, MASS, after=15, every=10, measures=MEASURES)
