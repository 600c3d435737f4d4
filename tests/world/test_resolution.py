"""The robot's joints as variables of the whole robot, of each finger, or one by one.

How finely variables are cut changes the graph and nothing else: whatever happens, and whatever
has a name at the coarsest resolution, is the same to the last bit.
"""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from worlds import NEEDS_BULLET, REST, actions

from scm_world import discover
from scm_world.curricula.targets import grouped, matching, settable
from scm_world.discovery.problems import TaskView, problem
from scm_world.env import ScmWorldEnv
from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.queries import World
from scm_world.tasks import TASKS, make_task
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.robot import RESOLUTIONS
from scm_world.variables import Box, Draw, Mechanism, Natural, Parent, Scale, Shift
from scm_world.world.batch import Batch

FINER = RESOLUTIONS[1:]
MODES = ("joint_positions", "joint_torques", "end_effector_positions")
NAMES = ("joint_positions", "joint_velocities", "joint_torques", "end_effector_positions", "action")
NEAR_REST = Draw(Box(tuple(REST - 0.1), tuple(REST + 0.1)))

DOS: dict[int, dict[str, Any]] = {
    0: {"floor_friction": Draw("A"), "joint_positions": Draw("A")},
    2: {"joint_velocities": Shift(0.1), "robot_finger_60_link_2.mass": Scale(0.7)},
    3: {"actuator_noise": 0.05},
    4: {"joint_positions": Scale(0.99)},
    5: {"joint_positions": NEAR_REST, "joint_velocities": [0.1] * 9},
    6: {"action": Draw(Box(-0.3, 0.3))},
    8: {"action": Scale(0.5)},
    9: {"action": Mechanism(lambda joints: 0.5 * joints, ["joint_positions"])},
    11: {"action": Natural()},
}
"""What is done at which control step, under the names of the whole robot."""


def story(task: Any, resolution: str, **options: Any) -> list[dict[str, Any]]:
    """Play an episode with every kind of intervention; give all values at every instant."""
    world = World(task, resolution=resolution, **options)
    world.reset(seed=5, do=DOS[0])
    generator, seen = np.random.default_rng(0), [world.values()]
    for step in range(1, 13):
        if step in DOS:
            world.do(DOS[step])
        world.step(generator.uniform(world.action_low, world.action_high))
        seen.append(world.values())
    world.close()
    return seen


def check(coarse: list[dict[str, Any]], fine: list[dict[str, Any]]) -> None:
    """Compare everything that has a name at both resolutions, bit for bit."""
    for one, other in zip(coarse, fine, strict=True):
        assert one.keys() < other.keys()
        for name, value in one.items():
            assert value.tobytes() == other[name].tobytes(), name
            assert value.dtype == other[name].dtype, name


@pytest.mark.parametrize("mode", MODES)
def test_nothing_that_happens_depends_on_it(mode: str) -> None:
    """Draws, noise, physics and rewards of pushing are the same bits at every resolution."""
    coarse = story("pushing", "vector", action_mode=mode)
    for resolution in FINER:
        check(coarse, story("pushing", resolution, action_mode=mode))


@NEEDS_BULLET
def test_nothing_depends_on_it_on_bullet() -> None:
    """The same on the other engine, of reaching."""
    check(
        story("reaching", "vector", backend="bullet"), story("reaching", "joint", backend="bullet")
    )


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_nothing_depends_on_it_in_any_task(task: str) -> None:
    """The same of all tasks, under both conventions."""
    few = {"num_of_levels": 2, "max_level_width": 0.04} if task.endswith("stacked_blocks") else {}
    for conventions in ("scm_world", "causal_world"):
        coarse, *fine = (
            story(make_task(task, **few), resolution, conventions=conventions)
            for resolution in RESOLUTIONS
        )
        for one in fine:
            check(coarse, one)


def test_the_parts_are_those_of_the_whole() -> None:
    """Each part has the numbers of its joints, under the name of its finger or joint."""
    worlds = {name: World("pushing", resolution=name, backend="fake") for name in FINER}
    for world in worlds.values():
        world.reset(seed=0, do={"joint_positions": REST + 0.01 * np.arange(9.0)})
        world.step(REST)
    finger, joint = worlds.values()
    for index, name in enumerate(hardware.FINGERS):
        three = slice(3 * index, 3 * index + 3)
        one = f"finger_{name}_joint_2"
        for vector, single in (("positions", "position"), ("velocities", "velocity")):
            whole = finger[f"joint_{vector}"]
            np.testing.assert_array_equal(finger[f"finger_{name}.joint_{vector}"], whole[three])
            assert joint[f"{one}.{single}"] == whole[three][2]
        for world in worlds.values():
            tip = world[f"finger_{name}.end_effector_position"]
            np.testing.assert_array_equal(tip, world["end_effector_positions"][three])
        np.testing.assert_array_equal(finger[f"finger_{name}.action"], REST[three])
        assert joint[f"{one}.action"] == REST[three][2]


