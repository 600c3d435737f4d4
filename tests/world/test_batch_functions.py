"""What functions of Python and compiled ones give is the same in a batch as in a single world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba import njit

from scm_world.tasks import Pushing
from scm_world.tasks.rewards import term
from scm_world.variables import Measured, Parent
from scm_world.world import Simulation
from scm_world.world.batch import Batch

COUNT, STEPS = 3, 10
PLACE, TIME, CLOCK = "tool_block.cartesian_position", "time_left_for_task", "control_index"
ONE, OTHER = "reward.one", "reward.other"
FLOWN = {"tool_block.linear_velocity": [0.05, 0.0, 0.5]}


def _height(place: Any) -> Any:
    return 0 if place[2] < 0.033 else float(place[2])


def _full_height(place: Any) -> Any:
    return 1 if place[2] > 0.033 else float(place[2])


def _kind(value: Any) -> float:
    return float(value) + (0.25 if isinstance(value, int) else 0.5)


def _first(place: Any) -> Any:
    return place[0] + 1.0


def _rounded(value: Any) -> Any:
    return round(float(value), 3) + value.astype(np.int64) % 3


def _short(clock: Any) -> Any:
    return np.float32(0.1) * np.float32(clock)


def _third(value: Any) -> Any:
    return value / 3


def _ahead(place: Any) -> Any:
    return place[0] > 0.0


def _is_truth(value: Any) -> float:
    return 1.5 if isinstance(value, bool | np.bool_) else 2.5


_shown = np.zeros(())


def _again(place: Any) -> Any:
    _shown[...] = place[0]
    return _shown


def _change(before: Any, now: Any) -> Any:
    return now - before


@njit
def _three(clock: Any) -> Any:
    return 3


@njit
def _ratio(one: Any, time: Any) -> Any:
    return one / time


def _own(name: str, parents: tuple[str | Parent, ...], function: Any) -> Measured:
    return term(name, function, parents, "Of the test.")


Terms = Callable[[], tuple[Any, ...]]
KINDS: dict[str, Terms] = {
    "whole at first": lambda: (_own(ONE, (PLACE,), _height), _own(OTHER, (ONE,), _kind)),
    "a fraction at first": lambda: (
        _own(ONE, (PLACE,), _full_height),
        _own(OTHER, (ONE,), _kind),
    ),
    "a scalar of numpy": lambda: (_own(ONE, (PLACE,), _first), _own(OTHER, (ONE,), _rounded)),
    "32 bits": lambda: (_own(ONE, (CLOCK,), _short), _own(OTHER, (ONE,), _third)),
    "a truth value": lambda: (_own(ONE, (PLACE,), _ahead), _own(OTHER, (ONE,), _is_truth)),
    "one array again": lambda: (_own(ONE, (PLACE,), _again), _own(OTHER, (ONE,), _third)),
    "compiled, of a function": lambda: (
        _own(ONE, (PLACE,), _height),
        _own(OTHER, (ONE, TIME), _ratio),
    ),
    "a constant, compiled": lambda: (_own(ONE, (CLOCK,), _three), _own(OTHER, (ONE,), _third)),
    "remembered": lambda: (
        _own(ONE, (PLACE,), _height),
        _own(OTHER, (Parent(ONE, 1), ONE), _change),
    ),
    "without causes": lambda: (_own(ONE, (), _nothing), _own(OTHER, (ONE,), _third)),
}


def _nothing() -> float:
    return 1.5


def _worlds(terms: Terms) -> list[Simulation]:
    first = Simulation(Pushing(terms=terms(), weights={ONE: 1.0, OTHER: 1.0}))
    found = [first, *(Simulation(first.structures) for _ in range(COUNT - 1))]
    for seed, world in enumerate(found):
        world.reset(seed=seed, do=FLOWN if seed else None)
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_types_are_those_of_a_single_world(kind: str) -> None:
    """Whatever type a function gives, what follows from it is the same, bit for bit."""
    alone, many = _worlds(KINDS[kind]), _worlds(KINDS[kind])
    batch = Batch(many, names=("reward", OTHER))
    for _ in range(STEPS):
        batch.advance(np.zeros((COUNT, 9)))
        for row, world in enumerate(alone):
            world.advance(np.zeros(9))
            now = world.evaluate(("reward", OTHER))
            for name in ("reward", OTHER):
                assert batch.table(row)[name][row] == float(now[name]), name


def test_what_is_remembered_is_not_cut_to_a_whole_number() -> None:
    """A number that happens to be whole at first is remembered like any other later."""
    world = _worlds(KINDS["remembered"])[1]
    height, highest = 0.0, 0.0
    for _ in range(STEPS):
        world.advance(np.zeros(9))
        now = world.evaluate((OTHER,))
        assert float(now[OTHER]) == pytest.approx(float(now[ONE]) - height)
        height = float(now[ONE])
        highest = max(highest, height)
    assert 0.0 < highest < 1.0


def test_what_compiled_functions_raise_is_raised() -> None:
    """An error in compiled code is one in a batch too, and no number."""
    own = _own(ONE, (TIME, CLOCK), njit(lambda time, clock: time / (2.0 - clock)))
    worlds = [Simulation(Pushing(terms=[own], weights={ONE: 1.0})) for _ in range(2)]
    for world in worlds:
        world.reset(seed=0)
    batch = Batch(worlds, names=("reward",))
    batch.advance(np.zeros((2, 9)))
    with pytest.raises(ZeroDivisionError):
        batch.advance(np.zeros((2, 9)))
    batch.advance(np.zeros((2, 9)))
    assert batch.world(1).index == 3
