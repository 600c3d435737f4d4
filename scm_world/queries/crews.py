"""Episodes in processes of their own, for engines that step one world at a time."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Generator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, final

from scm_world.errors import UnknownOption
from scm_world.queries.stages import Stage
from scm_world.queries.traces import Trace
from scm_world.queries.units import Unit
from scm_world.work.executors import Executor
from scm_world.world import World

PAYS = 10_000
"""Control steps that pay for the start of processes."""

GOES_ON = 200
"""Control steps that are worth sending to processes that are there."""

SHARE = 4
"""Jobs for each process, so that none waits long for the last one."""


def crew(stage: Stage, units: Sequence[Unit], workers: int) -> Executor | None:
    """Give processes for some units; None where they do not pay, or cannot be.

    Args:
        stage: Of the world.
        units: What is to happen.
        workers: How many processes there may be.
    """
    steps = sum(unit.steps - unit.first for unit in units)
    is_child = multiprocessing.parent_process() is not None
    worth = GOES_ON if stage.has_crew(workers) else PAYS
    if workers < 2 or len(units) < 2 or is_child or steps < worth:
        return None
    executor = stage.crew(workers)
    try:
        executor.check("stage", stage)
        executor.check("units", [_sent(unit) for unit in units])
    except UnknownOption:  # such as a policy that is a lambda: it acts in this process
        return None
    return executor


def sent(
    executor: Executor, stage: Stage, units: Sequence[Unit]
) -> Generator[Trace | Exception, None, None]:
    """Let units happen elsewhere.

    Args:
        executor: As ``crew`` gave it.
        stage: Of the world.
        units: What is to happen.

    Returns:
        How each ended, in the order of the units.

    Raises:
        EngineFailure: Processes ended again and again.
    """
    size = math.ceil(len(units) / (SHARE * executor.workers))
    jobs = [tuple(map(_sent, units[i : i + size])) for i in range(0, len(units), size)]
    early: dict[int, list[Any]] = {}
    told = 0
    with stage.twin() as world:
        for job, endings in executor.run(partial(Elsewhere, stage), jobs):
            early[job] = endings
            while told in early:
                yield from (_here(ending, world) for ending in early.pop(told))
                told += 1


@final
class Elsewhere:
    """Lets units happen in its process.

    Args:
        stage: Of the world.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage

    def __call__(self, units: Sequence[Unit]) -> list[Any]:
        """Give what each unit leaves behind, or what stopped it."""
        with self._stage.twin() as world:
            return [_told(_here_unit(unit, world).ended(world)) for unit in units]


def _sent(unit: Unit) -> Unit:
    """Write down a unit for another process: a structure is sent as what stands in it."""
    return replace(unit, past=_told(unit.past))


def _here_unit(unit: Unit, world: World) -> Unit:
    return replace(unit, past=_here(unit.past, world))


def _told(ending: Any) -> Any:
    if not isinstance(ending, Trace):
        return ending
    plans: Any = [(step, declaration.plan) for step, declaration in ending.declarations]
    return replace(ending, declarations=plans)


def _here(ending: Any, world: World) -> Any:
    if not isinstance(ending, Trace):
        return ending
    plans: Any = ending.declarations
    found = [(step, world.family.declaration(plan)) for step, plan in plans]
    return replace(ending, declarations=found)
