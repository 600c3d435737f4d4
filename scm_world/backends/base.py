"""What every physics engine must be able to do.

A backend holds one scene. It knows bodies, parameters and states, and nothing about causes.
``scm_world.testing.backend`` holds the conformance suite that each one passes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, SnapshotMismatch, UnknownOption, WrongShape
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
@dataclass(frozen=True)
class ContactPoint:
    """One point where two bodies touch.

    Attributes:
        bodies: Names of the two bodies. Of a ``Model`` as in its file, ``"world"`` for what is
            fixed to it; of other structures as they say.
        position: Of the point, shape (3,) [m].
        normal: Unit vector from the first body to the second, shape (3,).
        depth: How deep they intersect [m]; negative while they are apart.
        force: Normal force [N].
    """

    bodies: tuple[str, str]
    position: Floats
    normal: Floats
    depth: float
    force: float


@final
@dataclass(frozen=True)
class Capabilities:
    """What an engine promises.

    Attributes:
        physics: Whether anything moves by itself.
        batch: Whether many worlds can be stepped in one call.
        snapshot: ``"exact"`` where the engine's own state is saved, ``"replay"`` where the
            commands since the last canonical state are repeated. Both continue bit for bit.
    """

    physics: bool = True
    batch: bool = False
    snapshot: str = "exact"


@final
@dataclass(frozen=True)
class EngineSnapshot:
    """All that decides the future of an engine: state, parameters, caches. It can be pickled.

    Attributes:
        engine: Name and version of the engine that took it.
        payload: Owned by that engine.
    """

    engine: str
    payload: Any


class Backend(ABC):
    """A physics engine with one scene in it.

    Life: ``build`` once, then any of the others in any order. Every method may raise
    ``EngineFailure``. Changes made between two calls of ``step`` take no time, and their result
    depends on the last ``step`` and on the final parameters and state only, not on the path: a
    change that is taken back leaves no trace, bit for bit.
    """

    name: ClassVar[str]
    capabilities: ClassVar[Capabilities]

    @property
    @abstractmethod
    def version(self) -> str:
        """Version of the engine."""

    @property
    @abstractmethod
    def structure(self) -> Structure:
        """What was compiled: it says how large states and commands are."""

    @abstractmethod
    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing. Equal scenes continue bit-identically, in any process."""

    @abstractmethod
    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        What is not mentioned stays as it is, bit for bit.
        """

    @abstractmethod
    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the engine itself, in the units of the scene."""

    @abstractmethod
    def inertia(self, body: str) -> Floats:
        """Read the principal moments of inertia of a body, shape (3,) [kg m²].

        Raises:
            UnknownOption: There is no such body.
        """

    def remarks(self, before: Parameters) -> tuple[str, ...]:
        """Say which changes of parameters have no effect, and why; one sentence each.

        Args:
            before: The parameters that were changed, as they were.
        """
        return ()

    @abstractmethod
    def read(self, into: State) -> None:
        """Write the present state into an existing vector, without allocating."""

    @abstractmethod
    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps.

        Args:
            command: Shape (structure.n_commands,).
            substeps: How many steps of ``structure.timestep``.
        """

    @abstractmethod
    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""

    @abstractmethod
    def snapshot(self) -> EngineSnapshot:
        """Save everything. Restoring it continues bit for bit, in this process or another."""

    @abstractmethod
    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine.
        """

    def supports(self, structure: Structure, key: ParameterKey) -> bool:
        """Tell whether it realises a parameter of a structure."""
        return True

    def close(self) -> None:  # noqa: B027 # most engines have nothing to free
        """Free what the engine holds. Closing twice is harmless."""

    def state(self) -> Any:
        """Read the present state into a new vector; the kind of state that the structure has."""
        state = self.structure.empty_state()
        self.read(state)
        return state

    @final
    def sealed(self, payload: Any) -> EngineSnapshot:
        """Give a snapshot of this engine, in this version."""
        return EngineSnapshot(f"{self.name} {self.version}", payload)

    @final
    def opened(self, snapshot: EngineSnapshot) -> Any:
        """Give what a snapshot holds.

        Raises:
            SnapshotMismatch: It was taken by another engine, or another version of this one.
        """
        here = f"{self.name} {self.version}"
        if snapshot.engine != here:
            raise SnapshotMismatch(f"a snapshot of {snapshot.engine} cannot be restored by {here}")
        return snapshot.payload

    @classmethod
    def batch(cls, backends: Sequence[Backend], threads: int) -> EngineBatch:
        """Give what steps several scenes of this engine in one call.

        Args:
            backends: All of this class. Each can still be used by itself at any time.
            threads: That an engine may use which can step several scenes together.
        """
        return OneByOne(backends)


