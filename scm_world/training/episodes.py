"""Episodes of many worlds while an agent is trained in them: counted, staggered, repeatable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray

from scm_world.curricula import CurriculumVectorEnv
from scm_world.env.batched.sheet import FLAGS, FRACTION, told
from scm_world.errors import UnreadableFile

FINAL = "final_obs", "final_info"
ADVICE = "give what state() gave, of as many worlds"


@final
@dataclass(frozen=True)
class Ended:
    """An episode that was played to its end.

    Attributes:
        total: Sum of its rewards.
        fraction: Fractional success at its last step, if the task has that.
        success: Whether it succeeded, if the task says so.
    """

    total: float
    fraction: float | None
    success: bool | None


@final
class Episodes(VectorWrapper):
    """Keeps the actions of the episodes under way, and how the finished ones ended.

    Worlds whose episodes are all of one length are forever at the same place of them, and so a
    batch shows one place only. Where they are staggered the first episode of world i of n is cut
    after a share (i + 1) / n of its length: it is truncated there, as at its end.

    Args:
        env: The worlds, in the autoreset mode ``SAME_STEP``.
        length: Control steps of an episode.
        staggered: Whether first episodes are cut.

    Attributes:
        ended: Finished episodes; whoever reads them empties the list. Those that were cut are
            not among them.
    """

    def __init__(self, env: CurriculumVectorEnv, length: int, *, staggered: bool) -> None:
        super().__init__(env)
        self._members: Any = env
        n = self.num_envs
        cuts = np.ceil(length * np.arange(1, n + 1) / n).astype(np.int64)
        self._cuts = np.where(cuts < length, cuts, 0) if staggered else np.zeros(n, np.int64)
        self._size = int(np.prod(env.single_action_space.shape or ()))
        self._actions = np.zeros((length + 1, n, self._size), np.float32)
        self._lengths, self._totals = np.zeros(n, np.int64), np.zeros(n)
        self._rows = np.arange(n)
        self.ended: list[Ended] = []

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all worlds."""
        self._lengths[:] = 0
        self._totals[:] = 0.0
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all worlds one control step."""
        given = np.asarray(actions, dtype=np.float32)
        self._actions[self._lengths, self._rows] = given
        observations, rewards, terminated, truncated, infos = self.env.step(given)
        self._lengths += 1
        self._totals += rewards
        done = terminated | truncated
        if done.any():
            last = infos["final_info"]
            for index in np.flatnonzero(done).tolist():
                self._finish(index, last)
        if self._cuts.any():
            observations, truncated, infos = self._cut(done, observations, truncated, infos)
        return observations, rewards, terminated, truncated, infos

    def _finish(self, index: int, last: Mapping[str, Any]) -> None:
        total = float(self._totals[index])
        fraction = float(last[FRACTION][index]) if FRACTION in last else None
        success = bool(last[FLAGS[0]][index]) if FLAGS[0] in last else None
        self.ended.append(Ended(total, fraction, success))
        self._begin(index)

    def _begin(self, index: Any) -> None:
        """Note that an episode begins, and that it is not the first one any more."""
        self._lengths[index], self._totals[index], self._cuts[index] = 0, 0.0, 0

    def _cut(
        self, done: NDArray[np.bool_], observations: Any, truncated: Any, infos: dict[str, Any]
    ) -> tuple[Any, Any, dict[str, Any]]:
        """End the first episodes that are long enough."""
        cut = (self._lengths == self._cuts) & (self._cuts > 0)
        if not cut.any():
            return observations, truncated, infos
        sheet = self._members.unwrapped.crew.sheet
        shown = infos["final_obs"] if "final_obs" in infos else np.full(len(cut), None, object)
        for index in np.flatnonzero(cut).tolist():
            shown[index] = sheet.observation(index)
        last = told(sheet.infos, cut)
        if "final_info" in infos:
            last = _joined(infos["final_info"], last, cut)
        seen, begun = self.env.reset(options={"reset_mask": cut})
        self._begin(cut)
        now = _joined({k: v for k, v in infos.items() if k.lstrip("_") not in FINAL}, begun, cut)
        ended = cut | done
        final = {"final_obs": shown, "_final_obs": ended, "final_info": last, "_final_info": ended}
        return seen, truncated | cut, {**now, **final}

    # --- the episodes that are under way ----------------------------------------------------------

    def state(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Give what takes other worlds to where these are: arrays, and plain data."""
        longest = int(self._lengths.max())
        taken = np.arange(longest)[:, None] < self._lengths
        arrays: dict[str, NDArray[Any]] = {
            "actions": self._actions[:longest] * taken[..., None],
            "lengths": self._lengths.copy(),
            "totals": self._totals.copy(),
            "cuts": self._cuts.copy(),
        }
        return arrays, self._members.running()

    def resume(self, arrays: Mapping[str, NDArray[Any]], running: Mapping[str, Any]) -> Any:
        """Go to where ``state`` was taken: all episodes under way are played again.

        Returns:
            The observations.

        Raises:
            UnreadableFile: It is something else.
        """
        n, lengths, actions = self.num_envs, arrays["lengths"], arrays["actions"]
        fits = all(arrays[name].shape == (n,) for name in ("lengths", "totals", "cuts"))
        fits = fits and actions.shape[1:] == (n, self._size)
        if not fits or len(actions) >= len(self._actions):
            raise UnreadableFile("the running episodes", "they have another shape", ADVICE)
        seen = self._members.rerun(running, actions, lengths)
        self._actions[: len(actions)] = actions
        self._lengths[:], self._totals[:] = lengths, arrays["totals"]
        self._cuts[:] = arrays["cuts"]
        return seen


