"""Facts about observations that have the last pairs of observation and action."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from envs import PUSHING, make
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from scm_world import SCM, Action, Box, Measured, StepTask, World
from scm_world.env import ScmWorldEnv, ScmWorldVectorEnv
from scm_world.errors import InterventionError, SnapshotMismatch, UnknownOption
from scm_world.evaluation import evaluate, in_world, record
from scm_world.evaluation.recording import Recording
from scm_world.policies import MlpPolicy, save_policy
from scm_world.variables import Derived, Integers, Linear, Parent

K, N = 3, 3
CART = {
    "model": """<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom name="box" type="box" size=".1 .1 .1"/></body></worldbody><actuator><motor name="motor"
    joint="slide" ctrlrange="-1 1" gear="3"/></actuator></mujoco>""",
    "reward": (np.cos, "slide.position"),
    "max_episode_length": 7,
}
OPTIONS: list[dict[str, Any]] = [
    {},
    {"start": {"sensor_noise": 0.05}, "include": ["joint_torques"], "context": "observation"},
    {"action_mode": "delta_joint_positions", "delta_scale": 0.3, "normalize_observations": False},
    {"normalize_actions": False, "keypoints": "view"},
]


def _actions(step: int, env: Any, row: int = 0) -> Any:
    """Return an action, now and then outside of the space."""
    drawn = np.random.default_rng([step, row]).uniform(-0.3, 1.2, env.action_space.shape[-1])
    return (env.action_space.low.ravel()[0] * -drawn).astype(np.float32)


def _stacked(seen: list[Any], taken: list[Any], space: Any, steps: int = K) -> Any:
    """Stack by hand the present observation and the pairs before it, the newest first."""
    found, width = [seen[-1]], len(seen[-1]) + len(space.low)
    for lag in range(1, steps + 1):
        pair = np.zeros(width, np.float32)
        if lag < len(seen):
            pair[:] = [*seen[-1 - lag], *np.clip(taken[-lag], space.low, space.high)]
        found.append(pair)
    return np.concatenate(found)


@pytest.mark.parametrize("options", OPTIONS, ids=["plain", "noise", "relative", "units"])
def test_a_history_is_what_was_observed_and_done(options: dict[str, Any]) -> None:
    """As stacked by hand in an environment without it, also where a ``do`` is between the steps."""
    env, plain = make(history=K, **options).unwrapped, make(**options).unwrapped
    for episode in range(2):
        seen, taken = [plain.reset(seed=episode)[0]], list[Any]()
        found = env.reset(seed=episode)[0]
        for step in range(5):
            np.testing.assert_array_equal(found, _stacked(seen, taken, plain.action_space))
            assert found in env.observation_space
            if step == 2:
                for one in (env, plain):
                    one.do({"tool_block.cartesian_position": [0.05, 0.05, 0.0325]})
                seen[-1] = plain.observe()
                if episode:  # without it, the step observes the instant by itself
                    wanted = _stacked(seen, taken, plain.action_space)
                    np.testing.assert_array_equal(env.observe(), wanted)
                    np.testing.assert_array_equal(env.observe(), env.present()[0])
            taken.append(_actions(step, env))
            found = env.step(taken[-1])[0]
            seen.append(plain.step(taken[-1])[0])
    layout, now = env.layout, env.observe()
    assert sorted(n for one in layout.values() for n in range(one.start, one.stop)) == [
        *range(len(now))
    ]
    last = plain.layout["joint_positions"]
    np.testing.assert_array_equal(now[layout["joint_positions@-1"]], seen[-2][last])
    np.testing.assert_array_equal(now[layout["joint_positions@-3"]], seen[-4][last])
    np.testing.assert_array_equal(
        now[layout["agent.action@-2"]],
        np.clip(taken[-2], plain.action_space.low, plain.action_space.high),
    )


@pytest.mark.parametrize("more", [{}, {"goal_env": True, "context": "privileged"}])
def test_a_history_can_stand_beside_the_observation(more: dict[str, Any]) -> None:
    """With a row for each step; else it is in the part that is called ``observation``."""
    flat, stacked = make(history=2, **more), make(history=2, stack_history=True, **more)
    flat.reset(seed=0), stacked.reset(seed=0)
    for step in range(3):
        action = _actions(step, flat)
        one, other = flat.step(action)[0], stacked.step(action)[0]
        assert other in stacked.observation_space
    assert one in flat.observation_space
    vector = one["observation"] if more else one
    assert other["history"].shape == (2, 56 + 9)
    joined = np.concatenate([other["observation"], other["history"].ravel()])
    np.testing.assert_array_equal(joined, vector)
    assert {*other} - {"history"} == ({*one} if more else {"observation"})
    assert stacked.unwrapped.layout == make().unwrapped.layout


def test_choices_are_numbers_of_a_history() -> None:
    """Whole numbers, as they were given."""
    acts = Action(name="a", bounds=Integers(0, 3), dtype="integer")
    sums = Derived(
        name="s", parents=(Parent("s", 1), Parent("a", 1)), mechanism=Linear(weights=(1.0, 1.0))
    )
    options: dict[str, Any] = {"model": SCM([acts, sums]), "reward": "s", "observe": ["s"]}
    env: Any = gymnasium.make("scm_world/Model-v0", **options, history=2)
    envs: Any = gymnasium.make_vec("scm_world/Model-v0", 2, **options, history=2)
    env.reset(seed=0), envs.reset(seed=0)
    for choice in (2, 1):
        seen, both = env.step(choice)[0], envs.step(np.array([choice, 3]))[0]
    assert seen.tolist() == [3.0, 2.0, 1.0, 0.0, 2.0]
    assert both.tolist() == [seen.tolist(), [6.0, 3.0, 3.0, 0.0, 3.0]]


def _many(kind: str, mode: AutoresetMode, **options: Any) -> Any:
    """Make several environments of a kind."""
    if kind == "native":
        return gymnasium.make_vec(
            "scm_world/Model-v0", N, autoreset_mode=mode, history=K, **CART, **options
        )
    makers = [lambda: gymnasium.make("scm_world/Model-v0", history=K, **CART, **options)] * N
    made: Any = SyncVectorEnv if kind == "sync" else AsyncVectorEnv
    return made(makers, autoreset_mode=mode)


@pytest.mark.parametrize("options", [{}, {"stack_history": True}], ids=["flat", "stacked"])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_batches_remember_like_single_environments(
    mode: AutoresetMode, options: dict[str, Any]
) -> None:
    """Bit for bit, over the ends of episodes."""
    kinds = ["native", "sync", *(["async"] if not options else [])]
    envs = [_many(kind, mode, **options) for kind in kinds]
    first = [one.reset(seed=[4, 5, 6])[0] for one in envs]
    rows = np.random.default_rng(0).uniform(-1.3, 1.3, (17, N, 1)).astype(np.float32)
    paths = [
        [seen, *(one.step(row)[0] for row in rows)] for one, seen in zip(envs, first, strict=True)
    ]
    for path in paths[1:]:
        for one, other in zip(paths[0], path, strict=True):
            for name in one if isinstance(one, dict) else [...]:
                np.testing.assert_array_equal(one[name], other[name])
    for one in envs:
        one.close()


@pytest.mark.parametrize("options", OPTIONS[:2], ids=["plain", "noise"])
def test_a_batch_remembers_after_interventions_masks_and_branches(options: dict[str, Any]) -> None:
    """Each of its rows is that of a single environment that lives the same."""
    place = "tool_block.cartesian_position"
    envs: Any = gymnasium.make_vec(PUSHING, N, backend="fake", history=K, **options)
    alone: Any = [make(history=K, **options).unwrapped for _ in range(N)]
    envs.reset(seed=3)
    for row, one in enumerate(alone):
        one.reset(seed=3 + row)
    for step in range(6):
        actions = np.stack([_actions(step, envs.envs[0], row) for row in range(N)])
        if step == 2:
            envs.do({1: {place: [0.05, 0.05, 0.0325]}})
            alone[1].do({place: [0.05, 0.05, 0.0325]})
            envs.envs[2].unwrapped.do({place: [0.05, -0.05, 0.0325]})
            alone[2].do({place: [0.05, -0.05, 0.0325]})
        if step == 3:
            envs.reset(seed=8, options={"reset_mask": np.array([True, False, False])})
            alone[0].reset(seed=8)
        if step == 4:
            envs.branch(1, 2)
            alone[2].restore(alone[1].snapshot())
        seen = envs.step(actions)[0]
        for row, one in enumerate(alone):
            np.testing.assert_array_equal(seen[row], one.step(actions[row])[0])
    other = pickle.loads(pickle.dumps(envs))  # noqa: S301
    np.testing.assert_array_equal(other.step(actions)[0], envs.step(actions)[0])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])  # noqa: S301
def test_a_snapshot_holds_the_history(copied: Any) -> None:
    """As copies do; one of an environment without it is refused."""
    env = make(history=K).unwrapped
    env.reset(seed=0)
    for step in range(2):
        env.step(_actions(step, env))
    kept, other = env.snapshot(), copied(env)
    path = [env.step(_actions(step, env))[0] for step in (2, 3)]
    env.restore(copied(kept))
    for one in (env, other):
        again = [one.step(_actions(step, env))[0] for step in (2, 3)]
        np.testing.assert_array_equal(again, path)
    plain = make().unwrapped
    plain.reset(seed=0)
    with pytest.raises(SnapshotMismatch, match="another history"):
        env.restore(plain.snapshot())
    with pytest.raises(SnapshotMismatch, match="another history"):
        plain.restore(kept)


def _grown(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Square what is pushed, until no number is large enough."""
    with np.errstate(over="ignore"):
        return {"x": (state["x"] + 1e100) ** 2 if action["push"] > 0.0 else state["x"]}


