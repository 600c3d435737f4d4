"""Recordings from elsewhere: time, commands and measurements, as control steps of a world."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from scm_world._patterns import fits
from scm_world._types import Floats, Integers
from scm_world.errors import (
    DAMAGED,
    ActionError,
    ModelError,
    ScmWorldError,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
    in_one_line,
)
from scm_world.queries.episodes import Episode
from scm_world.runs.files import located, read_bytes
from scm_world.variables import Box, Rotations
from scm_world.world import Simulation

if TYPE_CHECKING:
    import pandas as pd

TIME, EPISODE = "time", "episode"
JITTER = 0.05
"""Largest distance of a time from a whole number of control steps, in control steps."""

KINDS = (
    "the path of a CSV or Parquet file",
    "a data frame",
    "arrays by name",
    "an Episode",
    "a Dataset with a row for each control step",
    "a dataset of Minari or an episode of one",
    "a list of these",
)


class MeasuredNumber(NamedTuple):
    """A measured number: its column, and the variable and component that it is.

    Attributes:
        name: ``"hinge.position"``, or ``"gravity[2]"`` for a component of a vector.
        variable: Name of the variable.
        component: Which of its numbers.
        unit: Unit of the variable.
    """

    name: str
    variable: str
    component: int
    unit: str


@final
@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A recorded run.

    Attributes:
        commands: The command of each control step, shape (steps, n_actions).
        instants: Number of the control step at whose beginning each row was measured, ascending
            from 0, shape (rows,).
        values: Measurements, shape (rows, columns).
    """

    commands: Floats
    instants: Integers
    values: Floats


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of the columns of a variable.

    Example:
        >>> labels("mass", ()), labels("size", (2,))
        (['mass'], ['size[0]', 'size[1]'])
    """
    return [name] if shape == () else [f"{name}[{i}]" for i in range(int(np.prod(shape)))]


def as_patterns(given: Any) -> tuple[Any, ...]:
    """Return a pattern, or several, as a tuple."""
    if not isinstance(given, str | Iterable):
        raise UnknownOption("names", given, ("a name or pattern, or a list of these",))
    return (given,) if isinstance(given, str) else tuple(given)


def fitting(patterns: Any, names: Mapping[str, Any]) -> list[str]:
    """Return the keys of a mapping that fit a pattern, or some patterns, in their own order.

    Raises:
        UnknownVariable: A pattern fits none of them.
    """
    given = as_patterns(patterns)
    for pattern in given:
        if not isinstance(pattern, str) or not any(fits(name, (pattern,)) for name in names):
            raise UnknownVariable(str(pattern), names)
    return [name for name in names if fits(name, given)]


def runs_of(
    world: Simulation, recording: Any
) -> tuple[tuple[RecordedRun, ...], tuple[MeasuredNumber, ...]]:
    """Read a recording: its runs, and what was measured in all of them.

    Args:
        world: The recorded system as it is modelled; it says how long a control step is, and what
            the columns mean.
        recording: See ``World.fit``.

    Raises:
        UnknownOption: It is of another kind, has no time, or measured nothing.
        UnknownVariable: A column is not a command, state or readout of the world.
        ModelError: Times do not rise, or are not whole control steps; or a number is missing.
        ActionError: A command lies outside its limits.
        UnreadableFile: A file cannot be read.
    """
    frames = [*_frames(world, recording)]
    if not frames:
        raise UnknownOption("recording", recording, ("one or more runs",))
    read = [_run(world, frame) for frame in frames]
    for _, columns in read:
        if columns != read[0][1]:
            one, other = ([c.name for c in each] for each in (read[0][1], columns))
            raise UnknownOption("columns of a further run", other, (f"those of the first, {one}",))
    return tuple(run for run, _ in read), read[0][1]


# --- kinds of recordings --------------------------------------------------------------------------


def _frames(world: Simulation, given: Any) -> Iterator[pd.DataFrame]:
    """Yield a frame for each run, with a column of the time [s]."""
    import pandas as pd

    dt = world.options.control_period
    if isinstance(given, list | tuple):
        for one in given:
            yield from _frames(world, one)
    elif isinstance(given, str | Path):
        yield from _frames(world, _file(given))
    elif isinstance(given, Episode):
        low, high = world.compiled.action_bounds
        arrays: dict[str, Any] = {TIME: dt * np.arange(given.steps + 1)}
        for name, where in world.compiled.actions.items():
            arrays[name] = np.clip(given.actions, low, high)[:, where]
        arrays |= {name: given[name] for name in _states(world)}
        yield _framed(arrays)
    elif isinstance(given, pd.DataFrame):
        if EPISODE not in given:
            yield given
        else:
            yield from (part.drop(columns=EPISODE) for _, part in given.groupby(EPISODE))
    elif isinstance(given, Mapping):
        yield from _frames(world, _framed(given))
    elif hasattr(given, "iterate_episodes"):  # a dataset of Minari
        for one in given.iterate_episodes():
            yield from _frames(world, one)
    elif hasattr(given, "observations") and hasattr(given, "actions"):  # an episode of Minari
        yield _of_minari(world, given)
    elif all(hasattr(given, name) for name in ("values", "names", "step", "episode", "columns")):
        yield from _of_dataset(world, given)
    else:
        raise UnknownOption("recording", type(given).__name__, KINDS)


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
    arrays: dict[str, Any] = {TIME: time, **dict(zip(names, seen.T, strict=True))}
    arrays |= {name: given.actions[:, at] for name, at in world.compiled.actions.items()}
    return _framed(arrays)


def _of_dataset(world: Simulation, given: Any) -> Iterator[pd.DataFrame]:
    """Yield the episodes of a dataset; its parameters are not measured, and are left out."""
    if not given.is_temporal:
        raise UnknownOption("dataset", "rows that are whole episodes", ("every_step=True",))
    known = {*columns_of(world), *commands_of(world)}
    arrays = {name: given[name] for name in given.names if name in known}
    time = world.options.control_period * given.step
    yield from _frames(world, _framed({TIME: time, EPISODE: given.episode, **arrays}))


def _file(path: str | Path) -> pd.DataFrame:
    import pandas as pd

    place = located(path)
    readers: dict[str, Any] = {".csv": pd.read_csv, ".parquet": pd.read_parquet}
    if place.suffix.lower() not in readers:
        raise UnknownOption("recording", str(path), ("a file that ends in .csv or .parquet",))
    try:
        return readers[place.suffix.lower()](io.BytesIO(read_bytes(place)))  # type: ignore[no-any-return]
    except DAMAGED as error:
        if isinstance(error, ScmWorldError):
            raise
        advice = "give a table with a column of the time and one for each command and measurement"
        raise UnreadableFile(str(path), in_one_line(error), advice) from error


def _framed(arrays: Mapping[str, Any]) -> pd.DataFrame:
    """Return arrays as a frame; commands may lack the row of the last instant."""
    import pandas as pd

    found: dict[str, Floats] = {}
    for name, given in arrays.items():
        values = np.asarray(given, dtype=np.float64)
        columns = values.reshape(len(values), -1).T if values.ndim else values.reshape(1, 1)
        alone = values.ndim < 2 or (len(columns) == 1 and values.ndim == 2)
        found |= {name if alone else f"{name}[{i}]": column for i, column in enumerate(columns)}
    return pd.DataFrame({name: pd.Series(values) for name, values in found.items()})


# --- one run --------------------------------------------------------------------------------------


def _states(world: Simulation) -> list[str]:
    """Return the names of all states, without bundles of them."""
    return [name for name in world.compiled.slices if name not in world.compiled.bundles]


def columns_of(world: Simulation) -> dict[str, MeasuredNumber]:
    """Return everything that can be measured, by the name of its column."""
    compiled = world.compiled
    names = [*compiled.slices, *(n for n in compiled.computed if n not in compiled.commanded)]
    declared = {name: world.model.declared(name) for name in names}
    return {
        label: MeasuredNumber(label, name, i, variable.unit)
        for name, variable in declared.items()
        for i, label in enumerate(labels(name, variable.shape))
    }


def commands_of(world: Simulation, *, bundles: bool = False) -> dict[str, int]:
    """Return the place of each command in an action, by the names of its columns."""
    found: dict[str, int] = {}
    compiled = world.compiled
    for name, where in (compiled.commanded if bundles else compiled.actions).items():
        names = labels(name, world.model.declared(name).shape)
        found |= dict(zip(names, range(where.start, where.stop), strict=True))
    return found


def _run(world: Simulation, frame: pd.DataFrame) -> tuple[RecordedRun, tuple[MeasuredNumber, ...]]:
    """Check and read one run."""
    names = list(map(str, frame.columns))
    if TIME not in names:
        allowed = ("a table with a column 'time' [s]",)
        raise UnknownOption("recording", f"the columns {', '.join(names)}", allowed)
    known, commands = columns_of(world), commands_of(world, bundles=True)
    for name in names:
        if name in world.compiled.static:
            advice = "leave it out, or fix it with world.given({…})"
            problem = f"the column {name!r} is a parameter, which is not measured: {advice}"
            raise ModelError([problem])
        if name not in known and name not in commands and name != TIME:
            raise UnknownVariable(name, [TIME, *commands, *known])
    columns = tuple(known[name] for name in names if name in known)
    filled = [name if name == TIME else commands.get(name, name) for name in names]
    twice = sorted({n for n, place in zip(names, filled, strict=True) if filled.count(place) > 1})
    if twice:
        problem = f"the columns {', '.join(twice)} give a number more than once"
        raise ModelError([f"{problem}: leave all but one of them out"])
    if not columns:
        raise UnknownOption("recording", f"the columns {', '.join(names)}", ("measurements, too",))
    try:
        table = frame.to_numpy(dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError([f"a column of the recording has no numbers: {error}"]) from None
    if len(table) < 2:
        raise ModelError([f"a run has two rows or more, got {len(table)}"])
    at = {name: i for i, name in enumerate(names)}
    held = [at[name] for name in names if name in commands]
    needed = np.ones(table.shape, dtype=bool)
    needed[-1, held] = False  # nothing follows the last row
    wrong = np.argwhere(needed & ~np.isfinite(table))
    if len(wrong):
        row, column = wrong[0]
        advice = "remove the rows in which something was not measured; times may have gaps"
        problem = f"row {row} of the column {names[column]!r} is {table[row, column]}"
        raise ModelError([f"{problem}: {advice}"])
    instants = _instants(table[:, at[TIME]], world.options.control_period)
    low, high = world.compiled.action_bounds
    asked = np.full((len(table), len(low)), np.nan)
    for column in held:
        asked[:, commands[names[column]]] = table[:, column]
    lacking = {i for i in range(len(low)) if np.isnan(asked[:-1, i]).any()}
    missing = [next(n for n, place in commands.items() if place == i) for i in sorted(lacking)]
    if missing:
        allowed = (f"a column for each command; {', '.join(missing)} is missing (0 if it was)",)
        raise UnknownOption("recording", f"the columns {', '.join(names)}", allowed)
    slack = 1e-9 * (1.0 + np.abs(low) + np.abs(high))
    wrong = np.argwhere((asked[:-1] < low - slack) | (asked[:-1] > high + slack))
    if len(wrong):
        row, place = wrong[0]
        name = next(name for name, i in commands.items() if i == place)
        said = f"row {row} of the command {name!r} is {asked[row, place]:g}, outside of its limits"
        advice = "give the limits of the recorded robot with spaces={…: {'bounds': (low, high)}}"
        limits = f"[{low[place]:g}, {high[place]:g}]"
        raise ActionError(f"{said} {limits}: {advice}", asked[row])
    repeats = np.diff(instants)
    values = table[:, [at[column.name] for column in columns]]
    _without_jumps(values, columns, rotations_of(world, columns))
    return RecordedRun(
        np.repeat(np.clip(asked[:-1], low, high), repeats, axis=0), instants, values
    ), columns


def _without_jumps(values: Floats, columns: Sequence[MeasuredNumber], rotations: Any) -> None:
    """Give each unit quaternion the sign that is nearest to the row before, in place."""
    for places in rotations:
        sizes = np.linalg.norm(values[:, places], axis=1)
        if (row := int(np.argmax(np.abs(sizes - 1.0)))) >= 0 and abs(sizes[row] - 1.0) > 0.5:
            said = f"row {row} of {columns[places[0]].variable!r} has the length {sizes[row]:g}"
            raise ModelError([f"{said}: an orientation is a unit quaternion (x, y, z, w)"])
        for one, other in pairwise(values):
            other[:] = aligned(other, one, [places])


def _instants(time: Floats, dt: float) -> Integers:
    """Return times as numbers of control steps after the first one."""
    for row, (one, other) in enumerate(pairwise(time.tolist()), 1):
        if other <= one:
            advice = "sort the rows, or tell runs apart by a column 'episode'"
            raise ModelError(
                [f"time does not rise in row {row}: {other:g} s after {one:g} s: {advice}"]
            )
    steps = (time - time[0]) / dt
    whole = np.rint(steps)
    far = np.flatnonzero((np.abs(steps - whole) > JITTER) | (np.diff(whole, prepend=-1.0) < 1.0))
    if len(far):
        row = int(far[0])
        advice = "choose control_dt= of the world to fit, or resample the recording"
        problem = f"row {row} is {steps[row]:.4g} control steps of {dt:g} s after the first row"
        raise ModelError([f"{problem}, which is not a whole number: {advice}"])
    return np.asarray(whole, dtype=np.int64)


def rotations_of(world: Simulation, columns: Sequence[MeasuredNumber]) -> list[Integers]:
    """Return the columns of each completely measured unit quaternion."""
    found: dict[str, list[int]] = {}
    for i, column in enumerate(columns):
        if isinstance(world.model.declared(column.variable).bounds, Rotations):
            found.setdefault(column.variable, []).append(i)
    return [np.array(places) for places in found.values() if len(places) == 4]


def aligned(values: Floats, others: Floats, rotations: Iterable[Any]) -> Floats:
    """Return values whose unit quaternions have the signs that are nearest to others.

    Unit quaternions q and -q are the same rotation. Arrays have shape (..., columns).
    """
    found = values.copy()
    for places in rotations:
        turned = (values[..., places] * others[..., places]).sum(axis=-1, keepdims=True) < 0.0
        found[..., places] *= np.where(turned, -1.0, 1.0)
    return found


def noise_of(noise: Any, columns: tuple[MeasuredNumber, ...]) -> Floats:
    """Return the given standard deviation of each column, shape (columns,); NaN where unknown.

    Args:
        noise: None, one number for all columns, or numbers by patterns of columns or variables.
        columns: What was measured.

    Raises:
        UnknownOption: A number is not positive.
        UnknownVariable: A pattern fits no column.
    """
    found = np.full(len(columns), np.nan)
    by_name = {name: i for i, c in enumerate(columns) for name in (c.name,)}
    for pattern, value in (noise if isinstance(noise, Mapping) else {"*": noise}).items():
        if value is None and pattern == "*":
            continue
        number = isinstance(value, int | float | np.number) and np.isfinite(value) and value > 0.0
        if not number:
            raise UnknownOption("noise", value, ("a standard deviation above zero",))
        whole = [c.name for c in columns if fits(c.variable, (pattern,))]
        for name in whole or fitting(pattern, by_name):
            found[by_name[name]] = float(value)
    return found


def limits_of(
    world: Simulation, limits: Mapping[str, Any] | None
) -> dict[str, tuple[float, float]]:
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
    found |= {n: (float(lowest[i]), float(highest[i])) for n, i in commands.items()}
    if not isinstance(limits or {}, Mapping):
        raise UnknownOption("limits", limits, ("a dictionary of ranges by name or pattern",))
    for pattern, given in (limits or {}).items():
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
