"""Facts about recordings: they happen again, bit for bit, out of every file."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TransformReward

from scm_world import Plan, ScmWorldEnv, Shift
from scm_world.errors import (
    ModelError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
    UnreadableFile,
)
from scm_world.evaluation.recording import Recorded, Recorder, Recording, record
from scm_world.policies.agents import as_agent
from scm_world.tasks import Pushing
from scm_world.variables import Box, Draw, Mechanism

BACKENDS = ["fake", "mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
STEPS = 20
AUTHOR = {"author": "A", "author_email": "a@example.org", "code_permalink": "https://example.org"}
"""What Minari warns of where it is missing."""
ARROW = {"data_format": "arrow"}

OPTIONS: list[dict[str, Any]] = [
    {},
    {"goal_env": True, "context": "privileged"},
    {
        "action_mode": "delta_joint_positions",
        "start": {"tool_block.mass": Draw("B")},
        "random_goal": "A",
        "variables_space": "A|B",
    },
    {"observation_mode": "pixel", "cameras": ["60"], "image_size": (8, 12)},
]


def make(task: str = "Pushing", **options: Any) -> Any:
    """Make a short environment, without Gymnasium's own checker."""
    options = {"backend": "fake", "max_episode_length": STEPS, **options}
    return gymnasium.make(f"scm_world/{task}-v0", disable_env_checker=True, **options)


def lived(task: str = "Pushing", episodes: int = 2, **options: Any) -> Recording:
    """Record episodes of random actions, with interventions before, within and after them."""
    recorder = Recorder(make(task, **options))
    draw = np.random.default_rng(0)
    for number in range(episodes):
        do = {"tool_block.mass": "A"} if task == "Pushing" else {}
        recorder.reset(seed=7 if number == 0 else None, options={"do": do})
        intervene = recorder.unwrapped.do  # type: ignore[attr-defined]
        intervene({"floor_friction": 0.3})
        for step in range(STEPS):
            if step == 7:
                intervene({"gravity": Shift([0.0, 0.0, 1.0])})
                intervene({"floor_friction": "A"})
            if step == 12 and task == "Towers":
                intervene({"number_of_blocks_in_tower": [1, 1, 2]})
            action = draw.uniform(-1, 1, 9)
            recorder.step(action.astype(np.float32) if number else action)
        intervene({"floor_friction": 0.35})
    recording = recorder.recording()
    recorder.close()
    return recording


