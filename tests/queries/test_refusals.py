"""What is refused leaves nothing behind: plans, twins, batches, worlds of equations, files."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from scm_world import SCM, Derived, Exogenous, Hard, Linear, Mechanism, World
from scm_world.errors import (
    InterventionError,
    ModelError,
    NotReset,
    OutOfBounds,
    UnknownOption,
    UnknownVariable,
)
from scm_world.queries import load_episode, save_episode
from scm_world.variables import Normal


@pytest.fixture(scope="module")
def world() -> World:
    """Make a world once; each test begins an episode."""
    return World("pushing", backend="fake")


def test_an_abandoned_episode_gives_its_twin_back(world: World) -> None:
    """Also one in a circle of references, which the collector frees in the middle of another."""
    with pytest.raises(OutOfBounds):
        world.live(seed=3, do={"floor_friction": 99.0})
    episode: Any = world.live(seed=1)
    episode.me = episode
    del episode
    for seed in range(3):
        world.live(seed=seed).close()


def test_a_refused_reset_has_no_plan() -> None:
    """Nothing of it is done later, in an environment as in a world."""
    plan = {"floor_friction": Hard(0.4, at=2), "tool_block.mass": -1.0}
    env = gymnasium.make("scm_world/Pushing-v0", backend="fake")
    env.reset(seed=0)
    with pytest.raises(OutOfBounds):
        env.reset(seed=1, options={"do": plan})
    for _ in range(3):
        env.step(np.zeros(9, np.float32))
    assert env.unwrapped.interventions == ()  # type: ignore[attr-defined]
    made: Any = env.unwrapped
    assert made.world["floor_friction"] == 0.5


def test_a_reset_that_cannot_begin_leaves_the_plan(world: World) -> None:
    """The episode goes on as it was."""
    world.reset(seed=3, do={"floor_friction": Hard(0.9, at=2)})
    for wrong in ({"seed": -5}, {"seed": 1, "episode": -1}, {"seed": 1, "space": "Z"}):
        with pytest.raises(UnknownOption):
            world.reset(**wrong)
    for _ in range(3):
        world.step(world["joint_positions"])
    assert (world.noise.seed, float(world["floor_friction"])) == (3, 0.9)


@pytest.mark.parametrize("way", ["reset", "given", "live", "do"])
def test_a_name_that_nothing_has_is_refused_at_once(world: World, way: str) -> None:
    """Also if its time is to come."""
    ways: dict[str, Any] = {
        "reset": lambda plan: world.reset(seed=1, do=plan),
        "given": world.given,
        "live": lambda plan: world.live(do=plan),
        "do": world.live(seed=1).do,
    }
    with pytest.raises(UnknownVariable, match="did you mean 'floor_friction'"):
        ways[way]({"floor_frictin": Hard(0.4, at=2)})


def grown(mass: Any) -> Any:
    """Return a friction that is impossible for a heavy block."""
    return 0.3 if mass < 0.035 else 99.0


def test_a_refused_plan_of_one_world_changes_none() -> None:
    """No world of a batch has been intervened on or stepped, and the error says which it was."""
    with World("pushing", backend="fake", num_worlds=3) as worlds:
        plan = Mechanism(grown, ["tool_block.mass"], at=1)
        worlds.reset(seed=0, do={"tool_block.mass": [0.02, 0.03, 0.04], "floor_friction": plan})
        worlds.step(worlds["joint_positions"])
        with pytest.raises(InterventionError, match=r"^world 2: "):
            worlds.step(worlds["joint_positions"])
        assert worlds["floor_friction"].tolist() == [0.5, 0.5, 0.5]
        assert worlds.index.tolist() == [1, 1, 1]
        for number in (3, "a"):
            with pytest.raises(UnknownOption, match="world"):
                worlds.world(number)  # type: ignore[arg-type]


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_many_worlds_are_copied_and_pickled(backend: str) -> None:
    """They go on bit for bit."""
    if backend == "bullet":
        pytest.importorskip("pybullet")
    worlds = World("pushing", backend=backend, num_worlds=2)
    worlds.reset(seed=0)
    worlds.step(worlds["joint_positions"] + 0.1)
    sent = pickle.loads(pickle.dumps(worlds))  # noqa: S301 # what was written a moment ago
    everywhere = (worlds, sent, copy.deepcopy(worlds))
    for one in everywhere:
        one.step(np.full((2, 9), 0.1))
    places = {one["joint_positions"].tobytes() for one in everywhere}
    assert len(places) == 1
    for one in everywhere:
        one.close()


def test_a_world_of_equations_is_strict() -> None:
    """It takes no option of an engine, begins with a reset, and has one instant without lags."""
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ]
    )
    for options in ({"threads": 3}, {"backend": "mujoco"}):
        with pytest.raises(UnknownOption, match=next(iter(options))):
            World(model, **options)
    made: Any = World(task=model)
    for ask in (lambda: made["y"], made.values, lambda: made.do({"x": 1.0})):
        with pytest.raises(NotReset):
            ask()
    made.reset(seed=0)
    with pytest.raises(ModelError, match="one instant"):
        made.step([])
    assert made.rollout().counterfactual({"x": 1.0}).final("y") == 2.0


def test_what_has_happened_by_hand_is_saved(world: World, tmp_path: Path) -> None:
    """An episode under way is saved up to the present; what is no episode is refused."""
    live = world.live(seed=0)
    for _ in range(2):
        live.step()
    assert load_episode(save_episode(live, tmp_path / "one")) == live.episode()
    live.close()
    with pytest.raises(UnknownOption, match="of type Episode"):
        save_episode(3, tmp_path / "other")  # type: ignore[arg-type]
