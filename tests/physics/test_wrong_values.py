"""An adapter that writes other numbers than it is given fails the experiments that measure them."""

from collections.abc import Callable
from typing import Any

import pytest
import test_fingers
import test_formulas
import test_models
import test_restitution
from lab import Lab
from test_models import CART, check_motion, check_rest

from benchmarks.sabotage import MASSES, SABOTAGES, Sabotaged, exchanged
from scm_world.backends import make_backend
from scm_world.tasks.trifinger.hardware import FAST

BY_NAME = {one.name: one for one in SABOTAGES}
SLIDE = (0.65, 0.45, 0.03)


def robot(test: Callable[..., None], *given: Any) -> Callable[[Any], None]:
    """Run an experiment with the robot on the sabotaged engine of a world."""
    return lambda world: test(Lab(world.backend, FAST), *given)


EXPERIMENTS: dict[str, Callable[[Any], None]] = {
    "mass times ten": check_rest,
    "mass inverted": lambda world: check_motion(world, CART),
    "mass of the block times ten": robot(test_formulas.test_weight, 0.03),
    "gravity upward": check_rest,
    "gravity of the task doubled": robot(test_formulas.test_free_fall, -9.81),
    "the motor turns the other way": lambda world: check_motion(world, CART),
    "damping times three": lambda world: check_motion(world, CART),
    "friction of the floor doubled": robot(test_formulas.test_stopping_distance, *SLIDE),
    "friction of the block halved": robot(test_formulas.test_stopping_distance, *SLIDE),
    "the block is a fifth larger": robot(test_formulas.test_weight, 0.03),
    "a ball is a fifth smaller": check_rest,
    "restitution doubled": robot(test_restitution.test_rebound, 0.3),
}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_wrong_value_fails_an_experiment(name: str) -> None:
    """What ``verify`` cannot see, since no edge changes, is seen by a formula."""
    if BY_NAME[name].system.endswith("bullet"):
        pytest.importorskip("pybullet")
    with pytest.raises(AssertionError):
        EXPERIMENTS[name](BY_NAME[name].make())


@pytest.mark.parametrize("engine", ["mujoco", "bullet"])
def test_permuted_masses_of_links_fail_an_experiment(engine: str) -> None:
    """The equations of motion of a finger tell its links apart."""
    if engine == "bullet":
        pytest.importorskip("pybullet")
    wrong = Sabotaged(make_backend(engine), write=exchanged(*MASSES))
    with pytest.raises(AssertionError):
        test_fingers.test_torques_and_weight_accelerate_the_fingers(Lab(wrong, FAST), 0)


def test_the_study_names_the_experiments() -> None:
    """Its list has an experiment for each sabotage of which it says that a test sees it."""
    assert {one.name for one in SABOTAGES if one.test} == EXPERIMENTS.keys()
    modules = test_fingers, test_formulas, test_models, test_restitution
    assert all(any(hasattr(m, one.test) for m in modules) for one in SABOTAGES if one.test)
