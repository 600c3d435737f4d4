"""What the goal families of the block-building robot have in common."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, ClassVar, Unpack

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.tasks.base import Observed, Scenario, Task, Timing, numbers_of
from scm_world.tasks.composition import Clock, Composition, Entity
from scm_world.tasks.rewards import (
    FRACTION,
    SUCCESS,
    TERMINATED,
    Common,
    declared,
    further_terms,
    resolve,
    succeeded,
)
from scm_world.tasks.trifinger import hardware, shaping
from scm_world.tasks.trifinger.entities.block_world import BlockWorld
from scm_world.tasks.trifinger.entities.robot import ACTIONS, Robot
from scm_world.tasks.trifinger.entities.stage import LightAndCameras, Stage
from scm_world.tasks.trifinger.hardware import PRESETS, RESOLUTIONS, TIMESTEP
from scm_world.tasks.trifinger.scenarios import scenarios
from scm_world.variables import Linear, Measured, Variable

HEAD = (
    Observed("joint_positions", (hardware.JOINT_LOW, hardware.JOINT_HIGH), low=-3.3, high=3.3),
    Observed("joint_velocities", (-50.0, 50.0)),
    Observed(
        "end_effector_positions", ((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3), low=-1.0, high=1.0
    ),
)
"""What every observation begins with, after the time that is left."""

_CARTESIAN = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.5))
_SPACE = {"low": -1.0, "high": 1.0}
_SIZE = (0.03, 0.1)


def _shape_and_pose(name: str, kind: int) -> Iterable[Observed]:
    yield Observed(f"{name}.type", (kind, kind), low=0.0, high=30.0)
    yield Observed(f"{name}.size", _SIZE, low=0.0, high=0.6)
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)
    yield Observed(f"{name}.orientation", (-10.0, 10.0), **_SPACE)


def observe_tool(name: str, kind: int = 1) -> Iterable[Observed]:
    """List the 17 numbers of a movable block."""
    yield from _shape_and_pose(name, kind)
    yield Observed(f"{name}.linear_velocity", (-0.5, 0.5))
    yield Observed(f"{name}.angular_velocity", (-np.pi, np.pi))


def observe_goal(name: str, kind: int = 20) -> Iterable[Observed]:
    """List the 11 numbers of a goal block."""
    return _shape_and_pose(name, kind)


def observe_obstacle(name: str) -> Iterable[Observed]:
    """List the 11 numbers of an obstacle."""
    return _shape_and_pose(name, 10)


def observe_position(name: str) -> Iterable[Observed]:
    """List the three numbers of a goal that is a point."""
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)


REWARD = "reward"

MEASURES = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
"""States of a block, in the order in which they are listed."""


def _scripted(name: str) -> Any:
    """Make a scripted policy; they are imported when the first one is used."""
    from scm_world.tasks.trifinger.policies import SCRIPTED

    return SCRIPTED[name]()


class TriFingerTask(Task):
    """A goal family of the robot.

    Attributes:
        default_weights: Weight of every dense reward term, in order, and of
            ``fractional_success``.
        paper_weights: Where the published training runs differ.
        ready_terms: Further reward terms, by name in the option ``terms``.
        unchecked: Prefixes of variables; an intervention that sets one may put bodies as deep in
            one another as it likes, under the conventions of the predecessor.
        start: Where the robot begins, shape (9,) [rad].
        success: What counts in place of the usual goal, if anything; see ``Common``.
        terminated: What ends an episode before its time, if anything; see ``Common``.
        training: See ``Task``.
    """

    action_modes = tuple(ACTIONS)
    presets = tuple(PRESETS)
    resolutions = RESOLUTIONS
    generated_graph = True
    time_unit = TIMESTEP
    frame_skip = 10

    default_weights: ClassVar[Mapping[str, float]]
    paper_weights: ClassVar[Mapping[str, float]] = {}
    head = HEAD
    saturates = True
    raised = hardware.RAISED
    policies: ClassVar[Mapping[str, Callable[[], Any]]] = {
        name: partial(_scripted, name) for name in ("sweep", "across", "feedback")
    }
    ready_terms: ClassVar[tuple[Measured, ...]] = shaping.ROBOT
    unchecked: ClassVar[tuple[str, ...]] = ()
    rest: ClassVar[tuple[float, ...]] = hardware.REST
    success: Any = None
    terminated: Any = None
    training: ClassVar[Mapping[str, Any]] = {
        "env": {
            "action_mode": "delta_joint_positions",
            "delta_scale": 0.1,
            "delta_origin": "measured",
            "frame_skip": 10,
        }
    }

    def __init__(self, **common: Unpack[Common]) -> None:
        unknown = sorted(common.keys() - Common.__annotations__.keys())
        if unknown:
            raise UnknownOption(f"option of {self.name}", unknown[0], self.arguments())
        self.terms = further_terms(common.get("terms", ()), self.default_weights, self.ready_terms)
        self.weights = resolve(self.default_weights, self.paper_weights, common, self.terms)
        for option in (SUCCESS, TERMINATED):
            if common.get(option) is not None:
                setattr(self, option, common[option])  # type: ignore[literal-required]
        given = common.get("joint_positions")
        joints = numbers_of(self.rest if given is None else given)
        if joints is None or joints.shape != (hardware.N_JOINTS,):
            raise UnknownOption("joint_positions", given, ("nine angles [rad]",))
        self.start = tuple(joints.tolist())

    @classmethod
    def arguments(cls) -> tuple[str, ...]:
        """Name the arguments of the constructor, those of this family first."""
        own = [vars(kind)["__init__"] for kind in cls.__mro__ if "__init__" in vars(kind)]
        given = [p for init in own[:-1] for p in inspect.signature(init).parameters.values()]
        names = [parameter.name for parameter in given if parameter.kind is parameter.KEYWORD_ONLY]
        return tuple(dict.fromkeys((*names, *Common.__annotations__)))

    @abstractmethod
    def entities(self) -> Iterable[Entity]:
        """List the entities of the scene other than the robot and the stage."""

    @abstractmethod
    def readouts(self) -> Iterable[Variable]:
        """Declare reward terms, fractional success and success."""

    def idle(self, world: Any) -> Floats:
        """Return the command that keeps the robot at rest (position, or no torque), shape (9,)."""
        if world.action_mode == "joint_torques":
            return super().idle(world)
        name = "end_effector_positions" if "effector" in world.action_mode else "joint_positions"
        return np.array(world[name])

    def measured(self, *, every_step: bool = False) -> tuple[str, ...]:
        """Name the states of blocks, and success; at every instant also those of the joints."""
        joints = ("joint_positions", "joint_velocities") if every_step else ()
        return (
            *joints,
            *(f"{tool}.{what}" for tool in self.tools() for what in MEASURES),
            FRACTION,
        )

    def scenarios(self, world: Any) -> Sequence[Scenario]:
        """List where fingers and blocks touch, and where blocks come and go."""
        return scenarios(world)

    def compose(self, timing: Timing) -> tuple[Composition, list[Variable]]:
        """Leave out what is absent, and what is computed from something that is not there.

        An entity of which something cannot be computed any more goes as well, such as the places
        of a pile of which a block is missing. The reward sums up the terms that are left.
        """
        torques = timing.action_mode == "joint_torques"
        entities: tuple[Entity, ...] = (
            *_always_there(timing, self.start),
            *self.entities(),
        )
        there = tuple(entity for entity in entities if entity.name not in self.absent)
        while True:
            unchecked = self.unchecked if self.conventions.published_spaces else ()
            made = BlockWorld(
                there,
                tuple(self.shared()),
                self.decided_by,
                torques,
                timing.resolution,
                self.conventions,
                unchecked,
            )
            readouts: Iterable[Variable] = self.readouts()
            if self.success is not None:
                own = {FRACTION: declared(FRACTION, self.success), SUCCESS: succeeded()}
                readouts = [own.get(one.name, one) for one in readouts]
            ends = () if self.terminated is None else (declared(TERMINATED, self.terminated),)
            variables: list[Variable] = [*made.variables(), *readouts, *ends]
            if not self.absent:
                return made, variables
            variables = _computable(variables)
            names = {variable.name for variable in variables}
            whole = tuple(e for e in there if all(v.name in names for v in e.declared[0]))
            if len(whole) == len(there):
                return made, variables
            there = whole


@lru_cache(maxsize=32)
def _always_there(timing: Timing, start: tuple[float, ...]) -> tuple[Entity, ...]:
    """List the entities of every goal family; none of them depends on the plan."""
    return (
        Robot(timing.action_mode, start, timing.resolution),
        Stage(timing.preset),
        LightAndCameras(),
        Clock(timing.steps, timing.control_period),
    )


def _computable(variables: list[Variable]) -> list[Variable]:
    while True:
        names = {variable.name for variable in variables}
        kept = [_kept(variable, names) for variable in variables]
        left = [variable for variable in kept if variable is not None]
        if len(left) == len(variables):
            return left
        variables = left


def _kept(variable: Variable, names: set[str]) -> Variable | None:
    parents = variable.all_parents
    there = [index for index, parent in enumerate(parents) if parent.name in names]
    if len(there) == len(parents):
        return variable
    mechanism: Any = getattr(variable, "mechanism", None)
    if variable.name == REWARD and isinstance(variable, Measured) and isinstance(mechanism, Linear):
        weights = tuple(mechanism.weights[index] for index in there)
        return variable.model_copy(
            update={
                "parents": tuple(parents[index] for index in there),
                "mechanism": mechanism.model_copy(update={"weights": weights}),
            }
        )
    return None