class EngineBatch(ABC):
    """Several scenes of one engine that are stepped in one call.

    That is, bit for bit, the same as stepping one after another.

    Attributes:
        may_refuse: Whether a scene that fails can be as it was; if not, it has lost its state.
    """

    may_refuse: ClassVar[bool] = False

    @abstractmethod
    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Hold commands for some physics steps.

        Args:
            which: Numbers of the scenes that are stepped, ascending, shape (m,).
            commands: One for each scene, in the first columns of its row, shape (n, at least
                n_commands).
            substeps: How many steps of ``structure.timestep``.
            into: Where their states are written afterwards: the vector of scene i into the first
                columns of row i, shape (n, at least layout.size).

        Raises:
            EngineFailure: A scene lost its state, or is as it was, which the error says; all
                others were stepped.
        """


@final
class OneByOne(EngineBatch):
    """Scenes of an engine that steps one at a time.

    Args:
        backends: The scenes.
    """

    def __init__(self, backends: Sequence[Backend]) -> None:
        self._backends = tuple(backends)

    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Step the scenes one after another.

        Raises:
            EngineFailure: The first one of a scene; all were stepped.
        """
        failed: EngineFailure | None = None
        for index in which.tolist():
            backend = self._backends[index]
            structure = backend.structure
            try:
                backend.step(commands[index, : structure.n_commands], substeps)
            except EngineFailure as error:
                said = f"scene {index} of the batch: {error}"
                failed = failed or EngineFailure(said, error.engine)
            layout = structure.layout
            backend.read(State(layout, into[index, : layout.size]))
        if failed is not None:
            raise failed


class BackendWrapper(Backend, ABC):
    """Asks another engine for everything; derive from it and override what should differ.

    A custom class needs a ``name``. If it keeps something between two steps, it has to
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

    def remarks(self, before: Parameters) -> tuple[str, ...]:
        """Say which changes of parameters have no effect, and why."""
        return self.engine.remarks(before)

    def read(self, into: State) -> None:
        """Write the present state into an existing vector."""
        self.engine.read(into)

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        self.engine.step(command, substeps)

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""
        return self.engine.contacts()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        return self.sealed(self.engine.snapshot())

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine, or by the one inside alone.
        """
        self.engine.restore(self.opened(snapshot))

    def close(self) -> None:
        """Free what the engine holds."""
        self.engine.close()


class InMemory(Backend, ABC):
    """What keeps a scene in memory: parameters in a dict, the state in a vector.

    Only ``step`` and ``inertia`` are left to a class that derives from it.
    """

    @property
    def version(self) -> str:
        """Version of the backend."""
        return "1"

    @property
    def structure(self) -> Any:
        """The structure of the scene."""
        return self._structure

    def build(self, scene: Scene) -> None:
        """Keep the scene."""
        self._structure, self._state = scene.structure, scene.structure.empty_state()
        self._parameters: dict[ParameterKey, Floats] = {}
        self._keep(scene.parameters)
        self._place(scene.state)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Raises:
            UnknownOption: There is no such parameter. Nothing has changed.
            WrongShape: A parameter has another shape. Nothing has changed.
        """
        structure = difference.structure
        if structure is not None:
            now = Scene(self._structure, self._parameters, self._state)
            difference = complete(now, structure, difference)
            self._structure, self._state = structure, structure.empty_state()
            self._state.carry(now.state)  # what is reported stays
            self._parameters = {}
        else:
            self._check(difference.parameters)
            for key, value in difference.parameters.items():
                if np.shape(value) != self._parameters[key].shape:
                    name, shape = ".".join(key).strip("."), self._parameters[key].shape
                    raise WrongShape(name, value, shape, np.shape(value))
        self._keep(difference.parameters)
        if difference.state is not None:
            self._place(difference.state)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Give the parameters that were set.

        Raises:
            UnknownOption: There is no such parameter.
        """
        keys = tuple(keys)
        self._check(keys)
        return {key: self._parameters[key].copy() for key in keys}

    def read(self, into: State) -> None:
        """Write the present state into an existing vector."""
        into.vector[:] = self._state.vector

    def contacts(self) -> tuple[ContactPoint, ...]:
        """Nothing ever touches anything."""
        return ()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        scene = Scene(self._structure, dict(self._parameters), self._state.copy())
        return self.sealed(scene)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine.
        """
        scene: Scene = self.opened(snapshot)
        self._structure, self._state = scene.structure, scene.state.copy()
        self._parameters = {}
        self._keep(scene.parameters)

    def _keep(self, parameters: Parameters) -> None:
        for key, value in parameters.items():
            self._parameters[key] = np.array(value, dtype=np.float64)

    def _place(self, state: State) -> None:
        """Put everything where a state says; what is only reported stays."""
        np.copyto(self._state.vector, state.vector, where=self._state.layout.can_be_set)

    def _check(self, keys: Iterable[ParameterKey]) -> None:
        for key in keys:
            if key not in self._parameters:
                known = (".".join(known).strip(".") for known in self._parameters)
                raise UnknownOption("parameter", ".".join(key).strip("."), known)
