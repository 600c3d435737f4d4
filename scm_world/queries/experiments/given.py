"""Which declared edges act, and what noise moves together, at given parameters."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from typing import NamedTuple, final

import numpy as np

from scm_world.backends.step import StepModel
from scm_world.errors import EngineFailure, InterventionError
from scm_world.graph import Edge
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import GIVEN, probes
from scm_world.variables import Box, Variable
from scm_world.world import Simulation

MOST, MOST_STEPS = 60, 1_000
"""Largest numbers of probe states, and of control steps in the search."""

ENOUGH, ENOUGH_OF_STEPS = 8, 32
"""Numbers of experiments without an effect after which an edge is absent.

The larger one is for step functions, which may have thresholds.
"""

FEW = 4
"""Number of experiments on noise."""


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
    function may act through a parameter that is zero. The experiments are those of ``verify``: one
    variable at a time is changed, in states all over their ranges, while no chain of contacts joins
    cause and effect. An edge is absent if its cause was changed often and nothing ever followed.

    Args:
        world: It is left in any state.
        begin: Begins an episode with the parameters of interest, by its number.
        seed: Seed of states and values.
        fixed: Variables whose changes would be without effect, since an intervention holds them.
    """
    model, searched = world.model, may_be_absent(world)
    by_contact = {edge.effect for edge in model.edges if searched and edge.when == "contact"}
    paired, missing = Paired(world, seed, apart=bool(by_contact)), set[EdgeKey]()
    causes, enough = {*paired.states, *paired.actions} - {*fixed}, ENOUGH_OF_STEPS
    if not isinstance(world.structure, StepModel):  # at the ends of joints, forces begin
        enough = ENOUGH
        causes -= {v.name for v in model.variables if v.name in paired.states and has_ends(v)}
    if searched:
        missing = {
            edge.key
            for edge in model.edges
            if edge.cause in causes and edge.effect in paired.states and edge.lag and not edge.when
        }
    noisy = getattr(world.composition.commands, "noisy", ())
    moved, declared = dict.fromkeys(noisy, frozenset[str]()), frozenset(missing)
    effects, most = paired.effects(), MOST if missing else FEW * bool(noisy)
    states = probes(world, most, seed, begin=begin, kinds=GIVEN if missing else ("start",))
    with suppress(InterventionError, EngineFailure):  # no episode can begin so
        for number, probe in enumerate(states):
            rest = {key for key in missing if paired.tested[key] < enough}
            if (not rest and number >= FEW) or effects.rollouts > MOST_STEPS:
                break
            with suppress(InterventionError, EngineFailure):
                if missing:
                    effects.add(paired.run(number, probe, rest))
                joined = paired.joins(paired.touched)
                for noise, state, *_ in paired.driven(probe):
                    moved[noise] |= {state} if not joined(noise, state) else set()
            missing -= effects.edges(declared)
    absent = {key for key in missing if paired.tested[key] >= enough}
    touching = {key for key in absent if key[1] in by_contact}
    shared = {noise: tuple(sorted(names)) for noise, names in moved.items() if len(names) > 1}
    return Present(frozenset(absent - touching), frozenset(touching), shared)


def has_ends(variable: Variable) -> bool:
    """Return whether the range of a variable has an end."""
    if not isinstance(variable.bounds, Box):
        return False
    return bool(np.isfinite(variable.bounds.bounds(variable.shape, {})).any())


def may_be_absent(world: Simulation) -> bool:
    """Return whether declared edges may not act at some parameters, or at any."""
    return world.task.generated_graph or isinstance(world.structure, StepModel)
