"""Every engine passes the same suite."""

import importlib.util
from typing import ClassVar

import pytest

from scm_world.backends import Backend, make_backend
from scm_world.scene import PRECISE, Preset
from scm_world.testing.backend import BackendConformance


class TestMujocoFast(BackendConformance):
    def make(self) -> Backend:
        return make_backend("mujoco")


class TestMujocoPrecise(BackendConformance):
    preset: ClassVar[Preset] = PRECISE

    def make(self) -> Backend:
        return make_backend("mujoco")


@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")
class TestBullet(BackendConformance):
    def make(self) -> Backend:
        return make_backend("bullet")


class TestFake(BackendConformance):
    def make(self) -> Backend:
        return make_backend("fake")
