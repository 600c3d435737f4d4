"""Recordings from elsewhere: time, commands and measurements, as control steps of a world."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, final

import numpy as np

from scm_world._arguments import real_number
from scm_world._patterns import as_names, fits, fitting
from scm_world._types import ArrayLike, Floats, Integers, Value
from scm_world.errors import (
    ModelError,
    ScmWorldError,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
    in_one_line,
)
from scm_world.fit.logs import BAGS, SAME, Clock, Log, Step, is_log, read_log
from scm_world.geometry.rotations import aligned
from scm_world.queries.episodes import Episode
from scm_world.runs.files import located, read_arrays, read_bytes
from scm_world.variables import Box, Rotations, Variable
from scm_world.world import Simulation

if TYPE_CHECKING:
    import pandas as pd

TIME, EPISODE, SETUP, DO = "time", "episode", "do", "do."
JITTER = 0.25  # of a control step: largest error of a time
FRACTION = 0.01  # of a physics step, by which rows may be apart from whole ones
DRIFT = 0.002  # largest relative error of a clock
GAP = 1.5  # of the usual distance of rows: a longer one ends a run
LONG = 500  # control steps from row to row, of which one of another unit of time has more
SLOW = 25  # the same, where these are a second or more
FEW = 5  # measurements of which noise can be estimated
FLOOR = 1e-6  # least noise, relative to the spread of a column
LEAST = 1e-9  # least noise
REST = 1e-3  # standard deviation of a velocity or an activation at rest
SHOWN = 20  # names that a message lists
ROUNDING = 1e-3  # of a range, by which commands of a file may exceed it
UNIT = 10.0  # of a range, which is soft: states that exceed it by more are in another unit
TURN = 2.0 * np.pi
FACTORS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "rad": 1.0, "deg": TURN / 360.0}
FACTORS |= {"rad/s": 1.0, "deg/s": TURN / 360.0, "rpm": TURN / 60.0, "m": 1.0, "mm": 1e-3}

KINDS = (
    "the path of a .csv, .txt, .tsv, .parquet or .npz file",
    "the path of a ROS bag (a folder, .mcap, .db3, .bag) or of a LeRobot dataset (a folder)",
    "a data frame",
    "arrays by name",
    "an Episode",
    "a Dataset with a row for each control step",
    "a dataset of Minari or an episode of one",
    "a list of these",
)
LACKING = "column of the table"  # of an error: a renamed one that no table has
READOUTS = (".position", ".orientation", ".linear_velocity", ".angular_velocity", ".value")


Recording: TypeAlias = object
"""A recording of one of the kinds that ``World.fit`` lists; ``read_recording`` refuses others."""

Noise: TypeAlias = float | Mapping[str, float | None] | None
"""Standard deviation of the noise: of all columns, by patterns of columns, or None: estimated."""

Begins: TypeAlias = str | Mapping[str, tuple[float, float]] | None
"""How runs begin: "rest", or values with standard deviations by patterns of states, or unknown."""

Limits: TypeAlias = Mapping[str, tuple[float, float]]
"""Ranges by names or patterns of columns."""


class MeasuredNumber(NamedTuple):
    """A measured number: its column, and the variable and component that it is.

    Attributes:
        name: ``"hinge.position"``, or ``"gravity[2]"`` for a component of a vector.
        variable: Name of the variable.
        component: Number of the component.
        unit: Unit of the variable.
    """

    name: str
    variable: str
    component: int
    unit: str


@final
@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A recorded run without a gap.

    Attributes:
        commands: The command of each control step, shape (steps, n_actions).
        instants: Number of the control step at whose beginning each row was measured, ascending
            from 0, shape (rows,).
        values: Measurements, shape (rows, columns); NaN where nothing was measured.
        begin: Time of its first row [s].
        whole: Whether it begins with the recording, and not after a gap.
        do: Its set-up: values of parameters that were set for it, by columns.
        before: Commands of the control steps before its first row, if they are known, shape
            (steps, n_actions), of which a delay has the last ones.
        sent: Where commands were sent within control steps: the time of each in control steps from
            the first row, ascending, shape (n,), and the commands from there on, (n, n_actions).
    """

    commands: Floats
    instants: Integers
    values: Floats
    begin: float = 0.0
    whole: bool = True
    do: Mapping[str, float] = field(default_factory=dict)
    before: Floats | None = None
    sent: tuple[Floats, Floats] | None = None

    @cached_property
    def filled(self) -> Floats:
        """Measurements, interpolated where missing; NaN in a column that was never measured."""
        found = self.values.copy()
        for column in found.T:
            seen = np.isfinite(column)
            if seen.any():
                column[:] = np.interp(self.instants, self.instants[seen], column[seen])
        return found

    def late(self, steps: Integers) -> Floats:
        """Return the commands of control steps, also of those before the first row (n, n_actions).

        Where it is not known, the first command is assumed to hold before.
        """
        before = self.commands[:0] if self.before is None else self.before
        sent = np.concatenate([before, self.commands])
        return sent[np.clip(steps + len(before), 0, len(sent) - 1)]

    def acting(self, delays: Floats, steps: Integers, substeps: int) -> Floats:
        """Return the mean command of each physics step, of commands that were ``sent`` within them.

        Before the first command, this one is assumed to hold.

        Args:
            delays: Delay of each command [control steps], shape (n_actions,).
            steps: Numbers of control steps, shape (n,).
            substeps: Physics steps of a control step.

        Returns:
            Shape (n, substeps, n_actions).
        """
        every = np.arange(len(self.commands), dtype=float), self.commands
        times, commands = every if self.sent is None else self.sent
        found = np.empty((len(steps), substeps, commands.shape[1]))
        start = steps[:, None] + np.arange(substeps) / substeps
        for i, delay in enumerate(delays.tolist()):
            one = commands[:, i]
            sums = np.concatenate([[0.0], np.cumsum(one[:-1] * np.diff(times))])
            begin, end = start - delay, start - delay + 1.0 / substeps
            first = np.maximum(np.searchsorted(times, begin, "right") - 1, 0)
            last = np.maximum(np.searchsorted(times, end, "left") - 1, 0)
            before = sums[first] + one[first] * (begin - times[first])
            after = sums[last] + one[last] * (end - times[last])
            found[..., i] = np.where(first >= last, one[first], (after - before) * substeps)
        return found

    def part(self, first: int, last: int, control_dt: float) -> RecordedRun:
        """Return the run from a row to that before another one, with the length of a step [s]."""
        since, instants = int(self.instants[first]), self.instants[first:last]
        sent = self.commands[since : int(instants[-1])]
        begin, whole = self.begin + control_dt * since, self.whole and not first
        before = self.late(np.arange(since))
        within = None if self.sent is None else (self.sent[0] - since, self.sent[1])
        rest = self.values[first:last], begin, whole, self.do, before, within
        return RecordedRun(sent, instants - since, *rest)


