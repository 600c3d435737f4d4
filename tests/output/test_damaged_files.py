"""Files that are not what they should be: one kind of error, no work begun, no foreign code run."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM
from scm_world.curricula import Curriculum
from scm_world.errors import ModelError, ScmWorldError, UnreadableFile
from scm_world.evaluation import Evaluation, evaluate
from scm_world.graph.files import from_dict, from_json
from scm_world.queries import Plan, World, load_episode, save_episode
from scm_world.variables import Derived, Exogenous

DEEP = "[" * 100_000

TEXTS: dict[str, Callable[[str], Any]] = {
    "model": from_json,
    "plan": Plan.from_json,
    "curriculum": Curriculum.from_json,
}


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("text", ["", "null", "[]", "{", DEEP, '{"format": 3}', "NaN", "\ud800"])
def test_texts_of_something_else_are_refused(kind: str, text: str) -> None:
    """With an error of this package, also where they are nested deeply."""
    with pytest.raises(ModelError):
        TEXTS[kind](text)


def test_functions_that_are_no_mechanisms_are_not_trusted() -> None:
    """A command of this package is a function, and computes nothing."""
    model = SCM(
        [
            Exogenous(name="size", default=1.0),
            Derived(name="double", parents=("size",), mechanism=np.negative),
        ]
    )
    for reference in ("scm_world.cli.app:main", "scm_world.tasks.factories:load_factory"):
        data: dict[str, Any] = {
            "format": "scm_world/model/1",
            "variables": [
                {"kind": variable["kind"], **variable} for variable in _plain(model, reference)
            ],
            "interventions": {},
        }
        with pytest.raises(ModelError, match="outside the trusted"):
            from_dict(data)


def _plain(model: SCM, reference: str) -> list[dict[str, Any]]:
    """Write declarations by hand, with another mechanism."""
    size, double = (variable.model_dump(mode="json") for variable in model.variables)
    return [size, {**double, "mechanism": {"kind": "function", "reference": reference}}]


@pytest.fixture(scope="module")
def episode_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save an episode of three steps."""
    episode = World("pushing", backend="fake").rollout("random", seed=0, steps=3)
    return save_episode(episode, tmp_path_factory.mktemp("episodes") / "one.npz")


@pytest.mark.parametrize("steps", [10**9, 2, -1, 1.5, True, "3", None])
def test_an_episode_says_no_more_steps_than_it_holds(
    episode_file: Path, tmp_path: Path, steps: Any
) -> None:
    """It is refused before a step is taken."""
    with np.load(episode_file) as arrays:
        found = dict(arrays)
    found["about"] = np.array(json.dumps({**json.loads(str(found["about"])), "steps": steps}))
    np.savez_compressed(tmp_path / "other.npz", **found)
    with pytest.raises(UnreadableFile, match="control steps"):
        load_episode(tmp_path / "other.npz")


def test_damaged_episodes_are_told(episode_file: Path, tmp_path: Path) -> None:
    """Whichever byte is another one, the error is one of this package, or nothing has changed."""
    data = episode_file.read_bytes()
    path, random = tmp_path / "damaged.npz", np.random.default_rng(0)
    for place in random.choice(len(data), 40, replace=False):
        changed = bytearray(data)
        changed[place] ^= 1 << int(random.integers(8))
        path.write_bytes(bytes(changed))
        with suppress(ScmWorldError):
            assert load_episode(path) == load_episode(episode_file)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(UnreadableFile):
        load_episode(path)


def test_results_with_another_bit_are_refused(tmp_path: Path) -> None:
    """The summary has a checksum; spaces do not count."""
    found = evaluate(
        "still", "P0", task="pushing", n=2, backend="fake", env={"max_episode_length": 2}
    )
    summary, _ = found.save(tmp_path)
    data, random = summary.read_bytes(), np.random.default_rng(0)
    assert len(Evaluation.load(tmp_path)) == 2
    whole = json.loads(data)
    for place in random.choice(len(data), 120, replace=False):
        changed = bytearray(data)
        changed[place] ^= 1 << int(random.integers(7))
        try:
            same = json.loads(changed.decode()) == whole
        except ValueError:
            same = False
        summary.write_bytes(bytes(changed))
        if same:
            continue
        with pytest.raises(UnreadableFile):
            Evaluation.load(tmp_path)
    summary.write_text(DEEP)
    with pytest.raises(UnreadableFile):
        Evaluation.load(tmp_path)
