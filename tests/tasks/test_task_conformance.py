"""Every task passes the same suite on every engine."""

import importlib.util
from typing import ClassVar

import pytest

from scm_world.tasks import TASKS
from scm_world.testing.task import TaskConformance
from scm_world.world import World

needs_bullet = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)


class Pushing(TaskConformance):
    """Pushing, on one of the engines."""

    backend: ClassVar[str]

    def make(self) -> World:
        """Create a world."""
        return World("pushing", backend=self.backend)


class Reaching(TaskConformance):
    """Reaching, on one of the engines."""

    backend: ClassVar[str]

    def make(self) -> World:
        """Create a world."""
        return World("reaching", backend=self.backend)


class TestPushingFake(Pushing):
    """Pushing without physics."""

    backend = "fake"


class TestPushingMujoco(Pushing):
    """Pushing on MuJoCo."""

    backend = "mujoco"


@needs_bullet
class TestPushingBullet(Pushing):
    """Pushing on Bullet."""

    backend = "bullet"


class TestReachingFake(Reaching):
    """Reaching without physics."""

    backend = "fake"


class TestReachingMujoco(Reaching):
    """Reaching on MuJoCo."""

    backend = "mujoco"


@needs_bullet
class TestReachingBullet(Reaching):
    """Reaching on Bullet."""

    backend = "bullet"


def test_every_task_is_here() -> None:
    """A new task is tested by being added above."""
    assert {suite.__name__.lower() for suite in TaskConformance.__subclasses__()} == set(TASKS)
