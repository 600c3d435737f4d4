"""Files of results are not added to, or read, by a system that was changed since."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scm_world as sw
from scm_world.discovery import benchmark
from scm_world.discovery.data import Design, collect, sweep, triplets
from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, SnapshotMismatch, UnreadableFile
from scm_world.evaluation import evaluate, record
from scm_world.graph import from_json, to_json
from scm_world.queries import load_episode, save_episode
from scm_world.variables import Box, Normal

FILE = """
<mujoco><include file="part.xml"/><worldbody>
  <body name="b">
    <joint name="j" axis="0 1 0" {joint}/><geom size=".1" mass="2" pos=".2 0 0"/>
  </body>
</worldbody><actuator><motor name="m" joint="j" ctrlrange="-1 1"/></actuator></mujoco>
"""
PART = '<mujoco><option timestep="{}"/></mujoco>'


def itself(value: Any) -> Any:
    """Reward a position."""
    return value


def written(folder: Path, joint: str = "", timestep: float = 0.002) -> Path:
    """Write a model of two files; the first one includes the other."""
    (folder / "part.xml").write_text(PART.format(timestep))
    path = folder / "m.xml"
    path.write_text(FILE.format(joint=joint))
    return path


def world(path: Path) -> sw.World:
    """Read the model; the mass of its body varies."""
    return sw.World(path, spaces={"b.mass": {"a": Box(1.0, 3.0)}})


def equations(gain: float) -> sw.SCM:
    """Make a model with a constant in a closure."""
    root = sw.Exogenous(name="x", distribution=Normal(0, 1), a=Box(1.0, 2.0))
    return sw.SCM([root, sw.Derived(name="y", parents=("x",), mechanism=lambda x: gain * x)])


def stepped(gain: float) -> sw.World:
    """Make a world of a step function with a constant in a closure."""

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        return {"y": state["y"] + gain * parameters["x"]}

    parameter = sw.Exogenous(name="x", distribution=Box(0.0, 1.0))
    return sw.World(step, parameters=[parameter], states=[sw.Measured(name="y")])


EQUATIONS = Design("single", ("x",), "A", 0.5)


@pytest.mark.parametrize(
    ("made", "design", "part"),
    [(equations, EQUATIONS, "mechanism of 'y'"), (stepped, Design(), "physics")],
)
def test_functions_that_changed_add_no_rows(
    made: Callable[[float], Any], design: Design, part: str, tmp_path: Path
) -> None:
    """A collection goes on with the same function, and refuses another one by name."""
    setting: Any = {"out": tmp_path / "d"} | ({} if made is equations else {"steps": 2})
    collect(made(1.0), design, 2, **setting)
    again = collect(
        made(1.0), design, 4, out=tmp_path / "d", steps=None if made is equations else 2
    )
    assert len(again) == 4
    with pytest.raises(UnreadableFile, match=part):
        collect(made(2.0), design, 6, **setting)


@pytest.mark.parametrize("change", [{"joint": 'stiffness="3"'}, {"timestep": 0.001}], ids=str)
def test_files_that_changed_add_no_rows(change: dict[str, Any], tmp_path: Path) -> None:
    """The model and what it includes count in collections, sweeps and pairs of pictures."""
    path, calls, masses = written(tmp_path), [], {"b.mass": [1.0, 2.0]}
    calls.append(lambda: collect(world(path), Design(), 2, out=tmp_path / "d", steps=2))
    calls.append(lambda: sweep(world(path), masses, n=2, out=tmp_path / "s", steps=2))
    calls.append(lambda: triplets(world(path), ["b.mass"], 2, tmp_path / "t", size=(8, 8)))
    for call in calls:
        call()
        call()  # the same again is read
    written(tmp_path, **change)
    for call in calls:
        with pytest.raises(UnreadableFile, match="physics"):
            call()


def test_what_is_done_counts(tmp_path: Path) -> None:
    """A policy with another constant acts otherwise, so its rows belong elsewhere."""
    path = written(tmp_path)

    def call(gain: float) -> None:
        def policy(present: Any) -> Any:
            return [gain * present["j.velocity"]]

        collect(world(path), Design(), 2, out=tmp_path / "d", steps=2, policy=policy)

    call(1.0)
    with pytest.raises(UnreadableFile, match=r"differ: .*policy"):
        call(2.0)


@pytest.fixture(autouse=True)
def _modules_are_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of one second and one size would have the same bytecode."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)


def task_file(path: Path) -> str:
    """Write a task of the model with a reward, and name it."""
    source = path.with_name("task_of_mine.py")
    source.write_text(
        "from scm_world import ModelTask\nfrom scm_world.variables import Box\n\n\n"
        "def first(value):\n    return value\n\n\n"
        "def task():\n"
        f"    spaces = {{'b.mass': {{'a': Box(1.0, 3.0)}}}}\n"
        f"    return ModelTask({str(path)!r}, spaces=spaces, reward=(first, 'j.position'))\n"
    )
    return f"{source}:task"


def learner_of(folder: Path, threshold: float) -> str:
    """Write a learner, and name it."""
    path = folder / "mine.py"
    path.write_text(
        f"import numpy as np\n\n\ndef learn(data, seed=0):\n"
        f"    n = len(data.names)\n    return np.full((n, n), {threshold}) * (1 - np.eye(n))\n"
    )
    sys.modules.pop("mine", None)
    importlib.invalidate_caches()
    return "mine:learn"


def test_a_benchmark_goes_on_with_the_same_systems_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scores of a changed model, or of a changed learner, are not those of before."""
    monkeypatch.syspath_prepend(tmp_path)
    task = task_file(written(tmp_path))

    def call(threshold: float = 1.0) -> Any:
        name = learner_of(tmp_path, threshold)
        return benchmark([name], [task], budgets=[8], seeds=1, out=tmp_path / "b", engine="serial")

    scores = [str(run.scores) for run in call().runs]
    assert [str(run.scores) for run in call().runs] == scores
    with pytest.raises(UnreadableFile, match=r"differ: .*learner 'mine:learn'"):
        call(0.5)
    written(tmp_path, 'stiffness="3"')
    with pytest.raises(UnreadableFile, match="physics in"):
        call()


