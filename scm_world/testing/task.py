"""Conformance suites for worlds and for tasks.

Subclass ``TaskConformance`` in a test file, return a world of the task, and pytest runs the rest::

    class TestMyTask(TaskConformance):
        def make(self) -> Simulation:
            return Simulation(MyTask(), backend="fake")
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world.errors import Infeasible
from scm_world.graph import from_json, to_json
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.testing.model import (
    SEED,
    actions,
    check_future,
    check_refusal,
    check_undo,
    check_variables,
    moved,
    quantities,
    trajectory,
)
from scm_world.variables import Draw, Noise
from scm_world.variables.kinds import SpaceName
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world import Simulation

__all__ = ["TaskConformance"]


class TaskConformance(ABC):
    """Every promise of a task, as a test.

    Attributes:
        awake: Interventions without which a variable has no effect: places of obstacles do not
            matter in a task without obstacles.
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

    def test_a_seed_and_a_snapshot_have_one_future(self, world: Simulation) -> None:
        """The same bits follow, here after other episodes and in another process."""
        check_future(world, type(self).__module__)

    def test_interventions_leave_no_trace(self, world: Simulation) -> None:
        """Neither an undone nor a refused intervention changes anything at all."""
        assert check_undo(world, (1, 3)) > 0
        check_refusal(world)

    def test_every_variable_is_documented(self, world: Simulation) -> None:
        """Each variable is named ``entity.quantity``, and has a unit, bounds and a sentence."""
        check_variables(world)
        for variable in world.model.variables:
            name = variable.name
            assert re.fullmatch(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)?", name), name
            assert re.fullmatch(r"[A-Z0-9].*\.", variable.doc, re.DOTALL), name
        for name in quantities(world):
            assert world.model.declared(name).bounds is not None, name

    @pytest.mark.parametrize("space", ["A", "B"])
    def test_spaces_lie_within_bounds(self, world: Simulation, space: SpaceName) -> None:
        """Every draw from A or B, in any coordinates, is possible."""
        values, noise, model = world.values(), Noise(SEED), world.model
        for variable in model.variables:
            source = variable.space(space)
            if source is None:
                continue
            for episode in range(20):
                drawn = noise.draw(source, variable.name, variable.shape, values, episode=episode)
                assert variable.in_space(drawn[0], space, values), variable.name
                acted = model.do({variable.name: drawn[0]}, any_variable=True)
                for target in model.targets(variable.name):
                    bounds, value = model.declared(target).bounds, acted.evaluate(target, values)
                    assert bounds is None or bounds.contains(value, values), variable.name

    def test_the_model_survives_json(self, world: Simulation) -> None:
        """Written and read again it is the same model."""
        again = from_json(to_json(world.model), trusted=(type(world.task).__module__,))
        assert again == world.model

    def test_the_observation_is_declared(self, world: Simulation) -> None:
        """The observation consists of variables, and low ends lie below high ones."""
        for part in world.task.observation.rows:
            assert part.variable in world.model
            low, high = part.published or (0.0, 1.0)
            assert (np.asarray(low) <= np.asarray(high)).all()
            if part.low is not None:
                assert (np.asarray(part.low) < np.asarray(part.high)).all()

    def test_every_quantity_is_realised(self, world: Simulation) -> None:
        """Setting any quantity changes the scene, a picture, or the next step.

        Only the noise of sensors does not: it acts on observations.
        """
        for name in quantities(world):
            world.reset(seed=SEED, do=self.awake.get(name))
            before, start = _seen(world), world.snapshot()
            assert moved(world, name), name
            if _seen(world) == before and name != SENSOR_NOISE:
                idle = world.task.idle(world)[None]
                changed = trajectory(world, idle)
                world.restore(start)
                assert not np.array_equal(changed[-1], trajectory(world, idle)[-1]), name

    def test_random_episodes_are_sound(self, world: Simulation) -> None:
        """No value is impossible or undefined, the reward sums its terms, success is a fraction.

        Each episode begins with interventions drawn from A.
        """
        weights = world.task.weights
        for episode in range(2):
            world.reset(seed=episode)
            for name in quantities(world):
                if name in world.static_names and world.model.declared(name).a is not None:
                    with suppress(Infeasible):  # a large block where a finger is
                        world.do({name: Draw("A")})
            for action in actions(world, 25, episode):
                world.step(action)
                check_variables(world)
                values = world.values()
                expected = sum(weight * float(values[name]) for name, weight in weights.items())
                assert float(values["reward"]) == pytest.approx(expected, rel=1e-9, abs=1e-9)
                assert 0.0 <= float(values[FRACTION]) <= 1.0
                assert int(values[SUCCESS]) in (0, 1)

    def test_the_solution_fulfils_the_task(self, world: Simulation) -> None:
        """The reward is zero at the start; after the solution, both goal vectors are alike."""
        assert world[SUCCESS] == 0
        assert world["reward"] == pytest.approx(world.task.weights[FRACTION] * world[FRACTION])
        achieved, desired = world.task.goal.vectors(world.values())
        assert np.isfinite([achieved, desired]).all()  # of one shape
        world.do(world.task.solution(world.values()))
        assert float(world[FRACTION]) >= 0.99
        assert world[SUCCESS] == 1
        achieved, desired = world.task.goal.vectors(world.values())
        np.testing.assert_allclose(achieved, desired, atol=0.02)
        for name, measure in world.task.goal.measures.items():
            if name in world.model:
                assert float(measure(achieved, desired)) == pytest.approx(float(world[name]))


def _seen(world: Simulation) -> tuple[Any, ...]:
    """Return the bodies, their properties, the goals, the light and the cameras, comparable."""
    scene = world.scene()
    numbers = {key: value.tobytes() for key, value in scene.parameters.items()}
    shown = repr((scene.goals, scene.light, world.cameras()))
    return scene.structure, numbers, scene.state.vector.tobytes(), shown
