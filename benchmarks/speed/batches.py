"""Many worlds at once: on one thread and on two, and beside the engine alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.growth import line
from benchmarks.speed.predecessor import Predecessor, running
from benchmarks.speed.scenes import GENERAL, PUSHING, SEED, Case, actions, bare, commands
from benchmarks.speed.timing import MICRO, Settings, in_turns, medians, on, ratio
from scm_world.env import IDS

WORLDS, FEW = 64, 8
STEPS, ROUNDS = 40, 7
LENGTH = 250  # of an episode [control steps]
ENOUGH = 300  # control steps: every world ends an episode once
SIZES = (1, 2, 4, 8, 16, 32, 64)
NAMES = {task: name for name, task in IDS.items()}
Clock = Callable[[], float]


def vector(case: Case, worlds: int, **how: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make a vector environment, and begin."""
    envs = gymnasium.make_vec(NAMES[case.task], num_envs=worlds, **how)
    envs.reset(seed=SEED)
    return envs


def batching(settings: Settings) -> dict[str, Any]:
    """Measure 64 worlds on both engines."""
    worlds = FEW if settings.quick else WORLDS
    compared = (PUSHING,) if settings.quick else (PUSHING, GENERAL)
    found: dict[str, Any] = {"worlds": worlds, "mujoco": {}, "bullet": {}}
    for case in compared:
        found["mujoco"][case.name] = {
            **beside_the_engine(case, worlds, settings),
            **living(case, worlds, settings),
            **together(case, worlds, settings, "mujoco", "threads"),
        }
        found["bullet"][case.name] = together(case, worlds, settings, "bullet", "workers")
        found[f"cost over worlds: {case.name}"] = over_worlds(case, settings)
    return found


def running_side(
    envs: gymnasium.vector.VectorEnv[Any, Any, Any], given: NDArray[np.float32], clock: Clock
) -> Callable[[], float]:
    """Give what steps all worlds from a reset on, and the time for each world's step [µs]."""

    def live() -> float:
        envs.reset(seed=SEED)
        started = clock()
        for action in given:
            envs.step(action)
        return (clock() - started) / (len(given) * envs.num_envs) * MICRO

    return live


def beside_the_engine(case: Case, worlds: int, settings: Settings) -> dict[str, float]:
    """Compare one thread with a plain loop over as many scenes that the engine alone steps.

    Seeds and actions are the same, so the engine does the same work.
    """
    given = actions(settings.steps(STEPS), worlds)
    batch, singles = vector(case, worlds, threads=1), [case.env("mujoco") for _ in range(worlds)]
    told = [commands(env, given[:, i]) for i, env in enumerate(singles)]

    def raw() -> float:
        for i, env in enumerate(singles):
            env.reset(seed=SEED + i)
        alone = [bare(env) for env in singles]
        started = time.process_time()
        for step in range(len(given)):
            for i, act in enumerate(alone):
                act(told[i][step])
        return (time.process_time() - started) / (len(given) * worlds) * MICRO

    sides = {"batch": running_side(batch, given, time.process_time), "raw": raw}
    rows = in_turns(sides, settings.rounds(ROUNDS))
    batch.close()
    for env in singles:
        env.close()
    times = medians(rows)
    return {
        "step of a world [µs]": times["batch"],
        "raw physics [µs]": times["raw"],
        "vector layer, of raw": ratio(rows, "batch", "raw") - 1.0,
    }


def living(case: Case, worlds: int, settings: Settings) -> dict[str, float]:
    """Count control steps in a second of the processor, with every reset that falls due."""
    length, steps = settings.steps(LENGTH), settings.steps(ENOUGH)
    envs = vector(case, worlds, threads=1, max_episode_length=length)
    given = actions(steps, worlds)
    ended, started = 0, time.process_time()
    for action in given:
        _, _, terminated, truncated, _ = envs.step(action)
        ended += int(np.count_nonzero(terminated | truncated))
    spent = time.process_time() - started
    envs.close()
    return {
        "control steps per CPU-second": given.shape[0] * worlds / spent,
        "episodes that ended": float(ended),
    }


def together(
    case: Case, worlds: int, settings: Settings, engine: str, hands: str
) -> dict[str, float]:
    """Compare one and two threads (or workers) by the clock on the wall, and the predecessor.

    The predecessor is one process with one world; its time is that of the processor.
    """
    given = actions(settings.steps(STEPS), worlds)
    with on(settings.cores), running(settings) as its:
        envs = {n: vector(case, worlds, backend=engine, **{hands: n}) for n in (1, 2)}
        sides = {
            f"{n} {hands}": running_side(env, given, time.perf_counter) for n, env in envs.items()
        }
        if its is not None:
            sides["predecessor"] = theirs(its, case, given)
        rows = in_turns(sides, settings.rounds(ROUNDS))
        for env in envs.values():
            env.close()
    found = {
        f"{side}, {'wall' if side[0].isdigit() else 'processor'} [µs]": value
        for side, value in medians(rows).items()
    }
    found[f"2 {hands} to 1: ratio"] = ratio(rows, f"1 {hands}", f"2 {hands}")
    if "predecessor" in rows:
        found["predecessor: ratio"] = ratio(rows, "predecessor", f"2 {hands}")
    return found


def theirs(its: Predecessor, case: Case, given: NDArray[np.float32]) -> Callable[[], float]:
    """Let the predecessor take the actions of the first world."""
    its.ask("make", task=case.task, options={}, seed=SEED)
    first = given[:, 0].tolist()
    return lambda: float(its.ask("step", actions=first))


def over_worlds(case: Case, settings: Settings) -> dict[str, Any]:
    """Fit a line to the time of a control step over the number of worlds, on one thread."""
    steps, sizes = settings.steps(STEPS), SIZES[:4] if settings.quick else SIZES
    envs = {size: vector(case, size, threads=1) for size in sizes}
    sides = {
        str(size): running_side(env, actions(steps, size), time.process_time)
        for size, env in envs.items()
    }
    times = medians(in_turns(sides, settings.rounds(5)))
    for env in envs.values():
        env.close()
    each = {f"{size} [µs]": times[str(size)] for size in sizes}
    whole = [times[str(size)] * size / MICRO for size in sizes]
    return {**each, **line(sizes, whole, "another world [µs]", MICRO)}
