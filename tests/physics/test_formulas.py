"""Experiments whose outcome a formula tells.

Speeds, masses and frictions are not those with which the presets were chosen.
"""

import math

import numpy as np
import pytest

GRAVITY = 9.81  # [m/s²]
SIZE = 0.05  # [m]
ON_FLOOR = SIZE / 2


def cube(index: int = 0, *, mass: float = 0.06, friction: float = 0.7):
    """Describe the parameters of a cube."""
    name = f"block_{index}" if index else "tool_block"
    return {
        (name, "size"): [SIZE] * 3,
        (name, "mass"): mass,
        (name, "friction"): friction,
    }


def tilted(angle: float):
    """Tilt gravity instead of the floor."""
    return [GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle)]


@pytest.mark.parametrize("gravity", [-9.81, -3.7])
def test_free_fall(lab, gravity: float) -> None:
    """A falling block has speed g t exactly, and g t²/2 within the error of the integrator."""
    seconds, start = 0.32, 1.2
    lab.place([0.02, 0.0, start], {**cube(), ("world", "gravity"): [0.0, 0.0, gravity]})
    state = lab.wait(seconds)
    velocity, fallen = state.linear_velocities[0], state.positions[0, 2] - start
    assert velocity[2] == pytest.approx(gravity * seconds, rel=1e-12)
    assert np.abs(velocity[:2]).max() < 1e-12
    expected = 0.5 * gravity * seconds**2
    assert abs(fallen / expected - 1.0) <= 1.1 * lab.preset.timestep / seconds


@pytest.mark.parametrize(
    ("speed", "floor", "mass"), [(0.65, 0.45, 0.03), (0.9, 0.8, 0.09), (0.4, 0.3, 0.05)]
)
def test_stopping_distance(lab, speed: float, floor: float, mass: float) -> None:
    """A sliding block stops after v²/(2 mu g); friction is the product of both surfaces."""
    lab.place([-0.1, 0.0, ON_FLOOR], {**cube(mass=mass), ("floor", "friction"): floor})
    start = lab.wait(0.3).positions[0, 0]
    lab.push([speed, 0.0, 0.0])
    distance = lab.wait(0.8).positions[0, 0] - start
    expected = speed**2 / (2 * 0.7 * floor * GRAVITY)
    assert distance == pytest.approx(expected, rel=0.02 if lab.precise else 0.05)


@pytest.mark.parametrize(("floor", "excess"), [(0.3, 2.0), (0.55, 1.7)])
def test_acceleration_on_a_slope(lab, floor: float, excess: float) -> None:
    """On a slope beyond the limit a block accelerates with g (sin a - mu cos a)."""
    friction = 0.7 * floor
    angle = math.atan(excess * friction)
    outside = [0.5, 0.0, ON_FLOOR]  # of the ring, where there is room
    lab.place(outside, {**cube(), ("floor", "friction"): floor})
    lab.wait(0.3)
    lab.set("world", "gravity", tilted(angle))
    lab.wait(0.2)
    times = 0.004 * np.arange(250)
    speeds = [lab.wait(0.004).linear_velocities[0, 0] for _ in times]
    expected = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
    assert np.polyfit(times, speeds, 1)[0] == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("floor", [0.35, 0.75])
def test_threshold_of_sliding(lab, floor: float) -> None:
    """A block stays where tan a is 1 % below mu, and slides where it is 1 % above."""
    friction = 0.7 * floor
    lab.place([-0.1, 0.0, ON_FLOOR], {**cube(), ("floor", "friction"): floor})
    lab.wait(0.3)
    lab.set("world", "gravity", tilted(math.atan(0.99 * friction)))
    assert lab.wait(1.5).linear_velocities[0, 0] < 2e-3
    lab.set("world", "gravity", tilted(math.atan(1.01 * friction)))
    assert lab.wait(1.5).linear_velocities[0, 0] > 5e-3


def test_creep(lab) -> None:
    """At 90 % of the limit a block creeps by at most 0.1 mm/s."""
    friction = 0.7 * 0.5
    lab.place([-0.1, 0.0, ON_FLOOR], {**cube(), ("floor", "friction"): 0.5})
    lab.wait(0.3)
    lab.set("world", "gravity", tilted(math.atan(0.9 * friction)))
    start = lab.wait(0.5).positions[0]
    creep = np.linalg.norm(lab.wait(2.0).positions[0] - start) / 2.0
    assert creep <= 1e-4


def test_tipping(lab) -> None:
    """A block three times as high as wide tips at a slope of 1:3, within 2 % or 3 %."""
    bound = 0.02 if lab.precise else 0.03
    tall = {("tool_block", "size"): [0.03, 0.03, 0.09], ("tool_block", "friction"): 1.0}
    for factor, tips in ((1 - bound, False), (1 + bound, True)):
        lab.place([0.0, 0.0, 0.045], {**tall, ("floor", "friction"): 0.9})
        lab.wait(0.3)
        lab.set("world", "gravity", tilted(math.atan(factor / 3)))
        height = lab.wait(1.5).positions[0, 2]
        assert (height < 0.03) == tips


@pytest.mark.parametrize(("left", "right"), [(0.03, 0.08), (0.05, 0.05)])
def test_momentum(lab, left: float, right: float) -> None:
    """A collision in free flight keeps the total momentum."""
    lab.place(
        [[-0.06, 0.0, 0.5], [0.06, 0.01, 0.51]],
        {**cube(0, mass=left), **cube(1, mass=right), ("world", "gravity"): [0.0] * 3},
        velocities=[[0.7, 0.0, 0.0], [-0.3, 0.0, 0.0]],
    )
    velocities = lab.wait(0.3).linear_velocities
    assert velocities[0, 0] < 0.6  # they met
    momentum = left * velocities[0] + right * velocities[1]
    np.testing.assert_allclose(momentum, [left * 0.7 - right * 0.3, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("mass", [0.03, 0.2])
def test_weight(lab, mass: float) -> None:
    """A block at rest is as high as half its size, and the floor carries its mass times g."""
    lab.place([-0.1, 0.0, ON_FLOOR], cube(mass=mass))
    state = lab.wait(0.5)
    carried = [c.force for c in lab.backend.contacts() if "tool_block" in c.bodies]
    assert sum(carried) == pytest.approx(mass * GRAVITY, rel=0.01)
    assert state.positions[0, 2] == pytest.approx(ON_FLOOR, rel=0.01)


def test_a_tower_stands(lab) -> None:
    """Five cubes, carelessly stacked, stand for ten seconds and move by 3 mm at most."""
    noise = np.random.default_rng(4).uniform(-0.002, 0.002, (5, 2))
    heights = ON_FLOOR + SIZE * np.arange(5)
    parameters = {key: value for i in range(5) for key, value in cube(i).items()}
    lab.place(np.column_stack([noise, heights]), parameters)
    start = lab.backend.read().positions.copy()
    drift = np.abs(lab.wait(10.0).positions - start).max()
    assert drift <= 3e-3
