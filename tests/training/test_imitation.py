"""Learning by imitation: what is shown, and what is made of it. Most of it needs no torch."""

from __future__ import annotations

import itertools
import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world  # noqa: F401 # registers the environments
from scm_world.env import ScmWorldEnv
from scm_world.errors import ActionError, MissingExtra, ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation.recording import record
from scm_world.policies import MlpPolicy, load_policy, save_policy
from scm_world.tasks import make_task
from scm_world.training import imitation
from scm_world.training.imitation import (
    Demonstrations,
    clone,
    demonstrated,
    fitted,
    given_demonstrations,
    joined,
    lesson,
    successful,
    whitening,
)
from scm_world.training.recipe import recipe

SHORT = {"max_episode_length": 12}
QUICK: dict[str, Any] = {
    "env": SHORT,
    "keep": 0.0,
    "symmetric": False,
    "settled": None,
    "episodes": 2,
    "rounds": 1,
    "more": 1,
    "updates": 20,
    "batch": 8,
    "network": {"hidden": [8]},
    "trials": {"protocols": []},
}

CAUSES: dict[str, Any] = {"context": "observation"}

WIDTH = 53
"""Numbers that a policy of the usual lesson of picking observes."""


def shown(n: int = 2, learner: MlpPolicy | None = None, **changes: Any) -> Demonstrations:
    """Let a teacher show a few short episodes."""
    how = lesson("picking", **{**QUICK, **changes})
    return demonstrated((range(n), "mujoco"), lesson=how, seed=0, learner=learner)


def constant(action: float) -> MlpPolicy:
    """Make a network that always gives one action."""
    tensors = {
        "layers.0.weight": np.zeros((9, WIDTH), np.float32),
        "layers.0.bias": np.full(9, action, np.float32),
    }
    return MlpPolicy.of(tensors, {"task": "picking"})


CART = f"{Path(__file__).parents[1] / 'env' / 'model_tasks.py'}:Falling"


def test_sequences_are_whole_episodes() -> None:
    """Each stream runs through one episode after another, and all episodes come."""
    lengths = np.array([3, 5, 40])
    owner = np.repeat(np.arange(3), lengths)
    found = list(itertools.islice(imitation.in_sequences(lengths, 2, 0), 20))
    rows, begins = (np.concatenate(parts) for parts in zip(*found, strict=True))
    for stream, first in zip(rows.T, begins.T, strict=True):
        starts = np.flatnonzero(first)
        assert starts[0] == 0
        assert {*owner[stream]} == {0, 1, 2}
        for one, after in itertools.pairwise(starts):
            episode = stream[one:after]
            np.testing.assert_array_equal(episode, np.flatnonzero(owner == owner[episode[0]]))


def test_a_recurrent_network_learns_what_was_seen_before() -> None:
    """An action that follows from what was seen in the first control step only."""
    pytest.importorskip("torch")
    random = np.random.default_rng(0)
    seen = random.normal(size=(200, 10, 3)).astype(np.float32)
    wanted = np.broadcast_to(np.where(seen[:, :1, :1] > 0.0, 0.5, -0.5), (200, 10, 1))
    rows = [seen.reshape(2000, 3), wanted.reshape(2000, 1), *2 * [np.empty((2000, 0))]]
    shown_ = successful(rows, [10] * 200, [1.0] * 200, 1.0)
    network = {"hidden": [16], "recurrent": 16}
    how = lesson("picking", updates=120, batch=512, symmetric=False, network=network, rate=1e-2)
    tensors, _ = fitted(shown_, how, seed=0)
    policy = MlpPolicy.of(tensors, {"task": "any", "activation": "relu"})
    fresh, state = random.normal(size=(10, 100, 3)), None
    for now in fresh:
        action, state = policy.predict(now, state)
    assert (np.sign(action[:, 0]) == np.sign(fresh[0, :, 0])).mean() > 0.8
    assert np.abs(np.abs(action) - 0.5).mean() < 0.3


