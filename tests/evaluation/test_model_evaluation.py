"""Protocols and evaluations of models: tasks that are files, functions, or objects."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_samples import played_again
from typer.testing import CliRunner

from scm_world import Box, ModelTask
from scm_world.cli.app import app
from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, SnapshotMismatch, UnknownOption
from scm_world.evaluation import Evaluation, Recording, evaluate, protocols_of, record, why
from scm_world.evaluation.figures import write_figures
from scm_world.evaluation.preparation import again
from scm_world.policies import WorldPolicy
from scm_world.tasks.sources import load_named

FILE = Path(__file__).parents[1] / "env" / "model_tasks.py"
Balance, Falling, Scored, Decay, Filling = (
    load_named(f"{FILE}:{name}", "task")
    for name in ("Balance", "Falling", "Scored", "Decay", "Filling")
)


def proportional(observation: np.ndarray) -> np.ndarray:
    """Push against the fall, a little."""
    return np.clip(2.0 * observation[2:3] + 0.3 * observation[3:4], -1.0, 1.0)


def test_protocols_follow_from_the_spaces() -> None:
    """Nothing, everything from A, one from A, and likewise B."""
    found = {p.name: (p.varies, p.space) for p in protocols_of(f"{FILE}:Balance")}
    assert found == {
        "P0": ((), "A"),
        "A": (("pole.mass", "motor.gear"), "A"),
        "A:pole.mass": (("pole.mass",), "A"),
        "A:motor.gear": (("motor.gear",), "A"),
        "B": (("pole.mass",), "B"),
        "B:pole.mass": (("pole.mass",), "B"),
    }
    assert [p.name for p in protocols_of(Decay())] == ["P0", "B", "B:rate"]
    with pytest.raises(UnknownOption, match="did you mean 'pushing'"):
        protocols_of("pushin")


def test_a_file_is_evaluated_kept_and_checked(tmp_path: Path) -> None:
    """By its text: scores, resuming, results on disk, replays; another model is told apart."""
    file = tmp_path / "tasks.py"
    shutil.copy(FILE, file)
    task, agents = f"{file}:Balance", {"mine": proportional, "random": "random"}
    found = evaluate(agents, "P0,A,B", task=task, n=6, out=tmp_path / "out")
    assert (found.metrics, found.metric()) == (("success", "return"), "success")
    assert found.score("A", agent="mine").value == 1.0
    assert found.score("A", "return", agent="mine").value > 28.0
    low, high = found.only(agent="mine", protocol="B").drawn()["pole.mass"].ravel()[[0, 1]]
    assert 0.2 <= low <= 0.4
    assert low != high
    assert evaluate(agents, "P0,A,B", task=task, n=6, out=tmp_path / "out") == found
    found.save(tmp_path / "out")
    loaded = Evaluation.load(tmp_path / "out")
    assert loaded == found
    assert loaded.about["task"] == task
    with pytest.raises(UnknownOption, match="trusted"):
        again(loaded, policy=agents)
    assert not played_again(loaded, policy=agents, task=task)
    assert not played_again(found)
    files = write_figures(found, tmp_path / "out")
    assert {file.name for file in files} >= {"bars.png", "radar.png"}
    text = file.read_text().replace('mass=".1"', 'mass=".12"')
    file.write_text(text)
    with pytest.raises((UnknownOption, SnapshotMismatch), match=r"model|tasks"):
        again(loaded, policy=agents, task=task)
    other = evaluate(agents, "P0", task=task, n=6, out=tmp_path / "out")
    assert other != found.only(protocol="P0")


def test_what_a_variable_did_is_explained() -> None:
    """An episode in B is played again with another mass."""
    task = f"{FILE}:Falling"
    found = evaluate("still", "B:pole.mass", task=task, n=2)
    assert found.metrics == ("return",)
    answer = why(found, "B:pole.mass", 0)
    assert {one.variable for one in answer.others} == {"pole.mass", "hinge.position.start"}
    assert answer.others[0].would_succeed is None
    assert "succeed" not in str(answer)
    assert found.causes("B:pole.mass") is not None


@pytest.mark.parametrize("task", [Filling, Filling(), f"{FILE}:Filling"])
def test_what_nature_drew_is_a_cause(task: Any, tmp_path: Path) -> None:
    """A tank overflows by the rate that its task draws: causes, why and explain name it alone."""
    found = evaluate("still", "P0", task=task, n=40)
    rate, begin = (found.drawn()[name].ravel() for name in ("rate", "level.start"))
    assert len({*rate}) == len({*begin}) == 40
    fine = (begin + 10.0 * rate < 1.0).astype(float)
    assert np.array_equal(found.frame["success"], fine)
    assert 0.0 < fine.mean() < 1.0
    causes = found.causes("P0")
    assert [cause.variable for cause in causes.found(0.01)] == ["rate"]
    assert "color" in causes.left_out
    failed = int(fine.argmin())
    answer = why(found, "P0", failed, versus="default")
    would = {one.variable: (one.was[0], one.would_be[0], one.gain) for one in answer.others}
    assert would["rate"] == (rate[failed], 0.05, 1.0)
    assert would["level.start"] == (begin[failed], 0.0, 0.0)
    assert would["color"][1:] == (0.5, 0.0)
    answer = why(found, "P0", failed, versus="A")
    assert [one.variable for one in answer.others] == ["color"]
    assert 0.0 <= answer.others[0].would_be[0] <= 0.1
    assert "no space A" in answer.left_out["rate"]
    found.save(tmp_path / "out")
    given = ["explain", str(tmp_path / "out")]
    told = CliRunner().invoke(app, given)
    assert told.exit_code == 0, told.output
    assert "rate" in told.output
    if isinstance(task, str):
        one = ["--protocol=P0", f"--episode={failed}", "--trust=model_tasks"]
        told = CliRunner().invoke(app, [*given, *one])
        assert told.exit_code == 0, told.output
        assert "with rate = 0.05 instead of" in told.output


def test_what_start_drew_is_a_cause() -> None:
    """Draws of ``start`` are told from those of a protocol, of own tasks and of the library's."""
    start = {"rate": Box(0.15, 0.2), "color": (0.8, 0.9)}
    found = evaluate("still", "P0", task=Filling(), n=1, env={"start": start})
    would = {one.variable: one for one in why(found, "P0", 0).others}
    assert 0.15 <= would["rate"].was[0] <= 0.2
    assert (would["rate"].would_be, would["rate"].gain) == ((0.05,), 1.0)
    assert (would["color"].would_be[0] <= 0.1, would["color"].gain) == (True, 0.0)
    mass, how = "tool_block.mass", {"max_episode_length": 2, "start": {"tool_block.mass": "A"}}
    found = evaluate("still", "P0", n=1, backend="fake", env=how)
    answer = why(found, "P0", 0)
    assert [one.variable for one in answer.others] == [mass]
    assert answer.others[0].was[0] == found.drawn()[mass].item()
    assert answer.others[0].would_be == (0.02,)


