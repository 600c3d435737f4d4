"""The command line: what it prints, what it writes, and how it refuses."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from matplotlib.image import imread
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.cli.options import parse_assignments, parse_value
from scm_world.errors import ConflictingTargets
from scm_world.variables import Draw, Scale, Shift

KEYS = {"task", "backend", "seed", "probes", "rollouts", "score", "edges", "seconds", "versions"}
CHAIN = """
import scm_world as sw


def chain():
    x = sw.Exogenous(name="x")
    return sw.SCM([x, sw.Derived(name="y", parents=("x",), mechanism=sw.Linear(weights=(2.0,)))])
"""
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f]")


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


def read(path: str) -> dict[str, Any]:
    """Read a JSON file."""
    found: dict[str, Any] = json.loads(Path(path).read_text())
    return found


def files() -> list[str]:
    """List everything below the present folder."""
    return sorted(str(path) for path in Path().rglob("*"))


# --- discover ------------------------------------------------------------------------------------


def test_discover_writes_a_report() -> None:
    """Discovery prints the graph and its scores, and writes them."""
    result = call("discover", "reaching", "--probes", "1", "--seed", "3", "--out", "here")

    assert result.exit_code == 0, result.output
    assert "Recovered graph" in result.stdout
    assert "SHD" in result.stdout
    report = read("here/report.json")
    assert set(report) >= KEYS
    assert (report["task"], report["backend"]) == ("reaching", "mujoco")
    assert (report["seed"], report["probes"]) == (3, 1)
    assert report["versions"]["mujoco"] in result.stdout


@pytest.mark.usefixtures("_undrawn")
def test_missing_edges_are_marked_and_strict_fails() -> None:
    """Without physics edges are missing: each has a symbol, and --strict exits 1."""
    given = ("--backend", "fake", "--probes", "1", "--option", "default_goal_60=0,0,0.2")
    result = call("discover", "reaching", *given, "--strict")

    assert result.exit_code == 1
    assert "[-]robot_height" in result.stdout
    folder = "scm-world-results/discover-reaching-fake-seed0-default_goal_60=0_0_0.2"
    assert f"{folder}/report.json" in result.stdout
    report = read(f"{folder}/report.json")
    assert report["score"]["shd"] > 0
    assert report["arguments"] == ["default_goal_60=0,0,0.2"]
    assert not CONTROL.search(result.output)
    assert "…" not in result.output


LEAKING = """
import scm_world as sw


def step(parameters, state, action, noise):
    return {"x": 0.5 * state["x"] + parameters["leak"], "still": 1.0}


def make(*parents):
    return sw.StepTask(
        step,
        parameters=[sw.Exogenous(name="leak", default=0.5, bounds=sw.Box(0.0, 1.0))],
        states=[
            sw.Measured(name="x", default=1.0, parents=parents),
            sw.Measured(name="still", default=1.0, parents=("still",)),
        ],
    )


def unseen():
    return make("x", "leak")


def refuted():
    return make("x")
"""


@pytest.mark.usefixtures("_undrawn")
@pytest.mark.parametrize("command", ["discover", "verify"])
def test_exit_codes_tell_outcomes_apart(command: str) -> None:
    """Edges that were never seen exit 0, strictly 1; an effect without an edge always 1."""
    Path("leaking.py").write_text(LEAKING)
    few = ("--probes", "2")
    codes = [
        call(command, f"leaking.py:{name}", *few, *more).exit_code
        for name in ("unseen", "refuted")
        for more in ((), ("--strict",))
    ]
    assert codes == [0, 1, 1, 1]


@pytest.mark.parametrize("finished", [0, 1])
def test_an_interrupted_discovery_reports_what_it_has(
    finished: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C is exit code 130, with a partial report; before anything is finished with none."""
    from scm_world.queries.experiments.paired import Paired

    run = Paired.run

    def interrupted(self: Paired, number: int, probe: Any) -> Any:
        if number == finished:
            raise KeyboardInterrupt
        return run(self, number, probe)

    monkeypatch.setattr(Paired, "run", interrupted)
    Path("chain.py").write_text(CHAIN)
    result = call("discover", "chain.py:chain", "--probes", "3", "--out", "here")

    assert result.exit_code == 130
    if finished:
        assert "1 of 3: interrupted" in result.stdout
        assert read("here/report.json")["planned"] == 3
    else:
        assert "interrupted" in result.stderr
        assert not Path("here/report.json").exists()


# --- graph ---------------------------------------------------------------------------------------