def test_a_failed_step_is_not_remembered() -> None:
    """Alone and in a batch: the last observation there was is that before."""
    task = StepTask(
        _grown,
        states=[Measured(name="x", parents=("x", "push"))],
        actions=[Action(name="push", bounds=Box(-1.0, 1.0))],
        reward=(np.tanh, "x"),
    )
    options: dict[str, Any] = {"task": task, "history": 2, "on_failure": "truncate"}
    env, envs = ScmWorldEnv(**options), ScmWorldVectorEnv(2, autoreset_mode="Disabled", **options)
    env.reset(seed=0)
    envs.reset(seed=0)
    before = env.step(np.array([0.5]))[0]
    envs.step(np.array([[0.5], [0.5]]))
    after, _, _, truncated, info = env.step(np.array([0.75]))
    both, _, _, cut, _ = envs.step(np.array([[0.75], [-0.25]]))
    assert (truncated, info["failed"]) == (True, True)
    assert cut.tolist() == [True, False]
    np.testing.assert_array_equal(after, before)
    np.testing.assert_array_equal(both[0], before)
    assert both[1].tolist()[2:] == [-0.25, 0.0, 0.5]


def _policy(env: Any) -> MlpPolicy:
    """Return a policy that reads the whole history."""
    random = np.random.default_rng(1)
    space = env.observation_space
    parts = getattr(space, "spaces", {"": space})
    size = sum(int(np.prod(part.shape)) for part in parts.values())
    weight = random.normal(size=(9, size)).astype(np.float32)
    tensors = {"layers.0.weight": weight, "layers.0.bias": np.zeros(9, np.float32)}
    inputs = None if "" in parts else tuple(parts)
    env_options = {n: env.made_with[n] for n in ("history", "stack_history")}
    return MlpPolicy.of(tensors, {"task": "pushing", "env": env_options, "inputs": inputs})


