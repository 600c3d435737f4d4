"""What happens to environments beside steps: closing, and worlds that are used by themselves."""

from __future__ import annotations

import pytest
from many_envs import KINDS, actions, check_same, make, sync

from scm_world.errors import InterventionError, NotReset


@pytest.mark.parametrize("kind", KINDS)
def test_a_closed_one_takes_no_step(kind: str) -> None:
    """After closing there is no episode; a reset begins one."""
    envs = make(kind, 2)
    envs.reset(seed=0)
    envs.step(actions(1, 2)[0])
    envs.close()
    envs.close()
    with pytest.raises(NotReset):
        envs.step(actions(1, 2)[0])
    envs.reset(seed=0)
    assert envs.step(actions(1, 2)[0])[1].shape == (2,)


def test_what_is_done_to_a_world_itself_is_seen() -> None:
    """Noise of the sensors that begins in a world that was asked for is there in the next step."""
    pair = [make("native", 2), sync(2, backend="mujoco")]
    for envs in pair:
        envs.reset(seed=0)
        envs.step(actions(1, 2)[0])
        envs.get_attr("world")[1].do({"sensor_noise": 0.05})
    one, other = (envs.step(actions(2, 2)[1]) for envs in pair)
    check_same(one, other)


def test_goals_that_are_unlike_the_others_are_named() -> None:
    """Where only goals differ, the refusal says so."""
    options = {"observation_mode": "custom", "observe": ["joint_positions"]}
    envs = make("turns", 2, "scm_world/General-v0", **options)
    envs.reset(seed=0)
    with pytest.raises(InterventionError, match="achieved_goal"):
        envs.do({1: {"nums_objects": 2}})
