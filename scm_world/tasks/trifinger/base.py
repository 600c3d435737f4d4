"""What the goal families of the block-building robot have in common."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import UnknownOption
from scm_world.geometry.hulls import Hull
from scm_world.graph import SCM
from scm_world.tasks.base import (
    OVERLAP,
    TIME,
    Goal,
    Observation,
    Observed,
    Options,
    Scenario,
    Task,
    some_numbers,
)
from scm_world.tasks.composition import Composition, Entity, clock
from scm_world.tasks.rewards import (
    FRACTION,
    FULFILLED,
    SUCCESS,
    TERMINATED,
    UNIT,
    Common,
    Declaration,
    declared,
    further_terms,
    resolve,
    reward,
    succeeded,
)
from scm_world.tasks.trifinger import hardware, kernels
from scm_world.tasks.trifinger.conventions import CONVENTIONS, TriFingerConventions
from scm_world.tasks.trifinger.entities.block_world import BlockWorld, fingers_reach
from scm_world.tasks.trifinger.entities.robot import ACTIONS, robot
from scm_world.tasks.trifinger.entities.stage import light_and_cameras, stage
from scm_world.tasks.trifinger.groups import grouped
from scm_world.tasks.trifinger.hardware import PRESETS, RESOLUTIONS, TIMESTEP
from scm_world.tasks.trifinger.kernels import POSE
from scm_world.tasks.trifinger.scenarios import scenarios
from scm_world.tasks.trifinger.symmetry import thirds
from scm_world.tasks.trifinger.views import boxes_apart, view_of
from scm_world.variables import Function, Linear, Measured, Variable, names

if TYPE_CHECKING:
    from scm_world.tasks.base import Simulation

HEAD = (
    Observed(TIME),
    Observed("joint_positions", (hardware.JOINT_LOW, hardware.JOINT_HIGH), low=-3.3, high=3.3),
    Observed("joint_velocities", (-50.0, 50.0)),
    Observed(
        "end_effector_positions", ((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3), low=-1.0, high=1.0
    ),
)
"""The first rows of every observation."""

ROWS: Mapping[str, Any] = {
    "size": ((0.03, 0.1), 0.0, 0.6),
    "cartesian_position": (((-0.5, -0.5, 0.0), (0.5, 0.5, 0.5)), -1.0, 1.0),
    "orientation": ((-10.0, 10.0), -1.0, 1.0),
    "linear_velocity": ((-0.5, 0.5),),
    "angular_velocity": ((-np.pi, np.pi),),
}
"""The published normalisation, and the bounds, of quantities of blocks and goals."""


def observe(name: str, kind: int, *parts: str) -> Iterable[Observed]:
    """List the published type of a body, its size and pose, and further quantities of it."""
    yield Observed(f"{name}.type", (kind, kind), low=0.0, high=30.0)
    for part in ("size", "cartesian_position", "orientation", *parts):
        yield Observed(f"{name}.{part}", *ROWS[part])


REWARD = "reward"

MEASURES = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
"""States of a block, in the order in which they are listed."""


def _scripted(name: str) -> Any:
    """Make a scripted policy; they are imported when the first one is used."""
    from scm_world.tasks.trifinger.policies import SCRIPTED

    return SCRIPTED[name]()


class TriFingerTask(Task):
    """A goal family of the robot: blocks that should fill goals, unless it says otherwise.

    Attributes:
        interleaved: Whether block and goal alternate in the observation.
        shape: Shape of block and goal, where that is not a box.
        roots: The variables that ``shared`` declares by default.
        goal_causes: The variables that a new goal is drawn for.
        default_weights: Weight of every dense reward term, in order, and of
            ``fractional_success``.
        paper_weights: Weights of the published training runs, where they differ.
        dense_terms: The terms that ``dense`` declares by default.
        ready_terms: Further reward terms, by name in the option ``terms``.
        terms: The further reward terms that were asked for.
        options: The options that every task of this kind has; ``Common``, or a subclass of it.
        unchecked: Prefixes of variables; an intervention that sets one may put bodies as deep in
            one another as it likes, under the conventions of the predecessor.
        rest: Joint positions at the start of an episode, shape (9,) [rad].
        start: The same, if an option changed them.
        success: Replaces the usual goal, if given; see ``Common``.
        terminated: Ends an episode before its time, if given; see ``Common``.

    Raises:
        UnknownOption: An argument is not known, or out of the bounds of its variable.
    """

    choices: ClassVar[dict[str, Any]] = {
        "action_mode": tuple(ACTIONS),
        "preset": tuple(PRESETS),
        "resolution": RESOLUTIONS,
        "conventions": CONVENTIONS,
    }
    time_unit = TIMESTEP
    frame_skip = 10
    n_actions = hardware.N_JOINTS
    conventions: TriFingerConventions = CONVENTIONS["scm_world"]

    interleaved: ClassVar[bool] = False
    shape: Hull | None = None
    roots: tuple[Variable, ...] = ()
    goal_causes: tuple[str, ...] = ()
    default_weights: ClassVar[Mapping[str, float]]
    paper_weights: ClassVar[Mapping[str, float]] = {}
    dense_terms: ClassVar[tuple[Measured, ...]] = ()
    ready_terms: ClassVar[tuple[Measured, ...]] = kernels.ROBOT
    terms: tuple[Measured, ...] = ()
    options: ClassVar[type] = Common
    unchecked: ClassVar[tuple[str, ...]] = ()
    rest: ClassVar[tuple[float, ...]] = hardware.REST
    success: Declaration = None
    terminated: Declaration = None
    policies: ClassVar[Mapping[str, Callable[[], Any]]] = {
        name: partial(_scripted, name) for name in ("sweep", "across", "feedback")
    }
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
        joints = self.rest if given is None else given
        read = some_numbers("joint_positions", joints, (hardware.N_JOINTS,), "nine angles [rad]")
        self.start = tuple(read)

    @classmethod
    def arguments(cls) -> tuple[str, ...]:
        """Return the names of the constructor's arguments, those of this family first."""
        own = [vars(kind)["__init__"] for kind in cls.__mro__ if "__init__" in vars(kind)]
        given = [p for init in own[:-1] for p in inspect.signature(init).parameters.values()]
        names = [parameter.name for parameter in given if parameter.kind is parameter.KEYWORD_ONLY]
        return tuple(dict.fromkeys((*names, *cls.options.__annotations__)))

    @abstractmethod
    def entities(self) -> Iterable[Entity]:
        """List the entities of the scene other than the robot and the stage."""

    @property
    def tools(self) -> tuple[str, ...]:
        """Names of the blocks that should be moved."""
        return tuple(self.targets.values())

    @property
    def targets(self) -> Mapping[str, str]:
        """Names of the goals, each with the block that its solution puts there."""
        return {}

    @property
    def obstacles(self) -> tuple[str, ...]:
        """Names of the obstacles."""
        return ()

    def shared(self) -> Iterable[Variable]:
        """Declare causes that several entities have in common."""
        return self.roots

    @cached_property
    def _first(self) -> Hashable:
        return self.arrange(SCM(self.conventions.adapt(self.shared())).solve())

    @property
    def arranged(self) -> Any:
        """The plan; where the task stands alone, the one that its defaults give."""
        return self._first if self.plan is None else self.plan

    def groups(
        self, model: SCM, spaced: Sequence[Variable], bodies: Collection[str]
    ) -> dict[str, list[str]]:
        """Return the groups of variables that curricula know by a word."""
        return grouped(model, spaced, bodies, placed=bool(self.decided_by))

    def dense(self) -> Iterable[Variable]:
        """Declare the dense reward terms."""
        return self.dense_terms

    def readouts(self) -> Iterable[Variable]:
        """Declare reward terms, fractional success and success."""
        yield from self.dense()
        published, parts = self.conventions.published, POSE
        constants = {"tools": float(len(self.tools))}
        if self.shape is not None:
            function = kernels.hull_aligned if published else kernels.hull_filled
            parts, constants = ("vertices", *POSE[1:]), {}
        else:
            function = kernels.aligned if published else kernels.filled
        bodies = (*self.tools, *self.targets)
        yield Measured(
            name=FRACTION,
            bounds=None if published else UNIT,
            parents=tuple(f"{body}.{part}" for body in bodies for part in parts),
            mechanism=Function(function, constants=constants),
            doc="Fraction of the volume of all goals that the blocks fill.",
        )
        yield succeeded()
        yield from self.terms
        yield reward(self.weights)

    @property
    def seconds(self) -> float:
        """Ten seconds for each block [s]."""
        still = len(self.obstacles) if self.conventions.published else 0
        return 10.0 * (len(self.tools) + still)

    @property
    def goal(self) -> Goal:
        """The blocks should fill the goals."""
        have, want = (
            tuple(f"{name}.{part}" for name in names for part in POSE)
            for names in (self.targets.values(), self.targets)
        )
        exact, aligned = (
            partial(kernels.fraction_of, self.shape, published) for published in (False, True)
        )
        fraction = aligned if self.conventions.published else exact
        return Goal(
            achieved=have,
            desired=want,
            causes=self.goal_causes,
            measures={
                FRACTION: fraction,
                SUCCESS: lambda mine, its: fraction(mine, its) > FULFILLED,
                OVERLAP: aligned,
            },
            closeness=((kernels.TIPS, *have, *want), boxes_apart),
            tools=self.tools,
            targets=self.targets,
        )

    def observed(self) -> Iterable[Observed]:
        """List the rows of blocks, goals and obstacles."""
        goals = {tool: goal for goal, tool in self.targets.items()}
        for tool in self.tools:
            yield from observe(tool, 1, *MEASURES[2:])
            if self.interleaved and tool in goals:
                yield from observe(goals.pop(tool), 20)
        for goal in goals.values():
            yield from observe(goal, 20)
        for obstacle in self.obstacles:
            yield from observe(obstacle, 10)

    @property
    def observation(self) -> Observation:
        """The time that is left, the robot, and the rows of the family."""
        boxes = self.targets if self.shape is None else {}
        return Observation(
            rows=(*HEAD, *self.observed()),
            saturates=True,
            view=view_of(boxes) if boxes else None,
            # a wall has none: it always stands in the same place
            symmetries=None if self.obstacles or not self.targets else thirds,
            measured=(*(f"{tool}.{what}" for tool in self.tools for what in MEASURES), FRACTION),
            moving=("joint_positions", "joint_velocities"),
        )

    def solution(self, values: Values) -> dict[str, Value]:
        """Put each block where its goal is, and fingers that are in the way to the side."""
        found = {
            f"{tool}.{part}": values[f"{goal}.{part}"]
            for goal, tool in self.targets.items()
            for part in POSE[1:]
        }
        joints, height = values["joint_positions"], float(values["robot_height"])
        boxes = ([values[f"{goal}.{part}"] for part in POSE] for goal in self.targets)
        if any(fingers_reach(b[0], b[1], b[2], joints, height) for b in boxes):
            found["joint_positions"] = np.array(hardware.ASIDE)
        return found

    def idle(self, world: Simulation) -> Floats:
        """Return the command that keeps the robot at rest (position, or no torque), shape (9,)."""
        if world.options.action_mode == "joint_torques":
            return super().idle(world)
        name = (
            "end_effector_positions"
            if "effector" in world.options.action_mode
            else "joint_positions"
        )
        return np.array(world[name])

    def scenarios(self, world: Simulation) -> Sequence[Scenario]:
        """List where fingers and blocks touch, and where blocks come and go."""
        return scenarios(world)

    def compose(self, options: Options) -> tuple[Composition, list[Variable]]:
        """Leave out absent entities, and variables computed from them.

        An entity of which something cannot be computed any more goes as well, such as the places
        of a pile of which a block is missing. The reward sums up the terms that are left.
        """
        others = list(self.readouts())
        if self.success is not None:
            own = {FRACTION: declared(FRACTION, self.success), SUCCESS: succeeded()}
            others = [own.get(one.name, one) for one in others]
        if self.terminated is not None:
            others.append(declared(TERMINATED, self.terminated))
        entities = (*_always_there(options, self.start), *self.entities())
        entities = tuple(entity for entity in entities if entity.name not in self.absent)
        shared, there = tuple(self.shared()), set[str]()

        def is_whole(variable: Variable) -> bool:
            causes = (parent.name for parent in variable.all_parents)
            return variable.name == REWARD or there.issuperset(causes)

        while self.absent:
            before = len(entities), len(others)
            bodies = (*shared, *(v for entity in entities for v in entity.variables))
            there = {variable.name for variable in (*bodies, *others)}
            entities = tuple(e for e in entities if all(map(is_whole, e.variables)))
            others = [variable for variable in others if is_whole(variable)]
            if before == (len(entities), len(others)):
                others = [_without(one, there) for one in others]
                break
        made = BlockWorld(entities, shared, self, options)
        return made, [*made.variables(), *others]


@lru_cache(maxsize=32)
def _always_there(options: Options, start: tuple[float, ...]) -> tuple[Entity, ...]:
    """List the entities of every goal family; none of them depends on the plan."""
    return (
        robot(options.action_mode, start, options.resolution),
        stage(options.preset),
        light_and_cameras(),
        Entity("clock", clock(options.steps, options.control_period)),
    )


def _without(variable: Variable, there: set[str]) -> Variable:
    """Return the sum of the reward terms that are left; any other variable as it is."""
    mechanism = variable.equation
    if variable.name != REWARD or not isinstance(mechanism, Linear):
        return variable
    terms = zip(names(variable.all_parents), mechanism.weights, strict=True)
    return reward({name: weight for name, weight in terms if name in there})