@final
@dataclass(frozen=True, eq=False)
class Measurements:
    """Recorded runs, and the columns that were measured in them.

    Attributes:
        runs: The runs.
        columns: Their measured columns.
        control_dt: Length of a control step [s].
        begins: Standard deviations of the last columns, which are known where a run begins.
        every: Every which row of the recording is among these; see ``thinned``.
    """

    runs: tuple[RecordedRun, ...]
    columns: tuple[MeasuredNumber, ...]
    control_dt: float
    begins: tuple[float, ...] = ()
    every: int = 1

    @property
    def recorded(self) -> tuple[MeasuredNumber, ...]:
        """The columns that were recorded."""
        return self.columns[: len(self.columns) - len(self.begins)]

    @cached_property
    def values(self) -> Floats:
        """The measurements of all runs, shape (rows, columns); NaN where nothing was measured."""
        return np.concatenate([run.values for run in self.runs])

    @cached_property
    def cells(self) -> tuple[Integers, Integers]:
        """The row and the column of each measured number, shape (n,) each."""
        row, column = np.nonzero(np.isfinite(self.values))
        return row, column

    @cached_property
    def least(self) -> Floats:
        """The least noise of each column: rounding, and that of files and finite differences."""
        return np.asarray(np.maximum(FLOOR * np.nanstd(self.values, axis=0), LEAST))

    @cached_property
    def noise(self) -> Floats:
        """The noise of each column from third differences, in which smooth motion vanishes."""
        found = list[float]()
        for each in zip(*(run.values.T for run in self.runs), strict=True):
            steps = np.concatenate([np.diff(one[np.isfinite(one)], n=3) for one in each])
            size = float(np.median(np.abs(steps))) if len(steps) > 3 else 0.0
            found.append(size / 0.6745 / np.sqrt(20.0))
        return np.asarray(np.maximum(found, self.least))

    def given(self, noise: Noise) -> Floats:
        """Return the given standard deviation of each column, shape (columns,); NaN where unknown.

        Args:
            noise: None, one number for all columns, or numbers by patterns of columns or variables.

        Raises:
            UnknownOption: A number is not positive, or missing: a column has too few measurements
                to estimate it.
            UnknownVariable: A pattern fits no column.
        """
        found = np.full(len(self.recorded), np.nan)
        places = {column.name: i for i, column in enumerate(self.recorded)}
        for pattern, value in (noise if isinstance(noise, Mapping) else {"*": noise}).items():
            if value is None and pattern == "*":
                continue
            deviation = real_number("noise", value)
            if deviation <= 0.0:
                raise UnknownOption("noise", value, ("a standard deviation above zero",))
            whole = [c.name for c in self.recorded if fits(c.variable, (pattern,))]
            for name in whole or fitting(pattern, places):
                found[places[name]] = deviation
        counts = np.isfinite(self.values).sum(axis=0)
        for column, given, n in zip(self.recorded, found, counts, strict=False):
            if n < (FEW if np.isnan(given) else 1):
                about = f"noise of {column.name}", f"not given: {n} measurements"
                allowed = f"estimated from at least {FEW} measurements; give noise="
                raise UnknownOption(*about, (f"{allowed}, or leave it out",))
        return np.append(found, self.begins)


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of the columns of a variable.

    Example:
        >>> labels("mass", ()), labels("size", (2,))
        (['mass'], ['size[0]', 'size[1]'])
    """
    return [name] if shape == () else [f"{name}[{i}]" for i in range(int(np.prod(shape)))]


def setup_of(world: Simulation, do: Any) -> dict[str, float]:
    """Return the set-up of a run, values of parameters by name, by its columns.

    Raises:
        UnknownOption: It is no dictionary, or a value has another shape.
        UnknownVariable: A name is not that of a parameter that can be set.
    """
    if not isinstance(do, Mapping):
        raise UnknownOption("set-up", do, ("a dictionary of values of parameters by name",))
    known, found = settable_of(world), dict[str, float]()
    parts = {label: name for name in known for label in labels(name, known[name].shape)}
    for name, value in do.items():
        if name not in known and name not in parts:
            raise UnknownVariable(str(name), [*known, *parts])
        own = labels(name, known[name].shape) if name in known else [name]
        try:
            numbers = np.asarray(value, float).ravel()
        except (TypeError, ValueError):
            numbers = np.array([np.nan])
        if len(numbers) != len(own) or not np.isfinite(numbers).all():
            raise UnknownOption(f"set-up of {name!r}", value, (f"{len(own)} finite numbers",))
        found |= dict(zip(own, numbers.tolist(), strict=True))
    return found


def settable_of(world: Simulation) -> dict[str, Variable]:
    """Return the parameters of real numbers that can be set, by name."""
    variables = {name: world.model.declared(name) for name in world.compiled.static_names}
    return {n: v for n, v in variables.items() if v.is_root and v.settable and v.dtype == "real"}


class Reading(NamedTuple):
    """How recordings are read.

    Attributes:
        setups: The set-up of each of several recordings, if they do not have it.
        columns: Names of this world by those of the tables.
        ignore: Patterns of columns that are left out.
    """

    setups: Sequence[Mapping[str, object]] | None = None
    columns: Mapping[str, str] | None = None
    ignore: Iterable[str] = ()

    def meant(self, names: Iterable[str]) -> dict[str, tuple[str, float | None]]:
        """Return the columns that are read, of those with some names: a new name, and a factor.

        The factor is None where no unit is given.

        Raises:
            UnknownOption: A unit is not known.
        """
        ignore, found = as_names(self.ignore), dict[str, tuple[str, float | None]]()
        for own in names:
            stem, bracket, place = own.partition("[")
            if fits(own, ignore):
                continue
            name, factor = own, None
            for pattern, given in (self.columns or {}).items():
                target, unit = _with_unit(given)
                if target and pattern in (own, stem):
                    name = target if pattern == own else f"{target}{bracket}{place}"
                if pattern in (own, stem) or (not target and fits(own, (pattern,))):
                    factor = unit
            found[own] = name, factor
        return found

    def named(self, table: Any) -> Any:
        """Return a table or arrays by name, with the names and in the units of this world."""
        if not (self.columns or self.ignore):
            return table
        names = {str(name).strip(): name for name in table}
        found = self.meant(names)
        if isinstance(table, Mapping):
            arrays = {
                name: np.asarray(table[names[own]]) * factor if factor else table[names[own]]
                for own, (name, factor) in found.items()
            }
            if len(arrays) < len(found):
                raise ModelError(["columns= gives two columns one name: leave one out by ignore="])
            return arrays
        kept = table[[names[own] for own in found]].set_axis([n for n, _ in found.values()], axis=1)
        for i, (own, (_, factor)) in enumerate(found.items()):
            if factor is not None:
                cells = table[names[own]]
                try:
                    kept.isetitem(i, cells.astype(float) * factor)
                except (TypeError, ValueError) as error:
                    raise ModelError([f"the column {own!r} has no unit: {error}"]) from error
        return kept

    def missing(self, names: Collection[str]) -> list[str]:
        """Return the columns that are renamed, and are not among those with some names."""
        there = {*names, *(name.partition("[")[0] for name in names)}

        def found(one: str, given: str) -> bool:
            """Return whether a column is there, or one of the pattern of those with a unit."""
            return one in there or (given.startswith("[") and any(fits(n, (one,)) for n in names))

        return [one for one, given in (self.columns or {}).items() if not found(one, given)]


def _with_unit(given: str) -> tuple[str, float | None]:
    """Return a name, and the factor of the unit that follows it, if one does.

    Example:
        >>> _with_unit("time [ms]"), _with_unit("gravity[2]"), _with_unit("[deg]")[0]
        (('time', 0.001), ('gravity[2]', None), '')
    """
    found = re.fullmatch(r"(.*?)\s*\[([^]\d][^]]*)\]", str(given))
    if found is None:
        return str(given), None
    if found[2] not in FACTORS:
        raise UnknownOption("unit", found[2], FACTORS)
    return found[1], FACTORS[found[2]]


def read_recording(
    world: Simulation, recording: Recording, how: Reading | None = None
) -> Measurements:
    """Read a recording.

    A run ends where a command is not known: at a gap, which is longer than the usual (median)
    distance of rows, and after a row without a command.

    Args:
        world: The model of the recorded system, which defines the control step and the meaning of
            the columns.
        recording: See ``World.fit``.
        how: How to read it.

    Raises:
        UnknownOption: The recording is of another kind, has another number of set-ups, or lacks a
            column that is renamed.
        ModelError: The tables have faults; see ``World.fit``.
        UnreadableFile: A file cannot be read.
    """
    import pandas as pd

    known = columns_of(world)
    frames: list[tuple[str, pd.DataFrame, bool]] = []
    every = [*recording] if isinstance(recording, list | tuple) else [recording]
    how = how or Reading()
    setups = [{}] * len(every) if how.setups is None else how.setups
    if len(setups) != len(every):
        raise UnknownOption("setups", f"{len(setups)} set-ups", (f"{len(every)}, one of each",))
    names, has = dict[str, None](), dict[str, str]()  # of all columns; what logs have, in words
    for number, (one, setup) in enumerate(zip(every, setups, strict=True)):
        label = f"run {number}" if one is not recording else ""
        label, table = (
            (str(one), _file(world, one, how)) if isinstance(one, str | Path) else (label, one)
        )
        if isinstance(table, Log):
            names |= dict.fromkeys(table.names)
            made = [*_frames(world, table.table, label, setup)]
            has |= {name: f"{one} has {table.said}" for name, _, _ in made}
            frames += made
        elif isinstance(table, Mapping | pd.DataFrame):
            names |= dict.fromkeys(str(name).strip() for name in table)
            frames += _frames(world, how.named(table), label, setup)
        else:
            made = [*_frames(world, table, label, setup)]
            names |= dict.fromkeys(str(name) for _, frame, _ in made for name in frame)
            frames += [(n, how.named(frame), by) for n, frame, by in made]
    if not frames:
        raise UnknownOption("recording", recording, ("one or more runs",))
    if missing := how.missing(names):
        allowed = [*names, *dict.fromkeys(has.values())]
        raise UnknownOption(LACKING, missing[0], allowed)
    for label, frame, _ in frames:
        faults = [*_faults(world, frame)]
        faults += [has[label]] if faults and label in has else []
        _refuse(faults, label * (len(frames) > 1))
    seen = (name for _, frame, _ in frames for name in frame if frame[name].notna().any())
    columns = tuple(known[name] for name in dict.fromkeys(seen) if name in known)
    if not columns:
        _refuse([f"nothing was measured: give columns such as {_few(known.values())}"])
    runs = list[RecordedRun]()
    for label, frame, simulated in frames:
        slack = np.inf if simulated else UNIT
        runs += _runs(world, frame.astype(float), columns, slack, label * (len(frames) > 1))
    return Measurements(tuple(runs), columns, world.options.control_period)


def at_rest(world: Simulation, run: RecordedRun) -> dict[str, float]:
    """Return velocities and activations at rest: 0, or the first command that these follow."""
    commands, found = commands_of(world, bundles=True), dict[str, float]()
    for name in _states(world):
        stem, _, kind = name.rpartition(".")
        if kind == "activation" or kind.endswith(("velocity", "velocities")):
            followed = f"{stem}.timeconst" in world.compiled.parameter_keys
            command = commands.get(f"{stem}.control" if followed and kind == "activation" else "")
            value = 0.0 if command is None else float(run.commands[0, command.component])
            found |= dict.fromkeys(labels(name, world.model.declared(name).shape), value)
    return found


def begun(world: Simulation, measured: Measurements, begins: Begins) -> Measurements:
    """Return a recording that begins as is known, which is a further measurement of its first row.

    Args:
        world: A twin of the world.
        measured: The recording.
        begins: "rest": velocities and activations as ``at_rest``, with a standard deviation of
            0.001; or values and standard deviations by patterns of states.

    Raises:
        UnknownOption: It is something else, or a standard deviation is not positive.
        UnknownVariable: A pattern fits no state.
    """
    if begins is None:
        return measured
    states = {label for n in _states(world) for label in labels(n, world.model.declared(n).shape)}
    known, every = columns_of(world), list[dict[str, tuple[float, float]]]()
    for run in measured.runs:
        if begins == "rest":
            rest = at_rest(world, run).items()
            every.append({name: (value, REST) for name, value in rest})
        elif isinstance(begins, Mapping):
            every.append({})
            for pattern, given in begins.items():
                pair = np.asarray(given, float)
                if pair.shape != (2,) or not np.isfinite(pair).all() or pair[1] <= 0.0:
                    allowed = ("a value and a standard deviation above zero",)
                    raise UnknownOption(f"begins[{pattern!r}]", given, allowed)
                value, deviation = map(float, pair)
                whole = [n for n in known if n in states and fits(known[n].variable, (pattern,))]
                names = whole or fitting(pattern, states)
                every[-1] |= dict.fromkeys(names, (value, deviation))
        else:
            raise UnknownOption("begins", begins, ("rest", "values and deviations by states"))
    names = [*every[0]]
    if not names:
        raise UnknownOption("begins", begins, ("that of a world with velocities or activations",))
    runs = list[RecordedRun]()
    for run, one in zip(measured.runs, every, strict=True):
        first = np.full((len(run.values), len(names)), np.nan)
        if run.whole:
            first[0] = [one[name][0] for name in names]
        runs.append(replace(run, values=np.hstack([run.values, first])))
    columns = [known[name]._replace(name=f"{name} at the start") for name in names]
    deviations = tuple(every[0][name][1] for name in names)
    return replace(
        measured, runs=tuple(runs), columns=(*measured.columns, *columns), begins=deviations
    )


def _refuse(problems: Iterable[str], label: str = "") -> None:
    """Raise the faults of a table, if there are any."""
    if found := [f"{label}: {problem}" if label else problem for problem in problems]:
        raise ModelError(found)


# --- kinds of recordings --------------------------------------------------------------------------


def _frames(
    world: Simulation, given: Any, label: str = "", do: object = None
) -> Iterator[tuple[str, pd.DataFrame, bool]]:
    """Yield each table or episode: a name, a frame with the time [s], and if we recorded it.

    Its set-up becomes columns.
    """
    import pandas as pd

    if do:
        setup = {f"{DO}{name}": value for name, value in setup_of(world, do).items()}
        made = _frames(world, given, label)
        yield from ((name, _set_up(frame, setup), simulated) for name, frame, simulated in made)
        return

    dt = world.options.control_period
    if isinstance(given, list | tuple):
        for number, one in enumerate(given):
            yield from _frames(world, one, f"run {number}")
    elif isinstance(given, str | Path):
        raise UnknownOption("recording", str(given), ("paths in a list that is not in another",))
    elif isinstance(given, Episode):
        arrays = {TIME: dt * np.arange(given.steps + 1)}
        names = (*world.compiled.actions, *_states(world))
        yield label, _framed(arrays | {name: given[name] for name in names}), True
    elif isinstance(given, pd.DataFrame):
        frame = given.rename(columns=lambda name: str(name).strip())
        if EPISODE in frame:
            for which, part in frame.groupby(EPISODE, dropna=False):
                yield f"{label} episode {which}".strip(), part.drop(columns=EPISODE), False
        else:
            yield label, frame, False
    elif isinstance(given, Mapping):
        arrays = {name: given[name] for name in given if name != SETUP}
        yield from _frames(world, _framed(arrays), label, given.get(SETUP))
    elif hasattr(given, "iterate_episodes"):  # a dataset of Minari
        _refuse_scaled(given)
        for one in given.iterate_episodes():
            yield from _frames(world, one, f"episode {one.id}")
    elif hasattr(given, "observations") and hasattr(given, "actions"):  # an episode of Minari
        yield label, _of_minari(world, given), True
    elif hasattr(given, "is_temporal") and hasattr(given, "regimes"):  # a Dataset
        if not given.is_temporal:
            raise UnknownOption("dataset", "rows that are whole episodes", ("every_step=True",))
        frame = pd.DataFrame(given.values, columns=given.names)
        known = {*columns_of(world), *commands_of(world)}  # without the parameters
        frame = frame[[name for name in given.names if name in known]]
        frame = frame.assign(time=dt * given.step, episode=given.episode)
        yield from ((name, part, True) for name, part, _ in _frames(world, frame, label))
    else:
        raise UnknownOption("recording", type(given).__name__, KINDS)


def _set_up(frame: pd.DataFrame, setup: Mapping[str, float]) -> pd.DataFrame:
    """Return a table with the columns of a set-up, which it has not yet."""
    _refuse(f"{n} is in the recording, and in its set-up: give one" for n in setup if n in frame)
    return frame.assign(**setup)


def _refuse_scaled(given: object) -> None:
    """Refuse a dataset of an environment of this package whose numbers are in [-1, 1]."""
    spec = getattr(given, "env_spec", None)
    if spec is None or not spec.id.startswith("scm_world/"):
        return
    options = ("normalize_actions", "normalize_observations")
    if scaled := [name for name in options if spec.kwargs.get(name, True)]:
        allowed = (f"one of an environment with {', '.join(f'{n}=False' for n in options)}",)
        raise UnknownOption("dataset", f"numbers in [-1, 1] ({', '.join(scaled)})", allowed)


def _of_minari(world: Simulation, given: Any) -> pd.DataFrame:
    """Return observations, in the order of the world's observed variables, and actions."""
    if not isinstance(given.observations, np.ndarray):
        raise UnknownOption("observations", "a dictionary", ("arrays, one for each instant",))
    names = [one for n in world.observed for one in labels(n, world.model.declared(n).shape)]
    seen = given.observations.reshape(len(given.observations), -1)
    if seen.shape[1] != len(names):
        allowed = (f"{len(names)} numbers: {', '.join(names)}",)
        raise UnknownOption("observation", f"{seen.shape[1]} numbers", allowed)
    time = world.options.control_period * np.arange(len(seen))
    arrays = {TIME: time, **dict(zip(names, seen.T, strict=True))}
    arrays |= {name: given.actions[:, at] for name, at in world.compiled.actions.items()}
    return _framed(arrays)


