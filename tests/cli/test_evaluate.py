"""``scm-world evaluate`` and ``scm-world explain``: what they write, print and refuse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.cli.policies import policies_of
from scm_world.errors import UnknownOption
from scm_world.evaluation import METRICS, Evaluation, evaluate, protocols_of
from scm_world.policies import save_policy

QUICK = ("--backend", "fake", "--env", "max_episode_length=3", "--workers", "1")
POLICIES = {"random": ["random"], "still": ["still"]}
SHORT = {"max_episode_length": 3}


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print on a wide terminal."""
    monkeypatch.setenv("COLUMNS", "200")


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write results once."""
    folder = tmp_path_factory.mktemp("saved")
    evaluate(POLICIES, "P0,P8", n=12, backend="fake", env=SHORT).save(folder)
    return folder


@pytest.fixture
def results(saved: Path, tmp_path: Path) -> Evaluation:
    """Show these results in the present folder as ``out``."""
    (tmp_path / "out").symlink_to(saved)
    return Evaluation.load("out")


@pytest.mark.usefixtures("drawn")
def test_evaluate_writes_everything_and_prints_a_table() -> None:
    """JSON, the table of episodes, plots and the report; the table names all scores."""
    done = call(
        "evaluate",
        "mine=random+sweep,still",
        "picking",
        "--protocols=P0,P6,P8@2",
        "-n1",
        *QUICK,
        "--seeds=3,4",
        "--option=tool_block_mass=0.05",
    )
    assert done.exit_code == 0, done.output
    for word in ("mine", "still", "P0", "P8@2", "goal, start from B", "95 % intervals"):
        assert word in done.stdout
    (folder,) = Path("scm-world-results").iterdir()
    assert folder.name.startswith("evaluate-mine-still-picking-tool_block_mass=0.05")
    found = Evaluation.load(folder)
    assert (found.task, found.agents, found.protocols) == (
        "picking",
        ("mine", "still"),
        ("P0", "P6", "P8@2"),
    )
    assert len(found) == 3 * 3 * 2
    assert found.about["arguments"] == {} or found.about["env"]["task_options"]
    data = json.loads((folder / "results.json").read_text())
    assert {*METRICS} - {"failed"} <= {*data["scores"][0]}
    names = {path.name for path in folder.iterdir()}
    assert {"results.json", "episodes.parquet", "bars.png", "radar.png", "parts"} <= names
    assert all(name in " ".join(done.stdout.split()) for name in names - {"parts", "study.json"})


@pytest.mark.usefixtures("_undrawn")
def test_two_engines_show_the_gap() -> None:
    """A second table has one minus the other."""
    done = call("evaluate", "still", "--protocols=P8", "-n1", *QUICK, "--backend=fake,mujoco")
    assert done.exit_code == 0, done.output
    assert "fake minus mujoco, the same draws on both" in " ".join(done.stdout.split())


@pytest.mark.usefixtures("_undrawn")
def test_a_policy_beside_where_it_is_called(tmp_path: Path) -> None:
    """``module:function`` is found in the present folder, and again for the check."""
    Path("policies_of_a_test.py").write_text("def lazy(observation):\n    return [0.0] * 9\n")
    done = call("evaluate", "policies_of_a_test:lazy", "--protocols=P8", "-n2", *QUICK, "--out=o")
    assert done.exit_code == 0, done.output
    refused = call("explain", "o", "--protocol=P8", "--episode=1")  # a file does not decide
    assert refused.exit_code == 2
    told = call("explain", "o", "--protocol=P8", "--episode=1", "--trust=policies_of_a_test")
    assert told.exit_code == 0


@pytest.mark.usefixtures("results")
def test_explain_ranks_causes_and_asks_what_would_have_been() -> None:
    """A table for each protocol that varies something; one for an episode."""
    done = call("explain", "out", "--agent", "still")
    assert done.exit_code == 0, done.output
    assert "P8: still on fake" in done.stdout
    assert "nothing is varied" in done.stdout.partition("P0: still")[2].partition("P8")[0]
    for word in ("tool_block.mass", "share of variance", "upper - lower third"):
        assert word in done.stdout
    nothing = call("explain", "out", "--agent", "still", "--protocol", "P0")
    assert "nothing is varied" in nothing.stdout
    one = call(
        *("explain", "out", "--agent=still", "--protocol=P8", "--episode=3", "--versus=default")
    )
    assert one.exit_code == 0, one.output
    assert "tool_block.mass = 0.02" in one.stdout
    assert "goal_block.cylindrical_position" in one.stdout


def test_explain_names_the_options_that_choose(results: Evaluation) -> None:
    """Of several agents, and of several backends, it says with which option one is chosen."""
    found = results
    for missing, said in (((), "--agent"), (("--agent=nobody",), "no --agent is named 'nobody'")):
        refused = call("explain", "out", *missing)
        assert refused.exit_code == 2
        assert said in " ".join(refused.output.split())
    frame = found.frame.copy()
    frame.loc[::2, "engine"] = "mujoco"
    about = {**found.about, "engines": [*found.about["engines"], {"name": "mujoco"}]}
    Evaluation(about, frame).save("two")
    refused = call("explain", "two", "--agent", "still")
    assert refused.exit_code == 2
    assert "--backend" in refused.output
    assert "fake" in refused.output
    assert "agent" not in refused.output.partition("Error")[2]


def test_an_agent_of_another_task_is_told() -> None:
    """A policy that was trained for another task acts, with a warning."""
    with pytest.warns(UserWarning, match="'picking' was trained for the task 'picking'"):
        evaluate("zoo:picking", "P0", task="pushing", n=1, backend="fake", env=SHORT)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("evaluate",), "Missing argument 'POLICY'"),
        (("evaluate", "stil"), "stil"),
        (("evaluate", "still,still"), "each once"),
        (("evaluate", "still+"), "each once"),
        (("evaluate", "a/b=still"), "name of an agent"),
        (("evaluate", "nowhere.onnx"), "nowhere.onnx"),
        (("evaluate", "nowhere:lazy"), "nowhere:lazy"),
        (("evaluate", "still", "pushng"), "pushing"),
        (("evaluate", "still", "--protocols", "P13"), "P13"),
        (("evaluate", "still", "--protocols", "P1@x"), "P1@100"),
        (("evaluate", "still", "--seeds", "a"), "seed cannot be 'a'"),
        (("evaluate", "still", "--backend", "physx"), "physx"),
        (("evaluate", "still", "--env", "frame_skp=3"), "frame_skip"),
        (("evaluate", "still", "--env", "frame_skip"), "frame_skip"),
        (("evaluate", "still", "--option", "color=3"), "color"),
        (("evaluate", "still", "--metric", "beauty"), "beauty"),
        (("evaluate", "still", "-n", "0"), "n"),
        (("explain", "nowhere"), "nowhere"),
        (("explain", "out"), "agent"),
        (("explain", "out", "--agent=still", "--protocol=P5"), "P5"),
        (("explain", "out", "--agent=still", "--episode=1"), "needs its protocol"),
        (("explain", "out", "--agent=still", "--protocol=P8", "--episode=99"), "99"),
        (("explain", "out", "--agent=still", "--metric=beauty"), "beauty"),
        (("explain", "out", "--agent=still", "--backend=bullet"), "bullet"),
    ],
)
@pytest.mark.usefixtures("results")
def test_what_is_wrong_is_told(
    arguments: tuple[str, ...], said: str, saved: Path, tmp_path: Path
) -> None:
    """Exit code 2, the word that is wrong, no traceback, and nothing written."""
    done = call(*arguments)
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.output.replace("│", " ").split())
    assert "Traceback" not in done.output
    assert not [path for path in tmp_path.rglob("*.json") if saved not in path.parents]


@pytest.mark.usefixtures("_undrawn")
def test_ctrl_c_keeps_what_is_finished(
    results: Evaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 130 and what is safe; the same command resumes, with the scores of the call."""
    from scm_world.runs import study

    command = ("evaluate", "random,still", "--protocols=P0,P8", "-n12", *QUICK)
    write = study.write_whole

    def interrupted(path: Any, data: Any) -> None:
        write(path, data)
        if path.parent.name == "parts":
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(study, "write_whole", interrupted)
        stopped = call(*command, "--out", "mine")
    assert stopped.exit_code == 130
    assert "1 files are safe in mine; the same command resumes" in stopped.output
    assert not Path("mine/results.json").exists()
    assert call(*command, "--out", "mine").exit_code == 0
    found = Evaluation.load("mine")
    assert found == results
    assert np.array_equal(found.scores(agent="still"), results.scores(agent="still"))


