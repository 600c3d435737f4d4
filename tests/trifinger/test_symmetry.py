"""What happens in a scene happens in the scene that is turned by a third of a turn, too."""

from typing import Any

import numpy as np
import pytest

from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.symmetry import swapped, turned
from scm_world.training.imitation import lesson

DO = {
    "tool_block.cartesian_position": [0.03, 0.02, 0.0325],
    "tool_block.euler_orientation": [0.0, 0.0, 0.4],
    "goal_block.euler_orientation": [0.0, 0.0, 1.0],
}
SETTABLE = (
    "joint_positions",
    *(
        f"{b}.{p}"
        for b in ("tool_block", "goal_block")
        for p in ("cartesian_position", "orientation")
    ),
)


MASSES = tuple(f"{link}.mass" for link in hardware.LINK_NAMES)


@pytest.mark.parametrize("observations", ["plain", "privileged"])
@pytest.mark.parametrize("thirds", [1, 2])
def test_physics_has_the_symmetry_that_lessons_use(thirds: int, observations: str) -> None:
    """Turned actions in a turned scene give the turned observation, while fingers touch nothing."""
    options: Any = lesson("pushing", observations=observations).options
    one, other = (ScmWorldEnv("pushing", backend="mujoco", **options) for _ in range(2))
    random, names = np.random.default_rng(0), one.observed or ()
    masses = dict(zip(MASSES, random.uniform(0.02, 0.1, len(MASSES)), strict=True))
    one.reset(seed=0, options={"do": {**DO, **masses}})
    shown = [n for n in names if n.startswith(("camera", "robot_finger", "light_direction"))]
    scene = turned(one.world.evaluate(()), (*SETTABLE, *MASSES, *shown, "goal_block.polar"), thirds)
    del scene["goal_block.cartesian_position"]  # it follows
    other.reset(seed=0, options={"do": scene})
    for _ in range(25):
        action: Any = random.uniform(-0.3, 0.3, 9)
        one.step(action)
        observation: Any = other.step(swapped(action, thirds))[0]
        symmetries = one.world.task.observation.symmetries
        assert symmetries is not None
        (first, order), (second, _) = symmetries(one.world.evaluate(names), names)
        assert not np.allclose(one.observe(), observation, atol=1e-3)  # type: ignore[arg-type]
        seen = one.observe_values(first if thirds == 1 else second)
        np.testing.assert_allclose(seen, observation, atol=1e-6)
    np.testing.assert_array_equal(action[order], swapped(action, 1))
    one.close()
    other.close()


def test_a_wall_stays_where_it_is() -> None:
    """Where one stands, no turned scene is shown."""
    env = ScmWorldEnv("pick_and_place", backend="fake")
    assert env.world.task.observation.symmetries is None
    assert not lesson("pick_and_place").symmetric


def test_three_thirds_are_a_whole_turn() -> None:
    """Turned three times, everything is where it was."""
    env = ScmWorldEnv("pushing", backend="fake")
    env.reset(seed=3, options={"do": DO})
    names = (*SETTABLE, "end_effector_positions", "block.size")
    values = {name: np.array(env.world[name]) for name in names}
    found: Any = values
    for _ in range(3):
        found = turned(found, names, 1)
    for name in names:
        np.testing.assert_allclose(found[name], values[name], atol=1e-12, err_msg=name)


def test_what_has_no_known_symmetry_is_refused() -> None:
    """The message names the variable."""
    with pytest.raises(UnknownOption, match=r"wind"):
        turned({"wind": np.zeros(3)}, ("wind",), 1)
