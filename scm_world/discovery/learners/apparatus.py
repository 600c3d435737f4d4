"""What learners that do their own, paired experiments are handed: units that live again.

A unit is lived once as it is, and again with something moved and all else the same, noise
included. An experiment is one such life. The graph is not shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import ModelError
from scm_world.graph import SCM, Moment
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.models import paired_effects
from scm_world.variables import Box, Noise

SMALL = 1e-6  # of the size of a variable: so little that everything answers in proportion


class Apparatus(Protocol):
    """Paired experiments on a system.

    Attributes:
        names: Of all variables of the graph that is looked for.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """All variables of the graph that is looked for."""

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time, in one unit after another, with all others held.

        Args:
            budget: How many experiments there are; the last unit is finished even if it takes a
                few more.
        """


class Movable(Apparatus, Protocol):
    """An apparatus that can move several variables at once."""

    @property
    def lag(self) -> int:
        """How many control steps later the answers are read."""

    @property
    def causes(self) -> tuple[str, ...]:
        """What can be moved; each is one number."""

    @property
    def watched(self) -> tuple[str, ...]:
        """What answers; each is one number."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What one should know of what it does not show."""

    @property
    def used(self) -> int:
        """How many experiments there were."""

    def prepare(self, unit: int) -> None:
        """Let a unit live as it is: one experiment."""

    def answers(self, moves: Mapping[str, float]) -> Floats:
        """Let it live again with some causes moved: one experiment.

        Args:
            moves: How far each is moved, in its own size (1 for a variable without bounds).

        Returns:
            By how much what is watched differs, shape (len(watched),).
        """


@final
class Model:
    """Paired experiments in a causal model without physics, whose variables are numbers.

    All others are held while some are moved: what each mechanism makes of that is the answer. So
    answers are those of direct effects.

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
        self.notes = (f"edges of lag {self.lag} only, and there are others",) if others else ()
        self.names = tuple(model)
        self.causes = self.watched = self.names
        self.used = 0

    def effects(self, budget: int) -> Effects:
        """Move one variable at a time; see ``Apparatus``."""
        probes = max(1, budget // (len(self.names) + 2))
        return paired_effects(self._model, probes=probes, seed=self._seed)

    def prepare(self, unit: int) -> None:
        """Draw a unit: two instants of it.

        Raises:
            ModelError: A variable is a vector or not real, so that it cannot be moved a little.
        """
        still = [v.name for v in self._model.variables if v.shape or v.dtype != "real"]
        _refuse(still, "is not one real number, so it cannot be moved a little")
        noise = Noise(self._seed)
        self._before = self._model.solve(moment=Moment(noise, unit, 0))
        self._moment = Moment(noise, unit, 1)
        self._now = self._model.solve(previous=self._before, moment=self._moment)
        self._base = self._mechanisms(self._now, self._before)
        self.used += 1

    def answers(self, moves: Mapping[str, float]) -> Floats:
        """Say what every mechanism makes of a change of its causes."""
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
        """Compute what each mechanism says; 0 where there is none, whatever the value is."""
        found = (
            self._model.solve(now, previous=before, moment=self._moment, only=(name,))[name]
            if self._model[name].all_parents
            else 0.0
            for name in self.watched
        )
        return np.array([float(value) for value in found])


def _refuse(names: list[str], why: str) -> None:
    if names:
        raise ModelError([f"{name!r} {why}" for name in names])


__all__ = ["SMALL", "Apparatus", "Model", "Movable"]