def test_graph_as_table_has_causes_in_few_words() -> None:
    """The table has every variable with its causes, and no line is cut off."""
    result = call("graph", "pushing")

    assert result.exit_code == 0, result.output
    assert "88 variables, 270 edges" in result.stdout
    assert "robot_finger_{60,120,300}_link_{1,2,3}.mass" in result.stdout
    assert "without causes: " in result.stdout
    assert "…" not in result.stdout


def test_graph_as_json_is_the_model() -> None:
    """What is printed as JSON can be read back."""
    from scm_world import World
    from scm_world.graph import from_json

    result = call("graph", "reaching", "--format", "json", "--action-mode", "joint_torques")

    expected = World("reaching", backend="fake", action_mode="joint_torques").model
    assert from_json(result.stdout) == expected


@pytest.mark.parametrize("form", ["table", "json"])
def test_graph_goes_to_a_file(form: str) -> None:
    """With --out standard output stays empty and the file has the text."""
    shown = call("graph", "reaching", "--format", form).stdout
    result = call("graph", "reaching", "--format", form, "--out", "deep/graph.txt")

    assert (result.exit_code, result.stdout) == (0, "")
    assert Path("deep/graph.txt").read_text() == shown


@pytest.mark.usefixtures("drawn")
def test_the_ending_of_a_file_says_how_a_graph_is_written() -> None:
    """graph.png is a picture, graph.json the model; an ending that is no format is refused."""
    Path("chain.py").write_text(CHAIN)
    assert call("graph", "chain.py:chain", "--out", "graph.png").exit_code == 0
    assert imread("graph.png").shape[1] == 1600
    assert call("graph", "chain.py:chain", "--out", "graph.json").exit_code == 0
    shown = call("graph", "chain.py:chain", "--format", "json").stdout
    assert Path("graph.json").read_text() == shown
    refused = call("graph", "chain.py:chain", "--out", "graph.svg")
    assert refused.exit_code == 2
    assert "'svg'" in refused.output
    assert "png" in refused.output
    assert not Path("graph.svg").exists()


def test_variables_are_shown_with_their_spaces() -> None:
    """A row for each variable of a task, and of a causal model without an engine."""
    shown = call("variables", "pushing").stdout
    row = next(line for line in shown.splitlines() if line.strip().startswith("tool_block.mass"))
    assert row.split()[1:5] == ["parameter", "kg", "-", "0.02"]
    Path("chain.py").write_text(CHAIN)
    assert "2 variables" in call("variables", "chain.py:chain").stdout


def test_graph_shows_the_strong_edges_of_a_verification() -> None:
    """With edges.csv of verify: tables and pictures without weak edges, graphs with numbers."""
    assert (
        call("verify", "reaching", "--probes", "2", "--held-out", "0", "--out", "v").exit_code < 2
    )
    given = ("graph", "reaching", "--strength", "v/edges.csv")
    some, every = (call(*given, *more).stdout for more in (("--at-least", "0.1"), ()))
    assert 0 < int(some.split()[2]) < int(every.split()[2]) == 114
    assert 'attr.name="strength"' in call(*given, "--format", "graphml").stdout
    for more in ("--fold", "--unfold", "--at-least=.1"):
        assert call(*given, more, "--out", "graph.png").exit_code == 0
    for words, said in (
        (("graph", "reaching", "--at-least", "0.1"), "--strength edges.csv"),
        (("graph", "reaching", "--strength", "no.csv"), "scm-world verify or discover wrote"),
        ((*given, "--format", "json"), "graphml"),
    ):
        refused = call(*words)
        assert refused.exit_code == 2
        assert said in refused.stderr


@pytest.mark.usefixtures("drawn")
def test_graph_as_picture_has_a_default_name() -> None:
    """The picture of the declared graph is a PNG 1600 pixels wide."""
    Path("chain.py").write_text(CHAIN)
    result = call("graph", "chain.py:chain", "--format", "png")

    assert result.exit_code == 0, result.output
    assert imread("chain-chain-graph.png").shape[1] == 1600


# --- do ------------------------------------------------------------------------------------------


def test_do_shows_the_audit_and_what_followed() -> None:
    """A larger block moves its descendants, and nothing else; pictures show it, and its color."""
    given = ("block.size=[0.07,0.07,0.07]", "tool_block.color=0,0,1")
    result = call("do", "pushing", *given, "--steps", "2", "--out", "here")

    assert result.exit_code == 0, result.output
    assert "goal_block.cartesian_position" in result.stdout
    assert "descendants did not move" in result.stdout
    found = read("here/result.json")
    assert found["audit"]["block.size"]["applied"] == [0.07, 0.07, 0.07]
    assert found["moved_without_a_path"] == []
    row = found["variables"]["tool_block.size"]
    assert (row["before"][0], row["after"][0], row["without"][0]) == (0.065, 0.07, 0.065)
    assert found["versions"]["mujoco"]
    before, after = (imread(f"here/{name}.png") for name in ("before", "after"))
    assert before.shape == after.shape
    assert not np.array_equal(before, after)


