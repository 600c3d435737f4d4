"""Every engine passes the same suite."""

import importlib.util

import pytest

from scm_world.backends import Backend, make_backend
from scm_world.testing.backend import BackendConformance


class TestMujoco(BackendConformance):
    """MuJoCo."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("mujoco")


@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")
class TestBullet(BackendConformance):
    """Bullet."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("bullet")


class TestFake(BackendConformance):
    """The backend without physics."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("fake")
