"""A world on paper: its variables, what they mean physically, and its options."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.entities import ACTIONS, Clock, Composition, Robot, Stage
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.scene import (
    TIMESTEP,
    ControlMode,
    ParameterKey,
    PhysicalState,
    Scene,
    Structure,
    default_parameters,
    preset,
)
from scm_world.tasks import Task, conventions, make_task
from scm_world.variables import Derived, Exogenous, Measured
from scm_world.world.readouts import Readouts, static_order
from scm_world.world.start import whole_number


class Declaration:
    """Everything about a world that stays the same, whatever happens in it.

    Args:
        task: A task.
        preset_name: Numerical settings of the engine.
        action_mode: How the robot is commanded.
        frame_skip: Length of a control step in units of 4 ms.
        max_episode_length: In control steps; the task's own length if None.
        conventions_name: Ours or the predecessor's.

    Attributes:
        model: The causal model, without interventions.
        composition: The entities.
        slices: Where each state stands in the state vector.
        parameter_keys: Which physical parameter each variable sets.
        carried: States that follow others when these are set.
        static_names: Everything that interventions alone decide, causes before effects.
    """

    def __init__(
        self,
        task: Task | str,
        *,
        preset_name: str,
        action_mode: str,
        frame_skip: int,
        max_episode_length: int | None,
        conventions_name: str,
    ) -> None:
        self.task = make_task(task) if isinstance(task, str) else task
        self.frame_skip = whole_number("frame_skip", frame_skip, least=1)
        self.control_period = TIMESTEP * self.frame_skip  # [s]
        self.given_length = max_episode_length
        if max_episode_length is not None:
            whole_number("max_episode_length", max_episode_length, least=1)
        self.max_episode_length = max_episode_length or round(
            self.task.seconds / self.control_period
        )
        if action_mode not in ACTIONS:
            raise UnknownOption("action_mode", action_mode, ACTIONS)
        self.action_mode = action_mode
        self.conventions = conventions(conventions_name)
        self._preset = preset(preset_name)
        self._substeps = round(self.control_period / self._preset.timestep)
        self._mode = (
            ControlMode.JOINT_TORQUES
            if action_mode == "joint_torques"
            else ControlMode.JOINT_POSITIONS
        )
        self._declare()

    def _declare(self) -> None:
        clock = Clock(self.max_episode_length, self.control_period)
        self.composition = Composition(
            (Robot(self.action_mode), Stage(), clock, *self.task.entities()),
            tuple(self.task.shared()),
        )
        self.model = SCM([*self.composition.variables(), *self.task.readouts(self.conventions)])
        _refuse_draws(self.model)
        self.slices = self.composition.slices()
        self.parameter_keys = self.composition.parameters()
        self.carried = tuple(
            v for v in self.model.variables if isinstance(v, Measured) and v.set_parents()
        )
        self._now: dict[str, Value] = {}
        self._before: dict[str, Value] = {}
        self._readouts = Readouts(self.model, self._now, self._before)
        self.static_names = static_order(self.model, self._readouts.order)
        self._coordinates: dict[str, Callable[..., Any]] = {}
        self._follow: dict[tuple[str, ...], tuple[str, ...]] = {}
        bounds: Any = self.model.declared("action").bounds
        low, high = bounds.bounds((9,), {})
        self.action_low, self.action_high = np.array(low), np.array(high)

    @property
    def computed(self) -> tuple[str, ...]:
        """Variables that are computed from what moves, causes before effects."""
        return self._readouts.order

    @cached_property
    def _constants(self) -> dict[ParameterKey, Floats]:
        return default_parameters(self.structure)

    @cached_property
    def structure(self) -> Structure:
        """The bodies that the engine has to build."""
        return Structure(blocks=self.composition.blocks, preset=self._preset)

    def static_order(self, targets: Iterable[str]) -> tuple[str, ...]:
        """Name some variables and what follows them at once, without physics, causes first."""
        key = tuple(targets)
        if key not in self._follow:
            follow = {*key, *self.model.structure.instant_descendants(key)}
            self._follow[key] = tuple(name for name in self.static_names if name in follow)
        return self._follow[key]

    def states(self, state: PhysicalState) -> dict[str, Value]:
        """Give the states by name, as views of a vector."""
        return {name: state.vector[where] for name, where in self.slices.items()}

    def in_coordinates(self, name: str, value: Value) -> Value:
        """Give a value of a quantity in other coordinates of it."""
        function = self._coordinates.get(name)
        if function is None:
            variable: Any = self.model.declared(name)
            function = self._coordinates[name] = variable.mechanism.bind()
        return np.asarray(function(value))

    def describe(self, values: Values, state: PhysicalState) -> Scene:
        """Describe the scene that some values stand for."""
        parameters = dict(self._constants)
        for name, key in self.parameter_keys.items():
            parameters[key] = values[name]
        goals = self.composition.goals(values)
        return Scene(self.structure, parameters, state, goals)

    @cached_property
    def identity(self) -> tuple[Any, ...]:
        """What two worlds have in common if one can take up a snapshot of the other."""
        options = (self._preset.name, self.action_mode, self.conventions.name)
        numbers = (self.frame_skip, self.max_episode_length)
        return (self.task.name, *options, *numbers, *self.model)


def _refuse_draws(model: SCM) -> None:
    """Refuse what would be ignored: an episode begins at defaults and draws when asked to.

    Raises:
        ModelError: A variable of the world has a distribution or noise of its own.
    """
    problems = [
        f"{v.name!r} is random by declaration, but an episode begins at defaults; leave that out "
        f"and draw it with reset(do={{{v.name!r}: Draw(…)}})"
        for v in model.variables
        if (isinstance(v, Exogenous) and v.distribution) or (isinstance(v, Derived) and v.noise)
    ]
    if problems:
        raise ModelError(problems)
