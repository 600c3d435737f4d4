"""Policies with a name, and the static graph of an episode that they lead to."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.errors import ActionError
from scm_world.graph import SCM, episode_outcome
from scm_world.policies.scripted import NAMED, as_policy
from scm_world.queries import World, nature_graph
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.variables import Box, Draw, Exogenous, Measured, Mechanism, Parent

MODES = ("joint_positions", "end_effector_positions")
PLACE = "tool_block.cartesian_position"
SPEED = "tool_block.linear_velocity"


class Blind:
    """A world of which only the step and the mode can be seen."""

    def __init__(self, index: int, action_mode: str) -> None:
        self.index, self.options = index, SimpleNamespace(action_mode=action_mode)


def way(policy: str, mode: str, steps: int = 20) -> Floats:
    """List the actions of a policy that sees nothing of the world."""
    act: Any = as_policy(policy)
    return np.array([act(Blind(index, mode)) for index in range(steps)])


def tips(policy: str, mode: str, **do: Any) -> Floats:
    """Let an episode happen, and give the fingertips at its end, shape (3, 3) [m]."""
    world = World("pushing", backend="mujoco", action_mode=mode)
    beside = {PLACE: [0.0, 0.13, 0.0325], **do}
    episode = world.rollout(policy, steps=24, do=beside, record=["joint_positions"])
    return forward(episode["joint_positions"][-1], hardware.NOMINAL_HEIGHT).reshape(3, 3)


# --- sweeps ---------------------------------------------------------------------------------------


def test_a_sweep_is_told_in_joints_or_in_fingertips() -> None:
    """Both action modes mean the same places; the end of the way across is hardly in reach."""
    for policy, near in (("sweep", 1e-4), ("across", 0.006)):
        joints, places = (way(policy, mode) for mode in MODES)
        reached = np.array([forward(one, hardware.NOMINAL_HEIGHT).ravel() for one in joints])
        np.testing.assert_allclose(reached, places, atol=near)


def test_a_sweep_goes_to_the_middle() -> None:
    """The three fingertips end 2 cm around it, on the level of a block, and stay there."""
    places = way("sweep", MODES[1]).reshape(-1, 3, 3)
    far = np.hypot(places[..., 0], places[..., 1])
    np.testing.assert_allclose(far[13:], 0.02, atol=1e-9)
    np.testing.assert_allclose(places[13:, :, 2], 0.035)
    assert (np.diff(far, axis=0) <= 1e-12).all()
    np.testing.assert_array_equal(places[14:], places[13:-1])


def test_one_finger_goes_across() -> None:
    """The first fingertip ends on the other side, and the others stay where they are."""
    places = way("across", MODES[1]).reshape(-1, 3, 3)
    rest = forward(np.array(hardware.REST), hardware.NOMINAL_HEIGHT).reshape(3, 3)
    start = rest[0, :2] / np.hypot(*rest[0, :2])
    np.testing.assert_allclose(places[-1, 0, :2] @ start, -0.11, atol=1e-9)
    np.testing.assert_allclose(places[:, 1:], np.broadcast_to(rest[1:], (20, 2, 3)))


@pytest.mark.parametrize("mode", MODES)
def test_the_robot_follows_a_sweep(mode: str) -> None:
    """With nothing in the way the fingertips come near the places they are told."""
    swept, across = tips("sweep", mode), tips("across", mode)
    assert (np.hypot(swept[:, 0], swept[:, 1]) < 0.05).all()
    expected = way("across", MODES[1])[-1].reshape(3, 3)
    assert np.linalg.norm(across[0, :2] - expected[0, :2]) < 0.05
    assert across[0, :2] @ expected[1, :2] > 0.0 or across[0, :2] @ expected[2, :2] > 0.0


@pytest.mark.parametrize("policy", ["sweep", "across"])
def test_a_sweep_pushes_a_block(policy: str) -> None:
    """A block in the way does not stay where it was, and where it ends depends on its mass."""
    world = World("pushing", backend="mujoco")
    start = 0.05 * way(policy, MODES[1])[3, :2] / np.linalg.norm(way(policy, MODES[1])[3, :2])
    ends = []
    for mass in (0.03, 0.09):
        do = {PLACE: [*start, 0.0325], "tool_block.mass": mass}
        episode = world.rollout(policy, steps=20, do=do, record=[PLACE])
        assert np.linalg.norm(episode[PLACE][-1] - episode[PLACE][0]) > 0.02
        ends.append(episode[PLACE][-1])
    assert not np.array_equal(*ends)


@pytest.mark.parametrize("policy", ["sweep", "across"])
def test_every_episode_has_the_same_sweep(policy: str) -> None:
    """Another seed, mass or place changes no action."""
    world = World("pushing", backend="fake")
    one = world.rollout(policy, seed=0, steps=6)
    other = world.rollout(policy, seed=5, episode=3, steps=6, do={"tool_block.mass": 0.09})
    np.testing.assert_array_equal(one.actions, other.actions)
    np.testing.assert_array_equal(one.actions, way(policy, MODES[0], 6))


@pytest.mark.parametrize("policy", ["sweep", "across"])
def test_a_sweep_needs_positions(policy: str) -> None:
    """In the mode of torques it is refused."""
    world = World("pushing", backend="fake", action_mode="joint_torques")
    with pytest.raises(ActionError, match="a sweep needs positions"):
        world.rollout(policy, steps=2)


def test_names_of_policies_are_told() -> None:
    """An unknown one is refused with those there are."""
    assert set(NAMED) == {"random", "sweep", "across", "feedback", "mpc"}
    with pytest.raises(ActionError, match="'random', 'mpc', 'sweep', 'across'"):
        as_policy("dance")


# --- graphs of an episode -------------------------------------------------------------------------


def small() -> SCM:
    """Make a model with two parameters, two states and a readout of both."""
    return SCM(
        [
            Exogenous(name="mass"),
            Exogenous(name="color"),
            Measured(name="speed", parents=("mass", Parent("speed", 1))),
            Measured(name="place", parents=(Parent("speed", 1), Parent("place", 1))),
            Measured(name="success", parents=("place",)),
        ]
    )


def test_outcomes_do_not_act_on_one_another() -> None:
    """What an episode ends with has causes at its beginning only, however many there are."""
    ends = ["speed", "place", "success"]
    graph = episode_outcome(small(), ends, starts=["speed", "place"])
    assert not any(graph.out_degree(end) for end in ends)
    assert set(graph.edges) == {
        *product(["mass", "speed@0"], ends),
        ("place@0", "place"),
        ("place@0", "success"),
    }
    for end in ends:
        alone = episode_outcome(small(), [end], starts=["speed", "place"])
        assert set(alone.predecessors(end)) == set(graph.predecessors(end))


def test_outcomes_of_a_task_do_not_act_on_one_another() -> None:
    """Nor do the states of a block in a world, and colors cause none of them."""
    model = World("pushing", backend="fake").model
    ends = [PLACE, SPEED, "joint_positions", "fractional_success"]
    graph = nature_graph(model, {"tool_block.mass": "A", SPEED: Draw(Box(-1.0, 1.0))}, ends)
    assert nx.is_directed_acyclic_graph(graph)
    assert not any(graph.out_degree(end) for end in ends)
    assert all(graph.has_edge("tool_block.mass", end) for end in ends)
    assert not nx.descendants(graph, "tool_block.color") & set(ends)


def test_a_state_that_nature_draws_is_a_beginning() -> None:
    """It acts on what follows, and what acted on it before is not cut off from its end."""
    model = World("pushing", backend="fake").model
    graph = nature_graph(model, {PLACE: Draw(Box((0, 0, 0.1), (0.01, 0.01, 0.1)))}, [PLACE, SPEED])
    assert graph.has_edge(f"{PLACE}@0", PLACE)
    assert graph.has_edge(f"{PLACE}@0", SPEED)
    assert graph.has_edge("tool_block.mass", PLACE)
    assert graph.has_edge("floor_friction", SPEED)
    assert not list(graph.predecessors(f"{PLACE}@0"))


def test_a_space_that_follows_others_has_edges() -> None:
    """A block on the floor begins at half its height: its size is a cause of where it begins."""
    model = World("pushing", backend="fake").model
    name = "tool_block.cylindrical_position"
    graph = nature_graph(model, {name: "A"}, [PLACE])
    assert set(graph.predecessors(f"{PLACE}@0")) == {"tool_block.size"}
    mechanism = Mechanism(lambda mass: [mass, 0.0, 0.1], ["tool_block.mass"])
    followed = nature_graph(model, {PLACE: mechanism}, [PLACE])
    assert set(followed.predecessors(f"{PLACE}@0")) == {"tool_block.mass"}
