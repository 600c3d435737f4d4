"""Computed variables: compiled, bound once, and never out of date."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import numpy as np
import pytest
from numba.extending import is_jitted

from scm_world import World
from scm_world.env import ScmWorldEnv
from scm_world.tasks import TASKS
from scm_world.tasks.trifinger.kernels import filled, minus_length
from scm_world.variables import Concatenation, Linear
from scm_world.variables.mechanisms import Stacked


@pytest.mark.parametrize("task", TASKS)
def test_a_control_step_evaluates_compiled_functions_only(task: str) -> None:
    """What an environment needs in every step is a kernel, or the weighted sum."""
    env = ScmWorldEnv(task, backend="fake")
    env.reset(seed=0)
    for name in env.world.compiled.needed(env.observer.needed):
        mechanism = env.world.model.declared(name).mechanism
        function = mechanism.bind()
        function = function.func if isinstance(function, partial) else function
        kernel = function.kernel if isinstance(function, Stacked) else function
        assert isinstance(mechanism, Linear | Concatenation) or is_jitted(kernel), name


def test_every_readout_is_that_of_the_model() -> None:
    """What is bound beforehand gives what solving the model from scratch gives, bit for bit."""
    world = World("stacking2", backend="fake")
    world.reset(seed=0)
    for step in range(3):
        world.step(world.action_high * step / 3)
        world.do({"goal_tower.polar": [0.02 * step, 0.3], "tool_block_1.mass": 0.02 + 0.01 * step})
        now, order = world.values(), world.compiled.computed
        known = {name: value for name, value in now.items() if name not in order}
        solved = world.model.solve(known, previous=world.previous(), only=order)
        for name in order:
            np.testing.assert_array_equal(now[name], solved[name], err_msg=name)


def test_a_stacked_function_is_one_object() -> None:
    """A copy, or what comes out of a pickle, is the function itself: it is found by its name."""
    assert pickle.loads(pickle.dumps(filled)) is filled is copy.deepcopy(filled)  # noqa: S301 # ours


def test_a_weighted_sum_is_added_up_in_order() -> None:
    """The rounding is that of one sum after another, on every version of Python."""
    assert Linear(weights=(1.0, 1.0, 1.0)).bind()(1e16, 1.0, -1e16) == 0.0


def test_a_norm_is_that_of_numpy() -> None:
    """The loop over a vector agrees with numpy's norm."""
    vector = np.random.default_rng(0).normal(size=9)
    assert minus_length(vector) == pytest.approx(-np.linalg.norm(vector), rel=1e-15)
