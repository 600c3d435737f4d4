"""Which crew simulates."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable

from scm_world.env.batched.crew import Crew
from scm_world.env.batched.loop import LoopCrew
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import UnknownOption
from scm_world.work.threads import cores

TOGETHER = ("mujoco", "step")
"""Engines that step many worlds in one call."""

CREWS = ("native", "processes", "loop")


def made_crew(
    crew: str | None,
    make: Callable[[], ScmWorldEnv],
    num_envs: int,
    *,
    backend: str,
    threads: int | None = None,
    workers: int | None = None,
) -> Crew:
    """Make what simulates many environments.

    Args:
        crew: Its name; the fastest one for the backend if None.
        make: Makes one environment.
        num_envs: How many.
        backend: Name of the engine.
        threads: Of the native crew.
        workers: Processes of the crew that has some.

    Raises:
        UnknownOption: There is no such crew, or an option is not one of it.
    """
    kind = crew if crew is not None else fastest(backend, num_envs, workers=workers)
    if kind not in CREWS:
        raise UnknownOption("crew", kind, CREWS)
    for option, value, owner in (("threads", threads, "native"), ("workers", workers, "processes")):
        if value is not None and kind != owner:
            raise UnknownOption(option, value, (f"None with crew={kind!r}", f"any with {owner!r}"))
    if kind == "processes":
        from scm_world.env.batched.processes import ProcessCrew

        return ProcessCrew(make, num_envs, workers=workers)
    if kind == "native":
        from scm_world.env.batched.native import NativeCrew

        return NativeCrew(make, num_envs, threads=threads)
    return LoopCrew(make, num_envs)


def fastest(backend: str, num_envs: int, *, workers: int | None) -> str:
    """Name the crew that is fastest, which is the one with processes if their number is asked.

    A process of a pool starts none of its own.
    """
    if backend in TOGETHER and workers is None:
        return "native"
    several = num_envs > 1 and cores() > 1 and not multiprocessing.current_process().daemon
    return "processes" if workers is not None or (backend == "bullet" and several) else "loop"
