"""Defects of the predecessor that a world does not have, by their numbers in the document."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from given import BACKENDS, ENGINES, begin

from scm_world.errors import Infeasible, SeveralProblems, UnknownVariable
from scm_world.tasks import TASKS, General, PickAndPlace, Picking, Pushing, StackedBlocks
from scm_world.tasks.trifinger import hardware
from scm_world.variables import Box, Draw
from scm_world.world import Simulation

REST = np.array(hardware.REST)
TIPS = "end_effector_positions"


@pytest.mark.parametrize("backend", ENGINES)
def test_d03_tips_go_where_they_are_sent(backend: str) -> None:
    """Without weight on the fingers their tips end within half a millimeter of the target."""
    world = begin("reaching", backend, action_mode=TIPS)
    world.do({"gravity": [0.0, 0.0, 0.0]})
    target = world[TIPS] + np.tile([0.0, 0.0, 0.03], 3)
    for _ in range(100):
        world.step(target)
    np.testing.assert_allclose(world[TIPS], target, atol=5e-4)
    world.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_d03_a_solution_moves_no_goal(backend: str) -> None:
    """Inverse kinematics brings the tips to their goals, and leaves the goals alone."""
    world = begin("reaching", backend)
    before = world.task.goal.vectors(world.values())[1].copy()
    world.do(world.task.solution(world.values()))
    achieved, desired = world.task.goal.vectors(world.values())
    np.testing.assert_array_equal(desired, before)
    np.testing.assert_allclose(achieved, desired, atol=1e-9)
    world.close()


@pytest.mark.parametrize("space", ["A", "B", "A|B"])
def test_d21_goals_across_the_wall_can_always_be_drawn(space: Any) -> None:
    """From every space, together with the side or alone, and they lie in it."""
    world, name = begin("pick_and_place"), "goal_block.cylindrical_position"
    variable = world.model[name]
    for _ in range(20):
        world.reset(do=world.task.sample_goal(space))
        assert variable.in_space(world[name], space, world.values())
        world.reset()
        world.do({name: Draw(space)}, space=space)


@pytest.mark.parametrize("task", [Pushing, Picking, PickAndPlace])
def test_d22_d59_spaces_have_no_memory(task: Any) -> None:
    """After episodes with other sizes and sides, A and B are those of a new world."""
    world = begin(task())
    for space in ("B", "A"):
        world.reset(do={**world.task.sample_goal(space), "block.size": Draw(space)})
        world.step(REST)
        world.do({"block.size": Draw(space)})
    world.reset()
    assert corners(world) == corners(begin(task()))


def corners(world: Simulation) -> dict[str, Any]:
    """Give the corners of all boxes A and B as they are now."""
    values = world.values()
    variables = [world.model.declared(name) for name in world.model]
    return {
        f"{variable.name} in {space}": np.array(box.bounds(variable.shape, values)).tolist()
        for variable in variables
        for space, box in (("A", variable.a), ("B", variable.b))
        if isinstance(box, Box)
    }


@pytest.mark.parametrize("backend", BACKENDS)
def test_d27_d50_nothing_is_put_into_something_else(backend: str) -> None:
    """Two blocks 2 mm in one another are refused, also beside a goal; nothing has changed."""
    world = begin("stacking2", backend)
    before = world.values()
    places = {"tool_block_1": [0.0, 0.0, 0.0325], "tool_block_2": [0.063, 0.0, 0.0325]}
    blocks = {f"{name}.cartesian_position": place for name, place in places.items()}
    for goal in ({}, {"goal_tower.cylindrical_position": [0.1, 2.0, 0.065]}):
        with pytest.raises(Infeasible, match="tool_block_1"):
            world.do({**blocks, **goal})
    now = world.values()
    assert all(np.array_equal(now[name], before[name]) for name in before)
    world.do({**blocks, "tool_block_2.cartesian_position": [0.0655, 0.0, 0.0325]})
    world.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_d50_the_predecessor_takes_blocks_up_to_3_cm_in_one_another(backend: str) -> None:
    """Under its conventions 2 cm are taken, 3.5 cm are not; of a link of the robot, 9.5 mm."""
    world = Simulation("stacking2", backend=backend, conventions="causal_world")
    world.reset(seed=0)
    block = "tool_block_2.cartesian_position"
    world.do({"tool_block_1.cartesian_position": [0.0, 0.0, 0.0325], block: [0.045, 0.0, 0.0325]})
    with pytest.raises(Infeasible, match="35 mm deep"):
        world.do({block: [0.03, 0.0, 0.0325]})
    x, y, z = world["end_effector_positions"][:3]
    for depth, is_taken in ((0.008, True), (0.011, False)):
        place = {block: [x, y, z - hardware.COLLISION["tip"].radius - 0.0325 + depth]}
        if is_taken:
            world.do(place)
        else:
            with pytest.raises(Infeasible, match="link_3"):
                world.do(place)
    world.close()


def test_d28_names_that_do_not_exist_are_errors() -> None:
    """Each of them is told, whether it misses the body or the quantity."""
    with pytest.raises(SeveralProblems) as caught:
        begin().do({"tool_block": {"weight": 1.0}, "toolblock.mass": 0.03, "stage": {"mass": 1.0}})
    assert [type(problem) for problem in caught.value.problems] == [UnknownVariable] * 3


@pytest.mark.parametrize("backend", BACKENDS)
def test_d29_a_reset_restores_what_generates_the_scene(backend: str) -> None:
    """Numbers, dimensions and blocks agree before and after a reset."""
    world = begin("towers", backend)
    first, tools = world.values(), world.task.tools
    world.do({"number_of_blocks_in_tower": [2, 2, 2], "tower_dims": [0.1, 0.1, 0.1]})
    assert len(world.task.tools) == world["number_of_blocks_in_tower"].prod() == 8
    np.testing.assert_allclose(world[f"{world.task.tools[0]}.size"], [0.05] * 3)
    world.reset(seed=0)
    assert world.task.tools == tools == world.structure.blocks
    now = world.values()
    assert all(np.array_equal(now[name], first[name]) for name in first)
    world.close()


@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("task", [General, StackedBlocks])
def test_d31_random_scenes_can_be_replayed(task: Any, backend: str) -> None:
    """The same seed, or a pickled snapshot, gives the same scene and the same future."""
    one, other = Simulation(task(), backend=backend), Simulation(task(), backend=backend)
    goal = {"nums_objects": 3} if task is General else {"stack_levels": 2}
    for world in (one, other):
        world.reset(seed=4, do={**world.task.sample_goal("A"), **goal})
    saved = pickle.dumps(one.snapshot())
    futures = [future(world) for world in (one, other)]
    other.reset(seed=9, do={**other.task.sample_goal("A"), **goal})
    assert future(other) != futures[0]
    other.restore(pickle.loads(saved))  # noqa: S301 # our own
    assert [*futures, future(other)] == [futures[0]] * 3
    for world in (one, other):
        world.close()


def future(world: Simulation) -> list[Any]:
    """Take three steps, and give the goal and all states."""
    taken = [world.task.goal.vectors(world.values())[1].tolist()]
    for _ in range(3):
        world.step(np.array(world.task.start))
        taken.append(world.vector.tolist())
    return taken


@pytest.mark.parametrize("backend", BACKENDS)
def test_d32_everything_in_one_request_reaches_the_engine(backend: str) -> None:
    """Size, mass and friction together are what the engine reports."""
    world = begin(backend=backend)
    asked: dict[str, Any] = {"size": [0.07, 0.06, 0.08], "mass": 0.05, "friction": 0.4}
    world.do({"tool_block": asked})
    found = world.backend.parameters([("tool_block", quantity) for quantity in asked])
    for (_, quantity), value in found.items():
        np.testing.assert_allclose(value, asked[quantity])
    world.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_d33_a_block_that_grows_flies_on(backend: str) -> None:
    """In mid-air it keeps velocity and place; its center rises with its lowest point fixed."""
    world = begin(backend=backend)
    world.do({"tool_block.cartesian_position": [0.05, 0.02, 0.2]})
    world.do({"tool_block.linear_velocity": [0.1, 0.0, 0.0]})
    for _ in range(2):
        world.step(REST)
    before = world.values()
    world.do({"tool_block.size": [0.075, 0.075, 0.075]})
    for what in ("linear_velocity", "angular_velocity", "orientation"):
        np.testing.assert_array_equal(world[f"tool_block.{what}"], before[f"tool_block.{what}"])
    moved = world["tool_block.cartesian_position"] - before["tool_block.cartesian_position"]
    np.testing.assert_allclose(moved, [0.0, 0.0, 0.005], atol=1e-9)
    world.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_d38_an_engine_is_built_once(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Resets, after whatever interventions, load nothing again."""
    world, built = Simulation("pushing", backend=backend), []
    build = type(world.backend).build

    def counted(self: Any, scene: Any) -> None:
        built.append(scene)
        build(self, scene)

    monkeypatch.setattr(type(world.backend), "build", counted)
    for seed in range(5):
        world.reset(seed=seed, do={"block.size": Draw("A"), "tool_block.mass": Draw("B")})
        world.step(REST)
    assert len(built) == 1
    world.close()


