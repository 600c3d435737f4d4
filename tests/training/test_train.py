"""Training with Stable-Baselines3: policies, interruptions, the same bits."""

from __future__ import annotations

import csv
import errno
import io
import json
import signal
import subprocess
import sys
import zipfile
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
import safetensors.numpy

from scm_world._arguments import missing
from scm_world.curricula import CurriculumEnv, make_vec, stages
from scm_world.curricula.curriculum import as_curriculum
from scm_world.env import ScmWorldEnv
from scm_world.errors import (
    ActionError,
    Diverged,
    InterventionError,
    MissingExtra,
    ModelError,
    ScmWorldError,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.evaluation import Protocol, evaluate
from scm_world.policies import MlpPolicy, as_agent, load_policy, save_policy
from scm_world.runs.study import Study, settings_in
from scm_world.training.export import SEED, begin_with
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe, recipe
from scm_world.training.settings import Rate
from scm_world.training.worlds import SCALES, level_seed, scales

sb3 = pytest.importorskip("stable_baselines3")

from scm_world.training import algorithms  # noqa: E402 # needs the library

SMALL: dict[str, Any] = {
    "worlds": 4,
    "env": {"delta_scale": 0.1},
    "episode_length": 10,
    "network": {"hidden": [8, 8], "log_std_end": None},
    "trials": {"episodes": 1, "times": 2, "protocols": ["P0"]},
}
OFF: dict[str, Any] = {
    **SMALL,
    "steps": 240,
    "batch_size": 16,
    "learning_starts": 60,
    "buffer_size": 120,
    "gradient_steps": 1,
}
RECIPES: dict[str, Recipe] = {
    "ppo": recipe(
        "pushing",
        **SMALL,
        steps=256,
        n_steps=8,
        batch_size=16,
        rate={"schedule": "adaptive"},
        scale_rewards=True,
        critic_warmup=64,
    ),
    "recurrent": recipe(
        "pushing",
        "recurrent_ppo",
        **{**SMALL, "network": {"hidden": [8], "recurrent": 6}},
        steps=256,
        n_steps=8,
        batch_size=16,
        critic_warmup=64,
    ),
    "sac": recipe("pushing", "sac", **OFF),
    "td3": recipe("pushing", "td3", **OFF),
    "hindsight": recipe("pushing", "sac", **OFF, hindsight=True),
}


def run(name: str | Recipe, out: Path, steps: Any = None, **options: Any) -> Any:
    """Train a little."""
    given = {"out": out, "backend": "fake", "threads": 1, "seed": 3, **options}
    how = RECIPES[name] if isinstance(name, str) else name
    return train(how.but(steps=steps), **given)


def killed(name: str, out: Path, at: int) -> None:
    """Train until so many steps are done, in a process that is killed then."""
    text = RECIPES[name].to_json()
    program = f"""
import json, os
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe
die = lambda done, _: done >= {at} and os.kill(os.getpid(), 9)
made = Recipe.from_dict(json.loads({text!r}))
train(made, out={str(out)!r}, backend="fake", threads=1, seed=3, progress=die)
"""
    done = subprocess.run([sys.executable, "-c", program], check=False)  # noqa: S603 # ours
    assert done.returncode == -9


def checkpoints(folder: Path) -> list[int]:
    """List the steps of the checkpoints of a run."""
    return sorted(int(path.stem.split("_")[1]) for path in folder.glob("checkpoints/run_*.zip"))


def weights(path: Path) -> dict[str, Any]:
    """Read a policy file."""
    found: dict[str, Any] = safetensors.numpy.load_file(path)
    return found


def test_what_was_killed_goes_on_from_the_last_checkpoint(tmp_path: Path) -> None:
    """With the weights of the checkpoint, to the end; the best score so far is known."""
    name, out, said = "hindsight", tmp_path / "run", list[str]()
    killed(name, out, 160)
    last = checkpoints(out)[-1]
    assert last <= 160
    found = run(name, out, tell=said.append)
    assert f"goes on after {last:,} steps" in said
    assert found.steps == RECIPES[name].steps
    assert checkpoints(out)[-1] == RECIPES[name].steps
    scores = [json.loads(path.read_text())["mean"] for path in out.glob("evaluations/*.json")]
    assert found.score == max(scores)


@pytest.mark.parametrize("name", ["sac", "hindsight", "ppo"])
def test_a_training_goes_on_with_what_it_remembers(name: str, tmp_path: Path) -> None:
    """The replay buffer or the scale of rewards, of the last checkpoint; else it says so."""
    out, said, recipe = tmp_path / "run", list[str](), RECIPES[name]
    run(name, out, steps=128)
    (memory,) = out.glob("checkpoints/memory_*.npz")
    assert memory.stem == "memory_128"

    worlds = algorithms.make_worlds(recipe, backend="fake")

    def resumed() -> Any:
        model = algorithms.make_learner(recipe, worlds, seed=3)
        study = Study(out, "training", settings_in(out, "training"))
        algorithms.resume(model, study, said.append)
        return model

    def begun() -> Any:
        seen = worlds.reset()
        return seen["observation"] if isinstance(seen, dict) else seen

    algorithms.make_learner(recipe, worlds, seed=3)
    first = begun()
    model = resumed()
    assert said == ["goes on after 128 steps"]
    assert not np.array_equal(first, begun())  # other episodes
    if name == "ppo":
        assert model.get_vec_normalize_env().ret_rms.count > 100
    else:
        buffer, before = model.replay_buffer, np.load(memory)
        assert (buffer.pos, buffer.full) == (128 // 4 % 30, True)
        np.testing.assert_array_equal(buffer.rewards, before["buffer.rewards."])
        assert (buffer.dones[buffer.pos - 1] == 1.0).all()  # what was under way is over
        assert model.learning_starts < 128
        assert np.isfinite(buffer.sample(16).rewards.numpy()).all()
    memory.unlink()
    resumed()
    assert "without its memory" in said[1]
    assert ("random steps" in said[1]) == (name != "ppo")
    worlds.close()


def test_the_same_seed_learns_the_same(tmp_path: Path) -> None:
    """Bit for bit, on a CPU."""
    one, other = (weights(run("ppo", tmp_path / name).policy) for name in ("one", "other"))
    for key, array in one.items():
        np.testing.assert_array_equal(array, other[key], err_msg=key)


def test_a_recurrent_policy_acts_as_its_model(tmp_path: Path) -> None:
    """Over two episodes, with scaled observations; the file resumes, starts and has its value."""
    made = RECIPES["recurrent"].but(**{"network.scaled": True})
    path = run(made, tmp_path / "run").policy
    worlds = algorithms.make_worlds(made, backend="fake")
    model = algorithms.make_learner(made, worlds, seed=0)
    begin_with(model, made, path)
    worlds.close()
    seen = np.random.default_rng(0).normal(0, 0.5, (12, 3, *model.observation_space.shape))
    seen, policy = seen.astype(np.float32), load_policy(path)
    mine = theirs = alone = None
    for step, rows in enumerate(seen):
        first = np.array([step in (0, 7), False, step == 5])
        wanted, theirs = model.predict(rows, theirs, first, deterministic=True)
        found, mine = policy.predict(rows, mine, first)
        single, alone = policy.predict(rows[0], alone, first[0])
        np.testing.assert_allclose(found, wanted, atol=1e-5)
        np.testing.assert_array_equal(single, found[0])
    assert np.ptp(found) > 0.01
    assert policy.value_lstm
    agent = as_agent(str(path))
    with closing(ScmWorldEnv("pushing", backend="fake", **made.options)) as env:
        played = []
        for _ in range(2):
            shown, _ = env.reset(seed=0)
            agent.start(env)
            played.append([agent.act(shown) for _ in range(3)])
    np.testing.assert_array_equal(*played)  # emptied at the start of an episode
    assert np.ptp(played[0], axis=0).max() > 0.0  # it remembers what it has seen
    with pytest.raises(ActionError, match="has a memory"):
        policy(shown)
    for tensors in (
        {**policy.tensors(), "lstm.1.bias": np.zeros(7, np.float32)},
        {n: one for n, one in policy.tensors().items() if not n.startswith("lstm.1")},
    ):
        with pytest.raises(ModelError, match=r"lstm: expected two layers"):
            MlpPolicy.of(tensors)


def test_a_recurrent_training_resumes_and_repeats(tmp_path: Path) -> None:
    """After a kill from its checkpoint; with the same seed the same bits."""
    out, said = tmp_path / "run", list[str]()
    killed("recurrent", out, 160)
    assert run("recurrent", out, tell=said.append).steps == 256
    assert said[1].startswith("goes on after")
    one, two = (run("recurrent", tmp_path / name).policy for name in ("one", "two"))
    for name, array in weights(one).items():
        np.testing.assert_array_equal(array, weights(two)[name], err_msg=name)
    given = RECIPES["recurrent"].but(**{"rate.initial": 1e-12, "rate.schedule": "constant"})
    found = weights(run(given, tmp_path / "started", start=one).policy)
    for name, array in weights(one).items():
        np.testing.assert_allclose(found[name], array, atol=1e-6, err_msg=name)
    with pytest.raises(UnknownOption, match=r"network\.recurrent with ppo"):
        recipe("pushing", network={"recurrent": 6})


def test_a_critic_can_observe_more_than_the_actor(tmp_path: Path) -> None:
    """The causal parameters reach the value alone; the policy acts, resumes and starts without."""
    changes = {"observations": "critic", "env.history": 1, "env.context": ["tool_*.mass"]}
    made, out = RECIPES["ppo"].but(**changes, **{"network.scaled": True}), tmp_path / "run"
    run(made, out, steps=128)
    found = run(made, out)
    assert found.steps == made.steps
    policy = load_policy(found.policy)
    assert (policy.about.option("context"), policy.value) == ("none", ())
    with closing(algorithms.make_worlds(made, backend="fake")) as worlds:
        model = algorithms.make_learner(made, worlds, seed=0)
    begin_with(model, made, found.policy)
    envs = [ScmWorldEnv("pushing", backend="fake", **o) for o in (made.options, made.trained_in)]
    for env in envs:
        env.reset(seed=0)
        env.step(np.full(9, 0.3, np.float32))
    assert envs[1].appended == ("tool_block.mass",)
    bare, whole = (env.observe() for env in envs)
    envs[1].do({"tool_block.mass": 0.09})
    changed = envs[1].observe()
    action, other = (model.predict(one, deterministic=True)[0] for one in (whole, changed))
    np.testing.assert_allclose(policy(bare), action, atol=1e-5)
    np.testing.assert_array_equal(action, other)
    rows = model.policy.obs_to_tensor(np.stack([whole, changed]))[0]
    one, two = model.policy.predict_values(rows).detach().numpy().ravel()
    assert one != two
    once, again = (weights(run(made, tmp_path / name).policy) for name in ("one", "two"))
    for name, array in once.items():
        np.testing.assert_array_equal(array, again[name], err_msg=name)
    for algo, wrong in (("sac", {}), ("ppo", {"env": {"goal_env": True}})):
        with pytest.raises(UnknownOption, match="critic"):
            recipe("pushing", algo, observations="critic", **wrong)


@pytest.mark.parametrize("name", [name for name in RECIPES if name != "recurrent"])
@pytest.mark.parametrize("scaled", [False, True])
def test_the_policy_file_acts_as_the_model(name: str, scaled: bool, tmp_path: Path) -> None:
    """On observations of every size; scales of observations are in its weights."""
    made = RECIPES[name].but(**{"network.scaled": scaled, "trials.protocols": []})
    path = run(made, tmp_path / "run").policy
    worlds = algorithms.make_worlds(made, backend="fake")
    model = algorithms.make_learner(made, worlds, seed=0)
    begin_with(model, made, path)
    worlds.close()
    rng, space = np.random.default_rng(0), model.observation_space

    def draw(part: Any) -> Any:
        return rng.normal(0, 0.5, (32, *part.shape)).astype(part.dtype)

    is_dict = isinstance(space, gymnasium.spaces.Dict)
    seen = {key: draw(part) for key, part in space.items()} if is_dict else draw(space)
    wanted, policy = model.predict(seen, deterministic=True)[0], load_policy(path)
    np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)
    assert np.ptp(wanted) > 0.01
    assert (policy.about.task, policy.about.card["steps"]) == ("pushing", made.steps)
    assert (policy.about.inputs is not None) == is_dict
    if name == "td3":
        target = model.actor_target.state_dict()
        for key, tensor in model.actor.state_dict().items():
            np.testing.assert_array_equal(tensor.numpy(), target[key].numpy())


def test_an_evaluation_has_no_episode_of_a_training() -> None:
    """The goals of P5 by seed 0 are none that the worlds of a training by seed 0 begin with."""
    made = recipe("reaching", worlds=2, n_steps=8, batch_size=8, trials={"protocols": []})
    worlds = algorithms.make_worlds(made, backend="fake")
    algorithms.make_learner(made, worlds, seed=0)
    assert made.env["observe"][-1] == "goal_300.cartesian_position"
    met = worlds.reset()[0, -3:]
    worlds.close()
    short = {"max_episode_length": 1}
    found = evaluate("still", "P5", task="reaching", n=1, backend="fake", env=short)
    radius, angle, height = found.drawn()["goal_300.cylindrical_position"][0]
    drawn = [radius * np.cos(angle), radius * np.sin(angle), height]
    assert met != pytest.approx(drawn, abs=1e-3)


def test_worlds_begin_at_different_steps_of_their_episodes() -> None:
    """World i of n began i / n of an episode later than the first one."""
    worlds = algorithms.make_worlds(RECIPES["sac"], backend="fake")
    worlds.seed(0)
    worlds.reset()
    ends: list[list[int]] = [[] for _ in range(4)]
    for step in range(1, 25):
        *_, dones, infos = worlds.step(np.zeros((4, 9)))
        for index in np.flatnonzero(dones):
            ends[index].append(step)
            assert infos[index]["episode"]["l"] == 10
            assert {"is_success", "fractional_success"} <= infos[index]["episode"].keys()
    worlds.close()
    assert ends == [[3, 13, 23], [5, 15], [8, 18], [10, 20]]


def test_a_run_is_whole(tmp_path: Path) -> None:
    """Everything is in its place; the same call again does nothing."""
    said: list[str] = []
    told: list[tuple[int, int]] = []
    folder = tmp_path / "run"
    found = run("ppo", folder, tell=said.append, progress=lambda *given: told.append(given))
    assert {path.name for path in folder.iterdir()} == {
        "best.safetensors",
        "checkpoints",
        "evaluations",
        "policy.safetensors",
        "progress.csv",
        "study.json",
        "tensorboard",
    }
    card: Any = load_policy(found.policy).about.card
    assert card["versions"]["stable-baselines3"]
    assert Recipe.from_dict(card["recipe"]) == found.recipe
    names = sorted(path.name for path in (folder / "evaluations").iterdir())
    assert names == ["128.json", "256.json"]
    head = (folder / "progress.csv").read_text().partition("\n")[0].split(",")
    for name in ("rollout/ep_rew_mean", "rollout/success_rate", "rollout/fractional_success"):
        assert name in head
    assert {"train/approx_kl", "train/learning_rate", "evaluation/P0"} <= {*head}
    assert told[-1] == (256, 256)
    assert said[-1].startswith("256 steps: P0")
    before = found.policy.read_bytes()
    again = run("ppo", folder)
    assert (again.best, again.score) == (found.best, found.score)
    assert again.policy.read_bytes() == before


class Tracker(ModuleType):
    """The interface that wandb and trackio have in common, as they have it."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.runs: list[dict[str, Any]] = []

    def init(self, project: str, name: str, config: Any, resume: str, **more: Any) -> None:
        """Begin a run, or go on with one of this name."""
        assert (more == {"id": name}) == (self.__name__ == "wandb")
        self.runs.append({"about": (project, name, resume), "algo": config["recipe"]["algo"]})
        self.runs[-1] |= {"steps": [], "rows": [], "finished": False}

    def log(self, numbers: dict[str, Any], step: int) -> None:
        """Keep numbers."""
        self.runs[-1]["steps"].append(step)
        self.runs[-1]["rows"].append(numbers)

    def finish(self) -> None:
        """End the run."""
        self.runs[-1]["finished"] = True


def test_trackers_and_a_callback_get_the_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the learning curve; a resumed run goes on under its name."""
    trackers = {name: Tracker(name) for name in ("wandb", "trackio")}
    for name, tracker in trackers.items():
        monkeypatch.setitem(sys.modules, name, tracker)
    heard: list[dict[str, Any]] = []
    out, log = tmp_path / "run", "wandb,trackio"
    run("ppo", out, steps=128, log=log, callback=heard.append)
    run("ppo", out, log=["wandb", "trackio"], callback=heard.append)
    first, second = trackers["wandb"].runs
    assert first["about"] == second["about"]
    assert first["about"][::2] == ("scm-world", "allow")
    assert (first["algo"], first["finished"], second["finished"]) == ("ppo", True, True)
    assert first["steps"] == [32, 64, 96, 128, 128]  # at last with the evaluation
    assert second["steps"] == [160, 192, 224, 256, 256]
    rows = [*first["rows"], *second["rows"]]
    assert heard == rows == [row for one in trackers["trackio"].runs for row in one["rows"]]
    with (out / "progress.csv").open() as file:
        curve = list(csv.DictReader(file))
    for row, line in zip(first["rows"], curve, strict=True):
        assert {name: float(text) for name, text in line.items() if text} == pytest.approx(row)
    assert "evaluation/P0" in rows[-1]
    assert not (out / "tensorboard").exists()

    class Stop(sb3.common.callbacks.BaseCallback):  # type: ignore[name-defined,misc]
        def _on_step(self) -> bool:
            return bool(self.num_timesteps < 64)

    assert run("ppo", tmp_path / "stopped", callback=Stop()).steps == 64
    with pytest.raises(UnknownOption, match="callback"):
        run("ppo", tmp_path / "no", callback=3)
    with pytest.raises(UnknownOption, match="log of ppo"):
        run("ppo", tmp_path / "no", log="mlflow")
    monkeypatch.setitem(sys.modules, "trackio", None)
    with pytest.raises(MissingExtra, match="pip install trackio"):
        run("ppo", tmp_path / "no", log="trackio")


def test_an_agent_that_is_told_some_causes_is_scored_on_the_way(tmp_path: Path) -> None:
    """Its file is that of its environment, in each form of the option."""
    told: dict[str, Any] = {"observations": "privileged", "env": {"context": ["*.mass"]}}
    made = recipe("pushing", **{**SMALL, **told}, steps=64, n_steps=8, batch_size=16)
    found = run(made, tmp_path)
    given = {"context": "*.mass", "max_episode_length": 3}
    agent = as_agent(found.policy, env={"context": {"observation": "*.mass"}})
    scores = evaluate({"told": agent}, "P0", task="pushing", backend="fake", n=1, env=given)
    assert found.score is not None
    assert len(scores.frame) == 1


def test_levels_are_a_fixed_set_of_episodes(tmp_path: Path) -> None:
    """All worlds play them; trials have the scores on them and on new draws, and the gap."""
    made = RECIPES["ppo"].but(levels=3, curriculum="P5", steps=128)
    worlds = algorithms.make_worlds(made, backend="fake", seed=3)
    worlds.seed(0)
    met = [worlds.reset(), *(worlds.step(np.zeros((4, 9)))[0] for _ in range(80))]
    (layout,) = worlds.get_attr("layout", 0)
    worlds.close()
    goals = np.stack(met)[..., layout["goal_block.cartesian_position"]].reshape(-1, 3)
    curriculum = as_curriculum(made.curriculum)
    with closing(ScmWorldEnv("pushing", backend="fake", **made.options)) as inside:
        env, wanted = CurriculumEnv(inside, curriculum), []
        for level in range(3):
            shown, _ = env.reset(seed=level_seed(3), options={"episode": level})
            wanted.append(shown[layout["goal_block.cartesian_position"]])
    assert {*map(tuple, goals.tolist())} == {*map(tuple, np.array(wanted).tolist())}

    many: dict[str, Any] = {"levels": 3, "level_seed": level_seed(3), "backend": "fake"}
    seen = []
    for how in ({"threads": 1}, {"workers": 2}):
        mode = gymnasium.vector.AutoresetMode.SAME_STEP
        with closing(make_vec("scm_world/Pushing-v0", 4, curriculum, **how, **many,
                              autoreset_mode=mode, max_episode_length=9)) as envs:  # fmt: skip
            seen.append(
                [envs.reset(seed=0)[0], *(envs.step(np.zeros((4, 9)))[0] for _ in range(30))]
            )
    np.testing.assert_array_equal(*seen)  # levels come in the same order from processes

    found = run(made, tmp_path / "run")
    card: Any = load_policy(found.best).about.card["trial"]
    trial = json.loads((tmp_path / "run" / "evaluations" / f"{card['steps']}.json").read_text())
    drawn = Protocol("drawn", act=curriculum)
    how: Any = {"task": "pushing", "backend": "fake", "n": 1}
    for name, seed in {"training_levels": level_seed(3), "new_draws": SEED}.items():
        score = evaluate(found.best, drawn, seeds=seed, **how).score("drawn").value
        assert trial[name] == card[name] == pytest.approx(score)
    assert card["gap"] == trial["gap"] == trial["training_levels"] - trial["new_draws"]
    assert "evaluation/gap" in (tmp_path / "run" / "progress.csv").read_text()
    again = run(made, tmp_path / "again")
    for name, array in weights(found.policy).items():
        np.testing.assert_array_equal(array, weights(again.policy)[name], err_msg=name)
    staged = stages({"floor_friction": 0.4}, {"floor_friction": 0.6}, up=0.8)
    with pytest.raises(UnknownOption, match="levels of a curriculum with stages"):
        recipe("pushing", levels=3, curriculum=staged)


def test_one_training_is_not_another(tmp_path: Path) -> None:
    """Another seed learns something else; what is different is said."""
    run("ppo", tmp_path / "one"), run("ppo", tmp_path / "two", seed=4)
    one, two = (weights(tmp_path / name / "policy.safetensors") for name in ("one", "two"))
    assert not np.array_equal(one["layers.0.weight"], two["layers.0.weight"])
    for options, said in (
        ({"seed": 4}, r"seed \(.* there, .* here\)"),
        ({"backend": "mujoco"}, r"backend \(.* there, .* here\)"),
        ({"name": RECIPES["ppo"].but(**{"rate.initial": 0.25})}, r"rate.*\(.* there, .* here\)"),
        ({"start": tmp_path / "two" / "policy.safetensors"}, "differ: start"),
    ):
        with pytest.raises(UnreadableFile, match=said):
            run(**{"name": "ppo", "out": tmp_path / "one", **options})
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "thesis.tex").write_text("")
    with pytest.raises(UnreadableFile, match="thesis"):
        run("ppo", tmp_path / "strange")
    (tmp_path / "strange" / "study.json").write_text("{")
    with pytest.raises(UnreadableFile, match="strange"):
        run("ppo", tmp_path / "strange")


