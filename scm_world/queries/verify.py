"""Verification: every declared edge must move its child, every other one must leave it alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from scm_world._arguments import whole_number
from scm_world.graph import SCM, Edge
from scm_world.queries.experiments.effects import EdgeKey, Effects
from scm_world.queries.experiments.markov import Markov
from scm_world.queries.experiments.paired import Paired, opened
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.progress import Progress
from scm_world.queries.verification import Verification, edge_reports
from scm_world.tasks import Task
from scm_world.world import Simulation

MOST = 200
"""Largest number of probe states in which declared edges are looked for."""

QUIET = 10
"""After how many probe states without a new edge the search ends, of a generated graph."""

HELD_OUT = 8
"""In how many further probe states of another seed effects without an edge are looked for."""

OTHER = 1_000_003
"""What is added to the seed for these."""


def verify(
    system: Simulation | SCM | Task | str,
    *,
    probes: int = MOST,
    held_out: int = HELD_OUT,
    seed: int = 0,
    progress: Progress | None = None,
    found: Callable[[set[EdgeKey]], object] | None = None,
    **options: Any,
) -> Verification:
    """Check a declared graph against the physics or the equations that realise it.

    Two tests are made. Each declared edge has to change its child when its cause is changed and
    everything else is kept. And with its parents held, changing everything else together has to
    leave each variable as it is, bit for bit.

    Edges are looked for in one probe state after another, until each was observed. Effects without
    an edge are looked for in further states, which are held out: of another seed, half of them
    with other parameters, where random actions lead, anywhere that is feasible, and where bodies
    touch. It may be interrupted (Ctrl-C); the report then covers the probe states that were
    finished.

    A graph that was generated from a model says what can act on what; some of its edges may never
    show, and stay unseen. So its search ends when nothing new is seen any more.

    A causal model without a backend is its own physics: each mechanism is evaluated with one
    parent changed, and with everything but its parents changed.

    Args:
        system: A world, a causal model, a task, the name of one, or a model file.
        probes: How many states to look for edges in at most.
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
        UnknownOption: ``probes`` is not a positive whole number, ``held_out`` is not a whole
            number, there are options for a world that is made, or a name does not exist.

    Example:
        >>> found = verify("reaching", backend="fake", probes=1, held_out=0)
        >>> found.floor, found.undeclared, found.outcome  # without physics nothing moves
        (0.0, (), 'not refuted')
    """
    whole_number("number of probes", probes, least=1)
    whole_number("number of held-out probes", held_out, least=0)
    with opened(system, options) as there:
        started, paired = time.perf_counter(), Paired(there, seed)
        model, world = paired.model, there if isinstance(there, Simulation) else None
        markov = None if world is None else Markov(paired)
        generated = world is not None and world.task.generated_graph
        declared = {edge.key for edge in model.edges}
        missing, after = set(declared), dict[EdgeKey, int]()
        effects, done, searched, interrupted = Effects(exact=generated), 0, 0, False
        search = probe_states(there, probes, seed)
        others = probe_states(there, held_out, seed + OTHER, scenarios=False)
        try:
            for held, states in ((False, search), (True, others)):
                for probe in states:
                    one = paired.run(done, probe, missing)
                    if held and markov is not None and not one.unstable:
                        markov.run(one)
                    effects.add(one)
                    done, searched = done + 1, searched + (not held)
                    now = effects.edges(declared)
                    after.update(dict.fromkeys(missing & now, done))
                    missing -= now
                    quiet = generated and done - max(after.values(), default=0) >= QUIET
                    last = not held and (quiet or not missing)
                    if found is not None:
                        found(now)
                    if progress is not None:
                        progress(done, held_out + (searched if held or last else probes))
                    if last:
                        break
        except KeyboardInterrupt:
            if not done:
                raise
            interrupted = True
        reason = partial(_reason, world, effects, effects.edges(declared))
        return Verification.of(
            there,
            effects,
            edge_reports(model, effects, after, reason),
            seed=seed,
            generated=generated,
            probes=searched,
            held_out=done - searched,
            planned=probes,
            interrupted=interrupted,
            seconds=time.perf_counter() - started,
        )


def _reason(world: Simulation | None, effects: Effects, observed: set[EdgeKey], edge: Edge) -> str:
    """Say why an edge was not seen, as far as the experiments tell."""
    cause, states = edge.cause, effects.changed[edge.cause]
    if not states:
        refused = ": every other value that was tried was refused" * (cause in effects.refused)
        return f"no probe state had another value of {cause}{refused}"
    if edge.when == "contact":
        body = cause.partition(".")[0]
        known = world is not None and body in getattr(world.structure, "bodies", ())
        if not effects.touched:
            return "nothing touched in any probe state"
        if known and body not in effects.touched:
            return f"{body} touched nothing in any probe state"
    acted = {name for name, _, lag in observed if lag}
    for action in () if world is None else world.compiled.actions:
        if action.partition(".")[0] == cause.partition(".")[0] and action not in acted:
            return f"no command of {action} acted: each was cut to a limit, or drives nothing"
    beyond = " beyond rounding and noise" * (effects.largest.get(edge.key, 0.0) > 0.0)
    return f"no difference{beyond}, though {cause} was changed in {states} of the probe states"
