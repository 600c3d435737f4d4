"""A conformance suite for tasks.

Subclass it in a test file, say how to make a world of the task, and pytest runs the rest::

    class TestMyTask(TaskConformance):
        def make(self) -> World:
            return World(MyTask(), backend="fake")
"""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world._types import Floats, Value
from scm_world.errors import Infeasible
from scm_world.graph import from_json, to_json
from scm_world.models import Scene
from scm_world.tasks import Timing
from scm_world.testing.dynamics import SEED, WorldConformance
from scm_world.testing.values import command, moved, quantities
from scm_world.variables import Draw, Noise, Variable
from scm_world.variables.kinds import SpaceName
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world import World, WorldSnapshot

_NAME = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)?")
_SPACES: tuple[SpaceName, ...] = ("A", "B")


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

    def test_names_are_unique_and_published(self, world: World) -> None:
        """Names are ``entity.quantity``, and none stands for two things."""
        declared = [variable.name for variable in _declared(world)]
        assert len(set(declared)) == len(declared)
        assert not [name for name in declared if not _NAME.fullmatch(name)]

    def test_every_variable_is_documented(self, world: World) -> None:
        """Each has a unit, and a sentence that begins with a capital and ends with a full stop."""
        for variable in world.model.variables:
            assert variable.unit, variable.name
            assert re.fullmatch(r"[A-Z0-9].*\.", variable.doc, re.DOTALL), variable.name

    def test_what_can_be_set_is_bounded(self, world: World) -> None:
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

    def test_the_start_lies_within_bounds(self, world: World) -> None:
        """Every default is possible."""
        assert not out_of_bounds(world)

    @pytest.mark.parametrize("space", _SPACES)
    def test_spaces_lie_within_bounds(self, world: World, space: SpaceName) -> None:
        """Whatever is drawn from A or B, in any coordinates, is possible."""
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

    def test_the_model_survives_json(self, world: World) -> None:
        """Written and read again it is the same model."""
        assert from_json(to_json(world.model), trusted=(type(world.task).__module__,)) == (
            world.model
        )

    def test_what_is_observed_is_declared(self, world: World) -> None:
        """The observation consists of variables, and low ends lie below high ones."""
        for part in world.task.observed():
            assert part.variable in world.model
            low, high = part.published
            assert (np.asarray(low) <= np.asarray(high)).all()
            if part.low is not None:
                assert (np.asarray(part.low) < np.asarray(part.high)).all()

    # --- physics --------------------------------------------------------------------------------

    def test_every_quantity_is_realised(self, world: World) -> None:
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

    def test_every_quantity_is_read_back(self, world: World) -> None:
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

    def test_random_episodes_are_sound(self, world: World) -> None:
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

    def test_standing_still_is_not_success(self, world: World) -> None:
        """At the start there is something left to do, and nothing has been earned."""
        assert world["success"] == 0
        assert world["reward"] == pytest.approx(
            world.task.weights["fractional_success"] * world["fractional_success"]
        )

    def test_the_solution_fulfils_the_task(self, world: World) -> None:
        """After the intervention that the task calls its solution, it is solved."""
        world.do(world.task.solution(world.values()))
        assert float(world["fractional_success"]) >= self.fulfilled
        assert world["success"] == 1

    def test_achieved_and_desired_are_alike(self, world: World) -> None:
        """Both are arrays of one shape, of finite numbers, equal once the task is solved."""
        achieved, desired = world.task.goals(world.values())
        assert achieved.shape == desired.shape
        assert np.isfinite(achieved).all()
        assert np.isfinite(desired).all()
        world.do(world.task.solution(world.values()))
        np.testing.assert_allclose(*world.task.goals(world.values()), atol=0.02)


def out_of_bounds(world: World) -> list[str]:
    """Name the variables whose present value is impossible, or not a number."""
    values = world.values()
    return [
        variable.name
        for variable in world.model.variables
        if not np.isfinite(values[variable.name]).all()
        or not (variable.bounds is None or variable.bounds.contains(values[variable.name], values))
    ]


def _declared(world: World) -> list[Variable]:
    """List the declarations as they were written down, duplicates included."""
    options, task = world.options, world.task
    mode, period = options.action_mode, options.control_period
    length, fine = world.max_episode_length, options.resolution
    timing = Timing(mode, options.preset, period, length, fine)
    return [
        *task.compose(timing)[1],
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


def _holding(world: World) -> Floats:
    """Give the action that keeps the robot where it is."""
    joints = world["joint_positions"]
    match world.action_mode:
        case "joint_positions":
            return joints
        case "joint_torques":
            return np.zeros_like(joints)
        case _:
            return world["end_effector_positions"]


def _moves_differently(world: World, before: WorldSnapshot) -> bool:
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