def test_what_was_swapped_or_cut_is_not_resumed_from(tmp_path: Path) -> None:
    """A checkpoint under the name of another one is passed over; a cut evaluation is named."""
    out, said = tmp_path / "run", list[str]()
    run("ppo", out, steps=128)
    *_, before, last = checkpoints(out)
    path = out / "checkpoints" / f"run_{last}_steps.zip"
    path.rename(path.with_name("run_192_steps.zip"))
    run("ppo", out, tell=said.append)
    assert any("run_192_steps.zip" in line and "belongs elsewhere" in line for line in said)
    assert any(line.startswith(f"goes on after {before} steps") for line in said)
    path = next(out.glob("evaluations/*.json"))
    path.write_text("{")
    with pytest.raises(UnreadableFile, match=path.name):
        run("ppo", out)


def test_a_training_becomes_longer(tmp_path: Path) -> None:
    """It goes on; not where the learning rate knows the length."""
    run("ppo", tmp_path / "longer", steps=128)
    found = run("ppo", tmp_path / "longer")
    assert found.steps == 256
    assert run("ppo", tmp_path / "longer", steps=128).steps == 256  # there is nothing left
    for name, value in {"rate.schedule": "linear", "network.log_std_end": -3.0}.items():
        line = RECIPES["ppo"].but(**{name: value, "steps": 64})
        run(line, tmp_path / name)
        with pytest.raises(UnreadableFile, match=r"differ: .*steps"):
            run(line, tmp_path / name, steps=128)


