"""Observations and rewards of many worlds as tensors, beside the compiled programs of rows."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest

from scm_world.env import ScmWorldEnv
from scm_world.tasks import TASKS
from scm_world.training.recipe import recipe
from scm_world.world.mechanisms import Rows

pytest.importorskip("torch")

import torch  # see above

from scm_world.world.tensors import TensorRows

N = 200
READY = {name: task.ready_terms for name, task in TASKS.items()}


def _disturbed(env: Any) -> Any:
    """Return rows of a structure in random states, before and now, with with random goals."""
    compiled, rng = env.world.compiled, np.random.default_rng(7)
    numbers = np.repeat(env.world.row.numbers[None], N, axis=0)
    places = [slice(0, compiled.state_size), *compiled.earlier.values()]
    poses = "cartesian_position", "orientation"
    places += [
        at
        for name, at in compiled.where.items()
        if name.startswith("goal_") and name.endswith(poses)
    ]
    for place in places:
        numbers[:, place] += rng.normal(scale=0.02, size=numbers[:, place].shape)
    numbers[:, compiled.clock] = rng.integers(0, 60, N)
    return Rows(compiled, numbers)


@pytest.mark.parametrize("name", [*TASKS])
def test_every_task_has_the_same_numbers(name: str) -> None:
    """In 200 random states, with all terms for the asking: 1e-12 in 64 bits on the CPU."""
    terms = [term.name for term in READY[name]]
    options = {"terms": terms, "weights": dict.fromkeys(terms, 0.5)}
    env = ScmWorldEnv(name, backend="fake", task_options=options)
    env.reset(seed=0)
    rows, names = _disturbed(env), env.observer.needed
    tensors = TensorRows(rows, names, "cpu", copies := Counter())
    assert set(tensors.on_host) <= {"fractional_success"}
    assert (name == "reaching") == (not tensors.on_host)
    tensors.evaluate()
    rows.evaluate(names, np.arange(N))
    for one in names:
        found = tensors.table[rows.compiled.where[one]].numpy().T
        wanted = rows[one].reshape(N, -1)
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12, err_msg=one)
    assert np.ptp(rows["reward"]) > 0.0
    # Only what moves is copied for a mechanism that is computed on the host.
    moving = 7 * len(env.world.tools) if tensors.on_host else 0
    assert copies["mechanisms to the host"] == 8 * N * moving
    assert copies["mechanisms to the device"] == 8 * N * bool(moving)
    vector = env.observer.parts["observation"]
    seen = vector.on_columns(torch.as_tensor)(tensors.table).float().numpy()
    np.testing.assert_allclose(seen, vector.observe(rows), rtol=0.0, atol=2e-7)


@pytest.mark.parametrize("name", ["reaching", "pushing"])
def test_the_usual_settings_of_training_are_traced(name: str) -> None:
    """All of reaching; of pushing all but how full the goal is."""
    env = ScmWorldEnv(name, backend="fake", **recipe(name, "rsl_ppo").env)
    env.reset(seed=0)
    tensors = TensorRows(_disturbed(env), env.observer.needed, "cpu", Counter())
    assert tensors.on_host == [] if name == "reaching" else ["fractional_success"]


def test_a_reward_in_plain_python_is_computed_on_the_host() -> None:
    """With its numbers."""
    success: Any = (lambda tips: float(tips[2] > 0.056), "end_effector_positions")
    env = ScmWorldEnv("reaching", backend="fake", task_options={"success": success})
    env.reset(seed=0)
    rows = _disturbed(env)
    tensors = TensorRows(rows, env.observer.needed, "cpu", Counter())
    assert tensors.on_host == ["fractional_success"]
    tensors.evaluate()
    rows.evaluate(("end_effector_positions",), np.arange(N))
    wanted = rows["end_effector_positions"][:, 2] > 0.056
    found = tensors.table[rows.compiled.where["success"]].numpy()[0]
    np.testing.assert_array_equal(found, wanted)
    assert 0 < wanted.sum() < N
