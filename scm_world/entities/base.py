"""What an entity is: declarations, and what they mean physically."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import final

from scm_world._types import Floats, Values
from scm_world.geometry.hulls import Hull
from scm_world.graph import Moment
from scm_world.models import (
    ControlMode,
    Goal,
    Light,
    ParameterKey,
    Scene,
    Structure,
)
from scm_world.scene import PRESETS, preset
from scm_world.scene import Structure as SceneStructure
from scm_world.scene.camera import Camera
from scm_world.scene.feasibility import Overlap, overlaps
from scm_world.scene.state import BLOCK_SIZE, ROBOT_SIZE
from scm_world.variables import Function, Measured, Parent, Space, Variable
from scm_world.variables.catalogue import PRESET

Numbers = float | tuple[float, ...]

PRESET_NAMES = tuple(PRESETS)
"""What the categories of ``timestep_preset`` stand for."""


@final
@dataclass(frozen=True)
class State:
    """A quantity that physics moves.

    Attributes:
        name: ``"<entity>.<quantity>"``.
        unit: SI unit.
        shape: Of one value.
        bounds: What is possible.
        default: At the start of an episode.
        doc: One sentence.
        always: Causes that act at every control step; all other physical quantities of the
            world act while there is contact.
        on_set: Parameters and states that move it when they are set.
        start: Its value at the start, a function of ``on_set``.
        carry: Its value after one of ``on_set`` was set: a function of the present value, of
            ``on_set`` before and of ``on_set`` after.
        restart: Those of ``on_set`` that, when set, put it where it would be at the start.
        settable: False for what the engine reports only.
        a: Space A.
        b: Space B.
    """

    name: str
    unit: str
    shape: tuple[int, ...]
    bounds: Space
    default: Numbers
    doc: str
    always: tuple[str, ...]
    on_set: tuple[str, ...] = ()
    start: Function | None = None
    carry: Function | None = None
    restart: tuple[str, ...] = ()
    settable: bool = True
    a: Space | None = None
    b: Space | None = None

    def declare(self, inputs: Iterable[Parent]) -> Measured:
        """Write the declaration.

        Args:
            inputs: All quantities of the world that physics knows, as causes that act where
                there is contact.
        """
        always = tuple(Parent(name, 1) for name in self.always)
        contact = tuple(parent for parent in inputs if parent.name not in self.always)
        on_set = tuple(Parent(name, 0, "set") for name in self.on_set)
        return Measured(
            name=self.name,
            unit=self.unit,
            shape=self.shape,
            bounds=self.bounds,
            a=self.a,
            b=self.b,
            default=self.default,
            doc=self.doc,
            parents=always + contact + on_set,
            start=self.start,
            carry=self.carry,
            restart=self.restart,
            settable_state=self.settable,
        )


class Entity(ABC):  # every hook has a sensible empty default
    """Something in the world: it declares its variables and says what they mean physically.

    Attributes:
        name: Prefix of its variables.
    """

    name: str

    def variables(self) -> Iterable[Variable]:
        """Declare everything but the states."""
        return ()

    def states(self) -> Iterable[State]:
        """Declare what physics moves."""
        return ()

    def inputs(self) -> Iterable[str]:
        """Name the variables of this entity that physics depends on."""
        return ()

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        return {}

    def slices(self, block: int) -> Mapping[str, slice]:
        """Say where its states stand in the vector of ``PhysicalState``.

        Args:
            block: Index of this entity among the movable blocks.
        """
        return {}

    @property
    def is_block(self) -> bool:
        """Whether it is a movable block."""
        return False

    @property
    def is_obstacle(self) -> bool:
        """Whether it is a box that nothing moves."""
        return False

    @property
    def hull(self) -> Hull | None:
        """The shape of a block that is no box."""
        return None

    def goal(self, values: Values) -> Goal | None:
        """Describe the goal that this entity is, if it is one."""
        return None

    def light(self, values: Values) -> Light | None:
        """Describe the light that this entity is, if it is one."""
        return None

    def cameras(self, values: Values) -> tuple[Camera, ...]:
        """Describe the cameras that this entity is."""
        return ()

    def commands(self) -> Commands | None:
        """Give what turns actions into commands, if this entity does."""
        return None


def block_slice(block: int, start: int, stop: int) -> slice:
    """Give the place of some numbers of a block in the state vector."""
    offset = ROBOT_SIZE + BLOCK_SIZE * block
    return slice(offset + start, offset + stop)


class Commands(ABC):
    """What turns an action into what the engine is told, where they are not the same."""

    @abstractmethod
    def applies(self, values: Values) -> bool:
        """Tell whether it is needed, given the values of everything that physics does not move."""

    @abstractmethod
    def told(self, action: Floats, values: Values, vector: Floats, moment: Moment) -> Floats:
        """Give the command of one control step.

        Args:
            action: All action variables, shape (n_actions,).
            values: Of everything that physics does not move.
            vector: The state.
            moment: Where in the noise this control step draws.

        Returns:
            Shape (n_commands,). It holds until the next call.
        """


class Composition(ABC):
    """What the variables of a world mean to an engine: where causal and physical column meet.

    Attributes:
        entities: In the order of the observation.
        blocks: Names of the movable blocks.
        obstacles: Names of the obstacles.
        hulls: The blocks that are no boxes.
        solid: Whether ``overlaps`` tells which bodies are in one place.
        mode: What a command means.
        commands: What turns an action into a command; None where they are the same.
    """

    entities: tuple[Entity, ...] = ()
    blocks: tuple[str, ...] = ()
    obstacles: tuple[str, ...] = ()
    hulls: tuple[tuple[str, Hull], ...] = ()
    solid: bool = False
    mode: ControlMode = ControlMode.CONTROLS
    commands: Commands | None = None

    @abstractmethod
    def structure(self, values: Values) -> Structure:
        """Say what the engine has to compile; equal values give the same object."""

    @abstractmethod
    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""

    @abstractmethod
    def slices(self) -> Mapping[str, slice]:
        """Say where each state stands in the state vector."""

    def timestep(self, values: Values) -> float:
        """Give the physics step [s]."""
        return float(self.structure(values).timestep)

    def overlaps(self, scene: Scene, tolerance: float) -> tuple[Overlap, ...]:
        """List the bodies that lie deeper in one another than a tolerance [m]."""
        return ()

    def goals(self, values: Values) -> tuple[Goal, ...]:
        """Describe all goals."""
        return ()

    def light(self, values: Values) -> Light:
        """Describe the light of pictures."""
        return Light()

    def cameras(self, values: Values) -> tuple[Camera, ...]:
        """Describe the cameras whose places are variables."""
        return tuple(camera for entity in self.entities for camera in entity.cameras(values))


@final
@dataclass(frozen=True)
class BlockWorld(Composition):
    """The robot, blocks, obstacles, goals and what they stand in.

    Attributes:
        entities: In the order of the observation.
        shared: Variables that belong to no single entity.
        deciding: Variables that decide which entities there are. A body that comes or goes acts
            on the others by contact, so they do.
        mode: What a command means.
    """

    entities: tuple[Entity, ...]
    shared: tuple[Variable, ...] = ()
    deciding: tuple[str, ...] = ()
    mode: ControlMode = ControlMode.JOINT_POSITIONS
    solid: bool = field(init=False, default=True)
    blocks: tuple[str, ...] = field(init=False)
    obstacles: tuple[str, ...] = field(init=False)
    hulls: tuple[tuple[str, Hull], ...] = field(init=False)
    commands: Commands | None = field(init=False)
    _structures: dict[str, SceneStructure] = field(init=False, default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        blocks = [entity for entity in self.entities if entity.is_block]
        commands = (entity.commands() for entity in self.entities)
        found = {
            "blocks": tuple(entity.name for entity in blocks),
            "obstacles": tuple(entity.name for entity in self.entities if entity.is_obstacle),
            "hulls": tuple((e.name, e.hull) for e in blocks if e.hull is not None),
            "commands": next((one for one in commands if one is not None), None),
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def structure(self, values: Values) -> SceneStructure:
        """Say which bodies the engine has to build, and how finely it cuts time."""
        name = PRESET_NAMES[int(values[PRESET])]
        if name not in self._structures:
            made = SceneStructure(self.blocks, preset(name), self.obstacles, self.hulls)
            self._structures[name] = made
        return self._structures[name]

    def overlaps(self, scene: Scene, tolerance: float) -> tuple[Overlap, ...]:
        """List the bodies that lie deeper in one another than a tolerance [m]."""
        return overlaps(scene, tolerance=tolerance)

    def variables(self) -> tuple[Variable, ...]:
        """Declare every variable, with the states coupled to all physical quantities."""
        names = [name for entity in self.entities for name in entity.inputs()]
        inputs = tuple(Parent(name, 1, "contact") for name in (*names, *self.deciding))
        declared: list[Variable] = list(self.shared)
        for entity in self.entities:
            declared.extend(entity.variables())
            declared.extend(state.declare(inputs) for state in entity.states())
        return tuple(declared)

    def parameters(self) -> dict[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        return {k: v for entity in self.entities for k, v in entity.parameters().items()}

    def slices(self) -> dict[str, slice]:
        """Say where each state stands in the state vector."""
        found: dict[str, slice] = {}
        for entity in self.entities:
            block = self.blocks.index(entity.name) if entity.is_block else -1
            found.update(entity.slices(block))
        return found

    def goals(self, values: Values) -> tuple[Goal, ...]:
        """Describe all goals."""
        goals = (entity.goal(values) for entity in self.entities)
        return tuple(goal for goal in goals if goal is not None)

    def light(self, values: Values) -> Light:
        """Describe the light of pictures."""
        lights = (entity.light(values) for entity in self.entities)
        return next((light for light in lights if light is not None), Light())


def lowest_point(size: Floats, orientation: Floats) -> float:
    """Compute how far a box reaches below its center [m].

    Args:
        size: Edge lengths, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
    """
    x, y, z, w = orientation.tolist()
    length, width, height = size.tolist()
    row = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    return 0.5 * float(abs(row[0]) * length + abs(row[1]) * width + abs(row[2]) * height)
