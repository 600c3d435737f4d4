"""Control steps on the device: the same as on the host, what is copied, and training with them."""

from __future__ import annotations

import csv
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from gymnasium.vector import AutoresetMode
from numba import njit

pytest.importorskip("mujoco_warp")
torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from mujoco_warp import OverflowType  # noqa: E402

from scm_world.backends.warp.constants import NOTHING  # noqa: E402
from scm_world.backends.warp.device import Engine  # noqa: E402 # needs the libraries
from scm_world.env import ScmWorldVectorEnv  # noqa: E402
from scm_world.env.tensors import TensorEnvs  # noqa: E402
from scm_world.errors import EngineFailure, ModelError  # noqa: E402
from scm_world.evaluation import evaluate  # noqa: E402
from scm_world.training.loop import train  # noqa: E402
from scm_world.training.many import ManyPpo  # noqa: E402
from scm_world.training.recipe import Recipe, recipe  # noqa: E402
from scm_world.training.worlds import make_envs  # noqa: E402
from scm_world.variables import Hard, Measured, Time  # noqa: E402

N = 5
GIVEN: dict[str, Any] = {"backend": "warp:cpu", "threads": 1, "seed": 3}
SMALL = recipe(
    "reaching",
    "rsl_ppo",
    worlds=8,
    steps=512,
    n_steps=8,
    batch_size=32,
    curriculum="P5",
    episode_length=11,
    network={"hidden": [16]},
    trials={"episodes": 1, "times": 1, "protocols": ["P0"], "backend": "fake"},
)


def _pair(task: str, curriculum: Any, env: Any = None) -> tuple[Any, Any]:
    """Return environments on the device, and equal ones on the host."""
    sizes = {"env": env or {}, "worlds": N, "n_steps": 8, "batch_size": 8 * N, "episode_length": 6}
    made = recipe(task, "rsl_ppo", curriculum=curriculum, **sizes)
    envs = [make_envs(made, backend="warp:cpu") for _ in range(2)]
    for one in envs:
        one.reset(seed=3)
    return TensorEnvs(envs[0]), envs[1]


def _actions(step: int) -> Any:
    return np.random.default_rng(step).uniform(-1.0, 1.0, (N, 9)).astype(np.float32)


def _same(found: Any, wanted: Any) -> None:
    """Compare a control step on the device with one on the host."""
    seen, rewards, terminated, truncated, infos = wanted
    np.testing.assert_array_equal(found.seen.numpy(), seen)
    np.testing.assert_allclose(found.rewards.numpy(), rewards, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found.terminated.numpy(), terminated)
    np.testing.assert_array_equal(found.truncated.numpy(), truncated)
    np.testing.assert_array_equal(found.rows, np.flatnonzero(terminated | truncated))
    if len(found.rows):
        last = np.stack([*infos["final_obs"][found.rows]])
        np.testing.assert_array_equal(found.last.numpy(), last)
        for name, values in found.facts.items():
            np.testing.assert_array_equal(values, infos["final_info"][name][found.rows])


@pytest.mark.parametrize(
    ("task", "curriculum", "env"),
    [
        ("reaching", "P7", {}),
        ("pushing", "2", {}),
        ("picking", "P10", {}),
        ("reaching", "P7", {"history": 2, "action_mode": "delta_joint_positions"}),
    ],
)
def test_a_control_step_is_that_of_the_host(task: str, curriculum: str, env: Any) -> None:
    """Bit for bit what is observed, also with everything from A; and after the device is left."""
    there, here = _pair(task, curriculum, env)
    assert there.why_not == ""
    for step in range(14):
        _same(there.step(torch.as_tensor(_actions(step))), here.step(_actions(step)))
    there.leave()
    for step in range(3):
        for one, other in zip(
            there._envs.step(_actions(step))[:4], here.step(_actions(step))[:4], strict=True
        ):
            np.testing.assert_array_equal(one, other)


def _vector(task: str, **options: Any) -> Any:
    mode = AutoresetMode.SAME_STEP
    return ScmWorldVectorEnv(N, task=task, backend="warp:cpu", autoreset_mode=mode, **options)


@pytest.mark.parametrize(
    ("task", "options", "do", "why"),
    [
        ("reaching", {"action_mode": "end_effector_positions"}, {}, "computed from states"),
        ("pushing", {"conventions": "causal_world"}, {}, "predecessor"),
        ("pushing", {"keypoints": "view"}, {}, "views of hands"),
        ("pushing", {}, {"floor_friction": Hard(value=0.3, time=Time(at=3))}, "planned"),
    ],
)
def test_what_the_device_cannot_do_is_said(task: str, options: Any, do: Any, why: str) -> None:
    """In a sentence."""
    envs = _vector(task, **options)
    envs.reset(seed=0, options={"do": do})
    there = TensorEnvs(envs)
    assert why in there.why_not
    there.leave()
    envs.step(np.zeros((N, 9)))


