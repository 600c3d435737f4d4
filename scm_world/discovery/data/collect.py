"""Collecting: episodes under a design, in memory or in a folder that can be resumed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from scm_world._arguments import one_of, typed, whole_number
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.files import (
    COUNT,
    KIND,
    count_in,
    decoded,
    encoded,
    settings_of,
    shard_name,
    together,
    write_count,
)
from scm_world.discovery.data.worlds import EpisodeRows
from scm_world.errors import InterventionError, UnknownOption
from scm_world.graph import SCM
from scm_world.queries.equations import as_given
from scm_world.queries.progress import Progress
from scm_world.queries.samples import STEPS, Setting
from scm_world.runs.files import Location, is_there, remove
from scm_world.runs.pool import Pool, pool_of
from scm_world.runs.study import Study
from scm_world.world import CausalSystem

ENOUGH = 20
"""After so many episodes, and when all are done, the share of refused ones is checked."""
MOST = 1_000_000
"""Maximal number of files of a collection."""


CIRCUMSTANCES = (
    *("steps", "policy", "nature", "causes", "outcomes", "every_step", "pictures", "contacts"),
)
"""The further arguments for a world; a model without physics has the first one."""


@typed
def collect(
    source: SCM | CausalSystem,
    design: Design,
    n: int,
    *,
    seed: int = 0,
    out: Location | str | None = None,
    shard: int | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
    engine: Pool | str | None = None,
    **circumstances: object,
) -> Dataset:
    """Collect episodes under a design, as a table with regimes.

    The rows of an episode depend on the seed and on its number only: not on how many there are, on
    the shards, or on the workers. An interrupted call resumes when it is repeated, and the
    files are then the same, byte for byte. A larger ``n`` adds episodes.

    Args:
        source: A model (one row per episode, or one per control step if ``steps`` are given), or a
            ``World``.
        design: The interventions of each episode.
        n: Number of episodes.
        seed: Seed of the noise, and of the random choices of the design.
        out: A folder, or a URL: new, empty, or one in which this collection was begun. Its files
            are Parquet.
        shard: How many episodes are in one of its files, and run by a worker in one piece. If
            None, 10,000 of a model; of a world 500, or as many as its engine steps best together
            (``Capabilities.scenes``).
        progress: Called with how many episodes are done, and how many there will be, after each
            shard.
        workers: How many shards are made at the same time. None is one, in this process; with an
            engine it is as many as there are cores.
        engine: The executor: ``"serial"``, ``"process"``, ``"ray"``, the address of a cluster,
            or a ``Pool``.
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
        UnreadableFile: The folder holds something else, or a damaged file.
        UnwritableFolder: The disk is full, or permission is missing; nothing is lost.
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
    how: dict[str, Any] = {
        "shard": shard,
        "progress": progress,
        "workers": workers,
        "engine": engine,
    }
    made, trusted = _rows_of(source, design, seed, circumstances), design.modules
    return collected(
        made, whole_number("n", n, least=1, most=math.inf), out, **how, trusted=trusted
    )


@typed
def collect_parts(
    source: SCM | CausalSystem,
    design: Design,
    n: int,
    *,
    seed: int = 0,
    out: Location | str | None = None,
    shard: int | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
    engine: Pool | str | None = None,
    **circumstances: object,
) -> Iterator[Dataset]:
    """Collect as ``collect`` does, in bounded memory: yield the rows of each file.

    Files that are there come first, the others as they are ready. The ``about`` of each part has
    what that of the whole table has, of its own episodes. Arguments and errors are those of
    ``collect``.
    """
    how: dict[str, Any] = {
        "shard": shard,
        "progress": progress,
        "workers": workers,
        "engine": engine,
    }
    made, trusted = _rows_of(source, design, seed, circumstances), design.modules
    count = whole_number("n", n, least=1, most=math.inf)
    settings = settings_of(made.about, made.columns, 1)
    parts = _parts(made, count, out, **how, trusted=trusted)
    return (together(settings, [part]) for _, part in parts)


