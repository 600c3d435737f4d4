"""Verification: every declared edge must move its child, every other one must leave it alone."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, final

import networkx as nx

from scm_world._arguments import whole_number
from scm_world.errors import UnknownOption
from scm_world.graph import SCM, Edge
from scm_world.models import Model
from scm_world.queries.agreement import SEEDS, Agreement, Sign, compare_signs
from scm_world.queries.experiments.effects import EdgeKey, Effects, Series
from scm_world.queries.experiments.joint import JointExperiments
from scm_world.queries.experiments.models import PairedEquations
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import Pair, Probe
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.queries.verification import (
    Fired,
    Undeclared,
    Unseen,
    Unstable,
    Verification,
    by_provenance,
    named,
)
from scm_world.tasks import Task
from scm_world.variables import Measured
from scm_world.world import Simulation

MOST, LEAST = 200, 16
"""Largest and least number of probe states."""

QUIET = 4
"""After how many probe states without a new edge it ends, of a generated graph."""

HELD_OUT = 8
"""How many further probe states of another seed there are, whatever was seen before."""

EACH = 4
"""In which part of the least number of states signs are compared, with each seed."""

OTHER = 1_000_003
"""What is added to the seed for these."""


def verify(
    system: Simulation | SCM | Task | str,
    *,
    probes: int = MOST,
    least: int = LEAST,
    held_out: int = HELD_OUT,
    seed: int = 0,
    progress: Progress | None = None,
    found: Callable[[set[EdgeKey]], object] | None = None,
    **options: Any,
) -> Verification:
    """Check a declared graph against the physics or the equations that realise it.

    From many probe states one variable at a time is changed, everything else kept, and all
    differences afterwards are compared with the declared edges. The search for declared edges ends
    when each of them was observed. It may be interrupted (Ctrl-C); the report then covers the probe
    states that were finished.

    Effects without an edge are looked for in further states, which are held out: of another seed,
    half of them with other parameters, where random actions lead, anywhere that is feasible, and
    where bodies touch. A task's own scenarios are not used there, so the report says how much of
    the graph shows without them.

    A graph that was generated from a model says what can act on what; some of its edges may never
    show, and stay unseen. So its search ends when nothing new is seen any more, and in the held-out
    states only what was never seen, or seen without an edge, is looked for.

    A causal model without a backend is its own physics: each mechanism is evaluated with one
    variable changed. A declared parent that its mechanism ignores never shows. An effect without
    an edge cannot be, since a mechanism is given its declared parents only.

    Args:
        system: A world, a causal model, a task, the name of one, or a model file.
        probes: How many states to experiment in at most.
        least: How many even if every declared edge has been seen before.
        held_out: How many further ones for effects without an edge.
        seed: Of states and values.
        progress: Called with (finished, planned) after each probe state.
        found: Called before that with all edges observed so far: (cause, effect, lag).
        options: Arguments of ``World``, such as ``backend``, unless ``system`` is one.

    Returns:
        The report. Its ``outcome`` is ``"confirmed"``, ``"not refuted"`` where declared edges are
        left that no probe state showed, with the reasons, or ``"refuted"``. A world that was given
        is afterwards as it was.

    Raises:
        UnknownOption: ``probes`` or ``least`` is not a positive whole number, ``held_out`` is not
            a whole number, there are options for a world that is made, or a name does not exist.

    Example:
        >>> found = verify("reaching", backend="fake", probes=1, held_out=0)
        >>> found.floor, found.undeclared, found.outcome  # without physics nothing moves
        (0.0, (), 'not refuted')
    """
    whole_number("number of probes", probes, least=1)
    whole_number("least number of probes", least, least=1)
    whole_number("number of held-out probes", held_out, least=0)
    if isinstance(system, Simulation | SCM):
        if options:
            raise UnknownOption("option for a world that is made", next(iter(options)), ())
        with system.unchanged() if isinstance(system, Simulation) else contextlib.nullcontext():
            return _verified(system, probes, least, held_out, seed, progress, found)
    world = Simulation(system, **options)
    try:
        return _verified(world, probes, least, held_out, seed, progress, found)
    finally:
        world.close()


def verify_engines(
    task: Task | str,
    *,
    backends: tuple[str, str] = ("mujoco", "bullet"),
    probes: int = MOST,
    least: int = LEAST,
    held_out: int = HELD_OUT,
    seed: int = 0,
    seeds: int = SEEDS,
    progress: Callable[[str], Progress | None] | None = None,
    **options: Any,
) -> Agreement:
    """Verify a task on two backends, and compare the signs of its effects.

    It may be interrupted (Ctrl-C); the report then has what is finished.

    Signs are compared from probe states that are made of the same numbers on both backends, over
    one control step. Two backends differ even where nothing was changed (their noise floor); only
    effects well above this are comparable.

    Args:
        task: A task, or the name of one.
        backends: Their names.
        probes: How many states to experiment in at most.
        least: How many at least, even if every declared edge has been observed before; signs are
            compared in a fourth of as many with each seed.
        held_out: How many further ones for effects without an edge.
        seed: Of states and values.
        seeds: With how many seeds signs are compared, this one and those after it.
        progress: Called with the name of each backend, and last with ``"signs"``; gives what is
            called with (finished, planned) after each probe state.
        options: Arguments of ``World``, without ``backend``.

    Raises:
        UnknownOption: See ``verify``.
        MissingEngine: One of the backends is not installed.
    """
    started = time.perf_counter()
    many = whole_number("number of seeds", seeds, least=1)

    def progress_of(name: str) -> Progress | None:
        return None if progress is None else progress(name)

    compared = max(1, min(least, probes) // EACH)
    limits: dict[str, Any] = {"probes": probes, "least": least, "seed": seed}
    limits["held_out"] = held_out
    reports: list[Verification] = []
    for name in backends:
        reports.append(verify(task, progress=progress_of(name), **limits, backend=name, **options))
        if reports[-1].interrupted:
            break
    signs: tuple[Sign, ...] | None = None
    if not reports[-1].interrupted:
        with contextlib.suppress(KeyboardInterrupt):
            signs = compare_signs(
                task, backends, compared, range(seed, seed + many), progress_of("signs"), options
            )
    return Agreement(
        task=reports[0].task,
        backends=backends,
        verifications=tuple(reports),
        interrupted=signs is None,
        probes=0 if signs is None else many * compared,
        seeds=many,
        signs=signs or (),
        seconds=time.perf_counter() - started,
    )


@final
class _Experiments:
    """All experiments with a world: one variable changed, and everything that should not matter.

    Args:
        world: To experiment with.
        seed: Of the values.
        causes: Names of the variables that are changed alone; all if None.
    """

    def __init__(self, world: Simulation, seed: int, causes: set[str] | None = None) -> None:
        self._paired = Paired(world, seed, causes=causes)
        self.effects, self.targets = self._paired.effects, self._paired.targets
        self._together = JointExperiments(world, seed, self.effects)

    def run(self, number: int, probe: Probe) -> None:
        """Do all experiments of one probe state."""
        if self._paired.arrives(probe):
            self._paired.run(number, probe)
            self._together.run(number, probe)


@final
class _Watch:
    """Records after how many probe states each declared edge was first observed.

    Args:
        declared: The edges.
        least: When it is early to end.
        quiet: After how many probe states without a new edge it is enough; never if None.
    """

    def __init__(self, declared: Iterable[EdgeKey], least: int, quiet: int | None) -> None:
        self.missing, self.after = set(declared), dict[EdgeKey, int]()
        self._least, self._quiet, self._last = least, quiet, 0
        self.ended = False

    def __call__(self, effects: Effects, done: int) -> bool:
        """Record the edges that are observed now; tell whether to stop."""
        new = self.missing & effects.edges(self.missing)
        self.missing -= new
        self.after.update(dict.fromkeys(new, done))
        self._last = done if new else self._last
        is_quiet = self._quiet is not None and done - self._last >= self._quiet
        self.ended = done >= self._least and (not self.missing or is_quiet)
        return self.ended


def _verified(
    system: Simulation | SCM,
    probes: int,
    least: int,
    held_out: int,
    seed: int,
    progress: Progress | None,
    found: Callable[[set[EdgeKey]], object] | None,
) -> Verification:
    started = time.perf_counter()
    world = system if isinstance(system, Simulation) else None
    model: SCM = system.model if isinstance(system, Simulation) else system
    generated = world is not None and world.task.generated_graph
    declared = tuple(edge.key for edge in model.edges)
    measured = {v.name for v in model.variables if isinstance(v, Measured)}
    watch = _Watch(declared, least, QUIET if generated else None)

    def watched(effects: Effects, done: int) -> bool:
        if found is not None:
            found(effects.edges(set(declared)))
        return watch(effects, done)

    paired: Any = _Experiments(world, seed) if world else PairedEquations(model, seed)
    series = Series(paired, probes, progress)
    series.run(probe_states(world, probes, seed) if world else range(probes), watched)
    effects, done = series.effects, series.done
    observed = effects.edges(set(declared))
    interrupted = done < probes and not watch.ended
    open_ = observed.symmetric_difference(declared)
    further: Series | None = None
    again: set[EdgeKey] | None = None
    if world and held_out and not interrupted:
        causes = {cause for cause, _, _ in open_} if generated else None
        further = Series(_Experiments(world, seed + OTHER, causes), held_out)
        with contextlib.suppress(KeyboardInterrupt):
            states = probe_states(world, held_out, seed + OTHER, scenarios=False)
            further.run(states, lambda new, more: watch(new, done + more) and False)
        interrupted = further.done < held_out
        again = further.effects.edges(set(declared))
        effects.take(further.effects, done)
        observed = effects.edges(set(declared))
    undeclared = []
    seen = [(key, effects.largest[key], effects.settings[key]) for key in observed - set(declared)]
    seen += [
        (key, size, replace(where, kind=f"{where.kind}, without contact"))
        for key, (size, where) in effects.apart.items()
    ]
    for key, size, setting in sorted(seen, key=lambda one: one[0]):
        undeclared.append(
            Undeclared(
                **named(key),
                size=size,
                probe=setting.probe,
                kind=setting.kind,
                change=() if setting.change is None else tuple(setting.change.tolist()),
                again=None if again is None else key in again,
            )
        )
    return Verification(
        task=world.task.name if world else "model",
        backend=world.backend.name if world else "equations",
        preset=world.options.preset if world else "none",
        seed=seed,
        generated=generated,
        probes=done,
        held_out=0 if further is None else further.done,
        seen_held_out=None if again is None or generated else len(again & set(declared)),
        provenance=by_provenance(model, declared, observed, [edge.key for edge in undeclared]),
        unstable=tuple(
            Unstable(variable=name, after=after, size=size)
            for (name, after), size in sorted(effects.unstable.items())
        ),
        shared_noise=tuple(sorted(effects.shared_noise)),
        planned=probes,
        interrupted=interrupted,
        rollouts=effects.rollouts,
        floor=effects.floor,
        threshold=effects.threshold,
        settable=len(paired.targets),
        untried=tuple(sorted(name for name in paired.targets if not effects.changed[name])),
        fired=tuple(
            Fired(
                **named(key),
                after=watch.after[key],
                largest=effects.largest[key],
                states=effects.states[key],
            )
            for key in sorted(observed & set(declared))
        ),
        unseen=_unseen(world, model, effects, observed),
        undeclared=tuple(undeclared),
        colors=tuple(
            sorted(
                edge
                for edge in {*observed, *declared}
                if edge[0].endswith("color") and edge[1] in measured
            )
        ),
        seconds=time.perf_counter() - started,
        versions=versions(world.engine if world else ""),
    )


def _unseen(
    world: Simulation | None, model: SCM, effects: Effects, observed: set[EdgeKey]
) -> tuple[Unseen, ...]:
    """List the declared edges that were not seen, each with the reason."""
    found = []
    for edge in sorted(model.edges, key=lambda edge: edge.key):
        if edge.key not in observed:
            states = effects.changed[edge.cause]
            reason = _reason(world, edge, effects, observed)
            found.append(Unseen(**named(edge.key), states=states, reason=reason))
    return tuple(found)


def _reason(world: Simulation | None, edge: Edge, effects: Effects, observed: set[EdgeKey]) -> str:
    """Say why an edge was not seen, as far as the experiments tell."""
    cause, states = edge.cause, effects.changed[edge.cause]
    if not states:
        refused = ": every other value that was tried was refused" * (cause in effects.refused)
        return f"no probe state had another value of {cause}{refused}"
    if world is not None and edge.when == "contact":
        apart = _apart(world.structure, edge, effects.touched)
        if apart is not None:
            return apart
    acted = {name for name, _, lag in observed if lag}
    for action in () if world is None else world.compiled.actions:
        if action.partition(".")[0] == cause.partition(".")[0] and action not in acted:
            return f"no command of {action} acted: each was cut to a limit, or drives nothing"
    beyond = " beyond rounding and noise" * (effects.largest.get(edge.key, 0.0) > 0.0)
    where = "units" if world is None else "probe states"
    return f"no difference{beyond}, though {cause} was changed in {states} of the {where}"


def _apart(structure: Any, edge: Edge, touched: set[Pair]) -> str | None:
    """Name the bodies that never touched, so that an edge by contact could not act.

    Args:
        structure: A model says which body each of its joints and shapes belongs to.
        edge: By contact.
        touched: The pairs of bodies that touched in some probe state.
    """
    if not touched:
        return "nothing touched in any probe state"
    if not isinstance(structure, Model):
        return None
    bodies, rows = structure.bodies, dict[str, int]()
    for elements in ("joints", "shapes"):
        rows |= {name: n for n, body in enumerate(bodies) for name in getattr(body, elements)}
    rows |= {body.name: number for number, body in enumerate(bodies)}
    one, other = (rows.get(name.partition(".")[0]) for name in (edge.cause, edge.effect))
    if one is None or other is None:
        return None
    first, second = bodies[one], bodies[other]
    if not any(first.name in pair for pair in touched):
        return f"{first.name} touched nothing in any probe state"
    trees = nx.Graph([[bodies[rows[name]].tree for name in pair] for pair in touched])
    trees.remove_nodes_from([-1])  # what is fixed passes nothing on
    trees.add_nodes_from([first.tree, second.tree])
    if first.tree >= 0 and not nx.has_path(trees, first.tree, second.tree):
        return f"{first.name} and {second.name} touched in no probe state, nor through other bodies"
    return None
