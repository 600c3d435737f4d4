"""Recordings: some episodes of one environment, as a value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.env.observer import Observation
from scm_world.errors import ModelError, SnapshotMismatch, UnreadableFile
from scm_world.evaluation.recording.environments import named, refuse_untrusted, remade
from scm_world.evaluation.recording.episodes import Recorded, parts
from scm_world.evaluation.recording.headers import ADVICE, written
from scm_world.evaluation.recording.minari_datasets import from_dataset, to_dataset
from scm_world.evaluation.recording.parquet import decoded, encoded
from scm_world.evaluation.recording.replaying import first_difference
from scm_world.output.durable import write_durably
from scm_world.output.locations import Location, located
from scm_world.output.remote import said
from scm_world.tasks import Task

Singles = NDArray[np.float32]
SUFFIX = ".parquet"


@final
@dataclass(frozen=True)
class Recording:
    """Episodes of one environment, with all that it takes to live through them again.

    Attributes:
        environment: Arguments of the environment.
        episodes: What happened.
        versions: What it was made with.
        policy: What acted, if it is known.
        trusted: Packages whose functions may be called to make the environment again; any if the
            recording was made in this process.
    """

    environment: Mapping[str, Any]
    episodes: tuple[Recorded, ...]
    versions: Mapping[str, str] = field(default_factory=dict)
    policy: Mapping[str, Any] | None = None
    trusted: Sequence[str] | None = field(default=None, compare=False, repr=False)

    def __len__(self) -> int:
        """Give the number of episodes."""
        return len(self.episodes)

    def __getitem__(self, number: int) -> Recorded:
        return self.episodes[number]

    def __iter__(self) -> Iterator[Recorded]:
        return iter(self.episodes)

    def __repr__(self) -> str:
        steps = sum(map(len, self.episodes))
        task = named(self.environment["task"])
        return (
            f"Recording of {_count(len(self), 'episode')}, {_count(steps, 'control step')}, "
            f"of {task}"
        )

    def pairs(self) -> tuple[Singles, Singles]:
        """Give what was seen and what was done then, for behavior cloning.

        Returns:
            Observations, shape (n, k), and actions, shape (n, m), of all control steps. The parts
            of an observation that has names follow one another in the order of the names.

        Raises:
            ModelError: The observations have several lengths, as the structure changed.
        """
        rows = [_flat(seen) for e in self.episodes for seen in e.observations[: len(e)]]
        lengths = sorted({len(row) for row in rows})
        if len(lengths) != 1:
            raise ModelError([f"pairs need observations of one length, got the lengths {lengths}"])
        actions = np.concatenate([e.actions for e in self.episodes])
        return np.array(rows, dtype=np.float32), actions.astype(np.float32)

    def replay(self, which: int | None = None, *, task: Task | str | None = None) -> int:
        """Live through episodes again, and compare observations, rewards and true states.

        Args:
            which: Number of the episode; all if None.
            task: In the place of the task of the recording, if that is not registered, or the
                text that names it, to run what is in there.

        Returns:
            How many control steps happened again, bit for bit.

        Raises:
            SnapshotMismatch: Something differs; it says from which control step on.
            UnknownOption: The task is not registered, or a function of no trusted package.
        """
        if task is None:
            refuse_untrusted(named(self.environment["task"]), self.trusted)
        numbers = range(len(self)) if which is None else (range(len(self))[which],)
        env = remade(self.environment, task)
        try:
            for number in numbers:
                found = first_difference(env, self.episodes[number])
                if found:
                    made = ", ".join(f"{name} {v}" for name, v in self.versions.items())
                    raise SnapshotMismatch(
                        f"episode {number} happens otherwise from {found}; the recording was made "
                        f"with {made or 'unknown versions'}"
                    )
        finally:
            env.close()
        return sum(len(self.episodes[number]) for number in numbers)

    def save(self, path: Location | str) -> Location:
        """Write a Parquet file, whole or not at all: one row for each instant.

        Args:
            path: Of the file; it gets the ending ``.parquet`` if it has another one.

        Raises:
            MissingExtra: pyarrow is not installed.
            ModelError: Something cannot be written: a function without a name, say.
            UnwritableFolder: There is no such folder, no room, or no permission.
        """
        target = located(path)
        if target.suffix != SUFFIX:
            target = target.with_name(target.name + SUFFIX)
        write_durably(target, encoded(self._header(), self.episodes))
        return target

    @classmethod
    def load(cls, path: Location | str, *, trusted: Sequence[str] = ()) -> Recording:
        """Read what ``save`` wrote.

        Args:
            path: Of the file.
            trusted: Packages, besides this one, whose functions may be mechanisms.

        Raises:
            MissingExtra: pyarrow is not installed.
            UnreadableFile: It is no recording, or damaged.
            ModelError: A mechanism is a function of no trusted package.
        """
        try:
            data = located(path).read_bytes()
        except OSError as error:
            raise UnreadableFile(str(path), said(error), ADVICE) from None
        header, episodes = decoded(data, str(path), trusted)
        about = header.environment, tuple(episodes), header.versions, header.policy
        return cls(*about, tuple(trusted))

    def to_minari(self, dataset_id: str, **about: Any) -> Any:
        """Write a dataset of Minari; ``recover_environment`` of it gives the environment.

        Args:
            dataset_id: Such as ``"scm_world/pushing/sweep-v0"``.
            about: What ``minari.create_dataset_from_buffers`` takes besides: ``author``,
                ``author_email``, ``code_permalink``, ``algorithm_name``, ``description``,
                ``data_format``, ….

        Returns:
            The ``minari.MinariDataset``.

        Raises:
            MissingExtra: Minari is not installed.
            ModelError: Observations have several shapes, the task has no id with Gymnasium, or
                something cannot be written.
            ValueError: There is such a dataset already, says Minari.
        """
        return to_dataset(self, self._header(), dataset_id, about)

    @classmethod
    def from_minari(cls, dataset: Any, *, trusted: Sequence[str] = ()) -> Recording:
        """Read a dataset of Minari that ``to_minari`` wrote, or a part of it.

        Args:
            dataset: A ``minari.MinariDataset``, also a filtered one, or the id of a local one.
            trusted: Packages, besides this one, whose functions may be mechanisms.

        Raises:
            MissingExtra: Minari is not installed.
            UnreadableFile: It is another dataset, or a damaged one.
            ModelError: A mechanism is a function of no trusted package.
        """
        header, episodes = from_dataset(dataset, trusted)
        about = header.environment, tuple(episodes), header.versions, header.policy
        return cls(*about, tuple(trusted))

    def _header(self) -> str:
        return written(self.environment, self.versions, self.policy, self.episodes)


def _flat(observation: Observation) -> NDArray[Any]:
    return np.concatenate([part.reshape(-1) for part in parts(observation).values()])


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