@pytest.mark.parametrize("change", [{"network.log_std": 1_000.0}, {"rate.initial": 1e12}])
def test_divergence_ends_a_training(change: dict[str, float], tmp_path: Path) -> None:
    """Deviations that are infinite, and steps that are far too long; nothing of it is kept."""
    with pytest.raises(Diverged, match="lower learning rate"):
        run(RECIPES["ppo"].but(**change, critic_warmup=0), tmp_path / "run")
    assert not [*(tmp_path / "run").glob("*.safetensors")]


def test_bodies_that_come_and_go_cannot_all_be_observed(tmp_path: Path) -> None:
    """Worlds are observed alike; the error of the worlds is shown, and what to do."""
    everything = {"curriculum": 2, "observations": "privileged", "n_steps": 8, "batch_size": 16}
    privileged = recipe("reaching", **SMALL, steps=64, **everything)
    with pytest.raises(InterventionError, match="leave it out of a curriculum"):
        run(privileged, tmp_path / "run")


def test_the_value_is_learned_alone_at_first(tmp_path: Path) -> None:
    """During the warm-up of the critic the policy and an adaptive rate stay as they are."""
    made = RECIPES["ppo"].but(critic_warmup=1_000, steps=64)
    one = weights(run(made, tmp_path / "one").policy)
    two = weights(run(made, tmp_path / "two", steps=256).policy)
    np.testing.assert_array_equal(one["layers.0.weight"], two["layers.0.weight"])
    np.testing.assert_array_equal(one["log_std"], two["log_std"])
    assert not np.array_equal(one["value.layers.0.weight"], two["value.layers.0.weight"])
    rows = (tmp_path / "two" / "progress.csv").read_text().splitlines()
    column = rows[0].split(",").index("train/learning_rate")
    assert {float(row.split(",")[column]) for row in rows[2:]} == {made.rate.initial}


