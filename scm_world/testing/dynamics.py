"""A conformance suite for worlds: determinism, undoing, snapshots, and refusals without a trace."""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import cache
from multiprocessing import get_context
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world._types import Value
from scm_world.errors import InterventionError
from scm_world.testing.values import command, moved, quantities
from scm_world.variables import Draw, Scale, Shift
from scm_world.world import World

SEED = 20_26


class WorldConformance(ABC):
    """Every promise that a world makes, as a test.

    Attributes:
        awake: Interventions without which a variable has no effect: where obstacles are does not
            matter as long as there are none.
    """

    awake: ClassVar[Mapping[str, Mapping[str, Any]]] = {}

    @abstractmethod
    def make(self) -> World:
        """Create a world of the task."""

    @pytest.fixture
    def world(self) -> Iterator[World]:
        """Provide a world at the start of an episode."""
        world = self.make()
        world.reset(seed=SEED)
        yield world
        world.close()

    def prepare(self, world: World, name: str) -> None:
        """Begin an episode in which a variable matters."""
        world.reset(seed=SEED, do=self.awake.get(name))

    def test_one_seed_has_one_future(self, world: World) -> None:
        """Same seed, actions and interventions give the same bits, here and in another process."""
        elsewhere = _pool().submit(_future, type(self), dict(vars(self)))
        first = story(world)
        assert story(world) == first
        assert elsewhere.result(timeout=120) == first

    def test_do_and_undo_leave_no_trace(self, world: World) -> None:
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

    def test_a_snapshot_goes_on_bit_for_bit(self, world: World) -> None:
        """After it was pickled, and after other episodes."""
        play(world, 4)
        saved, values = pickle.dumps(world.snapshot()), world.values()
        future = play(world, 6)
        world.reset()
        play(world, 3)
        world.restore(pickle.loads(saved))  # noqa: S301 # our own
        assert same(world.values(), values)
        assert play(world, 6) == future

    def test_what_is_refused_leaves_no_trace(self, world: World) -> None:
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

    def test_a_reset_leaves_nothing_behind(self, world: World) -> None:
        """After an episode with interventions the next one is as if there had been none."""
        values, future = world.values(), play(world, 5)
        story(world)
        world.reset(seed=SEED)
        assert same(world.values(), values)
        assert play(world, 5) == future


def same(first: Mapping[str, Value], second: Mapping[str, Value]) -> bool:
    """Compare all values of two worlds bit for bit."""
    return first.keys() == second.keys() and all(
        np.asarray(first[name]).tobytes() == np.asarray(second[name]).tobytes() for name in first
    )


def play(world: World, steps: int) -> list[bytes]:
    """Take random actions, always the same ones; give states and rewards."""
    generator, seen = np.random.default_rng(SEED), []
    for _ in range(steps):
        world.step(command(world, generator))
        now = world.evaluate(("reward", "fractional_success"))
        numbers = [now["reward"], now["fractional_success"]]
        seen.append(world.current()[1].vector.tobytes() + np.array(numbers, float).tobytes())
    return seen


def story(world: World) -> list[bytes]:
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
