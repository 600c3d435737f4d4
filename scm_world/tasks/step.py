"""A task whose physics is one function of the user's."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.backends.step import Quantity, StepModel
from scm_world.entities import Clock, Commands, Composition
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import Moment
from scm_world.models import ParameterKey
from scm_world.tasks.base import Task, Timing
from scm_world.tasks.observed import Observed
from scm_world.variables import (
    Action,
    Derived,
    Distribution,
    Exogenous,
    Fixed,
    Function,
    Measured,
    Parent,
    Variable,
)

LENGTH = 100
"""Control steps of an episode, if no other length is asked for."""


@final
class ProcessNoise(Commands):
    """Draws the noise of each control step, which the step function is given.

    A draw depends on seed, episode, control step and name only: it is the same whatever is
    intervened on.

    Args:
        sources: What is drawn from, by name.
        shapes: Of one draw.
    """

    def __init__(
        self, sources: Mapping[str, Distribution], shapes: Mapping[str, tuple[int, ...]]
    ) -> None:
        self._sources, self._shapes = dict(sources), dict(shapes)

    def applies(self, values: Values) -> bool:
        """Tell that it is always needed."""
        return True

    def told(self, action: Floats, values: Values, vector: Floats, moment: Moment) -> Floats:
        """Give the action and the noise of a control step, shape (n_commands,)."""
        drawn = [
            np.ravel(moment.draw(source, name, self._shapes[name], values, "process noise"))
            for name, source in self._sources.items()
        ]
        return np.concatenate([action, *drawn])


@final
class StepComposition(Composition):
    """What the variables of a step function mean to the backend.

    Args:
        model: With the function.
        names: Of the parameters.
        clock: The counter of control steps.
        noise: What draws the noise, if there is some.
    """

    def __init__(
        self, model: StepModel, names: Iterable[str], clock: Clock, noise: ProcessNoise | None
    ) -> None:
        self._model, self._keys = model, {q.name: q.key for q in model.parameters}
        self.entities, self.commands = (clock,), noise

    def structure(self, values: Values) -> StepModel:
        """Give the model, which is always the same."""
        return self._model

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which parameter: each one its own."""
        return self._keys

    def slices(self) -> Mapping[str, slice]:
        """Say where each state stands in the state vector."""
        return self._model.layout.slices


class StepTask(Task):
    """A system that a function moves: ``step(parameters, state, action, noise) -> new state``.

    The causes of a state are the parents it declares, all of them one control step before; of a
    state that declares none, every parameter, state and action is a cause. The function is held
    against that by ``discover`` and ``verify``.

    Args:
        step: The function; see ``StepModel`` for what it is given and gives. It must be the same
            function of what it is given in every call.
        name: Of the task; that of the function if None.
        parameters: ``Exogenous`` variables, or ``Derived`` and ``Fixed`` ones.
        states: ``Measured`` variables without a mechanism; ``do`` may set each of them. One with
            ``start`` begins where that says, given its parents with ``when="set"``.
        actions: ``Action`` variables. The command is one after another.
        control_dt: What one call of the function advances [s].
        noise: What the function is given anew in every step, by name. What is named like a state
            has its shape; else it is a number, or has as many components as its corners.
        outcomes: ``Measured`` variables that are computed from others.
        reward: A ``Measured`` variable named ``"reward"``, or a function and the names of what it
            is a function of.
        steps: Length of an episode in control steps.
        vectorized: Whether the function takes many systems at once, with a leading axis.
        signature: ``"dicts"``, or ``"arrays"`` for flat arrays in the order of declaration.

    Raises:
        ModelError: With everything that is wrong with the declaration.
    """

    action_modes = ("actions",)
    presets = ("default",)
    frame_skip = 1

    def __init__(
        self,
        step: Callable[..., Any],
        *,
        states: Sequence[Measured],
        control_dt: float,
        name: str | None = None,
        parameters: Sequence[Variable] = (),
        actions: Sequence[Action] = (),
        noise: Mapping[str, Distribution] | None = None,
        outcomes: Sequence[Variable] = (),
        reward: Measured | tuple[Any, ...] | None = None,
        steps: int = LENGTH,
        vectorized: bool = False,
        signature: Literal["dicts", "arrays"] = "dicts",
    ) -> None:
        noise = dict(noise or {})
        _refuse(step, control_dt, parameters, states, actions, outcomes, noise, signature)
        self.name = name or getattr(step, "__name__", type(step).__name__)
        self.time_unit, self._steps = float(control_dt), steps
        given = [variable.name for variable in (*parameters, *states, *actions)]
        self._states = tuple(_with_causes(state, given) for state in states)
        rewards = [] if reward is None else [_reward(reward)]
        self._variables = (*parameters, *actions, *self._states, *outcomes, *rewards)
        shapes = {state.name: state.shape for state in states}
        self._noise = None
        if noise:
            own = {name: shapes.get(name, _shape(source)) for name, source in noise.items()}
            self._noise = ProcessNoise(noise, own)
        self.model = StepModel(
            self.name,
            step,
            self.time_unit,
            tuple(map(_quantity, parameters)),
            tuple(map(_quantity, self._states)),
            tuple(map(_quantity, actions)),
            tuple(
                Quantity(name, own[name], integer=source.kind in ("integers", "categories"))
                for name, source in noise.items()
            ),
            vectorized,
            signature,
        )

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        return self._steps * self.time_unit

    def compose(self, timing: Timing) -> tuple[Composition, list[Variable]]:
        """Declare all variables, and say what they mean to the backend.

        Raises:
            UnknownOption: A control step is to be several calls of the function: the declared
                edges are those of one.
        """
        if timing.control_period != self.time_unit:
            count = round(timing.control_period / self.time_unit)
            raise UnknownOption("frame_skip", count, ("1: one call of the step function",))
        clock = Clock(timing.steps, timing.control_period)
        made = StepComposition(self.model, self._keys, clock, self._noise)
        return made, [*self._variables, *clock.variables()]
