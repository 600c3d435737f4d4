"""A window on the screen, where there is one."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, final

from scm_world.errors import EngineError
from scm_world.models import Scene

if TYPE_CHECKING:
    from scm_world.backends.mujoco.opengl import Viewer


@final
class Window:
    """A window in which MuJoCo draws scenes of any engine.

    Raises:
        EngineError: There is no screen.
    """

    def __init__(self) -> None:
        if not self.is_possible():
            raise EngineError(
                "render_mode='human' opens a window, and there is no screen: neither DISPLAY nor "
                "WAYLAND_DISPLAY is set; use render_mode='rgb_array', which needs none",
                "mujoco",
            )
        self._viewer: Viewer | None = None

    @staticmethod
    def is_possible() -> bool:
        """Tell whether there is a screen."""
        if not sys.platform.startswith("linux"):
            return True
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))

    def show(self, scene: Scene) -> None:
        """Show a scene; the first time, the window opens."""
        if self._viewer is None:
            from scm_world.backends.mujoco.opengl import Viewer

            self._viewer = Viewer()
        self._viewer.show(scene)

    def close(self) -> None:
        """Close the window."""
        if self._viewer is not None:
            self._viewer.close()
