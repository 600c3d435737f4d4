"""Sweeps: every point of a grid of interventions, in the same episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world.discovery.data.collect import collect
from scm_world.discovery.data.dataset import Column, Dataset
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.folders import SHARD, FewerEpisodes
from scm_world.discovery.data.levels import Point, points_of
from scm_world.discovery.data.sources import SourceRows, Tell
from scm_world.discovery.data.swept import Swept
from scm_world.discovery.data.worlds import WorldSource
from scm_world.errors import UnknownOption
from scm_world.graph.structure import Edge
from scm_world.output.locations import Location, located
from scm_world.queries.plans import Plan
from scm_world.queries.progress import Progress
from scm_world.queries.samples import STEPS, Setting
from scm_world.work.executors import Executor
from scm_world.world import World


def sweep(
    world: World,
    over: Mapping[str, Any],
    outcomes: Iterable[Any] | None = None,
    *,
    n: int = 50,
    steps: int = STEPS,
    policy: Any = "random",
    nature: Mapping[str, Any] | None = None,
    seed: int = 0,
    out: Location | str | None = None,
    shard: int = SHARD,
    format: str = "parquet",  # noqa: A002 # as other libraries call it
    workers: int | None = None,
    engine: Executor | str | None = None,
    address: str | None = None,
    progress: Progress | None = None,
) -> Swept:
    """Find out how outcomes depend on interventions, over a grid of them.

    The same ``n`` units live through every point, with the same noise, so that points can be
    compared one by one. Interrupted, the same call goes on where it was; a larger ``n`` does, too.

    Args:
        world: Is not touched; what is given to it holds at every point.
        over: What is set to which values: lists, ``Levels("A", 7)``, or a space for five levels of
            it. All combinations are tried.
        outcomes: Names of variables or ``Outcome``; those of a collection if None.
        n: Episodes at each point.
        steps: Control steps of an episode.
        policy: Who acts; see ``Setting``.
        nature: What varies from unit to unit; likewise.
        seed: Of the noise.
        out: A folder, or a URL, for the episodes and the table.
        shard: How many episodes are in one of its files, and made by a worker at once.
        format: Of these files: ``"parquet"`` or ``"csv"``.
        workers: See ``collect``.
        engine: Likewise.
        address: Likewise.
        progress: Told how many episodes are done, and how many there will be.

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
    if not isinstance(world, World):
        raise UnknownOption("world", world, ("a World: World('pushing')",))
    count = whole_number("n", n, least=1)
    points = points_of(over, world.model)
    setting = Setting(policy, nature, whole_number("steps", steps, least=1), seed)
    source = Grid(world, points, outcomes, setting)
    try:
        data = collect(
            source,
            Design(),
            count * len(points),
            seed=seed,
            out=out,
            shard=shard,
            format=format,
            progress=progress,
            workers=workers,
            engine=engine,
            address=address,
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
        world: Is not touched.
        points: What is done at each of the p points.
        outcomes: What is measured.
        setting: Who acts, what varies by itself, how long, and the seed.
    """

    at_once = False
    uneven = True  # points that are impossible may be neighbors

    def __init__(
        self,
        world: World,
        points: Sequence[Point],
        outcomes: Iterable[Any] | None,
        setting: Setting,
    ) -> None:
        measured = None if outcomes is None else tuple(outcomes)
        self._points = [
            WorldSource(
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
        """Let some episodes happen, those of one point together."""
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
