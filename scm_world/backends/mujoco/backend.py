"""MuJoCo as a backend."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, final

import mujoco

from scm_world._types import Floats
from scm_world.backends.base import Backend, Capabilities, ContactPoint, EngineSnapshot, Scenes
from scm_world.backends.mujoco.batch import MujocoBatch, Slot
from scm_world.backends.mujoco.contacts import Touches, named
from scm_world.backends.mujoco.realization import Realization
from scm_world.errors import EngineFailure
from scm_world.models.scene import (
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    State,
    Structure,
    complete,
)


@final
class MujocoBackend(Backend):
    """MuJoCo, with one compiled model per structure and everything else edited in place.

    Attributes:
        realization: The compiled model, with parameters and state of the scene.
        slot: Where the state is instead, while a batch steps the scene.
    """

    name: ClassVar[str] = "mujoco"
    capabilities: ClassVar[Capabilities] = Capabilities(
        remarks=lambda backend, before: backend.realization.remarks(before)
    )
    batch: ClassVar[type[Scenes]] = MujocoBatch
    version = str(mujoco.__version__)

    realization: Realization
    _touches: Touches | None
    slot: Slot | None = None

    def __getattr__(self, name: str) -> Any:
        if name == "realization":
            raise EngineFailure("there is no scene; call build() first", self.name)
        if name == "structure":
            return self.realization.structure
        raise AttributeError(name)

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing; where the structure is the same, that costs little."""
        now = self._realized(scene.structure, scene.parameters)
        now.reset()
        now.place(scene.state.vector)
        self.realization, self.slot, self._touches = now, None, None

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time."""
        self._return()
        now, structure = self.realization, difference.structure
        if now.replay is not None and (difference.parameters or structure is not None):
            self._last_touches()  # later, this would be another step
        if structure is None:
            now.edit(difference.parameters)
        else:
            record = self._last_touches()
            scene = Scene(now.structure, now.kept, self.read())
            difference = complete(scene, structure, difference)
            self.realization = self._realized(structure, difference.parameters)
            if self.realization is not now:
                self.realization.follow(now)
            self._touches = record
        if difference.state is not None:
            self.realization.place(difference.state.vector)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the arrays of the model."""
        return self.realization.parameters(keys)

    def read(self, into: State | None = None) -> State:
        """Write the present state into an existing one, or a new one."""
        if self.slot is not None:
            self._return()
        into = self.realization.structure.empty_state() if into is None else into
        self.realization.read(into.vector)
        return into

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        if self.slot is not None:
            self._return()
        self._touches = None
        if problem := self.realization.step(command, substeps):
            raise EngineFailure(problem, self.name, lost=(0,), diverged=True)

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step; see ``Model.staged``."""
        return named(self._last_touches())

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        self._return()
        now = self.realization
        touches = self._touches if now.replay is not None else self._last_touches()
        replay = now.replay if touches is None else None
        scene = now.structure, dict(now.kept), now.revision
        return EngineSnapshot.of(self, (*scene, now.numbers(), now.memory(), touches, replay))

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot."""
        structure, parameters, revision, numbers, memory, touches, replay = snapshot.opened(self)
        now: Realization | None = vars(self).get("realization")
        if now is None or now.revision is not revision:
            now = self._realized(structure, parameters)
            now.revision = revision
        now.recall(numbers, memory)
        now.replay = replay
        self.realization, self.slot, self._touches = now, None, touches

    def move_to(self, slot: Slot) -> Realization:
        """Copy the state to a slot; return the model with the parameters of the scene."""
        if self.slot != slot:
            self._return()
            slot[0].take(slot[1], self.realization)
            self.slot = slot
        self.realization.forget()
        self._touches = None
        return self.realization

    def _return(self) -> None:
        """Take the state back from where it is stepped."""
        if self.slot is not None:
            group, index = self.slot
            group.give_back(index, self.realization)
            self.slot = None

    def close(self) -> None:
        """Free the model and its data."""
        vars(self).clear()

    def _realized(self, structure: Structure, parameters: Parameters) -> Realization:
        """Return the present realization, edited, or a new one."""
        now: Realization | None = vars(self).get("realization")
        if now is None or structure != now.structure:
            return Realization(structure, parameters)
        now.edit(parameters)
        return now

    def _last_touches(self) -> Touches:
        if self._touches is None:
            self._return()
            self._touches = self.realization.touches()
        return self._touches