def _file(
    world: Simulation, path: str | Path, how: Reading
) -> pd.DataFrame | dict[str, Value] | Log:
    """Return a table, arrays by name, or the columns of a log that a world has."""
    import pandas as pd

    place = located(path)
    known = columns_of(world) | commands_of(world, bundles=True)

    def chosen(columns: Mapping[str, str], units: bool) -> dict[str, tuple[str, float]]:
        """Choose the columns of a log that the world has, by their names or by columns=."""
        found, unsaid = dict[str, tuple[str, float]](), list[str]()
        for raw, (given, factor) in how.meant(columns).items():
            name = columns[raw] if given == raw else given
            if name not in known and given != raw:
                raise UnknownVariable(name, known)
            if name not in known or fits(name, as_names(how.ignore)):
                continue
            unsaid += [raw] * (not units and factor is None and known[name].unit.startswith("rad"))
            if twice := [other for other, (one, _) in found.items() if one == name]:
                said = f"{twice[0]} and {raw} are both {name}"
                raise ModelError([f"{said}: leave one out by ignore=[{raw!r}]"])
            found[raw] = name, 1.0 if factor is None else factor
        if unsaid:
            said = f"the dataset does not say the unit of {', '.join(unsaid)}, which are often in"
            advice = f"give it, columns={{{unsaid[0]!r}: '[deg]'}} or '[rad]', patterns too"
            raise ModelError([f"{said} degrees or in -100 to 100: {advice}; convert others"])
        return found

    readers: dict[str, Callable[[bytes], pd.DataFrame | dict[str, Value]]] = {
        ".csv": _separated,
        ".txt": _separated,
        ".tsv": _separated,
        ".parquet": lambda data: pd.read_parquet(io.BytesIO(data)),
        ".npz": read_arrays,
    }
    log = is_log(place)
    if place.suffix.lower() not in readers and not log:
        allowed = f"a file that ends in {', '.join((*readers, *BAGS))}", *KINDS[1:2]
        raise UnknownOption("recording", str(path), allowed)
    try:
        if log:
            commands = frozenset(commands_of(world, bundles=True))
            step = Step(world.options.control_period, world.substeps, commands)
            return read_log(place, chosen, step)
        return readers[place.suffix.lower()](read_bytes(place))
    except FileNotFoundError:
        advice = "give the path of a recording, from the current folder or whole"
        raise UnreadableFile(str(path), "there is no such file", advice) from None
    except Exception as error:
        if isinstance(error, ScmWorldError):
            raise
        advice = "give a table with a column of the time and one for each command and measurement"
        raise UnreadableFile(str(path), in_one_line(error), advice) from error


