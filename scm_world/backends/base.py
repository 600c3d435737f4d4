"""What every physics engine must be able to do.

A backend holds one scene. It knows bodies, parameters and states, and nothing about causes.
``scm_world.testing.backend`` holds the conformance suite that each one passes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar, final

import numpy as np

from scm_world._arguments import typed
from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, ScmWorldError, SnapshotMismatch, UnknownOption
from scm_world.models.scene import (
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    State,
    Structure,
    complete,
)

T = TypeVar("T")

ROUNDING = 1e-12
"""What numbers of 64 bits lose in a control step, by the values that differ."""

NO_DEVICE = "the engine has no states on a device; world[name] returns a variable as an array"


@final
@dataclass(frozen=True)
class ContactPoint:
    """One point where two bodies touch.

    Attributes:
        bodies: Names of the two bodies. In a ``Model`` as in its file, ``"world"`` for shapes fixed
            to it; in other structures as they say.
        position: Place of the point, shape (3,) [m].
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
    """What an engine can do beyond the methods of a backend.

    Attributes:
        physics: Whether anything moves by itself.
        floor: How far apart the states of two equal runs may be, in their units; 0 if the engine
            is exact: equal runs are equal bit for bit.
        rounding: Given a backend, a structure and the number of physics steps in a control step,
            the changes of a state in such a step that are no effects, by the larger of the value
            and one unit, of all numbers of the state or of each: the engine rounds, or solves for
            bodies together that do not touch.
        scenes: How many scenes the engine steps best in one call, where that does not follow from
            the number of its threads: of a GPU, thousands.
        supports: Whether the engine realises a parameter of a structure.
        remarks: Given a backend and the old values of all parameters that were changed, the
            changes that have no effect, and why; one sentence each.
    """

    physics: bool = True
    floor: float = 0.0
    rounding: Callable[[Any, Structure, int], Floats | float] = lambda *_: ROUNDING
    scenes: int | None = None
    supports: Callable[[Structure, ParameterKey], bool] = lambda structure, key: True
    remarks: Callable[[Any, Parameters], tuple[str, ...]] = lambda backend, before: ()


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

    @classmethod
    def of(cls, backend: Backend, payload: Any) -> EngineSnapshot:
        """Return a snapshot of a backend, in its version."""
        return cls(f"{backend.name} {backend.version}", payload)

    def opened(self, backend: Backend) -> Any:
        """Return the payload for a backend."""
        here = f"{backend.name} {backend.version}"
        if self.engine != here:
            raise SnapshotMismatch(f"a snapshot of {self.engine} cannot be restored by {here}")
        return self.payload