@pytest.mark.parametrize("stacked", [False, True])
def test_recordings_and_policy_files_have_a_history(*, stacked: bool, tmp_path: Path) -> None:
    """A recording replays, a policy acts as by hand, and one of another history is refused."""
    options = {"history": K, "stack_history": stacked, "max_episode_length": 5}
    env: Any = make(**options).unwrapped
    policy = _policy(env)
    made = record(policy, env, 2, seed=1, do={"tool_block.mass": "A"})
    assert Recording.load(made.save(tmp_path / "made")).replay() == 10
    plain: Any = make(max_episode_length=5).unwrapped
    episode = made.episodes[1]
    seen, taken = [plain.reset(seed=1, options={"episode": 1, "do": {"tool_block.mass": "A"}})], []
    seen = [seen[0][0]]
    for step in range(5):
        wanted = _stacked(seen, taken, plain.action_space)
        now = episode.observations[step]
        if stacked:
            now = np.concatenate([now["observation"], now["history"].ravel()])
        np.testing.assert_array_equal(now, wanted)
        taken.append(episode.actions[step])
        np.testing.assert_allclose(taken[-1], policy(episode.observations[step]))
        seen.append(plain.step(taken[-1])[0])
    file = save_policy(tmp_path / "one.safetensors", policy)
    about: dict[str, Any] = {"backend": "fake", "n": 1, "env": {"max_episode_length": 5}}
    found = evaluate({"one": file, "random": "random"}, ["P0"], **about)
    total = float(found.only(agent="one").frame["return"].iloc[0])
    env.reset(seed=0, options={"episode": 0})
    own, over = 0.0, False
    while not over:
        _, reward, _, over, _ = env.step(policy(env.observe()))
        own += reward
    assert total == own
    with pytest.raises(UnknownOption, match="history"):
        evaluate({"one": file}, ["P0"], **{**about, "env": {"history": 1}})