def _rows_of(
    source: SCM | CausalSystem, design: Design, seed: int, circumstances: Mapping[str, Any]
) -> EpisodeRows:
    """Return what makes the rows of a collection, with checked arguments."""
    source, given = as_given(source), dict(circumstances)
    kind, many = ("model", 1) if isinstance(source, SCM) else ("world", None)
    for name in given:
        one_of(f"circumstance of a {kind}", name, CIRCUMSTANCES[:many])
    if isinstance(source, SCM):
        setting = Setting(None, None, given.get("steps"), seed)
        return EpisodeRows(source, design, setting, every_step=True)
    steps = whole_number("steps", given.pop("steps", STEPS), least=1)
    policy, nature = given.pop("policy", "random"), given.pop("nature", None)
    return EpisodeRows(source, design, Setting(policy, nature, steps, seed), **given)


def collected(source: EpisodeRows, count: int, out: Location | str | None, **how: Any) -> Dataset:
    """Read or make the rows of episodes, as one table; see ``collect``."""
    parts = sorted(_parts(source, count, out, **how), key=lambda part: part[0])
    settings = settings_of(source.about, source.columns, 1)
    return together(settings, [part for _, part in parts])


def _parts(
    source: EpisodeRows,
    count: int,
    out: Location | str | None,
    *,
    shard: int | None,
    progress: Progress | None,
    workers: int | None,
    engine: Pool | str | None,
    trusted: Sequence[str] = (),
    at_end: bool = False,
) -> Iterator[tuple[int, Dataset]]:
    """Yield the rows of each file, with its number.

    Functions of the ``trusted`` modules serve as mechanisms. With ``at_end`` the share of refused
    episodes counts only when all are done.
    """
    size = source.shard if shard is None else whole_number("shard", shard, least=1)
    taken = source.about.get("pictures")
    if out is None and taken is not None:
        raise UnknownOption("out", None, ("a folder, since there are pictures",))
    if count > MOST * size:
        allowed = (f"at most {MOST * size:,} in files of {size} episodes; raise `shard` for more",)
        raise UnknownOption("number of episodes", count, allowed)
    starts = range(0, count, size)
    cells = {shard_name(i): range(at, min(at + size, count)) for i, at in enumerate(starts)}
    seen = {name: f"pictures-{i:05d}.parquet" for i, name in enumerate(cells) if taken}
    settings = settings_of(source.about, source.columns, size)
    places = {name: place for place, name in enumerate(cells)}
    refused, why, done = 0, ("", ""), 0
    with Study(out, KIND, settings) as study, pool_of(engine, workers) as pool:
        folder = study.folder
        if folder is not None:
            there = count_in(folder)["episodes"] if (folder / COUNT).exists() else 0
            if there > count:
                allowed = (f"{there} or more: {folder} has so many already",)
                raise UnknownOption("number of episodes", count, allowed)
            if there < count and there % size:  # the last file was not full
                last = shard_name(there // size)
                for name in (seen.get(last, last), last):
                    remove(folder / name)
            for name in seen:  # a process can be killed between the two
                if not is_there(folder / seen[name]):
                    remove(folder / name)
                elif is_there(folder / name):
                    study.kept(seen[name], len, cells[name])
            write_count(folder, count, len(cells))
        for name, (part, pictures) in study.map(
            cells,
            source.rows,
            read=lambda data: (decoded(data, source.columns, trusted), b""),
            write=lambda made: encoded(made[0]),
            pool=pool,
        ):
            if pictures and folder is not None:
                study.keep(seen[name], pictures, cells[name])
            done += len(cells[name])
            here = [*part.about.get("refused", {}).items()]
            refused, why = refused + len(here), here[-1] if here else why
            is_known = done == count or (done >= ENOUGH and not at_end)
            if is_known and 2 * refused > done:
                said = f"{refused} of {done} episodes were refused; number {why[0]} because"
                raise InterventionError(f"{said}: {why[1]}", variable="")
            if progress is not None:
                progress(done, count)
            yield places[name], part