class Scenes(ABC):
    """Several scenes in one engine: all that a world of n rows asks of it.

    ``which`` are the numbers of the scenes that a method is about, ascending, each once, shape
    (m,). All other scenes stay as they are, bit for bit. Each scene does what it would do alone in
    a ``Backend``: bit for bit if the engine is exact. Numbers have a leading axis with one entry
    for each of these scenes, in their order; scenes of one call have states of one layout.

    An error has in ``scenes`` the numbers of all scenes that refused. Those are unchanged.

    Args:
        n: Number of scenes, none of which is built yet.
        threads: Number of threads, for an engine with several.

    Attributes:
        may_refuse: Whether a scene whose step fails can be as it was; if not, it has lost its
            state.
        stays: Whether states may stay on a device; see ``resident``.
    """

    may_refuse: ClassVar[bool] = True
    stays: ClassVar[bool] = False

    @abstractmethod
    def __init__(self, n: int, threads: int) -> None: ...

    @classmethod
    def of(cls, backends: Sequence[Any], threads: int = 1) -> Scenes:
        """Move the scenes of backends of one class into an engine.

        Each backend can still be used by itself at any time.
        """
        scenes = cls.made_by(lambda: backends[0], len(backends), threads)
        for index, backend in enumerate(backends):
            backend.move_to(scenes, index)
        return scenes

    @classmethod
    def made_by(cls, make: Callable[[], Any], n: int, threads: int = 1) -> Scenes:
        """Return an engine of ``n`` scenes; ``make`` makes an empty backend for one."""
        return cls(n, threads)

    def alone(self, index: int, make: Callable[[], Any], *, is_built: bool) -> Any:
        """Return a backend that is one of the scenes; ``make`` makes an empty one."""
        one = make()
        one.be(self, index, is_built=is_built)
        return one

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of scenes."""

    @abstractmethod
    def structure(self, index: int) -> Structure:
        """Return the compiled structure of a scene."""

    @abstractmethod
    def build(self, which: Integers, scene: Scene) -> None:
        """Realise one scene from nothing in each of some places."""

    @abstractmethod
    def apply(
        self,
        which: Integers,
        parameters: Parameters,
        states: Floats | None = None,
        structure: Structure | None = None,
    ) -> None:
        """Change some scenes without advancing time; see ``Backend.apply``.

        Args:
            which: The scenes.
            parameters: The parameters that change, each of shape (m, *shape), or (1, *shape) if
                all of these scenes get the same.
            states: Complete new states, shape (m, layout.size); None if nothing is moved.
            structure: The new structure of all of them; None if it stays.

        Raises:
            UnknownOption: There is no such parameter.
            NotIntervenable: The engine does not have the parameter.
            Infeasible: Nothing could move with the parameters.
            ModelError: The engine cannot realise the structure.

        The error is that of the first scene that refused. All scenes that are not in its ``scenes``
        have changed.
        """

    @abstractmethod
    def parameters(
        self, which: Integers, keys: Iterable[ParameterKey]
    ) -> dict[ParameterKey, Floats]:
        """Read parameters back from the engine, each of shape (m, *shape).

        Raises:
            UnknownOption: There is no such parameter.
        """

    @abstractmethod
    def read(self, which: Integers) -> Floats:
        """Return the present states of some scenes, shape (m, layout.size)."""

    @abstractmethod
    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Hold commands for some physics steps.

        Args:
            which: The scenes that are stepped.
            commands: One for each scene, stepped or not, in the first columns of its row, shape
                (n, at least n_commands).
            substeps: How many steps of ``structure.timestep``.
            into: Where their states are written afterwards: the vector of scene i into the first
                columns of row i, shape (n, at least layout.size).

        Raises:
            EngineFailure: Scenes lost their state, or did not move, which the error lists in
                ``lost`` and ``unmoved``; all others were stepped.
        """

    @abstractmethod
    def contacts(self, which: Integers) -> tuple[tuple[ContactPoint, ...], ...]:
        """List the contact points of the last physics step of some scenes."""

    def tensor(self, which: Integers, name: str) -> Any:
        """Return a state of some scenes where the engine has it; see ``Backend.tensor``."""
        raise EngineFailure(NO_DEVICE, getattr(self, "name", type(self).__name__))

    def resident(self, which: Integers, copies: Counter[str]) -> Any:
        """Return what steps scenes whose states stay on the device of the engine.

        Args:
            which: The scenes, all that there are.
            copies: Counts the bytes that are copied between host and device, by reason.

        Returns:
            What steps them there; see ``scm_world.backends.warp.resident.Resident``.

        Raises:
            EngineFailure: The engine has no states on a device, or not these together.
        """
        raise EngineFailure(NO_DEVICE, getattr(self, "name", type(self).__name__))

    @abstractmethod
    def snapshot(self, which: Integers) -> tuple[EngineSnapshot, ...]:
        """Save some scenes, each by itself."""

    @abstractmethod
    def restore(self, which: Integers, snapshots: Sequence[EngineSnapshot]) -> None:
        """Restore one snapshot for each scene, or a single one in all of them.

        Raises:
            SnapshotMismatch: One of them was taken by another engine. No scene has changed.
        """

    @abstractmethod
    def close(self) -> None:
        """Free what the engine holds. Closing twice is harmless."""