def test_the_ceiling_of_the_noise_falls(tmp_path: Path) -> None:
    """At the end of a training no standard deviation is above what was asked for."""
    made = RECIPES["ppo"].but(**{"network.log_std_end": -3.0})
    assert weights(run(made, tmp_path / "run").policy)["log_std"].max() <= -3.0


@pytest.mark.parametrize("name", ["ppo", "sac", "td3"])
def test_training_begins_with_a_policy(name: str, tmp_path: Path) -> None:
    """Its weights are those of the first round; it is part of what the run is."""
    given = run(name, tmp_path / "first").policy
    made = RECIPES[name].but(**{"rate.initial": 1e-12, "rate.schedule": "constant"})
    found = run(made, tmp_path / "second", start=given).policy
    for key, array in weights(given).items():
        np.testing.assert_allclose(weights(found)[key], array, atol=1e-6)
    with pytest.raises(UnreadableFile, match="differ: start"):
        run(made, tmp_path / "second")
    bare = {k: v for k, v in weights(given).items() if k.startswith("layers")}
    start = save_policy(tmp_path / "bare.safetensors", bare, load_policy(given).about)
    third = weights(run(made, tmp_path / "third", start=start).policy)
    np.testing.assert_allclose(third["layers.0.weight"], bare["layers.0.weight"], atol=1e-6)


