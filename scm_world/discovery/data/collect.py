"""Collecting: episodes under a design, in memory or in a folder that can be resumed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, TypedDict, Unpack

from scm_world._arguments import typed, whole_number
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.folders import SHARD, Folder, Head, refusals, together
from scm_world.discovery.data.pictures import Pictures
from scm_world.discovery.data.sources import DataSource, ModelSource, SourceRows, Tell
from scm_world.discovery.data.worlds import Experiments, WorldSource
from scm_world.errors import InterventionError, UnknownOption
from scm_world.graph import SCM
from scm_world.output.remote import Location
from scm_world.queries.equations import Equations, System
from scm_world.queries.laboratory import Laboratory
from scm_world.queries.progress import Progress
from scm_world.queries.samples import STEPS, Setting
from scm_world.queries.twins import asked
from scm_world.work.executors import Executor, Serial, opened
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
    source: SCM | System | Laboratory | DataSource,
    design: Design,
    n: int,
    *,
    seed: int = 0,
    out: Location | str | None = None,
    shard: int = SHARD,
    progress: Progress | None = None,
    workers: int | None = None,
    engine: Executor | str | None = None,
    **circumstances: Unpack[Circumstances],
) -> Dataset:
    """Collect episodes under a design, as a table with regimes.

    What is in an episode depends on the seed and on its number only: not on how many there are, on
    the shards, or on the workers. An interrupted call resumes when it is repeated, and the
    files are then the same, byte for byte. A larger ``n`` adds episodes.

    Args:
        source: A model (one row per episode, or one per control step if ``steps`` are given), a
            ``World``, or a ``Laboratory`` (through its ``see`` and ``do`` only).
        design: What is done in which episode.
        n: How many episodes.
        seed: Of the noise; for a laboratory only of what the design draws by lot.
        out: A folder, or a URL: new, empty, or one in which this collection was begun. Its files
            are Parquet, which needs the extra ``data``.
        shard: How many episodes are in one of its files.
        progress: Called with how many episodes are done, and how many there will be: after each
            episode in this process, after each shard of others.
        workers: How many shards are made at the same time. None is one, in this process; with an
            engine it is as many as there are cores.
        engine: What makes them: ``"serial"``, ``"process"``, ``"ray"``, or an executor; see
            ``engine_of``. A laboratory, which keeps a log, has the first one only.
        circumstances: ``steps`` of an episode, 25 in a world. Of a world also ``policy`` and
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
    count = whole_number("n", n, least=1)
    size = whole_number("shard", shard, least=1)
    whole_number("seed", seed, least=0)
    made = source_of(source, design, count, seed=seed, **circumstances)
    about = json.loads(json.dumps(made.about))
    if out is None and "pictures" in about:
        raise UnknownOption("out", None, ("a folder, since there are pictures",))
    folder = None
    if out is None:
        size = count if made.at_once else size
    elif isinstance(source, Laboratory):
        allowed = ("None with a laboratory: save the dataset",)
        raise UnknownOption("out", str(out), allowed)
    head = Head(about, made.columns, count, size, made.edges)
    if out is not None:
        folder = Folder(out, head, design.modules)
    with opened(engine, workers) as executor:
        if isinstance(source, Laboratory) and not isinstance(executor, Serial):
            allowed = ("'serial' with one worker: a laboratory keeps its budget in one process",)
            raise UnknownOption("engine of work", executor.engine, allowed)
        with nullcontext() if folder is None else folder.opened():
            parts = _gathered(made, head, folder, executor, progress)
            if folder is not None:
                folder.note(refusals(parts), complete=True)
    return together(head, parts)


def source_of(
    source: SCM | System | Laboratory | DataSource,
    design: Design,
    n: int,
    *,
    seed: int,
    **given: Unpack[Circumstances],
) -> DataSource:
    """Turn what can be collected from into something that has episodes.

    Raises:
        UnknownOption: It is none of the kinds, or is given arguments that it does not take.
    """
    if isinstance(source, Equations):
        source = source.model
    match source:
        case SCM():
            _refuse_others(given, ("steps",), "a model")
            return ModelSource(source, design, seed=seed, steps=given.get("steps"))
        case Laboratory():
            _refuse_others(given, (), "a laboratory, which has its own")
            return Experiments(source, design, n, seed=seed)
        case Simulation():
            setting = Setting(
                policy=given.get("policy", "random"),
                nature=given.get("nature"),
                steps=whole_number("steps", given.get("steps", STEPS), least=1),
                seed=seed,
            )
            return WorldSource(
                *asked(source),
                design,
                causes=given.get("causes"),
                outcomes=given.get("outcomes"),
                every_step=given.get("every_step", False),
                setting=setting,
                pictures=given.get("pictures"),
                contacts=given.get("contacts", False),
            )
    if not hasattr(source, "part"):
        raise UnknownOption("source", source, ("an SCM", "a World", "a Laboratory", "a Source"))
    _refuse_others(given, (), "a source, which has its own")
    return source


def _refuse_others(given: Mapping[str, Any], allowed: tuple[str, ...], of: str) -> None:
    for name in given:
        if name not in allowed:
            raise UnknownOption(f"circumstance of {of}", name, allowed or ("nothing",))


def _gathered(
    source: DataSource,
    head: Head,
    folder: Folder | None,
    executor: Executor,
    progress: Progress | None,
) -> list[SourceRows]:
    """Read or make all parts."""
    ranges, serial, done = head.ranges(), isinstance(executor, Serial), 0

    def tell(more: int) -> None:
        nonlocal done
        done += more
        if progress is not None and more:
            progress(done, head.n)

    parts: dict[int, SourceRows] = {}
    for index, numbers in enumerate(ranges):
        part = None if folder is None else folder.read(index, numbers)
        if part is not None:
            parts[index] = part
            tell(len(numbers))
    missing = [index for index in range(len(ranges)) if index not in parts]
    executor.check("source of episodes with several workers", source)
    make = partial(partial, made_of, source, tell if serial else None)
    refused = [pair for part in parts.values() for pair in part.refused]
    made = sum(len(ranges[index]) for index in parts)
    for place, found in executor.run(make, [ranges[index] for index in missing]):
        index = missing[place]
        parts[index] = part = replace(found, table=replace(found.table, about=head.about))
        refused += part.refused
        made += len(ranges[index])
        is_known = made >= ENOUGH and (made == head.n or not source.uneven)
        if is_known and 2 * len(refused) > made:
            number, why = refused[-1]
            said = f"{len(refused)} of {made} episodes were refused; number {number} because"
            raise InterventionError(f"{said}: {why}", variable="")
        if folder is not None:
            folder.write(index, ranges[index], part)
            parts[index] = replace(part, pictures=b"")
        if not serial:
            tell(len(ranges[index]))
    return [parts[index] for index in range(len(ranges))]


def made_of(source: DataSource, tell: Tell | None, numbers: range) -> SourceRows:
    """Make the rows of a shard, in any process; ``tell`` is None in other ones."""
    part = source.part(numbers, tell or (lambda more: None))
    return replace(part, table=replace(part.table, about={}))  # it is the same in all of them
