"""Files of strangers that name functions: nothing of it is imported or called unasked."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Exogenous, World
from scm_world.curricula.curriculum import as_curriculum
from scm_world.env import ScmWorldEnv
from scm_world.errors import ScmWorldError
from scm_world.evaluation import Evaluation, evaluate
from scm_world.evaluation.preparation import again, task_of
from scm_world.evaluation.recording import Recording, record
from scm_world.graph.files import from_json
from scm_world.policies import MlpPolicy, save_policy
from scm_world.queries import Episode, Plan, load_episode, save_episode
from scm_world.training.recipe import Recipe, recipe

BAIT = "bait_module"
REFERENCES = (
    "os:system",
    "scm_world.cli.app:main",
    "scm_world.__main__:main",
    "scm_world.tasks.sources:load_named",
    "scm_world.testing.model:check_model",
    f"{BAIT}:run",
)


@pytest.fixture(autouse=True)
def bait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Lay out a module whose import leaves a trace."""
    (tmp_path / f"{BAIT}.py").write_text(
        "import pathlib\npathlib.Path(__file__).with_name('taken').touch()\n"
        "def run(*args, **kwargs):\n    return 0.0\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    assert not (tmp_path / "taken").exists()
    assert BAIT not in sys.modules


def _mechanism(reference: str) -> dict[str, Any]:
    return {
        "kind": "mechanism",
        "function": {"kind": "function", "reference": reference},
        "parents": [{"name": "floor_friction"}],
    }


def _plan(reference: str) -> dict[str, Any]:
    return {"format": "scm_world/plan/2", "do": {"stage_friction": [_mechanism(reference)]}}


def _read_plan(reference: str) -> None:
    Plan.from_dict(_plan(reference))


def _read_curriculum(reference: str) -> None:
    data = {"kind": "do", "request": {"stage_friction": _mechanism(reference)}}
    as_curriculum({"format": "scm_world/curriculum/2", **data})


def _model(reference: str) -> dict[str, Any]:
    function = {"kind": "function", "reference": reference}
    return {
        "format": "scm_world/model/2",
        "variables": [
            {"kind": "exogenous", "name": "size", "default": 1.0},
            {
                "kind": "derived",
                "name": "two",
                "parents": [{"name": "size"}],
                "mechanism": function,
            },
        ],
    }


def _read_model(reference: str) -> None:
    from_json(json.dumps(_model(reference)))


def _read_recipe(reference: str) -> None:
    data = {**recipe("reaching").as_dict(), "task": reference}
    Path("recipe.json").write_text(json.dumps(data))
    Recipe.load("recipe.json")


def _read_policy(reference: str) -> None:
    weights = {"layers.0.weight": np.zeros((9, 56), "f4"), "layers.0.bias": np.zeros(9, "f4")}
    save_policy("it.safetensors", MlpPolicy.of(weights, {"task": reference}))
    task_of("it.safetensors")


@cache
def _evaluated() -> Evaluation:
    short = {"max_episode_length": 1}
    return evaluate("still", "P0", task="reaching", n=1, backend="fake", env=short)


@cache
def _recorded() -> Recording:
    return record("still", ScmWorldEnv("reaching", backend="fake", max_episode_length=1), 1)


def _evaluation(change: Callable[[dict[str, Any]], None]) -> Evaluation:
    """Save an evaluation, change what it is about, and read it."""
    summary, _ = _evaluated().save("results")
    data = json.loads(Path(str(summary)).read_text())
    change(data["about"])
    Path(str(summary)).write_text(json.dumps(data))
    return Evaluation.load("results")


def _check_policy(reference: str) -> None:
    policy = {"kind": "function", "name": reference, "sees": "world"}
    again(_evaluation(lambda about: about["agents"][0].update(policy=policy)))


def _check_task(reference: str) -> None:
    again(_evaluation(lambda about: about.update(task=reference)))


def _check_start(reference: str) -> None:
    start = {"stage_friction": _mechanism(reference)}
    again(_evaluation(lambda about: about["env"].update(start=start)))


def _check_protocol(reference: str) -> None:
    part = {"kind": "do", "request": {"stage_friction": _mechanism(reference)}}
    again(_evaluation(lambda about: about["protocols"][0].update(act=part)))


def _recording(reference: str) -> Recording:
    changed = replace(_recorded(), environment={**_recorded().environment, "task": reference})
    return Recording.load(changed.save("it.parquet"))


def _replay(reference: str) -> None:
    _recording(reference).replay()


def _to_minari(reference: str) -> None:
    _recording(reference).to_minari("it-v0")


def _load_changed(episode: Episode, **changes: Any) -> None:
    save_episode(episode, "it.npz")
    with np.load("it.npz") as arrays:
        found = dict(arrays)
    about = {**json.loads(str(found["about"])), **changes}
    np.savez("it.npz", **{**found, "about": np.array(json.dumps(about))})
    load_episode("it.npz")


def _read_episode(reference: str) -> None:
    episode = World("reaching", backend="fake").rollout("random", seed=0, steps=1)
    _load_changed(episode, plan=_plan(reference))


def _read_episode_of_equations(reference: str) -> None:
    model = SCM([Exogenous(name="size", default=1.0)])
    _load_changed(model.rollout(), equations=_model(reference))


ATTACKS = (
    _read_plan,
    _read_curriculum,
    _read_model,
    _read_recipe,
    _read_policy,
    _check_policy,
    _check_task,
    _check_start,
    _check_protocol,
    _replay,
    _to_minari,
    _read_episode,
    _read_episode_of_equations,
)


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: str(attack.__name__))
def test_what_a_file_names_is_not_run(attack: Callable[[str], None]) -> None:
    """Commands, functions of the system and of this package are refused, unless trusted."""
    for reference in REFERENCES:
        with pytest.raises(ScmWorldError, match="trusted"):
            attack(reference)


def test_policies_and_models_of_this_package_need_no_trust() -> None:
    """They run no code that a file could choose."""
    known = {"kind": "function", "name": "scm_world.policies.scripted:Random", "sees": "world"}
    found = _evaluation(lambda about: about["agents"][0].update(policy=known))
    again(found)
