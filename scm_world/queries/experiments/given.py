"""Which declared edges act, and what noise moves together, at given parameters."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from typing import NamedTuple, final

from scm_world.backends.step import StepModel
from scm_world.errors import EngineFailure, InterventionError
from scm_world.graph import Edge
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes
from scm_world.world import Simulation

MOST = 60
"""Largest number of probe states."""

QUIET, FEW = 16, 4
"""Numbers of probe states without news that end the search for edges, and for effects of noise."""


@final
class Present(NamedTuple):
    """What experiments at given parameters found.

    Attributes:
        absent: Declared edges that never act there.
        touching: Declared edges that act there only while bodies touch.
        driven: The states that a noise of the control step moves, by its name, if they are several.
    """

    absent: frozenset[EdgeKey] = frozenset()
    touching: frozenset[EdgeKey] = frozenset()
    driven: Mapping[str, tuple[str, ...]] = {}

    def when(self, edge: Edge) -> str | None:
        """Return the condition under which an edge acts there."""
        return "contact" if edge.key in self.touching else edge.when


EVERYTHING = Present()
"""All declared edges act, and no noise is shared."""


def present(
    world: Simulation, begin: Callable[[int], object], seed: int, fixed: Collection[str]
) -> Present:
    """Find the edges between states, and from actions, that do not act at given parameters.

    A generated graph has all edges that are possible at any parameters, and the parents of a step
    function may act through a parameter that is zero. The experiments are those of ``verify``, in
    control steps in which nothing touches: in states all over their ranges, some at their ends, one
    variable at a time is changed. An edge is absent if its cause was changed and its effect never
    followed.

    Args:
        world: It is left in any state.
        begin: Begins an episode with the parameters of interest, by its number.
        seed: Seed of states and values.
        fixed: Variables whose changes would be without effect, since an intervention holds them.
    """
    model = world.model
    known = not getattr(world.structure, "staged", False)  # what touches in a control step
    by_contact = {edge.effect for edge in model.edges if known and edge.when == "contact"}
    paired = Paired(world, seed, apart=bool(by_contact))
    noisy = getattr(world.composition.commands, "noisy", ())
    moved, missing = dict.fromkeys(noisy, frozenset[str]()), set[EdgeKey]()
    causes = {*paired.states, *paired.actions} - {*fixed}
    if may_be_absent(world):
        missing = {
            edge.key
            for edge in model.edges
            if edge.cause in causes and edge.effect in paired.states and edge.lag and not edge.when
        }
    declared, effects, quiet = frozenset(missing), paired.effects(), 0
    states = probes(world, MOST if missing or moved else 0, seed, begin=begin)
    try:
        for number, probe in enumerate(states):
            unknown = len(missing) - sum(map(len, moved.values()))
            with suppress(InterventionError, EngineFailure):
                for noise, state, *_ in paired.driven(probe):
                    moved[noise] |= {state}
                if missing:
                    effects.add(paired.run(number, probe, missing))
            missing -= effects.edges(declared)
            quiet = 0 if len(missing) - sum(map(len, moved.values())) < unknown else quiet + 1
            if quiet == (QUIET if missing else FEW):
                break
    except (InterventionError, EngineFailure):  # no episode can begin so
        missing.clear()
    absent = {key for key in missing if effects.changed[key[0]] >= FEW}
    touching = {key for key in absent if key[1] in by_contact}
    shared = {noise: tuple(sorted(names)) for noise, names in moved.items() if len(names) > 1}
    return Present(frozenset(absent - touching), frozenset(touching), shared)


def may_be_absent(world: Simulation) -> bool:
    """Return whether declared edges may not act at some parameters, or at any."""
    return world.task.generated_graph or isinstance(world.structure, StepModel)
