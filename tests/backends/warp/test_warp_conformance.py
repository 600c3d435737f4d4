"""The promises of an engine, on Warp's CPU device."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco_warp")

from scm_world.backends import Backend
from scm_world.backends.warp import WarpBackend
from scm_world.testing.backend import BackendConformance


class TestWarp(BackendConformance):
    """The suite of every engine, on its own model."""

    def make(self) -> Backend:
        """Create a backend on the CPU device."""
        return WarpBackend("cpu")