def test_the_default_has_the_variables_that_it_always_had() -> None:
    """Worlds, snapshots and copies are those of before where no resolution is asked for."""
    world = World("pushing", backend="fake")
    assert world.options.resolution == "vector"
    assert not world.compiled.bundles
    for resolution in FINER:
        finer = World("pushing", backend="fake", resolution=resolution)
        assert [n for n in finer.model if n not in finer.compiled.parts] == list(world.model)
    assert world.identity == World("pushing", backend="fake", resolution="vector").identity
    assert copy.copy(world).options.resolution == "vector"
    with pytest.raises(UnknownOption, match="finger"):
        World("pushing", backend="fake", resolution="arm")


@pytest.mark.parametrize("resolution", FINER)
def test_an_audit_speaks_of_what_was_asked(resolution: str) -> None:
    """Targets are named as in the request; what follows is the same but for the parts."""
    coarse, fine = (World("pushing", resolution=r, backend="fake") for r in ("vector", resolution))
    requests: tuple[dict[str, Any], ...] = (
        {"joint_positions": NEAR_REST, "tool_block.mass": 0.03},
        {"joint_velocities": Shift(0.1)},
        {"action": REST},
        {"action": Draw(Box(-0.3, 0.3))},
    )
    for world in (coarse, fine):
        world.reset(seed=0)
    for request in requests:
        one, other = coarse.do(request), fine.do(request)
        assert str(one) == str(other)
        assert one.targets.keys() == other.targets.keys() == request.keys()
        assert one.followed.keys() == other.followed.keys()
    part = next(name for name in fine.model if name.startswith("finger_60") and "velocit" in name)
    assert fine.do({part: Shift(0.1)}).followed.keys() == set()


REFUSED: tuple[dict[str, Any], ...] = (
    {"joint_positions": [9.0] * 9},
    {"joint_positions": Shift(9.0)},
    {"joint_positions": Scale(np.nan)},
    {"joint_positions": [0.0] * 8},
    {"joint_positions": "rest"},
    {"joint_positions": [0.0] * 9, "robot_height": 0.2},
    {"joint_velocities": Draw("A")},
    {"joint_velocities": Draw(Box(0.0, 99.0))},
    {"joint_torques": [0.0] * 9},
    {"end_effector_positions": [0.0] * 9},
    {"action": [7.0] * 9, "floor_friction": 9.0},
    {"action": Mechanism(lambda index: index, [Parent("control_index", 1)])},
)


@pytest.mark.parametrize("resolution", FINER)
def test_what_is_refused_is_refused_in_the_same_words(resolution: str) -> None:
    """Errors name what was asked for, and the world is as it was."""
    coarse, fine = (World("pushing", resolution=r, backend="fake") for r in ("vector", resolution))
    for request in REFUSED:
        errors = []
        for world in (coarse, fine):
            world.reset(seed=0)
            before = world.snapshot()
            with pytest.raises(InterventionError) as caught:
                world.do(request)
            errors.append(caught.value)
            assert pickle.dumps(world.snapshot()) == pickle.dumps(before)
        assert type(errors[0]) is type(errors[1]), request
        assert errors[0].variable == errors[1].variable
        if errors[0].variable not in ("joint_torques", "end_effector_positions"):
            assert str(errors[0]) == str(errors[1])


def test_spaces_are_those_of_the_whole_robot() -> None:
    """What has to lie in A or B is held against the spaces of the vector."""
    for resolution in ("vector", *FINER):
        world = World("pushing", resolution=resolution, backend="fake")
        world.reset(seed=0)
        world.do({"joint_positions": Draw("A")}, space="A")
        with pytest.raises(InterventionError, match="space B") as caught:
            world.do({"joint_positions": [-1.0, -0.5, -1.0] * 3}, space="B")
        assert caught.value.variable == "joint_positions"


@pytest.mark.parametrize("resolution", FINER)
def test_a_bundle_and_a_part_of_it_are_one_quantity(resolution: str) -> None:
    """To give both in one do is an error; one after another, the later one holds for its part."""
    world = World("pushing", resolution=resolution, backend="fake")
    world.reset(seed=0)
    part = world.model.targets("joint_positions")[-1]
    last = REST[6:] + 0.05 if resolution == "finger" else REST[8] + 0.05
    with pytest.raises(ConflictingTargets) as caught:
        world.do({"joint_positions": REST, part: last})
    assert caught.value.names == ("joint_positions", part)
    world.do({"joint_positions": REST - 0.1})
    world.do({part: last})
    assert world["joint_positions"][-1] == REST[8] + 0.05
    np.testing.assert_array_equal(world["joint_positions"][:6], (REST - 0.1)[:6])
    world.do({"joint_positions": REST})
    np.testing.assert_array_equal(world["joint_positions"], REST)


