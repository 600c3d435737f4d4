"""Discovery from beginning to end."""

from __future__ import annotations

import time
from typing import Any

from scm_world.discovery.checkpoints import Checkpoint
from scm_world.discovery.design import bounds
from scm_world.discovery.report import DiscoveryReport
from scm_world.discovery.scores import score
from scm_world.graph import SCM
from scm_world.output.locations import Location
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.models import PairedEquations
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.experiments.series import Series, checked_count
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.world import World


def discover(
    system: World | SCM | str,
    *,
    probes: int = 32,
    seed: int = 0,
    progress: Progress | None = None,
    checkpoint: Location | str | None = None,
    **options: Any,
) -> DiscoveryReport:
    """Recover a causal graph by paired single-target interventions, and score it.

    The threshold follows from the measured floor: the largest difference that is left after
    something was done and undone. It may be interrupted (Ctrl-C); the report then covers the
    probe states that were finished.

    Args:
        system: A world, the name of a task, or a causal model without physics.
        probes: How many states to experiment in.
        seed: Of states and values.
        progress: Called with (finished, planned) after each probe state.
        checkpoint: A file to write to after each probe state of a world; the same call goes on
            from there, with the same result. It is removed when all are finished.
        options: Arguments of ``World``, where ``system`` is a name.

    Raises:
        UnknownOption: ``probes`` is not a positive number, or a name does not exist.
        UnreadableFile: The checkpoint is damaged, or of another discovery.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="a"),
        ...     Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
        ... ])
        >>> discover(model, probes=2).score.shd
        0
    """
    checked_count("number of probes", probes)
    started = time.perf_counter()
    if isinstance(system, SCM):
        series = Series(PairedEquations(system, seed), probes, progress)
        series.run(range(probes))
        about = {"task": "model", "backend": "none", "preset": "none", "engine": ""}
        return _report(system, series.effects, series.done, probes, seed, about, started)
    world = World(system, **options) if isinstance(system, str) else system
    try:
        effects, done = _experiments(world, probes, seed, progress, checkpoint)
        about = {
            "task": world.task.name,
            "backend": world.backend.name,
            "preset": world.options.preset,
            "engine": f"{world.backend.name} {world.backend.version}",
        }
        return _report(world.model, effects, done, probes, seed, about, started)
    finally:
        if isinstance(system, str):
            world.close()


def _experiments(
    world: World, probes: int, seed: int, progress: Progress | None, path: Location | str | None
) -> tuple[Effects, int]:
    paired = Paired(world, seed)
    saved = None if path is None else Checkpoint(path, _terms(world, seed))
    first = 0 if saved is None else min(saved.read(paired), probes)
    series = Series(paired, probes, progress, done=first)

    def written(effects: Effects, done: int) -> bool:
        if saved is not None:
            saved.write(effects, done, paired)
        return False

    series.run(probe_states(world, probes, seed, first=first), written)
    if saved is not None and series.done == probes:
        saved.end()
    return series.effects, series.done


def _terms(world: World, seed: int) -> dict[str, Any]:
    given = {name: str(value) for name, value in sorted(world.task.given.items())}
    backend = world.backend
    finer = (
        {} if world.resolution == world.task.resolutions[0] else {"resolution": world.resolution}
    )
    return {
        **finer,
        "task": world.task.name,
        "arguments": given,
        "action_mode": world.action_mode,
        "preset": world.options.preset,
        "seed": seed,
        "versions": versions(f"{backend.name} {backend.version}"),
    }


def _report(
    model: SCM,
    effects: Effects,
    done: int,
    planned: int,
    seed: int,
    about: dict[str, str],
    started: float,
) -> DiscoveryReport:
    declared = {edge.key for edge in model.edges}
    found = effects.edges(declared)
    inert = [size for key, size in effects.largest.items() if key not in found]
    return DiscoveryReport(
        task=about["task"],
        backend=about["backend"],
        preset=about["preset"],
        seed=seed,
        probes=done,
        planned=planned,
        rollouts=effects.rollouts,
        bound=done * bounds.paired_single_target(len(effects.undone) or len(list(model))),
        floor=effects.floor,
        threshold=effects.threshold,
        inert=max(inert, default=0.0),
        score=score(found, declared),
        found=tuple(sorted(found)),
        declared=tuple(sorted(declared)),
        effects={key: effects.largest[key] for key in found},
        refused=effects.refused,
        seconds=time.perf_counter() - started,
        versions=versions(about["engine"]),
    )
