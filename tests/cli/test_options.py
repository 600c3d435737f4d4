"""Arguments of tasks on the command line, and custom tasks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.cli.options import load_system
from scm_world.errors import ConflictingTargets, UnknownOption
from scm_world.evaluation import Evaluation
from scm_world.graph import from_json
from scm_world.world import Simulation

SMALL = ("--option", "nums_objects=2")
STEP = """
from scm_world import Action, Exogenous, Measured, StepTask
from scm_world.variables import Box


def step(parameters, state, action, noise):
    return {"x": parameters["rate"] * state["x"] + action["push"]}


def make():
    return StepTask(
        step,
        parameters=[Exogenous(name="rate", default=0.5, a=Box(0.2, 0.8))],
        states=[Measured(name="x", default=1.0, parents=("x", "rate", "push"))],
        actions=[Action(name="push", bounds=Box(-1.0, 1.0))],
        reward=(lambda x: -x, "x"),
    )
"""


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


def test_graph_takes_options() -> None:
    """The declared graph is that of the variant, and so are the tables."""
    shown = call("graph", "general", "--format", "json", *SMALL).stdout
    small = Simulation(load_system("general", ["nums_objects=2"]), backend="fake").model
    assert from_json(shown) == small
    tables = [call("graph", "general", *given).stdout for given in (SMALL, ())]
    assert tables[0] != tables[1]


def test_whole_numbers_are_read_alike_everywhere() -> None:
    """``--steps 1e4`` is ``--set steps=1e4``; a fraction and a number out of range are refused."""
    given = ("train", "reaching", "--show-recipe", "--set", "worlds=2")
    found = call(*given, "--steps", "1e4").stdout
    assert json.loads(found)["steps"] == 10_000
    for number in ("--steps=10_000", "--steps=+10000", "--set=steps=1e4"):
        assert call(*given, number).stdout == found
    for number in ("1.5", "1e-3", "True", "ten", "-1"):
        refused = call("do", "pushing", "tool_block.mass=0.05", f"--steps={number}")
        assert refused.exit_code == 2
        assert "expected a whole number from 0 on" in " ".join(refused.stderr.split())


def test_do_takes_options() -> None:
    """An intervention on a block that only the variant leaves out is refused there."""
    given = ("--backend", "fake", "--steps", "1", *SMALL, "--out", "here")
    assert call("do", "general", "tool_1.friction=0.5", *given).exit_code == 0
    assert json.loads(Path("here/result.json").read_text())["arguments"] == ["nums_objects=2"]
    refused = call("do", "general", "tool_2.friction=0.5", *given)
    assert refused.exit_code == 2
    assert "tool_2.friction" in refused.stderr


def test_a_do_may_change_what_there_is() -> None:
    """Bodies that come and go are named, and what is there before and after is compared."""
    words = ("do", "towers", "number_of_blocks_in_tower=1,1,4", "--backend", "fake")
    done = call(*words, "--steps", "1", "--out", "here")
    assert done.exit_code == 0, done.output
    assert "gone: tool_level_4_col_0_row_0" in done.output
    result = json.loads(Path("here/result.json").read_text())
    assert result["went"] == ["tool_level_4_col_0_row_0"]
    assert "tool_level_4_col_0_row_0.mass" not in result["variables"]
    assert result["variables"]["tool_level_0_col_0_row_0.size"]["moved"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def make():\n    raise KeyError('no room')\n", "own.py:make raised KeyError: 'no room'"),
        ("def make(size):\n    pass\n", "own.py:make raised TypeError: make() missing 1"),
        ("1 / 0\ndef make():\n    pass\n", "own.py raised ZeroDivisionError: division by zero"),
    ],
)
def test_a_factory_that_fails_is_named(text: str, message: str) -> None:
    """With the cause, and without a traceback."""
    Path("own.py").write_text(text)
    result = call("graph", "own.py:make")
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.output


@pytest.mark.usefixtures("_undrawn")
def test_a_step_function_needs_no_backend() -> None:
    """Its own backend is the default, also of an evaluation."""
    Path("own.py").write_text(STEP)
    done = call("do", "own.py:make", "x=2", "--steps", "1", "--out", "done")
    assert done.exit_code == 0, done.stderr
    assert "on step" in done.stdout
    given = ("--protocols", "P0", "-n", "1", "--env", "max_episode_length=2")
    done = call("evaluate", "random", "own.py:make", *given, "--workers", "1", "--out", "scores")
    assert done.exit_code == 0, done.output
    assert Evaluation.load("scores").engines == ("step",)


@pytest.mark.parametrize("command", ["train", "clone"])
def test_training_is_on_the_backend_of_the_task(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless another one is asked for."""
    from scm_world.tasks import Picking
    from scm_world.training import imitation, loop

    seen: list[str] = []

    def interrupted(*_: object, backend: str, **__: object) -> None:
        seen.append(backend)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "train", interrupted)
    monkeypatch.setattr(imitation, "clone", interrupted)
    monkeypatch.setattr(Picking, "backend", "fake")
    assert call(command, "picking").exit_code == 130
    assert call(command, "picking", "--backend", "mujoco").exit_code == 130
    assert seen == ["fake", "mujoco"]


def test_values_of_all_kinds_are_read() -> None:
    """Numbers, points, truth values and names of weights."""
    task = load_system("pushing", ["tool_block_mass=0.05", "weights=sparse"]).task()
    assert {name for name, weight in task.weights.items() if weight} == {"success"}
    assert load_system("pushing", ["activate_sparse_reward=true"]).task().weights == task.weights
    assert load_system("reaching", ["default_goal_60=0,0,0.2"]).task().name == "reaching"


@pytest.mark.parametrize(
    ("task", "argument", "message"),
    [
        ("towrs", "tower_dims=1", "did you mean 'towers'"),
        ("towers", "tower_dim=1,1,1", "did you mean 'tower_dims'"),
        ("stacked_blocks", "num_of_levels=200", "num_of_levels"),
        ("stacked_blocks", "weights=best", "weights"),
        ("pushing", "terms=1", "terms"),
        ("stacked_blocks", "num_of_levels=many", "num_of_levels"),
    ],
)
def test_wrong_options_are_refused(task: str, argument: str, message: str) -> None:
    """What does not exist, or is out of bounds, is named."""
    with pytest.raises(UnknownOption, match=message):
        load_system(task, [argument])


@pytest.mark.parametrize("argument", ["num_of_levels", "num_of_levels="])
def test_what_cannot_be_read_is_refused(argument: str) -> None:
    """The message is about ``--option``."""
    with pytest.raises(typer.BadParameter) as caught:
        load_system("stacked_blocks", [argument])
    assert caught.value.param_hint == "'--option'"


def test_an_option_can_be_given_once() -> None:
    """The same argument twice is a conflict."""
    with pytest.raises(ConflictingTargets):
        load_system("general", ["nums_objects=2", "nums_objects=3"])