def _separated(data: bytes) -> pd.DataFrame:
    """Read a table of text: commas, semicolons or tabs, comments, decimal commas.

    Lines that begin with # or % are comments; the last one before the numbers names the columns if
    no other line does.
    """
    import pandas as pd

    lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip(" \t,;")]
    comments = [line.lstrip()[0] in "#%" for line in lines]
    rows = [line for line, comment in zip(lines, comments, strict=True) if not comment]
    first = comments.index(False) if rows else 0
    if first and not re.search(
        "[a-z]", re.sub(r"(?<=[\d.])e(?=[-+\d])|\bnan\b", "", rows[0].lower())
    ):
        rows = [lines[first - 1].lstrip(" #%\t"), *rows]
    separator = next((one for one in ";\t," if one in (rows or [""])[0]), r"\s+")
    cell = re.compile(
        rf"(?:^|{separator})[\s\"]*[-+]?\d*,\d+(?:e[-+]?\d+)?[\s\"]*(?:$|{separator})", re.I
    )
    commas = separator != "," and any(map(cell.search, rows[1:]))
    text, decimal = io.StringIO("\n".join(rows)), "," if commas else "."
    frame: pd.DataFrame = pd.read_csv(text, sep=separator, decimal=decimal, skipinitialspace=True)
    names = [*frame.columns]
    cells = {len(re.findall(r'"[^"]*"|\S+', line)) for line in rows if separator == r"\s+"}
    short = len(cells) > 1  # where empty cells cannot be seen
    if not isinstance(frame.index, pd.RangeIndex):  # rows have more cells than there are names
        more = frame.index.nlevels
        short = short or bool(frame.iloc[:, -more:].notna().any(axis=None))
        frame = frame.reset_index().iloc[:, : len(names)].set_axis(names, axis=1)
    if short:
        said = f"rows have more or fewer cells than the {len(names)} names {', '.join(names)}"
        raise ModelError([f"{said}: write nan in empty cells, or separate them by semicolons"])
    texts = [n for n in names if commas and not pd.api.types.is_numeric_dtype(frame[n])]
    if mixed := [n for n in texts if frame[n].astype(str).str.fullmatch(r"[-+]?\d*\.\d+").any()]:
        said = f"the column {mixed[0]!r} has points, and others have decimal commas"
        raise ModelError([f"{said}: write all numbers in one way, without separated thousands"])
    return frame