class SeparateScenes(Scenes):
    """Scenes of an engine that holds one scene at a time: a backend for each of them.

    Args:
        backends: All of one class.
        threads: For an engine that steps several scenes together.
    """

    @typed
    def __init__(self, backends: Sequence[Backend], threads: int = 1) -> None:
        self._backends: tuple[Any, ...] = tuple(backends)

    @classmethod
    def of(cls, backends: Sequence[Any], threads: int = 1) -> Scenes:
        """Use backends where they are."""
        return cls(backends, threads)

    @classmethod
    def made_by(cls, make: Callable[[], Any], n: int, threads: int = 1) -> Scenes:
        """Make as many backends."""
        return cls([make() for _ in range(n)], threads)

    def alone(self, index: int, make: Callable[[], Any], *, is_built: bool) -> Any:
        """Return the backend of a scene."""
        return self._backends[index]

    def __len__(self) -> int:
        return len(self._backends)

    def structure(self, index: int) -> Structure:
        """Return the compiled structure of a scene."""
        found: Structure = self._backends[index].structure
        return found

    def build(self, which: Integers, scene: Scene) -> None:
        """Realise one scene in each of some backends."""
        self._each(which, lambda place, backend: backend.build(scene))

    def apply(
        self,
        which: Integers,
        parameters: Parameters,
        states: Floats | None = None,
        structure: Structure | None = None,
    ) -> None:
        """Change some scenes, one after another."""

        def change(place: int, backend: Backend) -> None:
            given = {k: np.array(v[place * (len(v) > 1)]) for k, v in parameters.items()}
            state = None
            if states is not None:
                empty = (structure or backend.structure).empty_state()
                state = empty.with_vector(states[place].copy())
            backend.apply(Difference(structure, given, state))

        self._each(which, change)

    def parameters(
        self, which: Integers, keys: Iterable[ParameterKey]
    ) -> dict[ParameterKey, Floats]:
        """Read parameters back."""
        wanted = tuple(keys)
        found = self._each(which, lambda place, backend: backend.parameters(wanted))
        return {key: np.stack([one[key] for one in found]) for key in wanted}

    def read(self, which: Integers) -> Floats:
        """Return the present states of some scenes."""
        return np.stack(self._each(which, lambda place, backend: backend.read().vector))

    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Hold commands for some physics steps, in one scene after another."""
        failed: EngineFailure | None = None
        for index in which.tolist():
            backend = self._backends[index]
            structure = backend.structure
            try:
                backend.step(commands[index, : structure.n_commands], substeps)
            except EngineFailure as error:
                now, error.row = backend.read().vector, index
                is_lost = bool(error.lost) or not np.isfinite(now).all()
                error.lost, error.unmoved = ((index,), ()) if is_lost else ((), (index,))
                failed = error.after(failed)
            layout = structure.layout
            backend.read(State(layout, into[index, : layout.size]))
        if failed is not None:
            raise failed

    def contacts(self, which: Integers) -> tuple[tuple[ContactPoint, ...], ...]:
        """List the contact points of some scenes."""
        return tuple(self._each(which, lambda place, backend: backend.contacts()))

    def snapshot(self, which: Integers) -> tuple[EngineSnapshot, ...]:
        """Save some scenes."""
        return tuple(self._each(which, lambda place, backend: backend.snapshot()))

    def restore(self, which: Integers, snapshots: Sequence[EngineSnapshot]) -> None:
        """Restore snapshots, one after another, if the engine has taken all of them."""
        for snapshot in snapshots:
            snapshot.opened(self._backends[0])
        several = len(snapshots) > 1
        self._each(which, lambda place, backend: backend.restore(snapshots[several * place]))

    def close(self) -> None:
        """Free what the backends hold."""
        for backend in self._backends:
            backend.close()

    def _each(self, which: Integers, act: Callable[[int, Any], T]) -> list[T]:
        """Act on some backends; raise the first error, with the numbers of all that refused."""
        first: ScmWorldError | None = None
        refused, found = list[int](), list[T]()
        for place, index in enumerate(which.tolist()):
            try:
                found.append(act(place, self._backends[index]))
            except ScmWorldError as error:
                first = first or error
                refused.append(index)
        if first is not None:
            first.scenes = tuple(refused)
            raise first
        return found


class Backend(ABC):
    """A physics engine with one scene in it.

    Life: ``build`` once, then any of the others in any order. Every method may raise
    ``EngineFailure``. Changes made between two calls of ``step`` take no time, and their result
    depends on the last ``step`` and on the final parameters and state only, not on the path: a
    change that is taken back leaves no trace, bit for bit.

    Attributes:
        name: Name of the engine.
        capabilities: Abilities beyond these methods; by default those of most backends.
        batch: What holds several scenes.
        version: Version of the engine.
        structure: The compiled structure: it says how large states and commands are.
    """

    name: ClassVar[str]
    capabilities: ClassVar[Capabilities] = Capabilities()
    batch: ClassVar[type[Scenes]] = SeparateScenes
    version: str
    structure: Structure

    @abstractmethod
    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing. Equal scenes continue bit-identically, in any process."""

    @abstractmethod
    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Everything else stays as it is, bit for bit; all of it where an error is raised.

        Raises:
            UnknownOption: There is no such parameter.
            NotIntervenable: The engine does not have the parameter.
            Infeasible: Nothing could move with the parameters.
            ModelError: The engine cannot realise the structure.
        """

    @abstractmethod
    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the engine itself, in the units of the scene.

        Also ``(body, "inertia")``, the principal moments of inertia of any body, shape (3,)
        [kg m²], where they follow from other parameters.

        Raises:
            UnknownOption: There is no such parameter.
        """

    @abstractmethod
    def read(self, into: State | None = None) -> State:
        """Write the present state into an existing one, or a new one; return it."""

    @abstractmethod
    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps.

        Args:
            command: Shape (structure.n_commands,); it is not to be changed.
            substeps: How many steps of ``structure.timestep``.
        """

    @abstractmethod
    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""

    def tensor(self, name: str) -> Any:
        """Return a state where the engine has it, without a copy.

        Args:
            name: Name of the state.

        Returns:
            Something with ``__dlpack__``, shape (size,). It is for reading; steps change it.

        Raises:
            EngineFailure: The engine has no states on a device, or not this one as it is.
        """
        raise EngineFailure(NO_DEVICE, self.name)

    @abstractmethod
    def snapshot(self) -> EngineSnapshot:
        """Save everything. Restoring it continues bit for bit, in this process or another."""

    @abstractmethod
    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine.
        """

    def close(self) -> None:  # noqa: B027 # most engines have nothing to free
        """Free what the engine holds. Closing twice is harmless."""


