"""What an environment lets one observe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from envs import MADE, PUSHING, REACHING, make, roll

from scm_world.backends.renderer import camera_pixels
from scm_world.env.vector import WIDE, bounds
from scm_world.errors import InterventionError, UnknownOption
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix
from scm_world.graph import SCM
from scm_world.policies import PolicyAbout
from scm_world.tasks.trifinger.cameras import CAMERAS
from scm_world.variables import Box, Derived, Exogenous, Linear
from scm_world.variables.spaces import Affine, Switch


def values(env: Any, observation: Any) -> dict[str, Any]:
    """Cut a vector into its parts."""
    return {name: observation[where] for name, where in env.unwrapped.layout.items()}


@pytest.mark.parametrize("id_", MADE)
def test_full_mode_shows_every_variable(id_: str) -> None:
    """The full observation begins with the structured one and has all variables, in SI units."""
    env = make(id_, observation_mode="full", normalize_observations=False)
    roll(env, 3)
    observation, world = env.unwrapped.observe(), env.unwrapped.world
    plain = make(id_, normalize_observations=False)
    roll(plain, 3)
    structured = plain.unwrapped.observe()
    np.testing.assert_array_equal(observation[: structured.size], structured)
    found = values(env, observation)
    assert set(found) == set(world.model)
    for name, value in world.values().items():
        np.testing.assert_allclose(found[name], value.ravel(), rtol=1e-6, atol=1e-6, err_msg=name)


def test_custom_mode_is_scaled_by_declared_bounds() -> None:
    """A chosen variable goes from -1 at its lower bound to 1 at its upper one."""
    names = ["gravity", "tool_block.friction", "tool_block.mass"]
    env = make(observation_mode="custom", observe=names)
    env.reset(seed=0, options={"do": {"gravity": [-30.0, 0.0, 30.0], "tool_block.friction": 0.5}})
    found = values(env, env.unwrapped.observe())
    assert list(found) == names
    np.testing.assert_allclose(found["gravity"], [-1.0, 0.0, 1.0])
    np.testing.assert_allclose(found["tool_block.friction"], [-0.5])


def test_what_has_no_bounds_is_given_as_it_is() -> None:
    """A reward term declares no bounds: it is not scaled, and its space is as wide as can be."""
    env = make(observation_mode="custom", observe=["success", "reward.block_to_goal"])
    env.reset(seed=0)
    env.unwrapped.do({"tool_block.cartesian_position": [0.0, 0.0, 0.0325]})
    env.step(np.zeros(9))
    env.unwrapped.do({"tool_block.cartesian_position": [0.0, 0.05, 0.0325]})
    world = env.unwrapped.world
    expected = float(world["reward.block_to_goal"])
    assert expected == pytest.approx(0.05)
    np.testing.assert_allclose(env.unwrapped.observe(), [-1.0, expected], rtol=1e-6)
    assert env.observation_space.high.tolist() == [1.0, WIDE]


def test_bounds_that_follow_a_variable_are_as_wide_as_it_makes_them() -> None:
    """A bound that follows another variable is taken at its widest."""
    model = SCM(
        [
            Exogenous(name="n", dtype="integer", bounds={"kind": "integers", "low": 0, "high": 3}),
            Exogenous(name="size", shape=(2,), default=(0.1, 0.1), bounds=Box((0.0, 0.2), 0.4)),
            Exogenous(
                name="place",
                shape=(2,),
                default=(0.0, 0.5),
                bounds=Box(
                    (Affine(parent="size", index=1, scale=-0.5), 0.0),
                    (0.3, Switch(parent="n", below=1.0, above=2.0)),
                ),
            ),
            Derived(name="sum", parents=("n",), mechanism=Linear(weights=(1.0,))),
        ]
    )
    np.testing.assert_allclose(bounds(model, "place"), [[-0.2, 0.0], [0.3, 2.0]])
    assert bounds(model, "n") == ([0.0], [3.0])
    assert bounds(model, "sum") == ([-WIDE], [WIDE])


def test_appended_parts_follow_the_structured_ones() -> None:
    """What is included, the view and the context stand behind the layout in this order."""
    env = make(include=["joint_torques"], keypoints="view", context="observation")
    env.reset(seed=0)
    names = list(env.unwrapped.layout)
    assert env.unwrapped.layout["joint_torques"] == slice(56, 65)
    assert env.unwrapped.layout["keypoints"] == slice(65, 65 + 20)
    rest = names[names.index("keypoints") + 1 :]
    model = env.unwrapped.world.model
    assert {"gravity", "tool_block.mass", "block.size", "goal_block.polar"} <= set(rest)
    assert all(model.declared(name).settable for name in rest)
    assert len(set(names)) == len(names)


def test_privileged_context_is_told_apart() -> None:
    """The privileged context stands beside the observation and follows interventions."""
    env = make(context="privileged")
    first, _ = env.reset(seed=0)
    then, _ = env.reset(seed=0, options={"do": {"tool_block.mass": 0.09}})
    np.testing.assert_array_equal(first["observation"], then["observation"])
    assert np.count_nonzero(first["context"] != then["context"]) == 1
    assert env.observation_space.contains(then)


@pytest.mark.parametrize("history", [0, 2])
def test_a_context_can_be_some_parameters(history: int) -> None:
    """Names or patterns of them, appended or beside the vector, in the order of all of them."""
    both: dict[str, Any] = {"history": history, "normalize_observations": False}
    every, _ = make(context="privileged", **both).reset(seed=0)
    model = make(context="observation").unwrapped
    masses = [name for name in model.appended if name.endswith(".mass")]
    wanted = [*masses, "floor_friction"]
    wanted.sort(key=model.appended.index)
    given = ["floor_friction", "*.mass"]
    env, plain = make(context=given, **both), make(**both)
    assert [*env.unwrapped.appended] == wanted
    seen, _ = env.reset(seed=0)
    bare, _ = plain.reset(seed=0)
    assert seen[:56].tolist() == bare[:56].tolist()
    values = [float(env.unwrapped.world[name]) for name in wanted]
    np.testing.assert_allclose(seen[56 : 56 + len(wanted)], values, rtol=1e-6)
    same, _ = make(context={"observation": given}, **both).reset(seed=0)
    np.testing.assert_array_equal(seen, same)
    beside, _ = make(context={"privileged": given}, **both).reset(seed=0)
    np.testing.assert_array_equal(beside["observation"], bare)
    np.testing.assert_array_equal(beside["context"], seen[56 : 56 + len(wanted)])
    assert len(every["context"]) > len(beside["context"])
    one = make(context="floor_friction", **both)
    assert len(one.reset(seed=0)[0]) == len(bare) + 1 + history
    for same in (["floor_friction"], {"observation": "floor_friction"}):  # for policy files, too
        other = make(context=same, **both).unwrapped
        PolicyAbout.in_env(one).check(other, "it")
        PolicyAbout(task="pushing", env={"context": same, "history": history,
                    "normalize_observations": False}).check(one.unwrapped, "it")  # fmt: skip
    for same in ("*", ["*"], {"observation": "*"}):
        PolicyAbout.in_env(make(context="observation")).check(make(context=same).unwrapped, "it")
    with pytest.raises(UnknownOption, match="context for 'it'"):
        PolicyAbout.in_env(one).check(make(**both).unwrapped, "it")


@pytest.mark.parametrize(
    "context",
    [
        "privileged ones",
        "*.colour",
        ["*.mass", "joint_positions"],
        ["reward"],
        [],
        3,
        [3],
        {"privileged": []},
        {"hidden": "*.mass"},
        {"privileged": "*.mass", "observation": "floor_friction"},
    ],
)
def test_a_context_of_no_parameters_is_refused(context: Any) -> None:
    """What fits nothing, or is not a parameter that an intervention can set."""
    with pytest.raises(UnknownOption, match="context"):
        make(context=context)


def test_a_view_is_the_same_however_axes_are_named() -> None:
    """Quarter turns with exchanged edges, and half turns of the goal, are one box and one view."""
    env = make(keypoints="view", normalize_observations=False)

    def seen(size: Any, turn: float, goal: float, place: float = 0.0) -> Any:
        do = {
            "block.size": size,
            "tool_block.cylindrical_position": [0.05, place, size[2] / 2],
            "tool_block.euler_orientation": [0.0, 0.0, turn],
            "goal_block.euler_orientation": [0.0, 0.0, goal],
        }
        env.reset(seed=0, options={"do": do})
        return env.unwrapped.observe()[env.unwrapped.layout["keypoints"]]

    long, wide, quarter = [0.07, 0.055, 0.06], [0.055, 0.07, 0.06], np.pi / 2
    view = seen(long, 0.3, 0.7)
    np.testing.assert_allclose(view[12:18], [*long, 0.3, 0.4, 0.4], atol=1e-6)
    for other in (
        seen(long, 0.3 + np.pi, 0.7),
        seen(long, 0.3, 0.7 - np.pi),
        seen(wide, 0.3 - quarter, 0.7 - quarter),
        seen(wide, 0.3 + quarter, 0.7 - quarter),
    ):
        np.testing.assert_allclose(other, view, atol=1e-6)
    assert not np.allclose(seen(wide, 0.3, 0.7), view, atol=1e-3)
    tips = env.unwrapped.world["end_effector_positions"].reshape(3, 3)
    own = (tips - env.unwrapped.world["tool_block.cartesian_position"]) @ rotation_matrix(
        from_rotation_vector(np.array([0.0, 0.0, 0.3]))
    )
    np.testing.assert_allclose(view[:9].reshape(3, 3), own, atol=1e-6)


def test_a_view_needs_boxes() -> None:
    """Anything else is refused with what is allowed."""
    for id_, asked in ((PUSHING, "corner"), (REACHING, "view")):
        with pytest.raises(UnknownOption, match="keypoints"):
            make(id_, keypoints=asked)


def test_no_sensor_noise_costs_no_bit() -> None:
    """With the noise set to zero an observation is bit-identical to one without any."""
    env = make(start={"sensor_noise": 0.0})
    for mine, plain in zip(roll(env, 5), roll(make(), 5), strict=True):
        np.testing.assert_array_equal(mine[0], plain[0])


def test_sensor_noise_is_a_function_of_the_instant() -> None:
    """Noise is the same for one seed and however often one looks, and differs between steps."""
    noisy = {"start": {"sensor_noise": 0.01}}
    one, two, other = roll(make(**noisy), 3), roll(make(**noisy), 3), roll(make(**noisy), 3, seed=1)
    clean = roll(make(), 3)
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(one, two, strict=True))
    first, second = (one[i][0] - clean[i][0] for i in (0, 1))
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, other[0][0] - clean[0][0])
    env = make(**noisy)
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.unwrapped.observe(), observation)


def test_sensor_noise_has_the_declared_strength() -> None:
    """Its deviation is the fraction of half the range, and it reaches neither world nor context."""
    env = make(context="privileged", start={"sensor_noise": 0.02})
    clean = make(context="privileged")
    noise = []
    for _ in range(40):
        mine, plain = env.reset()[0], clean.reset()[0]
        inside = np.abs(plain["observation"]) < 0.9
        noise.extend((mine["observation"] - plain["observation"])[inside])
        changed = np.flatnonzero(mine["context"] != plain["context"])
        assert changed.size == 1  # the strength of the noise itself
    assert np.std(noise) == pytest.approx(0.02, rel=0.1)
    assert abs(np.mean(noise)) < 0.002


def test_noisy_numbers_saturate() -> None:
    """Strong noise leaves no number outside of the space."""
    env = make(start={"sensor_noise": 1.0})
    for observation, *_ in roll(env, 20):
        assert env.observation_space.contains(observation)


def test_pixels_show_now_and_then_the_goal() -> None:
    """The second half is the picture of the goals; it stays until someone intervenes."""
    env = make(observation_mode="pixel", image_size=(24, 32), cameras=["300", CAMERAS[0]])
    first, _ = env.reset(seed=0)
    assert first.shape == (4, 3, 24, 32)
    assert first.dtype == np.uint8
    expected = np.empty((2, 3, 24, 32), np.uint8)
    cameras = [CAMERAS[2], CAMERAS[0]]
    assert [camera.name for camera in cameras] == ["300", "60"]
    cameras = [replace(camera, height=24, width=32) for camera in cameras]
    camera_pixels(env.unwrapped.world.scene(), cameras, expected, goals=True)
    np.testing.assert_array_equal(first[2:], expected)
    moved = env.step(np.ones(9))[0]
    assert not np.array_equal(moved[:2], first[:2])
    np.testing.assert_array_equal(moved[2:], first[2:])
    env.unwrapped.do({"goal_block.polar": [0.0, 0.0]})
    assert not np.array_equal(env.unwrapped.observe()[2:], first[2:])
    assert env.unwrapped.layout == {}


def test_the_predecessors_pictures_have_their_channels_last() -> None:
    """Under its conventions a picture has shape (128, 128, 3)."""
    env = make(observation_mode="pixel", conventions="causal_world")
    assert env.reset(seed=0)[0].shape == env.observation_space.shape == (6, 128, 128, 3)


def test_bodies_that_come_are_observed() -> None:
    """An intervention that changes which bodies exist changes the space; a reset undoes it."""
    env = make(REACHING)
    assert env.reset(seed=0)[0].shape == (37,)
    env.unwrapped.do({"number_of_obstacles": 2})
    assert env.observation_space.shape == (37 + 22,)
    observation = env.step(np.zeros(9))[0]
    assert env.observation_space.contains(observation)
    assert list(env.unwrapped.layout)[-1].startswith("obstacle_1.")
    assert env.reset()[0].shape == env.observation_space.shape == (37,)


def test_bodies_that_are_there_from_the_start_are_in_the_space() -> None:
    """A start with other bodies is known to the space before the first reset."""
    env = make(REACHING, start={"number_of_obstacles": 3})
    assert env.observation_space.shape == (37 + 33,)
    assert env.reset(seed=0)[0].shape == (37 + 33,)
    shape = env.reset(options={"do": {"number_of_obstacles": 1}})[0].shape
    assert shape == env.observation_space.shape == (37 + 11,)


def test_layout_names_what_stands_where() -> None:
    """The layout of the structured observation is the documented one."""
    layout = make(PUSHING).unwrapped.layout
    assert layout["time_left_for_task"] == slice(0, 1)
    assert layout["tool_block.orientation"] == slice(35, 39)
    assert layout["goal_block.size"] == slice(46, 49)


COUNT = "number_of_obstacles"


def test_a_shape_may_change_between_episodes() -> None:
    """Where a start draws which bodies there are; the space is that of the present episode."""
    env = make(REACHING, start={COUNT: "A"})
    shapes = set()
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
        shapes.add(observation.shape)
    assert len(shapes) > 1


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"normalize_observations": False},
        {"observation_mode": "full"},
        {"context": "observation"},
        {"start": {COUNT: "A", "sensor_noise": 0.1}},
        {"conventions": "causal_world"},
    ],
)
def test_padding_keeps_one_shape(options: dict[str, Any]) -> None:
    """Every observation lies in the space of the largest structure; what is missing is 0."""
    given = {"start": {COUNT: "A"}, **options, "pad": {COUNT: 5}}
    env = make(REACHING, **given)
    largest = make(REACHING, **{**options, "start": {**options.get("start", {}), COUNT: 5}})
    assert env.observation_space.shape == largest.observation_space.shape
    assert env.unwrapped.layout == largest.unwrapped.layout
    counts = set()
    for seed in range(4):
        seen, _ = env.reset(seed=seed)
        assert env.observation_space.contains(seen)
        there = int(env.unwrapped.world[COUNT])
        counts.add(there)
        for obstacle in range(5):
            pose = seen[env.unwrapped.layout[f"obstacle_{obstacle}.orientation"]]
            assert pose.any() == (obstacle < there)
    assert len(counts) > 1


def test_a_padded_observation_shows_what_is_there_as_ever() -> None:
    """The numbers of bodies that exist are those without padding; one too many is refused."""
    padded, plain = make(REACHING, pad={COUNT: 2}), make(REACHING)
    for env in (padded, plain):
        env.reset(seed=3)
        env.unwrapped.do({COUNT: 1})
    mine, other = (values(env, env.unwrapped.observe()) for env in (padded, plain))
    for name, numbers in other.items():
        np.testing.assert_array_equal(mine[name], numbers)
    assert not any(mine[name].any() for name in mine.keys() - other.keys())
    assert mine.keys() - other.keys()
    now = padded.unwrapped.observe_values(padded.unwrapped.world.values())
    np.testing.assert_array_equal(now, padded.unwrapped.observe())
    with pytest.raises(InterventionError, match="too small"):
        padded.unwrapped.do({COUNT: 3})
    np.testing.assert_array_equal(padded.unwrapped.observe(), now)


@pytest.mark.parametrize("workers", [1, 2])
def test_padded_worlds_of_a_batch_have_different_bodies(workers: int) -> None:
    """They are observed like single environments, in every kind."""
    options = {"backend": "mujoco", "start": {COUNT: "A"}, "pad": {COUNT: 5}}
    envs: Any = gymnasium.make_vec(REACHING, num_envs=3, workers=workers, **options)
    seen, _ = envs.reset(seed=1)
    rows = [seen, envs.step(np.zeros((3, 9), np.float32))[0]]
    envs.close()
    alone = make(REACHING, **options)
    for index in range(3):
        np.testing.assert_array_equal(rows[0][index], alone.reset(seed=1 + index)[0])
        np.testing.assert_array_equal(rows[1][index], alone.step(np.zeros(9, np.float32))[0])
    assert len({int((row[37::11] != 0.0).sum()) for row in rows[0]}) > 1
    alone.close()