def test_do_reads_back_from_the_engine() -> None:
    """Shifts, scales and draws are applied, and the engine agrees."""
    given = ("tool_block.mass=scale:2", "floor_friction=draw:B", "joint_positions=shift:0.01")
    assert call("do", "pushing", *given, "--steps", "0", "--out", "o").exit_code == 0

    audit = read("o/result.json")["audit"]
    assert audit["tool_block.mass"]["read_back"] == pytest.approx(0.04)
    assert 0.6 <= audit["floor_friction"]["read_back"] <= 0.8
    assert audit["joint_positions"]["requested"] == {"kind": "shift", "by": 0.01}


def test_all_shows_descendants_that_did_not_move() -> None:
    """With --all there is a row for every descendant."""
    arguments = ("do", "pushing", "tool_block.mass=0.04", "--backend", "fake", "--steps", "1")
    moved, every = call(*arguments).stdout, call(*arguments, "--all").stdout

    assert "tool_block.linear_velocity" not in moved
    assert "tool_block.linear_velocity" in every
    assert not CONTROL.search(every)
    assert "…" not in every


def test_a_change_without_a_path_is_loud(monkeypatch: pytest.MonkeyPatch) -> None:
    """If a variable moves that is no descendant, it is named and the exit code is 1."""
    from scm_world.graph import SCM

    monkeypatch.setattr(SCM, "descendants", lambda self, name: frozenset())
    result = call("do", "pushing", "block.size=0.07,0.07,0.07", "--steps", "0", "--backend", "fake")

    assert result.exit_code == 1
    assert "MOVED WITHOUT A DECLARED PATH" in result.stdout
    assert "tool_block.size" in result.stdout


