"""Collecting: episodes under a design, in memory or in a folder that can be gone on with."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.files import refusals, together
from scm_world.discovery.data.folders import SHARD, Folder, Head
from scm_world.discovery.data.laboratories import Experiments
from scm_world.discovery.data.models import Model
from scm_world.discovery.data.sources import Part, Source
from scm_world.discovery.data.worlds import Episodes
from scm_world.errors import InterventionError, ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.queries.laboratory import Laboratory
from scm_world.queries.progress import Progress
from scm_world.queries.samples import STEPS, Setting
from scm_world.world import World
from scm_world.world.start import whole_number

ENOUGH = 20
"""After so many episodes it is told whether most of them are refused."""


class Circumstances(TypedDict, total=False):
    """What can be said besides, of a world; of a model only ``steps``, of a laboratory nothing."""

    steps: int
    policy: Any
    nature: Mapping[str, Any] | None
    causes: Iterable[str] | None
    outcomes: Iterable[Any] | None
    every_step: bool


def collect(
    source: SCM | World | Laboratory | Source,
    design: Design,
    n: int,
    *,
    seed: int = 0,
    out: Path | str | None = None,
    shard: int = SHARD,
    format: str = "parquet",  # noqa: A002 # as other libraries call it
    progress: Progress | None = None,
    workers: int = 1,
    **circumstances: Unpack[Circumstances],
) -> Dataset:
    """Let episodes happen under a design, and write them down as a table with regimes.

    What is in an episode depends on the seed and on its number only: not on how many there are, on
    the shards, or on the workers. Interrupted, the same call goes on where it was, and the files
    are in the end the same, byte for byte. A larger ``n`` goes on, too.

    Args:
        source: A model (one row per episode, or one per control step if ``steps`` are given), a
            ``World``, or a ``Laboratory`` (through its ``see`` and ``do`` only).
        design: What is done in which episode.
        n: How many episodes.
        seed: Of the noise; for a laboratory only of what the design draws by lot.
        out: A folder: new, empty, or one in which this collection was begun.
        shard: How many episodes are in one of its files.
        format: Of the files: ``"parquet"`` (needs the extra ``data``) or ``"csv"``.
        progress: Told after each episode how many are done, and how many there will be.
        workers: Threads in which episodes of a world happen.
        circumstances: ``steps`` of an episode, 25 in a world. Of a world also ``policy`` and
            ``nature`` (see ``Setting``), ``causes`` (patterns of parameters), ``outcomes`` (names
            or ``Outcome``), and ``every_step``: a row for each control step, with the action.

    Returns:
        The table. Episodes that were refused are left out, and listed in ``about["refused"]``.

    Raises:
        InterventionError: More than half of the episodes were refused, or a target cannot be set.
        Forbidden: The laboratory does not allow it.
        BudgetExhausted: The laboratory has fewer episodes left.
        UnreadableFile: The folder holds something else, or a damaged file.
        UnwritableFolder: There is no room, or no permission; nothing is lost.
        UnknownOption: An argument does not fit.

    Example:
        >>> from scm_world.queries import World
        >>> world = World("pushing", backend="fake")
        >>> design = Design("single", ("tool_block.mass", "floor_friction"), values="B", seen=0.5)
        >>> table = collect(world, design, 4, steps=2, causes=["floor_friction"])
        >>> [table.regimes[i].targets for i in table.regime]
        [(), ('tool_block.mass',), (), ('floor_friction',)]
    """
    count = whole_number("n", n, least=1)
    size = whole_number("shard", shard, least=1)
    whole_number("seed", seed, least=0)
    made = source_of(source, design, count, seed=seed, workers=workers, **circumstances)
    about = json.loads(json.dumps(made.about))
    if out is None:
        size = count if made.at_once else size
        head = Head(about, made.columns, count, size, format, made.edges)
        return together(head, _gathered(made, head, None, progress))
    if isinstance(source, Laboratory):
        allowed = ("None with a laboratory: give it a log, and save the dataset",)
        raise UnknownOption("out", str(out), allowed)
    if about.get("model", "") is None:
        raise ModelError(["a function of the model has no name: define it at the top of a module"])
    head = Head(about, made.columns, count, size, format, made.edges)
    folder = Folder(out, head, design.modules)
    with folder.opened():
        parts = _gathered(made, head, folder, progress)
        folder.note(refusals(parts), complete=True)
    return together(head, parts)


def source_of(
    source: SCM | World | Laboratory | Source,
    design: Design,
    n: int,
    *,
    seed: int,
    workers: int = 1,
    **given: Unpack[Circumstances],
) -> Source:
    """Turn what can be collected from into something that has episodes.

    Raises:
        UnknownOption: It is none of the kinds, or is told what it cannot take.
    """
    match source:
        case SCM():
            _refuse_others(given, ("steps",), "a model")
            return Model(source, design, seed=seed, steps=given.get("steps"))
        case Laboratory():
            _refuse_others(given, (), "a laboratory, which has its own")
            return Experiments(source, design, n, seed=seed)
        case World():
            setting = Setting(
                policy=given.get("policy", "random"),
                nature=given.get("nature"),
                steps=whole_number("steps", given.get("steps", STEPS), least=1),
                seed=seed,
                workers=workers,
            )
            return Episodes(
                source,
                design,
                causes=given.get("causes"),
                outcomes=given.get("outcomes"),
                every_step=given.get("every_step", False),
                setting=setting,
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
    source: Source, head: Head, folder: Folder | None, progress: Progress | None
) -> list[Part]:
    """Read or make all parts."""
    parts: list[Part] = []
    done = 0

    def tell(more: int) -> None:
        nonlocal done
        done += more
        if progress is not None and more:
            progress(done, head.n)

    for index, numbers in enumerate(head.ranges()):
        part = None if folder is None else folder.read(index, numbers)
        if part is None:
            part = _made(source, numbers, tell, head)
            _refuse_hopeless([*parts, part], numbers.stop)
            if folder is not None:
                folder.write(index, numbers, part)
        else:
            tell(len(numbers))
        parts.append(part)
    return parts


def _made(source: Source, numbers: range, tell: Any, head: Head) -> Part:
    part = source.part(numbers, tell)
    return replace(part, table=replace(part.table, about=head.about))


def _refuse_hopeless(parts: list[Part], done: int) -> None:
    refused = [pair for part in parts for pair in part.refused]
    if done >= ENOUGH and 2 * len(refused) > done:
        number, why = refused[-1]
        raise InterventionError(
            f"{len(refused)} of {done} episodes were refused; number {number} because: {why}",
            variable="",
        )
