"""Cart-pole swing-up as a causal model; ``examples/cartpole_swing_up.py train`` learns it."""

import itertools
import math
import sys

from numba import njit

from scm_world import Box, Measured, ModelTask, World, discover
from scm_world.curricula import everything

CARTPOLE = """<mujoco model="cartpole"><option timestep="0.01"/><worldbody><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" range="-1.8 1.8"/><geom size=".2 .1 .1" type="box"
  mass="1"/><body name="pole"><joint name="hinge" axis="0 1 0" damping="2e-6"/><geom type="capsule"
  fromto="0 0 .2 0 0 1" size=".045" mass=".1"/></body></body></worldbody><actuator>
  <motor name="motor" joint="slider" gear="10" ctrlrange="-1 1"/></actuator></mujoco>"""


upright = njit(lambda angle, x, speed: (1 + math.cos(angle)) / (2 + x**2 + 0.04 * speed**2))


class SwingUp(ModelTask):
    """The pole begins where it hangs. In B it is heavier, and the motor is weaker."""

    model, seconds, control_dt, start = CARTPOLE, 8.0, 0.04, {"hinge.position": Box(3.0, 3.3)}
    mass, gear = {"a": Box(0.05, 0.2), "b": Box(0.2, 0.4)}, {"a": Box(8, 12), "b": Box(6, 8)}
    spaces = {"pole.mass": mass, "motor.gear": gear}  # noqa: RUF012
    cos = Measured(name="cos", parents=("hinge.position",), mechanism=math.cos)
    sin = Measured(name="sin", parents=("hinge.position",), mechanism=math.sin)
    outcomes, success = (cos, sin), (njit(lambda cos: cos > 0.95), "cos")
    reward = (upright, "hinge.position", "slider.position", "hinge.velocity")
    observe = ("cos", "sin", "hinge.velocity", "slider.position", "slider.velocity")


def main(backend: str = "mujoco") -> None:
    """Do, ask the graph, imagine, discover."""
    world = World(SwingUp(), backend=backend)
    world.reset(seed=0)
    print(world.do({"pole.mass": 0.3}), world.graph.parents("slider.velocity"), sep="\n")
    lived = world.rollout("random", seed=1, steps=50)
    print("heavier:", lived.counterfactual({"pole.mass": 0.5}, at=10).final("hinge.position"))
    print("nothing else, nothing different:", lived.counterfactual({}) == lived)
    print(discover(world, probes=4))


def train(folder: str = "runs/cartpole", steps: str = "1000000") -> None:
    """Train in A; evaluate in A and B, beside random actions and none."""
    from scm_world.evaluation import evaluate
    from scm_world.training import loop, recipe

    task = f"{__file__}:SwingUp"
    loop.train(recipe.recipe(task, curriculum=everything("A"), steps=int(steps)), out=folder)
    found = evaluate({"trained": folder, "random": "random", "still": "still"}, "A,B", task=task)
    for who, where in itertools.product(found.agents, "AB"):
        print(who, where, *(found.score(where, metric, agent=who) for metric in found.metrics))


if __name__ == "__main__":
    train(*sys.argv[2:]) if sys.argv[1:2] == ["train"] else main(*sys.argv[1:])