OUTSIDE = {
    *("tool.color", "goal.color", "link.color", "stage_color", "link.mass", "joint_positions"),
    *("tool.mass", "blocks_mass", "tool.cylindrical_position", "goal.cylindrical_position"),
    *("number_of_blocks_in_tower", "tower_dims", "stack_levels", "max_level_width"),
    *("number_of_obstacles", "drop_positions"),
}
"""Variables, in some tasks at least; ``link`` stands for all links, ``tool`` for all blocks."""


def test_d53_defaults_outside_of_a_are_listed() -> None:
    """The published numbers are kept, so these defaults, and no others, are not in A."""
    found = {kind(name) for task in TASKS for name in outside(begin(task))}
    assert found == OUTSIDE


def outside(world: Simulation) -> list[str]:
    """Name the published variables whose default is not in A."""
    values, model = world.values(), world.model
    spaced = [name for name in model if model.declared(name).a is not None]
    return [n for n in spaced if not model.declared(n).in_space(values[n], "A", values)]


def kind(name: str) -> str:
    """Give a name without the number of the body."""
    body, _, quantity = name.rpartition(".")
    if body.startswith("robot_finger"):
        return f"link.{quantity}"
    return f"{body.partition('_')[0]}.{quantity}" if body else quantity


@pytest.mark.parametrize("backend", ENGINES)
def test_d56_torques_are_measured(backend: str) -> None:
    """A finger that moves has torques, and the term that penalizes them is their norm."""
    world = begin("reaching", backend)
    world.step(REST + 0.2)
    torques = world["joint_torques"]
    assert (np.abs(torques) > 1e-3).all()
    assert world["reward.torque"] == pytest.approx(-np.linalg.norm(torques))
    world.close()


