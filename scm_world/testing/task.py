"""Conformance suites for worlds and for tasks.

Subclass ``TaskConformance`` in a test file, say how to make a world of the task, and pytest runs
the rest::

    class TestMyTask(TaskConformance):
        def make(self) -> Simulation:
            return Simulation(MyTask(), backend="fake")
"""

from __future__ import annotations

import pickle
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import cache
from multiprocessing import get_context
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world._types import Floats, Value
from scm_world.errors import Infeasible, InterventionError, OutOfBounds, SeveralProblems
from scm_world.graph import from_json, to_json
from scm_world.models import Scene
from scm_world.tasks import Timing
from scm_world.tasks.trifinger import hardware
from scm_world.variables import (
    Box,
    Categories,
    Draw,
    Integers,
    Noise,
    Rotations,
    Scale,
    Shift,
    Variable,
)
from scm_world.variables.kinds import SpaceName
from scm_world.variables.reserved import CONTROL_INDEX, SENSOR_NOISE
from scm_world.world import Audit, Simulation, WorldSnapshot

_NAME = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)?")
_SPACES: tuple[SpaceName, ...] = ("A", "B")
SEED = 20_26


class WorldConformance(ABC):
    """Every promise that a world makes, as a test.

    Attributes:
        awake: Interventions without which a variable has no effect: where obstacles are does not
            matter as long as there are none.
    """

    awake: ClassVar[Mapping[str, Mapping[str, Any]]] = {}

    @abstractmethod
    def make(self) -> Simulation:
        """Create a world of the task."""

    @pytest.fixture
    def world(self) -> Iterator[Simulation]:
        """Provide a world at the start of an episode."""
        world = self.make()
        world.reset(seed=SEED)
        yield world
        world.close()

    def prepare(self, world: Simulation, name: str) -> None:
        """Begin an episode in which a variable matters."""
        world.reset(seed=SEED, do=self.awake.get(name))

    def test_one_seed_has_one_future(self, world: Simulation) -> None:
        """Same seed, actions and interventions give the same bits, here and in another process."""
        first = story(world)
        elsewhere = _pool().submit(_future, type(self), dict(vars(self)))
        assert story(world) == first
        assert elsewhere.result(timeout=120) == first

    def test_do_and_undo_leave_no_trace(self, world: Simulation) -> None:
        """Each quantity is set and set back; the next steps are bit-identical."""
        for name in quantities(world):
            self.prepare(world, name)
            play(world, 2)
            start, values = world.snapshot(), world.values()
            future = play(world, 3)
            world.restore(start)
            try:
                moved(world, name)
            except InterventionError:
                continue  # where it stands after two steps, nothing near is feasible
            world.do({name: values[name]})
            assert same(world.values(), values), name
            assert play(world, 3) == future, name

    def test_a_snapshot_goes_on_bit_for_bit(self, world: Simulation) -> None:
        """After it was pickled, and after other episodes."""
        play(world, 4)
        saved, values = pickle.dumps(world.snapshot()), world.values()
        future = play(world, 6)
        world.reset()
        play(world, 3)
        world.restore(pickle.loads(saved))  # noqa: S301 # our own
        assert same(world.values(), values)
        assert play(world, 6) == future

    def test_what_is_refused_leaves_no_trace(self, world: Simulation) -> None:
        """A request of which one part is wrong changes nothing at all."""
        play(world, 2)
        start, values = world.snapshot(), world.values()
        future = play(world, 4)
        world.restore(start)
        for wrong in ({"gravity": [0.0, 0.0, np.nan]}, {"no_such_variable": 1.0}):
            with pytest.raises(InterventionError):
                world.do({"floor_friction": 0.3, "joint_velocities": Shift(0.1), **wrong})
            assert same(world.values(), values)
        assert play(world, 4) == future

    def test_a_reset_leaves_nothing_behind(self, world: Simulation) -> None:
        """After an episode with interventions the next one is as if there had been none."""
        values, future = world.values(), play(world, 5)
        story(world)
        world.reset(seed=SEED)
        assert same(world.values(), values)
        assert play(world, 5) == future


