"""Sweeps: every point of a grid of interventions, in the same episodes, and what came out."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._types import Floats
from scm_world.discovery.data.collect import collect
from scm_world.discovery.data.dataset import Column, Dataset, Ints
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.folders import SHARD, FewerEpisodes
from scm_world.discovery.data.sources import SourceRows, Tell
from scm_world.discovery.data.worlds import WorldSource
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.graph.structure import Edge
from scm_world.output.durable import made, write_whole
from scm_world.output.remote import Location, located
from scm_world.queries.equations import System
from scm_world.queries.estimates import CONFIDENCE, difference
from scm_world.queries.plans import Plan
from scm_world.queries.progress import Progress
from scm_world.queries.samples import Setting
from scm_world.queries.twins import Twins, asked
from scm_world.variables import Box, Categories, Either, Integers, Variable
from scm_world.variables.kinds import SPACES
from scm_world.work.executors import Executor
from scm_world.world import Simulation

FORMAT = "scm_world/sweep/1"
TABLE, SUMMARY = "sweep.csv", "sweep.json"
ENDS = ("", ".low", ".high")
LEVELS = 5
MOST = 100_000  # points: each has its own plan, and a row of the table

Point = Mapping[str, Any]
"""What is done: values as plain numbers or lists, by variable."""


@typed
@final
@dataclass(frozen=True)
class Levels:
    """Values of a variable that lie evenly in a space, from one end to the other.

    Attributes:
        space: ``"A"``, ``"B"`` or ``"A|B"`` of the variable, or a ``Box``, ``Integers`` or
            ``Categories``. Of a vector, the values lead from the lower corner to the upper one; of
            categories all are taken.
        count: How many, where there are so many.
    """

    space: Any = "A"
    count: int = LEVELS

    def of(self, variable: Variable) -> tuple[Any, ...]:
        """List the values.

        Raises:
            UnknownOption: There is no such space, or it has no ends.
        """
        count = whole_number(f"levels of {variable.name}", self.count, least=1)
        check_points(count)
        space = self.space
        if isinstance(space, str):
            if space not in SPACES:
                raise UnknownOption(f"levels of {variable.name}", space, (*SPACES, "values"))
            space = variable.space(space)
        if space is None:
            allowed = ("values, as it has no such space",)
            raise UnknownOption(f"levels of {variable.name}", self.space, allowed)
        return tuple(_plain(value) for value in _evenly(variable, space, count))


def _evenly(variable: Variable, space: Any, count: int) -> Sequence[Any]:
    match space:
        case Categories():
            return space.members
        case Integers():
            return sorted({round(x) for x in np.linspace(space.low, space.high, count)})
        case Either():
            first, other = -(-count // 2), count // 2
            rest = _evenly(variable, space.second, other) if other else ()
            return (*_evenly(variable, space.first, first), *rest)
        case Box() if not space.parents():
            low, high = space.bounds(variable.shape, {})
            return [np.asarray(value) for value in np.linspace(low, high, count)]
    allowed = ("a space with ends of its own", "values")
    raise UnknownOption(f"levels of {variable.name}", space, allowed)


def _plain(value: Any) -> Any:
    return np.asarray(value).tolist()


def points_of(over: Mapping[str, Any], model: SCM) -> tuple[Point, ...]:
    """List every combination of the values of some variables, the last one varying fastest.

    Args:
        over: By variable: a list of values, ``Levels``, or a space, which is five levels of it.
        model: Knows the variables.

    Raises:
        UnknownVariable: No variable has this name.
        UnknownOption: A variable has no values, what is given is none, or there are too many
            combinations.

    Example:
        >>> from scm_world.variables import Exogenous
        >>> model = SCM([Exogenous(name="x", a=Box(0.0, 1.0)), Exogenous(name="y")])
        >>> points_of({"x": Levels("A", 2), "y": [5.0]}, model)
        ({'x': 0.0, 'y': 5.0}, {'x': 1.0, 'y': 5.0})
    """
    if not over:
        raise UnknownOption("over", "nothing", ("one variable or more, with values",))
    columns = [_values_of(name, given, model) for name, given in over.items()]
    check_points(math.prod(map(len, columns)))
    return tuple(dict(zip(over, chosen, strict=True)) for chosen in itertools.product(*columns))


def check_points(count: int) -> None:
    """Refuse a grid with more points than a table can have.

    Raises:
        UnknownOption: It has.
    """
    if count > MOST:
        allowed = (f"at most {MOST}: give fewer values, or several sweeps",)
        raise UnknownOption("points of the grid", count, allowed)


def _values_of(name: str, given: Any, model: SCM) -> tuple[Any, ...]:
    variable = model.declared(name)
    if isinstance(given, str | Box | Integers | Categories | Either):
        given = Levels(given)
    if isinstance(given, Levels):
        return given.of(variable)
    try:
        found = tuple(np.asarray(value, dtype=float).tolist() for value in given)
    except (TypeError, ValueError):
        found = ()
    if not found or any(found.count(value) > 1 for value in found):
        allowed = ("numbers, each of them once", "Levels(space, count)", "a space")
        raise UnknownOption(f"values of {name}", given, allowed)
    return found


# --- what came out --------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Swept:
    """Episodes at the points of a grid.

    Attributes:
        points: What was done at each.
        data: All episodes; number k is unit ``k // p`` at point ``k % p`` of p points.
    """

    points: tuple[Point, ...]
    data: Dataset

    @cached_property
    def measured(self) -> tuple[Column, ...]:
        """What was measured: all columns but those that were set."""
        return tuple(c for c in self.data.columns if c.variable not in self.points[0])

    def values(self, point: int, name: str) -> Floats:
        """Give what was measured at a point, one number for each unit that was not refused."""
        return np.asarray(self.data[name][self._rows(point)])

    def units(self, point: int) -> Ints:
        """Give the numbers of these units."""
        return np.asarray(self.data.episode[self._rows(point)] // len(self.points))

    def _rows(self, point: int) -> Ints:
        return np.flatnonzero(self.data.episode % len(self.points) == point)

    def rows(self) -> list[dict[str, Any]]:
        """Write the table down: a row for each point, in which None is unknown.

        Its columns are the values that were set (``name``, or ``name[i]`` of a vector), ``n``, the
        number of ``refused`` episodes, and for each number that was measured its mean with the
        ends of a 95 % interval (``name``, ``name.low``, ``name.high``), and its mean difference
        to the first point in the units that both have (``name.change`` with its ends).
        """
        refused = self.data.about.get("refused", {})
        lost = np.array([int(number) % len(self.points) for number in refused], dtype=np.int64)
        return [
            {
                **_flat(point),
                "n": len(self._rows(place)),
                "refused": int((lost == place).sum()),
                **self._means(place),
            }
            for place, point in enumerate(self.points)
        ]

    def _means(self, place: int) -> dict[str, float | None]:
        found: dict[str, float | None] = {}
        mine, first = self.units(place), self.units(0)
        _, here, there = np.intersect1d(mine, first, assume_unique=True, return_indices=True)
        for column in self.measured:
            values, base = (self.values(at, column.name) for at in (place, 0))
            found |= _mean(column.name, values, np.zeros_like(values))
            found |= _mean(f"{column.name}.change", values[here], base[there])
        return found

    def save(self, folder: Location) -> tuple[Location, Location]:
        """Write the table as CSV, and with where it comes from as JSON.

        Raises:
            UnwritableFolder: There is no room, or no permission.
        """
        made(folder)
        rows = self.rows()
        stream = io.StringIO(newline="")
        writer = csv.DictWriter(stream, [*rows[0]], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_whole(stream.getvalue(), folder / TABLE)
        data = {
            "format": FORMAT,
            "confidence": CONFIDENCE,
            "units": {c.name: c.unit for c in self.measured},
            "points": [dict(point) for point in self.points],
            "rows": rows,
            "about": self.data.about,
        }
        write_whole(json.dumps(data, indent=1, allow_nan=False) + "\n", folder / SUMMARY)
        return folder / TABLE, folder / SUMMARY


def _flat(point: Point) -> dict[str, float]:
    """Write values down, the components of vectors apart.

    Example:
        >>> _flat({"x": 1.0, "g": [0.0, -9.81]})
        {'x': 1.0, 'g[0]': 0.0, 'g[1]': -9.81}
    """
    return {
        f"{name}[{i}]" if isinstance(value, Sequence) else name: part
        for name, value in point.items()
        for i, part in enumerate(np.ravel(value).tolist())
    }


def _mean(name: str, values: Floats, base: Floats) -> dict[str, float | None]:
    """Estimate the mean difference of paired numbers; equal ones and a single one: no interval."""
    found: list[float | None] = [None, None, None]
    if len(values) > 1:
        ends = [float(end) for end in difference(values, base, paired=True)[:3]]
        found = [None if np.isnan(end) else end for end in ends]
    elif len(values):
        found[0] = float(values[0] - base[0])
    return {name + end: value for end, value in zip(ENDS, found, strict=True)}


# --- the sweep ------------------------------------------------------------------------------------


@typed
def sweep(
    system: Simulation | SCM,
    over: Mapping[str, Any],
    outcomes: Iterable[Any] | None = None,
    *,
    n: int = 50,
    out: Location | str | None = None,
    shard: int = SHARD,
    workers: int | None = None,
    engine: Executor | str | None = None,
    progress: Progress | None = None,
    **setting: Any,
) -> Swept:
    """Estimate outcomes over a grid of interventions.

    The same ``n`` units, with the same noise, are run at every point, so that points can be
    compared one by one. An interrupted call resumes when it is repeated; a larger ``n`` adds units.

    Args:
        system: A world or a causal model. It is not changed; what is given to it holds at every
            point.
        over: What is set to which values: lists, ``Levels("A", 7)``, or a space for five levels of
            it. All combinations are tried.
        outcomes: Names of variables or ``Outcome``; those of a collection if None.
        n: Episodes at each point.
        out: A folder, or a URL, for the episodes and the table.
        shard: How many episodes are in one of its files, and run by a worker in one piece.
        workers: See ``collect``.
        engine: Likewise.
        progress: Called with how many episodes are done, and how many there will be.
        setting: ``policy``, ``nature``, ``steps`` and ``seed``; see ``Setting``. By default the
            actions of a world are random, those of a causal model zero.

    Returns:
        Means and intervals at each point, and all episodes. In a folder they are ``sweep.csv`` and
        ``sweep.json``, beside the episodes as a dataset that ``load`` reads.

    Raises:
        InterventionError: A value was refused, or more than half of the episodes.
        UnknownOption: An argument does not fit.
        UnreadableFile: The folder holds something else, or a damaged file.

    Example:
        >>> from scm_world.queries import World
        >>> world = World("pushing", backend="fake")
        >>> found = sweep(world, {"tool_block.mass": [0.02, 0.08]}, ["reward"], n=3, steps=2)
        >>> [(row["tool_block.mass"], row["n"]) for row in found.rows()]
        [(0.02, 3), (0.08, 3)]
    """
    if not isinstance(system, Simulation | SCM):
        raise UnknownOption("system", system, ("a World: World('pushing')", "an SCM"))
    count = whole_number("n", n, least=1)
    twins, world = asked(system)
    points = points_of(over, world.model)
    circumstances = Setting.of(world, setting)
    source = Grid(twins, world, points, outcomes, circumstances)
    try:
        data = collect(
            source,
            Design(),
            count * len(points),
            seed=circumstances.seed,
            out=out,
            shard=shard,
            progress=progress,
            workers=workers,
            engine=engine,
        )
    except FewerEpisodes as error:
        there = error.there // len(points)
        raise FewerEpisodes(count, there, error.folder, "number of episodes at a point") from None
    found = Swept(points, data)
    if out is not None:
        found.save(located(out))
    return found


@final
class Grid:
    """Episodes at the points of a grid, units in turn: episode k is unit k // p at point k % p.

    Args:
        twins: Where the episodes are run; see ``asked``.
        world: Is not touched.
        points: What is done at each of the p points.
        outcomes: What is measured.
        setting: Who acts, what varies by itself, how long, and the seed.
    """

    at_once = False
    uneven = True  # points that are impossible may be neighbors

    def __init__(
        self,
        twins: Twins,
        world: System,
        points: Sequence[Point],
        outcomes: Iterable[Any] | None,
        setting: Setting,
    ) -> None:
        measured = None if outcomes is None else tuple(outcomes)
        self._points = [
            WorldSource(
                twins,
                world,
                Design("all", tuple(point), point, observational_fraction=0.0),
                causes=tuple(point),
                outcomes=measured,
                every_step=False,
                setting=setting,
            )
            for point in points
        ]
        first = self._points[0]
        self.columns: tuple[Column, ...] = first.columns
        self.edges: tuple[Edge, ...] | None = first.edges
        about = {name: value for name, value in first.about.items() if name != "design"}
        grid = [Plan(point).as_dict()["do"] for point in points]
        self.about: dict[str, Any] = {**about, "points": grid}

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Run some episodes, those of one point together."""
        tables: list[Dataset] = []
        refused: list[tuple[int, str]] = []
        for place, episodes in enumerate(self._points):
            units = self._units(numbers, place)
            if units:
                part = episodes.part(units, tell)
                number = self._number(part.table.episode, place)
                tables.append(replace(part.table, episode=number, about=self.about))
                refused += [(int(self._number(unit, place)), why) for unit, why in part.refused]
        whole = Dataset.joined(tables)
        return SourceRows(
            whole.rows(np.argsort(whole.episode, kind="stable")), tuple(sorted(refused))
        )

    def _number(self, unit: Any, place: int) -> Any:
        return unit * len(self._points) + place

    def _units(self, numbers: range, place: int) -> range:
        """Give the units whose episodes at a point are among some numbers."""
        size = len(self._points)
        return range(*(-(-(end - place) // size) for end in (numbers.start, numbers.stop)))
