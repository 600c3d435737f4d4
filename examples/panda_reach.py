"""A Panda that reaches, as a causal model. The arm is robosuite's (``pip install robosuite``)."""

import importlib.util

import mujoco
import numpy as np

from scm_world import Box, Exogenous, ModelTask, World

HAND, GOAL = "right_hand.position", "goal.position"
JOINTS = [f"joint{k}.position" for k in range(1, 8)]
BENT = dict(zip(JOINTS, (0.0, 0.2, 0.0, -2.0, 0.0, 2.2, 0.8), strict=True))
PLACES = {  # where the goal may be, and where it is drawn from [m]
    "bounds": Box((0.2, -0.6, 0.1), (0.7, 0.6, 0.9)),
    "a": Box((0.4, -0.2, 0.3), (0.6, 0.2, 0.6)),
    "b": Box((0.3, 0.2, 0.2), (0.5, 0.5, 0.7)),
}


def panda() -> ModelTask:
    """Make position servos of the motors, compensate gravity, and declare what counts."""
    home = importlib.util.find_spec("robosuite").submodule_search_locations[0]
    spec = mujoco.MjSpec.from_file(f"{home}/models/assets/robots/panda/robot.xml")
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    for motor in spec.actuators:
        motor.set_to_position(kp=200.0, kv=20.0)
        motor.ctrlrange, motor.forcerange = spec.joint(motor.target).range, (-87.0, 87.0)
    goal = Exogenous(name=GOAL, unit="m", shape=(3,), default=(0.5, 0.2, 0.4), **PLACES)
    near = (lambda hand, goal: -np.linalg.norm(hand - goal), HAND, GOAL)
    return ModelTask(spec, ties=[goal], outcomes=[HAND], reward=near, start=BENT, seconds=3.0)


def solve(world: World, goal: np.ndarray) -> np.ndarray:
    """Find joints that put the hand at the goal: interventions show the Jacobian."""
    angles = np.array([*BENT.values()])
    for _ in range(10):
        places = []
        for each in (angles, *(angles + 1e-5 * np.eye(7))):
            world.do(dict(zip(JOINTS, each, strict=True)))
            places.append(world[HAND])
        slopes = (places[1:] - places[0]).T / 1e-5
        angles += np.linalg.pinv(slopes, rcond=1e-2) @ (goal - places[0])
    return angles


def main(backend: str = "mujoco") -> None:
    """Do, ask the graph, reach, and imagine."""
    world, aim = World(panda(), backend=backend), np.array([0.4, 0.3, 0.5])
    world.reset(seed=0)
    print(world.do({GOAL: aim}), world.graph.parents("reward"), sep="\n")
    lived = world.rollout(solve(world, aim), seed=0, do={GOAL: aim})
    heavy = lived.counterfactual({"right_hand.mass": 3.0, "right_hand.gravcomp": 0.0}, at=50)
    print("ends", -lived.final("reward"), "m off; with a heavy hand", -heavy.final("reward"))
    print("nothing else, nothing different:", lived.counterfactual({}) == lived)


if __name__ == "__main__":
    main()
