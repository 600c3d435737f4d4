"""Tasks of one's own: registered by name."""

from __future__ import annotations

from typing import Any

import pytest

from scm_world._fingerprint import differing, fingerprint
from scm_world.errors import ModelError, UnknownOption
from scm_world.evaluation import evaluate, protocols_of
from scm_world.evaluation.preparation import again
from scm_world.tasks import TASKS, Reaching, Task, TriFingerTask, make_task, register, tasks
from scm_world.training.recipe import Recipe, recipe
from scm_world.world import Simulation


class Mine(Reaching):  # type: ignore[misc] # a twin of it is enough here
    """Reaching under another name."""

    name = "mine"


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[Task]]:
    """Provide a registry that is forgotten after the test."""
    mine: dict[str, type[Task]] = {}
    monkeypatch.setattr("scm_world.tasks.sources._REGISTERED", mine)
    return mine


def test_what_is_registered_is_known_by_its_name(registry: dict[str, type[Task]]) -> None:
    """Worlds and evaluations take the name; the tasks of the package stay what they are."""
    assert register(Mine) is Mine
    assert register(Mine) is Mine  # a second time, as when a module is run again
    assert tasks() == {**TASKS, "mine": Mine}
    assert "mine" not in TASKS
    assert isinstance(Simulation("mine", backend="fake").task, Mine)
    assert [protocol.name for protocol in protocols_of("mine")] == ["P0"]
    found = evaluate("still", task="mine", n=1, backend="fake", env={"max_episode_length": 2})
    assert "class of the task" in found.about["fingerprint"]
    again(found)
    registry["mine"] = type("Changed", (Mine,), {})
    with pytest.raises(UnknownOption, match="class of the task differ"):
        again(found)


def test_a_recipe_takes_it(registry: dict[str, type[Task]]) -> None:
    """It is evaluated where there is something, and its run says which class it was."""
    with pytest.raises(UnknownOption, match="mine"):
        recipe("mine")
    register(Mine)
    made = recipe("mine", worlds=2, n_steps=8, batch_size=8, steps=16)
    assert made.trials.protocols == ("P0",)
    assert Recipe.from_dict(made.as_dict()) == made
    before = fingerprint(make_task(made.task), libraries=False)
    registry["mine"] = type("Changed", (Mine,), {})
    assert differing(before, fingerprint(make_task(made.task), libraries=False)) == [
        "class of the task"
    ]
    registry["mine"] = Mine
    with pytest.raises(UnknownOption, match="P5"):
        recipe("mine", trials={"protocols": ["P5"]})


def test_it_is_trained(registry: dict[str, type[Task]], tmp_path: Any) -> None:
    """A training in its name is one of it, and its policy is evaluated in it."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.loop import train

    register(Mine)
    made = recipe("mine", worlds=2, n_steps=8, batch_size=8, steps=16, trials={"protocols": []})
    trained = train(made, out=tmp_path / "run", backend="fake")
    found = evaluate(trained.best, n=1, backend="fake", env={"max_episode_length": 2})
    assert found.about["task"] == "mine"


def test_a_name_belongs_to_one(registry: dict[str, type[Task]]) -> None:
    """Names of this package and of others are not taken over."""
    register(Mine)
    for name in ("mine", "reaching"):
        other = type("Other", (Mine,), {"name": name})
        with pytest.raises(UnknownOption, match="a name that is not taken"):
            register(other)
    assert registry == {"mine": Mine}


class Needy(Mine):  # type: ignore[misc] # likewise
    """It cannot be made by its name alone."""

    def __init__(self, *, height: float, **options: Any) -> None:
        super().__init__(**options)
        self.height = height


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (Mine(), "is not a class derived from"),
        (int, "is not a class derived from"),
        (type("Nameless", (Task,), {}), "has no name"),
        (type("Weightless", (TriFingerTask,), {}), "has no default_weights"),
        (type("Half", (TriFingerTask,), {"name": "half"}), "does not define 'entities'"),
        (Needy, "no default for 'height'"),
    ],
    ids=["instance", "int", "nameless", "weightless", "half", "needy"],
)
def test_what_is_no_task_is_refused(registry: dict[str, type[Task]], given: Any, said: str) -> None:
    """The error says what is missing, all of it."""
    with pytest.raises(ModelError, match=said):
        register(given)
    assert not registry
