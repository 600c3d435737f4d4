"""``scm-world do``: one world with the intervention, its twin without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

from scm_world._types import Floats, Value, Values
from scm_world.cli.assignments import parse_assignments
from scm_world.cli.console import PAGE, RESULTS, check_writable, console
from scm_world.cli.tasks import build, suffix, tag
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.models import Scene
from scm_world.output.locations import Location
from scm_world.queries.experiments.effects import gap
from scm_world.variables.kinds import SPACES
from scm_world.world import Audit, World


@final
@dataclass(frozen=True)
class Options:
    """Where to intervene.

    Attributes:
        task: Name of the task.
        backend: Name of the engine.
        preset: Numerical settings.
        seed: Of the noise.
        steps: Control steps to run afterwards.
        space: The space that values must lie in, or None.
        arguments: Of the task, each as ``name=value``.
    """

    task: str
    backend: str
    preset: str | None
    seed: int
    steps: int
    space: str | None
    arguments: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class Row:
    """What became of one variable.

    Attributes:
        name: Of the variable.
        unit: Its unit.
        follows: Whether it is a descendant of a target in the declared graph.
        before: Value at the start.
        at_once: Value right after the intervention.
        after: Value at the end.
        alone: Value at the end of the twin without the intervention.
    """

    name: str
    unit: str
    follows: bool
    before: Value
    at_once: Value
    after: Value
    alone: Value

    @property
    def difference(self) -> float:
        """The largest difference of the two ends."""
        return gap(self.after, self.alone)

    @property
    def moved(self) -> bool:
        """Whether the intervention changed it, at once or later."""
        return self.difference > 0.0 or gap(self.at_once, self.before) > 0.0


@final
@dataclass(frozen=True)
class Outcome:
    """The result of a paired run.

    Attributes:
        options: Where it was done.
        engine: Name and version of the engine.
        audit: Of the intervention.
        rows: One for each variable that is not a target.
        before: The scene at the start.
        after: The scene at the end.
    """

    options: Options
    engine: str
    audit: Audit
    rows: tuple[Row, ...]
    before: Scene
    after: Scene

    @property
    def astray(self) -> tuple[str, ...]:
        """Variables that moved although no declared path leads to them."""
        return tuple(row.name for row in self.rows if row.moved and not row.follows)


def run(
    assignments: Sequence[str], options: Options, *, show_all: bool, out: Location | None
) -> int:
    """Intervene, print, write; return the exit code."""
    from scm_world.cli.outcome import report, save

    if options.space is not None and options.space not in SPACES:
        raise UnknownOption("space", options.space, SPACES)
    request = parse_assignments(assignments)
    about = f"{options.backend}-seed{options.seed}{suffix(options.arguments)}"
    folder = out or RESULTS / f"do-{tag(options.task)}-{about}"
    check_writable(folder, folder=True)
    outcome = paired(request, options)
    save(outcome, folder)
    report(console(width=PAGE), outcome, folder, show_all=show_all)
    return int(bool(outcome.astray))


def paired(request: dict[str, Any], options: Options) -> Outcome:
    """Run a world with an intervention, and again without it: same noise, same actions.

    Raises:
        InterventionError: The intervention was refused.
        UnknownOption: A name does not exist.
    """
    task = build(options.task, options.arguments)
    world = World(task, backend=options.backend, preset=options.preset)
    try:
        world.reset(seed=options.seed)
        start, before, scene = world.snapshot(), world.values(), world.scene()
        hold = world.task.idle(world)
        space: Any = options.space
        audit = world.do(request, space=space)
        at_once, models = world.values(), (world.model,)
        after = _advance(world, hold, options.steps)
        last = world.scene()
        world.restore(start)
        alone = _advance(world, hold, options.steps)
        rows = _rows((*models, world.model), audit, (before, at_once, after, alone))
        engine = f"{world.backend.name} {world.backend.version}"
        return Outcome(options, engine, audit, rows, scene, last)
    finally:
        world.close()


def _advance(world: World, action: Floats, steps: int) -> dict[str, Value]:
    for _ in range(steps):
        world.step(action)
    return world.values()


def _rows(models: tuple[SCM, ...], audit: Audit, values: tuple[Values, ...]) -> tuple[Row, ...]:
    """Compare what there is with and without the intervention, which may change what there is."""
    after, before = models
    targets = {after.target(name) for name in audit.targets}
    follow = {
        name
        for model in models
        for target in targets & {*model}
        for name in model.descendants(target)
    }
    return tuple(
        Row(name, before.declared(name).unit, name in follow, *(v[name] for v in values))
        for name in before
        if all(name in v for v in values) and (name not in targets or name in follow)
    )
