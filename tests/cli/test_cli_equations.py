"""Commands on a causal model without a backend, which a function of a file gives."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import scm_world as sw
from scm_world.cli.app import app
from scm_world.discovery.data import Design, collect, load
from scm_world.graph import from_json, to_json
from scm_world.queries import load_episode
from scm_world.variables import Box, Normal

FILE = """
import scm_world as sw
from scm_world.variables import Box, Normal, Parent


def chain(weight=2.0):
    return sw.SCM([
        sw.Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0)),
        sw.Derived(name="y", parents=("x",), mechanism=sw.Linear(weights=(weight,)),
                   noise=Normal()),
    ])


def growth():
    return sw.SCM([
        sw.Exogenous(name="rate", default=1.0, a=Box(0.5, 1.5)),
        sw.Derived(name="size", parents=(Parent("size", lag=1), Parent("rate", lag=1)), start=1.0,
                   mechanism=sw.Linear(weights=(1.0, 1.0))),
    ])
"""


@pytest.fixture
def file() -> str:
    """Write the file."""
    Path("models.py").write_text(FILE)
    return "models.py"


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


@pytest.mark.parametrize(
    ("command", "report"),
    [
        (("discover", "--probes", "2"), "report.json"),
        (("verify", "--probes", "16"), "report.json"),
        (("effect", "y", "x=1", "--versus", "x=0", "-n", "5"), "effect.json"),
    ],
)
def test_commands_take_a_model_without_a_backend(
    file: str, command: tuple[str, ...], report: str
) -> None:
    """Their reports are those of the functions."""
    name, *rest = command
    found = call(name, f"{file}:chain", *rest, "--out", "out")
    assert found.exit_code == 0, found.output
    data = json.loads(Path("out", report).read_text())
    if name == "effect":
        assert data["mean"] == pytest.approx(2.0, abs=1e-12)
        assert data["engine"] == "equations"


def test_the_graph_and_the_variables_are_shown(file: str) -> None:
    """With the arguments of the function."""
    found = call("graph", f"{file}:chain", "--format", "json", "--option", "weight=3")
    model = from_json(found.stdout)
    assert (list(model), model.declared("y").mechanism.weights) == (["x", "y"], (3.0,))
    assert "x" in call("graph", f"{file}:chain").stdout


def test_a_dataset_is_collected(file: str) -> None:
    """It is that of the function; a model with lagged edges has a row per control step."""
    given = ("--design", "single", "-n", "6", "--out")
    done = call("collect", f"{file}:chain", *given, "static")
    assert done.exit_code == 0, done.output
    assert "do(x)" in done.output
    model = sw.SCM(
        [
            sw.Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0)),
            sw.Derived(
                name="y", parents=("x",), mechanism=sw.Linear(weights=(2.0,)), noise=Normal()
            ),
        ]
    )
    told = collect(model, Design("single", ("x",), "A", 0.3), 6)
    assert np.array_equal(load("static").values, told.values)
    done = call("collect", f"{file}:growth", *given, "lagged", "--steps", "4", "--target", "ra*")
    assert done.exit_code == 0, done.output
    assert len(load("lagged")) == 6 * 4


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--nature", "x=1"), "circumstance of a model"),
        (("--policy", "random"), "circumstance of a model"),
        (("--backend", "mujoco"), "--backend cannot be 'mujoco'; it can be: left out"),
        (("--target", "z*"), "z*"),
    ],
)
def test_what_equations_do_not_have_is_refused(
    file: str, wrong: tuple[str, ...], said: str
) -> None:
    """A policy, a context distribution and a backend are those of a world."""
    done = call("collect", f"{file}:chain", *wrong, "--out", "out")
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.output.split())
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("name", "do", "final"), [("chain", "x=5", None), ("growth", "rate=3", 4.0)]
)
def test_a_counterfactual_keeps_the_noise(
    file: str, name: str, do: str, final: float | None
) -> None:
    """The difference and both episodes are written."""
    done = call("counterfactual", f"{file}:{name}", do, "--steps", "2", "--out", "out")
    assert done.exit_code == 0, done.output
    found = json.loads(Path("out/difference.json").read_text())["variables"]
    variable = do.partition("=")[0]
    if final is None:  # y = 2 x + noise: the noise cancels
        assert found["y"]["final"] == pytest.approx(2 * found[variable]["final"])
    else:
        assert -found["size"]["final"] == pytest.approx(final)
    effect = "size" if name == "growth" else "y"
    factual, other = (load_episode(f"out/{of}.npz") for of in ("episode", "counterfactual"))
    assert factual.final(effect) - other.final(effect) == pytest.approx(found[effect]["final"])


def test_do_compares_with_and_without(file: str) -> None:
    """The report has the values of the equations; there are no pictures."""
    done = call("do", f"{file}:growth", "rate=3", "--steps", "2", "--out", "out")
    assert done.exit_code == 0, done.output
    assert "backend reports" not in done.output
    assert [path.name for path in Path("out").iterdir()] == ["result.json"]
    found = json.loads(Path("out/result.json").read_text())
    assert found["backend"] == "equations"
    size = found["variables"]["size"]
    assert (size["before"], size["right_after"], size["after"], size["without"]) == (1, 1, 7, 3)
    assert found["audit"]["rate"]["applied"] == 3.0
    done = call("do", f"{file}:chain", "x=1", "--out", "static")
    assert done.exit_code == 0, done.output
    found = json.loads(Path("static/result.json").read_text())
    assert found["steps"] == 0
    assert found["followed"]["y"][1] == found["variables"]["y"]["after"]


@pytest.mark.parametrize("setting", ["space", "preset", "backend"])
def test_do_refuses_settings_of_a_world(file: str, setting: str) -> None:
    """By the name of the option."""
    done = call("do", f"{file}:chain", "x=1", f"--{setting}", "A", "--out", "out")
    assert done.exit_code == 2, done.output
    assert f"--{setting} cannot be 'A'" in " ".join(done.output.split())
    assert not Path("out").exists()


def rows_of(folder: str) -> list[dict[str, float]]:
    """Read the table of a sweep."""
    with Path(folder, "sweep.csv").open(newline="") as stream:
        return [
            {name: float(cell) for name, cell in row.items() if cell}
            for row in csv.DictReader(stream)
        ]


def test_a_sweep_has_the_same_units_at_every_point(file: str) -> None:
    """The means are those of samples of the model, and what is done besides holds everywhere."""
    given = ("--over", "x=0,1", "-n", "5")
    done = call("sweep", f"{file}:chain", *given, "--out", "static")
    assert done.exit_code == 0, done.output
    assert "on equations" in done.output
    rows = rows_of("static")
    assert [row["y.change"] for row in rows] == [0.0, pytest.approx(2.0)]
    given = ("--over", "rate=0.5,1", "-n", "2", "--steps", "4")
    done = call("sweep", f"{file}:growth", *given, "--do", "size=2", "--out", "lagged")
    assert done.exit_code == 0, done.output
    rows = rows_of("lagged")
    assert [row["size"] for row in rows] == [2.0, 2.0]
    done = call("sweep", f"{file}:growth", *given, "--outcome", "sum:size", "--out", "summed")
    assert done.exit_code == 0, done.output
    rows = rows_of("summed")
    assert [row["sum size"] for row in rows] == [9.0, 14.0]
    done = call("sweep", f"{file}:chain", "--over", "x=0", "--preset", "fast", "--out", "no")
    assert done.exit_code == 2, done.output
    assert "--preset cannot be 'fast'" in " ".join(done.output.split())


@pytest.mark.parametrize("name", ["model.json", "models.py:MODEL"])
def test_files_and_objects_of_equations_are_systems(file: str, name: str) -> None:
    """A JSON file and an SCM object of a module: without and with a learner, and in queries."""
    Path(file).write_text(f"{FILE}\n\nMODEL = chain(3.0)\n")
    model = sw.SCM(
        [
            sw.Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0)),
            sw.Derived(
                name="y", parents=("x",), mechanism=sw.Linear(weights=(3.0,)), noise=Normal()
            ),
        ]
    )
    Path("model.json").write_text(to_json(model))
    for number, words in enumerate(
        (
            ("graph", name),
            ("variables", name),
            ("effect", name, "y", "x=1", "--versus", "x=0", "-n", "5"),
            ("verify", name, "--probes", "4"),
            ("collect", name, "--n", "6", "--target", "x"),
            ("discover", name, "--learner", "do_order", "--no-baselines", "--budget", "30,40",
             "--seeds", "1"),
        )
    ):  # fmt: skip
        out = () if number < 2 else ("--out", f"out{number}")
        result = call(*words, *out)
        assert result.exit_code == 0, (words, result.output)
    effect = json.loads(Path("out2", "effect.json").read_text())
    assert effect["mean"] == pytest.approx(3.0)
    assert load("out4").truth is not None


@pytest.mark.usefixtures("in_this_process")
def test_what_a_learner_said_is_in_the_terminal(file: str) -> None:
    """A learner that fails: which one, on what, how often, and its own words in one line."""
    Path("troubled.py").write_text(
        "def learn(data, *, seed=0):\n    raise ValueError('no luck with\\nthese rows')\n"
    )
    words = ("--no-baselines", "--budget", "20,30", "--seeds", "1", "--out", "out")
    result = call("discover", f"{file}:chain", "--learner", "troubled:learn", *words)
    assert result.exit_code == 0, result.output
    said = " ".join(result.output.split())
    assert "troubled:learn on models:chain, not done in 3 run(s)" in said
    assert "ValueError: no luck with these rows" in said


def test_a_file_without_a_model_is_refused(file: str) -> None:
    """One line with what to do; a JSON file has no arguments."""
    Path("other.json").write_text("{}")
    for name in ("other.json", "nowhere.json"):
        result = call("graph", name)
        assert result.exit_code == 2
        assert "to_json" in result.output
    assert "no arguments" in call("graph", "other.json", "--option", "a=1").output