class OneScene(Backend, ABC):
    """A backend that is one scene of an engine that holds many.

    Derive from it with a ``name`` and with ``batch``, which alone has to be written.

    Attributes:
        scenes: The engine that holds the scene.
        which: Number of the scene in it, shape (1,).
    """

    scenes: Scenes
    which: Integers

    def __init__(self) -> None:
        self.scenes, self.which = type(self).batch(1, 1), np.array([0])
        self._is_built = False

    def move_to(self, scenes: Scenes, index: int) -> None:
        """Move the scene to a place in another engine."""
        kept = self.snapshot() if self._is_built else None
        self.be(scenes, index, is_built=False)
        if kept is not None:
            self.restore(kept)

    def be(self, scenes: Scenes, index: int, *, is_built: bool) -> None:
        """Be a scene of an engine."""
        self.scenes, self.which, self._is_built = scenes, np.array([index]), is_built

    @property
    def structure(self) -> Structure:  # type: ignore[override] # nothing sets it
        """The compiled structure."""
        return self.scenes.structure(int(self.which[0]))

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing."""
        self.scenes.build(self.which, scene)
        self._is_built = True

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time."""
        given = {key: np.asarray(value)[None] for key, value in difference.parameters.items()}
        state = difference.state
        states = None if state is None else state.vector[None]
        self.scenes.apply(self.which, given, states, difference.structure)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the engine."""
        found = self.scenes.parameters(self.which, keys)
        return {key: np.array(values[0]) for key, values in found.items()}

    def read(self, into: State | None = None) -> State:
        """Read the present state."""
        into = self.structure.empty_state() if into is None else into
        into.vector[:] = self.scenes.read(self.which)[0]
        return into

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        count, index = len(self.scenes), self.which[0]
        commands = np.empty((count, len(command)))
        commands[index] = command
        self.scenes.step(
            self.which, commands, substeps, np.empty((count, self.structure.layout.size))
        )

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""
        return self.scenes.contacts(self.which)[0]

    def tensor(self, name: str) -> Any:
        """Return a state where the engine has it."""
        return self.scenes.tensor(self.which, name)[0]

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        return self.scenes.snapshot(self.which)[0]

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot."""
        self.scenes.restore(self.which, [snapshot])
        self._is_built = True


