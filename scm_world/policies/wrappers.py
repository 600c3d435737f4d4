"""What wrappers around an environment do to the observations of a policy."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any, NamedTuple, NoReturn, cast

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats, Observation
from scm_world.errors import ModelError, in_one_line

NEUTRAL = (
    *("Autoreset", "HumanRendering", "OrderEnforcing", "PassiveEnvChecker", "TimeLimit"),
    *("RecordEpisodeStatistics", "RecordVideo", "CurriculumEnv", "Monitor"),
    *("VecMonitor", "VecCheckNan", "VecVideoRecorder", "Episodes"),
)
"""Wrappers of Gymnasium, Stable-Baselines3 and this package that change no observation."""

AnySpace = gymnasium.Space[Any]
SAMPLES = 12
"""Observations with which a wrapper is tried."""


class LinearMap(NamedTuple):
    """A linear map of observations, shape (m, n), and the shift after it, shape (m,)."""

    weight: Floats
    bias: Floats

    def __call__(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Map observations, shape (..., n), to shape (..., m)."""
        found = np.asarray(observation, np.float64) @ self.weight.T + self.bias
        return found.astype(np.float32)


def seen_through(env: object) -> LinearMap | None:
    """Return the linear map that wrappers apply to an observation; None if they change nothing.

    Each wrapper is copied and tried with drawn observations and actions; the environment is left
    alone. Running means stay as they are now.

    Args:
        env: An environment of this package, or many, in any wrappers.

    Raises:
        ModelError: A wrapper changes actions, or observations in another way than linearly.
    """
    found: LinearMap | None = None
    for wrapper in reversed([*_wrappers(env)]):
        outer = _map_of(wrapper)
        if found is None or outer is None:
            found = found or outer
        else:
            weight = outer.weight @ found.weight
            found = LinearMap(weight, outer.weight @ found.bias + outer.bias)
    return found


def samples(space: AnySpace, count: int = SAMPLES, seed: int = 0) -> list[Any]:
    """Draw observations of a space; numbers without bounds, or with wide ones, lie in [-3, 3]."""
    if isinstance(space, gymnasium.spaces.Dict):
        parts = {
            name: samples(part, count, seed + k) for k, (name, part) in enumerate(space.items())
        }
        return [{name: drawn[row] for name, drawn in parts.items()} for row in range(count)]
    box = cast("gymnasium.spaces.Box", space)
    low, high = np.clip(box.low, -3.0, None), np.clip(box.high, None, 3.0)
    draw = np.random.default_rng(seed).random((count, *box.shape))
    drawn = low + draw * np.where(high > low, high - low, 1.0)
    return [*drawn.astype(box.dtype)]


def _wrappers(env: Any) -> Iterator[Any]:
    """List wrappers, the outer ones first; of many environments also those of the first one."""
    while True:
        inner = getattr(env, "venv", None) or vars(env).get("worlds")
        if inner is None and isinstance(env, gymnasium.Wrapper | gymnasium.vector.VectorWrapper):
            inner = env.env
        if inner is not None:
            yield env
        elif not hasattr(env, "envs"):
            break
        env = env.envs[0] if inner is None else inner
    if hasattr(env, "get_attr"):  # in processes
        (spec, *_) = env.get_attr("spec")
        for one in () if spec is None else spec.additional_wrappers:
            if one.name not in NEUTRAL:
                _refuse(one.name, "is in another process, where it cannot be tried")


def _map_of(wrapper: Any) -> LinearMap | None:
    name = type(wrapper).__name__
    if name in NEUTRAL or hasattr(wrapper, "worlds"):
        return None
    if name == "VecNormalize":
        return _normalized(wrapper) if wrapper.norm_obs else None
    if hasattr(wrapper, "venv"):
        _refuse(name, "is not known not to change observations")
    try:
        return _tried(wrapper)
    except ModelError:
        raise
    except Exception as error:  # of many kinds: it is a user's
        _refuse(name, f"cannot be tried alone ({in_one_line(error)})")