def test_an_evaluation_runs_what_changed_again(tmp_path: Path) -> None:
    """The scores in a folder are those of the present model, not of the one before."""
    path = written(tmp_path)

    def call(folder: str) -> Any:
        task = sw.ModelTask(path, reward=(itself, "j.position"), seconds=0.2)
        return evaluate("still", task=task, n=1, out=tmp_path / folder).frame["return"].tolist()

    first = call("e")
    assert call("e") == first
    written(tmp_path, 'stiffness="300"')
    assert call("e") == call("fresh") != first


def test_recordings_and_episodes_name_what_changed(tmp_path: Path) -> None:
    """Their replay is refused before it is run."""
    path = written(tmp_path)
    env = ScmWorldEnv(task_file(path), max_episode_length=3)
    recording = record("random", env, 1)
    env.close()
    assert recording.replay() == 3
    saved = save_episode(sw.World(path).rollout("random", seed=0, steps=3), tmp_path / "e.npz")
    assert load_episode(saved).steps == 3
    written(tmp_path, 'stiffness="3"')
    for again in (recording.replay, lambda: load_episode(saved)):
        with pytest.raises(SnapshotMismatch, match="physics"):
            again()


def test_a_saved_model_names_a_function_that_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model is read with the functions that it was written with, or not at all."""
    monkeypatch.syspath_prepend(tmp_path)

    def model(gain: float) -> sw.SCM:
        (tmp_path / "laws_of_mine.py").write_text(f"def law(x):\n    return {gain} * x\n")
        sys.modules.pop("laws_of_mine", None)
        importlib.invalidate_caches()
        law = importlib.import_module("laws_of_mine").law
        root = sw.Exogenous(name="x", distribution=Normal(0, 1))
        return sw.SCM([root, sw.Derived(name="y", parents=("x",), mechanism=law)])

    text = to_json(model(2.0))
    drawn = model(2.0).draw(3, seed=0)["y"]  # made again, as in another process
    read = from_json(text, trusted=("laws_of_mine",))
    np.testing.assert_array_equal(read.draw(3, seed=0)["y"], drawn)
    assert to_json(read) == text
    model(3.0)
    with pytest.raises(ModelError, match="mechanism of 'y' differ"):
        from_json(text, trusted=("laws_of_mine",))
