"""Worlds in one ``World(…, num_worlds=n)``: arrays with a leading axis, each as it is alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest
from worlds import NEEDS_BULLET

from scm_world import SCM, World, do
from scm_world.errors import ActionError, NotReset, OutOfBounds, UnknownOption, UnknownVariable
from scm_world.queries.plans import Plan
from scm_world.tasks import StepTask
from scm_world.variables import (
    Action,
    Box,
    Exogenous,
    Hard,
    Measured,
    Normal,
    Null,
    Shift,
)
from scm_world.world import Batch

N = 3
HINGE = """<mujoco><worldbody><body><joint name="hinge" axis="0 0 1"/><geom size=".1" mass="1"/>
</body></worldbody>
<actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


class Growth(StepTask):
    """A population that grows, with noise."""

    parameters = (Exogenous(name="rate", default=0.1, bounds=Box(0.0, 1.0)),)
    states = (Measured(name="size", default=1.0, parents=("rate", "size", "push")),)
    actions = (Action(name="push", bounds=Box(-1.0, 1.0)),)
    noise: Mapping[str, Any] = {"luck": Normal(0.0, 0.1)}
    control_dt = 0.1

    @staticmethod
    def step(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        """Grow."""
        grown = state["size"] * (1.0 + 0.1 * parameters["rate"]) + action["push"] + noise["luck"]
        return {"size": grown}


KINDS = [
    pytest.param("mujoco", "pushing", "tool_block.mass", [0.02, 0.05, 0.08], id="mujoco"),
    pytest.param(
        "bullet", "pushing", "tool_block.mass", [0.02, 0.05, 0.08], marks=NEEDS_BULLET, id="bullet"
    ),
    pytest.param("step", Growth(), "rate", [0.1, 0.5, 0.9], id="step"),
]


def alike(worlds: Any, alone: list[World]) -> None:
    """Assert that all values are those of worlds by themselves, bit for bit."""
    for name in alone[0].values():
        found = worlds[name]
        np.testing.assert_array_equal(found, [world[name] for world in alone], name)
        assert found.dtype == alone[0][name].dtype
    np.testing.assert_array_equal(worlds.index, [world.index for world in alone])


@pytest.mark.parametrize(("backend", "task", "name", "values"), KINDS)
def test_each_is_the_world_alone(backend: str, task: Any, name: str, values: list[float]) -> None:
    """Resets, steps and interventions by mask are, bit for bit, those of single worlds."""
    worlds: Any = World(task, backend=backend, num_worlds=N)
    alone = [World(task, backend=backend) for _ in range(N)]
    assert isinstance(worlds, Batch)
    assert len(worlds) == N
    with pytest.raises(NotReset):
        worlds.do({name: values})
    worlds.reset(seed=5, do={name: values})
    for seed, world in enumerate(alone):
        world.reset(seed=5 + seed, do={name: values[seed]})
    alike(worlds, alone)
    size = alone[0].compiled.n_actions
    rng = np.random.default_rng(0)
    for step in range(6):
        given = rng.uniform(-2.0, 2.0, (N, size))
        which = np.array([True, step % 2 == 0, step < 4])
        worlds.step(given, where=which)
        if step == 2:
            assert [*worlds.do({name: Shift(0.001)}, where=which)] == [0, 1, 2]
            worlds.do({name: Hard(values[::-1])}, where=~np.array([True, False, False]))
        if step == 3:
            worlds.reset(seed=[None, 9, None], where=np.array([False, True, False]))
        for index in range(N):
            if which[index]:
                alone[index].step(given[index])
            if step == 2:
                alone[index].do({name: Shift(0.001)})
                if index:
                    alone[index].do({name: values[::-1][index]})
            if step == 3 and index == 1:
                alone[index].reset(seed=9)
        alike(worlds, alone)
    worlds.close()


def test_a_refusal_changes_nothing_anywhere() -> None:
    """The error is that of a single world, and says which one; no world has changed."""
    worlds: Any = World("pushing", backend="fake", num_worlds=N)
    with pytest.raises(OutOfBounds, match="world 1"):
        worlds.reset(seed=0, do={"tool_block.mass": [0.02, -1.0, 0.03]})
    assert worlds["tool_block.mass"].tolist() == [0.02] * N  # the episodes begin without it
    worlds.step(np.zeros((N, 9)))
    before = {name: worlds[name] for name in worlds.world(0).model}
    with pytest.raises(OutOfBounds, match="world 2") as refused:
        worlds.do({"tool_block.mass": [0.02, 0.03, -1.0], "floor_friction": 0.4})
    assert refused.value.variable == "tool_block.mass"
    for given in (np.zeros((N, 8)), np.zeros(9), [["a"] * 9] * N):
        with pytest.raises(ActionError, match="worlds have shape"):
            worlds.step(given)
    with pytest.raises(ActionError, match="world 1"):
        worlds.step([[0.0] * 9, [np.nan] * 9, [0.0] * 9])
    for which in ([True, False, False], np.zeros(N, bool), np.ones(2, bool)):
        with pytest.raises(UnknownOption, match="truth values"):
            worlds.do({"floor_friction": 0.4}, where=which)
    for name, value in before.items():
        np.testing.assert_array_equal(worlds[name], value, name)
    with pytest.raises(UnknownVariable):
        worlds["tool_block.mas"]
    for n in (0, 1.5, "3"):
        with pytest.raises(UnknownOption, match="num_worlds"):
            World("pushing", backend="fake", num_worlds=n)  # type: ignore[arg-type]


def test_a_vector_of_the_length_of_the_batch_is_one_value() -> None:
    """Only a leading axis before the whole shape of the variable means one value for each."""
    worlds: Any = World("pushing", backend="fake", num_worlds=N)
    worlds.reset(seed=0, do={"block.size": [0.06, 0.07, 0.08]})
    np.testing.assert_array_equal(worlds["block.size"], [[0.06, 0.07, 0.08]] * N)
    each = np.full((N, 3), 0.05) + 0.01 * np.arange(N)[:, None]
    worlds.do({"block": {"size": each}})
    np.testing.assert_array_equal(worlds["block.size"], each)


def test_each_can_be_asked_and_used_alone() -> None:
    """A world of a batch is a whole world; plans that are given act in it as in one alone."""
    worlds: Any = World("pushing", backend="fake", num_worlds=2)
    alone = [World("pushing", backend="fake") for _ in range(2)]
    plan = do({"floor_friction": Hard(0.3, at=2)})
    worlds.reset(seed=1, do=plan)
    for seed, world in enumerate(alone):
        world.reset(seed=1 + seed, do=plan)
    for step in range(4):
        worlds.step(np.zeros((2, 9)))
        for world in alone:
            world.step(np.zeros(9))
        if step == 1:
            assert worlds.world(0).effect("reward", do={"floor_friction": 0.9}, n=2, steps=2).n == 2
            worlds.world(1).step(np.ones(9))
            alone[1].step(np.ones(9))
        alike(worlds, alone)


@pytest.mark.parametrize("source", ["pushing", "equations"])
def test_the_layers_of_a_plan_hold_in_every_world(source: str) -> None:
    """A shift of a reset acts on the context of its plan, as in a world alone."""
    if source == "pushing":
        made: Any = partial(World, "pushing", backend="fake")
        name, value = "tool_block.mass", 0.05
    else:
        model = SCM([Exogenous(name="x", distribution=Normal())])
        made, name, value = partial(World, model), "x", 5.0
    plan = Plan({name: Shift(0.01)}).over({name: value}, "start")
    worlds, alone = made(num_worlds=2), made()
    worlds.reset(seed=3, do=plan)
    alone.reset(seed=4, do=plan)
    assert worlds[name].tolist() == [value + 0.01] * 2
    assert worlds[name][1] == alone[name]


def test_a_held_action_ends_with_the_episode() -> None:
    """Worlds that acted alone, since an action was held, take their actions after a reset."""
    worlds, alone = World(HINGE, num_worlds=N), World(HINGE)
    for world in (worlds, alone):
        world.reset(seed=0)
        world.do({"motor.control": 0.9})
    worlds.step(np.zeros((N, 1)))
    alone.step(np.zeros(1))
    assert worlds["hinge.position"][0] == alone["hinge.position"] > 0.0
    for world in (worlds, alone):
        world.reset(seed=0)
    worlds.step(np.full((N, 1), -0.25))
    alone.step(np.full(1, -0.25))
    assert worlds["hinge.position"][0] == alone["hinge.position"] < 0.0


def test_audits_of_many_worlds_say_which_bodies_went() -> None:
    """Where nothing else changes, too."""
    worlds = World("pushing", backend="fake", num_worlds=3)
    worlds.reset(seed=0)
    some = np.array([True, False, True])
    assert str(worlds.do({"tool_block": Null()}, where=some)) == "  gone: tool_block in 2 worlds"