def _refuse(name: str, why: str) -> NoReturn:
    advice = "a policy keeps running means and linear maps of an observation that is one vector"
    raise ModelError([f"the wrapper {name} {why}, and the policy was trained in it; {advice}"])


def _normalized(wrapper: Any) -> LinearMap:
    """Return the map of Stable-Baselines3's ``VecNormalize``, where it cuts nothing off."""
    space = wrapper.venv.observation_space
    if not isinstance(space, gymnasium.spaces.Box):
        _refuse("VecNormalize", "normalises parts of an observation")
    running = wrapper.obs_rms
    gain = 1.0 / np.sqrt(running.var + wrapper.epsilon)
    found = LinearMap(np.diag(gain), -running.mean * gain)
    ends = [np.asarray(end, np.float64) * gain + found.bias for end in (space.low, space.high)]
    if np.max(np.abs(ends)) > wrapper.clip_obs:
        _refuse("VecNormalize", f"cuts numbers off at {wrapper.clip_obs:g} (give clip_obs=np.inf)")
    return found


def _tried(wrapper: Any) -> LinearMap | None:
    """Return the map of a wrapper, found by showing it drawn observations."""
    many, name = isinstance(wrapper, gymnasium.vector.VectorWrapper), type(wrapper).__name__
    probe = _probe(wrapper.env, many=many)
    tried = copy.deepcopy(wrapper, {id(wrapper.env): probe})
    if hasattr(tried, "update_running_mean"):
        tried.update_running_mean = False
    space = wrapper.env.single_observation_space if many else wrapper.env.observation_space
    actions = iter(samples(wrapper.action_space, 10_000, seed=1))

    def show(observation: Observation, *, begin: bool = False) -> Any:
        probe.shown = observation
        if begin:
            found = tried.reset()[0]
        else:
            action = next(actions)
            found = tried.step(action)[0]
            if not np.allclose(action, probe.taken, rtol=1e-6, atol=1e-6):
                _refuse(name, "changes actions")
        return found[0] if many and not isinstance(found, dict) else found

    given = samples(space)
    found = [show(one, begin=row == 0) for row, one in enumerate(given)]
    expected = given
    if many and isinstance(space, gymnasium.spaces.Dict):
        expected = [_batched(one, wrapper.num_envs) for one in given]
    if all(data_equivalence(*pair) for pair in zip(expected, found, strict=True)):
        return None
    if not (isinstance(space, gymnasium.spaces.Box) and np.ndim(found[0]) == len(space.shape) == 1):
        _refuse(name, "changes observations")
    base, other = given[:2]
    columns = []
    for place in range(base.size):
        moved = base.copy()
        moved[place] = other[place]
        columns.append((show(moved) - found[0].astype(float)) / (moved[place] - float(base[place])))
    weight = np.stack(columns, axis=-1)
    linear = LinearMap(weight, found[0] - weight @ base)
    if not np.allclose([linear(one) for one in given], found, rtol=1e-3, atol=1e-3):
        _refuse(name, "changes observations, and not linearly")
    return linear


def _probe(env: Any, *, many: bool) -> Any:
    """Return an environment that shows ``shown``, and keeps its last action as ``taken``."""
    probe: Any = (gymnasium.vector.VectorWrapper if many else gymnasium.Wrapper)(env)
    none = np.zeros(env.num_envs, bool) if many else False

    def shown() -> Any:
        return _batched(probe.shown, env.num_envs) if many else copy.deepcopy(probe.shown)

    def step(action: object) -> tuple[Any, ...]:
        probe.taken = action
        return shown(), 0.0 * none, none, none | none, {}

    probe.reset, probe.step = lambda **_: (shown(), {}), step
    return probe


def _batched(observation: Observation, count: int) -> Any:
    """Return an observation for each of many environments."""
    if isinstance(observation, dict):
        return {name: _batched(part, count) for name, part in observation.items()}
    return np.repeat(observation[None], count, axis=0)
