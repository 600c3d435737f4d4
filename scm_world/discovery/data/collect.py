"""Collecting: episodes under a design, in memory or in a folder that can be resumed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, TypedDict, Unpack

from scm_world._arguments import typed, whole_number
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.folders import Folder, Head, refusals, together
from scm_world.discovery.data.pictures import Pictures
from scm_world.discovery.data.sources import SourceRows
from scm_world.discovery.data.worlds import LaboratoryRows, ModelRows, WorldRows
from scm_world.errors import Forbidden, InterventionError, UnknownOption
from scm_world.graph import SCM
from scm_world.output.remote import Location
from scm_world.queries.laboratory import Laboratory
from scm_world.queries.progress import Progress
from scm_world.queries.samples import STEPS, Setting
from scm_world.work.executors import Executor, opened
from scm_world.world import Simulation

ENOUGH = 20
"""After so many episodes the share of refused ones is checked."""


class Circumstances(TypedDict, total=False):
    """Further arguments for a world; for a model ``steps`` only, for a laboratory none."""

    steps: int
    policy: Any
    nature: Mapping[str, Any] | None
    causes: Iterable[str] | None
    outcomes: Iterable[Any] | None
    every_step: bool
    pictures: Pictures | None
    contacts: bool


@typed
def collect(
    source: SCM | Simulation | Laboratory,
    design: Design,
    n: int,
    *,
    seed: int = 0,
    out: Location | str | None = None,
    shard: int | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
    engine: Executor | str | None = None,
    **circumstances: Unpack[Circumstances],
) -> Dataset:
    """Collect episodes under a design, as a table with regimes.

    The rows of an episode depend on the seed and on its number only: not on how many there are, on
    the shards, or on the workers. An interrupted call resumes when it is repeated, and the
    files are then the same, byte for byte. A larger ``n`` adds episodes.

    Args:
        source: A model (one row per episode, or one per control step if ``steps`` are given), a
            ``World``, or a ``Laboratory`` (through its ``see`` and ``do`` only).
        design: The interventions of each episode.
        n: Number of episodes.
        seed: Seed of the noise; for a laboratory only of the random choices of the design.
        out: A folder, or a URL: new, empty, or one in which this collection was begun. Its files
            are Parquet.
        shard: How many episodes are in one of its files, and run by a worker in one piece; 100 of a
            world, 10,000 of a model if None.
        progress: Called with how many episodes are done, and how many there will be, after each
            shard.
        workers: How many shards are made at the same time. None is one, in this process; with an
            engine it is as many as there are cores.
        engine: What makes them: ``"serial"``, ``"process"``, ``"ray"``, or an executor; see
            ``engine_of``. A laboratory, which keeps a log, has the first one only.
        circumstances: ``steps`` of an episode, 25 in a world. For a world also ``policy`` and
            ``nature`` (see ``Setting``), ``causes`` (patterns of parameters), ``outcomes`` (names
            or ``Outcome``), ``every_step``: a row for each control step, with the action,
            ``pictures`` to write beside the rows, in files of their own in ``out``, and
            ``contacts``: whether to look at every physics step for bodies that touch, for
            ``Dataset.acting`` and ``Dataset.contacts``; the rows are the same.

    Returns:
        The table. Episodes that were refused are left out, and listed in ``about["refused"]``.

    Raises:
        InterventionError: More than half of the episodes were refused, or a target cannot be set.
        Forbidden: The laboratory does not allow it, or has fewer episodes left.
        UnreadableFile: The folder holds something else, or a damaged file.
        UnwritableFolder: There is no room, or no permission; nothing is lost.
        UnknownOption: An argument does not fit, or other processes cannot have the source.
        EngineFailure: Three workers ended over one shard.

    Example:
        >>> from scm_world.queries import World
        >>> world = World("pushing", backend="fake")
        >>> design = Design("single", ("tool_block.mass", "floor_friction"), "B", 0.5)
        >>> table = collect(world, design, 4, steps=2, causes=["floor_friction"])
        >>> [table.regimes[i].targets for i in table.regime]
        [(), ('tool_block.mass',), (), ('floor_friction',)]
    """
    count, given = whole_number("n", n, least=1), dict[str, Any](circumstances)
    whole_number("seed", seed, least=0)
    kinds: dict[Any, Any] = {SCM: ("model", ("steps",)), Laboratory: ("laboratory", ())}
    world = "world", tuple(Circumstances.__annotations__)
    kind, allowed = next((kinds[one] for one in kinds if isinstance(source, one)), world)
    for name in given:
        if name not in allowed:
            choices = allowed or ("nothing: it has its own",)
            raise UnknownOption(f"circumstance of a {kind}", name, choices)
    if isinstance(source, Laboratory):
        if out is not None:
            choices = ("None with a laboratory: give it a log, and save the dataset",)
            raise UnknownOption("out", str(out), choices)
        if engine not in (None, "serial") or workers not in (None, 1):
            choices = ("'serial' with one worker: a laboratory keeps its log in one process",)
            raise UnknownOption("engine of work", engine or workers, choices)
        left = source.remaining
        if left is not None and count > left:
            raise Forbidden(f"run {count} more episodes", [f"{left} episodes"])
        made: Any = LaboratoryRows(source, design, seed)
    elif isinstance(source, SCM):
        made = ModelRows(source, design, seed, given.get("steps"))
    else:
        steps = whole_number("steps", given.pop("steps", STEPS), least=1)
        policy, nature = given.pop("policy", "random"), given.pop("nature", None)
        made = WorldRows(source, design, Setting(policy, nature, steps, seed), **given)
    return collected(made, count, out, shard, progress, workers, engine, design.modules)


def collected(
    source: ModelRows | WorldRows | LaboratoryRows,
    count: int,
    out: Location | str | None,
    shard: int | None,
    progress: Progress | None,
    workers: int | None,
    engine: Executor | str | None,
    trusted: Iterable[str] = (),
    *,
    at_end: bool = False,
) -> Dataset:
    """Read or make the rows of episodes; see ``collect``.

    Functions of the ``trusted`` modules serve as mechanisms. With ``at_end`` the share of refused
    episodes counts only when all are done.
    """
    size = source.shard if shard is None else whole_number("shard", shard, least=1)
    about = json.loads(json.dumps(source.about))
    if out is None and "pictures" in about:
        raise UnknownOption("out", None, ("a folder, since there are pictures",))
    head = Head(about, source.columns, count, size)
    folder = None if out is None else Folder(out, head, (*trusted,))
    ranges, parts, done = head.ranges(), dict[int, SourceRows](), 0
    with opened(engine, workers) as executor, nullcontext() if folder is None else folder.opened():
        for index, numbers in enumerate(ranges):
            part = None if folder is None else folder.read(index, numbers)
            if part is not None:
                parts[index] = part
                done += len(numbers)
        if progress is not None and done:
            progress(done, count)
        missing = [index for index in range(len(ranges)) if index not in parts]
        executor.check("source of episodes with several workers", source)
        refused = [pair for part in parts.values() for pair in part.refused]
        for place, one in executor.run(_Maker(source), [ranges[index] for index in missing]):
            index = missing[place]
            parts[index] = part = replace(one, table=replace(one.table, about=about))
            refused += part.refused
            done += len(ranges[index])
            is_known = done >= ENOUGH and (done == count or not at_end)
            if is_known and 2 * len(refused) > done:
                number, why = refused[-1]
                said = f"{len(refused)} of {done} episodes were refused; number {number} because"
                raise InterventionError(f"{said}: {why}", variable="")
            if folder is not None:
                folder.write(index, ranges[index], part)
                parts[index] = replace(part, pictures=b"")
            if progress is not None:
                progress(done, count)
        found = [parts[index] for index in range(len(ranges))]
        if folder is not None:
            folder.note(refusals(found), complete=True)
    return together(head, found)


class _Maker:
    def __init__(self, source: Any) -> None:
        self.source = source

    def __call__(self) -> Any:
        return self.make

    def make(self, numbers: range) -> SourceRows:
        table, pictures = self.source.rows(numbers)
        refused = tuple((int(k), v) for k, v in table.about.get("refused", {}).items())
        touching = table.about.get("touching", {})
        return SourceRows(replace(table, about={}), refused, pictures, touching)
