"""Sweeps: every point of a grid of interventions, in the same episodes, with the outcomes."""

from __future__ import annotations

import itertools
import math
from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._patterns import meant
from scm_world._types import Floats
from scm_world.discovery.data.collect import collected
from scm_world.discovery.data.dataset import Column, Dataset, Ints
from scm_world.discovery.data.designs import Grid
from scm_world.discovery.data.worlds import EpisodeRows
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.queries.progress import Progress
from scm_world.queries.samples import Setting, difference
from scm_world.queries.twins import EQUAL, asked
from scm_world.runs.canvas import PALETTE, blank, styled
from scm_world.runs.files import Location, located, write_whole
from scm_world.runs.pool import Pool
from scm_world.variables import Box, Categories, Either, Integers, Variable
from scm_world.variables.kinds import SPACES
from scm_world.variables.spaces import Sampler
from scm_world.world import CausalSystem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLE = "sweep.csv"
PICTURE = "sweep.png"
PANELS = 12
"""How many outcomes are drawn."""
TICKS = 9
"""Up to so many values are labels of an axis."""
ENDS = ("", ".low", ".high")
LEVELS = 5
MOST = 100_000  # points: each has its own plan, and a row of the table

Point = Mapping[str, Any]
"""The values that are set, as plain numbers or lists, by variable."""


