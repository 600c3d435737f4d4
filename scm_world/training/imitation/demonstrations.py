"""What a teacher shows: pairs of what was seen and what should be done then."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Container, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation.arena import Arena
from scm_world.evaluation.policies.weights import NetworkPolicy
from scm_world.evaluation.protocols import Protocol
from scm_world.evaluation.recording import Recording
from scm_world.output.durable import write_durably
from scm_world.queries.policies import NAMED, Policy
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.training.imitation.lessons import Lesson

Singles = NDArray[np.float32]

SEED = 5_000_003
"""Added to seeds, so that nobody is examined in the episodes of the lesson."""

MEMORY = 0.8
"""Share of the noise of a control step that is left in the next one."""


@final
@dataclass(frozen=True)
class Demonstrations:
    """Episodes that ended well, as pairs, and how all of them ended.

    Attributes:
        observations: Shape (n, k).
        actions: What the teacher would have done, shape (n, n_actions), in [-1, 1].
        scores: Fractional success at the end of each episode, shape (episodes,).
        kept: Whether it is among the pairs, shape (episodes,).
    """

    observations: Singles
    actions: Singles
    scores: Floats
    kept: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.observations)

    def save(self, path: Path) -> None:
        """Write a file of numpy, whole or not at all.

        Raises:
            UnwritableFolder: There is no room, or no permission.
        """
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **vars(self))
        write_durably(path, stream.getvalue())

    @classmethod
    def load(cls, path: Path) -> Demonstrations:
        """Read what ``save`` wrote.

        Raises:
            UnreadableFile: It is something else, or damaged.
        """
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
                made = cls(*(file[name] for name in cls.__dataclass_fields__))
            if made.observations.shape[:1] != made.actions.shape[:1]:
                raise ValueError("observations and actions are not equally many")
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            advice = "remove it: the same call makes it again"
            raise UnreadableFile(str(path), f"it is damaged ({error})", advice) from None
        return made


def joined(parts: Iterable[Demonstrations]) -> Demonstrations:
    """Put demonstrations together.

    Raises:
        ModelError: There is nothing to learn from, or observations have several lengths.
    """
    listed = list(parts)
    filled = [part for part in listed if len(part)]
    played = sum(len(part.scores) for part in listed)
    if not filled:
        best = max((float(part.scores.max(initial=0.0)) for part in listed), default=0.0)
        raise ModelError(
            [
                f"none of {played} demonstrations ended well enough to learn from; the best one "
                f"reached {best:.3f}: take another teacher, less noise, or a smaller keep"
            ]
        )
    lengths = {part.observations.shape[1] for part in filled}
    if len(lengths) != 1:
        raise ModelError([f"observations have several lengths: {sorted(lengths)}"])
    return Demonstrations(
        *(np.concatenate([getattr(part, name) for part in filled]) for name in _PAIRS),
        *(np.concatenate([getattr(part, name) for part in listed]) for name in _EPISODES),
    )


_PAIRS = ("observations", "actions")
_EPISODES = ("scores", "kept")


@final
class School:
    """Where a teacher acts, and a learner with it.

    Args:
        lesson: What is shown.
        backend: Name of the engine.
        seed: Of everything that is drawn.

    Attributes:
        engine: Name and version of the engine.

    Raises:
        ActionError: The teacher cannot act in this task.
        UnknownOption: An option of the environment does not exist.
    """

    def __init__(self, lesson: Lesson, *, backend: str, seed: int) -> None:
        self._lesson, self._seed = lesson, seed
        self._protocols = lesson.taught()
        self._env = ScmWorldEnv(lesson.task, backend=backend, **lesson.options)
        self._arena = Arena(self._env)
        self.engine = self._env.world.engine
        self._score = _score_of(self._env.world.model, lesson.task)
        try:
            self._env.reset(seed=seed)
            self._teacher()(self._env.world)
        except BaseException:
            self.close()
            raise

    def _teacher(self) -> Policy:
        return NAMED[self._lesson.teacher]()

    def shown(
        self, round_: int, numbers: range, learner: NetworkPolicy | None = None
    ) -> Demonstrations:
        """Let the teacher show some episodes; those that do not end well are left out.

        Args:
            round_: Of the lesson.
            numbers: Of the episodes, within the noise.
            learner: Acts now and then; nobody if None.
        """
        parts = [self._episode(round_, number, learner) for number in numbers]
        seen, done, scores = zip(*parts, strict=True)
        kept = np.array(scores) >= self._lesson.keep
        width, size = seen[0].shape[1], done[0].shape[1]
        return Demonstrations(
            np.concatenate([np.empty((0, width), np.float32), *_where(kept, seen)]),
            np.concatenate([np.empty((0, size), np.float32), *_where(kept, done)]),
            np.array(scores),
            kept,
        )

    def _episode(
        self, round_: int, number: int, learner: NetworkPolicy | None
    ) -> tuple[Singles, Singles, float]:
        protocol: Protocol = self._protocols[number % len(self._protocols)]
        turn, observation = self._arena.begin(protocol, seed=SEED + self._seed, episode=number)
        teacher = self._teacher()
        random = np.random.default_rng([self._seed, round_, number])
        hands = Hands(self._lesson, self._env.world.declaration.n_actions, random)
        seen, done, over, info = [], [], False, dict[str, Any]()
        while not over:
            action = np.clip(self._env.toward(teacher(self._env.world)), -1.0, 1.0)
            seen.append(np.array(observation, np.float32))
            done.append(action.astype(np.float32))
            given = hands.action(action, observation, learner)
            observation, _, terminated, truncated, info = self._env.step(given)
            over = terminated or truncated
            if not over and turn.step(self._env):
                observation = self._env.observe()
        return np.array(seen), np.array(done), float(info[self._score])

    def close(self) -> None:
        """Free the engine."""
        self._arena.close()


@final
class Hands:
    """Decides in one episode who acts, and shakes the hands of whoever it is.

    Args:
        lesson: How often the learner acts, and how much noise there is.
        size: How many numbers an action has.
        random: What is drawn with.
    """

    def __init__(self, lesson: Lesson, size: int, random: np.random.Generator) -> None:
        self._random = random
        self._scale = lesson.noise * random.uniform()
        self._share = lesson.share * random.uniform(0.0, 2.0)
        self._turn = 1.0 / lesson.stretch
        self._noise, self._learns = np.zeros(size), False

    def action(
        self, right: Floats, observation: Any, learner: NetworkPolicy | None
    ) -> NDArray[Any]:
        """Give the action that is taken, shape (n_actions,).

        Args:
            right: The teacher's.
            observation: What the learner sees.
            learner: Nobody if None.
        """
        if learner is not None and self._random.uniform() < self._turn:
            self._learns = self._random.uniform() < self._share
        innovation = np.sqrt(1.0 - MEMORY**2) * self._random.standard_normal(len(self._noise))
        self._noise = MEMORY * self._noise + innovation
        chosen = right if learner is None or not self._learns else learner(observation)
        return np.clip(chosen + self._scale * self._noise, -1.0, 1.0)


def _score_of(names: Container[str], task: str) -> str:
    """Name what says how well an episode ended.

    Raises:
        UnknownOption: The task does not say it.
    """
    for name in (FRACTION, SUCCESS):
        if name in names:
            return name
    allowed = f"a task with {FRACTION!r} or {SUCCESS!r}: only what ended well is learned from"
    raise UnknownOption("task of a lesson", task, (allowed,))


def recorded(recording: Recording, keep: float) -> Demonstrations:
    """Take demonstrations from a recording.

    Args:
        recording: Its actions lie in [-1, 1].
        keep: Fractional success of an episode, in the end, that is learned from.

    Raises:
        ModelError: Nothing ended well enough, or was told of how it ended.
    """
    told = [name for name in (FRACTION, SUCCESS) if all(name in e.infos for e in recording)]
    if not told:
        problem = f"the recording does not say how episodes ended: record {FRACTION!r}, too"
        raise ModelError([problem])
    scores = np.array([float(episode.infos[told[0]][-1]) for episode in recording])
    kept = scores >= keep
    good = tuple(episode for episode, is_good in zip(recording, kept, strict=True) if is_good)
    none = np.empty((0, 1), np.float32), np.empty((0, 1), np.float32)
    pairs = Recording(recording.environment, good).pairs() if good else none
    return joined([Demonstrations(*pairs, scores, kept)])


def _where(kept: NDArray[np.bool_], parts: Iterable[Singles]) -> list[Singles]:
    return [part for part, is_kept in zip(parts, kept, strict=True) if is_kept]
