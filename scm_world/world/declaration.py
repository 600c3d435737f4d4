"""A world on paper: its variables, what they mean physically, and its options."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.entities import ACTIONS, PRESET_NAMES, Clock, Entity, Looks, Robot, Stage
from scm_world.errors import UnknownOption
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
from scm_world.tasks import Conventions, Task, conventions
from scm_world.variables import Derived, Exogenous, Measured
from scm_world.variables import catalogue as numbers
from scm_world.world.absence import put_together, remaining
from scm_world.world.readouts import computed_order, static_order
from scm_world.world.start import whole_number


@final
@dataclass(frozen=True)
class Options:
    """What a world is made with besides its task.

    Attributes:
        preset: Numerical settings of the engine at the start of an episode.
        action_mode: How the robot is commanded.
        frame_skip: Length of a control step in units of 4 ms.
        given_length: Length of an episode in control steps, if one was given.
        conventions: Ours or the predecessor's.
    """

    preset: str
    action_mode: str
    frame_skip: int
    given_length: int | None
    conventions: Conventions

    @classmethod
    def checked(
        cls,
        *,
        preset_name: str,
        action_mode: str,
        frame_skip: int,
        max_episode_length: int | None,
        conventions_name: str,
    ) -> Options:
        """Check what a user gave.

        Raises:
            UnknownOption: One of the names does not exist, or a number is none.
        """
        skip = whole_number("frame_skip", frame_skip, least=1)
        if max_episode_length is not None:
            whole_number("max_episode_length", max_episode_length, least=1)
        if action_mode not in ACTIONS:
            raise UnknownOption("action_mode", action_mode, ACTIONS)
        name = preset(preset_name).name
        return cls(name, action_mode, skip, max_episode_length, conventions(conventions_name))

    @property
    def control_period(self) -> float:
        """Length of a control step [s]."""
        return TIMESTEP * self.frame_skip

    @property
    def mode(self) -> ControlMode:
        """What the engine is told."""
        torques = self.action_mode == "joint_torques"
        return ControlMode.JOINT_TORQUES if torques else ControlMode.JOINT_POSITIONS


class Declaration:
    """Everything about a world that stays the same as long as its structure does.

    Args:
        task: With the plan and the conventions of this world.
        options: Of the world.
        steps: Length of an episode in control steps.

    Attributes:
        task: As it was given.
        model: The causal model, without interventions.
        composition: The entities.
        slices: Where each state stands in the state vector.
        parameter_keys: Which physical parameter each variable sets.
        carried: States that follow others when these are set.
        computed: Variables that are computed from what moves, causes before effects.
        static_names: Everything that interventions alone decide, causes before effects.
        random: Variables that are drawn when an episode begins.
    """

    def __init__(self, task: Task, options: Options, steps: int) -> None:
        self.task = task
        entities: tuple[Entity, ...] = (
            Robot(options.action_mode, task.start),
            Stage(options.preset),
            Looks(),
            Clock(steps, options.control_period),
            *task.entities(),
        )
        self.composition, variables = remaining(entities, task)
        self.model = SCM(options.conventions.adapt(variables))
        self.slices = self.composition.slices()
        self.parameter_keys = self.composition.parameters()
        ordered = map(self.model.declared, self.model.structure.order)
        self.carried = tuple(v for v in ordered if isinstance(v, Measured) and v.set_parents())
        self.computed = computed_order(self.model)
        self.static_names = static_order(self.model, self.computed)
        self.random = tuple(
            v.name
            for v in self.model.variables
            if (isinstance(v, Exogenous) and v.distribution) or (isinstance(v, Derived) and v.noise)
        )
        self._coordinates: dict[str, Callable[..., Any]] = {}
        self._follow: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._structures: dict[str, Structure] = {}
        self._constants: dict[str, dict[ParameterKey, Floats]] = {}

    @property
    def plan(self) -> Hashable:
        """What stands in the world, and what was taken out of it."""
        return put_together(self.task.plan, self.task.absent)

    @cached_property
    def entity_names(self) -> frozenset[str]:
        """Names of what stands in the world."""
        return frozenset(entity.name for entity in self.composition.entities)

    @property
    def n_blocks(self) -> int:
        """How many movable blocks there are."""
        return len(self.composition.blocks)

    @cached_property
    def action_bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper end of an action, shape (9,) each."""
        bounds: Any = self.model.declared("action").bounds
        low, high = bounds.bounds((9,), {})
        return np.array(low), np.array(high)

    def structure(self, values: Values) -> Structure:
        """Say which bodies the engine has to build, and how finely it cuts time."""
        name = PRESET_NAMES[int(values[numbers.PRESET])]
        if name not in self._structures:
            made = self.composition
            self._structures[name] = structure = Structure(
                made.blocks, preset(name), made.obstacles, made.hulls
            )
            self._constants[name] = default_parameters(structure)
        return self._structures[name]

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
        structure = self.structure(values)
        parameters = dict(self._constants[structure.preset.name])
        for name, key in self.parameter_keys.items():
            parameters[key] = values[name]
        goals = self.composition.goals(values)
        return Scene(structure, parameters, state, goals, self.composition.light(values))