def test_beginnings_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """Other networks, other observations, no policy; nothing is left in the folder."""
    first, out = run("ppo", tmp_path / "first"), tmp_path / "second"
    for made, said in (
        (RECIPES["ppo"].but(**{"network.hidden": [9, 8]}), "shape of layers.0"),
        (RECIPES["ppo"].but(**{"env.delta_scale": 0.2}), "delta_scale is 0.1 there and 0.2"),
        (RECIPES["sac"], "output"),
    ):
        with pytest.raises(UnreadableFile, match=said):
            run(made, out, start=first.policy)
        assert not out.exists()
    for start in (tmp_path / "nothing", tmp_path / "first" / "study.json"):
        with pytest.raises(UnreadableFile, match=start.name):
            run("ppo", out, start=start)
        assert not out.exists()
    with pytest.raises(UnknownOption, match="policy of the zoo"):
        run("ppo", out, start="zoo:nothing-of-this-name")
    assert run("ppo", out, start=first.folder).steps == 256


def test_damaged_checkpoints_are_left_out(tmp_path: Path) -> None:
    """A file that was cut, or is something else: the one before is taken, and nothing is run."""
    folder, said = tmp_path / "run", list[str]()
    run("ppo", folder, steps=128)
    last = folder / "checkpoints" / f"run_{checkpoints(folder)[-1]}_steps.zip"
    for data in (last.read_bytes()[:-9], b"", b"short"):
        last.write_bytes(data)
        said.clear()
        run("ppo", folder, steps=128, tell=said.append)
        assert any(f"{last} is damaged" in line for line in said)
        before = checkpoints(folder)[-2]
        assert any(f"goes on after {before:,} steps without its memory" in line for line in said)


