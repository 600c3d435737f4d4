"""Environments that can be copied and pickled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

from gymnasium.utils import EzPickle

from scm_world.errors import NotReset, SnapshotMismatch
from scm_world.queries.world import World
from scm_world.world import WorldSnapshot


@final
@dataclass(frozen=True)
class EnvSnapshot:
    """An instant of an episode of an environment. It can be pickled.

    Attributes:
        world: Of its world.
        interventions: What was done so far.
        ended: Whether the episode is over and the next one begins with the next step of a batch.
        memory: The state of a curriculum around it.
    """

    world: WorldSnapshot
    interventions: tuple[tuple[int, dict[str, Any]], ...]
    ended: bool = False
    memory: Any = None


class Copied(EzPickle):
    """Makes an environment again from its arguments, with the state of the other one.

    Attributes:
        world: That is simulated.
    """

    world: World
    _done: list[tuple[int, dict[str, Any]]]

    @property
    def made_with(self) -> dict[str, Any]:
        """The options that it was made with, by name."""
        return dict(self._ezpickle_kwargs)

    def snapshot(self) -> EnvSnapshot:
        """Save everything that decides the future of the episode.

        Raises:
            NotReset: There is no episode yet.
        """
        return EnvSnapshot(self.world.snapshot(), tuple(self._done))

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Go back to a snapshot, bit for bit.

        Raises:
            SnapshotMismatch: It is none of an environment, or one of another task or engine.
        """
        if not isinstance(snapshot, EnvSnapshot):
            raise SnapshotMismatch(f"{snapshot!r} is no snapshot; give what snapshot() returned")
        self.world.restore(snapshot.world)
        self._done = list(snapshot.interventions)

    def __getstate__(self) -> dict[str, Any]:
        """Give the arguments, a snapshot of the world, and Gymnasium's generator."""
        try:
            snapshot = self.world.snapshot()
        except NotReset:
            snapshot = None
        generator = {name: self.__dict__[name] for name in _GENERATOR if name in self.__dict__}
        done = list(self._done)
        state = {"snapshot": snapshot, "generator": generator, "done": done}
        return {**super().__getstate__(), **state}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin where the other environment is; a closed one, or one without episode, is new."""
        super().__setstate__(state)
        self.__dict__.update(state["generator"])
        if state["snapshot"] is not None:
            self.world.restore(state["snapshot"])
            self._done = state["done"]


_GENERATOR = ("_np_random", "_np_random_seed", "spec")
"""What Gymnasium keeps in an environment."""