def _joined(one: Mapping[str, Any], other: Mapping[str, Any], which: Any) -> dict[str, Any]:
    """Put infos together: those of some worlds from the one, of the rest from the other."""
    return {
        name: _joined(column, other[name], which)
        if isinstance(column, Mapping)
        else np.where(which if column.ndim == 1 else which[:, None], other[name], column)
        for name, column in one.items()
    }


@final
class ScaledRewards(VectorWrapper):
    """Divides rewards by the running standard deviation of the discounted return.

    Args:
        env: The worlds.
        gamma: Discount of a control step.

    Source:
        As ``VecNormalize`` of Stable-Baselines3 does; the variance is that of Chan et al., 1979.
    """

    LARGEST, SMALLEST = 10.0, 1e-8

    def __init__(self, env: Any, gamma: float) -> None:
        super().__init__(env)
        self._gamma = gamma
        self._returns = np.zeros(self.num_envs)
        self._count, self._mean, self._variance = 1e-4, 0.0, 1.0

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all worlds one control step."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self._returns = self._returns * self._gamma + rewards
        self._learn(float(self._returns.mean()), float(self._returns.var()), len(rewards))
        scaled = rewards / np.sqrt(self._variance + self.SMALLEST)
        self._returns[terminated | truncated] = 0.0
        return (
            observations,
            np.clip(scaled, -self.LARGEST, self.LARGEST),
            terminated,
            truncated,
            infos,
        )

    def _learn(self, mean: float, variance: float, count: int) -> None:
        total, apart = self._count + count, mean - self._mean
        spread = self._variance * self._count + variance * count
        self._variance = (spread + apart**2 * self._count * count / total) / total
        self._mean += apart * count / total
        self._count = total

    def state(self) -> dict[str, NDArray[Any]]:
        """Give what was learned, as arrays."""
        moments = np.array([self._count, self._mean, self._variance])
        return {"returns": self._returns.copy(), "moments": moments}

    def resume(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on where ``state`` was taken."""
        if arrays["returns"].shape != (self.num_envs,) or arrays["moments"].shape != (3,):
            raise UnreadableFile("the scale of the rewards", "it has another shape", ADVICE)
        self._returns = arrays["returns"].copy()
        self._count, self._mean, self._variance = map(float, arrays["moments"])
