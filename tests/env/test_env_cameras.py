"""Facts about cameras that are variables."""

from __future__ import annotations

import numpy as np

from scm_world.env import ScmWorldEnv
from scm_world.tasks.trifinger.cameras import CAMERAS


def test_pictures_follow_the_variables_of_the_cameras() -> None:
    """A camera that is moved sees something else; the others see what they saw."""
    env = ScmWorldEnv("pushing", backend="fake", observation_mode="pixel", image_size=32)
    before, _ = env.reset(seed=0)
    env.do({"camera_60.position": [0.3, 0.2, 0.5]})
    after = env.observe()
    changed = [bool((before[i] != after[i]).any()) for i in range(6)]
    assert changed == [True, False, False, True, False, False]
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again, before)


def test_a_camera_of_ones_own_stays_where_it_is() -> None:
    """What is given as a camera is no variable."""
    options = {"observation_mode": "pixel", "cameras": (CAMERAS[0],), "image_size": 32}
    env = ScmWorldEnv("pushing", backend="fake", **options)
    before, _ = env.reset(seed=0)
    env.do({"camera_60.field_of_view": 80.0})
    np.testing.assert_array_equal(env.observe(), before)