def test_a_policy_with_a_history_acts_in_a_world() -> None:
    """As in its environment."""
    env: Any = make(history=K).unwrapped
    policy = _policy(env)
    world = World("pushing", backend="fake")
    acting = in_world(policy, world)
    world.reset(seed=2)
    env.reset(seed=2)
    for _ in range(4):
        world.step(acting(world))
        env.step(policy(env.observe()))
        np.testing.assert_array_equal(world.vector, env.world.vector)
    acting(world)
    world.step(env.actions.command(np.full(9, 0.5)))  # somebody else decides
    env.step(np.full(9, 0.5))
    wanted = env.actions.command(policy(env.observe()))
    np.testing.assert_allclose(acting(world), wanted, rtol=1e-6)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"history": -1}, "history"),
    ({"history": 1.5}, "history"),
    ({"history": 2, "observation_mode": "pixel"}, "FrameStackObservation"),
    ({"stack_history": True}, "stack_history"),
]


@pytest.mark.parametrize(("options", "said"), REFUSED)
def test_what_cannot_be_is_refused(options: dict[str, Any], said: str) -> None:
    """With the remedy."""
    with pytest.raises(UnknownOption, match=said):
        ScmWorldEnv("pushing", backend="fake", **options)


def test_a_history_has_observations_of_one_kind() -> None:
    """Other bodies are refused without ``pad``, and nothing changes."""
    env = make("scm_world/Reaching-v0", history=2).unwrapped
    seen = env.reset(seed=0)[0]
    with pytest.raises(InterventionError, match="pad="):
        env.do({"number_of_obstacles": 1})
    np.testing.assert_array_equal(env.observe(), seen)
    env.step(np.zeros(9))
    padded = make("scm_world/Reaching-v0", history=2, pad={"number_of_obstacles": 2}).unwrapped
    padded.reset(seed=0)
    padded.do({"number_of_obstacles": 1})
    before = padded.observe()
    now = padded.step(np.zeros(9, np.float32))[0]
    size = padded.history.size
    np.testing.assert_array_equal(now[size : 2 * size], before[:size])
    with pytest.raises(UnknownOption, match="history"):
        padded.observe_values({name: padded.world[name] for name in padded.observed})
