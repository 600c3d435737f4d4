"""A world that is asked stays as it is, bit for bit."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

from scm_world.discovery import Design, collect, discover
from scm_world.errors import EngineFailure, InterventionError, NotReset
from scm_world.queries import World, consequences, verify
from scm_world.variables import Action, Box, Exogenous, Hard, Measured, Normal, Reaches

HAS_BULLET = importlib.util.find_spec("pybullet") is not None


def tank(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """A tank that leaks, fills and splashes."""
    level = state["level"] * (1.0 - 0.1 * parameters["leak"])
    return {"level": level + 0.1 * action["pump"] + 0.01 * noise["splash"]}


def stepped() -> World:
    """Make the world of a step function with noise."""
    return World(
        tank,
        parameters=[Exogenous(name="leak", default=0.5, bounds=Box(0.0, 1.0))],
        states=[Measured(name="level", default=1.0, parents=("level", "leak", "pump"))],
        actions=[Action(name="pump", bounds=Box(-1.0, 1.0))],
        noise={"splash": Normal()},
        control_dt=0.1,
    )


def robot(backend: str) -> Callable[[], World]:
    """Give what makes a world of the robot."""
    return lambda: World("reaching", backend=backend)


SYSTEMS: dict[str, tuple[Callable[[], World], str, float]] = {
    "fake": (robot("fake"), "joint_damping", 0.05),
    "mujoco": (robot("mujoco"), "joint_damping", 0.05),
    "bullet": (robot("bullet"), "joint_damping", 0.05),
    "step": (stepped, "leak", 0.2),
}
QUESTIONS: dict[str, Callable[[World, str, float], Any]] = {
    "verify": lambda world, name, value: verify(world, probes=1, held_out=1),
    "discover": lambda world, name, value: discover(world, probes=1),
    "consequences": lambda world, name, value: consequences(world, {name: value}, steps=2),
    "effect": lambda world, name, value: world.effect(name, do={name: value}, n=2, steps=8),
    "counterfactual": lambda world, name, value: world.rollout(steps=8).counterfactual(
        {name: value}
    ),
    "collect": lambda world, name, value: collect(world, Design(), 2, steps=8, causes=[name]),
    "live": lambda world, name, value: world.live("random").step(),
}


def moment(world: Any) -> tuple[Any, ...]:
    """Give all that a world shows of its present."""
    values = {name: value.tobytes() for name, value in world.values().items()}
    earlier = {name: value.tobytes() for name, value in world.previous().items()}
    clock = world.noise.seed, world.episode, world.index
    return values, earlier, world.vector.tobytes(), clock, world.graph.interventions


def in_the_middle(make: Callable[[], World], name: str, value: float) -> World:
    """Go into an episode in which windows are open and pending, and something is waited for."""
    state = "level" if "level" in make().model else "joint_positions"
    world = make().given({
        name: Hard(value, during=(3, 6)),
        "control_index": Hard(0, when=Reaches(state, below=-1e9)),
    })  # fmt: skip
    world.reset(seed=5)
    world.step(0.1 * world.action_high)
    world.do({name: 0.5 * value})
    return world


@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_question_changes_nothing(system: str, question: str) -> None:
    """Values, noise, clock, windows and what was done go on as if nothing had been asked."""
    if system == "bullet" and not HAS_BULLET:
        pytest.skip("Bullet is not installed")
    asked, other = (in_the_middle(*SYSTEMS[system]) for _ in range(2))
    QUESTIONS[question](asked, *SYSTEMS[system][1:])
    assert moment(asked) == moment(other)
    for _ in range(6):
        for world in (asked, other):
            world.step(0.5 * world.action_high)
        assert moment(asked) == moment(other)
    for world in (asked, other):
        world.reset()
    assert moment(asked) == moment(other)


@pytest.mark.parametrize("question", ["verify", "discover"])
def test_a_world_without_an_episode_has_none_afterwards(question: str) -> None:
    """It has no values, and its first episode is the one that it would have had."""
    asked, other = World("pushing", backend="fake"), World("pushing", backend="fake")
    QUESTIONS[question](asked, "tool_block.mass", 0.1)
    with pytest.raises(NotReset):
        asked.values()
    for world in (asked, other):
        world.reset(seed=3)
    assert moment(asked) == moment(other)


def test_an_error_on_the_way_changes_nothing() -> None:
    """Neither a refused intervention nor one that stops the experiments leaves a trace."""
    world = in_the_middle(*SYSTEMS["mujoco"])
    before = moment(world)
    with pytest.raises(InterventionError):
        consequences(world, {"joint_damping": -1.0})

    def stop(done: int, planned: int) -> None:
        raise RuntimeError

    for ask in (verify, discover):
        with pytest.raises(RuntimeError):
            ask(world, probes=2, progress=stop)
    assert moment(world) == before
    world.step(world["joint_positions"])


def test_a_world_whose_state_is_lost_still_says_so() -> None:
    """After a question it needs a reset as before, and begins the episode that it would have."""

    def burst(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        return {"x": state["x"] * parameters["gain"]}

    def lost() -> World:
        world = World(
            burst,
            parameters=[Exogenous(name="gain", default=1.0, bounds=Box(0.0, 1e308))],
            states=[Measured(name="x", default=2.0, parents=("x", "gain"))],
            control_dt=0.1,
        )
        world.reset(seed=4)
        world.do({"gain": 1e308})
        with pytest.raises(EngineFailure):
            world.step([])
        return world

    asked, other = lost(), lost()
    verify(asked, probes=1)
    for world in (asked, other):
        world.reset()
    assert moment(asked) == moment(other)


def test_an_environment_goes_on_after_its_world_was_verified() -> None:
    """Its episode continues with the same observations and rewards."""
    runs = []
    for ask in (False, True):
        env = gymnasium.make("scm_world/Reaching-v0")
        env.reset(seed=5)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (4, *env.action_space.shape))
        env.step(actions[0])
        if ask:
            verify(env.unwrapped.world, probes=1, held_out=1)
        runs.append([env.step(action)[:2] for action in actions])
    for (one, reward), (other, again) in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)
        assert reward == again


def test_a_local_graph_is_read_without_a_trace() -> None:
    """The control step that is simulated for it is undone."""
    world = World("pushing").given({"floor_friction": Hard(0.2, at=2)})
    world.reset(seed=5)
    before = moment(world)
    world.local_graph(world["joint_positions"])
    assert moment(world) == before
