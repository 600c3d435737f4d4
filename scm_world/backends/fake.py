"""A backend without physics: things stay where they are put. For fast tests."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Capabilities, InMemory
from scm_world.errors import EngineFailure
from scm_world.models.scene import State


@final
class FakeBackend(InMemory):
    """No forces and no contacts: nothing moves.

    A model can say otherwise by two methods that change a state in place:
    ``move(state, command, seconds)``, and ``settle(state)`` after it was set.
    """

    name: ClassVar[str] = "fake"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False, scenes=512)

    def step(self, command: Floats, substeps: int) -> None:
        """Advance time."""
        if hasattr(self.structure, "move"):
            self.structure.move(self._state, command, substeps * self.structure.timestep)
        if not np.isfinite(self._state.vector).all():
            raise EngineFailure("a number is not finite", self.name, lost=(0,))

    def _place(self, state: State) -> None:
        super()._place(state)
        if hasattr(self.structure, "settle"):
            self.structure.settle(self._state)
