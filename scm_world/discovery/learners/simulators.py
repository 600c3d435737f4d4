"""Paired simulators: what learners get that do their own, paired experiments.

A unit is run once as it is, and again with something moved and all else the same, noise included.
An experiment is one such run. The graph is not shown.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, Protocol, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.discovery.data.recorded import first_name
from scm_world.errors import InterventionError, ModelError
from scm_world.graph import SCM, NoiseKey
from scm_world.queries.experiments.effects import Effects, gap
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes
from scm_world.queries.outcomes import Outcome, read
from scm_world.queries.samples import Setting
from scm_world.queries.twins import twins_of
from scm_world.variables import Box, Exogenous, Noise
from scm_world.world import Simulation

SMALL = 1e-6  # of the size of a variable: so little that everything answers in proportion
MOST = 10_000  # probe states, where the budget is what counts
OTHER = 1_000_000
"""Units from here on lend their values to the others; none of them is a unit of the experiment."""


def paired_effects(
    system: Simulation | SCM, states: int, seed: int, budget: float = np.inf
) -> Effects:
    """Move one variable at a time, in one state or unit after another, as the budget allows."""
    paired = Paired(system, seed)
    effects = Effects(exact=paired.exact)
    for number, probe in enumerate(probes(system, states, seed)):
        effects.add(paired.run(number, probe))
        if effects.rollouts >= budget:
            break
    return effects


class PairedSimulator(Protocol):
    """Paired experiments on a system; ``names`` are all variables of its graph."""

    names: tuple[str, ...]

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time, in one unit after another, with all others held.

        Args:
            budget: How many experiments there are; the last unit is finished even if it takes a
                few more.
        """


@final
class SCMSimulator:
    """Paired experiments in a causal model without physics, whose variables are numbers.

    It can move several together. All others are held while some are moved: answers are those of
    direct effects.

    Attributes:
        lag: How many control steps later the answers are read.
        causes: What can be moved.
        watched: What answers.
        notes: What it does not show.
        used: How many experiments there were.

    Args:
        model: All its variables can be set.
        seed: Of the units.
        lag: Whether what is moved is moved at the same instant (0) or one control step before (1);
            what the model has if None. 1 if it has both.

    Raises:
        ModelError: A variable cannot be set.
    """

    def __init__(self, model: SCM, seed: int = 0, *, lag: int | None = None) -> None:
        _refuse([v.name for v in model.variables if not v.settable], "cannot be set")
        self._model, self._seed = model, seed
        lags = {edge.lag for edge in model.edges}
        self.lag = max(lags, default=0) if lag is None else lag
        others = lags - {self.lag}
        self.notes: tuple[str, ...] = ()
        if others:
            self.notes = (f"edges of lag {self.lag} only, and there are others",)
        self.names = tuple(model)
        self.causes = self.watched = self.names
        self.used = 0

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``PairedSimulator``."""
        units = max(1, budget // (len(self.names) + 2))
        return paired_effects(self._model, units, self._seed)

    def prepare(self, unit: int) -> None:
        """Draw a unit, two instants of it, and run it as it is: one experiment.

        Raises:
            ModelError: A variable is a vector or not real, so that it cannot be moved a little.
        """
        still = [v.name for v in self._model.variables if v.shape or v.dtype != "real"]
        _refuse(still, "is not one real number, so it cannot be moved a little")
        noise = Noise(self._seed)
        self._before = self._model.solve(key=NoiseKey(noise, unit, 0))
        self._key = NoiseKey(noise, unit, 1)
        self._now = self._model.solve(previous=self._before, key=self._key)
        self._base = self._mechanisms(self._now, self._before)
        self.used += 1

    def answers(self, moves: Mapping[str, float]) -> Floats:
        """Run the unit again with some causes moved: one experiment.

        Args:
            moves: How far each is moved, in its own size (1 for a variable without bounds).

        Returns:
            By how much each mechanism gives something else, shape (len(watched),).
        """
        source = self._before if self.lag else self._now
        moved = {
            **source,
            **{n: source[n] + by * self._size(n, source) for n, by in moves.items()},
        }
        self.used += 1
        if self.lag:
            return self._mechanisms(self._now, moved) - self._base
        return self._mechanisms(moved, self._before) - self._base

    def _size(self, name: str, values: Values) -> Value:
        bounds = self._model[name].bounds
        if not isinstance(bounds, Box):
            return np.ones(())
        low, high = bounds.bounds((), values)
        return np.asarray(np.where(np.isfinite(high - low), high - low, 1.0))

    def _mechanisms(self, now: Values, before: Values) -> Floats:
        """Compute each mechanism; 0 where there is none."""
        found = (
            self._model.solve(now, previous=before, key=self._key, only=(name,))[name]
            if self._model[name].all_parents
            else 0.0
            for name in self.watched
        )
        return np.array([float(value) for value in found])


def _refuse(names: list[str], why: str) -> None:
    if names:
        raise ModelError([f"{name!r} {why}" for name in names])


@final
class StepSimulator:
    """Paired experiments on one control step of a world, in one state after another.

    Args:
        world: It is reset; its task and options stay.
        seed: Of states and values.
    """

    def __init__(self, world: Simulation, seed: int = 0) -> None:
        self._world, self._seed = world, seed
        self.names = tuple(world.model)

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``PairedSimulator``."""
        return paired_effects(self._world, MOST, self._seed, budget)