def test_a_training_goes_on_where_the_device_cannot() -> None:
    """As on every engine, and it says so."""
    env = {**SMALL.env, "action_mode": "end_effector_positions", "delta_scale": 1.0}
    made = SMALL.but(env={**env, "delta_origin": "command"}, steps=64)
    model = ManyPpo(made, backend="warp:cpu", seed=3, device="cpu", threads=1)
    model.round()
    (said,) = model.news
    assert said.startswith("control steps are computed on the host: commands")
    assert model.num_timesteps == 64


def test_a_world_that_fails_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """It shows what it showed before the step, and begins anew; the others are not touched."""
    there, here = _pair("pushing", 0)
    start = there._engine.read()
    fast = next(row for row in there._engine._group.structure.states if row.array == "qvel")
    place = there._engine._group.structure.layout.slices[fast.name].start
    where = int(np.flatnonzero(there._engine._places.numpy() == place)[0])
    speeds = there._engine._tensors["qvel"]
    for step in range(2):
        _same(there.step(torch.as_tensor(_actions(step))), here.step(_actions(step)))
    before = there.seen.clone()
    speeds[2, where - there._engine._tensors["qpos"].shape[1]] = 3e10
    found, wanted = there.step(torch.as_tensor(_actions(2))), here.step(_actions(2))
    assert found.rows.tolist() == [2]
    assert found.facts["failed"].tolist() == [True]
    assert found.rewards[2] == 0.0
    assert found.truncated.tolist() == [False, False, True, False, False]
    np.testing.assert_array_equal(found.last[0].numpy(), before[2].numpy())
    others = [0, 1, 3, 4]
    np.testing.assert_array_equal(found.seen[others].numpy(), wanted[0][others])
    assert there.copies["steps taken again to the host"] > 0
    assert start.shape[1] == N
    again = there.step(torch.as_tensor(_actions(3)))
    assert not again.terminated.any()
    assert again.seen.isfinite().all()


def test_a_step_in_which_memory_overflows_is_taken_again() -> None:
    """From the state before it, with the same result."""
    there, here = _pair("reaching", 0)
    engine = there._engine._group.synced()
    plain, calls = engine.launch, list[int]()

    def full_once(substeps: int) -> None:
        plain(substeps)
        calls.append(substeps)
        if len(calls) == 2:
            there._engine._tensors["overflow"][1] = int(OverflowType.NEFC)

    engine.launch = full_once
    for step in range(4):
        _same(there.step(torch.as_tensor(_actions(step))), here.step(_actions(step)))
    assert len(calls) == 5
    assert there.copies["steps taken again to the host"] > 0


def test_states_do_not_get_lost_where_scenes_are_added() -> None:
    """Arrays that grow have no states of before: that is an error."""
    there, _ = _pair("reaching", 0)
    for _ in range(8):
        there._engine._group.add(NOTHING)
    with pytest.raises(EngineFailure, match="scenes were added"):
        there.step(torch.zeros((N, 9)))


@njit
def _late(index: int) -> float:
    return math.sqrt(1.5 - index)  # no number from the second step on


def test_a_reward_that_is_not_a_number_is_refused() -> None:
    """As on the host."""
    late = Measured(name="reward.late", parents=("control_index",), mechanism=_late)
    options = {"terms": (late,), "weights": {"reward.late": 1.0}}
    envs = _vector("reaching", task_options=options)
    envs.reset(seed=0)
    there = TensorEnvs(envs)
    assert there.why_not == ""
    there.step(torch.zeros((N, 9)))
    with pytest.raises(ModelError, match=r"environment 0: .*reward\.late"):
        there.step(torch.zeros((N, 9)))


def test_a_reward_that_is_finite_on_the_host_alone_is_refused() -> None:
    """It is not taken for a reward, and not passed over."""
    envs = _vector("reaching")
    envs.reset(seed=0)
    there = TensorEnvs(envs)
    there._scale = float("nan")
    with pytest.raises(EngineFailure, match=r"environment 0: .*finite on the host"):
        there.step(torch.zeros((N, 9)))