class TaskConformance(WorldConformance):
    """Every promise that a task makes, as a test; those of a world are among them.

    Attributes:
        fulfilled: The fractional success that its own solution reaches at least.
        episodes: How many random episodes the suite plays.
        steps: How many control steps of each.
    """

    fulfilled: ClassVar[float] = 0.99
    episodes: ClassVar[int] = 3
    steps: ClassVar[int] = 40

    # --- declarations ---------------------------------------------------------------------------

    def test_names_are_unique_and_published(self, world: Simulation) -> None:
        """Names are ``entity.quantity``, and none stands for two things."""
        options = world.options
        mode, period = options.action_mode, options.control_period
        timing = Timing(mode, options.preset, period, world.max_episode_length, options.resolution)
        declared = [variable.name for variable in world.task.compose(timing)[1]]
        assert len(set(declared)) == len(declared)
        assert not [name for name in declared if not _NAME.fullmatch(name)]

    def test_every_variable_is_documented(self, world: Simulation) -> None:
        """Each has a unit, and a sentence that begins with a capital and ends with a full stop."""
        for variable in world.model.variables:
            assert variable.unit, variable.name
            assert re.fullmatch(r"[A-Z0-9].*\.", variable.doc, re.DOTALL), variable.name

    def test_what_can_be_set_is_bounded(self, world: Simulation) -> None:
        """Each quantity that ``do`` accepts says what is physically possible."""
        model = world.model
        unbounded = [
            name
            for name in model
            if model.declared(name).settable
            and model.target(name) == name
            and model.declared(name).bounds is None
        ]
        assert not unbounded

    def test_the_start_lies_within_bounds(self, world: Simulation) -> None:
        """Every default is possible."""
        assert not out_of_bounds(world)

    @pytest.mark.parametrize("space", _SPACES)
    def test_spaces_lie_within_bounds(self, world: Simulation, space: SpaceName) -> None:
        """Every draw from A or B, in any coordinates, is possible."""
        values, noise = world.values(), Noise(SEED)
        for variable in world.model.variables:
            source = variable.space(space)
            if source is None:
                continue
            targets = world.model.targets(variable.name)
            for episode in range(20):
                drawn = noise.draw(source, variable.name, variable.shape, values, episode=episode)
                assert variable.in_space(drawn[0], space, values), variable.name
                for target, value in zip(targets, _meant(variable, drawn[0]), strict=True):
                    bounds = world.model.declared(target).bounds
                    assert bounds is None or bounds.contains(value, values), variable.name

    def test_the_model_survives_json(self, world: Simulation) -> None:
        """Written and read again it is the same model."""
        assert from_json(to_json(world.model), trusted=(type(world.task).__module__,)) == (
            world.model
        )

    def test_what_is_observed_is_declared(self, world: Simulation) -> None:
        """The observation consists of variables, and low ends lie below high ones."""
        for part in world.task.observation.rows:
            assert part.variable in world.model
            low, high = part.published or (0.0, 1.0)
            assert (np.asarray(low) <= np.asarray(high)).all()
            if part.low is not None:
                assert (np.asarray(part.low) < np.asarray(part.high)).all()

    # --- physics --------------------------------------------------------------------------------

    def test_every_quantity_is_realised(self, world: Simulation) -> None:
        """Setting any parameter or state changes what stands there, a picture, or the next step.

        Only the noise of sensors does not: it acts where observations are made.
        """
        for name in quantities(world):
            if name == SENSOR_NOISE:
                continue
            self.prepare(world, name)
            before = world.scene(), world.cameras(), world.snapshot()
            moved(world, name)
            differ = _differ(before[0], world.scene()) or before[1] != world.cameras()
            assert differ or _moves_differently(world, before[2]), name

    def test_every_quantity_is_read_back(self, world: Simulation) -> None:
        """What the engine knows it reports as it was given, and the model agrees."""
        for name in quantities(world):
            self.prepare(world, name)
            wanted, audit = moved(world, name)
            entry = audit.targets[name]
            assert entry.applied is not None, name
            np.testing.assert_array_equal(entry.applied, world[name])
            np.testing.assert_allclose(entry.applied, wanted, rtol=1e-9, atol=1e-12)
            if name in world.parameter_keys or name in world.slices:
                assert entry.read_back is not None, name
                np.testing.assert_allclose(entry.read_back, wanted, rtol=1e-6, atol=1e-9)

    def test_random_episodes_are_sound(self, world: Simulation) -> None:
        """No value is impossible or undefined, the reward sums its terms, success is a fraction.

        Each episode begins with interventions drawn from A.
        """
        generator, weights = np.random.default_rng(SEED), world.task.weights
        for episode in range(self.episodes):
            world.reset(seed=episode)
            for name in quantities(world):
                if name in world.static_names and world.model.declared(name).a is not None:
                    with suppress(Infeasible):  # a large block where a finger is
                        world.do({name: Draw("A")})
            for _ in range(self.steps):
                world.step(command(world, generator))
                values = world.values()
                assert not out_of_bounds(world)
                terms = {name: float(values[name]) for name in weights}
                expected = sum(weight * terms[name] for name, weight in weights.items())
                assert float(values["reward"]) == pytest.approx(expected, rel=1e-9, abs=1e-9)
                assert 0.0 <= float(values["fractional_success"]) <= 1.0
                assert int(values["success"]) in (0, 1)

    # --- what counts ----------------------------------------------------------------------------

    def test_standing_still_is_not_success(self, world: Simulation) -> None:
        """At the start there is something left to do, and nothing has been earned."""
        assert world["success"] == 0
        assert world["reward"] == pytest.approx(
            world.task.weights["fractional_success"] * world["fractional_success"]
        )

    def test_the_solution_fulfils_the_task(self, world: Simulation) -> None:
        """After the intervention that the task calls its solution, it is solved."""
        world.do(world.task.solution(world.values()))
        assert float(world["fractional_success"]) >= self.fulfilled
        assert world["success"] == 1

    def test_achieved_and_desired_are_alike(self, world: Simulation) -> None:
        """Both are arrays of one shape, of finite numbers, equal once the task is solved."""
        achieved, desired = world.task.goal.vectors(world.values())
        assert achieved.shape == desired.shape
        assert np.isfinite(achieved).all()
        assert np.isfinite(desired).all()
        world.do(world.task.solution(world.values()))
        np.testing.assert_allclose(*world.task.goal.vectors(world.values()), atol=0.02)


