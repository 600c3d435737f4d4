"""Paired experiments on worlds: on one control step, and on what episodes end with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.discovery.data.recorded import first_label
from scm_world.errors import InterventionError
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes
from scm_world.queries.experiments.series import Series
from scm_world.queries.outcomes import Outcome, read
from scm_world.queries.progress import Progress
from scm_world.queries.samples import Setting
from scm_world.queries.stages import stage_of
from scm_world.variables import Exogenous
from scm_world.world import World

MOST = 10_000  # probe states, where the budget is what counts
OTHER = 1_000_000
"""Units from here on lend their values to the others; none of them is a unit of the experiment."""


@final
class Steps:
    """Paired experiments on one control step of a world, in one state after another.

    They find the whole graph, with what acts within an instant: see ``discover``.

    Args:
        world: It is reset; its task and options stay.
        seed: Of states and values.
        progress: Told after each state how many experiments there were, and the budget.
    """

    def __init__(self, world: World, seed: int = 0, *, progress: Progress | None = None) -> None:
        self._world, self._seed, self._progress = world, seed, progress
        self.names = tuple(world.model)

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``Apparatus``."""
        series = Series(Paired(self._world, self._seed), MOST)

        def enough(effects: Effects, _: int) -> bool:
            if self._progress is not None:
                self._progress(min(effects.rollouts, budget), budget)
            return effects.rollouts >= budget

        series.run(probes(self._world, MOST, self._seed), enough)
        return series.effects


@final
class Outcomes:
    """Paired experiments on whole episodes: what they begin with, and what they end with.

    A unit is an episode. It lives again, with the same noise, while one cause has the value that
    it has in another unit. What else begins differently then is an effect; it is held while the
    rest is looked at, so that effects are direct.

    Args:
        world: Is not touched.
        causes: Parameters, and states at the beginning; they can be set.
        outcomes: What episodes end with.
        settings: Who acts, what varies by itself, how long, and the seed: the first one for the
            first unit, and so on, in turn.
        progress: Told after each unit how many experiments there were, and the budget.
    """

    def __init__(
        self,
        world: World,
        causes: Sequence[str],
        outcomes: Iterable[Outcome],
        settings: Sequence[Setting],
        *,
        progress: Progress | None = None,
    ) -> None:
        self._world, self._stage, self._settings = world, stage_of(world), tuple(settings)
        self._causes, self._outcomes = tuple(causes), tuple(outcomes)
        self._progress = progress
        self._target = {n: world.model.target(n) for n in self._causes}
        declared = world.model.declared
        self._drawn = tuple(n for n in self._causes if isinstance(declared(n), Exogenous))
        self._read = tuple(dict.fromkeys((*self._causes, *self._target.values())))
        self._named = {n: f"{first_label(world.model, n)} {n}".strip() for n in self._causes}
        ends = (str(outcome).removeprefix("final ") for outcome in self._outcomes)
        self.names = (*self._named.values(), *ends)

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``Apparatus``."""
        found = Effects()
        for unit in count():
            self._unit(unit, found)
            if self._progress is not None:
                self._progress(min(found.rollouts, budget), budget)
            if found.rollouts >= budget:
                return found
        return found

    def _unit(self, unit: int, found: Effects) -> None:
        """Do all experiments on one unit."""
        begin, end = self._begun(unit, {}, found), self._lived(unit, {}, found)
        for what, again in zip(end, self._lived(unit, {}, found), strict=True):
            found.floor = max(found.floor, float(np.max(np.abs(again - what), initial=0.0)))
        others = self._begun(OTHER + unit, {}, found)
        for cause in self._causes:
            try:
                self._moved(unit, cause, others[cause], begin, end, found)
            except InterventionError:
                found.refused[cause] = found.refused.get(cause, 0) + 1

    def _moved(
        self,
        unit: int,
        cause: str,
        value: Value,
        begin: Mapping[str, Value],
        end: Sequence[Value],
        found: Effects,
    ) -> None:
        """Give a cause another value, and see what follows.

        What the unit drew is set to what it drew, so that nothing is drawn anew where the other
        value makes a draw infeasible.
        """
        drawn = self._held(begin, (name for name in self._drawn if name != cause))
        do: dict[str, Any] = {**drawn, cause: value}
        then = self._begun(unit, do, found)
        follow = [n for n in self._causes if n != cause and not np.array_equal(then[n], begin[n])]
        for name in follow:
            held = self._held(begin, [other for other in follow if other != name])
            there = self._begun(unit, {**do, **held}, found) if held else then
            found.see(self._named[cause], self._named[name], 0, there[name], begin[name])
        held = self._held(begin, (name for name in self._causes if name != cause))
        after = self._lived(unit, {**held, cause: value}, found)
        last = self.names[len(self._causes) :]
        for name, now, before in zip(last, after, end, strict=True):
            found.see(self._named[cause], name, 0, now, before)

    def _setting_of(self, unit: int) -> Setting:
        return self._settings[unit % len(self._settings)]

    def _begun(self, unit: int, do: Mapping[str, Any], found: Effects) -> dict[str, Value]:
        """Begin an episode, and look at what it begins with."""
        found.rollouts += 1
        short = replace(self._setting_of(unit), steps=1)
        episode = short.episode(self._stage, self._world, do, unit, self._read)
        return {name: np.array(episode[name][0]) for name in self._read}

    def _held(self, begin: Mapping[str, Value], names: Iterable[str]) -> dict[str, Any]:
        """Hold causes at what they were: the quantity itself, not its rounded coordinates."""
        return {self._target[name]: begin[self._target[name]] for name in names}

    def _lived(self, unit: int, do: Mapping[str, Any], found: Effects) -> list[Value]:
        """Live an episode, and look at what it ends with."""
        found.rollouts += 1
        names = tuple(outcome.name for outcome in self._outcomes)
        episode = self._setting_of(unit).episode(self._stage, self._world, do, unit, names)
        return [read(outcome, episode) for outcome in self._outcomes]


__all__ = ["Outcomes", "Steps"]
