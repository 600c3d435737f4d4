"""Many worlds for Stable-Baselines3, whose vector interface is not Gymnasium's."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from scm_world.env.batched import Crew, ScmWorldVectorEnv
from scm_world.errors import UnknownOption
from scm_world.graph.exchange.libraries import load

USUAL = ("is_success",)
"""What is told of ``info`` if nothing else is asked for, where the task has it."""
FINAL = ("final_obs", "final_info")

Indices = int | Iterable[int] | None


def sb3_vec_env(envs: VectorEnv[Any, Any, Any], infos: Sequence[str] | None = USUAL) -> Any:
    """Give many worlds the interface of Stable-Baselines3's ``VecEnv``.

    Rewards, observations and flags are those that its ``DummyVecEnv`` makes of as many single
    environments, value by value.

    Args:
        envs: With ``autoreset_mode="SameStep"``; wrappers of Gymnasium may be around it.
        infos: What is told of ``info`` at every step; all of it if None. Building dictionaries
            takes time: the algorithms read ``is_success`` alone, besides what ends an episode.

    Returns:
        A ``stable_baselines3.common.vec_env.VecEnv``.

    Raises:
        MissingExtra: Stable-Baselines3 is not installed.
        UnknownOption: Episodes do not begin in the step that ends the last one, or nothing in
            ``info`` has such a name.
    """
    mode = envs.metadata.get("autoreset_mode")
    if mode is not AutoresetMode.SAME_STEP:
        raise UnknownOption("autoreset_mode", mode, (AutoresetMode.SAME_STEP.value,))
    if not isinstance(envs.unwrapped, ScmWorldVectorEnv):
        raise UnknownOption("envs", envs, ("what gymnasium.make_vec makes of a task",))
    return _adapter()(envs, infos)


def make_sb3(
    env_id: str, num_envs: int, *, infos: Sequence[str] | None = USUAL, **options: Any
) -> Any:
    """Make many worlds for Stable-Baselines3.

    Args:
        env_id: Such as ``"scm_world/Pushing-v0"``.
        num_envs: How many.
        infos: As in ``sb3_vec_env``.
        options: Of ``gymnasium.make_vec``.

    Returns:
        A ``stable_baselines3.common.vec_env.VecEnv``.

    Raises:
        MissingExtra: Stable-Baselines3 is not installed.
    """
    import gymnasium

    _adapter()  # before processes are started for nothing
    mode = AutoresetMode.SAME_STEP
    return sb3_vec_env(gymnasium.make_vec(env_id, num_envs, autoreset_mode=mode, **options), infos)


@functools.cache
def _adapter() -> Any:
    """Make the class, which is one of Stable-Baselines3's, when it is first needed."""
    base = load("stable_baselines3.common.vec_env", "stable-baselines3", "train").VecEnv
    return type("Sb3VecEnv", (_Adapted, base), {"__doc__": _Adapted.__doc__})


class _Adapted:
    """Many worlds behind Stable-Baselines3's vector interface; see ``sb3_vec_env``.

    Args:
        envs: The worlds.
        infos: What is told of ``info``.

    Attributes:
        worlds: For all that Stable-Baselines3 knows nothing of: ``do``, ``branch``, …
        reset_infos: What was told at the last reset of each.
    """

    num_envs: int
    render_mode: str | None
    reset_infos: list[dict[str, Any]]
    _seeds: list[int | None]
    _options: list[dict[str, Any]]
    _reset_seeds: Callable[[], None]
    _reset_options: Callable[[], None]
    _get_indices: Callable[[Indices], Iterable[int]]

    def __init__(self, envs: VectorEnv[Any, Any, Any], infos: Sequence[str] | None) -> None:
        self.worlds: Any = envs
        bare: Any = envs.unwrapped
        self._crew: Crew = bare.crew
        self._names = None if infos is None else tuple(infos)
        if self._names is not None:
            form = self._crew.sheet.infos
            self._names = tuple(n for n in self._names if n in form or n not in USUAL)
            for name in self._names:
                if name not in form:
                    raise UnknownOption("info", name, form)
        initialize: Any = super().__init__
        initialize(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Begin an episode in all of them, with the seeds and options that were set before."""
        names = {name: None for mine in self._options for name in mine}
        given = {name: [mine.get(name) for mine in self._options] for name in names}
        observations, infos = self.worlds.reset(seed=list(self._seeds), options=given or None)
        self.reset_infos = _rows(infos, None, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all of them one control step; what is done begins anew at once."""
        observations, rewards, terminated, truncated, infos = self.worlds.step(self._actions)
        done = terminated | truncated
        told = _rows(infos, self._names, self.num_envs)
        for info in told:
            info["TimeLimit.truncated"] = False
        if done.any():
            begun = _rows(infos, None, self.num_envs)
            ended = _rows(infos["final_info"], self._names, self.num_envs)
            for index in np.flatnonzero(done).tolist():
                self.reset_infos[index] = begun[index]
                told[index] = {
                    **ended[index],
                    "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                    "terminal_observation": infos["final_obs"][index],
                }
        return observations, rewards.astype(np.float32), done, told

    def close(self) -> None:
        """Free what simulates."""
        self.worlds.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Look an attribute of some worlds up."""
        return self._crew.attribute(self._chosen(indices), attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of some worlds to one value."""
        self._crew.assign(attr_name, dict.fromkeys(self._chosen(indices), value))

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of some worlds."""
        return self._crew.call(self._chosen(indices), method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Tell whether worlds are in a wrapper: none is, one by one."""
        return [False for _ in self._chosen(indices)]

    def get_images(self) -> list[Any]:
        """Draw every world."""
        return list(self.worlds.render() or ())

    def _chosen(self, indices: Indices) -> list[int]:
        return [range(self.num_envs)[index] for index in self._get_indices(indices)]


def _rows(infos: Mapping[str, Any], names: Sequence[str] | None, size: int) -> list[dict[str, Any]]:
    """Give every world its own dictionary of what all of them told.

    Example:
        >>> _rows({"x": np.array([1.0, 2.0]), "_x": np.array([True, True])}, None, 2)
        [{'x': 1.0}, {'x': 2.0}]
    """
    if names is None:
        names = [name for name in infos if f"_{name}" in infos and name not in FINAL]
    columns = [_listed(infos[name], size) for name in names]
    if len(columns) == 1:
        (name,) = names
        return [{name: value} for value in columns[0]]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)] or [
        {} for _ in range(size)
    ]


def _listed(column: Any, size: int) -> list[Any]:
    if isinstance(column, dict):
        return _rows(column, None, size)
    return column.tolist() if column.ndim == 1 else list(column)