def _framed(arrays: Mapping[str, ArrayLike]) -> pd.DataFrame:
    """Return arrays as a frame; commands may lack the row of the last instant."""
    import pandas as pd

    found = dict[str, Value]()
    for name, given in arrays.items():
        values = np.asarray(given)
        columns = values.reshape(len(values), -1).T if values.ndim else values.reshape(1, 1)
        alone = values.ndim < 2 or (len(columns) == 1 and values.ndim == 2)
        found |= {name if alone else f"{name}[{i}]": column for i, column in enumerate(columns)}
    rows = {len(column) for column in found.values()}
    if rows and max(rows) - min(rows) > 1:
        said = ", ".join(f"{name} {len(column)}" for name, column in found.items())
        raise ModelError([f"arrays need a row for each instant, and have {said} rows"])
    return pd.DataFrame({name: pd.Series(values) for name, values in found.items()})


# --- tables ---------------------------------------------------------------------------------------


def _states(world: Simulation) -> list[str]:
    """Return the names of all states, without bundles of them."""
    return [name for name in world.compiled.slices if name not in world.compiled.bundles]


def columns_of(world: Simulation) -> dict[str, MeasuredNumber]:
    """Return everything that can be measured, by the name of its column."""
    compiled = world.compiled
    names = [*compiled.slices, *(n for n in compiled.computed if n not in compiled.commanded)]
    return _numbers(world, dict.fromkeys(names, slice(0, None)))