# --- list, version, help -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        ("variables",),
        ("graph",),
        ("do", "left.damping=2", "--steps", "1"),
        ("verify", "--probes", "1"),
        ("discover", "--probes", "1"),
    ],
    ids=lambda command: command[0],
)
def test_what_a_model_does_unlike_its_file_is_noted_once(command: tuple[str, ...]) -> None:
    """Each note of the model is a line of the error stream, so that tables can be piped."""
    bodies = "".join(
        f'<body pos="{x / 10} 0 1"><joint name="{name}" damping="1"/><geom size=".1"/></body>'
        for x, name in enumerate(("left", "right"))
    )
    Path("two.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    result = call(command[0], "two.xml", *command[1:])
    assert result.exit_code in (0, 1), result.output
    assert result.stderr.count("note: The start pose has bodies in one another") == 1
    assert result.stderr.count("fidelity: up to ") == 1
    assert "start pose" not in result.stdout


def test_list_names_what_there_is() -> None:
    """Tasks, engines with their version, presets, conventions and environments."""
    shown = call("list").stdout

    for name in ("pushing", "mujoco", "precise", "causal_world", "scm_world/Pushing-v0"):
        assert name in shown
    assert "available, version" in shown
    assert not CONTROL.search(shown)
    assert "…" not in shown


def test_version() -> None:
    """--version is the version of the package."""
    from scm_world import __version__

    assert call("--version").stdout == f"scm-world {__version__}\n"


def test_help_loads_no_engine() -> None:
    """Nothing is loaded to show the help, or by the package, that takes a tenth of a second."""
    code = (
        "import sys; from scm_world.cli.app import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "bad = {'mujoco', 'pybullet', 'matplotlib', 'numba', 'networkx', 'scipy', 'pandas',\n"
        "       'pyarrow', 'yaml', 'safetensors', 'threadpoolctl', 'trimesh', 'torch', 'asyncio'}\n"
        "bad &= set(sys.modules)\n"
        "sys.exit(','.join(bad) or 0)"
    )
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stderr


def test_the_module_is_the_command() -> None:
    """``python -m scm_world`` runs, is plain when piped, and errors have no traceback."""
    done = subprocess.run(
        [sys.executable, "-m", "scm_world", "graph", "pushin"],
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 2
    assert done.stderr.startswith("error: no task is named 'pushin'; did you mean 'pushing'?")
    assert done.stderr.count("\n") == 1
    assert not CONTROL.search(done.stderr)


# --- refusing ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("discover", "pushin"), "did you mean 'pushing'?"),
        (("discover", "pushing", "--backend", "mujco"), "did you mean 'mujoco'?"),
        (("discover", "pushing", "--preset", "fats"), "did you mean 'fast'?"),
        (("discover", "pushing", "--probes", "0"), "--probes"),
        (("discover", "pushing", "--seed", "-1"), "--seed"),
        (("graph", "pushing", "--action-mode", "torques"), "did you mean 'joint_torques'?"),
        (("graph", "pushing", "--format", "svg"), "--format"),
        (("do", "pushing", "tool_block.mas=0.1"), "did you mean 'tool_block.mass'?"),
        (("do", "pushing", "tool_block.mass=heavy"), "'heavy'; it can be: a number"),
        (("do", "pushing", "tool_block.mass=nan"), "must be finite"),
        (("do", "pushing", "tool_block.mass=-1"), "the nearest allowed value"),
        (("do", "pushing", "gravity=1,2"), "expected shape (3,), got (2,)"),
        (("do", "pushing", "success=1"), "intervene on a cause"),
        (("do", "pushing", "gravity=1,2,3", "tool_block.mass=9e9"), "tool_block.mass"),
        (("do", "pushing", "tool_block.mass=0.09", "--space", "A"), "outside space A"),
        (("do", "pushing", "tool_block.mass=0.09", "--space", "C"), "no space is named 'C'"),
        (("do", "pushing", "tool_block.mass"), "name=value"),
        (("do", "pushing", "tool_block.mass=shift:x"), "expected numbers"),
        (("do", "pushing", "tool_block.mass=1", "tool_block.mass=2"), "both set"),
    ],
)
def test_bad_input_is_one_clean_message(arguments: tuple[str, ...], message: str) -> None:
    """Every mistake has exit code 2, says what is allowed, and leaves nothing behind."""
    result = call(*arguments)

    assert result.exit_code == 2
    assert message in " ".join(result.stderr.replace("│", " ").split())
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert files() == []


@pytest.mark.parametrize(
    "command",
    [
        ("discover", "reaching"),
        ("do", "pushing", "gravity=0,0,-5"),
        ("collect", "pushing", "-n2"),
        ("sweep", "pushing", "--over", "tool_block.mass=0.02,0.03"),
    ],
)
def test_a_file_in_the_way_is_found_before_the_work(command: tuple[str, ...]) -> None:
    """Where the folder for the results is a file, nothing is run."""
    Path("taken").write_text("mine")
    result = call(*command, "--backend", "fake", "--out", "taken")

    assert result.exit_code == 2
    assert "'--out': 'taken' is a file" in " ".join(result.output.split())
    assert Path("taken").read_text() == "mine"


# --- values --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("-0.5", -0.5),
        ("1e-3", 0.001),
        ("1,2,3", [1, 2, 3]),
        (" [ 1, 2.5 ] ", [1, 2.5]),
        ("[1]", [1]),
        ("[]", []),
        ("1,,2", [1, "", 2]),
        ("heavy", "heavy"),
        ("shift:0.1", Shift(0.1)),
        ("shift:[0,0,1]", Shift((0, 0, 1))),
        ("Scale: 2", Scale(2)),
        ("draw:A", Draw("A")),
        ("draw:A|B", Draw("A|B")),
    ],
)
def test_values_are_read(text: str, value: object) -> None:
    """Numbers, lists and interventions; what is none is left to the model."""
    assert parse_value(text) == value


@pytest.mark.parametrize("text", ["", " ", "shift:", "shift:x", "draw:C"])
def test_what_is_no_value_is_refused(text: str) -> None:
    """An empty value and an unknown intervention are usage errors."""
    with pytest.raises(typer.BadParameter):
        parse_value(text)


def test_assignments_are_read() -> None:
    """A value may contain further equal signs only where the model refuses it."""
    assert parse_assignments(["a=1", " b =2,3"]) == {"a": 1, "b": [2, 3]}
    with pytest.raises(typer.BadParameter, match="name=value"):
        parse_assignments(["a"])
    with pytest.raises(ConflictingTargets):
        parse_assignments(["a=1", "a=2"])


def test_a_sweep_does_not_lose_episodes() -> None:
    """Fewer than a folder has already are refused."""
    command = ("sweep", "pushing", "--over=tool_block.mass=0.02,0.03,0.04", "--backend=fake")
    options = ("--steps=1", "--outcome=reward", "--out=swept")
    assert call(*command, *options, "-n7").exit_code == 0
    refused = call(*command, *options, "-n5")
    assert refused.exit_code == 2
    said = " ".join(refused.output.split())
    assert "it can be: 21 or more: swept has so many already" in said