def out_of_bounds(world: Simulation) -> list[str]:
    """Name the variables whose present value is impossible, or not a number."""
    values = world.values()
    return [
        variable.name
        for variable in world.model.variables
        if not np.isfinite(values[variable.name]).all()
        or not (variable.bounds is None or variable.bounds.contains(values[variable.name], values))
    ]


def _differ(one: Scene, other: Scene) -> bool:
    """Tell whether two scenes have other bodies, or the same ones but for their properties."""
    if one.structure != other.structure or len(one.goals) != len(other.goals):
        return True
    parameters = any(
        not np.array_equal(value, other.parameters[key]) for key, value in one.parameters.items()
    )
    goals = any(
        not np.array_equal(getattr(mine, what), getattr(theirs, what))
        for mine, theirs in zip(one.goals, other.goals, strict=True)
        for what in ("size", "position", "orientation", "color")
    )
    return parameters or goals or one.state != other.state or one.light != other.light


def _holding(world: Simulation) -> Floats:
    """Give the action that keeps the robot where it is."""
    joints = world["joint_positions"]
    match world.action_mode:
        case "joint_positions":
            return joints
        case "joint_torques":
            return np.zeros_like(joints)
        case _:
            return world["end_effector_positions"]


def _moves_differently(world: Simulation, before: WorldSnapshot) -> bool:
    """Tell whether the next control step differs from the one that was to be taken before."""
    ends = []
    for instant in (world.snapshot(), before):
        world.restore(instant)
        world.step(_holding(world))
        ends.append(world.scene().state)
    return bool(ends[0] != ends[1])


def _meant(variable: Variable, value: Value) -> tuple[Value, ...]:
    """Give the values of the quantities that a value in other coordinates, or a bundle, means."""
    meant: Any = variable
    if variable.parts:
        parts: tuple[Value, ...] = meant.mechanism.split(value)
        return parts
    if getattr(variable, "inverse", None) is not None:
        return (np.asarray(meant.inverse.bind()(value)),)
    return (value,)