def test_episodes_end_where_the_task_says_so() -> None:
    """Each has as many steps as it had; the last one counts."""
    driven = WorldPolicy(lambda world: world.action_high)
    found = evaluate(driven, "P0", task=Falling(), n=3)
    assert (found.frame["steps"] < 30).all()
    found = evaluate("still", "P0", task=Scored(), n=2)
    assert found.metrics[0] == found.metric() == "last_fractional_success"
    assert (found.frame["steps"] == 30).all()


def test_workers_need_a_task_that_can_be_sent() -> None:
    """A text can; an object with a lambda cannot, and the error says what to do."""
    how: Any = {"n": 26, "workers": 2, "env": {"max_episode_length": 2}}
    task = f"{FILE}:Balance"
    assert evaluate("random", "P0", task=task, **how) == evaluate(
        "random", "P0", task=task, n=26, env={"max_episode_length": 2}
    )
    mine = Balance(reward=(lambda angle: 2.0 * angle, "hinge.position"))
    assert len(evaluate("random", "P0", task=mine, n=2)) == 2
    with pytest.raises(UnknownOption, match="module:function"):
        evaluate("random", "P0", task=mine, **how)


def test_many_actions_are_checked() -> None:
    """A policy for another number of actuators is named."""
    with pytest.raises(ModelError, match="no reward"):
        evaluate("random", "P0", task=ModelTask(Balance().system), n=1)
    from scm_world.errors import EvaluationError

    with pytest.raises(EvaluationError, match=r"shape \(1,\)"):
        evaluate([np.zeros((3, 2))], "P0", task=Balance(), n=1)


def test_episodes_are_recorded_and_replayed(tmp_path: Path) -> None:
    """A recording names the task by a text, from which it is made again."""
    env = ScmWorldEnv(f"{FILE}:Falling")
    found = record("random", env, 2, seed=1, out=tmp_path / "runs.parquet")
    assert found[0].infos == {}
    loaded = Recording.load(tmp_path / "runs.parquet")
    assert [*loaded] == [*found]
    with pytest.raises(UnknownOption, match="trusted"):
        loaded.replay()
    assert loaded.replay(task=f"{FILE}:Falling") == found.replay() == sum(map(len, found))
    loaded = Recording.load(tmp_path / "runs.parquet", trusted=("model_tasks",))
    assert loaded.replay(1) == len(found[1])
    assert loaded[0].terminations[-1] or loaded[0].truncations[-1]


def test_the_command_line_evaluates_files(tmp_path: Path) -> None:
    """A file:function where a task is named; a model without a reward is refused."""
    runner, folder = CliRunner(), tmp_path / "out"
    given = ["evaluate", "random", f"{FILE}:Balance", "--protocols", "P0,B", "-n", "2"]
    given += ["--workers", "1"]
    done = runner.invoke(app, [*given, "--out", str(folder)])
    assert done.exit_code == 0, done.output
    results = json.loads((folder / "results.json").read_text())
    assert [row["protocol"] for row in results["scores"]] == ["P0", "B"]
    assert results["about"]["task"] == f"{FILE}:Balance"
    model = tmp_path / "cartpole.xml"
    model.write_text(Balance.model)
    done = runner.invoke(app, ["evaluate", "random", str(model), "-n", "1", "--workers", "1"])
    assert done.exit_code != 0
    assert "reward" in done.output