def test_a_trained_teacher_observes_its_own_form(tmp_path: Path) -> None:
    """Of the same world at the same instant: its actions follow from the causes by its weights."""
    with closing(ScmWorldEnv(CART, **CAUSES)) as env:
        width = env.observation_space.shape[0]  # type: ignore[index]
    weight = np.random.default_rng(0).normal(0.0, 0.2, (1, width)).astype(np.float32)
    tensors = {"layers.0.weight": weight, "layers.0.bias": np.zeros(1, np.float32)}
    path = save_policy(tmp_path / "teacher.safetensors", tensors, {"task": CART, "env": CAUSES})
    given: dict[str, Any] = {**QUICK, "teacher": str(path), "rounds": 0, "env": {}}
    plain, wide = (
        demonstrated((range(2), "mujoco"), lesson=lesson(CART, **given, **more), seed=0)
        for more in ({}, {"observations": "privileged"})
    )
    wanted = MlpPolicy.of(tensors)(wide["observations"])
    np.testing.assert_allclose(wide["actions"], wanted, atol=1e-5)
    np.testing.assert_array_equal(plain["actions"], wide["actions"])
    narrow = plain["observations"].shape[1]
    assert narrow < width
    np.testing.assert_array_equal(plain["observations"], wide["observations"][:, :narrow])


def test_an_episode_whose_world_is_lost_is_no_example(tmp_path: Path) -> None:
    """A slider that is pushed becomes unstable; the others of the lesson are learned from."""
    task = f"{Path(__file__).parents[1] / 'env' / 'test_env_failures.py'}:Growing"
    with closing(ScmWorldEnv(task)) as env:
        width = env.observation_space.shape[0]  # type: ignore[index]
    for push, lost in ((1.0, True), (0.0, False)):
        tensors = {"layers.0.weight": np.zeros((1, width), np.float32)}
        tensors["layers.0.bias"] = np.full(1, push, np.float32)
        path = save_policy(tmp_path / f"{push}.safetensors", tensors, {"task": task})
        fields = {**QUICK, "teacher": str(path), "env": {"max_episode_length": 100}, "noise": 0.0}
        found = demonstrated((range(2), "mujoco"), lesson=lesson(task, **fields), seed=0)
        assert np.isnan(found["scores"]).tolist() == [lost, lost]
        assert found["kept"].tolist() == [not lost, not lost]
        assert len(found["actions"]) == (0 if lost else 200)
    with pytest.raises(ModelError, match=r"none of 2 .* reached 0\.000"):
        joined([{**found, "actions": found["actions"][:0], "scores": np.full(2, np.nan)}])


def test_a_recurrent_student_resumes_and_repeats(tmp_path: Path) -> None:
    """Rounds of a trained teacher, without success: interrupted or not, the same bits."""
    pytest.importorskip("torch")
    weight = np.full((1, 8), 0.1, np.float32)
    with closing(ScmWorldEnv(CART)) as env:
        weight = weight[:, : env.observation_space.shape[0]]  # type: ignore[index]
    tensors = {"layers.0.weight": weight, "layers.0.bias": np.zeros(1, np.float32)}
    path = save_policy(tmp_path / "teacher.safetensors", tensors, {"task": CART})
    network = {"hidden": [4], "recurrent": 4}
    how = lesson(CART, **{**QUICK, "teacher": str(path), "network": network, "stretch": 1.0})
    whole = clone(None, how, out=tmp_path / "whole")

    def interrupt(done: int, _: int) -> None:
        if done > 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clone(None, how, out=tmp_path / "parts", progress=interrupt)
    parts = clone(None, how, out=tmp_path / "parts")
    assert parts.policy.read_bytes() == whole.policy.read_bytes()
    assert load_policy(whole.policy).n_remembered == 8
    save_policy(path, {**tensors, "layers.0.bias": np.ones(1, np.float32)}, {"task": CART})
    with pytest.raises(UnreadableFile, match="differ: teacher"):
        clone(None, how, out=tmp_path / "whole")
    with pytest.raises(UnknownOption, match=r"keep of a lesson.*0: all episodes"):
        demonstrated((range(1), "mujoco"), lesson=lesson(CART, keep=0.5), seed=0)
    with pytest.raises(UnknownOption, match=r"settled of a lesson.*None"):
        demonstrated((range(1), "mujoco"), lesson=lesson(CART, keep=0.0, settled=3), seed=0)
    with pytest.raises(UnknownOption, match=r"network\.recurrent.*symmetric=False"):
        lesson("picking", network=network, symmetric=True)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"action_mode": "delta_joint_positions"},
        {"action_mode": "delta_joint_positions", "delta_scale": 0.1, "delta_origin": "measured"},
        {"action_mode": "delta_end_effector_positions", "delta_scale": 0.2},
        {"action_mode": "delta_joint_positions", "normalize_actions": False},
    ],
)
def test_an_action_does_what_a_command_says(options: dict[str, Any]) -> None:
    """Whatever actions mean, the one that stands for a command within reach is that command."""
    env = ScmWorldEnv("picking", **options)
    env.reset(seed=0)
    env.step(np.zeros(9, np.float32))
    mode = options.get("action_mode", "joint_positions").removeprefix("delta_")
    command = np.clip(env.world[mode] + 0.01, env.world.action_low, env.world.action_high)

    action: Any = env.as_action(command)
    env.step(action)

    np.testing.assert_allclose(env.world["action"], command, atol=1e-12)
    env.close()