def test_a_part_of_an_action_that_is_drawn_can_be_set() -> None:
    """The other fingers go on with the numbers of the whole draw, and a release gives it back."""
    wide = Draw(Box(-0.3, 0.3))
    drawn = {}
    for resolution in ("vector", "finger"):
        world = World("pushing", resolution=resolution, backend="fake")
        world.reset(seed=3, do={"action": wide})
        world.step(REST)
        drawn[resolution] = world["action"]
    np.testing.assert_array_equal(drawn["vector"], drawn["finger"])
    world.reset(seed=3, do={"action": wide})
    world.do({"finger_120.action": [0.1, 0.2, 0.3]})
    world.do({"finger_300.action": Natural()})
    again = pickle.loads(pickle.dumps(world))  # noqa: S301 # our own
    for one in (world, again):
        one.step(REST)
        expected = [*drawn["finger"][:3], 0.1, 0.2, 0.3, *REST[6:]]
        np.testing.assert_array_equal(one["action"], expected)


@pytest.mark.parametrize("resolution", FINER)
def test_a_snapshot_goes_on_at_its_own_resolution(resolution: str) -> None:
    """Bit for bit in a copy; a world that is cut otherwise refuses it."""
    world = World("pushing", resolution=resolution)
    world.reset(seed=0, do={"action": Draw(Box(-0.3, 0.3)), "joint_positions": NEAR_REST})
    world.step(REST)
    other = pickle.loads(pickle.dumps(world))  # noqa: S301 # our own
    for one in (world, other):
        one.step(REST)
    np.testing.assert_array_equal(world.vector, other.vector)
    with pytest.raises(SnapshotMismatch):
        World("pushing").restore(world.snapshot())


@pytest.mark.parametrize("resolution", FINER)
def test_questions_have_the_same_answers(resolution: str) -> None:
    """Episodes, counterfactuals and effects under the names of the whole robot."""
    answers = []
    for name in ("vector", resolution):
        world = World("pushing", resolution=name)
        episode = world.rollout("random", seed=1, steps=6, record=("joint_velocities",))
        other = episode.counterfactual({"joint_velocities": Shift(0.2)}, at=3)
        answers.append([episode[n] for n in NAMES] + [other[n] for n in NAMES])
        with world.given({"joint_positions": REST}) as given:
            answers[-1].append(given.rollout("random", seed=2, steps=3)["joint_positions"])
    for one, two in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("resolution", FINER)
def test_worlds_that_are_stepped_together(resolution: str) -> None:
    """A batch does what single worlds do, and its tables know the names of the whole robot."""
    names = ("reward", *NAMES, "finger_60.end_effector_position")
    first = World("picking", resolution=resolution)
    many = [first, *(World(first.structures, resolution=resolution) for _ in range(2))]
    alone = [World(first.structures, resolution=resolution) for _ in range(3)]
    for seed, (one, other) in enumerate(zip(many, alone, strict=True)):
        for world in (one, other):
            world.reset(seed=seed, do={"action": Draw(Box(-0.5, 0.5))} if seed == 1 else None)
    batch = Batch(many, threads=1, names=names)
    for command in actions(4):
        batch.advance(np.tile(command, (3, 1)))
        for row, world in enumerate(alone):
            world.step(command)
            now = world.evaluate(names)
            for name in names:
                column = np.ravel(batch.table(row)[name][row])
                np.testing.assert_array_equal(column, np.ravel(now[name]), err_msg=name)


PARTS = [pytest.param("mujoco"), pytest.param("bullet", marks=NEEDS_BULLET)]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("backend", PARTS)
def test_fingers_that_do_not_touch_leave_each_other_alone(backend: str, mode: str) -> None:
    """State, masses and action of one finger change nothing about the others, not a last digit."""
    world = World("pushing", resolution="finger", backend=backend, action_mode=mode)
    world.reset(seed=0, do={"joint_positions": np.tile([0.0, 0.9, -1.7], 3)})
    world.do({"joint_velocities": Shift(0.2)})
    hold = {"joint_torques": np.zeros(9), "joint_positions": world["joint_positions"]}
    action = hold.get(mode, world["end_effector_positions"])
    world.step(action)
    before = world.snapshot()
    world.step(action)
    rest = world.values()
    for name in sorted(n for n in world.model if "finger_60" in n and "link_0" not in n):
        if not world.model.declared(name).settable or name.endswith("color"):
            continue
        world.restore(before)
        world.do({name: Shift(0.01)})
        world.step(action)
        after = world.values()
        for finger in hardware.FINGERS:
            moved = not np.array_equal(
                after[f"finger_{finger}.joint_velocities"],
                rest[f"finger_{finger}.joint_velocities"],
            )
            assert moved == (finger == "60"), (name, finger)