def commands_of(world: Simulation, *, bundles: bool = False) -> dict[str, MeasuredNumber]:
    """Return the commands by the names of their columns; the component is that of the action."""
    return _numbers(world, world.compiled.commanded if bundles else world.compiled.actions)


def _numbers(world: Simulation, places: Mapping[str, slice]) -> dict[str, MeasuredNumber]:
    """Return the numbers of variables by the names of columns, counted from their first place."""
    found = dict[str, MeasuredNumber]()
    for name, where in places.items():
        variable = world.model.declared(name)
        for place, label in enumerate(labels(name, variable.shape), where.start):
            found[label] = MeasuredNumber(label, name, place, variable.unit)
    return found


def _few(columns: Iterable[MeasuredNumber]) -> str:
    """Return the names of columns with their units; of very many the first ones."""
    found = [c.name + f" [{c.unit}]" * (c.unit not in ("", "1")) for c in columns]
    rest = f" and {len(found) - SHOWN} more ('scm-world variables' lists them)"
    return ", ".join(found[:SHOWN]) + rest * (len(found) > SHOWN)


def _faults(world: Simulation, frame: pd.DataFrame) -> Iterator[str]:
    """Yield the faults of the columns of a table."""
    known, commands, names = columns_of(world), commands_of(world, bundles=True), [*frame.columns]
    own = commands_of(world).values()
    if TIME not in names:
        found = ", ".join(names)
        advice = "name one by columns={'stamp': 'time'}, and leave others out by ignore="
        yield f"there is no column 'time' [s] in a table of {found}: {advice}"
        return
    if len(frame) < 2:
        yield f"a run has two rows or more, got {len(frame)}"
    setup = [name for name in names if name.startswith(DO)]
    parameters = [name for name in names if name.partition("[")[0] in world.compiled.static]
    if parameters:
        said = f"the columns {', '.join(parameters)} are parameters, which are not measured"
        said += f": name them {', '.join(f'{DO}{name}' for name in parameters)}, if they were set"
        yield f"{said} for this run, leave them out, or fix them with world.given({{…}})"
    if setup:
        settable = settable_of(world)
        parts = [f"{DO}{label}" for n, v in settable.items() for label in labels(n, v.shape)]
        yield from (f"{UnknownVariable(n, parts)}" for n in setup if n not in parts)
        several = (name for name in setup if frame[name].nunique() > 1)
        advice = "one run has one set-up: tell runs apart by a column 'episode'"
        yield from (f"the column {name!r} has several values: {advice}" for name in several)
    there = {TIME, *commands, *known, *setup}
    unknown = [name.partition("[")[0] for name in names if name not in {*parameters, *there}]
    for name in dict.fromkeys(unknown):
        yield f"rename a column, or leave it out: {UnknownVariable(name, sorted(there))}"
    if unknown:
        asked = sorted({name for name in unknown if name.endswith(READOUTS)}) or ["gyro.value"]
        lists = f"the commands {_few(own)}, and the measurements {_few(known.values())}"
        more = f"readouts of sites, bodies and sensors that the world is given, outcomes={asked}"
        yield f"columns can be time [s], {lists}; or {more}"
    places = [commands[name].component if name in commands else name for name in names]
    twice = {n for n, place in zip(names, places, strict=True) if places.count(place) > 1}
    if twice:
        said = ", ".join(sorted(twice))
        yield f"the columns {said} give a number more than once: leave all but one out"
    if lacking := [c for c in own if c.component not in places]:
        advice = "add a column for each, of zeros if nothing was sent"
        yield f"the commands {_few(lacking)} are missing: {advice}"
    for name in names if not twice else ():
        cells, advice = frame[name], "remove the row" if name == TIME else "leave the cell empty"
        try:  # dates become numbers only as texts do
            numbers = (cells.astype(str) if cells.dtype.kind in "mM" else cells).astype(float)
        except (TypeError, ValueError) as error:
            advice = "give seconds" if name == TIME else advice
            yield f"the column {name!r} has values that are not numbers: {error}; {advice}"
            continue
        wrong = np.flatnonzero(~np.isfinite(numbers) if name == TIME else np.isinf(numbers))
        if len(wrong):
            value = numbers.iloc[wrong[0]]
            yield f"row {wrong[0]} of the column {name!r} is {value}: {advice}"