class EveryThird(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Intervenes like a curriculum does."""

    def reset(self, **how: Any) -> Any:
        """Begin with an intervention."""
        options = {**(how.pop("options", None) or {}), "do": {"tool_block.mass": "B"}}
        return self.env.reset(options=options, **how)

    def step(self, action: Any) -> Any:
        """Intervene after every third step."""
        _, reward, *ends, info = self.env.step(action)
        inside: Any = self.unwrapped
        if inside.world.index % 3 == 0:
            inside.do({"floor_friction": "A"})
        observation, now = inside.present()
        return observation, reward, *ends, {**info, **now, "done": inside.world.index // 3}


# --- happening again --------------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS, ids=["vector", "parts", "relative", "pixel"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_recording_happens_again(backend: str, options: dict[str, Any], tmp_path: Path) -> None:
    """From memory and from a file; with draws and interventions at any step."""
    recording = lived(backend=backend, **options)
    assert recording.replay() == 2 * STEPS
    loaded = Recording.load(recording.save(tmp_path / "runs"))
    assert loaded == recording
    assert loaded != Recording.load(lived(episodes=1).save(tmp_path / "other"))
    assert loaded.replay(1) == STEPS
    assert [step for step, _ in loaded[0].interventions] == [0, 0, 7, 7, 20]


@pytest.mark.parametrize("backend", BACKENDS)
def test_another_structure_happens_again(backend: str, tmp_path: Path) -> None:
    """An intervention may change which bodies there are, and so the length of what is seen."""
    recording = lived("Towers", episodes=1, backend=backend)
    lengths = {len(seen) for seen in recording[0].observations}
    assert len(lengths) == 2
    assert Recording.load(recording.save(tmp_path / "towers")).replay() == STEPS
    with pytest.raises(ModelError, match="one length"):
        recording.pairs()


def test_random_episodes_differ() -> None:
    """A replay that compares nothing would not notice; this shows that there is a difference."""
    first, second = lived()
    assert first != second
    assert not np.array_equal(first.states, second.states)


@pytest.mark.parametrize(
    ("field", "what"),
    [("rewards", "the reward"), ("states", "the true state"), ("observations", "the observation")],
)
def test_what_differs_is_named(field: str, what: str) -> None:
    """With the first control step that differs, and the versions."""
    recording = lived(episodes=1)
    values = list(getattr(recording[0], field))
    values[5] = values[5] + (1 if field == "states" else np.float32(1e-6))
    kept = {**vars(recording[0]), field: np.array(values)}
    changed = Recording(recording.environment, (Recorded(**kept),), recording.versions)
    with pytest.raises(SnapshotMismatch, match=f"episode 0 .* control step 5: {what}.*numpy"):
        changed.replay()


def test_a_refused_intervention_is_a_difference() -> None:
    """What was done once must be possible again."""
    recording = lived(episodes=1)
    kept = {**vars(recording[0]), "interventions": ((3, Plan({"tool_block.mass": -1.0})),)}
    changed = Recording(recording.environment, (Recorded(**kept),))
    with pytest.raises(SnapshotMismatch, match="control step 3: an intervention is refused"):
        changed.replay(0)


def test_a_forgotten_intervention_is_a_difference() -> None:
    """The interventions decide what happens, not the actions alone."""
    recording = lived(episodes=1, backend="mujoco")
    kept = {**vars(recording[0]), "interventions": recording[0].interventions[:2]}
    changed = Recording(recording.environment, (Recorded(**kept),))
    with pytest.raises(SnapshotMismatch, match=r"control step 7: the .*unknown versions"):
        changed.replay(-1)


@pytest.mark.parametrize("outside", [False, True])
def test_a_curriculum_is_recorded(outside: bool, tmp_path: Path) -> None:
    """Above or below the recorder: what it did is repeated without it."""
    recorder: Any = Recorder(make() if outside else EveryThird(make()))
    env = EveryThird(recorder) if outside else recorder
    seen = [env.reset(seed=1)[0]]
    actions = np.random.default_rng(2).uniform(-1, 1, (STEPS, 9)).astype(np.float32)
    seen += [env.step(action)[0] for action in actions]
    recording = recorder.recording()
    assert [step for step, _ in recording[0].interventions] == [0, *range(3, STEPS, 3)]
    assert recording.replay() == STEPS
    for mine, its in zip(recording[0].observations, seen, strict=True):
        np.testing.assert_array_equal(mine, its)


def test_named_infos_of_wrappers_are_kept() -> None:
    """Also those that the environment itself does not have."""
    recording = record("still", EveryThird(make()), 1, infos=["success", "is_success"])
    assert {*recording[0].infos} == {"success", "is_success"}
    assert recording[0].infos["success"].dtype == np.bool_
    with pytest.raises(UnknownOption, match="fractional_success"):
        record("still", make(), 1, infos=["sucess"])


def test_wrappers_that_change_something_belong_above() -> None:
    """Below a recorder they are refused; above it they are welcome."""
    with pytest.raises(UnknownOption, match=r"TransformReward\(Recorder\(env\)\)"):
        Recorder(TransformReward(make(), abs))
    recorder = Recorder(make())
    record("still", recorder, 1)
    env = TransformReward(recorder, abs)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.full(9, 0.1, np.float32))
    assert recorder.recording().replay() > 0
    with pytest.raises(UnknownOption, match="ScmWorldEnv"):
        Recorder(gymnasium.make("CartPole-v1"))


def test_episodes_without_a_step_are_forgotten() -> None:
    """And without an episode there is nothing to record."""
    recorder = Recorder(make())
    with pytest.raises(NotReset):
        recorder.step(np.zeros(9, np.float32))
    for _ in range(3):
        recorder.reset(seed=0)
    assert len(recorder.recording()) == 0
    recorder.step(np.zeros(9, np.float32))
    assert len(recorder.recording()) == len(recorder.recording()) == 1


def test_tasks_in_memory_happen_again(tmp_path: Path) -> None:
    """A task that was made is saved by its name and arguments."""
    env = ScmWorldEnv(Pushing(weights="sparse"), backend="fake", max_episode_length=STEPS)
    recording = record("random", env, 1)
    assert recording.replay() == STEPS
    loaded = Recording.load(recording.save(tmp_path / "sparse.parquet"))
    assert loaded.environment["task_options"] == {"weights": "sparse"}
    assert loaded.replay() == STEPS
    other = Recording({**loaded.environment, "task": "unknown"}, loaded.episodes)
    with pytest.raises(UnknownOption, match="unknown"):
        other.replay()
    assert other.replay(task=Pushing(weights="sparse")) == STEPS


def test_record_counts_episodes_on() -> None:
    """A part of a series is the same as in the whole series."""
    env = make()
    series = record("random", env, 4, seed=5, do={"tool_block.mass": "A"})
    part = record("random", env, 2, seed=5, first=2, do={"tool_block.mass": "A"})
    assert part.episodes == series.episodes[2:]
    assert [episode.number for episode in series] == [0, 1, 2, 3]
    assert series.policy == as_agent("random").about


def test_recorded_actions_can_be_played() -> None:
    """The same environment does the same with them."""
    recording = record("random", make(backend="mujoco"), 2, seed=3)
    again = record(recording[1].actions, make(backend="mujoco"), 1, seed=3, first=1)
    np.testing.assert_array_equal(again[0].states, recording[1].states)


def test_pairs_are_what_was_seen_and_done() -> None:
    """In single precision, and without the last instants."""
    recording = lived(goal_env=True)
    seen, done = recording.pairs()
    assert (len(seen), seen.dtype, done.shape) == (2 * STEPS, np.float32, (2 * STEPS, 9))
    first: Any = recording[0].observations[0]
    parts = [first[name] for name in ("achieved_goal", "desired_goal", "observation")]
    np.testing.assert_array_equal(seen[0], np.concatenate(parts).astype(np.float32))
    np.testing.assert_array_equal(done[STEPS:], recording[1].actions)


def test_pairs_are_enough_for_a_clone() -> None:
    """A linear policy that is fitted to them acts like its teacher, in closed loop."""
    env = make(backend="mujoco")
    seen, done = record("sweep", env, 3, do={"tool_block.mass": "A"}).pairs()
    weights = np.linalg.lstsq(np.c_[seen, np.ones(len(seen))], done, rcond=1e-3)[0]
    clone = record(lambda observation: np.append(observation, 1.0) @ weights, env, 1)
    np.testing.assert_allclose(clone[0].actions, done[:STEPS], atol=0.05)
    assert np.ptp(done, axis=0).max() > 0.25


def test_the_observation_of_a_pair_is_that_after_the_intervention() -> None:
    """An action answers to what was there when it was chosen."""
    recorder: Any = Recorder(make(context="observation"))
    recorder.reset(seed=0)
    recorder.step(np.zeros(9, np.float32))
    before = recorder.unwrapped.observe()
    recorder.unwrapped.do({"tool_block.mass": 0.09})
    after = recorder.unwrapped.observe()
    recorder.step(np.zeros(9, np.float32))
    seen = recorder.recording()[0].observations[1]
    assert not np.array_equal(before, after)
    np.testing.assert_array_equal(seen, after)


def test_functions_without_a_name_stay_in_memory(tmp_path: Path) -> None:
    """They happen again and can be compared, but not be written."""
    tied = {"floor_friction": Mechanism(lambda mass: 5.0 * mass, parents=("tool_block.mass",))}
    recording = record("random", make(), 1, do=tied)
    assert recording.replay() == STEPS
    assert recording[0] == record("random", make(), 1, do=tied)[0]
    assert recording[0] != record("random", make(), 1)[0]
    with pytest.raises(ModelError, match="<lambda>"):
        recording.save(tmp_path / "runs")


def test_options_of_another_version_are_said() -> None:
    """An argument that environments do not have any more is named."""
    recording = record("still", make(), 1)
    other = Recording({**recording.environment, "wind": 1.0}, recording.episodes)
    with pytest.raises(SnapshotMismatch, match="'wind'"):
        other.replay()


# --- files ------------------------------------------------------------------------------------


def halved(mass: Any) -> Any:
    """Give half of a mass."""
    return 5.0 * mass


def test_mechanisms_need_trust(tmp_path: Path) -> None:
    """A function of the user is found again only if the reader names its package."""
    recorder: Any = Recorder(make())
    recorder.reset(seed=0)
    recorder.unwrapped.do({"floor_friction": Mechanism(halved, parents=("tool_block.mass",))})
    recorder.step(np.zeros(9, np.float32))
    recording = recorder.recording()
    assert recording.replay() == 1
    path = recording.save(tmp_path / "tied")
    with pytest.raises(ModelError, match="trusted"):
        Recording.load(path)
    package = halved.__module__.partition(".")[0]
    assert Recording.load(path, trusted=(package,)).replay() == 1


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    """All of it at once, and nothing is left behind; in memory it happens again."""
    start = {"tool_block.mass": Draw(Box(0.02, 0.03))}
    recording = record("still", make(start=start), 1)
    assert recording.replay() == STEPS
    with pytest.raises(ModelError, match="'start'"):
        recording.save(tmp_path / "start")
    with pytest.raises(ModelError, match="one at least"):
        Recorder(make()).recording().save(tmp_path / "empty")
    assert [*tmp_path.iterdir()] == []


def test_a_file_has_a_row_for_each_instant(tmp_path: Path) -> None:
    """Any program that reads Parquet can read it."""
    pandas: Any = pytest.importorskip("pandas")
    recording = lived()
    path = recording.save(tmp_path / "runs")
    table = pandas.read_parquet(path)
    assert len(table) == 2 * (STEPS + 1)
    steps = table.dropna(subset=["reward"])
    np.testing.assert_array_equal(steps["reward"][:STEPS], recording[0].rewards)
    np.testing.assert_array_equal(steps["action"].iloc[3], recording[0].actions[3])
    seen = table["observation"].iloc[STEPS]
    np.testing.assert_array_equal(seen, recording[0].observations[STEPS])
    assert path.read_bytes() == recording.save(tmp_path / "again").read_bytes()


def test_damaged_files_are_refused_by_name(tmp_path: Path) -> None:
    """Cut, incomplete, or made by somebody else."""
    parquet: Any = importlib.import_module("pyarrow.parquet")
    path = record("random", make(), 2).save(tmp_path / "runs.parquet")
    whole = path.read_bytes()
    changes: list[Any] = [
        lambda table: table.replace_schema_metadata({}),
        lambda table: table.drop_columns(["episode"]),
        lambda table: table.drop_columns(["observation"]),
        lambda table: table.slice(0, STEPS + 1),
    ]
    for change in changes:
        path.write_bytes(whole)
        parquet.write_table(change(parquet.read_table(path)), path)
        with pytest.raises(UnreadableFile, match=r"runs\.parquet"):
            Recording.load(path)
    for data in (b"", b"text", whole[:-100], whole[100:]):
        path.write_bytes(data)
        with pytest.raises(UnreadableFile, match=r"runs\.parquet"):
            Recording.load(path)
    with pytest.raises(UnreadableFile, match="No such file"):
        Recording.load(tmp_path / "missing.parquet")


# --- Minari -----------------------------------------------------------------------------------


@pytest.fixture
def minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Minari with a folder of its own."""
    pytest.importorskip("pyarrow")
    library = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return library


@pytest.mark.parametrize("kind", ["hdf5", "arrow"])
@pytest.mark.parametrize("options", OPTIONS, ids=["vector", "parts", "relative", "pixel"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_datasets_of_minari_have_the_same_numbers(
    backend: str, options: dict[str, Any], kind: str, minari: Any
) -> None:
    """Observations, actions and rewards keep their bits; the environment can be recovered."""
    if kind == "hdf5":
        pytest.importorskip("h5py")
    recording = lived(backend=backend, **options)
    dataset = recording.to_minari("scm_world/pushing/test-v0", **AUTHOR, data_format=kind)
    assert len(dataset) == len(recording)
    for found, episode in zip(dataset, recording, strict=True):
        np.testing.assert_array_equal(found.actions, episode.actions)
        np.testing.assert_array_equal(found.rewards, episode.rewards)
        for at, seen in enumerate(episode.observations):
            for name, part in seen.items() if isinstance(seen, dict) else [("", seen)]:
                there = found.observations[name] if name else found.observations
                np.testing.assert_array_equal(there[at], part)
        assert found.infos["success"].shape == (STEPS + 1,)
    env = dataset.recover_environment(disable_env_checker=True)
    assert env.unwrapped.world.backend.name.startswith(backend)
    assert env.observation_space == dataset.observation_space
    assert env.unwrapped.world.max_episode_length == STEPS


def test_what_minari_cannot_hold_is_refused(minari: Any, tmp_path: Path) -> None:
    """Nothing is left of a dataset that fails, and none is written over."""
    recording = lived("Towers", episodes=1)
    with pytest.raises(ModelError, match="one shape"):
        recording.to_minari("towers-v0", **AUTHOR)
    good = record("random", make(), 1)
    with pytest.raises(ValueError, match="format"):
        good.to_minari("test-v0", **AUTHOR, data_format="paper")
    assert not (tmp_path / "datasets" / "test-v0").exists()
    for name in ("test", "towers/test", "test-v", "-v0", "", 3):
        with pytest.raises(UnknownOption, match="a name with a version"):
            good.to_minari(name, **AUTHOR, **ARROW)  # type: ignore[arg-type] # the point
    good.to_minari("test-v0", **AUTHOR, **ARROW)
    with pytest.raises(UnknownOption, match="delete_dataset"):
        good.to_minari("test-v0", **AUTHOR, **ARROW)


# --- labels -----------------------------------------------------------------------------------


def test_a_teacher_that_is_pushed_off_its_path_says_what_to_do_there(tmp_path: Path) -> None:
    """What is played has noise, what is learned from has none, and all of it happens again."""
    env = make(action_mode="delta_joint_positions")
    noisy = record("across", env, 2, noise=0.5, labels="teacher", seed=3)
    other = record("across", env, 1, noise=0.5, labels="teacher", seed=3, first=1)
    assert noisy[1] == other[0]  # the noise follows from seed and number
    assert noisy.replay() == 2 * STEPS
    for episode in noisy:
        assert episode.labels is not None
        assert not np.array_equal(episode.labels, episode.actions)
        assert np.abs(episode.actions).max() <= 1.0
    env.reset(seed=3, options={"episode": 0})
    player = as_agent("across")
    player.start(env.unwrapped)
    for step, played in enumerate(noisy[0].actions):
        said = np.clip(player.act(env.unwrapped.observe()), -1.0, 1.0)
        np.testing.assert_array_equal(noisy[0].labels[step], said.astype(np.float32))
        env.step(played)
    np.testing.assert_array_equal(noisy.pairs()[1], np.concatenate([e.labels for e in noisy]))
    loaded = Recording.load(noisy.save(tmp_path / "runs"))
    assert loaded.episodes == noisy.episodes
    np.testing.assert_array_equal(loaded[1].labels, noisy[1].labels)


def test_a_learner_acts_and_its_teacher_says_what_it_should_do() -> None:
    """A round of DAgger: labels come from another policy; without any, actions are learned."""
    learner = record("still", make(), 1, labels="across")
    assert learner[0] != record("still", make(), 1)[0]
    np.testing.assert_array_equal(learner[0].actions, record("still", make(), 1)[0].actions)
    assert not np.array_equal(learner.pairs()[1], learner[0].actions)
    assert record("still", make(), 1)[0].labels is None
    with pytest.raises(UnknownOption, match="noise"):
        record("still", make(), 1, noise=-0.1)


def test_labels_are_infos_of_minari(minari: Any) -> None:
    """Transitions have the actions that were played; labels are beside them."""
    recording = record("across", make(), 1, noise=0.3, labels="teacher")
    given = {**AUTHOR, **ARROW, "ref_min_score": 1.0, "ref_max_score": 2.0}
    dataset = recording.to_minari("scm_world/pushing/labels-v0", **given)
    np.testing.assert_array_equal(dataset[0].actions, recording[0].actions)
    np.testing.assert_array_equal(dataset[0].infos["label"][:-1], recording[0].labels)
    assert minari.get_normalized_score(dataset, np.array([1.5])) == 0.5
