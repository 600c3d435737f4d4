"""What a world has been through since its last canonical state; enough to live it again."""

from __future__ import annotations

import weakref
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, final

from scm_world.backends.bullet.client import Client
from scm_world.backends.bullet.values import Instant, Values
from scm_world.models.scene import ControlMode

Step = tuple[ControlMode, Sequence[float], int]

MODES = tuple(ControlMode)
AHEAD = 2  # numbers of each step before its command: mode and substeps


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
@dataclass(frozen=True)
class Past:
    """The first part of a history: how the world of the last step came about.

    Attributes:
        origin: Where it began.
        rows: The steps: mode, substeps and command of each; it may go on after ``length``.
        length: How many numbers belong to this past.
        edits: Changes of parameters: the length of ``rows`` at that moment, and the new values.
        reported: What nobody can set, after the last step.
    """

    origin: Instant
    rows: array[float]
    length: int
    edits: tuple[tuple[int, Values], ...]
    reported: list[float]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "rows": self.rows[: self.length]}

    def events(self) -> Iterator[Values | Step]:
        """List what happened, in order."""
        edits, row = list(reversed(self.edits)), AHEAD + self.origin.structure.n_commands
        for start in range(0, self.length, row):
            while edits and edits[-1][0] == start:
                yield edits.pop()[1]
            mode, substeps, *command = self.rows[start : start + row]
            yield MODES[int(mode)], command, int(substeps)
        yield from (edit for _, edit in reversed(edits))

    def parameters(self) -> Values:
        """Give all parameters as they are in the end."""
        values = dict(self.origin.parameters)
        for _, edit in self.edits:
            values.update(edit)
        return values


@final
@dataclass(frozen=True)
class Record:
    """What a snapshot of Bullet holds. It can be pickled; the saved state then stays behind.

    Attributes:
        past: How the world of the last step came about.
        present: The world now, if anything was changed since.
        light: Whether the present differs from the last step in nothing but light parameters.
        resting: The state after the last step.
        saved: The engine's own state after the last step, if one was kept.
    """

    past: Past
    present: Instant | None
    light: bool
    resting: list[float]
    saved: SavedState | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "saved": None}


@final
@dataclass
class History:
    """A growing past. What is taken from it shares its numbers, so that taking it costs little.

    Attributes:
        origin: The last canonical state.
        rows: See ``Past``.
        edits: See ``Past``.
        substeps: How many physics steps a replay takes.
    """

    origin: Instant
    rows: array[float] = field(default_factory=lambda: array("d"))
    edits: list[tuple[int, Values]] = field(default_factory=list)
    substeps: int = 0

    @classmethod
    def of(cls, past: Past) -> History:
        """Go on from a past without touching the history it was taken from."""
        rows, row = past.rows[: past.length], AHEAD + past.origin.structure.n_commands
        return cls(past.origin, rows, list(past.edits), int(sum(rows[1::row])))

    def edit(self, values: Values) -> None:
        """Write down a change of parameters."""
        if values:
            self.edits.append((len(self.rows), values))

    def step(self, mode: ControlMode, command: Sequence[float], substeps: int) -> None:
        """Write down a command."""
        self.rows.extend((MODES.index(mode), substeps, *command))
        self.substeps += substeps

    def past(self, reported: list[float]) -> Past:
        """Take what was so far."""
        return Past(self.origin, self.rows, len(self.rows), tuple(self.edits), reported)


def relive(client: Client, past: Past) -> None:
    """Go through a past from its canonical state to its end."""
    client.canonicalize(past.origin)
    for event in past.events():
        if isinstance(event, dict):
            client.edit(event)
        else:
            client.stepped(*event)
