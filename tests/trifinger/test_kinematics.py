"""Facts about the closed-form kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scm_world._types import Floats
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import forward, inverse, point_kernel

HEIGHT = hardware.NOMINAL_HEIGHT
LOW, HIGH = np.array(hardware.JOINT_LOW), np.array(hardware.JOINT_HIGH)

# fmt: off
PUBLISHED = {
    "rest": (hardware.REST, (-0.05945, 0.158637, 0.055863, 0.167109, -0.027833, 0.055863,
                              -0.107659, -0.130804, 0.055863)),
    "zero": ((0.0,) * 9, (-0.05945, 0.0455, 0.009, 0.069129, 0.028735, 0.009,
                          -0.009679, -0.074235, 0.009)),
    "raised": (hardware.RAISED, (0.009192, -0.023889, 0.269447, -0.025284, 0.003984, 0.269447,
                                  0.016092, 0.019905, 0.269447)),
    "low": (hardware.JOINT_LOW, (-0.020512, 0.035826, 0.269566, 0.041282, -0.000149, 0.269566,
                                  -0.02077, -0.035677, 0.269566)),
    "high": (hardware.JOINT_HIGH, (-0.013122, 0.047119, 0.391224, 0.047368, -0.012195, 0.391224,
                                    -0.034245, -0.034924, 0.391224)),
}  # Source: CausalWorld 1.2, computed from its URDF.
# fmt: on


def chain(joint_positions: Floats, finger: int) -> list[tuple[Floats, Rotation]]:
    """Walk down one finger, hinge by hinge, as an engine would."""
    world = Rotation.from_rotvec([0, 0, hardware.WORLD_YAW])
    up = [0.0, 0.0, HEIGHT - hardware.TABLE_OFFSET]
    position = np.add(world.apply(hardware.FINGER_OFFSET[finger]), up)
    turn = world * Rotation.from_rotvec([0, 0, hardware.FINGER_YAW[finger]])
    frames = [(position, turn)]
    hinges = zip(hardware.JOINT_ORIGINS, hardware.JOINT_AXES, strict=True)
    for joint, (origin, axis) in enumerate(hinges):
        position = position + turn.apply(origin)
        angle = joint_positions[3 * finger + joint]
        turn = turn * Rotation.from_rotvec(np.multiply(axis, angle))
        frames.append((position, turn))
    frames.append((position + turn.apply(hardware.TIP_ORIGIN), turn))
    return frames


@pytest.mark.parametrize("pose", PUBLISHED)
def test_tips_are_where_the_predecessor_has_them(pose: str) -> None:
    """The published check values hold to their last digit."""
    joint_positions, tips = PUBLISHED[pose]

    np.testing.assert_allclose(forward(joint_positions, HEIGHT), tips, atol=6e-7)


def test_points_are_those_of_the_chain() -> None:
    """Joints and tips equal a walk down the chain of hinges."""
    rng, shoulder = np.random.default_rng(0), hardware.JOINT_ORIGINS[1][1]
    knee = shoulder + hardware.JOINT_ORIGINS[2][1]
    for _ in range(100):
        joint_positions = rng.uniform(LOW, HIGH)
        tips = forward(joint_positions, HEIGHT).reshape(3, 3)
        for finger in range(3):
            angles = joint_positions[3 * finger : 3 * finger + 3]
            places = (0.0, 0.0, 0.0), (shoulder, 0.0, 0.0), (knee, 1.0, 0.0)
            found = [point_kernel(finger, angles, HEIGHT, *place) for place in places]
            expected = [position for position, _ in chain(joint_positions, finger)[1:]]
            np.testing.assert_allclose([*found, tips[finger]], expected, atol=1e-11)


def test_height_lifts_the_robot() -> None:
    """A higher robot has higher tips, and nothing else changes."""
    lifted = forward(hardware.REST, HEIGHT + 0.05) - forward(hardware.REST, HEIGHT)

    np.testing.assert_allclose(lifted.reshape(3, 3), np.tile([0.0, 0.0, 0.05], (3, 1)), atol=1e-15)


def test_inverse_undoes_forward() -> None:
    """Every pose within the bounds is found again from its tips, in joints and in space."""
    rng = np.random.default_rng(2)
    for joint_positions in rng.uniform(LOW, HIGH, size=(5000, 9)):
        tips = forward(joint_positions, HEIGHT)
        solution = inverse(tips, HEIGHT, near=joint_positions)

        assert solution.reached.all()
        np.testing.assert_allclose(forward(solution.joint_positions, HEIGHT), tips, atol=1e-12)
        straight = np.abs(joint_positions[2::3])
        regular = np.repeat((straight > 0.05) & (solution.reached), 3)
        np.testing.assert_allclose(
            solution.joint_positions[regular], joint_positions[regular], atol=1e-10
        )


def test_inverse_returns_to_the_tips_from_anywhere() -> None:
    """Whatever it stays near to, the solution brings the tips to their targets."""
    rng = np.random.default_rng(3)
    for _ in range(1000):
        tips = forward(rng.uniform(LOW, HIGH), HEIGHT)
        solution = inverse(tips, HEIGHT, near=rng.uniform(LOW, HIGH))

        assert solution.reached.all()
        assert (solution.joint_positions >= LOW).all()
        assert (solution.joint_positions <= HIGH).all()
        np.testing.assert_allclose(forward(solution.joint_positions, HEIGHT), tips, atol=1e-12)


def test_inverse_stays_on_the_branch() -> None:
    """The knee bends the way it is bent already."""
    for bend in (-1.0, 1.0):
        pose = np.tile([0.0, -bend * 0.4, bend * 0.8], 3)
        solution = inverse(forward(pose, HEIGHT), HEIGHT, near=pose)
        np.testing.assert_allclose(solution.joint_positions, pose, atol=1e-12)


@pytest.mark.parametrize("pose", [hardware.JOINT_LOW, hardware.JOINT_HIGH])
def test_corners_of_the_bounds_are_reached(pose: tuple[float, ...]) -> None:
    """A pose on its bounds does not fall out of them by rounding."""
    solution = inverse(forward(pose, HEIGHT), HEIGHT, near=pose)

    assert solution.reached.all()
    np.testing.assert_allclose(solution.joint_positions, pose, atol=1e-10)


def test_each_finger_answers_for_itself() -> None:
    """One target out of reach does not disturb the other two fingers."""
    tips = forward(hardware.REST, HEIGHT)
    tips[3:6] = (3.0, 0.0, 0.0)
    solution = inverse(tips, HEIGHT, near=hardware.REST)

    assert solution.reached.tolist() == [True, False, True]
    np.testing.assert_allclose(solution.joint_positions[:3], hardware.REST[:3], atol=1e-12)
    np.testing.assert_allclose(solution.joint_positions[6:], hardware.REST[6:], atol=1e-12)


def test_target_below_reach_stretches_the_leg() -> None:
    """A target straight below the finger and too low is aimed at with a straight leg."""
    tips = forward(np.zeros(9), HEIGHT)
    tips[2::3] -= 0.05
    solution = inverse(tips, HEIGHT, near=hardware.REST)

    assert not solution.reached.any()
    np.testing.assert_allclose(solution.joint_positions[2::3], 0.0)
    assert (forward(solution.joint_positions, HEIGHT)[2::3] < 0.01).all()


def test_target_only_an_engine_could_reach_is_refused() -> None:
    """What lies beyond the software bounds is not reached, and the bounds are kept."""
    beyond = np.tile([1.3, 0.0, -0.5], 3)
    solution = inverse(forward(beyond, HEIGHT), HEIGHT, near=beyond)
    there = forward(solution.joint_positions, HEIGHT) - forward(beyond, HEIGHT)

    distances = np.linalg.norm(there.reshape(3, 3), axis=1)
    np.testing.assert_array_equal(solution.reached, distances < 1e-8)
    assert (solution.joint_positions <= HIGH).all()


def base_positions() -> Floats:
    """Where the first axes begin."""
    return np.concatenate([chain(np.zeros(9), finger)[0][0] for finger in range(3)])


@pytest.mark.parametrize("lateral", [0.0, 1e-300, 0.01, hardware.LATERAL_OFFSET])
def test_singular_targets_give_finite_joints(lateral: float) -> None:
    """On the first axis, or too near to it, the answer is finite and says so."""
    targets = base_positions()
    targets[1] += lateral
    solution = inverse(targets, HEIGHT, near=hardware.REST)

    assert np.isfinite(solution.joint_positions).all()
    assert not solution.reached.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308])
def test_absurd_targets_give_finite_joints(bad: float) -> None:
    """Not a number, infinity and overflow are not reached and do not spread."""
    targets = forward(hardware.REST, HEIGHT)
    targets[0] = bad
    solution = inverse(targets, HEIGHT, near=hardware.REST)

    assert solution.reached.tolist() == [False, True, True]
    assert np.isfinite(solution.joint_positions).all()


@settings(max_examples=300, deadline=None)
@given(st.lists(st.floats(-0.6, 0.6), min_size=9, max_size=9))
def test_any_target_gives_joints_within_bounds(targets: list[float]) -> None:
    """The flags say exactly whether the tips are there, and the bounds always hold."""
    solution = inverse(targets, HEIGHT, near=hardware.REST)
    there = forward(solution.joint_positions, HEIGHT) - targets

    assert (solution.joint_positions >= LOW).all()
    assert (solution.joint_positions <= HIGH).all()
    distances = np.linalg.norm(there.reshape(3, 3), axis=1)
    np.testing.assert_array_equal(solution.reached, distances <= 1.001e-8)


def test_wrong_shape_is_refused() -> None:
    """Three numbers are not nine."""
    with pytest.raises(ValueError, match=r"size 3 into shape \(9,\)"):
        inverse(np.zeros(3), HEIGHT, hardware.REST)
