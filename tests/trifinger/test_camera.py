"""Facts about cameras."""

from __future__ import annotations

import numpy as np
import pytest

from scm_world.geometry.rotations import rotation_matrix
from scm_world.models.camera import Camera, camera_from
from scm_world.tasks.trifinger.cameras import CAMERAS, ORIGINAL_CAMERAS, OVERVIEW, POSES
from scm_world.tasks.trifinger.hardware import TABLE_OFFSET

EVERY = [*CAMERAS, *ORIGINAL_CAMERAS, OVERVIEW]


@pytest.mark.parametrize("camera", EVERY, ids=lambda camera: camera.name)
def test_axes_are_a_rotation(camera: Camera) -> None:
    """Right, up and back are orthonormal and right-handed."""
    axes = camera.axes()

    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_target_is_in_the_middle() -> None:
    """The optical axis goes through the center of the picture."""
    column, row, _ = OVERVIEW.project(OVERVIEW.target)

    assert (column, row) == pytest.approx((320.0, 240.0))


@pytest.mark.parametrize("camera", [*CAMERAS, OVERVIEW], ids=lambda camera: camera.name)
def test_our_cameras_are_upright(camera: Camera) -> None:
    """What is higher in the world is higher in the picture."""
    assert camera.project([0.0, 0.0, 0.1])[1] < camera.project([0.0, 0.0, 0.0])[1]


def test_originals_have_the_published_targets() -> None:
    """The point that the predecessor looks at, and its up vector, are the published ones."""
    targets = [(-0.4548, -0.4053, -0.7931), (-0.0074, 0.5028, -0.8646), (0.4402, -0.4570, -0.7729)]
    ups = [(0.5745, 0.5470, -0.6090), (-0.0223, -0.8645, -0.5025), (-0.5545, 0.5387, -0.6343)]
    for camera, target, up in zip(ORIGINAL_CAMERAS, targets, ups, strict=True):
        np.testing.assert_allclose(np.add(camera.target, (0, 0, TABLE_OFFSET)), target, atol=2e-4)
        np.testing.assert_allclose(camera.up, up, atol=2e-4)


def test_originals_miss_the_optical_axis() -> None:
    """The predecessor's views are off by the published angles."""
    for ours, theirs, angle in zip(CAMERAS, ORIGINAL_CAMERAS, (2.66, 1.62, 1.60), strict=True):
        off = np.degrees(np.arccos(ours.axes()[2] @ theirs.axes()[2]))
        assert off == pytest.approx(angle, abs=0.006)


def test_up_along_the_axis_is_refused() -> None:
    """A camera that looks along its up vector has no right and left."""
    camera = Camera("lost", eye=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0))

    with pytest.raises(ValueError, match="camera 'lost': up"):
        camera.axes()


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_camera_from_numbers_is_the_published_one(camera: Camera) -> None:
    """Pose and quaternion of a published camera, of any length and sign, make that camera."""
    position, orientation = POSES[camera.name]
    assert camera_from(camera.name, position, orientation) == camera
    for factor in (-1.0, 3.0):
        made = camera_from(camera.name, position, factor * orientation)
        np.testing.assert_allclose(made.axes(), camera.axes(), atol=1e-12)
        assert made.eye == camera.eye

    assert np.linalg.norm(orientation) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(position, camera.eye, atol=1e-15)


def test_published_poses_are_those_of_the_predecessor() -> None:
    """Positions are published from the plane below the table top, and ours from the table top."""
    assert list(POSES) == ["60", "120", "300"]
    np.testing.assert_allclose(POSES["60"][0], [0.2496, 0.2458, 0.58 - TABLE_OFFSET])
    quaternion = np.array([0.9655, -0.0098, -0.0065, -0.2603])
    np.testing.assert_allclose(POSES["120"][1], quaternion / np.linalg.norm(quaternion))


def test_quaternion_turns_the_axes_of_the_camera() -> None:
    """The first axis points right, the second one down and the third one forward."""
    orientation = np.array([0.3, -0.5, 0.2, 0.7])
    camera = camera_from("it", [0.1, 0.2, 0.3], orientation, 40.0, 64, 32)
    right, down, forward = rotation_matrix(orientation).T

    np.testing.assert_allclose(camera.axes(), [right, -down, -forward], atol=1e-12)
    assert (camera.field_of_view, camera.width, camera.height) == (40.0, 64, 32)
    assert camera.eye == (0.1, 0.2, 0.3)


@pytest.mark.parametrize("orientation", [np.zeros(4), np.full(4, np.nan), [1.0, 0.0, 0.0]])
def test_no_orientation_is_refused(orientation: list[float]) -> None:
    """A quaternion that names no rotation makes no camera."""
    with pytest.raises(ValueError, match=r"quaternion|unpack"):
        camera_from("it", [0.0, 0.0, 1.0], orientation)
