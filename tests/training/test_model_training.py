"""Recipes and trainings in models, whose tasks are named by a text."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.evaluation import evaluate
from scm_world.policies import load_policy
from scm_world.training.recipe import Recipe, recipe

TASK = f"{Path(__file__).parents[1] / 'env' / 'model_tasks.py'}:Balance"
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
    with pytest.raises(UnreadableFile, match="other work"):
        train(made.but(gamma=0.9), out=folder)
