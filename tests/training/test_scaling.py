"""Facts about scales of observations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world  # noqa: F401 # registers the environments
from scm_world.errors import UnknownOption
from scm_world.training.recipe import recipe
from scm_world.training.scaling import SCALES, scales, scales_of

PUSHING = "scm_world/Pushing-v0"


class Some:
    """What Stable-Baselines3 would see of an environment.

    Args:
        options: Of the environment.
    """

    def __init__(self, **options: Any) -> None:
        self._env = gymnasium.make(PUSHING, backend="fake", **options)
        self.observation_space = self._env.observation_space

    def get_attr(self, name: str) -> list[Any]:
        """Look an attribute up."""
        return [getattr(self._env.unwrapped, name)]


def test_scales_follow_the_quantities() -> None:
    """A position of the block has that of positions; what has none is left alone."""
    env: Any = gymnasium.make(PUSHING, backend="fake")
    layout = env.unwrapped.layout
    found = scales(layout, 56)
    assert set(found[layout["tool_block.cartesian_position"]]) == {SCALES["cartesian_position"]}
    assert set(found[layout["time_left_for_task"]]) == {1.0}


def test_the_parts_of_a_dictionary_are_joined_in_its_order() -> None:
    """Goals, which are in SI units, are left alone."""
    space = Some(goal_env=True)
    found = scales_of(space, {"goal_env": True})
    sizes = [part.shape[0] for part in space.observation_space.spaces.values()]  # type: ignore[attr-defined]
    assert len(found) == sum(sizes)
    assert (found != 1.0).sum() == (scales_of(Some(), {}) != 1.0).sum()


@pytest.mark.parametrize("env", [{"observation_mode": "pixel"}, {"normalize_observations": False}])
def test_scales_are_those_of_normalized_vectors(env: dict[str, Any]) -> None:
    """Pictures and SI units are refused."""
    with pytest.raises(UnknownOption, match=next(iter(env))):
        scales_of(Some(), env)


def test_a_policy_file_has_the_scales_in_its_weights(tmp_path: Path) -> None:
    """It acts as the network that was trained, and a training begins with the same network."""
    pytest.importorskip("stable_baselines3")
    from scm_world.evaluation.policies.weights import save_policy
    from scm_world.training.export import begin_with, exported
    from scm_world.training.learners import make_learner
    from scm_world.training.worlds import make_worlds

    made = recipe("pushing", worlds=2, steps=8, n_steps=4, batch_size=4, network={"scaled": True})
    worlds = make_worlds(made, backend="fake", seed=0)
    try:
        models = [make_learner(made, worlds.vec_env, seed=seed, length=250) for seed in (0, 1)]
    finally:
        worlds.close()
    seen = np.random.default_rng(0).uniform(-1, 1, (5, 56)).astype(np.float32)
    acted = models[0].predict(seen, deterministic=True)[0]
    policy = exported(models[0], made, {})
    np.testing.assert_allclose(policy(seen), acted, atol=1e-6)
    begin_with(models[1], made, Path(str(save_policy(tmp_path / "a.safetensors", policy))))
    np.testing.assert_allclose(models[1].predict(seen, deterministic=True)[0], acted, atol=1e-6)