class BackendWrapper(Backend, ABC):
    """Asks another engine for everything; derive from it and override what should differ.

    A custom class needs a ``name``. If it keeps something between two steps, it has to
    be forgotten in ``build`` and to be a part of ``snapshot`` and ``restore``.

    Args:
        engine: That does the work, empty and not used elsewhere.

    Attributes:
        engine: The same.
    """

    capabilities: ClassVar[Capabilities] = Capabilities(
        rounding=lambda self, *of: self.engine.capabilities.rounding(self.engine, *of),
        remarks=lambda self, before: self.engine.capabilities.remarks(self.engine, before),
    )

    @typed
    def __init__(self, engine: Backend) -> None:
        self.engine = engine
        mine, floor = self.capabilities, engine.capabilities.floor
        vars(self)["capabilities"] = replace(mine, floor=max(mine.floor, floor))
        self.version = f"{engine.name} {engine.version}"

    def __getattr__(self, name: str) -> Any:
        """Return what only the engine inside has, such as its structure."""
        if name == "engine":  # while it is copied
            raise AttributeError(name)
        return getattr(self.engine, name)

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing."""
        self.engine.build(scene)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time."""
        self.engine.apply(difference)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the engine."""
        return self.engine.parameters(keys)

    def read(self, into: State | None = None) -> State:
        """Read the present state."""
        return self.engine.read(into)

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        self.engine.step(command, substeps)

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""
        return self.engine.contacts()

    def tensor(self, name: str) -> Any:
        """Return a state where the engine has it."""
        return self.engine.tensor(name)

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        return EngineSnapshot.of(self, self.engine.snapshot())

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot; one of the engine inside alone is refused."""
        self.engine.restore(snapshot.opened(self))

    def close(self) -> None:
        """Free what the engine holds."""
        self.engine.close()


class InMemory(Backend, ABC):
    """What keeps a scene in memory: parameters in a dict, the state in a vector.

    Only ``step`` is left to a class that derives from it. A model may have a method
    ``inertia(parameters, body)``, which computes moments of inertia.
    """

    version = "1"

    def build(self, scene: Scene) -> None:
        """Keep the scene."""
        self.structure, self._state = scene.structure, scene.structure.empty_state()
        self._parameters: dict[ParameterKey, Floats] = {}
        self._keep(scene.parameters)
        self._place(scene.state)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state; where a parameter is wrong, nothing changes."""
        structure = difference.structure
        if structure is not None:
            now = Scene(self.structure, self._parameters, self._state)
            difference = complete(now, structure, difference)
            self.structure, self._state = structure, structure.empty_state()
            self._state.carry(now.state)  # reported values stay
            self._parameters = {}
        else:
            for key in difference.parameters:
                self._known(key)
        self._keep(difference.parameters)
        if difference.state is not None:
            self._place(difference.state)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Return the parameters that were set."""
        inertia, found = getattr(self.structure, "inertia", None), dict[ParameterKey, Floats]()
        for key in keys:
            body, what = key
            if what == "inertia" and inertia is not None and (body, "mass") in self._parameters:
                found[key] = inertia(self._parameters, body)
            else:
                found[key] = self._known(key).copy()
        return found

    def read(self, into: State | None = None) -> State:
        """Write the present state into an existing one, or a new one."""
        into = self.structure.empty_state() if into is None else into
        into.vector[:] = self._state.vector
        return into

    def contacts(self) -> tuple[ContactPoint, ...]:
        """Nothing ever touches anything."""
        return ()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        scene = Scene(self.structure, dict(self._parameters), self._state.copy())
        return EngineSnapshot.of(self, scene)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot."""
        scene: Scene = snapshot.opened(self)
        self.structure, self._state = scene.structure, scene.state.copy()
        self._parameters = {}
        self._keep(scene.parameters)

    def _keep(self, parameters: Parameters) -> None:
        for key, value in parameters.items():
            self._parameters[key] = np.array(value, dtype=np.float64)

    def _place(self, state: State) -> None:
        """Write a state; values that are only reported stay."""
        np.copyto(self._state.vector, state.vector, where=self._state.layout.can_be_set)

    def _known(self, key: ParameterKey) -> Floats:
        """Return a parameter as it is kept, or refuse the key."""
        if key not in self._parameters:
            known = (".".join(known).strip(".") for known in self._parameters)
            raise UnknownOption("parameter", ".".join(key).strip("."), known)
        return self._parameters[key]
