"""Files that are not what they should be: one kind of error, no work begun, no foreign code run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM
from scm_world.backends import read_model
from scm_world.curricula import Curriculum
from scm_world.discovery.data import load as dataset_of
from scm_world.errors import ModelError, ScmWorldError, UnreadableFile
from scm_world.evaluation import Evaluation, evaluate
from scm_world.evaluation.preparation import again
from scm_world.evaluation.recording import Recording
from scm_world.geometry.hulls import load_hull
from scm_world.graph.files import from_json
from scm_world.policies import load_sb2
from scm_world.policies.agents import as_agent
from scm_world.queries import Plan, World, load_episode, save_episode
from scm_world.training.recipe import Recipe
from scm_world.variables import Derived, Exogenous

DEEP = "[" * 100_000

TEXTS: dict[str, Callable[[str], Any]] = {
    "model": from_json,
    "plan": Plan.from_json,
}


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("text", ["", "null", "[]", "{", DEEP, '{"format": 3}', "NaN", "\ud800"])
def test_texts_of_something_else_are_refused(kind: str, text: str) -> None:
    """With an error of this package, also where they are nested deeply."""
    with pytest.raises(ModelError):
        TEXTS[kind](text)


INCLUDE = """<mujoco><include file="{}"/><worldbody/></mujoco>"""


def _named_by(text: str, path: Path) -> Any:
    """Read a model that names a file."""
    model = path.with_name("model.xml")
    model.write_text(text.format(path))
    return read_model(model)


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "policy": (".safetensors", as_agent),
    "network": (".safetensors", as_agent),
    "archive": (".zip", load_sb2),
    "episode": (".npz", load_episode),
    "recording": (".parquet", Recording.load),
    "results": (".json", Evaluation.load),
    "curriculum": (".json", Curriculum.load),
    "recipe": (".json", Recipe.load),
    "dataset": ("", lambda path: dataset_of(path.parent)),
    "model": (".xml", read_model),
    "included": (".xml", lambda path: _named_by(INCLUDE, path)),
    "shape": (".stl", load_hull),
}


@pytest.mark.parametrize("reader", READERS)
def test_files_without_an_end_are_not_opened(reader: str, tmp_path: Path) -> None:
    """Nobody waits for a pipe, or reads a device to its end."""
    ending, read = READERS[reader]
    path = tmp_path / (f"it{ending}" if reader != "dataset" else "study.json")
    os.mkfifo(path)
    with pytest.raises(ScmWorldError, match="regular file"):
        read(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(ScmWorldError, match="regular file"):
        read(path)


def test_functions_that_are_no_mechanisms_are_not_trusted() -> None:
    """A command of this package is a function, and computes nothing."""
    model = SCM(
        [
            Exogenous(name="size", default=1.0),
            Derived(name="double", parents=("size",), mechanism=np.negative),
        ]
    )
    for reference in ("scm_world.cli.app:main", "scm_world.tasks.sources:load_named"):
        data: dict[str, Any] = {
            "format": "scm_world/model/2",
            "variables": [
                {"kind": variable["kind"], **variable} for variable in _plain(model, reference)
            ],
            "interventions": {},
        }
        with pytest.raises(ModelError, match="outside the trusted"):
            from_json(json.dumps(data))


def _plain(model: SCM, reference: str) -> list[dict[str, Any]]:
    """Write declarations by hand, with another mechanism."""
    size, double = (variable.model_dump(mode="json") for variable in model.variables)
    return [size, {**double, "mechanism": {"kind": "function", "reference": reference}}]


@pytest.fixture(scope="module")
def episode_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save an episode of three steps."""
    episode = World("pushing", backend="fake").rollout("random", seed=0, steps=3)
    return save_episode(episode, tmp_path_factory.mktemp("episodes") / "one.npz")


@pytest.mark.parametrize(
    "changed",
    [
        *({"plan": 3}, {"plan": {"do": 3}}, {"options": "x"}, {"task": {}}, {"arguments": [1]}),
        *({"instants": []}, {"instants": None}, {"format": "scm_world/episode/3"}),
    ],
)
def test_an_episode_that_says_something_else_is_refused(
    episode_file: Path, tmp_path: Path, changed: dict[str, Any]
) -> None:
    """Whatever stands where something else should."""
    with np.load(episode_file) as arrays:
        found = dict(arrays)
    about = {**json.loads(str(found["about"])), **changed}
    np.savez(tmp_path / "other.npz", **{**found, "about": np.array(json.dumps(about))})
    with pytest.raises(ModelError if "plan" in changed else UnreadableFile):
        load_episode(tmp_path / "other.npz")


@pytest.mark.parametrize("written", [3, [], {}, {"format": "scm_world/model/2"}, "x"])
def test_an_episode_of_other_equations_is_refused(tmp_path: Path, written: Any) -> None:
    """The error says that there is no model."""
    episode = SCM([Exogenous(name="size", default=1.0)]).rollout()
    with np.load(save_episode(episode, tmp_path / "one.npz")) as arrays:
        found = dict(arrays)
    about = {**json.loads(str(found["about"])), "equations": written}
    np.savez(tmp_path / "other.npz", **{**found, "about": np.array(json.dumps(about))})
    with pytest.raises(ModelError, match="not a model"):
        load_episode(tmp_path / "other.npz")


@pytest.mark.parametrize(
    "changed", [{"agents": [3]}, {"env": {"start": {"kind": "x"}}}, {"seeds": 3}]
)
def test_results_that_say_something_else_are_not_played_again(changed: dict[str, Any]) -> None:
    """With an error of this package."""
    short = {"max_episode_length": 1}
    found = evaluate("still", "P0", task="reaching", n=1, backend="fake", env=short)
    with pytest.raises(ScmWorldError):
        again(Evaluation({**found.about, **changed}, found.frame))


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
