"""Run the published actors in CausalWorld and here, from the same starts, and compare.

CausalWorld 1.2 draws the starts of its protocols. Requests that it accepts are replayed here, on
Bullet, under ``conventions="causal_world"``. It has to be importable. Of gym, which it asks
for, a stand-in will do::

    pip download causal-world==1.2 --no-deps -d wheel
    unzip wheel/causal_world-1.2-*.whl -d theirs
    PYTHONPATH=theirs python benchmarks/causal_world_twin.py picking --protocols P1 P3 --episodes 30

Every row says how many starts were compared; the last fractional success there and here, with the
mean of the differences and its standard error; the greatest difference of the first observation,
and that of the states in ten control steps in which both were given the same actions.
"""

from __future__ import annotations

import argparse
import copy
import json
import logging
import sys
import types
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from scm_world.env import IDS
from scm_world.errors import ScmWorldError
from scm_world.policies import load_sb2

ACTORS = {
    "pushing": "pushing_ppo_curr1",
    "picking": "picking_ppo_curr1",
    "pick_and_place": "pick_and_place_ppo_curr0",
    "stacking2": "stacking2_ppo_curr1",
}
STATE = ("cartesian_position", "linear_velocity", "angular_velocity")
SAME = 10  # control steps in which both are given the same actions


def stand_in_for_gym() -> None:
    """Let CausalWorld, which wants an old gym and an old numpy, be imported without them."""
    if "gym" in sys.modules:
        return

    class Env:
        observation_space = action_space = None

    class Wrapper(Env):
        def __init__(self, env: Any) -> None:
            self.env = env

        def __getattr__(self, name: str) -> Any:
            return getattr(self.env, name)

    def np_random(seed: int) -> tuple[Any, int]:
        return np.random.RandomState(seed), seed

    classes = {"Env": Env, "GoalEnv": Env, "spaces": gymnasium.spaces}
    wrappers = dict.fromkeys(("Wrapper", "ActionWrapper", "ObservationWrapper"), Wrapper)
    seeding = types.SimpleNamespace(np_random=np_random)
    recorder = types.ModuleType("gym.wrappers.monitoring.video_recorder")
    recorder.__dict__["VideoRecorder"] = object
    gym = types.ModuleType("gym")
    gym.__dict__.update(classes, **wrappers, utils=types.SimpleNamespace(seeding=seeding))
    register = types.ModuleType("gym.envs.registration")
    register.__dict__["register"] = lambda **_: None
    for name in ("gym.envs", "gym.wrappers", "gym.wrappers.monitoring"):
        sys.modules[name] = types.ModuleType(name)
    sys.modules |= {"gym": gym, recorder.__name__: recorder, register.__name__: register}
    np.__dict__.setdefault("bool", np.bool_)


def state_there(env: Any, blocks: tuple[str, ...]) -> Any:
    """Return joints and blocks of CausalWorld."""
    robot, stage = env.get_robot().get_latest_full_state(), env.get_stage()
    found = [robot["positions"], robot["velocities"]]
    found += [stage.get_object_state(block, name) for block in blocks for name in STATE]
    return np.concatenate(found)


def state_here(world: Any, blocks: tuple[str, ...]) -> Any:
    """Return the same of ours."""
    found = [world["joint_positions"], world["joint_velocities"]]
    found += [world[f"{block}.{name}"] for block in blocks for name in STATE]
    return np.concatenate(found)


