"""Recipes and trainings in models, whose tasks are named by a text."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from scm_world.errors import EngineFailure, UnknownOption, UnreadableFile
from scm_world.evaluation import evaluate, protocols_of
from scm_world.policies import load_policy
from scm_world.tasks import TASKS, register
from scm_world.tasks.sources import load_named
from scm_world.training.imitation import lesson
from scm_world.training.recipe import Recipe, recipe

TASK = f"{Path(__file__).parents[1] / 'env' / 'model_tasks.py'}:Balance"
Balance = load_named(TASK, "task")
SMALL = {
    "worlds": 2,
    "steps": 256,
    "n_steps": 32,
    "batch_size": 32,
    "n_epochs": 1,
    "rate": {"schedule": "constant"},
}


def test_a_recipe_takes_a_model() -> None:
    """Without the options of the robot; trials are in the protocols that there are."""
    made = recipe(TASK, curriculum=2)
    assert made.env == {}
    assert made.trials.protocols == ("P0", "A", "B")
    assert Recipe.from_dict(made.as_dict(), trusted=(TASK,)) == made
    with pytest.raises(UnknownOption, match="trusted"):
        Recipe.from_dict(made.as_dict())
    with pytest.raises(UnknownOption, match="P5"):
        recipe(TASK, trials={"protocols": ("P5",)})
    with pytest.raises(UnknownOption, match="did you mean 'pushing'"):
        recipe("pushin")
    with pytest.raises(UnknownOption, match="no_such_module"):
        recipe("no_such_module:task")


def test_a_task_has_one_recipe_however_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registered, or as a function in a file; none has options of the robot."""
    monkeypatch.setattr("scm_world.tasks.sources._REGISTERED", {})
    register(type("Named", (Balance,), {"name": "mybalance"}))
    for algo in ("ppo", "sac", "td3"):
        mine, other = recipe("mybalance", algo), recipe(TASK, algo)
        assert mine == other.model_copy(update={"task": "mybalance"})
        assert mine.env == {}
    assert protocols_of("mybalance") == protocols_of(TASK)
    assert recipe("mybalance").trials.protocols == ("P0", "A", "B")
    assert lesson("mybalance").env == lesson(TASK).env == {}
    assert lesson("pushing").env["action_mode"] == "delta_joint_positions"
    monkeypatch.setattr("scm_world.tasks.sources._REGISTERED", {})
    register(type("Own", (TASKS["reaching"],), {"name": "myreaching"}))
    assert recipe("myreaching").env == dict(TASKS["reaching"].training["env"])


def test_a_class_says_what_its_recipe_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """For all algorithms or for one; what is wrong in it is said."""
    monkeypatch.setattr("scm_world.tasks.sources._REGISTERED", {})
    given = {"steps": 4_096, "env": {"context": "none"}, "sac": {"worlds": 4}}
    register(type("Own", (Balance,), {"name": "own", "training": given}))
    assert (recipe("own").steps, recipe("own").worlds) == (4_096, 64)
    assert recipe("own", "sac").worlds == 4
    assert recipe("own", steps=8_192).steps == 8_192
    register(type("Wrong", (Balance,), {"name": "wrong", "training": {"step": 1}}))
    with pytest.raises(UnknownOption, match="step of a recipe"):
        recipe("wrong")


@pytest.mark.slow
def test_ppo_balances_a_pole_from_its_recipe(tmp_path: Path) -> None:
    """Less than three minutes of one core: episodes of random actions end after half a second."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.loop import train

    task = f"{Path(__file__).parents[2] / 'examples' / 'cartpole.py'}:CartPole"
    before, made = time.process_time(), recipe(task)
    trained = train(made, out=tmp_path / "run", threads=1)
    assert time.process_time() - before < 180.0
    found = evaluate({"trained": trained.best, "random": "random"}, "P0,A", task=task, n=20)
    for protocol in ("P0", "A"):
        lengths = found.only(agent="trained", protocol=protocol).frame["steps"]
        assert lengths.mean() > 450.0
    assert found.only(agent="random").frame["steps"].mean() < 50.0


@pytest.mark.parametrize("kind", ["Balance", "Falling"])
def test_an_agent_is_trained_evaluated_and_goes_on(tmp_path: Path, kind: str) -> None:
    """In a task with success, and in one that ends episodes and knows rewards alone."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.loop import train

    task, folder = TASK.replace("Balance", kind), tmp_path / "run"
    trials = {"protocols": ("A",), "episodes": 2, "times": 2}
    made = recipe(task, curriculum=2, trials=trials, network={"hidden": (8,)}, **SMALL)
    trained = train(made, out=folder)
    assert trained.steps == 256
    (first, *_) = sorted(trained.folder.glob("evaluations/*.json"))
    metric = {"Balance": "success", "Falling": "return"}[kind]
    assert json.loads(first.read_text())["metric"] == metric
    assert load_policy(trained.policy).n_actions == 1
    found = evaluate(folder, "A,B", task=task, n=2)
    assert found.task == task
    assert found.metric() == metric
    longer = train(made.but(steps=512), out=folder)
    assert longer.steps == 512
    with pytest.raises(UnreadableFile, match=r"differ: .*settings"):
        train(made.but(gamma=0.9), out=folder)


def test_a_training_goes_on_where_a_world_fails(tmp_path: Path) -> None:
    """Its episode ends; the training says how often, and evaluations on the way go on, too."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.loop import train

    task = f"{Path(__file__).parents[1] / 'env' / 'test_env_failures.py'}:Growing"
    said: list[str] = []
    made = recipe(task, **{**SMALL, "steps": 640, "trials": {"protocols": ["P0"], "episodes": 1}})
    train(made, out=tmp_path / "on", tell=said.append)
    (told,) = (line for line in said if "grew beyond all bounds" in line)
    failed, _, over = told.split()[:3]
    assert 0 < int(failed) <= int(over)
    assert "rollout/failed" in (tmp_path / "on" / "progress.csv").read_text().splitlines()[0]
    with pytest.raises(EngineFailure, match=r"environment [01]: .*unstable"):
        train(
            made.but(env={"on_failure": "raise"}, trials={"protocols": ()}), out=tmp_path / "ends"
        )
