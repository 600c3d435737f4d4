"""Living through a recorded episode again, and comparing every bit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scm_world.env import ScmWorldEnv
from scm_world.env.observer import Observation
from scm_world.errors import InterventionError
from scm_world.evaluation.recording.episodes import Recorded, parts, summed


def first_difference(env: ScmWorldEnv, episode: Recorded) -> str:
    """Live through an episode again, and say where it is another one.

    Args:
        env: Made like the one of the episode, but without interventions of its own.
        episode: What happened.

    Returns:
        The first control step that differs, and in what; empty if nothing does.
    """
    return next(_differences(env, episode), "")


def _differences(env: ScmWorldEnv, episode: Recorded) -> Iterator[str]:
    env.reset(seed=episode.seed, options={"episode": episode.number})
    yield from _at_instant(env, episode, 0)
    for step, action in enumerate(episode.actions):
        reward = env.step(action)[1]
        then = episode.rewards[step]
        if not _same(np.float64(reward), then):
            yield f"control step {step}: the reward is {reward!r}, not {float(then)!r}"
        yield from _at_instant(env, episode, step + 1)


def _at_instant(env: ScmWorldEnv, episode: Recorded, step: int) -> Iterator[str]:
    """Do what was done at an instant, and compare what it looks like then."""
    for plan in episode.done_at(step):
        try:
            env.do(plan.at_start())
        except InterventionError as error:
            yield f"control step {step}: an intervention is refused ({error})"
    if summed(env.world.current()[1].vector) != episode.states[step]:
        yield f"control step {step}: the true state"
    for name in _changed(env.observe(), episode.observations[step]):
        yield f"control step {step}: the observation{f' {name!r}' if name else ''}"


def _changed(now: Observation, then: Observation) -> Iterator[str]:
    mine, its = parts(now), parts(then)
    for name in sorted({*mine, *its}):
        if name not in mine or name not in its or not _same(mine[name], its[name]):
            yield name


def _same(one: NDArray[np.generic] | np.generic, other: NDArray[np.generic] | np.generic) -> bool:
    same = one.dtype == other.dtype and one.shape == other.shape
    return bool(same) and one.tobytes() == other.tobytes()