def test_demonstrations_follow_from_the_seed_and_the_number() -> None:
    """An episode is the same, whichever ones are shown with it."""
    both = shown(2)
    alone = demonstrated((range(1, 2), "mujoco"), lesson=lesson("picking", **QUICK), seed=0)
    assert both["observations"].shape == (24, WIDTH)
    assert both["actions"].shape == (24, 9)
    np.testing.assert_array_equal(both["actions"][12:], alone["actions"])
    np.testing.assert_array_equal(both["observations"][12:], alone["observations"])


def test_privileged_observations_have_the_causes_besides() -> None:
    """The teacher does the same, and the network sees more."""
    plain, more = shown(1), shown(1, observations="privileged")
    np.testing.assert_array_equal(more["actions"], plain["actions"])
    width = plain["observations"].shape[1]
    np.testing.assert_array_equal(more["observations"][:, :width], plain["observations"])
    assert more["observations"].shape[1] > width
    with pytest.raises(UnknownOption, match="observations of a lesson"):
        lesson("picking", observations="everything")


def test_a_protocol_that_stands_twice_is_shown_twice() -> None:
    """In turns; evaluations have each protocol once."""
    both, one = shown(3, protocols=["P0", "P5", "P5"]), shown(3, protocols=["P0"])
    two = shown(3, protocols=["P5"])
    parts = [np.split(found["observations"], 3) for found in (both, one, two)]
    np.testing.assert_array_equal(parts[0], [parts[1][0], *parts[2][1:]])
    assert not np.array_equal(parts[1][1], parts[2][1])
    with pytest.raises(UnknownOption, match="once"):
        lesson("picking", trials={"protocols": ["P5", "P5"]})


def test_pick_and_place_sees_how_high_the_wall_is() -> None:
    """The teacher lifts a block as high as that; so does the recipe that goes on from its clone."""
    for env in (lesson("pick_and_place").options, recipe("pick_and_place").env):
        assert "obstacle.size" in env["observe"]


def test_a_quiet_teacher_is_itself() -> None:
    """Without noise, what is shown leads from each observation to the next one."""
    first = shown(1, noise=0.0, protocols=["P0"])
    env = ScmWorldEnv("picking", **lesson("picking", **QUICK).env)
    observation: Any = env.reset(seed=123)[0]  # nothing varies
    for seen, done in zip(first["observations"], first["actions"], strict=True):
        np.testing.assert_allclose(observation, seen, atol=1e-6)
        observation = env.step(done)[0]
    env.close()


def test_who_learns_acts_but_does_not_teach() -> None:
    """The network's own actions change what is seen, and are no example of what to do."""
    alone = shown(1, noise=0.0)
    together = shown(1, constant(0.9), noise=0.0, share=0.5, stretch=1.0)
    assert not np.array_equal(alone["observations"], together["observations"])
    assert not (together["actions"] == np.float32(0.9)).all(axis=1).any()


