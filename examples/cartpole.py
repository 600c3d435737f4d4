"""A pole on a cart that PPO learns to balance; ``examples/cartpole.py train`` learns it.

An episode ends where the pole leans or the cart is far off, and each step before that is worth 1.
"""

import sys

from numba import njit

from scm_world import Box, ModelTask
from scm_world.evaluation import evaluate

CARTPOLE = """<mujoco model="cartpole"><option timestep="0.01"/><worldbody><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" range="-1.8 1.8"/><geom size=".2 .1 .1" type="box"
  mass="1"/><body name="pole"><joint name="hinge" axis="0 1 0"/><geom type="capsule"
  fromto="0 0 .2 0 0 1" size=".045" mass=".1"/></body></body></worldbody><actuator>
  <motor name="motor" joint="slider" gear="10" ctrlrange="-1 1"/></actuator></mujoco>"""

ANGLE, PLACE = "hinge.position", "slider.position"


class CartPole(ModelTask):
    """It begins nearly upright. In B the pole is heavier, and the motor is weaker."""

    model, seconds, control_dt = CARTPOLE, 10.0, 0.02
    start = {ANGLE: Box(-0.05, 0.05), PLACE: Box(-0.05, 0.05)}  # noqa: RUF012
    mass, gear = {"a": Box(0.05, 0.2), "b": Box(0.2, 0.4)}, {"a": Box(8, 12), "b": Box(6, 8)}
    spaces = {"pole.mass": mass, "motor.gear": gear}  # noqa: RUF012
    reward = (njit(lambda angle: 1.0), ANGLE)
    terminated = (njit(lambda angle, place: abs(angle) > 0.2 or abs(place) > 1.0), ANGLE, PLACE)
    training = {  # noqa: RUF012
        "worlds": 16,
        "steps": 100_000,
        "network": {"hidden": (64, 64), "log_std": -0.5},
        "trials": {"protocols": ("P0",), "times": 4},
        "ppo": {"settings": {"n_steps": 64, "batch_size": 256, "n_epochs": 10, "gamma": 0.99}},
    }


def main() -> None:
    """Say how long random actions and none keep the pole up."""
    found = evaluate({"random": "random", "still": "still"}, "P0", task=CartPole(), n=5)
    for agent in found.agents:
        steps = found.only(agent=agent).frame["steps"]
        print(agent, found.score("P0", agent=agent), "steps:", steps.tolist())


def train(folder: str = "runs/cartpole", steps: str = "100000") -> None:
    """Learn, and evaluate in A and B: ``scm-world train examples/cartpole.py:CartPole`` does so."""
    from scm_world.training import loop, recipe

    task = f"{__file__}:CartPole"
    trained = loop.train(recipe.recipe(task, steps=int(steps)), out=folder, tell=print)
    found = evaluate({"trained": trained.best}, "P0,A,B", task=task, n=20)
    for protocol in found.protocols:
        print(protocol, found.score(protocol))


if __name__ == "__main__":
    train(*sys.argv[2:]) if sys.argv[1:2] == ["train"] else main()