def test_policies_have_names() -> None:
    """Given ones, or those of their files; several files of one name need one."""
    assert policies_of("a/b.onnx, mine=c.zip+d.zip,pkg.mod:act") == {
        "b": ["a/b.onnx"],
        "mine": ["c.zip", "d.zip"],
        "pkg.mod.act": ["pkg.mod:act"],
    }
    for wrong in ("", "a/x.onnx,b/x.onnx", "=still", "mine=", "a,,b"):
        with pytest.raises(UnknownOption, match="policy"):
            policies_of(wrong)


def test_list_shows_protocols() -> None:
    """``scm-world list`` has every protocol, with what it varies."""
    done = call("list")
    assert done.exit_code == 0
    for protocol in protocols_of("pushing"):
        assert f"{protocol.name} " in done.stdout
        assert protocol.doc in done.stdout


@pytest.mark.usefixtures("_undrawn")
def test_the_file_of_a_policy_says_the_task_and_the_environment(tmp_path: Path) -> None:
    """The task need not be typed; an option that contradicts the file is refused."""
    layers = {
        "layers.0.weight": np.full((9, 56), 0.01, np.float32),
        "layers.0.bias": np.zeros(9, np.float32),
    }
    about = {"task": "picking", "env": {"action_mode": "delta_joint_positions"}}
    run = tmp_path / "run=1"
    run.mkdir()
    save_policy(run / "policy.safetensors", layers, about)
    done = call("evaluate", "run=1,still", "--protocols=P0", "-n1", *QUICK)
    assert done.exit_code == 0, done.output
    assert "in picking" in done.output
    found = Evaluation.load(
        Path("scm-world-results/evaluate-run=1-still-picking-max_episode_length=3")
    )
    assert found.agents == ("run=1", "still")
    assert found.about["agents"][0]["env"] == about["env"]
    wrong = call("evaluate", "run=1", "--env", "action_mode=joint_torques", *QUICK)
    assert wrong.exit_code != 0
    assert "action_mode for 'run=1' cannot be 'joint_torques'" in " ".join(wrong.output.split())
    assert policies_of("zoo:pushing") == {"zoo.pushing": ["zoo:pushing"]}
