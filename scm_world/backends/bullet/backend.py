"""Bullet as a backend: two physics clients, of which one always holds the last step."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Backend, Capabilities, ContactPoint, EngineSnapshot
from scm_world.backends.bullet.client import Client, Instant, SavedState, alike
from scm_world.backends.bullet.engine import load
from scm_world.backends.bullet.honoured import check, rebuilt, settle, supports
from scm_world.errors import EngineFailure, Infeasible, ModelError, UnknownOption
from scm_world.models.model import Model
from scm_world.models.scene import Difference, ParameterKey, Parameters, Scene, complete

LONG = 200  # [physics steps] from here on, saving the engine's state is cheaper than a replay


@final
@dataclass
class History:
    """Everything since the last canonical state that is needed to replay it.

    Attributes:
        origin: The last canonical state.
        rows: The steps: how many physics steps, then the command.
        edits: Changes of parameters: the length of ``rows`` at that moment, and the new values.
        substeps: How many physics steps a replay takes.
    """

    origin: Instant
    rows: array[float] = field(default_factory=lambda: array("d"))
    edits: list[tuple[int, Parameters]] = field(default_factory=list)
    substeps: int = 0

    def replay(self, client: Client) -> None:
        """Repeat it, from the canonical state to the end."""
        client.canonicalize(self.origin)
        edits, row = list(reversed(self.edits)), 1 + self.origin.structure.n_commands
        for start in range(0, len(self.rows), row):
            while edits and edits[-1][0] == start:
                client.edit(edits.pop()[1])
            substeps, *command = self.rows[start : start + row]
            client.step(command, int(substeps))
        for _, parameters in reversed(edits):
            client.edit(parameters)


@final
@dataclass(frozen=True)
class Record:
    """What a snapshot of Bullet holds. It can be pickled; the saved state then stays behind.

    Attributes:
        history: Until the last step. It is shared, so that taking it costs little: it may go on.
        length: How many numbers of its rows belong to this record.
        n_edits: How many of its edits do.
        last: The world after the last step.
        now: The world with what was changed since.
        light: Whether the two differ in nothing but parameters that live bodies can take on.
        saved: The engine's own state after the last step, if one was kept.
    """

    history: History
    length: int
    n_edits: int
    last: Instant
    now: Instant
    light: bool
    saved: SavedState | None = None

    def past(self) -> History:
        """Copy the history as far as it belongs to this record."""
        rows, origin = self.history.rows[: self.length], self.history.origin
        substeps = int(sum(rows[:: 1 + origin.structure.n_commands]))
        return History(origin, rows, self.history.edits[: self.n_edits], substeps)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "history": self.past(), "saved": None}


@final
class BulletBackend(Backend):
    """Bullet, through pybullet: what it can honour of a ``Model``.

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
        supports=supports, remarks=lambda backend, before: backend.client().remarks(before)
    )

    _history: History
    _last: Instant  # the world after the last step
    _now: Instant  # with what was changed since
    _light: bool  # whether the first client can hold it, edited

    def __init__(self) -> None:
        self._engine, self.version = load()
        self._base: Client | None = None  # holds the world of the last step, once it is needed
        self._spare: Client | None = None  # holds the canonical world, if there is one
        self._saved: SavedState | None = None  # stands for the state of the base

    def __getattr__(self, name: str) -> Any:
        if name == "structure":
            return self._now.structure
        if name in ("_history", "_last", "_now"):
            raise EngineFailure("there is no scene yet; call build() first", self.name)
        raise AttributeError(name)

    # --- clients -------------------------------------------------------------------------------

    def base(self) -> Client:
        """Return the client that holds the last step, perhaps with what live bodies took on."""
        history = self._history
        self._base = self._base or Client(self._engine)
        if self._base.holds is not history:
            history.replay(self._base)
            self._base.holds = history
            if self._light:
                self._base.edit(self._now.parameters)
        return self._base

    def _recall(self) -> None:
        """Spare the base a replay, if one of the clients still has the saved state."""
        base, spare = self._base, self._spare
        if self._saved is None or (base and base.holds is self._history):
            return
        if base and base.load(self._saved):
            base.holds = self._history
        elif spare and spare.load(self._saved):
            spare.holds = self._history
            self._base, self._spare = spare, base

    def client(self) -> Client:
        """Return the client that holds the present."""
        if self._light:
            return self.base()
        self._spare = self._spare or Client(self._engine)
        if self._spare.holds is not self._now:
            self._spare.canonicalize(self._now)
            self._spare.holds = self._now
        return self._spare

    def _drop(self, client: Client) -> None:
        """Disconnect a client in which something went wrong."""
        client.engine.close()
        if client is self._base:
            self._base = None
        else:
            self._spare = None

    # --- the interface -------------------------------------------------------------------------

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing; with the bodies that are there already, where possible."""
        structure = scene.structure
        parameters = self._checked(structure, {}, scene.parameters)
        self._bring(Instant(structure, parameters, settle(structure, scene.state)))
        self._commit()

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Raises:
            ModelError: The engine cannot honour the new structure.
            UnknownOption: The scene has no such parameter.
            NotIntervenable: The engine has no such parameter.
            EngineFailure: A value is not finite, or the engine refused. The world is as it was.
        """
        now, last, structure = self._now, self._last, difference.structure
        state, known = now.structure.empty_state().with_vector(now.state), now.parameters
        if structure is not None:
            difference = complete(Scene(now.structure, known, state), structure, difference)
            known = {}
        else:
            structure = now.structure
        parameters, vector = self._checked(structure, known, difference.parameters), now.state
        if difference.state is not None:
            vector = settle(structure, difference.state, state)
        settable = structure.layout.can_be_set
        self._bring(
            Instant(structure, parameters, vector),
            light=structure == last.structure
            and np.array_equal(vector[settable], last.state[settable])
            and alike(parameters, last.parameters, rebuilt(structure)),
        )

    def _checked(self, structure: Any, known: Parameters, given: Parameters) -> Parameters:
        """Return all parameters, some of them new; those that do not change are the same arrays."""
        if not isinstance(structure, Model):
            name = type(structure).__name__
            raise ModelError([f"Bullet cannot realise a {name}; it takes models"])
        found, before = dict[ParameterKey, Floats](), vars(self).get("_now")
        for key in given if known else [row.key for row in structure.parameters]:
            if key not in (known or given):
                raise UnknownOption("parameter", ".".join(key), map(".".join, known or given))
            value = np.array(given[key], dtype=np.float64)
            old = value if before is None else before.parameters.get(key, value)
            found[key] = old if old.tobytes() == value.tobytes() else value
        check(structure, found)
        return {**known, **found}

    def _bring(self, wish: Instant, *, light: bool = False) -> None:
        """Make a world the present, which stays as it was, should the engine fail half way."""
        if light:
            client = self.base()
        else:
            client = self._spare = self._spare or Client(self._engine)
        try:
            if light:
                client.edit(wish.parameters)
            else:
                client.canonicalize(wish)
                client.holds = wish
        except Infeasible:  # nothing was told to the engine
            raise
        except Exception as error:
            self._drop(client)
            raise EngineFailure(f"Bullet refused the change: {error}", self.name) from error
        self._now, self._light = wish, light

    def _commit(self) -> None:
        """Make the present the world that everything after it starts from."""
        now = self._now
        if self._light:
            old = self._last.parameters
            given = now.parameters.items()
            pending = {key: v for key, v in given if not alike(now.parameters, old, [key])}
            if pending:
                self._history.edits.append((len(self._history.rows), pending))
        else:
            client, self._history = self.client(), History(now)
            client.holds = self._history
            self._base, self._spare, self._saved = client, self._base, None
        self._last, self._light = now, True

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back; see ``Client.parameters``.

        Raises:
            UnknownOption: The scene has no such parameter.
        """
        return self.client().parameters(keys)

    def read(self, into: Any = None) -> Any:
        """Write the present state into an existing one, or a new one."""
        now = self._now
        if not math.isfinite(now.state.sum()):
            raise EngineFailure("Bullet produced a state that is not finite", self.name)
        into = now.structure.empty_state() if into is None else into
        into.vector[:] = now.state
        return into

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        numbers, size = np.asarray(command, dtype=np.float64).tolist(), self.structure.n_commands
        if len(numbers) != size:
            raise ValueError(f"a command has {size} numbers, got {len(numbers)}")
        if substeps < 1:
            return
        if self._now is not self._last:
            self._commit()
        client, history, last = self.base(), self._history, self._last
        try:
            client.step(numbers, substeps)
            state = client.read()
        except Exception as error:
            self._drop(client)  # torques that were not stepped would count twice
            raise EngineFailure(f"Bullet could not step: {error}", self.name) from error
        history.rows.extend((substeps, *numbers))
        history.substeps += substeps
        self._last = self._now = Instant(last.structure, last.parameters, state)
        self._saved = None

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""
        return self.base().contacts()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        history, base = self._history, self._base
        if history.substeps >= LONG and self._saved is None and base and base.holds is history:
            self._saved = base.save()
        counts = len(history.rows), len(history.edits)
        record = Record(history, *counts, self._last, self._now, self._light, self._saved)
        return EngineSnapshot.of(self, record)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine, or another version of it.
        """
        record: Record = snapshot.opened(self)
        mine: History | None = vars(self).get("_history")
        counts = (len(mine.rows), len(mine.edits)) if mine is record.history else None
        if counts != (record.length, record.n_edits):
            self._history = record.past()
        self._last, self._now, self._light = record.last, record.now, record.light
        self._saved = record.saved
        try:
            self._recall()
            if self._light:
                self.base().edit(record.now.parameters)
            self.client()
        except Exception as error:
            self.close()
            raise EngineFailure(f"Bullet could not go there: {error}", self.name) from error

    def close(self) -> None:
        """Disconnect both clients. Closing twice is harmless."""
        for client in (self._base, self._spare):
            if client is not None:
                client.engine.close()
        self._base = self._spare = self._saved = None
        for name in ("_history", "_last", "_now"):
            vars(self).pop(name, None)
