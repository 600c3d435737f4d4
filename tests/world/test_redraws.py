"""What is drawn again takes over what is the same again, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world import Draw, Mechanism, Shift, World
from scm_world.errors import Infeasible, InterventionError
from scm_world.graph import NoiseKey
from scm_world.variables import Box, Function
from scm_world.variables.distributions import Noise, word_of
from scm_world.world import interventions
from scm_world.world.interventions import Transaction
from scm_world.world.philox import philox
from scm_world.world.snapshot import Base


def mean(color: Any) -> float:
    """Make a friction of a color."""
    return 0.3 + 0.1 * float(np.mean(color))


CROWDED: dict[str, Any] = {
    "joint_positions": Draw("A"),
    "tool_block.cylindrical_position": Draw("A|B", stream="one"),
    "goal_block.polar": Draw("B"),
    "block.size": Draw(Box((0.05, 0.05, 0.05), (0.08, 0.08, 0.08))),
    "tool_block.mass": Draw("A"),
    "floor_color": Draw("A"),
    "floor_friction": Mechanism(Function(mean), ["floor_color"]),
    "gravity": Shift([0.0, 0.0, 0.1]),
    "stage_friction": 0.5,
}


@pytest.mark.parametrize(
    ("task", "request_"),
    [
        ("pushing", {"tool_block.cartesian_position": [0, 0, 0.01], "floor_color": Draw("A")}),
        (
            "stacking2",
            {
                "tool_block_1.cartesian_position": [0.0, 0.0, 0.1],
                "tool_block_2.cartesian_position": [0.0, 0.0, 0.1],
                "joint_positions": Draw("A"),
            },
        ),
    ],
)
def test_what_no_draw_changes_is_refused_without_drawing_again(
    task: str, request_: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two bodies in one place that follow no draw are refused after the first one."""
    attempts: list[int] = []
    solve = Transaction.solve

    def counted(done: Transaction, key: NoiseKey, now: Base) -> Any:
        attempts.append(key.attempt)
        return solve(done, key, now)

    world = World(task, backend="fake")
    world.reset(seed=1)
    monkeypatch.setattr(Transaction, "solve", counted)
    with pytest.raises(Infeasible, match="for every draw, '"):
        world.do(request_)
    assert len(attempts) == 1


def test_what_was_asked_in_other_episodes_changes_nothing() -> None:
    """A request that comes again is carried out, or refused, as in a world that never had it."""
    beyond = {**CROWDED, "tool_block.mass": Draw(Box(-0.02, 0.03))}  # none is negative
    requests = [CROWDED] * 4 + [{**CROWDED, "goal_block.polar": Draw("A")}, beyond, beyond, beyond]
    used, refused = World("pushing", backend="fake"), 0
    for episode, request in enumerate(requests):
        found: list[Any] = []
        for world in (used, World("pushing", backend="fake")):
            try:
                world.reset(seed=3, episode=episode, do=request)
            except InterventionError as error:
                refused += 1
                found.append(str(error))
            else:
                saved = world.snapshot()
                assert saved.base is not None
                found.append([world.graph.interventions, saved.base.pending])
                found[-1].append(world.vector.tobytes())
                found[-1] += [value.tobytes() for value in world.values().values()]
        assert found[0] == found[1]
    assert 0 < refused < 6


@pytest.mark.parametrize(
    ("task", "space", "request_"),
    [
        ("pushing", None, {"joint_positions": Draw("A"), "tool_block.size": Draw("A|B")}),
        ("pushing", "A", {"joint_positions": Draw("A"), "tool_block.size": Draw("A|B")}),
        ("pick_and_place", None, {"joint_positions": Draw("A"), "wall_side": Draw("A")}),
    ],
)
def test_a_crowded_request_ends_as_in_a_world_that_never_had_it(
    task: str, space: Any, request_: dict[str, Any]
) -> None:
    """Also where the first draw would be refused for something else than an overlap."""
    used, found = World(task, backend="fake", variables_space=space), [list[Any](), list[Any]()]
    for episode in range(12):
        fresh = World(task, backend="fake", variables_space=space)
        for ends, world in zip(found, (used, fresh), strict=True):
            try:
                world.reset(seed=3, episode=episode, do=request_)
            except InterventionError as error:
                ends.append(str(error))
            else:
                ends.append({name: value.tobytes() for name, value in world.values().items()})
    assert found[0] == found[1]
    assert any(isinstance(end, dict) for end in found[0])