def there(task: str, protocol: str, episodes: int, policy: Any) -> list[dict[str, Any]]:
    """Run a protocol of CausalWorld; keep the requests that it accepted."""
    import causal_world.benchmark.benchmarks as benchmarks
    from causal_world.envs.causalworld import CausalWorld
    from causal_world.task_generators.task import generate_task

    logging.getLogger().setLevel(logging.ERROR)
    rows = getattr(benchmarks, f"{task.upper()}_BENCHMARK")["evaluation_protocols"]
    chosen = next(row for row in rows if row.get_name() == protocol)
    env = CausalWorld(generate_task(task, variables_space="space_a_b"), skip_frame=3, seed=0)
    chosen.init_protocol(env=env, tracker=env.get_tracker())
    blocks = tuple(env.get_stage().get_rigid_objects())
    blocks = tuple(name for name in blocks if name.startswith("tool"))
    found = []
    for number in range(1, episodes + 1):
        env.reset()
        for _ in range(6):  # as often as its own wrapper tries
            request = chosen.get_intervention(number, 0)
            accepted, observation = env.do_intervention(copy.deepcopy(request))
            if accepted:
                break
        row: dict[str, Any] = {"do": request if accepted else {}, "blocks": blocks}
        row |= {"first": observation, "actions": [], "states": []}
        over = False
        while not over:
            action = policy(np.asarray(observation, np.float32))
            observation, _, over, info = env.step(action)
            if len(row["states"]) < SAME:
                row["actions"].append(action)
                row["states"].append(state_there(env, blocks))
        found.append(row | {"last": info["fractional_success"]})
    env.close()
    return found


def request_here(request: dict[str, Any]) -> dict[str, Any]:
    """Say the same to ours: block and goal share a size; a tower that moves is not turned there."""
    wish = copy.deepcopy(request)
    for name in ("tool_block", "goal_block"):
        if "size" in wish.get(name, {}):
            wish["block.size"] = wish[name].pop("size")
    if "cylindrical_position" in wish.get("goal_tower", {}):
        wish["goal_tower"].pop("euler_orientation", None)
    return {
        name: value for name, value in wish.items() if not (isinstance(value, dict) and not value)
    }


def here(env: Any, row: dict[str, Any], policy: Any) -> tuple[float, float, float]:
    """Replay a start; give the last success, and how far observation and states are off."""
    wish = {"options": {"do": request_here(row["do"])}} if row["do"] else {}
    world, apart, over, info = env.unwrapped.world, 0.0, False, {}
    observation, _ = env.reset(seed=0, **wish)
    first = float(np.abs(observation - row["first"]).max())
    for action, state in zip(row["actions"], row["states"], strict=True):
        env.step(action)
        apart = max(apart, float(np.abs(state_here(world, row["blocks"]) - state).max()))
    observation, _ = env.reset(seed=0, **wish)
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        over = terminated or truncated
    return info["fractional_success"], first, apart


def main() -> None:
    """Compare the protocols that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=ACTORS)
    parser.add_argument("--protocols", nargs="+", default=[f"P{index}" for index in range(12)])
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--out", type=Path, help="a file that gets a line of JSON for every start")
    asked = parser.parse_args()
    stand_in_for_gym()
    import causal_world

    assets = Path(causal_world.__file__).parent / "assets" / "baseline_actors"
    policy = load_sb2(assets / f"{ACTORS[asked.task]}.zip")
    env: Any = gymnasium.make(
        next(name for name, task in IDS.items() if task == asked.task),
        backend="bullet",
        conventions="causal_world",
        frame_skip=3,
        disable_env_checker=True,
    )
    print("| protocol | starts | there | here | difference | first observation | states |")
    print("|---|---|---|---|---|---|---|")
    for protocol in asked.protocols:
        pairs, refused = [], 0
        for row in there(asked.task, protocol, asked.episodes, policy):
            try:
                pairs.append((row["last"], *here(env, row, policy)))
            except ScmWorldError as problem:
                refused += 1
                print(f"{protocol}: {problem}", file=sys.stderr)
        if asked.out:
            names = ("there", "here", "first", "states")
            with asked.out.open("a", encoding="utf-8") as file:
                for pair in pairs:
                    about = {"task": asked.task, "protocol": protocol}
                    print(json.dumps(about | dict(zip(names, pair, strict=True))), file=file)
        theirs, ours, first, apart = np.array(pairs).T
        off = ours - theirs
        error = off.std(ddof=1) / len(off) ** 0.5 if len(off) > 1 else float("nan")
        cells = (protocol, f"{len(off)} ({refused} refused)", f"{theirs.mean():.3f}")
        cells += (f"{ours.mean():.3f}", f"{off.mean():+.3f} ± {error:.3f}")
        cells += (f"{first.max():.1e}", f"{apart.max():.1e}")
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