def test_symmetric_scenes_are_shown_besides() -> None:
    """Each control step is followed by the same one, turned by one and by two thirds of a turn."""
    plain, more = shown(1), shown(1, symmetric=True)
    assert len(more["actions"]) == 3 * len(plain["actions"])
    np.testing.assert_array_equal(more["observations"][::3], plain["observations"])
    np.testing.assert_array_equal(more["actions"][::3], plain["actions"])
    first, once, twice = (more["actions"][k::3].reshape(-1, 3, 3) for k in range(3))
    np.testing.assert_array_equal(once, first[:, [1, 2, 0]])
    np.testing.assert_array_equal(twice, first[:, [2, 0, 1]])
    assert not np.allclose(more["observations"][1::3], plain["observations"])


@pytest.mark.parametrize("task", ["pushing", "picking", "pick_and_place"])
def test_usual_lessons_may_show_the_causes(task: str) -> None:
    """Scenes that are turned have them, too; an episode ends after its first control step here."""
    how = lesson(task, observations="privileged", settled=1, keep=0.0)
    found = demonstrated((range(1), "mujoco"), lesson=how, seed=0)
    assert len(found["actions"]) == (3 if how.symmetric else 1)


def test_what_a_teacher_remembers_is_shown() -> None:
    """It is what it remembered one control step ago; at first it is nothing."""
    how = lesson("stacking2", settled=None, keep=0.0, env=SHORT)
    found = demonstrated((range(2), "mujoco"), lesson=how, seed=0)
    assert (
        found["after"].shape == found["before"].shape == (24, 7)
    )  # two blocks, three fingers, two more
    np.testing.assert_array_equal(found["before"][[0, 12]], 0.0)
    np.testing.assert_array_equal(found["before"][1:12], found["after"][:11])
    assert {*np.unique(found["after"])} == {-1.0, 1.0}
    assert (found["after"][:, :2].sum(axis=1) == 0.0).all()  # one block of two is taken
    assert (found["after"][:, 2:5].sum(axis=1) >= 1.0).all()  # by two fingers at least


def test_a_network_learns_to_remember() -> None:
    """An action that follows from what was seen in the first control step only."""
    pytest.importorskip("torch")
    random = np.random.default_rng(0)
    seen = random.normal(size=(400, 10, 3)).astype(np.float32)
    sign = np.where(seen[:, :1, :1] > 0.0, 1.0, -1.0).astype(np.float32)
    after = np.broadcast_to(sign, (400, 10, 1)).copy()
    before = after.copy()
    before[:, 0] = 0.0
    rows = [array.reshape(4000, -1) for array in (seen, 0.5 * after, before, after)]
    shown_ = successful(rows, [10] * 400, [1.0] * 400, 1.0)
    how = lesson("picking", updates=600, batch=256, network={"hidden": [32]})
    network, _ = fitted(shown_, how, seed=0)
    policy = MlpPolicy.of(network, {"task": "any", "activation": "relu", "memory": 1})
    fresh, state = random.normal(size=(10, 100, 3)), None
    for now in fresh:
        action, state = policy.predict(now, state)
    assert (np.sign(action[:, 0]) == np.sign(fresh[0, :, 0])).mean() > 0.75


def test_only_a_teacher_that_says_what_it_remembers_teaches_it() -> None:
    """Nor are scenes turned then."""
    with pytest.raises(UnknownOption, match=r"history of a lesson.*symmetric=False"):
        lesson("pushing", symmetric=True, env={"history": 2})
    with pytest.raises(UnknownOption, match=r"memory of a lesson.*'sweep' does not report"):
        lesson("picking", teacher="sweep", symmetric=False, memory=True)
    with pytest.raises(UnknownOption, match=r"symmetric.*memory=False"):
        lesson("picking", memory=True)


def test_an_episode_ends_once_it_is_settled() -> None:
    """It is the beginning of the whole one, and its score is the one there."""
    whole, less = shown(1), shown(1, settled=3)
    assert (len(whole["actions"]), len(less["actions"])) == (
        12,
        3,
    )  # keep is 0: every control step is good enough
    np.testing.assert_array_equal(less["observations"], whole["observations"][:3])
    np.testing.assert_array_equal(less["actions"], whole["actions"][:3])
    never = shown(1, settled=3, keep=1.0, protocols=["P0"])
    assert never["scores"][0] < 1.0
    assert not never["kept"].any()
    with pytest.raises(UnknownOption, match="settled"):
        lesson("picking", settled=0)


