"""Bullet as a backend: two physics clients, of which one always holds the last step.

The engine is imported when the first backend is made, and only then.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Backend, Capabilities, ContactPoint, EngineSnapshot
from scm_world.backends.bullet.client import CanonicalState, Client, Past, SavedState
from scm_world.backends.bullet.engine import load
from scm_world.backends.bullet.honoured import accepted, settle, supports
from scm_world.errors import EngineFailure, Infeasible
from scm_world.models import Model
from scm_world.models.scene import Difference, ParameterKey, Parameters, Scene, State, complete

LONG = 200  # [physics steps] from here on, saving the engine's state is cheaper than a replay


@final
@dataclass(frozen=True)
class Record:
    """What a backend holds, and its snapshot.

    Attributes:
        past: All up to the last step.
        last: The world after it.
        now: The world with the changes since.
        world: That from which live bodies come to the present by taking on parameters alone: the
            past, or a canonical one.
        saved: The engine's own state after the last step, if one was kept.
    """

    past: Past
    last: CanonicalState
    now: CanonicalState
    world: Past
    saved: SavedState | None = None


@final
class BulletBackend(Backend):
    """Bullet, through pybullet: the part of a ``Model`` that it can honour.

    The engine cannot set a state exactly, because contact caches survive. So a state is set by
    bringing about a *canonical* world, which is a function of parameters and state alone. It is
    made in a second physics client while the first keeps the world of the last step: going back
    to that world is then exact and costs nothing, and a change that fails cannot harm it.

    A snapshot is the last canonical state and the commands since. Within the process that took
    it, the engine's own saved state stands in for a long replay.

    Raises:
        MissingEngine: pybullet is not installed.
    """

    name: ClassVar[str] = "bullet"
    capabilities: ClassVar[Capabilities] = Capabilities(
        supports=supports, remarks=lambda backend, before: backend.client().twin.remarks(before)
    )

    _at: Record

    def __init__(self) -> None:
        self._engine, self.version = load()
        self._clients: list[Client] = []

    def __getattr__(self, name: str) -> Any:
        if name == "structure":
            return self._at.now.structure
        if name == "_at":
            raise EngineFailure("there is no scene yet; call build() first", self.name)
        raise AttributeError(name)

    def client(self) -> Client:
        """Return the client that holds the present."""
        return self._holding(self._at.world, self._at.now.parameters)

    def _holding(self, world: Past, parameters: Parameters) -> Client:
        """Return a client in a world, with the parameters that its live bodies took on since."""
        at: Record | None = vars(self).get("_at")
        client = next((one for one in self._clients if one.holds is world), None)
        try:
            if client is None and at and at.saved and world is at.past:
                client = next((one for one in self._clients if one.load(at.saved)), None)
            if client is None:
                free = (one for one in self._clients if not at or one.holds is not at.past)
                client = next(free, None)
                if client is None:
                    client = Client(self._engine)
                    self._clients.append(client)
                client.replay(world)
            client.holds = world
            client.edit(parameters)
        except Infeasible:
            raise
        except Exception as error:
            self._drop(client)
            raise EngineFailure(f"Bullet refused the change: {error}", self.name) from error
        return client

    def _drop(self, client: Client | None) -> None:
        """Disconnect a client in which something went wrong."""
        if client is not None:
            client.engine.close()
            self._clients.remove(client)

    # --- the interface -------------------------------------------------------------------------

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing; with the bodies that are there already, where possible."""
        structure = Model.of(scene.structure, "Bullet")
        same = "_at" in vars(self) and structure == self.structure
        known = self._at.now.parameters if same else {}
        parameters = accepted(structure, scene.parameters, known)
        now = CanonicalState(structure, parameters, settle(structure, scene.state))
        world = Past(now)
        self._holding(world, parameters)
        self._at = Record(world, now, now, world)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time."""
        now, structure = self._at.now, difference.structure
        state, known = now.structure.empty_state().with_vector(now.state), now.parameters
        given: Parameters = {**known, **difference.parameters}
        if structure is not None:
            difference = complete(Scene(now.structure, known, state), structure, difference)
            given, known = difference.parameters, known if structure == now.structure else {}
        structure = Model.of(structure or now.structure, "Bullet")
        parameters, vector = accepted(structure, given, known), now.state
        if difference.state is not None:
            vector = settle(structure, difference.state, state)
        now = CanonicalState(structure, parameters, vector)
        at, world = self._at, Past(now)
        if now.differs_lightly(at.last):
            world = at.past
        elif not at.world.steps and now.differs_lightly(at.world.start):
            world = at.world
        self._holding(world, parameters)
        self._at = replace(at, now=now, world=world)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back; see ``Realization.parameters``."""
        return self.client().twin.parameters(keys)

    def read(self, into: State | None = None) -> State:
        """Write the present state into an existing one, or a new one."""
        now = self._at.now
        into = now.structure.empty_state() if into is None else into
        into.vector[:] = now.state
        return into

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        if substeps < 1:
            return
        at, client, now = self._at, self.client(), self._at.now
        numbers: list[float] = np.asarray(command, dtype=np.float64).tolist()
        past = at.past if at.world is at.past else Past(now)
        try:
            client.step(numbers, substeps)
            state = client.read()
        except Exception as error:
            self._drop(client)  # torques that were not stepped would count twice
            raise EngineFailure(f"Bullet could not step: {error}", self.name) from error
        steps = *past.steps, (now.parameters, numbers, substeps)
        client.holds = past = Past(past.start, steps)
        last = CanonicalState(now.structure, now.parameters, state)
        self._at = Record(past, last, last, past)
        if not math.isfinite(state.sum()):
            what = "Bullet produced a state that is not finite"
            raise EngineFailure(what, self.name, lost=(0,), diverged=True)

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""
        at = self._at
        parameters = (at.now if at.world is at.past else at.last).parameters
        return self._holding(at.past, parameters).contacts()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        at = self._at
        if at.saved is None and sum(substeps for *_, substeps in at.past.steps) >= LONG:
            for client in self._clients:
                if client.holds is at.past:
                    self._at = replace(at, saved=client.save())
        return EngineSnapshot.of(self, self._at)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot."""
        self._at = snapshot.opened(self)
        self.client()

    def close(self) -> None:
        """Disconnect both clients. Closing twice is harmless."""
        for client in self._clients:
            client.engine.close()
        self._clients = []
        vars(self).pop("_at", None)
