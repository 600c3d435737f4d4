"""Paired experiments in a model without physics."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from scm_world._types import Value, Values
from scm_world.graph import SCM, NoiseKey
from scm_world.graph.evaluate import earlier
from scm_world.queries.equations import Layout
from scm_world.queries.experiments.effects import Effects, ProbeSetting, gap
from scm_world.queries.experiments.noise import shared_noise
from scm_world.variables import Box, Categories, Integers, Noise, Variable


@final
class PairedEquations:
    """Paired experiments with a structural causal model.

    From a drawn unit, one variable at a time is set to another value while every other variable
    keeps its old one; what a mechanism then says differently is a direct effect. The noise is the
    same throughout.

    Args:
        model: Every variable of it can be computed; actions have the value that is nearest to zero.
        seed: Of the units and of the values.

    Attributes:
        effects: What was seen.
        targets: The variables that are set.
    """

    def __init__(self, model: SCM, seed: int) -> None:
        self._model, self._noise = model, Noise(seed)
        self._actions = Layout(model).idle()
        self.effects = Effects()
        self.targets = tuple(model)

    def run(self, number: int, probe: Any = None) -> None:
        """Do all experiments with one unit."""
        model, effects, noise = self._model, self.effects, self._noise
        effects.setting = ProbeSetting(number, "unit")
        longest = max((1, *(edge.lag for edge in model.edges)))
        first = model.solve(self._actions, key=NoiseKey(noise, number, 0))
        at = NoiseKey(noise, number, 1)
        unit = model.solve(self._actions, previous=first, key=at)
        again = model.solve(self._actions, previous=first, key=at)
        effects.rollouts += 2
        effects.floor = max(effects.floor, *(gap(unit[n], again[n]) for n in unit))
        if number == 0:
            effects.shared_noise |= shared_noise(model, unit, first)
        for cause in model:
            other = _another(model[cause], unit[cause], unit, noise, number)
            effects.changed[cause] += gap(other, unit[cause]) > 0.0
            _compare(model, cause, {**unit, cause: other}, first, unit, at, effects, lag=0)
            other = _another(model[cause], first[cause], first, noise, number)
            for lag in range(1, longest + 1):
                memory = {**first, earlier(cause, lag): other}
                _compare(model, cause, unit, memory, unit, at, effects, lag=lag)
            effects.rollouts += 1
        for name in reversed(tuple(model)):  # alone, last ones first, and after all the others
            value = model.solve(unit, previous=first, key=at, only=(name,))[name]
            effects.see_unstable(name, gap(value, unit[name]))
        effects.end_of_probe()


def _compare(
    model: SCM,
    cause: str,
    known: Values,
    previous: Values,
    unit: Values,
    at: NoiseKey,
    effects: Effects,
    *,
    lag: int,
) -> None:
    for name in model:
        if lag == 0 and name == cause:
            continue
        value = model.solve(known, previous=previous, key=at, only=(name,))[name]
        effects.see(cause, name, lag, value, unit[name])


def _another(variable: Variable, value: Value, values: Values, noise: Noise, number: int) -> Value:
    """Choose another value of a variable, within its bounds."""
    n = int(np.prod(variable.shape))
    unit = noise.uniforms(f"{variable.name}|paired", n=n, episode=number)[0]
    direction = (0.5 + unit).reshape(variable.shape)
    match variable.bounds:
        case Box():
            low, high = variable.bounds.bounds(variable.shape, values)
            step = np.where(np.isfinite(high - low), 0.2 * (high - low), 1.0) * direction
            return np.asarray(np.where(value + step > high, value - step, value + step))
        case Integers():
            return np.asarray(np.where(value < variable.bounds.high, value + 1, value - 1))
        case Categories():
            others = [m for m in variable.bounds.members if not np.any(value == m)]
            return variable.array(np.broadcast_to(others[0] if others else value, variable.shape))
        case _:
            whole = variable.dtype != "real"
            return np.asarray(value + (1 if whole else direction * (1.0 + np.abs(value))))
