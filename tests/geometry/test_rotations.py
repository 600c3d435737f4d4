"""Facts about quaternions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scm_world._types import Floats
from scm_world.geometry.rotations import (
    angle_between,
    canonical,
    from_rotation_vector,
    quaternion_product,
    rotation_kernel,
    rotation_matrix,
    to_rotation_vector,
)


@pytest.fixture
def quaternions() -> Floats:
    """Random unit quaternions of both signs, shape (2, 50, 4)."""
    draws = np.random.default_rng(0).normal(size=(2, 50, 4))
    return draws / np.linalg.norm(draws, axis=-1, keepdims=True)


def test_matrices_are_those_of_scipy(quaternions: Floats) -> None:
    """A quaternion (x, y, z, w) has the matrix that scipy gives it, on any leading axes."""
    expected = Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix().reshape(2, 50, 3, 3)
    np.testing.assert_allclose(rotation_matrix(quaternions), expected, atol=1e-15)


def test_length_does_not_matter_to_the_matrix(quaternions: Floats) -> None:
    """Three times a quaternion has the same matrix."""
    expected = rotation_matrix(quaternions)
    np.testing.assert_allclose(rotation_matrix(3.0 * quaternions), expected, atol=1e-15)


def test_products_compose_as_matrices_do(quaternions: Floats) -> None:
    """The matrix of a product is the product of the matrices."""
    p, q = quaternions
    product = rotation_matrix(p) @ rotation_matrix(q)
    np.testing.assert_allclose(rotation_matrix(quaternion_product(p, q)), product, atol=1e-15)


def test_products_broadcast(quaternions: Floats) -> None:
    """One quaternion times many is one product each."""
    many, one = quaternions[0], quaternions[1, 0]
    np.testing.assert_array_equal(
        quaternion_product(one, many)[7], quaternion_product(one, many[7])
    )


def test_both_signs_have_one_canonical_name(quaternions: Floats) -> None:
    """A quaternion and its negative become the same bits, of unit length and with w >= 0."""
    half_turns = np.array([[0.0, 0.0, -1.0, 0.0], [0.0, -3.0, 4.0, -0.0], [-1.0, 0.0, 0.0, 0.0]])
    given = np.concatenate((quaternions.reshape(-1, 4), half_turns))
    named = canonical(given)
    assert named.tobytes() == canonical(-given).tobytes()
    assert np.all(named[:, 3] >= 0.0)
    np.testing.assert_allclose(np.linalg.norm(named, axis=-1), 1.0, rtol=1e-15)


def test_the_canonical_name_stays() -> None:
    """Naming twice changes no bit."""
    named = canonical(np.random.default_rng(1).normal(size=(20_000, 4)))
    assert canonical(named).tobytes() == named.tobytes()


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 1.0, np.pi - 1e-7, np.pi])
def test_rotation_vectors_round_trip(angle: float) -> None:
    """A rotation vector of any angle up to pi comes back, near zero and near pi too."""
    axes = np.random.default_rng(2).normal(size=(100, 3))
    vectors = angle * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    back = to_rotation_vector(from_rotation_vector(vectors))
    # At pi itself the axis may come back reversed: both name the same half turn.
    sign = np.sign(np.sum(back * vectors, axis=-1, keepdims=True)) if angle == np.pi else 1.0
    np.testing.assert_allclose(sign * back, vectors, rtol=1e-14, atol=2e-15 * angle)


def test_large_angles_wrap() -> None:
    """A turn by 3 pi / 2 comes back as one by pi / 2 the other way."""
    back = to_rotation_vector(from_rotation_vector([0.0, 1.5 * np.pi, 0.0]))
    np.testing.assert_allclose(back, [0.0, -0.5 * np.pi, 0.0], atol=1e-15)


def test_angles_are_exact_and_free_of_sign() -> None:
    """The angle between orientations is that of the turn, from 1e-10 to pi, for either sign."""
    p = canonical(np.random.default_rng(3).normal(size=4))
    for angle in (0.0, 1e-10, 0.3, 3.0, np.pi):
        q = quaternion_product(from_rotation_vector([0.0, 0.6 * angle, 0.8 * angle]), p)
        assert angle_between(p, q) == pytest.approx(angle, rel=1e-9, abs=4e-16)
        assert angle_between(p, -5.0 * q) == pytest.approx(angle, rel=1e-9, abs=4e-16)
        assert 0.0 <= angle_between(p, q) <= np.pi


def test_angles_are_those_of_scipy(quaternions: Floats) -> None:
    """The angle between two orientations is the magnitude of the rotation between them."""
    p, q = quaternions
    turns = Rotation.from_quat(p).inv() * Rotation.from_quat(q)
    found = [angle_between(*pair) for pair in zip(p, q, strict=True)]
    np.testing.assert_allclose(found, turns.magnitude(), atol=1e-14)


def test_kernels_make_no_nan_of_zero() -> None:
    """To a kernel the quaternion zero is no rotation."""
    matrix = np.empty((3, 3))
    rotation_kernel(np.zeros(4), matrix)
    np.testing.assert_array_equal(matrix, np.eye(3))


@pytest.mark.parametrize("function", [canonical, rotation_matrix])
@pytest.mark.parametrize("given", [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
def test_what_is_no_quaternion_is_refused(function, given) -> None:  # type: ignore[no-untyped-def]
    """Zero, and anything but four numbers, is a ValueError."""
    with pytest.raises(ValueError, match=r"zero|unpack"):
        function(given)
