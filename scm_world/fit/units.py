"""Recorded angles in degrees, and quaternions that begin with w, noticed by the motion."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.errors import ModelError
from scm_world.fit.problem import Window, segments_of, windows_of
from scm_world.fit.recordings import MeasuredNumber, Measurements, RecordedRun, commands_of
from scm_world.fit.shooting import SPEEDS, Shooting
from scm_world.fit.targets import twin_of
from scm_world.geometry.rotations import aligned, angle_between
from scm_world.queries.world import World

FEWEST = 5  # rows of a segment in which an acceleration shows
SEGMENTS = 32  # of a recording that are simulated
ALONE = 16  # angles of which each may be in degrees alone, at most
POOR = 0.7  # least share of the motion that is not simulated, if a reading is doubted
BETTER = 0.7  # largest share in another reading, relative to that
MOTION = 1.0  # the same, from which on a reading explains no motion
TURNED = 0.3  # the same of quaternions, which have no scale that would tell
BEGINNING = 0.95  # the same, if they begin at the default orientation in the other reading only
TEN = 10.0  # times less of the motion is not simulated with another factor that is named
NEAR, AWAY = 0.5, 2.0  # [rad] from the default orientation in the other reading, and as they are


class _Reading(NamedTuple):
    """Some columns: angles in degrees, a quaternion with w first, or numbers times a factor.

    Attributes:
        places: Numbers of the columns; none for a command.
        angles: Columns that may jump by a turn.
        quaternion: Whether the columns are a quaternion.
        factor: By which the columns, or the command, are multiplied.
        command: Number of a command.
    """

    places: Integers
    angles: Integers
    quaternion: bool = False
    factor: float = np.pi / 180.0
    command: int | None = None

    def converted(self, run: RecordedRun) -> RecordedRun:
        """Return a run in radians, with quaternions x, y, z, w, or with multiplied numbers."""
        values, commands = run.values.copy(), run.commands.copy()
        if self.command is not None:
            commands[:, self.command] *= self.factor
            sent = None if run.sent is None else (run.sent[0], run.sent[1].copy())
            if sent is not None:
                sent[1][:, self.command] *= self.factor
            return replace(run, commands=commands, sent=sent)
        if self.quaternion:
            values[:, self.places] = values[:, np.roll(self.places, -1)]
            return replace(run, values=values)
        values[:, self.places] *= self.factor
        for cells in (values[:, i] for i in self.angles):
            seen = np.isfinite(cells)
            cells[seen] = np.unwrap(cells[seen])
        return replace(run, values=values)


def check_units(world: World, measured: Measurements) -> None:
    """Refuse a recording that moves like the world only in degrees, or as quaternions (w, x, y, z).

    Segments of about ten rows are simulated from their measured start states. A start state
    determines neither changes of velocities, nor positions whose velocities are measured. A reading
    is doubted where most of this motion is not simulated, and clearly more of it in another one,
    which explains motion: it leaves less than there is.
    The reading of a quaternion is doubted where the recording begins at the default orientation in
    the other reading only.

    Args:
        world: The model of the recorded system; it is not changed.
        measured: The recording.

    Raises:
        ModelError: Columns are in degrees, or an orientation is not in the order x, y, z, w.
    """
    runs, columns, segments = measured.runs, measured.columns, _segments(measured)
    angles = np.array([c.unit in ("rad", "rad/s") for c in columns])
    quaternions = any(c.component == 3 for c in columns)
    if not segments or not (angles.any() or quaternions):
        return
    with Shooting(world, measured, ()) as shooting:
        plain = _compared(shooting, segments)
        found = []
        for reading in _readings(columns, angles, shooting.rotations):
            before, most = plain.share(reading.places), TURNED if reading.quaternion else BETTER
            if reading.quaternion and _begins(world, columns, runs[0], reading):
                most = BEGINNING
            elif before < POOR:
                continue
            shooting.runs = tuple(map(reading.converted, runs))
            other = _compared(shooting, segments)
            after = other.share(reading.places)
            if after < min(most * before, MOTION):
                found.append((other.total, before, after, reading))
    if found:
        _, before, after, reading = min(found, key=lambda one: one[0])
        _refuse([columns[i] for i in reading.places], reading.quaternion, before, after)


def reading_of(world: World, measured: Measurements) -> str:
    """Return which factor on one column or command makes the world follow the recording, in words.

    The factors are those of signs, units and gears. It is empty where none leaves a tenth of the
    motion that is not simulated, or less.
    """
    segments, none = _segments(measured), np.zeros(0, int)
    if not segments:
        return ""
    with twin_of(world) as twin:
        names = [*commands_of(twin)]
        stems = [name.rpartition(".")[0] for name in names]
        gears = [
            float(np.ravel(twin[n])[0]) for n in (f"{s}.gear" for s in stems) if n in twin.model
        ]
    factors = {"-1": -1.0, "1000": 1000.0, "1/1000": 1e-3, "180/pi": 180.0 / np.pi}
    factors["pi/180"] = np.pi / 180.0
    for gear in {*gears} - {0.0, 1.0, -1.0}:
        factors |= {f"1/gear = {1.0 / gear:g}": 1.0 / gear, f"gear = {gear:g}": gear}
    every: list[tuple[str, Any]] = [
        (c.name, {"places": np.array([i])}) for i, c in enumerate(measured.recorded)
    ]
    every += [(name, {"places": none, "command": i}) for i, name in enumerate(names)]
    found = []
    with Shooting(world, measured, ()) as shooting:
        before = _compared(shooting, segments).size
        for (name, what), (words, factor) in itertools.product(every, factors.items()):
            reading = _Reading(angles=none, factor=factor, **what)
            shooting.runs = tuple(map(reading.converted, measured.runs))
            found.append((_compared(shooting, segments).size, name, words))
    after, name, words = min(found)
    said = f"{name} times {words} leaves {after / before:.2g} of the motion that the world does "
    return f"{said}not follow as it is: check its unit and its sign" if TEN * after < before else ""


def _segments(measured: Measurements) -> list[Window]:
    """Return some short segments of a recording."""
    segments = [s for one in windows_of(measured.runs, None) for s in segments_of(one)]
    segments = [one for one in segments if one.last - one.first >= FEWEST]
    return segments[:: -(-len(segments) // SEGMENTS)] if segments else []


def _readings(
    columns: Sequence[MeasuredNumber], angles: Floats, rotations: Sequence[Integers]
) -> Iterator[_Reading]:
    """Yield other readings: of all angles, of each alone, and of quaternions."""
    speeds, every = np.array([c.unit == "rad/s" for c in columns]), np.eye(len(columns)) > 0.0
    kinds = [angles, *([angles & speeds, angles & ~speeds] if (angles & speeds).any() else [])]
    kinds += [*every[angles]] if angles.sum() <= ALONE else []
    for kind in kinds:
        if kind.any():
            yield _Reading(np.flatnonzero(kind), np.flatnonzero(kind & ~speeds))
    yield from (_Reading(places, places[:0], True) for places in rotations)


class _Compared(NamedTuple):
    """Sums of squares of the motion that is not simulated, and of the recorded one, (columns,)."""

    left: Floats
    whole: Floats

    def share(self, places: Integers) -> float:
        """Return the share of the motion of some columns that is not simulated."""
        return float(self.left[places].sum() / max(self.whole[places].sum(), 1e-300))

    @property
    def size(self) -> float:
        """The sum of the shares of all columns."""
        return float((self.left / np.maximum(self.whole, 1e-300)).sum())

    @property
    def total(self) -> float:
        """The sum of the shares of all columns, of each at most 1."""
        return float(np.minimum(self.left / np.maximum(self.whole, 1e-300), 1.0).sum())


def _compared(shooting: Shooting, segments: Sequence[Window]) -> _Compared:
    """Compare simulated segments with recorded ones.

    The part that the start state gives is left out: a constant, and a slope if no velocity was
    measured.
    """
    names = {c.variable for c in shooting.columns}
    parts = [c.variable.rpartition(".") for c in shooting.columns]
    given = [last in SPEEDS.values() or f"{a}.{SPEEDS.get(last)}" in names for a, _, last in parts]
    starts = shooting.guess(segments)
    tasks = [(one, np.zeros(0), start) for one, start in zip(segments, starts, strict=True)]
    left, whole = (np.zeros(len(given)) for _ in range(2))
    for (number, first, last), made in zip(segments, shooting.simulate(tasks), strict=True):
        run = shooting.runs[number]
        recorded = run.values[first:last]
        simulated = np.nan_to_num(aligned(made.values, recorded, shooting.rotations), nan=1e6)
        time = (run.instants[first:last] - run.instants[first]).astype(float)
        for i, known in enumerate(given):
            seen = np.isfinite(recorded[:, i])
            if seen.sum() >= FEWEST - known:
                basis, _ = np.linalg.qr(np.vander(time[seen], 1 if known else 2))
                both = np.stack([recorded[seen, i] - simulated[seen, i], recorded[seen, i]], axis=1)
                squares = ((both - basis @ (basis.T @ both)) ** 2).sum(axis=0)
                left[i] += squares[0]
                whole[i] += squares[1]
    return _Compared(left, whole)


def _begins(
    world: World, columns: Sequence[MeasuredNumber], run: RecordedRun, reading: _Reading
) -> bool:
    """Return whether a run begins at the default orientation in another reading only."""
    with twin_of(world) as twin:
        default = np.ravel(twin[columns[reading.places[0]].variable])
    ones = (one.filled[0, reading.places] for one in (run, reading.converted(run)))
    now, other = (angle_between(one, default) for one in ones)
    return other < NEAR and now > AWAY


def _refuse(
    columns: Sequence[MeasuredNumber], quaternion: bool, before: float, after: float
) -> None:
    kind, advice = "in degrees", "convert them, to rad and rad/s (np.deg2rad)"
    names = ", ".join(c.name for c in columns)
    if quaternion:
        kind, advice, names = "(w, x, y, z)", "give them as x, y, z, w", columns[0].variable
    said = f"the values of {names} are {kind}: the world leaves {before:.2g} of their motion "
    said += f"unexplained as they are, and {after:.2g} of it in that reading"
    otherwise = "if they are right, bring the world nearer to the recorded system"
    raise ModelError([f"{said}; {advice}; {otherwise}"])
