"""Rows from a structural causal model without an engine."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.discovery.data.dataset import Bools, Column, Dataset, Regime, columns_of
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.recorded import reached
from scm_world.discovery.data.sources import FORMAT, Part, Tell
from scm_world.errors import ModelError
from scm_world.graph import SCM, Moment, to_json
from scm_world.graph.structure import Edge
from scm_world.queries.experiments.versions import versions
from scm_world.variables import Noise


@final
class Model:
    """A model whose every variable is computed or drawn.

    All episodes are solved together, whatever is done in them: a target has its own value where
    it is left alone, and the value of the intervention elsewhere. Row i is that of
    ``model.do(regime(i).plan.at_start()).sample(1, seed=seed, first=i)``.

    Args:
        model: To draw from.
        design: What is done.
        seed: Of the noise.
        steps: Control steps of an episode, each of them a row; None where nothing is lagged.

    Raises:
        ModelError: The model has lagged edges and ``steps`` is None, or the interventions of the
            design together close a cycle.
        InterventionError: A target cannot be set to its values.
    """

    at_once = True
    uneven = False

    def __init__(self, model: SCM, design: Design, *, seed: int, steps: int | None) -> None:
        if steps is None and any(edge.lag for edge in model.edges):
            raise ModelError(["the model has lagged edges: say how many steps an episode has"])
        self._model, self._design, self._noise, self._steps = model, design, Noise(seed), steps
        self._done = {name: model.do({name: act}) for name, act in design.acts.items()}
        self._targets = tuple(model.target(name) for name in design.targets)
        self._order = _order(model, self._done)
        self.columns: tuple[Column, ...] = tuple(c for v in model.variables for c in columns_of(v))
        self.edges: tuple[Edge, ...] | None = model.edges
        self.about: dict[str, Any] = {
            "format": FORMAT,
            "system": "model",
            "model": _digest(model),
            "seed": seed,
            "steps": 1 if steps is None else steps,
            "design": design.as_dict(),
            "versions": versions(),
        }

    def part(self, numbers: range, tell: Tell) -> Part:
        """Draw some episodes."""
        chosen = self._design.chosen(self._noise.seed, numbers.start, len(numbers))
        instants: list[dict[str, Value]] = []
        for step in range(self._steps or 1):
            moment = Moment(self._noise, numbers.start, step, len(numbers))
            instants.append(self._solve(chosen, instants[-1] if instants else {}, moment))
        length, n = len(instants), len(numbers)
        names = [variable.name for variable in self._model.variables]
        rows = [
            np.concatenate([np.reshape(values[name], (n, -1)) for name in names], axis=1)
            for values in instants
        ]
        regimes, regime = self._regimes(chosen)
        tell(n)
        return Part(
            Dataset(
                values=np.stack(rows, axis=1).reshape(n * length, -1).astype(np.float64),
                columns=self.columns,
                regimes=regimes,
                regime=np.repeat(regime, length),
                episode=np.repeat(np.arange(numbers.start, numbers.stop), length),
                step=np.tile(np.arange(length), n),
                about=self.about,
            )
        )

    def _regimes(self, chosen: Bools) -> tuple[tuple[Regime, ...], Any]:
        kinds, where = np.unique(chosen, axis=0, return_inverse=True)
        found = []
        for kind in kinds:
            regime = self._design.regime_of(kind)
            found.append(replace(regime, targets=reached(self._model, regime.targets)))
        return tuple(found), np.asarray(where, dtype=np.int64).reshape(len(chosen))

    def _solve(
        self, chosen: Bools, previous: Mapping[str, Value], moment: Moment
    ) -> dict[str, Value]:
        """Compute every variable of all episodes, shape (n, ...) each."""
        values: dict[str, Value] = {}
        for name in self._order:
            shape = (len(chosen), *self._model.declared(name).shape)

            def computed(model: SCM, name: str = name, shape: tuple[int, ...] = shape) -> Value:
                found = model.solve(values, previous=previous, moment=moment, only=(name,))[name]
                return np.broadcast_to(found, shape)

            value = computed(self._model)
            for column, target in enumerate(self._targets):
                if target == name:
                    done = computed(self._done[self._design.targets[column]])
                    here = chosen[:, column].reshape(-1, *(1,) * (len(shape) - 1))
                    value = np.where(here, done, value)
            values[name] = value
        return values


def _order(model: SCM, done: Mapping[str, SCM]) -> tuple[str, ...]:
    """Find an order in which everything can be computed, whatever is done.

    A draw from a space that follows other variables adds edges.
    """
    causes: dict[str, set[str]] = {name: set() for name in model}
    for mutilated in (model, *done.values()):
        for edge in mutilated.edges:
            if not edge.lag:
                causes[edge.effect].add(edge.cause)
    try:
        return tuple(TopologicalSorter(causes).static_order())
    except CycleError as error:
        cycle = " -> ".join(error.args[1])
        raise ModelError([f"the interventions of the design close a cycle: {cycle}"]) from None


def _digest(model: SCM) -> str | None:
    """Sum up a model; None where it cannot be written, since a function has no name."""
    try:
        return hashlib.sha256(to_json(model).encode()).hexdigest()
    except ModelError:
        return None
