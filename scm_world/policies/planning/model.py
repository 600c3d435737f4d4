"""What a planner believes the world to be: copies of it, which are stepped together."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import ActionError
from scm_world.work.threads import cores
from scm_world.world import World, WorldSnapshot
from scm_world.world.batch import Batch

STREAM = "what a planner expects"
"""The stream from which the noise of a model that does not foresee it is seeded."""


@final
class Model:
    """Copies of a world in which sequences of actions are tried out; the world is not touched.

    Args:
        world: What is modelled.
        n: How many sequences are tried out together.
        names: Variables that are wanted after every control step.
        backend: The engine of the copies, by name; that of the world if None. Where it is another
            one, the physical state is carried over, but no memory of contacts.
        do: What the model believes to be different, as in ``World.do``: the true model if None.
        foresees: Whether the copies have the noise of the world, and so know what will be drawn.
        threads: Of the engine; as many as there are cores if None.

    Raises:
        UnknownOption: There is no such engine, or a number is none.
        UnknownVariable: A name does not exist.

    Example:
        >>> world = World("pushing", backend="fake")
        >>> world.reset(seed=0)
        >>> model = Model(world, 2, ["reward"])
        >>> values = model.rollouts(model.present(world), np.zeros((2, 5, 9)))
        >>> values["reward"].shape, world.index
        ((2, 5), 0)
    """

    def __init__(
        self,
        world: World,
        n: int,
        names: Iterable[str],
        *,
        backend: str | None = None,
        do: Mapping[str, Any] | None = None,
        foresees: bool = False,
        threads: int | None = None,
    ) -> None:
        count = whole_number("samples", n, least=1)
        _, (_, task, given, _), *_ = world.__reduce__()
        options = {**given, "backend": backend or world.backend.name}
        options["variables_space"] = None  # what is believed may lie anywhere
        first = World(copy.copy(task), **options)
        self._copies = [first, *(World(first.structures, **options) for _ in range(count - 1))]
        self._is_foreign = first.engine != world.engine
        self._do, self._foresees = dict(do or {}), foresees
        self.names = tuple(dict.fromkeys(names))
        self._shapes = {name: world.model.declared(name).shape for name in self.names}
        share = cores() if threads is None else threads
        self._batch = Batch(self._copies, threads=share, names=self.names)

    def __len__(self) -> int:
        """Count the copies."""
        return len(self._copies)

    def present(self, world: World) -> WorldSnapshot:
        """Say where the rollouts begin, if a world is as it is now.

        Args:
            world: It is only looked at.

        Raises:
            InterventionError: What is believed cannot be done to the present.
        """
        snapshot = world.snapshot()
        if self._is_foreign:
            snapshot = replace(snapshot, engine=self._carried(world))
        if not self._foresees:
            drawn = world.noise.uniforms(STREAM, n=1, episode=world.episode, step=world.index)
            snapshot = replace(snapshot, seed=int(drawn[0, 0] * 2.0**53))
        if not self._do:
            return snapshot
        believed = self._batch.world(0)
        believed.restore(snapshot)
        believed.do(self._do)
        return believed.snapshot()

    def _carried(self, world: World) -> Any:
        """Realise the present in the engine of the model."""
        engine = self._batch.world(0).backend
        engine.build(world.scene())
        return engine.snapshot()

    def rollouts(self, start: WorldSnapshot, actions: Floats) -> dict[str, Floats]:
        """Try sequences of actions out.

        Args:
            start: As ``present`` gives it.
            actions: Shape (n, steps, n_actions) in the units of the action mode, in their range;
                as many as there are copies, or fewer.

        Returns:
            By name, the values after each control step, shape (n, steps, *shape).

        Raises:
            ActionError: Actions have another shape.
            EngineFailure: The engine lost a state.
        """
        size = self._copies[0].compiled.n_actions
        if actions.ndim != 3 or actions.shape[2] != size or len(actions) > len(self):
            allowed = f"(n, steps, {size}), with n up to {len(self)}"
            raise ActionError(f"actions have shape {allowed}, got {actions.shape}", actions)
        n, steps = actions.shape[:2]
        which = np.arange(len(self._copies)) < n
        commands = np.zeros((len(which), steps, size))
        commands[:n] = actions
        for row in range(n):
            self._batch.world(row).restore(start)
        found = {name: np.empty((n, steps, *shape)) for name, shape in self._shapes.items()}
        for step in range(steps):
            self._batch.advance(commands[:, step], which)
            table = self._batch.table(0)
            for name, shape in self._shapes.items():
                found[name][:, step] = table.column(name)[:n].reshape(n, *shape)
        return found

    def close(self) -> None:
        """Free the engines."""
        self._batch.close()
