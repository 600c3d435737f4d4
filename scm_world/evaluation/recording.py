"""Recordings: episodes of an environment with everything that a bit-exact replay needs."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from scm_world._arguments import one_of, whole_number
from scm_world._fingerprint import differing, fingerprint
from scm_world._types import Floats
from scm_world.env import ENV_OPTIONS, ScmWorldEnv
from scm_world.env.actions import doubles
from scm_world.env.observer import Observation
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import (
    InterventionError,
    ModelError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
    UnreadableFile,
    in_one_line,
)
from scm_world.evaluation.episodes import Hook, play
from scm_world.evaluation.recording_files import (
    Recorded,
    as_data,
    from_parquet,
    parts,
    to_minari,
    to_parquet,
    whole,
)
from scm_world.policies.agents import Agent, as_agent
from scm_world.queries.episodes import as_names
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan
from scm_world.runs.files import Location, located, read_bytes, write_whole
from scm_world.tasks import Task
from scm_world.tasks.factories import refuse_untrusted

__all__ = ["Recorded", "Recorder", "Recording", "record"]

Singles = NDArray[np.float32]

INFOS = ("success", "fractional_success")
ALL = "all"
TEACHER = "teacher"

_UNUSED: Mapping[str, Any] = {
    "start": None,
    "random_goal": None,
    "variables_space": None,
    "render_mode": None,
    "render_camera": None,
    "render_size": None,
}
"""Arguments of an environment that repeats recorded interventions, and makes none itself."""

_CHANGING = (gymnasium.ActionWrapper, gymnasium.ObservationWrapper, gymnasium.RewardWrapper)


@final
@dataclass(frozen=True)
class Recording:
    """Episodes of one environment, with everything that a bit-exact replay needs.

    Attributes:
        environment: Arguments of the environment.
        episodes: The recorded episodes.
        versions: Versions of Python, the packages and the backend.
        policy: Description of the policy, if known.
        fingerprint: Hashes of the parts of the system; a replay compares them, if there are any.
        trusted: Packages whose functions may be called to make the environment again; any if the
            recording was made in this process.
    """

    environment: Mapping[str, Any]
    episodes: tuple[Recorded, ...]
    versions: Mapping[str, str] = field(default_factory=dict)
    policy: Mapping[str, Any] | None = None
    fingerprint: Mapping[str, str] = field(default_factory=dict)
    trusted: Sequence[str] | None = field(default=None, compare=False, repr=False)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.episodes)

    def __getitem__(self, number: int) -> Recorded:
        return self.episodes[number]

    def __iter__(self) -> Iterator[Recorded]:
        return iter(self.episodes)

    def __repr__(self) -> str:
        steps = sum(map(len, self.episodes))
        counts = (len(self), "episode"), (steps, "control step")
        words = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in counts)
        return f"Recording of {words}, of {_name(self.environment)}"

    def pairs(self) -> tuple[Singles, Singles]:
        """Return observations and what should be done there, for behavior cloning.

        Returns:
            Observations, shape (n, k), and actions, shape (n, m), of all control steps: the labels
            where a teacher was asked, else the actions that followed. The parts of a dictionary
            observation follow one another in the order of their names.

        Raises:
            ModelError: The observations have several lengths, as the structure changed.
        """
        rows = [
            np.concatenate([part.reshape(-1) for part in parts(seen).values()])
            for episode in self.episodes
            for seen in episode.observations[: len(episode)]
        ]
        lengths = sorted({len(row) for row in rows})
        if len(lengths) != 1:
            raise ModelError([f"pairs need observations of one length, got the lengths {lengths}"])
        actions = np.concatenate(
            [one.actions if one.labels is None else one.labels for one in self.episodes]
        )
        return np.array(rows, dtype=np.float32), actions.astype(np.float32)

    def replay(self, which: int | None = None, *, task: Task | str | None = None) -> int:
        """Repeat actions and interventions; compare observations, rewards and true states.

        Args:
            which: Number of the episode; all if None.
            task: In place of the task of the recording, if that is not registered, or the text
                that names it, to run its code.

        Returns:
            How many control steps were repeated, bit for bit.

        Raises:
            SnapshotMismatch: Something differs; it says from which control step on.
            UnknownOption: The task is not registered, or a function of no trusted package.
        """
        if task is None:
            refuse_untrusted(_name(self.environment), self.trusted)
        arguments = {**self.environment, **_UNUSED}
        unknown = arguments.keys() - {*ENV_OPTIONS}
        if unknown:
            raise SnapshotMismatch(
                "the recording is one of another version: environments have no option "
                f"{min(unknown)!r}"
            )
        if task is not None:
            arguments["task"] = task
        if isinstance(task, Task):
            arguments["task_options"] = None
        numbers = range(len(self)) if which is None else (range(len(self))[which],)
        env = ScmWorldEnv(**arguments)
        try:
            now = fingerprint(env.world.structures, libraries=False)
            changed = differing(self.fingerprint, now) if self.fingerprint else ()
            if changed:
                what = f"{', '.join(changed)} of the system differ"
                raise SnapshotMismatch(f"the recording is one of another system: {what}")
            for number in numbers:
                for difference in _differences(env, self.episodes[number]):
                    made = ", ".join(f"{name} {v}" for name, v in self.versions.items())
                    raise SnapshotMismatch(
                        f"episode {number} happens otherwise from {difference}; the recording was "
                        f"made with {made or 'unknown versions'}"
                    )
        finally:
            env.close()
        return sum(len(self.episodes[number]) for number in numbers)

    def save(self, path: Location | str) -> Location:
        """Write a Parquet file, whole or not at all: one row for each instant.

        Args:
            path: The file; it gets the ending ``.parquet`` if it has another one.

        Raises:
            ModelError: Something cannot be written: a function without a name, say.
            UnwritableFolder: There is no room, or no permission.
        """
        target = located(path)
        if target.suffix != ".parquet":
            target = target.with_name(target.name + ".parquet")
        about = {
            "environment": as_data(self.environment),
            "fingerprint": dict(self.fingerprint),
            "versions": dict(self.versions),
            "policy": None if self.policy is None else dict(self.policy),
        }
        write_whole(target, to_parquet(about, self.episodes))
        return target

    @classmethod
    def load(cls, path: Location | str, *, trusted: Sequence[str] = ()) -> Recording:
        """Read a file of ``save``.

        Args:
            path: The file.
            trusted: Packages other than this one whose functions may be mechanisms.

        Raises:
            UnreadableFile: It is not a recording, or damaged.
            ModelError: A mechanism is a function of no trusted package.
        """
        try:
            data = read_bytes(path)
        except OSError as error:
            advice = "give one that a Recording was saved to"
            raise UnreadableFile(str(path), in_one_line(error), advice) from None
        header, episodes = from_parquet(data, str(path), trusted)
        about = header["environment"], tuple(episodes), header["versions"], header["policy"]
        return cls(*about, header["fingerprint"], tuple(trusted))

    def to_minari(self, dataset_id: str, **about: Any) -> Any:
        """Write a dataset of Minari; its ``recover_environment`` returns the environment.

        Its actions are those that were played, so that every transition is one; the labels of a
        teacher are ``infos["label"]``, of which the last row is there twice. What a bit-exact
        replay needs besides is in the file of ``save`` alone.

        Args:
            dataset_id: Such as ``"scm_world/pushing/sweep-v0"``.
            about: Arguments of ``minari.create_dataset_from_buffers``: ``author``,
                ``author_email``, ``code_permalink``, ``algorithm_name``, ``description``,
                ``data_format``, ``ref_min_score``, ``ref_max_score``, ….

        Returns:
            The ``minari.MinariDataset``.

        Raises:
            MissingExtra: Minari is not installed.
            ModelError: Observations have several shapes, the task has no id with Gymnasium, or
                something cannot be written.
            UnknownOption: The task is a function of no trusted package, or there is a dataset of
                this name.
            ValueError: Minari refuses a name or an argument.
        """
        refuse_untrusted(_name(self.environment), self.trusted)
        usual = {
            "algorithm_name": str((self.policy or {}).get("name", "unknown")),
            "description": f"{self!r}, recorded by scm_world.",
        }
        return to_minari(self.environment, self.episodes, dataset_id, **{**usual, **about})


def _name(made_with: Mapping[str, Any]) -> str:
    task = made_with["task"]
    return task.name if isinstance(task, Task) else str(task)


def _differences(env: ScmWorldEnv, episode: Recorded) -> Iterator[str]:
    """Repeat an episode; yield each control step that differs, and in what."""
    env.reset(seed=episode.seed, options={"episode": episode.number})
    for step in range(len(episode) + 1):
        for at, plan in episode.interventions:
            try:
                if at == step:
                    env.do(plan.at_start())
            except InterventionError as error:
                yield f"control step {step}: an intervention is refused ({error})"
        if _digest(env.world.vector) != episode.states[step]:
            yield f"control step {step}: the true state"
        now, then = parts(env.observe()), parts(episode.observations[step])
        for name in sorted({*now, *then}):
            if name not in now or name not in then or not _same(now[name], then[name]):
                yield f"control step {step}: the observation{f' {name!r}' if name else ''}"
        if step < len(episode):
            reward, known = env.step(episode.actions[step])[1], episode.rewards[step]
            if not _same(np.float64(reward), known):
                yield f"control step {step}: the reward is {reward!r}, not {float(known)!r}"


def _same(one: NDArray[Any] | np.generic, other: NDArray[Any] | np.generic) -> bool:
    same = one.dtype == other.dtype and one.shape == other.shape
    return bool(same) and one.tobytes() == other.tobytes()


def _digest(state: Floats) -> int:
    """Return a digest of a true state: a whole number of 64 bits."""
    digest = hashlib.blake2b(state.tobytes(), digest_size=8).digest()
    return int.from_bytes(digest, "little", signed=True)


# --- recording --------------------------------------------------------------------------------


@final
class Recorder(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Records whole episodes of an environment, so that they can be replayed.

    All interventions count: at the reset, by ``env.unwrapped.do``, or by a wrapper above or below.
    An instant is recorded after its interventions, as the next action meets it. An episode without
    any step is left out.

    Args:
        env: An environment of this package. Wrappers that change actions, observations or rewards
            belong above the recorder.
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
        self._inner = unwrapped_env(env, "Recorder")
        _refuse_changes(env, self._inner)
        model = self._inner.world.model
        chosen = tuple(name for name in INFOS if name in model) if infos is None else infos
        self._wanted = chosen if chosen == ALL else as_names(chosen)
        self._made: list[Recorded] = []
        self._steps: list[tuple[Any, ...]] = []  # action, label, reward, terminated, truncated
        self._instants: list[tuple[Observation, dict[str, Any], int]] = []  # the last: the state
        self._label: Any = None
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
        self._write(observation, info)
        return observation, info

    def label(self, action: Any) -> None:
        """Record the action that a teacher would take in the next control step."""
        self._label = action

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            NotReset: There is no episode.
        """
        if not self._instants:
            raise NotReset
        self._update()
        single = getattr(action, "dtype", None) == np.float32
        n = self._inner.world.compiled.n_actions
        taken = np.array(action if single else doubles(action, n))  # as the environment reads it
        observation, reward, terminated, truncated, info = self.env.step(action)
        ends = float(reward), bool(terminated), bool(truncated)
        self._steps.append((taken, self._label, *ends))
        self._label = None
        self._write(observation, info)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Keep the last episode, and free the backend."""
        self._keep()
        super().close()

    def recording(self, policy: Mapping[str, Any] | None = None) -> Recording:
        """Return all episodes so far, the present one included.

        Args:
            policy: Description of the policy.
        """
        present = self._recorded()
        episodes = (*self._made, *([present] if present else []))
        made_with = versions(self._inner.world.engine)
        system = fingerprint(self._inner.world.structures, libraries=False)
        return Recording(self._inner.made_with, episodes, made_with, policy, system)

    def _write(
        self, observation: Any, info: Mapping[str, Any], before: Mapping[str, Any] | None = None
    ) -> None:
        """Record an instant; ``before`` are its infos before an intervention."""
        world = self._inner.world
        self._version, self._did = world.version, self._inner.interventions
        self._place = world.noise.seed, world.episode
        numbers, names = info, self._wanted
        if names == ALL or any(type(info.get(name)) not in (bool, int, float) for name in names):
            numbers = {**(before or {}), **dict(_numbers(info))}
            names = tuple(numbers) if names == ALL else names
        for name in names:
            one_of("info", name, numbers)
        copied: Observation = whole({n: np.array(part) for n, part in parts(observation).items()})
        kept = {name: numbers[name] for name in names}
        self._instants.append((copied, kept, _digest(world.vector)))

    def _update(self) -> None:
        """Record the present instant again if there was an intervention since."""
        if self._inner.world.version != self._version:
            observation, info = self._inner.present()
            self._write(observation, info, before=self._instants.pop()[1])

    def _keep(self) -> None:
        made = self._recorded()
        if made is not None:
            self._made.append(made)
        self._steps, self._instants = [], []

    def _recorded(self) -> Recorded | None:
        """Return the present episode, if it has a step."""
        if not self._steps:
            return None
        self._update()
        actions, labels, rewards, ends, cuts = zip(*self._steps, strict=True)
        observations, known, states = zip(*self._instants, strict=True)
        infos = {}
        for name in known[0]:
            if all(name in info for info in known):
                values = [info[name] for info in known]
                is_logical = all(isinstance(value, bool | np.bool_) for value in values)
                infos[name] = np.array(values, dtype=np.bool_ if is_logical else np.float64)
        has_labels = all(label is not None for label in labels)
        return Recorded(
            seed=self._place[0],
            number=self._place[1],
            interventions=tuple((step, Plan(did)) for step, did in self._did),
            observations=tuple(observations),
            actions=np.array(actions),
            rewards=np.array(rewards, dtype=np.float64),
            terminations=np.array(ends, dtype=np.bool_),
            truncations=np.array(cuts, dtype=np.bool_),
            infos=infos,
            states=np.array(states, dtype=np.int64),
            labels=np.array(labels, dtype=np.float32) if has_labels else None,
        )


CORRELATION = 0.8
"""Of the noise of actions, from a control step to the next one."""


def action_noise(random: np.random.Generator, size: int) -> Iterator[Floats]:
    """Yield correlated noise for actions, shape (size,), with a standard deviation of one."""
    noise = np.zeros(size)
    while True:
        innovation = np.sqrt(1.0 - CORRELATION**2) * random.standard_normal(size)
        noise = CORRELATION * noise + innovation
        yield noise


def record(
    policy: Any,
    env: gymnasium.Env[Any, Any],
    n: int,
    *,
    seed: int = 0,
    first: int = 0,
    do: Mapping[str, Any] | None = None,
    infos: Sequence[str] | str | None = None,
    noise: float = 0.0,
    labels: Any = None,
    out: Location | str | None = None,
) -> Recording:
    """Run a policy for some episodes, and record them.

    A learner of demonstrations has to know what to do beside the path of its teacher, too. With
    ``noise`` and ``labels="teacher"`` the policy is driven off its path, and its action
    there is recorded beside the played one (DART); with a learner as the policy and its teacher
    as ``labels``, that is a round of DAgger. ``Recording.pairs`` gives the labels.

    Args:
        policy: Anything that ``as_agent`` reads.
        env: An environment of this package, perhaps in wrappers that intervene: a curriculum, say.
        n: How many episodes.
        seed: Seed of the noise.
        first: Number of the first episode within the noise.
        do: An intervention at every reset.
        infos: Names in ``info`` that are kept; see ``Recorder``.
        noise: Largest standard deviation of the noise of actions, in their units; each episode
            has one between 0 and that, and it changes slowly (correlation 0.8 between steps).
        labels: Who is asked at every step what to do there: ``"teacher"`` for the policy itself,
            or another policy; nobody if None.
        out: Where to save the recording, if anywhere.

    Source:
        Laskey et al., *DART*, CoRL 2017; Ross et al., *DAgger*, AISTATS 2011.

    Raises:
        UnknownOption: A number is not whole, or the environment or the policy is none.
        ActionError: The policy gave no action.
        InterventionError: ``do`` was refused.

    Example:
        >>> env = gymnasium.make("scm_world/Reaching-v0", backend="fake", max_episode_length=5)
        >>> record("random", env, 2)
        Recording of 2 episodes, 10 control steps, of reaching
    """
    agent, recorder = as_agent(policy), Recorder(env, infos)
    teacher = agent if labels in (None, TEACHER) else as_agent(labels)
    whole_number("n", n, least=1)
    if not (isinstance(noise, int | float) and 0.0 <= noise < np.inf):
        raise UnknownOption("noise", noise, ("a standard deviation of actions, 0 or more",))
    shown = _Shown(recorder, agent, teacher, noise=noise, has_labels=labels is not None)
    for number in range(n):
        start: dict[str, Any] = {"seed": seed, "episode": first} if number == 0 else {}
        play(recorder, agent, do, [shown], **start)
    found = recorder.recording(agent.about)
    if out is not None:
        found.save(out)
    return found


@final
class _Shown(Hook):
    """Asks a teacher in every control step, and disturbs the action that is played."""

    def __init__(
        self, recorder: Recorder, agent: Agent, teacher: Agent, *, noise: float, has_labels: bool
    ) -> None:
        self.recorder, self.agent, self.teacher = recorder, agent, teacher
        self.noise, self.has_labels = noise, has_labels

    def begin(self, env: ScmWorldEnv, observation: Any) -> None:
        """Draw how much noise there is in this episode."""
        if self.teacher is not self.agent:
            self.teacher.start(env)
        random = np.random.default_rng([env.world.noise.seed, env.world.episode])
        self.scale = self.noise * random.uniform()
        self.noises = action_noise(random, env.world.compiled.n_actions)

    def choose(self, observation: Any, action: Any) -> Any:
        """Record what the teacher would do; add the noise."""
        space: Any = self.recorder.action_space
        if self.has_labels:
            same = self.teacher is self.agent
            right = action if same else self.teacher.act(observation)
            self.recorder.label(np.clip(right, space.low, space.high))
        if self.noise:
            action = np.clip(action + self.scale * next(self.noises), space.low, space.high)
        return action


def _refuse_changes(env: gymnasium.Env[Any, Any], inside: ScmWorldEnv) -> None:
    """Refuse wrappers below a recorder that change actions, observations or rewards."""
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
        if isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating):
            yield within + name, value
        elif isinstance(value, Mapping):
            yield from _numbers(value, f"{within}{name}.")
