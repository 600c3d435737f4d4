"""Facts about results that are played again, and about those of several machines."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_samples import (
    MASS,
    SHORT,
    contents,
    linear,
    opposite,
    played_again,
    small,
)

from scm_world.errors import (
    ModelError,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.evaluation import Evaluation, why
from scm_world.policies import save_policy
from scm_world.tasks import make_task
from scm_world.variables import Draw, Shift, Subset

# --- again ----------------------------------------------------------------------------------------


def test_results_are_played_again(tmp_path: Path) -> None:
    """Named policies, functions and arrays, from the files alone or with the policy at hand."""
    found = small({"named": "random", "function": linear})
    found.save(tmp_path)
    read = Evaluation.load(tmp_path)
    assert not played_again(read, trusted=["evaluation_samples"])
    assert not played_again(read, policy={"named": "random", "function": linear})
    with pytest.raises(ModelError, match="trusted"):
        played_again(read)


@pytest.mark.parametrize(
    "env",
    [
        {"start": {MASS: Draw("B"), "tool_block": {"linear_velocity": Shift([0.1, 0.0, 0.0])}}},
        {"start": {MASS: "B"}, "random_goal": "A"},
        {"variables_space": Subset({"*.mass": "A|B", "*.cylindrical_position": "B"})},
        {"goal_env": True, "frame_skip": np.int64(3), "conventions": "causal_world"},
        {"task_options": {"fractional_reward_weight": 2, "tool_block_mass": 0.05}},
    ],
    ids=str,
)
def test_environments_are_made_again(env: dict[str, Any], tmp_path: Path) -> None:
    """Whatever the options were: from the file alone the same bits come out."""
    small(env={**SHORT, **env}).save(tmp_path)
    assert not played_again(Evaluation.load(tmp_path))


def test_tasks_are_made_again(tmp_path: Path) -> None:
    """A task with arguments is the same as its name with them."""
    task = make_task("pushing", tool_block_mass=0.05)
    found = small(task=task)
    found.save(tmp_path)
    assert not played_again(Evaluation.load(tmp_path))
    assert found != small()


def test_another_policy_plays_otherwise() -> None:
    """Given under the name of the one that acted."""
    found = small({"mine": linear})
    assert played_again(found, policy=opposite)
    assert not played_again(found, policy={"mine": linear})
    for wrong in ({"typo": linear}, {"mine": [linear, linear]}):
        with pytest.raises(UnknownOption, match="policy"):
            played_again(found, policy=wrong)


def test_policies_in_memory_are_known_as_long_as_they_are_there() -> None:
    """In one process they need not be given again; a file does not have them."""
    found = small({"mine": lambda observation: np.zeros(9), "other": "still"})
    assert not played_again(found)
    assert why(found.only(agent="mine"), "P6", 0).others
    read = pickle.loads(pickle.dumps(found))  # noqa: S301 # ours
    assert read == found
    with pytest.raises(UnknownOption, match="give the policy itself"):
        played_again(read)


def test_an_episode_that_does_not_happen_again_explains_nothing() -> None:
    """The error says with which versions the results were made."""
    found = small()
    versions = {"fake": {**found.about["versions"]["fake"], "numpy": "0.1"}}
    changed = Evaluation({**found.about, "versions": versions}, found.frame.assign(hash="other"))
    with pytest.raises(SnapshotMismatch, match=r"does not happen again.*numpy 0\.1"):
        why(changed, "P6", 0)


def test_one_file_in_two_places_is_one_policy(tmp_path: Path) -> None:
    """Where a machine keeps a policy does not matter, its content does."""
    layers = {
        "layers.0.weight": np.full((9, 56), 0.05, np.float32),
        "layers.0.bias": np.zeros(9, np.float32),
    }
    tables = []
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        path = save_policy(tmp_path / name / "policy.safetensors", layers, {"task": "pushing"})
        tables.append(small(str(path), out=tmp_path / "out"))
    assert len(contents(tmp_path / "out")) == 1 + 2
    assert tables[1] == tables[0]