def test_d58_a_world_has_no_setters() -> None:
    """Action mode, step and length are chosen when a world is made, and never disagree."""
    world: Any = begin(action_mode="joint_torques", frame_skip=3)
    for name in ("action_mode", "frame_skip", "max_episode_length", "action_low", "conventions"):
        with pytest.raises(AttributeError):
            setattr(world, name, getattr(world, name))
    with pytest.raises(AttributeError):
        world.options.frame_skip = 10
    assert (world.max_episode_length, float(world.action_high[0])) == (833, 0.36)


@pytest.mark.parametrize("backend", ENGINES)
def test_d65_inertia_is_a_function_of_mass(backend: str) -> None:
    """Neither a reset nor a mass that is set and set back moves the inertia of a link."""
    world, upper = begin(backend=backend), "robot_finger_60_link_1"
    key = (upper, "inertia")

    def moments() -> Any:
        return world.backend.parameters([key])[key]

    first = moments().copy()
    world.reset()
    np.testing.assert_array_equal(moments(), first)
    world.do({f"{upper}.mass": 0.05})
    np.testing.assert_allclose(moments(), first * 0.05 / 0.14854, rtol=1e-6)
    world.do({f"{upper}.mass": 0.14854})
    np.testing.assert_array_equal(moments(), first)
    np.testing.assert_allclose(sorted(first), [9.430e-5, 5.744e-4, 6.044e-4], rtol=1e-3)
    world.close()