@pytest.mark.parametrize("resolution", FINER)
def test_the_graph_says_so(resolution: str) -> None:
    """No edge from one finger to another holds without contact."""
    world = World("pushing", resolution=resolution, backend="fake")
    fingers = {
        name: finger
        for name in world.model
        for finger in hardware.FINGERS
        if f"finger_{finger}" in name
    }
    across = [
        edge.when
        for edge in world.model.edges
        if edge.lag == 1
        and edge.effect in fingers
        and fingers.get(edge.cause, fingers[edge.effect]) != fingers[edge.effect]
    ]
    assert across
    assert set(across) == {"contact"}


@pytest.mark.slow
@pytest.mark.parametrize("backend", PARTS)
def test_every_edge_between_fingers_is_found(backend: str) -> None:
    """Experiments with the physics recover the graph of fingers, no edge more and none less."""
    report = discover(World("pushing", resolution="finger", backend=backend), probes=16)
    assert (report.score.shd, report.floor) == (0, 0.0)
    assert len(report.declared) == 565


# --- what is built on worlds ---------------------------------------------------------------------


@pytest.mark.parametrize("resolution", FINER)
@pytest.mark.parametrize("mode", ["delta_joint_positions", "end_effector_positions"])
def test_environments_observe_and_reward_the_same(resolution: str, mode: str) -> None:
    """Spaces, observations, rewards and infos of an episode, relative actions included."""
    options: dict[str, Any] = {
        "action_mode": mode,
        "include": ("joint_torques",),
        "observation_mode": "full",
        "start": {"joint_positions": NEAR_REST},
    }
    envs = [ScmWorldEnv("picking", resolution=name, **options) for name in ("vector", resolution)]
    assert envs[0].observation_space == envs[1].observation_space
    (first, _), (second, _) = (env.reset(seed=2) for env in envs)
    generator = np.random.default_rng(0)
    for step in range(6):
        np.testing.assert_array_equal(first, second)
        action = generator.uniform(-1.0, 1.0, 9).astype(np.float32)
        if step == 3:
            for env in envs:
                env.do({"joint_positions": REST})
        (first, *one), (second, *other) = (env.step(action) for env in envs)
        np.testing.assert_equal(one, other)


@pytest.mark.parametrize("resolution", FINER)
def test_curricula_mean_the_same_variables(resolution: str) -> None:
    """Every group of variables has the same names, and what is drawn for them is the same."""
    coarse, fine = (World("pushing", resolution=r, backend="fake") for r in ("vector", resolution))
    for group in grouped(coarse.compiled):
        found = [matching(world.compiled, [f"@{group}"]) for world in (coarse, fine)]
        assert found[0] == found[1], group
    names = [set(settable(world.compiled)) for world in (coarse, fine)]
    assert names[0] < names[1]
    assert "action" not in names[1]


def test_a_later_plan_for_a_whole_takes_the_place_of_one_for_a_part() -> None:
    """The other way round it says so: what one plan draws as a whole cannot be given in part."""
    world = World("pushing", resolution="finger", backend="fake")
    part = {"finger_120.joint_velocities": [0.1] * 3}
    episode = world.rollout(seed=0, steps=2, do=part)
    other = episode.counterfactual({"joint_velocities": [0.2] * 9}, at=0)
    assert other["joint_velocities"][0].tolist() == [0.2] * 9
    with pytest.raises(ConflictingTargets):
        other.counterfactual(part, at=0)


def test_what_is_learnt_by_step_has_one_truth() -> None:
    """A data set has the joints of the whole robot, and the actions of the resolution."""
    truths = []
    for resolution in RESOLUTIONS:
        options = {"resolution": resolution, "backend": "fake"}
        made = problem("pushing", view=TaskView("step", options=options))
        assert set(made.data("see", 5, 0).variables) == set(made.truth.names)
        edges = set(made.truth.edges)
        commands = {cause for cause, _, _ in edges if cause.endswith("action")}
        assert {("joint_positions", 1), ("tool_block.linear_velocity", 1)} <= {
            (effect, lag) for cause, effect, lag in edges if cause in commands
        }
        assert len(commands) == {"vector": 1, "finger": 3, "joint": 9}[resolution]
        truths.append({edge for edge in edges if edge[0] not in commands})
        made.close()
    assert truths[0] == truths[1] == truths[2]