@typed
@final
@dataclass(frozen=True)
class Levels:
    """Values of a variable that lie evenly in a space, from one end to the other.

    Attributes:
        space: ``"A"``, ``"B"`` or ``"A|B"`` of the variable, or a ``Box``, ``Integers`` or
            ``Categories``. Values of a vector lead from the lower corner to the upper one; of
            categories all are taken.
        count: How many, where there are so many.
    """

    space: str | Sampler = "A"
    count: int = LEVELS

    @typed
    def of(self, variable: Variable) -> tuple[Any, ...]:
        """List the values."""
        option = f"levels of {variable.name}"
        check_points(whole_number(option, self.count, least=1))
        found: str | Sampler | None = self.space
        if isinstance(found, str) and found in SPACES:
            found = variable.space(found)
        if not isinstance(found, Sampler):
            allowed = ("values, as it has no such space",) if found is None else (*SPACES, "values")
            raise UnknownOption(option, self.space, allowed)

        def evenly(space: Sampler, count: int) -> Sequence[Any]:
            match space:
                case Categories():
                    return space.members
                case Integers():
                    return sorted({round(x) for x in np.linspace(space.low, space.high, count)})
                case Either():
                    rest = evenly(space.second, count // 2) if count > 1 else ()
                    return (*evenly(space.first, -(-count // 2)), *rest)
                case Box() if not space.parents():
                    return [*np.linspace(*space.bounds(variable.shape, {}), count)]
            raise UnknownOption(option, space, ("a space with ends of its own", "values"))

        return tuple(np.asarray(value).tolist() for value in evenly(found, self.count))


def points_of(over: Mapping[str, Any], model: SCM) -> tuple[Point, ...]:
    """List every combination of the values of some variables, the last one varying fastest.

    Example:
        >>> from scm_world.variables import Exogenous
        >>> model = SCM([Exogenous(name="x", a=Box(0.0, 1.0)), Exogenous(name="y")])
        >>> points_of({"x": Levels("A", 2), "y": [5.0]}, model)
        ({'x': 0.0, 'y': 5.0}, {'x': 1.0, 'y': 5.0})
        >>> points_of({"?": [1.0, 2.0]}, model)  # a pattern: they have their values together
        ({'x': 1.0, 'y': 1.0}, {'x': 2.0, 'y': 2.0})
    """
    if not over:
        raise UnknownOption("over", "nothing", ("one variable or more, with values",))
    among = [name for name in model if model.declared(model.target(name)).settable]
    columns: dict[str, list[dict[str, Any]]] = {}
    for name, key in meant(over, among, model.targets, literal=[*model]).items():
        values = _values_of(name, over[key], model)
        column = columns.setdefault(key, [{} for _ in values])
        if len(column) != len(values):
            allowed = (f"{len(column)} for each variable that fits {key!r}",)
            raise UnknownOption(f"number of values of {name}", len(values), allowed)
        for point, value in zip(column, values, strict=True):
            point[name] = value
    check_points(math.prod(map(len, columns.values())))
    return tuple(dict(ChainMap(*reversed(rows))) for rows in itertools.product(*columns.values()))


def check_points(count: int) -> None:
    """Refuse a grid with more points than a table can have."""
    if count > MOST:
        allowed = (f"at most {MOST}: give fewer values, or several sweeps",)
        raise UnknownOption("points of the grid", count, allowed)


def _values_of(name: str, given: object, model: SCM) -> tuple[Any, ...]:
    variable = model.declared(name)
    if isinstance(given, str | Box | Integers | Categories | Either):
        given = Levels(given)
    if isinstance(given, Levels):
        return given.of(variable)
    listed: Any = given
    try:
        found = tuple(np.asarray(value, dtype=float).tolist() for value in listed)
    except (TypeError, ValueError):
        found = ()
    if not found or any(found.count(value) > 1 for value in found):
        allowed = ("numbers, each of them once", "Levels(space, count)", "a space")
        raise UnknownOption(f"values of {name}", given, allowed)
    return found


@final
@dataclass(frozen=True)
class Swept:
    """Episodes at the points of a grid.

    Attributes:
        points: The values that are set at each.
        data: All episodes; number k is unit ``k // p`` at point ``k % p`` of p points.
        floors: How far apart equal runs were, at most, in each measured column, in its unit; empty
            if the engine is exact. A change up to it is not seen.
    """

    points: tuple[Point, ...]
    data: Dataset
    floors: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def measured(self) -> tuple[Column, ...]:
        """All columns but those that were set."""
        return tuple(c for c in self.data.columns if c.variable not in self.points[0])

    def values(self, point: int, name: str) -> Floats:
        """Return a column at a point, one number for each unit that was not refused."""
        return np.asarray(self.data[name][self._rows(point)])

    def units(self, point: int) -> Ints:
        """Return the numbers of these units."""
        return np.asarray(self.data.episode[self._rows(point)] // len(self.points))

    def _rows(self, point: int) -> Ints:
        point = whole_number("point", point, least=0, most=len(self.points) - 1)
        return np.flatnonzero(self.data.episode % len(self.points) == point)

    def rows(self) -> list[dict[str, Any]]:
        """Return the table: a row for each point, in which None is unknown.

        Its columns are the values that were set (``name``, or ``name[i]`` of a vector), ``n``, the
        number of ``refused`` episodes, and for each number that was measured its mean with the
        ends of a 95 % interval (``name``, ``name.low``, ``name.high``), and its mean difference
        to the first point in the units that both have (``name.change`` with its ends). On an
        engine that is not exact ``name.floor`` stands beside it, see ``floors``.
        """
        lost = [int(number) % len(self.points) for number in self.data.about.get("refused", {})]
        table, first = [], self.units(0)
        for place, point in enumerate(self.points):
            units = self.units(place)
            row: dict[str, Any] = {
                f"{name}[{i}]" if isinstance(value, Sequence) else name: part
                for name, value in point.items()
                for i, part in enumerate(np.ravel(value).tolist())
            }
            row |= {"n": len(units), "refused": lost.count(place)}
            _, here, there = np.intersect1d(units, first, assume_unique=True, return_indices=True)
            for column in self.measured:
                values, base = (self.values(at, column.name) for at in (place, 0))
                row |= _mean(column.name, values, np.zeros_like(values))
                row |= _mean(f"{column.name}.change", values[here], base[there])
                if self.floors:
                    row[f"{column.name}.floor"] = self.floors[column.name]
            table.append(row)
        return table

    @styled
    def picture(self) -> Figure:
        """Draw the mean of each outcome with its 95 % interval, over the variable of most values.

        Every combination of values of other variables is a line. There are at most ``PANELS``
        outcomes, components of vectors last; the table has all of them.
        """
        import pandas

        table = pandas.DataFrame(self.rows()).astype(float)
        counts = table[list(table.columns[: table.columns.get_loc("n")])].nunique()
        across = str(counts.idxmax())
        mine = across if across in self.points[0] else across.rpartition("[")[0]
        free = table.groupby(across)[[*counts.index]].nunique().max() > 1  # not tied to it
        others = [n for n in counts.index if n.rpartition("[")[0] != mine != n and free[n]]
        lines = [*table.groupby(others, sort=False)] if others else [((), table)]
        names = sorted((column.name for column in self.measured), key=lambda n: n.endswith("]"))
        shown = names[:PANELS]
        wide = min(len(shown), 3)
        tall = -(-len(shown) // wide)
        figure = blank(4.4 * wide, 3.2 * tall + 0.3, layout="constrained")
        axes = figure.subplots(tall, wide, squeeze=False).ravel()
        for ax, name in zip(axes, shown, strict=False):
            for place, (chosen, part) in enumerate(lines):
                line, color = part.sort_values(across), PALETTE[place % len(PALETTE)]
                x, low, high = line[across], line[name + ".low"], line[name + ".high"]
                label = ", ".join(f"{n} = {v:.4g}" for n, v in zip(others, chosen, strict=True))
                ax.plot(x, line[name], color=color, marker="o", markersize=3, label=label)
                ax.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
            ax.set_title(name)
            ax.set_xlabel(across)
            if counts[across] <= TICKS:
                ax.set_xticks(sorted(table[across].unique()))
        for ax in axes[len(shown) :]:
            ax.remove()
        if others:
            drawn = axes[0].get_legend_handles_labels()
            figure.legend(*drawn, loc="outside lower center", ncols=wide)
        n = sorted({int(count) for count in table["n"]})
        each = f"{n[0]}" if len(n) == 1 else f"{n[0]} to {n[-1]}"
        more = len(self.measured) - len(shown)
        rest = f"; {more} more outcomes are in {TABLE}" if more else ""
        figure.suptitle(f"means and 95 % intervals of {each} episodes at each point{rest}")
        return figure

    def save(self, folder: Location | str) -> Location:
        """Write the table as CSV."""
        import pandas

        text = pandas.DataFrame(self.rows()).to_csv(index=False, lineterminator="\n")
        path = located(folder) / TABLE
        write_whole(path, text)
        return path


def _mean(name: str, values: Floats, base: Floats) -> dict[str, float | None]:
    """Return the mean difference of paired numbers; equal ones and a single one: no interval."""
    found: list[float | None] = [None, None, None]
    if len(values) > 1:
        ends = [float(end) for end in difference(values, base, paired=True)[:3]]
        found = [None if np.isnan(end) else end for end in ends]
    elif len(values):
        found[0] = float(values[0] - base[0])
    return {name + end: value for end, value in zip(ENDS, found, strict=True)}


@typed
def sweep(
    system: CausalSystem | SCM,
    over: Mapping[str, Any],
    outcomes: Iterable[Any] | None = None,
    *,
    n: int = 50,
    out: Location | str | None = None,
    shard: int | None = None,
    workers: int | None = None,
    engine: Pool | str | None = None,
    progress: Progress | None = None,
    **setting: object,
) -> Swept:
    """Estimate outcomes over a grid of interventions.

    The same ``n`` units, with the same noise, are run at every point, so that points can be
    compared one by one. An interrupted call resumes when it is repeated; a larger ``n`` adds units.

    Args:
        system: A world or a causal model. It is not changed; interventions given to it hold at
            every point.
        over: The values of each variable: lists, ``Levels("A", 7)``, or a space for five levels of
            it. All combinations are tried; those that fit a pattern have their values together.
        outcomes: Names of variables or ``Outcome``; those of a collection if None.
        n: Episodes at each point.
        out: A folder, or a URL, for the episodes and the table.
        shard: How many episodes are in one of its files, and run by a worker in one piece.
        workers: See ``collect``.
        engine: See ``collect``.
        progress: Called with how many episodes are done, and how many there will be.
        setting: ``policy``, ``nature``, ``steps`` and ``seed``; see ``Setting``. By default the
            actions of a world are random, those of a causal model zero.

    Returns:
        Means and intervals at each point, and all episodes. In a folder they are ``sweep.csv``,
        beside the episodes as a dataset that ``load`` reads.

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
    count, (twins, world) = whole_number("n", n, least=1), asked(system)
    points = points_of(over, world.model)
    given, measured = Setting.of(world, setting), None if outcomes is None else tuple(outcomes)
    rows = EpisodeRows(system, Grid(points), given, causes=points[0], outcomes=measured)
    data = collected(
        rows,
        count * len(points),
        out,
        shard=shard,
        progress=progress,
        workers=workers,
        engine=engine,
        at_end=True,  # points that are impossible may be neighbors
    )
    floors = dict[str, float]()
    if not twins.is_exact:
        again = rows.rows(range(min(count * len(points), EQUAL)))[0]
        _, here, there = np.intersect1d(
            data.episode, again.episode, assume_unique=True, return_indices=True
        )
        for name in (one.name for one in data.columns if one.variable not in points[0]):
            apart = np.abs(data[name][here] - again[name][there])
            floors[name] = float(apart.max(initial=0.0))
    found = Swept(points, data, floors)
    if out is not None:
        found.save(out)
    return found
