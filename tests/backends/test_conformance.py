"""Every engine passes the same suite."""

import importlib.util
from typing import ClassVar

import pytest

from scm_world.backends import Backend, make_backend
from scm_world.tasks.trifinger.hardware import PRECISE, Preset
from scm_world.testing.backend import BackendConformance


class TestMujocoFast(BackendConformance):
    """MuJoCo with large steps."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("mujoco")


class TestMujocoPrecise(TestMujocoFast):
    """MuJoCo with small steps."""

    preset: ClassVar[Preset] = PRECISE


@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")
class TestBullet(BackendConformance):
    """Bullet with large steps."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("bullet")


class TestFake(BackendConformance):
    """The backend without physics."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("fake")
