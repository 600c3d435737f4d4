"""Rows from a world: an engine moves it, and sensors measure it."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Column, Dataset, Regime
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.recorded import (
    Ends,
    Instants,
    default_causes,
    default_outcomes,
    names_of,
    settable,
)
from scm_world.discovery.data.sensors import Sensors
from scm_world.discovery.data.sources import FORMAT, SourceRows, Tell, plain_options, policy_name
from scm_world.errors import InterventionError, UnknownOption
from scm_world.graph.structure import Edge
from scm_world.queries.episodes import episode_of
from scm_world.queries.experiments.versions import versions
from scm_world.queries.outcomes import Outcome, as_outcome
from scm_world.queries.parallel import Result, run_units
from scm_world.queries.plans import Plan
from scm_world.queries.rollouts import Unit
from scm_world.queries.samples import Setting
from scm_world.queries.twins import twins_of
from scm_world.world import World
from scm_world.world.plan import merged


@final
class WorldSource:
    """Episodes of a world, under a design.

    Args:
        world: Is not touched; what is given to it holds in every episode.
        design: What is done at the beginning.
        causes: Patterns of the parameters to write down; ``default_causes`` if None. The targets
            of the design are among them.
        outcomes: Names of variables or ``Outcome``; ``default_outcomes`` if None.
        every_step: One row for each control step in place of one for each episode.
        setting: Who acts, what varies by itself, how long, and the seed.

    Raises:
        InterventionError: A target, or what varies, cannot be set to its values.
        UnknownVariable: No variable has this name.
        UnknownOption: An outcome is a function, sums up an episode with ``every_step``, or is
            written down as a cause already.
    """

    at_once = False
    uneven = False

    def __init__(
        self,
        world: World,
        design: Design,
        *,
        causes: Iterable[str] | None,
        outcomes: Iterable[Any] | None,
        every_step: bool,
        setting: Setting,
    ) -> None:
        self._world, self._twins, self._design = world, twins_of(world), design
        self._setting, self._given = setting, getattr(world, "plan", Plan())
        for name, act in (*design.acts.items(), *Plan(setting.nature).acts()):
            world.model.accept(name, act)
        chosen = default_causes(world) if causes is None else settable(world, causes)
        varied = tuple(dict.fromkeys((*chosen, *design.targets)))
        wanted = default_outcomes(world, every_step=every_step) if outcomes is None else outcomes
        measured = _outcomes(wanted)
        self._rows: Ends | Instants = (
            Instants(world, (*varied, *names_of(measured)))
            if every_step
            else Ends(world, varied, measured)
        )
        self.columns: tuple[Column, ...] = self._rows.columns
        _refuse_twice(self.columns)
        self._sensors = Sensors(world, self._rows.watched)
        self.edges: tuple[Edge, ...] | None = world.model.edges
        self.about: dict[str, Any] = self._about()

    def __getstate__(self) -> dict[str, Any]:
        """Go elsewhere, where workers share the cores: an engine has one thread there."""
        setting = replace(self._setting, workers=self._setting.workers or 1)
        return {**self.__dict__, "_setting": setting}

    def _about(self) -> dict[str, Any]:
        setting = self._setting
        return {
            "format": FORMAT,
            "system": self._world.task.name,
            "arguments": {n: str(v) for n, v in sorted(self._world.task.given.items())},
            "options": plain_options(self._twins.options),
            "given": self._given.as_dict()["do"],
            "seed": setting.seed,
            "steps": setting.steps,
            "policy": policy_name(setting.policy),
            "nature": Plan(setting.nature).as_dict()["do"],
            "design": self._design.as_dict(),
            "engine": self._world.backend.name,
            "versions": versions(self._world.engine),
        }

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Let some episodes happen; those that are refused are left out."""
        chosen = self._design.chosen(self._setting.seed, numbers.start, len(numbers))
        regimes = [self._design.regime_of(kind) for kind in chosen]
        lock = threading.Lock()

        def finish(place: int, result: Result) -> Floats | str:
            found: Floats | str
            if isinstance(result, InterventionError):
                found = str(result)
            elif isinstance(result, Exception):
                raise result
            else:
                episode = episode_of(self._twins, units[place], result)
                found = self._rows.rows(episode, self._sensors)
            with lock:
                tell(1)
            return found

        units = [self._unit(n, regime) for n, regime in zip(numbers, regimes, strict=True)]
        found = run_units(self._twins, units, finish, self._setting.workers)
        return self._part(list(zip(numbers, regimes, found, strict=True)))

    def _unit(self, number: int, regime: Regime) -> Unit:
        given = Plan(merged(self._world.model, self._given, regime.plan))
        plan = self._setting.plan(self._world, given)
        return self._setting.unit(self._world, plan, number, self._written)

    def _part(self, found: Sequence[tuple[int, Regime, Floats | str]]) -> SourceRows:
        """Tell rows from refusals."""
        rows = [(number, done, rows) for number, done, rows in found if not isinstance(rows, str)]
        refused = tuple((number, why) for number, _, why in found if isinstance(why, str))
        return SourceRows(self._table(rows), refused)

    @property
    def _written(self) -> tuple[str, ...]:
        """Name what has to be written down on the way: the rest is kept anyway."""
        kept = {*self._world.compiled.slices, *self._world.static_names}
        return tuple(name for name in self._rows.watched if name not in kept)

    def _table(self, found: Sequence[tuple[int, Regime, Floats]]) -> Dataset:
        numbered: dict[Regime, int] = {}
        regime, episode, step = [], [], []
        for number, done, rows in found:
            for index in range(len(rows)):
                targets = self._rows.targets(done.targets, index)
                at = numbered.setdefault(replace(done, targets=targets), len(numbered))
                regime.append(at)
                episode.append(number)
                step.append(index)
        parts = [rows for _, _, rows in found]
        return Dataset(
            values=np.concatenate([np.empty((0, len(self.columns))), *parts]),
            columns=self.columns,
            regimes=tuple(numbered),
            regime=np.array(regime, dtype=np.int64),
            episode=np.array(episode, dtype=np.int64),
            step=np.array(step, dtype=np.int64),
            about=self.about,
        )


def _refuse_twice(columns: Sequence[Column]) -> None:
    """Refuse two columns with one name, before episodes happen for them."""
    names = [column.name for column in columns]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        allowed = ("what is no cause: those have a column already",)
        raise UnknownOption("outcomes", ", ".join(twice), allowed)


def _outcomes(given: Iterable[Any]) -> tuple[Outcome, ...]:
    several = (given,) if isinstance(given, str | Outcome) else given
    found = tuple(dict.fromkeys(as_outcome(outcome) for outcome in several))
    for outcome in found:
        if not isinstance(outcome, Outcome):
            allowed = ("the name of a variable", "Outcome(name, how)")
            raise UnknownOption("outcome of a dataset", outcome, allowed)
    return found
