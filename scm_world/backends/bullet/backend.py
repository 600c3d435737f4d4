"""Bullet as a backend: two physics clients, of which one always holds the last step."""

from __future__ import annotations

import math
import weakref
from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Backend, Capabilities, ContactPoint, EngineSnapshot
from scm_world.backends.bullet.client import (
    Client,
    Instant,
    Values,
    arrays,
    known,
    plain,
)
from scm_world.backends.bullet.engine import load, version
from scm_world.backends.bullet.honoured import check, heavy, keys, settle, supports
from scm_world.errors import EngineFailure, Infeasible, ModelError
from scm_world.models.model import Model
from scm_world.models.scene import (
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    complete,
)

LONG = 200  # [physics steps] from here on, saving the engine's state is cheaper than a replay
AHEAD = 1  # numbers of each step before its command: its substeps


@final
class SavedState:
    """A claim on a state that a client keeps; the client forgets it when the claim is dropped."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.generation = client.generation
        self.ticket = client.save()
        weakref.finalize(self, client.forget, self.ticket).atexit = False

    def usable(self) -> bool:
        """Tell whether the client still stands where the state is exact."""
        return self.client.handle is not None and self.client.generation == self.generation


@final
@dataclass
class History:
    """Everything since the last canonical state that is needed to replay it.

    Attributes:
        origin: The last canonical state.
        rows: The steps: substeps and command of each.
        edits: Changes of parameters: the length of ``rows`` at that moment, and the new values.
        substeps: How many physics steps a replay takes.
    """

    origin: Instant
    rows: array[float] = field(default_factory=lambda: array("d"))
    edits: list[tuple[int, Values]] = field(default_factory=list)
    substeps: int = 0

    def relive(self, client: Client) -> None:
        """Go through it again, from the canonical state to the end."""
        client.canonicalize(self.origin)
        edits, row = list(reversed(self.edits)), AHEAD + self.origin.structure.n_commands
        for start in range(0, len(self.rows), row):
            while edits and edits[-1][0] == start:
                client.edit(edits.pop()[1])
            substeps, *command = self.rows[start : start + row]
            client.step(command, int(substeps))
        for _, values_ in reversed(edits):
            client.edit(values_)


@final
@dataclass(frozen=True)
class Record:
    """What a snapshot of Bullet holds. It can be pickled; the saved state then stays behind.

    Attributes:
        origin: See ``History``.
        rows: The same. They are shared, so that taking them costs little: it may go on.
        length: How many of its numbers belong to this record.
        edits: See ``History``.
        reported: What cannot be set, after the last step.
        present: The world now, if anything was changed since.
        light: Whether the present differs from the last step in nothing but light parameters.
        resting: The state after the last step.
        saved: The engine's own state after the last step, if one was kept.
    """

    origin: Instant
    rows: array[float]
    length: int
    edits: tuple[tuple[int, Values], ...]
    reported: list[float]
    present: Instant | None
    light: bool
    resting: list[float]
    saved: SavedState | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "rows": self.rows[: self.length], "saved": None}


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
        supports=lambda structure, key: isinstance(structure, Model) and supports(structure, key),
        remarks=lambda backend, before: backend._now().remarks(before),
    )

    def __init__(self) -> None:
        self._engine = load()
        self.version = version()
        self._base: Client | None = None  # holds the world of the last step, once it is needed
        self._lost = False  # whether the past must be replayed before the base is used
        self._spare: Client | None = None  # holds the canonical world, if there is one
        self._history: History | None = None
        self._before: Values = {}  # parameters of the last step
        self._present: Instant | None = None  # what was made of the last step since
        self._light = True  # whether the base itself holds the present, and not the spare
        self._reported: list[float] = []  # what cannot be set, after the last step
        self._resting: list[float] | None = None  # state of the base, once it was asked for
        self._saved: SavedState | None = None  # of the base

    def __getattr__(self, name: str) -> Any:
        if name == "structure":
            return (self._present or self._lived().origin).structure
        raise AttributeError(name)

    # --- clients -------------------------------------------------------------------------------

    def _lived(self) -> History:
        if self._history is None:
            raise EngineFailure("there is no scene yet; call build() first", self.name)
        return self._history

    def _last(self) -> Client:
        """Give the client that holds the world of the last step."""
        history = self._lived()
        if self._base is None:
            self._base, self._lost = Client(self._engine), True
        if self._lost:
            history.relive(self._base)
            self._lost = False
        return self._base

    def _other(self) -> Client:
        """Give the client that does not hold the last step."""
        if self._spare is None:
            self._spare = Client(self._engine)
        return self._spare

    def _now(self) -> Client:
        """Give the client that holds the present."""
        return self._last() if self._light else self._other()

    # --- the interface -------------------------------------------------------------------------

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing; with the bodies that are there already, where possible."""
        structure = scene.structure
        if not isinstance(structure, Model):
            name = type(structure).__name__
            raise ModelError([f"Bullet cannot realise a {name}; it takes models"])
        parameters = plain(scene.parameters, known(scene.parameters, keys(structure)))
        check(structure, parameters)
        origin = Instant(structure, parameters, settle(structure, scene.state))
        with self._all_or_nothing():
            self._other().canonicalize(origin)
        self._present, self._light = origin, False
        self._reported = [0.0] * int((~structure.layout.can_be_set).sum())
        self._commit()

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Raises:
            ModelError: The engine cannot honour the new structure.
            UnknownOption: The scene has no such parameter.
            NotIntervenable: The engine has no such parameter.
            EngineFailure: A value is not finite, or the engine refused. The world is as it was.
        """
        present = self._described()
        wish = self._wish(present, difference)
        light = self._is_light(self._described_base(), wish)
        with self._all_or_nothing():
            if light:
                changed = difference.parameters if self._light else wish.parameters
                self._last().edit({key: wish.parameters[key] for key in changed})
            elif not self._light and self._is_light(present, wish):
                spare = self._other()
                spare.edit({key: wish.parameters[key] for key in difference.parameters})
            else:
                self._other().canonicalize(wish)
        self._present, self._light = wish, light

    def _described_base(self) -> Instant:
        """Describe the world of the last step."""
        structure = self._lived().origin.structure
        if self._resting is None:
            self._resting = self._last().read([0.0] * len(self._reported))
        return Instant(structure, self._before, self._resting)

    def _described(self) -> Instant:
        """Describe the present."""
        return self._present or self._described_base()

    def _wish(self, present: Instant, difference: Difference) -> Instant:
        """Say which world the difference makes of the present."""
        structure, parameters, state = present.structure, present.parameters, present.state
        if difference.structure is not None:
            now = Scene(
                structure,
                arrays(parameters),
                structure.empty_state().with_vector(np.array(state)),
            )
            structure = difference.structure
            difference = complete(now, structure, difference)
            given = difference.parameters
            parameters = plain(given, known(given, keys(structure)))
        elif difference.parameters:
            given = difference.parameters
            parameters = {**parameters, **plain(given, known(parameters, given))}
        if difference.structure is not None or difference.parameters:
            check(structure, parameters)
        if difference.state is not None:
            state = settle(structure, difference.state)
        return Instant(structure, parameters, state)

    def _is_light(self, here: Instant, there: Instant) -> bool:
        """Tell whether one world becomes another without setting a state.

        That is so if only parameters change that live bodies can take on.
        """
        return (
            here.structure == there.structure
            and here.state == there.state
            and all(here.parameters[k] == there.parameters[k] for k in heavy(here.structure))
        )

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        """Bring the present back, should the engine fail half way."""
        try:
            yield
        except Infeasible:  # nothing was told to the engine
            if self._history is not None:
                self._return()
            raise
        except Exception as error:
            if self._spare is not None:
                self._spare.close()
                self._spare = None
            if self._history is not None:
                self._return()
            raise EngineFailure(f"Bullet refused the change: {error}", self.name) from error

    def _return(self) -> None:
        """Bring the clients back to the present."""
        present = self._described()
        if self._light:
            self._last().edit(present.parameters)
        else:
            self._other().canonicalize(present)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back; see ``Client.parameters``.

        Raises:
            UnknownOption: The scene has no such parameter.
        """
        return self._now().parameters(keys)

    def read(self, into: Any = None) -> Any:
        """Write the present state into an existing one, or a new one."""
        numbers = self._now().read(self._reported)
        if not math.isfinite(sum(numbers)):
            raise EngineFailure("Bullet produced a state that is not finite", self.name)
        into = self.structure.empty_state() if into is None else into
        into.vector[:] = numbers
        return into

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps.

        Raises:
            UnknownOption: Commands of this structure mean something else.
        """
        numbers, size = np.asarray(command, dtype=np.float64).tolist(), self.structure.n_commands
        if len(numbers) != size:
            raise ValueError(f"a command has {size} numbers, got {len(numbers)}")
        if substeps < 1:
            return
        self._commit()
        client, history = self._last(), self._lived()
        try:
            reported = client.step(numbers, substeps)
        except Exception as error:
            client.close()  # torques that were not stepped would count twice
            self._base = None
            raise EngineFailure(f"Bullet could not step: {error}", self.name) from error
        history.rows.extend((substeps, *numbers))
        history.substeps += substeps
        self._reported, self._resting, self._saved = reported, None, None

    def _commit(self) -> None:
        """Make the present the world that everything after it starts from."""
        if self._present is None:
            return
        if self._light:
            history, before = self._lived(), self._before
            now = self._present.parameters
            pending = {key: value for key, value in now.items() if value != before[key]}
            if pending:
                history.edits.append((len(history.rows), pending))
        else:
            self._history = History(self._present)
            self._base, self._spare, self._lost = self._spare, self._base, False
            self._resting = self._saved = None
        self._before = self._present.parameters
        self._present, self._light = None, True

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the contact points of the last physics step."""
        return self._last().contacts()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        history, resting = self._lived(), self._described_base().state
        if history.substeps >= LONG and self._saved is None and not self._lost:
            self._saved = SavedState(self._last())
        record = Record(
            history.origin,
            history.rows,
            len(history.rows),
            tuple(history.edits),
            self._reported,
            self._present,
            self._light,
            resting,
            self._saved,
        )
        return EngineSnapshot.of(self, record)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine, or another version of it.
        """
        record: Record = snapshot.opened(self)
        rows, row = record.rows[: record.length], AHEAD + record.origin.structure.n_commands
        self._history = History(record.origin, rows, list(record.edits), int(sum(rows[::row])))
        self._before = dict(record.origin.parameters)
        for _, edit in record.edits:
            self._before.update(edit)
        self._present, self._light = record.present, record.light
        self._reported, self._resting = record.reported, record.resting
        self._lost, self._saved = True, None
        try:
            self._recall(record.saved)
            self._return()
        except Exception as error:
            self.close()
            raise EngineFailure(f"Bullet could not go there: {error}", self.name) from error

    def _recall(self, saved: SavedState | None) -> None:
        """Spare the base a replay, if one of the clients still has the saved state."""
        if saved is None or not saved.usable():
            return
        if saved.client is self._spare:
            self._base, self._spare = self._spare, self._base
        if saved.client is self._base:
            saved.client.load(saved.ticket)
            saved.client.edit(self._before)
            self._lost, self._saved = False, saved

    def close(self) -> None:
        """Disconnect both clients. Closing twice is harmless."""
        for client in (self._base, self._spare):
            if client is not None:
                client.close()
        self._base = self._spare = self._history = self._present = self._saved = None