def test_reading_a_checkpoint_runs_no_code(tmp_path: Path) -> None:
    """A pickle that would call something is not read."""
    import torch

    class Trap:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "sprung",))

    folder = tmp_path / "run"
    run("ppo", folder, steps=128)
    last = folder / "checkpoints" / f"run_{checkpoints(folder)[-1]}_steps.zip"
    stream = io.BytesIO()
    torch.save({"parameters": Trap()}, stream)
    with zipfile.ZipFile(last, "w") as file:
        file.writestr("data", "{}")
        file.writestr("policy.pth", stream.getvalue())
    assert run("ppo", folder).steps == 256
    assert not (tmp_path / "sprung").exists()


def test_a_full_disk_ends_the_training_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says what is wrong, and the same call goes on."""
    folder = tmp_path / "run"

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(sb3.PPO, "save", full)
        with pytest.raises(UnwritableFolder, match="No space left"):
            run("ppo", folder)
    assert run("ppo", folder).steps == 256


def test_ctrl_c_writes_a_checkpoint(tmp_path: Path) -> None:
    """The same call goes on."""
    said: list[str] = []

    def interrupt(done: int, _: int) -> None:
        if done == 96:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run("ppo", tmp_path / "run", tell=said.append, progress=interrupt)
    assert checkpoints(tmp_path / "run")[-1] == 96
    run("ppo", tmp_path / "run", tell=said.append)
    assert "goes on after 96 steps" in said


def test_what_is_never_learned_is_told(tmp_path: Path) -> None:
    """More random steps than there are steps."""
    said: list[str] = []
    made = RECIPES["sac"].but(**{"learning_starts": 5_000, "trials.protocols": []})
    run(made, tmp_path / "run", tell=said.append)
    assert said[0].startswith("Training SAC on pushing")
    assert said[1:] == ["nothing will be learned: learning starts after 5,000 steps"]


def test_a_recipe_for_a_policy_that_can_act_says_so(tmp_path: Path) -> None:
    """The recipe learns the value first, and no policy is given; with one nothing is said."""
    said: list[str] = []
    found = run("ppo", tmp_path / "run", tell=said.append)
    assert "give it with --start" in said[1]
    said.clear()
    run("ppo", tmp_path / "again", tell=said.append, start=found.policy)
    assert not [line for line in said if "--start" in line]


def test_without_the_library_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a folder is made."""
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(MissingExtra, match=r"'stable-baselines3'.*scm-world\[train\]"):
        run("ppo", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_library_that_another_one_needs_is_named() -> None:
    """Without torch it is torch that is missing, not what imports it."""
    error = ModuleNotFoundError("No module named 'absent_torch'", name="absent_torch.nn")
    told = missing(error, "stable_baselines3.ppo", "stable-baselines3", "train")
    assert (told.package, told.extra) == ("absent_torch", "train")
    itself = ModuleNotFoundError("No module named 'stable_baselines3'", name="stable_baselines3")
    told = missing(itself, "stable_baselines3.ppo", "stable-baselines3", "train")
    assert told.package == "stable-baselines3"


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"steps": 0}, "steps"),
    ({"steps": 10}, "at least 32"),
    ({"steps": "many"}, "steps"),
    ({"seed": -1}, "seed"),
    ({"seed": 2**32}, "from 0 to 4294967295"),
    ({"threads": 0}, "threads"),
    ({"backend": "fakes"}, "fake"),
    ({"device": "tpu"}, "tpu"),
]


