"""Worlds that are stepped together do what each would do alone."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from worlds import BACKENDS, NEEDS_BULLET

from scm_world.errors import NotReset, UnknownOption
from scm_world.tasks import TASKS, Pushing
from scm_world.tasks.rewards import term
from scm_world.variables import Function, Measured, Mechanism
from scm_world.world import Simulation
from scm_world.world.batch import Batch

COUNT = 4
ENGINES = [pytest.param(b, marks=NEEDS_BULLET if b == "bullet" else ()) for b in BACKENDS]
NAMES = ("reward", "success", "fractional_success", "end_effector_positions")


def worlds(task: Any = "pushing", count: int = COUNT, **options: Any) -> list[Simulation]:
    """Make worlds that share what is declared, each at the beginning of another episode."""
    first = Simulation(task, **options)
    found = [first, *(Simulation(first.structures, **options) for _ in range(count - 1))]
    for seed, world in enumerate(found):
        world.reset(seed=seed)
    return found


def commands(world: Simulation, steps: int) -> Any:
    """Draw commands for all worlds, shape (steps, n, 9)."""
    generator = np.random.default_rng(0)
    return generator.uniform(world.action_low, world.action_high, (steps, COUNT, 9))


def check(batch: Batch, alone: list[Simulation], rows: Any) -> None:
    """Compare what a table has with what worlds say."""
    for row in rows:
        now = alone[row].evaluate(NAMES)
        for name in NAMES:
            found = np.ravel(batch.table(row)[name][row])
            np.testing.assert_array_equal(found, np.ravel(now[name]), err_msg=f"{name}, {row}")


def check_whole(batch: Batch, alone: list[Simulation]) -> None:
    """Compare worlds that were handed back with others, value by value and bit by bit."""
    for index, world in enumerate(alone):
        handed = batch.world(index)
        for mine, other in (
            (world.values(), handed.values()),
            (world.previous(), handed.previous()),
        ):
            assert mine.keys() == other.keys()
            for name, value in mine.items():
                np.testing.assert_array_equal(other[name], value, err_msg=name)
                assert other[name].dtype == value.dtype


def compare(
    alone: list[Simulation], many: list[Simulation], *, steps: int = 10, threads: int = 2
) -> None:
    """Go on with both kinds, and compare."""
    batch = Batch(many, threads=threads, names=NAMES)
    for step, asked in enumerate(commands(alone[0], steps)):
        which = np.ones(COUNT, dtype=np.bool_)
        which[::2] = step % 4 != 3
        for index in np.flatnonzero(which):
            alone[index].advance(asked[index].copy())
        batch.advance(asked, which)
        check(batch, alone, np.flatnonzero(which))
    check_whole(batch, alone)


@pytest.mark.parametrize("task", TASKS)
def test_every_task(task: str) -> None:
    """Rewards and successes of a batch are those of single worlds, in every task."""
    compare(worlds(task), worlds(task), steps=6)


@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("mode", ["joint_torques", "end_effector_positions"])
def test_every_action_mode(backend: str, mode: str) -> None:
    """Torques and fingertips, too, mean to a batch what they mean to a world."""
    options = {"backend": backend, "action_mode": mode, "preset": "precise"}
    compare(worlds(**options), worlds(**options))


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.parametrize("count", [1, 2, 7])
def test_numbers_of_worlds_and_threads(count: int, threads: int) -> None:
    """What a world does depends neither on how many there are nor on the threads."""
    alone, many = worlds(count=1), worlds(count=count)
    batch = Batch(many, threads=threads, names=NAMES)
    for asked in commands(alone[0], 8):
        alone[0].advance(asked[0].copy())
        batch.advance(np.resize(asked, (count, 9)))
        np.testing.assert_array_equal(batch.table(0).numbers[0, :40], alone[0].vector)


@pytest.mark.parametrize("name", ["tool_block.mass", "block.size", "control_index"])
def test_rows_write_what_they_read(name: str) -> None:
    """A value written to all rows, one for each world or one for all, is the one of each world."""
    alone = worlds(backend="fake", count=3)
    table = Batch(alone).table(0)
    columns = table.compiled.where[name]
    shape = np.shape(table[name])[1:]
    each = np.arange(1.0, 1.0 + 3 * np.prod(shape)).reshape(3, *shape)
    for given in (each, each[1]):
        expected = table.numbers.copy()
        expected[:, columns] = np.broadcast_to(given, (3, *shape)).reshape(3, -1)
        table[name] = given
        np.testing.assert_array_equal(table.numbers, expected)
        np.testing.assert_array_equal(table[name], np.broadcast_to(given, (3, *shape)))


def _lean(joints: Any) -> Any:
    return joints + 0.05


MEDDLING: dict[int, Callable[[Callable[[int], Simulation]], Any]] = {
    1: lambda world: world(0).do({"tool_block.mass": 0.08, "floor_friction": 0.4}),
    2: lambda world: world(1).do({"actuator_noise": 0.1}),
    3: lambda world: world(2).do({"tool_block.linear_velocity": [0.05, 0.02, 0.1]}),
    4: lambda world: world(3).restore(world(0).snapshot()),
    5: lambda world: world(1).reset(seed=11),
    6: lambda world: world(2).do({"action": Mechanism(_lean, ("joint_positions",))}),
    7: lambda world: world(0).do({"block.size": [0.06, 0.06, 0.06]}),
}
"""What is done to which world before some steps."""


@pytest.mark.parametrize("backend", ENGINES)
def test_interventions_in_between(backend: str) -> None:
    """Whatever is done to one of them between steps is done to that one, and to it alone."""
    alone, many = worlds(backend=backend), worlds(backend=backend)
    batch = Batch(many, threads=2, names=NAMES)
    for step, asked in enumerate(commands(alone[0], 12)):
        for world in (alone.__getitem__, batch.world):
            MEDDLING.get(step, lambda _: None)(world)
        for index, world in enumerate(alone):
            world.advance(asked[index].copy())
        batch.advance(asked)
        check(batch, alone, range(COUNT))
    check_whole(batch, alone)


def test_bodies_come_and_go() -> None:
    """A world whose structure changes goes on in another table."""
    alone, many = worlds("general"), worlds("general")
    batch = Batch(many, threads=2, names=NAMES)
    request = next(iter(alone[1].task.nearby(alone[1].values())))
    for step, asked in enumerate(commands(alone[0], 6)):
        if step == 2:
            alone[1].do(request)
            batch.world(1).do(request)
            assert many[1].compiled is not many[0].compiled
        for index, world in enumerate(alone):
            world.advance(asked[index].copy())
        batch.advance(asked)
        check(batch, alone, range(COUNT))
    check_whole(batch, alone)


def test_functions_of_ones_own() -> None:
    """A reward term that is a plain function of Python is computed in its own world."""
    own = term("reward.own", _own, ("tool_block.type", "control_index", NAMES[3]), "Of mine.")
    task = {"terms": [own], "weights": {"reward.own": 2.0}}
    compare(worlds(Pushing(**task)), worlds(Pushing(**task)))


def test_whole_numbers_that_become_fractions() -> None:
    """A function that gives a whole number first and a fraction later is not cut short."""
    half = Measured(name="half", parents=("control_index",), mechanism=Function(_half))
    own = term("reward.own", _plus, ("half", "control_index"), "Of mine.")

    class Halved(Pushing):  # type: ignore[misc] # it is final; a test may
        """Pushing, with one more readout."""

        def dense(self) -> Any:
            """Declare it beside the others."""
            yield half
            yield from super().dense()

    task = {"terms": [own], "weights": {"reward.own": 2.0}}
    compare(worlds(Halved(**task)), worlds(Halved(**task)))


def _half(index: Any) -> Any:
    return int(index) // 2 if int(index) % 2 == 0 else int(index) / 2


def _plus(half: Any, index: Any) -> float:
    return float(half * 10.0 + index)


def _own(kind: Any, index: Any, tips: Any) -> float:
    assert np.ndim(kind) <= 1
    assert int(index) == index
    return float(tips[0] * 3.0 + index)


def test_worlds_must_be_alike() -> None:
    """Worlds of two tasks, no world and no thread are refused with the reason."""
    with pytest.raises(UnknownOption, match="one task"):
        Batch([Simulation("pushing", backend="fake"), Simulation("picking", backend="fake")])
    with pytest.raises(UnknownOption, match="one or more"):
        Batch([])
    with pytest.raises(UnknownOption, match="threads"):
        Batch(worlds(backend="fake"), threads=0)


def test_a_world_without_episode() -> None:
    """Advancing worlds that were never reset is an error."""
    batch = Batch([Simulation("pushing", backend="fake")])
    with pytest.raises(NotReset):
        batch.advance(np.zeros((1, 9)))


def test_a_family_of_other_options() -> None:
    """A world cannot share what is declared for other options."""
    family = Simulation("pushing", backend="fake").structures
    with pytest.raises(UnknownOption, match="structures"):
        Simulation(family, backend="fake", frame_skip=3)


def test_a_copy_of_a_sibling_is_whole() -> None:
    """A world that shares its declarations can be pickled and copied like any other."""
    first = worlds(backend="fake")[1]
    again = pickle.loads(pickle.dumps(first))  # noqa: S301 # our own
    for world in (first, again):
        world.step(np.zeros(9))
    for name, value in first.values().items():
        np.testing.assert_array_equal(again[name], value)
