"""The engine mujoco-warp: many worlds of one model, on a GPU or on Warp's CPU device."""

from __future__ import annotations

from scm_world.backends.warp.backend import WarpBackend

__all__ = ["WarpBackend"]