def test_a_task_without_symmetries_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is silently left out of a lesson."""
    seen = replace(make_task("picking").observation, symmetries=None)
    monkeypatch.setattr("scm_world.tasks.Picking.observation", seen)
    with pytest.raises(UnknownOption, match=r"symmetric.*False"):
        shown(1, symmetric=True)


def test_backends_take_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of episodes come from several backends in turns, each as from that one alone."""
    pytest.importorskip("torch")
    pytest.importorskip("pybullet")
    monkeypatch.setattr(imitation, "SHARD", 1)
    how = lesson("picking", **{**QUICK, "rounds": 0})
    found = clone(None, how, out=tmp_path, backend="mujoco,bullet")
    assert {"mujoco", "bullet"} <= {*load_policy(found.policy).about.card["versions"]}  # type: ignore[misc]
    for k, backend in enumerate(("mujoco", "bullet")):
        alone = demonstrated((range(k, k + 1), backend), lesson=how, seed=0)
        with np.load(tmp_path / "demonstrations" / f"00-{k:06}.npz") as file:
            np.testing.assert_array_equal(file["observations"], alone["observations"])
    again = clone(None, how, out=tmp_path / "2", backend="mujoco,bullet", workers=2)
    assert again.policy.read_bytes() == found.policy.read_bytes()


def test_a_damaged_file_is_named_before_more_is_recorded(tmp_path: Path) -> None:
    """It is not found out after hours; progress counts what is there."""
    pytest.importorskip("torch")
    how, done = lesson("picking", **{**QUICK, "episodes": 26, "rounds": 0}), list[int]()
    clone(None, how, out=tmp_path, progress=lambda n, _: done.append(n))
    clone(None, how, out=tmp_path, progress=lambda n, _: done.append(n))
    assert done == [25, 26, 25, 26]
    first, second = sorted((tmp_path / "demonstrations").iterdir())
    second.unlink()
    (tmp_path / "rounds" / "00.safetensors").unlink()
    first.write_bytes(first.read_bytes()[:-9])
    with pytest.raises(UnreadableFile, match=r"000000.*delete this file"):
        clone(None, how, out=tmp_path)
    assert not second.exists()


@pytest.mark.parametrize("task", ["pick_and_place", "stacking2"])
def test_a_training_can_go_on_from_a_clone(task: str) -> None:
    """The recipe of PPO has the network and the actions of the lesson, where it needs one."""
    learned, usual = lesson(task), recipe(task)
    assert usual.network.hidden == learned.network.hidden
    assert usual.network.activation == learned.network.activation
    for name in ("observe", "keypoints", "action_mode", "delta_scale", "delta_origin"):
        assert usual.env.get(name) == learned.env.get(name)


def test_what_ends_badly_is_left_out() -> None:
    """Only episodes that end well are pairs; how the others ended is known."""
    found = shown(2, keep=1.0)
    assert len(found["actions"]) == 0
    assert found["scores"].shape == (2,)
    with pytest.raises(ModelError, match=r"none of 2 demonstrations ended well enough"):
        joined([found])


def test_whitening_makes_small_things_count() -> None:
    """Features have a variance of one, also of a small difference; what is constant is left out."""
    random = np.random.default_rng(0)
    place = random.normal(size=(4000, 1))
    points = np.c_[place, place + 0.01 * random.normal(size=(4000, 1)), np.ones(4000)]
    turn, shift = whitening(points)
    features = points @ turn.T + shift
    np.testing.assert_allclose(np.cov(features.T), np.eye(2), atol=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"teacher": "nobody"}, "no teacher is called|teacher"),
        ({"protocols": ["P77"]}, "P77"),
        ({"episode": 3}, "field of a lesson"),
        ({"episodes": 0}, "episodes of a lesson"),
        ({"noise": -0.1}, "noise of a lesson"),
        ({"env": {"goal_env": True}}, "goal_env of a lesson"),
        ({"env": {"backend": "mujoco"}}, "option of the environment"),
        ({"trials": {"protocols": ["P99"]}}, "P99"),
    ],
)
def test_impossible_lessons_are_refused(changes: dict[str, Any], message: str) -> None:
    """An error names what was asked for."""
    with pytest.raises(UnknownOption, match=message):
        lesson("picking", **changes)


