"""Resets, interventions, snapshots, and the making of environments."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.scenes import CASES, ENGINES, SEED, Case, actions, cases
from benchmarks.speed.subprocesses import answer, asked
from benchmarks.speed.timing import MILLI, Settings, micros
from scm_world.curricula import CurriculumEnv, everything
from scm_world.env import ScmWorldEnv

TIMES = 40
BETWEEN = 5  # control steps before every reset
INTO = 30  # control steps into the episode, from which on snapshots are taken
DISTANCE = 20  # control steps after a snapshot, before it is restored


def changing(settings: Settings) -> dict[str, Any]:
    """Time resets, interventions and snapshots of every scene, each after control steps [µs].

    Caches are cold then, as they are in use; in a tight loop everything is faster.
    """
    return {
        engine: {case.name: changes(case, engine, settings) for case in cases(settings)}
        for engine in ENGINES
    }


def changes(case: Case, engine: str, settings: Settings) -> dict[str, float]:
    """Time what can be done to one environment."""
    env = case.env(engine)
    times = settings.steps(case.steps(TIMES))
    found: dict[str, float] = {"blocks": case.blocks}
    found["reset [µs]"] = after(env, BETWEEN, lambda: env.reset(seed=SEED), times)
    for title, request in requests(case, env, ENGINES.index(engine)).items():
        found[f"do: {title} [µs]"] = statistics.median(
            doing(env, request()) for _ in range(times + 2)
        )
    found |= compared(case, env, engine, found["reset [µs]"], times)
    env.reset(seed=SEED)
    for action in actions(INTO):
        env.step(action)
    found["snapshot [µs]"] = after(env, 1, env.world.snapshot, times)
    saved = env.world.snapshot()
    found["restore [µs]"] = after(env, DISTANCE, lambda: env.world.restore(saved), times // 2)
    env.close()
    return found


def compared(
    case: Case, env: ScmWorldEnv, engine: str, reset: float, times: int
) -> dict[str, float]:
    """Compare with a reset: an intervention after which there are other bodies, or many draws.

    Where which bodies there are is a variable, the structure is compiled anew every time, but for
    the engine; elsewhere everything is drawn from space A at the reset.
    """
    world = env.world
    if not len(world.structures.head):
        drawn = CurriculumEnv(case.env(engine), everything("A"))
        drawn.reset(seed=SEED)
        spent = after(drawn, BETWEEN, drawn.reset, times)
        drawn.close()
        return {"reset, all drawn, to reset": spent / reset}
    spent = []
    for _ in range(times // 4 + 2):
        env.reset(seed=SEED)
        wanted = next(iter(world.task.nearby(world.values())))
        world.structures.compiled.cache_clear()
        spent.append(micros(partial(world.do, wanted)))
    return {"do: bodies, to reset": statistics.median(spent[2:]) / reset}


def after(env: Any, steps: int, act: Callable[[], Any], times: int) -> float:
    """Time something after some control steps, as a median [µs]."""
    rest, found = at_rest(env.unwrapped), []
    for _ in range(times + 2):
        for _ in range(steps):
            env.step(rest)
        found.append(micros(act))
    return statistics.median(found[2:])


def doing(env: ScmWorldEnv, wanted: dict[str, Any]) -> float:
    """Time an intervention after the first control step of an episode [µs]."""
    env.reset(seed=SEED)
    env.step(at_rest(env))
    return micros(lambda: env.world.do(wanted))


def at_rest(env: ScmWorldEnv) -> NDArray[np.float32]:
    """Give the action that holds the robot where it is, shape (9,)."""
    return env.as_action(env.world["joint_positions"]).astype(np.float32)


def requests(case: Case, env: ScmWorldEnv, turn: int) -> dict[str, Callable[[], dict[str, Any]]]:
    """Give interventions: on the last block, on which nothing stands, and on what all share.

    Where a block begins depends on its size: for the size, one is chosen that has room. Every
    engine draws its own values: piles that were computed for one are known to the other.
    """
    world, draws = env.world, np.random.default_rng([SEED, turn])
    block, sized = world.structure.blocks[-1], world.structure.blocks[case.sized]
    edges = np.array(world[f"{sized}.size"])
    up = np.array([0.0, 0.0, 0.02])  # [m]
    lies = np.array(world[f"{block}.cylindrical_position"])
    size = "block.size" if "block.size" in world.model else f"{sized}.size"
    return {
        "mass": lambda: {f"{block}.mass": draws.uniform(0.03, 0.09)},
        "friction": lambda: {"floor_friction": draws.uniform(0.4, 0.7)},
        "pose": lambda: {f"{block}.cylindrical_position": lies + up * draws.uniform(0.5, 1.0)},
        "size": lambda: {size: edges * draws.uniform(0.9, 1.0)},
        "gravity": lambda: {"gravity": [0.0, 0.0, draws.uniform(-10.0, -8.0)]},
        "color": lambda: {f"{block}.color": draws.random(3)},
        "link mass": lambda: {"robot_finger_60_link_2.mass": draws.uniform(0.1, 0.2)},
    }


# --- making ---------------------------------------------------------------------------------------


def making(settings: Settings) -> dict[str, Any]:
    """Time construction and first reset in fresh processes, and a second time in each [ms]."""
    return {
        engine: {
            case.name: made(case, engine, 1 if settings.quick else 3) for case in cases(settings)
        }
        for engine in ENGINES
    }


def made(case: Case, engine: str, processes: int) -> dict[str, float]:
    """Make an environment twice in each of some processes; medians."""
    rows = [asked("changing", case.name, engine) for _ in range(processes)]
    first, second = (statistics.median(times) for times in zip(*rows, strict=True))
    return {"blocks": case.blocks, "first [ms]": first, "second [ms]": second}


def main() -> None:
    """Make an environment twice, and print the times."""
    name, engine = sys.argv[1:]
    case = next(case for case in CASES if case.name == name)
    times = []
    for _ in range(2):
        started = time.perf_counter()
        env = case.env(engine)
        times.append((time.perf_counter() - started) * MILLI)
        env.step(actions(1)[0])
        env.close()
    answer(times)


if __name__ == "__main__":
    main()
