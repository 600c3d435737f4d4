"""The MuJoCo engine. It is checked and imported when ``MujocoBackend`` is first asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scm_world.backends.mujoco.installation import check_installation

if TYPE_CHECKING:
    from scm_world.backends.mujoco.backend import MujocoBackend


def __getattr__(name: str) -> object:
    if name != "MujocoBackend":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    check_installation()
    from scm_world.backends.mujoco.backend import MujocoBackend

    globals()[name] = MujocoBackend
    return MujocoBackend


__all__ = ["MujocoBackend", "check_installation"]
