"""Facts about cylindrical coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from scm_world.geometry.coordinates import from_cylindrical, to_cylindrical


def test_points_round_trip() -> None:
    """Cylindrical coordinates lead back to the point, on any leading axes."""
    points = np.random.default_rng(0).normal(size=(4, 25, 3))
    np.testing.assert_allclose(from_cylindrical(to_cylindrical(points)), points, atol=1e-15)


@pytest.mark.parametrize("y", [0.0, -0.0])
def test_the_azimuth_of_the_negative_x_axis_is_pi(y: float) -> None:
    """Azimuths are in (-pi, pi], whatever the sign of zero."""
    np.testing.assert_array_equal(to_cylindrical([-1.0, y, 0.5]), [1.0, np.pi, 0.5])


@pytest.mark.parametrize("x", [0.0, -0.0])
def test_the_azimuth_on_the_axis_is_zero(x: float) -> None:
    """Where every azimuth would do, it is zero."""
    np.testing.assert_array_equal(to_cylindrical([x, 0.0, 2.0]), [0.0, 0.0, 2.0])