@pytest.mark.parametrize(("given", "said"), WRONG)
def test_what_cannot_be_trained_is_refused(
    given: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """Before anything is written."""
    with pytest.raises(ScmWorldError, match=said):
        run("ppo", tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


def test_learning_rates() -> None:
    """Constant, falling in a line, and following the divergence between bounds."""
    assert algorithms.rate_of(Rate(initial=0.5)) == 0.5
    line: Any = algorithms.rate_of(Rate(initial=1.0, schedule="linear", final=0.5))
    assert [line(left) for left in (1.0, 0.5, 0.0, -0.1)] == [1.0, 0.75, 0.5, 0.5]
    kept = Rate(initial=0.1, schedule="adaptive", target_kl=0.01, lowest=0.05, highest=0.12)
    now, found = kept.initial, []
    for divergence in (0.01, 0.001, 0.03, 0.03, 0.03):
        now = algorithms.adapted(kept, now, divergence)
        found.append(round(now, 4))
    assert found == [0.1, 0.12, 0.08, 0.0533, 0.05]


def test_scales_follow_the_quantities() -> None:
    """A position of the block has that of positions; what has none, and goals, are left alone."""
    for name, goals in (("sac", False), ("hindsight", True)):
        worlds = algorithms.make_worlds(RECIPES[name].but(**{"env.observe": None}), backend="fake")
        (layout,) = worlds.get_attr("layout", 0)
        found = scales(layout, worlds.observation_space, {})
        first = 20 if goals else 0  # achieved and desired goal
        where = np.arange(len(found))[first:][layout["tool_block.cartesian_position"]]
        assert set(found[where]) == {SCALES["cartesian_position"]}
        assert set(found[:first]) <= {1.0}
        worlds.close()
    with pytest.raises(UnknownOption, match="normalize_observations"):
        scales({}, None, {"normalize_observations": False})


def test_the_best_policy_is_best_by_the_metric_that_was_asked_for(tmp_path: Path) -> None:
    """Evaluations measure the return, if they should; what is no metric is refused."""
    how = RECIPES["ppo"].but(**{"trials.metric": "return"})
    found = run(how, tmp_path / "run")
    files = sorted((tmp_path / "run" / "evaluations").glob("*.json"))
    told = [json.loads(path.read_text()) for path in files]
    assert {one["metric"] for one in told} == {"return"}
    assert found.score == max(one["mean"] for one in told)
    with pytest.raises(UnknownOption, match="did you mean 'return'"):
        how.but(**{"trials.metric": "retrun"})
