"""What a world says about its task and its options."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import NotReset
from scm_world.graph import SCM
from scm_world.models import ParameterKey, Scene, State
from scm_world.tasks import Conventions, Task
from scm_world.tasks.composition import Composition
from scm_world.world.compiled_task import CompiledTask, Options
from scm_world.world.structures import StructureCache


def _copied(kind: Any, task: Task, options: Mapping[str, Any], snapshot: Any) -> Any:
    world = kind(task, **options)
    if snapshot is not None:
        world.restore(snapshot)
    return world


class WorldAttributes:
    """The task of a world and its options, under short names.

    Attributes:
        options: What the world was made with.
        structures: All structures of its task.
    """

    options: Options
    structures: StructureCache

    @property
    def compiled(self) -> CompiledTask:
        """The task in the structure that there is."""
        return self.structures.natural(None)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle through a snapshot: another backend, the same future bit for bit."""
        world: Any = self
        try:
            snapshot = world.snapshot()
        except NotReset:
            snapshot = None
        options = {
            "backend": world.backend.name,
            "preset": self.options.preset,
            "action_mode": self.action_mode,
            "frame_skip": self.frame_skip,
            "max_episode_length": self.given_length,
            "conventions": self.conventions.name,
            "variables_space": world.variables_space,
        }
        usual = self.task.choices["resolution"][0]
        if self.resolution != usual:  # logs and files of before have none
            options["resolution"] = self.resolution
        return _copied, (type(self), self.structures.task, options, snapshot)

    @property
    def engine(self) -> str:
        """Name and version of the physics engine."""
        world: Any = self
        return f"{world.backend.name} {world.backend.version}"

    @property
    def task(self) -> Task:
        """The task, with its present plan."""
        return self.compiled.task

    @property
    def model(self) -> SCM:
        """The causal model of the present structure, without interventions."""
        return self.compiled.model

    @property
    def composition(self) -> Composition:
        """The entities."""
        return self.compiled.composition

    @property
    def slices(self) -> Mapping[str, slice]:
        """Where each state stands in the state vector."""
        return self.compiled.slices

    @property
    def parameter_keys(self) -> Mapping[str, ParameterKey]:
        """Which physical parameter each variable sets."""
        return self.compiled.parameter_keys

    @property
    def static_names(self) -> tuple[str, ...]:
        """Everything that interventions alone decide, causes before effects."""
        return self.compiled.static_names

    @property
    def computed(self) -> tuple[str, ...]:
        """Variables that are computed from what moves, causes before effects."""
        return self.compiled.computed

    @property
    def conventions(self) -> Conventions:
        """Ours or the predecessor's."""
        return self.options.conventions

    @property
    def action_mode(self) -> str:
        """How the system is commanded."""
        return self.options.action_mode

    @property
    def resolution(self) -> str:
        """How finely the variables are cut."""
        return self.options.resolution

    @property
    def frame_skip(self) -> int:
        """Length of a control step in units of the task; 4 ms for the robot."""
        return self.options.frame_skip

    @property
    def control_period(self) -> float:
        """Length of a control step [s]."""
        return self.options.control_period

    @property
    def given_length(self) -> int | None:
        """Length of an episode in control steps, if one was given."""
        return self.options.given_length

    @property
    def max_episode_length(self) -> int:
        """Length of an episode in control steps."""
        return self.structures.steps

    @property
    def action_low(self) -> Floats:
        """Lower end of all actions, shape (n_actions,)."""
        return self.compiled.action_bounds[0]

    @property
    def action_high(self) -> Floats:
        """Upper end of all actions, shape (n_actions,)."""
        return self.compiled.action_bounds[1]

    @property
    def action_space(self) -> gymnasium.spaces.Box:
        """The space of actions in SI units."""
        low, high = self.compiled.action_bounds
        return gymnasium.spaces.Box(low, high, dtype=np.float64)

    @property
    def observation_space(self) -> gymnasium.spaces.Dict:
        """The space of the observed variables by name, in SI units; nothing is clipped."""
        names = (part.variable for part in self.task.observation.rows)
        shapes = {name: self.model.declared(name).shape for name in names}
        return gymnasium.spaces.Dict(
            {
                name: gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)
                for name, shape in shapes.items()
            }
        )

    @property
    def identity(self) -> tuple[Any, ...]:
        """What two worlds have in common if one can take up a snapshot of the other."""
        return (*self._settings, self.structures.digest)

    @property
    def _settings(self) -> tuple[Any, ...]:
        numbers = (self.frame_skip, self.max_episode_length)
        options = (self.options.preset, self.action_mode, self.conventions.name)
        usual = self.task.choices["resolution"][0]
        finer = () if self.resolution == usual else (self.resolution,)
        return (self.task.name, *options, *numbers, *finer)

    def __fingerprint__(self) -> dict[str, Any]:
        """Return what decides what happens here, except versions: the task, and the options."""
        world: Any = self
        options = (world.backend.name, world.variables_space, self._settings)
        return {**self.structures.__fingerprint__(), "options": options}

    def describe(self, values: Values, state: State) -> Scene:
        """Describe the scene that some values stand for."""
        return self.compiled.describe(values, state)

    def static_order(self, targets: Iterable[str]) -> tuple[str, ...]:
        """Name some variables and what follows them at lag 0, without physics, causes first."""
        return self.compiled.static_order(targets)

    def in_coordinates(self, name: str, *values: Value) -> Value:
        """Give a value of a quantity in other coordinates, or values of the parts of a bundle."""
        return self.compiled.in_coordinates(name, *values)
