"""How fast environments of models are, beside Gymnasium's own.

``python -m benchmarks.models.speed [--quick] [--json FILE]``. Both sides take the same actions in
the same process, in turns. Times are of this process: a step of one environment, and a step of one
of 64 worlds on two threads, in seconds of CPU and on the clock.

Then, for files of Gymnasium with its frame skip, a control step of ``mj_step`` with our settings,
of ``World.step``, of our environment with a compiled reward, and of Gymnasium's environment.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numba import njit

from benchmarks.models.gymnasium_tasks import PAIRS, Pair
from scm_world import World

WORLDS, THREADS = 64, 2
MICRO = 1e6
FILES = (
    *("InvertedPendulum-v5", "Reacher-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5"),
    "Humanoid-v5",
)
GOALS = {"single": 1.0, "per core": 1.3, "on the clock": 2.2}
RAW = {"normalize_observations": False, "normalize_actions": False}
ENDLESS = {**RAW, "max_episode_length": 10**9}


def single(env: Any, actions: Any, clock: Callable[[], float]) -> float:
    """Give the time of a step [µs]; nothing is reset on the way."""
    env.reset(seed=0)
    started = clock()
    for action in actions:
        env.step(action)
    return (clock() - started) / len(actions) * MICRO


def reset(env: Any, count: int) -> float:
    """Give the time of a reset [µs]."""
    started = time.process_time()
    for _ in range(count):
        env.reset()
    return (time.process_time() - started) / count * MICRO


def many(envs: Any, actions: Any, clock: Callable[[], float]) -> float:
    """Give the time for a step of one of many worlds [µs]; an episode that ends begins anew."""
    envs.reset(seed=0)
    envs.step(actions[0])  # from here on all are in their seats
    started = clock()
    for action in actions:
        envs.step(action)
    return (clock() - started) / (len(actions) * envs.num_envs) * MICRO


def bare(env: Any, actions: Any, clock: Callable[[], float]) -> float:
    """Give the time of the physics alone [µs]: ``mj_step`` on Gymnasium's own model."""
    inner = env.unwrapped
    env.reset(seed=0)
    model, data, skip = inner.model, inner.data, inner.frame_skip
    started = clock()
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, skip)
    return (clock() - started) / len(actions) * MICRO


def compare(pair: Pair, steps: int, rounds: int) -> dict[str, float]:
    """Measure one task, the sides in turns.

    Returns:
        Medians over rounds: times [µs], and how many times faster we are.
    """
    theirs = gymnasium.make(pair.id, **pair.options)
    ours = gymnasium.make("scm_world/Model-v0", model=pair.make(), **ENDLESS)
    envs = gymnasium.make_vec(
        "scm_world/Model-v0", WORLDS, model=pair.make(), threads=THREADS, copy=False, **ENDLESS
    )
    space, rng = theirs.action_space, np.random.default_rng(0)
    one: Any = rng.uniform(space.low, space.high, (steps, *space.shape)).astype(np.float32)
    few = max(2, 4 * steps // WORLDS)
    all_: Any = rng.uniform(space.low, space.high, (few, WORLDS, *space.shape)).astype(np.float32)
    for env in (theirs, ours):
        single(env, one[:50], time.perf_counter)
    many(envs, all_[:2], time.perf_counter)
    rows = [
        {
            "theirs": single(theirs, one, time.process_time),
            "ours": single(ours, one, time.process_time),
            "physics": bare(theirs, one, time.process_time),
            "batch, CPU": many(envs, all_, time.process_time),
            "batch, clock": many(envs, all_, time.perf_counter),
            "reset, theirs": reset(theirs, 50),
            "reset, ours": reset(ours, 50),
        }
        for _ in range(rounds)
    ]
    for env in (theirs, ours, envs):
        env.close()
    found = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
    ratios = {"single": "ours", "per core": "batch, CPU", "on the clock": "batch, clock"}
    return found | {
        name: float(np.median([row["theirs"] / row[side] for row in rows]))
        for name, side in ratios.items()
    }


@njit(cache=True)
def as_it_is(velocity: float) -> float:
    """Give a velocity as a reward."""
    return velocity


def control_step(id_: str, steps: int, rounds: int) -> dict[str, float]:
    """Measure control steps with one file of Gymnasium, the sides in turns.

    Returns:
        The least times of CPU [µs]; ``mj_step`` has the settings and the commands of ``World``.
    """
    theirs: Any = gymnasium.make(id_).unwrapped
    file, skip = theirs.fullpath, theirs.frame_skip
    world = World(file, frame_skip=skip, max_episode_length=10**9)
    reward = as_it_is, next(name for name in world.model if name.endswith(".velocity"))
    ours = gymnasium.make(
        "scm_world/Model-v0", model=file, frame_skip=skip, reward=reward, **ENDLESS
    )
    world.reset(seed=0)
    model: Any = world.backend.realization.model  # type: ignore[attr-defined]
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    low, high = world.action_low, world.action_high
    actions: Any = rng.uniform(low, high, (steps, low.size)).astype(np.float32)

    def physics() -> None:
        mujoco.mj_resetData(model, data)
        for action in actions:
            data.ctrl[: low.size] = action
            mujoco.mj_step(model, data, skip)

    def run(one: Any) -> None:
        one.reset(seed=0)
        for action in actions:
            one.step(action)

    sides: dict[str, Callable[[], None]] = {
        "mj_step": physics,
        "World": lambda: run(world),
        "ours": lambda: run(ours.unwrapped),
        "gymnasium": lambda: run(theirs),
    }
    least = dict.fromkeys(sides, float("inf"))
    for _ in range(rounds):
        for name, side in sides.items():
            started = time.process_time()
            side()
            least[name] = min(least[name], time.process_time() - started)
    for one in (theirs, ours, world):
        one.close()
    return {name: seconds / steps * MICRO for name, seconds in least.items()}


def main() -> None:
    """Compare all tasks, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few steps only")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    parser.add_argument("tasks", nargs="*", default=[*PAIRS], help=f"of {', '.join(PAIRS)}")
    given = parser.parse_args()
    steps, rounds = (200, 2) if given.quick else (2000, 9)
    found = {name: compare(PAIRS[name], steps, rounds) for name in given.tasks}
    for name, row in found.items():
        times = ", ".join(f"{key} {row[key]:.1f} µs" for key in row if key not in GOALS)
        ratios = ", ".join(f"{key} {row[key]:.2f} (goal {goal})" for key, goal in GOALS.items())
        print(f"{name}: {times}\n  times faster: {ratios}")
    for id_ in FILES:
        row = found[id_] = control_step(id_, *((100, 4) if given.quick else (200, 24)))
        times = ", ".join(f"{key} {value:.1f} µs" for key, value in row.items())
        world, ours = row["mj_step"] / row["World"], row["mj_step"] / row["ours"]
        print(
            f"{id_}: {times}\n  World : mj_step {world:.2f}, ours : mj_step {ours:.2f} (goal 0.9, "
            f"{row['ours'] - row['mj_step']:.1f} µs more), ours : gymnasium "
            f"{row['gymnasium'] / row['ours']:.2f} (goal 1.0)"
        )
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
