"""Many worlds for Stable-Baselines3, whose vector interface is not Gymnasium's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast, final

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from scm_world._arguments import missing, one_of
from scm_world.env.observer import FAILED
from scm_world.errors import UnknownOption

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise missing(error, "stable_baselines3", "stable-baselines3", "train") from error

USUAL = ("is_success", FAILED)
"""Keys of ``info`` that are passed on by default, where there are such."""
Indices = int | Iterable[int] | None
PURE = ("get_wrapper_attr", "compute_reward")
"""Methods that change nothing, so that worlds in processes may be called in vain."""


def make_sb3(
    env_id: str, num_envs: int, *, infos: Sequence[str] | None = USUAL, **options: object
) -> Sb3VecEnv:
    """Make many worlds for Stable-Baselines3.

    Args:
        env_id: Such as ``"scm_world/Pushing-v0"``.
        num_envs: How many.
        infos: As in ``Sb3VecEnv``.
        options: Of ``gymnasium.make_vec``.
    """
    given: dict[str, Any] = {**options, "autoreset_mode": AutoresetMode.SAME_STEP}
    return Sb3VecEnv(gymnasium.make_vec(env_id, num_envs, **given), infos)


@final
class Sb3VecEnv(VecEnv):
    """Many worlds behind the interface of Stable-Baselines3's ``VecEnv``.

    Rewards, observations and flags are those that its ``DummyVecEnv`` makes of as many single
    environments, value by value.

    Args:
        envs: With ``autoreset_mode="SameStep"``; wrappers of Gymnasium may be around it.
        infos: Keys of ``info`` that are passed on at every step; all if None. Building dictionaries
            takes time; the algorithms read ``is_success`` and the keys that end an episode.

    Attributes:
        worlds: For all that Stable-Baselines3 knows nothing of: ``do``, ``branch``, …
        names: Keys of ``info`` that are passed on at every step; all if None.

    Raises:
        UnknownOption: Episodes do not begin in the step that ends the last one, or nothing in
            ``info`` has such a name.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], infos: Sequence[str] | None = USUAL) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise UnknownOption("autoreset_mode", mode, (AutoresetMode.SAME_STEP.value,))
        self.worlds = cast("Any", envs)  # Gymnasium's type has neither `do` nor `get_attr`
        self._members = self.worlds.unwrapped
        try:
            (shapes, *_) = self._members.get_attr("info_shapes")
        except AttributeError:
            allowed = ("what gymnasium.make_vec makes of a task",)
            raise UnknownOption("envs", envs, allowed) from None
        known = (*shapes, "reward_terms")
        self.names = infos and tuple(name for name in infos if name in known or name not in USUAL)
        for name in self.names or ():
            one_of("info", name, known)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Begin an episode in all of them, with the seeds and options that were set before."""
        found: list[dict[str, Any]] = []
        which = [*np.eye(self.num_envs, dtype=bool)] if any(self._options) else [None]
        for index, mask in enumerate(which):  # each with its options, if one has some
            given = None if mask is None else {**self._options[index], "reset_mask": mask}
            observations, infos = self.worlds.reset(seed=list(self._seeds), options=given)
            rows = _rows(infos, None, self.num_envs)
            found = [*found[:index], *rows[index:]]
        self.reset_infos = found
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all of them one control step; environments that are done are reset."""
        observations, rewards, terminated, truncated, infos = self.worlds.step(self._actions)
        done = terminated | truncated
        rows = _rows(infos, self.names, self.num_envs)
        for info in rows:
            info["TimeLimit.truncated"] = False
        if done.any():
            begun = _rows(infos, None, self.num_envs)
            ended = _rows(infos["final_info"], self.names, self.num_envs)
            for index in np.flatnonzero(done).tolist():
                self.reset_infos[index] = begun[index]
                rows[index] = {
                    **ended[index],
                    "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                    "terminal_observation": infos["final_obs"][index],
                }
        return observations, rewards.astype(np.float32), done, rows

    def close(self) -> None:
        """Free the engines."""
        self.worlds.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of some worlds."""
        return self.env_method("get_wrapper_attr", attr_name, indices=indices)

    def set_attr(self, attr_name: str, value: object, indices: Indices = None) -> None:
        """Set an attribute of some worlds to one value."""
        self.env_method("set_wrapper_attr", attr_name, value, indices=indices)

    def env_method(
        self,
        method_name: str,
        *method_args: object,
        indices: Indices = None,
        **method_kwargs: object,
    ) -> list[Any]:
        """Call a method of some worlds."""
        chosen = self._chosen(indices)
        if hasattr(self._members, "envs"):
            methods = [self._members.envs[i].get_wrapper_attr(method_name) for i in chosen]
            return [method(*method_args, **method_kwargs) for method in methods]
        if {*chosen} != {*range(self.num_envs)} and method_name not in PURE:
            allowed = ("None: worlds in processes do the same", "workers=1")
            raise UnknownOption(f"indices for {method_name}", indices, allowed)
        found = self._members.call(method_name, *method_args, **method_kwargs)
        return [found[index] for index in chosen]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Return False for each world: it is in no wrapper of its own."""
        return [False for _ in self._chosen(indices)]

    def get_images(self) -> list[Any]:
        """Draw every world."""
        return list(self.worlds.render() or ())

    def _chosen(self, indices: Indices) -> list[int]:
        return [range(self.num_envs)[index] for index in self._get_indices(indices)]


def _rows(infos: Mapping[str, Any], names: Sequence[str] | None, size: int) -> list[dict[str, Any]]:
    """Split the batched ``infos`` into one dictionary for each environment."""
    if names is None:
        final = ("final_obs", "final_info")
        names = [name for name in infos if f"_{name}" in infos and name not in final]
    columns = []
    for name in names:
        column = infos[name]
        if isinstance(column, dict):
            columns.append(_rows(column, None, size))
        else:
            columns.append(column.tolist() if column.ndim == 1 else list(column))
    rows = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
    return rows or [{} for _ in range(size)]
