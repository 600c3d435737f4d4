"""The learner ``paired``, and the paired simulators on which it experiments.

A unit is run once unchanged, and again with one variable moved and all else equal, noise included.
An experiment is one such run. The graph is not shown.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Value
from scm_world.discovery.data.recorded import first_name
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import InterventionError, ModelError
from scm_world.graph import SCM
from scm_world.queries.episodes import Episode
from scm_world.queries.equations import as_given
from scm_world.queries.experiments.effects import Effects, gap
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes, rounds_at
from scm_world.queries.samples import Outcome, Setting, read
from scm_world.queries.twins import twins_of
from scm_world.world import Simulation

MOST = 10_000  # probe states, where the budget is what counts
OTHER = 1_000_000
"""Units from here on lend their values to the others; none of them is a unit of the experiment."""


class PairedSimulator(Protocol):
    """Paired experiments on a system; ``names`` are all variables of its graph."""

    names: tuple[str, ...]

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time, in one unit after another, with all others held.

        Args:
            budget: How many experiments there are; the last unit is finished even if it takes a
                few more.
        """


def paired(simulator: PairedSimulator, *, seed: int = 0, budget: int = 1000) -> EstimatedGraph:
    """Find a graph with the simulator, an oracle: one variable moves, all noise is the same.

    Args:
        simulator: Does the experiments.
        seed: Not used: the simulator has its own.
        budget: How many experiments there are.

    Returns:
        A graph; ``edge_scores`` are the largest effects over the threshold, in powers of ten.
    """
    del seed
    effects = simulator.effects(whole_number("budget", budget, least=1))
    names = simulator.names
    at = {name: i for i, name in enumerate(names)}
    lags = 1 + max((lag for *_, lag in effects.largest), default=0)
    ratio = np.zeros((lags, len(names), len(names)))
    for cause, effect, lag in effects.largest:
        if cause in at:  # not the noise of a variable
            ratio[lag, at[cause], at[effect]] = effects.ratio((cause, effect, lag))
    return EstimatedGraph.of(
        names,
        ratio > 1.0,
        edge_scores=np.log10(1.0 + ratio),
        experiments=effects.rollouts,
        bound=len(names),  # each is a cause of its own; edges between instants may form cycles
        notes=(f"floor {effects.floor:g}",),
    )


@final
class SystemSimulator:
    """Paired experiments on single instants of a world, or of a causal model without physics.

    Args:
        system: The world, which is not changed, or the model; all variables of this can be set.
        seed: Of states and values.

    Raises:
        ModelError: A variable of the model cannot be set.
    """

    def __init__(self, system: Simulation | SCM, seed: int = 0) -> None:
        self._system, self._seed = (system := as_given(system)), seed
        self.names = tuple(system if isinstance(system, SCM) else system.model)
        if isinstance(system, SCM):
            still = [v.name for v in system.variables if not v.settable]
            if still:
                raise ModelError([f"{name!r} cannot be set" for name in still])

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``PairedSimulator``."""
        system, states, most = self._system, MOST, float(budget)
        if isinstance(system, SCM):  # each unit costs about one experiment for each variable
            states, most = max(1, budget // (len(self.names) + 2)), np.inf
        experiments = Paired(system, self._seed)
        effects = experiments.effects()
        for number, probe in enumerate(probes(system, states, self._seed)):
            effects.add(experiments.run(number, probe))
            if effects.rollouts >= most:
                break
        return effects


@final
class EpisodeSimulator:
    """Paired experiments on whole episodes: their starts and their ends.

    A unit is an episode. It is run again, with the same noise, while one cause has the value that
    it has in another unit. All else that begins differently then is an effect. It is held while
    the others are examined, so that effects are direct.

    Args:
        world: Is not touched.
        causes: Parameters, and states at the beginning; they can be set.
        outcomes: The outcomes of an episode.
        settings: Policy, context distribution, length and seed: the first setting for the first
            unit, and so on, in turn.
    """

    def __init__(
        self,
        world: Simulation,
        causes: Sequence[str],
        outcomes: Iterable[Outcome],
        settings: Sequence[Setting],
    ) -> None:
        world.require_exact("a paired experiment on episodes", independent=True)
        self._world, self._twins, self._settings = world, twins_of(world), tuple(settings)
        self._causes, self._outcomes = tuple(causes), tuple(outcomes)
        self._target = {n: world.model.target(n) for n in self._causes}
        declared = world.model.declared
        self._drawn = tuple(n for n in self._causes if declared(n).is_root)
        self._read = tuple(dict.fromkeys((*self._causes, *self._target.values())))
        self._named = {n: first_name(world.model, n) for n in self._causes}
        ends = (str(outcome).removeprefix("final ") for outcome in self._outcomes)
        self.names = (*self._named.values(), *ends)

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``PairedSimulator``.

        The draws of a unit are set to their values, so that nothing is drawn again where the other
        value of a cause makes a draw infeasible. Causes are held as the quantity itself, not as its
        rounded coordinates.
        """
        found, unit = Effects(least=rounds_at(self._world)), 0
        outcomes, causes, named = self._outcomes, self._causes, self._named

        def run(
            number: int, do: Mapping[str, Any], names: Iterable[str], steps: int | None = None
        ) -> Episode:
            found.rollouts += 1
            setting = self._settings[number % len(self._settings)]
            setting = setting if steps is None else replace(setting, steps=steps)
            return self._twins.episode(setting.unit(self._world, do, number, names))

        def begun(number: int, do: Mapping[str, Any]) -> dict[str, Value]:
            episode = run(number, do, self._read, steps=1)
            return {name: np.array(episode[name][0]) for name in self._read}

        def ended(do: Mapping[str, Any]) -> list[Value]:
            episode = run(unit, do, [outcome.name for outcome in outcomes])
            return [read(outcome, episode) for outcome in outcomes]

        while found.rollouts < budget:
            begin = begun(unit, {})
            end, again = ended({}), ended({})
            ends = self.names[len(causes) :]
            for name, one, other in zip(ends, end, again, strict=True):
                found.see_unstable(name, gap(other, one))
            lent = begun(OTHER + unit, {})
            held = {name: {self._target[name]: begin[self._target[name]]} for name in causes}

            def hold(
                names: Iterable[str], held: Mapping[str, dict[str, Value]] = held
            ) -> dict[str, Value]:
                return {k: value for name in names for k, value in held[name].items()}

            for cause in causes:
                try:
                    do = {**hold(n for n in self._drawn if n != cause), cause: lent[cause]}
                    then = begun(unit, do)
                    follow = [
                        n for n in causes if n != cause and not np.array_equal(then[n], begin[n])
                    ]
                    for name in follow:
                        more = hold(other for other in follow if other != name)
                        there = begun(unit, {**do, **more}) if more else then
                        found.see((named[cause], named[name], 0), there[name], begin[name])
                    others = hold(name for name in causes if name != cause)
                    after = ended({**others, cause: lent[cause]})
                except InterventionError:
                    found.refused[cause] += 1
                    continue
                for name, now, before in zip(ends, after, end, strict=True):
                    found.see((named[cause], name, 0), now, before)
            unit += 1
        return found
