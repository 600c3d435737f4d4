"""A wrapper that remembers episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.env import ScmWorldEnv
from scm_world.env.given import doubles, names_of
from scm_world.env.observer import Observation
from scm_world.errors import NotReset, UnknownOption
from scm_world.evaluation.policies import as_player
from scm_world.evaluation.policies.players import inner
from scm_world.evaluation.recording.environments import environment
from scm_world.evaluation.recording.episodes import Recorded, summed
from scm_world.evaluation.recording.recording import Recording
from scm_world.output.locations import Location
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan
from scm_world.world.start import whole_number

INFOS = ("success", "fractional_success")
ALL = "all"
_CHANGING = (gymnasium.ActionWrapper, gymnasium.ObservationWrapper, gymnasium.RewardWrapper)
_PLAIN = (bool, int, float)
_NUMBERS = (*_PLAIN, np.bool_, np.integer, np.floating)


@dataclass
class _Episode:
    """What has been seen of an episode so far."""

    seed: int
    number: int
    observations: list[Observation] = field(default_factory=list)
    infos: list[dict[str, Any]] = field(default_factory=list)
    states: list[Floats] = field(default_factory=list)
    actions: list[NDArray[Any]] = field(default_factory=list)
    returns: list[tuple[float, bool, bool]] = field(default_factory=list)
    interventions: tuple[tuple[int, Mapping[str, Any]], ...] = ()


@final
class Recorder(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Remembers whole episodes of an environment, so that they can be lived through again.

    Interventions count, whoever makes them: at the reset, by ``env.unwrapped.do`` or by a wrapper
    above or below. What is remembered of an instant is what it looked like after them, which is
    what the next action met. An episode without any step is forgotten.

    Args:
        env: Made by this package. Wrappers that change actions, observations or rewards come
            above the recorder.
        infos: Names in ``info`` that are kept; ``"all"`` for all numbers that every instant has,
            terms of the reward as ``"reward_terms.…"``; None for success and fractional success,
            if the task has them.

    Raises:
        UnknownOption: The environment is none of this package, or a wrapper changes it.

    Example:
        >>> env = Recorder(gymnasium.make("scm_world/Pushing-v0", backend="fake"))
        >>> _ = env.reset(seed=0, options={"do": {"tool_block.mass": "A"}})
        >>> _ = env.step(np.zeros(9, np.float32))
        >>> _ = env.unwrapped.do({"floor_friction": 0.4})
        >>> env.recording()
        Recording of 1 episode, 1 control step, of pushing
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], infos: Sequence[str] | str | None = None
    ) -> None:
        RecordConstructorArgs.__init__(self, infos=infos)
        super().__init__(env)
        self._inner = inner(env)
        _refuse_changes(env, self._inner)
        model = self._inner.world.model
        chosen = tuple(name for name in INFOS if name in model) if infos is None else infos
        self._wanted = chosen if chosen == ALL else names_of("infos", chosen)
        self._made: list[Recorded] = []
        self._now: _Episode | None = None
        self._version = -1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the last one is kept.

        Raises:
            UnknownOption: ``info`` has no such name as one that should be kept.
        """
        self._keep()
        observation, info = self.env.reset(seed=seed, options=options)
        world = self._inner.world
        self._now = _Episode(world.noise.seed, world.episode)
        self._write(self._now, observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            NotReset: There is no episode.
        """
        episode = self._now
        if episode is None:
            raise NotReset
        self._look_again(episode)
        taken = _as_given(action, self._inner.world.declaration.n_actions)
        observation, reward, terminated, truncated, info = self.env.step(action)
        episode.actions.append(taken)
        episode.returns.append((float(reward), bool(terminated), bool(truncated)))
        self._write(episode, observation, info)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Keep the last episode, and free the engine."""
        self._keep()
        super().close()

    def recording(self, policy: Mapping[str, Any] | None = None) -> Recording:
        """Give all episodes so far, the present one included.

        Args:
            policy: What acted, if that is to be written down.
        """
        present = self._recorded()
        episodes = (*self._made, *([present] if present else []))
        made_with = versions(self._inner.world.engine)
        return Recording(environment(self._inner), episodes, made_with, policy)

    # --- the present episode ------------------------------------------------------------------

    def _write(
        self,
        episode: _Episode,
        observation: Any,
        info: Mapping[str, Any],
        before: Mapping[str, Any] | None = None,
    ) -> None:
        """Write down an instant; ``before`` is what ``info`` said of it earlier."""
        world = self._inner.world
        self._version = world.version
        episode.infos.append(self._plain(info) or self._selected(info, before or {}))
        episode.observations.append(_copied(observation))
        episode.states.append(world.current()[1].vector.copy())
        episode.interventions = self._inner.interventions

    def _look_again(self, episode: _Episode) -> None:
        """Write the present instant down anew if something was done since."""
        if self._inner.world.version != self._version:
            observation, info = self._inner.present()
            del episode.observations[-1], episode.states[-1]
            self._write(episode, observation, info, before=episode.infos.pop())

    def _plain(self, info: Mapping[str, Any]) -> dict[str, Any] | None:
        """Pick what is wanted if that is easy: every name stands for a number. Else give None."""
        found = {}
        for name in () if self._wanted == ALL else self._wanted:
            found[name] = value = info.get(name)
            if type(value) not in _PLAIN:
                return None
        return found

    def _selected(self, info: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
        numbers = {**before, **dict(_numbers(info))}
        if self._wanted == ALL:
            return numbers
        missing = [name for name in self._wanted if name not in numbers]
        if missing:
            raise UnknownOption("info", missing[0], numbers)
        return {name: numbers[name] for name in self._wanted}

    def _keep(self) -> None:
        made = self._recorded()
        if made is not None:
            self._made.append(made)
        self._now = None

    def _recorded(self) -> Recorded | None:
        """Give the present episode, if it has a step."""
        episode = self._now
        if episode is None or not episode.actions:
            return None
        self._look_again(episode)
        rewards, ends, cuts = zip(*episode.returns, strict=True)
        names = [n for n in episode.infos[0] if all(n in info for info in episode.infos)]
        return Recorded(
            environment=environment(self._inner),
            seed=episode.seed,
            number=episode.number,
            interventions=tuple((step, Plan(did)) for step, did in episode.interventions),
            observations=tuple(episode.observations),
            actions=np.array(episode.actions),
            rewards=np.array(rewards, dtype=np.float64),
            terminations=np.array(ends, dtype=np.bool_),
            truncations=np.array(cuts, dtype=np.bool_),
            infos={name: _column(info[name] for info in episode.infos) for name in names},
            states=np.array(list(map(summed, episode.states)), dtype=np.int64),
        )


def record(
    policy: Any,
    env: gymnasium.Env[Any, Any],
    n: int,
    *,
    seed: int = 0,
    first: int = 0,
    do: Mapping[str, Any] | None = None,
    infos: Sequence[str] | str | None = None,
    out: Location | str | None = None,
) -> Recording:
    """Let a policy act for some episodes, and record them.

    Args:
        policy: Anything that ``as_player`` reads.
        env: Made by this package; wrappers that intervene, such as a curriculum, are welcome.
        n: How many episodes.
        seed: Of the noise.
        first: Number of the first episode within the noise.
        do: An intervention at every reset.
        infos: Names in ``info`` that are kept; see ``Recorder``.
        out: Where to save the recording, if anywhere.

    Raises:
        UnknownOption: A number is not whole, or the environment or the policy is none.
        ActionError: The policy gave no action.
        InterventionError: ``do`` was refused.

    Example:
        >>> env = gymnasium.make("scm_world/Reaching-v0", backend="fake", max_episode_length=5)
        >>> record("random", env, 2)
        Recording of 2 episodes, 10 control steps, of reaching
    """
    player, recorder = as_player(policy), Recorder(env, infos)
    whole_number("n", n, least=1)
    start: dict[str, Any] = {"seed": seed, "options": {"episode": first, "do": do}}
    for _ in range(n):
        observation, _info = recorder.reset(**start)
        start = {"options": {"do": do}}  # the next episode, also after attempts that failed
        player.begin(inner(env))
        over = False
        while not over:
            observation, _, ended, cut, _info = recorder.step(player.act(observation))
            over = ended or cut
    found = recorder.recording(player.about)
    if out is not None:
        found.save(out)
    return found


def _refuse_changes(env: gymnasium.Env[Any, Any], inside: ScmWorldEnv) -> None:
    """Refuse wrappers below a recorder that change what is recorded.

    Raises:
        UnknownOption: There is one.
    """
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        same = layer.action_space == inside.action_space
        same = same and layer.observation_space == inside.observation_space
        if isinstance(layer, _CHANGING) or not same:
            name = type(layer).__name__
            allowed = (f"one that changes nothing; record below it: {name}(Recorder(env))",)
            raise UnknownOption("wrapper below a Recorder", name, allowed)
        layer = layer.env


def _numbers(info: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """List the numbers in an info, those of dictionaries with dotted names."""
    for name, value in info.items():
        if isinstance(value, _NUMBERS):
            yield within + name, value
        elif isinstance(value, Mapping):
            yield from _numbers(value, f"{within}{name}.")


def _column(values: Iterable[Any]) -> NDArray[Any]:
    """Give numbers as one array, of truth values or 64-bit floats."""
    given = list(values)
    is_logical = all(isinstance(value, bool | np.bool_) for value in given)
    return np.array(given, dtype=np.bool_ if is_logical else np.float64)


def _as_given(action: Any, size: int) -> NDArray[Any]:
    """Copy an action with the bits that the environment computes with."""
    single = getattr(action, "dtype", None) == np.float32
    return np.array(action if single else doubles(action, size))


def _copied(observation: Any) -> Observation:
    if isinstance(observation, dict):
        return {name: np.array(part) for name, part in observation.items()}
    return np.array(observation)
