"""An engine in an engine: to change one thing about it, and leave the rest as it is."""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterable
from typing import ClassVar

from scm_world._types import Floats
from scm_world.backends.base import Backend, Capabilities, Contact, EngineSnapshot
from scm_world.errors import SnapshotMismatch
from scm_world.models.scene import (
    ControlMode,
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    Structure,
)
from scm_world.models.state import State


class BackendWrapper(Backend, ABC):
    """Asks another engine for everything; derive from it and override what should differ.

    A class of one's own needs a ``name``. If it remembers something between two steps, it has to
    be forgotten in ``build`` and to be a part of ``snapshot`` and ``restore``.

    Args:
        engine: That does the work, empty and not used elsewhere.

    Attributes:
        engine: The same.
    """

    capabilities: ClassVar[Capabilities] = Capabilities()

    def __init__(self, engine: Backend) -> None:
        self.engine = engine

    @property
    def version(self) -> str:
        """Name and version of the engine inside."""
        return f"{self.engine.name} {self.engine.version}"

    @property
    def structure(self) -> Structure:
        """What was compiled."""
        return self.engine.structure

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing."""
        self.engine.build(scene)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time."""
        self.engine.apply(difference)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the engine."""
        return self.engine.parameters(keys)

    def inertia(self, body: str) -> Floats:
        """Read the principal moments of inertia of a body, shape (3,) [kg m²]."""
        return self.engine.inertia(body)

    def read(self, into: State) -> None:
        """Write the present state into an existing vector."""
        self.engine.read(into)

    def step(self, mode: ControlMode, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        self.engine.step(mode, command, substeps)

    def contacts(self) -> tuple[Contact, ...]:
        """List the contact points of the last physics step."""
        return self.engine.contacts()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        return EngineSnapshot(f"{self.name} {self.version}", self.engine.snapshot())

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine, or by the one inside alone.
        """
        here = f"{self.name} {self.version}"
        if snapshot.engine != here:
            raise SnapshotMismatch(f"a snapshot of {snapshot.engine} cannot be restored by {here}")
        self.engine.restore(snapshot.payload)

    def close(self) -> None:
        """Free what the engine holds."""
        self.engine.close()