TURNED = {"tool_block.euler_orientation": [0.3, 0.2, 0.0]}
SCREENED: list[tuple[str, dict[str, Any], bool]] = [
    ("pushing", CROWDED, True),
    ("pushing", {"joint_positions": Draw("A"), "robot_height": Draw("A|B")}, True),
    ("pushing", {**TURNED, "tool_block.cylindrical_position": Draw("B")}, False),
    (
        "stacking2",
        {"tool_block_1.cylindrical_position": Draw("A|B"), "joint_positions": Draw("A|B")},
        True,
    ),
    ("reaching", {"number_of_obstacles": 2, "joint_positions": Draw("A")}, True),
    ("reaching", {"number_of_obstacles": Draw("A|B"), "joint_positions": Draw("A")}, True),
    (
        "stacked_blocks",
        {"stack_levels": Draw("A"), "wall_noise": Draw("A"), "joint_positions": Draw("A")},
        True,
    ),
    (
        "general",
        {"nums_objects": Draw("A"), "tool_0.cartesian_position": [0.0, 0.0, 0.0]},
        False,
    ),
]


@pytest.mark.parametrize(("task", "request_", "is_feasible"), SCREENED)
def test_draws_are_looked_at_together_and_the_same_one_is_taken(
    task: str, request_: dict[str, Any], *, is_feasible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Leaving out draws in which bodies overlap changes neither the world nor the error."""
    solved: list[int] = []
    solve = Transaction.solve

    def noted(done: Transaction, key: NoiseKey, now: Base) -> Any:
        solved.append(key.attempt)
        return solve(done, key, now)

    monkeypatch.setattr(Transaction, "solve", noted)
    monkeypatch.setattr(interventions, "ATTEMPTS", 200)
    found: list[Any] = []
    for screened in (True, False):
        world = World(task, backend="fake")
        world.reset(seed=2)
        world.step(world.action_high if "reaching" in task else world.task.idle(world))
        if not screened:
            monkeypatch.setattr(Transaction, "screened_draws", lambda *_: range(200))
        solved.clear()
        try:
            world.do(request_)
        except Infeasible as error:
            found.append(str(error))
        else:
            found.append({name: value.tobytes() for name, value in world.values().items()})
        if screened and is_feasible:
            assert len(solved) < 25
    assert found[0] == found[1]
    assert isinstance(found[0], dict) == is_feasible


@pytest.mark.parametrize("episode", [0, 7, 2**40])
def test_draws_that_are_looked_at_together_have_the_numbers_of_their_streams(episode: int) -> None:
    """The compiled generator gives what that of numpy gives, bit for bit."""
    for n in range(14):
        noise, step = Noise(2**61 + n), 2**32 + n
        names = [f"joints#{attempt}" for attempt in range(20)]
        where = np.array([noise.key, episode, step], dtype=np.uint64)
        found = np.empty((len(names), n))
        philox(where, np.array([*map(word_of, names)], dtype=np.uint64), found)
        for name, row in zip(names, found, strict=True):
            expected = noise.uniforms(name, n=n, episode=episode, step=step)
            np.testing.assert_array_equal(row, expected[0])


def test_crowded_structures_are_drawn_until_one_is_feasible() -> None:
    """Where bodies come and go, each draw of them is followed by other draws of the rest."""
    world = World("reaching", backend="fake")
    drawn = {
        v.name: Draw("A")
        for v in world.model.variables
        if v.settable and v.role in ("parameter", "state") and v.a is not None
    }
    for seed in range(12):
        world.reset(seed=seed, do=drawn)