def _runs(
    world: Simulation,
    numbers: pd.DataFrame,
    columns: Sequence[MeasuredNumber],
    slack: float,
    label: str,
) -> Iterator[RecordedRun]:
    """Yield the runs of a table, between gaps."""
    time, dt = numbers[TIME].to_numpy(), world.options.control_period
    (low, high), own = world.compiled.action_bounds, commands_of(world).values()
    sent = np.full((len(time), len(own)), np.nan)
    for name, command in commands_of(world, bundles=True).items():
        if name in numbers:
            sent[:, command.component] = numbers[name]
    values = numbers.reindex(columns=[c.name for c in columns]).to_numpy().copy()
    problems = [
        *_not_rising(time, dt),
        *_out_of_range(world, zip(own, sent.T, strict=True), ROUNDING),
        *_out_of_range(world, zip(columns, values.T, strict=True), slack),
        *_without_jumps(world, columns, values),
    ]
    _refuse(problems, label)
    seen, places = np.isfinite(values).any(axis=1), np.zeros(len(time))
    if seen.any():
        places = Clock.of(time[seen], dt).places(time)
    within = ~seen & (np.abs(places - np.rint(places)) * world.substeps > SAME)
    if within.any() and any(f"{name}_past" in world.compiled.slices for name in commands_of(world)):
        said = f"row {within.argmax()} has a command within a control step of {dt:g} s, and the"
        advice = "leave its delay out, and fit 'delay' or '*.control_delay'"
        _refuse([f"{said} world delays commands by control steps: {advice}"], label)
    known = np.flatnonzero(~within)
    unknown = np.logical_or.reduceat(np.isnan(sent).any(axis=1), known)
    steps = np.diff(time[known])
    usual = float(np.median(steps)) if len(steps) else dt
    ends = np.flatnonzero((steps > GAP * usual) | unknown[:-1]) + 1
    pieces = [rows for rows in np.split(known, ends) if len(rows) > 1]
    if not pieces:
        _refuse(["no command is known from one row to the next: fill its column"], label)
    for rows in pieces:
        repeats = np.rint(np.diff(time[rows]) / dt).astype(np.int64)
        instants = np.concatenate([[0], np.cumsum(repeats)])
        apart = (time[rows] - time[rows[0]]) / dt - instants
        if len(rows) > 2 and repeats.all():
            apart -= np.clip(np.polyfit(instants, apart, 1)[0], -DRIFT, DRIFT) * instants
        apart = np.abs(apart - np.median(apart))
        if not repeats.all() or apart.max() > JITTER:
            said = f"times are not whole control steps of {dt:g} s, by row {rows[apart.argmax()]}"
            said += f": rows are usually {usual:.4g} s apart: give the world control_dt={usual:.4g}"
            unit = getattr(world.task, "time_unit", dt)
            if abs(usual / unit - round(usual / unit)) > FRACTION:
                said += f" and timestep={usual / np.ceil(usual / unit):.6g}, which divides it"
            _refuse([f"{said}, or resample the recording"], label)
        if np.isfinite(values[rows]).any():
            commands = np.repeat(np.clip(sent[rows[:-1]], low, high), repeats, axis=0)
            begin, whole, late = float(time[rows[0]]), not rows[0], None
            if len(rows) <= (last := rows[-1] - rows[0]):
                at = places[rows[0] : rows[-1] + 1] - places[rows[0]]
                at[rows - rows[0]] = instants
                late = at[:last], np.clip(sent[rows[0] : rows[-1]], low, high)
            setup = [str(n) for n in numbers if str(n).startswith(DO) and numbers[n].notna().any()]
            do = {name.removeprefix(DO): float(numbers[name].max()) for name in setup}
            about = begin, whole, do, None, late
            yield RecordedRun(commands, instants, values[rows], *about)