# --- values and actions -------------------------------------------------------------------------


def quantities(world: Simulation) -> list[str]:
    """Name every parameter and state that can be set, each in its own coordinates."""
    model = world.model
    return [
        name
        for name in model
        if model.declared(name).settable
        and model.declared(name).role != "action"
        and model.target(name) == name
        and name != CONTROL_INDEX
    ]


def nearby(world: Simulation, name: str) -> Iterator[Value]:
    """Give other possible values of a variable, near the present one."""
    variable, value = world.model.declared(name), world[name]
    match variable.bounds:
        case Box() as box:
            low, high = box.bounds(variable.shape, world.values())
            inwards = 0.02 * (low + 0.37 * (high - low) - value)
            yield value + inwards
            yield value + 0.02 * (low - value)
            first = np.zeros(variable.shape)
            first.flat[0] = inwards.flat[0]
            yield from (value + first, value - first)
        case Integers(high=most):
            yield np.where(value < most, value + 1, value - 1)
        case Categories(members=members):
            yield np.asarray(next(member for member in members if member != value))
        case Rotations():
            for angle in (0.1, 0.02):  # [rad]
                yield np.array([0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)])
        case _:
            raise ValueError(f"{name} has no bounds to choose from")


def moved(world: Simulation, name: str) -> tuple[Value, Audit]:
    """Give a variable the first nearby value that is feasible: blocks may touch one another.

    Returns:
        The value, and what became of it.
    """
    *others, last = nearby(world, name)
    for value in others:
        try:
            return value, world.do({name: value})
        except (Infeasible, OutOfBounds, SeveralProblems):
            continue
    return last, world.do({name: last})


def command(world: Simulation, generator: np.random.Generator) -> Floats:
    """Draw an action: anywhere in its range, now and then at its ends, or near the rest pose."""
    low, high = world.action_low, world.action_high
    match generator.integers(4):
        case 0:
            return np.asarray(np.where(generator.random(9) < 0.5, low, high))
        case 1 if world.action_mode == "joint_positions":
            return np.asarray(np.array(hardware.REST) + generator.uniform(-0.8, 0.8, 9))
        case _:
            return np.asarray(generator.uniform(low, high))


def same(first: Mapping[str, Value], second: Mapping[str, Value]) -> bool:
    """Compare all values of two worlds bit for bit."""
    return first.keys() == second.keys() and all(
        np.asarray(first[name]).tobytes() == np.asarray(second[name]).tobytes() for name in first
    )


def play(world: Simulation, steps: int) -> list[bytes]:
    """Take random actions, always the same ones; give states and rewards."""
    generator, seen = np.random.default_rng(SEED), []
    for _ in range(steps):
        world.step(command(world, generator))
        now = world.evaluate(("reward", "fractional_success"))
        numbers = [now["reward"], now["fractional_success"]]
        seen.append(world.current()[1].vector.tobytes() + np.array(numbers, float).tobytes())
    return seen


def story(world: Simulation) -> list[bytes]:
    """Play two episodes with all kinds of interventions; give everything that there was."""
    seen = []
    for episode in range(2):
        world.reset(seed=SEED + episode)
        for request in (
            world.task.sample_goal("A"),
            {"gravity": Draw("A"), "robot_finger_60_link_2.mass": Scale(0.7)},
            {"actuator_noise": 0.02, "joint_velocities": Shift(0.1)},
        ):
            with suppress(InterventionError):  # what is refused here is refused everywhere
                world.do(request)
            seen += play(world, 4)
        values = world.values()
        seen += [name.encode() + np.asarray(values[name]).tobytes() for name in sorted(values)]
    return seen


@cache
def _pool() -> ProcessPoolExecutor:
    """Give the other process, which knows nothing of this one."""
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"))


def _future(suite: type[WorldConformance], attributes: dict[str, Any]) -> list[bytes]:
    made = object.__new__(suite)
    vars(made).update(attributes)
    world = made.make()
    try:
        return story(world)
    finally:
        world.close()
