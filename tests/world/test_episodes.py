"""Facts about episodes: they begin without a trace of the last one, and can be repeated."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import PARAMS, PHYSICS, PUSHING, actions, begin, play, same, shared, story

from scm_world.errors import InterventionError, NotReset, SnapshotMismatch, UnknownOption
from scm_world.variables import Draw, Shift
from scm_world.world import Simulation, Snapshot

HERE = Path(__file__).parent

STORIES = """
import json, sys
sys.path.insert(0, sys.argv[1])
from worlds import story
print(json.dumps([story(*key) for key in json.loads(sys.argv[2])]))
"""

CONTINUE = """
import hashlib, json, pickle, sys
sys.path.insert(0, sys.argv[1])
from worlds import actions, play
from scm_world.world import Simulation
digests = []
for backend, task, path in json.loads(sys.argv[2]):
    world = Simulation(task, backend=backend)
    world.restore(pickle.load(open(path, "rb")))
    digests.append(hashlib.sha256(play(world, actions(20, seed=3)).tobytes()).hexdigest())
print(json.dumps(digests))
"""


def elsewhere(program: str, data: Any) -> list[str]:
    """Run a program in a fresh process."""
    command = [sys.executable, "-c", program, str(HERE), json.dumps(data)]
    run = subprocess.run(  # noqa: S603 our own interpreter
        command, capture_output=True, text=True, check=True
    )
    answer: list[str] = json.loads(run.stdout.splitlines()[-1])
    return answer


KEYS = [tuple(p.values) for p in PARAMS if not any(m.args[0] for m in p.marks)]


def test_the_same_seed_actions_and_interventions_give_the_same_everywhere() -> None:
    """Every value of two episodes is bit-identical in another process, on every engine."""
    assert elsewhere(STORIES, KEYS) == [story(*key) for key in KEYS]


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_reset_leaves_no_trace(backend: str, task: str) -> None:
    """An episode after a wild one equals the first episode of a new world."""
    world = Simulation(task, backend=backend)
    world.reset(seed=1)
    fresh, first = world.values(), play(world, actions(20))
    do = {"gravity": [0.5, 0.0, -4.0], "robot_finger_60_link_3.mass": 0.1, "control_index": 7}
    world.reset(seed=2, do=do)
    play(world, actions(20, seed=2, spread=1.5))
    world.do({"joint_velocities": np.ones(9), "robot_height": 0.36})
    world.reset(seed=1)
    assert same(world.values(), fresh)
    assert not world.graph.interventions
    np.testing.assert_array_equal(play(world, actions(20)), first)
    world.close()


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_an_intervention_at_the_beginning_holds_until_the_next_reset(
    backend: str, task: str
) -> None:
    """reset(do=…) is part of this episode only."""
    world = shared(backend, task)
    world.reset(seed=0)
    fresh = world.values()
    audit = world.reset(seed=0, do={"floor_friction": 0.4})
    assert audit is not None
    assert audit.targets["floor_friction"].read_back == pytest.approx(0.4)
    play(world, actions(5))
    assert world["floor_friction"] == 0.4
    assert world.reset(seed=0) is None
    assert same(world.values(), fresh)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_block_of_another_size_starts_on_the_floor(backend: str, task: str) -> None:
    """The first position derives from the size, to the last bit."""
    world = shared(backend, task)
    for size in (0.0551, 0.0713, 0.0907):
        world.reset(seed=0, do={"block.size": [size, 0.06, size]})
        assert world["tool_block.cartesian_position"].tolist() == [0.0, -0.08, size / 2.0]
        assert world["goal_block.cartesian_position"][2] == size / 2.0
        assert world["reward"] == world["fractional_success"]  # nothing has moved yet


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_the_start_can_be_refined(backend: str, task: str) -> None:
    """Size, then turn, then place: each do before the first step is part of the start."""
    world = shared(backend, task)
    half = np.sin(np.pi / 8), np.cos(np.pi / 8)
    world.reset(seed=0, do={"block.size": [0.06, 0.06, 0.08]})
    world.do({"tool_block.orientation": [half[0], 0.0, 0.0, half[1]]})
    height = (0.06 + 0.08) / 2.0 * np.sqrt(0.5)
    np.testing.assert_allclose(world["tool_block.cartesian_position"], [0.0, -0.08, height])
    world.do({"tool_block.cartesian_position": [0.0, 0.0, 0.1]})
    world.do({"tool_block.mass": 0.04})
    assert world["tool_block.cartesian_position"].tolist() == [0.0, 0.0, 0.1]


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_a_refused_beginning_is_a_beginning(backend: str, task: str) -> None:
    """After a reset with a bad do the episode has begun, without it."""
    world = shared(backend, task)
    world.reset(seed=0)
    fresh = world.values()
    play(world, actions(2))
    with pytest.raises(InterventionError):
        world.reset(seed=0, do={"floor_friction": -1.0})
    assert same(world.values(), fresh)


def test_a_seed_starts_a_sequence_of_episodes() -> None:
    """Draws differ from episode to episode, and the sequence repeats with the seed."""
    world = shared("fake", "pushing")

    def sequence(seed: int | None) -> list[float]:
        values = []
        for episode in range(4):
            world.reset(seed=seed if episode == 0 else None, do={"tool_block.mass": Draw("A")})
            values.append(float(world["tool_block.mass"]))
        return values

    first = sequence(3)
    assert len(set(first)) == 4
    assert sequence(3) == first
    assert sequence(4) != first


def test_worlds_without_a_seed_differ() -> None:
    """Without a seed, noise is fresh."""
    masses = []
    for _ in range(2):
        world = Simulation("pushing", backend="fake")
        world.reset(do={"tool_block.mass": Draw("A")})
        masses.append(float(world["tool_block.mass"]))
    assert masses[0] != masses[1]


def test_a_world_needs_a_reset() -> None:
    """Before the first one there is nothing to ask, step, save or intervene on."""
    world = Simulation("pushing", backend="fake")
    for attempt in (
        world.values,
        world.previous,
        world.scene,
        world.snapshot,
        lambda: world["gravity"],
        lambda: world.step(np.zeros(9)),
        lambda: world.do({"floor_friction": 0.4}),
    ):
        with pytest.raises(NotReset):
            attempt()


@pytest.mark.parametrize("seed", [-1, 0.5, "x", [1]])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    """Nothing else is taken for one."""
    with pytest.raises(UnknownOption, match="seed"):
        shared("fake", "pushing").reset(seed=seed)


# --- snapshots -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_a_snapshot_goes_on_bit_for_bit(backend: str, task: str) -> None:
    """After anything that happened since, restoring repeats the same future."""
    world = begin(backend, task)
    world.do({"gravity": [0.0, 0.0, -6.0], "joint_velocities": Shift(0.2)})
    start, values, before = world.snapshot(), world.values(), world.previous()
    future = play(world, actions(30, seed=3))
    world.reset(seed=9, do={"floor_friction": 0.1})
    play(world, actions(4))
    world.restore(start)
    assert same(world.values(), values)
    assert same(world.previous(), before)
    assert (world.index, world.episode, world.noise.seed) == (3, 0, 0)
    np.testing.assert_array_equal(play(world, actions(30, seed=3)), future)


def test_a_snapshot_goes_on_in_another_process(tmp_path: Path) -> None:
    """Pickled, restored in a new world elsewhere: the same future."""
    import hashlib

    data, digests = [], []
    for backend, task in KEYS:
        world = begin(backend, task)
        world.do({"robot_finger_120_link_1.mass": 0.1, "joint_velocities": Shift(-0.1)})
        path = tmp_path / f"{backend}_{task}.pickle"
        path.write_bytes(pickle.dumps(world.snapshot()))
        data.append((backend, task, str(path)))
        digests.append(hashlib.sha256(play(world, actions(20, seed=3)).tobytes()).hexdigest())
    assert elsewhere(CONTINUE, data) == digests


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_snapshot_remembers_what_was_done_at_its_instant(backend: str, task: str) -> None:
    """Interventions after restoring mean what they would have meant without."""
    world = begin(backend, task)
    world.do({"block.size": Shift(0.005), "tool_block.cartesian_position": Shift([0, 0, 0.1])})
    start: Snapshot = pickle.loads(pickle.dumps(world.snapshot()))  # noqa: S301
    world.do({"block.size": [0.07, 0.06, 0.066]})
    expected = world.values()
    world.restore(start)
    world.do({"block.size": [0.07, 0.06, 0.066]})
    assert same(world.values(), expected)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_snapshot_of_the_beginning_is_a_beginning(backend: str, task: str) -> None:
    """A block that changes its size after restoring the start stands on the floor."""
    world = shared(backend, task)
    world.reset(seed=0, do={"block.size": [0.08] * 3})
    start = world.snapshot()
    play(world, actions(3))
    world.restore(start)
    world.do({"block.size": [0.0713] * 3})
    assert world["tool_block.cartesian_position"].tolist() == [0.0, -0.08, 0.0713 / 2.0]


@pytest.mark.parametrize(
    "options",
    [
        {"task": "reaching"},
        {"backend": "mujoco"},
        {"preset": "precise"},
        {"action_mode": "joint_torques"},
        {"frame_skip": 5},
        {"max_episode_length": 7},
        {"conventions": "causal_world"},
    ],
    ids=str,
)
def test_a_snapshot_of_another_world_is_refused(options: dict[str, Any]) -> None:
    """Task, engine and options have to agree; the world stays as it is."""
    start = begin("fake", "pushing").snapshot()
    world = Simulation(**{"task": "pushing", "backend": "fake", **options})
    world.reset(seed=0)
    values = world.values()
    with pytest.raises(SnapshotMismatch):
        world.restore(start)
    assert same(world.values(), values)
    world.close()


# --- worlds side by side -------------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_two_worlds_do_not_disturb_each_other(backend: str, task: str) -> None:
    """Interleaved with another world, an episode is the same as alone."""
    alone = begin(backend, task)
    expected = play(alone, actions(15, seed=1))
    one, other = (Simulation(task, backend=backend) for _ in range(2))
    one.reset(seed=0)
    other.reset(seed=0, do={"gravity": [0.0, 0.0, -5.0], "robot_height": 0.35})
    rows = []
    for mine, theirs in zip(
        [*actions(3, seed=7), *actions(15, seed=1)], actions(18, seed=2), strict=True
    ):
        rows.append(play(one, [mine])[0])
        play(other, [theirs])
        other.do({"floor_friction": Draw("A")})
    np.testing.assert_array_equal(rows[3:], expected)
    one.close()
    other.close()


@pytest.mark.parametrize(("backend", "task"), PHYSICS)
def test_one_seed_gives_a_counterfactual_pair(backend: str, task: str) -> None:
    """A heavier block in a world with the same seed changes nothing else at the start."""
    one, other = (Simulation(task, backend=backend) for _ in range(2))
    one.reset(seed=4, do={"floor_friction": Draw("A")})
    other.reset(seed=4, do={"floor_friction": Draw("A"), "tool_block.mass": 0.09})
    assert one["floor_friction"] == other["floor_friction"]
    one.close()
    other.close()