def _not_rising(time: Floats, dt: float) -> Iterator[str]:
    """Yield why times are not those of the rows of a run."""
    steps = np.diff(time)
    if len(wrong := np.flatnonzero(steps <= 0.0)):
        row = int(wrong[0]) + 1
        advice = "sort the rows, remove repeated ones, or tell runs apart by a column 'episode'"
        said = f"{time[row]:.10g} s after {time[row - 1]:.10g} s"
        yield f"time does not rise in row {row}: {said}: {advice}"
    elif (usual := float(np.median(steps))) > (SLOW * dt if usual >= 1.0 else LONG * dt):
        units = {name: abs(np.log(FACTORS[name] * usual / dt)) for name in ("ms", "us", "ns")}
        unit = min(units, key=lambda name: units[name])
        said = f"rows are {usual:.4g} s apart, which is {usual / dt:.4g} control steps of {dt:g} s"
        advice = f"give the time in seconds, or its unit, columns={{{TIME!r}: '{TIME} [{unit}]'}}"
        yield f"{said}: {advice}, or give the world a longer control_dt="


def _out_of_range(
    world: Simulation, given: Iterable[tuple[MeasuredNumber, Floats]], slack: float
) -> Iterator[str]:
    """Yield which columns leave their limits by more than a share of them."""
    limits = limits_of(world, None)
    for column, cells in given:
        low, high = limits.get(column.name, (-np.inf, np.inf))
        away = np.nan_to_num(np.maximum(cells - high, low - cells), nan=-np.inf)
        row = int(away.argmax()) if len(away) else 0
        if len(away) and away[row] > slack * (high - low):
            advice = "convert it" + " from degrees" * column.unit.startswith("rad")
            if away[row] < high - low:  # those of a command, at least nearly
                bounds = f"spaces={{{column.name!r}: {{'bounds': (low, high)}}}}"
                advice = f"clip it if the robot did, or give the robot's limits, {bounds}"
            unit = f" {column.unit}" * (column.unit not in ("", "1"))
            said = f"{column.name!r} is {cells[row]:.4g} in row {row}, outside of its limits"
            yield f"{said} [{low:g}, {high:g}]{unit}: {advice}"


def _without_jumps(
    world: Simulation, columns: Sequence[MeasuredNumber], values: Floats
) -> Iterator[str]:
    """Unwrap angles, and give quaternions the signs nearest to the row before, in place.

    Yields:
        Messages about orientations that are not unit quaternions.
    """
    limits = limits_of(world, None)
    for column, cells in zip(columns, values.T, strict=True):
        seen = np.isfinite(cells)
        turns = (np.abs(np.diff(cells[seen])) > 0.75 * TURN).any()
        if turns and column.unit == "rad" and column.name not in limits:
            whole = np.ptp(cells[seen]) < 1.01 * TURN
            cells[seen] = np.unwrap(cells[seen]) if whole else cells[seen]
    for places in rotations_of(world, columns):
        sizes = np.linalg.norm(values[:, places], axis=1)
        values[np.ix_(np.isnan(sizes), places)] = np.nan
        wrong = np.flatnonzero(np.abs(sizes - 1.0) > 0.5)
        if len(wrong):
            name, size = columns[places[0]].variable, sizes[wrong[0]]
            said = f"row {wrong[0]} of {name!r} has the length {size:g}"
            yield f"{said}: an orientation is a unit quaternion (x, y, z, w)"
        for one, other in pairwise(np.flatnonzero(np.isfinite(sizes))):
            values[other] = aligned(values[other], values[one], [places])


def rotations_of(world: Simulation, columns: Sequence[MeasuredNumber]) -> list[Integers]:
    """Return the columns of each completely measured unit quaternion."""
    found: dict[str, list[int]] = {}
    for i, column in enumerate(columns):
        if isinstance(world.model.declared(column.variable).bounds, Rotations):
            found.setdefault(column.variable, []).append(i)
    return [np.array(places) for places in found.values() if len(places) == 4]


def limits_of(world: Simulation, limits: Limits | None) -> dict[str, tuple[float, float]]:
    """Return the ranges of columns: those of commands and joints, and others that are given.

    Raises:
        UnknownVariable: A pattern fits no column.
        UnknownOption: A range has not a lower and a higher end, or exceeds that of a command.
    """
    commands, found = commands_of(world), dict[str, tuple[float, float]]()
    for name in _states(world):
        variable = world.model.declared(name)
        if isinstance(variable.bounds, Box) and not variable.bounds.parents():
            ends = zip(*map(np.ravel, variable.bounds.bounds(variable.shape, {})), strict=True)
            for label, (low, high) in zip(labels(name, variable.shape), ends, strict=True):
                if np.isfinite([low, high]).any():
                    found[label] = float(low), float(high)
    lowest, highest = world.compiled.action_bounds
    for name, command in commands.items():
        found[name] = float(lowest[command.component]), float(highest[command.component])
    limits = {} if limits is None else limits
    if not isinstance(limits, Mapping):
        raise UnknownOption("limits", limits, ("a dictionary of ranges by name or pattern",))
    for pattern, given in limits.items():
        try:
            low, high = map(float, given)
        except (TypeError, ValueError):
            low, high = 1.0, 0.0
        names = fitting(pattern, {**columns_of(world), **commands})
        inside = all(found[n][0] <= low and high <= found[n][1] for n in names if n in commands)
        if not low < high or not inside:
            most = [f", within {found[n][0]:g} to {found[n][1]:g}" for n in names if n in commands]
            allowed = ("a lower and a higher end" + (most[0] if most else ""),)
            raise UnknownOption(f"limits[{pattern!r}]", given, allowed)
        found |= dict.fromkeys(names, (low, high))
    return found