@final
class EpisodeSimulator:
    """Paired experiments on whole episodes: what they begin with, and what they end with.

    A unit is an episode. It is run again, with the same noise, while one cause has the value that
    it has in another unit. What else begins differently then is an effect; it is held while the
    rest is looked at, so that effects are direct.

    Args:
        world: Is not touched.
        causes: Parameters, and states at the beginning; they can be set.
        outcomes: What episodes end with.
        settings: Who acts, what varies by itself, how long, and the seed: the first one for the
            first unit, and so on, in turn.
    """

    def __init__(
        self,
        world: Simulation,
        causes: Sequence[str],
        outcomes: Iterable[Outcome],
        settings: Sequence[Setting],
    ) -> None:
        self._world, self._twins, self._settings = world, twins_of(world), tuple(settings)
        self._causes, self._outcomes = tuple(causes), tuple(outcomes)
        self._target = {n: world.model.target(n) for n in self._causes}
        declared = world.model.declared
        self._drawn = tuple(n for n in self._causes if isinstance(declared(n), Exogenous))
        self._read = tuple(dict.fromkeys((*self._causes, *self._target.values())))
        self._named = {n: first_name(world.model, n) for n in self._causes}
        ends = (str(outcome).removeprefix("final ") for outcome in self._outcomes)
        self.names = (*self._named.values(), *ends)

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``PairedSimulator``."""
        found = Effects()
        for unit in count():
            self._unit(unit, found)
            if found.rollouts >= budget:
                return found
        return found

    def _unit(self, unit: int, found: Effects) -> None:
        begin, end = self._begun(unit, {}, found), self._ended(unit, {}, found)
        for what, again in zip(end, self._ended(unit, {}, found), strict=True):
            found.see_unstable("", float(np.max(np.abs(again - what), initial=0.0)))
        others = self._begun(OTHER + unit, {}, found)
        for cause in self._causes:
            try:
                self._moved(unit, cause, others[cause], begin, end, found)
            except InterventionError:
                found.refused[cause] += 1

    def _moved(
        self,
        unit: int,
        cause: str,
        value: Value,
        begin: Mapping[str, Value],
        end: Sequence[Value],
        found: Effects,
    ) -> None:
        """Give a cause another value, and record what follows.

        What the unit drew is set to what it drew, so that nothing is drawn again where the other
        value makes a draw infeasible.
        """
        drawn = self._held(begin, (name for name in self._drawn if name != cause))
        do: dict[str, Any] = {**drawn, cause: value}
        then = self._begun(unit, do, found)
        follow = [n for n in self._causes if n != cause and not np.array_equal(then[n], begin[n])]
        for name in follow:
            held = self._held(begin, [other for other in follow if other != name])
            there = self._begun(unit, {**do, **held}, found) if held else then
            key = self._named[cause], self._named[name], 0
            found.see(key, gap(there[name], begin[name]))
        held = self._held(begin, (name for name in self._causes if name != cause))
        after = self._ended(unit, {**held, cause: value}, found)
        last = self.names[len(self._causes) :]
        for name, now, before in zip(last, after, end, strict=True):
            found.see((self._named[cause], name, 0), gap(now, before))

    def _begun(self, unit: int, do: Mapping[str, Any], found: Effects) -> dict[str, Value]:
        found.rollouts += 1
        short = replace(self._settings[unit % len(self._settings)], steps=1)
        episode = short.episode(self._twins, self._world, do, unit, self._read)
        return {name: np.array(episode[name][0]) for name in self._read}

    def _held(self, begin: Mapping[str, Value], names: Iterable[str]) -> dict[str, Any]:
        """Hold causes at what they were: the quantity itself, not its rounded coordinates."""
        return {self._target[name]: begin[self._target[name]] for name in names}

    def _ended(self, unit: int, do: Mapping[str, Any], found: Effects) -> list[Value]:
        found.rollouts += 1
        names = tuple(outcome.name for outcome in self._outcomes)
        setting = self._settings[unit % len(self._settings)]
        episode = setting.episode(self._twins, self._world, do, unit, names)
        return [read(outcome, episode) for outcome in self._outcomes]