@pytest.mark.parametrize("task", ["reaching", "pushing"])
def test_a_step_copies_what_is_stated_and_nothing_else(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three bytes of flags; in pushing the pose of the block, and how full the goal is, too."""
    there, _ = _pair(task, 0)
    read: list[int] = []
    for name in ("cpu", "numpy", "tolist", "item", "__array__", "nonzero", "__bool__"):
        plain = getattr(torch.Tensor, name)

        def counted(self: Any, *given: Any, plain: Any = plain, **named: Any) -> Any:
            read.append(self.nbytes)
            return plain(self, *given, **named)

        monkeypatch.setattr(torch.Tensor, name, counted)
    made: list[int] = []
    plain_tensor = torch.as_tensor

    def uploaded(data: Any, *given: Any, **named: Any) -> Any:
        if isinstance(data, np.ndarray):
            made.append(data.nbytes)
        return plain_tensor(data, *given, **named)

    monkeypatch.setattr(torch, "as_tensor", uploaded)
    for name in ("step", "touches", "field"):  # of the engine: what copies whole arrays

        def refused(*_: Any, name: str = name) -> Any:
            raise AssertionError(name)

        monkeypatch.setattr(Engine, name, refused)
    actions = torch.zeros((N, 9))
    there.copies.clear()
    there.step(actions)
    moving = N * 8 * 7 * (task == "pushing")
    filled = N * 8 * (task == "pushing")
    assert dict(there.copies) == {
        "flags to the host": 3,
        **({"mechanisms to the host": moving} if moving else {}),
        **({"mechanisms to the device": filled} if moving else {}),
    }
    # Each byte is seen twice at most: ``cpu().numpy()``.
    assert sum(made) == filled
    assert sorted(set(read)) == sorted({1, 2, *([moving] if moving else [])})


def test_training_gives_the_same_again_and_goes_on_after_a_kill(tmp_path: Path) -> None:
    """The same weights in two folders; a killed one resumes from its last checkpoint."""
    said: list[str] = []
    found = train(SMALL, out=tmp_path / "one", tell=said.append, **GIVEN)
    again = train(SMALL, out=tmp_path / "two", **GIVEN)
    one, two = (safetensors.numpy.load_file(run.policy) for run in (found, again))
    assert all(np.array_equal(one[name], two[name]) for name in one)
    assert not any("on the host" in line for line in said)
    program = f"""
import json, os
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe
die = lambda done, _: done >= 256 and os.kill(os.getpid(), 9)
made = Recipe.from_dict(json.loads({SMALL.to_json()!r}))
train(made, out={str(tmp_path / "run")!r}, progress=die, **{GIVEN!r})
"""
    done = subprocess.run(  # noqa: S603 # ours
        [sys.executable, "-c", program], check=False, env={**os.environ}
    )
    assert done.returncode == -9
    said.clear()
    resumed = train(SMALL, out=tmp_path / "run", tell=said.append, **GIVEN)
    assert resumed.steps == 512
    assert any(line.startswith("goes on after") for line in said)
    assert Recipe.from_dict(SMALL.as_dict()) == SMALL
    scores = evaluate(resumed.policy, ["P0", "P5"], task="reaching", n=1, backend="fake")
    assert len(scores.frame) == 2


def test_a_short_training_learns(tmp_path: Path) -> None:
    """To reach: in 6,144 steps of 32 worlds a control step earns more than twice as much."""
    sizes = {"worlds": 32, "steps": 6144, "n_steps": 16, "batch_size": 128, "episode_length": 20}
    rate = {"initial": 1e-3, "schedule": "constant"}
    network = {"hidden": [64, 64]}
    made = recipe("reaching", "rsl_ppo", rate=rate, network=network, **sizes)
    train(made.but(trials={"protocols": []}), out=tmp_path, **GIVEN)
    with (tmp_path / "progress.csv").open() as file:
        rows = [*csv.DictReader(file)]
    earned = [float(row["rollout/ep_rew_mean"]) / float(row["rollout/ep_len_mean"]) for row in rows]
    assert earned[-1] > 2.0 * earned[0]


def test_a_training_says_what_is_computed_on_the_host(tmp_path: Path) -> None:
    """In one line, once."""
    said: list[str] = []
    sizes = {"worlds": 8, "steps": 128, "n_steps": 8, "batch_size": 32, "episode_length": 11}
    made = recipe("pushing", "rsl_ppo", trials={"protocols": []}, **sizes)
    train(made, out=tmp_path, tell=said.append, **GIVEN)
    lines = [line for line in said if "on the host" in line]
    assert lines == ["computed on the host, in each step: fractional_success"]
