"""Arguments of tasks on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from matplotlib.image import imread
from typer.testing import CliRunner

from scm_world.cli import app, discovery, graphs, intervene, variables
from scm_world.cli.tasks import build, suffix
from scm_world.errors import ConflictingTargets, UnknownOption
from scm_world.graph import from_json
from scm_world.tasks import TASKS
from scm_world.world import World

SMALL = {
    "towers": ("number_of_blocks_in_tower=1,1,2", "tower_dims=[0.035, 0.035, 0.07]"),
    "stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "creative_stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "general": ("nums_objects=2",),
}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run where nothing is lost."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_discovered_with_its_options(task: str) -> None:
    """There is a report that names the options, and a picture, for each of the nine tasks."""
    arguments = SMALL.get(task, ())
    options = discovery.Options(task, "fake", "fast", 1, 0, arguments)

    assert discovery.run(options, out=Path("here"), strict=False) == 0
    report = json.loads(Path("here/report.json").read_text())
    assert (report["task"], tuple(report["arguments"])) == (task, arguments)
    assert imread("here/graphs.png").shape[:2] == (900, 1600)
    assert len(report["declared"]) == len(World(build(task, arguments), backend="fake").model.edges)


def test_default_folders_are_those_of_the_options() -> None:
    """Two variants of a task do not overwrite one another."""
    options = discovery.Options("stacked_blocks", "fake", "fast", 1, 0, SMALL["stacked_blocks"])
    discovery.run(options, out=None, strict=False)

    folder = "discover-stacked_blocks-fake-seed0-num_of_levels=2-max_level_width=0.04"
    assert Path("scm-world-results", folder, "report.json").exists()
    assert suffix(()) == ""


def test_graph_takes_options(capsys: pytest.CaptureFixture[str]) -> None:
    """The declared graph is that of the variant."""
    graphs.run("general", "json", None, "joint_positions", SMALL["general"])
    graphs.run("general", "png", None, "joint_positions", SMALL["general"])

    expected = World(build("general", SMALL["general"]), backend="fake").model
    assert from_json(capsys.readouterr().out) == expected
    assert Path("general-nums_objects=2-graph.png").exists()


def test_variables_takes_options(capsys: pytest.CaptureFixture[str]) -> None:
    """The table is that of the variant."""
    variables.run("general", SMALL["general"], as_markdown=False)
    small = capsys.readouterr().out
    variables.run("general", as_markdown=False)
    assert small != capsys.readouterr().out


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
    result = CliRunner().invoke(app, ["variables", "own.py:make"])
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.output


def test_a_step_function_needs_no_backend() -> None:
    """It is that of the task."""
    Path("own.py").write_text(
        "from scm_world import Measured, StepTask\n"
        "def step(parameters, state, action, noise):\n    return {'x': 0.5 * state['x']}\n"
        "def make():\n"
        "    states = [Measured(name='x', default=1.0, parents=('x',))]\n"
        "    return StepTask(step, states=states)\n"
    )
    result = CliRunner().invoke(app, ["do", "own.py:make", "x=2", "--steps", "1", "--out", "here"])
    assert result.exit_code == 0, result.stderr
    assert "on step" in result.stdout


def test_do_takes_options() -> None:
    """An intervention on a block that only the variant leaves out is refused there."""
    options = intervene.Options("general", "fake", "fast", 0, 1, None, SMALL["general"])
    intervene.run(["tool_1.friction=0.5"], options, show_all=False, out=Path("here"))

    assert json.loads(Path("here/result.json").read_text())["arguments"] == [*SMALL["general"]]
    with pytest.raises(Exception, match=r"tool_2\.friction"):
        intervene.run(["tool_2.friction=0.5"], options, show_all=False, out=Path("here"))


def test_values_of_all_kinds_are_read() -> None:
    """Numbers, points, truth values and names of weights."""
    task = build("pushing", ["tool_block_mass=0.05", "weights=sparse"])
    assert {name for name, weight in task.weights.items() if weight} == {"success"}
    assert build("pushing", ["activate_sparse_reward=true"]).weights == task.weights
    assert build("reaching", ["default_goal_60=0,0,0.2"]).name == "reaching"


@pytest.mark.parametrize(
    ("task", "argument", "message"),
    [
        ("towrs", "tower_dims=1", "did you mean 'towers'"),
        ("towers", "tower_dim=1,1,1", "did you mean 'tower_dims'"),
        ("stacked_blocks", "num_of_levels=200", "num_of_levels"),
        ("stacked_blocks", "weights=best", "weights"),
        ("pushing", "terms=1", "terms"),
    ],
)
def test_wrong_options_are_refused(task: str, argument: str, message: str) -> None:
    """What does not exist, or is out of bounds, is named."""
    with pytest.raises(UnknownOption, match=message):
        build(task, [argument])


@pytest.mark.parametrize("argument", ["num_of_levels=many", "num_of_levels", "num_of_levels="])
def test_what_cannot_be_read_is_refused(argument: str) -> None:
    """The message is about ``--option``."""
    with pytest.raises(typer.BadParameter) as caught:
        build("stacked_blocks", [argument])
    assert caught.value.param_hint == "'--option'"


def test_an_option_can_be_given_once() -> None:
    """The same argument twice is a conflict."""
    with pytest.raises(ConflictingTargets):
        build("general", ["nums_objects=2", "nums_objects=3"])