@pytest.mark.parametrize(
    ("task", "env", "message"),
    [("reaching", {}, "needs blocks"), ("picking", {"action_mode": "joint_torques"}, "torques")],
)
def test_a_teacher_that_cannot_teach_says_so_at_once(
    task: str, env: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """Before any episode: it knows nothing of the task, or cannot act in such units."""
    pytest.importorskip("torch")
    usual = {"delta_scale": 1.0, "delta_origin": "command", **env} if env else {}
    with pytest.raises(ActionError, match=message):
        clone(None, lesson(task, env=usual), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_unknown_task_is_refused() -> None:
    """There is no lesson for a task that does not exist."""
    with pytest.raises(UnknownOption, match="lifting"):
        lesson("lifting")


def recorded(path: Path, n: int = 2) -> Path:
    """Record somebody who stays where it is."""
    env = gymnasium.make(
        "scm_world/Picking-v0",
        action_mode="delta_joint_positions",
        delta_scale=0.1,
        delta_origin="measured",
        **SHORT,  # type: ignore[arg-type] # options
    )
    record(np.zeros(9), env, n, out=path)
    env.close()
    return path


def test_recordings_are_demonstrations(tmp_path: Path) -> None:
    """A recording says in which environment one learns, and what was done there."""
    path = recorded(tmp_path / "still.parquet")
    for source in (path, tmp_path):
        given, learned = given_demonstrations(source, lesson("picking", keep=0.0))
        assert len(given["actions"]) == 24
        assert learned.rounds == 0
        assert learned.env["delta_scale"] == 0.1
        np.testing.assert_array_equal(given["actions"], np.zeros((24, 9)))


def test_recordings_of_something_else_are_refused(tmp_path: Path) -> None:
    """Another task, nothing that ended well, and an empty folder have messages of their own."""
    path = recorded(tmp_path / "still.parquet", 1)
    with pytest.raises(UnknownOption, match="task of a recording"):
        given_demonstrations(path, lesson("pushing", keep=0.0))
    with pytest.raises(ModelError, match="ended well"):
        given_demonstrations(path, lesson("picking", keep=0.9))
    with pytest.raises(UnknownOption, match="plain: these recordings"):
        given_demonstrations(path, lesson("picking", keep=0.0, observations="privileged"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UnreadableFile, match="no Parquet file"):
        given_demonstrations(tmp_path / "empty", lesson("picking"))


def test_recordings_of_what_no_network_learns_are_refused(tmp_path: Path) -> None:
    """The message says which option of their environment it is."""
    env = gymnasium.make("scm_world/Picking-v0", max_episode_length=2, normalize_actions=False)
    record(np.zeros(9), env, 1, out=tmp_path / "own.parquet")
    env.close()
    with pytest.raises(UnknownOption, match="normalize_actions of a lesson"):
        given_demonstrations(tmp_path / "own.parquet", lesson("picking", keep=0.0))


def test_without_torch_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error comes before an episode is played, and leaves no folder."""
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    with pytest.raises(MissingExtra, match="torch"):
        clone(None, lesson("picking"), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


# --- with torch -------------------------------------------------------------------------------


def test_a_clone_learns_what_was_shown(tmp_path: Path) -> None:
    """A network that sees enough gives the actions of a teacher who always does the same."""
    pytest.importorskip("torch")
    path = recorded(tmp_path / "still.parquet")
    found = clone(path, lesson("picking", **QUICK), out=tmp_path / "run")
    policy = load_policy(found.policy)
    assert policy.about.env["delta_origin"] == "measured"
    assert found.score is None
    seen = given_demonstrations(path, lesson("picking", keep=0.0))[0]["observations"]
    assert np.abs(policy(seen)).max() < 0.1


def test_a_clone_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    """Interrupted in the middle or not: the same bits; and nothing is done twice."""
    pytest.importorskip("torch")
    how = lesson("picking", **QUICK)
    whole = clone(None, how, out=tmp_path / "whole")

    def interrupt(done: int, _: int) -> None:
        if done > 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clone(None, how, out=tmp_path / "parts", progress=interrupt)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "parts").rglob("*.npz")}
    parts = clone(None, how, out=tmp_path / "parts")
    assert parts.policy.read_bytes() == whole.policy.read_bytes()
    assert before == {p: p.stat().st_mtime_ns for p in before}
    assert len(before) == 2
    first, last = (tmp_path / "parts" / "rounds" / f"0{i}.safetensors" for i in range(2))
    kept = first.read_bytes()
    for changed in (
        kept[:-1] + bytes([kept[-1] ^ 1]),
        last.read_bytes(),
    ):  # a weight; another round
        first.write_bytes(changed)
        with pytest.raises(UnreadableFile, match=rf"{first.name}.*belongs elsewhere"):
            clone(None, how, out=tmp_path / "parts")
    first.write_bytes(kept)
    last.unlink()
    damaged = min(before)
    damaged.write_bytes(damaged.read_bytes()[:500])
    with pytest.raises(UnreadableFile, match=rf"{damaged.name}.*delete this file"):
        clone(None, how, out=tmp_path / "parts")


def test_a_folder_of_other_work_is_refused(tmp_path: Path) -> None:
    """The message says what is different, or what is there."""
    pytest.importorskip("torch")
    how = lesson("picking", **{**QUICK, "rounds": 0})
    clone(None, how, out=tmp_path / "run")
    with pytest.raises(UnreadableFile, match="differ: seed"):
        clone(None, how, out=tmp_path / "run", seed=1)
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "thesis.tex").write_text("x")
    with pytest.raises(UnreadableFile, match=r"thesis\.tex"):
        clone(None, how, out=tmp_path / "strange")


def test_a_clone_says_how_it_was_made(tmp_path: Path) -> None:
    """The card has the lesson, the seed, how many episodes were of use, and versions."""
    pytest.importorskip("torch")
    trials = {"protocols": ["P0"], "episodes": 1}
    found = clone(None, lesson("picking", **{**QUICK, "trials": trials}), out=tmp_path / "run")
    card = load_policy(found.best).about.card
    assert card["episodes"] in ({"shown": 2, "kept": 2}, {"shown": 3, "kept": 3})
    assert card["lesson"]["teacher"] == "feedback"  # type: ignore[index,call-overload] # JSON
    assert "torch" in card["versions"]  # type: ignore[operator] # JSON
    assert found.score is not None
    settings = json.loads((tmp_path / "run" / "study.json").read_text())["settings"]
    assert settings["seed"] == 0


def test_weights_that_are_no_numbers_are_no_clone(tmp_path: Path) -> None:
    """The message says what to do, and no policy is written."""
    pytest.importorskip("torch")
    how = lesson("picking", **{**QUICK, "rounds": 0, "rate": 1e30})
    with pytest.raises(ModelError, match="smaller rate"):
        clone(None, how, out=tmp_path / "run")
    assert not [*(tmp_path / "run").rglob("*.safetensors")]


def test_a_clone_does_not_depend_on_the_threads_of_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has one while it learns, and as many as before afterwards."""
    torch = pytest.importorskip("torch")
    seen: list[int] = []

    def counted(*given: Any, **options: Any) -> Any:
        seen.append(torch.get_num_threads())
        return fitted(*given, **options)

    monkeypatch.setattr(imitation, "fitted", counted)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        clone(None, lesson("picking", **{**QUICK, "rounds": 0}), out=tmp_path / "run")
        assert (seen, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


def test_a_task_that_is_not_ours_has_a_lesson() -> None:
    """With the protocols that it has; what was asked for and is not there is refused."""
    task = f"{Path(__file__).parents[1] / 'env' / 'model_tasks.py'}:Balance"
    made = lesson(task, keep=0.0)
    assert made.protocols == made.trials.protocols == ("P0",)
    with pytest.raises(UnknownOption, match="P5"):
        lesson(task, protocols=["P5"])
